"""The poses of a topic in a window as arrays, from its columns, else from its messages."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.poses import FrameCodes, Poses, joined_poses
from ros2_memory.columns.pack import METRES
from ros2_memory.columns.poses import NoPoseError, PoseColumns, rounded
from ros2_memory.columns.table import Texts
from ros2_memory.core.errors import InvalidArgumentsError, UndecodableError
from ros2_memory.history.no_data import describe_lack
from ros2_memory.history.scan import (
    blocks,
    messages_of,
    of_columns,
    scan,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.columns.units import Rows
    from ros2_memory.core.model import Pose, TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.robots import ParallelRecordings
    from ros2_memory.history.view import View

_MOST_SLICES: Final = 64
"""If a block spans more slices, its poses are read to see which slices have some."""


@dataclass
class PoseRows:
    """A block of poses that no other block overlaps in time. Its poses are read on demand.

    Attributes:
        first: no pose is earlier than this log time (ns).
        last: no pose is later.
        load: returns the poses.
        rows: the rows that they are read from; empty if some of these rows do not count.
    """

    first: Ns
    last: Ns
    load: Callable[[], Poses]
    rows: Sequence[Rows] = ()

    def parts_between(self, start: Ns, stop: Ns) -> Sequence[int] | None:
        """Returns the numbers of the stored parts that have all poses between two log times.

        None if some of the poses are not in whole parts.
        """
        parts: list[int] = []
        for rows in self.rows:
            part = rows.part_between(start, stop)
            if part is None:
                return None
            parts.append(part)
        return parts or None

    def slices(self, length: Ns) -> Iterable[int]:
        """Returns the slices of the clock that may have poses, counted from the epoch."""
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
        return self.load()


def pose_rows(
    view: View,
    topic: str,
    window: TimeWindow,
    *,
    among: Callable[[Path], bool],
) -> Iterator[PoseRows]:
    """Yields blocks of the poses of a topic in a window, in order of time.

    Positions are rounded to 0.1 mm, as in the store.

    Args:
        view: of the call.
        topic: of the poses.
        window: of log time.
        among: returns whether a recording counts.
    """
    reader = PoseReader(view)
    counting = (rows for rows in scan(view, topic, window) if among(rows.recording))
    for together in blocks(counting, newest_first=False):
        yield reader.block(together)


class PoseReader:
    """Reads the poses of rows from their columns, else from their messages.

    Args:
        view: of the call.
        parallel: recordings with different poses at the same time: then the `other` one of a pair
            does not count.
        failures: the list to which messages that cannot be decoded are added; None for an own one.
    """

    def __init__(
        self,
        view: View,
        parallel: Sequence[ParallelRecordings] = (),
        failures: list[UndecodableError] | None = None,
    ) -> None:
        self._view = view
        self.failures: list[UndecodableError] = [] if failures is None else failures
        self._parallel = parallel
        self._columns = PoseColumns(view.extractor)

    def block(self, rows: Sequence[Rows]) -> PoseRows:
        """Returns the block of rows that overlap in time, in the order of `blocks`."""
        first, last = min(part.first for part in rows), max(part.last for part in rows)
        all_count = not any(map(self.overruling, rows))
        return PoseRows(first, last, partial(self._joined, rows), rows if all_count else ())

    def _joined(self, rows: Sequence[Rows]) -> Poses:
        return joined_poses([*map(self.poses, rows)])

    def _counting(self, rows: Rows) -> Rows:
        """Returns the rows without those at whose time another recording counts."""
        for pair in self.overruling(rows):
            is_overruled = pair.span.holding(rows.times)
            if pair.bags:
                is_of_bags = np.zeros(len(rows), np.bool_)
                for bag, positions in rows.bag_rows():
                    is_of_bags[positions] = bag.file in pair.bags
                is_overruled &= is_of_bags
            rows = rows.some(np.flatnonzero(~is_overruled))
        return rows

    def overruling(self, rows: Rows) -> list[ParallelRecordings]:
        """Returns the pairs by which another recording counts at times of these rows."""
        return [
            pair
            for pair in self._parallel
            if (pair.bags or pair.other == rows.recording)
            and pair.span.overlaps(rows.first, rows.last)
        ]

    def poses(self, rows: Rows) -> Poses:
        """Returns the poses of rows, in order of log time, that count.

        Raises:
            InvalidArgumentsError: messages carry no position.
        """
        rows = self._counting(rows)
        if not len(rows):
            return joined_poses([])
        try:
            poses = of_columns(self._view, rows, self._read_columns)
        except NoPoseError:
            for message in messages_of(self._view, rows.some(np.array([0]))):
                lack = describe_lack(self._view, "position", message)
                raise InvalidArgumentsError(lack) from None
            return joined_poses([])  # deleted meanwhile
        return self._read_messages(rows) if poses is None else joined_poses(poses)

    def poses_of_all(self, rows: Rows) -> Poses | None:
        """Returns one pose for each row; None if a row has none."""
        try:
            poses = self.poses(rows)
        except InvalidArgumentsError:
            return None
        return poses if len(poses) == len(rows) else None

    def _read_columns(self, rows: Rows) -> Poses | None:
        read = partial(self._columns.of, rows.table, rows.times, rows.index)
        if rows.index is None and self._view.call.stored:
            # The path, track, standstills and sights of a part are all made of its poses.
            return rows.table.remember("poses", read, lambda poses: 1000 + 76 * len(poses or ()))
        return read()

    def _read_messages(self, rows: Rows) -> Poses:
        extractor = self._view.extractor
        times: list[Ns] = []
        poses: list[Pose] = []
        speeds: list[float] = []
        for stored, message in self._view.bags.decoded(
            messages_of(self._view, rows), self.failures
        ):
            pose = extractor.pose(message, stored.type)
            twist = extractor.twist(message, stored.type)
            if pose is None:
                raise InvalidArgumentsError(describe_lack(self._view, "position", stored))
            times.append(stored.time)
            poses.append(pose)
            speeds.append(math.nan if twist is None else math.hypot(*twist.linear))
        turns = [pose.orientation or (math.nan,) * 4 for pose in poses]
        places = np.array([pose.position for pose in poses], np.float64).reshape(-1, 3)
        frames = Texts.of([pose.frame_id for pose in poses])
        unsorted = Poses(
            np.array(times, np.int64),
            rounded(places, METRES),
            np.array(turns, np.float64).reshape(-1, 4),
            FrameCodes(frames.codes, frames.words),
            np.array(speeds, np.float64),
        )
        # A part has bag after bag, in the order in which they were stored.
        return unsorted.rows(np.argsort(unsorted.times, kind="stable"))
