"""Scans of topics within one call: what `columns.scan` yields, under the call's deadline.

Also counts the messages in pieces of a window, each message once. The index has the numbers of bags
that lie in one piece and share no time with another recording. Of other bags, the times of the
messages that count are read.
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
from ros2_memory.core.arrays import concatenated
from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.core.model import BagFile, TimeWindow
from ros2_memory.core.spans import united
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns, Span
from ros2_memory.messages.to_json import evenly

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from ros2_memory.columns.stored import PartZones
    from ros2_memory.columns.table import Table
    from ros2_memory.core.arrays import Ints
    from ros2_memory.history.bag_access import StoredMessage
    from ros2_memory.history.view import View
    from ros2_memory.index.segment import TopicColumn
    from ros2_memory.storage.base import IntArray, Mask

T = TypeVar("T", bound="Sized")
V = TypeVar("V")


def scan(
    view: View, topic: str, window: TimeWindow, *, newest_first: bool = False, **how: Unpack[How]
) -> Iterator[Rows]:
    """Yields the rows of a topic in a window; see `open_scan` and `columns.scan.Scan.rows`."""
    for rows in open_scan(view, topic, window, **how).rows(newest_first=newest_first):
        view.bags.track_thinned(rows.first, rows.last)
        yield rows


class Wanted(TypedDict, total=False):
    """Options of `Scan`; see there."""

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
    before_table: Callable[[Ns], None]


def open_scan(
    view: View,
    topic: str,
    window: TimeWindow,
    *,
    columns: bool = True,
    copies: bool = False,
    before_table: Callable[[Ns], None] = lambda _: None,
    **wanted: Unpack[Wanted],
) -> Scan:
    """Returns the scan of a topic in a window; notes report what cannot be read.

    Args:
        view: of the call.
        topic: its name.
        window: of log time.
        columns: whether rows have more than times.
        copies: whether a message counts in each recording that holds it.
        before_table: called before each table, with a log time. Rows that are left are not
            earlier; with `newest_first`, not later.
        **wanted: options of `Scan`.
    """

    def decode(bag: BagFile, topic: str, hashed: bool) -> Iterable[Table]:
        return view.bags.tables(bag, topic, window, hashed=hashed, columns=columns, around=True)

    def check(at: Ns) -> None:
        before_table(at)
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
    """Yields what `make` returns for the stretches of a scan, the newest first.

    With each result comes a log time (ns) that nothing of it is earlier than. The results of a
    stretch of whole parts are joined, and remembered as one.

    Args:
        view: of the call.
        opened: the scan.
        kind: the kind of the results.
        make: returns the results for rows that begin in a stretch, the newest first. If the stretch
            has no parts and the call is for the store, it may leave out what is not stored.
        key_of: returns the key by which the result of a stretch is remembered; None for none.
        beside: how far (ns) before and after a stretch its results depend on rows.
    """
    for stretch in opened.stretches(beside):
        view.bags.track_thinned(stretch.window.start, stretch.last)
        key = key_of(stretch)
        if key is None:
            yield from make(stretch._replace(parts=None))
            continue
        view.bags.check_deadline()
        results: list[tuple[Ns, T]] = []
        join = partial(_joined, kind, make(stretch), results)
        before = key.start - opened.window.start  # earlier stretches are wanted next
        try:
            joined = remembered(view, joining(kind), key, join, also_before=before)
        except QueryTimeoutError:
            # The results so far are an answer, too, with a note.
            yield from results
            raise
        for result in reversed(joined.fragments):
            yield stretch.window.start, result


def _joined(
    kind: FragmentKind[T], made: Iterable[tuple[Ns, T]], results: list[tuple[Ns, T]]
) -> Joined[T]:
    """Joins results, the newest first. Adds each to `results`, in case that time runs out."""
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
    """Returns the fragment with a key, or makes and remembers it.

    It is not remembered if something could not be read meanwhile, or if the key is None: then it
    may still change. `also_before` is as in `Fragments.get`.
    """
    if key is None:
        return make()
    fragments = view.memory.scanner.fragments(kind)
    fragment = fragments.get(key, also_before)
    if fragment is None:
        with view.bags.watched() as reading:
            fragment = make()
        if reading.is_final:
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
        for since, value in newest_first:
            values.append(value)
            if len(values) > 1 and reading.expired():
                return values, since
    except QueryTimeoutError:
        if not values:
            raise
        return values, since
    return values, None


def blocks(scanned: Iterable[Rows], *, newest_first: bool) -> Iterator[list[Rows]]:
    """Yields the rows of a scan in blocks: rows of different blocks do not overlap in time.

    Within a block they are sorted by `Rows.order`, which decides between messages of one log time.
    """
    block: list[Rows] = []
    for rows in scanned:
        if newest_first:
            is_apart = bool(block) and rows.last < min(other.first for other in block)
        else:
            is_apart = bool(block) and rows.first > max(other.last for other in block)
        if is_apart:
            yield _in_order(block)
            block = []
        block.append(rows)
    if block:
        yield _in_order(block)


def _in_order(block: list[Rows]) -> list[Rows]:
    # Mostly a block is one table: then its order need not be computed.
    return sorted(block, key=lambda rows: rows.order) if len(block) > 1 else block


def decoded_rows(view: View, rows: Rows) -> Iterator[tuple[IntArray, Rows]]:
    """Decodes rows from their bags; yields them with their positions in `rows`."""
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
    """Reads the columns of rows; decodes their bags if the store has left columns out.

    Returns one value, or a value for each bag. None if only the messages can tell.
    """
    value = read(rows)
    if value is not None:
        return [value]
    left_out = rows.table.left_out
    lacks_all = "" in left_out
    if isinstance(rows.table, StoredTable):
        # The bags have columns that are too large for the store, and none of a type without any.
        bags_tell = bool(left_out) and not lacks_all
    else:
        bags_tell = lacks_all  # the bag was too large to hold the columns of all its messages
    if not bags_tell:
        return None
    values: list[V] = []
    missing = len(rows)
    for positions, decoded in decoded_rows(view, rows):
        value = read(decoded)
        if value is None:
            return None
        values.append(value)
        missing -= positions.size
    return values if values and not missing else None


def messages_of(view: View, rows: Rows) -> Iterator[StoredMessage]:
    """Yields the messages of rows, read from their bags: bag after bag, in log-time order."""
    return (stored for _, stored in messages_at(view, rows))


def messages_at(view: View, rows: Rows) -> Iterator[tuple[int, StoredMessage]]:
    """Yields `messages_of`, each with its position in `rows`."""
    times, ranks, channel = rows.times, rows.ranks, rows.table.channel
    for bag, positions in rows.bag_rows():
        wanted = times[positions]
        window = TimeWindow(int(wanted[0]), int(wanted[-1]) + 1)
        keys = zip(wanted.tolist(), ranks[positions].tolist(), strict=True)
        position_of = dict(zip(keys, positions.tolist(), strict=True))
        rank_of = Counter[Ns]()  # tells messages of one log time apart
        for stored in view.bags.read(bag, [channel.topic], window):
            if stored.type != channel.type:
                continue
            position = position_of.get((stored.time, rank_of[stored.time]))
            rank_of[stored.time] += 1
            if position is not None:
                yield position, stored


def positions_in(times: Ints, window: TimeWindow) -> Ints:
    """Returns the positions of the times that are in a window."""
    return np.flatnonzero(window.holding(times))


class Counted(NamedTuple):
    """For each piece the number of its messages, and the log times of the first and the last."""

    messages: IntArray
    first: IntArray
    last: IntArray

    def add(self, pieces: IntArray, messages: IntArray, first: IntArray, last: IntArray) -> None:
        """Adds numbers of messages to pieces; a piece may occur several times."""
        np.add.at(self.messages, pieces, messages)
        np.minimum.at(self.first, pieces, first)
        np.maximum.at(self.last, pieces, last)


def count_messages(
    view: View, topic: str, window: TimeWindow, edges: IntArray, *, proves: bool = False
) -> Counted:
    """Counts the messages of a topic in each piece of a window, including undecodable ones.

    Args:
        view: of the call.
        topic: its name.
        window: of log time.
        edges: where pieces begin (ns), ascending; piece 0 is before the first edge.
        proves: whether messages themselves are read for their times: the index of a bag may lie.
    """
    size = len(edges) + 1
    counted = Counted(np.zeros(size, np.int64), np.full(size, MAX_NS), np.full(size, MIN_NS))
    # No bag alone shows which of repeated messages count.
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
        is_in_window = window.overlapping(firsts, lasts)
        must_be_read = _must_be_read(column, window, edges, shared_ends) | is_repeated
        is_known = is_in_window & ~must_be_read
        counted.add(pieces[is_known], messages[is_known], firsts[is_known], lasts[is_known])
        for row in np.flatnonzero(is_in_window & must_be_read).tolist():
            to_read.add(segment.bags[bags[row]].file)
            spans.append((int(firsts[row]), int(lasts[row]) + 1))
    for rows in scan(view, topic, window, columns=proves, shared=shared, within=united(spans)):
        for _, positions in rows.bag_rows(to_read):
            times = rows.times[positions]
            pieces = np.searchsorted(edges, times, side="right")
            counted.add(pieces, np.ones_like(times), times, times)
    return counted


def _must_be_read(
    column: TopicColumn, window: TimeWindow, edges: IntArray, shared_ends: Ints
) -> Mask:
    """Returns which rows are of bags that must be read: the index does not have their numbers.

    They lie in several pieces, or have times that recordings share. A bag that must be read for one
    type of the topic is read for all of its types. `shared_ends` has the starts and the stops of
    shared times, in order.
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
    """Counts the messages of a topic in a window, and picks `at_most` of them, evenly spaced.

    The first and the last are always picked. Each message is read when the iterator reaches it.
    """
    firsts, _ = view.bounds(topic, window)
    edges = np.unique(firsts)
    counts = count_messages(view, topic, window, edges, proves=True).messages
    ends = np.cumsum(counts)
    total = int(ends[-1])
    chosen = np.array(evenly(total, at_most), np.int64)
    opened = open_scan(view, topic, window)

    def read() -> Iterator[StoredMessage]:
        pieces = np.searchsorted(ends, chosen, side="right")
        bounds = [MIN_NS, *edges.tolist(), MAX_NS]
        for piece in np.unique(pieces).tolist():
            part = window.intersect(TimeWindow(bounds[piece], bounds[piece + 1]))
            in_piece = chosen[pieces == piece] - (ends[piece] - counts[piece])
            yield from _nth_messages(view, opened, part, in_piece)

    return total, read()


def _nth_messages(
    view: View, opened: Scan, part: TimeWindow, numbers: Ints
) -> Iterator[StoredMessage]:
    """Yields the messages of a part with these numbers, counted from 0 in log-time order."""
    tables = [
        rows.some(positions_in(rows.times, part)) for rows in _in_order([*opened.rows(among=part)])
    ]
    begins = np.cumsum([0, *map(len, tables)])
    times = concatenated(rows.times for rows in tables)
    order = np.argsort(times, kind="stable")
    for row in order[numbers[numbers < times.size]].tolist():  # a bag may be deleted since
        table = int(np.searchsorted(begins, row, side="right")) - 1
        yield from messages_of(view, tables[table].some(row - begins[table : table + 1]))
