"""The arguments of the tools, one declaration for each question.

A pair of tools (`_at` and `_seconds_ago`, `_in_range` and `_in_last`) shares one declaration, in
which a `moment` or a `span` stands for the arguments that differ; a `TimeArgument` unfolds it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

from pydantic import BaseModel, ConfigDict, JsonValue

from ros2_memory.history.time_arguments import AtTime, TimeRange
from ros2_memory.tools.argument_types import (
    Before,
    Child,
    ConditionType,
    ConditionValue,
    Coordinate,
    End,
    Fields,
    FrameOfPlace,
    Label,
    Limit,
    MaxSamples,
    OldestFirst,
    Parent,
    Pattern,
    PoseTopic,
    Radius,
    SearchField,
    SearchTopic,
    Seconds,
    SecondsAfter,
    SecondsAgo,
    SecondsBefore,
    Since,
    Start,
    Timestamp,
    Tolerance,
    Topic,
    TypeName,
    Until,
    ValueTopic,
    Within,
    from_json,
)


class Arguments(BaseModel):
    """The arguments of one question. Unknown ones are refused before a model sees them."""

    model_config = ConfigDict(frozen=True)


class TimeArgument(Arguments, ABC):
    """Arguments that unfold a `moment` or a `span`; `stands_for` names which."""

    stands_for: ClassVar[str]

    @abstractmethod
    def folded(self) -> AtTime | TimeRange:
        """The moment or span that they mean."""


class At(TimeArgument):
    """A moment in Unix seconds."""

    stands_for = "moment"
    timestamp: Timestamp

    def folded(self) -> AtTime:
        """The moment itself."""
        return AtTime(at_s=self.timestamp)


class Ago(TimeArgument):
    """A moment counted back from now."""

    stands_for = "moment"
    seconds_ago: SecondsAgo

    def folded(self) -> AtTime:
        """The moment, relative to now."""
        return AtTime(ago_s=self.seconds_ago)


class Between(TimeArgument):
    """A window in Unix seconds."""

    stands_for = "span"
    start: Start
    end: End

    def folded(self) -> TimeRange:
        """The window itself."""
        return TimeRange(start_s=self.start, end_s=self.end)


class Last(TimeArgument):
    """A window that ends now."""

    stands_for = "span"
    seconds: Seconds

    def folded(self) -> TimeRange:
        """The window, relative to now."""
        return TimeRange(last_s=self.seconds)


class Nothing(Arguments):
    """No arguments."""


class Listing(Arguments):
    """Which topics are listed."""

    pattern: Pattern | None = None


class TopicAt(Arguments):
    """One message of a topic."""

    topic: Topic
    moment: AtTime
    tolerance_s: Tolerance | None = None
    fields: Fields = ()


class TopicOver(Arguments):
    """Messages of a topic over a window."""

    topic: Topic
    span: TimeRange
    max_samples: MaxSamples = 100
    fields: Fields = ()


class MotionAt(Arguments):
    """Pose or twist at a moment."""

    moment: AtTime
    topic: PoseTopic | None = None
    tolerance_s: Tolerance | None = None


class TransformAt(Arguments):
    """A pair of frames at a moment."""

    parent: Parent
    child: Child
    moment: AtTime


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

    span: TimeRange
    topic: PoseTopic | None = None


class Window(Arguments):
    """A window."""

    span: TimeRange


class Remember(Arguments):
    """A label, and how much around now is to be kept."""

    label: Label
    seconds_before: SecondsBefore = 30
    seconds_after: SecondsAfter = 0


class OfType(Arguments):
    """A message type."""

    type: TypeName


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
