"""What the supervisor does when a recorder dies, the disk fails it, fills or is unmounted."""

import errno
import os
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from ros2_memory.bag_dir import durable_write, handover_file
from ros2_memory.bag_dir.handover_file import read_handover
from ros2_memory.bag_dir.layout import LOST_FILE
from ros2_memory.bag_dir.state_files import read_losses
from ros2_memory.core.errors import RecorderError
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S
from ros2_memory.recorder import sessions
from ros2_memory.recorder.background import Background
from ros2_memory.recorder.sessions import SplitChanges, Splits
from ros2_memory.recorder.supervisor import make_bag_dir
from ros2_memory.storage.mcap_reader import McapReader
from tests.support import simulated_recorders
from tests.support.bags import odom
from tests.support.fakes import broken
from tests.support.housekeepers import keeper_of
from tests.support.simulated_recorders import (
    T0,
    World,
    assert_each_counts_once,
    assert_what_stands_counts_once,
    events,
    rotating,
)

pytestmark = pytest.mark.usefixtures("no_flushing")


@pytest.fixture
def world(tmp_path: Path) -> World:
    """A recorder that has recorded for three seconds."""
    return World(tmp_path / "bags").started(3)


def test_waits_before_restarts_grow_until_a_good_split_was_written(tmp_path: Path) -> None:
    world = World(tmp_path, split_duration_s=100).started()
    waits = []
    # Each of the first lives for longer than a minute and closes nothing.
    for lives_s in (70, 70, 110, 70):
        world.run(lives_s)
        world.running[0].die()
        count, before = len(world.recorders), world.mono
        while len(world.recorders) == count:
            world.run(0.25)
        waits.append(round(world.mono - before))
    assert waits == [1, 2, 1, 2]


def test_a_recorder_that_hangs_and_must_be_killed_counts_as_a_restart(world: World) -> None:
    world.run(9)
    hung = world.recorders[0]
    hung.deaf, hung.ends_with = True, -9
    stopped = world.wall
    assert len(world.logged(40, "recorder_hung")) == 1
    assert world.heartbeat()["restarts"] == 1
    [(first, how)] = world.house.restarts
    assert how == "hung"
    assert stopped - 6 * NS_PER_S < first <= stopped + NS_PER_S


@pytest.mark.parametrize("fails", ["each dies", "none starts"])
def test_an_interruption_lasts_until_a_recorder_records_again(world: World, fails: str) -> None:
    died = world.wall
    world.recorders[0].die()
    if fails == "each dies":
        world.defaults["status"] = -9
    else:
        world.refuse = "there is no ros2"
    world.run(60)
    assert world.house.restarts == []
    world.defaults, world.refuse = {}, ""
    world.run(60)
    assert world.supervisor.is_recording
    [(first, how)] = world.house.restarts
    assert how == "died"
    assert abs(first - died) <= NS_PER_S


def test_a_recorder_that_does_not_begin_is_given_up_and_another_is_started(tmp_path: Path) -> None:
    world = World(tmp_path, defaults={"ready_s": 10**9, "subscribe_s": 10**9}).started()
    world.run(119)
    assert len(world.recorders) == 1
    assert len(world.logged(4, "recorder_not_ready")) == 1
    assert [recorder.status for recorder in world.recorders] == [0, None]
    assert world.heartbeat()["restarts"] == 1
    world.running[0].ready_s = 20
    world.run(20)
    assert world.house.restarts == [(T0, "hung")]


def test_a_recorder_that_dies_before_its_first_byte_leaves_no_directory(tmp_path: Path) -> None:
    world = World(tmp_path)
    world.disk_full = True
    world.started(0.5)
    world.recorders[0].die()
    world.run(0.5)
    assert not world.recorders[0].directory.exists()


def test_where_the_disk_does_not_list_recordings_handovers_are_settled_later(
    tmp_path: Path,
) -> None:
    world = rotating(tmp_path, 24)
    for recorder in world.running:
        recorder.die()
    again = World(tmp_path)
    again.wall = world.wall + NS_PER_S
    with broken(sessions, "unsettled_handovers", errno.EIO), capture_logs() as logs:
        again.started(3)
    assert again.supervisor.is_recording
    assert [each["task"] for each in events(logs, "supervision_failed")] == ["settle"]
    again.run(60)
    again.supervisor.stop()
    assert_what_stands_counts_once(world)


def test_a_restart_whose_name_cannot_be_looked_up_is_tried_again(world: World) -> None:
    world.recorders[0].die()
    known = world.recorders[0].directory
    with broken(os, "stat", errno.EIO, where=lambda path: "/rec_" in str(path) and path != known):
        assert "Input/output error" in world.logged(3, "recorder_not_started")[0]["reason"]
    assert "Input/output error" in world.heartbeat()["last_error"]
    world.run(10)
    assert world.supervisor.is_recording


def test_a_handover_is_given_up_where_the_new_directory_cannot_be_found_out(tmp_path: Path) -> None:
    world = rotating(tmp_path, 20.75)
    old, new = world.recorders
    new.die()
    with broken(os, "stat", errno.EIO, where=lambda path: path == new.directory):
        assert "Input/output error" in world.logged(1, "rotation_failed")[0]["reason"]
    assert world.running == [old]


@pytest.mark.parametrize("refused_s", [0.5, 30])
def test_a_recording_that_is_given_up_counts_not_though_its_sidecar_was_refused_at_first(
    tmp_path: Path, refused_s: float
) -> None:
    """It takes its time to end, and records meanwhile."""
    world = rotating(tmp_path, 20, defaults={"obeys_after": 20})
    with broken(handover_file, "write_all_durably"):
        [reported, *_] = world.logged(refused_s, "rotation_failed")
    assert "No space left on device" in reported["reason"]
    world.run(40)
    assert len(world.recorders) > 2
    assert_each_counts_once(world)


@pytest.mark.parametrize("fails", ["its start", "its sidecar's flush"])
def test_a_rotation_that_fails_is_tried_again(tmp_path: Path, fails: str) -> None:
    world = rotating(tmp_path, 19)
    if fails == "its start":
        world.refuse = "no more processes"
        world.run(4)
        assert read_handover(world.recorders[0].directory).handover.next is None
        world.refuse = ""
    else:
        with broken(durable_write, "flush", errno.EIO):
            assert world.logged(3, "rotation_failed")
    assert len(world.recorders) == 1
    world.run(20)
    assert len(world.recorders) == 2
    assert_each_counts_once(world)


def test_once_its_splits_can_be_read_again_and_one_is_closed_that_fault_is_past(
    world: World,
) -> None:
    for _ in range(2):
        with broken(world.reader, "is_finished", errno.ESTALE):
            *_, reported = world.logged(12, "unreadable")
        assert reported["reason"] == world.heartbeat()["last_error"]
        assert world.heartbeat()["recovered"] is False
        world.run(13)
        assert world.heartbeat()["recovered"] is True
    assert len(world.recorders) == 1
    # One that dies is replaced all the same.
    world.recorders[0].die()
    with broken(world.reader, "is_finished", errno.ESTALE):
        assert "Stale file handle" in world.logged(6, "unreadable")[0]["reason"]
    assert len(world.running) == 1


def test_each_split_that_cannot_be_read_is_named_once_and_is_past_once_all_can_be(
    world: World,
) -> None:
    world.run(10)
    directory = world.recorders[0].directory
    early, late = (directory / f"{directory.name}_{number}.mcap" for number in (4, 5))
    for paths, named in (((early, late), (early, late)), ((early,), ())):
        with broken(world.reader, "is_finished", errno.EACCES, where=paths.__contains__):
            reasons = [each["reason"] for each in world.logged(20, "unreadable")]
        assert reasons == [f"{path}: Permission denied" for path in named]
        beat = world.heartbeat()
        assert beat["last_error"] == f"{paths[-1]}: Permission denied"
        assert beat["recovered"] is False
    world.run(20)
    assert world.heartbeat()["recovered"] is True


def test_one_task_that_fails_keeps_no_other_from_being_done(world: World) -> None:
    with broken(world.recorders[0], "take_lines", errno.EIO):
        [reported] = world.logged(30, "supervision_failed")
        world.run(40)
    assert (reported["task"], reported["reason"]) == ("look", "[Errno 5] Input/output error")
    assert "apply" in world.house.asked


def test_room_is_made_first_and_waited_for_while_half_the_least_is_free(world: World) -> None:
    world.house.frees_to = 5000
    world.free = 900
    world.run(3)
    assert world.house.asked.count("room 1200") == 1
    assert world.heartbeat()["state"] == "recording"
    world.house.frees_to, world.house.making = 0, True
    world.free = 600
    world.run(200)
    assert world.house.asked.count("room 1200") == 2
    assert world.supervisor.is_recording
    world.free = 400
    world.run(2)
    assert world.heartbeat()["state"] == "paused"


def test_what_is_free_and_cannot_be_measured_is_no_full_disk(world: World) -> None:
    world.free = 900
    world.unmeasurable_after = 1
    with capture_logs() as logs:
        world.run(3)
    assert len(events(logs, "free_space_unknown")) == 1
    assert world.supervisor.is_recording
    assert events(logs, "recording_paused") == []


def test_pausing_in_a_handover_loses_and_doubles_nothing(tmp_path: Path) -> None:
    world = rotating(tmp_path, 22.25)
    world.free = 900
    world.run(3)
    assert world.running == []
    assert_each_counts_once(world)


@pytest.mark.parametrize("ends", ["room", "a stop"])
def test_while_it_pauses_room_is_asked_for_again_and_the_pause_is_noted_at_its_end(
    world: World, ends: str
) -> None:
    world.free = 900
    paused = world.wall
    world.run(200)
    assert 3 <= world.house.asked.count("room 1200") <= 5
    assert world.house.restarts == []
    if ends == "room":
        world.free = 1100
        world.run(10)
        assert world.running == []
        world.free = 1200
        world.run(3)
        assert (len(world.running), world.heartbeat()["state"]) == (1, "recording")
    else:
        world.supervisor.stop()
    [(since, how)] = world.house.restarts
    assert how == "paused"
    assert 0 <= since - paused <= 2 * NS_PER_S


def test_each_split_that_stays_empty_is_reported_and_past_once_a_newer_one_is_closed(
    world: World,
) -> None:
    world.run(5)
    world.disk_full = True
    reasons = [each["reason"] for each in world.logged(14.5, "split_empty")]
    assert len({*reasons}) == len(reasons) >= 2
    world.disk_full = False
    for after_s, is_past in ((2, False), (18, True)):
        world.run(after_s)
        assert world.heartbeat()["recovered"] is is_past
    assert "is empty" in world.heartbeat()["last_error"]
    assert len(world.recorders) == 1


def lost_in(bag_dir: Path) -> list[tuple[str, int, str]]:
    return [(loss.topic, loss.lost, loss.by) for loss in read_losses(bag_dir, MIN_NS, MAX_NS)]


@contextmanager
def unmounted(world: World) -> Iterator[None]:
    """The disk is unmounted: its recordings are not there, and an empty directory is."""
    aside, device = world.bag_dir.with_name("aside"), world.device
    world.bag_dir.rename(aside)
    world.bag_dir.mkdir()
    world.device = 2
    yield
    shutil.rmtree(world.bag_dir)
    aside.rename(world.bag_dir)
    world.device = device


def test_nothing_is_recorded_onto_another_disk_and_it_goes_on_when_the_disk_is_back(
    world: World,
) -> None:
    with unmounted(world):
        assert len(world.logged(200, "disk_gone")) == 1
        assert world.running == []
        assert world.house.asked == ["apply"]
        assert list(world.bag_dir.iterdir()) == []
    with capture_logs() as logs:
        world.run(0.5)
        assert len(world.recorders) == 1
        world.run(60)
    assert len(events(logs, "disk_back")) == 1
    beat = world.heartbeat()
    assert (world.supervisor.is_recording, beat["state"]) == (True, "recording")
    assert "has been unmounted" in beat["last_error"]
    assert [how for _, how in world.house.restarts] == ["paused"]
    with unmounted(world):
        world.run(3)
        world.supervisor.stop()
        assert list(world.bag_dir.iterdir()) == []


@pytest.mark.parametrize("how", ["died", "hung"])
def test_nothing_is_lost_with_a_recorder_that_has_not_taken_over_yet_and_counts_for_nothing(
    tmp_path: Path, how: str
) -> None:
    world = rotating(tmp_path, 22, housekeeper=keeper_of(tmp_path))
    old, new = world.recorders
    if how == "died":
        new.die()
    else:
        new.ends_with = -9
        world.set_clock(-3600)
    with capture_logs() as logs:
        world.run(1)
        assert how == "hung" or read_handover(old.directory).handover.next is None
        world.run(2)
    found = [len(events(logs, f"recorder_{name}")) for name in ("died", "hung")]
    assert found == ([1, 0] if how == "died" else [0, 1])
    assert (old.status, new.status) == (None, -9)
    assert world.heartbeat()["restarts"] == 1
    assert lost_in(tmp_path) == []
    assert read_handover(new.directory).handover.hides_all
    if how == "died":
        world.run(15)
        assert len(world.recorders) == 3
        assert_each_counts_once(world)


def test_what_was_lost_when_it_went_is_written_down_once_it_is_back(tmp_path: Path) -> None:
    bag_dir = tmp_path / "bags"
    world = World(bag_dir, housekeeper=keeper_of(bag_dir)).started(3)
    world.recorders[0].ends_with = -9
    with unmounted(world):
        world.run(0.25)
        name = world.recorders[0].directory.name
        world.orders.reception.note_lost(name, "/door", 3, (T0, world.wall))
        world.run(20)
        assert list(bag_dir.iterdir()) == []
    world.run(20)
    found = [("*", 0, "hung"), ("*", 0, "paused"), ("/door", 3, "rosbag2")]
    assert sorted(lost_in(bag_dir)) == found


def test_one_that_comes_and_goes_is_waited_for_longer_each_time(world: World) -> None:
    for _ in range(5):
        with unmounted(world):
            world.run(1)
        world.run(1)
    world.run(10)
    assert len(world.recorders) <= 3


# What `ros2 bag record` itself counts; it prints that before it closes the split.


def test_what_ros2_bag_counts_as_lost_is_said_of_the_time_until_the_split_that_closes(
    tmp_path: Path,
) -> None:
    world = World(tmp_path)
    world.before_start = lambda directory: world.orders.reception.overrides(directory.name)
    world.started(2)
    recorder = world.recorders[0]
    recorder.lines.append("\t/door: 5")
    world.run(5)
    recorder.lines.append("\t/door: 5")
    world.run(2)
    recorder.lines.append("\t/door: 12")
    world.supervisor.stop()
    first, last = min(published := world.published(counting=False)), max(published)
    assert lost_in(tmp_path) == [("/door", 5, "rosbag2"), ("/door", 7, "rosbag2")]
    early, late = read_losses(tmp_path, MIN_NS, MAX_NS)
    assert first <= early.start < early.stop < last <= late.stop


def test_what_was_lost_before_a_first_split_closed_is_said_of_the_time_until_the_death(
    tmp_path: Path,
) -> None:
    world = World(tmp_path).started(3)
    world.recorders[0].lines.append("\t/door: 5")
    world.recorders[0].die()
    world.run(3)
    assert world.heartbeat()["lost"] == {"/door": 5}
    [loss] = (each for each in read_losses(tmp_path, T0, world.wall) if each.by == "rosbag2")
    assert (loss.start, loss.stop) == (T0, T0 + 13 * NS_PER_S // 4)


def test_what_the_messages_themselves_show_to_be_missing_counts_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        simulated_recorders, "boolean", lambda at, _, topic: odom(at, 1.0, 2.0, topic=topic)
    )
    world = World(tmp_path, split_duration_s=100).started(20)
    recorder = world.recorders[0]
    recorder.deaf = True
    world.run(1.25)
    recorder.deaf = False
    world.run(20)
    recorder.lines += ["\t/bumper: 5", "\t/door: 5"]
    world.supervisor.stop()
    assert sorted(lost_in(tmp_path)) == [("/bumper", 5, "stamps"), ("/door", 5, "stamps")]


def test_the_house_is_told_what_is_recorded_and_what_it_holds_is_in_the_heartbeat(
    world: World,
) -> None:
    world.run(17)
    names, written, at_s = world.house.recorded[-1]
    assert [*names] == world.heartbeat()["recordings"]
    assert (written > 0, at_s) == (True, max(each[2] for each in world.house.recorded))
    assert world.heartbeat()["age_held"] is None
    world.house.held = "2 bags stay"
    world.run(1)
    assert world.heartbeat()["age_held"] == "2 bags stay"
    world.free = 900
    world.run(3)
    assert world.house.recorded[-1][0] == ()


def test_what_failed_in_the_background_is_told(world: World) -> None:
    lost = world.bag_dir / LOST_FILE
    lost.mkdir()
    name = world.recorders[0].directory.name
    world.orders.reception.note_lost(name, "/door", 3, (T0, world.wall))
    [reported] = world.logged(5, "housekeeping_failed")
    assert (reported["task"], "losses" in reported["reason"]) == ("reception", True)
    world.run(30)
    beat = world.heartbeat()
    assert (beat["last_error"], beat["recovered"]) == (reported["reason"], False)
    lost.rmdir()
    world.run(15)
    assert world.heartbeat()["recovered"] is True
    assert lost_in(world.bag_dir) == [("/door", 3, "rosbag2")]


def test_the_house_is_kept_at_the_start_and_now_and_then_when_nothing_comes(tmp_path: Path) -> None:
    world = World(tmp_path, silent=True).started(130)
    assert world.house.asked.count("apply") == 3


def test_a_recorder_that_waits_for_a_slow_disk_is_no_dead_one_to_the_service_manager(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each flush takes 5 s; after 90 s without a sign of life it would be killed."""
    signs = [1_000.0]
    slow = World(
        tmp_path,
        session_duration_s=20,
        keep_alive=lambda: signs.append(slow.mono),
        background=Background(),
    )

    def flush(_: int) -> None:
        if threading.current_thread() is threading.main_thread():
            slow.mono += 5.0
            slow.wall += 5 * NS_PER_S

    monkeypatch.setattr(os, "fsync", flush)
    slow.started(30)
    assert len(slow.recorders) > 2
    assert max(after - before for before, after in pairwise(signs)) < 45.0


def test_a_bag_directory_that_is_a_file_is_called_one(tmp_path: Path) -> None:
    (tmp_path / "bags").touch()
    with pytest.raises(RecorderError, match="is a file, or lies below one, and not a directory"):
        make_bag_dir(tmp_path / "bags")


def test_a_closed_split_that_cannot_be_read_is_reported_and_counts_as_closed(
    tmp_path: Path,
) -> None:
    (tmp_path / "rec_1_0.mcap").write_bytes(b"a text file of that name")
    splits = Splits(tmp_path, McapReader())
    changes = splits.observe(0)
    assert (changes.closed, len(changes.faults)) == (("rec_1_0.mcap",), 1)
    assert splits.observe(1) == SplitChanges()
