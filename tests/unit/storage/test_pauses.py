"""Where no topic has a message for a while, as the summary of a bag states it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
from tests.support.bags import McapLayout, Msg, boolean, odom, write_db3, write_mcap

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.core.pauses import Pauses

S = 10**9
BEGIN = 1_784_000_000 * S
KINDS = {"mcap": 1 << 12, "large chunks": 1 << 20, "no chunks": None, "no summary": 1 << 12}
"""The sizes of their chunks."""


def every(hz: float, seconds: float, *, but: tuple[tuple[float, float], ...] = ()) -> list[float]:
    times = [n / hz for n in range(round(hz * seconds))]
    return [t for t in times if not any(start < t < stop for start, stop in but)]


def bag_of(odometry: list[float], flags: list[float]) -> list[Msg]:
    messages = [odom(BEGIN + round(t * S), 0.0, 0.0) for t in odometry]
    messages += [boolean(BEGIN + round(t * S) + 1, data=True) for t in flags]
    return sorted(messages, key=lambda message: message.log_time)


def pauses(folder: Path, kind: str, messages: list[Msg]) -> Pauses:
    if kind == "db3":
        path = write_db3(folder / "bag.db3", messages)
    else:
        path = write_mcap(folder / "bag.mcap", messages, McapLayout(chunk_size=KINDS[kind]))
    if kind == "no summary":
        path.write_bytes(path.read_bytes()[: -path.stat().st_size // 50])
    return Rosbag2Reader().summarize(path).schema.pauses


@pytest.mark.parametrize("kind", [*KINDS, "db3"])
def test_a_pause_of_all_topics_is_found_wherever_its_messages_lie(
    tmp_path: Path, kind: str
) -> None:
    """And none where a slower topic goes on."""
    off = ((3.0, 3.7), (5.0, 5.4), (6.0, 8.0))
    messages = bag_of(every(50, 10, but=(*off, (1, 2.5))), every(10, 10, but=off))
    assert pauses(tmp_path, kind, messages) == (
        (BEGIN + 3 * S + 1, BEGIN + round(3.7 * S)),
        (BEGIN + 6 * S + 1, BEGIN + 8 * S),
    )
