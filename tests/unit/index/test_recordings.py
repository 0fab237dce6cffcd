"""Recordings of a bag directory: one alone, those that overlap or are one, and what is listed."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.config import load_settings
from ros2_memory.core.spans import overlap_spans
from ros2_memory.core.timebase import MIN_NS, NS_PER_S
from ros2_memory.history.context import Memory
from ros2_memory.index import listed_splits, timeline
from ros2_memory.index.listed_splits import Absent
from ros2_memory.index.recordings import name_of, recordings_of
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.recorder.index_manager import IndexManager
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import odom, text, write_mcap
from tests.support.clocks import SettableClock
from tests.support.listed_bags import odom_bag
from tests.support.memories import LAST_WRITTEN, memory_of, with_store

T0 = 1_700_000_000
T0_NS = T0 * NS_PER_S


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


@pytest.mark.parametrize(
    "name", ["a", "a_1", "run", "run_1", "deep", "deep/b", "broken", "loose", "nothing"]
)
def test_the_index_of_one_recording_finds_what_a_scan_of_it_finds(
    tmp_path: Path, name: str
) -> None:
    bags = ["a/a_0", "a/a_1", "a_1/0", "run_0", "run_1", "run_10", "loose", "loose_x"]
    for n, bag in enumerate(
        [*bags, "deep/b/0", "deep/c/0", "latched/carried", "broken/broken_\n0"]
    ):
        write(tmp_path, bag, at_s=n)
    for folder in ("a", "deep/b"):
        (tmp_path / folder / "metadata.yaml").write_text("rosbag2_bagfile_information: {}")
        (tmp_path / folder / "damaged.mcap").write_bytes(b"this is not a bag" * 100)
        (tmp_path / folder / "other.db3").symlink_to(tmp_path / "run_0.mcap")
    index = index_of(tmp_path)
    for path, own in recordings_of(index.refresh()).items():
        assert [*index.alone(name_of(path, own, str(tmp_path))).refresh().bags] == own
    part = index.alone(name)
    assert comparable(part.refresh()) == comparable(index_of(tmp_path, name).refresh())
    write(tmp_path, "a/a_2", at_s=50)
    write(tmp_path, "run_2", at_s=51)
    (tmp_path / "a" / "a_0.mcap").unlink()
    assert comparable(part.refresh()) == comparable(index_of(tmp_path, name).refresh())


@pytest.mark.parametrize(
    ("bags", "name"),
    [
        (["run_0"], "run_0"),
        (["run_0", "run_1"], "run"),
        (["0", "1"], "."),
        (["morning", "evening"], "."),
        (["run_0", "run_1", "run_late"], "."),
    ],
)
def test_a_bag_directory_that_is_a_recording_has_a_name_that_selects_it(
    tmp_path: Path, bags: list[str], name: str
) -> None:
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: {}")
    for n, bag in enumerate([*bags, "other/other_0"]):
        write(tmp_path, bag, at_s=n)
    index = index_of(tmp_path)
    own = recordings_of(index.refresh())[str(tmp_path)]
    assert (name_of(str(tmp_path), own, str(tmp_path)), len(own)) == (name, len(bags))
    assert [*index.alone(name).refresh().bags] == own
    settings = load_settings([f"recording.bag_dir={tmp_path}", f"data.recording={name}"])
    assert settings.data.recording == name


@pytest.mark.parametrize(
    ("bag", "name"),
    [("walk_00", "walk_00"), ("walk_20261130", "walk_20261130"), ("walk_0", "walk"), ("w", "w")],
)
def test_a_lone_bag_among_others_keeps_a_number_that_is_none_of_a_split(
    tmp_path: Path, bag: str, name: str
) -> None:
    for n, file in enumerate([bag, "run_0", "run_1"]):
        write(tmp_path, file, at_s=n)
    index = index_of(tmp_path)
    recordings = recordings_of(index.refresh())
    names = {name_of(path, own, str(tmp_path)): own for path, own in recordings.items()}
    assert {*names} == {name, "run"}
    assert [*index.alone(name).refresh().bags] == names[name]


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


halves_of_seconds = st.integers(0, 120).map(lambda number: number * NS_PER_S // 2)

drawn_bags = st.lists(
    st.tuples(st.integers(0, 3), st.just(MIN_NS) | halves_of_seconds, halves_of_seconds)
)


@given(drawn_bags, st.integers(1, 8))
def test_times_that_recordings_share_are_those_of_all_their_bags(
    drawn: Sequence[tuple[int, int, int]], size: int
) -> None:
    bags = [
        odom_bag(f"/bags/r{recording}/{number}.mcap", start, start + length)
        for number, (recording, start, length) in enumerate(drawn)
    ]
    with patch.object(timeline, "SEGMENT_BAGS", size):
        shared = timeline.Timeline.of(bags).shared_times
    assert shared == overlap_spans((bag.start, bag.end, bag.recording) for bag in bags)


def listed_recording(bag_dir: Path) -> Memory:
    """A recording of five splits, of which two are missing, as another program left it."""
    for n in (0, 2, 4):
        write_mcap(bag_dir / "r" / f"r_{n}.mcap", [text(T0_NS + n, "a")])
    files = "".join(f"  - path: r_{n}.mcap\n    message_count: 7\n" for n in range(5))
    listing = bag_dir / "r" / "metadata.yaml"
    listing.write_text(f"rosbag2_bagfile_information:\n  files:\n{files}")
    for each in (listing, listing.parent):
        os.utime(each, (T0, T0))
    return memory_of(bag_dir)


def absent_of(memory: Memory) -> Sequence[Absent]:
    return memory.absent_splits(memory.index.snapshot())


def test_what_changed_since_is_read_again(tmp_path: Path) -> None:
    memory = listed_recording(tmp_path)
    assert [each.files for each in absent_of(memory)] == [("r_1.mcap", "r_3.mcap")]
    write_mcap(tmp_path / "r" / "r_1.mcap", [text(T0_NS + 1, "a")])
    assert [each.files for each in absent_of(memory)] == [("r_3.mcap",)]
    (tmp_path / "r" / "metadata.yaml").unlink()
    assert absent_of(memory) == []


def test_what_was_stored_is_not_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    memory = with_store(listed_recording(tmp_path), tmp_path)
    [absent] = absent_of(memory)
    memory.store_listings(memory.index.snapshot())
    monkeypatch.setattr(listed_splits, "read_listing", None)
    later = with_store(memory_of(tmp_path), tmp_path)
    assert absent_of(later) == [absent]
    (tmp_path / "r" / "metadata.yaml").unlink()
    later.store_listings(later.index.refresh())
    assert later.scanner.store is not None
    assert later.scanner.store.listings() == {}
