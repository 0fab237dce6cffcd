"""The driven path, measured and drawn.

The length of a path depends on how many poses are measured together (see `path_length`). So a
history is measured in slices of `SLICE_NS` of the clock, however it is cut into bags. A `PathSlice`
is stored for each slice, and `joined_slices` joins the slices of a window.

The drawn path is simplified twice, and the deviations of both add up: a vertex that the second
simplification drops lies beside the same segment as its neighbours. The sum is at most the
tolerance, unless a limit on the count of vertices widens it. Nothing is drawn along a jump.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import groupby
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from ros2_memory.analysis.motion.odometry import (
    MeasuredPath,
    Motion,
    MotionTotals,
    are_places,
    measured_path,
)
from ros2_memory.analysis.motion.path_length import SPEED_STEPS
from ros2_memory.analysis.poses import Poses, headings, joined_poses
from ros2_memory.core.arrays import (
    Flags,
    Floats,
    Vectors,
    row_sums,
    rows_of,
    runs_where,
    stable_order,
    stacked,
)
from ros2_memory.core.geometry import simplified
from ros2_memory.core.text import counted
from ros2_memory.core.timebase import NS_PER_S, Ns

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.core.model import Vector3
    from ros2_memory.storage.base import IntArray

SLICE_NS: Final = 300 * NS_PER_S
"""Slices are counted from the epoch. Every time zone is a multiple of this off UTC."""
TOLERANCE_M: Final = 0.05
"""How far a pose may be from the drawn path, unless a limit on count widens it."""
MAX_WAYPOINTS: Final = 50
"""How many waypoints a path has, unless another number is asked for."""
LEAST_OF_SPEED_S: Final = 0.5
"""Poses over a shorter time give no speed: noise is as large as what was driven."""

_MOST_VERTICES: Final = 400
"""How many vertices a slice stores, besides the ends of jumps and gaps."""
_STORED_WITHIN_M: Final = 0.0175
"""How far a pose may be from the path of a slice. Within 1.25 cm, noise of 4 mm would leave four
times as many vertices."""
_OF_TIME: Final = 0.7
"""The share of the tolerance that counts along the time, so that the metres driven up to any time
are right within 2.5 cm."""
_FEW: Final = 32
"""Neighbouring slices with at most so many poses each are measured together."""
_WIDEST_WANDER_M: Final = 0.3
"""Positions of one place at rest are no farther apart."""
_NOISY_SHARE: Final = 0.02
_NOISY_M: Final = 0.001
_SLOW_MPS: Final = 0.01
"""The ends of a gap may be so far apart by noise alone, or by a correction of the map."""
_BYTES: Final = 3000
"""About how much memory a slice takes without its vertices."""


@dataclass(frozen=True, slots=True)
class Waypoint:
    """A vertex of the drawn path: a pose as recorded (m, rad); no yaw without an orientation.

    `jump`: the robot did not drive here from the waypoint before, but jumped.
    """

    time: Ns
    position: Vector3
    yaw_rad: float | None
    jump: bool = False


def mean_speed(distance_m: float, duration_s: float) -> float | None:
    """Returns the mean speed (m/s); None over less than `LEAST_OF_SPEED_S`."""
    return distance_m / duration_s if duration_s >= LEAST_OF_SPEED_S else None


@dataclass(frozen=True, slots=True)
class Trajectory:
    """The measurements of a driven path.

    Attributes:
        totals: the length in 3D without noise (see `path_length`), and what is left out of it.
        avg_speed: `distance_m / duration_s` (m/s); None over less than `LEAST_OF_SPEED_S`.
        max_speed: the highest speed (m/s); None as `avg_speed`, unless messages state it.
        max_speed_from: `twist` if messages state it, `positions` if it is measured over a second
            and eight poses.
        waypoints: vertices of the path drawn in space and time: first and last pose, corners,
            turning points, ends of stops, and both ends of the longest jumps.
        waypoint_error_m: no pose is farther than this from the drawn path.
        poses: how many poses are valid.
        invalid: how many are not: a coordinate is NaN, infinite or beyond any place.
        are_gaps_between_runs: whether odometry may have begun anew in a gap.
    """

    totals: MotionTotals
    avg_speed: float | None
    max_speed: float | None
    max_speed_from: Literal["twist", "positions"]
    waypoints: tuple[Waypoint, ...]
    waypoint_error_m: float
    poses: int
    invalid: int
    are_gaps_between_runs: bool = False

    @property
    def gap_m(self) -> float | None:
        """The distance (m) across gaps, in straight lines; None without a gap, or if unknown."""
        return self.totals.gap_m if self.totals.gaps and not self.are_gaps_between_runs else None

    @property
    def is_known(self) -> bool:
        """Whether there is a valid pose."""
        return self.poses > 0

    @property
    def is_noisy(self) -> bool:
        """Whether the sum of distances is longer than the length by 2 %, and by a millimetre."""
        distance_m = self.totals.distance_m
        more_m = self.totals.path_sum_m - distance_m
        return more_m > max(_NOISY_SHARE * distance_m, _NOISY_M)


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """A drawn path, with the metres driven up to each of its vertices.

    Attributes:
        times: log times (ns), ascending.
        metres: metres driven since the first vertex, without gaps, jumps and noise.
        places: rows of x, y and z (m).
        headings: yaw (rad); NaN if it is not known.
        jumps: whether the robot jumped to the vertex.
    """

    times: IntArray
    metres: Floats
    places: Vectors
    headings: Floats
    jumps: Flags

    def __len__(self) -> int:
        """Returns the number of vertices."""
        return self.times.size

    def metres_at(self, times: IntArray) -> Floats:
        """Returns the metres driven up to log times (ns), on a line with at least one vertex."""
        since = self.times[0]
        metres: Floats = np.interp(times - since, self.times - since, self.metres)
        return metres

    def at(self, times: IntArray) -> Line:
        """Returns a line with vertices at log times (ns), interpolated between those of this one.

        During a jump the robot is at its nearer end. This line has at least one vertex.
        """
        after = np.searchsorted(self.times, times, side="right").clip(max=len(self) - 1)
        before = np.maximum(after - 1, 0)
        lasted = np.maximum(self.times[after] - self.times[before], 1)
        share = ((times - self.times[before]) / lasted).clip(0.0, 1.0)
        share = np.where(self.jumps[after], np.rint(share), share)
        turn = np.remainder(self.headings[after] - self.headings[before] + np.pi, 2 * np.pi) - np.pi
        return Line(
            times,
            self.metres_at(times),
            self.places[before] + (self.places[after] - self.places[before]) * share[:, None],
            self.headings[before] + turn * share,
            np.zeros(len(times), np.bool_),
        )


@dataclass(frozen=True, slots=True, eq=False)
class PathSlice:
    """The path of consecutive poses.

    Attributes:
        first: log time (ns) of the first pose, valid or not.
        last: log time (ns) of the last pose.
        poses: how many poses are valid (see `are_places`).
        invalid: how many are not.
        totals: the sums over the driven legs.
        step_mps: see `odometry.Motion`.
        twist: the highest speed (m/s) that a message states; None if none states one.
        frames: the frames of all poses, in order of appearance.
        line: the drawn path from the first valid pose to the last.
        error_m: no valid pose is farther than this from the line.
        few: the poses, if there are at most `_FEW`; else None.
    """

    first: Ns
    last: Ns
    poses: int
    invalid: int
    totals: MotionTotals
    step_mps: float
    twist: float | None
    frames: tuple[str, ...]
    line: Line
    error_m: float
    few: Poses | None = None

    @property
    def memory_bytes(self) -> int:
        """About how much memory it takes."""
        return _BYTES + 49 * len(self.line)

    def trajectory(self, max_waypoints: int = MAX_WAYPOINTS) -> Trajectory:
        """Returns the measurements, and the path drawn with at most so many waypoints.

        No waypoints are drawn for 0, and two for 1.
        """
        distance_m, duration_s = self.totals.distance_m, self.totals.duration_s
        avg_speed = mean_speed(distance_m, duration_s)
        step_mps = self.step_mps if self.poses <= SPEED_STEPS else 0.0
        max_speed = None
        if avg_speed is not None:
            max_speed = max(self.totals.speed_mps or step_mps, avg_speed)
        # Drivers without a twist leave it zero, which is wrong if the robot moved.
        is_stated = self.twist is not None and (self.twist != 0 or not distance_m)
        waypoints: tuple[Waypoint, ...] = ()
        error_m = 0.0
        if max_waypoints and len(self.line):
            waypoints, error_m = draw_waypoints(self.line, max(max_waypoints, 2), self.error_m)
        return Trajectory(
            self.totals,
            avg_speed,
            self.twist if is_stated else max_speed,
            "twist" if is_stated else "positions",
            waypoints,
            error_m,
            self.poses,
            self.invalid,
        )


def path_slice(poses: Poses, fastest_mps: float, *, draws: bool = True) -> PathSlice:
    """Measures poses in order of log time and, if it `draws`, draws them within 1.75 cm.

    A step that would take a higher speed than `fastest_mps` is a jump.
    """
    valid = np.flatnonzero(are_places(poses.positions))
    placed = poses if valid.size == len(poses) else poses.rows(valid)
    stated = placed.speeds[np.isfinite(placed.speeds)]
    totals, step_mps, line, error_m = MotionTotals(), 0.0, NO_LINE, 0.0
    if len(placed):
        measured = measured_path(placed.times, _without_wander(placed), fastest_mps)
        totals, step_mps = measured.totals, measured.step_mps
        if draws:
            line, error_m = _line_through(placed, measured)
    return PathSlice(
        int(poses.times[0]) if len(poses) else 0,
        int(poses.times[-1]) if len(poses) else 0,
        len(placed),
        len(poses) - len(placed),
        totals,
        step_mps,
        float(stated.max()) if stated.size else None,
        poses.frames.names(),
        line,
        error_m,
        poses if len(placed) <= _FEW else None,
    )


def _without_wander(poses: Poses) -> Vectors:
    """Returns the positions (m); those of a rest are one place, as long as they are near it."""
    positions, at_rest = poses.positions, poses.wander_m() > 0
    if not at_rest.any():
        return positions
    positions = positions.copy()
    for begin, end in runs_where(at_rest).tolist():
        rest = positions[begin:end]
        while len(rest):
            sizes = np.maximum.accumulate(rest) - np.minimum.accumulate(rest)
            # Both only grow along a rest: the poses that are near are the first ones.
            near = int((row_sums(sizes * sizes) <= _WIDEST_WANDER_M * _WIDEST_WANDER_M).sum())
            rest[:near] = rest[:near].mean(axis=0)
            rest = rest[near:]
    return positions


def _line_through(poses: Poses, measured: MeasuredPath) -> tuple[Line, float]:
    """Returns the line through poses, and how far (m) a pose may be off it."""
    vertices, error_m = np.arange(len(poses)), 0.0
    if len(poses) > _FEW:
        begins = np.array(measured.begins, np.intp)
        vertices, error_m = simplified(
            poses.positions,
            (poses.times - poses.times[0]) / NS_PER_S,
            np.unique(np.concatenate(([0, len(poses) - 1], begins - 1, begins))),
            tolerance_m=_STORED_WITHIN_M,
            at_most=_MOST_VERTICES,
            of_time=_OF_TIME,
        )
    line = Line(
        poses.times[vertices],
        np.concatenate(([0.0], np.cumsum(measured.steps_m)))[vertices],
        poses.positions[vertices],
        headings(poses.turns[vertices]),
        np.isin(vertices, measured.parted),
    )
    return line, error_m


NO_LINE: Final = Line(
    np.empty(0, np.int64), np.empty(0), np.empty((0, 3)), np.empty(0), np.empty(0, np.bool_)
)


def joined_slices(slices: Sequence[PathSlice], fastest_mps: float) -> PathSlice:
    """Joins one or more consecutive slices; see `path_slice`."""
    slices = [*_with_few_joined(slices, fastest_mps)]
    motion = Motion(fastest_mps)
    jumped: list[bool] = []
    added: list[float] = []
    for part in slices:
        motion.join(part.totals)
        jumped.append(motion.is_parted)
        # What joining adds to the slice's own length is driven up to its first vertex.
        added.append(motion.totals.distance_m - part.totals.distance_m)
    line = stacked([part.line for part in slices])
    vertices = np.array([len(part.line) for part in slices])
    firsts = (np.cumsum(vertices) - vertices)[vertices > 0]
    jumps = line.jumps.copy()
    jumps[firsts] |= np.array(jumped)[vertices > 0]
    metres = line.metres + np.repeat(added, vertices)
    # Joining may shorten a path: two places of a creep may turn out to be one.
    metres = np.maximum.accumulate(np.minimum(metres, motion.totals.distance_m))
    twists = [part.twist for part in slices if part.twist is not None]
    return PathSlice(
        slices[0].first,
        slices[-1].last,
        sum(part.poses for part in slices),
        sum(part.invalid for part in slices),
        motion.totals,
        max(part.step_mps for part in slices),
        max(twists, default=None),
        tuple(dict.fromkeys(frame for part in slices for frame in part.frames)),
        replace(line, metres=metres, jumps=jumps),
        max(part.error_m for part in slices),
    )


def length_notes(path: Trajectory) -> Iterator[str]:
    """Yields sentences on what the length of a path leaves out, and on what makes it uncertain."""
    totals = path.totals
    if path.invalid:
        poses = counted(path.invalid, "pose")
        yield f"{poses} left out: their coordinates are not valid (NaN, all zeros or out of range)"
    if path.avg_speed is None and path.poses:
        within = "" if path.poses == 1 else f" within {totals.duration_s:.3f} s"
        yield f"{counted(path.poses, 'pose')}{within}: too short to say how fast"
    if totals.is_uncertain:
        yield (
            "distance_m may be too long by noise or sharp turns: the positions are more than "
            "0.25 s apart"
        )
    if totals.gaps:
        without = "without a valid pose" if path.invalid else "without a pose"
        across = f", {totals.gap_m:.2f} m across in straight lines (gap_m): left out of distance_m"
        if path.gap_m is None:
            across = (
                ": left out of distance_m, and of unknown length, as odometry may have begun anew"
            )
        yield f"{counted(totals.gaps, 'gap')} {without}{across}"
        crossed_mps = mean_speed(path.gap_m or 0.0, totals.gap_ns / NS_PER_S)
        if crossed_mps and path.max_speed is not None and crossed_mps > path.max_speed + _SLOW_MPS:
            yield (
                "max_speed is of the time with poses alone: across gaps it was "
                f"{crossed_mps:.2f} m/s or more"
            )
    if totals.jumps:
        yield (
            f"{counted(totals.jumps, 'jump')} of {totals.jumped_m:.2f} m in all, faster than is "
            "plausible, left out of distance and speed"
        )
    if totals.resets:
        yield (
            f"positions jumped back to their origin {counted(len(totals.resets), 'time')}, as "
            "where odometry restarts: left out of distance and speed"
        )


def draw_waypoints(
    line: Line, at_most: int, error_m: float = 0.0
) -> tuple[tuple[Waypoint, ...], float]:
    """Draws a line with at most so many waypoints (2 or more), and with the longest jumps alone.

    Args:
        line: the line, which has at least one vertex.
        at_most: how many waypoints to draw.
        error_m: how far (m) a pose may be off the line.

    Returns:
        The waypoints, and how far (m) a pose may be off the path through them.
    """
    jumps = np.flatnonzero(line.jumps[1:]) + 1
    jump_m = np.linalg.norm(line.places[jumps] - line.places[jumps - 1], axis=1)
    longest = np.sort(jumps[stable_order(-jump_m)[: at_most // 2 - 1]])
    ends = np.unique(np.concatenate(([0, len(line) - 1], longest - 1, longest)))
    seconds = (line.times - line.times[0]) / NS_PER_S
    left_m = max(TOLERANCE_M - error_m, TOLERANCE_M / 4)
    vertices, off_m = simplified(line.places, seconds, ends, tolerance_m=left_m, at_most=at_most)
    drawn = rows_of(line, vertices)
    is_jump = drawn.jumps & np.isin(vertices, [0, *longest])
    waypoints = tuple(
        Waypoint(time, (x, y, z), None if math.isnan(heading) else heading, jump=jump)
        for time, (x, y, z), heading, jump in zip(
            drawn.times.tolist(),
            drawn.places.tolist(),
            drawn.headings.tolist(),
            is_jump.tolist(),
            strict=True,
        )
    )
    return waypoints, error_m + off_m


def _with_few_joined(slices: Sequence[PathSlice], fastest_mps: float) -> Iterator[PathSlice]:
    """Yields slices; consecutive slices with few poses are measured together, as one slice."""
    for _, run in groupby(slices, key=lambda part: part.few is None):
        parts = [*run]
        few = [part.few for part in parts if part.few is not None]
        if len(few) > 1:
            yield path_slice(joined_poses(few), fastest_mps)
        else:
            yield from parts
