"""The whole world of a scale: life, people, things, frames, and when the robot is recorded."""

from dataclasses import dataclass
from functools import cache, cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ros2_memory.core.arrays import Floats
from tests.home import camera, days, drift, things
from tests.home.camera import Sights
from tests.home.days import Life, Person, Scale, people
from tests.home.drift import Drift
from tests.home.paths import Pose
from tests.home.things import Thing

START_S = 1_772_409_600
"""When the world begins: Monday, 2026-03-02, 00:00 UTC, in Unix seconds."""
SPLITS_OF_A_RECORDING = 10

_GOLDEN = 0.6180339887498949
_VISION_DELAY_S = (0.05, 0.15)
_DELAY_S = (0.00006, 0.00046)


class Stream(NamedTuple):
    """A topic with a steady rate: seconds between messages, life and compressed."""

    topic: str
    period_s: float
    short_period_s: float
    delay_s: tuple[float, float] = _DELAY_S

    def period(self, scale: Scale) -> float:
        """Returns the seconds between two messages."""
        return self.short_period_s if scale.short else self.period_s


VISION = Stream("/vision/scene/scene_objects", 1.0, 0.5, _VISION_DELAY_S)


class Recording(NamedTuple):
    """One run of the recorder: all messages that it receives in `[start, stop)`."""

    number: int
    start: float
    stop: float
    booted: float
    """When the robot was switched on."""
    cut: bool = False
    """Whether the power failed: its last split has no end."""

    @property
    def name(self) -> str:
        """Returns the name of its folder."""
        return f"rec_{self.number:04}"

    def splits(self, split_s: float) -> list[tuple[float, float]]:
        """Returns the times of its splits."""
        count = max(1, round(np.ceil((self.stop - self.start) / split_s - 1e-6)))
        edges = [self.start + nth * split_s for nth in range(count)] + [self.stop]
        return list(pairwise(edges))


class Beats(NamedTuple):
    """The messages of a stream: when the robot made each, and when the recorder received it."""

    stamp: Floats
    log: Floats


@dataclass(frozen=True)
class World:
    """A home robot's days."""

    scale: Scale
    life: Life
    people: tuple[Person, ...]
    things: tuple[Thing, ...]
    drift: Drift
    on: tuple[tuple[float, float], ...]
    """When the robot is on and recorded."""

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """Returns the label of each target: things, then people."""
        return tuple([thing.label for thing in self.things] + [camera.PERSON] * len(self.people))

    @cached_property
    def recordings(self) -> tuple[Recording, ...]:
        """Returns the recordings, in order."""
        length = SPLITS_OF_A_RECORDING * self.scale.split_s
        cut = self.life.power_cut[0]
        found: list[Recording] = []
        for start, stop in self.on:
            at = start
            while at < stop - 1e-6:
                # A rest that is shorter than a split joins the last recording.
                end = stop if stop - at < length + self.scale.split_s else at + length
                found.append(Recording(len(found), at, end, start, abs(end - cut) < 1e-6))
                at = end
        return tuple(found)

    def clock(self, t: Floats) -> Floats:
        """Returns what the robot's clock shows at each moment, in Unix seconds."""
        shown: Floats = START_S + t + days.CLOCK_STEP_S * (t >= self.life.clock_step)
        return shown

    def clock_at(self, t: float) -> float:
        """Returns what the robot's clock shows at a moment, in Unix seconds."""
        return float(self.clock(np.array([t]))[0])

    def clock_ns(self, t: Floats) -> NDArray[np.int64]:
        """Returns what the robot's clock shows at each moment, in nanoseconds."""
        # Apart, so that no nanosecond is lost in a float of Unix seconds.
        step = (t >= self.life.clock_step) * round(days.CLOCK_STEP_S * 1e9)
        ns: NDArray[np.int64] = (np.round(t * 1e9) + step).astype(np.int64) + START_S * 10**9
        return ns

    def beats(self, stream: Stream, recording: Recording) -> Beats:
        """Returns the messages of a stream that a recording receives."""
        period = stream.period(self.scale)
        first = int((recording.start - 1.0) / period)
        k = np.arange(first, int(recording.stop / period) + 2)
        # The same fraction for a message whatever recording is asked: no draw.
        shortest, longest = stream.delay_s
        stamp = np.asarray(k * period, dtype=np.float64)
        log = stamp + shortest + (longest - shortest) * ((k * _GOLDEN) % 1.0)
        kept = (log >= recording.start) & (log < recording.stop) & (stamp >= recording.booted)
        if stream is VISION:
            blind = self.life.blind
            kept &= ~((stamp >= blind[0]) & (stamp < blind[1]))
        return Beats(stamp[kept], log[kept])

    def robot(self, t: Floats) -> Pose:
        """Returns where the robot is in the map."""
        return self.life.path.at(t)

    def odom(self, t: Floats) -> Pose:
        """Returns where odometry without noise has the robot."""
        robot, frame = self.robot(t), self.drift.at(t, believed=False)
        cos, sin = np.cos(frame.yaw), np.sin(frame.yaw)
        east, north = robot.x - frame.x, robot.y - frame.y
        return Pose(cos * east + sin * north, cos * north - sin * east, robot.yaw - frame.yaw)

    def docked(self, t: Floats) -> NDArray[np.bool_]:
        """Returns whether the robot is on its dock."""
        docked = np.ones(len(t), dtype=np.bool_)
        for outing in self.life.outings:
            docked &= ~((t >= outing.start) & (t < outing.stop))
        return docked

    def battery(self, t: Floats) -> Floats:
        """Returns the charge, 0 to 1."""
        known = np.array(self.life.battery)
        charge: Floats = np.interp(t, known[:, 0], known[:, 1])
        return charge

    def sights(self, recording: Recording) -> tuple[Beats, Sights]:
        """Returns a recording's messages of the detector, and what was in view and detected."""
        beats = self.beats(VISION, recording)
        seen = camera.targets(self.things, self.people, beats.stamp)
        chance = self.scale.chance(5, recording.number)
        return beats, camera.look(self.robot(beats.stamp), seen, self.labels, chance)


@cache
def world_of(scale: Scale) -> World:
    """Returns the world of a scale; the same one however often it is asked for."""
    life = days.live(scale)
    moving = [(outing.start - 5.0, outing.stop + 5.0) for outing in life.outings]
    moving.append((life.power_cut[1] - 1.0, life.power_cut[1] + 5.0))
    return World(
        scale=scale,
        life=life,
        people=tuple(people(scale)),
        things=tuple(things.things_of(scale.days, scale.chance(4), life.blind)),
        drift=drift.drift(scale, life, sorted(moving)),
        on=tuple(days.switched_on(scale, life)),
    )
