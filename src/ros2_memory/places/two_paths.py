"""Compares two paths by the robot's tracks: where they are farthest apart, and where it stood.

Both results are in one frame, so they are useful only if that is the map, or if odometry did not
start again between the two.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.analysis.motion.robot_track import RobotTrack, cut, jumps
from ros2_memory.core.arrays import Flags, Groups, Ints, distinct_rows
from ros2_memory.core.regions import Region, Steps
from ros2_memory.core.timebase import Ns, Span, unix_from_ns
from ros2_memory.results import FarFromOther, Pair, StandstillPlace

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from ros2_memory.analysis.frames import Floats, Times
    from ros2_memory.core.model import TimeWindow

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
    part = cut(track, window)
    jumped = jumps(part)
    ends = part.ends | jumped
    alone = ends & np.append([True], ends[:-1])[: len(ends)]
    alone &= ~(jumped & np.append([False], jumped[:-1])[: len(ends)])
    first = np.flatnonzero(~ends | alone)
    last = first + ~ends[first]
    places = np.column_stack((part.x, part.y))
    return _Steps(places[first], places[last], part.times[first], part.times[last])


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
    lines = Steps(*other.begin.T, *other.end.T)
    away = [float(lines.nearest_to(x, y)[1].min()) for x, y in points[tried].tolist()]
    farthest = int(np.argmax(away))
    x, y = points[tried[farthest]].tolist()
    return FarFromOther((x, y), (), away[farthest], int(times[tried[farthest]]))


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
    """Returns whether a track covers some times, or ends or begins `SILENCE_NS` from them."""
    starts, stops = track.pieces
    piece = np.searchsorted(starts - SILENCE_NS, at, side="right") - 1
    return (piece >= 0) & (at <= stops[piece] + SILENCE_NS)


def stood_at(
    this: Iterable[PlacedStandstill], other: Iterable[PlacedStandstill]
) -> list[StandstillPlace]:
    """Returns where the robot stood in two windows, and how long in each, without named places.

    A place is where it stood longest within `SAME_STAND_M`.
    """
    stands = [(stand, side) for side, window in enumerate((this, other)) for stand in window]
    stands.sort(key=lambda sided: (-sided[0].duration, sided[0]))
    middles = np.empty((len(stands), 2))
    by_place: list[tuple[list[PlacedStandstill], list[PlacedStandstill]]] = []
    for stand, side in stands:
        nth = count = len(by_place)
        away = ((middles[:count] - (stand.x, stand.y)) ** 2).sum(axis=1)
        if (away <= SAME_STAND_M**2).any():
            nth = int(away.argmin())
        else:
            middles[nth] = stand.x, stand.y
            by_place.append(([], []))
        by_place[nth][side].append(stand)
    return [
        StandstillPlace(
            (x, y),
            (),
            Pair(*(unix_from_ns(sum(stand.duration for stand in own)) for own in (these, those))),
            (_first_of(these), _first_of(those)),
        )
        for (x, y), (these, those) in zip(middles.tolist(), by_place, strict=False)
    ]


def _first_of(stands: Iterable[PlacedStandstill]) -> Ns | None:
    return min((stand.start for stand in stands), default=None)
