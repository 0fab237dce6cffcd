"""Where the simulated robot of the recorded sessions was, in closed form.

A circle of radius 2 m at 0.5 m/s, t seconds after the session's T0: from (0, 0) facing +x, turning
left about (0, 2). Header stamps are T0 + t exactly; log times lie some milliseconds later.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tests.support.memories import ROOT
from tests.support.shared_bags import RECORDED

TURN_RATE: Final = 0.25  # rad/s
RADIUS: Final = 2.0  # m
SPEED: Final = 0.5  # m/s
LASER: Final = (0.10, 0.0, 0.20)  # in base_link, m
CAMERA: Final = (0.15, 0.0, 0.30)


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
