"""The poses of a topic in a window as arrays, from its columns, else from its messages."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from functools import cached_property, partial
from operator import itemgetter
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.poses import NO_POSES, FrameCodes, Poses, joined_poses
from ros2_memory.columns.poses import NoPoseError, PoseColumns, rounded
from ros2_memory.columns.steps import METRES
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
    from collections.abc import Callable, Container, Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.columns.units import Rows
    from ros2_memory.core.model import Pose, TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.robots import ParallelRecordings
    from ros2_memory.history.view import View

_MOST_SLICES: Final = 64
"""Of more between its ends, a block may have most slices without a pose."""


@dataclass
class PoseRows:
    """Poses that no other ones overlap in time.

    Attributes:
        first: a log time (ns) that none of the poses is earlier than.
        last: one that none is later than.
        load: returns the poses.
        rows: what they are read of; none if not all of them are poses here.
    """

    first: Ns
    last: Ns
    load: Callable[[], Poses]
    rows: Sequence[Rows] = ()

    def parts_between(self, start: Ns, stop: Ns) -> Sequence[int] | None:
        """Returns the numbers of the whole parts whose rows at these log times are all poses here.

        None if there may be others, too.
        """
        parts = [rows.part_between(start, stop) for rows in self.rows]
        known = [part for part in parts if part is not None]
        return known if known and len(known) == len(parts) else None

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
        return self.load()


def pose_rows(
    view: View,
    topic: str,
    window: TimeWindow,
    failures: list[UndecodableError],
    *,
    among: Callable[[Path], bool],
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


def poses_by_bag(view: View, tables: Iterable[Rows], files: Container[str]) -> dict[str, Poses]:
    """Returns the poses of each of some bags, by their files; of none in which a message has none.

    Args:
        view: of the call.
        tables: all rows of a topic, of these bags and of others.
        files: of the bags.
    """
    reader = PoseReader(view, [])
    parts: dict[str, list[Poses]] = defaultdict(list)
    for rows in tables:
        poses = reader.poses_of_all(rows)
        for bag, positions in rows.bag_rows(files):
            of_bag = poses.rows(positions) if poses else reader.poses_of_all(rows.some(positions))
            parts[bag.file].append(of_bag or NO_POSES)
    return {file: joined_poses(of_bag) for file, of_bag in parts.items() if all(map(len, of_bag))}


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
        known = () if any(map(self._held_by_others, rows)) else rows
        first, last = min(some.first for some in rows), max(some.last for some in rows)
        return PoseRows(first, last, partial(self._joined, rows), known)

    def _joined(self, rows: Sequence[Rows]) -> Poses:
        counting = map(self._without_others, rows)
        return joined_poses([self.poses(some) for some in counting if len(some)])

    def _without_others(self, rows: Rows) -> Rows:
        """Returns the rows without those whose time another recording has."""
        for beside in self._held_by_others(rows):
            is_held = (rows.times >= beside.span.start) & (rows.times < beside.span.stop)
            if beside.bags:
                is_of_bags = np.zeros(len(rows), np.bool_)
                for bag, positions in rows.bag_rows():
                    is_of_bags[positions] = bag.file in beside.bags
                is_held &= is_of_bags
            rows = rows.some(np.flatnonzero(~is_held))
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
            poses = of_columns(self._view, rows, self._by_columns)
        except NoPoseError:
            for message in messages_of(self._view, rows.some(np.array([0]))):
                lack = describe_lack(self._view, "position", message)
                raise InvalidArgumentsError(lack) from None
            return joined_poses([])  # deleted meanwhile
        return self._by_messages(rows) if poses is None else joined_poses(poses)

    def poses_of_all(self, rows: Rows) -> Poses | None:
        """Returns the poses of rows, each at the place of its row; None where a row has none."""
        try:
            poses = self.poses(rows)
        except InvalidArgumentsError:
            return None
        return poses if len(poses) == len(rows) else None

    def _by_columns(self, rows: Rows) -> Poses | None:
        read = partial(self._columns.of, rows.table, rows.times, rows.index)
        if rows.index is None and self._view.call.stored:
            # Of the poses of a part its path, track, standstills and sights are made.
            return rows.table.remember("poses", read, lambda poses: 1000 + 76 * len(poses or ()))
        return read()

    def _by_messages(self, rows: Rows) -> Poses:
        extractor = self._view.extractor
        samples: list[tuple[Ns, Pose, float]] = []
        for stored in messages_of(self._view, rows):
            message = self._view.bags.decode(stored, self._failures)
            if message is not None:
                pose = extractor.pose(message, stored.type)
                twist = extractor.twist(message, stored.type)
                if pose is None:
                    raise InvalidArgumentsError(describe_lack(self._view, "position", stored))
                speed = math.nan if twist is None else math.hypot(*twist.linear)
                samples.append((stored.time, pose, speed))
        # Those of a part come bag after bag, in the order in which bags were stored.
        samples.sort(key=itemgetter(0))
        times, poses, speeds = zip(*samples, strict=True) if samples else ((), (), ())
        turns = [pose.orientation or (math.nan,) * 4 for pose in poses]
        places = np.array([pose.position for pose in poses], np.float64).reshape(-1, 3)
        frames = Texts.of([pose.frame_id for pose in poses])
        return Poses(
            np.array(times, np.int64),
            rounded(places, METRES),
            np.array(turns, np.float64).reshape(-1, 4),
            FrameCodes(frames.codes, frames.words),
            np.array(speeds, np.float64),
        )
