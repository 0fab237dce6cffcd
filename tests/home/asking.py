"""Questions of an owner, each with the call that a script asks it by, and what its reply must have.

A question is asked at the end of the data. Nothing is reckoned: values are compared as they stand
in the reply. What a call may be given is in the question, never in another reply.
"""

import asyncio
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest

from ros2_memory.bootstrap import build_backfill, build_memory, build_server
from ros2_memory.cli.maintenance.index import fill_store
from ros2_memory.config import Settings, load_settings
from ros2_memory.core.logging_setup import configure_logging
from ros2_memory.serving.mcp_server import EpisodicServer
from tests.home.days import CLOCK_STEP_S
from tests.home.things import DAY
from tests.home.truth import PlaceOfThing, ThingTruth, Truth
from tests.home.world import START_S, World

Row: TypeAlias = "dict[str, Any]"
SINCE = ("since", "from", "first_seen")


@dataclass(frozen=True)
class Words:
    """A text that holds one of some words, if there are any; else none of others."""

    any_of: tuple[str, ...]
    none_of: tuple[str, ...] = ()

    def __call__(self, given: object) -> bool:
        """Returns whether the text of a value is right."""
        text = json.dumps(given).casefold()
        is_any = not self.any_of or any(word in text for word in self.any_of)
        return is_any and not any(word in text for word in self.none_of)


@dataclass(frozen=True)
class Names:
    """A set of names: all of some, and besides them none but those of others."""

    all_of: frozenset[str]
    maybe: frozenset[str] = frozenset()

    def __call__(self, given: Sequence[str]) -> bool:
        """Returns whether the set is right; names may come twice, and in any order."""
        return self.all_of <= {*given} <= self.all_of | self.maybe


@dataclass(frozen=True)
class Series:
    """A value for each of some names; a name that is left out counts as 0."""

    values: Mapping[str, object]

    def __call__(self, given: Mapping[str, Any]) -> bool:
        """Returns whether every value is right, and no other name has one but 0."""
        return not any(value for name, value in given.items() if name not in self.values) and all(
            given.get(name, 0) == expected for name, expected in self.values.items()
        )


@dataclass(frozen=True)
class Question:
    """A question in words, the call of the script, and what its reply must have."""

    text: str
    tool: str
    arguments: Mapping[str, Any]
    checks: Sequence[tuple[object, str | Callable[[Row], Any]]]
    """What a value must equal or satisfy, and where it is: keys with dots, or what finds it."""

    def wrong(self, reply: Row) -> list[tuple[object, object]]:
        """Returns the values of a reply that are wrong, each with what it must be."""
        given = [(_value(reply, where), expected) for expected, where in self.checks]
        return [(value, expected) for value, expected in given if not _is(value, expected)]


def _is(value: object, expected: object) -> bool:
    return bool(expected(value) if callable(expected) else value == expected)


def _value(reply: Any, where: str | Callable[[Row], Any]) -> Any:
    if callable(where):
        return where(reply)
    for key in where.split("."):
        reply = reply[int(key) if key.isdigit() else key]
    return reply


@dataclass(frozen=True)
class Asked:
    """What questions are made of: the world, the truth about it, and the calendar."""

    world: World
    truth: Truth

    @property
    def last(self) -> int:
        """Returns the number of the day on which is asked."""
        return self.world.scale.days - 1

    def day(self, number: int, hour: float = 0.0) -> float:
        """Returns a moment of a day; day 0 is the first, and days before it are day 0."""
        return START_S + max(number, 0) * DAY + hour * 3600.0

    def days(self, first: int, after: int) -> Row:
        """Returns the time from one midnight to another, as tools take it."""
        return {"start": self.day(first), "end": self.day(after)}

    @property
    def today(self) -> Row:
        """Returns the time since midnight."""
        return self.days(self.last, self.last + 1)

    @property
    def all_days(self) -> Row:
        """Returns all the time."""
        return self.days(0, self.last + 1)

    def thing(self, label: str) -> ThingTruth:
        """Returns the only thing of a label."""
        (thing,) = self.truth.of(label)
        return thing

    def since(self, stays: Sequence[PlaceOfThing]) -> object:
        """Returns since when a thing stands at the last of its known places.

        It was moved after it was last seen at the place before; that it was moved is known when it
        is next seen, to within a split.
        """
        first = stays[-1].sight.first_detected or 0.0
        before = stays[-2].sight.last_detected if len(stays) > 1 else None
        return between((before or stays[-1].start) - 1.0, first + self.world.scale.split_s)

    def at(self, moment: float) -> tuple[float, float]:
        """Returns where the robot is in the map at a moment of its clock."""
        t = moment - START_S
        if moment >= self.truth.clock_step + CLOCK_STEP_S:
            t -= CLOCK_STEP_S
        pose = self.world.robot(np.array([t]))
        return float(pose.x[0]), float(pose.y[0])


def near(value: float, within: float) -> object:
    """Returns what is equal to a number that is right within a tolerance."""
    return pytest.approx(value, abs=within + 1e-9)


def between(earliest: float, latest: float) -> object:
    """Returns what is equal to a number that lies between two others."""
    return near((earliest + latest) / 2, (latest - earliest) / 2)


def in_words(moment: float) -> str:
    """Returns a moment as an owner writes it: "08:12:30 on 3 March"."""
    at = datetime.fromtimestamp(moment, UTC)
    return f"{at:%H:%M:%S} on {at.day} {at:%B}"


def stays(thing: Row) -> list[Row]:
    """Returns the places of a thing, oldest first; a thing that was not moved has one."""
    return sorted(thing.get("moved", [thing]), key=since)


def since(stay: Row) -> float:
    """Returns since when a thing is at a place."""
    return next(float(stay[name]) for name in SINCE if name in stay)


def bins(name: str) -> Callable[[Row], Row]:
    """Returns a reader of a column, also as what is said of a field (`charge.min`), by its bins."""

    def read(reply: Row) -> Row:
        [at] = [nth for nth, column in enumerate(reply["columns"]) if column.split(".")[-1] == name]
        return {str(row[0]): _plain(row[at]) for row in reply["rows"]}

    return read


def _plain(value: Any) -> Any:
    """Returns a value, a local time as Unix seconds."""
    return datetime.fromisoformat(value).timestamp() if isinstance(value, str) else value


def settings_for(world: Path, split_s: float) -> Settings:
    """Returns the shipped configuration over the bags of a world, with its places and labels."""
    configure_logging("error", "json")
    shipped = [
        f"recording.bag_dir='{world / 'bags'}'",
        f"recording.split_duration_s={split_s:g}",
        "data.now=latest",
        "logging.level=error",
    ]
    own = [f"data.{kind}_file='{world / kind}.yaml'" for kind in ("places", "labels")]
    return load_settings([*shipped, *own], env={})


def server_over(settings: Settings) -> EpisodicServer:
    """Returns a server that has every bag stored."""
    memory = build_memory(settings)
    memory.index.refresh()
    fill_store(build_backfill(settings, memory))
    return build_server(settings, memory)


def text_of(server: EpisodicServer, tool: str, arguments: Mapping[str, Any]) -> str:
    """Returns the text of a reply."""
    reply = asyncio.run(server.dispatcher.answer(tool, arguments))
    assert not reply.is_error, (tool, arguments, reply.text)
    return reply.text


def replies_to(server: EpisodicServer, questions: Sequence[Question]) -> list[str]:
    """Returns the texts of the replies."""
    return [text_of(server, each.tool, each.arguments) for each in questions]


def missed(questions: Sequence[Question], replies: Sequence[str]) -> Row:
    """Returns the questions whose answer is not right, and what is wrong of it."""
    found: Row = {}
    for question, text in zip(questions, replies, strict=True):
        reply = json.loads(text)
        try:
            wrong: object = question.wrong(reply)
        except (LookupError, TypeError, ValueError) as error:
            wrong = repr(error)
        if wrong:
            found[question.text] = wrong
    return found
