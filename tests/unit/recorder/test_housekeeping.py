"""The recorder's house: limits, repair, room, and the jobs of its background."""

import errno
import threading
from collections.abc import Iterable, MutableMapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock, patch

import pytest
import zstandard
from structlog.testing import capture_logs

from ros2_memory.bag_dir.heartbeat import Heartbeat, RecorderState, write_heartbeat
from ros2_memory.bag_dir.state_files import (
    DELETED,
    Loss,
    Receipt,
    append_losses,
    append_receipts,
    read_losses,
)
from ros2_memory.core.errors import RecorderError
from ros2_memory.core.timebase import MAX_NS
from ros2_memory.recorder import housekeeping
from ros2_memory.recorder.background import Background
from ros2_memory.recorder.housekeeping import Housekeeping
from ros2_memory.recorder.index_manager import IndexManager
from ros2_memory.retention import collect
from ros2_memory.retention.delete import remove_bag
from ros2_memory.storage.mcap.writer import McapWriter
from ros2_memory.storage.mcap_reader import McapReader
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
from tests.support.bags import McapLayout, odom, write_db3
from tests.support.fakes import broken, failing
from tests.support.housekeepers import (
    HOUR,
    PLENTY,
    T0,
    A,
    S,
    bag,
    files_in,
    keeper_of,
    later,
    recording,
    recording_now,
    size_of,
)
from tests.support.memories import asked, memory_of
from tests.support.simulated_recorders import events


def receipt(path: Path, bag_dir: Path, more: int = 0) -> Receipt:
    name = path.relative_to(bag_dir).as_posix()
    return Receipt(name, "id", path.stat().st_size + more, "00", "lake", T0)


def left_open(path: Path, start: int = 0) -> Path:
    return bag(path, start, McapLayout(chunk_size=400, finish=False))


def said(keeper: Housekeeping, event: str) -> list[MutableMapping[str, Any]]:
    """What two passes log under a name."""
    with capture_logs() as captured:
        keeper.apply()
        keeper.apply()
    return events(captured, event)


def test_what_is_too_old_stays_while_the_clock_is_not_known_to_be_right(tmp_path: Path) -> None:
    """What rules need is not held by the clock."""
    old, young = bag(tmp_path / "a/a_0.mcap", 0), bag(tmp_path / "b/b_0.mcap", 3 * 3600)
    clock, needed = Mock(return_value=False), bag(tmp_path / "a/a_1.mcap", 10)
    rules = Mock(restarts=(), needed=lambda _: frozenset({str(needed)}))
    keeper = keeper_of(tmp_path, max_age_h=2, is_synchronised=clock, watch=lambda _: rules)
    with capture_logs() as captured:
        keeper.apply()
        keeper.apply()
        assert (old.exists(), clock.call_count) == (True, 2)
        [held] = events(captured, "age_held")
        assert (held["bags"], held["reason"]) == (1, keeper.status().age_held)
        assert "1 bag is older than 2 h" in held["reason"]
        clock.return_value = True
        keeper.apply()
    assert (old.exists(), young.exists(), keeper.status().age_held) == (False, True, None)
    assert len(events(captured, "age_no_longer_held")) == 1
    keeper.apply()
    assert clock.call_count == 3


def test_where_bags_must_be_shipped_age_waits_for_the_receipt_of_this_very_bag(
    tmp_path: Path,
) -> None:
    old = recording(tmp_path, "a", 0, splits=3)
    young = recording(tmp_path, "b", 3 * 3600)
    keeper = keeper_of(tmp_path, max_age_h=2, require_shipped=True)
    keeper.apply()
    append_receipts(tmp_path, [receipt(old[0], tmp_path), receipt(old[1], tmp_path, more=1)])
    keeper.apply()
    assert [each.exists() for each in old] == [False, True, True]
    append_receipts(tmp_path, [receipt(each, tmp_path) for each in (*old[1:], young[0])])
    keeper.apply()
    assert not (tmp_path / "a").exists()
    assert all(each.exists() for each in young)
    assert keeper.status().unshipped is None


def test_what_the_budget_deletes_unshipped_is_counted_and_named(tmp_path: Path) -> None:
    old = recording(tmp_path, "a", 0, splits=3)
    new = recording(tmp_path, "b", 3 * 3600)
    append_receipts(tmp_path, [receipt(old[1], tmp_path)])
    budget = size_of(tmp_path) - sum(path.stat().st_size for path in old)
    keeper = keeper_of(tmp_path, max_bytes=budget, max_age_h=2, require_shipped=True)
    with capture_logs() as captured:
        keeper.apply()
        [applied] = events(captured, "retention_applied")
        found = (applied["log_level"], applied["bags"], applied["recordings"])
        assert found == ("info", 3, 1)
        [lost] = events(captured, "unshipped_deleted")
        told = (lost["bags"], lost["names"], lost["reason"])
        assert told == (2, ["a/a_0.mcap", "a/a_2.mcap"], keeper.status().unshipped)
        assert "2 bags were deleted unshipped" in lost["reason"]
    assert all(each.exists() for each in new)


def test_what_was_recorded_longer_ago_than_the_limit_goes_by_the_monotonic_clock(
    tmp_path: Path,
) -> None:
    old = bag(tmp_path / "a/a_0.mcap", 0)
    keeper = keeper_of(tmp_path, max_age_h=0.1, is_synchronised=lambda: False)
    keeper.apply()
    for second in range(400):
        keeper.note_recorded(["b"], second, float(second))
        if second == 350:
            bag(tmp_path / "b/b_0.mcap", 30)
            keeper.apply()
            assert old.exists()
    keeper.apply()
    assert files_in(tmp_path / "b") == ["b_0.mcap"]
    assert not old.exists()


def test_a_bag_goes_with_its_unfinished_compressed_form_and_with_its_journals(
    tmp_path: Path,
) -> None:
    messages = [odom(T0 + n, 1.0, 2.0) for n in range(5)]
    plain, base = bag(tmp_path / "a/a_0.mcap", 0), write_db3(tmp_path / "a/a_0.db3", messages)
    packed = zstandard.compress(plain.read_bytes())
    plain.with_name("a_0.mcap.zstd").write_bytes(packed[: len(packed) // 2])
    for journal in ("a_0.db3-shm", "a_1.db3-shm", "a\n.db3-wal", ".a\n.mcap.repair"):
        base.with_name(journal).write_bytes(b"")
    bag(tmp_path / "b/b_0.mcap", 100)
    keeper_of(tmp_path, max_bytes=1, reader=Rosbag2Reader()).apply()
    assert files_in(tmp_path) == ["b", "b/b_0.mcap"]


def test_the_budget_counts_sidecars_open_bags_and_what_is_derived_and_nothing_behind_a_link(
    tmp_path: Path,
) -> None:
    bags, log = tmp_path / "bags", tmp_path / "log"
    first, *_ = recording(bags, "a", 0)
    left_open(bags / "b" / "b_0.mcap", 100)
    for name in (".episodic/catalogue.sqlite", ".ros_log/ros2_1.log"):
        (bags / name).parent.mkdir()
        (bags / name).write_bytes(bytes(5000))
    recording_now(bags, "b")
    total = size_of(bags)
    keeper_of(bags, max_bytes=total).apply()
    assert first.exists()
    (bags / ".ros_log").rename(log)
    (bags / "moments").mkdir()
    for link in (".ros_log", "moments/x"):
        (bags / link).symlink_to(log)
    keeper_of(bags, max_bytes=total - 5000).apply()
    assert first.exists()
    keeper_of(bags, max_bytes=total - 5001).apply()
    assert not first.exists()


def test_never_deleted_is_what_is_no_closed_bag_of_a_recording_or_is_being_written(
    tmp_path: Path,
) -> None:
    bags, outside = tmp_path / "bags", tmp_path / "outside"
    kept = recording(outside, "x", 0)
    recording(bags, "a", 0)
    (bags / "a/notes.txt").write_text("mine")
    (bags / "a/.hidden.tmp").write_text("mine")
    bag(bags / "b/b_0.mcap", 50)
    left_open(bags / "b/b_1.mcap", 60)
    (bags / "b/handover.json").write_text("{}")
    (bags / "c").mkdir()
    (bags / "c/c_0.mcap").write_bytes(b"no bag at all")
    bag(bags / "z/z_0.mcap", 100)
    (bags / "z/z_9.mcap").symlink_to(kept[0])
    (bags / "x").symlink_to(outside / "x", target_is_directory=True)
    bag(bags / "d/d_0.mcap", 70)
    recording_now(bags, "b", "d", clock=later(0))  # though its heartbeat is old
    keeper = keeper_of(bags, max_bytes=1)
    keeper.apply()
    assert "d" in files_in(bags)
    recording_now(bags, "b", clock=later(0))
    keeper.apply()
    assert "d" not in files_in(bags)
    left = ["a/.hidden.tmp", "a/notes.txt", "b/b_1.mcap", "b/handover.json", "c/c_0.mcap"]
    left += ["z/z_0.mcap", "z/z_9.mcap"]
    assert [name for name in files_in(bags) if name.count("/") and name[0] != "x"] == left
    assert all(path.exists() for path in (*kept, bags / "x" / kept[0].name))


def test_deletions_that_fail_are_told_and_written_down_once_and_do_not_stop_the_rest(
    tmp_path: Path,
) -> None:
    stuck = bag(tmp_path / "a/a_0.mcap", 0)
    recording(tmp_path, "b", 7200)
    keeper = keeper_of(tmp_path, max_bytes=45_000, max_age_h=1)
    # As something that is mounted, or immutable.
    with broken(collect, "remove_bag", errno.EBUSY, where=lambda _, path, *__: path == stuck):
        (reported,) = said(keeper, "not_deleted")
    assert reported["path"] == str(stuck)
    assert "busy" in reported["reason"]
    assert "b/b_0.mcap" not in files_in(tmp_path)
    assert size_of(tmp_path) <= 45_000
    assert [row.files for row in DELETED.rows(tmp_path)].count((stuck.name,)) == 1
    keeper.apply()
    assert not stuck.exists()


def test_the_budget_names_what_takes_it_in_the_log_and_to_who_asks(tmp_path: Path) -> None:
    recording(tmp_path, "b", 100, splits=1)
    (tmp_path / ".episodic").mkdir()
    (tmp_path / ".episodic/catalogue.sqlite-wal").write_bytes(bytes(4_200_000))
    keeper = keeper_of(tmp_path, max_bytes=1_000_000)
    assert keeper.status().counted_bytes is None
    (reported,) = said(keeper, "budget_not_held")
    assert "(.episodic, .ros_log) 4.2 MB, saved moments 0 MB, memory/, l" in reported["reason"]
    status = keeper.status()
    assert (status.counted_bytes, status.state_bytes) == (size_of(tmp_path), 4_200_000)


def test_where_no_deletion_is_enough_nothing_is_deleted_and_that_is_said_once(
    tmp_path: Path,
) -> None:
    recording(tmp_path, "a", 0)
    before = files_in(tmp_path)
    keeper = keeper_of(tmp_path, measure_free=lambda _: 0)
    with capture_logs() as logs:
        keeper.make_room(PLENTY)
        keeper.make_room(PLENTY)
    assert files_in(tmp_path) == before
    (told,) = events(logs, "room_out_of_reach")
    assert 0 < told["most_free_bytes"] < told["free_bytes_wanted"] == PLENTY
    assert not events(logs, "budget_not_held")


def test_room_is_made_while_the_caller_goes_on(tmp_path: Path) -> None:
    first, *_ = recording(tmp_path, "a", 0)
    held, asked = threading.Event(), []

    def measured(_directory: Path) -> int:
        asked.append(held.wait(30))
        return 0

    keeper = keeper_of(tmp_path, background=Background(), measure_free=measured)
    keeper.make_room(1)
    keeper.make_room(1)
    assert keeper.is_making_room()
    assert first.exists()
    held.set()
    keeper.finish()
    assert not keeper.is_making_room()
    assert not first.exists()
    assert all(asked)


def test_what_was_known_before_answers_from_what_is_left_and_says_what_is_gone(
    tmp_path: Path,
) -> None:
    paths = recording(tmp_path, "a", 0, splits=3)
    memory = memory_of(tmp_path)
    index = IndexManager(
        tmp_path, memory.reader, memory.clock, refresh_s=10**6, split_duration_s=10.0
    )
    index.refresh()
    memory = replace(memory, index=index)

    def ask(tool: str, **given: object) -> Any:
        return asked(memory, tool, start=T0 / S, end=T0 / S + 24.5, **given)

    assert ask("get_topic_in_range", topic="/odom")["total"] == 25
    for path in paths[:2]:
        path.unlink()
    found = ask("get_topic_in_range", topic="/odom")
    assert len(found["samples"]) == 5
    assert "2 bags were deleted before they could be read: " in str(found["notes"])
    assert ask("trajectory_summary")["start"] == T0 / S + 20
    paths[2].unlink()
    assert ask("get_topic_in_range", topic="/odom")["error"] == "no_data"
    assert ask("trajectory_summary")["error"] == "no_data"
    assert asked(memory, "list_recorded_topics") == []


def test_a_removal_takes_no_other_file_than_the_one_looked_at_and_follows_no_link(
    tmp_path: Path,
) -> None:
    path = bag(tmp_path / "bags/a/a_0.mcap", 0)
    status = path.stat()
    with pytest.raises(OSError, match="not the file that was looked at"):
        remove_bag(tmp_path / "bags", path, (status.st_dev, status.st_ino + 1))
    (tmp_path / "bags/a").rename(tmp_path / "moved")
    (tmp_path / "bags/a").symlink_to(tmp_path / "moved", target_is_directory=True)
    with pytest.raises(OSError, match="behind a symbolic link"):
        remove_bag(tmp_path / "bags", path, (status.st_dev, status.st_ino))
    assert (tmp_path / "moved/a_0.mcap").exists()


@pytest.mark.parametrize(
    ("state", "found"),
    [
        (RecorderState.RECORDING, [("unclean", 60)]),
        (RecorderState.STOPPING, [("unclean", 60)]),
        (RecorderState.STARTING, [("unclean", 10)]),
        (RecorderState.PAUSED, [("paused", 10)]),
        (RecorderState.STOPPED, []),
    ],
)
def test_a_recorder_that_was_killed_is_noted_when_it_starts_again(
    tmp_path: Path, state: RecorderState, found: list[tuple[str, int]]
) -> None:
    """Though the disk is full at first."""
    beat = Heartbeat(1, 60, state, (), 10, 0, (), (), None, 2.0)
    write_heartbeat(tmp_path, beat)
    keeper = keeper_of(tmp_path, clock=later(0))
    with patch("ros2_memory.bag_dir.json_files.append_durably", failing(errno.ENOSPC)):
        keeper.prepare()
    keeper.apply()
    keeper.wait()
    assert [(loss.by, loss.start) for loss in read_losses(tmp_path, 0, MAX_NS)] == found


def test_recordings_without_a_last_word_are_repaired_once_the_disk_has_room(tmp_path: Path) -> None:
    open_one = left_open(tmp_path / A / f"{A}_0.mcap")
    empty = tmp_path / A / f"{A}_1.mcap"
    empty.write_bytes(b"")
    (tmp_path / A / "metadata.yaml").touch()  # as on a disk that was full
    readable = McapReader().summarize(open_one).topics
    free = Mock(return_value=1000)
    keeper = keeper_of(tmp_path, measure_free=free)
    with capture_logs() as captured:
        with broken(McapWriter, "rewrite"):
            keeper.apply()
        free.return_value = PLENTY
        keeper.apply()
    after = McapReader().summarize(open_one)
    assert (after.complete, after.topics) == (True, readable)
    assert not empty.exists()
    (reported,) = events(captured, "bag_repaired")
    assert (reported["path"], reported["messages"]) == (str(open_one), after.count)
    newest = max(topic.last for topic in after.topics) / 1e9
    assert f"the newest message is of {newest:.3f}; later ones that had not" in reported["reason"]
    assert [each["path"] for each in events(captured, "empty_split_removed")] == [str(empty)]


def test_a_recording_of_another_is_left_alone_until_it_lay_still_and_nobody_holds_it(
    tmp_path: Path,
) -> None:
    theirs = left_open(tmp_path / "theirs" / "theirs_0.mcap")
    clock = later(0)
    keeper = keeper_of(tmp_path, clock=clock)
    keeper.apply()
    assert not McapReader().summarize(theirs).complete
    clock.at += HOUR
    with theirs.open("rb"):
        keeper.apply()
    assert not McapReader().summarize(theirs).complete
    keeper.apply()
    assert McapReader().summarize(theirs).complete


def test_what_cannot_be_repaired_is_reported_once_and_stays(tmp_path: Path) -> None:
    damaged = tmp_path / A / f"{A}_0.mcap"
    damaged.parent.mkdir()
    damaged.write_bytes(b"\x89MCAP")
    keeper = keeper_of(tmp_path)
    (reported,) = said(keeper, "bag_not_repaired")
    assert reported["path"] == str(damaged)
    assert "first 5 bytes" in reported["reason"]
    assert damaged.read_bytes() == b"\x89MCAP"


def test_an_interruption_that_comes_while_another_is_written_is_written_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keeper = keeper_of(tmp_path, clock=later(0))
    paused = threading.Thread(target=keeper.note_restart, args=(T0, "paused"))
    lock, waits = threading.Lock(), threading.Event()

    class WatchedLock:
        def __enter__(self) -> None:
            if threading.current_thread() is paused:
                waits.set()
            lock.acquire()

        def __exit__(self, *_: object) -> None:
            lock.release()

    def slow(bag_dir: Path, losses: Iterable[Loss]) -> None:
        append_losses(bag_dir, losses)
        if not paused.ident:
            paused.start()
            assert waits.wait(60)

    monkeypatch.setattr(keeper, "_lock", WatchedLock())
    monkeypatch.setattr(housekeeping, "append_losses", slow)
    keeper.note_restart(T0, "died")
    paused.join()
    assert [loss.by for loss in read_losses(tmp_path, 0, MAX_NS)] == ["died", "paused"]


def test_jobs_of_one_task_run_in_order_and_those_of_another_beside_them() -> None:
    background, may_end, done = Background(), threading.Event(), list[object]()
    background.add("slow", lambda: may_end.wait(30))
    for number in range(3):
        background.add("slow", partial(done.append, number))
    background.add("quick", may_end.set)
    background.wait(None)
    assert done == [0, 1, 2]
    assert not background.is_under_way("slow")


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (RecorderError("the disk is full"), "the disk is full"),
        (KeyError("x"), "a fault in this program (KeyError); see its log"),
    ],
    ids=["of the disk", "of this program"],
)
def test_a_fault_stays_until_the_task_succeeds(error: Exception, reason: str) -> None:
    background = Background()
    for job, faults in ((Mock(side_effect=error), {"task": reason}), (Mock(), {})):
        background.add("task", job)
        background.add("other", Mock())
        background.wait(None)
        assert background.faults() == faults


def test_what_does_not_end_is_waited_for_no_longer_than_the_patience() -> None:
    background, may_end = Background(), threading.Event()
    background.add("task", lambda: may_end.wait(30))
    background.wait(0.0)
    assert background.is_under_way("task")
    may_end.set()
    background.wait(None)
    assert not background.is_under_way("task")
