"""What the supervisor does as time passes: no process runs, no second is waited for."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, MutableMapping
from pathlib import Path
from typing import Any

import pytest
from structlog.testing import capture_logs

from ros2_memory.errors import RecorderError
from ros2_memory.recorder.handover import read_handover
from ros2_memory.recorder.settle import settle_all
from ros2_memory.storage.base import Closing
from tests.recorder_world import PERIOD, World


@pytest.fixture(autouse=True)
def no_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing here is about power cuts, and flushing takes most of the time."""
    monkeypatch.setattr(os, "fsync", lambda _descriptor: None)


def events(logs: list[MutableMapping[str, Any]], name: str) -> list[MutableMapping[str, Any]]:
    return [each for each in logs if each["event"] == name]


def assert_each_counts_once(world: World) -> None:
    """Whatever stands in any bag counts exactly once, and nothing is missing in between."""
    stands, counts = world.published(counting=False), world.published(counting=True)
    assert set(counts) == set(stands)
    assert [moment for moment, times in counts.items() if times != 1] == []
    assert len(stands) == (max(stands) - min(stands)) // PERIOD + 1


class TestStart:
    def test_a_recording_is_named_in_the_heartbeat_before_its_recorder_starts(
        self, tmp_path: Path
    ) -> None:
        world = World(tmp_path)
        world.supervisor.start()
        assert world.named_at_start == [[world.recorders[0].directory.name]]

    def test_it_records_once_the_recorder_says_so(self, tmp_path: Path) -> None:
        world = World(tmp_path)
        world.supervisor.start()
        assert world.heartbeat()["state"] == "starting"
        world.run(3)
        assert world.supervisor.is_recording
        beat = world.heartbeat()
        assert beat["state"] == "recording"
        assert beat["subscribed"] == ["/bumper", "/door"]

    def test_one_whose_words_for_it_are_not_known_records_once_it_subscribes(
        self, tmp_path: Path
    ) -> None:
        world = World(tmp_path)
        world.defaults = {"ready_s": 10**9}
        world.supervisor.start()
        world.run(130)
        assert world.supervisor.is_recording
        assert len(world.recorders) == 1

    def test_a_second_start_changes_nothing(self, tmp_path: Path) -> None:
        world = World(tmp_path)
        world.supervisor.start()
        world.supervisor.start()
        assert len(world.recorders) == 1

    def test_a_recorder_that_cannot_be_started_is_an_error_and_leaves_nothing(
        self, tmp_path: Path
    ) -> None:
        world = World(tmp_path)
        world.refuse = "there is no ros2"
        with pytest.raises(RecorderError, match="there is no ros2"):
            world.supervisor.start()
        world.run(5)
        assert world.recorders == []

    def test_after_a_stop_it_goes_on_in_a_new_recording(self, tmp_path: Path) -> None:
        world = World(tmp_path)
        world.supervisor.start()
        world.run(3)
        world.supervisor.stop()
        assert world.heartbeat()["state"] == "stopped"
        assert world.heartbeat()["recordings"] == []
        world.supervisor.start()
        world.run(3)
        assert len({recorder.directory for recorder in world.recorders}) == 2
        assert world.supervisor.is_recording

    def test_ticks_of_one_that_is_stopped_do_nothing(self, tmp_path: Path) -> None:
        world = World(tmp_path)
        world.run(2)
        world.supervisor.stop()
        assert list(tmp_path.iterdir()) == []


class TestRotation:
    def test_no_message_is_lost_or_counts_twice(self, tmp_path: Path) -> None:
        world = World(tmp_path, session_duration_s=20)
        world.supervisor.start()
        world.run(75)
        world.supervisor.stop()
        assert len(world.recorders) == 4
        assert sum(world.published(counting=False).values()) > len(world.published(counting=False))
        assert_each_counts_once(world)

    def test_both_recordings_are_named_while_both_are_open(self, tmp_path: Path) -> None:
        world = World(tmp_path, session_duration_s=20)
        world.supervisor.start()
        world.run(22)
        names = [recorder.directory.name for recorder in world.recorders]
        assert world.heartbeat()["recordings"] == names
        world.run(8)
        assert world.heartbeat()["recordings"] == names[1:]

    def test_the_old_one_is_ended_two_seconds_after_the_new_one_has_subscribed(
        self, tmp_path: Path
    ) -> None:
        world = World(tmp_path, session_duration_s=20)
        world.supervisor.start()
        world.run(21)
        old, new = world.recorders
        world.run(1.75)
        assert old.asked_to_end == 0
        world.run(1)
        assert (old.status, new.status) == (0, None)
        assert new.status is None

    def test_a_topic_that_went_away_does_not_hold_it_up_for_ever(self, tmp_path: Path) -> None:
        world = World(tmp_path, session_duration_s=20, subscribe_timeout_s=6)
        world.supervisor.start()
        world.run(19)
        world.defaults = {"topics": ("/bumper",)}
        with capture_logs() as logs:
            world.run(12)
        assert world.recorders[0].status == 0
        (said,) = events(logs, "rotated_without")
        assert str(said["reason"]).endswith("/door")
        world.supervisor.stop()
        assert_each_counts_once(world)

    def test_a_split_that_the_old_one_opens_while_it_ends_is_in_its_sidecar(
        self, tmp_path: Path
    ) -> None:
        world = World(tmp_path, session_duration_s=20)
        world.supervisor.start()
        world.recorders[0].obeys_after = 40
        world.run(40)
        old = read_handover(world.recorders[0].directory).handover
        assert old.end is not None
        last = f"{world.recorders[0].directory.name}_{world.recorders[0].splits}.mcap"
        assert last in old.end.files
        world.supervisor.stop()
        assert_each_counts_once(world)

    def test_times_of_a_simulated_clock_are_not_compared(self, tmp_path: Path) -> None:
        world = World(tmp_path, session_duration_s=20, simulated=True)
        world.supervisor.start()
        world.run(30)
        new = read_handover(world.recorders[1].directory).handover
        assert new.begin is not None
        assert (new.begin.log_from, new.begin.log_until) == (None, None)
        world.supervisor.stop()
        assert_each_counts_once(world)

    def test_a_rotation_that_cannot_begin_is_tried_again(self, tmp_path: Path) -> None:
        world = World(tmp_path, session_duration_s=20)
        world.supervisor.start()
        world.run(19)
        world.refuse = "no more processes"
        world.run(4)
        assert read_handover(world.recorders[0].directory).handover.next is None
        world.refuse = ""
        world.run(12)
        world.supervisor.stop()
        assert len(world.recorders) == 2
        assert_each_counts_once(world)


class TestDeath:
    def test_a_recorder_that_dies_is_replaced_after_a_growing_wait(self, tmp_path: Path) -> None:
        world = World(tmp_path)
        world.supervisor.start()
        waits = []
        for _ in range(4):
            world.run(2)
            world.running[0].die()
            count, before = len(world.recorders), world.mono
            while len(world.recorders) == count:
                world.run(0.25)
            waits.append(round(world.mono - before))
        assert waits == [1, 2, 4, 8]

    def test_it_is_told_with_its_last_words(self, tmp_path: Path) -> None:
        world = World(tmp_path)
        world.supervisor.start()
        world.run(2)
        world.recorders[0].lines.append("terminate called after throwing")
        world.recorders[0].die(-6)
        with capture_logs() as logs:
            world.run(3)
        (died,) = events(logs, "recorder_died")
        assert died["log_level"] == "error"
        assert "status -6" in str(died["reason"])
        assert "terminate called" in str(died["reason"])
        assert world.heartbeat()["last_error"] == died["reason"]

    def test_one_that_does_not_begin_is_given_up_and_another_is_started(
        self, tmp_path: Path
    ) -> None:
        world = World(tmp_path)
        world.defaults = {"ready_s": 10**9, "subscribe_s": 10**9}
        world.supervisor.start()
        with capture_logs() as logs:
            world.run(119)
            assert len(world.recorders) == 1
            world.run(4)
        assert [recorder.status for recorder in world.recorders] == [0, None]
        assert len(events(logs, "recorder_not_ready")) == 1

    def test_a_new_one_that_does_not_begin_never_takes_over(self, tmp_path: Path) -> None:
        world = World(tmp_path, session_duration_s=20)
        world.supervisor.start()
        world.run(19)
        world.defaults = {"ready_s": 10**9, "subscribe_s": 10**9}
        world.run(125)
        old, new = world.recorders[:2]
        assert (old.status, new.status) == (None, 0)
        assert read_handover(old.directory).handover.next != new.directory.name

    def test_what_never_held_a_byte_leaves_no_directory(self, tmp_path: Path) -> None:
        world = World(tmp_path)
        world.disk_full = True
        world.supervisor.start()
        world.run(0.5)
        world.recorders[0].die()
        world.run(0.5)
        assert not world.recorders[0].directory.exists()

    def test_its_recording_is_not_named_as_open_any_more(self, tmp_path: Path) -> None:
        world = World(tmp_path)
        world.supervisor.start()
        world.run(2)
        world.recorders[0].die()
        world.run(5)
        assert world.heartbeat()["recordings"] == [world.recorders[1].directory.name]

    def test_a_new_one_that_dies_in_a_handover_counts_for_nothing(self, tmp_path: Path) -> None:
        world = World(tmp_path, session_duration_s=20)
        world.supervisor.start()
        world.run(22.5)
        old, new = world.recorders
        new.die()
        world.run(1)
        assert old.status is None
        assert read_handover(new.directory).handover.hides_all
        assert read_handover(old.directory).handover.next is None
        world.run(15)
        world.supervisor.stop()
        assert len(world.recorders) == 3
        assert_each_counts_once(world)

    @pytest.mark.parametrize("after_s", [21.25, 21.75, 22.0, 23.0])
    def test_an_old_one_that_dies_in_a_handover_counts_as_far_as_it_reaches(
        self, tmp_path: Path, after_s: float
    ) -> None:
        world = World(tmp_path, session_duration_s=20)
        world.supervisor.start()
        world.run(after_s)
        old, new = world.recorders
        old.die()
        world.run(12)
        assert new.status is None
        assert world.supervisor.is_recording
        world.supervisor.stop()
        stands, counts = world.published(counting=False), world.published(counting=True)
        assert counts == dict.fromkeys(stands, 1)

    @pytest.mark.parametrize("after_s", [20.5, 21.0, 21.75, 22.5, 23.25, 23.75, 24.0])
    def test_after_a_crash_of_everything_the_next_start_settles_the_handover(
        self, tmp_path: Path, after_s: float
    ) -> None:
        world = World(tmp_path, session_duration_s=20)
        world.supervisor.start()
        world.run(after_s)
        for recorder in world.running:
            recorder.die()
        settle_all(tmp_path, world.reader)
        stands, counts = world.published(counting=False), world.published(counting=True)
        assert counts == dict.fromkeys(stands, 1)


class TestStop:
    @pytest.mark.parametrize("after_s", [10.0, 20.5, 21.25, 21.75, 22.5, 23.0, 23.75, 24.25])
    def test_at_any_moment_of_a_handover_nothing_is_lost_or_counts_twice(
        self, tmp_path: Path, after_s: float
    ) -> None:
        world = World(tmp_path, session_duration_s=20)
        world.supervisor.start()
        world.run(after_s)
        world.supervisor.stop()
        assert world.running == []
        assert_each_counts_once(world)

    def test_a_process_that_nothing_ends_is_named(self, tmp_path: Path) -> None:
        world = World(tmp_path)
        world.defaults = {"obeys_after": 10**9, "patience_s": 0.05}
        world.supervisor.start()
        world.run(2)
        with capture_logs() as logs:
            world.supervisor.stop()
        (said,) = events(logs, "recorder_not_ended")
        assert "process 100" in str(said["reason"])


class TestClock:
    def test_set_back_in_a_handover_the_handover_is_tried_again(self, tmp_path: Path) -> None:
        world = World(tmp_path, session_duration_s=20)
        world.supervisor.start()
        world.run(22)
        world.set_clock(-5)
        world.run(15)
        world.supervisor.stop()
        first, second, third = world.recorders
        assert read_handover(second.directory).handover.hides_all
        assert read_handover(first.directory).handover.next == third.directory.name
        # Some seconds were lived twice, and their publish times stand twice in one recording.
        lived_s = round(world.mono - 1_000) - 1
        counts = world.published(counting=True)
        assert set(counts) == set(world.published(counting=False))
        assert sum(counts.values()) == pytest.approx(4 * lived_s, abs=4)

    def test_set_back_by_an_hour_a_new_recording_begins(self, tmp_path: Path) -> None:
        world = World(tmp_path)
        world.supervisor.start()
        world.run(10)
        world.set_clock(-3600)
        world.run(8)
        assert len(world.recorders) == 2
        world.supervisor.stop()
        stands, counts = world.published(counting=False), world.published(counting=True)
        assert counts == dict.fromkeys(stands, 1)

    def test_set_back_by_seconds_is_waited_out(self, tmp_path: Path) -> None:
        world = World(tmp_path)
        world.supervisor.start()
        world.run(10)
        world.set_clock(-30)
        world.run(20)
        assert len(world.recorders) == 1

    def test_set_forward_by_a_year_nothing_happens(self, tmp_path: Path) -> None:
        world = World(tmp_path)
        world.supervisor.start()
        world.run(10)
        world.set_clock(365 * 86400)
        world.run(20)
        assert len(world.recorders) == 1


class FailingDisk:
    """Lets whatever asks for the status of some paths fail, as a disk or a server that is gone."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, fails: Callable[[Path], bool]) -> None:
        self.failing = True
        stat = os.stat

        def failing(path: Any, **options: Any) -> os.stat_result:
            if self.failing and isinstance(path, Path) and fails(path):
                raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))
            return stat(path, **options)

        monkeypatch.setattr(os, "stat", failing)


class TestFailingDisk:
    def test_a_restart_whose_name_cannot_be_looked_up_is_tried_again(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        world = World(tmp_path)
        world.supervisor.start()
        world.run(3)
        world.recorders[0].die()
        known = [recorder.directory for recorder in world.recorders]
        disk = FailingDisk(
            monkeypatch, lambda path: path.name.startswith("rec_") and path not in known
        )
        with capture_logs() as logs:
            world.run(3)
        assert "Input/output error" in events(logs, "recorder_not_started")[0]["reason"]
        assert "Input/output error" in world.heartbeat()["last_error"]
        disk.failing = False
        world.run(10)
        assert world.supervisor.is_recording

    def test_a_rotation_whose_name_cannot_be_looked_up_is_tried_again(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        world = World(tmp_path, session_duration_s=20)
        world.supervisor.start()
        world.run(18)
        known = [recorder.directory for recorder in world.recorders]
        disk = FailingDisk(
            monkeypatch, lambda path: path.name.startswith("rec_") and path not in known
        )
        with capture_logs() as logs:
            world.run(4)
        assert events(logs, "rotation_failed")
        disk.failing = False
        world.run(15)
        world.supervisor.stop()
        assert len(world.recorders) == 2
        assert_each_counts_once(world)

    def test_a_handover_is_given_up_where_the_new_directory_cannot_be_told(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        world = World(tmp_path, session_duration_s=20)
        world.supervisor.start()
        world.run(20.75)
        old, new = world.recorders
        new.die()
        FailingDisk(monkeypatch, lambda path: path == new.directory)
        with capture_logs() as logs:
            world.run(1)
        assert "Input/output error" in events(logs, "rotation_failed")[0]["reason"]
        assert world.running == [old]

    def test_a_recorder_that_dies_is_replaced_though_its_splits_cannot_be_read(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        world = World(tmp_path)
        world.supervisor.start()
        world.run(3)

        def fails(_path: Path) -> Closing:
            raise OSError(errno.ESTALE, os.strerror(errno.ESTALE))

        monkeypatch.setattr(world.reader, "closing", fails)
        world.recorders[0].die()
        with capture_logs() as logs:
            world.run(6)
        assert len(world.running) == 1
        assert "Stale file handle" in events(logs, "unreadable")[0]["reason"]

    def test_one_task_that_fails_keeps_no_other_from_being_done(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        keeper = Housekeeping()
        world = World(tmp_path, housekeeper=keeper)
        world.supervisor.start()
        world.run(3)

        def fails() -> list[str]:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

        monkeypatch.setattr(world.recorders[0], "take_lines", fails)
        with capture_logs() as logs:
            world.run(30)
        (told,) = events(logs, "supervision_failed")
        assert (told["task"], told["reason"]) == ("look", "[Errno 5] Input/output error")
        world.run(40)
        assert "apply" in keeper.asked


class Housekeeping:
    """Notes what it is asked for, and frees what it is told to."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.world: World | None = None
        self.frees_to = 0
        self.fails = False
        self.making = False
        self.moments_kept = 0
        self.failed: dict[str, str] = {}

    def repair(self, bag_dir: Path) -> None:
        self.asked.append("repair")

    def make_room(self, bag_dir: Path, free_bytes_wanted: int) -> None:
        self.asked.append(f"room {free_bytes_wanted}")
        if self.world is not None:
            self.world.free = max(self.world.free, self.frees_to)

    def making_room(self) -> bool:
        return self.making

    def apply(self, bag_dir: Path) -> None:
        self.asked.append("apply")
        if self.fails:
            raise RecorderError("the catalogue is locked")

    def keep_moments(self, bag_dir: Path) -> None:
        self.moments_kept += 1

    def faults(self) -> dict[str, str]:
        return self.failed


class TestSpace:
    def world(self, tmp_path: Path) -> tuple[World, Housekeeping]:
        housekeeping = Housekeeping()
        world = World(tmp_path, housekeeper=housekeeping)
        housekeeping.world = world
        return world, housekeeping

    def test_a_disk_that_fills_is_first_made_room_on(self, tmp_path: Path) -> None:
        world, housekeeping = self.world(tmp_path)
        world.supervisor.start()
        world.run(3)
        housekeeping.frees_to = 5000
        world.free = 900
        world.run(3)
        assert "room 1200" in housekeeping.asked
        assert world.supervisor.is_recording
        assert world.heartbeat()["state"] == "recording"

    def test_where_that_does_not_help_recording_pauses_with_an_error(self, tmp_path: Path) -> None:
        world, _ = self.world(tmp_path)
        world.supervisor.start()
        world.run(3)
        world.free = 900
        with capture_logs() as logs:
            world.run(3)
        (paused,) = events(logs, "recording_paused")
        assert paused["log_level"] == "error"
        assert "min_free_gb" in str(paused["reason"])
        assert world.running == []
        beat = world.heartbeat()
        assert (beat["state"], beat["recordings"]) == ("paused", [])
        assert beat["last_error"] == paused["reason"]

    def test_room_that_is_being_made_is_waited_for_while_half_the_least_is_free(
        self, tmp_path: Path
    ) -> None:
        housekeeping = Housekeeping()
        housekeeping.making = True
        world = World(tmp_path, housekeeper=housekeeping)
        world.supervisor.start()
        world.run(3)
        world.free = 600
        world.run(200)
        assert housekeeping.asked.count("room 1200") == 1
        assert world.supervisor.is_recording
        world.free = 400
        world.run(2)
        assert world.heartbeat()["state"] == "paused"

    def test_room_that_was_made_too_little_has_recording_pause(self, tmp_path: Path) -> None:
        housekeeping = Housekeeping()
        housekeeping.making = True
        world = World(tmp_path, housekeeper=housekeeping)
        world.supervisor.start()
        world.run(3)
        world.free = 600
        world.run(3)
        housekeeping.making = False
        world.run(2)
        assert world.heartbeat()["state"] == "paused"

    def test_it_resumes_by_itself_when_more_than_that_is_free(self, tmp_path: Path) -> None:
        world, _ = self.world(tmp_path)
        world.supervisor.start()
        world.run(3)
        world.free = 900
        world.run(3)
        world.free = 1100
        world.run(10)
        assert world.running == []
        world.free = 1200
        world.run(3)
        assert len(world.running) == 1
        assert world.heartbeat()["state"] == "recording"

    def test_while_it_pauses_room_is_asked_for_again_now_and_then(self, tmp_path: Path) -> None:
        world, housekeeping = self.world(tmp_path)
        world.supervisor.start()
        world.run(3)
        world.free = 900
        world.run(200)
        assert 3 <= housekeeping.asked.count("room 1200") <= 5

    def test_a_disk_that_is_full_at_the_start_is_waited_for(self, tmp_path: Path) -> None:
        world, _ = self.world(tmp_path)
        world.free = 5
        world.supervisor.start()
        world.run(5)
        assert world.recorders == []
        assert world.heartbeat()["state"] == "paused"
        world.free = 10**9
        world.run(3)
        assert world.supervisor.is_recording

    def test_pausing_in_a_handover_loses_and_doubles_nothing(self, tmp_path: Path) -> None:
        housekeeping = Housekeeping()
        world = World(tmp_path, housekeeper=housekeeping, session_duration_s=20)
        world.supervisor.start()
        world.run(22.25)
        world.free = 900
        world.run(3)
        assert world.running == []
        assert_each_counts_once(world)

    def test_a_split_that_stays_empty_is_told(self, tmp_path: Path) -> None:
        world = World(tmp_path)
        world.supervisor.start()
        world.run(8)
        world.disk_full = True
        with capture_logs() as logs:
            world.run(30)
        told = events(logs, "split_empty")
        assert len(told) >= 2
        assert len({each["reason"] for each in told}) == len(told)


class TestUnmounted:
    """The disk is unmounted: its recordings are not there, and an empty directory is."""

    @staticmethod
    def unmounted(world: World) -> Path:
        aside = world.bag_dir.with_name("aside")
        world.bag_dir.rename(aside)
        world.bag_dir.mkdir()
        world.device = 2
        return aside

    def test_nothing_is_recorded_onto_another_disk_and_that_is_told(self, tmp_path: Path) -> None:
        housekeeping = Housekeeping()
        world = World(tmp_path / "bags", housekeeper=housekeeping)
        world.supervisor.start()
        world.run(3)
        self.unmounted(world)
        with capture_logs() as logs:
            world.run(200)
        assert len(events(logs, "disk_gone")) == 1
        assert world.running == []
        assert len(world.recorders) == 1
        assert housekeeping.asked == []
        world.supervisor.stop()
        assert list(world.bag_dir.iterdir()) == []

    def test_it_goes_on_by_itself_when_the_disk_is_back(self, tmp_path: Path) -> None:
        world = World(tmp_path / "bags")
        world.supervisor.start()
        world.run(3)
        aside = self.unmounted(world)
        world.run(20)
        shutil.rmtree(world.bag_dir)
        aside.rename(world.bag_dir)
        world.device = 1
        with capture_logs() as logs:
            world.run(0.5)
            assert len(world.recorders) == 1
            world.run(5)
        assert len(events(logs, "disk_back")) == 1
        assert world.supervisor.is_recording
        beat = world.heartbeat()
        assert beat["state"] == "recording"
        assert "has been unmounted" in beat["last_error"]

    def test_one_that_comes_and_goes_is_waited_for_longer_each_time(self, tmp_path: Path) -> None:
        world = World(tmp_path / "bags")
        world.supervisor.start()
        world.run(3)
        for _ in range(5):
            aside = self.unmounted(world)
            world.run(1)
            shutil.rmtree(world.bag_dir)
            aside.rename(world.bag_dir)
            world.device = 1
            world.run(1)
        world.run(10)
        assert len(world.recorders) <= 3


class TestHouse:
    def test_what_failed_while_nobody_waited_is_told_once_and_in_the_heartbeat(
        self, tmp_path: Path
    ) -> None:
        housekeeping = Housekeeping()
        world = World(tmp_path, housekeeper=housekeeping)
        world.supervisor.start()
        world.run(3)
        housekeeping.failed = {"make_room": "the oldest bags cannot be deleted"}
        with capture_logs() as logs:
            world.run(130)
        (told,) = events(logs, "housekeeping_failed")
        assert (told["task"], told["reason"]) == ("make_room", "the oldest bags cannot be deleted")
        assert world.heartbeat()["last_error"] == "the oldest bags cannot be deleted"

    def test_it_is_kept_after_splits_were_closed(self, tmp_path: Path) -> None:
        housekeeping = Housekeeping()
        world = World(tmp_path, housekeeper=housekeeping)
        world.supervisor.start()
        world.run(31)
        assert housekeeping.asked.count("apply") == 3

    def test_it_is_kept_now_and_then_when_nothing_comes(self, tmp_path: Path) -> None:
        housekeeping = Housekeeping()
        world = World(tmp_path, housekeeper=housekeeping)
        world.silent = True
        world.supervisor.start()
        world.run(130)
        assert housekeeping.asked.count("apply") == 2

    def test_what_goes_wrong_there_is_told_once_and_stops_nothing(self, tmp_path: Path) -> None:
        housekeeping = Housekeeping()
        housekeeping.fails = True
        world = World(tmp_path, housekeeper=housekeeping)
        world.supervisor.start()
        with capture_logs() as logs:
            world.run(60)
        assert len([each for each in logs if "catalogue is locked" in str(each)]) == 1
        assert world.supervisor.is_recording


class TestWatch:
    def test_a_robot_that_falls_silent_has_its_last_split_closed_once(self, tmp_path: Path) -> None:
        world = World(tmp_path)
        world.supervisor.start()
        world.run(18)
        world.silent = True
        with capture_logs() as logs:
            world.run(300)
        (told,) = events(logs, "no_growth")
        assert world.heartbeat()["last_error"] == told["reason"]
        assert len(world.recorders) == 2
        assert world.recorders[0].status == 0
        world.silent = False
        world.run(20)
        world.silent = True
        world.run(100)
        assert len(world.recorders) == 3
        world.supervisor.stop()
        stands, counts = world.published(counting=False), world.published(counting=True)
        assert counts == dict.fromkeys(stands, 1)

    def test_a_directory_that_vanished_is_told_and_recording_goes_on_elsewhere(
        self, tmp_path: Path
    ) -> None:
        world = World(tmp_path)
        world.supervisor.start()
        world.run(8)
        shutil.rmtree(world.recorders[0].directory)
        with capture_logs() as logs:
            world.run(4)
        assert len(events(logs, "recording_vanished")) == 1
        assert [recorder.status for recorder in world.recorders] == [0, None]
        assert world.supervisor.is_recording

    def test_a_bag_directory_that_vanished_is_made_again(self, tmp_path: Path) -> None:
        bag_dir = tmp_path / "bags"
        world = World(bag_dir)
        world.supervisor.start()
        world.run(8)
        shutil.rmtree(bag_dir)
        world.run(5)
        assert world.supervisor.is_recording
        assert world.running[0].directory.is_dir()

    @pytest.mark.parametrize("loser", ["old", "new"])
    def test_a_directory_that_vanished_in_a_handover_leaves_the_other(
        self, tmp_path: Path, loser: str
    ) -> None:
        world = World(tmp_path, session_duration_s=20)
        world.supervisor.start()
        world.run(22)
        old, new = world.recorders
        shutil.rmtree((old if loser == "old" else new).directory)
        world.run(2)
        kept = new if loser == "old" else old
        assert kept.status is None
        assert not read_handover(kept.directory).handover.hides_all
        world.run(20)
        world.supervisor.stop()
        stands, counts = world.published(counting=False), world.published(counting=True)
        assert counts == dict.fromkeys(stands, 1)

    def test_topics_that_brought_nothing_in_a_whole_recording_are_told(
        self, tmp_path: Path
    ) -> None:
        world = World(tmp_path, session_duration_s=20)
        world.defaults = {"heard": ("/bumper",)}
        world.supervisor.start()
        with capture_logs() as logs:
            world.run(30)
        (told,) = events(logs, "topics_silent")
        assert str(told["reason"]).endswith("/door")
        assert world.heartbeat()["silent"] == ["/door"]

    def test_subscribed_to_all_and_hearing_nothing_points_at_the_transport(
        self, tmp_path: Path
    ) -> None:
        world = World(tmp_path, session_duration_s=20)
        world.silent = True
        world.supervisor.start()
        with capture_logs() as logs:
            world.run(30)
        (told,) = events(logs, "topics_silent")
        assert "UDPv4" in str(told["reason"])

    def test_a_warning_that_repeats_is_told_once_for_each_topic(self, tmp_path: Path) -> None:
        world = World(tmp_path)
        world.supervisor.start()
        world.run(2)
        with capture_logs() as logs:
            for number in range(40):
                world.recorders[0].lines += [
                    f"[ERROR] [{number}.5] [ROSBAG2_TRANSPORT]: Topic '/cam{topic}' has more than "
                    "one type associated. Only topics with one type are supported"
                    for topic in (1, 2)
                ]
                world.run(0.5)
        assert len(events(logs, "several_types")) == 2
        assert "/cam2" in str(world.heartbeat()["last_error"])

    def test_a_refused_publisher_is_told_with_what_it_means(self, tmp_path: Path) -> None:
        world = World(tmp_path)
        world.supervisor.start()
        world.run(2)
        world.recorders[0].lines.append(
            "[WARN] [1.5] [rosbag2_recorder]: A new publisher for subscribed topic /scan was found "
            "offering RMW_QOS_POLICY_RELIABILITY_BEST_EFFORT, but rosbag already subscribed"
        )
        with capture_logs() as logs:
            world.run(3)
        (told,) = events(logs, "qos_refused")
        assert str(told["reason"]).startswith("/scan: messages of this publisher are not recorded")
        assert world.heartbeat()["last_error"] == told["reason"]


class TestHeartbeat:
    def test_it_comes_every_five_seconds(self, tmp_path: Path) -> None:
        world = World(tmp_path)
        world.supervisor.start()
        world.run(5)
        moments = set()
        for _ in range(80):
            world.run(0.25)
            moments.add(world.heartbeat()["updated"])
        assert len(moments) == 4

    def test_a_change_is_told_at_once(self, tmp_path: Path) -> None:
        world = World(tmp_path)
        world.supervisor.start()
        world.run(7)
        world.recorders[0].die()
        world.run(0.25)
        beat = world.heartbeat()
        assert (beat["state"], beat["recordings"]) == ("starting", [])

    def test_one_that_cannot_be_written_is_told_once_and_recording_goes_on(
        self, tmp_path: Path
    ) -> None:
        world = World(tmp_path)
        world.supervisor.start()
        world.run(2)
        (tmp_path / ".recorder.json.tmp").mkdir()
        with capture_logs() as logs:
            world.run(20)
        assert len(events(logs, "heartbeat_not_written")) == 1
        assert world.supervisor.is_recording

    def test_bytes_count_recordings_that_ended_too(self, tmp_path: Path) -> None:
        world = World(tmp_path, session_duration_s=20)
        world.supervisor.start()
        sizes = []
        for _ in range(12):
            world.run(5)
            sizes.append(world.heartbeat()["bytes_written"])
        assert sizes == sorted(sizes, key=lambda size: int(str(size)))
        on_disk = sum(path.stat().st_size for path in tmp_path.glob("*/*.mcap"))
        assert abs(int(str(sizes[-1])) - on_disk) < 20_000
        assert world.heartbeat()["interval_s"] == 5.0
