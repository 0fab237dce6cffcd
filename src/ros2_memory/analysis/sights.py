"""Sights: what detectors saw in a slice of the clock, and from where, as small tables of integers.

A *spot* is a place where a detector saw one label: the mean of detections that lie together, no two
of them in one message. A *look* is a cell of the robot's pose (`CELL_MM`, `CELL_DECIDEG`) from
which a detector published, whether it saw anything or not. A *hit* counts how often a spot was seen
in a look. So it is known what was not seen, too.

Lengths are in mm, angles in tenths of a degree, times in ns of log time, scores in thousandths: all
are integers, so that sums do not depend on their order. A slice is ten seconds of the clock,
however a history is cut into bags. Sums over an hour would not show whether a thing was missed
before or after it was last seen.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from enum import IntEnum
from itertools import combinations, groupby
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ros2_memory.core.arrays import (
    Flags,
    Groups,
    Ints,
    distinct_rows,
    pair_counts,
    places_within,
    rows_of,
    run_starts,
    sorted_codes,
    stable_order,
)
from ros2_memory.core.text import MAX_LABEL_CHARS, shortened
from ros2_memory.core.timebase import MAX_NS, NS_PER_S, NS_PER_US

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from ros2_memory.core.model import Vector3

Floats: TypeAlias = NDArray[np.float64]
_Sums: TypeAlias = tuple[int, int, int]
"""The number of detections in a spot, and the sums of their x and y (mm)."""

CELL_MM: Final = 250
CELL_DECIDEG: Final = 100
NO_YAW: Final = -1
STOREY_MM: Final = 2_000
"""Two points that differ so much in height are on different floors."""
_UPRIGHT: Final = 3
"""The z component of the up direction for a detector that does not lean, in thirds."""
SCORE_BINS: Final = 20
"""Scores are counted in bins of 0.05; scores above 1 are in the last bin."""
SLICE_NS: Final = 10 * NS_PER_S

_GATE_SQUARED: Final = 750.0**2
"""A detection farther (mm) from a spot is of another thing: two and a half times 30 cm of noise."""
_SAME_SQUARED: Final = 500.0**2
"""Spots nearer (mm) to each other than this are one thing, unless messages have both."""
_TOGETHER_SHARE: Final = 0.05
"""Spots that share messages, but fewer than this share of the smaller spot, may still be one."""
_BESIDE_MM: Final = 600
"""Another label this near in the same message is another thing, and no wrong name of this one."""
MAX_SPOTS: Final = 128
"""How many spots a label may have at once; further detections count as without a place."""
_MANY_PAIRS: Final = 200
"""From so many pairs on, arrays are quicker than a loop."""
MAX_LABELS: Final = 512
"""How many labels a slice may have; one more stays and shows that others are left out."""
_MAX_COMPARED: Final = 128
"""Each detection of a message is compared with so many next ones in order of x."""
_MAX_AWAY_M: Final = 1e8
"""The farthest place: UTM reaches 1e7 m, and squares (mm2) of more would be beyond 63 bits."""
_MAX_SCORE: Final = 1e6
_TOGETHER_MESSAGES: Final = 3
_NO_IDS: Final = frozenset({"", "-1"})
"""What trackers write for an object that they do not follow."""


Spot = IntEnum("Spot", "SLICE TOPIC LABEL N X Y Z DEV FIRST LAST BEST TOGETHER ID", start=0)
"""Columns of `Sights.spots`.

`DEV` is the root mean square distance of the detections in the plane; `BEST` is -1 without scores;
`TOGETHER` is how many of the label at least three messages had at once, or all had; `ID` the id of
most of the detections that have one.
"""

Look = IntEnum("Look", "SLICE TOPIC X Y YAW PAN N FIRST LAST Z LEAN", start=0)
"""Columns of `Sights.looks`: the mean pose in one cell, and the number of messages.

Messages for which the robot's pose is not known have a look of their own, with `NO_YAW`. `PAN` is
how far the detector was turned from the robot's heading, to `CELL_DECIDEG`; `LEAN` a number for
how it was tilted or rolled, to some 20 degrees: 0 if it was upright.
"""

Hit = IntEnum("Hit", "SPOT LOOK N", start=0)
"""Columns of `Sights.hits`: how many messages of a look have a detection of a spot."""

Score = IntEnum("Score", "SPOT BIN N", start=0)
"""Columns of `Sights.scores`: how many detections of a spot have a score in a bin."""

Beside = IntEnum("Beside", "SPOT LABEL N", start=0)
"""Columns of `Sights.beside`: detections of a spot that had another label beside them."""

Unplaced = IntEnum("Unplaced", "SLICE TOPIC LABEL N FIRST LAST", start=0)
"""Columns of `Sights.unplaced`: detections of a label without a place."""

Fix = IntEnum("Fix", "SLICE TIME JUMP SIGMA", start=0)
"""Columns of `Sights.fixes`: how well it was known where the robot was in the map.

Both are of a point `AHEAD_MM` before the robot, in mm: `JUMP` how far the map moved it under
odometry since the fix before, `SIGMA` its standard deviation as the localiser states it; -1 if it
does not.
"""

AHEAD_MM: Final = 2_000
"""The usual distance of a thing, by which errors of the heading are weighed."""
TABLES: Final = (Spot, Look, Hit, Score, Beside, Unplaced, Fix)
"""The columns of each table of `Sights`."""


class DetectorMessages(NamedTuple):
    """The M messages of a detector, in order of log time, and their N detections, in one frame.

    Attributes:
        times: for each message, its log time (ns).
        robot: for each message, x, y, z (m) and yaw (rad) of the robot, the angle (rad) by which
            the detector was turned from the robot's heading, and the up direction as a unit vector
            in the frame that the detector is mounted on (M x 8); NaN if not known. A lift adds
            to z.
        rows: for each detection, the index of its message, ascending.
        labels: for each detection, the index of its label in `names`.
        names: the labels; some may have no detection.
        places: for each detection, x, y, z (m); NaN if not known.
        scores: for each detection, its score; not finite if it has none.
        ids: for each detection, the index of its id in `id_names`; "" there is none.
    """

    times: Ints
    robot: Floats
    rows: Ints
    labels: Ints
    names: tuple[str, ...]
    places: Floats
    scores: Floats
    ids: Ints
    id_names: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Sights:
    """What detectors saw in slices of the clock; column 0 of most tables is the slice.

    Attributes:
        topics: the topics of the detectors.
        labels: the labels that they saw.
        ids: the ids of spots; "" stands for none.
        spots: where labels were seen (`Spot`).
        looks: from where detectors published (`Look`).
        hits: how often a spot was seen in a look (`Hit`).
        scores: how high the scores of spots were (`Score`).
        beside: which other labels were beside a spot in the same message (`Beside`).
        unplaced: detections without a place (`Unplaced`).
        fixes: how well it was known where the robot was in the map (`Fix`).
    """

    topics: tuple[str, ...]
    labels: tuple[str, ...]
    ids: tuple[str, ...]
    spots: Ints
    looks: Ints
    hits: Ints
    scores: Ints
    beside: Ints
    unplaced: Ints
    fixes: Ints

    @property
    def tables(self) -> tuple[Ints, ...]:
        """All tables, in the order of `TABLES`."""
        return (
            self.spots,
            self.looks,
            self.hits,
            self.scores,
            self.beside,
            self.unplaced,
            self.fixes,
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Detections:
    """Detections in whole millimetres, ascending by message; at 0 if they are not placed."""

    message: Ints
    slice: Ints
    label: Ints
    x: Ints
    y: Ints
    z: Ints
    score: Floats
    is_placed: Flags
    id: Ints


def sights_of(topic: str, seen: DetectorMessages) -> Sights:
    """Returns the sights of the messages of one topic."""
    slices = seen.times // SLICE_NS
    look, looks = _looks(seen, slices)
    detections, labels = _detections(seen, slices)
    group, together = _label_groups(detections)
    rows = np.flatnonzero(detections.is_placed)
    floor, cluster = np.full((2, len(detections.message)), -1, np.int64)
    floor[rows] = _floors(group[rows], detections.z[rows])
    rows = rows[stable_order(floor[rows])]
    cluster[rows] = _clusters(
        floor[rows], detections.message[rows], detections.x[rows], detections.y[rows]
    )
    in_spot = cluster >= 0
    _, spot = distinct_rows((floor[in_spot], cluster[in_spot]))
    placed = rows_of(detections, in_spot)
    is_scored = ~np.isnan(placed.score)
    row, other_label = _labels_beside(placed)
    own_id, ids = _ids_of_spots(spot, placed.id, seen.id_names)
    spots = _spots(placed, spot, seen.times, together[group[in_spot]])
    tables = (
        np.column_stack((spots, own_id)),
        looks,
        pair_counts(spot, look[placed.message]),
        pair_counts(spot[is_scored], bin_of(_thousandths(placed.score[is_scored]))),
        pair_counts(spot[row], other_label),
        _unplaced(rows_of(detections, ~in_spot), seen.times),
        np.zeros((0, len(Fix)), np.int64),
    )
    return Sights((topic,), labels, ids, *tables)


def fixes_of(times: Ints, jumps_m: Floats, sigma_m: Floats) -> Sights:
    """Returns sights with fixes alone: how well it was known where the robot was in the map.

    Args:
        times: log times (ns).
        jumps_m: for each time, `Fix.JUMP`.
        sigma_m: for each time, `Fix.SIGMA` as the localiser states it; NaN if it does not.
    """
    sigma_mm = np.nan_to_num(np.minimum(sigma_m, _MAX_AWAY_M) * 1000, nan=-1)
    sigmas = np.rint(sigma_mm).astype(np.int64)
    jumps = _mm(np.minimum(jumps_m, _MAX_AWAY_M))
    columns = (times // SLICE_NS, _rounded(times), jumps, sigmas)
    empty = (np.zeros((0, len(kind)), np.int64) for kind in TABLES[:-1])
    return Sights((), (), (), *(*empty, np.stack(columns, axis=1)))


def _looks(seen: DetectorMessages, slices: Ints) -> tuple[Ints, Ints]:
    """Returns the look of each message (-1 if the robot's pose is not known), and the table.

    All messages of a slice without a known pose have one look, at 0 and with `NO_YAW`.
    """
    is_known = ~np.isnan(seen.robot.sum(axis=1))
    x, y, z, yaw, pan, *up = np.where(is_known[:, None], seen.robot, 0.0).T
    turned = np.rint(_decideg(pan) / CELL_DECIDEG).astype(np.int64) * CELL_DECIDEG % 3600
    facing = np.where(is_known, _decideg(yaw) % 3600, NO_YAW)
    columns = (_mm(x), _mm(y), _mm(z), facing, turned)
    lean = np.where(is_known, _leans(up), 0)
    grid = (columns[0] // CELL_MM, columns[1] // CELL_MM, height_cells(columns[2]))
    cells = (*grid, *(column // CELL_DECIDEG for column in columns[3:]), lean)
    _, number = distinct_rows((slices, *cells))
    look = np.where(is_known, number, -1)
    by = Groups.of(number)
    x_mm, y_mm, z_mm, *turns = (by.sums(column) // by.sizes for column in columns)
    first, last = by.ends(_rounded(seen.times))
    slices, lean = slices[by.firsts], lean[by.firsts]
    topic = np.zeros(len(slices), np.int64)
    rows = (slices, topic, x_mm, y_mm, *turns, by.sizes, first, last, z_mm, lean)
    return look, np.stack(rows, axis=1)


def apart_m(one: Vector3, other: Vector3) -> float:
    """Returns how far (m) two points are apart in the plane; infinite for those on two floors."""
    above_mm = abs(one[2] - other[2]) * 1000
    return math.dist(one[:2], other[:2]) if above_mm <= STOREY_MM else math.inf


def height_cells(z_mm: Ints) -> Ints:
    """Returns the cell of each height: a robot on the floor is in the middle of one."""
    return (z_mm + CELL_MM // 2) // CELL_MM


def _leans(up: Sequence[Floats]) -> Ints:
    """Returns a number for each direction (x, y, z) of up, to some 20 degrees; see `Look.LEAN`."""
    x, y, z = (np.rint(axis * 3).astype(np.int64) for axis in up)
    return x * 49 + y * 7 + z - _UPRIGHT


def _detections(seen: DetectorMessages, slices: Ints) -> tuple[_Detections, tuple[str, ...]]:
    """Returns the detections, and the names of their labels, sorted."""
    # A label without a detection is of other messages, which may be forgotten.
    short_names = [shortened(name, MAX_LABEL_CHARS) for name in seen.names]
    label, names = sorted_codes(seen.labels, short_names)
    with np.errstate(invalid="ignore"):
        is_placed: Flags = np.all(np.abs(seen.places) < _MAX_AWAY_M, axis=1)
    x, y, z = _mm(np.where(is_placed[:, None], seen.places, 0.0)).T
    scores = np.where(np.isfinite(seen.scores), seen.scores, np.nan)
    detections = _Detections(
        seen.rows, slices[seen.rows], label, x, y, z, scores, is_placed, seen.ids
    )
    if len(names) > MAX_LABELS:
        rows, nth = distinct_rows((detections.slice, label))
        begins = run_starts(rows[:, 0])
        nth_in_slice = places_within(np.diff(begins, append=len(rows)))
        detections = rows_of(detections, (nth_in_slice <= MAX_LABELS)[nth])
    return detections, names


def _label_groups(detections: _Detections) -> tuple[Ints, Ints]:
    """Groups detections by slice and label.

    Returns:
        For each detection its group, and for each group how many of the label are seen at once:
        at least three messages of the slice have so many or, if there are fewer, all messages.
    """
    _, group = distinct_rows((detections.slice, detections.label))
    rows, nth = distinct_rows((group, detections.message))
    counts = np.bincount(nth, minlength=len(rows))
    order = np.lexsort((-counts, rows[:, 0]))
    begins = run_starts(rows[:, 0])
    sizes = np.diff(begins, append=len(rows))
    together: Ints = counts[order][begins + np.minimum(sizes, _TOGETHER_MESSAGES) - 1]
    return group, together


def _floors(group: Ints, z: Ints) -> Ints:
    """Returns a number for the detections of a group that are on one floor, ascending by group."""
    order = np.lexsort((z, group))
    is_other = np.diff(group[order], prepend=-1) > 0
    is_other |= np.diff(z[order], prepend=0) > STOREY_MM
    floors = np.empty(len(group), np.int64)
    floors[order] = np.cumsum(is_other)
    return floors


def _clusters(group: Ints, message: Ints, x: Ints, y: Ints) -> Ints:
    """Returns the spot of each detection within its group; -1 for detections of too many spots.

    A group has one label in one slice on one floor. Detections are ordered by group and by message.
    Each goes to the nearest spot, no two of a message to one. Mostly a group is one spot, as each
    of its detections lies near the mean of those before: only the other groups are clustered one
    by one.
    """
    begins = run_starts(group)
    start = np.repeat(begins, np.diff(begins, append=len(group)))
    nth = np.arange(len(group)) - start
    squared = np.zeros(len(group))
    for column in (x, y):
        off = column - column[start]
        before = np.cumsum(off) - off
        squared += (off - (before - before[start]) / np.maximum(nth, 1)) ** 2
    is_apart = (nth > 0) & (squared > _GATE_SQUARED)
    is_apart[1:] |= (group[1:] == group[:-1]) & (message[1:] == message[:-1])
    spots = np.zeros(len(group), np.int64)
    for number in np.unique(group[is_apart]).tolist():
        rows = slice(*np.searchsorted(group, (number, number + 1)).tolist())
        places = [*zip(x[rows].tolist(), y[rows].tolist(), strict=True)]
        spots[rows] = _cluster_label(message[rows].tolist(), places)
    return spots


def _cluster_label(messages: Sequence[int], places: Sequence[tuple[int, int]]) -> list[int]:
    """Returns the spot of each detection of one label; -1 if there are too many spots.

    `messages` are the indices of the detections' messages, ascending.
    """
    spots: list[_Sums] = []
    together: Counter[tuple[int, int]] = Counter()
    assigned: list[int] = []
    for _, in_message in groupby(range(len(messages)), key=messages.__getitem__):
        own_places = [places[nth] for nth in in_message]
        nearest = _nearest_spots(spots, own_places)
        own_spots: list[int] = []
        for nth, (x, y) in enumerate(own_places):
            spot = nearest.get(nth, -1)
            if spot < 0 and len(spots) < MAX_SPOTS:
                spot = len(spots)
                spots.append((0, 0, 0))
            if spot >= 0:
                spots[spot] = _added(spots[spot], (1, x, y))
            own_spots.append(spot)
        assigned += own_spots
        together.update(combinations(sorted(spot for spot in own_spots if spot >= 0), 2))
    merged_into = _merged_spots(spots, together)
    return [spot if spot < 0 else merged_into[spot] for spot in assigned]


def _nearest_spots(spots: Sequence[_Sums], places: Sequence[tuple[int, int]]) -> dict[int, int]:
    """Returns the spots that the detections of a message go to, by the index of the detection.

    The nearest pairs are matched first, each spot and each detection once.
    """
    pairs: list[tuple[float, int, int]] = []
    if len(spots) * len(places) < _MANY_PAIRS:
        for nth, (x, y) in enumerate(places):
            for spot, (n, sum_x, sum_y) in enumerate(spots):
                squared = (sum_x / n - x) ** 2 + (sum_y / n - y) ** 2
                if squared <= _GATE_SQUARED:
                    pairs.append((squared, nth, spot))
    else:
        sums = np.array(spots)
        squares = ((sums[:, 1:] / sums[:, :1] - np.array(places)[:, None]) ** 2).sum(axis=2)
        near = np.nonzero(squares <= _GATE_SQUARED)
        pairs += zip(squares[near].tolist(), *(column.tolist() for column in near), strict=True)
    spot_of: dict[int, int] = {}
    taken: set[int] = set()
    for _, nth, spot in sorted(pairs):
        if nth not in spot_of and spot not in taken:
            spot_of[nth] = spot
            taken.add(spot)
    return spot_of


def _added(one: _Sums, other: _Sums) -> _Sums:
    return one[0] + other[0], one[1] + other[1], one[2] + other[2]


def _merged_spots(spots: Sequence[_Sums], together: Mapping[tuple[int, int], int]) -> list[int]:
    """Returns the spot that each spot is merged into, often itself.

    Spots that lie together are merged, unless messages have both. `together` counts the messages
    that have a pair of spots.
    """
    sums = [*spots]
    merged_into = [*range(len(sums))]
    for first, other in combinations(range(len(sums)), 2):
        if merged_into[first] != first or merged_into[other] != other:
            continue
        (n, x, y), (other_n, other_x, other_y) = sums[first], sums[other]
        squared = (x / n - other_x / other_n) ** 2 + (y / n - other_y / other_n) ** 2
        both = together.get((first, other), 0)
        if both <= _TOGETHER_SHARE * min(n, other_n) and squared < _SAME_SQUARED:
            sums[first] = _added(sums[first], sums[other])
            merged_into[other] = first
    return merged_into


def _spots(detections: _Detections, spot: Ints, times: Ints, together: Ints) -> Ints:
    """Returns the table of spots; `spot` and `together` are for each detection."""
    by = Groups.of(spot)
    n, firsts = by.sizes, by.firsts
    x, y, z = (by.sums(column) // n for column in (detections.x, detections.y, detections.z))
    # Relative to the first detection of each: squares of far places are beyond 63 bits.
    dx, dy = (column - column[firsts][spot] for column in (detections.x, detections.y))
    spread = n * by.sums(dx * dx + dy * dy) - by.sums(dx) ** 2 - by.sums(dy) ** 2
    dev = np.sqrt(np.maximum(spread, 0)).astype(np.int64) // n
    first, last = by.ends(_rounded(times[detections.message]))
    score = np.where(np.isnan(detections.score), -1, _thousandths(detections.score))
    best = by.ends(score)[1]
    topic = np.zeros(len(n), np.int64)
    columns = (n, x, y, z, dev, first, last, best, together[firsts])
    return np.stack((detections.slice[firsts], topic, detections.label[firsts], *columns), axis=1)


def _ids_of_spots(spot: Ints, ids: Ints, names: Sequence[str]) -> tuple[Ints, tuple[str, ...]]:
    """Returns the id of each spot, and their names in order.

    `spot` and `ids` are for each detection. The id is that of most detections with one; of no
    object has a detector -1.
    """
    words = [shortened(name, MAX_LABEL_CHARS) for name in names]
    has_id = np.array([word not in _NO_IDS for word in words], np.bool_)[ids]
    chosen = np.full(int(spot.max(initial=-1)) + 1, len(words))
    with_id, own_id, n = pair_counts(spot[has_id], ids[has_id]).T
    is_most = 2 * n > np.bincount(with_id, n)[with_id]
    chosen[with_id[is_most]] = own_id[is_most]
    return sorted_codes(chosen, [*words, ""])


def _unplaced(detections: _Detections, times: Ints) -> Ints:
    """Returns the table of detections without a place."""
    rows, group = distinct_rows((detections.slice, detections.label))
    by = Groups.of(group)
    first, last = by.ends(_rounded(times[detections.message]))
    topic = np.zeros(len(rows), np.int64)
    return np.stack((rows[:, 0], topic, rows[:, 1], by.sizes, first, last), axis=1)


def _labels_beside(detections: _Detections) -> tuple[Ints, Ints]:
    """Returns pairs of a detection and another label that is beside it, each pair once.

    Detections of a message are compared in order of x, each with the next one, then each with the
    next but one, and so on, until none are near enough in x.
    """
    order = np.lexsort((detections.x, detections.message))
    ones, others = [order[:0]], [order[:0]]
    for step in range(1, _MAX_COMPARED):
        a, b = order[:-step], order[step:]
        is_near = detections.message[a] == detections.message[b]
        is_near &= detections.x[b] - detections.x[a] < _BESIDE_MM
        if not is_near.any():
            break
        is_near &= detections.label[a] != detections.label[b]
        is_near &= np.abs(detections.y[a] - detections.y[b]) < _BESIDE_MM
        ones += [a[is_near], b[is_near]]
        others += [b[is_near], a[is_near]]
    rows, _ = distinct_rows((np.concatenate(ones), detections.label[np.concatenate(others)]))
    return rows[:, 0], rows[:, 1]


def _mm(metres: Floats) -> Ints:
    return np.rint(metres * 1000).astype(np.int64)


def _decideg(radians: Floats) -> Ints:
    tenths: Ints = np.rint(np.degrees(radians) * 10).astype(np.int64)
    return tenths


def _thousandths(scores: Floats) -> Ints:
    """Returns scores in whole thousandths, so that 0.69999999, a float32 of 0.7, is 700."""
    return np.rint(np.clip(np.nan_to_num(scores), 0.0, _MAX_SCORE) * 1000).astype(np.int64)


def bin_of(thousandths: Ints) -> Ints:
    """Returns the bin of each score (thousandths); -1 for a negative one, which stands for none."""
    return np.minimum(thousandths * SCORE_BINS // 1000, SCORE_BINS - 1)


def _rounded(times: Ints) -> Ints:
    """Rounds log times (ns) up to microseconds: no message is later than the time that is shown."""
    # The greatest time lies inside of a microsecond, whose end would overflow.
    return np.minimum(-(-times // NS_PER_US), MAX_NS // NS_PER_US) * NS_PER_US
