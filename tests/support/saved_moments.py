"""Recordings of some splits, and moments of them that are kept."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from ros2_memory.bag_dir.layout import MOMENT_FILE
from ros2_memory.bag_dir.request_queue import PendingRequest
from tests.support.bags import McapLayout, odom, write_mcap
from tests.support.clocks import SettableClock
from tests.support.housekeepers import keeper_of

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.bag_dir.request_queue import Outcome
    from ros2_memory.recorder.housekeeping import Housekeeping

S = 10**9
T0 = 1_790_000_000 * S
NOW = T0 + 4 * 3600 * S
A, B = "rec_20260921T101320Z", "rec_20260921T102320Z"


def bag(path: Path, start: int, layout: McapLayout | None = None) -> Path:
    """A split of ten seconds; where the robot is tells the time."""
    times = [T0 + (start + n) * S for n in range(10)]
    return write_mcap(path, [odom(at, (at - T0) / S, 2.0) for at in times], layout)


def recording(bag_dir: Path, name: str, start: int, splits: int = 6) -> list[Path]:
    made = [bag(bag_dir / name / f"{name}_{n}.mcap", start + n * 10) for n in range(splits)]
    (bag_dir / name / "handover.json").write_text('{"format": 1}')
    return made


def asked(
    bag_dir: Path, start: int, end: int, label: str = "here", at: int = NOW
) -> PendingRequest:
    """Asks for what was recorded in these seconds."""
    pending = PendingRequest(bag_dir, label, T0 + start * S, T0 + end * S, at)
    pending.post()
    return pending


def kept(
    house: Housekeeping, bag_dir: Path, start: int, end: int, label: str = "here", at: int = NOW
) -> Outcome:
    pending = asked(bag_dir, start, end, label, at)
    house.keep_moments()
    outcome = pending.outcome()
    pending.close()
    assert outcome is not None
    return outcome


def house_of(bag_dir: Path, **limits: Any) -> Housekeeping:
    return keeper_of(bag_dir, **{"clock": SettableClock(NOW), **limits})


def in_moments(bag_dir: Path) -> list[str]:
    """The bags that are kept, each as moment and name."""
    return [
        path.relative_to(bag_dir / "moments").as_posix()
        for path in sorted((bag_dir / "moments").rglob("*.mcap"))
    ]


def told_of(bag_dir: Path) -> dict[str, Any]:
    [path] = (bag_dir / "moments").glob(f"*/{MOMENT_FILE}")
    reported: dict[str, Any] = json.loads(path.read_text())
    return reported
