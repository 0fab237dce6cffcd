"""One recording of a bag directory: the index of it alone finds what a scan of it does."""

from dataclasses import replace
from pathlib import Path

import pytest

from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.index.recordings import name_of, recordings_of
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.recorder.index_manager import IndexManager
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import odom, write_mcap
from tests.support.clocks import SettableClock
from tests.support.memories import LAST_WRITTEN

T0 = 1_700_000_000


def write(folder: Path, name: str, *, at_s: int = 0) -> None:
    write_mcap(folder / f"{name}.mcap", [odom((T0 + at_s) * NS_PER_S, 0.0, 0.0)])


def index_of(folder: Path, only: str | None = None) -> IndexManager:
    clock = SettableClock(LAST_WRITTEN)
    return IndexManager(folder, McapReader(), clock, refresh_s=0, split_duration_s=10.0, only=only)


def comparable(snapshot: Snapshot) -> tuple[object, ...]:
    files = [bag.file for bag in snapshot.timeline.bags]
    return files, replace(snapshot, problem=None, scanned_at=0)


def test_a_recording_that_is_not_there_is_named_as_it_was_asked_for(tmp_path: Path) -> None:
    write(tmp_path, "a/a_0")
    assert index_of(tmp_path, "b").refresh().problem == "no bag is named b (data.recording)"


@pytest.mark.parametrize("name", ["a", "a_1", "run", "run_1", "deep", "deep/b", "loose", "nothing"])
def test_the_index_of_one_recording_finds_what_a_scan_of_it_finds(
    tmp_path: Path, name: str
) -> None:
    bags = ["a/a_0", "a/a_1", "a_1/0", "run_0", "run_1", "run_10", "loose", "loose_x"]
    for n, bag in enumerate([*bags, "deep/b/0", "deep/c/0", "latched/carried"]):
        write(tmp_path, bag, at_s=n)
    for folder in ("a", "deep/b"):
        (tmp_path / folder / "metadata.yaml").write_text("rosbag2_bagfile_information: {}")
        (tmp_path / folder / "damaged.mcap").write_bytes(b"this is not a bag" * 100)
        (tmp_path / folder / "other.db3").symlink_to(tmp_path / "run_0.mcap")
    index = index_of(tmp_path)
    index.refresh()
    part = index.alone(name)
    assert comparable(part.refresh()) == comparable(index_of(tmp_path, name).refresh())
    write(tmp_path, "a/a_2", at_s=50)
    write(tmp_path, "run_2", at_s=51)
    (tmp_path / "a" / "a_0.mcap").unlink()
    assert comparable(part.refresh()) == comparable(index_of(tmp_path, name).refresh())


def test_the_index_of_one_recording_has_no_other_than_that_which_it_is_made_of(
    tmp_path: Path,
) -> None:
    for bag in ("deep/b/0", "deep/c/0", "a/0", "run_0", "run_1"):
        write(tmp_path, bag)

    def found(only: str, name: str) -> list[str]:
        bags = index_of(tmp_path, only).alone(name).refresh().bags
        return [str(bag.path.relative_to(tmp_path)) for bag in bags]

    assert found("deep", "deep/b") == found("deep/b", "deep") == ["deep/b/0.mcap"]
    assert found("run_0.mcap", "run") == found("run", "run_0") == ["run_0.mcap"]
    assert found("deep", "a") == found("deep/b", "deep/c") == found("run", "a") == []


def test_every_recording_is_found_by_its_name(tmp_path: Path) -> None:
    for n, bag in enumerate(["a/0", "a/1", "run_0", "run_1", "loose", "deep/b/x", "deep/b/y"]):
        write(tmp_path, bag, at_s=n)
    index = index_of(tmp_path)
    for path, bags in recordings_of(index.refresh()).items():
        part = index.alone(name_of(path, bags, str(tmp_path))).refresh()
        assert list(part.bags) == bags
