"""The replies of several robots as one: pure, on JSON values.

Two ways. Where a reply is a list of rows along time, the rows of all robots become one list, newest
first, each with the name of its robot (`MERGED_ROWS`); what else the replies have is added up, kept
once where all agree, or listed by robot. Where a reply is about one robot as a whole, it becomes a
row itself (`SHORT_KEYS`).
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from functools import partial
from heapq import merge
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.core.reply import with_notes
from ros2_memory.core.text import listed, still_quoted
from ros2_memory.core.timebase import iso_local
from ros2_memory.results import (
    AnswerWithNotes,
    Before,
    Comparison,
    DataTimeRange,
    Recap,
    Sightings,
    Status,
    Things,
    Visits,
)
from ros2_memory.tools.reply_json import ROBOT_NAME
from ros2_memory.tools.reply_size import to_json_text

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from ros2_memory.core.model import JsonValue
    from ros2_memory.core.reply import JsonObject, Merging
    from ros2_memory.core.timebase import Ns
    from ros2_memory.fleet.robots import FromLake

_MOST_NAMED: Final = 8
"""Robots that a note names."""
_LEFT_OUT: Final = ("notes", "more", "local")
"""Keys that are merged otherwise, or that say nothing of several robots."""


@dataclass(frozen=True, slots=True)
class RobotReply:
    """What one robot answered.

    Attributes:
        name: of the robot.
        value: its reply, as a server of this robot alone would send it, before it is shortened.
        latest: the log time of its newest data; None if there is none.
        is_ahead: whether that lies in the future, so that its times say little beside others'.
        lake: what the reply has to report if the answer is from a lake.
    """

    name: str
    value: JsonValue
    latest: Ns | None = None
    is_ahead: bool = False
    lake: FromLake | None = None

    @property
    def body(self) -> JsonObject:
        """The reply as an object; an empty one where it is something else."""
        return self.value if isinstance(self.value, dict) else {}


class MergedRows(NamedTuple):
    """How the rows of a tool's replies become one list, as the class of the replies declares it.

    Attributes:
        rows: by the key of the rows, that of their time; a row whose time is null goes on.
        merging: of the other keys. Those that are added up are also listed by robot.
        marks_more: whether `more` says that rows are left out.
    """

    rows: Mapping[str, str]
    merging: Mapping[str, Merging] = MappingProxyType({})
    marks_more: bool = False

    @classmethod
    def declared(cls, answer: type[AnswerWithNotes]) -> MergedRows:
        """Returns what the keys of an answer say."""
        return cls(
            {key.name: key.row_time for key in answer.reply.all if key.row_time},
            {key.name: key.merging for key in answer.reply.all if key.merging},
            any(key.name == "more" for key in answer.reply.all),
        )


_TOTAL: Final = "total"
AT_LEAST: Final = "at_least"
"""How many there are in a reply that did not count all, in place of the total."""
MATCHES: Final = "matches"
TOPICS: Final = "topics"
MERGED_ROWS: Final[Mapping[str, MergedRows]] = {
    "find_last_match": MergedRows({MATCHES: "timestamp"}),
    "list_recorded_topics": MergedRows({TOPICS: "last_ts"}),
    "find_matches": MergedRows.declared(Sightings),
    "find_things": MergedRows.declared(Things),
    "visits": MergedRows.declared(Visits),
}
"""The tools whose rows are merged."""

SHORT_KEYS: Final[Mapping[str, tuple[str, ...]]] = {
    tool: tuple(key.name for answer in answers for key in answer.reply.short.keys)
    for tool, answers in (
        ("compare", (Comparison,)),
        ("recap", (Before, Recap)),
        ("memory_status", (Status,)),
        ("data_time_range", (DataTimeRange,)),
    )
}
"""The tools with a row for each robot, and what is left of it where the whole is too long."""

ANSWER_FOR_ALL: Final = frozenset({*MERGED_ROWS, *SHORT_KEYS})
"""The tools that answer for all robots."""

TABLE_FOR_ALL: Final = frozenset({"trajectory_summary", "recent_trajectory_summary"})
"""The tools that answer for all robots where they count (the argument `by`)."""


def merged(
    tool: str,
    replies: Sequence[RobotReply],
    failures: Mapping[str, str],
    *,
    limit: int | None = None,
    oldest_first: bool = False,
    max_chars: int,
) -> JsonObject:
    """Returns the reply of several robots to one question.

    Args:
        tool: one of `ANSWER_FOR_ALL`.
        replies: of the robots that answered.
        failures: for each other robot, why there is no answer.
        limit: how many rows are wanted, of all robots together.
        oldest_first: whether the rows are wanted in this order; each reply has it already.
        max_chars: where the reply would be longer, rows for each robot are given shortly.
    """
    order = sorted(replies, key=lambda each: (each.is_ahead, -(each.latest or 0), each.name))
    if any("columns" in each.body for each in order):
        reply = _one_table(order)
    elif tool == "list_recorded_topics":
        reply = {TOPICS: _by_topic(order)}
    elif tool in MERGED_ROWS:
        reply = _rows(MERGED_ROWS[tool], order, limit, oldest_first=oldest_first)
    else:
        return _robot_rows(tool, order, failures, max_chars)
    return with_notes(reply, [*_notes_of(order), *_notes_on(order, failures)])


def _rows(
    rule: MergedRows, replies: Sequence[RobotReply], limit: int | None, *, oldest_first: bool
) -> JsonObject:
    values = [_as_rows(each) for each in replies]
    key = next(
        (key for key in rule.rows for value in values if key in value), next(iter(rule.rows))
    )
    newest = partial(_time_of, rule.rows[key])
    order: Callable[[JsonObject], float] = newest if oldest_first else lambda row: -newest(row)
    found: list[JsonObject] = []
    for is_ahead in (False, True):
        # Each reply is in order. A robot whose clock is ahead does not have the newest row.
        lists = [
            [_named_row(rule, each.name, value, row) for row in _list(value.get(key))]
            for each, value in zip(replies, values, strict=True)
            if each.is_ahead is is_ahead
        ]
        found += merge(*lists, key=order)
    reply: JsonObject = {key: [*found[:limit]]}
    if key == MATCHES:
        if never := [each.name for each in replies if each.value is None]:
            reply["never"] = [*never]
        return reply
    inherited = {name for name, how in rule.merging.items() if how == "inherited"}
    reply |= _rest(rule, replies, [_without(value, {key, *inherited}) for value in values])
    is_cut = len(found) > len(found[:limit])
    if rule.marks_more and (is_cut or any(value.get("more") for value in values)):
        reply["more"] = True
    return reply


def _as_rows(reply: RobotReply) -> JsonObject:
    """Returns a reply as an object with a list of rows: one that is a row itself becomes a list."""
    value = reply.value
    if value is None:
        return {MATCHES: []}
    if isinstance(value, dict) and "timestamp" in value:
        return {MATCHES: [] if value["timestamp"] is None else [_without(value, {"notes"})]}
    return reply.body


def _named_row(rule: MergedRows, name: str, reply: JsonObject, row: JsonObject) -> JsonObject:
    taken = {
        key: reply[key]
        for key, how in rule.merging.items()
        if how == "inherited" and key in reply and key not in row
    }
    return {ROBOT_NAME: name, **row, **taken}


def _rest(
    rule: MergedRows, replies: Sequence[RobotReply], values: Sequence[JsonObject]
) -> JsonObject:
    """Returns what the replies have besides rows, and what of it is not the same for all."""
    reply: JsonObject = {}
    by_robot: dict[str, JsonValue] = {}
    for key in dict.fromkeys(key for value in values for key in value):
        if key in _LEFT_OUT:
            continue
        each = {
            one.name: value[key] for one, value in zip(replies, values, strict=True) if key in value
        }
        how = rule.merging.get(key)
        if how == "who":
            reply[key] = [name for name, is_so in each.items() if is_so]
        elif how == "counted":
            reply[key] = _added(each.values())
        elif how in {"earliest", "newest"}:
            numbers = [
                _number(each[one.name]) for one in _dated(replies) if each.get(one.name) is not None
            ]
            best = min if how == "earliest" else max
            reply[key] = best(numbers, default=None)
        elif how == "added" or key == AT_LEAST:
            reply |= _summed(key, each.values(), values)
            _add(by_robot, key, each)
        elif len(each) == len(replies) and len({to_json_text(one) for one in each.values()}) == 1:
            reply[key] = next(iter(each.values()))
        else:
            _add(by_robot, key, each)
    if by_robot:
        reply["by_robot"] = by_robot
    return reply


def _dated(replies: Sequence[RobotReply]) -> list[RobotReply]:
    """Returns the replies whose times can be compared; all of them where none can."""
    return [each for each in replies if not each.is_ahead] or [*replies]


def _summed(key: str, own: Iterable[JsonValue], values: Sequence[JsonObject]) -> JsonObject:
    """Returns a key with its sum; no total where a robot has not counted all, but at least."""
    if key == _TOTAL and any(AT_LEAST in value for value in values):
        return {}
    others = (value.get(_TOTAL) for value in values) if key == AT_LEAST else ()
    numbers = [each for each in (*own, *others) if isinstance(each, int | float)]
    return {key: round(sum(numbers), 2)}


def _add(by_robot: dict[str, JsonValue], key: str, values: Mapping[str, JsonValue]) -> None:
    for name, value in values.items():
        row = by_robot.setdefault(name, {})
        if isinstance(row, dict):
            row[key] = value


def _added(objects: Iterable[JsonValue]) -> JsonObject:
    sums: Counter[str] = Counter()
    for each in objects:
        for key, count in each.items() if isinstance(each, dict) else ():
            sums[key] += count if isinstance(count, int) else 0
    return dict(sums.most_common())


def _by_topic(replies: Sequence[RobotReply]) -> list[JsonValue]:
    """Returns a row for each topic of a type, with the names of the robots that record it."""
    topics: dict[tuple[str, str], JsonObject] = {}
    for each in replies:  # those whose clock ran ahead come last
        for row in _list(each.value):
            key = str(row["topic"]), str(row["type"])
            known = topics.setdefault(key, {**row, "count": 0, f"{ROBOT_NAME}s": []})
            for time, best in (("first_ts", min), ("last_ts", max)):
                if not each.is_ahead:
                    known[time] = best(_number(known[time]), _number(row[time]))
            known["count"] = int(_number(known["count"]) + _number(row["count"]))
            names = known[f"{ROBOT_NAME}s"]
            if isinstance(names, list):
                names.append(each.name)
    return [*sorted(topics.values(), key=lambda row: (-_number(row["last_ts"]), str(row["topic"])))]


def _one_table(replies: Sequence[RobotReply]) -> JsonObject:
    """Returns the tables of robots as one, whose first column is the robot.

    A column that one of them lacks is null there.
    """
    headers = [[str(name) for name in _items(each.body, "columns")] for each in replies]
    columns = [*dict.fromkeys(name for own in headers for name in own)]
    rows: list[JsonValue] = []
    every: JsonObject = {}
    for each, own in zip(replies, headers, strict=True):
        for row in _items(each.body, "rows"):
            cells = dict(zip(own, row if isinstance(row, list) else (), strict=True))
            rows.append([each.name, *(cells.get(name) for name in columns)])
        if total := _items(each.body, "all"):
            cells = dict(zip(own[1:], total, strict=True))
            every[each.name] = [cells.get(name) for name in columns[1:]]
    rest = [_without(each.body, {"columns", "rows", "all"}) for each in replies]
    table: JsonObject = {"columns": [ROBOT_NAME, *columns], "rows": rows, "all": every}
    return table | _rest(MergedRows({}), replies, rest)


def _robot_rows(
    tool: str, replies: Sequence[RobotReply], failures: Mapping[str, str], max_chars: int
) -> JsonObject:
    """Returns a row for each robot; shortly where they would be too long otherwise."""
    whole: list[JsonObject] = [{ROBOT_NAME: each.name, **each.body} for each in replies]
    notes = _notes_on(replies, failures)
    reply = with_notes({"robots": [*whole]}, notes)
    if len(to_json_text(reply)) <= max_chars:
        return reply
    keys = dict.fromkeys((ROBOT_NAME, "now", *SHORT_KEYS[tool]))
    short = [{key: row[key] for key in keys if key in row} for row in whole]
    return with_notes(
        {"robots": [*short]}, ["each robot shortly; pass robot for all of it", *notes]
    )


def by_reason(said: Iterable[tuple[str, str]]) -> dict[str, list[str]]:
    """Returns the names of robots by reason, from pairs of a name and a reason."""
    found: dict[str, list[str]] = {}
    for name, reason in said:
        found.setdefault(reason, []).append(name)
    return found


def _notes_of(replies: Sequence[RobotReply]) -> list[str]:
    """Returns the notes of the replies, each with the names of its robots."""
    # `str(note)` would lose that it is quoted.
    said = [
        (each.name, note)
        for each in replies
        for note in _items(each.body, "notes")
        if isinstance(note, str)
    ]
    return [_of_robots(names, note) for note, names in by_reason(said).items()]


def _of_robots(names: Sequence[str], note: str) -> str:
    return still_quoted(f"{listed(names, at_most=_MOST_NAMED)}: {note}", note)


def _notes_on(replies: Sequence[RobotReply], failures: Mapping[str, str]) -> list[str]:
    """Returns what is to be known of robots: who did not answer and why, whose clock is ahead."""
    notes = [
        still_quoted(f"no answer of {_of_robots(names, reason)}", reason)
        for reason, names in by_reason(failures.items()).items()
    ]
    of_lake = {each.name: each.lake for each in replies if each.lake is not None}
    said = ((name, note) for name, lake in of_lake.items() for note in lake.notes)
    notes += [_of_robots(names, note) for note, names in by_reason(said).items()]
    notes += shipped_to({name: lake.latest for name, lake in of_lake.items()})
    if ahead := [each.name for each in replies if each.is_ahead]:
        notes.append(
            f"{listed(ahead, at_most=_MOST_NAMED)}: dated in the future by a clock that ran ahead, "
            "so listed last: their times cannot be compared with others'"
        )
    return notes


def shipped_to(latest: Mapping[str, Ns | None]) -> list[str]:
    """Returns the note on answers from a lake: up to when each robot's bags were shipped."""
    if not latest:
        return []
    order = sorted(latest, key=lambda name: latest[name] or 0)
    parts = [f"{name} up to {_moment(latest[name])}" for name in order[:_MOST_NAMED]]
    if order[_MOST_NAMED:]:
        parts.append(f"{len(order) - _MOST_NAMED} others up to later")
    return [f"from the lake, which has what was shipped: {', '.join(parts)}"]


def _moment(time: Ns | None) -> str:
    return "no time" if time is None else iso_local(time) or str(time)


def _without(value: JsonObject, keys: set[str]) -> JsonObject:
    return {key: item for key, item in value.items() if key not in keys}


def _items(reply: JsonObject, key: str) -> list[JsonValue]:
    found = reply.get(key)
    return found if isinstance(found, list) else []


def _list(value: JsonValue) -> list[JsonObject]:
    return [row for row in value if isinstance(row, dict)] if isinstance(value, list) else []


def _number(value: JsonValue) -> float:
    return value if isinstance(value, int | float) else 0


def _time_of(key: str, row: JsonObject) -> float:
    """Returns the time of a row; infinite where it is not over."""
    value = row.get(key)
    return math.inf if value is None and key in row else _number(value)
