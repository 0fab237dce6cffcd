"""metadata.yaml after files of its recording were deleted."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING, Any

import pytest
import yaml
from rosbags.rosbag2 import Reader

from ros2_memory.bag_dir.metadata_yaml import Listing, parse_listing, take_out, without
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
from tests.support.shared_bags import RECORDED, needs_recorded

if TYPE_CHECKING:
    from pathlib import Path

ROOT = "rosbag2_bagfile_information"


def content(**changes: object) -> dict[str, Any]:
    """Two files of ten seconds; five messages of /a in the first, /a and /b in the second."""
    info: dict[str, object] = {
        "version": 9,
        "duration": {"nanoseconds": 20},
        "starting_time": {"nanoseconds_since_epoch": 100},
        "message_count": 8,
        "topics_with_message_count": [
            {"topic_metadata": {"name": "/a", "type": "t"}, "message_count": 7},
            {"topic_metadata": {"name": "/b", "type": "t"}, "message_count": 1},
        ],
        "relative_file_paths": ["r_0.mcap", "r_1.mcap"],
        "files": [file("r_0.mcap", 100, 5), file("r_1.mcap", 111, 3)],
        "custom_data": None,
        "ros_distro": "jazzy",
    }
    return {ROOT: info | changes}


def file(path: str, start: int, count: int) -> dict[str, object]:
    return {
        "path": path,
        "starting_time": {"nanoseconds_since_epoch": start},
        "duration": {"nanoseconds": 9},
        "message_count": count,
    }


def left(given: object, gone: dict[str, dict[str, int]]) -> dict[str, Any]:
    text = without(yaml.safe_dump(given), gone)
    assert text is not None
    info: dict[str, Any] = yaml.safe_load(text)[ROOT]
    return info


@pytest.mark.parametrize("sort_keys", [True, False])
def test_a_listing_is_read_in_any_order_of_keys(sort_keys: bool) -> None:
    text = yaml.safe_dump(content(), sort_keys=sort_keys)
    names = ("r_0.mcap", "r_1.mcap")
    listing = parse_listing(text)
    assert set(listing.names) == {*names}
    assert listing == Listing(listing.names, dict(zip(names, (5, 3), strict=True)), 8)


def test_it_lists_what_is_left_and_counts_it() -> None:
    info = left(content(), {"r_0.mcap": {"/a": 5}})
    assert info["relative_file_paths"] == ["r_1.mcap"]
    assert [each["path"] for each in info["files"]] == ["r_1.mcap"]
    assert info["starting_time"] == {"nanoseconds_since_epoch": 111}
    assert info["duration"] == {"nanoseconds": 9}
    assert info["message_count"] == 3
    assert [each["message_count"] for each in info["topics_with_message_count"]] == [2, 1]
    assert (info["version"], info["ros_distro"], info["custom_data"]) == (9, "jazzy", None)


def test_a_topic_of_which_nothing_is_left_is_listed_with_none() -> None:
    info = left(content(), {"r_1.mcap": {"/a": 2, "/b": 1}})
    assert [each["message_count"] for each in info["topics_with_message_count"]] == [5, 0]


@pytest.mark.parametrize("deleted", ["r_0.mcap.zstd", "r_0.mcap"])
@pytest.mark.parametrize("listed", ["r_0.mcap.zstd", "r_0.mcap"])
def test_compressed_files_may_be_listed_under_either_name(deleted: str, listed: str) -> None:
    given = content(relative_file_paths=[listed, "r_1.mcap.zstd"])
    assert left(given, {deleted: {"/a": 5}})["relative_file_paths"] == ["r_1.mcap.zstd"]


@pytest.mark.parametrize(
    ("given", "gone", "reason"),
    [
        (content(), {"r_0.mcap": {"/a": 4}}, "numbers"),
        (content(), {"r_0.mcap": {"/c": 5}}, "numbers"),
        (content(message_count=8), {"r_0.mcap": {}}, "numbers"),
        (content(files=None), {"r_0.mcap": {"/a": 5}}, "no list files"),
        (content(relative_file_paths=["r_0.mcap"]), {"r_0.mcap": {"/a": 5}}, "files that are left"),
        (content(files=[file("r_0.mcap", 100, 5)]), {"r_0.mcap": {"/a": 5}}, "that are left"),
        (content(files=["r_0.mcap"]), {"r_0.mcap": {"/a": 5}}, "files holds no keys"),
        ({}, {"r_0.mcap": {}}, "holds no keys"),
        ([], {"r_0.mcap": {}}, "holds no keys"),
    ],
)
def test_what_cannot_be_corrected_is_refused(
    given: object, gone: dict[str, dict[str, int]], reason: str
) -> None:
    with pytest.raises(ValueError, match=reason):
        without(yaml.safe_dump(given), gone)


@needs_recorded
@pytest.mark.parametrize(
    "name", ["session_mcap", "session_sqlite3", "session_zstd", "session_zstd_file"]
)
def test_what_ros_recorded_is_opened_by_rosbags_without_its_first_file(
    tmp_path: Path, name: str
) -> None:
    recording = tmp_path / name
    shutil.copytree(RECORDED / name, recording)
    first = min(recording.glob("*_0.*"))
    held = {each.topic: each.count for each in Rosbag2Reader().summarize(first).topics}
    first.unlink()
    assert take_out(recording, {first.name: held})
    with Reader(recording) as reader:
        messages = [*reader.messages()]
        assert len(messages) == reader.message_count
        assert reader.start_time == min(time for _, time, _ in messages)
        assert reader.end_time - 1 == max(time for _, time, _ in messages)
        counts = {each.topic: each.msgcount for each in reader.connections}
    assert sum(counts.values()) == len(messages)
