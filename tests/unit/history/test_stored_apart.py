"""What is computed of some bags is stored whatever could not be read of others."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ros2_memory.history.context import Call
from ros2_memory.history.view import TimeRange
from ros2_memory.insights.recap import recap
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import odom, write_mcap
from tests.support.mcap_surgery import spoil_chunk
from tests.support.memories import memory_of, recalling

if TYPE_CHECKING:
    from pathlib import Path

S = 10**9


def test_a_damaged_bag_keeps_no_digest_of_others_from_being_stored(
    tmp_path: Path,
) -> None:
    poses = [odom(n * S, float(n), 0.0) for n in range(1, 10)]
    spoil_chunk(write_mcap(tmp_path / "a" / "a_0.mcap", poses), 0)
    for name in ("b", "c"):  # they overlap, so their digest is made by the first question
        messages = [odom(n * S, float(n), 0.0) for n in range(100, 110)]
        write_mcap(tmp_path / name / f"{name}_0.mcap", messages)
    memory = recalling(memory_of(tmp_path, reader=McapReader()), tmp_path)
    assert memory.recall is not None
    recap(memory, Call(), TimeRange(0.0, 200.0))
    assert memory.recall.catalogue.cached_answers("poses /odom")
