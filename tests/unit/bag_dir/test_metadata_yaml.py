"""metadata.yaml after files of its recording were deleted."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING, Any

import pytest
import yaml
from rosbags.rosbag2 import Reader

from ros2_memory.bag_dir.metadata_yaml import Listing, correct, parse_listing
from ros2_memory.storage.mcap_reader import McapReader
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
from tests.support.bags import text, write_mcap
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


@pytest.mark.parametrize("sort_keys", [True, False])
def test_a_listing_is_read_in_any_order_of_keys(sort_keys: bool) -> None:
    text = yaml.safe_dump(content(), sort_keys=sort_keys)
    names = ("r_0.mcap", "r_1.mcap")
    listing = parse_listing(text)
    assert set(listing.names) == {*names}
    assert listing == Listing(listing.names, dict(zip(names, (5, 3), strict=True)), 8)


def test_what_is_left_is_described_and_other_keys_stay(tmp_path: Path) -> None:
    for number in range(2):
        messages = [text(10 * number + at, "x", topic) for topic in ("/a", "/b") for at in (1, 4)]
        write_mcap(tmp_path / f"r_{number}.mcap", messages)
    listing = tmp_path / "metadata.yaml"
    listing.write_text(yaml.safe_dump(content(storage_identifier="mcap")))
    (tmp_path / "r_0.mcap").unlink()
    assert correct(tmp_path, McapReader())
    info = yaml.safe_load(listing.read_text())[ROOT]
    assert info["relative_file_paths"] == [each["path"] for each in info["files"]] == ["r_1.mcap"]
    assert info["starting_time"] == {"nanoseconds_since_epoch": 11}
    assert info["duration"] == {"nanoseconds": 3}
    assert info["message_count"] == info["files"][0]["message_count"] == 4
    assert (info["version"], info["ros_distro"], info["custom_data"]) == (9, "jazzy", None)
    assert not correct(tmp_path, McapReader())


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        (content(), "storage"),
        (content(storage_identifier="sqlite3"), "storage"),
        (content(storage_identifier="mcap", compression_mode="FILE"), "compression"),
        (content(storage_identifier="mcap", version=4), "version 4"),
        ({}, "holds no keys"),
        ([], "holds no keys"),
    ],
)
def test_what_cannot_be_corrected_is_refused(tmp_path: Path, given: object, reason: str) -> None:
    write_mcap(tmp_path / "r_0.mcap", [text(1, "x")])
    listing = tmp_path / "metadata.yaml"
    listing.write_text(yaml.safe_dump(given))
    before = listing.read_text()
    with pytest.raises(ValueError, match=reason):
        correct(tmp_path, McapReader())
    assert listing.read_text() == before


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
    first.unlink()
    assert correct(recording, Rosbag2Reader())
    with Reader(recording) as reader:
        messages = [*reader.messages()]
        assert len(messages) == reader.message_count
        assert reader.start_time == min(time for _, time, _ in messages)
        assert reader.end_time - 1 == max(time for _, time, _ in messages)
        counts = {each.topic: each.msgcount for each in reader.connections}
    assert sum(counts.values()) == len(messages)
