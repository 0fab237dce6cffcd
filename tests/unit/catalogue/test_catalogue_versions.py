"""The catalogue of another version of the program is never misread, and disturbs nobody."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import anyio
import pytest

from ros2_memory.bootstrap import build_backfill, build_dispatcher, build_memory
from ros2_memory.catalogue.sql import TABLES
from ros2_memory.catalogue.store import FILE, FOLDER
from ros2_memory.config import load_settings
from tests.support.memories import ROOT

if TYPE_CHECKING:
    from collections.abc import Callable

    from ros2_memory.config import Settings
    from ros2_memory.history.context import Memory

DATA: Final = ROOT / "tests" / "data"
WRITTEN_S: Final = 1_700_000_000
CALLS: Final[tuple[tuple[str, dict[str, Any]], ...]] = (
    ("list_recorded_topics", {}),
    ("data_time_range", {}),
    ("list_frames", {}),
    ("trajectory_summary", {"start": 0, "end": 4e9}),
    ("recap", {"start": 0, "end": 4e9}),
    ("visits", {"x": 0, "y": 0, "radius_m": 5}),
    ("find_matches", {"topic": "/*", "condition_type": "contains", "value": "a"}),
    (
        "find_last_match",
        {"topic": "/odom", "condition_type": "above", "value": 0, "field": "position.x"},
    ),
    ("get_position_seconds_ago", {"seconds_ago": 3}),
    ("memory_status", {}),
)


@pytest.fixture
def bag_dir(tmp_path: Path) -> Path:
    """The bags of which the commit 3d1d2aa made a catalogue, which lies beside them."""
    shutil.copytree(DATA / "session_zstd", tmp_path / "bags" / "session_zstd")
    for each in (tmp_path / "bags" / "session_zstd").iterdir():
        os.utime(each, (WRITTEN_S, WRITTEN_S))
    folder = tmp_path / "bags" / FOLDER
    folder.mkdir()
    shutil.copyfile(DATA / "catalogue_3d1d2aa" / FILE, folder / FILE)
    # A recorder has been here, so the catalogue lies beside the bags.
    (tmp_path / "bags" / "recorder.json").write_text("{}")
    return tmp_path / "bags"


@pytest.fixture(autouse=True)
def _cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def settings_of(bag_dir: Path) -> Settings:
    return load_settings([f"recording.bag_dir={bag_dir}", "data.now=latest"], {})


def replies(settings: Settings, memory: Memory) -> dict[str, Any]:
    dispatcher = build_dispatcher(settings, memory)

    async def ask() -> dict[str, Any]:
        return {
            name: json.loads((await dispatcher.answer(name, given)).text) for name, given in CALLS
        }

    try:
        return anyio.run(ask)
    finally:
        dispatcher.stop()


def fill(settings: Settings, memory: Memory) -> int:
    filler = build_backfill(settings, memory)
    return sum(filler.digest(bag) for bag in filler.waiting())


def close(memory: Memory) -> None:
    assert memory.recall is not None
    memory.recall.catalogue.close()


def without_catalogue(bag_dir: Path) -> dict[str, Any]:
    shutil.copytree(bag_dir, bag_dir.parent / "bare", ignore=shutil.ignore_patterns(FOLDER))
    settings = settings_of(bag_dir.parent / "bare")
    memory = build_memory(settings)
    try:
        return replies(settings, memory)
    finally:
        close(memory)


def as_it_was(file: Path) -> None:
    """The file of 3d1d2aa."""


def older(file: Path) -> None:
    changed(file, "PRAGMA user_version = 3")


VERSION = TABLES.version


def newer(file: Path) -> None:
    changed(file, f"PRAGMA user_version = {VERSION + 1}", "ALTER TABLE bags ADD COLUMN more BLOB")


def of_no_version(file: Path) -> None:
    changed(file, "PRAGMA user_version = 0")


def with_another_column(file: Path) -> None:
    changed(file, f"PRAGMA user_version = {VERSION}", "ALTER TABLE held ADD COLUMN more BLOB")


def with_another_type(file: Path) -> None:
    changed(
        file,
        f"PRAGMA user_version = {VERSION}",
        "ALTER TABLE held RENAME COLUMN low TO high_",
        "ALTER TABLE held RENAME COLUMN high TO low",
        "ALTER TABLE held RENAME COLUMN high_ TO high",
    )


def changed(file: Path, *statements: str) -> None:
    with closing(sqlite3.connect(file, isolation_level=None)) as base:
        for each in statements:
            base.execute(each)


@pytest.mark.parametrize(
    "change", [as_it_was, older, newer, of_no_version, with_another_column, with_another_type]
)
def test_the_file_of_another_version_is_never_misread(
    bag_dir: Path, change: Callable[[Path], None]
) -> None:
    file = bag_dir / FOLDER / FILE
    change(file)
    expected = without_catalogue(bag_dir)
    assert expected["list_recorded_topics"]
    settings = settings_of(bag_dir)
    memory = build_memory(settings)
    assert replies(settings, memory) == expected
    # Rebuilt, or of the same digests.
    fill(settings, memory)
    assert build_backfill(settings, memory).waiting() == []
    assert memory.recall is not None
    assert memory.recall.catalogue.path == file
    assert replies(settings, memory) == expected
    close(memory)
    with closing(sqlite3.connect(file)) as base:
        assert base.execute("PRAGMA user_version").fetchone()[0] == VERSION
    # As it is left it is taken by whoever comes next.
    memory = build_memory(settings)
    assert build_backfill(settings, memory).waiting() == []
    assert replies(settings, memory) == expected
    close(memory)


@pytest.mark.parametrize("change", [older, newer, with_another_column])
def test_a_file_that_another_version_has_open_is_left_to_it(
    bag_dir: Path, tmp_path: Path, change: Callable[[Path], None]
) -> None:
    file = bag_dir / FOLDER / FILE
    change(file)
    settings = settings_of(bag_dir)
    with closing(sqlite3.connect(file)) as theirs:
        before = theirs.execute("SELECT count(*) FROM bags").fetchone()
        memory = build_memory(settings)
        assert fill(settings, memory) == 2
        assert memory.recall is not None
        path = memory.recall.catalogue.path
        assert path is not None
        assert path.is_relative_to(tmp_path / "cache")
        memory.recall.catalogue.look_after(thorough=True)
        assert build_backfill(settings, memory).waiting() == []
        assert theirs.execute("SELECT count(*) FROM bags").fetchone() == before
        assert not file.with_name(f"{FILE}.aside").exists()
    close(memory)
