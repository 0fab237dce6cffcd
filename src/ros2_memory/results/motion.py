"""Results about motion: poses, velocities, transforms, paths, visits."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ros2_memory.core.geometry import yaw
from ros2_memory.core.reply import (
    AGO,
    INSIDE,
    LOCAL,
    LOCAL_OF_DAYS,
    MINUTES,
    NAME,
    NAMES,
    OBJECT,
    OBJECTS,
    PLAIN,
    POSE,
    SECONDS,
    TIME,
    TOTAL,
    XYZ,
    YAW,
    AnswerWithNotes,
    Keys,
    an_object,
    digits,
    keys,
    objects,
    result,
    vector,
)
from ros2_memory.core.timebase import Ns, unix_from_ns

if TYPE_CHECKING:
    from ros2_memory.analysis.motion.trajectory import Trajectory, Waypoint
    from ros2_memory.core.model import (
        FrameEdge,
        Geodetic,
        JsonValue,
        Pose,
        Quaternion,
        Transform,
        Twist,
        Vector3,
    )
    from ros2_memory.core.regions import Circle

_GEODETIC: Final = keys(digits(8)("latitude"), digits(8)("longitude"), digits(4)("altitude"))


def _waypoints(mark: str) -> Keys:
    """Returns the keys of a waypoint; the key `mark` is true if no line of the path leads to it."""
    return keys(
        TIME("timestamp", "time"),
        LOCAL("local", "time", "time"),
        XYZ.spread("position"),
        YAW("yaw", "yaw_rad"),
        PLAIN(mark, "jump").if_any,
    )


@result(
    POSE("pose"),
    an_object(_GEODETIC).spread("geodetic"),
    TIME("timestamp", "time"),
    "topic",
    NAME("frame_id", "pose.frame_id"),
    SECONDS("age_s").if_known,
)
class Position(AnswerWithNotes):
    """Where the robot was, in the frame of the pose.

    For a satellite receiver `geodetic` is set, and the coordinates of the pose are NaN.
    """

    topic: str
    time: Ns
    pose: Pose
    age: Ns | None = None
    geodetic: Geodetic | None = None


@result(
    XYZ("linear", "twist.linear"),
    XYZ("angular", "twist.angular"),
    TIME("timestamp", "time"),
    "topic",
    NAME("frame_id", "twist.frame_id"),
    SECONDS("age_s").if_known,
)
class Velocity(AnswerWithNotes):
    """How fast the robot moved, in the frame of the twist."""

    topic: str
    time: Ns
    twist: Twist
    age: Ns | None = None


@result(
    XYZ("translation", "transform.translation"),
    vector("xyzw", 6)("rotation"),
    YAW("yaw"),
    TIME("timestamp", "time"),
    "parent",
    "child",
    "clock",
    SECONDS("age_s").if_known,
)
class TransformAt(AnswerWithNotes):
    """The pose of the frame `child` in the frame `parent`.

    `clock` tells what `time` is: a header stamp (`stamp`) or a log time (`log`).
    """

    parent: str
    child: str
    time: Ns
    transform: Transform
    clock: str
    age: Ns | None = None

    @property
    def rotation(self) -> Quaternion:
        """The quaternion of the rotation with w >= 0; its negative is the same rotation."""
        x, y, z, w = self.transform.rotation
        return (-x, -y, -z, -w) if w < 0 else (x, y, z, w)

    @property
    def yaw(self) -> float:
        """The heading of `child` in `parent` (rad)."""
        return yaw(self.rotation)


@result(
    NAMES("frames"),
    objects(keys(NAME("parent"), NAME("child"), "static"))("transforms", "sorted_edges"),
)
class Frames(AnswerWithNotes):
    """The frame graph as it was recorded."""

    edges: tuple[FrameEdge, ...]

    @property
    def frames(self) -> tuple[str, ...]:
        """The names of all frames, sorted."""
        return tuple(sorted({name for edge in self.edges for name in (edge.parent, edge.child)}))

    @property
    def sorted_edges(self) -> list[FrameEdge]:
        """The edges, sorted by parent and child."""
        return sorted(self.edges, key=lambda edge: (edge.parent, edge.child))


@result(
    digits(3)("distance_m"),
    vector("xy", 3).spread("place"),
    INSIDE("inside"),
    TIME("timestamp", "time"),
    LOCAL("local", "time", "time"),
    NAME("frame_id"),
    vector("xy", 3)("from", "origin"),
)
class FarthestPose:
    """The pose of the robot that is farthest from a point.

    Attributes:
        origin: x, y of the point (m), in `frame_id`.
        frame_id: of the point and the pose.
        distance_m: between them.
        time: log time of the pose.
        place: of the pose (m).
        inside: the named places around it, the smallest first.
    """

    origin: tuple[float, float]
    frame_id: str
    distance_m: float
    time: Ns
    place: Vector3
    inside: tuple[str, ...]


@result(
    digits(4)("distance_m", "known.totals.distance_m"),
    digits(4)("avg_speed", "known.avg_speed"),
    digits(4)("max_speed", "known.max_speed"),
    digits(3)("duration_s"),
    digits(3)("recorded_s").if_known,
    objects(_waypoints("jump"))("waypoints", "trajectory.waypoints"),
    "topic",
    NAME("frame_id"),
    TIME("start"),
    TIME("end"),
    LOCAL("local", "start", "end"),
    PLAIN("poses", "trajectory.poses"),
    digits(4)("path_sum_m", "trajectory.totals.path_sum_m").when("trajectory.is_noisy"),
    digits(4)("gap_m", "trajectory.gap_m").if_known,
    OBJECT("farthest").if_known,
    span=("start", "end"),
)
class TrajectorySummary(AnswerWithNotes):
    """The driven path in a window, from one pose topic in log-time order.

    Attributes:
        skipped: how much of the time from its first to its last pose the clock skipped.
        unrecorded: how much of the other time has no poses.
        farthest: the pose farthest from a point; None if no point was asked about.
    """

    topic: str
    frame_id: str
    start: Ns
    end: Ns
    trajectory: Trajectory
    skipped: Ns = 0
    unrecorded: Ns = 0
    farthest: FarthestPose | None = None

    @property
    def known(self) -> Trajectory | None:
        """The path; None if it has no valid pose."""
        return self.trajectory if self.trajectory.is_known else None

    @property
    def duration_s(self) -> float | None:
        """The time (s) from its first to its last pose; None without poses."""
        known = self.known
        return None if known is None else known.totals.duration_s - unix_from_ns(self.skipped)

    @property
    def recorded_s(self) -> float | None:
        """The seconds of `duration_s` with poses; None if all of it has poses."""
        lasted_s = self.duration_s if self.unrecorded else None
        return None if lasted_s is None else lasted_s - unix_from_ns(self.unrecorded)


@result(
    PLAIN("where").if_known,
    digits(4)("distance_m"),
    digits(4)("avg_speed"),
    digits(4)("max_speed"),
    SECONDS("duration_s"),
    PLAIN("visits").if_known,
    SECONDS("unknown_s").if_any,
    TIME("start"),
    TIME("end"),
    LOCAL("local", "start", "end"),
    objects(_waypoints("entered"))("waypoints"),
    "topic",
    NAME("frame_id"),
    OBJECT("farthest").if_known,
    span=("start", "end"),
)
class DrivenInside(AnswerWithNotes):
    """The path driven in a window inside a region, or while topics met conditions.

    Attributes:
        topic: of the poses.
        frame_id: of the waypoints.
        where: the name of the region, or its bounds; None if no region was asked about.
        visits: how often the robot was inside while the conditions held; None without a region.
        duration: how long (ns) all counted time lasts.
        start: log time (ns) at which counted time begins; None without any.
        end: log time (ns) at which counted time ends; None without any.
        distance_m: metres driven in it.
        avg_speed: distance by duration (m/s); None if one pose alone counts.
        max_speed: over a second (m/s); None as for `avg_speed`.
        waypoints: of the counted path; `jump` marks where a stretch of it begins.
        farthest: the counted pose that is farthest from a point; None if no point was asked about.
        unknown: for how long it is not known, though something was recorded, whether the conditions
            held.
    """

    topic: str
    frame_id: str
    where: JsonValue | None
    visits: int | None
    duration: Ns
    start: Ns | None
    end: Ns | None
    distance_m: float
    avg_speed: float | None
    max_speed: float | None
    waypoints: tuple[Waypoint, ...]
    farthest: FarthestPose | None = None
    unknown: Ns = 0


@result(
    TIME("arrived"),
    TIME("departed"),
    LOCAL("local", "arrived", "departed"),
    SECONDS("duration_s"),
    digits(3)("closest_m").if_known,
    TIME("closest_at").if_known,
    AGO("ago_s", "departed"),
    PLAIN("already_inside").if_any,
    PLAIN("still_inside").if_any,
    PLAIN("restarts_since", "restarts").if_any,
)
class Visit:
    """A visit of the robot to a place.

    Attributes:
        arrived: log time of its first pose there; None if it was there before the searched time.
        departed: log time of its last pose there; None if it is still there, by a recent pose.
        duration: from the first to the last known pose there.
        closest_m: distance (m, in the plane) of a recorded pose, of noisy poses of the nearest one
            to about 5 cm; the robot may have been nearer between two messages. None if the place
            is no circle.
        closest_at: log time of this pose; None if the place is no circle.
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


@result(
    "place",
    MINUTES("minutes", "duration"),
    "entries",
    "exits",
    TIME("first_entry", "first").if_known,
    TIME("last_exit", "last").if_known,
    LOCAL_OF_DAYS("local", "first", "last_after_first"),
)
class PlaceVisits:
    """How long the robot was in a named place, and how often it was seen to enter and to leave.

    `first` is the first entry and `last` the last exit, as log times; None if it was not seen.
    """

    place: str
    entries: int
    exits: int
    duration: Ns
    first: Ns | None
    last: Ns | None

    @property
    def last_after_first(self) -> Ns | None:
        """The last exit; None if it was before the first entry: then the two are no stretch."""
        return None if self.first and self.last and self.last < self.first else self.last


@result(
    NAME("frame_id"),
    PLAIN("where").if_known,
    PLAIN("x", "circle.x").if_known,
    PLAIN("y", "circle.y").if_known,
    PLAIN("radius_m", "circle.radius_m").if_known,
    PLAIN("there_now").if_known,
    OBJECTS("places").if_known.along("last_exit"),
    OBJECTS("visits").unless("is_of_places").along("departed"),
    TOTAL("total", "total", "all_counted").unless("is_of_places").added,
    PLAIN("entries").if_known.added,
    PLAIN("exits").if_known.added,
    MINUTES("minutes", "duration").unless("is_of_places").added,
    SECONDS("unknown_s").if_any.added,
    PLAIN("more").if_any,
    span=("oldest", "now"),
)
class Visits(AnswerWithNotes):
    """Visits to a place, newest first; or the times in every named place.

    Attributes:
        frame_id: of the place.
        total: how many visits were counted.
        visits: the newest visits.
        more: whether there are older ones.
        circle: the place, if it has no name.
        duration: of all counted visits together.
        entries: in how many visits the robot was seen to enter; None if that is not known.
        exits: in how many visits the robot was seen to leave; None if that is not known.
        all_counted: False if time ran out; a note says how far back visits were counted.
        where: the name of the place; None if it has none.
        places: of every named place, if no place was asked about; then there are no visits.
        unknown: for how long it is not known, though something was recorded, where the robot was.
        is_current: whether the window has a pose that shows where the robot is now.
    """

    frame_id: str
    total: int
    now: Ns
    visits: tuple[Visit, ...] = ()
    more: bool = False
    circle: Circle | None = None
    duration: Ns = 0
    entries: int | None = None
    exits: int | None = None
    all_counted: bool = True
    where: str | None = None
    places: tuple[PlaceVisits, ...] | None = None
    unknown: Ns = 0
    is_current: bool = True

    @property
    def there_now(self) -> bool | None:
        """Whether the robot is there now; None if no pose of the window shows it."""
        if not self.is_current or self.is_of_places:
            return None
        return any(visit.departed is None for visit in self.visits)

    @property
    def oldest(self) -> Ns | None:
        """The oldest time of the reply."""
        ends = [at for visit in self.visits for at in (visit.arrived, visit.departed)]
        ends += [place.first for place in self.places or ()]
        return min((at for at in ends if at is not None), default=None)

    @property
    def is_of_places(self) -> bool:
        """Whether the answer is about every named place."""
        return self.places is not None
