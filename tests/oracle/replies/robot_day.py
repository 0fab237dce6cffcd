"""24 minutes of a noisy robot in splits of 10 s: a drifting map, detections, many changes."""

from __future__ import annotations

import math
from random import Random
from typing import TYPE_CHECKING, Final, NamedTuple

from tests.support.bags import (
    Msg,
    battery,
    boolean,
    detections,
    diagnostics,
    goals,
    log_entry,
    odom,
    text,
    tf,
    transform,
    write_mcap,
)

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

S: Final = 10**9
MS: Final = 10**6
BEGIN: Final = 1_784_591_400 * S
"""2026-07-20, 23:50 UTC: the day ends after ten minutes."""
SPLIT_S: Final = 10
SPLITS_OF_A_RECORDING: Final = 60
LENGTH_S: Final = 1440
POSES_HZ: Final = 4
SPEED_MPS: Final = 0.4
_SPOTS: Final = ((0.0, 0.0), (5.0, 0.5), (5.5, 4.0), (0.5, 4.5), (8.0, 2.0))
_THINGS: Final = (
    ("mug", 1.5, 0.8),
    ("coffee mug", 1.5, 0.85),
    ("chair", 5.6, 1.4),
    ("dog", 4.0, 4.2),
    ("dog bed", 0.2, 3.2),
    ("scissors", 7.5, 2.6),
)
_SEEN_WITHIN_M: Final = 3.0
_TEXTS: Final = ("Ünder way", "docked", "level 20 reached", "no path to the kitchen", "straße")
_EXECUTING, _SUCCEEDED, _ABORTED = 2, 4, 6


class _Second(NamedTuple):
    """Where the robot was (in the map) in one second, and where it went."""

    x: float
    y: float
    yaw: float
    speed: float


def write_robot_day(seed: int, folder: Path) -> None:
    """Writes recordings of ten minutes, each pause between two of them 0.05, 2 or 8 s long."""
    draw = Random(f"robot day {seed}")
    seconds = [*_way(draw, LENGTH_S)]
    count = math.ceil(len(seconds) / (SPLITS_OF_A_RECORDING * SPLIT_S))
    drift = [0.4, -0.2, 0.1]
    late_ns = 0
    for number in range(count):
        name = f"rec_{number:02}"
        for split in range(SPLITS_OF_A_RECORDING):
            first = (number * SPLITS_OF_A_RECORDING + split) * SPLIT_S
            part = seconds[first : first + SPLIT_S]
            if not part:
                break
            begin = BEGIN + first * S + late_ns
            messages = sorted(
                _split(draw, begin, first, part, drift), key=lambda message: message.log_time
            )
            write_mcap(folder / name / f"{name}_{split}.mcap", messages)
        late_ns += draw.choice((50 * MS, 2 * S, 8 * S))


def _way(draw: Random, seconds: int) -> Iterator[_Second]:
    """Yields where the robot is: it drives from spot to spot, and stands at each."""
    x, y = _SPOTS[0]
    yaw, target, stands = 0.0, 1, 20
    for _ in range(seconds):
        goal = _SPOTS[target]
        away = math.dist((x, y), goal)
        speed = 0.0
        if stands:
            stands -= 1
        elif away < SPEED_MPS:
            target, stands = draw.randrange(len(_SPOTS)), draw.randint(5, 90)
        else:
            yaw, speed = math.atan2(goal[1] - y, goal[0] - x), SPEED_MPS
        yield _Second(x, y, yaw, speed)
        x, y = x + speed * math.cos(yaw), y + speed * math.sin(yaw)


def _split(
    draw: Random,
    begin: int,
    first: int,
    part: list[_Second],
    drift: list[float],
) -> Iterator[Msg]:
    """Yields the messages of a split; `drift` (x, y, yaw of odom in the map) goes on from it."""
    mount = transform(begin, "base_link", "camera", (0.2, 0.0, 0.5), 0.1)
    yield tf(begin, mount, topic="/tf_static")
    for nth, second in enumerate(part):
        at, number = begin + nth * S, first + nth
        drift[0] += draw.gauss(0, 0.002)
        drift[1] += draw.gauss(0, 0.002)
        drift[2] += draw.gauss(0, 0.0005)
        if draw.random() < 0.002:
            drift[0] += draw.uniform(-0.8, 0.8)
        correction = transform(at, "map", "odom", (drift[0], drift[1], 0.0), drift[2])
        yield tf(at, correction, log_time=at + 3 * MS)
        yield from _poses(draw, at, second, drift)
        yield from _seen(draw, at + 40 * MS, second)
        yield from _changes(draw, at, number)


def _poses(draw: Random, at: int, second: _Second, drift: list[float]) -> Iterator[Msg]:
    cos, sin = math.cos(drift[2]), math.sin(drift[2])
    for step in range(POSES_HZ):
        gone = second.speed * step / POSES_HZ
        x = second.x + gone * math.cos(second.yaw) - drift[0] + draw.gauss(0, 0.01)
        y = second.y + gone * math.sin(second.yaw) - drift[1] + draw.gauss(0, 0.01)
        own_x, own_y = x * cos + y * sin, y * cos - x * sin
        yaw, now = second.yaw - drift[2], at + step * S // POSES_HZ
        yield odom(now, own_x, own_y, yaw, vx=second.speed, log_time=now + MS)
        base = transform(now, "odom", "base_link", (own_x, own_y, 0.0), yaw)
        yield tf(now, base, log_time=now + 2 * MS)


def _seen(draw: Random, at: int, second: _Second) -> Iterator[Msg]:
    """What is near is seen, mostly; with noise, at times with a low score, or where nothing is."""
    for label, x, y in _THINGS:
        east, north = x - second.x, y - second.y
        if math.hypot(east, north) > _SEEN_WITHIN_M or draw.random() < 0.2:
            continue
        cos, sin = math.cos(second.yaw), math.sin(second.yaw)
        ahead, left = east * cos + north * sin, north * cos - east * sin
        if ahead <= 0.2:
            continue
        place = draw.gauss(ahead, 0.05), draw.gauss(left, 0.05), 0.4
        yield detections(at, [label], at=place, score=round(draw.uniform(0.35, 0.99), 3))
    if draw.random() < 0.01:
        yield detections(at + MS, ["ghost"], at=(2.0, 0.0, 0.1), score=0.3)


def _changes(draw: Random, at: int, number: int) -> Iterator[Msg]:
    """Texts, booleans, a battery, logs, diagnostics and goals."""
    if number % 2 == 0:
        yield boolean(at + 5 * MS, (number // 150) % 2 == 0, "/is_docked")
    if draw.random() < 0.03:
        yield boolean(at + 6 * MS, draw.random() < 0.5)
    if number % 5 == 0:
        yield text(at + 7 * MS, draw.choice(_TEXTS))
    if number % 10 == 0:
        yield battery(at + 8 * MS, 0.95 - 0.9 * (number % 7200) / 7200)
    if draw.random() < 0.02:
        level = draw.choice((20, 30, 40))
        yield log_entry(at + 9 * MS, level, "planner", draw.choice(("no path", f"stuck {number}")))
    if number % 10 == 3:
        yield diagnostics(at + 10 * MS, motors=(draw.choice((0, 0, 0, 1, 2)), "warm"))
    if number % 60 == 0:
        ended = draw.choice((_EXECUTING, _SUCCEEDED, _ABORTED))
        yield goals(at + 11 * MS, {number // 60 % 250: ended})
