from __future__ import annotations

from typing import TYPE_CHECKING, Any

import structlog

from ros2_memory import queries
from ros2_memory.history.context import Call
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import McapLayout, odom, write_mcap
from tests.support.housekeepers import copied, files_in, keeper_of, later, recording_now
from tests.support.memories import memory_of
from tests.support.shared_bags import RECORDED, needs_recorded

if TYPE_CHECKING:
    from collections.abc import MutableMapping
    from pathlib import Path

S = 10**9
T0 = 1_790_000_000 * S
HOUR = 3600 * S
OWN = "rec_20260921T101320Z"


def bag(path: Path, start: int, layout: McapLayout | None = None) -> Path:
    times = [T0 + start * S + n * S // 4 for n in range(20)]
    return write_mcap(path, [odom(time, 1.0, 2.0) for time in times], layout)


def recording(bag_dir: Path, name: str) -> None:
    """A closed recording as `ros2 bag record` leaves it."""
    for number in range(3):
        bag(bag_dir / name / f"{name}_{number}.mcap", number * 10)
    (bag_dir / name / "metadata.yaml").write_text("rosbag2_bagfile_information:\n")


def left_open(path: Path, start: int = 0) -> Path:
    return bag(path, start, McapLayout(chunk_size=400, finish=False))


def events(captured: list[MutableMapping[str, Any]], name: str) -> list[MutableMapping[str, Any]]:
    return [each for each in captured if each["event"] == name]


def test_recordings_without_a_last_word_are_repaired(tmp_path: Path) -> None:
    open_one = left_open(tmp_path / OWN / f"{OWN}_0.mcap")
    empty = tmp_path / OWN / f"{OWN}_1.mcap"
    empty.write_bytes(b"")
    readable = McapReader().summarize(open_one).topics
    with structlog.testing.capture_logs() as captured:
        keeper_of(tmp_path, clock=later(0)).repair()
    after = McapReader().summarize(open_one)
    assert (after.complete, after.topics) == (True, readable)
    assert not empty.exists()
    (reported,) = events(captured, "bag_repaired")
    assert reported["path"] == str(open_one)
    assert reported["messages"] == after.count
    assert reported["cut_bytes"] >= 0
    newest = max(topic.last for topic in after.topics) / 1e9
    assert f"the newest message is of {newest:.3f}; later ones that had not" in reported["reason"]
    assert [each["path"] for each in events(captured, "empty_split_removed")] == [str(empty)]


def test_a_metadata_file_of_no_bytes_is_no_last_word(tmp_path: Path) -> None:
    open_one = left_open(tmp_path / OWN / f"{OWN}_0.mcap")
    (tmp_path / OWN / "metadata.yaml").write_bytes(b"")
    keeper_of(tmp_path).repair()
    assert McapReader().summarize(open_one).complete


def test_a_recording_that_the_dead_recorder_named_is_repaired_at_once(tmp_path: Path) -> None:
    open_one = left_open(tmp_path / "rec" / "rec_0.mcap")
    clock = later(0)
    recording_now(tmp_path, "rec", clock=clock)
    keeper_of(tmp_path, clock=clock).repair()
    assert McapReader().summarize(open_one).complete


def test_a_recording_of_nothing_but_empty_splits_goes(tmp_path: Path) -> None:
    (tmp_path / OWN).mkdir()
    (tmp_path / OWN / f"{OWN}_0.mcap").write_bytes(b"")
    (tmp_path / OWN / "handover.json").write_text("{}")
    keeper_of(tmp_path).repair()
    assert files_in(tmp_path) == []


def test_what_a_repair_left_that_was_cut_short_goes(tmp_path: Path) -> None:
    left_open(tmp_path / OWN / f"{OWN}_0.mcap")
    (tmp_path / OWN / f".{OWN}_0.mcap.repair").write_bytes(b"half")
    keeper_of(tmp_path).repair()
    assert files_in(tmp_path) == [OWN, f"{OWN}/{OWN}_0.mcap"]


def test_a_recording_of_another_is_left_alone_until_it_lay_still(tmp_path: Path) -> None:
    theirs = left_open(tmp_path / "theirs" / "theirs_0.mcap")
    clock = later(0)
    keeper = keeper_of(tmp_path, clock=clock)
    keeper.repair()
    keeper.apply()
    assert not McapReader().summarize(theirs).complete
    clock.at += HOUR
    keeper.apply()
    assert McapReader().summarize(theirs).complete


def test_a_file_that_a_process_holds_open_is_left_alone(tmp_path: Path) -> None:
    theirs = left_open(tmp_path / "theirs" / "theirs_0.mcap")
    with theirs.open("rb"):
        keeper_of(tmp_path).apply()
    assert not McapReader().summarize(theirs).complete
    keeper_of(tmp_path).apply()
    assert McapReader().summarize(theirs).complete


def test_splits_that_a_full_disk_cut_short_are_repaired_later_on(tmp_path: Path) -> None:
    recording(tmp_path, OWN)
    cut = left_open(tmp_path / OWN / f"{OWN}_7.mcap", 50)
    empty = tmp_path / OWN / f"{OWN}_8.mcap"
    empty.write_bytes(b"")
    keeper = keeper_of(tmp_path)
    keeper.repair()
    keeper.apply()
    assert McapReader().summarize(cut).complete
    assert not empty.exists()


def test_what_cannot_be_repaired_is_reported_once_and_stays(tmp_path: Path) -> None:
    damaged = tmp_path / OWN / f"{OWN}_0.mcap"
    damaged.parent.mkdir()
    damaged.write_bytes(b"\x89MCAP")
    keeper = keeper_of(tmp_path)
    with structlog.testing.capture_logs() as captured:
        keeper.apply()
        keeper.apply()
    (reported,) = events(captured, "bag_not_repaired")
    assert reported["path"] == str(damaged)
    assert "first 5 bytes" in reported["reason"]
    assert damaged.read_bytes() == b"\x89MCAP"


@needs_recorded
def test_what_real_recorders_left_when_they_were_killed(tmp_path: Path) -> None:
    for name in ("session_killed", "session_killed_chunk64k", "extra/full_truncated"):
        copied(RECORDED / name, tmp_path / name.rpartition("/")[2])
    before = counts(tmp_path)
    keeper_of(tmp_path).apply()
    assert counts(tmp_path) == before
    snapshot = memory_of(tmp_path).index.snapshot()
    assert (snapshot.damaged, snapshot.active) == ((), ())
    assert all(bag.state == "closed" for bag in snapshot.bags)
    assert "session_killed/session_killed_2.mcap" not in files_in(tmp_path)


def counts(bag_dir: Path) -> dict[str, int]:
    rows = queries.list_recorded_topics(memory_of(bag_dir), Call())
    return {row.topic: row.count for row in rows}
