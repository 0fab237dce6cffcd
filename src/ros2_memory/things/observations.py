"""Which detections count, and from where they were seen: what is computed once for all labels.

Detections with a low score do not count. Nor do those of carried things: a thing in a gripper, or
on a tray, moves with the robot. While the robot drives, such a thing stays at one place in the
robot's frame, and is at a new one in the map each time. None of these is a place of the thing: the
robot only passed there with it. A part of the robot that a detector takes for a thing looks the
same.

When localisation was poor, a detection is not where it seems to be: it moves nothing. Localisation
is poor while the localiser's covariance is large, and for some seconds before the map jumps under
odometry, which shows that it had been off.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np

from ros2_memory.analysis.sights import SCORE_BINS, Fix, Floats, Hit, Look, Score, Spot
from ros2_memory.core.arrays import Columns, Flags, Ints, run_starts, runs_where, stable_order
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.things.instances import Tally
from ros2_memory.things.labels import moves_by_itself
from ros2_memory.things.presence import Cells, half_turns

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from ros2_memory.columns.sights import JoinedSights
    from ros2_memory.things.labels import Labels

    Complexes: TypeAlias = NDArray[np.complex128]

FEWEST: Final = 3
"""Fewer detections are no thing: a detector sees what is not there."""
_VIEW_SHARE: Final = 0.02
"""The share of detections outside of each side of a field of view: they are mistaken."""


class Observations:
    """The sights of an estimate, and what is computed once for all labels.

    Attributes:
        counts: how many detections of each spot count; none of carried things.
        carried: which spots are of carried things.
        poor: which spots were seen while localisation was poor: they move nothing.
        hits: the looks of detections that count, by spot; -1 where localisation was poor.
        fields: the field of view of each topic; see `_fields_of_view`.
        side: for each spot, the mean of the unit vectors to it from where it was seen; 0 if that
            is unknown.
        ids: the id that distinguishes each spot from others of its label; 0 for none.
        go_on: as in `estimate`.
    """

    def __init__(
        self, sights: JoinedSights, labels: Labels, min_score: float, go_on: Callable[[], None]
    ) -> None:
        spots, self.sights, self.go_on = sights.spots, sights, go_on
        self.counts = spots[:, Spot.N]
        low = np.flatnonzero(sights.scores[:, Score.BIN] < lowest_bin(min_score))
        spot, n = (sights.scores[low, name] for name in (Score.SPOT, Score.N))
        self.counts -= np.bincount(spot, n, len(spots)).astype(np.int64)
        # People who walk along are carried by nobody.
        keys = map(labels.key, sights.labels)
        goes = np.array([moves_by_itself(key) for key in keys], np.bool_)[spots[:, Spot.LABEL]]
        self.carried = _carried_spots(sights) & ~goes
        self.counts[self.carried] = 0
        self.ids = np.zeros(len(spots), np.int64)
        self.poor, poor_looks = _poorly_localised(sights)
        # Which hits are of detections that count is not known: as many in proportion, rounded up.
        spot, look, n = (sights.hits[:, name] for name in Hit)
        n = -(-n * self.counts[spot] // spots[spot, Spot.N])
        look[np.append(poor_looks, [False])[look]] = -1
        spot, look, n = (column[n > 0] for column in (spot, look, n))
        self.hits = Tally.of(len(spots), spot, look, n)
        self.cells = Cells(sights, poor_looks)
        spot, look, n = (column[look >= 0] for column in (spot, look, n))
        distance, bearing = self.cells.seen_at(look, spots[spot, Spot.X], spots[spot, Spot.Y])
        topic = spots[spot, Spot.TOPIC]
        self.fields = _fields_of_view(topic, distance, bearing, n, len(sights.topics))
        angle = np.radians(bearing + self.cells.heading(look))
        sums = [np.bincount(spot, n * part, len(spots)) for part in (np.cos(angle), np.sin(angle))]
        total = np.maximum(np.bincount(spot, n, len(spots)), 1)
        self.side = np.stack(sums, axis=1) / total[:, None]

    def firm(self, rows: Ints) -> Ints:
        """Returns the spots seen while localisation was good; all spots if those are too few."""
        good: Ints = rows[~self.poor[rows]]
        return good if self.counts[good].sum() >= FEWEST else rows


def _fields_of_view(topic: Ints, distance: Floats, bearing: Floats, n: Ints, topics: int) -> Floats:
    """Returns how far (mm) each detector sees, in which direction, and how far to both sides of it.

    Angles are in degrees. Nearly all detections of its topic lie there. `topics` is the number of
    topics; `n` has the detections at each distance and bearing. The field of a topic without
    detections is -1.
    """
    fields = np.full((topics, 4), -1.0)
    toward = np.exp(1j * np.radians(bearing))
    for number in np.flatnonzero(np.bincount(topic)).tolist():
        rows = topic == number
        quantile = partial(np.quantile, weights=n[rows], method="inverted_cdf")
        far = quantile(distance[rows], 1 - _VIEW_SHARE)
        # A camera that looks back sees from 150 to -150 degrees, not all between.
        middle = round(np.degrees(np.angle(toward[rows] @ n[rows])))
        beside = half_turns(bearing[rows] - middle)
        sides = quantile(beside, [_VIEW_SHARE, 1 - _VIEW_SHARE])
        fields[number] = far, middle, *sides
    return fields


def lowest_bin(min_score: float) -> int:
    """Returns the lowest bin of scores that count."""
    return min(round(min_score * 1000) * SCORE_BINS // 1000, SCORE_BINS - 1)


_FEWEST_CARRIED: Final = 3
"""Fewer spots in a row may be similar things, each seen from the same side."""
_REACH_MM: Final = 1500.0
"""The farthest that a carried thing is from the origin of the robot's frame."""
_STEP_MM: Final = 300.0
"""From one spot to the next a carried thing moves at least so far in the map, ..."""
_SAME_MM: Final = 200.0
"""... and at most so far in the robot's frame, whose pose is known to a quarter of a cell."""
_PAUSE_NS: Final = 15 * NS_PER_S
_FIXED_SHARE: Final = 0.15
"""A thing stands still if its detections scatter by less than this share of the robot's way.

Those of a carried thing scatter by a third of that way.
"""


def _carried_spots(sights: JoinedSights) -> Flags:
    """Returns which spots are of a thing that the robot carried while it drove.

    Their detections follow one another. Others of the label may be in view meanwhile, if they stand
    still or are out of reach.
    """
    spots = sights.spots
    place = spots[:, Spot.X] + 1j * spots[:, Spot.Y]
    ahead, way = _seen_ahead(sights, place)
    stands = (way >= _STEP_MM) & (spots[:, Spot.DEV] < _FIXED_SHARE * way)
    may_be = np.flatnonzero((np.abs(ahead) <= _REACH_MM) & ~stands)
    first, last, label, topic = (
        spots[may_be, name] for name in (Spot.FIRST, Spot.LAST, Spot.LABEL, Spot.TOPIC)
    )
    epoch = sights.epochs[spots[may_be, Spot.SLICE]]
    order = np.lexsort((first, label, topic, epoch))
    before, after = order[:-1], order[1:]
    # Spots of one alone may overlap in time, as where the clock was set back.
    pause, is_alone = first[after] - last[before], spots[may_be, Spot.TOGETHER] == 1
    is_step = (pause <= _PAUSE_NS) & ((pause >= 0) | is_alone[before] & is_alone[after])
    for column in (label, topic, epoch):
        is_step &= column[before] == column[after]
    before, after = may_be[before], may_be[after]
    is_step &= np.abs(place[after] - place[before]) >= _STEP_MM
    is_step &= np.abs(ahead[after] - ahead[before]) <= _SAME_MM
    # Runs of steps: a run of n steps has n + 1 spots.
    carried: Flags = np.zeros(len(spots), np.bool_)
    for begin, end in runs_where(is_step).tolist():
        if end - begin + 1 >= _FEWEST_CARRIED:
            carried[may_be[order[begin : end + 1]]] = True
    return carried


def _seen_ahead(sights: JoinedSights, place: Complexes) -> tuple[Complexes, Floats]:
    """Returns each spot's place (mm) relative to the robot, x ahead, and how far it went meanwhile.

    A complex number has x and y. NaN where no pose of the robot is known.
    """
    spot, look, n = (sights.hits[sights.hits[:, Hit.LOOK] >= 0, name] for name in Hit)
    x, y, yaw = (sights.looks[look, name] for name in (Look.X, Look.Y, Look.YAW))
    relative = (place[spot] - x - 1j * y) * np.exp(-1j * np.radians(yaw / 10))
    begins = run_starts(spot)
    moved = [np.maximum.reduceat(at, begins) - np.minimum.reduceat(at, begins) for at in (x, y)]
    ahead, way = np.full(len(place), np.nan, np.complex128), np.full(len(place), np.nan)
    ahead[spot[begins]] = np.add.reduceat(n * relative, begins) / np.add.reduceat(n, begins)
    way[spot[begins]] = np.hypot(*moved)
    return ahead, way


_POOR_MM: Final = 600
"""Standard deviation of a point `AHEAD_MM` before the robot, above which localisation is poor."""
_JUMP_MM: Final = 300.0
"""A jump moves that point by more in the map, without odometry."""
_BEFORE_NS: Final = 5 * NS_PER_S
_NEXT_NS: Final = 4 * NS_PER_S
_NEVER_NS: Final = 3600 * NS_PER_S
_KNOWN_NS: Final = 60 * NS_PER_S
"""What a localiser said holds as long; it says nothing while the robot stands."""


def _poorly_localised(sights: JoinedSights) -> tuple[Flags, Flags]:
    """Returns which spots and which looks are in a slice in which localisation was poor."""
    starts, stops = _poor_times(sights.fixes)

    def are_poor(first: Ints, last: Ints) -> Flags:
        before = np.searchsorted(starts, last, side="right")
        return (before > 0) & (np.append(stops, 0)[before - 1] >= first)

    spots, looks = sights.spots, sights.looks
    poor_spots = are_poor(spots[:, Spot.FIRST], spots[:, Spot.LAST])
    poor_looks = are_poor(looks[:, Look.FIRST], looks[:, Look.LAST])
    # Whole slices: else a look from beside would miss what a spot that is left out has seen.
    slices = np.union1d(spots[poor_spots, Spot.SLICE], looks[poor_looks, Look.SLICE])
    return np.isin(spots[:, Spot.SLICE], slices), np.isin(looks[:, Look.SLICE], slices)


def _poor_times(fixes: Columns) -> tuple[Ints, Ints]:
    """Returns when localisation was poor, as starts and stops (ns), both ascending."""
    time = fixes[:, Fix.TIME]
    after = np.diff(time, append=time[-1:] + _NEVER_NS)
    after[after < 0] = _NEVER_NS  # the next one is of another session
    jumped = np.flatnonzero((fixes[:, Fix.JUMP][1:] > _JUMP_MM) & (after[:-1] <= _NEXT_NS))
    # The last covariance that the localiser gave before each fix, unless it is too old.
    sigma = fixes[:, Fix.SIGMA]
    is_new = sigma >= 0
    is_new[1:] |= after[:-1] > _KNOWN_NS
    newest = np.maximum.accumulate(np.where(is_new, np.arange(len(sigma)), 0))
    vague = np.flatnonzero(sigma[newest] > _POOR_MM)
    starts = np.concatenate((time[jumped] - _BEFORE_NS, time[vague]))
    stops = np.concatenate((time[jumped + 1], time[vague] + np.minimum(after[vague], _KNOWN_NS)))
    order = stable_order(starts)
    return starts[order], np.maximum.accumulate(stops[order])
