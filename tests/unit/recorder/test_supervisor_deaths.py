"""What the supervisor does when a recorder dies, or the disk fails it."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from structlog.testing import capture_logs

from ros2_memory.bag_dir import durable_write, handover_file
from ros2_memory.bag_dir.handover_file import read_handover
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.recorder import sessions
from tests.support.fakes import failing
from tests.support.simulated_recorders import (
    PlayedHousekeeper,
    World,
    assert_each_counts_once,
    assert_what_stands_counts_once,
    events,
)

pytestmark = pytest.mark.usefixtures("no_flushing")


class TestDeath:
    def test_waits_grow_until_a_good_split_was_written(self, tmp_path: Path) -> None:
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

    def test_it_is_reported_with_its_last_words(self, tmp_path: Path) -> None:
        world = World(tmp_path).started(2)
        world.recorders[0].lines.append("terminate called after throwing")
        world.recorders[0].die(-6)
        [died] = world.logged(3, "recorder_died")
        assert died["log_level"] == "error"
        assert "was killed (SIGABRT)" in str(died["reason"])
        assert "terminate called" in str(died["reason"])
        assert world.heartbeat()["last_error"] == died["reason"]

    def test_one_that_hangs_and_must_be_killed_counts_as_a_restart(self, tmp_path: Path) -> None:
        house = PlayedHousekeeper()
        world = World(tmp_path, housekeeper=house).started(12)
        hung = world.recorders[0]
        hung.deaf, hung.ends_with = True, -9
        stopped = world.wall
        assert len(world.logged(40, "recorder_hung")) == 1
        assert world.heartbeat()["restarts"] == 1
        [(first, how)] = house.restarts
        assert how == "hung"
        assert stopped - 6 * NS_PER_S < first <= stopped + NS_PER_S

    def test_one_that_does_not_begin_is_given_up_and_another_is_started(
        self, tmp_path: Path
    ) -> None:
        world = World(tmp_path, defaults={"ready_s": 10**9, "subscribe_s": 10**9}).started()
        with capture_logs() as logs:
            world.run(119)
            assert len(world.recorders) == 1
            world.run(4)
        assert [recorder.status for recorder in world.recorders] == [0, None]
        assert len(events(logs, "recorder_not_ready")) == 1
        assert world.heartbeat()["restarts"] == 1

    def test_what_never_held_a_byte_leaves_no_directory(self, tmp_path: Path) -> None:
        world = World(tmp_path)
        world.disk_full = True
        world.started(0.5)
        world.recorders[0].die()
        world.run(0.5)
        assert not world.recorders[0].directory.exists()

    def test_a_new_one_that_dies_in_a_handover_counts_for_nothing(self, tmp_path: Path) -> None:
        world = World(tmp_path, session_duration_s=20).started(22.5)
        old, new = world.recorders
        new.die()
        with capture_logs() as logs:
            world.run(1)
        assert (len(events(logs, "recorder_died")), events(logs, "recorder_hung")) == (1, [])
        assert world.heartbeat()["restarts"] == 1
        assert old.status is None
        assert read_handover(new.directory).handover.hides_all
        assert read_handover(old.directory).handover.next is None
        world.run(15)
        world.supervisor.stop()
        assert len(world.recorders) == 3
        assert_each_counts_once(world)

    @pytest.mark.parametrize("after_s", [21.25, 21.75, 24.0, 26.0])
    def test_an_old_one_that_dies_in_a_handover_counts_as_far_as_it_reaches(
        self, tmp_path: Path, after_s: float
    ) -> None:
        world = World(tmp_path, session_duration_s=20).started(after_s)
        old, new = world.recorders
        old.die()
        world.run(12)
        assert new.status is None
        assert world.supervisor.is_recording
        world.supervisor.stop()
        assert_what_stands_counts_once(world)

    @pytest.mark.parametrize("after_s", [20.5, 21.0, 21.75, 24.0, 26.25, 26.75, 27.0])
    def test_after_a_crash_of_everything_the_next_start_settles_the_handover(
        self, tmp_path: Path, after_s: float
    ) -> None:
        world = World(tmp_path, session_duration_s=20).started(after_s)
        for recorder in world.running:
            recorder.die()
        World(tmp_path).started(0.25)
        assert_what_stands_counts_once(world)

    def test_where_the_disk_does_not_list_what_is_there_it_is_settled_later(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        world = World(tmp_path, session_duration_s=20).started(24)
        for recorder in world.running:
            recorder.die()
        again = World(tmp_path)
        again.wall = world.wall + NS_PER_S
        with monkeypatch.context() as patch, capture_logs() as logs:
            failing = Mock(side_effect=OSError(errno.EIO, "Input/output error"))
            patch.setattr(sessions, "unsettled_handovers", failing)
            again.started(3)
        assert again.supervisor.is_recording
        assert [each["task"] for each in events(logs, "supervision_failed")] == ["settle"]
        again.run(60)
        again.supervisor.stop()
        assert_what_stands_counts_once(world)


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
        world = World(tmp_path).started(3)
        world.recorders[0].die()
        known = [recorder.directory for recorder in world.recorders]
        disk = FailingDisk(
            monkeypatch, lambda path: path.name.startswith("rec_") and path not in known
        )
        assert "Input/output error" in world.logged(3, "recorder_not_started")[0]["reason"]
        assert "Input/output error" in world.heartbeat()["last_error"]
        disk.failing = False
        world.run(10)
        assert world.supervisor.is_recording

    def test_a_handover_is_given_up_where_the_new_directory_cannot_be_found_out(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        world = World(tmp_path, session_duration_s=20).started(20.75)
        old, new = world.recorders
        new.die()
        FailingDisk(monkeypatch, lambda path: path == new.directory)
        assert "Input/output error" in world.logged(1, "rotation_failed")[0]["reason"]
        assert world.running == [old]

    @pytest.mark.parametrize("refused_s", [0.5, 30])
    def test_one_that_is_given_up_counts_not_though_its_sidecar_was_refused_at_first(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused_s: float
    ) -> None:
        """It takes its time to end, and records meanwhile."""
        world = World(tmp_path, session_duration_s=20, defaults={"obeys_after": 20}).started(20)
        with monkeypatch.context() as full:
            full.setattr(handover_file, "write_all_durably", failing(errno.ENOSPC))
            [reported, *_] = world.logged(refused_s, "rotation_failed")
        assert "No space left on device" in reported["reason"]
        world.run(40)
        world.supervisor.stop()
        assert len(world.recorders) > 2
        assert_each_counts_once(world)

    def test_a_rotation_that_was_noted_and_not_flushed_is_tried_again(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        world = World(tmp_path, session_duration_s=20).started(19)
        with monkeypatch.context() as failing_disk:
            failing_disk.setattr(durable_write, "flush", failing(errno.EIO))
            assert world.logged(3, "rotation_failed")
        assert len(world.recorders) == 1
        world.run(20)
        world.supervisor.stop()
        assert len(world.recorders) == 2
        assert_each_counts_once(world)

    def test_a_recorder_that_dies_is_replaced_though_its_splits_cannot_be_read(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        world = World(tmp_path).started(3)

        monkeypatch.setattr(world.reader, "closing", failing(errno.ESTALE))
        world.recorders[0].die()
        with capture_logs() as logs:
            world.run(6)
        assert len(world.running) == 1
        assert "Stale file handle" in events(logs, "unreadable")[0]["reason"]

    def test_one_task_that_fails_keeps_no_other_from_being_done(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        keeper = PlayedHousekeeper()
        world = World(tmp_path, housekeeper=keeper).started(3)

        monkeypatch.setattr(world.recorders[0], "take_lines", failing(errno.EIO))
        [reported] = world.logged(30, "supervision_failed")
        assert (reported["task"], reported["reason"]) == ("look", "[Errno 5] Input/output error")
        world.run(40)
        assert "apply" in keeper.asked
