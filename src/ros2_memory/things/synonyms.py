"""Which labels a detector uses for one thing in turn: "mug" and "coffee mug", at one place.

They end in the same word, lie within the scatter of each other, alternate within a visit, and are
not in one message there. Names that the owner declares apart stay apart, and one that is used in
turn with both of them is joined with neither.
"""

from __future__ import annotations

from collections import defaultdict
from itertools import combinations, starmap
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.sights import Beside, Ints, Sights, Spot
from ros2_memory.things.labels import Labels, last_word, moves_by_itself
from ros2_memory.things.moves import visits_of
from ros2_memory.things.places import places_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from ros2_memory.storage.base import Mask

_FEWEST: Final = 3
"""A label that took fewer turns is a mistake."""
_BESIDE_SHARE: Final = 0.02
"""One message in fifty may have a thing twice."""
_LEAST_SHARE: Final = 0.05
"""A label that is given more rarely is a mistake."""
_SAME_MM: Final = 100.0
"""Means of two labels in a visit that are no farther apart are of one place."""
_SCATTERS: Final = 2.0
"""So are those within as many root mean square distances of the looks, if that is more."""


def with_synonyms(
    sights: Sights,
    counts: Ints,
    epoch: Ints,
    labels: Labels,
    go_on: Callable[[], None],
) -> list[str]:
    """Returns the keys of the labels of sights, one for all that are names of one thing.

    `epoch` has the coordinate system of each spot, and `counts` how many of its detections count.
    """
    keys = [labels.key(label) for label in sights.labels]
    by_word: dict[str, list[str]] = defaultdict(list)
    for key in sorted(set(keys)):
        if not moves_by_itself(key):
            by_word[last_word(key)].append(key)
    has_key = {key: np.array([key == other for other in keys]) for key in set(keys)}

    def are_two(one: str, other: str) -> bool:
        go_on()
        return labels.are_apart(one, other) or _are_beside(sights, has_key[one], has_key[other])

    groups = {key: frozenset({key}) for key in keys}
    pairs = [pair for alike in by_word.values() for pair in combinations(alike, 2)]
    for one, other in pairs:
        masks = has_key[one], has_key[other]
        if not are_two(one, other) and _alternate(sights.spots, counts, epoch, *masks):
            group = groups[one] | groups[other]
            groups |= dict.fromkeys(group, group)
    # A name that is used for two things does not tell them apart.
    names = {
        group: None if any(starmap(are_two, combinations(sorted(group), 2))) else min(group)
        for group in {*groups.values()}
    }
    return [names[groups[key]] or key for key in keys]


def _are_beside(sights: Sights, one: Mask, other: Mask) -> bool:
    """Whether messages have both of two labels at one place, more often than by mistake.

    Each is given as which labels of the sights are names of it.
    """
    label, beside = sights.spots[:, Spot.LABEL], sights.beside
    is_both = one[label[beside[:, Beside.SPOT]]] & other[beside[:, Beside.LABEL]]
    rarer = min(int(sights.spots[mask[label], Spot.N].sum()) for mask in (one, other))
    return bool(beside[is_both, Beside.N].sum() > _BESIDE_SHARE * rarer)


def _alternate(spots: Ints, counts: Ints, epoch: Ints, one: Mask, other: Mask) -> bool:
    """Whether two labels take turns at some place, within the scatter of each other."""
    of_both = np.flatnonzero((one | other)[spots[:, Spot.LABEL]] & (counts > 0))
    for number in np.unique(epoch[of_both]).tolist():
        rows = of_both[epoch[of_both] == number]
        x, y, slices, label = spots[rows][:, [Spot.X, Spot.Y, Spot.SLICE, Spot.LABEL]].T
        place = places_of(x, y, counts[rows], slices)
        for here in (place == nearest for nearest in range(int(place.max(initial=-1)) + 1)):
            is_other = other[label[here]].astype(np.int64)
            if is_other.any() and not is_other.all():
                rarer, total = _turns(spots[rows[here]], counts[rows[here]], is_other)
                if rarer >= max(_FEWEST, _LEAST_SHARE * total):
                    return True
    return False


def _turns(spots: Ints, n: Ints, is_other: Ints) -> tuple[int, int]:
    """Returns how often the rarer of two labels was seen in visits with turns, and both.

    `spots` are at one place in order of time, with `n` detections each; `is_other` is 0 or 1.
    """
    visit = visits_of(spots[:, Spot.FIRST], spots[:, Spot.LAST])
    cell, size = 2 * visit + is_other, 2 * int(visit[-1]) + 2
    seen = np.bincount(cell, n, size)
    means = [
        (np.bincount(cell, n * spots[:, column], size) / np.maximum(seen, 1)).reshape(-1, 2)
        for column in (Spot.X, Spot.Y)
    ]
    apart = np.hypot(*(mean[:, 1] - mean[:, 0] for mean in means))
    squares = np.bincount(visit, n * spots[:, Spot.DEV] ** 2)
    scatter = np.sqrt(squares / np.bincount(visit, n))
    first, last = np.full(size, np.iinfo(np.int64).max), np.zeros(size, np.int64)
    np.minimum.at(first, cell, spots[:, Spot.FIRST])
    np.maximum.at(last, cell, spots[:, Spot.LAST])
    begin, end = first.reshape(-1, 2), last.reshape(-1, 2)
    in_turn = (begin[:, 0] < end[:, 1]) & (begin[:, 1] < end[:, 0])
    in_turn &= apart <= np.maximum(_SAME_MM, _SCATTERS * scatter)
    turns = seen.reshape(-1, 2)[in_turn].sum(axis=0)
    return int(turns.min()), int(turns.sum())
