"""The events of one topic in a window, from what its messages state."""

from __future__ import annotations

from heapq import merge
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.facts import Stated, joined_stated, state_of, stated_by
from ros2_memory.analysis.topic_events import (
    Change,
    KnownState,
    TopicEvents,
    events_of,
    joined_events,
)
from ros2_memory.columns.decode import decoded
from ros2_memory.columns.fragments import FragmentKey
from ros2_memory.columns.kinds import EVENTS
from ros2_memory.columns.stated import StatedColumns
from ros2_memory.columns.units import BagUnit, Rows
from ros2_memory.columns.writing import PART_NS
from ros2_memory.core.text import Reason, counted
from ros2_memory.history.context import Note
from ros2_memory.history.scan import (
    blocks,
    joined_back,
    messages_of,
    of_columns,
    open_scan,
    remembered,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from ros2_memory.columns.scan import Stretch
    from ros2_memory.core.model import BagFile, TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.history.view import View

_UNDECODED: Final = Reason("could not be decoded, so their content is missing", "topic")


def flag_name(topic: str, flag: KnownState | Change) -> str:
    """Returns how a boolean of a topic is called."""
    return topic if flag.name == "value" else f"{topic} {flag.name}"


def toggled(topic: str, toggle: Change) -> str:
    """Returns a sentence for a boolean of a topic that toggled."""
    return f"{flag_name(topic, toggle)} became {'true' if toggle.value else 'false'}"


def events_in(view: View, topic: str, window: TimeWindow) -> TopicEvents | None:
    """Returns what the messages of a topic report in a window; None where there is no message.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
    return joined_events([*events_back(view, topic, window)][::-1])


def events_back(
    view: View,
    topic: str,
    window: TimeWindow,
    *,
    reached: Callable[[Ns], None] = lambda _: None,
) -> Iterator[TopicEvents]:
    """Yields the events in times that do not overlap, the newest first.

    `reached` is called before each table, as by `scan`.

    Raises:
        QueryTimeoutError: while it is iterated, when the deadline has passed.
    """
    return (events for _, events in _timed_events_back(view, topic, window, reached))


def _timed_events_back(
    view: View, topic: str, window: TimeWindow, reached: Callable[[Ns], None] = lambda _: None
) -> Iterator[tuple[Ns, TopicEvents]]:
    """Yields as `events_back`, each with a log time (ns) that none of it is earlier than."""
    columns = StatedColumns(view.extractor)
    opened = open_scan(view, topic, window, stored=view.call.stored, reached=reached)

    def make(stretch: Stretch) -> Iterator[tuple[Ns, TopicEvents]]:
        rows = opened.rows(newest_first=True, among=stretch.window)
        for overlapping in blocks(rows, newest_first=True):
            first = max(min(rows.first for rows in overlapping), window.start)
            is_whole = all(rows.part is not None for rows in overlapping)
            is_wanted = is_whole or stretch.parts is not None or not view.call.stored
            if stretch.window.contains(first) and is_wanted:
                yield first, _events_of_tables(view, columns, overlapping)

    return joined_back(view, opened, EVENTS, make)


def events_made(view: View, window: TimeWindow, topics: Iterable[str]) -> Iterator[Ns]:
    """Makes the events of the parts of some topics in a window, the newest first.

    Yields a log time (ns) of each.

    Raises:
        QueryTimeoutError: while it is iterated, when the deadline has passed.
    """
    # The parts that lie across a bound of the window are made, too.
    of_topics = [_timed_events_back(view, topic, window.widened(PART_NS)) for topic in topics]
    yield from merge(*((at for at, _ in timed) for timed in of_topics), reverse=True)


def events_of_messages(view: View, messages: Iterable[StoredMessage]) -> TopicEvents | None:
    """Returns what messages of one topic report; None without any."""
    return events_of(_stated_in_messages(view, messages))


def events_of_bag(view: View, bag: BagFile, topics: Sequence[str]) -> dict[str, TopicEvents]:
    """Returns the events of those topics that have a message in a bag, read at once.

    Raises:
        BagError: the bag cannot be read.
    """
    reader, columns = view.memory.reader, StatedColumns(view.extractor)
    stated_of_topics: dict[str, list[Stated]] = {}
    for tables in decoded(reader, bag.path, topics=topics) if topics else ():
        for nth, table in enumerate(tables):
            rows = Rows(BagUnit(bag, table, nth), lambda: None)
            stated = _stated_in_rows(view, columns, rows)
            stated_of_topics.setdefault(table.channel.topic, []).append(stated)
    return {
        topic: events
        for topic, parts in stated_of_topics.items()
        if (events := events_of(joined_stated(parts))) is not None
    }


def _events_of_tables(view: View, columns: StatedColumns, together: list[Rows]) -> TopicEvents:
    """Returns the events of tables that overlap in time; those of whole parts are remembered."""

    def make() -> TopicEvents:
        stated = joined_stated([_stated_in_rows(view, columns, rows) for rows in together])
        return events_of(stated) or TopicEvents(1, 0)

    parts = tuple(rows.part for rows in together if rows.part is not None)
    key = FragmentKey(together[0].first, "", parts) if len(parts) == len(together) else None
    return remembered(view, EVENTS, key, make)


def _stated_in_rows(view: View, columns: StatedColumns, rows: Rows) -> Stated:
    """Returns what the messages of some rows state: by their columns, else by reading them."""
    states = of_columns(view, rows, lambda counting: _stated_by_columns(view, columns, counting))
    if states is None:
        return _stated_in_messages(view, messages_of(view, rows))
    return joined_stated(states)


def _stated_by_columns(view: View, columns: StatedColumns, rows: Rows) -> Stated | None:
    """Returns what the messages of some rows state; None where all of them have to be read."""
    of_table = columns.of(rows.table)
    if of_table is None:
        return None
    counting = of_table.stated if rows.index is None else of_table.stated.at(rows.index)
    stated = counting._replace(times=rows.times)
    to_read = of_table.to_read(rows.index)
    if not to_read.size:
        return stated
    others = np.setdiff1d(np.arange(len(rows)), to_read)
    read = _stated_in_messages(view, messages_of(view, rows.some(to_read)))
    return joined_stated([stated.at(others), read])


def _stated_in_messages(view: View, messages: Iterable[StoredMessage]) -> Stated:
    """Returns what messages state, in order of log time; nothing of one that is undecodable."""
    states = []
    for message in messages:
        value = view.value(message)
        states.append((message.time, None if value is None else state_of(value, message.type)))
    # Those of a part come bag after bag, in the order in which bags were stored.
    states.sort(key=lambda timed_state: timed_state[0])
    return stated_by([time for time, _ in states], [state for _, state in states])


def note_limits(view: View, topic: str, events: TopicEvents) -> None:
    """Adds notes on events of a topic that are left out: too many, or undecodable."""
    if events.undecodable:
        messages = counted(events.undecodable, "message")
        view.notes.add(Note(_UNDECODED, f"{messages} of {topic}"))
    note_left_out(view, topic, events)


def note_left_out(view: View, topic: str, events: TopicEvents) -> None:
    """Adds notes on events of a topic that are too many."""
    if events.left_out:
        view.notes.add(f"{topic} changes too often to list each change: {events.left_out} more")
    if events.beyond:
        view.notes.add(
            f"{topic} has too many booleans or things in one message: {events.beyond} more are "
            "not followed"
        )
