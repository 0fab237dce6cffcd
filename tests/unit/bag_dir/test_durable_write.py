"""Small files that are replaced at once, and closed bags that survive a power cut."""

import errno
import os
from pathlib import Path

import pytest

from ros2_memory.bag_dir.durable_write import (
    flush_bags,
    write_durably,
)


@pytest.fixture
def flushed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What the system was asked to flush, by name and in order."""
    names: list[str] = []

    def fsync(descriptor: int) -> None:
        names.append(Path(f"/proc/self/fd/{descriptor}").readlink().name)

    monkeypatch.setattr(os, "fsync", fsync)
    return names


def test_closed_splits_are_flushed_and_then_the_directory_that_names_them(
    tmp_path: Path, flushed: list[str]
) -> None:
    (tmp_path / "a.mcap").touch()
    (tmp_path / "b.mcap").touch()
    assert flush_bags(tmp_path, ["a.mcap", "b.mcap", "gone.mcap"]) == []
    assert flushed == ["a.mcap", "b.mcap", tmp_path.name]


def test_what_cannot_be_flushed_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.mcap").touch()

    def broken(_descriptor: int) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "fsync", broken)
    faults = flush_bags(tmp_path, ["a.mcap"])
    assert len(faults) == 2
    assert faults[0].startswith(str(tmp_path / "a.mcap"))
    assert "power cut" in faults[0]


def test_a_full_disk_names_the_file_that_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left") as raised:
        write_durably(tmp_path / "a.yaml", "text")
    assert raised.value.filename == str(tmp_path / "a.yaml")
    assert [*tmp_path.iterdir()] == []
