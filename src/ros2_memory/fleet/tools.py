"""The tools of one robot as those of a fleet: with the argument `robot`, and for all without it.

The tools themselves are unchanged: each is asked of the memory of a robot. Where it is asked of
several, their replies become one (`merging`), and what keeps a robot from answering is a note.
"""

from __future__ import annotations

import threading
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Final, cast

from ros2_memory.core.errors import (
    EpisodicError,
    InvalidArgumentsError,
    NoDataError,
    NotInLakeError,
    QueryTimeoutError,
    RefusedError,
)
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.text import listed
from ros2_memory.core.timebase import (
    MAX_NS,
    MIN_NS,
    NS_PER_S,
    Ns,
    ns_from_unix,
    unix_from_text,
    unix_rounded_up,
)
from ros2_memory.fleet.merging import (
    ANSWER_FOR_ALL,
    MATCHES,
    MERGED_ROWS,
    TABLE_FOR_ALL,
    TOPICS,
    RobotReply,
    by_reason,
    merged,
    reason_of,
    shipped_to,
)
from ros2_memory.fleet.robots import AT_ONCE, FanOut, Fleet, FromLake, Robot, StoppedClock, names_of
from ros2_memory.results import Match, OfFleet, OfRobot, OneAnswer, Sightings
from ros2_memory.tools.reply_json import ROBOT_NAME, as_json

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from ros2_memory.core.reply import JsonObject
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.tools.declaration import Question, Tool

ROBOT: Final = "robot"
"""The argument that names a robot."""
_AHEAD_NS: Final[Ns] = 60 * NS_PER_S
"""Data that is newer than now by more was dated by a clock that runs ahead."""
_TIMES: Final = ("start", "with_start", "timestamp", "timestamps", "around")
_LENGTHS: Final = ("last_s", "seconds", "seconds_ago")
"""Arguments that say from when a question is: a time, or seconds before now."""
_REPORTS_ITSELF: Final = frozenset({"memory_status", "data_time_range"})
"""Tools about the bags that a robot has, which say themselves that its directory is missing."""


_SHOWN_NS: Final[Ns] = NS_PER_S // 1000
"""Rows are put in order by times as replies show them, in milliseconds."""


def fleet_tools(
    tools: Sequence[Tool], fleet: Fleet, max_chars: int, at_once: int = AT_ONCE
) -> tuple[Tool, ...]:
    """Returns the tools of a fleet, without those that write.

    `max_chars` is how long a reply may be: rows for many robots are given shortly before that.
    `at_once`: how many robots are asked at once.
    """
    fan_out = FanOut(at_once)
    return tuple(
        replace(
            tool,
            describe=partial(_described, tool),
            # One robot that is slow must not keep a quick tool's thread.
            blocking=tool.blocking or tool.name in ANSWER_FOR_ALL | TABLE_FOR_ALL,
            question=partial(_asking, tool, fleet, fan_out, max_chars),
        )
        for tool in tools
        if not tool.writes
    )


def _described(tool: Tool) -> tuple[str, JsonObject]:
    """Returns the description, with the shape of the reply for all robots, and the schema."""
    text, needs = tool.description, "Its name."
    if tool.name in TABLE_FOR_ALL:
        needs = "Its name; without it, or with several (a, b), by of all."
    if tool.name in ANSWER_FOR_ALL:
        needs = "Its name, or several (a, b); without it, all."
        shape = f"{{robots: [{{{ROBOT_NAME}, ...}}]}}"
        if tool.name in MERGED_ROWS:
            key = next(key.name for key in MERGED_ROWS[tool.name] if key.row_time)
            name = f"{ROBOT_NAME}s" if key == TOPICS else ROBOT_NAME
            also = ", never: robots that never did" if key == MATCHES else ""
            shape = f"{{{key}: [{{{name}, ...}}]{also}}}"
        text = f"{text} Of all robots: {shape}."
    argument: JsonObject = {"type": "string", "description": needs}
    return text, {**tool.schema, "properties": {ROBOT: argument, **tool.arguments}}


def _asking(
    tool: Tool, fleet: Fleet, fan_out: FanOut, max_chars: int, given: Mapping[str, object]
) -> Question:
    """Checks the arguments of a call, and returns what asks one robot or several."""
    own = {name: value for name, value in given.items() if name != ROBOT}
    asked = _FleetQuestion(tool, fleet, fan_out, max_chars, tool.question(own), own)
    return lambda _, call: asked.ask(given.get(ROBOT), call)


@dataclass(frozen=True, slots=True)
class _FleetQuestion:
    """A question to robots of a fleet: what asks one of them, and its arguments."""

    tool: Tool
    fleet: Fleet
    fan_out: FanOut
    max_chars: int
    question: Question
    given: Mapping[str, object]

    def ask(self, named: object, call: Call) -> OfRobot | OfFleet:
        """Returns the answer of the robot of a name, of several (a, b), or where it is None of all.

        Raises:
            EpisodicError: there is none.
        """
        if isinstance(named, str) and "," in named:
            names = dict.fromkeys(map(str.strip, named.split(",")))
            robots = [self.fleet.named(name, call) for name in names]
        elif named is not None:
            return self._of_one(self.fleet.named(named, call), call)
        else:
            robots = self.fleet.allowed(call)
        is_table = self.tool.name in TABLE_FOR_ALL and self.given.get("by") is not None
        if (self.tool.name in ANSWER_FOR_ALL or is_table) and self.given.get("between") is None:
            return self._of_all(robots, call)
        return self._of_one(_only_one(self.tool.name, robots), call)

    def _of_one(self, robot: Robot, call: Call) -> OfRobot:
        """Returns a robot's answer; one whose disk hangs blocks one thread, however often asked.

        Raises:
            EpisodicError: it has none.
        """

        def ask(_: Robot, own: Call) -> OfRobot:
            answer, found = robot.asked(partial(_answer, self.question), own, self._since)
            lake = self._reported(answer, found)
            notes = () if lake is None else (*shipped_to({robot.name: lake.latest}), *lake.notes)
            return OfRobot(robot.name, robot.bag_dir, answer, notes, own.now)

        found = self.fan_out.ask([robot], ask, call)[robot.name]
        if isinstance(found, EpisodicError):
            raise found
        return found

    def _of_all(self, robots: list[Robot], call: Call) -> OfFleet:
        given = self.given
        if not robots:
            raise RefusedError("there is no robot that this token may ask about")
        if len(robots) > 1 and not self.fleet.shared_map and (name := _coordinates_in(given)):
            raise InvalidArgumentsError(
                f"{name} has coordinates, which each robot has in a map of its own: pass robot, or "
                "where with the name of a place (fleet.shared_map is set where all share one map)"
            )
        robots.sort(key=Robot.latest_known, reverse=True)
        now = StoppedClock(self.fleet.clock.now())
        default = self.tool.arguments.get("limit", {}).get("default")
        wanted = default if given.get("limit") is None else given["limit"]
        limit = int(wanted) if isinstance(wanted, int | float) else None
        oldest_first = given.get("oldest_first") is True
        page = _Page(limit, oldest_first=oldest_first)
        found = self.fan_out.ask(robots, partial(self._reply, now, page), call)
        replies = [reply for reply in found.values() if isinstance(reply, RobotReply)]
        errors = {name: error for name, error in found.items() if isinstance(error, EpisodicError)}
        if not replies:
            raise _shared_error(errors)
        return OfFleet(
            merged(
                self.tool.name,
                replies,
                errors,
                limit=limit,
                oldest_first=oldest_first,
                max_chars=self.max_chars,
            )
        )

    def _reply(self, now: StoppedClock, page: _Page, robot: Robot, call: Call) -> RobotReply:
        """Returns a robot's reply; runs in a thread of its own.

        Raises:
            EpisodicError: it has none.
        """

        def ask(memory: Memory, own: Call) -> tuple[RobotReply, OneAnswer]:
            snapshot = memory.index.snapshot()
            if snapshot.problem is not None and self.tool.name not in _REPORTS_ITSELF:
                # "Never" would be a claim about bags that were not searched.
                raise RefusedError(snapshot.problem)
            latest = snapshot.latest
            is_ahead = latest is not None and latest > now.at + _AHEAD_NS
            # Rows of those whose clock is ahead come last, whenever they are.
            own.rows_in = None if is_ahead else page.window()
            answer = _answer(self.question, replace(memory, clock=now), own)
            if isinstance(answer, Sightings) and not is_ahead:
                page.add(sighting.last for sighting in answer.sightings)
                page.add(episode.until for episode in answer.episodes)
            value = as_json(answer, memory.index.bag_dir)
            if own.now is not None and isinstance(value, dict):
                value = {"now": unix_rounded_up(own.now), **value}
            return RobotReply(robot.name, value, latest, is_ahead), answer

        (reply, answer), lake = robot.asked(ask, call, self._since)
        return replace(reply, lake=self._reported(answer, lake))

    def _since(self, now: Ns) -> Ns | None:
        """Returns from when the question is; None where it is about the bags that there are."""
        given = {name: value for name, value in self.given.items() if value is not None}
        begins = [now - ns_from_unix(float(str(given[name]))) for name in _LENGTHS if name in given]
        for value in (given[name] for name in _TIMES if name in given):
            for time in value if isinstance(value, list) else [value]:
                with suppress(ValueError):  # a list as text
                    read = unix_from_text if isinstance(time, str) else float
                    begins.append(ns_from_unix(read(str(time))))
        # Without a time, searches are about all that there ever was.
        takes_time = self.tool.arguments.keys() & {*_TIMES, *_LENGTHS, "before"}
        searches = takes_time and self.tool.name not in _REPORTS_ITSELF
        return min(begins, default=MIN_NS if searches else None)

    def _reported(self, answer: OneAnswer, lake: FromLake | None) -> FromLake | None:
        """Returns what is to be reported of a lake, given from when its answer is."""
        if lake is None:
            return None
        if isinstance(answer, Match) and answer.found is not None:
            return lake.since(answer.found.sample.time)
        begin = self._since(MIN_NS if lake.latest is None else lake.latest)
        return lake.since(MIN_NS if begin is None else begin)


@dataclass(eq=False)
class _Page:
    """The `limit` rows that come first, of the rows of robots that answered so far. Thread-safe.

    The newest rows come first, or the oldest.
    """

    limit: int | None
    _: KW_ONLY
    oldest_first: bool
    _lock: threading.Lock = field(default_factory=threading.Lock, init=False)
    _times: list[Ns] = field(default_factory=list, init=False)

    def add(self, times: Iterable[Ns]) -> None:
        """Adds the times of a robot's rows."""
        with self._lock:
            self._times = sorted((*self._times, *times), reverse=not self.oldest_first)
            del self._times[self.limit :]

    def window(self) -> TimeWindow | None:
        """Returns where a row's time must lie for a place on the page; None while there is room."""
        with self._lock:
            if self.limit is None or len(self._times) < max(self.limit, 1):
                return None
            last = self._times[-1]
        if self.oldest_first:
            return TimeWindow(MIN_NS, last + _SHOWN_NS)
        return TimeWindow(last - _SHOWN_NS, MAX_NS)


def _answer(question: Question, memory: Memory, call: Call) -> OneAnswer:
    """Returns a robot's answer, in the thread that it is asked in."""
    with call.reading(memory.large):
        return cast("OneAnswer", question(memory, call))


def _coordinates_in(given: Mapping[str, object]) -> str | None:
    """Returns the argument that has coordinates, if there is one."""
    for name in ("where", "near"):
        where = given.get(name)
        is_object = isinstance(where, dict) or str(where).lstrip().startswith("{")
        if is_object and not (name == "near" and "label" in str(where)):
            return name
    if given.get("condition_type") == "near_position":
        return "value"
    return next((name for name in ("x", "y") if given.get(name) is not None), None)


def _only_one(tool: str, robots: Sequence[Robot]) -> Robot:
    """Returns the only one of some robots.

    Raises:
        InvalidArgumentsError: there are several, or none; the sentence names them.
    """
    if len(robots) == 1:
        return robots[0]
    example = f", e.g. robot={robots[0].name}" if robots else ""
    raise InvalidArgumentsError(
        f"which robot? {tool} answers for one: pass robot{example}; there {names_of(robots)}"
    )


def _shared_error(errors: Mapping[str, EpisodicError]) -> EpisodicError:
    """Returns the error where no robot has an answer."""
    reasons = by_reason((name, reason_of(error)) for name, error in errors.items())
    text = "; ".join(f"{listed(names)}: {reason}" for reason, names in reasons.items())
    kinds = {type(error) for error in errors.values()}
    first = next(iter(errors.values()))
    no_data = {error.reason for error in errors.values() if isinstance(error, NoDataError)}
    if isinstance(first, NoDataError) and len(kinds) == len(no_data) == 1:
        return NoDataError(first.reason, text)
    if kinds == {NotInLakeError}:
        return NotInLakeError(text)
    if kinds == {InvalidArgumentsError}:
        return InvalidArgumentsError(str(first) if len(reasons) == 1 else text)
    if any(issubclass(kind, QueryTimeoutError) for kind in kinds):
        return QueryTimeoutError(text)
    return RefusedError(text)
