"""Each argument of the tools by itself: its type, its bounds, and what the planner reads of it.

Types are strict: `true` is no number and `"10"` no duration.
"""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Annotated, Final, Literal, TypeAlias

from pydantic import AfterValidator, BeforeValidator, Field, JsonValue, WithJsonSchema

from ros2_memory.bag_dir.moment_file import fault_of_label

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


Name: TypeAlias = Annotated[str, Field(strict=True), AfterValidator(_name)]
_Duration: TypeAlias = Annotated[float, Field(strict=True, ge=0, allow_inf_nan=False)]
_Unix: TypeAlias = Annotated[
    float, Field(strict=True, allow_inf_nan=False), AfterValidator(_reachable)
]
"""Also before 1970: what reaches back too far is clamped to what is recorded."""

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
Topic: TypeAlias = Annotated[Name, Field(examples=["/odom"])]
PoseTopic: TypeAlias = Annotated[Name, Field(description="Not the default.")]
ValueTopic: TypeAlias = Annotated[
    Name, Field(description="Topic to read at the match.", examples=["/odom"])
]
SearchTopic: TypeAlias = Annotated[
    Name,
    Field(description="Topic, or glob over topics.", examples=["/vision/*/scene_objects"]),
]
Pattern: TypeAlias = Annotated[
    Name, Field(description="Only topics that match this glob, e.g. /vision/*.")
]
Parent: TypeAlias = Annotated[Name, Field(description="Reference frame.", examples=["odom"])]
Child: TypeAlias = Annotated[
    Name, Field(description="Frame whose pose is asked.", examples=["laser"])
]
Fields: TypeAlias = Annotated[
    tuple[Name, ...],
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
    Name, Field(description="Of x and y, as replies name it; default: the map.")
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
    Name, Field(description="Dot-path in value that alone is tested.")
]
Before: TypeAlias = Annotated[_Unix, Field(description="Unix seconds; nothing after.")]
Label: TypeAlias = Annotated[
    str, Field(strict=True, examples=["charger found"]), AfterValidator(_label)
]
SecondsBefore: TypeAlias = Annotated[_Duration, AfterValidator(_within(MOST_BEFORE_S))]
SecondsAfter: TypeAlias = Annotated[_Duration, AfterValidator(_within(MOST_AFTER_S))]
TypeName: TypeAlias = Annotated[Name, Field(examples=["nav_msgs/msg/Odometry"])]
