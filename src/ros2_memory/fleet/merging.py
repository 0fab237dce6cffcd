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
from heapq import merge
from typing import TYPE_CHECKING, Final

from ros2_memory.core.errors import BagError, EpisodicError, QueryTimeoutError
from ros2_memory.core.reply import PLAIN, JsonObject, Key, Merging, with_notes
from ros2_memory.core.text import listed, still_quoted
from ros2_memory.core.timebase import Ns, iso_local, unix_rounded_up
from ros2_memory.results import (
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
    from collections.abc import Iterable, Mapping, Sequence

    from ros2_memory.core.model import JsonValue
    from ros2_memory.fleet.robots import FromLake

_MOST_NAMED: Final = 8
"""Robots that a note names."""
_LEFT_OUT: Final = ("notes", "more", "local")
"""Keys that are merged otherwise, or that say nothing of several robots."""
FAILED: Final = "robots_failed"
"""The key of the robots without an answer: for each the code of its error, whose note says more."""


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


_TOTAL: Final = "total"
AT_LEAST: Final = "at_least"
"""How many there are in a reply that did not count all, in place of the total."""
MATCHES: Final = "matches"
TOPICS: Final = "topics"
MERGED_ROWS: Final[Mapping[str, Sequence[Key]]] = {
    "find_last_match": (PLAIN(MATCHES).along("timestamp"),),
    "list_recorded_topics": (PLAIN(TOPICS).along("last_ts"),),
    "find_matches": Sightings.reply.all,
    "find_things": Things.reply.all,
    "visits": Visits.reply.all,
}
"""The tools whose rows are merged, and the keys of their replies, which declare how."""

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
    failures: Mapping[str, EpisodicError],
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
    order = sorted(replies, key=lambda reply: (reply.is_ahead, -(reply.latest or 0), reply.name))
    codes: JsonObject = {name: error.code for name, error in failures.items()}
    failed: JsonObject = {FAILED: codes} if codes else {}
    notes = _notes_on(order, failures)
    if any("columns" in reply.body for reply in order):
        found = _one_table(order)
    elif tool == "list_recorded_topics":
        found = {TOPICS: _by_topic(order)}
    elif tool in MERGED_ROWS:
        found = _rows(MERGED_ROWS[tool], order, limit, oldest_first=oldest_first)
    else:
        whole: list[JsonObject] = [{ROBOT_NAME: reply.name, **reply.body} for reply in order]
        found = with_notes({"robots": [*whole], **failed}, notes)
        if len(to_json_text(found)) <= max_chars:
            return found
        keys = dict.fromkeys((ROBOT_NAME, "now", *SHORT_KEYS[tool]))
        short = [{key: row[key] for key in keys if key in row} for row in whole]
        do = "each robot shortly; pass robot for all of it"
        return with_notes({"robots": [*short], **failed}, [do, *notes])
    own = by_reason(
        (reply.name, note)
        for reply in order
        # `str(note)` would lose that it is quoted.
        for note in _items(reply.body, "notes")
        if isinstance(note, str)
    )
    return with_notes({**found, **failed}, [*map(_of_robots, own.values(), own), *notes])


def _rows(
    declared: Sequence[Key], replies: Sequence[RobotReply], limit: int | None, *, oldest_first: bool
) -> JsonObject:
    values = {reply.name: _as_rows(reply) for reply in replies}
    times = {key.name: key.row_time for key in declared if key.row_time}
    there = [key for key in times if any(key in value for value in values.values())]
    key = (there or [*times])[0]
    time_key, merging = times[key], {key.name: key.merging for key in declared if key.merging}

    def order(row: JsonObject) -> float:
        # A row whose time is null goes on.
        time = math.inf if row.get(time_key, 0) is None else _number(row.get(time_key))
        return time if oldest_first else -time

    names = {name for name, how in merging.items() if how == "inherited"}
    inherited = {robot: _without(value, value.keys() - names) for robot, value in values.items()}
    found: list[JsonObject] = []
    for is_ahead in (False, True):
        # Each reply is in order. A robot whose clock is ahead does not have the newest row.
        lists = [
            [
                {ROBOT_NAME: reply.name, **inherited[reply.name], **row}
                for row in _list(values[reply.name].get(key))
            ]
            for reply in replies
            if reply.is_ahead is is_ahead
        ]
        found += merge(*lists, key=order)
    rows: JsonObject = {key: [*found[:limit]]}
    if key == MATCHES:
        never = [reply.name for reply in replies if reply.value is None]
        return {**rows, "never": [*never]} if never else rows
    rest = {name: _without(value, {key, *names}) for name, value in values.items()}
    is_cut = len(found) > len(found[:limit]) or any(value.get("more") for value in values.values())
    marks_more = is_cut and any(key.name == "more" for key in declared)
    return {**rows, **_rest(merging, replies, rest), **({"more": True} if marks_more else {})}


def _as_rows(reply: RobotReply) -> JsonObject:
    """Returns a reply as an object with a list of rows: one that is a row itself becomes a list."""
    value = reply.value
    if value is None:
        return {MATCHES: []}
    if isinstance(value, dict) and "timestamp" in value:
        return {MATCHES: [] if value["timestamp"] is None else [_without(value, {"notes"})]}
    return reply.body


def _rest(
    merging: Mapping[str, Merging], replies: Sequence[RobotReply], values: Mapping[str, JsonObject]
) -> JsonObject:
    """Returns what the replies have besides rows, and what of it is not the same for all.

    What is added up is also listed by robot.
    """
    found: JsonObject = {}
    by_robot: dict[str, JsonObject] = {}
    # Times of robots whose clock is ahead are compared only where there are no others.
    dated = [reply.name for reply in replies if not reply.is_ahead] or [*values]
    for key in dict.fromkeys(key for value in values.values() for key in value):
        if key in _LEFT_OUT:
            continue
        own = {name: value[key] for name, value in values.items() if key in value}
        match merging.get(key, "added" if key == AT_LEAST else ""):
            case "who":
                found[key] = [name for name, is_so in own.items() if is_so]
            case "counted":
                sums: Counter[str] = Counter()
                for counts in own.values():
                    sums.update(counts if isinstance(counts, dict) else {})
                found[key] = dict(sums.most_common())
            case ("earliest" | "newest") as how:
                numbers = [_number(own[name]) for name in dated if own.get(name) is not None]
                found[key] = (min if how == "earliest" else max)(numbers, default=None)
            case "" if len(own) == len(values) and len({*map(to_json_text, own.values())}) == 1:
                found[key] = next(iter(own.values()))
            case how:
                # Where a robot has not counted all, there is no total, but at least so many.
                totals = [value.get(_TOTAL) for value in values.values() if key == AT_LEAST]
                is_counted = key != _TOTAL or not any(AT_LEAST in one for one in values.values())
                if how == "added" and is_counted:
                    found[key] = round(sum(map(_number, (*own.values(), *totals))), 2)
                for name, value in own.items():
                    by_robot.setdefault(name, {})[key] = value
    return {**found, "by_robot": {**by_robot}} if by_robot else found


def _by_topic(replies: Sequence[RobotReply]) -> list[JsonValue]:
    """Returns a row for each topic of a type, with the names of the robots that record it."""
    topics: dict[tuple[str, str], JsonObject] = {}
    robots: dict[tuple[str, str], list[JsonValue]] = {}
    for reply in replies:  # those whose clock ran ahead come last
        for row in _list(reply.value):
            key = str(row["topic"]), str(row["type"])
            known = topics.setdefault(key, {**row, "count": 0})
            for time, best in (("first_ts", min), ("last_ts", max)):
                if not reply.is_ahead:
                    known[time] = best(_number(known[time]), _number(row[time]))
            known["count"] = int(_number(known["count"]) + _number(row["count"]))
            known[f"{ROBOT_NAME}s"] = robots.setdefault(key, [])
            robots[key].append(reply.name)
    return [*sorted(topics.values(), key=lambda row: (-_number(row["last_ts"]), str(row["topic"])))]


def _one_table(replies: Sequence[RobotReply]) -> JsonObject:
    """Returns the tables of robots as one, whose first column is the robot.

    A column that one of them lacks is null there.
    """
    headers = {reply.name: [*map(str, _items(reply.body, "columns"))] for reply in replies}
    columns = [*dict.fromkeys(name for own in headers.values() for name in own)]
    rows: list[JsonValue] = []
    every: JsonObject = {}
    for reply in replies:
        own = headers[reply.name]
        for row in _items(reply.body, "rows"):
            cells = dict(zip(own, row if isinstance(row, list) else (), strict=True))
            rows.append([reply.name, *map(cells.get, columns)])
        if total := _items(reply.body, "all"):
            every[reply.name] = [*map(dict(zip(own[1:], total, strict=True)).get, columns[1:])]
    rest = {reply.name: _without(reply.body, {"columns", "rows", "all"}) for reply in replies}
    table: JsonObject = {"columns": [ROBOT_NAME, *columns], "rows": rows, "all": every}
    return table | _rest({}, replies, rest)


def by_reason(said: Iterable[tuple[str, str]]) -> dict[str, list[str]]:
    """Returns the names of robots by reason, from pairs of a name and a reason."""
    found: dict[str, list[str]] = {}
    for name, reason in said:
        found.setdefault(reason, []).append(name)
    return found


def reason_of(error: EpisodicError) -> str:
    """Returns why a robot has no answer, as a phrase; names no path of this machine."""
    match error:
        case BagError():
            return f"a bag cannot be read: {error.reason}"
        case QueryTimeoutError(searched_back_to=int(back_to)):
            return f"{error} (searched back to {unix_rounded_up(back_to):.3f})"
        case _:
            return str(error)


def _of_robots(names: Sequence[str], note: str) -> str:
    return still_quoted(f"{listed(names, at_most=_MOST_NAMED)}: {note}", note)


def _notes_on(replies: Sequence[RobotReply], failures: Mapping[str, EpisodicError]) -> list[str]:
    """Returns what is to be known of robots: who did not answer and why, whose clock is ahead."""
    failed = by_reason((name, reason_of(error)) for name, error in failures.items())
    notes = [
        still_quoted(f"no answer of {_of_robots(names, reason)}", reason)
        for reason, names in failed.items()
    ]
    of_lake = {reply.name: reply.lake for reply in replies if reply.lake is not None}
    unseen = by_reason((name, note) for name, lake in of_lake.items() for note in lake.notes)
    notes += map(_of_robots, unseen.values(), unseen)
    notes += shipped_to({name: lake.latest for name, lake in of_lake.items()})
    if ahead := [reply.name for reply in replies if reply.is_ahead]:
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
    parts = []
    for name in order[:_MOST_NAMED]:
        time = latest[name]
        at = "no time" if time is None else iso_local(time) or str(time)
        parts.append(f"{name} up to {at}")
    if order[_MOST_NAMED:]:
        parts.append(f"{len(order) - _MOST_NAMED} others up to later")
    return [f"from the lake, which has what was shipped: {', '.join(parts)}"]


def _without(value: JsonObject, keys: set[str]) -> JsonObject:
    return {key: item for key, item in value.items() if key not in keys}


def _items(reply: JsonObject, key: str) -> list[JsonValue]:
    found = reply.get(key)
    return found if isinstance(found, list) else []


def _list(value: JsonValue) -> list[JsonObject]:
    return [row for row in value if isinstance(row, dict)] if isinstance(value, list) else []


def _number(value: JsonValue) -> float:
    return value if isinstance(value, int | float) else 0
