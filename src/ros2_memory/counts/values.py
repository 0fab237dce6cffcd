"""How often and how long a topic held each value, until a message said otherwise."""

from __future__ import annotations

import json
from collections import defaultdict
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.core.errors import InvalidArgumentsError, QueryTimeoutError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import Spans, united, without
from ros2_memory.core.text import Quoted, counted, shortened
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns
from ros2_memory.counts.bins import HELD_COLUMNS
from ros2_memory.history.clock_steps import elapsed_in
from ros2_memory.history.coverage import (
    note_edges,
    note_unread,
    recording_gaps,
    shown_span,
    unix_text,
)
from ros2_memory.history.held_values import Held, HeldValues
from ros2_memory.history.no_data import no_data_between
from ros2_memory.history.robots import note_robots
from ros2_memory.results import Bins

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.analysis.clock_steps import Elapsed
    from ros2_memory.analysis.conditions import Condition
    from ros2_memory.history.view import View

_MOST_VALUES: Final = 100
_LONGEST_NAME: Final = 120
"""Characters of a value that its row shows."""


class _ValueRow(NamedTuple):
    """The values of `HELD_COLUMNS` for one value of the topic."""

    occurrences: int
    length: Ns
    first: Ns
    last: Ns


def count_values(
    view: View,
    topic: str,
    asked: TimeWindow,
    *,
    fields: Sequence[str],
    condition: Condition | None = None,
) -> Bins:
    """Returns a row for each value that held in a window, the one that held longest first.

    Time outside of the window and in gaps of the recording does not count. An empty text is no
    value.

    Args:
        view: the view of this call.
        topic: the name of the topic.
        asked: the window.
        fields: the field that has the value; none for the whole message.
        condition: a condition on field `value` that values must meet; None counts all.

    Raises:
        InvalidArgumentsError: more than one field is named, or there is no single value.
        NoDataError: the topic said nothing in the window.
        QueryTimeoutError: the call's time runs out before any result.
    """
    if len(fields) > 1:
        raise InvalidArgumentsError("by value counts one field: name one in fields")
    values = HeldValues(view, topic, *fields, asked="by value", until=asked.stop)
    start, end = shown_span(view.snapshot, asked)
    stop = end + 1
    try:
        held_values = values.during(start, stop)
    except QueryTimeoutError as error:
        held_values = values.known[::-1]
        if not held_values:
            raise
        start = values.reached
        view.notes.add_lack(f"only what is after {unix_text(start)} is counted: {error}")
    if not held_values:
        raise no_data_between(view, (topic,), asked)
    outside = [(MIN_NS, start), *recording_gaps(view, TimeWindow(start, stop)), (stop, MAX_NS)]
    named_rows = _value_rows(held_values, elapsed_in(view, asked), united(outside), condition)
    if len(named_rows) > _MOST_VALUES:
        more = counted(len(named_rows) - _MOST_VALUES, "value")
        view.notes.add(f"{more} that held for a shorter time are left out; all counts them, too")
    note_unread(view, asked)
    note_edges(view, asked)
    note_robots(view, topic, asked)
    rows = [row for _, row in named_rows]
    return Bins(
        by="value",
        about=(topic,),
        start=start,
        end=stop - 1,
        columns=HELD_COLUMNS,
        rows=tuple(named_rows[:_MOST_VALUES]),
        all=(
            sum(row.occurrences for row in rows),
            sum(row.length for row in rows),
            min((row.first for row in rows), default=None),
            max((row.last for row in rows), default=None),
        ),
        notes=view.notes.sentences(),
    )


def _value_rows(
    held_values: Sequence[Held], elapsed: Elapsed, outside: Spans, condition: Condition | None
) -> list[tuple[str, _ValueRow]]:
    """Returns each value that counts with its row, the one that held longest first.

    Time that lies in the spans `outside` adds nothing to a length.
    """
    by_word: defaultdict[str, list[Held]] = defaultdict(list)
    for held in held_values:
        by_word[held.word].append(held)
    rows = []
    for times in by_word.values():
        first, last = times[0], times[-1]
        if first.is_blank or (condition and not condition.matches({"value": first.exact})):
            continue
        text = first.value if isinstance(first.value, str) else json.dumps(first.value)
        length = elapsed.among(without([(held.start, held.stop) for held in times], outside))
        row = _ValueRow(len(times), length, first.start, last.stop)
        rows.append((Quoted(shortened(text, _LONGEST_NAME)), row))
    return sorted(rows, key=lambda named_row: (-named_row[1].length, named_row[1].first))
