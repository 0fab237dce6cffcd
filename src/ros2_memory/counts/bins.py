"""The bins of a window, and what is counted in them: local days, hours and weekdays, or places.

A window is cut where local days (or hours) begin; each piece belongs to one bin. Where clocks are
changed, a day has 23 or 25 hours, the hour that is skipped has no piece, and the one that occurs
twice is one piece of two hours: the pieces always cover the window exactly, so sums over bins are
those of the window.

Bins of places are the named ones, or those of a question; elsewhere; and where that is not known.
A place that lies in another one counts to both, so they may add up to more than the window.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from datetime import date
from itertools import compress, groupby
from typing import TYPE_CHECKING, Final, Literal, TypeAlias

import numpy as np

from ros2_memory.analysis.intervals import pieces_of
from ros2_memory.analysis.silences import length_in
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import Spans, united, without
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S, Ns, Span
from ros2_memory.history.clock_steps import elapsed_in
from ros2_memory.history.coverage import (
    note_edges,
    note_unread,
    reached,
    recording_gaps,
    shown_span,
    unix_text,
)
from ros2_memory.history.driven_path import resolve_path_topic
from ros2_memory.history.no_data import no_data_between
from ros2_memory.places.pose_frames import known_track, map_placement, placed_times, places_in
from ros2_memory.places.where import Where, places_setting
from ros2_memory.results import BinColumn, Bins, Usual

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import ArrayLike, NDArray

    from ros2_memory.core.arrays import Flags, Ints
    from ros2_memory.history.view import View


ClockBin: TypeAlias = Literal["day", "hour", "weekday"]
Offset: TypeAlias = "Callable[[int], int]"
"""Returns how many seconds local time is ahead of UTC at a Unix second."""

MOST_BINS: Final = 62
"""Days that one answer lists: two months."""
MOST_DAYS: Final = 1_000
"""Days that are counted by hour or by weekday."""

_HOUR_S: Final = 3_600
_DAY_S: Final = 86_400
_EPOCH: Final = date(1970, 1, 1).toordinal()
_WEEKDAYS: Final = (
    "Monday",
    "Tuesday",
    "Wednesday",
    "Thursday",
    "Friday",
    "Saturday",
    "Sunday",
)


def local_offset(at_s: int) -> int:
    """Returns the offset of this machine's zone (or of TZ); 0 for years without a calendar."""
    try:
        return time.localtime(at_s).tm_gmtoff
    except (OverflowError, ValueError, OSError):
        return 0


@dataclass(frozen=True, slots=True)
class TimeBins:
    """A window cut into pieces, each of which belongs to a bin, or to several.

    Attributes:
        names: of the bins, in order.
        edges: where pieces begin, and where the last one ends; they ascend.
        member: for each piece and each bin, whether the piece belongs to the bin.
        day_of: for each piece, the number of its local day since the epoch; None where pieces may
            lie in several days.
    """

    names: tuple[str, ...]
    edges: Ints
    member: Flags
    day_of: Ints | None

    def pieces(self, times: ArrayLike) -> NDArray[np.intp]:
        """Returns the piece of each time; times outside of the window count to its ends."""
        pieces = np.searchsorted(self.edges, np.asarray(times, np.int64), side="right") - 1
        return np.clip(pieces, 0, len(self.member) - 1)

    def lengths(self, starts: ArrayLike, stops: ArrayLike) -> Ints:
        """Returns how much (ns) of half-open spans falls into each piece, all spans together.

        What lies outside of the window does not count.
        """
        start_times = np.asarray(starts, np.int64)
        elapsed_until_edges = _summed_ages(self.edges, start_times) - _summed_ages(
            self.edges, np.maximum(start_times, np.asarray(stops, np.int64))
        )
        return np.diff(elapsed_until_edges)


def _summed_ages(edges: Ints, times: Ints) -> Ints:
    """Returns for each edge the sum (ns) of how long before it each of the earlier times was.

    Sums may wrap around; so do their differences, which are what is wanted.
    """
    ordered = np.sort(times)
    counts_before = np.searchsorted(ordered, edges)
    sums = np.concatenate((np.zeros(1, np.int64), np.cumsum(ordered)))
    return counts_before.astype(np.int64) * edges - sums[counts_before]


def time_bins(window: TimeWindow, by: ClockBin, offset: Offset = local_offset) -> TimeBins:
    """Returns the bins of a window, which must not be empty.

    Raises:
        InvalidArgumentsError: there would be too many.
    """
    days_long = (window.stop - window.start) // (_DAY_S * NS_PER_S)
    most_days = MOST_BINS if by == "day" else MOST_DAYS
    if days_long > most_days:
        raise _too_long(by, most_days)
    starts = _piece_starts(window, _HOUR_S if by == "hour" else _DAY_S, offset)
    locals_s = [start // NS_PER_S + offset(start // NS_PER_S) for start in starts]
    days = [local_s // _DAY_S for local_s in locals_s]
    if by == "day":
        bin_of_piece = days
    elif by == "weekday":
        bin_of_piece = [date.fromordinal(_EPOCH + day).weekday() for day in days]
    else:
        bin_of_piece = [local_s % _DAY_S // _HOUR_S for local_s in locals_s]
    bins = sorted(set(bin_of_piece))
    if len(bins) > MOST_BINS + 1:  # a window of so many days touches one day more
        raise _too_long(by, MOST_BINS)
    return TimeBins(
        names=tuple(_bin_name(number, by) for number in bins),
        edges=np.array([*starts, window.stop], np.int64),
        member=np.array(bin_of_piece)[:, None] == np.array(bins),
        day_of=np.array(days, np.int64),
    )


def _piece_starts(window: TimeWindow, unit_s: int, offset: Offset) -> list[Ns]:
    """Returns the window's start, and where local days (or hours) begin in it."""
    starts = [window.start]
    last_s = (window.stop - 1) // NS_PER_S
    edge_s = _next_edge(window.start // NS_PER_S, unit_s, offset)
    while edge_s <= last_s:
        starts.append(edge_s * NS_PER_S)
        edge_s = _next_edge(edge_s, unit_s, offset)
    return starts


def _too_long(by: ClockBin, most: int) -> InvalidArgumentsError:
    other = ", or by weekday" if by == "day" else ""
    return InvalidArgumentsError(
        f"by {by} takes at most {most} days: ask about a shorter window{other}"
    )


def _next_edge(at_s: int, unit_s: int, offset: Offset) -> int:
    """Returns the first Unix second after this one in which another local day (or hour) begins."""
    while True:
        ahead = offset(at_s)
        following = at_s - (at_s + ahead) % unit_s + unit_s
        if offset(following) == ahead:
            return following
        # Clocks are changed on the way: the first second of the new time.
        low, high = at_s, following
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if offset(middle) == ahead else (low, middle)
        if (high + offset(high)) // unit_s != (high - 1 + ahead) // unit_s:
            return high
        at_s = high


def _bin_name(number: int, by: ClockBin) -> str:
    if by == "day":
        return date.fromordinal(_EPOCH + number).isoformat()
    return _WEEKDAYS[number] if by == "weekday" else f"{number:02d}:00"


def first_of_days(bins: TimeBins, times: ArrayLike) -> list[tuple[int, Ns]]:
    """Returns the local days that have some of these times, in order, each with its first one.

    None of bins whose pieces may lie in several days.
    """
    if bins.day_of is None:
        return []
    ordered = np.sort(np.asarray(times, np.int64))
    days, first = np.unique(bins.day_of[bins.pieces(ordered)], return_index=True)
    return list(zip(days.tolist(), ordered[first].tolist(), strict=True))


def usual_time(times: Sequence[Ns], of_days: int, offset: Offset = local_offset) -> Usual:
    """Returns the usual time of day of one time from each of several days, of so many recorded."""
    clock = sorted((at // NS_PER_S + offset(at // NS_PER_S)) % _DAY_S for at in times)
    median = (clock[(len(clock) - 1) // 2] + clock[len(clock) // 2]) // 2
    return Usual(median, clock[0], clock[-1], len(clock), of_days)


ELSEWHERE: Final = "(elsewhere)"
UNKNOWN: Final = "(unknown)"


def place_bins(
    view: View, window: TimeWindow, counted: TimeWindow, where: Where | None
) -> TimeBins:
    """Returns places as bins: when the robot was in each, by its track in what is counted.

    Notes list unknown times.

    Raises:
        InvalidArgumentsError: no place is named in the frame of places, or those of the question
            are in a frame that no transforms lead to.
        NoDataError: there are no poses.
        QueryTimeoutError: the call's time runs out before any result.
    """
    topic = resolve_path_topic(view)
    asked_frame = None if where is None else where.frame_id
    placement = map_placement(view, topic, asked_frame)
    named_places = view.limits.places if where is None else where.places(placement.frame_id)
    places = places_in(view, named_places, placement, counted)
    if not places:
        frames = " or ".join(placement.frames)
        raise InvalidArgumentsError(
            f"by place needs named places in {frames}, and there is none in "
            f"{places_setting(view.limits)}"
        )
    spans_inside = [
        united((visit.start, visit.stop + 1) for visit in joined.inside(place.region, window))
        for place, joined in places
    ]
    placed_spans = placed_times(known_track(view, placement.frame_id, counted).track, [])
    edges = _edges_at_spans(window, [*spans_inside, placed_spans])
    in_places = np.array([_lies_in_spans(edges, spans) for spans in spans_inside]).T
    if (np.diff(edges)[in_places.sum(axis=1) > 1] > NS_PER_S).any():
        view.notes.add("places overlap: what is in two of them counts to both")
    in_none = ~in_places.any(axis=1)
    placed = _lies_in_spans(edges, placed_spans)
    member = np.column_stack((in_places, in_none & placed, in_none & ~placed))
    names = (*(place.name for place, _ in places), ELSEWHERE, UNKNOWN)
    return TimeBins(names, edges, member, None)


def _edges_at_spans(window: TimeWindow, span_lists: Sequence[Sequence[Span]]) -> Ints:
    """Returns the bounds of a window, and those of spans that lie in it, in order."""
    bounds = {at for spans in span_lists for span in spans for at in span}
    inner = sorted(at for at in bounds if window.start < at < window.stop)
    return np.array([window.start, *inner, window.stop], np.int64)


def _lies_in_spans(edges: Ints, spans: Sequence[Span]) -> Flags:
    """Returns for each piece between two edges whether it lies in one of some half-open spans."""
    starts, stops = np.array(spans, np.int64).reshape(-1, 2).T
    begun = np.searchsorted(starts, edges[:-1], side="right")
    ended = np.searchsorted(stops, edges[:-1], side="right")
    return begun > ended


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
        start, end = shown_span(view.snapshot, asked)
        if end < start:
            raise no_data_between(view, self._topics, asked)
        self.counted = reached(view.snapshot, asked)
        # Up to midnight is no part of the next day; what is at the very end counts to the last bin.
        self.window = TimeWindow(start, max(end, start + 1))
        self.bins: TimeBins = (
            place_bins(view, self.window, self.counted, where)
            if by == "place"
            else time_bins(self.window, by)
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
        firsts, lasts = pieces_of(*self.bounds(topics), pause)
        heard = zip(firsts.tolist(), lasts.tolist(), strict=True)
        self.add_lengths(column, "duration", without(heard, self.gaps))

    def bounds(self, topics: Sequence[str]) -> tuple[Ints, Ints]:
        """Returns first and last log times (ns) of topics: one for each topic and bag counted."""
        bounds = [self.view.bounds(topic, self.counted) for topic in topics]
        firsts, lasts = np.concatenate(bounds, axis=1)
        is_inside = (firsts < self.counted.stop) & (lasts >= self.counted.start)
        return firsts[is_inside], lasts[is_inside]

    def add_unknown(self, spans: Spans) -> None:
        """Adds for how long the answer is not known, if there are such times."""
        if spans:
            self.add_lengths("unknown_s", "duration", spans)

    def add_lengths(self, column: str, kind: BinColumn, spans: Sequence[Span]) -> None:
        """Adds how much (ns) of half-open spans, which do not overlap, falls into each bin."""
        self.add_sums(column, kind, self._time_in_pieces(spans))

    def add_counts(self, column: str, times: Ints) -> None:
        """Adds how many of these times each bin has."""
        pieces = self.bins.pieces(times)
        self.add_sums(column, "count", np.bincount(pieces, minlength=len(self.bins.member)))

    def add_sums(self, column: str, kind: BinColumn, of_pieces: Ints) -> None:
        """Adds what the pieces of each bin have together."""
        self.add(column, kind, (of_pieces @ self.bins.member).tolist(), int(of_pieces.sum()))

    def add_held(self, held: Ints) -> None:
        """Adds how often something began, its first and last time, and how long it held.

        That is without gaps, in which it may have held on, or begun and ended.

        Args:
            held: from when to when, and whether it is known to have begun then; else it held
                before, or that is not known (N x 3).
        """
        starts, stops, begun = held.T
        inside = (stops >= self.counted.start) & (starts < self.counted.stop)
        starts, stops = (times[inside].clip(*self._counted_bounds) for times in (starts, stops))
        begins = starts[begun[inside] > 0]
        self.add_counts("count", begins)
        is_long = starts < stops  # what happened at a moment took no time
        lasting = united(zip(starts[is_long].tolist(), stops[is_long].tolist(), strict=True))
        self.add_lengths("seconds", "duration", without(lasting, self.gaps))
        self.add_first("first", begins)
        self.add_last(self._last_held(starts, stops), max(stops.tolist(), default=None))
        self.usual = self.usual_of(begins)

    def add_first(self, column: str, times: Ints) -> None:
        """Adds the first of these times in each bin."""
        firsts = np.full(len(self.bins.member), MAX_NS)
        np.minimum.at(firsts, self.bins.pieces(times), times)
        of_bins = (int(firsts[in_bin].min(initial=MAX_NS)) for in_bin in self.bins.member.T)
        first = [None if at == MAX_NS else at for at in of_bins]
        self.add(column, "time", first, min(times.tolist(), default=None))

    def add_last(self, of_pieces: Ints, whole: Ns | None) -> None:
        """Adds the last time in each bin, by those in pieces; `MIN_NS` where there is none."""
        of_bins = (int(of_pieces[in_bin].max(initial=MIN_NS)) for in_bin in self.bins.member.T)
        self.add("last", "time", [None if at == MIN_NS else at for at in of_bins], whole)

    def _last_held(self, starts: Ints, stops: Ints) -> Ints:
        """Returns for each piece when something held there for the last time; `MIN_NS`: never."""
        piece_ends = self.bins.edges[1:] - 1
        first_pieces, last_pieces = self.bins.pieces(starts), self.bins.pieces(stops)
        newest = np.full(len(piece_ends), MIN_NS)
        np.maximum.at(newest, last_pieces, np.minimum(stops, piece_ends[last_pieces]))
        spans = np.stack((first_pieces, last_pieces), axis=1)[first_pieces < last_pieces]
        for first, last in spans.tolist():
            newest[first:last] = piece_ends[first:last]
        return newest

    def usual_of(self, times: Ints) -> Usual | None:
        """Returns the usual time of day of the first of these times in each day.

        Of a day that is not counted from its begin, the first is not known.
        """
        days = self._days_recorded()
        firsts = [at for day, at in first_of_days(self.bins, times) if day in days]
        return usual_time(firsts, len(days)) if firsts else None

    def _days_recorded(self) -> set[int]:
        """Returns the local days that have something recorded, and are counted from their begin."""
        if self.bins.day_of is None:
            return set()
        edges, days = self.bins.edges.tolist(), self.bins.day_of.tolist()
        recorded_days, cut_days = set(), set(days[:1] if self._is_first_day_cut() else ())
        for start, stop, day in zip(edges[:-1], edges[1:], days, strict=True):
            if length_in(self.gaps, start, stop) < stop - start:
                recorded_days.add(day)
            if self._since is not None and start < self._since:
                cut_days.add(day)
        return recorded_days - cut_days

    def _is_first_day_cut(self) -> bool:
        """Returns whether something was recorded in the first local day before the window."""
        start = self.window.start
        start_s = start // NS_PER_S
        midnight_s = start_s - (start_s + local_offset(start_s)) % _DAY_S
        before = TimeWindow(midnight_s * NS_PER_S, start)
        first, last = shown_span(self.view.snapshot, before)
        unrecorded = length_in([*recording_gaps(self.view, before)], first, last)
        return last - first - unrecorded > NS_PER_S  # a start that is the memory's own is rounded

    def _time_in_pieces(self, spans: Sequence[Span]) -> Ints:
        """Returns how much time (ns) of half-open spans passed in each piece."""
        starts, stops = np.array(spans, np.int64).reshape(-1, 2).T.clip(*self._counted_bounds)
        lengths = self.bins.lengths(starts, stops)
        for skipped in self.elapsed.skipped:
            lengths -= self.bins.lengths(starts.clip(*skipped), stops.clip(*skipped))
        return lengths

    @property
    def _counted_bounds(self) -> Span:
        """Begin and end (ns) of the part of the window that is counted."""
        start = self.window.start if self._since is None else max(self.window.start, self._since)
        return start, max(start, self.window.stop)

    def count_since(self, since: Ns | None, too_many: str = "") -> None:
        """Leaves out what is before a moment, and notes that it was not counted, if there is one.

        To be called before columns are added. `too_many` names what there is too much of to count,
        where the call's time was not over.
        """
        if since is None:
            return
        self._since = since
        self.counted = self.counted.intersect(TimeWindow(since, MAX_NS))
        why = f"{too_many}; " if too_many else self.view.bags.filling_progress() or "out of time; "
        self.view.notes.add_lack(
            f"only what is after {unix_text(since)} is counted: {why}ask about a shorter window"
        )

    def answer(self) -> Bins:
        """Returns the answer, with notes on what could not be read."""
        start, end = bounds = self._counted_bounds
        recorded = self._time_in_pieces([bounds]) - self._time_in_pieces(self.gaps)
        note_unread(self.view, self.asked)
        note_edges(self.view, self.asked)
        columns = zip((recorded @ self.bins.member).tolist(), *self._values, strict=True)
        rows = [*zip(self.bins.names, columns, strict=True)]
        if self._since is not None:
            is_late = self.bins.edges[1:] > self._since
            rows = [*compress(rows, np.any(self.bins.member[is_late], axis=0))]
        if self._by != "place":
            self._note_empty(rows)
            rows = [(name, values) for name, values in rows if any(values)]
        return Bins(
            by=self._by,
            about=self._topics,
            start=start,
            end=end,
            columns=(("recorded_s", "duration"), *self._columns),
            rows=tuple(rows),
            all=(int(recorded.sum()), *self._all),
            usual=self.usual,
            usual_exit=self.usual_exit,
            notes=self.view.notes.sentences(),
        )

    def _note_empty(self, rows: Sequence[tuple[str, Values]]) -> None:
        """Notes the bins in which nothing was recorded: several in a row by the first and last."""
        spans: list[str] = []
        for has_values, group in groupby(rows, lambda row: any(row[1])):
            first, *later = (name for name, _ in group)
            if not has_values:
                spans.append(f"{first} to {later[-1]}" if later else first)
        if spans:
            more = len(spans) - _MOST_SPANS
            shown = ", ".join(spans[:_MOST_SPANS]) + (f" and {more} more" if more > 0 else "")
            self.view.notes.add(f"no rows for times in which nothing was recorded: {shown}")
