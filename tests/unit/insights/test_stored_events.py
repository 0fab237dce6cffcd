"""What messages report is worked out while the store is filled, and read by each process after."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from ros2_memory.columns.stated import StatedColumns
from tests.support.bags import boolean, command, detections, log_entry, write_splits
from tests.support.memories import asked, memory_of, with_store

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.history.context import Memory

S = 10**9
BEGIN = 1_784_000_400
SPAN = {"start": BEGIN, "end": BEGIN + 1199}


def written(folder: Path) -> Memory:
    """Twenty minutes: a bumper, a detector that sees a cup at times, commands, and two errors."""
    rows = [boolean((BEGIN + at) * S, data=at % 100 == 40) for at in range(0, 1200, 10)]
    seen = [["cup"] if at % 200 < 50 else [] for at in range(0, 1200, 5)]
    rows += [detections((BEGIN + 5 * nth) * S, labels) for nth, labels in enumerate(seen)]
    rows += [command((BEGIN + at) * S, float(at % 60 < 40)) for at in range(1200)]
    rows += [log_entry((BEGIN + at) * S, 40, "arm", "stuck") for at in (100, 900)]
    write_splits(folder, rows, 60)
    return memory_of(folder)


def recalled(memory: Memory) -> Any:
    return asked(memory, memory.index.bag_dir, "recap", **SPAN)


def test_a_later_process_reads_them_from_the_store(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory = written(tmp_path)
    from_bags = recalled(memory)
    assert from_bags["counts"] == {"errors": 1, "on/off changes": 24, "sightings": 6}
    filled = with_store(memory, tmp_path)
    filled.scanner.write_fragments()

    def worked_out_again(*_: object) -> None:
        pytest.fail("a part's messages were looked at again")

    monkeypatch.setattr(StatedColumns, "of", worked_out_again)
    assert recalled(with_store(memory_of(tmp_path), tmp_path)) == from_bags
