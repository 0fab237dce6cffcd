"""Makes the tools of one robot tools of a fleet: with the argument `robot`, and for all without it.

The tools themselves are unchanged: each asks the memory of one robot. If several robots are asked,
their replies become one reply (see `replies`), and a note says why a robot has no answer.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final, TypeVar, cast

from ros2_memory.core import errors
from ros2_memory.core.errors import EpisodicError, InvalidArgumentsError
from ros2_memory.core.timebase import (
    MIN_NS,
    NS_PER_MS,
    Ns,
    StoppedClock,
    ns_from_unix,
    unix_from_text,
    unix_rounded_up,
)
from ros2_memory.fleet.replies import (
    MATCHES,
    MERGED_ROWS,
    ROBOT_NAMES,
    SHORT_KEYS,
    TOPICS,
    Page,
    RobotReply,
    merge_replies,
    shared_error,
    shipped_to,
)
from ros2_memory.fleet.robots import AT_ONCE, FanOut, Robot, robots_clause
from ros2_memory.places.where import has_coordinates
from ros2_memory.results import Match, OfFleet, OfRobot, OneAnswer, Sightings, ValueWhen
from ros2_memory.tools.arguments import as_region, as_while
from ros2_memory.tools.declaration import Described
from ros2_memory.tools.replies import ROBOT_NAME, as_json

T = TypeVar("T")

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from ros2_memory.core.reply import JsonObject
    from ros2_memory.fleet.robots import Fleet, LakeReport
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.tools.declaration import Question, Tool

ANSWER_FOR_ALL: Final = frozenset({*MERGED_ROWS, *SHORT_KEYS})
"""The tools that answer for all robots."""

TABLE_FOR_ALL: Final = frozenset({"trajectory_summary", "recent_trajectory_summary"})
"""The tools that answer for all robots where they count (the argument `by`)."""

ROBOT: Final = "robot"
"""The argument that names a robot."""
_AHEAD_NS: Final[Ns] = 60_000 * NS_PER_MS
"""Data that is newer than now by more was dated by a clock that runs ahead."""
_TIMES: Final = ("start", "with_start", "timestamp", "timestamps", "around")
"""Arguments with the time that a question is about."""
_LENGTHS: Final = ("last_s", "seconds", "seconds_ago")
"""Arguments with seconds before now."""
_OF_RECORDER: Final = frozenset({"memory_status"})
"""Tools about a bag directory and its recorder."""
_REPORTS_ITSELF: Final = frozenset({"memory_status", "data_time_range"})
"""Tools about a robot's bags, whose replies say themselves that its directory is missing."""


def fleet_tools(
    tools: Sequence[Tool], fleet: Fleet, max_chars: int, at_once: int = AT_ONCE
) -> tuple[Tool, ...]:
    """Returns the tools of a fleet, without the tools that write.

    `max_chars` is how long a reply may be; if it would be longer, rows of whole robots are
    shortened. `at_once`: how many robots are asked at once.
    """
    fan_out = FanOut(at_once)

    def question_of(tool: Tool, given: Mapping[str, object]) -> Question:
        own = {name: value for name, value in given.items() if name != ROBOT}
        question = _FleetQuestion(tool, fleet, fan_out, max_chars, tool.question(own), own)
        return lambda _, call: question.ask(given.get(ROBOT), call)

    return tuple(
        replace(
            tool,
            describe=partial(_describe, tool),
            # One robot that is slow must not keep a quick tool's thread.
            blocking=tool.blocking or tool.name in ANSWER_FOR_ALL | TABLE_FOR_ALL,
            question=partial(question_of, tool),
        )
        for tool in tools
        if not tool.writes
    )


def _describe(tool: Tool) -> Described:
    """Returns what planners read of a tool, with the shape of replies for all robots."""
    text, needs = tool.description, "Its name."
    if tool.name in TABLE_FOR_ALL:
        needs = "Its name; without it, or with several (a, b), by of all."
    if tool.name in ANSWER_FOR_ALL:
        needs = "Its name, or several (a, b); without it, all."
        shape = f"{{robots: [{{{ROBOT_NAME}, ...}}]}}"
        if tool.name in MERGED_ROWS:
            key = next(key.name for key in MERGED_ROWS[tool.name] if key.row_time)
            name = ROBOT_NAMES if key == TOPICS else ROBOT_NAME
            also = ", never: robots that never did" if key == MATCHES else ""
            shape = f"{{{key}: [{{{name}, ...}}]{also}}}"
        text = f"{text} Of all robots: {shape}."
    argument: JsonObject = {"type": "string", "description": needs}
    return Described(text, {ROBOT: argument, **tool.arguments}, tool.described.required)


@dataclass(frozen=True, slots=True)
class _FleetQuestion:
    """A question to robots of a fleet.

    `question` asks the memory of one robot; `given` are the arguments, without the robot.
    """

    tool: Tool
    fleet: Fleet
    fan_out: FanOut
    max_chars: int
    question: Question
    given: Mapping[str, object]

    def ask(self, named: object, call: Call) -> OfRobot | OfFleet:
        """Returns the answer of the named robot, of several ("a, b"), or of all if it is None.

        Raises:
            EpisodicError: there is no answer.
        """
        robots = self.fleet.chosen(named, call)
        tool, given = self.tool.name, self.given
        is_table = tool in TABLE_FOR_ALL and given.get("by") is not None
        is_of_all = (tool in ANSWER_FOR_ALL or is_table) and given.get("between") is None
        if is_of_all and (named is None or "," in str(named)):
            return self._ask_all(robots, call)
        if len(robots) == 1:
            return self._ask_one(robots[0], call)
        example = f", e.g. robot={robots[0].name}" if robots else ""
        raise InvalidArgumentsError(
            f"which robot? {tool} answers for one: pass robot{example}; {robots_clause(robots)}"
        )

    def _ask_one(self, robot: Robot, call: Call) -> OfRobot:
        """Returns a robot's answer, asked in a thread of its own: its disk may hang.

        Raises:
            EpisodicError: the robot has no answer.
        """

        def ask(_: Robot, own: Call) -> OfRobot:
            answer, lake = self._ask_memory(robot, partial(_answer, self.question), own)
            report = self._lake_report(answer, lake)
            notes = () if report is None else (*shipped_to({robot.name: report}), *report.notes)
            return OfRobot(robot.name, robot.memory.bag_dir, answer, notes, own.now)

        answer_or_error = self.fan_out.ask([robot], ask, call)[robot.name]
        if isinstance(answer_or_error, EpisodicError):
            raise answer_or_error
        return answer_or_error

    def _ask_all(self, robots: Sequence[Robot], call: Call) -> OfFleet:
        given = self.given
        if not robots:
            raise errors.RefusedError("there is no robot that this token may ask about")
        if len(robots) > 1 and not self.fleet.shared_map and (name := _coordinates_in(given)):
            raise InvalidArgumentsError(
                f"{name} has coordinates, which each robot has in a map of its own: pass robot, or "
                "where with the name of a place (fleet.shared_map is set where all share one map)"
            )
        # A full page of the newest rows spares robots with older data most of their search.
        robots = sorted(robots, key=lambda robot: robot.latest or MIN_NS, reverse=True)
        now = StoppedClock(self.fleet.clock.now())
        wanted = given.get("limit") or self.tool.arguments.get("limit", {}).get("default")
        limit = int(wanted) if isinstance(wanted, int | float) else None
        page = Page(limit, oldest_first=given.get("oldest_first") is True)
        answers = self.fan_out.ask(robots, partial(self._reply, now, page), call)
        replies = [reply for reply in answers.values() if isinstance(reply, RobotReply)]
        failed = {
            name: error for name, error in answers.items() if isinstance(error, EpisodicError)
        }
        if not replies:
            raise shared_error(failed)
        return OfFleet(merge_replies(self.tool.name, replies, failed, page, self.max_chars))

    def _reply(self, now: StoppedClock, page: Page, robot: Robot, call: Call) -> RobotReply:
        """Returns a robot's reply; runs in a thread of its own.

        Raises:
            EpisodicError: the robot has no answer.
        """

        def ask(memory: Memory, own: Call) -> tuple[RobotReply, OneAnswer]:
            snapshot = memory.snapshot()
            if snapshot.problem is not None and self.tool.name not in _REPORTS_ITSELF:
                # "Never" would be a claim about bags that were not searched.
                raise errors.RefusedError(snapshot.problem)
            latest = snapshot.latest
            is_ahead = latest is not None and latest > now.at + _AHEAD_NS
            # Rows of a robot whose clock is ahead come last, whatever their times are.
            own.rows_in = None if is_ahead else page.window()
            answer = _answer(self.question, replace(memory, clock=now), own)
            if isinstance(answer, Sightings) and not is_ahead:
                page.add(sighting.last for sighting in answer.sightings)
                page.add(episode.until for episode in answer.episodes)
            value = as_json(answer, memory.bag_dir)
            if own.now is not None and isinstance(value, dict):
                value = {"now": unix_rounded_up(own.now), **value}
            return RobotReply(robot.name, value, latest, is_ahead), answer

        (reply, answer), lake = self._ask_memory(robot, ask, call)
        return replace(reply, lake=self._lake_report(answer, lake))

    def _ask_memory(
        self, robot: Robot, ask: Callable[[Memory, Call], T], call: Call
    ) -> tuple[T, LakeReport | None]:
        """Returns the same as `Robot.ask`, but asks about a recorder in its own bag directory."""
        if self.tool.name in _OF_RECORDER and robot.own is not None:
            return ask(robot.own, call), None
        return robot.ask(ask, call, self._since)

    def _since(self, now: Ns) -> Ns | None:
        """Returns the time from which on the question is, or None if it is about all bags."""
        given = {name: value for name, value in self.given.items() if value is not None}
        begins = [now - ns_from_unix(float(str(given[name]))) for name in _LENGTHS if name in given]
        for name in _TIMES:
            value = given.get(name, [])
            for time in value if isinstance(value, list) else [value]:
                with suppress(ValueError):  # a list as text
                    unix_s = unix_from_text(time) if isinstance(time, str) else float(str(time))
                    begins.append(ns_from_unix(unix_s))
        # Without a time, searches are about all that there ever was.
        takes_time = self.tool.arguments.keys() & {*_TIMES, *_LENGTHS, "before"}
        searches = takes_time and self.tool.name not in _REPORTS_ITSELF
        return min(begins, default=MIN_NS if searches else None)

    def _lake_report(self, answer: OneAnswer, lake: LakeReport | None) -> LakeReport | None:
        """Returns the report on the lake for an answer, which may need no older days."""
        if lake is None:
            return None
        if isinstance(answer, Match) and answer.found is not None:
            return lake.since(answer.found.sample.time)
        if isinstance(answer, ValueWhen) and answer.value is not None:
            return lake.since(answer.value.sample.time)
        begin = self._since(MIN_NS if lake.latest is None else lake.latest)
        return lake._replace(takes_time=False) if begin is None else lake.since(begin)


def _answer(question: Question, memory: Memory, call: Call) -> OneAnswer:
    """Returns a robot's answer, in the thread that it is asked in."""
    with call.reading(memory.large):
        return cast("OneAnswer", question(memory, call))


def _coordinates_in(given: Mapping[str, object]) -> str | None:
    """Returns the argument that has coordinates, if there is one."""
    for name in ("where", "near"):
        place = as_region(given.get(name))
        is_label = name == "near" and isinstance(place, dict) and "label" in place
        if has_coordinates(place) and not is_label:
            return name
    during = () if given.get("while") is None else as_while(given["while"])
    if any(condition.condition_type == "near_position" for condition in during):
        return "while"
    names = ["x", "y"]
    if given.get("condition_type") == "near_position":
        names.insert(0, "value")
    return next((name for name in names if given.get(name) is not None), None)
