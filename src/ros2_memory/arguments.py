"""The arguments of the tools: their types, their bounds, and what the planner reads of them.

A pair of tools (`_at` and `_seconds_ago`, `_in_range` and `_in_last`) shares one declaration, in
which a `moment` or a `span` stands for the arguments that differ; a `When` unfolds it. Types are
strict: `true` is no number and `"10"` no duration.
"""

from __future__ import annotations

import json
import math
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Annotated, ClassVar, Final, Literal, TypeAlias

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    JsonValue,
    WithJsonSchema,
)

from ros2_memory.moments import Moment, Span
from ros2_memory.recorder.keepsake import fault_of_label

if TYPE_CHECKING:
    from collections.abc import Callable

LATEST_MOMENT_S: Final = 9_223_372_036.0
"""The last second that a 64-bit clock of nanoseconds can tell; more is another unit."""


LONGEST_NAME: Final = 500
"""Characters: twice what DDS takes for a topic."""
LONGEST_VALUE: Final = 2_000
MOST_FIELDS: Final = 100
MOST_BEFORE_S: Final = 3600.0
MOST_AFTER_S: Final = 600.0
"""Of a moment that is to be kept."""


def _as_list(value: object) -> object:
    """A list as planners send it: as such, as JSON text, or as one bare name."""
    if isinstance(value, str):
        parsed = from_json(value)
        value = parsed if isinstance(parsed, list) else [value]
    if isinstance(value, list) and len(value) > MOST_FIELDS:
        raise ValueError(f"has more than {MOST_FIELDS} elements")
    return value


def from_json(text: str) -> object:
    """What a JSON text says; None where it is none, or longer than an argument may be."""
    if len(text) > MOST_FIELDS * LONGEST_NAME:
        return None
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def _whole(value: object) -> object:
    """JSON knows no integers: 100.0 is one."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _sound(value: str, longest: int) -> str:
    if len(value) > longest:
        raise ValueError(f"is longer than {longest} characters")
    if not value.isascii() and any("\ud800" <= char <= "\udfff" for char in value):
        raise ValueError("has half a character (a lone surrogate), which no recorded text has")
    return value


def _name(value: str) -> str:
    if not value.strip():
        raise ValueError("is empty")
    if "\0" in value:
        raise ValueError("has a NUL character, which no name has")
    return _sound(value, LONGEST_NAME)


def _reachable(seconds: float) -> float:
    if seconds > LATEST_MOMENT_S:
        raise ValueError("is too large for Unix seconds; is it in milliseconds or nanoseconds?")
    return seconds


def _label(value: str) -> str:
    fault = fault_of_label(value)
    if fault is not None:
        raise ValueError(fault)
    return value


def _within(most: float) -> Callable[[float], float]:
    def check(seconds: float) -> float:
        if seconds > most:
            raise ValueError(f"is more than {most:g}")
        return seconds

    return check


def _testable(value: JsonValue) -> JsonValue:
    if value is None:
        raise ValueError("is null")
    if isinstance(value, str):
        return _sound(value, LONGEST_VALUE)
    for part in (value, *(value.values() if isinstance(value, dict) else ())):
        if isinstance(part, float) and not math.isfinite(part):
            raise ValueError("is not a finite number")
    return value


_Text: TypeAlias = Annotated[str, Field(strict=True), AfterValidator(_name)]
_Duration: TypeAlias = Annotated[float, Field(strict=True, ge=0, allow_inf_nan=False)]
_Unix: TypeAlias = Annotated[_Duration, AfterValidator(_reachable)]

Timestamp: TypeAlias = Annotated[_Unix, Field(description="Unix seconds.", examples=[1784023200.5])]
SecondsAgo: TypeAlias = Annotated[
    _Duration, Field(description="Seconds before now.", examples=[10])
]
Start: TypeAlias = Annotated[_Unix, Field(description="Unix seconds.", examples=[1784023200])]
End: TypeAlias = Annotated[_Unix, Field(description="Unix seconds.", examples=[1784023260])]
Seconds: TypeAlias = Annotated[
    float,
    Field(strict=True, gt=0, allow_inf_nan=False),
    Field(description="Before now.", examples=[60]),
]
Tolerance: TypeAlias = Annotated[
    _Duration, Field(description="How old the message may be then, in s.")
]
Topic: TypeAlias = Annotated[_Text, Field(examples=["/odom"])]
PoseTopic: TypeAlias = Annotated[_Text, Field(description="Not the default.")]
ValueTopic: TypeAlias = Annotated[
    _Text, Field(description="Topic to read at the match.", examples=["/odom"])
]
SearchTopic: TypeAlias = Annotated[
    _Text,
    Field(description="Topic, or glob over topics.", examples=["/vision/*/scene_objects"]),
]
Pattern: TypeAlias = Annotated[
    _Text, Field(description="Only topics that match this glob, e.g. /vision/*.")
]
Parent: TypeAlias = Annotated[_Text, Field(description="Reference frame.", examples=["odom"])]
Child: TypeAlias = Annotated[
    _Text, Field(description="Frame whose pose is asked.", examples=["laser"])
]
Fields: TypeAlias = Annotated[
    tuple[_Text, ...],
    BeforeValidator(_as_list),
    Field(description='Parts of value, e.g. ["position.x"].'),
]
Since: TypeAlias = Annotated[_Unix, Field(description="Unix seconds.")]
Until: TypeAlias = Annotated[_Unix, Field(description="Unix seconds.")]
Within: TypeAlias = Annotated[
    float,
    Field(strict=True, gt=0, allow_inf_nan=False),
    Field(description="Only the last so many s."),
]
OldestFirst: TypeAlias = Annotated[
    bool, Field(strict=True, description="Counts all; the first are told.")
]
FrameOfPlace: TypeAlias = Annotated[
    _Text, Field(description="Of x and y, as replies name it; default: the map.")
]
Coordinate: TypeAlias = Annotated[
    float, Field(strict=True, allow_inf_nan=False), Field(examples=[1.5], description="m.")
]
Radius: TypeAlias = Annotated[
    float, Field(strict=True, gt=0, allow_inf_nan=False), Field(description="How near is there, m.")
]
Limit: TypeAlias = Annotated[
    Annotated[int, Field(strict=True, ge=1, le=100)], BeforeValidator(_whole)
]
MaxSamples: TypeAlias = Annotated[
    Annotated[int, Field(strict=True, ge=1, le=10_000)], BeforeValidator(_whole)
]
ConditionType: TypeAlias = Annotated[
    Literal["contains", "equals", "above", "below", "near_position"], Field(examples=["contains"])
]
ConditionValue: TypeAlias = Annotated[
    JsonValue,
    AfterValidator(_testable),
    WithJsonSchema(
        {
            "anyOf": [{"type": kind} for kind in ("string", "number", "boolean", "object")],
            "examples": ["scissors"],
        }
    ),
]
SearchField: TypeAlias = Annotated[
    _Text, Field(description="Dot-path in value that alone is tested.")
]
Before: TypeAlias = Annotated[_Unix, Field(description="Unix seconds; nothing after.")]
Label: TypeAlias = Annotated[
    str, Field(strict=True, examples=["charger found"]), AfterValidator(_label)
]
_Before: TypeAlias = Annotated[_Duration, AfterValidator(_within(MOST_BEFORE_S))]
_After: TypeAlias = Annotated[_Duration, AfterValidator(_within(MOST_AFTER_S))]


class Arguments(BaseModel):
    """The arguments of one question. Unknown ones are refused before a model sees them."""

    model_config = ConfigDict(frozen=True)


class When(Arguments, ABC):
    """Arguments that unfold a `moment` or a `span`; `stands_for` names which."""

    stands_for: ClassVar[str]

    @abstractmethod
    def folded(self) -> Moment | Span:
        """The moment or span that they mean."""


class At(When):
    """A moment in Unix seconds."""

    stands_for = "moment"
    timestamp: Timestamp

    def folded(self) -> Moment:
        """The moment itself."""
        return Moment(at_s=self.timestamp)


class Ago(When):
    """A moment counted back from now."""

    stands_for = "moment"
    seconds_ago: SecondsAgo

    def folded(self) -> Moment:
        """The moment, relative to now."""
        return Moment(ago_s=self.seconds_ago)


class Between(When):
    """A window in Unix seconds."""

    stands_for = "span"
    start: Start
    end: End

    def folded(self) -> Span:
        """The window itself."""
        return Span(start_s=self.start, end_s=self.end)


class Last(When):
    """A window that ends now."""

    stands_for = "span"
    seconds: Seconds

    def folded(self) -> Span:
        """The window, relative to now."""
        return Span(last_s=self.seconds)


class Nothing(Arguments):
    """No arguments."""


class Listing(Arguments):
    """Which topics are listed."""

    pattern: Pattern | None = None


class TopicAt(Arguments):
    """One message of a topic."""

    topic: Topic
    moment: Moment
    tolerance_s: Tolerance | None = None
    fields: Fields = ()


class TopicOver(Arguments):
    """Messages of a topic over a window."""

    topic: Topic
    span: Span
    max_samples: MaxSamples = 100
    fields: Fields = ()


class MotionAt(Arguments):
    """Pose or twist at a moment."""

    moment: Moment
    topic: PoseTopic | None = None
    tolerance_s: Tolerance | None = None


class TransformAt(Arguments):
    """A pair of frames at a moment."""

    parent: Parent
    child: Child
    moment: Moment


class Search(Arguments):
    """A condition on a topic."""

    topic: SearchTopic
    condition_type: ConditionType
    value: ConditionValue
    field: SearchField | None = None
    fields: Fields = ()
    before: Before | None = None


class Correlation(Arguments):
    """A condition on one topic, and another to read then."""

    value_topic: ValueTopic
    condition_topic: SearchTopic
    condition_type: ConditionType
    value: ConditionValue
    field: SearchField | None = None
    fields: Fields = ()
    before: Before | None = None


class WayOver(Arguments):
    """The way driven over a window."""

    span: Span
    topic: PoseTopic | None = None


class Window(Arguments):
    """A window."""

    span: Span


class Remember(Arguments):
    """A label, and how much around now is to be kept."""

    label: Label
    seconds_before: _Before = 30
    seconds_after: _After = 0


class OfType(Arguments):
    """A message type."""

    type: Annotated[_Text, Field(examples=["nav_msgs/msg/Odometry"])]


class Place(Arguments):
    """A place of the plane."""

    x: Coordinate
    y: Coordinate
    frame_id: FrameOfPlace | None = None
    radius_m: Radius | None = None
    limit: Limit = 10


class Matches(Arguments):
    """A condition on a topic, in a window or in all history."""

    topic: SearchTopic
    condition_type: ConditionType
    value: ConditionValue
    field: SearchField | None = None
    seconds: Within | None = None
    start: Since | None = None
    end: Until | None = None
    oldest_first: OldestFirst = False
    limit: Limit = 5


def tested(given: Search | Correlation | Matches) -> JsonValue:
    """The value of a condition: planners tend to send an object as JSON text."""
    if given.condition_type == "near_position" and isinstance(given.value, str):
        parsed = from_json(given.value)
        return parsed if isinstance(parsed, dict) else given.value
    return given.value
