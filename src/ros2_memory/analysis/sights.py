"""Sights: what detectors saw in a slice of the clock, and from where, as small tables of integers.

A *spot* is where a detector saw one label: the mean of detections that lie together, never two of
one message. A *look* is a cell of the robot's pose (`CELL_MM`, `CELL_DECIDEG`) from which a
detector published, whether it saw anything or not. A *hit* counts how often a spot was seen in a
look. So it is known what was not seen, too.

Lengths are in mm, angles in tenths of a degree, times in ns of log time, scores in thousandths:
integers, so that sums do not depend on their order. A slice is ten seconds of the clock, so that
sights do not depend on how a history is cut into bags: the sum over an hour would not show whether
a thing was missed before or after it was last seen.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from enum import IntEnum
from itertools import combinations, groupby
from operator import attrgetter
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ros2_memory.core.arrays import Flags, Groups, Ints, distinct_rows, rows_of, run_starts
from ros2_memory.core.text import MAX_LABEL_CHARS, shortened
from ros2_memory.core.timebase import MAX_NS, NS_PER_S, NS_PER_US

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

Floats: TypeAlias = NDArray[np.float64]
_Sums: TypeAlias = tuple[int, int, int]
"""Of a spot: the number of its detections, and the sums of x and of y (mm)."""

CELL_MM: Final = 250
CELL_DECIDEG: Final = 100
NO_YAW: Final = -1
STOREY_MM: Final = 2_000
"""What differs so much in height is on another floor."""
_CELL: Final = (CELL_MM, CELL_MM, STOREY_MM, CELL_DECIDEG, CELL_DECIDEG)
SCORE_BINS: Final = 20
"""Scores are counted in bins of 0.05, what lies above 1 in the last one."""
SLICE_NS: Final = 10 * NS_PER_S

_GATE_SQUARED: Final = 750.0**2
"""A detection farther from a spot is of another thing: 30 cm of noise, two and a half times."""
_SAME_SQUARED: Final = 500.0**2
"""Spots that grew this near to each other were one, unless messages have both."""
_TOGETHER_SHARE: Final = 0.05
_BESIDE_MM: Final = 600
"""Another label this near in the same message is not this one under a wrong name."""
MAX_SPOTS: Final = 128
"""Of more of a label at once, detections are left out as if they had no place."""
_MANY_PAIRS: Final = 200
"""So many are compared sooner as arrays."""
MAX_LABELS: Final = 512
"""Of more in a slice one more is kept, which shows that others are left out."""
_MAX_COMPARED: Final = 128
"""Of more detections of a message that lie so near in x, not all are compared."""
_MAX_AWAY_M: Final = 1e8
"""From the origin: UTM has ten thousand kilometres, and squares of more are beyond 63 bits."""
_MAX_SCORE: Final = 1e6
_TOGETHER_MESSAGES: Final = 3


Spot = IntEnum("Spot", "SLICE TOPIC LABEL N X Y Z DEV FIRST LAST BEST TOGETHER", start=0)
"""Columns of `Sights.spots`.

`DEV` is the root mean square distance of the detections in the plane; `BEST` is -1 without scores;
`TOGETHER` is how many of the label at least three messages had at once, or all had.
"""

Look = IntEnum("Look", "SLICE TOPIC X Y YAW PAN N FIRST LAST Z", start=0)
"""Columns of `Sights.looks`: the mean pose in one cell, and the number of messages.

Messages for which the robot's pose is not known have a look of their own, with `NO_YAW`. `PAN` is
how far the detector was turned from the robot's heading, to `CELL_DECIDEG`.
"""

Hit = IntEnum("Hit", "SPOT LOOK N", start=0)
"""Columns of `Sights.hits`: how many messages of a look have a detection of a spot."""

Score = IntEnum("Score", "SPOT BIN N", start=0)
"""Columns of `Sights.scores`: how many detections of a spot have a score in a bin."""

Beside = IntEnum("Beside", "SPOT LABEL N", start=0)
"""Columns of `Sights.beside`: detections of a spot that had another label beside them."""

Unplaced = IntEnum("Unplaced", "SLICE TOPIC LABEL N FIRST LAST", start=0)
"""Columns of `Sights.unplaced`: detections of a label without a place."""

Fix = IntEnum("Fix", "SLICE TIME X Y YAW SIGMA", start=0)
"""Columns of `Sights.fixes`: where odometry was in the map, and how exactly that was known.

`SIGMA` is what the localiser says, for a point `AHEAD_MM` before the robot; -1 if it does not.
"""

AHEAD_MM: Final = 2_000
"""Things are about so far away: so much do errors of heading weigh."""
TABLES: Final = (Spot, Look, Hit, Score, Beside, Unplaced, Fix)
"""The columns of each table of `Sights`."""
_NAMES: Final = ("spots", "looks", "hits", "scores", "beside", "unplaced", "fixes")


class DetectorMessages(NamedTuple):
    """What the messages of a detector have, in order of log time, in one frame.

    Attributes:
        times: log times of the messages (ns).
        robot: x, y, z (m) and yaw (rad) of the robot at each, and how far the detector was turned
            from that (rad) by what moves it (M x 5); NaN where that is not known.
        rows: of each detection its message, ascending.
        labels: the place of their names in `names`.
        names: of labels; there may be some that none has.
        places: N x 3 (m); NaN where that is not known.
        scores: not finite where there is none.
    """

    times: Ints
    robot: Floats
    rows: Ints
    labels: Ints
    names: tuple[str, ...]
    places: Floats
    scores: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Sights:
    """What detectors saw in some slices of the clock: column 0 of most tables is the slice.

    Attributes:
        spots: where labels were seen (`Spot`).
        looks: from where detectors published (`Look`).
        hits: how often a spot was seen in a look (`Hit`).
        scores: of spots (`Score`).
        beside: which other labels were beside a spot in the same message (`Beside`).
        unplaced: detections without a place (`Unplaced`).
        fixes: where odometry was in the map (`Fix`).
    """

    topics: tuple[str, ...]
    labels: tuple[str, ...]
    spots: Ints
    looks: Ints
    hits: Ints
    scores: Ints
    beside: Ints
    unplaced: Ints
    fixes: Ints

    @property
    def tables(self) -> tuple[Ints, ...]:
        """All of them, as `TABLES` has their columns."""
        return attrgetter(*_NAMES)(self)


@dataclass(frozen=True, slots=True, eq=False)
class _Detections:
    """Detections in whole millimetres, ascending by message; what is not placed has zeros."""

    message: Ints
    slice: Ints
    label: Ints
    x: Ints
    y: Ints
    z: Ints
    score: Floats
    is_placed: Flags


def sights_of(topic: str, seen: DetectorMessages) -> Sights:
    """Returns the sights of the messages of one topic."""
    slices = seen.times // SLICE_NS
    look, looks = _looks(seen, slices)
    detections, labels = _detections(seen, slices)
    group, together = _label_groups(detections)
    near = np.flatnonzero(detections.is_placed)
    near = near[np.argsort(group[near], kind="stable")]
    cluster = np.full(len(detections.message), -1, np.int64)
    cluster[near] = _clusters(
        group[near], detections.message[near], detections.x[near], detections.y[near]
    )
    lost, kept = rows_of(detections, cluster < 0), rows_of(detections, cluster >= 0)
    _, spot = distinct_rows((group[cluster >= 0], cluster[cluster >= 0]))
    scored = ~np.isnan(kept.score)
    which, other = _labels_beside(kept)
    tables = (
        _spots(kept, spot, seen.times, together[group[cluster >= 0]]),
        looks,
        _tallied(spot, look[kept.message]),
        _tallied(spot[scored], bin_of(_thousandths(kept.score[scored]))),
        _tallied(spot[which], other),
        _unplaced(lost, seen.times),
        np.zeros((0, len(Fix)), np.int64),
    )
    return Sights((topic,), labels, *tables)


def fixes_of(times: Ints, poses: Floats, sigma_m: Floats) -> Sights:
    """Returns where odometry was in the map at some log times, and nothing else.

    Args:
        times: ns.
        poses: x, y (m) and yaw (rad) at each.
        sigma_m: what the localiser says; NaN where it does not.
    """
    said = np.rint(np.nan_to_num(np.minimum(sigma_m, _MAX_AWAY_M) * 1000, nan=-1)).astype(np.int64)
    x, y, yaw = poses.T
    columns = (times // SLICE_NS, _rounded(times), _mm(x), _mm(y), _decideg(yaw), said)
    none = (np.zeros((0, len(kind)), np.int64) for kind in TABLES[:-1])
    return Sights((), (), *(*none, np.stack(columns, axis=1)))


def _looks(seen: DetectorMessages, slices: Ints) -> tuple[Ints, Ints]:
    """Returns the look of each message, -1 where the robot's pose is not known; and all looks."""
    is_known = ~np.isnan(seen.robot.sum(axis=1))
    x, y, z, yaw, pan = np.where(is_known[:, None], seen.robot, 0.0).T
    turned = np.rint(_decideg(pan) / CELL_DECIDEG).astype(np.int64) * CELL_DECIDEG % 3600
    facing = np.where(is_known, _decideg(yaw) % 3600, NO_YAW)
    columns = (_mm(x), _mm(y), _mm(z) + STOREY_MM // 2, facing, turned)
    cells = [column // size for column, size in zip(columns, _CELL, strict=True)]
    _, number = distinct_rows((slices, *cells))
    look = np.where(is_known, number, -1)
    by = Groups.of(number)
    x_mm, y_mm, z_mm, *turns = (by.sums(column) // by.sizes for column in columns)
    first, last = by.ends(_rounded(seen.times))
    slices = slices[by.firsts]
    topic = np.zeros(len(slices), np.int64)
    rows = (slices, topic, x_mm, y_mm, *turns, by.sizes, first, last, z_mm - STOREY_MM // 2)
    return look, np.stack(rows, axis=1)


def _detections(seen: DetectorMessages, slices: Ints) -> tuple[_Detections, tuple[str, ...]]:
    """Returns the detections, and the names of their labels."""
    # Those that none has are of other messages, which may be forgotten.
    used, nth_used = np.unique(seen.labels, return_inverse=True)
    shown = [shortened(seen.names[code], MAX_LABEL_CHARS) for code in used.tolist()]
    names = sorted({*shown})
    number = {name: nth for nth, name in enumerate(names)}
    label = np.array([number[name] for name in shown], np.int64)[nth_used]
    with np.errstate(invalid="ignore"):
        near: Flags = np.all(np.abs(seen.places) < _MAX_AWAY_M, axis=1)
    x, y, z = _mm(np.where(near[:, None], seen.places, 0.0)).T
    scores = np.where(np.isfinite(seen.scores), seen.scores, np.nan)
    detections = _Detections(seen.rows, slices[seen.rows], label, x, y, z, scores, near)
    if len(names) > MAX_LABELS:
        rows, nth = distinct_rows((detections.slice, label))
        begins = run_starts(rows[:, 0])
        before = np.repeat(begins, np.diff(begins, append=len(rows)))
        detections = rows_of(detections, (np.arange(len(rows)) - before <= MAX_LABELS)[nth])
    return detections, tuple(names)


def _label_groups(detections: _Detections) -> tuple[Ints, Ints]:
    """Returns the slice and label of each detection, numbered, and how many are seen at once.

    That is how many of the label at least three messages of the slice have, or all.
    """
    _, group = distinct_rows((detections.slice, detections.label))
    rows, nth = distinct_rows((group, detections.message))
    counts = np.bincount(nth, minlength=len(rows))
    order = np.lexsort((-counts, rows[:, 0]))
    begins = run_starts(rows[:, 0])
    sizes = np.diff(begins, append=len(rows))
    together: Ints = counts[order][begins + np.minimum(sizes, _TOGETHER_MESSAGES) - 1]
    return group, together


def _clusters(group: Ints, message: Ints, x: Ints, y: Ints) -> Ints:
    """Returns the spot of each detection within its group; -1 where it has too many.

    Detections are ordered by group, and by message. Each is of the nearest spot, no two of a
    message of one. Mostly a group is one spot: all lie near the mean of those before.
    """
    begins = run_starts(group)
    start = np.repeat(begins, np.diff(begins, append=len(group)))
    nth = np.arange(len(group)) - start
    away = np.zeros(len(group))
    for column in (x, y):
        off = column - column[start]
        before = np.cumsum(off) - off
        away += (off - (before - before[start]) / np.maximum(nth, 1)) ** 2
    is_hard = (nth > 0) & (away > _GATE_SQUARED)
    is_hard[1:] |= (group[1:] == group[:-1]) & (message[1:] == message[:-1])
    spots = np.zeros(len(group), np.int64)
    for which in np.unique(group[is_hard]).tolist():
        begin, end = np.searchsorted(group, (which, which + 1)).tolist()
        of_group = slice(begin, end)
        places = [*zip(x[of_group].tolist(), y[of_group].tolist(), strict=True)]
        spots[of_group] = _cluster_label(message[of_group].tolist(), places)
    return spots


def _cluster_label(messages: Sequence[int], places: Sequence[tuple[int, int]]) -> list[int]:
    """Returns the spot of each detection of one label, which are ordered by message."""
    spots: list[_Sums] = []
    together: Counter[tuple[int, int]] = Counter()
    assigned: list[int] = []
    for _, in_message in groupby(range(len(messages)), key=messages.__getitem__):
        chosen = _assign(spots, [places[nth] for nth in in_message])
        assigned += chosen
        together.update(combinations(sorted(spot for spot in chosen if spot >= 0), 2))
    # What has no spot, at -1, stays so.
    into = [*_merge_spots(spots, together), -1]
    return [into[spot] for spot in assigned]


def _assign(spots: list[_Sums], places: Sequence[tuple[int, int]]) -> list[int]:
    """Adds the detections of a message to spots, and returns these; -1 where there are too many."""
    if len(spots) * len(places) < _MANY_PAIRS:
        pairs = [
            (squared, nth, which)
            for nth, (x, y) in enumerate(places)
            for which, (n, sum_x, sum_y) in enumerate(spots)
            if (squared := (sum_x / n - x) ** 2 + (sum_y / n - y) ** 2) <= _GATE_SQUARED
        ]
    else:
        sums = np.array(spots)
        away = ((sums[:, 1:] / sums[:, :1] - np.array(places)[:, None]) ** 2).sum(axis=2)
        near = np.nonzero(away <= _GATE_SQUARED)
        pairs = [*zip(away[near].tolist(), *(column.tolist() for column in near), strict=True)]
    taken: dict[int, int] = {}
    others: set[int] = set()
    for _, nth, which in sorted(pairs):
        if nth not in taken and which not in others:
            taken[nth] = which
            others.add(which)
    chosen = []
    for nth, place in enumerate(places):
        which = taken.get(nth, -1)
        if which < 0 and len(spots) < MAX_SPOTS:
            which = len(spots)
            spots.append((0, 0, 0))
        if which >= 0:
            spots[which] = _added(spots[which], (1, *place))
        chosen.append(which)
    return chosen


def _added(one: _Sums, other: _Sums) -> _Sums:
    return one[0] + other[0], one[1] + other[1], one[2] + other[2]


def _merge_spots(spots: list[_Sums], together: Mapping[tuple[int, int], int]) -> list[int]:
    """Returns into which spot each goes: those that lie together, and no messages have both of."""
    into = [*range(len(spots))]
    for first, other in combinations(range(len(spots)), 2):
        if into[first] != first or into[other] != other:
            continue
        (n, x, y), (more, to_x, to_y) = spots[first], spots[other]
        squared = (x / n - to_x / more) ** 2 + (y / n - to_y / more) ** 2
        both = together.get((first, other), 0)
        if both <= _TOGETHER_SHARE * min(n, more) and squared < _SAME_SQUARED:
            spots[first] = _added(spots[first], spots[other])
            into[other] = first
    return into


def _spots(detections: _Detections, spot: Ints, times: Ints, together: Ints) -> Ints:
    by = Groups.of(spot)
    n, firsts = by.sizes, by.firsts
    x, y, z = (by.sums(column) // n for column in (detections.x, detections.y, detections.z))
    # From the first of each: squares of far places are more than 63 bits.
    dx, dy = (column - column[firsts][spot] for column in (detections.x, detections.y))
    spread = n * by.sums(dx * dx + dy * dy) - by.sums(dx) ** 2 - by.sums(dy) ** 2
    dev = np.sqrt(np.maximum(spread, 0)).astype(np.int64) // n
    first, last = by.ends(_rounded(times[detections.message]))
    score = np.where(np.isnan(detections.score), -1, _thousandths(detections.score))
    best = by.ends(score)[1]
    topic = np.zeros(len(n), np.int64)
    columns = (n, x, y, z, dev, first, last, best, together[firsts])
    return np.stack((detections.slice[firsts], topic, detections.label[firsts], *columns), axis=1)


def _unplaced(lost: _Detections, times: Ints) -> Ints:
    rows, group = distinct_rows((lost.slice, lost.label))
    by = Groups.of(group)
    first, last = by.ends(_rounded(times[lost.message]))
    topic = np.zeros(len(rows), np.int64)
    return np.stack((rows[:, 0], topic, rows[:, 1], by.sizes, first, last), axis=1)


def _labels_beside(detections: _Detections) -> tuple[Ints, Ints]:
    """Returns detections and another label that is beside each, each pair once."""
    order = np.lexsort((detections.x, detections.message))
    ones, others = [order[:0]], [order[:0]]
    for step in range(1, _MAX_COMPARED):
        a, b = order[:-step], order[step:]
        near = detections.message[a] == detections.message[b]
        near &= detections.x[b] - detections.x[a] < _BESIDE_MM
        if not near.any():
            break
        near &= detections.label[a] != detections.label[b]
        near &= np.abs(detections.y[a] - detections.y[b]) < _BESIDE_MM
        ones += [a[near], b[near]]
        others += [b[near], a[near]]
    rows, _ = distinct_rows((np.concatenate(ones), detections.label[np.concatenate(others)]))
    return rows[:, 0], rows[:, 1]


def _tallied(first: Ints, other: Ints) -> Ints:
    """Returns the distinct pairs, and how often there is each."""
    rows, nth = distinct_rows((first, other))
    return np.column_stack((rows, np.bincount(nth, minlength=len(rows))))


def _mm(metres: Floats) -> Ints:
    return np.rint(metres * 1000).astype(np.int64)


def _decideg(radians: Floats) -> Ints:
    tenths: Ints = np.rint(np.degrees(radians) * 10).astype(np.int64)
    return tenths


def _thousandths(scores: Floats) -> Ints:
    """Returns scores in thousandths: float32 has 0.7 as 0.69999999."""
    return np.rint(np.clip(np.nan_to_num(scores), 0.0, _MAX_SCORE) * 1000).astype(np.int64)


def bin_of(thousandths: Ints) -> Ints:
    """Returns the bin of each score; -1 where there is no score."""
    return np.minimum(thousandths * SCORE_BINS // 1000, SCORE_BINS - 1)


def _rounded(times: Ints) -> Ints:
    """Rounds log times (ns) up to 1 us: a message is never later than the time that is shown."""
    # The last microsecond is not whole: its end is no time.
    return np.minimum(-(-times // NS_PER_US), MAX_NS // NS_PER_US) * NS_PER_US
