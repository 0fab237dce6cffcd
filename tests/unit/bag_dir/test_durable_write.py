"""Small files that are replaced at once, and closed bags that survive a power cut."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from ros2_memory.bag_dir.durable_write import (
    flush_bags,
    write_all_durably,
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
