"""A full disk under the temporary files that compressed bags are unpacked into."""

import errno
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest

from ros2_memory.core.errors import BagUnreachableError
from ros2_memory.index.file_state import RETRY_SOON_NS
from ros2_memory.storage.errors import UnreachableError
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
from ros2_memory.storage.scratch import Scratch
from tests.faults.small_disk import filled, needs_mounts, small_disk
from tests.faults.world import NOW, compress, told, write_bags
from tests.support.clocks import SettableClock
from tests.support.memories import memory_of

COUNT = 3


@needs_mounts
def test_bags_that_cannot_be_unpacked_say_why_and_are_read_when_there_is_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bag_dir = tmp_path / "bags"
    for path in write_bags(bag_dir, COUNT):
        compress(path)
    right = told(memory_of(bag_dir, clock=NOW, storage="rosbag2"), count=COUNT)
    with small_disk(tmp_path / "temporary", "1m") as disk:
        monkeypatch.setattr(tempfile, "tempdir", str(disk))
        clock = SettableClock(NOW.now())
        memory = memory_of(bag_dir, clock=clock, reader=Rosbag2Reader())
        with filled(disk):
            damaged = memory.index.snapshot().damaged
        assert len(damaged) == COUNT
        for each in damaged:
            assert "the folder for temporary files (No space left on device)" in each.reason
            assert "name another folder in TMPDIR" in each.reason
        clock.at += RETRY_SOON_NS
        assert told(memory, count=COUNT) == right
        # What was unpacked before the disk filled up still answers.
        with filled(disk):
            assert told(memory, count=COUNT) == right


def test_without_a_folder_for_temporary_files_no_bag_counts_as_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    [path] = write_bags(tmp_path, 1)
    compress(path)

    def none(**_: object) -> str:
        raise FileNotFoundError(errno.ENOENT, "No usable temporary directory found")

    monkeypatch.setattr(tempfile, "mkdtemp", none)
    with pytest.raises(BagUnreachableError, match="No usable temporary directory"):
        Rosbag2Reader().summarize(path.with_name(f"{path.name}.zstd"))


def test_a_disk_that_fills_while_a_bag_is_unpacked_leaves_nothing_behind(tmp_path: Path) -> None:
    scratch = Scratch(1 << 20)
    made: list[Path] = []

    def fill(folder: Path, _reserve: Callable[[int], None]) -> tuple[Path, str]:
        made.append(folder)
        (folder / "half").write_bytes(b"x")
        raise OSError(errno.ENOSPC, "No space left on device")

    with (
        pytest.raises(UnreachableError, match="TMPDIR"),
        scratch.use("key", fill),
    ):
        pytest.fail("there is nothing to hold")
    assert not made[0].exists()
