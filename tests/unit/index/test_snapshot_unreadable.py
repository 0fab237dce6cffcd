"""What a snapshot tells of clocks, and of files that cannot be read."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from ros2_memory.core.bag_summary import BagSummary, TopicSummary
from ros2_memory.core.model import BagFile, BagState, TimeWindow
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.index.timeline import Timeline
from ros2_memory.recorder.index_manager import IndexManager
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import text, write_mcap
from tests.support.clocks import SettableClock

S = 10**9
T0 = 1_784_023_200 * S
DAY = 24 * 3600 * S


def bag(
    file: str,
    start: int,
    end: int,
    *,
    state: BagState = BagState.CLOSED,
    written: int = 0,
    notes: tuple[str, ...] = (),
) -> BagFile:
    topics = (TopicSummary("/odom", "nav_msgs/msg/Odometry", "cdr", 2, start, end),)
    return BagFile(file, 1, written, state, BagSummary(topics, notes=notes), start, end)


def snapshot_of(bag_dir: Path, now: int) -> Snapshot:
    clock = SettableClock(now)
    return IndexManager(
        bag_dir, McapReader(), clock, refresh_s=0.0, split_duration_s=10.0
    ).snapshot()


def write_splits(bag_dir: Path, *starts_s: float, folder: str = "rec") -> list[Path]:
    return [
        write_mcap(
            bag_dir / folder / f"{folder}_{number}.mcap",
            [text(T0 + round((start + second) * S), "a") for second in range(10)],
        )
        for number, start in enumerate(starts_s)
    ]


def test_a_split_that_cannot_be_read_lies_between_its_neighbours(tmp_path: Path) -> None:
    splits = write_splits(tmp_path, 0, 10, 20)
    splits[1].write_bytes(b"no bag at all, however long it is")
    snapshot = snapshot_of(tmp_path, T0 + DAY)
    [damaged] = snapshot.damaged
    assert snapshot.unread_spans[damaged] == TimeWindow(T0 + 9 * S, T0 + 20 * S + 1)


def test_the_last_split_that_cannot_be_read_ends_with_its_file(tmp_path: Path) -> None:
    splits = write_splits(tmp_path, 0, 10)
    splits[1].write_bytes(b"no bag at all, however long it is")
    os.utime(splits[1], ns=(T0 + 20 * S, T0 + 20 * S))
    snapshot = snapshot_of(tmp_path, T0 + DAY)
    [damaged] = snapshot.damaged
    assert damaged.written == T0 + 20 * S
    assert snapshot.unread_spans[damaged] == TimeWindow(T0 + 9 * S, T0 + 80 * S)


def test_a_question_about_now_looks_for_newer_bags_though_one_is_from_the_future(
    tmp_path: Path,
) -> None:
    write_splits(tmp_path, 0)
    write_mcap(tmp_path / "ahead" / "ahead_0.mcap", [text(T0 + DAY, "a")])
    clock = SettableClock(T0 + 15 * S)
    index = IndexManager(tmp_path, McapReader(), clock, refresh_s=3600.0, split_duration_s=10.0)
    assert index.snapshot().latest == T0 + 9 * S
    write_splits(tmp_path, 10, folder="next")
    assert index.snapshot(T0 + 15 * S).latest == T0 + 19 * S


@pytest.mark.parametrize(
    ("start", "stop", "found"),
    [(0, 5, []), (12, 15, ["open"]), (25, 26, ["open"]), (31, 33, []), (40, 41, ["odd"])],
)
def test_what_is_amiss_in_a_window_reaches_on_to_the_end_of_an_open_file(
    start: int, stop: int, found: list[str]
) -> None:
    bags = (
        bag("/r/good", T0, T0 + 50 * S),
        bag("/r/open", T0 + 10 * S, T0 + 20 * S, state=BagState.INCOMPLETE, written=T0 + 30 * S),
        bag("/r/odd", T0 + 40 * S, T0 + 41 * S, written=T0 + DAY, notes=("torn",)),
    )
    window = TimeWindow(T0 + start * S, T0 + stop * S)
    assert [each.path.name for each in Snapshot(Timeline.of(bags)).timeline.faulty(window)] == found
