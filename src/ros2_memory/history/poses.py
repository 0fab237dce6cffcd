"""The poses of a topic in a window as arrays, from its columns, else from its messages."""

from __future__ import annotations

import math
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ros2_memory.analysis.poses import Frames, Poses, joined_poses
from ros2_memory.columns.poses import NoPoseError, PoseColumns, rounded
from ros2_memory.columns.steps import METRES
from ros2_memory.columns.table import Texts
from ros2_memory.core.errors import InvalidArgumentsError, UndecodableError
from ros2_memory.history.no_data import describe_lack
from ros2_memory.history.scan import messages_of, scan

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.columns.units import Rows
    from ros2_memory.core.model import Pose, TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.view import View


class PoseRows:
    """Rows with poses, which no other ones of the scan overlap in time.

    Attributes:
        first: a log time (ns) that none of them is earlier than.
        last: one that none is later than.
    """

    def __init__(self, reader: PoseReader, rows: Sequence[Rows]) -> None:
        self.first = min(each.first for each in rows)
        self.last = max(each.last for each in rows)
        self._reader = reader
        self._rows = rows

    @cached_property
    def parts(self) -> tuple[int, ...] | None:
        """The numbers of the parts of which all rows are here; None if there are others, too."""
        known = [each.part for each in self._rows]
        numbers = tuple(part for part in known if part is not None)
        return numbers if len(numbers) == len(known) else None

    @cached_property
    def poses(self) -> Poses:
        """The poses, in order of log time.

        Raises:
            InvalidArgumentsError: messages carry no position.
        """
        rows = sorted(self._rows, key=lambda each: (each.first, each.last, str(each.recording)))
        return joined_poses([self._reader.poses(each) for each in rows])


def pose_rows(
    view: View,
    topic: str,
    window: TimeWindow,
    failures: list[UndecodableError],
    *,
    newest_first: bool = False,
    reached: Callable[[Ns], None] = lambda _: None,
    among: Callable[[Path], bool] = lambda _: True,
) -> Iterator[PoseRows]:
    """Yields the poses of a topic in a window, in order of time; the columns are not read yet.

    Positions are rounded to 0.1 mm, as the store has them. Why messages cannot be decoded is added
    to `failures` as poses are read. `reached` is as for `scan`; `among`: which recordings count.

    Raises:
        QueryTimeoutError: while it is iterated, when the deadline has passed.
    """
    reader = PoseReader(view, failures)
    together: list[Rows] = []
    for rows in scan(view, topic, window, newest_first=newest_first, reached=reached):
        if not among(rows.recording):
            continue
        is_apart = together and (
            rows.last < min(each.first for each in together)
            if newest_first
            else rows.first > max(each.last for each in together)
        )
        if is_apart:
            yield PoseRows(reader, together)
            together = []
        together.append(rows)
    if together:
        yield PoseRows(reader, together)


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


class PoseReader:
    """Reads the poses of rows by their columns, else by their messages.

    Args:
        view: of the memory.
        failures: why messages cannot be decoded is added to it.
    """

    def __init__(self, view: View, failures: list[UndecodableError]) -> None:
        self._view = view
        self._failures = failures
        self._columns = PoseColumns(view.memory.extractor)

    def poses(self, rows: Rows) -> Poses:
        """Returns the poses of rows, in order of log time.

        Raises:
            InvalidArgumentsError: messages carry no position.
        """
        try:
            found = self._columns.of(rows.table, rows.times, rows.index)
        except NoPoseError:
            for message in messages_of(self._view, rows.some(np.array([0]))):
                lack = describe_lack(self._view, "position", message)
                raise InvalidArgumentsError(lack) from None
            return joined_poses([])  # deleted meanwhile
        return poses_of(self._decoded(rows)) if found is None else found

    def _decoded(self, rows: Rows) -> Iterator[tuple[Ns, Pose, float | None]]:
        reader, extractor = self._view.memory.reader, self._view.memory.extractor
        samples: list[tuple[Ns, Pose, float | None]] = []
        for found in messages_of(self._view, rows):
            type_name = found.record.channel.type
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
