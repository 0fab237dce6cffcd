"""Metres in each bin where a bag has a jump."""

from __future__ import annotations

from datetime import UTC, datetime
from random import Random
from typing import TYPE_CHECKING

import pytest

from ros2_memory.counts.robot import count_path
from ros2_memory.history.context import Call
from ros2_memory.history.view import TimeRange
from tests.support.bags import odom, write_mcap
from tests.support.memories import memory_of

if TYPE_CHECKING:
    from pathlib import Path

S = 10**9
HOUR = 1_784_001_600 * S  # a whole hour of UTC


def test_a_jump_in_the_bag_in_which_a_bin_ends_adds_no_metres(tmp_path: Path) -> None:
    """Drives 1 m/s for 20 s around the full hour, and jumps by 500 m 5 s after it."""
    messages = []
    for step in range(400):
        at = HOUR - 10 * S + step * S // 20
        messages.append(odom(at, step / 20 + (500 if step >= 300 else 0), 0.0))
    write_mcap(tmp_path / "bag.mcap", messages)
    span = TimeRange(HOUR / S - 100, HOUR / S + 100)
    found = count_path(memory_of(tmp_path), Call(), span, "hour")
    column = [name for name, _ in found.columns].index("metres")
    metres = [row[column] for _, row in found.rows if row[column]]
    assert metres == pytest.approx([10.0, 9.9], abs=0.2)
    assert found.all[column] == pytest.approx(19.9, abs=0.2)


def test_hours_without_a_recording_have_no_row_whatever_was_driven_before(tmp_path: Path) -> None:
    drawn = Random(5)
    x = 0.0
    for recording in range(3):
        messages = []
        for step in range(200):
            x += drawn.random() * 0.05
            at = HOUR + recording * 5 * 3600 * S + 1234 * S + step * S // 10
            messages.append(odom(at, x, drawn.random() * 0.01))
        write_mcap(tmp_path / f"{recording}.mcap", messages)
    span = TimeRange(HOUR / S, HOUR / S + 50_000)
    found = count_path(memory_of(tmp_path), Call(), span, "hour")
    begins = [HOUR / S + 1234 + 5 * 3600 * nth for nth in range(3)]
    hours = [datetime.fromtimestamp(at, UTC).astimezone().strftime("%H:00") for at in begins]
    assert [name[-5:] for name, _ in found.rows] == hours
