"""Histories that are odd in the ways of real robots, each with what is true of it.

A world is a folder of recordings; each recording is a folder of splits.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random
from typing import Any, Final

from mcap.writer import CompressionType

from tests.support.bags import (
    STATUS_FLAGS,
    McapLayout,
    Msg,
    boolean,
    make,
    odom,
    text,
    tf,
    tf_of,
    transform,
    write_db3,
    write_mcap,
)

S: Final = 10**9
START: Final = 1_795_000_000 * S
LABELS: Final = ("cup", "scissors", "red chair", "Person 2", "straße")
PACKED: Final = McapLayout(chunk_size=64 * 1024, compression=CompressionType.ZSTD)
_DRIVE_S: Final = 60
_STEP_S: Final = 1 / 50
"""Between two poses of the robot that drives with noise."""
_UNSURE_S: Final = 0.25
"""How much shorter or longer a stop may seem: noise of 5 mm hides five poses of a slow robot, 0.1 s
at either end.
"""


@dataclass(frozen=True)
class World:
    """A folder of bags, and what the robot really did.

    Attributes:
        moved: true path length (m) between two times (ns), where the world knows it.
        stood: how long (s) the robot stood between two times (ns), at least and at most, where the
            world knows it.
        noisy: whether poses have noise.
        tf: whether transforms may be asked: `(topic, is it static)`.
        odometry: the topics that carry the robot's pose.
    """

    folder: Path
    storage: str = "mcap"
    moved: Callable[[int, int], float] | None = None
    stood: Callable[[int, int], tuple[float, float]] | None = None
    noisy: bool = False
    path_tolerance: float = 0.0
    tf: Sequence[tuple[str, bool]] = ()
    odometry: Sequence[str] = ("/odom",)
    settings: Sequence[str] = ()


def drifting_map(folder: Path, draw: Random) -> World:
    """A robot with 5 mm of pose noise, a moving map, and /tf_static repeated in every split."""
    messages: list[Msg] = []
    legs = _legs(draw, _DRIVE_S)
    for tick in range(_DRIVE_S * 50):
        at = START + tick * S // 50
        x, y, yaw, speed = _along(legs, tick / 50)
        noise = [draw.gauss(0, 0.005), draw.gauss(0, 0.005)]
        messages.append(odom(at, x + noise[0], y + noise[1], yaw, vx=speed))
        messages.append(tf_of(at, "odom", "base_link", (x, y, 0.0), yaw))
        if tick % 25 == 0:
            drift = 0.02 * math.sin(tick / 300)
            messages.append(tf_of(at, "map", "odom", (1.0 + drift, -2.0, 0.0), drift))
        if tick % 500 == 0:
            mount = transform(at, "base_link", "camera", (0.2, 0.0, 0.5), 0.3)
            messages.append(tf(at, mount, topic="/tf_static"))
        if tick % 10 == 0 and 12 < tick / 50 < 31:
            labels = ", ".join(draw.sample(LABELS, 2))
            messages.append(text(at, labels, "/vision/scene/scene_objects"))
    written(folder / "rec_a", messages, layout=PACKED)
    return World(
        folder,
        moved=lambda start, end: _length(legs, (start - START) / S, (end - START) / S),
        stood=lambda start, end: _standing(legs, (start - START) / S, (end - START) / S),
        noisy=True,
        path_tolerance=0.03,
        tf=(("/tf", False), ("/tf_static", True)),
    )


def two_robots(folder: Path, draw: Random) -> World:
    """A boat whose map moves, and beside it somebody's Nav2 bag with a static map -> odom."""
    boat: list[Msg] = []
    for tick in range(40 * 20):
        at = START + tick * S // 20
        boat.append(_framed(odom(at, 0.05 * tick, 0.0, vx=1.0, topic="/boat/odom"), "boat_odom"))
        boat.append(tf_of(at, "map", "boat_odom", (0.01 * tick, 3.0, 0.0)))
        boat.append(tf_of(at, "boat_odom", "boat", (0.05 * tick, 0.0, 0.0)))
    written(folder / "boat", boat, layout=PACKED)
    later = START + 3600 * S
    fixed = transform(later, "map", "cart_odom", (5.0, 5.0, 0.0), 0.5)
    cart = [tf(later, fixed, topic="/tf_static")]
    for tick in range(20 * 30):
        at = later + tick * S // 30
        pose = odom(at, 0.01 * tick, 0.5, 0.1, vx=0.3, topic="/cart/odom")
        cart.append(_framed(pose, "cart_odom"))
        cart.append(tf_of(at, "cart_odom", "cart", (0.01 * tick, 0.5, 0.0), 0.1))
        if tick % 40 == 0:
            cart.append(_status(at, draw))
    written(folder / "cart", cart, split_s=7, layout=PACKED)
    return World(
        folder,
        tf=(("/tf", False), ("/tf_static", True)),
        odometry=("/boat/odom", "/cart/odom"),
        settings=("data.pose_topic=/boat/odom",),
    )


def clock_from_zero(folder: Path, draw: Random) -> World:
    """Stamps and log times from 0 on, written out of order, in chunks that overlap."""
    messages: list[Msg] = []
    for tick in range(30 * 25):
        at = tick * S // 25
        messages.append(odom(at, math.sin(tick / 40), math.cos(tick / 40), vx=0.6))
        if tick % 5 == 0:
            messages.append(boolean(at, draw.random() < 0.1))
        if tick % 50 == 0:
            messages.append(_status(at, draw))
            messages.append(text(at, draw.choice(("docked", "level 20", "Ünder way")), "/notes"))
    for first in range(0, len(messages) - 8, 8):
        part = messages[first : first + 8]
        draw.shuffle(part)
        messages[first : first + 8] = part
    written(folder / "zero", messages, split_s=12, layout=replace(PACKED, chunk_size=2048))
    return World(folder)


def resets_and_gaps(folder: Path, draw: Random) -> World:
    """Three runs with pauses between, each of which begins at the origin again; sqlite3 files."""
    for run in range(3):
        messages: list[Msg] = []
        begin = START + run * 400 * S
        for tick in range(25 * 20):
            at = begin + tick * S // 20
            x = 0.02 * tick
            messages.append(odom(at, x, 0.5 * run, vx=0.4))
            if tick % 7 == 0:
                messages.append(boolean(at, draw.random() < 0.2))
            if tick % 30 == 0:
                messages.append(_number(at, "/battery", 0.9 - 0.01 * run - 0.0005 * tick))
        write_db3(folder / f"run_{run}" / f"run_{run}_0.db3", messages)
    return World(folder, storage="rosbag2", moved=_runs_of(3, 400, 25, 0.4), path_tolerance=0.004)


def fast_latched(folder: Path, draw: Random) -> World:
    """PX4's way: telemetry at 50 Hz that is transient local, a map published once, /rosout."""
    messages: list[Msg] = [text(START, "kitchen", "/map_name")]
    latched = frozenset({"/map_name", "/fmu/out/speed", "/fmu/out/vehicle_status"})
    for tick in range(30 * 50):
        at = START + tick * S // 50
        if tick < 900:
            messages.append(_number(at, "/fmu/out/speed", math.sin(tick / 100)))
        if tick % 50 == 0:
            messages.append(_status(at, draw, "/fmu/out/vehicle_status"))
            messages.append(odom(at, tick / 500, 0.0, vx=0.1))
    written(folder / "px4", messages, layout=replace(PACKED, latched=latched))
    return World(folder, moved=None)


WORLDS: Final[Mapping[str, Callable[[Path, Random], World]]] = {
    "drifting_map": drifting_map,
    "two_robots": two_robots,
    "clock_from_zero": clock_from_zero,
    "resets_and_gaps": resets_and_gaps,
    "fast_latched": fast_latched,
}


# -- the robot's way ---------------------------------------------------------------------------


@dataclass(frozen=True)
class _Leg:
    """Straight ahead at one speed (m/s, 0 to stand) for some seconds."""

    begin: float
    end: float
    x: float
    y: float
    yaw: float
    speed: float


def _legs(draw: Random, length_s: int) -> list[_Leg]:
    legs: list[_Leg] = []
    at = x = y = yaw = 0.0
    while at < length_s:
        lasts = draw.uniform(4, 12)
        speed = 0.0 if len(legs) % 3 == 1 else draw.uniform(0.2, 1.5)
        legs.append(_Leg(at, at + lasts, x, y, yaw, speed))
        x += speed * lasts * math.cos(yaw)
        y += speed * lasts * math.sin(yaw)
        at += lasts
        yaw += draw.uniform(-1.5, 1.5)
    return legs


def _along(legs: Sequence[_Leg], at: float) -> tuple[float, float, float, float]:
    leg = next(each for each in legs if each.begin <= at < each.end)
    gone = leg.speed * (at - leg.begin)
    return leg.x + gone * math.cos(leg.yaw), leg.y + gone * math.sin(leg.yaw), leg.yaw, leg.speed


def _length(legs: Sequence[_Leg], start: float, end: float) -> float:
    return sum(
        leg.speed * max(min(leg.end, end) - max(leg.begin, start), 0.0)
        for leg in legs
    )  # fmt: skip


def _standing(legs: Sequence[_Leg], start: float, end: float) -> tuple[float, float]:
    """Seconds in stops of 3 s and more, at least and at most.

    Where it stopped, and left, is known to some poses: a stop of hardly 3 s may count or not.
    """
    last_pose = _DRIVE_S - _STEP_S
    stops = [(leg.begin, min(leg.end, last_pose)) for leg in legs if leg.speed == 0]
    least, most = (
        sum(
            max(min(last, end) - max(first, start), 0.0)
            for first, last in stops
            if last - first >= shortest
        )
        for shortest in (3 + _UNSURE_S, 3 - _UNSURE_S)
    )
    return least, most


def _runs_of(runs: int, apart_s: int, length_s: int, speed: float) -> Callable[[int, int], float]:
    def moved(start: int, end: int) -> float:
        total = 0.0
        for run in range(runs):
            begin = START + run * apart_s * S
            last = begin + length_s * S - S // 20
            total += speed * max(min(end, last) - max(start, begin), 0) / S
        return total

    return moved


def written(
    folder: Path,
    messages: Iterable[Msg],
    *,
    split_s: int = 10,
    layout: McapLayout | None = None,
) -> None:
    """Writes one recording as MCAP splits of so many seconds, the first from its first message."""
    parts: dict[int, list[Msg]] = {}
    first = None
    for each in messages:
        first = each.log_time if first is None else first
        parts.setdefault((each.log_time - first) // (split_s * S), []).append(each)
    for number, key in enumerate(sorted(parts)):
        write_mcap(folder / f"{folder.name}_{number}.mcap", parts[key], layout)


def _framed(pose: Msg, frame_id: str) -> Msg:
    body: Any = pose.body
    body.header.frame_id = frame_id
    return pose


def _number(at: int, topic: str, value: float) -> Msg:
    kind = "std_msgs/msg/Float64"
    return Msg(topic, kind, at, make(kind, data=value))


def _status(at: int, draw: Random, topic: str = "/status") -> Msg:
    """A status of many booleans."""
    kind = "px4_msgs/msg/VehicleStatus"
    flags = {name: draw.random() < 0.3 for name in STATUS_FLAGS}
    state, lost = draw.randrange(20), draw.randrange(3)
    body = make(
        kind,
        timestamp=at // 1000,
        arming_state=state,
        gcs_connection_lost_counter=lost,
        **flags,
    )
    return Msg(topic, kind, at, body)
