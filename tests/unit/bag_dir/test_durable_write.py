"""Small files that are replaced at once, and closed bags that survive a power cut."""

import errno
import os
from pathlib import Path

import pytest

from ros2_memory.bag_dir.durable_write import flush_bags, write_durably
from tests.support.fakes import broken


def test_closed_splits_are_flushed_and_then_the_directory_that_names_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flushed: list[str] = []

    def fsync(descriptor: int) -> None:
        flushed.append(Path(f"/proc/self/fd/{descriptor}").readlink().name)

    monkeypatch.setattr(os, "fsync", fsync)
    (tmp_path / "a.mcap").touch()
    (tmp_path / "b.mcap").touch()
    assert flush_bags(tmp_path, ["a.mcap", "b.mcap", "gone.mcap"]) == []
    assert flushed == ["a.mcap", "b.mcap", tmp_path.name]


def test_what_cannot_be_flushed_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").touch()
    with broken(os, "fsync", errno.EIO):
        faults = flush_bags(tmp_path, ["a.mcap"])
    assert len(faults) == 2
    assert faults[0].startswith(str(tmp_path / "a.mcap"))
    assert "power cut" in faults[0]


def test_a_full_disk_names_the_file_that_cannot_be_written(tmp_path: Path) -> None:
    with broken(os, "fsync"), pytest.raises(OSError, match="No space left") as raised:
        write_durably(tmp_path / "a.yaml", "text")
    assert raised.value.filename == str(tmp_path / "a.yaml")
    assert [*tmp_path.iterdir()] == []
