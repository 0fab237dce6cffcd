"""Worlds that nobody tuned for: bags of drawn robots, the same for the same seed.

`home_week` is a home robot's minutes, `splits_week` another robot's splits of 10 s at 1,346 messages
each, `strangers` whatever bags of other people lie beside this checkout. Drawn are rates, names,
frames, noise, rooms, things, words, gaps in which the robot is off, and faults of its clock. What
the robot was drawn to be is in `world.json`, beside the bags.
"""

from __future__ import annotations

import json
import math
import shutil
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from benchmarks import payloads
from benchmarks.bags import Recording, Row, Topic
from benchmarks.motion import Interval, Motion, Route, building

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from benchmarks.motion import Floats
    from ros2_memory.core.model import JsonValue

HOME: Final = "home_week"
SPLITS: Final = "splits_week"
STRANGERS: Final = "strangers"
KINDS: Final = (HOME, SPLITS, STRANGERS)
DAY_S: Final = 86_400
_FORMAT: Final = 1  # of what is written here; worlds of another one are made anew
_STRANGE: Final = Path(__file__).resolve().parents[2] / "shared" / "bags"
_LABELS: Final = (
    *("kettle", "umbrella", "guitar", "basket", "stool", "teapot", "vase", "printer", "scarf"),
    *("wallet", "remote", "candle", "pillow", "globe", "ladder", "easel", "drill", "helmet"),
    *("bucket", "mirror", "radio", "suitcase", "toaster", "blanket", "crate", "racket", "flute"),
    *("cactus", "slipper", "jar", "clock", "notebook", "shovel", "lantern", "puzzle", "sieve"),
)
_SYLLABLES: Final = ("ka", "lo", "mi", "ren", "tu", "vas", "pel", "dor", "shi", "ne", "gra", "ul")
_DOING: Final = ("driving", "returning", "waiting", "looking", "listening", "charging")


class Moved(NamedTuple):
    """Where a thing is from a time (s) on: in the map, in metres."""

    since: float
    place: tuple[float, float, float]


class Thing(NamedTuple):
    """A thing of the building: its places, oldest first."""

    label: str
    places: tuple[Moved, ...]


class Part(NamedTuple):
    """A split to be written: of which recording, when (s), and since when the robot is on."""

    recording: int
    start: float
    stop: float
    booted: float
    is_cut: bool


class Shape(NamedTuple):
    """How the robots of a kind are drawn. Rates (1/s) lie between two numbers.

    Attributes:
        rates: by the role of a topic; `map` is `map -> odom` within the topic of transforms.
        splits: in a recording, at least and at most.
        noise_m: of odometry, one standard deviation.
        night: whether the robot sleeps at its dock.
        stay_s: how long it stays in a room.
        chunks: sizes of chunks, of which one is drawn.
        gap_h: so many hours lie between two times at which it is off.
    """

    split_s: int
    rates: Mapping[str, tuple[float, float]]
    splits: tuple[int, int]
    noise_m: tuple[float, float]
    night: bool
    stay_s: tuple[float, float]
    chunks: tuple[int, ...]
    gap_h: tuple[float, float]


_SHAPES: Final = {
    HOME: Shape(
        60,
        {
            **{"odom": (5, 20), "map": (0.5, 4), "cmd": (4, 10), "objects": (0.4, 2.5)},
            **{"battery": (0.1, 1), "docked": (0.1, 1), "status": (0.2, 1), "rosout": (0.1, 1)},
        },
        (10, 60),
        (0.001, 0.004),
        night=True,
        stay_s=(60.0, 600.0),
        chunks=(16 * 1024, 64 * 1024, 768 * 1024),
        gap_h=(12.0, 60.0),
    ),
    SPLITS: Shape(
        10,
        {
            **{"odom": (50, 50), "map": (5, 5), "cmd": (20, 20), "objects": (1, 1)},
            **{"battery": (1, 1), "docked": (0.5, 0.5), "status": (1, 1), "rosout": (1, 1)},
            "found": (5, 5),
        },
        (20, 60),
        (0.0003, 0.002),
        night=False,
        stay_s=(10.0, 90.0),
        chunks=(16 * 1024,),
        gap_h=(20.0, 80.0),
    ),
}
_NAMES: Final = {
    "odom": ("/odom", "/wheel/odometry", "/base/odometry/filtered"),
    "tf": ("/tf",),
    "static": ("/tf_static",),
    "cmd": ("/cmd_vel", "/base/cmd_vel_out"),
    "objects": ("/perception/objects", "/camera/detections", "/yolo/tracked"),
    "found": ("/perception/searched", "/arm_camera/detections"),
    "battery": ("/battery_state", "/power/battery"),
    "docked": ("/is_docked", "/charger/contact"),
    "status": ("/robot/mode", "/behaviour/state", "/mission/status"),
    "speech": ("/speech/said", "/tts/text"),
    "rosout": ("/rosout",),
}
_TYPES: Final = {
    "odom": "nav_msgs/msg/Odometry",
    "tf": "tf2_msgs/msg/TFMessage",
    "static": "tf2_msgs/msg/TFMessage",
    "cmd": "geometry_msgs/msg/Twist",
    "battery": "sensor_msgs/msg/BatteryState",
    "docked": "std_msgs/msg/Bool",
    "status": "std_msgs/msg/String",
    "speech": "std_msgs/msg/String",
    "rosout": "rcl_interfaces/msg/Log",
}
_DETECTIONS: Final = (payloads.DETECTIONS, payloads.DETECTIONS_3D, "std_msgs/msg/String")


class World:
    """A drawn robot and its days. `size` is in days for a home, in bags for splits."""

    def __init__(self, kind: str, seed: int, size: int) -> None:
        chance = np.random.default_rng([seed, KINDS.index(kind)])
        shape = _SHAPES[kind]
        self.kind, self.seed, self.shape = kind, seed, shape
        self.most_bags = size * DAY_S // shape.split_s if kind == HOME else size
        self.seconds = float(self.most_bags * shape.split_s)
        self.start_ns = int(chance.integers(19_800, 20_600)) * DAY_S * 10**9
        self.rates = {role: _drawn(chance, bounds) for role, bounds in shape.rates.items()}
        self.detector = str(chance.choice(_DETECTIONS))
        self.topics = self._topics(chance)
        self.roles = list(self.topics)
        self.frames = (
            str(chance.choice(["odom", "odom_wheel"])),
            str(chance.choice(["base_link", "base_footprint"])),
        )
        self.camera = (str(chance.choice(["camera", "eye_frame"])), chance.uniform(0.4, 1.3))
        self.noise_m = _drawn(chance, shape.noise_m)
        self.is_single = bool(chance.integers(2))  # whether odometry is reckoned in single precision
        self.chunk_bytes = int(chance.choice(shape.chunks))
        self.rooms = building(chance)
        night = (_drawn(chance, (20.5, 23.5)), _drawn(chance, (5.5, 8.5))) if shape.night else None
        self.route = Route(chance, self.rooms, self.seconds, night, _drawn(chance, shape.stay_s))
        self.things = self._things(chance)
        self._drift(chance)
        self._words(chance)
        self._clock(chance)
        self.parts = self._parts(chance)

    def _topics(self, chance: np.random.Generator) -> dict[str, Topic]:
        roles = [role for role in _NAMES if role != "found" or role in self.shape.rates]
        latched = {"static", "rosout"}
        return {
            role: Topic(
                str(chance.choice(_NAMES[role])),
                _TYPES.get(role, self.detector),
                "transient_local" if role in latched else "volatile",
            )
            for role in roles
        }

    def _things(self, chance: np.random.Generator) -> list[Thing]:
        def place() -> tuple[float, float, float]:
            room = self.rooms[int(chance.integers(len(self.rooms) - 1))]
            x, y = (chance.uniform(low + 0.2, high - 0.2) for low, high in room[1:])
            return x, y, chance.uniform(0.1, 1.4)

        things = []
        for label in chance.choice(_LABELS, int(chance.integers(12, 30)), replace=False):
            for _ in range(int(chance.integers(1, 4))):
                moves = np.sort(chance.uniform(0, self.seconds, chance.poisson(0.7)))
                moved = [Moved(since, place()) for since in [0.0, *moves.tolist()]]
                things.append(Thing(str(label), tuple(moved)))
        return things

    def _drift(self, chance: np.random.Generator) -> None:
        """Draws `map -> odom`, which moves in each bag: knots of a walk that stays near 0."""
        step_s = chance.uniform(4.0, 9.0)
        count = int(self.seconds / step_s) + 2
        steps = chance.normal(size=(3, count)) * [[0.012], [0.012], [0.0005]]
        self.drift_at = np.arange(count) * step_s
        self.drift = np.array([_reverting(row) for row in steps])

    def _words(self, chance: np.random.Generator) -> None:
        def word() -> str:
            return "".join(chance.choice(_SYLLABLES, int(chance.integers(2, 5))))

        def sentence() -> str:
            return " ".join(word() for _ in range(int(chance.integers(3, 8))))

        style = str(chance.choice(["{}", "state: {}", "MODE_{}"]))
        self.states = {doing: style.format(doing) for doing in _DOING}
        self.said = [sentence() for _ in range(40)]
        self.logged = [sentence() for _ in range(25)]
        self.rare = word() + "quex"
        self.rare_at = np.sort(chance.uniform(0.05, 0.95, 3)) * self.seconds

    def _clock(self, chance: np.random.Generator) -> None:
        """Draws when the robot is off, and how its clock is wrong: offsets (ns) from times on."""
        hours = self.shape.gap_h
        self.off: list[tuple[float, float]] = []
        at = chance.uniform(0.2, 0.6) * min(self.seconds, hours[1] * 3600.0)
        while at < 0.97 * self.seconds:
            long = min(chance.uniform(120.0, 5400.0), 0.02 * self.seconds)
            self.off.append((at, at + long))
            at += chance.uniform(*hours) * 3600.0
        breaks = [(0.0, 0)]
        stepped = chance.uniform(0.3, 0.9) * self.seconds
        most = min(900.0, 0.01 * self.seconds)
        step = int(chance.uniform(0.2, 1.0) * chance.choice([-1.0, 1.0]) * most * 1e9)
        unset = None
        if chance.random() < 0.5:  # no battery keeps its clock: it begins in 2000
            booted = self.off[int(chance.integers(len(self.off)))][1]
            unset = (booted, chance.uniform(20.0, 100.0))
            wrong = 946_684_800 * 10**9 - self.start_ns - int(booted * 1e9)
            later = step if booted > stepped else 0
            breaks += [(booted, wrong), (booted + unset[1], later)]
        breaks.append((stepped, step))
        breaks.sort()
        self.faults = {"step_s": step / 1e9, "stepped": stepped, "unset": unset}
        self._breaks = np.array([at for at, _ in breaks])
        self._offsets = np.array([offset for _, offset in breaks], np.int64)

    def _parts(self, chance: np.random.Generator) -> list[Part]:
        edges = [0.0, *(edge for gap in self.off for edge in gap), self.seconds + DAY_S]
        parts: list[Part] = []
        recording, failed = -1, chance.integers(len(self.off))
        for nth, (booted, off) in enumerate(zip(edges[::2], edges[1::2], strict=True)):
            stops = np.arange(booted + self.shape.split_s, off, self.shape.split_s)
            within = self._breaks[(self._breaks > booted) & (self._breaks < off)]
            times = np.unique([booted, *stops, *within, off])
            left = 0
            for start, stop in zip(times[:-1].tolist(), times[1:].tolist(), strict=True):
                if stop - start < 0.5:
                    continue
                if not left:
                    recording, left = recording + 1, int(chance.integers(*self.shape.splits))
                left -= 1
                parts.append(Part(recording, start, stop, booted, nth == failed and stop == off))
        return [part for part in parts if part.stop <= self.seconds][: self.most_bags]

    def clock(self, t: Floats) -> NDArray[np.int64]:
        """Returns what the robot's clock shows (ns) at times since its start."""
        offsets = self._offsets[np.searchsorted(self._breaks, t, side="right") - 1]
        return np.asarray(self.start_ns + np.rint(t * 1e9).astype(np.int64) + offsets, np.int64)

    def drifted(self, t: Floats) -> tuple[Floats, Floats, Floats]:
        """Returns `map -> odom` at some times: x, y, yaw."""
        x, y, yaw = (np.interp(t, self.drift_at, row) for row in self.drift)
        return x, y, yaw

    def facts(self) -> dict[str, JsonValue]:
        """Returns what questions are drawn from."""
        first, last = (int(self.clock(np.array([t]))[0]) for t in (0.0, self.parts[-1].stop - 0.5))
        return {
            "kind": self.kind,
            "start": first / 1e9,
            "end": last / 1e9,
            "topics": {role: topic.name for role, topic in self.topics.items()},
            "frames": ["map", *self.frames, self.camera[0]],
            "dock": list(self.route.dock),
            "never_there": list(self.rooms[-1].centre),
            "rooms": {room.name: [*room.x, *room.y] for room in self.rooms},
            "labels": sorted({thing.label for thing in self.things}),
            "states": dict(self.states),
            "rare": self.rare,
            "often": self.said[0].split()[0],
            "logged": self.logged[0].split()[0],
            "faults": {name: str(fault) for name, fault in self.faults.items()},
            "off": len(self.off),
            "rates": {role: rate for role, rate in self.rates.items()},
            "detector": self.detector,
            "noise_m": self.noise_m,
        }


def _drawn(chance: np.random.Generator, bounds: tuple[float, float]) -> float:
    return round(float(chance.uniform(*bounds)), 4)


def _reverting(steps: Floats) -> Floats:
    """Sums steps, and returns to 0 by half a percent with each."""
    found, at = np.empty_like(steps), 0.0
    for nth, step in enumerate(steps.tolist()):
        at = 0.995 * at + step
        found[nth] = at
    return found


@dataclass
class SplitRows:
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
        if not true.speed.any() and world.kind == HOME:
            return  # a planner that has no goal says nothing
        self._add("cmd", stamps, payloads.command_of(true.speed, true.turning))

    def _add_detections(self, role: str) -> None:
        world = self.world
        t, stamps = self._times(role)
        pack = _PACKERS[world.detector]
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
                label = str(self.chance.choice(_LABELS))  # noqa: PLW2901 - it errs
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
        levels = np.interp(t, *np.array(world.route.charge).T) + self.chance.normal(0, 0.002, len(t))
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
        said = [(t, str(self.chance.choice(world.said))) for t in begun if self.chance.random() < 0.6]
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
        body = payloads.serialized(_TYPES["static"], transforms=frames)
        self.found.append(Row(start + 1000, booted, world.roles.index("static"), body))


def _is_in(room: object, x: float, y: float) -> bool:
    _, (left, right), (low, high) = room  # type: ignore[misc]
    return left <= x <= right and low <= y <= high


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


_PACKERS: Final[
    Mapping[str, Callable[[int, str, Iterable[tuple[str, float, Floats]]], bytes]]
] = dict(zip(_DETECTIONS, (_vision, _vision_3d, _vision_json), strict=True))


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


@lru_cache(maxsize=1)
def _world(kind: str, seed: int, size: int) -> World:
    return World(kind, seed, size)


def _record(kind: str, seed: int, size: int, bags: Path, number: int) -> tuple[int, int, int]:
    """Writes one recording: bags, bytes, messages."""
    world = _world(kind, seed, size)
    parts = [part for part in world.parts if part.recording == number]
    name = f"run_{seed % 997:03}_{number:05}"
    recording = Recording(bags / name, list(world.topics.values()), world.chunk_bytes)
    for nth, part in enumerate(parts):
        chance = np.random.default_rng([seed, number, nth])
        recording.write(SplitRows(world, part, nth == 0, chance).rows())
    if parts[-1].is_cut:
        recording.cut()
    else:
        recording.close()
    size = sum(split.path.stat().st_size for split in recording.splits)
    return len(parts), size, sum(sum(split.counts) for split in recording.splits)


def made(kind: str, seed: int, size: int, folder: Path, *, jobs: int = 1) -> Path:
    """Returns the folder of a world: `bags` and `world.json`, taken as they lie there or made.

    Raises:
        FileNotFoundError: the strangers' bags do not lie beside this checkout.
    """
    place = folder / f"{kind}_{size}_{seed:x}"
    facts_file = place / "world.json"
    if facts_file.is_file() and json.loads(facts_file.read_bytes())["format"] == _FORMAT:
        return place
    shutil.rmtree(place, ignore_errors=True)
    if kind == STRANGERS:
        facts = _strangers(place / "bags")
    else:
        world = _world(kind, seed, size)
        record = partial(_record, kind, seed, size, place / "bags")
        numbers = sorted({part.recording for part in world.parts})
        with ProcessPoolExecutor(jobs) as workers:
            written = list(workers.map(record, numbers))
        bags, total, messages = (sum(column) for column in zip(*written, strict=True))
        facts = {**world.facts(), "bags": bags, "bytes": total, "messages": messages}
    text = json.dumps({"format": _FORMAT, "seed": f"{seed:x}", **facts}, indent=1)
    facts_file.write_text(text + "\n", encoding="utf-8")
    return place


def _strangers(bags: Path) -> dict[str, JsonValue]:
    """Copies the bags that other people recorded."""
    if not _STRANGE.is_dir():
        raise FileNotFoundError(f"no bags of others lie in {_STRANGE.name} beside this checkout")
    for name in ("real", "recorded"):
        shutil.copytree(_STRANGE / name, bags / name)
    files = [path for path in bags.rglob("*") if path.suffix in {".mcap", ".db3", ".zstd"}]
    return {
        "kind": STRANGERS,
        "bags": len(files),
        "bytes": sum(path.stat().st_size for path in files),
    }
