"""Which labels a detector uses for one thing in turn: "mug" and "coffee mug", at one place.

They end in the same word, lie within the scatter of each other, alternate within a visit, and are
not in one message there. Names that the owner declares apart stay apart, and one that is used in
turn with both of them is joined with neither.
"""

from __future__ import annotations

from collections import defaultdict
from itertools import chain, combinations
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.sights import Beside, Spot
from ros2_memory.core.arrays import Groups, Ints, distinct_rows, in_ranges, rows_by, stable_order
from ros2_memory.things.labels import Labels, last_word, moves_by_itself, unspaced
from ros2_memory.things.places import places_of, visits_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from ros2_memory.columns.sights import JoinedSights

_MOST_NAMES: Final = 64
"""How many labels at one place are compared with each other, the commonest."""
_FEWEST_TURNS: Final = 3
"""A label that took fewer turns is a mistake."""
_BESIDE_SHARE: Final = 0.02
"""One message in fifty may have a thing twice."""
_LEAST_SHARE: Final = 0.05
"""A label that is given more rarely is a mistake."""
_SAME_MM: Final = 100.0
"""The means of two labels in a visit are at one place if they are this near to each other."""
_SCATTERS: Final = 2.0
"""Or if they are within two root mean square distances of the looks."""


def with_synonyms(
    sights: JoinedSights,
    counts: Ints,
    labels: Labels,
    go_on: Callable[[], None],
) -> list[str]:
    """Returns the key of each label of the sights: one key for all names of one thing.

    `counts` has how many detections of each spot count.
    """
    keys = [labels.key(label) for label in sights.labels]
    names = sorted({*keys})
    numbers = {name: number for number, name in enumerate(names)}
    key_of_label = np.array([numbers[key] for key in keys], np.int64)
    beside = _often_beside(sights, key_of_label)

    def are_two(one: int, other: int) -> bool:
        return (one, other) in beside or labels.are_apart(names[one], names[other])

    key = key_of_label[sights.spots[:, Spot.LABEL]]
    by_word, by_spelling = defaultdict[str, list[int]](list), defaultdict[str, list[int]](list)
    for number in np.unique(key[counts > 0]).tolist():
        if not moves_by_itself(names[number]):
            by_word[last_word(names[number])].append(number)
            by_spelling[unspaced(names[number])].append(number)
    pairs = [*chain.from_iterable(combinations(alike, 2) for alike in by_spelling.values())]
    for alike in by_word.values():
        if len(alike) > 1:
            go_on()
            pairs += _pairs_in_turn(sights, counts, key, alike)
    groups = {number: frozenset({number}) for number in range(len(names))}
    for one, other in pairs:
        if not are_two(one, other):
            group = groups[one] | groups[other]
            groups |= dict.fromkeys(group, group)
    shown: dict[int, str] = {}
    for group in {*groups.values()}:
        # A name that is used for two things does not tell them apart.
        if not any(are_two(*pair) for pair in combinations(sorted(group), 2)):
            shown |= dict.fromkeys(group, names[min(group)])
    return [shown.get(numbers[key], key) for key in keys]


def _often_beside(sights: JoinedSights, key_of_label: Ints) -> set[tuple[int, int]]:
    """Returns the pairs of keys that messages have at one place, more often than by mistake."""
    spots = sights.spots
    key = key_of_label[spots[:, Spot.LABEL]]
    detections = np.bincount(key, spots[:, Spot.N])
    spot, label, n = (sights.beside[:, name] for name in Beside)
    pairs, pair = distinct_rows((key[spot], key_of_label[label]))
    rarer = detections[pairs].min(axis=1)
    often = np.bincount(pair, n, len(pairs)) > _BESIDE_SHARE * rarer
    return {(one, other) for one, other in pairs[often].tolist()}


def _pairs_in_turn(
    sights: JoinedSights, counts: Ints, key: Ints, alike: Sequence[int]
) -> Iterator[tuple[int, int]]:
    """Yields the pairs of some keys that take turns at a place. `key` has the key of each spot."""
    counting = np.flatnonzero((counts > 0) & np.isin(key, alike))
    epoch = sights.epochs[sights.spots[counting, Spot.SLICE]]
    for number in np.unique(epoch).tolist():
        rows = counting[epoch == number]
        x, y, slices = (sights.spots[rows, name] for name in (Spot.X, Spot.Y, Spot.SLICE))
        place = places_of(x, y, counts[rows], slices)
        rows, place = rows[place >= 0], place[place >= 0]
        for positions in rows_by(place, int(place.max(initial=-1)) + 1):
            here = rows[positions]
            commonest = stable_order(-np.bincount(key[here], counts[here]))[:_MOST_NAMES]
            here = here[np.isin(key[here], commonest)]
            yield from _pairs_in_turn_at(sights.spots[here], counts[here], key[here]).tolist()


def _pairs_in_turn_at(spots: Ints, n: Ints, key: Ints) -> Ints:
    """Returns the pairs of keys that take turns at a place, within the scatter of each other.

    `spots` are at the place, in order of time, with `n` detections each.
    """
    visit = visits_of(spots[:, Spot.FIRST], spots[:, Spot.LAST])
    seen_in, cell = distinct_rows((visit, key))
    by = Groups.of(cell)
    seen, squares = by.sums(n), by.sums(n * spots[:, Spot.DEV] ** 2)
    x, y = (by.sums(n * spots[:, axis]) / seen for axis in (Spot.X, Spot.Y))
    begin, end = by.ends(spots[:, Spot.FIRST])[0], by.ends(spots[:, Spot.LAST])[1]
    # Each key that a visit has, with each of those that follow in the same visit.
    number = np.arange(len(seen_in))
    following = np.cumsum(np.bincount(seen_in[:, 0]))[seen_in[:, 0]] - number - 1
    one, other = np.repeat(number, following), in_ranges(number + 1, following)
    scatter = np.sqrt((squares[one] + squares[other]) / (seen[one] + seen[other]))
    in_turn = (begin[one] < end[other]) & (begin[other] < end[one])
    away = np.hypot(x[one] - x[other], y[one] - y[other])
    in_turn &= away <= np.maximum(_SAME_MM, _SCATTERS * scatter)
    one, other = one[in_turn], other[in_turn]
    pairs, pair = distinct_rows((seen_in[one, 1], seen_in[other, 1]))
    turns, other_turns = (np.bincount(pair, seen[which], len(pairs)) for which in (one, other))
    fewest = np.maximum(_FEWEST_TURNS, _LEAST_SHARE * (turns + other_turns))
    alternating: Ints = pairs[np.minimum(turns, other_turns) >= fewest]
    return alternating
