"""The index over bags that real recorders wrote, killed ones among them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ros2_memory.core.model import BagFile, BagState, SetAside, TimeWindow
from ros2_memory.core.timebase import Ns
from ros2_memory.recorder.index_manager import IndexManager, Snapshot
from ros2_memory.storage.mcap_reader import McapReader
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
from tests.support.clocks import FixedClock
from tests.support.shared_bags import REAL, RECORDED, needs_real, needs_recorded

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from ros2_memory.storage.base import BagReader

S = 10**9
LONG_AFTER = 1_900_000_000 * S


def _scan(bag_dir: Path, reader: BagReader, now: Ns = LONG_AFTER) -> Snapshot:
    clock = FixedClock(now)
    return IndexManager(bag_dir, reader, clock, refresh_s=5.0, split_duration_s=10.0).snapshot()


def _names(files: Iterable[BagFile | SetAside]) -> list[str]:
    return [each.path.name for each in files]


def _states(snapshot: Snapshot) -> list[tuple[str, BagState]]:
    return [(bag.path.name, bag.state) for bag in snapshot.bags]


@needs_recorded
def test_the_splits_of_a_real_recording_are_found_in_order() -> None:
    snapshot = _scan(RECORDED / "session_mcap", McapReader())
    assert _states(snapshot) == [(f"session_mcap_{n}.mcap", BagState.CLOSED) for n in range(7)]
    assert snapshot.timeline.totals("/odom")["nav_msgs/msg/Odometry"].messages == 1300
    extents = snapshot.timeline.extents("/tf_static", TimeWindow.everything())
    assert [bag.path.name for bag, *_ in extents] == ["session_mcap_0.mcap"]
    assert "/tf_static" in snapshot.timeline.transient_local
    assert "/tf" not in snapshot.timeline.transient_local


@needs_recorded
def test_recordings_without_messages_with_deleted_splits_and_cut_by_a_full_disk_stand_right() -> (
    None
):
    snapshot = _scan(RECORDED / "extra", McapReader())
    by_recording: dict[str, int] = {}
    for bag in snapshot.bags:
        by_recording[bag.recording.name] = by_recording.get(bag.recording.name, 0) + 1
    assert by_recording["gc"] == 4
    assert by_recording["ev"] == 6
    assert "never" not in by_recording
    assert len(snapshot.empty) >= 2
    assert [bag.path.name for bag in snapshot.bags if bag.state is BagState.INCOMPLETE] == [
        "fullsmall_4.mcap"
    ]


@needs_recorded
def test_what_one_storage_does_not_read_the_other_does() -> None:
    by_mcap, by_rosbag2 = _scan(RECORDED, McapReader()), _scan(RECORDED, Rosbag2Reader())
    assert {each.path.suffix for each in by_mcap.unread} == {".db3", ".zstd"}
    assert all("storage=rosbag2" in each.reason for each in by_mcap.unread)
    assert by_rosbag2.unread == ()
    unread = {each.path for each in by_mcap.unread}
    assert {bag.path for bag in by_rosbag2.bags} == {bag.path for bag in by_mcap.bags} | unread


@needs_real
def test_both_forms_of_a_public_pair_are_indexed_and_a_text_file_is_damaged() -> None:
    snapshot = _scan(REAL / "tiryoh_small_and_truncated", Rosbag2Reader())
    assert sorted(_states(snapshot)) == [
        ("test_sample.mcap", BagState.CLOSED),
        ("test_sample.mcap.zstd", BagState.CLOSED),
        ("test_sample_no_rosout.mcap", BagState.CLOSED),
        ("test_sample_truncated.mcap", BagState.INCOMPLETE),
    ]
    assert _names(snapshot.damaged) == ["Dockerfile.mcap"]
