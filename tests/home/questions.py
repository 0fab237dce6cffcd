"""Sixty questions of an owner, each with its truth, and the calls that a script answers it by.

A question is asked at the end of the data. `calls` may not need a sum by hand: `read` takes values
out of replies as they stand. What a call may be given is in the question, never in another reply.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from tests.home.days import CLOCK_STEP_S, Scale
from tests.home.judging import Answer, Expected, Time
from tests.home.replies import Row
from tests.home.things import DAY
from tests.home.truth import PlaceOfThing, ThingTruth, Truth, truth_of
from tests.home.world import START_S, World, world_of

if TYPE_CHECKING:
    from ros2_memory.core.model import JsonValue

KINDS: Final = ("spatial", "temporal", "counting", "change", "routine", "why", "reliability")
Reader: TypeAlias = Callable[[Sequence[Row]], Answer]


class ToolCall(NamedTuple):
    """One call of the script."""

    tool: str
    arguments: Mapping[str, JsonValue]


@dataclass(frozen=True, slots=True)
class Question:
    """A question in words; `truth` has what each field of the answer must be."""

    id: str
    kind: str
    text: str
    truth: Mapping[str, Expected]
    calls: tuple[ToolCall, ...]
    read: Reader


@dataclass(frozen=True, slots=True)
class Asked:
    """What questions are made of: the world, the truth about it, and the calendar."""

    world: World
    truth: Truth

    @property
    def last(self) -> int:
        """Returns the number of the day on which is asked."""
        return self.world.scale.days - 1

    @property
    def split_s(self) -> float:
        """Returns how long a split is; what is known of a moment is known to within one."""
        return self.world.scale.split_s

    def day(self, number: int, hour: float = 0.0) -> float:
        """Returns a moment of a day; day 0 is the first, and days before it are day 0."""
        return START_S + max(number, 0) * DAY + hour * 3600.0

    @property
    def today(self) -> dict[str, JsonValue]:
        """Returns the time since midnight, as tools take it."""
        return {"start": self.day(self.last), "end": self.day(self.last + 1)}

    @property
    def yesterday(self) -> dict[str, JsonValue]:
        """Returns the day before, as tools take it."""
        return {"start": self.day(self.last - 1), "end": self.day(max(self.last, 1))}

    @property
    def all_days(self) -> dict[str, JsonValue]:
        """Returns all the time, as tools take it."""
        return {"start": self.day(0), "end": self.day(self.last + 1)}

    def thing(self, label: str) -> ThingTruth:
        """Returns the only thing of a label."""
        (thing,) = self.truth.of(label)
        return thing

    def since(self, stays: Sequence[PlaceOfThing]) -> Time:
        """Returns since when a thing stands at the last of its known places.

        It was moved after it was last seen at the place before; that it was moved is known when it
        is next seen.
        """
        first = stays[-1].sight.first_detected or 0.0
        before = stays[-2].sight.last_detected if len(stays) > 1 else None
        return Time((before or stays[-1].start) - 1.0, first + self.split_s)

    def at(self, moment: float) -> tuple[float, float]:
        """Returns where the robot is in the map at a moment of its clock."""
        t = moment - START_S
        if moment >= self.truth.clock_step + CLOCK_STEP_S:
            t -= CLOCK_STEP_S
        pose = self.world.robot(np.array([t]))
        return float(pose.x[0]), float(pose.y[0])


def ask(tool: str, **arguments: JsonValue) -> tuple[ToolCall, ...]:
    """Returns the one call of a question."""
    return (ToolCall(tool, arguments),)


def in_words(moment: float) -> str:
    """Returns a moment as an owner writes it: "08:12:30 on 3 March"."""
    at = datetime.fromtimestamp(moment, UTC)
    return f"{at:%H:%M:%S} on {at.day} {at:%B}"


def questions(scale: Scale) -> list[Question]:
    """Returns the questions about the world of a scale.

    Raises:
        ValueError: it has one day, which is to be compared with no other.
    """
    if scale.days < 2:
        raise ValueError("the questions need 2 days or more")
    # Their makers import this module.
    from tests.home import about_places, about_reasons, about_things  # noqa: PLC0415

    asked = Asked(world_of(scale), truth_of(scale))
    found = [
        *about_things.questions(asked),
        *about_places.questions(asked),
        *about_reasons.questions(asked),
    ]
    return sorted(found, key=lambda each: KINDS.index(each.kind))
