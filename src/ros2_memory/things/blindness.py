"""When a detector was blind: in the dark, or with its lens covered, it publishes empty messages.

From most poses a detector always sees something. Where it reports nothing at all although it looks
at several of these, or all that it saw is gone from one moment to the next, nothing was taken away.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.sights import NO_YAW, Hit, Look, Spot
from ros2_memory.core.arrays import (
    Columns,
    Ints,
    distinct_rows,
    runs_where,
    stable_order,
)
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.things.instances import BlindTime
from ros2_memory.things.labels import moves_by_itself
from ros2_memory.things.presence import half_turns

if TYPE_CHECKING:
    from ros2_memory.columns.sights import JoinedSights
    from ros2_memory.things.labels import Labels
    from ros2_memory.things.observations import Observations

_FEWEST_LABELS: Final = 3
"""Fewer things may have been taken away together."""
_FEWEST_LOOKS: Final = 3
_USUAL_SHARE: Final = 0.5
"""What is usual from a cell is in so many, and such a share, of its looks that saw anything, ..."""
_FEWEST_USUAL: Final = 2
"""... and a cell from which so many labels are usual counts as a place of its own, ..."""
_APART_MM: Final = 1000.0
"""... so far from another one, ..."""
_APART_DEG: Final = 60.0
"""... or so far turned from it."""
_AT_ONCE_NS: Final = 20 * NS_PER_S
"""What was seen so shortly before is gone from one moment to the next."""


def seeing_messages(observed: Observations, labels: Labels) -> tuple[Ints, list[BlindTime]]:
    """Returns how many messages of each look are of a seeing detector, and when one was blind.

    Of the looks next to a blind time, those count that saw what they saw most.
    """
    cells, sights = observed.cells, observed.sights
    seeing = cells.n.astype(np.int64)
    times: list[BlindTime] = []
    views = _Views(observed, labels)
    has_pose, firsts = cells.yaw != NO_YAW, cells.looks.first
    for number, topic in enumerate(sights.topics):
        looks = np.flatnonzero((cells.topic == number) & has_pose)
        looks = looks[stable_order(firsts[looks])]
        # The first columns of both tables are slice and topic.
        tables = (sights.spots, sights.unplaced)
        seen = (table[table[:, Spot.TOPIC] == number, Spot.SLICE] for table in tables)
        is_empty = ~np.isin(cells.slice[looks], np.concatenate([*seen]))
        for begin, end in runs_where(is_empty).tolist():
            run = looks[begin:end]
            if views.are_missed_in(run) or (begin and views.vanish(looks[begin - 1], run[0])):
                beside = looks[[*range(begin)[-1:], *range(len(looks))[end : end + 1]]]
                seeing[run] = 0
                seeing[beside] = views.most_hits[beside]
                times.append(BlindTime(topic, int(firsts[run[0]]), int(cells.last[run].max())))
    return seeing, times


def without_blind(sights: JoinedSights, seeing: Ints) -> JoinedSights:
    """Returns sights with fewer messages of looks, and without looks that have none left."""
    stays = seeing > 0
    number = np.cumsum(stays) - 1
    spot, look, n = (sights.hits[:, name] for name in Hit)
    look = np.where(look >= 0, number[look], look)
    looks = [*sights.looks.columns]
    looks[Look.N] = seeing
    return replace(
        sights, looks=Columns(column[stays] for column in looks), hits=Columns((spot, look, n))
    )


class _Views:
    """Which labels are usual in the view from each cell: they are in half of what it saw.

    People and the like are usual nowhere.
    """

    def __init__(self, observed: Observations, labels: Labels) -> None:
        cells, spots = observed.cells, observed.sights.spots
        keys = map(labels.key, observed.sights.labels)
        stays = ~np.array([moves_by_itself(key) for key in keys], np.bool_)
        sizes, look, n = observed.hits.rows_of(np.arange(len(spots)))
        self.most_hits = np.zeros(len(cells.slice), np.int64)
        np.maximum.at(self.most_hits, look[look >= 0], n[look >= 0])
        label = np.repeat(spots[:, Spot.LABEL], sizes)
        is_hit = (look >= 0) & stays[label]
        seen, _ = distinct_rows([look[is_hit], label[is_hit]])
        self._labels_of_look = _by_first(seen)
        seen_from, number = distinct_rows([cells.cell[seen[:, 0]], seen[:, 1]])
        often = np.bincount(number, minlength=len(seen_from))
        looks = np.bincount(cells.cell[np.unique(seen[:, 0])], minlength=len(cells.looks_in))
        enough = np.maximum(_USUAL_SHARE * looks[seen_from[:, 0]], _FEWEST_LOOKS)
        seen_from = seen_from[often >= enough]
        self._usual_in_cell = _by_first(seen_from)
        self._shows_usual = np.zeros(len(cells.looks_in), np.bool_)
        self._shows_usual[seen_from[:, 0]] = True
        self._cells = cells

    def are_missed_in(self, run: Ints) -> bool:
        """Returns whether looks that saw nothing are from places where some labels are usual."""
        run = run[self._shows_usual[self._cells.cell[run]]]
        cells, firsts = np.unique(self._cells.cell[run], return_index=True)
        usual = [self._usual_in_cell[cell] for cell in cells.tolist()]
        if len(frozenset().union(*usual)) < _FEWEST_LABELS:
            return False
        several = np.array([len(labels) >= _FEWEST_USUAL for labels in usual])
        looks = run[firsts[several]]
        x, y, heading = self._cells.x[looks], self._cells.y[looks], self._cells.heading(looks)
        away = np.hypot(x - x[:1], y - y[:1])
        turned = np.abs(half_turns(heading - heading[:1]))
        return bool(((away >= _APART_MM) | (turned >= _APART_DEG)).any())

    def vanish(self, before: int, after: int) -> bool:
        """Returns whether a look saw some labels, and the next one, from the same cell, none."""
        cells = self._cells
        pause = cells.looks.first[after] - cells.last[before]
        is_same_view = cells.cell[before] == cells.cell[after] and pause <= _AT_ONCE_NS
        return is_same_view and len(self._labels_of_look.get(before, ())) >= _FEWEST_LABELS


def _by_first(pairs: Ints) -> dict[int, frozenset[int]]:
    """Returns the second numbers of pairs by their first ones."""
    seconds: dict[int, set[int]] = {}
    for first, second in pairs.tolist():
        seconds.setdefault(first, set()).add(second)
    return {first: frozenset(those) for first, those in seconds.items()}
