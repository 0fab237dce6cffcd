"""metadata.yaml after files of its recording were deleted."""

import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml
from rosbags.rosbag2 import Reader

from ros2_memory.bag_dir.metadata_yaml import Listing, correct, parse_listing
from ros2_memory.storage.mcap_reader import McapReader
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
from tests.support.housekeepers import bag, described
from tests.support.shared_bags import RECORDED, needs_recorded

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


@pytest.mark.parametrize("quote", ["", "'", '"'])
@pytest.mark.parametrize("end", ["", " ", "\r", " \t\r"])
def test_a_path_is_read_with_quotes_and_whatever_space_around(quote: str, end: str) -> None:
    path = f"{quote}a b/r_0.mcap{quote}{end}"
    text = f"{ROOT}:\n  relative_file_paths:\n  -   {path}\n  files:\n  - path:\t{path}\n"
    listing = parse_listing(f"{text}    message_count: 5\n")
    assert listing == Listing(("r_0.mcap", "r_0.mcap"), {"r_0.mcap": 5}, 5)


@needs_recorded
@pytest.mark.parametrize(
    "name", ["session_mcap", "session_sqlite3", "session_zstd", "session_zstd_file"]
)
def test_what_ros_recorded_is_opened_by_rosbags_without_its_first_file(
    tmp_path: Path, name: str
) -> None:
    recording = tmp_path / name
    shutil.copytree(RECORDED / name, recording)
    recording.chmod(0o700)  # the shared folder may be read-only, and the copy is as that
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


def test_a_long_one_is_corrected(tmp_path: Path) -> None:
    """As that of a day of splits."""
    for number in range(2):
        last = bag(tmp_path / "r" / f"r_{number}.mcap", 10 * number)
    path = described(tmp_path / "r")
    with path.open("a") as stream:
        stream.write(f"# {'x' * 2**20}\n")
    last.unlink()
    assert correct(tmp_path / "r", McapReader())
    assert parse_listing(path.read_text()).messages == {"r_0.mcap": 10}
