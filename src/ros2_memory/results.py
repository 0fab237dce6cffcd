"""What each question is answered with, before it becomes JSON.

Times are `Ns` of log time, lengths metres, angles radians, velocities m/s and rad/s. `age` is how
long before "now" the answer's own moment lies, in nanoseconds; it is set for relative questions
only. `notes` are sentences on what was downsampled, skipped, clamped or could not be read.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ros2_memory.analysis.trajectory import Trajectory
    from ros2_memory.analysis.transform_tree import FrameEdge
    from ros2_memory.core.model import (
        Geodetic,
        Pose,
        Sample,
        SetAside,
        Transform,
        Twist,
    )
    from ros2_memory.core.timebase import Ns


@dataclass(frozen=True, slots=True)
class TopicRow:
    """One topic under one type over all bags; a message that stands twice counts once."""

    topic: str
    type: str
    first: Ns
    last: Ns
    count: int
    undecodable: str | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Undecodable:
    """A topic of which messages are recorded under a type that cannot be decoded, and why."""

    topic: str
    type: str
    reason: str


@dataclass(frozen=True, slots=True)
class Gap:
    """A hole in the memory between two bags: `end` is where data begins again."""

    start: Ns
    end: Ns


@dataclass(frozen=True, slots=True)
class DataTimeRange:
    """What the memory spans and what is wrong with it; `earliest` and `latest` None when empty."""

    earliest: Ns | None
    latest: Ns | None
    now: Ns
    bags: int
    gaps: tuple[Gap, ...]
    incomplete: tuple[SetAside, ...]
    active: tuple[SetAside, ...]
    damaged: tuple[SetAside, ...]
    unread: tuple[SetAside, ...]
    silent_topics: int
    notes: tuple[str, ...] = ()
    undecodable: tuple[Undecodable, ...] = ()
    clock_faults: tuple[SetAside, ...] = ()


@dataclass(frozen=True, slots=True)
class TopicValue:
    """One message of one topic; with `latched` it holds, however old it is.

    `age` counts back from now, where the question did, or else from the moment asked about.
    """

    topic: str
    type: str
    sample: Sample
    notes: tuple[str, ...] = ()
    age: Ns | None = None
    latched: bool = False


@dataclass(frozen=True, slots=True)
class Extremes:
    """The least and the greatest number that a field held, and when it first did."""

    field: str
    least: float
    least_at: Ns
    most: float
    most_at: Ns


@dataclass(frozen=True, slots=True)
class TopicRange:
    """Samples of a window, evenly spaced over all `total` messages in it, first and last kept.

    `extremes` are those of all messages, for the fields that were asked for and hold numbers.
    """

    topic: str
    type: str
    total: int
    samples: tuple[Sample, ...]
    notes: tuple[str, ...] = ()
    extremes: tuple[Extremes, ...] = ()


@dataclass(frozen=True, slots=True)
class Position:
    """Where the robot was, in the pose's own frame.

    `geodetic` is set for a satellite receiver, and the pose's coordinates are NaN then.
    """

    topic: str
    time: Ns
    pose: Pose
    notes: tuple[str, ...] = ()
    age: Ns | None = None
    geodetic: Geodetic | None = None


@dataclass(frozen=True, slots=True)
class Velocity:
    """How fast the robot moved, in the twist's own frame."""

    topic: str
    time: Ns
    twist: Twist
    notes: tuple[str, ...] = ()
    age: Ns | None = None


@dataclass(frozen=True, slots=True)
class TransformAt:
    """The pose of `child` in `parent` at `time`; `clock` says what that time is of.

    `clock` is `stamp` (header stamps) or `log` (log time).
    """

    parent: str
    child: str
    time: Ns
    transform: Transform
    clock: str
    notes: tuple[str, ...] = ()
    age: Ns | None = None


@dataclass(frozen=True, slots=True)
class Frames:
    """The frame graph as it was recorded."""

    edges: tuple[FrameEdge, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Match:
    """The newest message that met a condition; `found` is None after a search without a match.

    Where `found` is None and there are `notes`, the search was not complete.
    """

    found: TopicValue | None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class ValueWhen:
    """A match on one topic and what another topic held then; None where it held nothing yet."""

    matched: TopicValue | None
    value: TopicValue | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class TrajectorySummary:
    """The way driven in a window, from one pose topic in log-time order."""

    topic: str
    frame_id: str
    start: Ns
    end: Ns
    trajectory: Trajectory
    notes: tuple[str, ...] = field(default=())
