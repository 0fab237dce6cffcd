"""When a detector was blind: in the dark, or with its lens covered, it publishes empty messages.

From most poses a detector always sees something. Where it reports nothing at all although it looks
at several of these, or at what is there before and after in views far apart, or all that it saw is
gone from one moment to the next, nothing was taken away.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.sights import NO_YAW, Hit, Look, Spot
from ros2_memory.core.arrays import (
    Columns,
    Groups,
    Ints,
    distinct_rows,
    entries_of_codes,
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

_LABELS_MISSED: Final = 3
"""Fewer things may have been taken away together."""
_LABELS_OF_VIEW: Final = 2
"""A view in which so many labels are usual is compared with others."""
_TIMES_OF_USUAL: Final = 3
"""What was seen less often from a cell is not usual there."""
_SHARE_OF_USUAL: Final = 0.5
"""What is usual is in such a share of the messages of looks from its cell that saw anything."""
_FAR_MM: Final = 10_000.0
"""What is seen before and after in views so far apart was not taken away, and put back."""
_OTHER_VIEW_MM: Final = 1000.0
_OTHER_VIEW_DEG: Final = 60.0
_AT_ONCE_NS: Final = 20 * NS_PER_S
"""What was seen so shortly before is gone from one moment to the next."""


def without_blind_looks(
    observed: Observations, labels: Labels
) -> tuple[JoinedSights, list[BlindTime]]:
    """Returns sights without the looks of blind detectors, and when these were blind.

    Of the looks next to a blind time, as many messages count as have what was seen most.
    """
    cells, sights = observed.cells, observed.sights
    views, firsts = _Views(observed, labels), cells.looks.first
    messages = cells.n.astype(np.int64)
    times: list[BlindTime] = []
    for number, topic in enumerate(sights.topics):
        looks = np.flatnonzero((cells.topic == number) & (cells.yaw != NO_YAW))
        looks = looks[stable_order(firsts[looks])]
        # The first columns of both tables are slice and topic.
        tables = (sights.spots, sights.unplaced)
        seen = [table[table[:, Spot.TOPIC] == number, Spot.SLICE] for table in tables]
        is_empty = ~np.isin(cells.slice[looks], np.concatenate(seen))
        for begin, end in runs_where(is_empty).tolist():
            run, around = looks[begin:end], looks[max(begin - 1, 0) : end + 1]
            if views.lack_usual(run) or (begin and views.vanish(*around[:2].tolist())):
                messages[around] = views.most_hits[around]
                times.append(BlindTime(topic, int(firsts[run[0]]), int(cells.last[run].max())))
    return (_with_messages(sights, messages) if times else sights), times


def _with_messages(sights: JoinedSights, messages: Ints) -> JoinedSights:
    """Returns sights with so many messages of each look, without the looks that have none."""
    stays = messages > 0
    number = np.cumsum(stays) - 1
    spot, look, n = (sights.hits[:, name] for name in Hit)
    look = np.where(look >= 0, number[look], look)
    looks = [*sights.looks.columns]
    looks[Look.N] = messages
    return replace(
        sights, looks=Columns(column[stays] for column in looks), hits=Columns((spot, look, n))
    )


class _Views:
    """Which labels are usual from each cell; people and the like are usual nowhere.

    Attributes:
        most_hits: for each look, how often its most frequent thing was detected.
    """

    def __init__(self, observed: Observations, labels: Labels) -> None:
        cells, spots = observed.cells, observed.sights.spots
        keys = map(labels.key, observed.sights.labels)
        stays = ~np.array([moves_by_itself(key) for key in keys], np.bool_)
        sizes, look, n = observed.hits.rows_of(np.arange(len(spots)))
        label = np.repeat(spots[:, Spot.LABEL], sizes)
        look, n, label = (column[look >= 0] for column in (look, n, label))
        self.most_hits = np.zeros(len(cells.slice), np.int64)
        np.maximum.at(self.most_hits, look, n)
        seen, number = distinct_rows([look[stays[label]], label[stays[label]]])
        most = np.zeros(len(seen), np.int64)
        np.maximum.at(most, number, n[stays[label]])
        self._labels_in_look = np.bincount(seen[:, 0], minlength=len(cells.slice))
        seen_from, number = distinct_rows([cells.cell[seen[:, 0]], seen[:, 1]])
        times = np.bincount(number, most, len(seen_from))
        seeing = self._labels_in_look > 0
        messages = np.bincount(cells.cell[seeing], cells.n[seeing], len(cells.looks_in))
        least = np.maximum(_SHARE_OF_USUAL * messages[seen_from[:, 0]], _TIMES_OF_USUAL)
        is_usual = times >= least
        self._usual_cells, self._usual_labels = seen_from[is_usual].T
        ends = Groups.of(number).ends(cells.looks.first[seen[:, 0]])
        self._usual_since, self._usual_until = (end[is_usual] for end in ends)
        self._cells = cells

    def lack_usual(self, looks: Ints) -> bool:
        """Returns whether looks that saw nothing are from several views with usual labels."""
        cells = self._cells
        of_looks, first, row_of = np.unique(
            cells.cell[looks], return_index=True, return_inverse=True
        )
        counts, rows = entries_of_codes(self._usual_cells, of_looks)
        times = cells.looks.first[looks]
        is_back = self._usual_since[rows] < times.min()
        is_back &= self._usual_until[rows] > times.max()
        seen_from = np.repeat(looks[first], counts)[is_back]
        sides = (np.ptp(axis[seen_from].astype(np.int64)) for axis in (cells.x, cells.y))
        if is_back.any() and np.hypot(*sides) >= _FAR_MM:
            return True
        if len(np.unique(self._usual_labels[rows])) < _LABELS_MISSED:
            return False
        looks = looks[counts[row_of] >= _LABELS_OF_VIEW]
        x, y, heading = cells.x[looks], cells.y[looks], cells.heading(looks)
        away = np.hypot(x - x[:1], y - y[:1])
        turned = np.abs(half_turns(heading - heading[:1]))
        return bool(((away >= _OTHER_VIEW_MM) | (turned >= _OTHER_VIEW_DEG)).any())

    def vanish(self, before: int, after: int) -> bool:
        """Returns whether a look saw some labels, and the next one, from the same cell, none."""
        cells = self._cells
        pause = cells.looks.first[after] - cells.last[before]
        is_same_view = cells.cell[before] == cells.cell[after] and pause <= _AT_ONCE_NS
        return bool(is_same_view and self._labels_in_look[before] >= _LABELS_MISSED)
