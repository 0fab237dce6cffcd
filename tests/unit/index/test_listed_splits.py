"""What metadata.yaml lists is read once."""

import os
from collections.abc import Sequence
from pathlib import Path

import pytest

from ros2_memory.history.context import Memory
from ros2_memory.index import listed_splits
from ros2_memory.index.listed_splits import Absent
from tests.support.bags import text, write_mcap
from tests.support.memories import memory_of, with_store

T0 = 1_700_000_000 * 10**9
LONG_AGO = (T0 / 1e9, T0 / 1e9)


def recording(bag_dir: Path, name: str = "r", *, messages: int = 1) -> Memory:
    """A recording of five splits, of which two are missing, as another program left it."""
    for n in (0, 2, 4):
        write_mcap(bag_dir / name / f"r_{n}.mcap", [text(T0 + n, "a")])
    files = "".join(f"  - path: r_{n}.mcap\n    message_count: {messages}\n" for n in range(5))
    listing = bag_dir / name / "metadata.yaml"
    listing.write_text(f"rosbag2_bagfile_information:\n  files:\n{files}")
    for each in (listing, listing.parent):
        os.utime(each, LONG_AGO)
    return memory_of(bag_dir)


def found(memory: Memory) -> Sequence[Absent]:
    return memory.absent_splits(memory.index.snapshot())


def test_what_changed_since_is_read_again(tmp_path: Path) -> None:
    memory = recording(tmp_path)
    assert [each.files for each in found(memory)] == [("r_1.mcap", "r_3.mcap")]
    write_mcap(tmp_path / "r" / "r_1.mcap", [text(T0 + 1, "a")])
    assert [each.files for each in found(memory)] == [("r_3.mcap",)]
    (tmp_path / "r" / "metadata.yaml").unlink()
    assert found(memory) == []


def test_what_was_stored_is_not_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    memory = with_store(recording(tmp_path, messages=7), tmp_path)
    [absent] = found(memory)
    memory.store_listings(memory.index.snapshot())
    monkeypatch.setattr(listed_splits, "read_listing", None)
    later = with_store(memory_of(tmp_path), tmp_path)
    assert found(later) == [absent]
    (tmp_path / "r" / "metadata.yaml").unlink()
    later.store_listings(later.index.refresh())
    assert later.scanner.store is not None
    assert later.scanner.store.listings() == {}
