"""What all counts over time have in common: the window, its bins, and how much was recorded."""

from __future__ import annotations

from itertools import compress, groupby
from typing import TYPE_CHECKING, Final, Literal, TypeAlias

import numpy as np

from ros2_memory.analysis.intervals import pieces_of
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import Spans, united, without
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S, Ns
from ros2_memory.counts.place_bins import place_bins
from ros2_memory.counts.time_bins import (
    TimeBins,
    TrueIntervals,
    first_of_days,
    time_bins,
    usual_time,
)
from ros2_memory.history.clock_steps import elapsed_in
from ros2_memory.history.coverage import (
    note_edges,
    note_unread,
    reached,
    recorded_reach,
    recording_gaps,
    unix_text,
)
from ros2_memory.history.no_data import no_data_between
from ros2_memory.results import BinColumn, Bins, Usual

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

    from ros2_memory.core.arrays import Ints
    from ros2_memory.history.view import View
    from ros2_memory.places.where import Where

By: TypeAlias = Literal["day", "hour", "weekday", "place"]
Values: TypeAlias = "Sequence[float | None]"


_MOST_SPANS: Final = 6
"""Times without a row that are named."""
MOST_CELLS: Final = 124
"""Fields, or places, of all bins together that one reply has room for."""


class BinnedWindow:
    """A window of the memory, cut into bins, to which columns of values are added.

    `where` are the places of bins of places; None for all named ones.

    Attributes:
        asked: the whole window.
        counted: what of it is counted: what the memory reaches, without bags that a wrong clock
            dated unless it has nothing else, and since when there was time to count.
        window: the same without the tolerance of its bounds.
        bins: its bins.
        gaps: when nothing was recorded in it.
        elapsed: how much time passed between moments of it.
        usual: when something usually began first in a day, if that is counted.
        usual_exit: when the robot usually left first in a day, likewise.

    Raises:
        InvalidArgumentsError: there are too many bins, or there is no named place.
        NoDataError: nothing of the window was recorded, or no poses for bins of places.
    """

    def __init__(
        self,
        view: View,
        asked: TimeWindow,
        by: By,
        topics: Sequence[str],
        where: Where | None = None,
    ) -> None:
        self.view = view
        self.asked = asked
        self._by = by
        self._topics = tuple(topics)
        start, end = asked.asked()
        reach = recorded_reach(view.snapshot, asked)
        if reach is not None:
            start, end = max(start, reach[0]), min(end, reach[1])
        if end < start:
            raise no_data_between(view, self._topics, asked)
        self.counted = reached(view.snapshot, asked)
        # Up to midnight is no part of the next day; what is at the very end counts to the last bin.
        self.window = TimeWindow(start, max(end, start + 1))
        self.bins: TimeBins = (
            place_bins(view, self.window, where) if by == "place" else time_bins(self.window, by)
        )
        self._columns: list[tuple[str, BinColumn]] = []
        self._values: list[Values] = []
        self._all: list[float | None] = []
        self.usual: Usual | None = None
        self.usual_exit: Usual | None = None
        self.gaps = list(recording_gaps(view, self.window))
        self.elapsed = elapsed_in(view, self.window)
        self._since: Ns | None = None

    def add(self, name: str, kind: BinColumn, values: Values, whole: float | None) -> None:
        """Adds a column, and its value for all bins together."""
        self._columns.append((name, kind))
        self._values.append(values)
        self._all.append(whole)

    def add_heard(self, column: str, topics: Sequence[str]) -> None:
        """Adds how long topics had messages, without pauses far longer than usual on them."""
        pause = round(2 * NS_PER_S * self.view.limits.split_duration_s)
        parts = self.view.timeline.segments_in(self.counted)
        spans = np.concatenate(
            [np.empty((2, 0), np.int64), *(part.bounds_in(topics, self.counted) for part in parts)],
            axis=1,
        )
        firsts, lasts = pieces_of(spans[0], spans[1], pause)
        heard = zip(firsts.tolist(), lasts.tolist(), strict=True)
        self.add_lengths(column, "duration", without(heard, self.gaps))

    def add_unknown(self, spans: Spans) -> None:
        """Adds for how long the answer is not known, if there are such times."""
        if spans:
            self.add_lengths("unknown_s", "duration", spans)

    def add_lengths(self, column: str, kind: BinColumn, spans: Sequence[tuple[Ns, Ns]]) -> None:
        """Adds how much (ns) of half-open spans, which do not overlap, falls into each bin."""
        self.add(column, kind, self._lengths(spans).tolist(), self._total(spans))

    def add_counts(self, column: str, times: ArrayLike) -> None:
        """Adds how many of these times each bin has."""
        counts = self.bins.among(times).sum(axis=0)
        self.add(column, "count", counts.tolist(), len(np.asarray(times)))

    def add_held(self, held: TrueIntervals) -> None:
        """Adds how often something began, how long it held, and its first and last time."""
        inside = (held.stops >= self.counted.start) & (held.starts < self.counted.stop)
        starts, stops = (some[inside].clip(*self._ends) for some in (held.starts, held.stops))
        begins = starts[held.begun[inside]]
        self.add_counts("count", begins)
        self.add_lengths(
            "seconds", "duration", united(zip(starts.tolist(), stops.tolist(), strict=True))
        )
        self.add_first("first", begins)
        last = self._last_held(starts, stops)
        self.add("last", "time", last, max(stops.tolist(), default=None))
        self.usual = self.usual_of(begins)

    def add_first(self, column: str, times: Ints) -> None:
        """Adds the first of these times in each bin."""
        among = self.bins.among(times)
        first = [int(times[each].min()) if each.any() else None for each in among.T]
        self.add(column, "time", first, min(times.tolist(), default=None))

    def _last_held(self, starts: Ints, stops: Ints) -> Values:
        """Returns for each bin when something held there for the last time."""
        found: list[float | None] = [None] * len(self.bins.names)
        begin, end = self.bins.pieces(starts), self.bins.pieces(stops)
        newest = np.full(len(self.bins.member), MIN_NS)
        np.maximum.at(newest, end, np.minimum(stops, self.bins.edges[end + 1] - 1))
        for first, last in zip(begin[begin < end].tolist(), end[begin < end].tolist(), strict=True):
            before = newest[first:last]
            np.maximum(before, self.bins.edges[first + 1 : last + 1] - 1, out=before)
        for number, some in enumerate(self.bins.member.T):
            latest = int(newest[some].max(initial=MIN_NS))
            found[number] = None if latest == MIN_NS else latest
        return found

    def usual_of(self, times: Ints) -> Usual | None:
        """Returns the usual time of day of the first of these times in each day."""
        firsts = first_of_days(self.bins, times)
        return usual_time(firsts, self._days_recorded()) if firsts else None

    def _days_recorded(self) -> int:
        """Returns how many local days have something recorded."""
        if self.bins.day_of is None:
            return 0
        edges, days = self.bins.edges.tolist(), self.bins.day_of.tolist()
        found = set()
        for start, stop, day in zip(edges[:-1], edges[1:], days, strict=True):
            missing = sum(max(min(end, stop) - max(begin, start), 0) for begin, end in self.gaps)
            if missing < stop - start:
                found.add(day)
        return len(found)

    def _lengths(self, spans: Sequence[tuple[Ns, Ns]]) -> Ints:
        """Returns how much time (ns) of half-open spans passed in each bin."""
        starts, stops = np.array(spans, np.int64).reshape(-1, 2).T.clip(*self._ends)
        lengths = self.bins.lengths(starts, stops)
        for skipped in self.elapsed.skipped:
            lengths -= self.bins.lengths(starts.clip(*skipped), stops.clip(*skipped))
        return lengths

    def _total(self, spans: Sequence[tuple[Ns, Ns]]) -> Ns:
        """Returns how much time (ns) of half-open spans passed in the window."""
        start, stop = self._ends
        inside = [(max(begin, start), min(end, stop)) for begin, end in spans]
        return sum(self.elapsed.between(begin, end) for begin, end in inside if begin < end)

    @property
    def _ends(self) -> tuple[Ns, Ns]:
        start = self.window.start if self._since is None else max(self.window.start, self._since)
        return start, max(start, self.window.stop)

    def count_since(self, since: Ns | None) -> None:
        """Leaves out what is before a moment, and notes that it was not counted, if there is one.

        To be called before columns are added.
        """
        if since is None:
            return
        self._since = since
        self.counted = self.counted.intersect(TimeWindow(since, MAX_NS))
        self.view.notes.add_lack(
            f"only what is after {unix_text(since)} is counted: "
            f"{self.view.bags.filling_progress() or 'out of time; '}"
            "ask about a shorter window"
        )

    def _add_recorded(self) -> None:
        """Adds how long something was recorded, as the first column."""
        recorded = self._lengths([self._ends]) - self._lengths(self.gaps)
        total = self._total([self._ends]) - self._total(self.gaps)
        self._columns.insert(0, ("recorded_s", "duration"))
        self._values.insert(0, recorded.tolist())
        self._all.insert(0, total)

    def answer(self) -> Bins:
        """Returns the answer, with notes on what could not be read."""
        self._add_recorded()
        note_unread(self.view, self.asked)
        note_edges(self.view, self.asked)
        columns = zip(*self._values, strict=True)
        rows = [*zip(self.bins.names, columns, strict=True)]
        empty = [not any(values) for _, values in rows]
        if self._since is not None:
            is_late = self.bins.edges[1:] > self._since
            counted: list[bool] = np.any(self.bins.member[is_late], axis=0).tolist()
            rows, empty = [*compress(rows, counted)], [*compress(empty, counted)]
        if self._by != "place":
            self._note_empty(empty, [name for name, _ in rows])
            rows = [row for row, is_empty in zip(rows, empty, strict=True) if not is_empty]
        return Bins(
            by=self._by,
            about=self._topics,
            start=self.window.start,
            end=self.window.stop,
            columns=tuple(self._columns),
            rows=tuple(rows),
            all=tuple(self._all),
            usual=self.usual,
            usual_exit=self.usual_exit,
            notes=self.view.notes.sentences(),
        )

    def _note_empty(self, empty: Sequence[bool], names: Sequence[str]) -> None:
        """Notes the bins in which nothing was recorded: several in a row by the first and last."""
        spans: list[str] = []
        for is_empty, some in groupby(zip(empty, names, strict=True), lambda row: row[0]):
            of_span = [name for _, name in some]
            if is_empty:
                one = len(of_span) == 1
                spans.append(of_span[0] if one else f"{of_span[0]} to {of_span[-1]}")
        if spans:
            more = len(spans) - _MOST_SPANS
            shown = ", ".join(spans[:_MOST_SPANS]) + (f" and {more} more" if more > 0 else "")
            self.view.notes.add(f"no rows for times in which nothing was recorded: {shown}")
