"""Scans of topics within one call: what `columns.scan` yields, under the call's deadline.

And how many messages there are in pieces of a window, each counted once. The index knows that of
every bag in which no piece ends, where no other recording may hold copies. Of the rest the times of
messages are looked at, and where recordings overlap those that count.
"""

from __future__ import annotations

from collections import Counter
from functools import partial
from typing import TYPE_CHECKING, NamedTuple, TypedDict, TypeVar, Unpack

import numpy as np

from ros2_memory.columns.fragments import FragmentKey, FragmentKind, Joined, Sized, joining
from ros2_memory.columns.scan import Scan, Stretch
from ros2_memory.columns.stored import StoredTable
from ros2_memory.columns.units import BagUnit, Rows
from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.core.model import BagFile, TimeWindow
from ros2_memory.core.spans import united
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns, Span
from ros2_memory.messages.to_json import evenly

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from ros2_memory.columns.table import Table
    from ros2_memory.columns.zones import PartZones
    from ros2_memory.core.arrays import Ints
    from ros2_memory.history.stored_message import StoredMessage
    from ros2_memory.history.view import View
    from ros2_memory.index.segment import TopicColumn
    from ros2_memory.storage.base import IntArray, Mask

T = TypeVar("T", bound="Sized")
V = TypeVar("V")


def scan(
    view: View, topic: str, window: TimeWindow, *, newest_first: bool = False, **how: Unpack[How]
) -> Iterator[Rows]:
    """Yields the rows of a topic in a window; see `open_scan` and `columns.scan.Scan.rows`.

    Raises:
        QueryTimeoutError: while it is iterated, when the deadline has passed.
    """

    def noted(rows: Rows) -> Rows:
        view.note_thinned(TimeWindow(rows.first, rows.last + 1))
        return rows

    rows = open_scan(view, topic, window, **how).rows(newest_first=newest_first)
    return map(noted, rows) if view.timeline.thinned else rows


class Wanted(TypedDict, total=False):
    """What of a topic a scan is of; each is as in `Scan`."""

    shared: Sequence[Span]
    may_match: Callable[[PartZones], bool | Mask]
    may_not_match: bool
    may_be_empty: bool
    within: Sequence[Span]
    stored: bool


class How(Wanted, total=False):
    """The options of `open_scan`."""

    columns: bool
    copies: bool
    reached: Callable[[Ns], None]


def open_scan(
    view: View,
    topic: str,
    window: TimeWindow,
    *,
    columns: bool = True,
    copies: bool = False,
    reached: Callable[[Ns], None] = lambda _: None,
    **wanted: Unpack[Wanted],
) -> Scan:
    """Returns the scan of a topic in a window.

    What cannot be read is noted. `reached` is called before each table with a log time that what
    is left does not lie behind (with `newest_first`: is not later than). Without `columns` only the
    times of rows are asked for: then messages that cannot be decoded have rows, too. With `copies`
    a message counts in each recording that holds it.
    """

    def decode(bag: BagFile, topic: str, hashed: bool) -> Iterable[Table]:
        return view.bags.tables(bag, topic, window, hashed=hashed, columns=columns, around=True)

    def check(at: Ns) -> None:
        reached(at)
        view.bags.check_deadline()

    wanted.setdefault("shared", () if copies else view.timeline.shared_times)
    repeats_latched = not copies and view.stream.may_be_repeated([topic])
    return Scan(
        view.memory.scanner,
        topic,
        window,
        view.timeline,
        decode,
        repeats_latched=repeats_latched,
        check=check,
        **wanted,
    )


def joined_back(
    view: View,
    opened: Scan,
    kind: FragmentKind[T],
    make: Callable[[Stretch], Iterable[tuple[Ns, T]]],
    key_of: Callable[[Stretch], FragmentKey | None] = Stretch.key,
    *,
    beside: Ns = 0,
) -> Iterator[tuple[Ns, T]]:
    """Yields what `make` returns of the rows of a scan, the newest first, each with a time.

    Nothing of it is earlier than that (log time, ns). What follows from whole parts alone is joined
    by stretches of the clock, and remembered.

    Args:
        view: of the call.
        opened: the scan.
        kind: of what is made.
        make: returns what follows from the rows that begin in a stretch, the newest first. Of one
            without parts the call may leave out what is not `stored`.
        key_of: returns under which key that of a stretch is remembered; None: under none.
        beside: how far before and after a stretch (ns) rows are part of it, too.
    """
    for stretch in opened.stretches(beside):
        view.note_thinned(TimeWindow(stretch.window.start, stretch.last + 1))
        key = key_of(stretch)
        if key is None:
            yield from make(stretch._replace(parts=None))
            continue
        view.bags.check_deadline()
        results: list[tuple[Ns, T]] = []
        join = partial(_joined, kind, make(stretch), results)
        before = key.start - opened.window.start  # they are wanted next
        try:
            joined = remembered(view, joining(kind), key, join, also_before=before)
        except QueryTimeoutError:
            # What there was time for is an answer, too, with a note.
            yield from results
            raise
        for result in reversed(joined.fragments):
            yield stretch.window.start, result


def _joined(
    kind: FragmentKind[T], made: Iterable[tuple[Ns, T]], results: list[tuple[Ns, T]]
) -> Joined[T]:
    """Returns what was made, the newest first, as one; `results` has it one by one."""
    results.extend(made)
    return Joined(kind.join([result for _, result in results[::-1]]) if results else [])


def remembered(
    view: View,
    kind: FragmentKind[T],
    key: FragmentKey | None,
    make: Callable[[], T],
    *,
    also_before: Ns = 0,
) -> T:
    """Returns what is stored under a key, else what `make` returns.

    That is remembered unless something could not be read; see `joined_back`. A key of None stands
    for what may still change. `also_before`: see `Fragments.get`.
    """
    fragments = view.memory.scanner.fragments(kind)
    fragment = None if key is None else fragments.get(key, also_before)
    if fragment is None:
        before = view.notes.added
        fragment = make()
        if key is not None and view.notes.added == before:
            fragments.put(key, fragment)
    return fragment


def read_until_late(
    view: View, newest_first: Iterable[tuple[Ns, V]], budget_s: float
) -> tuple[list[V], Ns | None]:
    """Returns values, the newest first, until time runs out; and since when they are complete.

    The latter is None if there was time for all. With each value comes the log time that nothing of
    it is earlier than.

    Raises:
        QueryTimeoutError: the call's time is over before the first value.
    """
    reading = view.call.partial_after(budget_s)
    values: list[V] = []
    since = MAX_NS
    try:
        for at, value in newest_first:
            if values and reading.expired():
                return values, since
            values.append(value)
            since = at
    except QueryTimeoutError:
        if not values:
            raise
        return values, since
    return values, None


def blocks(scanned: Iterable[Rows], *, newest_first: bool) -> Iterator[list[Rows]]:
    """Yields the rows of a scan, those together that overlap in time: no other lies between.

    Those together are in the order that their messages of one log time have; see `Rows.order`.
    """
    together: list[Rows] = []
    for rows in scanned:
        is_apart = together and (
            rows.last < min(other.first for other in together)
            if newest_first
            else rows.first > max(other.last for other in together)
        )
        if is_apart:
            yield _in_order(together)
            together = []
        together.append(rows)
    if together:
        yield _in_order(together)


def _in_order(together: list[Rows]) -> list[Rows]:
    return sorted(together, key=lambda rows: rows.order) if len(together) > 1 else together


def decoded_rows(view: View, rows: Rows) -> Iterator[tuple[IntArray, Rows]]:
    """Yields some rows as their bags have them, with their positions among those that count."""
    times, ranks, channel = rows.times, rows.ranks, rows.table.channel
    for bag, positions in rows.bag_rows():
        wanted = times[positions]
        window = TimeWindow(int(wanted.min()), int(wanted.max()) + 1)
        for nth, table in enumerate(view.bags.tables(bag, channel.topic, window)):
            if table.channel.type != channel.type:
                continue
            at = np.searchsorted(table.log_times, wanted) + ranks[positions]
            same = np.append(table.log_times, MAX_NS)[np.minimum(at, len(table))] == wanted
            if same.any():
                yield positions[same], Rows.of(BagUnit(bag, table, nth), at[same])


def of_columns(view: View, rows: Rows, read: Callable[[Rows], V | None]) -> list[V] | None:
    """Returns what is read of the columns of some rows: of those in the store, else in their bags.

    A topic beyond its share has few in the store. None where only the messages have it.
    """
    values = read(rows)
    # Without any column ("") a stored table is for its type, which its bag does not change; one of
    # a bag may be so for the size of all its messages together.
    left_out, is_stored = rows.table.left_out, isinstance(rows.table, StoredTable)
    if values is not None or not left_out or ("" in left_out) == is_stored:
        return None if values is None else [values]
    by_bag, left = list[V](), len(rows)
    for positions, decoded in decoded_rows(view, rows):
        values, left = read(decoded), left - positions.size
        if values is None:
            return None
        by_bag.append(values)
    return by_bag if by_bag and not left else None


def messages_of(view: View, rows: Rows) -> Iterator[StoredMessage]:
    """Yields the messages of some rows, read from their bags: bag after bag, in log-time order."""
    return (stored for _, stored in messages_at(view, rows))


def messages_at(view: View, rows: Rows) -> Iterator[tuple[int, StoredMessage]]:
    """Does as `messages_of`, each with the position of its row among those that count."""
    times, ranks, channel = rows.times, rows.ranks, rows.table.channel
    for bag, positions in rows.bag_rows():
        wanted = times[positions]
        window = TimeWindow(int(wanted[0]), int(wanted[-1]) + 1)
        keys = zip(wanted.tolist(), ranks[positions].tolist(), strict=True)
        position_of = dict(zip(keys, positions.tolist(), strict=True))
        met = Counter[Ns]()
        for stored in view.bags.read(bag, [channel.topic], window):
            if stored.type == channel.type:
                position = position_of.get((stored.time, met[stored.time]))
                if position is not None:
                    yield position, stored
                met[stored.time] += 1


def positions_in(times: Ints, window: TimeWindow) -> Ints:
    """Returns the positions of those times that are in a window."""
    return np.flatnonzero((times >= window.start) & (times < window.stop))


class Counted(NamedTuple):
    """How many messages each piece holds, and the log times of its first and last one."""

    messages: IntArray
    first: IntArray
    last: IntArray

    def add(self, pieces: IntArray, messages: IntArray, first: IntArray, last: IntArray) -> None:
        """Adds messages to pieces, each of which may be named several times."""
        np.add.at(self.messages, pieces, messages)
        np.minimum.at(self.first, pieces, first)
        np.maximum.at(self.last, pieces, last)

    def add_times(self, times: IntArray, edges: IntArray) -> None:
        """Adds a message at each of some log times (ns) to the piece that it lies in."""
        pieces = np.searchsorted(edges, times, side="right")
        self.add(pieces, np.ones_like(times), times, times)


def count_messages(
    view: View, topic: str, window: TimeWindow, edges: IntArray, *, proves: bool = False
) -> Counted:
    """Returns how many messages of a topic lie in each piece of a window.

    Messages that cannot be decoded count, too.

    Args:
        view: the call's.
        topic: its name.
        window: of log time.
        edges: where pieces begin (ns), ascending; what is before the first is piece 0.
        proves: whether messages are read for their times, as indexes of bags may lie.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
    size = len(edges) + 1
    counted = Counted(np.zeros(size, np.int64), np.full(size, MAX_NS), np.full(size, MIN_NS))
    # Which of repeated messages count, no bag shows alone.
    is_repeated = view.stream.may_be_repeated([topic])
    shared = open_scan(view, topic, window).shared
    shared_ends = np.array([*shared, (MAX_NS, MAX_NS)], np.int64).T
    to_read: set[str] = set()
    spans: list[Span] = []
    for segment in view.timeline.segments_in(window):
        column = segment.column(topic)
        if column is None:
            continue
        bags, firsts, lasts, messages = column
        pieces = np.searchsorted(edges, firsts, side="right")
        is_here = (firsts < window.stop) & (lasts >= window.start)
        is_cut = _are_cut(column, window, edges, shared_ends) | is_repeated
        is_in = is_here & ~is_cut
        counted.add(pieces[is_in], messages[is_in], firsts[is_in], lasts[is_in])
        for row in np.flatnonzero(is_here & is_cut).tolist():
            # A bag has a row for each type of the topic.
            to_read.add(segment.bags[bags[row]].file)
            spans.append((int(firsts[row]), int(lasts[row]) + 1))
    for rows in scan(view, topic, window, columns=proves, shared=shared, within=united(spans)):
        for _, positions in rows.bag_rows(to_read):
            counted.add_times(rows.times[positions], edges)
    return counted


def _are_cut(column: TopicColumn, window: TimeWindow, edges: IntArray, shared_ends: Ints) -> Mask:
    """Returns which bags have to be read: those of several pieces, and those with shared times.

    A bag of which one type of the topic has to be read is read under all. `shared_ends` has the
    starts and the stops of shared times, which are in order and apart.
    """
    bags, firsts, lasts, _ = column
    is_cut = (firsts < window.start) | (lasts >= window.stop)
    is_cut |= np.searchsorted(edges, firsts, "right") != np.searchsorted(edges, lasts, "right")
    starts, stops = shared_ends
    is_cut |= starts[np.searchsorted(stops, firsts, side="right")] <= lasts
    return np.isin(bags, bags[is_cut])


def pick(
    view: View, topic: str, window: TimeWindow, at_most: int
) -> tuple[int, Iterator[StoredMessage]]:
    """Returns how many messages of a topic a window holds, and `at_most` of them, evenly spaced.

    The first and the last are always among them. Each is read when it is its turn.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
    edges = np.unique(view.bounds(topic, window)[0])
    counts = count_messages(view, topic, window, edges, proves=True).messages
    ends = np.cumsum(counts)
    chosen = np.array(evenly(int(ends[-1]), at_most), np.int64)
    opened = open_scan(view, topic, window)

    def read() -> Iterator[StoredMessage]:
        pieces = np.searchsorted(ends, chosen, side="right")
        bounds = [MIN_NS, *edges.tolist(), MAX_NS]
        for piece in np.unique(pieces).tolist():
            part = window.intersect(TimeWindow(bounds[piece], bounds[piece + 1]))
            nth = chosen[pieces == piece] - (ends[piece] - counts[piece])
            tables = [
                rows.some(positions_in(rows.times, part))
                for rows in _in_order([*opened.rows(among=part)])
            ]
            begins = np.cumsum([0, *map(len, tables)])
            times = np.concatenate([np.empty(0, np.int64), *(rows.times for rows in tables)])
            order = np.argsort(times, kind="stable")
            for place in order[nth[nth < times.size]].tolist():  # a bag may be deleted since
                table = int(np.searchsorted(begins, place, side="right")) - 1
                yield from messages_of(view, tables[table].some(place - begins[table : table + 1]))

    return int(ends[-1]), read()
