"""Compares two paths by the robot's tracks: where they are farthest apart, and where it stood.

Both tracks must be in one frame. That frame should be the map, unless odometry went on between the
two paths: after a restart the same coordinates are another place.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.analysis.motion.robot_track import RobotTrack, cut_track, jumps
from ros2_memory.core.arrays import (
    Flags,
    Groups,
    Ints,
    bounds_of,
    distinct_rows,
    range_numbers,
    stable_order,
)
from ros2_memory.core.regions import Region, Steps
from ros2_memory.core.timebase import Ns, Span, unix_from_ns
from ros2_memory.results import FarFromOther, Pair, StandstillPlace

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from ros2_memory.analysis.frames import Floats
    from ros2_memory.core.model import TimeWindow

SAME_STAND_M: Final = 0.5
"""Standstills so near to each other are at one place."""

_STEP_M: Final = 0.1
"""The distance of two samples of a path, unless that makes too many."""
_MOST_SAMPLES: Final = 200_000
_MOST_CELLS: Final = 4_000
"""How many samples of a path are compared with how many of the other one."""
_CANDIDATES: Final = 64
"""For how many samples the exact distance from the other path is measured."""
_SAMPLES_OF_STAND: Final = 9
"""The place of a standstill is the median of so many samples."""


class PlacedStandstill(NamedTuple):
    """A standstill and its place (m); `start` is a log time, `duration` in ns."""

    x: float
    y: float
    start: Ns
    duration: Ns


class _TrackSteps(NamedTuple):
    """The straight steps of a track in a window: x and y (m) of both ends, and their log times."""

    begin: Floats
    end: Floats
    start: Ints
    stop: Ints


def farthest_apart(
    this: tuple[RobotTrack, TimeWindow],
    other: tuple[RobotTrack, TimeWindow],
    region: Region | None = None,
) -> tuple[FarFromOther | None, FarFromOther | None]:
    """Returns the point of each path that is farthest from the other path.

    Of each path only the part in its window, and in the region, is searched. None if that has no
    point, or if the other path has none in its window. The names of places are left empty.
    """
    these, others = _steps(*this), _steps(*other)
    return _farthest(these, others, region), _farthest(others, these, region)


def _steps(track: RobotTrack, window: TimeWindow) -> _TrackSteps:
    """Returns the steps of a track inside a window; a lone vertex is a step of no length.

    Jumps are no steps, and a vertex that the robot jumped to and from is left out.
    """
    part = cut_track(track, window)
    jumped = jumps(part)
    ends = part.ends | jumped
    # The last vertex is an end, and not jumped from: it may stand before the first one.
    is_alone = ends & np.roll(ends, 1)
    is_jumped_over = jumped & np.roll(jumped, 1)
    first = np.flatnonzero(~ends | (is_alone & ~is_jumped_over))
    last = first + ~ends[first]
    places = np.column_stack((part.x, part.y))
    return _TrackSteps(places[first], places[last], part.times[first], part.times[last])


def _farthest(steps: _TrackSteps, other: _TrackSteps, region: Region | None) -> FarFromOther | None:
    """Returns the point of the steps that is farthest from the other steps.

    Samples of both are compared first, and then the farthest samples with the exact steps.
    """
    points, times = _sampled(steps)
    if region is not None:
        inside = [region.contains(x, y) for x, y in points.tolist()]
        points, times = points[inside], times[inside]
    if not len(points) or not len(other.begin):
        return None
    points, times = _thinned(points, times)
    other_points, _ = _thinned(*_sampled(other))
    candidates = stable_order(-_nearest_squared(points, other_points))[:_CANDIDATES]
    lines = Steps(*other.begin.T, *other.end.T)
    away_m = [float(lines.nearest_to(x, y)[1].min()) for x, y in points[candidates].tolist()]
    nth = int(np.argmax(away_m))
    farthest = candidates[nth]
    x, y = points[farthest].tolist()
    return FarFromOther((x, y), (), away_m[nth], int(times[farthest]))


def _nearest_squared(points: Floats, others: Floats) -> Floats:
    """Returns the squared distance (m2) of each point from the nearest of the others."""
    # In chunks, so that the table of all distances is never in memory.
    nearest = [
        ((chunk[:, :1] - others[:, 0]) ** 2 + (chunk[:, 1:] - others[:, 1]) ** 2).min(axis=1)
        for chunk in np.array_split(points, len(points) // 64 + 1)
    ]
    return np.concatenate(nearest)


def _sampled(steps: _TrackSteps) -> tuple[Floats, Ints]:
    """Returns points (m) along the steps, `_STEP_M` apart or, if too many, more; and log times."""
    lengths = np.hypot(*(steps.end - steps.begin).T)
    step_m = max(_STEP_M, float(lengths.sum()) / _MOST_SAMPLES)
    parts = np.ceil(lengths / step_m).astype(np.int64) + 1
    row = range_numbers(parts)
    nth = np.arange(len(row)) - np.repeat(np.cumsum(parts) - parts, parts)
    share = nth / np.maximum(parts[row] - 1, 1)
    points = steps.begin[row] + share[:, None] * (steps.end - steps.begin)[row]
    lasted = (steps.stop - steps.start)[row]
    return points, steps.start[row] + np.rint(lasted * share).astype(np.int64)


def _thinned(points: Floats, times: Ints) -> tuple[Floats, Ints]:
    """Returns the first point in each cell of the finest grid with `_MOST_CELLS` or fewer."""
    cell_m = _STEP_M
    while True:
        x, y = np.floor(points / cell_m).astype(np.int64).T
        _, cells = distinct_rows((x, y))
        first = np.sort(Groups.of(cells).firsts)
        if len(first) <= _MOST_CELLS:
            return points[first], times[first]
        cell_m *= 2


def placed_standstills(
    track: RobotTrack, spans: Iterable[Span], region: Region | None = None
) -> Iterator[PlacedStandstill]:
    """Yields standstills with their places on the track; only those in a region, if it is given.

    Standstills outside of the track's pieces are left out.
    """
    ends = bounds_of(spans).T
    if not len(track.times) or not len(ends):
        return
    times = np.linspace(ends[:, 0], ends[:, 1], _SAMPLES_OF_STAND, axis=1).astype(np.int64)
    is_known = _is_known(track, times)
    has_known = is_known.any(axis=1)
    ends, times, is_known = ends[has_known], times[has_known], is_known[has_known]
    x, y = (np.nanmedian(np.where(is_known, axis, np.nan), axis=1) for axis in track.at(times)[:2])
    rows = zip(x.tolist(), y.tolist(), ends[:, 0].tolist(), ends[:, 1].tolist(), strict=True)
    for stand_x, stand_y, start, stop in rows:
        if region is None or region.contains(stand_x, stand_y):
            yield PlacedStandstill(stand_x, stand_y, start, stop - start)


def _is_known(track: RobotTrack, times: Ints) -> Flags:
    """Returns which log times lie in a piece of the track, or within `SILENCE_NS` of one."""
    starts, stops = track.pieces
    piece = np.searchsorted(starts - SILENCE_NS, times, side="right") - 1
    return (piece >= 0) & (times <= stops[piece] + SILENCE_NS)


class _PlaceStands(NamedTuple):
    """A place (m), and the standstills there in each of two windows."""

    x: float
    y: float
    this: list[PlacedStandstill]
    other: list[PlacedStandstill]


def stood_at(
    this: Iterable[PlacedStandstill], other: Iterable[PlacedStandstill]
) -> list[StandstillPlace]:
    """Returns the places where the robot stood in two windows, and how long in each.

    A place is where the robot stood longest, and gathers standstills within `SAME_STAND_M`. The
    names of places are left empty.
    """
    stands = [*((stand, False) for stand in this), *((stand, True) for stand in other)]
    stands.sort(key=lambda marked: (-marked[0].duration, marked[0]))
    middles = np.empty((len(stands), 2))
    places: list[_PlaceStands] = []
    for stand, is_other in stands:
        squared = ((middles[: len(places)] - (stand.x, stand.y)) ** 2).sum(axis=1)
        if (squared <= SAME_STAND_M**2).any():
            place = places[int(squared.argmin())]
        else:
            middles[len(places)] = stand.x, stand.y
            place = _PlaceStands(stand.x, stand.y, [], [])
            places.append(place)
        (place.other if is_other else place.this).append(stand)
    return [
        StandstillPlace(
            (place.x, place.y),
            (),
            Pair(_total_s(place.this), _total_s(place.other)),
            (_first_start(place.this), _first_start(place.other)),
        )
        for place in places
    ]


def _total_s(stands: Iterable[PlacedStandstill]) -> float:
    return unix_from_ns(sum(stand.duration for stand in stands))


def _first_start(stands: Iterable[PlacedStandstill]) -> Ns | None:
    return min((stand.start for stand in stands), default=None)
