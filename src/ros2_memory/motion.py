"""Distance, speed and jumps along poses in log-time order, pose by pose or a whole bag at once.

Everything is defined so that it can be put together from parts: what a bag's poses amount to is a
`PoseDigest`, and digests joined at their end poses give what all their poses together give.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from ros2_memory.geometry import distance
from ros2_memory.timebase import NS_PER_MS, Ns, unix_from_ns

if TYPE_CHECKING:
    from ros2_memory.model import Quaternion, Vector3

ARRIVAL_JITTER_NS: Final[Ns] = 100 * NS_PER_MS
"""What an arrival may be off: the shortest time that the distance of two poses is divided by.

Log time is the time of arrival. Transports and a busy recorder deliver in bursts: public bags
hold poses 3 ms apart that lie 0.2 m apart, which is GNSS noise and not 72 m/s. So the time is cut
into slots of this length, counted from the epoch, and a speed is measured from the first pose of
one slot to the first pose of the next one that has any.
"""

FARTHEST_M: Final = 1e12
"""Coordinates beyond this are no place on Earth but memory that nobody filled in."""

Vertex: TypeAlias = "tuple[Ns, Vector3, Quaternion | float | None]"
"""A pose on a drawn path: its orientation as a quaternion or as a heading (rad) about Z."""


class Stop(NamedTuple):
    """Where the robot was (m), and when."""

    time: Ns
    position: Vector3


@dataclass(frozen=True, slots=True)
class PoseDigest:
    """What the poses of one bag amount to; a coordinate that is no place makes a pose invalid.

    Attributes:
        poses: valid poses.
        invalid: the others.
        first: the first valid pose; None without one, and then nothing below counts.
        last: the last valid pose.
        length_m: path length between them, jumps left out.
        jumps: steps that were faster than is plausible.
        jumped_m: their total length.
        anchor: the pose at which the first measurement of speed ends; None where there is none.
        anchored_by_jump: the anchor is where a jump led: no speed is measured up to it.
        max_speed: the highest speed (m/s) measured from the anchor on.
        measured_from: where the next measurement begins.
        twist: the highest speed (m/s) that a message states; None where none states one.
        frames: the frames of all poses, in order of appearance.
        vertices: the drawn path, first and last pose among them; parted where the robot jumped
            (see `paths.PARTED`).
        error_m: no valid pose lies farther than this from the drawn path.
    """

    poses: int
    invalid: int
    first: Stop | None
    last: Stop | None
    length_m: float
    jumps: int
    jumped_m: float
    anchor: Stop | None
    anchored_by_jump: bool
    max_speed: float
    measured_from: Stop | None
    twist: float | None
    frames: tuple[str, ...]
    vertices: tuple[Vertex, ...]
    error_m: float


class Motion:
    """Distance, speed and jumps of the positions in order."""

    def __init__(self, max_plausible_speed_mps: float) -> None:
        self._limit = max_plausible_speed_mps
        self.poses = 0
        self.first: Stop | None = None
        self.last: Stop | None = None
        self.distance_m = 0.0
        self.jumps = 0
        self.jumped_m = 0.0
        self.anchor: Stop | None = None
        self.anchored_by_jump = False
        self.first_speed = 0.0
        self.later_speed = 0.0
        self.measured_from: Stop | None = None

    @property
    def max_speed(self) -> float:
        """The highest speed (m/s) measured."""
        return max(self.first_speed, self.later_speed)

    @property
    def duration_s(self) -> float:
        """Seconds from the first pose to the last."""
        if self.first is None or self.last is None:
            return 0.0
        return unix_from_ns(self.last.time - self.first.time)

    def add(self, time: Ns, position: Vector3) -> None:
        """Takes the next valid pose."""
        here = Stop(time, position)
        self.poses += 1
        if self.last is None:
            self.first = self.measured_from = here
        else:
            self._step(self.last, here)
        self.last = here

    def join(self, whole: PoseDigest) -> None:
        """Takes the poses of a bag that come next."""
        if whole.first is None or whole.last is None:
            return
        self.add(*whole.first)
        self.poses += whole.poses - 1
        self.distance_m += whole.length_m
        self.jumps += whole.jumps
        self.jumped_m += whole.jumped_m
        if whole.anchor is not None:
            self._anchor(whole.anchor, jumped=whole.anchored_by_jump)
            self.later_speed = max(self.later_speed, whole.max_speed)
            self.measured_from = whole.measured_from
        self.last = whole.last

    def _step(self, before: Stop, here: Stop) -> None:
        step_m = distance(before.position, here.position)
        # A burst squeezes the time between two poses to nothing; it does not make a jump of them.
        step_s = unix_from_ns(max(here.time - before.time, ARRIVAL_JITTER_NS))
        if step_m > self._limit * step_s * (1 + 1e-9):
            self.jumps += 1
            self.jumped_m += step_m
            self._anchor(here, jumped=True)
            return
        self.distance_m += step_m
        since = self.measured_from or before
        if here.time // ARRIVAL_JITTER_NS != since.time // ARRIVAL_JITTER_NS:
            self._anchor(here, jumped=False)

    def _anchor(self, here: Stop, *, jumped: bool) -> None:
        """Ends a measurement at a pose, and begins the next one there."""
        since = self.measured_from
        first = self.anchor is None
        if first:
            self.anchor, self.anchored_by_jump = here, jumped
        if not jumped and since is not None:
            elapsed = max(here.time - since.time, ARRIVAL_JITTER_NS)
            speed = distance(since.position, here.position) / unix_from_ns(elapsed)
            if first:
                self.first_speed = speed
            else:
                self.later_speed = max(self.later_speed, speed)
        self.measured_from = here


def is_place(position: Vector3) -> bool:
    """Whether these are coordinates of a place: finite, and not beyond any."""
    x, y, z = position
    # A comparison with NaN is false, so this one refuses all three kinds.
    return abs(x) < FARTHEST_M and abs(y) < FARTHEST_M and abs(z) < FARTHEST_M


def faster(stated: float | None, speed_mps: float | None) -> float | None:
    """The higher of two speeds that messages state; one that is no number states nothing."""
    if speed_mps is None or not math.isfinite(speed_mps):
        return stated
    return max(stated or 0.0, abs(speed_mps))
