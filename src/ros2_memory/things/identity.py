"""Which ids tell alike things apart: a barcode's, and not those that a tracker counts anew.

An id that lasts is at its place again in a later session, and at one place at a time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.sights import Spot
from ros2_memory.core.arrays import Groups, distinct_rows, range_numbers

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.columns.sights import JoinedSights
    from ros2_memory.core.arrays import Ints

_FEWEST: Final = 3
"""Fewer ids that are at their places again may be so by chance, or be of classes."""
_LASTING_SHARE: Final = 2 / 3


def lasting_ids(sights: JoinedSights, rows: Ints, sizes: Sequence[int]) -> Ints:
    """Returns the id of each spot at some places of a label; 0 for none, or if they do not last.

    `rows` are the spots of one place after the other, in order of time, `sizes` how many each has.
    A spot without an id has that of the last one at its place, else of the next.
    """
    place = range_numbers(sizes)
    ids, slices = (sights.spots[rows, name] for name in (Spot.ID, Spot.SLICE))
    has_id = ids > 0
    if not _do_last(place[has_id], sights.sessions[slices[has_id]], ids[has_id]):
        return np.zeros_like(ids)
    for order in (slice(None), slice(None, None, -1)):
        own, there = ids[order], place[order]
        last = np.maximum.accumulate(np.where(own > 0, np.arange(len(own)), 0))
        ids[order] = np.where(there[last] == there, own[last], 0)
    return ids


def _do_last(place: Ints, session: Ints, ids: Ints) -> bool:
    """Returns whether most ids that a session has at a known place were there before."""
    seen, _ = distinct_rows((place, session, ids))
    there, when, own = seen.T
    is_known, is_again = (
        when > Groups.of(number).ends(when)[0][number]
        for _, number in (distinct_rows((there,)), distinct_rows((there, own)))
    )
    elsewhere = len(seen) - len(distinct_rows((when, own))[0])
    again, known = np.count_nonzero(is_again), np.count_nonzero(is_known)
    are_enough = len({*own[is_again].tolist()}) >= _FEWEST
    return bool(are_enough and again > _LASTING_SHARE * (known + elsewhere))
