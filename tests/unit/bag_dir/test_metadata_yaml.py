"""metadata.yaml after files of its recording were deleted."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING, Any

import pytest
import yaml
from rosbags.rosbag2 import Reader

from ros2_memory.bag_dir.metadata_yaml import Listing, correct, parse_listing
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
from tests.support.shared_bags import RECORDED, needs_recorded

if TYPE_CHECKING:
    from pathlib import Path

ROOT = "rosbag2_bagfile_information"
FILES: list[dict[str, Any]] = [
    {"path": "r_0.mcap", "message_count": 5},
    {"path": "r_1.mcap", "message_count": 3},
]


@pytest.mark.parametrize("sort_keys", [True, False])
def test_a_listing_is_read_in_any_order_of_keys(sort_keys: bool) -> None:
    names = [file["path"] for file in FILES]
    info = {"version": 9, "message_count": 8, "relative_file_paths": names, "files": FILES}
    listing = parse_listing(yaml.safe_dump({ROOT: info}, sort_keys=sort_keys))
    assert listing == Listing(listing.names, {"r_0.mcap": 5, "r_1.mcap": 3}, 8)
    assert set(listing.names) == {*names}


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
