"""Visible intervals: when objects were in view, as columns of numbers.

An object stays in view from one message that contains it to the next where these follow each other
on the topic within `SILENCE_NS`, or are within `FLICKER_NS` whatever is between them: detectors
miss objects now and then. Where a history is cut into bags changes nothing.

Many detectors publish only what they see, so an interval alone does not show that the object was
seen all the time. It was where its messages follow each other at the detector's own usual rate: no
farther apart than `USUAL_PERIODS` times their mean distance, or `SHORT_NS`.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.core.arrays import Flags, Ints, joined_codes
from ros2_memory.core.timebase import MAX_NS, NS_PER_S, Ns, Span

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Sequence

    from numpy.typing import NDArray


SILENCE_NS: Final = 10 * NS_PER_S
"""After so long without a message an object counts as gone: many detectors publish only what
they see."""
THINNED_NS: Final = 7 * NS_PER_S
"""In a day of which only some messages stayed, each topic has one in so long, or as it had them."""
FLICKER_NS: Final = 3 * NS_PER_S
"""An object that is missed for less did not leave."""
USUAL_PERIODS: Final = 3
SHORT_NS: Final = NS_PER_S

ROW: Final = np.dtype(
    [
        ("first", "<i8"),
        ("last", "<i8"),
        ("label", "<u4"),
        ("ends", "u1"),
        ("count", "<u4"),
        ("longest", "<i8"),
        ("best", "<i4"),
    ]
)
"""A row of an `IntervalTable`."""
IntervalRows: TypeAlias = "np.ndarray[tuple[int], np.dtype[np.void]]"

_NO_SCORE: Final = -(2**31)
_SCORES: Final = 10_000
"""What scores are multiplied with, and rounded."""
_FROM_START: Final = 1
_TO_END: Final = 2


def pieces_of(starts: Ints, stops: Ints, silence_ns: Ns = SILENCE_NS) -> tuple[Ints, Ints]:
    """Returns when the pieces of spans begin and end, in order. A silence parts them."""
    order = np.argsort(starts, kind="stable")
    starts, stops = starts[order], stops[order]
    reached = np.maximum.accumulate(stops)
    new = starts[1:] - reached[:-1] > silence_ns
    begins, ends = np.append([True], new), np.append(new, [True])
    return starts[begins[: len(starts)]], reached[ends[: len(starts)]]


class VisibleInterval(NamedTuple):
    """An object in view: log times of the first and last message that contain it (inclusive).

    `best` is the highest score among its detections; None where none has one.
    """

    label: str
    first: Ns
    last: Ns
    best: float | None


class IntervalTable(NamedTuple):
    """Visible intervals by the time of their first message, then by label, as a packed numpy table.

    A week of bags has too many for an object each.

    Attributes:
        labels: the labels, sorted.
        rows: of each interval its first and last time, the index of its label, whether the first
            and the last message of all contain it, how many messages do, the longest time between
            two of these, and its best score.
    """

    labels: tuple[str, ...] = ()
    rows: bytes = b""

    @property
    def size(self) -> int:
        """How many intervals there are."""
        return len(self.rows) // ROW.itemsize

    def intervals(self) -> tuple[VisibleInterval, ...]:
        """Returns each of them."""
        rows = _unpacked(self.rows).tolist()
        return tuple(
            VisibleInterval(
                self.labels[label], first, last, None if best == _NO_SCORE else best / _SCORES
            )
            for first, last, label, *_, best in rows
        )

    def spans(self) -> dict[str, tuple[Ints, Ints]]:
        """Returns by label the first and the last time of each of its intervals, in order."""
        rows = _unpacked(self.rows)
        by_label = {label: rows[rows["label"] == at] for at, label in enumerate(self.labels)}
        return {label: (its["first"], its["last"]) for label, its in by_label.items()}

    def most_lasting(self, at_most: int) -> IntervalTable:
        """Returns the longest intervals, in order of time; of equally long ones the earliest."""
        if self.size <= at_most:
            return self
        rows = _unpacked(self.rows)
        rows = rows[np.sort(_by_length(rows)[:at_most])]
        used, rows["label"] = np.unique(rows["label"], return_inverse=True)
        return IntervalTable(tuple(self.labels[place] for place in used.tolist()), rows.tobytes())

    def throughout(self, start: Ns, end: Ns) -> list[str]:
        """Returns the labels seen at their usual rate all the time from `start` to `end`."""
        rows = _unpacked(self.rows)
        pause = _longest_pause(rows)
        chosen = (rows["longest"] <= pause) & (rows["count"] > 1)
        chosen &= (rows["first"] <= start + pause) & (rows["last"] >= end - pause)
        return self._labels_in(rows[chosen])

    def at_end(self, last: Ns, known_to: Ns) -> list[str]:
        """Returns labels of the last message, at `last`, that may be visible until `known_to`."""
        rows = _unpacked(self.rows)
        return self._labels_in(
            rows[(rows["last"] == last) & (known_to - last <= _longest_pause(rows))]
        )

    def _labels_in(self, rows: IntervalRows) -> list[str]:
        return [self.labels[place] for place in rows["label"].tolist()]

    def without(self, labels: Collection[str]) -> IntervalTable:
        """Returns the intervals of all other labels."""
        kept = np.array([label not in labels for label in self.labels], np.bool_)
        return self if kept.all() else self._select(kept[_unpacked(self.rows)["label"]])

    def scoring(self, least: float) -> IntervalTable:
        """Returns the intervals with a best score of so much at least, or without any."""
        best = _unpacked(self.rows)["best"]
        return self._select((best == _NO_SCORE) | (best >= _stored_scores(np.array([least]))))

    def during(self, spans: Iterable[Span]) -> IntervalTable:
        """Returns the intervals some of which is in one of these times (inclusive)."""
        rows = _unpacked(self.rows)
        chosen = np.zeros(rows.size, np.bool_)
        for start, stop in spans:
            chosen |= (rows["first"] <= stop) & (rows["last"] >= start)
        return self._select(chosen)

    def longest(self, at_most: int) -> tuple[VisibleInterval, ...]:
        """Returns the longest intervals, the longest first; of equal ones the earliest first."""
        return self._select(_by_length(_unpacked(self.rows))[:at_most]).intervals()

    def _select(self, which: Flags | NDArray[np.intp]) -> IntervalTable:
        return IntervalTable(self.labels, _unpacked(self.rows)[which].tobytes())


class IntervalPart(NamedTuple):
    """Consecutive messages of one topic: first and last log time, and what was visible."""

    first: Ns
    last: Ns
    visible: IntervalTable


def visible_in(
    times: Ints,
    rows: Ints,
    codes: Ints,
    scores: NDArray[np.float64],
    labels: Sequence[str],
) -> IntervalTable:
    """Returns when objects were visible in consecutive messages of one topic.

    Args:
        times: log times of all messages, ascending.
        rows: for each detection, its message.
        codes: its label, by the place in `labels`.
        scores: NaN where it has none.
        labels: the labels, each once.
    """
    if not rows.size:
        return IntervalTable()
    used, codes = np.unique(codes, return_inverse=True)
    names = [labels[code] for code in used.tolist()]
    rank = np.argsort(np.argsort(np.array(names, object)))
    order = np.lexsort((rows, rank[codes]))
    label, row = rank[codes][order], rows[order]
    at = times[row]
    # Each detection is an interval; two of one label in a message are one.
    seen = np.zeros(row.size, ROW)
    seen["first"], seen["last"], seen["label"] = at, at, label
    seen["count"] = np.append(True, (np.diff(row) != 0) | (np.diff(label) != 0))
    seen["ends"] = (row == 0) * _FROM_START + (row == len(times) - 1) * _TO_END
    seen["best"] = _stored_scores(scores[order])
    # As if an empty message came where the topic was silent.
    silent = np.cumsum(np.diff(times, prepend=times[0]) > SILENCE_NS)
    goes_on = (np.diff(row + silent[row]) <= 1) | (np.diff(at) <= FLICKER_NS)
    goes_on &= np.diff(label) == 0
    return IntervalTable(tuple(sorted(names)), _merge_runs(seen, at, goes_on))


def _stored_scores(scores: NDArray[np.float64]) -> Ints:
    # The least number stands for no score.
    most = -_NO_SCORE - 1
    with np.errstate(invalid="ignore"):
        stored = np.rint(np.clip(scores, -most / _SCORES, most / _SCORES) * _SCORES)
    return np.where(np.isnan(scores), _NO_SCORE, stored).astype(np.int64)


def joined(parts: Sequence[IntervalPart]) -> IntervalPart:
    """Merges parts that follow each other: an object may stay visible from one to the next."""
    follow = [after.first - before.last <= SILENCE_NS for before, after in pairwise(parts)]
    seen = _merge_tables([part.visible for part in parts], np.array([False, *follow]))
    return IntervalPart(parts[0].first, parts[-1].last, seen)


def united(tables: Sequence[IntervalTable]) -> IntervalTable:
    """Merges the tables of several topics of one time: visible on one of them is visible."""
    return _merge_tables(tables, np.zeros(len(tables), np.bool_))


def _merge_tables(tables: Sequence[IntervalTable], follow: Flags) -> IntervalTable:
    """Merges tables: joins intervals of one label that overlap, or that go on in the next part."""
    rows = _unpacked(b"".join([table.rows for table in tables]))
    if not rows.size:
        return IntervalTable()
    part = np.repeat(np.arange(len(tables)), [table.size for table in tables])
    codes, words = joined_codes((_unpacked(table.rows)["label"], table.labels) for table in tables)
    labels = tuple(sorted(words))
    place = {label: at for at, label in enumerate(labels)}
    label = np.array([place[word] for word in words], np.intp)[codes]
    order = np.lexsort((part, rows["first"], label))
    rows, part, label = rows[order], part[order], label[order]
    first, ends, reach = rows["first"], rows["ends"], running_end(label, rows["last"])
    goes_on = (ends[:-1] & _TO_END > 0) & (ends[1:] & _FROM_START > 0)
    goes_on &= (part[1:] - part[:-1] == 1) & follow[part[1:]]
    goes_on |= first[1:] <= np.minimum(reach[:-1], MAX_NS - FLICKER_NS) + FLICKER_NS
    goes_on &= label[1:] == label[:-1]
    rows["label"] = label
    rows["ends"] = ends & ((part == 0) * _FROM_START + (part == len(tables) - 1) * _TO_END)
    return IntervalTable(labels, _merge_runs(rows, reach, goes_on))


def _merge_runs(rows: IntervalRows, reach: Ints, goes_on: Flags) -> bytes:
    """Returns rows, sorted by label, as those of an `IntervalTable`: some go on in the next one.

    `reach` is the latest end of each and of those of its label before it.
    """
    begins = np.flatnonzero(np.append(True, ~goes_on))
    stops = np.append(begins[1:], len(rows)) - 1
    intervals = rows[begins]
    intervals["last"] = reach[stops]
    intervals["count"] = np.add.reduceat(rows["count"], begins)
    # Times may be as far apart as any two can be: only those of one interval are subtracted.
    pauses = np.append(0, np.where(goes_on, np.maximum(rows["first"][1:] - reach[:-1], 0), 0))
    intervals["longest"] = np.maximum.reduceat(np.maximum(rows["longest"], pauses), begins)
    intervals["best"] = np.maximum.reduceat(rows["best"], begins)
    intervals["ends"] = rows["ends"][begins] & _FROM_START | rows["ends"][stops] & _TO_END
    return intervals[np.lexsort((intervals["label"], intervals["first"]))].tobytes()


def running_end(label: NDArray[np.intp], last: Ints) -> Ints:
    """Returns the latest end of each row and of those before it of its label; sorted by label."""
    if bool(((last[1:] >= last[:-1]) | (label[1:] != label[:-1])).all()):
        return last
    by_time = np.argsort(last, kind="stable")
    rank = np.empty(len(last), np.intp)
    rank[by_time] = np.arange(len(last))
    # Labels are whole tables apart, so that the running maximum starts again at each label.
    far = label * len(last)
    return last[by_time[np.maximum.accumulate(rank + far) - far]]


def _longest_pause(rows: IntervalRows) -> Ints:
    """Returns, for each row, the longest pause between messages at the detector's usual rate."""
    spans = rows["last"] - rows["first"]
    # An object seen once has no known rate: it may have been missed for a moment, at most.
    usual = USUAL_PERIODS * spans // np.maximum(rows["count"].astype(np.int64) - 1, 1)
    pause = np.where(rows["count"] > 1, np.maximum(usual, SHORT_NS), FLICKER_NS)
    return np.minimum(pause, SILENCE_NS)


def _by_length(rows: IntervalRows) -> NDArray[np.intp]:
    """Returns the indices of the rows, the longest interval first; of equal ones the earliest."""
    return np.argsort(rows["first"] - rows["last"], kind="stable")


def _unpacked(packed: bytes) -> IntervalRows:
    return np.frombuffer(packed, ROW)
