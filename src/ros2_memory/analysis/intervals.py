"""Visible intervals: when objects were in view, as columns of numbers.

An object stays in view from a message that contains it to the topic's next message that does, if
that follows within `SILENCE_NS`. Detectors miss objects now and then, so it also stays in view
if other messages lie between the two, but no more than `FLICKER_NS`. How a history is cut into bags
changes nothing.

Many detectors publish only what they see, so an interval does not show that the object was seen all
the time. It was if its messages follow each other at the detector's usual rate: at most
`USUAL_PERIODS` times their mean distance apart, or `SHORT_NS`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.core.arrays import (
    Flags,
    Ints,
    joined_codes,
    range_numbers,
    sorted_codes,
    stable_order,
)
from ros2_memory.core.timebase import MAX_NS, NS_PER_S, Ns, Span

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Sequence

    from numpy.typing import NDArray


SILENCE_NS: Final = 10 * NS_PER_S
"""After so long without a message an object is gone: many detectors publish only what they see."""
PACED: Final = 20
"""A topic is regular or not only if it has so many messages."""
_REGULAR: Final = 1.05
"""A topic is regular if one pause in twenty is at most so many times as long as one in four."""
THINNED_NS: Final = 7 * NS_PER_S
"""In a thinned day each topic keeps a message this often, if it had one."""
FLICKER_NS: Final = 3 * NS_PER_S
"""An object that is missed for less time has not left."""
USUAL_PERIODS: Final = 3
_FEWEST: Final = 3
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
"""Scores are stored as whole numbers of such parts."""
_FROM_START: Final = 1
"""Flag of `ends`: the first of all messages contains the object."""
_TO_END: Final = 2
"""Flag of `ends`: the last of all messages contains the object."""


def pause_of(times: Ints) -> Ns:
    """Returns after how long a pause (ns) a topic with messages at some log times is silent.

    That is `SILENCE_NS`, but one and a half periods of a topic that is regularly published more
    seldom, as a battery is, or about as often: else each message would be a state of its own.
    """
    if times.size < PACED:
        return SILENCE_NS
    often, seldom = np.quantile(np.diff(times), (0.75, 0.95))
    return max(SILENCE_NS, int(1.5 * often)) if seldom <= _REGULAR * often else SILENCE_NS


def pieces_of(starts: Ints, stops: Ints, silence_ns: Ns = SILENCE_NS) -> tuple[Ints, Ints]:
    """Joins spans that are at most `silence_ns` apart; returns the starts and the stops, in order.

    Without spans, both are empty.
    """
    order = stable_order(starts)
    starts, stops = starts[order], stops[order]
    reached = np.maximum.accumulate(stops)
    new = starts[1:] - reached[:-1] > silence_ns
    begins, ends = np.append([True], new), np.append(new, [True])
    return starts[begins[: len(starts)]], reached[ends[: len(starts)]]


class VisibleInterval(NamedTuple):
    """An object in view: log times of the first and last message that contain it (inclusive).

    `best` is the highest score among its detections; None if no detection has a score.
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
        rows: the rows of the table, of type `ROW`. For each interval they have its first and last
            time, the index of its label, whether the first and the last message of the topic
            contain it, how many messages do, the longest time between two of these, and its best
            score.
    """

    labels: tuple[str, ...] = ()
    rows: bytes = b""

    @property
    def size(self) -> int:
        """How many intervals there are."""
        return len(self.rows) // ROW.itemsize

    @property
    def _array(self) -> IntervalRows:
        return np.frombuffer(self.rows, ROW)

    def intervals(self) -> tuple[VisibleInterval, ...]:
        """Returns all intervals as objects."""
        return tuple(
            VisibleInterval(
                self.labels[label], first, last, None if best == _NO_SCORE else best / _SCORES
            )
            for first, last, label, *_, best in self._array.tolist()
        )

    def spans(self) -> dict[str, tuple[Ints, Ints]]:
        """Returns the first and the last times of the intervals of each label, in order."""
        rows = self._array[stable_order(self._array["label"])]
        bounds = np.searchsorted(rows["label"], np.arange(1, len(self.labels)))
        firsts, lasts = (np.split(rows[name], bounds) for name in ("first", "last"))
        return dict(zip(self.labels, zip(firsts, lasts, strict=True), strict=False))

    def most_lasting(self, at_most: int) -> IntervalTable:
        """Returns the longest intervals, in order of time; of equally long ones the earliest."""
        if self.size <= at_most:
            return self
        rows = self._array[np.sort(self._by_length()[:at_most])]
        rows["label"], labels = sorted_codes(rows["label"], self.labels)
        return IntervalTable(labels, rows.tobytes())

    def longest(self, at_most: int) -> tuple[VisibleInterval, ...]:
        """Returns the longest intervals, the longest first; of equal ones the earliest first."""
        return self._select(self._by_length()[:at_most]).intervals()

    def longest_of_each(self) -> IntervalTable:
        """Returns the longest interval of each label; of equally long ones the earliest."""
        by_length = self._by_length()
        _, longest = np.unique(self._array["label"][by_length], return_index=True)
        return self._select(np.sort(by_length[longest]))

    def messages(self) -> dict[str, float]:
        """Returns how many messages have each label."""
        counts = np.bincount(self._array["label"], self._array["count"], len(self.labels))
        return dict(zip(self.labels, counts.tolist(), strict=True))

    def relabelled(self, label_of: Callable[[str], str]) -> IntervalTable:
        """Returns the intervals with other labels; those that overlap then are one."""
        rows = self._array.copy()
        rows["label"], labels = sorted_codes(rows["label"], [*map(label_of, self.labels)])
        return united_tables([IntervalTable(labels, rows.tobytes())])

    def of_each_label(self) -> list[tuple[VisibleInterval, int, Ns]]:
        """Returns for each label the time from first to last, how many intervals, and their length.

        The time has no score. Intervals of fewer than `_FEWEST` messages do not count where the
        label has others: detectors are wrong now and then. A door sees a visitor once.
        """
        labels, counts = self._array["label"], self._array["count"]
        most = np.zeros(len(self.labels), counts.dtype)
        np.maximum.at(most, labels, counts)
        spans = self._select(counts >= np.minimum(_FEWEST, most)[labels]).spans()
        return [
            (
                VisibleInterval(label, int(first[0]), int(last.max()), None),
                first.size,
                int((last - first).sum()),
            )
            for label, (first, last) in spans.items()
            if first.size
        ]

    def throughout(self, start: Ns, end: Ns) -> list[str]:
        """Returns the labels seen at their usual rate all the time from `start` to `end`."""
        rows = self._array
        pause = _longest_pause(rows)
        is_steady = (rows["longest"] <= pause) & (rows["count"] > 1)
        reaches = (rows["first"] <= start + pause) & (rows["last"] >= end - pause)
        return self._labels_in(rows[is_steady & reaches])

    def at_end(self, last: Ns, known_to: Ns) -> list[str]:
        """Returns the labels in the last message (at `last`) that may be in view at `known_to`.

        They may be if the time since is no longer than their usual pauses.
        """
        rows = self._array
        is_recent = known_to - last <= _longest_pause(rows)
        return self._labels_in(rows[(rows["last"] == last) & is_recent])

    def _labels_in(self, rows: IntervalRows) -> list[str]:
        return [self.labels[code] for code in rows["label"].tolist()]

    def without(self, labels: Collection[str]) -> IntervalTable:
        """Returns the intervals of all other labels."""
        is_other = np.array([label not in labels for label in self.labels], np.bool_)
        return self if is_other.all() else self._select(is_other[self._array["label"]])

    def scoring(self, least: float) -> IntervalTable:
        """Returns the intervals whose best score is at least this, or that have no score."""
        best = self._array["best"]
        return self._select((best == _NO_SCORE) | (best >= _stored_scores(np.array([least]))))

    def during(self, spans: Iterable[Span]) -> IntervalTable:
        """Returns the intervals that overlap one of the spans (inclusive)."""
        rows = self._array
        overlaps = np.zeros(rows.size, np.bool_)
        for start, stop in spans:
            overlaps |= (rows["first"] <= stop) & (rows["last"] >= start)
        return self._select(overlaps)

    def _select(self, rows: Flags | NDArray[np.intp]) -> IntervalTable:
        return IntervalTable(self.labels, self._array[rows].tobytes())

    def _by_length(self) -> NDArray[np.intp]:
        """Returns the indices of rows, the longest interval first; of equal ones the earliest."""
        rows = self._array
        return stable_order(rows["first"] - rows["last"])


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
        rows: for each detection, the index of its message.
        codes: for each detection, the index of its label.
        scores: for each detection, its score or NaN.
        labels: the labels, each once.
    """
    if not rows.size:
        return IntervalTable()
    label, names = sorted_codes(codes, labels)
    order = np.lexsort((rows, label))
    label, row = label[order], rows[order]
    at = times[row]
    # Each detection begins as an interval of its own. Of two with one label in a message, the
    # second one adds no message to the count.
    seen = np.zeros(row.size, ROW)
    seen["first"], seen["last"], seen["label"] = at, at, label
    seen["count"] = np.append(True, (np.diff(row) != 0) | (np.diff(label) != 0))
    seen["ends"] = (row == 0) * _FROM_START + (row == len(times) - 1) * _TO_END
    seen["best"] = _stored_scores(scores[order])
    # A silence counts as a message without detections.
    silences = np.cumsum(np.diff(times, prepend=times[0]) > SILENCE_NS)
    goes_on = (np.diff(row + silences[row]) <= 1) | (np.diff(at) <= FLICKER_NS)
    goes_on &= np.diff(label) == 0
    return IntervalTable(names, _merge_runs(seen, at, goes_on))


def _stored_scores(scores: NDArray[np.float64]) -> Ints:
    """Returns scores as `ROW` stores them; `_NO_SCORE` for NaN, and only for NaN."""
    most = -_NO_SCORE - 1
    with np.errstate(invalid="ignore"):
        stored = np.rint(np.clip(scores, -most / _SCORES, most / _SCORES) * _SCORES)
    return np.where(np.isnan(scores), _NO_SCORE, stored).astype(np.int64)


def united_tables(
    tables: Sequence[IntervalTable], follows: Sequence[bool] | None = None
) -> IntervalTable:
    """Returns when objects were visible by any of several tables, as of topics.

    Intervals of one label are joined that overlap. So are those that go on in the next table, if
    `follows` is true for that table: no silence parts it from the one before.
    """
    is_next = np.array(follows or np.zeros(len(tables)), np.bool_)
    rows = np.frombuffer(b"".join([table.rows for table in tables]), ROW)
    if not rows.size:
        return IntervalTable()
    part = range_numbers([table.size for table in tables])
    codes = joined_codes((table._array["label"], table.labels) for table in tables)
    label, labels = sorted_codes(*codes)
    order = np.lexsort((part, rows["first"], label))
    rows, part, label = rows[order], part[order], label[order]
    first, ends, reach = rows["first"], rows["ends"], running_end(label, rows["last"])
    goes_on = (ends[:-1] & _TO_END > 0) & (ends[1:] & _FROM_START > 0)
    goes_on &= (part[1:] - part[:-1] == 1) & is_next[part[1:]]
    goes_on |= first[1:] <= np.minimum(reach[:-1], MAX_NS - FLICKER_NS) + FLICKER_NS
    goes_on &= label[1:] == label[:-1]
    rows["label"] = label
    rows["ends"] = ends & ((part == 0) * _FROM_START + (part == len(tables) - 1) * _TO_END)
    return IntervalTable(labels, _merge_runs(rows, reach, goes_on))


def _merge_runs(rows: IntervalRows, reach: Ints, goes_on: Flags) -> bytes:
    """Merges runs of rows into one interval each, and returns the rows of an `IntervalTable`.

    Args:
        rows: the rows, sorted by label and then by time.
        reach: for each row, the latest end so far of its label.
        goes_on: for each row but the last, whether the next one is of the same interval.
    """
    begins = np.flatnonzero(np.append(True, ~goes_on))
    stops = np.append(begins[1:], len(rows)) - 1
    intervals = rows[begins]
    intervals["last"] = reach[stops]
    intervals["count"] = np.add.reduceat(rows["count"], begins)
    # A difference of times of different intervals may overflow; `where` drops it.
    pauses = np.append(0, np.where(goes_on, np.maximum(rows["first"][1:] - reach[:-1], 0), 0))
    intervals["longest"] = np.maximum.reduceat(np.maximum(rows["longest"], pauses), begins)
    intervals["best"] = np.maximum.reduceat(rows["best"], begins)
    intervals["ends"] = rows["ends"][begins] & _FROM_START | rows["ends"][stops] & _TO_END
    return intervals[np.lexsort((intervals["label"], intervals["first"]))].tobytes()


def running_end(label: NDArray[np.intp], last: Ints) -> Ints:
    """Returns, for each row, the latest end so far of its label; rows are sorted by label."""
    if bool(((last[1:] >= last[:-1]) | (label[1:] != label[:-1])).all()):
        return last
    by_time = stable_order(last)
    rank = np.empty(len(last), np.intp)
    rank[by_time] = np.arange(len(last))
    # Ranks of a later label are all higher, so the running maximum starts again at each label.
    far = label * len(last)
    return last[by_time[np.maximum.accumulate(rank + far) - far]]


def _longest_pause(rows: IntervalRows) -> Ints:
    """Returns the longest usual pause between two messages with the object, for each row.

    An object that was seen once has no rate: it counts as missed for at most `FLICKER_NS`.
    """
    spans = rows["last"] - rows["first"]
    usual = USUAL_PERIODS * spans // np.maximum(rows["count"].astype(np.int64) - 1, 1)
    pause = np.where(rows["count"] > 1, np.maximum(usual, SHORT_NS), FLICKER_NS)
    return np.minimum(pause, SILENCE_NS)
