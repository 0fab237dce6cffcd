"""Small files that are replaced at once, and closed bags that survive a power cut."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from ros2_memory.bag_dir import durable_write
from ros2_memory.bag_dir.durable_write import (
    flush_bags,
    read_small_file,
    write_all_durably,
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


def test_a_small_file_is_on_the_disk_before_it_gets_its_name(
    tmp_path: Path, flushed: list[str]
) -> None:
    write_durably(tmp_path / "state.json", "{}")
    assert flushed == [".state.json.tmp", tmp_path.name]
    assert [path.name for path in tmp_path.iterdir()] == ["state.json"]


def test_a_file_that_cannot_be_replaced_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "state.json"
    write_durably(target, "before")

    def full(_descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write_durably(target, "after")
    assert target.read_text() == "before"
    assert [path.name for path in tmp_path.iterdir()] == ["state.json"]


def test_closed_splits_are_flushed_and_then_the_directory_that_names_them(
    tmp_path: Path, flushed: list[str]
) -> None:
    (tmp_path / "a.mcap").touch()
    (tmp_path / "b.mcap").touch()
    assert flush_bags(tmp_path, ["a.mcap", "b.mcap"]) == []
    assert flushed == ["a.mcap", "b.mcap", tmp_path.name]


def test_a_split_that_was_deleted_is_no_fault(tmp_path: Path) -> None:
    assert flush_bags(tmp_path, ["gone.mcap"]) == []


def test_what_cannot_be_flushed_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.mcap").touch()

    def broken(_descriptor: int) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "fsync", broken)
    faults = flush_bags(tmp_path, ["a.mcap"])
    assert len(faults) == 2
    assert faults[0].startswith(str(tmp_path / "a.mcap"))
    assert "power cut" in faults[0]


def test_only_a_small_regular_file_is_read(tmp_path: Path) -> None:
    (tmp_path / "large").write_bytes(b" " * (durable_write.MAX_SMALL_FILE + 1))
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "fine").write_text("text")
    assert read_small_file(tmp_path / "fine") == "text"
    with pytest.raises(ValueError, match="larger than"):
        read_small_file(tmp_path / "large")
    with pytest.raises(ValueError, match="not a regular file"):
        read_small_file(tmp_path / "pipe")


def test_of_several_files_none_is_replaced_where_one_cannot_be_written(tmp_path: Path) -> None:
    first, second = tmp_path / "a.json", tmp_path / "b.json"
    first.write_text("before")
    second.write_text("before")
    (tmp_path / ".b.json.tmp").mkdir()  # in the way, as a full disk is
    with pytest.raises(IsADirectoryError):
        write_all_durably({first: "after", second: "after"})
    assert (first.read_text(), second.read_text()) == ("before", "before")
    assert not (tmp_path / ".a.json.tmp").exists()
    (tmp_path / ".b.json.tmp").rmdir()
    write_all_durably({first: "after", second: "after"})
    assert (first.read_text(), second.read_text()) == ("after", "after")
