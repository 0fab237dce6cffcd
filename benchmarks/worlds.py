"""Worlds that nobody tuned for: bags of drawn robots, the same for the same seed.

`home_week` is a home robot's minutes, `splits_week` another robot's splits of 10 s with 1,346
messages each, `strangers` whatever bags of other people lie beside this checkout. Drawn are rates,
names, frames, noise, rooms, things, words, gaps in which the robot is off, and faults of its clock.
What the robot was drawn to be is in `world.json`, beside the bags.
"""

from __future__ import annotations

import json
import os
import shutil
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from benchmarks.bags import Recording, Topic
from benchmarks.messages import LABELS, PACKERS, SplitMessages
from benchmarks.motion import Route, building

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from ros2_memory.core.arrays import Floats
    from ros2_memory.core.model import JsonValue

HOME: Final = "home_week"
SPLITS: Final = "splits_week"
STRANGERS: Final = "strangers"
KINDS: Final = (HOME, SPLITS, STRANGERS)
DAY_S: Final = 86_400
_FORMAT: Final = 2  # of what is written here; worlds of another one are made anew
_STRANGE: Final = Path(__file__).resolve().parents[2] / "shared" / "bags"
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
            "odom": (5, 20),
            "map": (0.5, 4),
            "cmd": (4, 10),
            "objects": (0.4, 2.5),
            "battery": (0.1, 1),
            "docked": (0.1, 1),
            "status": (0.2, 1),
            "rosout": (0.1, 1),
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
            "odom": (50, 50),
            "map": (5, 5),
            "cmd": (20, 20),
            "objects": (1, 1),
            "battery": (1, 1),
            "docked": (0.5, 0.5),
            "status": (1, 1),
            "rosout": (1, 1),
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
        self.detector = str(chance.choice(list(PACKERS)))
        self.topics = self._topics(chance)
        self.roles = list(self.topics)
        self.frames = (
            str(chance.choice(["odom", "odom_wheel"])),
            str(chance.choice(["base_link", "base_footprint"])),
        )
        self.camera = (str(chance.choice(["camera", "eye_frame"])), chance.uniform(0.4, 1.3))
        self.noise_m = _drawn(chance, shape.noise_m)
        self.is_single = bool(
            chance.integers(2)
        )  # whether odometry is reckoned in single precision
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
        for label in chance.choice(LABELS, int(chance.integers(12, 30)), replace=False):
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
        begun = self.clock(np.array([gap[0] for gap in self.off])) / 1e9
        off: list[JsonValue] = [
            [at, at + stop - start]
            for at, (start, stop) in zip(begun.tolist(), self.off, strict=True)
        ]
        frames: list[JsonValue] = ["map", *self.frames, self.camera[0]]
        labels: list[JsonValue] = [*sorted({thing.label for thing in self.things})]
        return {
            "kind": self.kind,
            "start": first / 1e9,
            "end": last / 1e9,
            "topics": {role: topic.name for role, topic in self.topics.items()},
            "frames": frames,
            "dock": list(self.route.dock),
            "never_there": list(self.rooms[-1].centre),
            "rooms": {room.name: [*room.x, *room.y] for room in self.rooms},
            "labels": labels,
            "states": dict(self.states),
            "rare": self.rare,
            "often": self.said[0].split()[0],
            "logged": self.logged[0].split()[0],
            "faults": {name: str(fault) for name, fault in self.faults.items()},
            "off": off,
            "rates": {**self.rates},
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
        recording.write(SplitMessages(world, part, nth == 0, chance).rows())
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


def fleet_of(place: Path, robots: int, *, lake: bool) -> Path:
    """Returns the folder of a fleet, made anew: each robot has a third of a world's recordings."""
    fleet = place.with_name(f"{place.name}_{robots}_robots")
    shutil.rmtree(fleet, ignore_errors=True)
    recordings = sorted(path for path in (place / "bags").iterdir() if path.is_dir())
    third = max(len(recordings) // 3, 1)
    for number in range(robots):
        first = number * third % max(len(recordings) - third + 1, 1)
        for recording in recordings[first : first + third]:
            own = fleet / "robots" / f"r{number:02}" / recording.name
            shutil.copytree(recording, own, copy_function=os.link)
    shutil.copytree(place / "bags", fleet / "bags", copy_function=os.link)
    bags = [path.stat().st_size for path in (fleet / "robots").rglob("*.mcap")]
    facts = json.loads((place / "world.json").read_bytes())
    facts |= {"robots": robots, "lake": lake, "bags": len(bags), "bytes": sum(bags)}
    (fleet / "world.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    return fleet


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
