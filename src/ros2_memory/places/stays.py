"""When the robot was inside of a region, by its track."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ros2_memory.analysis.intervals import FLICKER_NS
from ros2_memory.analysis.motion.robot_track import RobotTrack, jumps
from ros2_memory.core.regions import ClippedSteps, Region, Steps, clipped

if TYPE_CHECKING:
    from ros2_memory.core.arrays import Flags
    from ros2_memory.core.model import TimeWindow
    from ros2_memory.core.timebase import Ns, Span


class Stay(NamedTuple):
    """A time (both ends inclusive) in which the robot was inside of a region.

    `entered`: it was seen outside just before; `left`: it was seen outside just after.
    """

    start: Ns
    stop: Ns
    entered: bool
    left: bool

    @property
    def span(self) -> Span:
        """Its first and last log time."""
        return self.start, self.stop

    def within(self, window: TimeWindow) -> Stay:
        """Returns the part of the stay in a window that overlaps it."""
        return Stay(
            max(self.start, window.start),
            min(self.stop, window.stop - 1),
            entered=self.entered and self.start >= window.start,
            left=self.left and self.stop < window.stop,
        )


@dataclass(frozen=True, slots=True)
class KnownTrack:
    """The track of the robot in a window.

    Attributes:
        track: the track by all recordings; where several robots were recorded at one time, by the
            recording that began first.
        since: log time before which nothing was placed because time ran out; else None.
        left_out: how many poses no transform places.
        others: one track for each recording of another robot, where `track` leaves it out.
    """

    track: RobotTrack
    since: Ns | None
    left_out: int
    others: tuple[RobotTrack, ...]

    @property
    def tracks(self) -> tuple[RobotTrack, ...]:
        """The tracks of all robots."""
        return self.track, *self.others

    def reaches(self, window: TimeWindow) -> bool:
        """Returns whether a robot's place is known at some time of a window."""
        return any(
            window.overlaps(start, stop)
            for track in self.tracks
            for start, stop in zip(*track.pieces, strict=True)
        )

    def inside(self, region: Region, window: TimeWindow) -> list[Stay]:
        """Returns the stays of all robots in a region, in order; they may overlap."""
        return sorted(chain(*(stays_within(track, region, window) for track in self.tracks)))


def _without_jumps(parts: ClippedSteps, are_jumps: Flags) -> ClippedSteps:
    """Returns parts of steps inside of a region; of a jump only its ends, where they are inside.

    A robot does not drive along a jump: its odometry started again, or its map was corrected.
    """
    jumped = are_jumps[parts.step]
    begins, ends = parts.start <= 0, parts.stop >= 1
    start = np.where(jumped & ~begins, 1.0, parts.start)
    stop = np.where(jumped & ~ends, 0.0, parts.stop)
    kept = ~jumped | begins | ends
    return ClippedSteps(parts.step[kept], start[kept], stop[kept])


def stays_within(track: RobotTrack, region: Region, window: TimeWindow) -> list[Stay]:
    """Returns the stays in a region by a track, cut at the ends of a window; see `stays`."""
    return [
        stay.within(window)
        for stay in stays(track, region)
        if window.overlaps(stay.start, stay.stop)
    ]


def stays(track: RobotTrack, region: Region) -> list[Stay]:
    """Returns the stays in a region, in order, by a track.

    A robot that is outside for less than `FLICKER_NS` does not leave. A silence longer than
    `SILENCE_NS` ends a stay, and the next one begins after it: what happened then is not known.
    """
    count = len(track.times)
    if not count:
        return []
    # A step from each vertex to the next; from the last vertex of a piece to itself.
    after = np.arange(count) + ~track.ends
    points = track.x, track.y, track.z
    steps = Steps(*points, *(axis[after] for axis in points))
    parts = _without_jumps(clipped(region, steps), jumps(track))
    if not len(parts.step):
        return []
    step_starts = track.times[parts.step]
    lasted = track.times[after[parts.step]] - step_starts
    starts = step_starts + np.rint(lasted * parts.start).astype(np.int64)
    stops = step_starts + np.rint(lasted * parts.stop).astype(np.int64)
    piece = np.cumsum(track.begins)[parts.step] - 1
    piece_starts, piece_stops = (ends[piece] for ends in track.pieces)
    is_apart = (starts[1:] - stops[:-1] >= FLICKER_NS) | (piece[1:] != piece[:-1])
    is_first, is_last = np.append([True], is_apart), np.append(is_apart, [True])
    entered, left = starts > piece_starts, stops < piece_stops
    columns = (starts[is_first], stops[is_last], entered[is_first], left[is_last])
    return [Stay(*row) for row in zip(*(column.tolist() for column in columns), strict=True)]
