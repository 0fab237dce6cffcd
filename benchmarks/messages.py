"""The messages of a split of a drawn world: what its robot publishes from when to when."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Final

import numpy as np

from benchmarks import payloads
from benchmarks.bags import Row
from benchmarks.motion import Interval, Motion, Room

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from benchmarks.worlds import Part, World
    from ros2_memory.core.arrays import Floats

LABELS: Final = (
    *("kettle", "umbrella", "guitar", "basket", "stool", "teapot", "vase", "printer", "scarf"),
    *("wallet", "remote", "candle", "pillow", "globe", "ladder", "easel", "drill", "helmet"),
    *("bucket", "mirror", "radio", "suitcase", "toaster", "blanket", "crate", "racket", "flute"),
    *("cactus", "slipper", "jar", "clock", "notebook", "shovel", "lantern", "puzzle", "sieve"),
)
"""What things of all worlds are called."""


@dataclass
class SplitMessages:
    """The messages of one split, drawn; `rows` are in order of log time when all were added."""

    world: World
    part: Part
    is_first: bool
    chance: np.random.Generator

    def rows(self) -> list[Row]:
        """Returns all messages of the split."""
        self.found: list[Row] = []
        self._add_motion()
        for role in ("objects", "found"):
            if role in self.world.topics:
                self._add_detections(role)
        self._add_states()
        self._add_texts()
        if self.is_first:
            self._add_statics()
        self.found.sort(key=lambda row: row.log_time)
        return self.found

    def _times(self, role: str) -> tuple[Floats, NDArray[np.int64]]:
        """Returns when a topic publishes: seconds, and the clock's nanoseconds."""
        rate = self.world.rates[role]
        first, last = (math.ceil(t * rate) for t in (self.part.start, self.part.stop))
        # Half of a first period of jitter would reach into the split before.
        t = (np.arange(first, last) + 0.02 + 0.02 * self.chance.random(last - first)) / rate
        t = t[t < self.part.stop]
        return t, self.world.clock(t)

    def _add(self, role: str, stamps: NDArray[np.int64], bodies: Iterable[bytes]) -> None:
        """Adds messages; the middleware takes some tenths of a millisecond."""
        logged = (stamps + self.chance.integers(60_000, 460_000, len(stamps))).tolist()
        number = self.world.roles.index(role)
        self.found += [
            Row(log_time, stamp, number, body)
            for log_time, stamp, body in zip(logged, stamps.tolist(), bodies, strict=True)
        ]

    def _add_motion(self) -> None:
        world = self.world
        t, stamps = self._times("odom")
        true, (dx, dy, dyaw) = world.route.at(t), world.drifted(t)
        x, y = true.x - dx, true.y - dy
        noise = self.chance.normal(size=(5, len(t))) * world.noise_m
        columns = [
            np.cos(dyaw) * x + np.sin(dyaw) * y + noise[0],
            np.cos(dyaw) * y - np.sin(dyaw) * x + noise[1],
            true.yaw - dyaw + 0.4 * noise[2],
            true.speed + noise[3],
            true.turning + noise[4],
        ]
        if world.is_single:
            columns = [column.astype(np.float32).astype(np.float64) for column in columns]
        moved = Motion(*columns)
        self._add("odom", stamps, payloads.odometry_of(moved, stamps, world.frames))
        frames = payloads.frames_of((moved.x, moved.y, moved.yaw), stamps, world.frames)
        self._add("tf", stamps, frames)
        t, stamps = self._times("map")
        corrected = world.drifted(t)
        self._add("tf", stamps, payloads.frames_of(corrected, stamps, ("map", world.frames[0])))
        t, stamps = self._times("cmd")
        true = world.route.at(t)
        if not true.speed.any() and world.shape.night:
            return  # a planner that has no goal says nothing
        self._add("cmd", stamps, payloads.command_of(true.speed, true.turning))

    def _add_detections(self, role: str) -> None:
        world = self.world
        t, stamps = self._times(role)
        pack = PACKERS[world.detector]
        motion = world.route.at(t)
        late = self.chance.integers(40_000_000, 150_000_000, len(t))
        seen = [
            self._seen(*pose)
            for pose in zip(motion.x.tolist(), motion.y.tolist(), motion.yaw.tolist(), strict=True)
        ]
        frame = world.camera[0]
        bodies = [
            pack(stamp, frame, things)
            for stamp, things in zip((stamps - late).tolist(), seen, strict=True)
        ]
        self._add(role, stamps, bodies)

    def _seen(self, x: float, y: float, yaw: float) -> list[tuple[str, float, Floats]]:
        """Returns label, score and place in the camera's frame of what is in view."""
        room = next((one for one in self.world.rooms if _is_in(one, x, y)), None)
        if room is None:
            return []
        found = []
        ahead, left = math.cos(yaw), math.sin(yaw)
        for label, (px, py, pz) in self._placed:
            if not _is_in(room, px, py):
                continue
            dx, dy = px - x, py - y
            at = (ahead * dx + left * dy - 0.12, ahead * dy - left * dx)
            if not 0.3 < at[0] < 4.5 or abs(at[1]) > 0.7 * at[0] or self.chance.random() > 0.75:
                continue
            place = np.array([*at, pz - self.world.camera[1]]) + self.chance.normal(0.0, 0.03, 3)
            if self.chance.random() < 0.02:
                label = str(self.chance.choice(LABELS))  # noqa: PLW2901 - it errs
            found.append((label, round(float(self.chance.beta(6, 2)), 4), place))
        return found

    @cached_property
    def _placed(self) -> list[tuple[str, tuple[float, float, float]]]:
        start = self.part.start
        return [
            (thing.label, next(at.place for at in reversed(thing.places) if at.since <= start))
            for thing in self.world.things
        ]

    def _add_states(self) -> None:
        world, busy = self.world, self.world.route.doing(self.part.start, self.part.stop)
        t, stamps = self._times("battery")
        levels = np.interp(t, *np.array(world.route.charge).T) + self.chance.normal(
            0, 0.002, len(t)
        )
        bodies = [_battery(*row) for row in zip(stamps.tolist(), levels.tolist(), strict=True)]
        self._add("battery", stamps, bodies)
        for role in ("docked", "status"):
            t, stamps = self._times(role)
            doing = [_doing(busy, moment) for moment in t.tolist()]
            texts = [_text(world.states[word]) for word in doing]
            flags = [_bool(word == "charging") for word in doing]
            self._add(role, stamps, flags if role == "docked" else texts)

    def _add_texts(self) -> None:
        world, part = self.world, self.part
        busy = world.route.doing(part.start, part.stop)
        begun = [each.start for each in busy if part.start <= each.start < part.stop]
        said = [
            (t, str(self.chance.choice(world.said))) for t in begun if self.chance.random() < 0.6
        ]
        rare = [t for t in world.rare_at.tolist() if part.start <= t < part.stop]
        said += [(t, f"{self.chance.choice(world.said)} {world.rare}") for t in rare]
        stamps = world.clock(np.array([t for t, _ in said], np.float64))
        self._add("speech", stamps, [_text(words) for _, words in said])
        t, stamps = self._times("rosout")
        drawn = self.chance.integers(len(world.logged), size=len(t)).tolist()
        bodies = [
            _log(stamp, 30 if self.chance.random() < 0.01 else 20, f"{world.logged[n]} {n * 7.31}")
            for stamp, n in zip(stamps.tolist(), drawn, strict=True)
        ]
        self._add("rosout", stamps, bodies)

    def _add_statics(self) -> None:
        """Adds `/tf_static`, which each recording receives when it begins."""
        world = self.world
        booted = int(world.clock(np.array([self.part.booted]))[0])
        start = int(world.clock(np.array([self.part.start]))[0])
        children = ((world.camera[0], 0.12, world.camera[1]), ("laser", -0.05, 0.2))
        frames = [
            payloads.transform(world.frames[1], child, booted, (x, 0.0, z, 0.0, 1.0))
            for child, x, z in children
        ]
        body = payloads.serialized("tf2_msgs/msg/TFMessage", transforms=frames)
        self.found.append(Row(start + 1000, booted, world.roles.index("static"), body))


def _is_in(room: Room, x: float, y: float) -> bool:
    return room.x[0] <= x <= room.x[1] and room.y[0] <= y <= room.y[1]


def _doing(busy: Sequence[Interval], t: float) -> str:
    return next((each.doing for each in busy if each.start <= t < each.stop), "waiting")


def _vision(stamp: int, frame: str, things: Iterable[tuple[str, float, Floats]]) -> bytes:
    box = np.array([10, 20, 30, 40], np.int32)
    detections = [
        payloads.make(
            "ros2_vision_interfaces/msg/VisionDetection",
            label=label,
            score=score,
            point=payloads.make("geometry_msgs/msg/Point", x=at[0], y=at[1], z=at[2]),
            bbox=box,
        )
        for label, score, at in things
    ]
    header = payloads.header(stamp, frame)
    return payloads.serialized(
        payloads.DETECTIONS, header=header, skill="watch", detections=detections
    )


def _vision_3d(stamp: int, frame: str, things: Iterable[tuple[str, float, Floats]]) -> bytes:
    make, header = payloads.make, payloads.header(stamp, frame)
    upright = make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    detections = []
    for number, (label, score, at) in enumerate(things):
        point = make("geometry_msgs/msg/Point", x=at[0], y=at[1], z=at[2])
        pose = make("geometry_msgs/msg/Pose", position=point, orientation=upright)
        result = make(
            "vision_msgs/msg/ObjectHypothesisWithPose",
            hypothesis=make("vision_msgs/msg/ObjectHypothesis", class_id=label, score=score),
            pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
        )
        box = make(
            "vision_msgs/msg/BoundingBox3D", center=pose, size=payloads.vector3(0.1, 0.1, 0.2)
        )
        detections.append(
            make(
                "vision_msgs/msg/Detection3D",
                header=header,
                results=[result],
                bbox=box,
                id=str(number),
            )
        )
    return payloads.serialized(payloads.DETECTIONS_3D, header=header, detections=detections)


def _vision_json(stamp: int, frame: str, things: Iterable[tuple[str, float, Floats]]) -> bytes:
    listed = [
        {
            "label": label,
            "confidence": score,
            "position": dict(zip("xyz", at.round(3).tolist(), strict=True)),
        }
        for label, score, at in things
    ]
    told = {"stamp": stamp / 1e9, "frame_id": frame, "found": listed}
    return payloads.serialized("std_msgs/msg/String", data=json.dumps(told))


PACKERS: Final[Mapping[str, Callable[[int, str, Iterable[tuple[str, float, Floats]]], bytes]]] = {
    payloads.DETECTIONS: _vision,
    payloads.DETECTIONS_3D: _vision_3d,
    "std_msgs/msg/String": _vision_json,
}


def _battery(stamp: int, level: float) -> bytes:
    return payloads.serialized(
        "sensor_msgs/msg/BatteryState",
        header=payloads.header(stamp, ""),
        **dict.fromkeys(("temperature", "current", "charge", "capacity"), math.nan),
        voltage=21.0 + 4.2 * level,
        design_capacity=5.2,
        percentage=level,
        power_supply_status=2,
        power_supply_health=1,
        power_supply_technology=2,
        present=True,
        cell_voltage=np.zeros(0, np.float32),
        cell_temperature=np.zeros(0, np.float32),
        location="",
        serial_number="",
    )


@lru_cache(maxsize=1000)
def _text(words: str) -> bytes:
    return payloads.serialized("std_msgs/msg/String", data=words)


@lru_cache(maxsize=2)
def _bool(value: bool) -> bytes:
    return payloads.serialized("std_msgs/msg/Bool", data=value)


def _log(stamp: int, level: int, words: str) -> bytes:
    where = {"name": "planner", "file": "planner.cpp", "function": "step", "line": 77}
    return payloads.serialized(
        "rcl_interfaces/msg/Log", stamp=payloads.time(stamp), level=level, msg=words, **where
    )
