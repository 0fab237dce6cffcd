"""The index over bags that real recorders wrote, killed ones among them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ros2_memory.core.model import BagState, TimeWindow
from ros2_memory.core.timebase import Ns
from ros2_memory.recorder.index_manager import IndexManager, Snapshot
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.clocks import FixedClock
from tests.support.shared_bags import RECORDED, needs_recorded

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.storage.base import BagReader

S = 10**9
LONG_AFTER = 1_900_000_000 * S


def _scan(bag_dir: Path, reader: BagReader, now: Ns = LONG_AFTER) -> Snapshot:
    clock = FixedClock(now)
    return IndexManager(bag_dir, reader, clock, refresh_s=5.0, split_duration_s=10.0).snapshot()


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
