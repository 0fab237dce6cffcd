"""The arguments of the tools: a model for each query, with the bounds and what planners read.

A pair of tools (`_at` and `_seconds_ago`, `_in_range` and `_in_last`) shares one model, in which
`moment` or `span` is a placeholder for the arguments that differ; a `TimeArgument` replaces it.
Types are strict: `true` is not a number and `"10"` is not a duration.
"""

from __future__ import annotations

import json
import math
import re
from datetime import time
from functools import partial
from typing import Annotated, ClassVar, Final, Literal, TypeAlias

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    InstanceOf,
    JsonValue,
    ValidationError,
    ValidationInfo,
    WithJsonSchema,
)

from ros2_memory.analysis.conditions import ConditionType
from ros2_memory.analysis.motion.trajectory import MAX_WAYPOINTS
from ros2_memory.bag_dir.moment_file import fault_of_label
from ros2_memory.core.text import abbreviate
from ros2_memory.core.timebase import (
    hours_from_text,
    require_no_date,
    rest_of_text_s,
    rounded_off_s,
    unix_from_text,
    window_end_s,
)
from ros2_memory.history.conditions import Sought
from ros2_memory.history.view import AtTime, TimeRange
from ros2_memory.messages.conversions import with_dots

LATEST_UNIX_S: Final = 9_223_372_036.0
"""The last second that int64 nanoseconds can represent; a larger number is in another unit."""
LONGEST_NAME: Final = 500
"""Characters: twice what DDS allows for a topic."""
LONGEST_VALUE: Final = 2_000
CONDITION_KEYS: Final = ("topic", "condition_type", "value", "field")
MOST_FIELDS: Final = 100
MOST_CONDITIONS: Final = 8
"""Conditions on other topics that one call takes."""
MOST_TIMES: Final = 20
"""Moments that one call asks about."""
MOST_WAYPOINTS: Final = 200
_INCLUSIVE: Final = "Inclusive."
_OTHER_WINDOW: Final = "Of the other."
FORMS_OF_TIME: Final = "Unix s or 2026-11-20T14:05."
TIME_KINDS: Final = ("number", "string")
"""The JSON types of a time: Unix seconds, or ISO 8601 text."""
REGION_KINDS: Final = ("string", "object")
"""The JSON types of a place: its name, or its bounds."""
LONGEST_BEFORE_S: Final = 3600.0
LONGEST_AFTER_S: Final = 600.0
"""How far a saved moment may reach before and after now."""
LONGEST_REASON_S: Final = 60.0
"""How far before a time `recap` looks for changes (`around`)."""
_FOR_LONGER: Final = ": for a longer time give start and end, without around and seconds_before"


_RELATIVE: Final = re.compile(r"-.*|.*(?:ago|now)|\d+(?:\.\d+)? ?[smhd][a-z]*")
"""Times before now, as people write them."""
_WITHOUT_DATE: Final = re.compile(r"today|yesterday|\d{1,2}:\d\d")
_AGO: Final = "for a time before now give seconds_ago, seconds or last_s, where a tool has it"
_DATE: Final = "give the date, too: now_local of data_time_range has today's"
# Not today's by this machine: of replayed bags (`data.now=latest`) now is another day.


def _as_list(value: object) -> object:
    """Returns a list, which planners also send as JSON text or as one bare text."""
    value = _parsed(value, list)
    return [value] if isinstance(value, str) else value


def _as_names(value: object) -> object:
    """Returns a list of names."""
    value = _as_list(value)
    if isinstance(value, list) and len(value) > MOST_FIELDS:
        raise ValueError(f"has more than {MOST_FIELDS} elements")
    return value


def _read_time(value: object) -> object:
    """Returns Unix seconds for a text that is a time; anything else as it is."""
    if isinstance(value, int | float):
        require_no_date(value)
    if not isinstance(value, str):
        return value
    try:
        seconds = unix_from_text(value)
    except ValueError as error:
        if _RELATIVE.fullmatch(value.strip().lower()):
            raise ValueError(f"{error}; {_AGO}") from None
        if _WITHOUT_DATE.match(value.strip().lower()):
            raise ValueError(f"{error}; {_DATE}") from None
        raise
    if seconds > LATEST_UNIX_S:
        raise ValueError("is after the year 2262, up to which times are recorded")
    return seconds


def _read_until(value: object, info: ValidationInfo[object]) -> object:
    """Returns the end of a window as `_read_time` does; a text means all of its last unit.

    `14:05` means until the end of that minute.
    """
    seconds = _read_time(value)
    if not isinstance(value, str) or not isinstance(seconds, float):
        return seconds
    name = info.field_name or ""
    if "end" not in name:  # before a time, or around one
        return seconds + rounded_off_s(value)
    return window_end_s(value, seconds, info.data.get(name.replace("end", "start")))


def _read_moment(value: object) -> tuple[object, float]:
    """Returns a time as `_read_time` does, and how many seconds a text spans: 60 for `14:05`."""
    return _read_time(value), rest_of_text_s(value) if isinstance(value, str) else 0.0


def _as_times(value: object) -> object:
    """Returns a list of times, which may also be one bare number."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    value = [value] if is_number else _as_list(value)
    if isinstance(value, list) and len(value) > MOST_TIMES:
        raise ValueError(f"has {len(value)} times, more than {MOST_TIMES}")
    return value


def _parsed(value: object, *kinds: type) -> object:
    """Returns the value of a JSON text, if it is of these kinds; anything else as it is.

    Nothing is parsed that is longer than any argument.
    """
    if not isinstance(value, str) or len(value) > MOST_FIELDS * LONGEST_NAME:
        return value
    try:
        parsed: object = json.loads(value)
    except (ValueError, RecursionError):
        return value
    return parsed if isinstance(parsed, kinds) else value


def as_region(value: object) -> object:
    """Returns a region, or several, which planners also send as JSON text."""
    if isinstance(value, str):
        return _parsed(_check_text(value, LONGEST_VALUE), dict, list)
    return value


def as_while(value: object) -> tuple[Sought, ...]:
    """Returns the conditions on other topics, which planners also send as JSON text."""
    value = as_region(value)
    conditions = value if isinstance(value, list) else [value]
    if not conditions:
        raise ValueError("is an empty list: leave it out, or give a condition")
    if len(conditions) > MOST_CONDITIONS:
        raise ValueError(f"has {len(conditions)} conditions, more than {MOST_CONDITIONS}")
    return tuple(map(_while_condition, conditions))


def _while_condition(parsed: object) -> Sought:
    if not isinstance(parsed, dict):
        raise ValueError("is not an object")  # noqa: TRY004 - pydantic reports ValueError alone
    unknown = sorted(str(name) for name in parsed.keys() - CONDITION_KEYS)
    if unknown:
        raise ValueError(f"has no {abbreviate(unknown[0])}; it has {', '.join(CONDITION_KEYS)}")
    try:
        asked = ConditionArguments.model_validate(parsed)
    except ValidationError as error:
        names = dict.fromkeys(str(fault["loc"][0]) for fault in error.errors(include_url=False))
        raise ValueError(f"needs a valid {' and '.join(names)}") from None
    # Detections of any score count.
    return Sought(asked.topic, asked.condition_type, asked.value, asked.field, 0.0)


def _as_hours(value: object) -> object:
    """Returns two local times of day, which planners also send as a list, or as JSON text."""
    parsed = _parsed(value, list)
    return hours_from_text("-".join(map(str, parsed if isinstance(parsed, list) else [value])))


def _as_integer(value: object) -> object:
    """Returns 100.0 as an int, since JSON does not distinguish the two."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _check_text(value: str, longest: int) -> str:
    if len(value) > longest:
        raise ValueError(f"is longer than {longest} characters")
    if not value.isascii() and any("\ud800" <= char <= "\udfff" for char in value):
        raise ValueError("has half a character (a lone surrogate), which no recorded text has")
    return value


def _check_name(value: str) -> str:
    if not value.strip():
        raise ValueError("is empty")
    if "\0" in value:
        raise ValueError("has a NUL character, which no name has")
    return _check_text(value, LONGEST_NAME)


def _check_unix(seconds: float) -> float:
    if seconds > LATEST_UNIX_S:
        raise ValueError("is too large for Unix seconds; is it in milliseconds or nanoseconds?")
    return seconds


def _check_label(value: str) -> str:
    fault = fault_of_label(value)
    if fault is not None:
        raise ValueError(fault)
    return value


def _check_most(most: float, seconds: float, advice: str = "") -> float:
    if seconds > most:
        raise ValueError(f"is more than {most:g}{advice}")
    return seconds


def _check_condition_value(value: JsonValue, info: ValidationInfo[object]) -> object:
    if value is None:
        raise ValueError("is null")
    if isinstance(value, str):
        # Planners tend to send an object as JSON text.
        is_point = info.data.get("condition_type") == "near_position"
        return _parsed(_check_text(value, LONGEST_VALUE), dict) if is_point else value
    for part in (value, *(value.values() if isinstance(value, dict) else ())):
        if isinstance(part, float) and not math.isfinite(part):
            raise ValueError("is not a finite number")
    return value


_Name: TypeAlias = Annotated[str, Field(strict=True), AfterValidator(_check_name)]
_AtLeast0: TypeAlias = Annotated[float, Field(strict=True, ge=0, allow_inf_nan=False)]
_Positive: TypeAlias = Annotated[float, Field(strict=True, gt=0, allow_inf_nan=False)]
_Tolerance: TypeAlias = Annotated[_AtLeast0, Field(description="Oldest age, s, e.g. 2 at 1 Hz.")]
_MinScore: TypeAlias = _AtLeast0
# Times before 1970 are allowed: a search that reaches back too far finds all that is recorded.
_UnixSeconds: TypeAlias = Annotated[
    float, Field(strict=True, allow_inf_nan=False), AfterValidator(_check_unix)
]
_TIME_SCHEMA: Final = WithJsonSchema({"type": [*TIME_KINDS]})
_Time: TypeAlias = Annotated[_UnixSeconds, BeforeValidator(_read_time), _TIME_SCHEMA]
_Until: TypeAlias = Annotated[_UnixSeconds, BeforeValidator(_read_until), _TIME_SCHEMA]
_Moment: TypeAlias = Annotated[
    tuple[_UnixSeconds, float], BeforeValidator(_read_moment), _TIME_SCHEMA
]
_Start: TypeAlias = Annotated[_Time | None, Field(alias="start", description=FORMS_OF_TIME)]
_End: TypeAlias = Annotated[_Until | None, Field(alias="end", description=_INCLUSIVE)]
_FirstTime: TypeAlias = Annotated[
    _Time, Field(alias="start", description=FORMS_OF_TIME, examples=[1784023200])
]
_LastTime: TypeAlias = Annotated[
    _Until, Field(alias="end", description=_INCLUSIVE, examples=[1784023260])
]
_Before: TypeAlias = Annotated[_Until | None, Field(alias="before", description="Up to this time.")]
_Times: TypeAlias = Annotated[tuple[_Moment, ...], BeforeValidator(_as_times)]
_Topic: TypeAlias = Annotated[_Name, Field(description="E.g. /odom.", examples=["/odom"])]
_PoseTopic: TypeAlias = Annotated[_Name, Field(description="Pose topic.")]
_SearchTopic: TypeAlias = Annotated[
    _Name, Field(description="Topic or glob.", examples=["/vision/*/scene_objects"])
]
_FieldName: TypeAlias = Annotated[_Name, AfterValidator(with_dots)]
_Fields: TypeAlias = Annotated[
    tuple[_FieldName, ...],
    BeforeValidator(_as_names),
    Field(description='Only these: ["position.x"].'),
]
_Labels: TypeAlias = Annotated[
    tuple[_Name, ...],
    BeforeValidator(_as_names),
    WithJsonSchema({"type": ["string", "array"], "items": {"type": "string"}, "examples": ["mug"]}),
]
_Coordinate: TypeAlias = Annotated[
    float, Field(strict=True, allow_inf_nan=False), Field(examples=[1.5], description="m.")
]
_Region: TypeAlias = Annotated[JsonValue, BeforeValidator(as_region)]
_REGION_SCHEMA: Final[dict[str, JsonValue]] = {
    "type": [*REGION_KINDS],
    "examples": ["kitchen", "kitchen, hall", {"den": {"x": [0, 5], "y": [0, 9]}}],
}


def _region(description: str, **schema: JsonValue) -> WithJsonSchema:
    """Returns the schema of a place: its name, or its bounds."""
    return WithJsonSchema({**_REGION_SCHEMA, **schema, "description": description})


_Where: TypeAlias = Annotated[_Region, _region("Of the robot; forms: trajectory_summary.")]
_WhereInFull: TypeAlias = Annotated[
    _Region,
    _region(
        "Where the robot was: kitchen | {x, y, radius_m} | {x: [0, 5], y: [0, 9]}; in any of "
        "several: kitchen, hall | {den: {x: [0, 5], ...}}."
    ),
]
_WhereOfThings: TypeAlias = Annotated[_Region, _region("Of the things; forms: trajectory_summary.")]
_WhereOfBoth: TypeAlias = Annotated[
    _Region, _region("Of robot and things; forms: trajectory_summary.")
]
_Point: TypeAlias = Annotated[
    _Region, _region("Point {x, y} or place.", examples=[{"x": 1.5, "y": 0.5}])
]
_Near: TypeAlias = Annotated[
    _Region,
    _region(
        "{label: table, radius_m: 1} or {x, y, radius_m}.",
        type=["object", "string"],
        examples=[{"label": "table", "radius_m": 1.0}],
    ),
]
_Between: TypeAlias = Annotated[
    tuple[time, time],
    BeforeValidator(_as_hours),
    WithJsonSchema(
        {
            "type": "string",
            "description": "e.g. 19:00-22:00, local, daily.",
            "examples": ["19:00-22:00"],
        }
    ),
]
_FrameId: TypeAlias = Annotated[_Name, Field(description="Of the reply.")]
_Limit: TypeAlias = Annotated[
    int,
    Field(strict=True, ge=1, le=100),
    BeforeValidator(_as_integer),
]
_ConditionType: TypeAlias = Annotated[
    ConditionType,
    Field(examples=["contains"]),
]
_ConditionValue: TypeAlias = Annotated[
    JsonValue,
    AfterValidator(_check_condition_value),
    WithJsonSchema(
        {
            "type": ["string", "number", "boolean", "object"],
            "description": "near_position: {x, y}.",
            "examples": ["scissors"],
        }
    ),
]
_SearchField: TypeAlias = Annotated[_FieldName, Field(description="E.g. status[name=arm].level.")]


_By: TypeAlias = Annotated[
    Literal["day", "hour", "weekday", "place"],
    Field(description="Rows, local; place: of where, else named."),
]


_ByValue: TypeAlias = Annotated[
    Literal["day", "hour", "weekday", "place", "value"],
    Field(description="Rows, local; place: of where, else named; value: that held."),
]
_ByInMatches: TypeAlias = Annotated[
    Literal["day", "hour", "weekday", "place", "label", "value"],
    Field(
        description="Rows, local; place: of where, else named; value: that held; "
        'label: seen (value "" for all).'
    ),
]


def _while(description: str) -> WithJsonSchema:
    """Returns the schema of conditions on other topics."""
    return WithJsonSchema(
        {
            "type": ["object", "array"],
            "items": {"type": "object"},
            "description": description,
            "examples": [{"topic": "/is_docked", "condition_type": "equals", "value": False}],
        }
    )


_Conditions: TypeAlias = Annotated[tuple[InstanceOf[Sought], ...], BeforeValidator(as_while)]
_While: TypeAlias = Annotated[_Conditions, _while("Forms: trajectory_summary.")]
_WhileInFull: TypeAlias = Annotated[
    _Conditions,
    _while(
        "Only while a topic meets this, e.g. "
        '{"topic": "/is_docked", "condition_type": "equals", "value": false}; of a list, all.'
    ),
]


class Arguments(BaseModel):
    """The arguments of one query. Its parameters have the names of the fields.

    An alias is the name that clients see. `Signature` has refused unknown names before.
    """

    # Few of them are needed by a program that asks one question: each is built when it is used.
    model_config = ConfigDict(frozen=True, defer_build=True)

    def for_query(self) -> dict[str, object]:
        """Returns the arguments of the query; those of a condition are one."""
        given = dict(self)
        if "condition_type" not in given:
            return given
        sought = Sought._make(given.pop(name) for name in Sought._fields)
        return {"sought": sought, **given}


class TimeArgument(Arguments):
    """The arguments that replace a placeholder of `Arguments`.

    Attributes:
        replaces: the placeholder, `moment` or `span`.
        text: replaces {when} in a tool's description.
        either: names of arguments; exactly one of them must be given.
    """

    replaces: ClassVar[str]
    text: ClassVar[str]
    either: ClassVar[tuple[str, ...]] = ()

    def replacement(self) -> object:
        """Returns the value of the placeholder."""
        return dict(self)


class At(TimeArgument):
    """A time, or several."""

    replaces = "moment"
    text = "at a time"
    either = ("timestamp", "timestamps")
    one: _Moment | None = Field(
        default=None, alias="timestamp", description=FORMS_OF_TIME, examples=[1784023200.5]
    )
    several: Annotated[_Times, Field(description=f"Up to {MOST_TIMES} times.")] = Field(
        default=(), alias="timestamps"
    )

    def replacement(self) -> AtTime:
        """Returns the moment, or several in one."""
        if self.one:
            at_s, rest_s = self.one
            return AtTime(at_s, rest_s=rest_s)
        return AtTime(each=tuple(AtTime(at_s, rest_s=rest_s) for at_s, rest_s in self.several))


class Ago(TimeArgument):
    """A time some seconds before now."""

    replaces = "moment"
    text = "some seconds ago, with age_s"
    ago_s: Annotated[_AtLeast0, Field(examples=[10], alias="seconds_ago")]


class Between(TimeArgument):
    """A window between two times."""

    replaces = "span"
    text = "between two times"
    start_s: _FirstTime
    end_s: _LastTime


class RecapTime(TimeArgument):
    """A window that ends now, a window between two times, or the seconds before a time."""

    replaces = "span"
    text = "in the last_s, between two times, or around a moment"
    either = ("last_s", "start", "around")
    last_s: Annotated[_Positive, Field(description="Up to now.", examples=[60])] | None = None
    start_s: _Start = Field(default=None, examples=[1784023200])
    end_s: _End = Field(default=None, examples=[1784023260])
    around_s: _Until | None = Field(
        default=None,
        alias="around",
        description="What changed before and after.",
        examples=[1784023230],
    )
    before_s: Annotated[
        _Positive,
        AfterValidator(partial(_check_most, LONGEST_REASON_S, advice=_FOR_LONGER)),
        Field(description="How far before it."),
    ] = Field(default=10, alias="seconds_before")


class Last(TimeArgument):
    """A window that ends now."""

    replaces = "span"
    text = "in the last seconds"
    last_s: Annotated[_Positive, Field(examples=[60], alias="seconds")]


class Window(TimeArgument):
    """A window of which either end may be open."""

    replaces = "span"
    text = ""
    start_s: _Start = None
    end_s: _End = None


class LastOrWindow(TimeArgument):
    """A window that ends now, or one of which either end may be open."""

    replaces = "span"
    text = ""
    last_s: Annotated[_Positive, Field(description="Up to now.")] | None = Field(
        default=None, alias="seconds"
    )
    start_s: _Start = None
    end_s: _End = None


class NoArguments(Arguments):
    """No arguments."""


class RecordedTimesArguments(Arguments):
    """The window in which gaps, silences and steps of the clock are listed."""

    span: TimeRange


class TopicListArguments(Arguments):
    """Which topics are listed."""

    pattern: Annotated[_Name, Field(description="A glob, e.g. /vision/*.")] | None = None


class TopicAtArguments(Arguments):
    """A topic at a moment."""

    topic: _Topic
    moment: AtTime
    tolerance_s: _Tolerance | None = None
    fields: _Fields = ()


class TopicRangeArguments(Arguments):
    """A topic over a window."""

    topic: _Topic
    span: TimeRange
    max_samples: Annotated[
        int,
        Field(strict=True, ge=1, le=10_000),
        BeforeValidator(_as_integer),
    ] = 100
    fields: _Fields = ()
    changes: (
        Annotated[bool, Field(strict=True, description="One row per change of value.")] | None
    ) = None
    by: _ByValue | None = None
    between: _Between | None = None


class MotionArguments(Arguments):
    """A pose or twist at a moment."""

    moment: AtTime
    topic: _PoseTopic | None = None
    tolerance_s: _Tolerance | None = None


class PositionArguments(MotionArguments):
    """A pose at a moment."""

    frame_id: _FrameId | None = None


class TransformArguments(Arguments):
    """Two frames at a time."""

    parent: Annotated[_Name, Field(description="Reference frame.", examples=["odom"])]
    child: Annotated[_Name, Field(description="Frame to locate.", examples=["laser"])]
    moment: AtTime


class ConditionArguments(Arguments):
    """A condition on a topic."""

    topic: _SearchTopic
    condition_type: _ConditionType
    value: _ConditionValue
    field: _SearchField | None = None
    min_score: _MinScore | None = None


class LastMatchArguments(ConditionArguments):
    """A condition on a topic; the last match is returned."""

    fields: _Fields = ()
    before_s: _Before = None


class ValueWhenArguments(Arguments):
    """A condition on one topic, and another topic to read at the match."""

    value_topic: Annotated[_Name, Field(description="Topic to read then.", examples=["/odom"])]
    topic: _SearchTopic = Field(alias="condition_topic")
    condition_type: _ConditionType
    value: _ConditionValue
    field: _SearchField | None = None
    min_score: _MinScore | None = None
    fields: _Fields = ()
    before_s: _Before = None


class TrajectoryArguments(Arguments):
    """A path over a window."""

    span: TimeRange
    topic: _PoseTopic | None = None
    where: _WhereInFull | None = None
    frame_id: _FrameId | None = None
    max_waypoints: Annotated[
        int,
        Field(strict=True, ge=0, le=MOST_WAYPOINTS, description="Corners."),
        BeforeValidator(_as_integer),
    ] = MAX_WAYPOINTS
    farthest: _Point | None = Field(default=None, alias="farthest_from")
    by: _By | None = None
    during: _WhileInFull = Field(default=(), alias="while")
    between: _Between | None = None


class RecapArguments(Arguments):
    """A window or a moment, and a place."""

    span: TimeRange
    where: _Where | None = None
    frame_id: _FrameId | None = None
    min_score: _MinScore | None = None
    between: _Between | None = None


class SaveMomentArguments(Arguments):
    """A label, and how many seconds before and after now to save."""

    label: Annotated[
        str,
        Field(strict=True, description="A few words.", examples=["charger found"]),
        AfterValidator(_check_label),
    ]
    seconds_before: Annotated[
        _AtLeast0,
        AfterValidator(partial(_check_most, LONGEST_BEFORE_S)),
        Field(description="Before now."),
    ] = 30
    seconds_after: Annotated[
        _AtLeast0,
        AfterValidator(partial(_check_most, LONGEST_AFTER_S)),
        Field(description="After now."),
    ] = 0


class TypeArguments(Arguments):
    """A message type."""

    type_name: Annotated[_Name, Field(alias="type", examples=["nav_msgs/msg/Odometry"])]


class MomentArguments(Arguments):
    """A saved moment."""

    name: Annotated[_Name, Field(alias="moment")]


class SelectArguments(Arguments):
    """A statement over the tables of a lake, and the robots that it is about."""

    select: Annotated[
        str,
        Field(
            strict=True,
            max_length=20_000,
            description="One SELECT.",
            examples=["SELECT robot, sum(distance_m) FROM bags GROUP BY robot"],
        ),
    ]
    robot: Annotated[
        str | None, Field(strict=True, description="Its name, or several (a, b); without it, all.")
    ] = None
    limit: Annotated[
        int,
        Field(strict=True, ge=1, le=1000),
        BeforeValidator(_as_integer),
    ] = 100


class VisitsArguments(Arguments):
    """A place in the plane."""

    x: _Coordinate | None = None
    y: _Coordinate | None = None
    where: _Where | None = None
    span: TimeRange
    frame_id: Annotated[_Name, Field(description="Of x, y; default: the map.")] | None = None
    radius_m: _Positive | None = None
    limit: _Limit = 10
    by: _By | None = None
    during: _While = Field(default=(), alias="while")
    between: _Between | None = None


class MatchesArguments(ConditionArguments):
    """A condition on a topic, in a window or in all history."""

    fields: _Fields = ()
    span: TimeRange
    oldest_first: Annotated[bool, Field(strict=True, description="With total.")] = False
    limit: _Limit = 5
    by: _ByInMatches | None = None
    beside: Annotated[_Name, Field(description="What topic or /topic.field said.")] | None = Field(
        default=None, alias="with", examples=["/action"]
    )
    where: _Where | None = None
    during: _While = Field(default=(), alias="while")
    frame_id: _FrameId | None = None
    between: _Between | None = None


class ThingsArguments(Arguments):
    """Which things, where, and when."""

    labels: _Labels = Field(default=(), alias="label", description="Whole labels.")
    where: _WhereOfThings | None = None
    near: _Near | None = None
    span: TimeRange
    min_score: _MinScore | None = None
    limit: _Limit = 12


class CompareArguments(Arguments):
    """Two windows to compare."""

    start_s: _FirstTime
    end_s: _LastTime
    with_start_s: Annotated[
        _Time, Field(alias="with_start", description=_OTHER_WINDOW, examples=[1783936800])
    ]
    with_end_s: Annotated[
        _Until, Field(alias="with_end", description=_OTHER_WINDOW, examples=[1783936860])
    ]
    where: _WhereOfBoth | None = None
