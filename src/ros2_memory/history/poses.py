"""The poses of a topic in a window as arrays, from its columns, else from its messages."""

from __future__ import annotations

import math
from functools import cached_property, partial
from hashlib import sha256
from typing import TYPE_CHECKING, Final, TypeVar

import numpy as np

from ros2_memory.analysis.poses import Frames, Poses, joined_poses
from ros2_memory.columns.fragments import FragmentKey
from ros2_memory.columns.poses import NoPoseError, PoseColumns, rounded
from ros2_memory.columns.steps import METRES
from ros2_memory.columns.table import Texts
from ros2_memory.columns.units import BagUnit, Rows
from ros2_memory.core.errors import InvalidArgumentsError, UndecodableError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MIN_NS
from ros2_memory.history.no_data import describe_lack
from ros2_memory.history.scan import (
    blocks,
    joined_back,
    messages_of,
    of_columns,
    open_scan,
    remembered,
    scan,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.columns.fragments import Kind, Sized
    from ros2_memory.columns.scan import Stretch
    from ros2_memory.core.model import BagFile, Pose
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.robots import Beside
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


def slices_of_poses(
    view: View,
    topic: str,
    window: TimeWindow,
    kind: Kind[T],
    make: Callable[[PoseSlice], T],
    *,
    failures: list[UndecodableError],
    length: Ns,
    beside: Ns = 0,
    settings: str = "",
    reached: Callable[[Ns], None] = lambda _: None,
    twice: Sequence[Beside] = (),
) -> Iterator[tuple[Ns, T]]:
    """Yields what is made of the poses of a topic in slices of the clock, the newest first.

    Each with a time (log time, ns) that no pose of it is earlier than.

    Args:
        view: of the call.
        topic: of the poses.
        window: of log time.
        kind: what is made; it is stored, and joined by stretches of the clock.
        make: makes it.
        failures: as for `pose_rows`.
        length: of a slice (ns); they are counted from the epoch.
        beside: poses so far before and after a slice (ns) are with it, too.
        settings: what it depends on besides the poses.
        reached: as for `scan`.
        twice: recordings that are beside each other: the poses are those of the first.

    Raises:
        InvalidArgumentsError: while it is iterated, messages carry no position.
        QueryTimeoutError: while it is iterated, when the deadline has passed.
    """
    opened = open_scan(view, topic, window, stored=view.call.stored, reached=reached)
    reader = PoseReader(view, failures, twice)

    def made_in(stretch: Stretch) -> Iterator[tuple[Ns, T]]:
        around = stretch.window.widened(beside)
        rows = opened.rows(newest_first=True, among=around)
        every = map(reader.block, blocks(rows, newest_first=True))
        needs_all = stretch.parts is not None or not view.call.stored
        found = (block for block in every if block.parts or needs_all)
        for some in slices_back(found, length, beside):
            if stretch.window.overlaps(some.start, some.stop - 1):
                made = partial(make, some)
                yield some.start, remembered(view, kind, some.key(settings), made, reader.trouble)

    def key_of(stretch: Stretch) -> FragmentKey | None:
        around = stretch.window.widened(beside)
        near = [one for one in twice if around.overlaps(one.span.start, one.span.stop - 1)]
        if not near:
            return stretch.key(settings)
        # Not the whole span: it grows with each bag, and poses beyond change nothing here.
        left_out = repr(
            [(str(one.other), one.span.intersect(around), sorted(one.bags)) for one in near]
        )
        return stretch.key(f"{settings} {sha256(left_out.encode()).hexdigest()}")

    yield from joined_back(
        view, opened, kind, made_in, key_of, beside=beside, trouble=reader.trouble
    )


class PoseSlice:
    """The poses in a slice of the clock, and those beside it.

    Attributes:
        start: log time (ns) where it begins.
        stop: where it ends.
    """

    def __init__(self, start: Ns, stop: Ns, beside: Ns, blocks: Sequence[PoseRows]) -> None:
        self.start, self.stop = start, stop
        self._beside = beside
        self._blocks = blocks

    @property
    def poses(self) -> Poses:
        """Those in the slice and beside it, in order; raises as `PoseRows.poses`."""
        start, stop = self.start - self._beside, self.stop + self._beside
        return joined_poses([block.poses.between(start, stop) for block in self._blocks])

    def key(self, settings: str) -> FragmentKey | None:
        """Returns what the poses are told apart by; None where not all are of whole parts."""
        parts: list[int] = []
        for block in self._blocks:
            if block.parts is None:
                return None
            parts += block.parts
        return FragmentKey(self.start, settings, tuple(parts))


def slices_back(blocks: Iterable[PoseRows], length: Ns, beside: Ns = 0) -> Iterator[PoseSlice]:
    """Yields the slices of the clock in which there may be poses, the newest first.

    Args:
        blocks: from `pose_rows`, the newest first.
        length: of a slice (ns); they are counted from the epoch.
        beside: poses so far before and after a slice (ns) are with it, too.
    """
    held: list[PoseRows] = []
    waiting: set[int] = set()

    def done(oldest: Ns) -> Iterator[PoseSlice]:
        """Yields the slices that reach no poses older than the oldest that is held."""
        for number in sorted(waiting, reverse=True):
            start, stop = number * length, (number + 1) * length
            if start - beside < oldest:
                return
            waiting.discard(number)
            near = [each for each in held if each.last >= start - beside]
            yield PoseSlice(start, stop, beside, [e for e in near[::-1] if e.first < stop + beside])

    for block in blocks:
        newest = max(waiting, default=block.last // length)
        held = [each for each in held if each.first < (newest + 1) * length + beside]
        held.append(block)
        waiting.update(block.slices(length))
        yield from done(block.first)
    yield from done(MIN_NS)


def poses_of(found: Iterable[tuple[Ns, Pose, float | None]]) -> Poses:
    """Returns poses with their log times, and the speed (m/s) that each message states, if any."""
    rows = [*found]
    unknown = (math.nan,) * 4
    turns = [unknown if pose.orientation is None else pose.orientation for _, pose, _ in rows]
    places = np.array([pose.position for _, pose, _ in rows], np.float64).reshape(-1, 3)
    frames = Texts.of([pose.frame_id for _, pose, _ in rows])
    return Poses(
        np.array([time for time, *_ in rows], np.int64),
        rounded(places, METRES),
        np.array(turns, np.float64).reshape(-1, 4),
        Frames(frames.codes, frames.words),
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
        self, view: View, failures: list[UndecodableError], beside: Sequence[Beside] = ()
    ) -> None:
        self._view = view
        self._failures = failures
        self._beside = beside
        self._columns = PoseColumns(view.extractor)

    def block(self, rows: Sequence[Rows]) -> PoseRows:
        """Returns the poses of rows that overlap in time, in the order of `blocks`."""
        span = min(each.first for each in rows), max(each.last for each in rows)
        known = [each.part for each in rows]
        numbers = tuple(part for part in known if part is not None)
        is_whole = len(numbers) == len(known) and not any(map(self._left_out, rows))
        parts = numbers if is_whole else None
        return PoseRows(span, partial(self._joined, rows), parts)

    def trouble(self) -> Hashable:
        """Returns what differs from before where something could not be read since."""
        return len(self._failures), self._view.notes.added

    def _joined(self, rows: Sequence[Rows]) -> Poses:
        counting = [self._counting(each) for each in rows]
        return joined_poses([self.poses(each) for each in counting if len(each)])

    def _counting(self, rows: Rows) -> Rows:
        """Returns the rows that others do not have the time of."""
        for beside in self._left_out(rows):
            out = (rows.times >= beside.span.start) & (rows.times < beside.span.stop)
            if beside.bags:
                own = [where for bag, where in rows.bag_rows() if bag.file in beside.bags]
                of = np.zeros(len(rows), np.bool_)
                of[np.concatenate([np.empty(0, np.int64), *own])] = True
                out &= of
            rows = rows.some(np.flatnonzero(~out))
        return rows

    def _left_out(self, rows: Rows) -> list[Beside]:
        """Returns what has the time of some of these rows first."""
        return [
            each
            for each in self._beside
            if each.other == rows.recording and each.span.overlaps(rows.first, rows.last)
        ]

    def poses(self, rows: Rows) -> Poses:
        """Returns the poses of rows, in order of log time.

        Raises:
            InvalidArgumentsError: messages carry no position.
        """
        try:
            found = of_columns(
                self._view, rows, lambda each: self._columns.of(each.table, each.times, each.index)
            )
        except NoPoseError:
            for message in messages_of(self._view, rows.some(np.array([0]))):
                lack = describe_lack(self._view, "position", message)
                raise InvalidArgumentsError(lack) from None
            return joined_poses([])  # deleted meanwhile
        return poses_of(self._decoded(rows)) if found is None else joined_poses(found)

    def _decoded(self, rows: Rows) -> Iterator[tuple[Ns, Pose, float | None]]:
        reader, extractor = self._view.memory.reader, self._view.extractor
        samples: list[tuple[Ns, Pose, float | None]] = []
        for found in messages_of(self._view, rows):
            type_name = found.type
            try:
                message = reader.decode(found.record)
            except UndecodableError as error:
                # A new one, since the one that was raised keeps the message by its traceback.
                self._failures.append(UndecodableError(error.topic, error.type_name, error.reason))
                continue
            pose, twist = extractor.pose(message, type_name), extractor.twist(message, type_name)
            if pose is None:
                raise InvalidArgumentsError(describe_lack(self._view, "position", found))
            samples.append((found.time, pose, None if twist is None else math.hypot(*twist.linear)))
        # Those of a part come bag after bag, in the order in which bags were stored.
        yield from sorted(samples, key=lambda sample: sample[0])
