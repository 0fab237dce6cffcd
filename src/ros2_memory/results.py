"""Results: what queries and insights return, before it becomes JSON.

Times are `Ns` of log time, lengths metres, angles radians, velocities m/s and rad/s. `age` is how
long before "now" the answer's own moment lies, in nanoseconds; it is set for relative questions
only. `now` is what ages count from.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from ros2_memory.analysis.clock_steps import ClockStep
    from ros2_memory.analysis.motion.trajectory import Trajectory, Waypoint
    from ros2_memory.analysis.silences import Silence
    from ros2_memory.analysis.transform_tree import FrameEdge
    from ros2_memory.bag_dir.moment_file import StoredMoment
    from ros2_memory.core.errors import NoDataReason
    from ros2_memory.core.model import (
        Geodetic,
        JsonValue,
        Pose,
        Sample,
        SetAside,
        Transform,
        Twist,
        Vector3,
    )
    from ros2_memory.core.timebase import Ns


@dataclass(frozen=True, slots=True, kw_only=True)
class AnswerWithNotes:
    """What most questions return.

    `notes` are sentences on what was downsampled, left out, clamped or could not be read.
    """

    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class TopicRow:
    """One topic under one type over all bags; each message counts once."""

    topic: str
    type: str
    first: Ns
    last: Ns
    count: int
    undecodable: str | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Undecodable:
    """A topic with messages under a type that cannot be decoded, and why."""

    topic: str
    type: str
    reason: str


@dataclass(frozen=True, slots=True)
class Gap:
    """A time without a bag; `end` is where data begins again.

    `deleted` is how much of it was recorded, and deleted by retention since.
    """

    start: Ns
    end: Ns
    deleted: Ns = 0


@dataclass(frozen=True, slots=True)
class DataTimeRange(AnswerWithNotes):
    """The recorded time range, and unreadable files; no times if nothing is recorded."""

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
    undecodable: tuple[Undecodable, ...] = ()
    clock_faults: tuple[SetAside, ...] = ()
    silences: tuple[Silence, ...] = ()
    clock_steps: tuple[ClockStep, ...] = ()


@dataclass(frozen=True, slots=True)
class TopicValue(AnswerWithNotes):
    """One message of one topic; with `latched` it is valid at any age.

    `age` counts back from now for a relative question, else from the time asked about. `frame_id`
    is that of the message's header; empty where it has none.
    """

    topic: str
    type: str
    sample: Sample
    age: Ns | None = None
    latched: bool = False
    frame_id: str = ""


@dataclass(frozen=True, slots=True)
class Extremes:
    """The minimum and maximum of a field, and the first time of each."""

    field: str
    least: float
    least_at: Ns
    most: float
    most_at: Ns


@dataclass(frozen=True, slots=True)
class TopicRange(AnswerWithNotes):
    """Samples of a window, evenly spaced over all `total` messages in it, with the first and last.

    Their values are objects by `fields`, if any were requested. `extremes` are those of all
    messages, for the requested numeric fields.
    """

    topic: str
    type: str
    total: int
    samples: tuple[Sample, ...]
    extremes: tuple[Extremes, ...] = ()
    fields: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Position(AnswerWithNotes):
    """Where the robot was, in the pose's own frame.

    `geodetic` is set for a satellite receiver; the pose's coordinates are NaN then.
    """

    topic: str
    time: Ns
    pose: Pose
    age: Ns | None = None
    geodetic: Geodetic | None = None


@dataclass(frozen=True, slots=True)
class Velocity(AnswerWithNotes):
    """How fast the robot moved, in the twist's own frame."""

    topic: str
    time: Ns
    twist: Twist
    age: Ns | None = None


@dataclass(frozen=True, slots=True)
class TransformAt(AnswerWithNotes):
    """The pose of `child` in `parent` at `time`.

    `clock` is what `time` is in: `stamp` (header stamps) or `log` (log time).
    """

    parent: str
    child: str
    time: Ns
    transform: Transform
    clock: str
    age: Ns | None = None


MomentAnswer: TypeAlias = TopicValue | Position | Velocity | TransformAt
"""An answer about one moment."""


@dataclass(frozen=True, slots=True)
class NothingAt(AnswerWithNotes):
    """The answer for one of several times without data: the reason."""

    at: Ns
    reason: NoDataReason
    detail: str


@dataclass(frozen=True, slots=True)
class AtEach(AnswerWithNotes):
    """The answers for several times, in the order given."""

    answers: tuple[MomentAnswer | NothingAt, ...]


@dataclass(frozen=True, slots=True)
class Frames(AnswerWithNotes):
    """The frame graph as it was recorded."""

    edges: tuple[FrameEdge, ...]


@dataclass(frozen=True, slots=True)
class Match(AnswerWithNotes):
    """The newest message that met a condition; `found` is None after a search without a match.

    Where `found` is None and there are `notes`, the search was not complete.
    """

    found: TopicValue | None


@dataclass(frozen=True, slots=True)
class ValueWhen(AnswerWithNotes):
    """A match on one topic, and the value of another at that time; None if it had none yet."""

    matched: TopicValue | None
    value: TopicValue | None = None


@dataclass(frozen=True, slots=True)
class TrajectorySummary(AnswerWithNotes):
    """The driven path in a window, from one pose topic in log-time order.

    `skipped`: how much of the time from its first to its last pose the clock skipped. `unrecorded`:
    for how much of the rest no poses were recorded.
    """

    topic: str
    frame_id: str
    start: Ns
    end: Ns
    trajectory: Trajectory
    skipped: Ns = 0
    unrecorded: Ns = 0


@dataclass(frozen=True, slots=True)
class DrivenInside(AnswerWithNotes):
    """The path driven inside a region in a window.

    Attributes:
        topic: of the poses.
        frame_id: of the waypoints.
        where: the region's name, or its bounds.
        visits: how often the robot was inside; `duration` is how long in all.
        start: log time at which the first visit began; None where there was none.
        end: at which the last one ended.
        distance_m: metres driven inside.
        max_speed: over a second (m/s).
        waypoints: of the drawn path; `jump` marks the first of a visit.
    """

    topic: str
    frame_id: str
    where: JsonValue
    visits: int
    duration: Ns
    start: Ns | None
    end: Ns | None
    distance_m: float
    max_speed: float
    waypoints: tuple[Waypoint, ...]


@dataclass(frozen=True, slots=True)
class LabelledPlace:
    """A place (m) in a frame; `label` names what is there."""

    label: str
    position: Vector3
    frame_id: str


@dataclass(frozen=True, slots=True)
class Sighting:
    """Consecutive messages of one topic that met a condition.

    Attributes:
        topic: of the messages.
        first: log time of the first of them; of the earliest one read where `begun` is False.
        last: of the last.
        messages: how many there are; 0 for a goal of an action.
        begun: whether the message before the first is known not to belong.
        robot: where the robot was at the first; at the last where that is the sighting of a thing,
            a goal, or began before what was read.
        thing: where the thing itself was then, if the message has that.
        matched: the texts of the last message that met the condition, where that is on texts.
        value: the requested fields of the last message; None where none were, or it has none. Of a
            goal its id and its status.
        score: of the detection, if the message has that; the best of several.
        skipped: how much of the time from the first to the last the clock skipped.
        robot_at_first: whether `robot` is of the first message.
    """

    topic: str
    first: Ns
    last: Ns
    messages: int
    begun: bool
    robot: Pose | None
    thing: LabelledPlace | None
    matched: tuple[str, ...] = ()
    value: JsonValue = None
    score: float | None = None
    skipped: Ns = 0
    robot_at_first: bool = False


@dataclass(frozen=True, slots=True)
class Sightings(AnswerWithNotes):
    """Sightings in the requested order; `more`: there are others. `start` and `end` were searched.

    `total` is how many there are; None if the search ended before it had counted all.
    """

    sightings: tuple[Sighting, ...]
    more: bool
    total: int | None
    start: Ns | None
    end: Ns | None
    now: Ns


class PastChange(NamedTuple):
    """Something that changed, and how long before another event."""

    text: str
    before: Ns


@dataclass(frozen=True, slots=True)
class Before(AnswerWithNotes):
    """What changed before a time.

    Attributes:
        at: the moment.
        length: how long before it changes count.
        changes: nearest first.
        more: how many others there are.
        looked_at: the topics that would show a change and were recorded at the time.
        recorded: how many topics were recorded then in all.
        robot: where the robot was; None where that is not known.
        speed_mps: from its pose topic.
        state: booleans, statuses that are not ok and the goal of each action, at that time.
        after: the first changes in the seconds after, nearest first; their `before` is negative.
    """

    at: Ns
    length: Ns
    changes: tuple[PastChange, ...]
    more: int
    looked_at: tuple[str, ...]
    recorded: int
    robot: Pose | None
    speed_mps: float | None
    state: tuple[tuple[str, bool | str], ...]
    after: tuple[PastChange, ...] = ()


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened at `start`, and lasted until `end` if it took time.

    With `goes_on`, the real end is not known. `before`: what changed before, nearest first.
    `places`: the named places that the robot was in, the smallest first. `score`: the best one of a
    thing in view. `skipped`: how much of its time the clock skipped. `point`: where it happened
    (m), in the frame of the recap, where that is known of the robot itself.
    """

    kind: str
    start: Ns
    end: Ns | None
    text: str
    goes_on: bool = False
    before: tuple[PastChange, ...] = ()
    places: tuple[str, ...] = ()
    score: float | None = None
    skipped: Ns = 0
    point: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class Recap(AnswerWithNotes):
    """What happened in a window.

    Attributes:
        start: of the window, inclusive.
        end: of the window, inclusive.
        now: what ages count from.
        distance_m: length of the driven path; None, as what follows, where no pose gives it.
        max_speed: in m/s.
        stood: how long the robot stood in all, in standstills of `shortest_stop` or longer. One
            that goes on outside of the window counts as far as it is inside, so the times of
            windows that follow each other add up. None where poses are there, but too noisy or too
            few to know.
        shortest_stop: shorter stops do not count.
        frame_id: of the places in texts.
        events: what happened, in order of time.
        throughout: things that a detector saw during the whole window at its usual rate.
        counts: how many events of each kind there were, also of those that are left out.
        path_sum_m: the plain sum of distances, if noise adds much to it.
        gap_m: the path across gaps in the recording, in straight lines; None without a gap.
        where: the region's name, or its bounds, where only what happened there was asked for.
        visits: how often the robot was there; `inside` is how long in all.
        skipped: how much of the window the clock skipped.
    """

    start: Ns
    end: Ns
    now: Ns
    distance_m: float | None
    max_speed: float | None
    stood: Ns | None
    shortest_stop: Ns
    frame_id: str | None
    events: tuple[Event, ...]
    throughout: tuple[str, ...]
    counts: tuple[tuple[str, int], ...] = ()
    path_sum_m: float | None = None
    gap_m: float | None = None
    where: JsonValue = None
    visits: int = 0
    inside: Ns = 0
    skipped: Ns = 0


@dataclass(frozen=True, slots=True)
class SilentTopic:
    """A topic without recent messages: its last one, and the usual time between two."""

    topic: str
    last: Ns
    usual: Ns


@dataclass(frozen=True, slots=True)
class Budget:
    """The bytes of all bags, the limit, and the growth per day; None where not known.

    `used` is what a live recorder counts, its own files (`state`) and sidecars too. `foreign`: the
    bytes of bags that the recorder did not make; they are in none of the others.
    """

    used: int
    most: int | None
    per_day: int | None
    max_age: Ns | None
    foreign: int | None = None
    state: int = 0


ANOTHER: Final = "another program"
"""The recorder of a status where this program has none, and files are being written."""


@dataclass(frozen=True, slots=True)
class Status(AnswerWithNotes):
    """How complete and how recent the recorded data is.

    Attributes:
        now: what ages count from.
        earliest: the oldest recorded time; None if nothing is recorded.
        latest: the newest one.
        heard: while a recorder runs, the newest time of a topic that it does not publish itself;
            else `latest`.
        recorder: its state; None where no recorder has written here.
        live: whether it is running.
        restarts: how often it restarted `ros2 bag record`; 0 without a recorder.
        missing: topics that it should record by name, and that no publisher offers.
        never_heard: topics it subscribed to that sent no message.
        lost: how many messages of each topic are known to be missing of the recorder's last hour.
        fell_silent: topics that had messages, but not lately.
        silences: when topics with a usual rate were silent although the robot was on.
        clock_steps: when the clock was set by 2 s or more.
        damaged: files that cannot be read.
        incomplete: bags that a crash left open.
        unread: files of a kind that is not read here.
        budget: the use of the disk budget.
        moments: the newest saved moments; None where they cannot be listed.
        problems: why answers may be incomplete.
    """

    now: Ns
    earliest: Ns | None
    latest: Ns | None
    heard: Ns | None
    recorder: str | None
    live: bool
    restarts: int
    missing: tuple[str, ...]
    never_heard: tuple[str, ...]
    fell_silent: tuple[SilentTopic, ...]
    damaged: int
    incomplete: int
    unread: int
    budget: Budget
    moments: MomentList | None
    problems: tuple[str, ...]
    silences: tuple[Silence, ...] = ()
    clock_steps: tuple[ClockStep, ...] = ()
    lost: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Visit:
    """A time in which the robot was near a place.

    Attributes:
        arrived: log time of its first pose there; None if it was there before the searched time.
        departed: of its last one; None if it is still there, by a recent pose.
        duration: from the first to the last known pose there.
        closest_m: distance (m, in the plane) of the nearest recorded pose; the robot may have been
            nearer between two messages. None where the place is no circle.
        closest_at: log time of that pose; None likewise.
        restarts: how often odometry was reset since.
        already_inside: it was not seen to enter: `arrived` is when the window, or its poses, begin.
        still_inside: it was not seen to leave: `departed` is when the window, or its poses, end.
    """

    arrived: Ns | None
    departed: Ns | None
    duration: Ns
    closest_m: float | None
    closest_at: Ns | None
    restarts: int
    already_inside: bool = False
    still_inside: bool = False


@dataclass(frozen=True, slots=True)
class PlaceVisits:
    """How long the robot was in a named place, and how often it was seen to enter and to leave.

    `first` is the first entry, `last` the last exit; None without one.
    """

    place: str
    entries: int
    exits: int
    duration: Ns
    first: Ns | None
    last: Ns | None


@dataclass(frozen=True, slots=True)
class Visits(AnswerWithNotes):
    """Visits to a place (m) of a frame, newest first; `more`: there are older ones.

    Attributes:
        where: the name of the place, where it has one.
        x: of a circle, with y and radius_m; None of another region.
        total: how many were found.
        all_counted: whether these are all; a note says how far back they were counted.
        duration: of all of these.
        entries: in how many of them the robot was seen to enter; None where that is not known.
        exits: likewise, to leave.
        places: of every named place, where none was asked for; then there are no visits.
    """

    frame_id: str
    x: float | None
    y: float | None
    radius_m: float | None
    visits: tuple[Visit, ...]
    more: bool
    total: int
    now: Ns
    duration: Ns = 0
    entries: int | None = None
    exits: int | None = None
    all_counted: bool = True
    where: str | None = None
    places: tuple[PlaceVisits, ...] | None = None


@dataclass(frozen=True, slots=True)
class ThingStay:
    """An interval in which a thing was at a place (m): first and last seen there, and how often."""

    start: Ns
    end: Ns
    place: Vector3
    count: int
    inside: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class StillThere:
    """The state of a thing since it was last seen, as in the reply.

    Attributes:
        state: `in_view`, `seen_since`, `not_looked_at_since` or `not_seen_where_expected`.
        at: when it was seen again, last seen, or known to be missed.
        looks: detector messages that should have had it.
    """

    state: str
    at: Ns
    looks: int = 0


@dataclass(frozen=True, slots=True)
class Thing:
    """One thing that detectors saw, or one label of things that move by themselves.

    Attributes:
        also_seen_as: other spellings that it was seen under, the commonest first; `misread_as`:
            labels of other things.
        place: its last one (m), in `frame_id`; `spread_m` is the root mean square distance of its
            detections there.
        inside: the named places that it is in, the smallest first.
        best, median: of its scores; None without any.
        robot: x, y (m) and yaw (rad) from which it was last seen; None where that is not known.
        moved: its places in order, where there are several.
        at_once: how many were seen at the same time: of what moves by itself, and of several things
            at one place; else None.
        moves: whether it moves by itself.
    """

    label: str
    also_seen_as: tuple[str, ...]
    place: Vector3
    spread_m: float
    frame_id: str
    inside: tuple[str, ...]
    first: Ns
    last: Ns
    count: int
    best: float | None
    median: float | None
    robot: tuple[float, float, float] | None
    still_there: StillThere | None
    moved: tuple[ThingStay, ...] = ()
    misread_as: tuple[str, ...] = ()
    at_once: int | None = None
    moves: bool = False


@dataclass(frozen=True, slots=True)
class Things(AnswerWithNotes):
    """Things, those seen last first; `labels` counts all of them, also those that are not shown."""

    frame_id: str
    things: tuple[Thing, ...]
    total: int
    labels: tuple[tuple[str, int], ...]
    now: Ns
    all_counted: bool = True


@dataclass(frozen=True, slots=True)
class ComparedThing:
    """A thing in both windows: where it was in the earlier, and in the later.

    Attributes:
        before: None where it was not known then; `after`: None where it was not seen then.
        missed: when it was not seen where expected.
        looks: detector messages that should have had it.
    """

    label: str
    before: ThingStay | None
    after: ThingStay | None
    missed: Ns | None = None
    looks: int = 0


@dataclass(frozen=True, slots=True)
class MoverSeen:
    """A mover in a window: the most at once, how often it was seen, and where last."""

    at_once: int
    count: int
    place: Vector3
    inside: tuple[str, ...]
    last: Ns


@dataclass(frozen=True, slots=True)
class ComparedMover:
    """A mover in the earlier window and in the later; None where it was not seen."""

    label: str
    before: MoverSeen | None
    after: MoverSeen | None


@dataclass(frozen=True, slots=True)
class ComparedThings:
    """The things that differ between two windows; `same` counts those that do not.

    `not_comparable`: seen in both, in the coordinates of different runs of odometry.
    """

    moved: tuple[ComparedThing, ...]
    appeared: tuple[ComparedThing, ...]
    missed: tuple[ComparedThing, ...]
    not_looked_at: tuple[ComparedThing, ...]
    same: int
    movers: tuple[ComparedMover, ...] = ()
    not_comparable: tuple[ComparedThing, ...] = ()


class Pair(NamedTuple):
    """A number in both compared windows."""

    this: float | None
    other: float | None


class StandstillPlace(NamedTuple):
    """A place (m) and the named one it is in: seconds for which the robot stood, since when first.

    `since` has no time where it did not stand there.
    """

    place: tuple[float, float]
    inside: tuple[str, ...]
    seconds: Pair
    since: tuple[Ns | None, Ns | None]


class FarFromOther(NamedTuple):
    """A point of a path (m): its distance from the other, and when the robot was first there."""

    place: tuple[float, float]
    inside: tuple[str, ...]
    away_m: float
    time: Ns


@dataclass(frozen=True, slots=True)
class Comparison(AnswerWithNotes):
    """What differs between two windows.

    Attributes:
        lengths: of the windows (s), and `recorded` how much of each was recorded.
        frame_id: of the things' places.
        way: numbers by name: metres, m/s, seconds and counts.
        way_frame_id: frame of the places where the robot stood, and of the points of the path.
        stood: where it stood in one window longer than in the other.
        farthest: the points of this path, and of the other one, that are farthest from the other
            and from this; None where the paths are the same.
        places: minutes in each named place.
        errors: reports of each error.
        silences: seconds for which each topic was silent.
    """

    lengths: Pair
    recorded: Pair
    frame_id: str
    things: ComparedThings
    way: tuple[tuple[str, Pair], ...]
    places: tuple[tuple[str, Pair], ...]
    errors: tuple[tuple[str, Pair], ...]
    silences: tuple[tuple[str, Pair], ...]
    way_frame_id: str = ""
    stood: tuple[StandstillPlace, ...] = ()
    farthest: tuple[FarFromOther | None, FarFromOther | None] = (None, None)


@dataclass(frozen=True, slots=True)
class TypeFields(AnswerWithNotes):
    """The fields that replies show of a message type, and the topics recorded under it."""

    type: str
    topics: tuple[str, ...]
    fields: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True)
class RememberedMoment:
    """A moment that the recorder saves: its name, and how many bags it has so far.

    `start` and `end` (inclusive) are as asked. `pending`: the rest is still being written.
    """

    moment: str
    label: str
    start: Ns
    end: Ns
    bags: int
    pending: bool


@dataclass(frozen=True, slots=True)
class FiredRule:
    """How often a rule of `recording.keep_when` fired, and how many moments that made.

    Attributes:
        name: of the rule.
        fired: how often it fired.
        moments: how many moments it made; a moment may hold several matches.
        refused: how often nothing was saved.
        last: log time at which it fired last; None where it never did.
        always_since: since when it matches without an end, where that is long; else None.
        problem: why it may have missed something, or keeps nothing; None where nothing is wrong.
    """

    name: str
    fired: int
    moments: int
    refused: int
    last: Ns | None
    always_since: Ns | None
    problem: str | None


@dataclass(frozen=True, slots=True)
class MomentList:
    """The saved moments, newest first; `more` is how many there are besides; the rules by name."""

    moments: tuple[StoredMoment, ...]
    more: int
    now: Ns
    rules: tuple[FiredRule, ...] = ()


@dataclass(frozen=True, slots=True)
class ShownMoment:
    """One saved moment; `now` is what "ago" counts from."""

    stored: StoredMoment
    now: Ns


BinColumn: TypeAlias = Literal["count", "duration", "minutes", "metres", "number", "time"]
"""What the values of a column are: whole numbers, nanoseconds (shown in seconds, or in minutes),
metres, plain numbers, log times."""


@dataclass(frozen=True, slots=True)
class Usual:
    """The usual first time of a day, in seconds since local midnight, over `days` days.

    `of_days` is the number of days with recorded data.
    """

    median_s: int
    earliest_s: int
    latest_s: int
    days: int
    of_days: int


@dataclass(frozen=True, slots=True)
class Bins(AnswerWithNotes):
    """Counts for each bin of a window.

    Attributes:
        by: the kind of the bins.
        about: the topics or the place that was counted.
        start: of the window, as far as the memory reaches; inclusive.
        end: of the window, likewise.
        columns: the name of each column after that of the bin, and what its values are.
        rows: for each bin its name and its values; None if there is none.
        all: the values of all bins together.
        usual: the usual time of the first beginning in a day, where beginnings are counted.
        usual_exit: of the first exit in a day, where visits are counted.
    """

    by: str
    about: tuple[str, ...]
    start: Ns
    end: Ns
    columns: tuple[tuple[str, BinColumn], ...]
    rows: tuple[tuple[str, tuple[float | None, ...]], ...]
    all: tuple[float | None, ...]
    usual: Usual | None = None
    usual_exit: Usual | None = None


OneAnswer: TypeAlias = (
    AnswerWithNotes | tuple[TopicRow, ...] | RememberedMoment | MomentList | ShownMoment
)


@dataclass(frozen=True, slots=True)
class OfRobot:
    """What one robot of a fleet answers; its files are named relative to `bag_dir`.

    `notes` are on where the answer was found.
    """

    name: str
    bag_dir: Path
    answer: OneAnswer
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class OfFleet:
    """What several robots answer, as one JSON value."""

    value: dict[str, JsonValue]


Answer: TypeAlias = OneAnswer | OfRobot | OfFleet
