"""What the supervisor does when the disk fills or is unmounted, and for the house."""

from __future__ import annotations

import os
import shutil
import threading
from itertools import pairwise
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from ros2_memory.bag_dir.layout import LOST_FILE
from ros2_memory.bag_dir.state_files import read_losses
from ros2_memory.core.errors import RecorderError
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S
from ros2_memory.recorder.background import Background
from ros2_memory.recorder.supervisor import make_bag_dir
from tests.support.housekeepers import keeper_of
from tests.support.simulated_recorders import (
    PlayedHousekeeper,
    World,
    assert_each_counts_once,
    events,
)

pytestmark = pytest.mark.usefixtures("no_flushing")


class TestRecordedTime:
    def test_the_house_is_reported_what_is_recorded_and_what_it_holds_is_in_the_heartbeat(
        self, tmp_path: Path
    ) -> None:
        housekeeping = PlayedHousekeeper()
        world = World(tmp_path, housekeeper=housekeeping).started(20)
        names, written, at_s = housekeeping.recorded[-1]
        assert [*names] == world.heartbeat()["recordings"]
        assert (written > 0, at_s) == (True, max(each[2] for each in housekeeping.recorded))
        assert world.heartbeat()["age_held"] is None
        housekeeping.held = "2 bags stay"
        world.run(1)
        assert world.heartbeat()["age_held"] == "2 bags stay"
        world.free = 900
        world.run(3)
        assert housekeeping.recorded[-1][0] == ()


class TestSpace:
    def world(self, tmp_path: Path) -> tuple[World, PlayedHousekeeper]:
        housekeeping = PlayedHousekeeper()
        housekeeping.world = World(tmp_path, housekeeper=housekeeping).started(3)
        return housekeeping.world, housekeeping

    def test_a_disk_that_fills_is_first_made_room_on(self, tmp_path: Path) -> None:
        world, housekeeping = self.world(tmp_path)
        housekeeping.frees_to = 5000
        world.free = 900
        world.run(3)
        assert "room 1200" in housekeeping.asked
        assert world.supervisor.is_recording
        assert world.heartbeat()["state"] == "recording"

    def test_room_that_is_being_made_is_waited_for_while_half_the_least_is_free(
        self, tmp_path: Path
    ) -> None:
        housekeeping = PlayedHousekeeper()
        housekeeping.making = True
        world = World(tmp_path, housekeeper=housekeeping).started(3)
        world.free = 600
        world.run(200)
        assert housekeeping.asked.count("room 1200") == 1
        assert world.supervisor.is_recording
        world.free = 400
        world.run(2)
        assert world.heartbeat()["state"] == "paused"

    def test_a_pause_that_a_stop_ends_is_noted(self, tmp_path: Path) -> None:
        world, housekeeping = self.world(tmp_path)
        world.free = 900
        paused = world.wall
        world.run(30)
        assert housekeeping.restarts == []
        world.supervisor.stop()
        [(since, how)] = housekeeping.restarts
        assert how == "paused"
        assert 0 <= since - paused <= NS_PER_S

    def test_it_resumes_by_itself_when_more_than_that_is_free(self, tmp_path: Path) -> None:
        world, housekeeping = self.world(tmp_path)
        world.free = 900
        paused = world.wall
        world.run(3)
        world.free = 1100
        world.run(10)
        assert world.running == []
        world.free = 1200
        world.run(3)
        assert len(world.running) == 1
        assert world.heartbeat()["state"] == "recording"
        [(since, how)] = housekeeping.restarts
        assert how == "paused"
        assert 0 <= since - paused <= 2 * NS_PER_S

    def test_what_is_free_and_cannot_be_measured_is_no_full_disk(self, tmp_path: Path) -> None:
        world = World(tmp_path).started(3)
        world.free = 900
        world.unmeasurable_after = 1
        with capture_logs() as logs:
            world.run(3)
        assert len(events(logs, "free_space_unknown")) == 1
        assert world.supervisor.is_recording
        assert events(logs, "recording_paused") == []

    def test_while_it_pauses_room_is_asked_for_again_now_and_then(self, tmp_path: Path) -> None:
        world, housekeeping = self.world(tmp_path)
        world.free = 900
        world.run(200)
        assert 3 <= housekeeping.asked.count("room 1200") <= 5

    def test_pausing_in_a_handover_loses_and_doubles_nothing(self, tmp_path: Path) -> None:
        housekeeping = PlayedHousekeeper()
        world = World(tmp_path, housekeeper=housekeeping, session_duration_s=20).started(22.25)
        world.free = 900
        world.run(3)
        assert world.running == []
        assert_each_counts_once(world)

    def test_a_split_that_stays_empty_is_reported(self, tmp_path: Path) -> None:
        world = World(tmp_path).started(8)
        world.disk_full = True
        with capture_logs() as logs:
            world.run(30)
        reported = events(logs, "split_empty")
        assert len(reported) >= 2
        assert len({each["reason"] for each in reported}) == len(reported)


class TestUnmounted:
    """The disk is unmounted: its recordings are not there, and an empty directory is."""

    @staticmethod
    def unmounted(world: World) -> Path:
        aside = world.bag_dir.with_name("aside")
        world.bag_dir.rename(aside)
        world.bag_dir.mkdir()
        world.device = 2
        return aside

    @staticmethod
    def mounted(world: World, aside: Path) -> None:
        shutil.rmtree(world.bag_dir)
        aside.rename(world.bag_dir)
        world.device = 1

    def test_nothing_is_recorded_onto_another_disk_and_that_is_reported(
        self, tmp_path: Path
    ) -> None:
        housekeeping = PlayedHousekeeper()
        world = World(tmp_path / "bags", housekeeper=housekeeping).started(3)
        self.unmounted(world)
        assert len(world.logged(200, "disk_gone")) == 1
        assert world.running == []
        assert len(world.recorders) == 1
        assert housekeeping.asked == ["apply"]
        world.supervisor.stop()
        assert list(world.bag_dir.iterdir()) == []

    def test_it_goes_on_by_itself_when_the_disk_is_back(self, tmp_path: Path) -> None:
        housekeeping = PlayedHousekeeper()
        world = World(tmp_path / "bags", housekeeper=housekeeping).started(3)
        aside = self.unmounted(world)
        world.run(20)
        self.mounted(world, aside)
        with capture_logs() as logs:
            world.run(0.5)
            assert len(world.recorders) == 1
            world.run(5)
        assert len(events(logs, "disk_back")) == 1
        assert world.supervisor.is_recording
        beat = world.heartbeat()
        assert beat["state"] == "recording"
        assert "has been unmounted" in beat["last_error"]
        assert [how for _, how in housekeeping.restarts] == ["paused"]

    def test_what_was_lost_when_it_went_is_written_down_once_it_is_back(
        self, tmp_path: Path
    ) -> None:
        bag_dir = tmp_path / "bags"
        world = World(bag_dir, housekeeper=keeper_of(bag_dir)).started(3)
        world.recorders[0].ends_with = -9
        aside = self.unmounted(world)
        world.run(0.25)
        world.orders.reception.lost(world.recorders[0].directory.name, "/door", 3)
        world.run(20)
        assert list(bag_dir.iterdir()) == []
        self.mounted(world, aside)
        world.run(20)
        lost = [(loss.topic, loss.lost, loss.by) for loss in read_losses(bag_dir, MIN_NS, MAX_NS)]
        assert lost == [("*", 0, "hung"), ("*", 0, "paused"), ("/door", 3, "rosbag2")]

    def test_one_that_comes_and_goes_is_waited_for_longer_each_time(self, tmp_path: Path) -> None:
        world = World(tmp_path / "bags").started(3)
        for _ in range(5):
            aside = self.unmounted(world)
            world.run(1)
            self.mounted(world, aside)
            world.run(1)
        world.run(10)
        assert len(world.recorders) <= 3


class TestHouse:
    def test_so_is_what_failed_in_the_background(self, tmp_path: Path) -> None:
        world = World(tmp_path).started(3)
        lost = tmp_path / LOST_FILE
        lost.mkdir()
        name = world.recorders[0].directory.name
        world.orders.reception.lost(name, "/door", 3)
        [reported] = world.logged(5, "housekeeping_failed")
        assert (reported["task"], "losses" in reported["reason"]) == ("reception", True)
        assert world.heartbeat()["last_error"] == reported["reason"]
        lost.rmdir()
        world.run(15)
        assert [loss.lost for loss in read_losses(tmp_path, MIN_NS, MAX_NS)] == [3]

    def test_it_is_kept_at_the_start_and_now_and_then_when_nothing_comes(
        self, tmp_path: Path
    ) -> None:
        housekeeping = PlayedHousekeeper()
        World(tmp_path, housekeeper=housekeeping, silent=True).started(130)
        assert housekeeping.asked.count("apply") == 3


class TestSlowDisk:
    def test_a_recorder_that_waits_for_it_is_no_dead_one_to_the_service_manager(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Each flush takes 5 s; after 90 s without a sign of life it would be killed."""
        signs = [1_000.0]
        world = World(
            tmp_path,
            session_duration_s=20,
            keep_alive=lambda: signs.append(world.mono),
            background=Background(),
        )

        def flush(_: int) -> None:
            if threading.current_thread() is threading.main_thread():
                world.mono += 5.0
                world.wall += 5 * NS_PER_S

        monkeypatch.setattr(os, "fsync", flush)
        world.started(30)
        assert len(world.recorders) > 2
        assert max(after - before for before, after in pairwise(signs)) < 45.0


def test_a_bag_directory_that_is_a_file_is_called_one(tmp_path: Path) -> None:
    (tmp_path / "bags").touch()
    with pytest.raises(RecorderError, match="is a file, or lies below one, and not a directory"):
        make_bag_dir(tmp_path / "bags")
