"""The poses of a topic in a window as arrays, from its columns, else from its messages."""

from __future__ import annotations

import math
from functools import cached_property, partial
from typing import TYPE_CHECKING, Final, TypeVar

import numpy as np

from ros2_memory.analysis.poses import FrameCodes, Poses, joined_poses
from ros2_memory.columns.poses import NoPoseError, PoseColumns, rounded
from ros2_memory.columns.steps import METRES
from ros2_memory.columns.table import Texts
from ros2_memory.columns.units import BagUnit, Rows
from ros2_memory.core.errors import InvalidArgumentsError, UndecodableError
from ros2_memory.core.model import BagFile, Pose, TimeWindow
from ros2_memory.history.no_data import describe_lack
from ros2_memory.history.scan import (
    blocks,
    messages_of,
    of_columns,
    scan,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.columns.fragments import Sized
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.robots import ParallelRecordings
    from ros2_memory.history.view import View


_MOST_SLICES: Final = 64
"""Of more between its ends, a block may have most slices without a pose."""


T = TypeVar("T", bound="Sized")


class PoseRows:
    """Poses that no other ones overlap in time.

    Args:
        span: log times (ns) that none of them is earlier or later than.
        load: returns the poses.
        parts: the numbers of the parts of which all rows are here; None if there are others, too.

    Attributes:
        first: a log time (ns) that none of the poses is earlier than.
        last: one that none is later than.
        parts: see above.
    """

    def __init__(
        self,
        span: tuple[Ns, Ns],
        load: Callable[[], Poses],
        parts: tuple[int, ...] | None = None,
    ) -> None:
        self.first, self.last = span
        self.parts = parts
        self._load = load

    def slices(self, length: Ns) -> Iterable[int]:
        """Returns which slices of the clock may have poses, counted from the epoch."""
        first, last = self.first // length, self.last // length
        if last - first < _MOST_SLICES:
            return range(first, last + 1)
        numbers: list[int] = np.unique(self.poses.times // length).tolist()
        return numbers

    @cached_property
    def poses(self) -> Poses:
        """The poses, in order of log time.

        Raises:
            InvalidArgumentsError: messages carry no position.
        """
        return self._load()


def pose_rows(
    view: View,
    topic: str,
    window: TimeWindow,
    failures: list[UndecodableError],
    *,
    among: Callable[[Path], bool] = lambda _: True,
) -> Iterator[PoseRows]:
    """Yields the poses of a topic in a window, in order of time; the columns are not read yet.

    Positions are rounded to 0.1 mm, as the store has them. Why messages cannot be decoded is added
    to `failures` as poses are read. `among`: which recordings count.

    Raises:
        QueryTimeoutError: while it is iterated, when the deadline has passed.
    """
    reader = PoseReader(view, failures)
    counting = (rows for rows in scan(view, topic, window) if among(rows.recording))
    for together in blocks(counting, newest_first=False):
        yield reader.block(together)


def poses_of(samples: Iterable[tuple[Ns, Pose, float | None]]) -> Poses:
    """Returns poses with their log times, and the speed (m/s) that each message states, if any."""
    rows = [*samples]
    unknown = (math.nan,) * 4
    turns = [unknown if pose.orientation is None else pose.orientation for _, pose, _ in rows]
    places = np.array([pose.position for _, pose, _ in rows], np.float64).reshape(-1, 3)
    frames = Texts.of([pose.frame_id for _, pose, _ in rows])
    return Poses(
        np.array([time for time, *_ in rows], np.int64),
        rounded(places, METRES),
        np.array(turns, np.float64).reshape(-1, 4),
        FrameCodes(frames.codes, frames.words),
        np.array([math.nan if speed is None else speed for *_, speed in rows], np.float64),
    )


def poses_of_bag(view: View, bag: BagFile, topic: str) -> Poses | None:
    """Returns the poses of a topic in a bag; None without any, and where some message has none."""
    failures: list[UndecodableError] = []
    reader = PoseReader(view, failures)
    tables = view.bags.tables(bag, topic, TimeWindow.everything())
    units = [BagUnit(bag, table, nth) for nth, table in enumerate(tables) if len(table)]
    try:
        poses = joined_poses([reader.poses(Rows(unit, lambda: None)) for unit in units])
    except InvalidArgumentsError:
        return None
    return poses if len(poses) and not failures else None


class PoseReader:
    """Reads the poses of rows by their columns, else by their messages.

    Args:
        view: of the memory.
        failures: why messages cannot be decoded is added to it.
        beside: recordings that have poses at the same time; those of the other one do not count.
    """

    def __init__(
        self,
        view: View,
        failures: list[UndecodableError],
        beside: Sequence[ParallelRecordings] = (),
    ) -> None:
        self._view = view
        self._failures = failures
        self._beside = beside
        self._columns = PoseColumns(view.extractor)

    def block(self, rows: Sequence[Rows]) -> PoseRows:
        """Returns the poses of rows that overlap in time, in the order of `blocks`."""
        span = (
            min(table_rows.first for table_rows in rows),
            max(table_rows.last for table_rows in rows),
        )
        part_numbers = [table_rows.part for table_rows in rows]
        numbers = tuple(part for part in part_numbers if part is not None)
        is_whole = len(numbers) == len(part_numbers) and not any(map(self._held_by_others, rows))
        parts = numbers if is_whole else None
        return PoseRows(span, partial(self._joined, rows), parts)

    def trouble(self) -> Hashable:
        """Returns how many failures and notes there are: more once something could not be read."""
        return len(self._failures), self._view.notes.added

    def _joined(self, rows: Sequence[Rows]) -> Poses:
        counting = [self._without_others(table_rows) for table_rows in rows]
        return joined_poses([self.poses(table_rows) for table_rows in counting if len(table_rows)])

    def _without_others(self, rows: Rows) -> Rows:
        """Returns the rows that others do not have the time of."""
        for beside in self._held_by_others(rows):
            out = (rows.times >= beside.span.start) & (rows.times < beside.span.stop)
            if beside.bags:
                positions = [where for bag, where in rows.bag_rows() if bag.file in beside.bags]
                is_of_bags = np.zeros(len(rows), np.bool_)
                is_of_bags[np.concatenate([np.empty(0, np.int64), *positions])] = True
                out &= is_of_bags
            rows = rows.some(np.flatnonzero(~out))
        return rows

    def _held_by_others(self, rows: Rows) -> list[ParallelRecordings]:
        """Returns the pairs by which another recording holds the time of these rows first."""
        return [
            beside
            for beside in self._beside
            if beside.other == rows.recording and beside.span.overlaps(rows.first, rows.last)
        ]

    def poses(self, rows: Rows) -> Poses:
        """Returns the poses of rows, in order of log time.

        Raises:
            InvalidArgumentsError: messages carry no position.
        """
        try:
            poses = of_columns(
                self._view,
                rows,
                lambda table_rows: self._columns.of(
                    table_rows.table, table_rows.times, table_rows.index
                ),
            )
        except NoPoseError:
            for message in messages_of(self._view, rows.some(np.array([0]))):
                lack = describe_lack(self._view, "position", message)
                raise InvalidArgumentsError(lack) from None
            return joined_poses([])  # deleted meanwhile
        return poses_of(self._decoded(rows)) if poses is None else joined_poses(poses)

    def _decoded(self, rows: Rows) -> Iterator[tuple[Ns, Pose, float | None]]:
        extractor = self._view.extractor
        samples: list[tuple[Ns, Pose, float | None]] = []
        for stored in messages_of(self._view, rows):
            type_name = stored.type
            message = self._view.bags.decode(stored, self._failures)
            if message is None:
                continue
            pose, twist = extractor.pose(message, type_name), extractor.twist(message, type_name)
            if pose is None:
                raise InvalidArgumentsError(describe_lack(self._view, "position", stored))
            samples.append(
                (stored.time, pose, None if twist is None else math.hypot(*twist.linear))
            )
        # Those of a part come bag after bag, in the order in which bags were stored.
        yield from sorted(samples, key=lambda sample: sample[0])
