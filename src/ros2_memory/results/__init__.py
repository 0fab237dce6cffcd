"""Results: what queries and insights return. The class of a result declares its JSON, too.

Times are `Ns` of log time, lengths metres, angles radians, velocities m/s and rad/s. `age` is how
long before "now" the answer's own moment lies, in nanoseconds; it is set for relative questions
only. `now` is what ages count from. `reply` of a class are the keys of its JSON, with their units
(`core/reply.py`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from ros2_memory.core.errors import NoDataError, NoDataReason
from ros2_memory.core.reply import PLAIN, TIME, AnswerWithNotes, JsonObject, result
from ros2_memory.results.memory import (
    ANOTHER,
    Budget,
    DataTimeRange,
    FiredRule,
    Gap,
    MomentList,
    RememberedMoment,
    ShownMoment,
    SilentTopic,
    Status,
    Undecodable,
)
from ros2_memory.results.motion import (
    DrivenInside,
    FarthestPose,
    Frames,
    PlaceVisits,
    Position,
    TrajectorySummary,
    TransformAt,
    Velocity,
    Visit,
    Visits,
)
from ros2_memory.results.recap import Before, Changes, Episode, Event, PastChange, Recap, Spell
from ros2_memory.results.things import (
    ComparedMover,
    ComparedThing,
    ComparedThings,
    Comparison,
    Pair,
    StandstillPlace,
    StillThere,
    Thing,
    Things,
    ThingStay,
    UsualPlace,
)
from ros2_memory.results.topics import (
    BinColumn,
    Bins,
    Extremes,
    LabelledPlace,
    Match,
    Sighting,
    Sightings,
    TopicRange,
    TopicRow,
    TopicValue,
    TypeFields,
    Usual,
    ValueWhen,
)

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.core.model import JsonValue
    from ros2_memory.core.timebase import Ns

MomentAnswer: TypeAlias = TopicValue | Position | Velocity | TransformAt
"""An answer about one moment."""


@result(TIME("at"), PLAIN("error", "code"), PLAIN("reason", "reason.value"), "detail")
class NothingAt(AnswerWithNotes):
    """Stands for an answer at one of several times that has no data: the reason."""

    at: Ns
    reason: NoDataReason
    detail: str

    @property
    def code(self) -> str:
        """The code of the error that a question about this time alone would get."""
        return NoDataError.code


@result()
class AtEach(AnswerWithNotes):
    """The answers for several times, in the order given."""

    answers: tuple[MomentAnswer | NothingAt, ...]


class InWindow(NamedTuple):
    """The answer for one of several windows, half-open."""

    start: Ns
    stop: Ns
    answer: OneAnswer


@result()
class InEach(AnswerWithNotes):
    """The answers for several windows in the order of time; not `is_all` if time ran out."""

    windows: tuple[InWindow, ...]
    is_all: bool = True


OneAnswer: TypeAlias = (
    AnswerWithNotes | tuple[TopicRow, ...] | RememberedMoment | MomentList | ShownMoment
)


@result()
class OfRobot:
    """The answer of one robot of a fleet.

    Attributes:
        name: of the robot.
        bag_dir: files are named relative to it.
        answer: of the robot.
        notes: sentences on where the answer was found.
        now: what ages count from; None for the wall clock.
    """

    name: str
    bag_dir: Path
    answer: OneAnswer
    notes: tuple[str, ...] = ()
    now: Ns | None = None


@result()
class OfFleet:
    """The answers of several robots as one JSON value."""

    value: JsonObject


Answer: TypeAlias = OneAnswer | OfRobot | OfFleet
