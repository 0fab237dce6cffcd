"""A window cut into bins (local days, hours, weekdays, or places), and tables of what they hold.

A window is cut into pieces where local days (or hours) begin. Each piece belongs to one bin. Pieces
cover the window exactly, so the values of all bins add up to the value of the window. When clocks
change, a day has 23 or 25 hours, the hour that is skipped has no piece, and the hour that occurs
twice is one piece of two hours.

Bins of places are the named places or those of the question, "(elsewhere)", and "(unknown)" for
when it is not known where the robot was. Time in overlapping places counts to each of them, so
these bins may add up to more than the window.
"""

from __future__ import annotations

import time
from bisect import bisect_left
from contextlib import suppress
from dataclasses import dataclass
from datetime import date
from itertools import compress, groupby
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.analysis.intervals import pieces_of
from ros2_memory.analysis.silences import length_in
from ros2_memory.core.arrays import bounds_of
from ros2_memory.core.errors import InvalidArgumentsError, QueryTimeoutError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import Spans, spans_of, united, without
from ros2_memory.core.text import listed
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S, Ns, Span
from ros2_memory.history.coverage import (
    note_unread,
    recording_gaps,
    shown_span,
    shown_window,
    unix_text,
)
from ros2_memory.history.driven_path import resolve_path_topic
from ros2_memory.history.lasting import TEXT, held_times, is_latched
from ros2_memory.history.no_data import no_data_between
from ros2_memory.places.pose_frames import (
    known_track,
    map_placement,
    note_overlaps,
    placed_times,
    places_in,
)
from ros2_memory.places.where import Where, places_setting
from ros2_memory.results import BinColumn, Bins, Usual

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import ArrayLike, NDArray

    from ros2_memory.core.arrays import Flags, Ints
    from ros2_memory.history.view import View


_BOOLEAN: Final = "std_msgs/msg/Bool"
ClockBin: TypeAlias = Literal["day", "hour", "weekday"]
By: TypeAlias = Literal["day", "hour", "weekday", "place"]
Values: TypeAlias = "Sequence[float | None]"
"""The values of a column, one for each bin; None if a bin has none."""
Offset: TypeAlias = "Callable[[int], int]"
"""Returns how many seconds local time is ahead of UTC at a Unix second."""

MOST_BINS: Final = 62
"""A reply by day lists at most two months."""
MOST_DAYS: Final = 1_000
"""The longest window, in days, that is counted by hour or by weekday."""
MOST_CELLS: Final = 124
"""Fields (or places) times bins that one reply has room for."""
_MOST_SPANS: Final = 6
"""How many empty times a note names."""
HELD_COLUMNS: Final[tuple[tuple[str, BinColumn], ...]] = (
    ("count", "count"),
    ("seconds", "duration"),
    ("first", "time"),
    ("last", "time"),
)
"""How often something held, how long, when it first began, and when it last ended."""
ELSEWHERE: Final = "(elsewhere)"
UNKNOWN: Final = "(unknown)"

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
    """Returns how many seconds local time (of TZ, or of this machine) is ahead of UTC.

    0 if the year is out of the calendar's range.
    """
    try:
        return time.localtime(at_s).tm_gmtoff
    except (OverflowError, ValueError, OSError):
        return 0


@dataclass(frozen=True, slots=True)
class TimeBins:
    """A window cut into pieces. Each piece belongs to one bin, or to several overlapping places.

    Attributes:
        names: the names of the bins, in order.
        edges: log times (ns), ascending: the begin of each piece, and the end of the last.
        member: a row for each piece and a column for each bin: whether the piece belongs to it.
        day_of: for each piece, its local day since the epoch; None for bins of places, whose
            pieces may last several days.
    """

    names: tuple[str, ...]
    edges: Ints
    member: Flags
    day_of: Ints | None

    def pieces(self, times: ArrayLike) -> NDArray[np.intp]:
        """Returns the piece of each log time; times outside of the window go to its ends."""
        pieces = np.searchsorted(self.edges, np.asarray(times, np.int64), side="right") - 1
        return np.clip(pieces, 0, len(self.member) - 1)

    def lengths(self, starts: ArrayLike, stops: ArrayLike) -> Ints:
        """Returns the length (ns) of all half-open spans together in each piece."""
        start_times = np.asarray(starts, np.int64)
        stop_times = np.maximum(start_times, np.asarray(stops, np.int64))
        # Up to an edge, a span lasts as long as its start is before it, minus as its stop is.
        until_edges = _summed_ages(self.edges, start_times) - _summed_ages(self.edges, stop_times)
        return np.diff(until_edges)


def _summed_ages(edges: Ints, times: Ints) -> Ints:
    """Returns, for each edge, the sum of `edge - time` (ns) over all earlier times.

    A sum may wrap around. The difference of two sums, which is what callers use, is right.
    """
    ordered = np.sort(times)
    counts_before: Ints = np.searchsorted(ordered, edges)
    sums: Ints = np.append(0, np.cumsum(ordered))
    return counts_before * edges - sums[counts_before]


def time_bins(window: TimeWindow, by: ClockBin) -> TimeBins:
    """Returns the bins of a window that is not empty.

    Raises:
        InvalidArgumentsError: there would be too many bins.
    """
    days_long = (window.stop - window.start) // (_DAY_S * NS_PER_S)
    most_days = MOST_BINS if by == "day" else MOST_DAYS
    if days_long > most_days:
        raise _too_long(by, most_days)
    starts = _piece_starts(window, _HOUR_S if by == "hour" else _DAY_S)
    locals_s = [_local_s(start // NS_PER_S) for start in starts]
    days = [local_s // _DAY_S for local_s in locals_s]
    if by == "day":
        bin_of_piece = days
    elif by == "weekday":
        bin_of_piece = [date.fromordinal(_EPOCH + day).weekday() for day in days]
    else:
        bin_of_piece = [local_s % _DAY_S // _HOUR_S for local_s in locals_s]
    bins = sorted(set(bin_of_piece))
    # A window of so many days may touch one more.
    if len(bins) > MOST_BINS + 1:
        raise _too_long(by, MOST_BINS)
    return TimeBins(
        names=tuple(_bin_name(number, by) for number in bins),
        edges=np.array([*starts, window.stop], np.int64),
        member=np.array(bin_of_piece)[:, None] == np.array(bins),
        day_of=np.array(days, np.int64),
    )


def _piece_starts(window: TimeWindow, unit_s: int) -> list[Ns]:
    """Returns the window's start, and the times at which a local day (or hour) begins in it."""
    starts = [window.start]
    last_s = (window.stop - 1) // NS_PER_S
    edge_s = _next_edge(window.start // NS_PER_S, unit_s)
    while edge_s <= last_s:
        starts.append(edge_s * NS_PER_S)
        edge_s = _next_edge(edge_s, unit_s)
    return starts


def _too_long(by: ClockBin, most: int) -> InvalidArgumentsError:
    other = ", or by weekday" if by == "day" else ""
    return InvalidArgumentsError(
        f"by {by} takes at most {most} days: ask about a shorter window{other}"
    )


def _next_edge(at_s: int, unit_s: int) -> int:
    """Returns the next Unix second in which another local day (or hour) begins."""
    while True:
        ahead_s = local_offset(at_s)
        following_s = at_s - (at_s + ahead_s) % unit_s + unit_s
        if local_offset(following_s) == ahead_s:
            return following_s
        # The clock is changed before: to the same hour or to another one, perhaps an earlier one.
        seconds = range(at_s, following_s)
        changed_s = at_s + bisect_left(seconds, True, key=lambda at: local_offset(at) != ahead_s)
        if _local_s(changed_s) // unit_s != (changed_s - 1 + ahead_s) // unit_s:
            return changed_s
        at_s = changed_s


def _local_s(at_s: int) -> int:
    """Returns the seconds of local time since the epoch at a Unix second."""
    return at_s + local_offset(at_s)


def _bin_name(number: int, by: ClockBin) -> str:
    if by == "day":
        return date.fromordinal(_EPOCH + number).isoformat()
    return _WEEKDAYS[number] if by == "weekday" else f"{number:02d}:00"


def place_bins(
    view: View, window: TimeWindow, counted: TimeWindow, where: Where | None
) -> TimeBins:
    """Returns a bin for each place, and the pieces in which the robot was there.

    Args:
        view: the view of this call.
        window: the window that the pieces cover.
        counted: the window in which the robot's track is read.
        where: the places; None for all named places.

    Raises:
        InvalidArgumentsError: no place is named in the frame of places, or no transforms lead to
            the frame of the places that are asked for.
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
    note_overlaps(view, spans_inside)
    in_none = ~in_places.any(axis=1)
    placed = _lies_in_spans(edges, placed_spans)
    member = np.column_stack((in_places, in_none & placed, in_none & ~placed))
    names = (*(place.name for place, _ in places), ELSEWHERE, UNKNOWN)
    return TimeBins(names, edges, member, None)


def _edges_at_spans(window: TimeWindow, span_lists: Sequence[Sequence[Span]]) -> Ints:
    """Returns the ends of a window, and the ends of spans that lie in it, ascending."""
    bounds = {at for spans in span_lists for span in spans for at in span}
    inner = sorted(at for at in bounds if window.start < at < window.stop)
    return np.array([window.start, *inner, window.stop], np.int64)


def _lies_in_spans(edges: Ints, spans: Sequence[Span]) -> Flags:
    """Returns, for each piece between two edges, whether it lies in one of the half-open spans."""
    starts, stops = bounds_of(spans)
    begun = np.searchsorted(starts, edges[:-1], side="right")
    ended = np.searchsorted(stops, edges[:-1], side="right")
    return begun > ended


class _Column(NamedTuple):
    """A column of a table of bins; `whole` is its value for all bins together."""

    name: str
    kind: BinColumn
    values: Values
    whole: float | None


class BinnedWindow:
    """A window of the memory, cut into bins, to which columns of values are added.

    Args:
        view: the view of this call.
        asked: the window that the client asked for.
        by: the kind of the bins.
        topics: the topics that the reply is about.
        where: the places of bins of places; None for all named ones.

    Attributes:
        asked: the window that the client asked for.
        counted: the part of it that is counted: what the memory reaches, and what there was time
            for. Bags with a wrong clock do not widen it, unless there are no others.
        window: the part that the memory reaches, without the tolerance of its bounds.
        bins: the bins of `window`.
        gaps: the spans of `window` in which nothing was recorded.
        elapsed: how much time passed between log times of `window`.
        usual: the usual time of day of the first begin, if that is counted.

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
        self.counted = shown_window(view.snapshot, asked)
        # The end is left out: a window until midnight has no bin of the next day. `TimeBins.pieces`
        # takes what happens at the very end into the last bin.
        self.window = TimeWindow(start, max(end, start + 1))
        if by == "place":
            self.bins = place_bins(view, self.window, self.counted, where)
        else:
            self.bins = time_bins(self.window, by)
        self._columns: list[_Column] = []
        self.usual: Usual | None = None
        self.gaps = list(recording_gaps(view, self.window))
        self.elapsed = view.elapsed_in(self.window)
        self._since: Ns | None = None

    def add(self, name: str, kind: BinColumn, values: Values, whole: float | None) -> None:
        """Adds a column: a value for each bin, and the value for all bins together."""
        self._columns.append(_Column(name, kind, values, whole))

    def add_heard(self, column: str, topics: Sequence[str]) -> None:
        """Adds how long topics had messages, without gaps and pauses of more than two splits.

        What a latched topic, or a rare one of texts or booleans, said is known until its next
        message.
        """
        pause = round(2 * NS_PER_S * self.view.limits.split_duration_s)
        heard = spans_of(*pieces_of(*self.bounds(topics), pause))
        # What was counted is answered also where no time is left for this.
        with suppress(QueryTimeoutError):
            for topic in topics:
                if _has_states(self.view, topic):
                    held = held_times(self.view, [topic], self.counted)
                    known = (TimeWindow(*span).intersect(self.counted) for span in held)
                    heard += [(part.start, part.stop) for part in known if not part.empty]
        self.add_lengths(column, "duration", without(united(heard), self.gaps))

    def bounds(self, topics: Sequence[str]) -> tuple[Ints, Ints]:
        """Returns the first and the last log times (ns) of each topic in each counted bag."""
        bounds = [self.view.bounds(topic, self.counted) for topic in topics]
        firsts, lasts = np.concatenate(bounds, axis=1)
        is_inside = (firsts < self.counted.stop) & (lasts >= self.counted.start)
        return firsts[is_inside], lasts[is_inside]

    def add_unknown(self, spans: Spans) -> None:
        """Adds how long the answer is not known, if there are such times."""
        if spans:
            self.add_lengths("unknown_s", "duration", spans)

    def add_lengths(self, column: str, kind: BinColumn, spans: Sequence[Span]) -> None:
        """Adds the time that passed in half-open spans, which do not overlap, for each bin."""
        self.add_sums(column, kind, self._time_in_pieces(spans))

    def add_counts(self, column: str, times: Ints) -> None:
        """Adds how many of the log times each bin has."""
        pieces = self.bins.pieces(times)
        self.add_sums(column, "count", np.bincount(pieces, minlength=len(self.bins.member)))

    def add_sums(self, column: str, kind: BinColumn, piece_values: Ints) -> None:
        """Adds, for each bin, the sum of the values of its pieces."""
        self.add(column, kind, (piece_values @ self.bins.member).tolist(), int(piece_values.sum()))

    def add_held(self, held: Ints) -> None:
        """Adds `HELD_COLUMNS`. Time in gaps does not count: what happened then is not known.

        Args:
            held: rows of a start and a stop (ns, inclusive), and 1 if it is known to begin at the
                start, 0 if it may have begun before.
        """
        starts, stops, begun = held.T
        inside = (stops >= self.counted.start) & (starts < self.counted.stop)
        starts, stops = (times[inside].clip(*self._counted_bounds) for times in (starts, stops))
        begins = starts[begun[inside] > 0]
        self.add_counts("count", begins)
        is_long = starts < stops
        lasting = without(united(spans_of(starts[is_long], stops[is_long])), self.gaps)
        self.add_lengths("seconds", "duration", lasting)
        self.add_first("first", begins)
        known = [*lasting, *spans_of(starts[~is_long], stops[~is_long])]
        self.add_last(self._last_held(*bounds_of(known)), max(stops.tolist(), default=None))
        self.usual = self.usual_of(begins)

    def add_first(self, column: str, times: Ints) -> None:
        """Adds the first of the log times in each bin."""
        firsts = np.full(len(self.bins.member), MAX_NS)
        np.minimum.at(firsts, self.bins.pieces(times), times)
        bin_firsts = (int(firsts[in_bin].min(initial=MAX_NS)) for in_bin in self.bins.member.T)
        values = [None if at == MAX_NS else at for at in bin_firsts]
        self.add(column, "time", values, min(times.tolist(), default=None))

    def add_last(self, piece_lasts: Ints, whole: Ns | None) -> None:
        """Adds the last log time in each bin; `piece_lasts` has `MIN_NS` for a piece without."""
        bin_lasts = (int(piece_lasts[in_bin].max(initial=MIN_NS)) for in_bin in self.bins.member.T)
        self.add("last", "time", [None if at == MIN_NS else at for at in bin_lasts], whole)

    def _last_held(self, starts: Ints, stops: Ints) -> Ints:
        """Returns the last time in each piece that lies in a span (inclusive); else `MIN_NS`."""
        piece_ends = self.bins.edges[1:] - 1
        piece_ends[-1] += 1  # the window's end is in the last piece
        first_pieces, last_pieces = self.bins.pieces(starts), self.bins.pieces(stops)
        newest = np.full(len(piece_ends), MIN_NS)
        np.maximum.at(newest, last_pieces, np.minimum(stops, piece_ends[last_pieces]))
        spans = np.stack((first_pieces, last_pieces), axis=1)[first_pieces < last_pieces]
        for first, last in spans.tolist():
            newest[first:last] = piece_ends[first:last]
        return newest

    def usual_of(self, times: Ints) -> Usual | None:
        """Returns the usual local time of day of the first of the log times in a day.

        Only days count that are counted from midnight and have something recorded. None for bins
        of places, and if no such day has one of the times.
        """
        if self.bins.day_of is None:
            return None
        ordered = np.sort(times)
        days, firsts = np.unique(self.bins.day_of[self.bins.pieces(ordered)], return_index=True)
        whole_days = self._whole_days(self.bins.day_of.tolist())
        clock_s = sorted(
            _local_s(at // NS_PER_S) % _DAY_S
            for day, at in zip(days.tolist(), ordered[firsts].tolist(), strict=True)
            if day in whole_days
        )
        if not clock_s:
            return None
        median_s = (clock_s[(len(clock_s) - 1) // 2] + clock_s[len(clock_s) // 2]) // 2
        return Usual(median_s, clock_s[0], clock_s[-1], len(clock_s), len(whole_days))

    def _whole_days(self, days: Sequence[int]) -> set[int]:
        """Returns the local days that have something recorded and are counted from midnight.

        `days` has the local day of each piece.
        """
        edges = self.bins.edges.tolist()
        recorded_days: set[int] = set()
        cut_days: set[int] = set()
        if self._is_first_day_cut():
            cut_days.add(days[0])
        for start, stop, day in zip(edges[:-1], edges[1:], days, strict=True):
            if length_in(self.gaps, start, stop) < stop - start:
                recorded_days.add(day)
            if self._since is not None and start < self._since:
                cut_days.add(day)
        return recorded_days - cut_days

    def _is_first_day_cut(self) -> bool:
        """Returns whether the first local day has something recorded before the window."""
        start = self.window.start
        # On the day of a change of clocks midnight is not as long ago as the clock says.
        *_, midnight = _piece_starts(TimeWindow(start - 2 * _DAY_S * NS_PER_S, start + 1), _DAY_S)
        before = TimeWindow(midnight, start)
        first, last = shown_span(self.view.snapshot, before)
        unrecorded = length_in([*recording_gaps(self.view, before)], first, last)
        # The memory's own start was rounded to be asked for: up to a second is not recorded.
        return last - first - unrecorded > NS_PER_S

    def _time_in_pieces(self, spans: Sequence[Span]) -> Ints:
        """Returns the time (ns) of half-open spans that passed in each piece, and is counted."""
        starts, stops = bounds_of(spans).clip(*self._counted_bounds)
        lengths = self.bins.lengths(starts, stops)
        for skipped in self.elapsed.skipped:
            lengths -= self.bins.lengths(starts.clip(*skipped), stops.clip(*skipped))
        return lengths

    @property
    def _counted_bounds(self) -> Span:
        """The begin and the end (ns) of the part of `window` that is counted."""
        start = self.window.start if self._since is None else max(self.window.start, self._since)
        return start, max(start, self.window.stop)

    def count_since(self, since: Ns | None, too_many: str = "") -> None:
        """Leaves out everything before a log time, with a note; does nothing if it is None.

        To be called before columns are added. The note gives `too_many` as the reason ("more than
        10,000 episodes"), or else that time ran out.
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
        """Returns the table of all columns, with notes on what could not be read."""
        start, end = bounds = self._counted_bounds
        recorded = self._time_in_pieces([bounds]) - self._time_in_pieces(self.gaps)
        recorded_s = (recorded @ self.bins.member).tolist()
        columns = [
            _Column("recorded_s", "duration", recorded_s, int(recorded.sum())),
            *self._columns,
        ]
        note_unread(self.view, self.asked)
        cells = zip(*(column.values for column in columns), strict=True)
        rows = [*zip(self.bins.names, cells, strict=True)]
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
            columns=tuple((column.name, column.kind) for column in columns),
            rows=tuple(rows),
            all=tuple(column.whole for column in columns),
            usual=self.usual,
            notes=self.view.notes.sentences(),
        )

    def _note_empty(self, rows: Sequence[tuple[str, Values]]) -> None:
        """Notes in which bins nothing was recorded; a run of such bins by its first and last."""
        spans: list[str] = []
        for has_values, group in groupby(rows, lambda row: any(row[1])):
            first, *later = (name for name, _ in group)
            if not has_values:
                spans.append(f"{first} to {later[-1]}" if later else first)
        if spans:
            shown = listed(spans, at_most=_MOST_SPANS)
            self.view.notes.add(f"no rows for times in which nothing was recorded: {shown}")


def _has_states(view: View, topic: str) -> bool:
    """Returns whether a topic states something that lasts through silence while it is rare.

    It is latched, or of texts or booleans. A number of a rare topic is measured anew.
    """
    are_states = {TEXT, _BOOLEAN}.issuperset(view.timeline.types_of(topic))
    return are_states or is_latched(view, topic)
