"""How often and how long a topic held each of its values."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from ros2_memory.core.errors import InvalidArgumentsError, QueryTimeoutError
from ros2_memory.core.text import Quoted, counted, shortened
from ros2_memory.history.clock_steps import elapsed_in
from ros2_memory.history.coverage import note_edges, note_unread, recorded_reach, unix_text
from ros2_memory.history.held_values import Held, HeldValues
from ros2_memory.history.no_data import no_data_between
from ros2_memory.history.robots import note_robots
from ros2_memory.results import Bins

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.analysis.conditions import Condition
    from ros2_memory.core.model import TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.view import View

_MOST_VALUES: Final = 100
_LONGEST_VALUE: Final = 120


@dataclass(slots=True)
class _Tally:
    """How often and how long (ns) a value held, when it first began, and when it last ended."""

    name: str
    count: int
    length: Ns
    first: Ns
    last: Ns


def count_values(
    view: View,
    topic: str,
    asked: TimeWindow,
    *,
    fields: Sequence[str] = (),
    condition: Condition | None = None,
) -> Bins:
    """Returns a row for each value that held at some time of a window, that of the longest first.

    What lies outside of the window counts to no length. An empty text is no value.

    Args:
        view: the call's.
        topic: its name.
        asked: the window.
        fields: the field of the messages that is meant, if it is not all that they have.
        condition: what values have to meet, if there is one.

    Raises:
        InvalidArgumentsError: more than one field is named, or there is no single value.
        NoDataError: the topic said nothing in the window.
        QueryTimeoutError: the call's time runs out before any result.
    """
    if len(fields) > 1:
        raise InvalidArgumentsError("by value counts one field: name one in fields")
    values = HeldValues(view, topic, *fields, asked="by value")
    start, end = asked.asked()
    first, last = recorded_reach(view.snapshot, asked) or (start, end)
    start, stop = max(start, first), min(end, last) + 1
    held: list[Held] = []
    try:
        held += values.during(start, stop)
    except QueryTimeoutError as error:
        # What is newer is known all the same.
        held += values.known[::-1]
        if not held:
            raise
        start = values.reached
        view.notes.add_lack(f"{error}: only what is after {unix_text(start)} is counted")
    if not held:
        raise no_data_between(view, (topic,), asked)
    tallies = _tallied(view, held, asked, (start, stop), condition)
    rows = sorted(tallies, key=lambda each: (-each.length, each.first))
    if len(rows) > _MOST_VALUES:
        more = counted(len(rows) - _MOST_VALUES, "value")
        view.notes.add(f"{more} that held for a shorter time are left out; all counts them, too")
    note_unread(view, asked)
    note_edges(view, asked)
    note_robots(view, topic, asked)
    return Bins(
        by="value",
        about=(topic,),
        start=start,
        end=stop - 1,
        columns=(("count", "count"), ("seconds", "duration"), ("first", "time"), ("last", "time")),
        rows=tuple(
            (each.name, (each.count, each.length, each.first, each.last))
            for each in rows[:_MOST_VALUES]
        ),
        all=(
            sum(each.count for each in rows),
            sum(each.length for each in rows),
            min((each.first for each in rows), default=None),
            max((each.last for each in rows), default=None),
        ),
        notes=view.notes.sentences(),
    )


def _tallied(
    view: View,
    held: Sequence[Held],
    asked: TimeWindow,
    window: tuple[Ns, Ns],
    condition: Condition | None,
) -> list[_Tally]:
    found: dict[str, _Tally | None] = {}
    elapsed = elapsed_in(view, asked)
    for each in held:
        if each.word not in found:
            counts = condition is None or condition.matches({"value": each.exact})
            found[each.word] = (
                None
                if each.is_blank or not counts
                else _Tally(_name(each), 0, 0, each.start, each.stop)
            )
        tally = found[each.word]
        if tally is not None:
            tally.count += 1
            tally.length += elapsed.between(max(each.start, window[0]), min(each.stop, window[1]))
            tally.last = each.stop
    return [each for each in found.values() if each is not None]


def _name(held: Held) -> str:
    value = held.value
    name = value if isinstance(value, str) else json.dumps(value)
    return Quoted(shortened(name, _LONGEST_VALUE))
