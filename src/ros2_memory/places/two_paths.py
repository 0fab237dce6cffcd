"""Compares two paths by the robot's tracks: where they are farthest apart, and where it stood.

Both results are in one frame, so they are useful only if that is the map, or if odometry did not
start again between the two.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.analysis.motion.robot_track import RobotTrack, jumps
from ros2_memory.core.arrays import Groups, distinct_rows
from ros2_memory.core.regions import Steps
from ros2_memory.core.timebase import Span, unix_from_ns
from ros2_memory.results import FarFromOther, Pair, StandstillPlace

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from ros2_memory.analysis.frames import Floats, Times
    from ros2_memory.core.arrays import Flags, Ints
    from ros2_memory.core.model import TimeWindow
    from ros2_memory.core.regions import Region
    from ros2_memory.core.timebase import Ns

SAME_STAND_M: Final = 0.5
"""Standstills so near to each other are at one place."""

_STEP_M: Final = 0.1
_MOST_SAMPLES: Final = 200_000
_MOST_CELLS: Final = 4_000
_CANDIDATES: Final = 64
_SAMPLES_OF_STAND: Final = 9


class PlacedStandstill(NamedTuple):
    """A standstill at a place (m)."""

    x: float
    y: float
    start: Ns
    duration: Ns


class _Steps(NamedTuple):
    """The straight steps of a track in a window: their ends (m), one row each, and their times."""

    begin: Floats
    end: Floats
    start: Times
    stop: Times


def farthest_apart(
    this: tuple[RobotTrack, TimeWindow],
    other: tuple[RobotTrack, TimeWindow],
    region: Region | None = None,
) -> tuple[FarFromOther | None, FarFromOther | None]:
    """Returns the point of each path that is farthest from the other one, without named places.

    Only the part of each path in its window counts, and in the region, if one is given.
    None where it has no point, or the other way has none at all.
    """
    these, two = _steps(*this), _steps(*other)
    return _farthest(these, two, region), _farthest(two, these, region)


def _steps(track: RobotTrack, window: TimeWindow) -> _Steps:
    """Returns the steps of a track inside a window; a piece of one vertex is one of no length.

    Nobody was between the ends of a jump, nor at a vertex that was jumped to and from.
    """
    jumped = jumps(track)
    ends = track.ends | jumped
    after = np.arange(len(ends)) + ~ends
    alone = ends & np.append([True], ends[:-1])[: len(ends)]
    alone &= ~(jumped & np.append([False], jumped[:-1])[: len(ends)])
    real = (~ends | alone) & (track.times < window.stop) & (track.times[after] >= window.start)
    first, last = np.flatnonzero(real), after[real]
    start = np.maximum(track.times[first], window.start)
    stop = np.minimum(track.times[last], window.stop - 1)
    lasted = np.maximum(track.times[last] - track.times[first], 1)
    here = np.column_stack((track.x[first], track.y[first]))
    there = np.column_stack((track.x[last], track.y[last]))
    share = ((start - track.times[first]) / lasted)[:, None]
    until = ((stop - track.times[first]) / lasted)[:, None]
    return _Steps(here + share * (there - here), here + until * (there - here), start, stop)


def _farthest(steps: _Steps, other: _Steps, region: Region | None) -> FarFromOther | None:
    points, times = _sampled(steps)
    if region is not None:
        inside = [region.contains(x, y) for x, y in points.tolist()]
        points, times = points[inside], times[inside]
    if not len(points) or not len(other.begin):
        return None
    points, times = _thinned(points, times)
    marks, _ = _thinned(*_sampled(other))
    near = np.concatenate(
        [
            ((chunk[:, :1] - marks[:, 0]) ** 2 + (chunk[:, 1:] - marks[:, 1]) ** 2).min(axis=1)
            for chunk in np.array_split(points, len(points) // 64 + 1)
        ]
    )
    tried = np.argsort(-near, kind="stable")[:_CANDIDATES]
    away = _distances_to(points[tried], other)
    farthest = int(np.argmax(away))
    nth = int(tried[farthest])
    x, y = points[nth].tolist()
    return FarFromOther((x, y), (), away[farthest], int(times[nth]))


def _sampled(steps: _Steps) -> tuple[Floats, Times]:
    """Returns points along the steps, no farther apart than `_STEP_M` unless they are too many."""
    lengths = np.hypot(*(steps.end - steps.begin).T)
    step_m = max(_STEP_M, float(lengths.sum()) / _MOST_SAMPLES)
    parts = np.ceil(lengths / step_m).astype(np.int64) + 1
    row = np.repeat(np.arange(len(parts)), parts)
    nth = np.arange(len(row)) - np.repeat(np.cumsum(parts) - parts, parts)
    share = nth / np.maximum(parts[row] - 1, 1)
    points = steps.begin[row] + share[:, None] * (steps.end - steps.begin)[row]
    lasted = (steps.stop - steps.start)[row]
    return points, steps.start[row] + np.rint(lasted * share).astype(np.int64)


def _thinned(points: Floats, times: Times) -> tuple[Floats, Times]:
    """Returns the first point in each cell of a grid as fine as leaves few of them."""
    size = _STEP_M
    while True:
        x, y = np.floor(points / size).astype(np.int64).T
        first = np.sort(Groups.of(distinct_rows((x, y))[1]).firsts)
        if len(first) <= _MOST_CELLS:
            return points[first], times[first]
        size *= 2


def _distances_to(points: Floats, steps: _Steps) -> list[float]:
    """Returns how far (m) each of some points is from the nearest step."""
    lines = Steps(*steps.begin.T.copy(), *steps.end.T.copy())
    return [float(lines.nearest_to(x, y)[1].min()) for x, y in points.tolist()]


def placed_standstills(
    track: RobotTrack, spans: Iterable[Span], region: Region | None = None
) -> Iterator[PlacedStandstill]:
    """Yields standstills with their place on the track; those in a region, if one is given.

    Standstills outside the track are left out.
    """
    ends = np.array([*spans], np.int64).reshape(-1, 2)
    if not len(track.times) or not len(ends):
        return
    at = np.linspace(ends[:, 0], ends[:, 1], _SAMPLES_OF_STAND, axis=1).astype(np.int64)
    is_known = _is_known(track, at)
    has_known = is_known.any(axis=1)
    ends, at, is_known = ends[has_known], at[has_known], is_known[has_known]
    x, y = (np.nanmedian(np.where(is_known, axis, np.nan), axis=1) for axis in track.at(at)[:2])
    rows = zip(x.tolist(), y.tolist(), ends[:, 0].tolist(), ends[:, 1].tolist(), strict=True)
    for here, there, start, stop in rows:
        if region is None or region.contains(here, there):
            yield PlacedStandstill(here, there, start, stop - start)


def _is_known(track: RobotTrack, at: Ints) -> Flags:
    """Returns whether a track covers some times."""
    last = np.searchsorted(track.times, at, side="right") - 1
    following = np.minimum(last + 1, len(track.times) - 1)
    before = (last >= 0) & (at - track.times[last] <= SILENCE_NS)
    after = (track.times[following] >= at) & (track.times[following] - at <= SILENCE_NS)
    between = (last >= 0) & (last + 1 < len(track.times)) & ~track.begins[following]
    return np.asarray(between | before | after)


def stood_at(
    this: Iterable[PlacedStandstill], other: Iterable[PlacedStandstill]
) -> list[StandstillPlace]:
    """Returns where the robot stood in two windows, and how long in each, without named places.

    A place is where it stood longest within `SAME_STAND_M`.
    """
    stands = [(stand, side) for side, window in enumerate((this, other)) for stand in window]
    stands.sort(key=lambda sided: (-sided[0].duration, sided[0]))
    middles = np.empty((len(stands), 2))
    durations: list[list[Ns]] = []
    since: list[list[Ns | None]] = []
    for stand, side in stands:
        count = len(durations)
        away = ((middles[:count] - (stand.x, stand.y)) ** 2).sum(axis=1)
        nth = int(away.argmin()) if (away <= SAME_STAND_M**2).any() else count
        if nth == count:
            middles[nth] = stand.x, stand.y
            durations.append([0, 0])
            since.append([None, None])
        durations[nth][side] += stand.duration
        earliest = since[nth][side]
        since[nth][side] = stand.start if earliest is None else min(earliest, stand.start)
    places = zip(middles[: len(durations)].tolist(), durations, since, strict=True)
    return [
        StandstillPlace((x, y), (), Pair(*map(unix_from_ns, lasted)), (first, second))
        for (x, y), lasted, (first, second) in places
    ]
