"""The condition of a question, of which units and constants are checked before it is searched."""

from __future__ import annotations

from bisect import bisect_left
from contextlib import suppress
from dataclasses import replace
from itertools import chain
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.analysis.conditions import Beyond, Condition, parse_condition
from ros2_memory.analysis.facts import BATTERY, FULL_CHARGE
from ros2_memory.core.errors import InvalidArgumentsError, QueryTimeoutError
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.history.condition_hints import constant_number
from ros2_memory.history.coverage import unix_text
from ros2_memory.history.held_values import NUMBERS
from ros2_memory.history.no_data import matching_topics
from ros2_memory.history.reverse_search import ReverseSearch
from ros2_memory.messages.levels import level_number, level_path, unknown_name_hint

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.history.bag_access import StoredMessage
    from ros2_memory.history.view import View

_FRACTIONS: Final = frozenset({"percentage", "relative_humidity"})
"""Fields that are fractions by the definitions of their messages."""
_OF_NUMBERS: Final = frozenset({"above", "below"})
_FIX_FIELDS: Final = frozenset({"latitude", "longitude", "altitude"})


class Sought(NamedTuple):
    """What a question searches for: a condition as it was asked.

    Attributes:
        topic: name or glob of the topics.
        condition_type: such as "equals".
        value: what is compared.
        field: dot-path; may be a full path in the messages. Not needed for equal levels, or if
            each message is a number.
        min_score: least score of detections; None for the configured one.
    """

    topic: str
    condition_type: str
    value: JsonValue
    field: str | None = None
    min_score: float | None = None


def condition_of(view: View, sought: Sought) -> Condition:
    """Returns the condition of a question.

    The value may be the name of a constant of the message definition if the field is a number; if
    all topics have one type, also that of a level (WARN) of a log or status.

    Raises:
        NoDataError: no such topic is recorded.
        InvalidArgumentsError: it is no condition.
    """
    limits = view.limits
    pattern, condition_type, value, field, min_score = sought
    least = limits.min_score if min_score is None else min_score
    types = types_matching(view, pattern)
    type_name = next(iter(types)) if len(types) == 1 else ""
    if not field and condition_type == "equals":
        field = level_path(value, type_name)
    elif not field and types and all(map(is_number, types)):
        # A message that is one number has no other that could be meant.
        field = "data" if condition_type in _OF_NUMBERS else None
    field = field and field.strip()
    if field and type_name:
        field = view.extractor.own_path(field, type_name)
        value = level_number(value, field, type_name)
    numbers = {name: constant_number(view, value, field, name) for name in sorted(types) if field}
    if len({*map(repr, numbers.values())}) == 1:
        [value, *_] = numbers.values()
    try:
        condition = parse_condition(
            condition_type, value, limits.position_tolerance_m, field, least
        )
    except InvalidArgumentsError as error:
        hint = unknown_name_hint(value, field, types)
        raise InvalidArgumentsError(f"{error}{hint}") from error
    _require_fraction(view, pattern, condition)
    named = [
        (name, parse_condition(condition_type, number, limits.position_tolerance_m, field).test)
        for name, number in numbers.items()
        if number != value
    ]
    return replace(condition, tests_by_type=tuple(named))


def is_number(type_name: str) -> bool:
    """Returns whether each message of a type is one number."""
    return type_name.startswith(NUMBERS) and not type_name.endswith("Array")


def types_matching(view: View, pattern: str) -> frozenset[str]:
    """Returns the types of the topics that a name or glob matches."""
    topics = matching_topics(view, pattern)
    return frozenset(chain.from_iterable(map(view.timeline.types_of, topics)))


def _require_fraction(view: View, pattern: str, condition: Condition) -> None:
    """Checks that fractions are not compared with percent: no message, or each, would match.

    sensor_msgs/BatteryState and RelativeHumidity ask for fractions, but some drivers publish
    percent, or no charge. Notes say where a battery has stated both, and that a limit below 1 is
    one in percent. Nothing is refused or noted if there is no time to look at all messages.

    Raises:
        InvalidArgumentsError: the limit is in percent, and all numbers are fractions.
    """
    test, field = condition.test, condition.field
    if field not in _FRACTIONS or not isinstance(test, Beyond):
        return
    brief = view.brief()
    with suppress(QueryTimeoutError):
        if newest_above(brief, pattern, field, FULL_CHARGE) is not None:
            batteries = [
                topic
                for topic in matching_topics(brief, pattern)
                if BATTERY in view.timeline.types_of(topic)
            ]
            mixed = [note for topic in batteries for note in _mixed_charges(brief, topic)]
            is_low = 0 < test.limit < FULL_CHARGE and not mixed
            percent = f"{field} is percent here: {test.limit:g} is {test.limit:g} %"
            view.notes.add(*mixed, *([percent] if is_low else []))
            return
        newest = newest_above(brief, pattern, field, 0) if test.limit > FULL_CHARGE else None
        value = None if newest is None else brief.value(newest)
        if isinstance(value, dict) and isinstance(value.get(field), float):
            raise InvalidArgumentsError(
                f"value: {field} is a fraction here, from 0 to 1: "
                f"{test.limit:g} % is {test.limit / 100:g}"
            )


def newest_above(
    view: View, pattern: str, field: str, limit: float, window: TimeWindow | None = None
) -> StoredMessage | None:
    """Returns the newest message (of a window) with a number above a limit in a field."""
    search = ReverseSearch(view, pattern, Condition(Beyond(limit, above=True), field))
    asked = window or TimeWindow.everything()
    return search.newest(asked.stop, asked.start)


def _mixed_charges(view: View, topic: str) -> tuple[str, ...]:
    """Returns a note if a battery states fractions in its first recordings, then percent.

    Or the reverse, as after an update of its driver.
    """
    spans = sorted(view.timeline.recordings(topic).values())

    def is_percent(nth: int) -> bool:
        first, last = spans[nth]
        recorded = TimeWindow(first, last + 1)
        return newest_above(view, topic, "percentage", FULL_CHARGE, recorded) is not None

    was_percent = is_percent(0)
    if was_percent == is_percent(-1):
        return ()
    nth = bisect_left(range(len(spans)), True, key=lambda nth: is_percent(nth) != was_percent)
    (_, until), (since, _) = spans[nth - 1], spans[nth]
    was, now = "a fraction, from 0 to 1,", "percent"
    if was_percent:
        was, now = "percent", "a fraction, from 0 to 1,"
    switch = f"{was} until {unix_text(until)} and {now} from {unix_text(since)} on"
    return (f"percentage of {topic} is {switch}: ask about each time with a limit of its own",)


def note_no_fix(view: View, topic: str, window: TimeWindow, fields: Sequence[str]) -> None:
    """Notes if numbers of a satellite receiver in a window are from messages without a fix."""
    types = view.timeline.types_of(topic)
    mapped = set(chain.from_iterable(map(view.extractor.fields_of, types)))
    if "fix_status" not in mapped or not _FIX_FIELDS.intersection(fields):
        return
    no_fix = Condition(Beyond(0, above=False), "fix_status")
    newest = None
    with suppress(QueryTimeoutError):
        newest = ReverseSearch(view, topic, no_fix).newest(window.stop, window.start)
    if newest is not None:
        view.notes.add(
            f"until {unix_text(newest.time)} some messages have no fix (fix_status -1): their "
            "latitude, longitude and altitude are not its position, but count here"
        )
