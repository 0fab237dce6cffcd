"""Merges the replies of several robots into one.

There are two kinds of merged replies. If a reply is a list of rows along time, the rows of all
robots become one list, newest first, each with the name of its robot (`MERGED_ROWS`). The other
keys are there once if all robots agree, else by robot, with a sum if that says something. If a
reply is about one robot as a whole, it becomes a row itself (`SHORT_KEYS`).
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from itertools import chain
from operator import attrgetter
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory import results
from ros2_memory.core import errors
from ros2_memory.core.errors import EpisodicError, InvalidArgumentsError
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.reply import PLAIN, JsonObject, Key, with_notes
from ros2_memory.core.text import listed, still_quoted
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_MS, Ns, iso_local, unix_rounded_up
from ros2_memory.tools.replies import ROBOT_NAME
from ros2_memory.tools.reply_size import notes_in, to_json_text

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

    from ros2_memory.fleet.robots import LakeReport

_MOST_NAMED: Final = 8
"""Robots that a note names."""
_LEFT_OUT: Final = ("notes", "more", "local")
"""Keys that are merged in another way, or that say nothing about several robots."""
FAILED: Final = "robots_failed"
"""The key of the robots without an answer: for each the code of its error, whose note says more."""


@dataclass(frozen=True, slots=True)
class RobotReply:
    """What one robot answered.

    Attributes:
        name: the robot.
        value: its reply, as a server of this robot alone would send it, before it is shortened.
        latest: the log time of its newest data; None if there is none.
        is_ahead: whether `latest` is in the future, so that times cannot be compared with others'.
        lake: what the reply has to report if the answer is from a lake.
    """

    name: str
    value: JsonValue
    latest: Ns | None = None
    is_ahead: bool = False
    lake: LakeReport | None = None

    @property
    def body(self) -> JsonObject:
        """The reply as an object; an empty one where it is something else."""
        return self.value if isinstance(self.value, dict) else {}


_TOTAL: Final = "total"
AT_LEAST: Final = "at_least"
"""The key of a count that is not complete, in place of the total."""
MATCHES: Final = "matches"
TOPICS: Final = "topics"
ROBOT_NAMES: Final = f"{ROBOT_NAME}s"
MERGED_ROWS: Final[Mapping[str, Sequence[Key]]] = {
    "find_last_match": (PLAIN(MATCHES).along("timestamp"),),
    "list_recorded_topics": (PLAIN(TOPICS).along("last_ts"),),
    "find_matches": results.Sightings.reply.keys,
    "find_things": results.Things.reply.keys,
    "visits": results.Visits.reply.keys,
}
"""The tools whose rows are merged, and the keys of their replies, which declare how."""

SHORT_KEYS: Final[Mapping[str, tuple[str, ...]]] = {
    tool: tuple(key.name for answer in answers for key in answer.reply.short.keys)
    for tool, answers in (
        ("compare", (results.Comparison,)),
        ("recap", (results.Before, results.Recap)),
        ("memory_status", (results.Status,)),
        ("data_time_range", (results.DataTimeRange,)),
    )
}
"""The tools with a row for each robot, and the keys of this row if the whole reply is too long."""


class Page:
    """The times of the first `limit` rows of the robots that answered so far.

    The newest rows come first, or the oldest. If two threads add rows at once, some may be missing;
    then `window` is wider than it needs to be.
    """

    def __init__(self, limit: int | None, *, oldest_first: bool) -> None:
        self.limit, self.oldest_first = limit, oldest_first
        self._times: list[Ns] = []

    def add(self, times: Iterable[Ns]) -> None:
        """Adds the times of a robot's rows."""
        times = sorted((*self._times, *times), reverse=not self.oldest_first)
        self._times = times[: self.limit]

    def window(self) -> TimeWindow | None:
        """Returns the times of rows that can be on the page; None while there is room for any."""
        times = self._times
        if self.limit is None or len(times) < max(self.limit, 1):
            return None
        # Rows are put in order by times as replies show them, in milliseconds.
        early, late = times[-1] - NS_PER_MS, times[-1] + NS_PER_MS
        return TimeWindow(MIN_NS, late) if self.oldest_first else TimeWindow(early, MAX_NS)


def shared_error(failed: Mapping[str, EpisodicError]) -> EpisodicError:
    """Returns the error of a call to which no robot has an answer."""
    reasons = by_reason((name, reason_of(error)) for name, error in failed.items())
    text = "; ".join(f"{listed(names)}: {reason}" for reason, names in reasons.items())
    kinds = {type(error) for error in failed.values()}
    no_data = {error.reason for error in failed.values() if isinstance(error, errors.NoDataError)}
    if kinds == {errors.NoDataError} and len(no_data) == 1:
        return errors.NoDataError(no_data.pop(), text)
    if kinds == {InvalidArgumentsError}:
        return InvalidArgumentsError(text if len(reasons) > 1 else next(iter(reasons)))
    if kinds == {errors.NotInLakeError}:
        return errors.NotInLakeError(text)
    is_late = errors.QueryTimeoutError in kinds
    return errors.QueryTimeoutError(text) if is_late else errors.RefusedError(text)


def merge_replies(
    tool: str,
    replies: Sequence[RobotReply],
    failures: Mapping[str, EpisodicError],
    page: Page,
    max_chars: int,
) -> JsonObject:
    """Returns the reply of several robots to one question.

    Args:
        tool: one of `ANSWER_FOR_ALL`.
        replies: the replies of the robots that answered, with rows in the order of the page.
        failures: the errors of the other robots.
        page: how many rows are wanted, of all robots together.
        max_chars: if the reply would be longer, the rows of whole robots are shortened.
    """
    order = sorted(replies, key=lambda reply: (reply.is_ahead, -(reply.latest or 0), reply.name))
    codes: JsonObject = {name: error.code for name, error in failures.items()}
    failed: JsonObject = {FAILED: codes} if codes else {}
    notes = _notes_on(order, failures)
    if any("columns" in reply.body for reply in order):
        body = _merge_tables(order)
    elif tool == "list_recorded_topics":
        body = {TOPICS: _merge_topics(order)}
    elif tool in MERGED_ROWS:
        body = _merge_rows(MERGED_ROWS[tool], order, page)
    else:
        whole: list[JsonObject] = [{ROBOT_NAME: reply.name, **reply.body} for reply in order]
        body = with_notes({"robots": [*whole], **failed}, notes)
        if len(to_json_text(body)) <= max_chars:
            return body
        keys = dict.fromkeys((ROBOT_NAME, "now", *SHORT_KEYS[tool]))
        short = [{key: row[key] for key in keys if key in row} for row in whole]
        do = "each robot shortly; pass robot for all of it"
        return with_notes({"robots": [*short], **failed}, [do, *notes])
    own_notes = _sentences((reply.name, note) for reply in order for note in notes_in(reply.body))
    return with_notes({**body, **failed}, [*own_notes, *notes])


class _TimedRow(NamedTuple):
    """A row of a robot, with its place in the merged list: robots with a clock ahead come last."""

    is_ahead: bool
    order: float
    key: str
    row: JsonObject


def _timed_rows(reply: RobotReply, times: Mapping[str, str], page: Page) -> Iterator[_TimedRow]:
    """Yields the rows of a reply; `times` has the key of a row's time for each key of rows."""
    values = _as_rows(reply)
    for key, time_key in times.items():
        for row in _objects(values.get(key)):
            time = row.get(time_key, 0)
            # A row whose time is null goes on.
            unix_s = math.inf if time is None else _number(time)
            order = unix_s if page.oldest_first else -unix_s
            yield _TimedRow(reply.is_ahead, order, key, {ROBOT_NAME: reply.name, **row})


def _merge_rows(declared: Sequence[Key], replies: Sequence[RobotReply], page: Page) -> JsonObject:
    """Returns the rows of all replies in order of time, and what the replies have besides."""
    values = {reply.name: _as_rows(reply) for reply in replies}
    times = {key.name: key.row_time for key in declared if key.row_time}
    # One robot may have episodes, another one sightings.
    keys = [name for name in times if any(name in value for value in values.values())]
    keys = keys or [*times][:1]
    order = [timed for reply in replies for timed in _timed_rows(reply, times, page)]
    order.sort(key=attrgetter("is_ahead", "order"))
    # Each robot lists every named place, whatever the limit of visits is.
    shown = order if keys == ["places"] else order[: page.limit]
    rows: JsonObject = {key: [timed.row for timed in shown if timed.key == key] for key in keys}
    if keys == [MATCHES]:
        never = [reply.name for reply in replies if reply.value is None]
        return {**rows, "never": [*never]} if never else rows
    rest = {name: _without(value, {*keys}) for name, value in values.items()}
    merged = {**rows, **_combined(rest, {key.name for key in declared if key.is_added})}
    is_cut = len(shown) < len(order) or any(value.get("more") for value in values.values())
    if is_cut and any(key.name == "more" for key in declared):
        merged["more"] = True
    return merged


def _as_rows(reply: RobotReply) -> JsonObject:
    """Returns a reply as an object with a list of rows; a reply that is one row becomes a list."""
    value = reply.value
    if value is None:
        return {MATCHES: []}
    if isinstance(value, dict) and "timestamp" in value:
        return {MATCHES: [] if value["timestamp"] is None else [_without(value, {"notes"})]}
    return reply.body


def _combined(values: Mapping[str, JsonObject], added: Collection[str] = frozenset()) -> JsonObject:
    """Returns the keys of replies besides rows: once if all robots agree, else by robot.

    Of the `added` keys, counts by name are only summed; numbers are summed and listed by robot.
    """
    combined: JsonObject = {}
    by_robot: dict[str, JsonObject] = {}
    for key in dict.fromkeys(chain.from_iterable(values.values())):
        if key in _LEFT_OUT:
            continue
        of_robots = {name: value[key] for name, value in values.items() if key in value}
        if key in added or key == AT_LEAST:
            total = _total_of(key, values.values())
            if total is not None:
                combined[key] = total
            if isinstance(total, dict):
                continue
        elif len(of_robots) == len(values) and _are_equal(of_robots.values()):
            combined[key] = next(iter(of_robots.values()))
            continue
        for name, value in of_robots.items():
            by_robot.setdefault(name, {})[key] = value
    return {**combined, "by_robot": {**by_robot}} if by_robot else combined


def _total_of(key: str, values: Collection[JsonObject]) -> float | JsonObject | None:
    """Returns the sum of a key's numbers, or its counts by name; None if there is no total."""
    of_robots = [value[key] for value in values if key in value]
    if counts := [value for value in of_robots if isinstance(value, dict)]:
        return dict(sum(map(Counter[str], counts), Counter()).most_common())
    # If a robot did not count all, the sum is not a total, but at least so many.
    if key == AT_LEAST:
        return _sum((*of_robots, *(value.get(_TOTAL) for value in values)))
    is_counted = key != _TOTAL or not any(AT_LEAST in value for value in values)
    return _sum(of_robots) if is_counted else None


def _are_equal(values: Iterable[JsonValue]) -> bool:
    return len({*map(to_json_text, values)}) == 1


def _merge_topics(replies: Sequence[RobotReply]) -> list[JsonValue]:
    """Returns a row for each topic and type, with the names of the robots that record it."""
    topics: dict[tuple[str, str], JsonObject] = {}
    for reply in replies:  # robots with a clock ahead come last: their times count if alone
        for row in _objects(reply.value):
            key = str(row["topic"]), str(row["type"])
            total = topics.setdefault(key, {**row, "count": 0})
            if not reply.is_ahead:
                total["first_ts"] = min(_number(total["first_ts"]), _number(row["first_ts"]))
                total["last_ts"] = max(_number(total["last_ts"]), _number(row["last_ts"]))
            total["count"] = int(_number(total["count"]) + _number(row["count"]))
            total[ROBOT_NAMES] = [*_items(total, ROBOT_NAMES), reply.name]
    return [*sorted(topics.values(), key=lambda row: (-_number(row["last_ts"]), str(row["topic"])))]


def _merge_tables(replies: Sequence[RobotReply]) -> JsonObject:
    """Returns the tables of robots as one, whose first column is the robot.

    A column that a robot lacks is null in its rows.
    """
    headers = {reply.name: [*map(str, _items(reply.body, "columns"))] for reply in replies}
    columns = [*dict.fromkeys(chain.from_iterable(headers.values()))]
    rows: list[JsonValue] = []
    totals: JsonObject = {}
    for reply in replies:
        header = headers[reply.name]
        for row in _items(reply.body, "rows"):
            cells = dict(zip(header, row if isinstance(row, list) else (), strict=True))
            rows.append([reply.name, *map(cells.get, columns)])
        if total := _items(reply.body, "all"):
            cells = dict(zip(header[1:], total, strict=True))
            totals[reply.name] = [*map(cells.get, columns[1:])]
    rest = {reply.name: _without(reply.body, {"columns", "rows", "all"}) for reply in replies}
    table: JsonObject = {"columns": [ROBOT_NAME, *columns], "rows": rows, "all": totals}
    return table | _combined(rest)


def by_reason(reasons: Iterable[tuple[str, str]]) -> dict[str, list[str]]:
    """Returns the names of robots by reason, from pairs of a name and a reason."""
    names_by_reason: dict[str, list[str]] = {}
    for name, reason in reasons:
        names_by_reason.setdefault(reason, []).append(name)
    return names_by_reason


def reason_of(error: EpisodicError) -> str:
    """Returns why a robot has no answer, as a phrase; names no path of this machine."""
    match error:
        case errors.BagError():
            return f"a bag cannot be read: {error.reason}"
        case errors.QueryTimeoutError(searched_back_to=int(back_to)):
            return f"{error} (searched back to {unix_rounded_up(back_to):.3f})"
        case _:
            return str(error)


def _sentences(reasons: Iterable[tuple[str, str]], begin: str = "") -> list[str]:
    """Returns a note for each reason, with the names of its robots."""
    return [
        still_quoted(f"{begin}{listed(names, at_most=_MOST_NAMED)}: {reason}", reason)
        for reason, names in by_reason(reasons).items()
    ]


def _notes_on(replies: Sequence[RobotReply], failures: Mapping[str, EpisodicError]) -> list[str]:
    """Returns notes on robots without an answer, answers from a lake, and clocks that are ahead."""
    failed = ((name, reason_of(error)) for name, error in failures.items())
    reports = {reply.name: reply.lake for reply in replies if reply.lake is not None}
    notes = _sentences(failed, "no answer of ")
    notes += _sentences((name, note) for name, report in reports.items() for note in report.notes)
    notes += shipped_to(reports)
    if ahead := [reply.name for reply in replies if reply.is_ahead]:
        notes.append(
            f"{listed(ahead, at_most=_MOST_NAMED)}: dated in the future by a clock that ran ahead, "
            "so listed last: their times cannot be compared with others'"
        )
    return notes


def shipped_to(reports: Mapping[str, LakeReport]) -> list[str]:
    """Returns the note on answers from a lake alone: up to when each robot's bags were shipped."""
    latest = {name: report.latest for name, report in reports.items() if report.is_alone}
    order = sorted(latest, key=lambda name: latest[name] or 0)
    parts: list[str] = []
    for name in order[:_MOST_NAMED]:
        at = latest[name]
        parts.append(f"{name} up to {'no time' if at is None else iso_local(at) or at}")
    if more := len(order) - len(parts):
        parts.append(f"{more} others up to later")
    return [f"from the lake, which has what was shipped: {', '.join(parts)}"] if parts else []


def _without(value: JsonObject, keys: set[str]) -> JsonObject:
    return {key: item for key, item in value.items() if key not in keys}


def _items(reply: JsonObject, key: str) -> list[JsonValue]:
    values = reply.get(key)
    return values if isinstance(values, list) else []


def _objects(value: JsonValue) -> list[JsonObject]:
    return [row for row in value if isinstance(row, dict)] if isinstance(value, list) else []


def _number(value: JsonValue) -> float:
    return value if isinstance(value, int | float) else 0


def _sum(values: Iterable[JsonValue]) -> float:
    return round(sum(map(_number, values)), 2)
