"""Where the simulated robot of the recorded sessions was, in closed form.

A circle of radius 2 m at 0.5 m/s, t seconds after the session's T0: from (0, 0) facing +x, turning
left about (0, 2). Header stamps are T0 + t exactly; log times lie some milliseconds later.
`written_session` writes such a session, so that its truth is held to without the recorded ones.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from mcap.writer import CompressionType

from tests.support.bags import (
    McapLayout,
    Msg,
    battery,
    boolean,
    command,
    detections,
    odom,
    tf,
    transform,
    write_mcap,
)
from tests.support.housekeepers import described
from tests.support.memories import ROOT
from tests.support.shared_bags import RECORDED

if TYPE_CHECKING:
    from collections.abc import Iterator

TURN_RATE: Final = 0.25  # rad/s
RADIUS: Final = 2.0  # m
SPEED: Final = 0.5  # m/s
LASER: Final = (0.10, 0.0, 0.20)  # in base_link, m
CAMERA: Final = (0.15, 0.0, 0.30)
SEEN: Final = {
    "table": ((0.0, math.inf),),
    "cup": ((5.0, 30.0),),
    "scissors": ((12.0, 18.0), (40.0, 46.0)),
}
"""When its detector saw what (seconds after T0)."""


@dataclass(frozen=True)
class Session:
    """A recorded session: its folder, its T0 (ns) and the adapter that reads it."""

    folder: Path
    t0: int
    storage: str = "mcap"

    def at(self, t: float) -> float:
        """Unix seconds, t seconds after T0."""
        return self.t0 / 1e9 + t

    def since(self, unix_s: float) -> float:
        """Seconds after T0."""
        return unix_s - self.t0 / 1e9


SMALL: Final = Session(ROOT / "tests" / "data" / "session_zstd", 1795144023536000000)
SESSIONS: Final = {
    "session_mcap": Session(RECORDED / "session_mcap", 1795144003095000000),
    "session_zstd": Session(RECORDED / "session_zstd", 1795144023536000000),
    "session_sqlite3": Session(RECORDED / "session_sqlite3", 1795144003086000000, "rosbag2"),
    "session_zstd_file": Session(RECORDED / "session_zstd_file", 1795144044072000000, "rosbag2"),
}


def position(t: float) -> tuple[float, float]:
    """x and y in the odom frame (m)."""
    angle = TURN_RATE * t
    return RADIUS * math.sin(angle), RADIUS * (1 - math.cos(angle))


def yaw_deg(t: float) -> float:
    """Heading in (-180, 180]."""
    angle = TURN_RATE * t
    return math.degrees(math.atan2(math.sin(angle), math.cos(angle)))


def degrees_apart(a: float, b: float) -> float:
    """The unsigned distance of two headings."""
    return abs((a - b + 180) % 360 - 180)


def mounted(t: float, mount: tuple[float, float, float]) -> tuple[float, float, float]:
    """A sensor's place in odom (m), its mount given in base_link."""
    x, y = position(t)
    angle = TURN_RATE * t
    return (
        x + mount[0] * math.cos(angle) - mount[1] * math.sin(angle),
        y + mount[0] * math.sin(angle) + mount[1] * math.cos(angle),
        mount[2],
    )


_TICKS: Final = 1300
_TICK_NS: Final = 50_000_000
_SPLIT_TICKS: Final = 200
_LAYOUT: Final = McapLayout(chunk_size=16_384, compression=CompressionType.ZSTD)


def written_session(folder: Path) -> Session:
    """Writes 65 s of the simulated robot as `ros2 bag record` lays them out: splits of 10 s."""
    session = Session(folder, 1795144003095000000)
    for nth, first in enumerate(range(0, _TICKS, _SPLIT_TICKS)):
        messages = _messages(session.t0, first, min(first + _SPLIT_TICKS, _TICKS))
        write_mcap(folder / f"{folder.name}_{nth}.mcap", messages, _LAYOUT)
    described(folder)
    return session


def _messages(t0: int, first: int, stop: int) -> Iterator[Msg]:
    """The messages of some ticks, each logged some tenths of a millisecond after the other."""
    for tick in range(first, stop):
        at, t = t0 + tick * _TICK_NS, tick / 20
        x, y = position(t)
        turned = math.radians(yaw_deg(t))
        found = [
            odom(at, x, y, turned, vx=SPEED, wz=TURN_RATE),
            tf(at, transform(at, "odom", "base_link", (x, y, 0.0), turned)),
        ]
        if not tick:
            mounts = {"laser": LASER, "camera": CAMERA}
            fixed = [transform(at, "base_link", name, mount) for name, mount in mounts.items()]
            found.append(tf(at, *fixed, topic="/tf_static"))
        if tick % 2 == 0:
            found.append(command(at, SPEED, TURN_RATE))
        if tick % 10 == 0:
            found.append(boolean(at, 25.0 <= t < 26.0))
        if tick % 20 == 0:
            found.append(battery(at, 0.80 - 0.001 * t))
            found.append(detections(at, [name for name in SEEN if _is_seen(name, t)]))
        for nth, each in enumerate(found, 1):
            yield replace(each, log_time=at + nth * 300_000, publish_time=at + nth * 200_000)


def _is_seen(name: str, t: float) -> bool:
    return any(begin <= t < end for begin, end in SEEN[name])
