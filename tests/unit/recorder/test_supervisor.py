"""What the supervisor does as time passes: no process runs, no second is waited for."""

from __future__ import annotations

from pathlib import Path

import pytest
from structlog.testing import capture_logs

from ros2_memory.bag_dir.handover_file import read_handover
from ros2_memory.core.errors import RecorderError
from ros2_memory.core.timebase import NS_PER_S
from tests.support.simulated_recorders import (
    World,
    assert_each_counts_once,
    assert_what_stands_counts_once,
    events,
)

pytestmark = pytest.mark.usefixtures("no_flushing")


class TestStart:
    def test_it_records_once_the_recorder_reports_it(self, tmp_path: Path) -> None:
        world = World(tmp_path).started()
        assert world.heartbeat()["state"] == "starting"
        world.run(3)
        assert world.supervisor.is_recording
        beat = world.heartbeat()
        assert beat["state"] == "recording"
        assert beat["subscribed"] == ["/bumper", "/door"]

    def test_one_whose_words_for_it_are_not_known_records_once_it_subscribes(
        self, tmp_path: Path
    ) -> None:
        world = World(tmp_path, defaults={"ready_s": 10**9}).started(130)
        assert world.supervisor.is_recording
        assert len(world.recorders) == 1

    def test_one_that_cannot_begin_leaves_the_reason_and_nothing_that_looks_begun(
        self, tmp_path: Path
    ) -> None:
        world = World(tmp_path)
        world.refuse = "no more processes"
        with pytest.raises(RecorderError, match="no more processes"):
            world.supervisor.start()
        beat = world.heartbeat()
        assert (beat["state"], beat["recordings"], beat["last_error"]) == (
            "stopped",
            [],
            "no more processes",
        )


class TestRotation:
    @pytest.mark.parametrize(("age_s", "recordings"), [(599.9, 1), (600.0, 2)])
    def test_a_session_is_over_when_it_has_lasted_for_its_duration(
        self, tmp_path: Path, age_s: float, recordings: int
    ) -> None:
        # Splits so long that a jump in time is no silence.
        world = World(tmp_path, split_duration_s=600, session_duration_s=600)
        began_s = world.mono
        world.started(5)
        world.wall += round((began_s + age_s - world.mono) * NS_PER_S)
        world.mono = began_s + age_s
        world.supervisor.tick()
        assert len(world.recorders) == recordings

    def test_no_message_is_lost_or_counts_twice(self, tmp_path: Path) -> None:
        world = World(tmp_path, session_duration_s=20).started(75)
        world.supervisor.stop()
        assert (len(world.recorders), world.heartbeat()["restarts"]) == (4, 0)
        assert sum(world.published(counting=False).values()) > len(world.published(counting=False))
        assert_each_counts_once(world)

    def test_a_topic_that_appears_while_both_record_is_waited_for_again(
        self, tmp_path: Path
    ) -> None:
        world = World(tmp_path, session_duration_s=20).started(24)
        old, new = world.recorders
        for recorder in (old, new):
            recorder.lines.append("[INFO] [1.0] [rosbag2_recorder]: Subscribed to topic '/late'")
            world.run(2)
        world.run(2.5)
        assert old.asked_to_end == 0
        world.run(3)
        assert old.status == 0

    def test_what_the_new_one_does_not_receive_for_4_s_counts_in_the_old_one(
        self, tmp_path: Path
    ) -> None:
        """Publishers on a busy machine discover who has subscribed seconds later."""
        world = World(tmp_path, session_duration_s=20).started(20.5)
        _, new = world.recorders
        new.deaf = True
        world.run(4)
        new.deaf = False
        world.run(12)
        world.supervisor.stop()
        assert_each_counts_once(world)

    def test_a_topic_that_went_away_does_not_hold_it_up_for_ever(self, tmp_path: Path) -> None:
        world = World(tmp_path, session_duration_s=20, subscribe_timeout_s=6).started(19)
        world.defaults = {"topics": ("/bumper",)}
        [said] = world.logged(12.25, "rotated_without")
        assert world.recorders[0].status == 0
        assert "does not subscribe to /door yet" in str(said["reason"])
        assert world.heartbeat()["last_error"] is None
        world.supervisor.stop()
        assert_each_counts_once(world)

    def test_a_split_that_the_old_one_opens_while_it_ends_is_in_its_sidecar(
        self, tmp_path: Path
    ) -> None:
        world = World(tmp_path, session_duration_s=20).started()
        world.recorders[0].obeys_after = 40
        world.run(40)
        old = read_handover(world.recorders[0].directory).handover
        assert old.end is not None
        last = f"{world.recorders[0].directory.name}_{world.recorders[0].splits}.mcap"
        assert last in old.end.files
        world.supervisor.stop()
        assert_each_counts_once(world)

    def test_a_rotation_that_cannot_begin_is_tried_again(self, tmp_path: Path) -> None:
        world = World(tmp_path, session_duration_s=20).started(19)
        world.refuse = "no more processes"
        world.run(4)
        assert read_handover(world.recorders[0].directory).handover.next is None
        world.refuse = ""
        world.run(12)
        world.supervisor.stop()
        assert len(world.recorders) == 2
        assert_each_counts_once(world)


class TestStop:
    @pytest.mark.parametrize("is_deaf", [False, True])
    @pytest.mark.parametrize("after_s", [10.0, 20.5, 21.25, 21.75, 22.5, 23.75, 24.5, 26.0, 26.5])
    def test_at_any_moment_of_a_handover_nothing_is_lost_or_counts_twice(
        self, tmp_path: Path, after_s: float, is_deaf: bool
    ) -> None:
        """Nor is anything hidden that the new one alone has."""
        world = World(tmp_path, session_duration_s=20).started(after_s - 0.5)
        world.recorders[0].deaf = is_deaf
        world.run(0.5)
        world.supervisor.stop()
        assert world.running == []
        (assert_what_stands_counts_once if is_deaf else assert_each_counts_once)(world)

    def test_a_process_that_nothing_ends_is_named(self, tmp_path: Path) -> None:
        world = World(tmp_path, defaults={"obeys_after": 10**9, "patience_s": 0.05}).started(2)
        with capture_logs() as logs:
            world.supervisor.stop()
        (said,) = events(logs, "recorder_not_ended")
        assert "process 100" in str(said["reason"])


class TestMessagesOfOneRecordingAlone:
    @pytest.mark.parametrize("which", [0, 1])
    def test_what_one_missed_in_a_rotation_counts_in_the_other(
        self, tmp_path: Path, which: int
    ) -> None:
        world = World(tmp_path, session_duration_s=20).started(21.75)
        world.recorders[which].deaf = True
        world.run(0.75)
        world.recorders[which].deaf = False
        # Compared as soon as the first split of the new one is closed, long before it ends.
        world.run(15)
        assert len(world.running) == 1
        stands = {at for at in world.published(counting=False) if at < world.wall - 7 * NS_PER_S}
        counts = world.published(counting=True)
        assert {at: counts[at] for at in stands} == dict.fromkeys(stands, 1)
        world.supervisor.stop()
        assert_each_counts_once(world)

    @pytest.mark.parametrize("deaf_s", [2, 8, 15])
    def test_what_one_missed_since_long_before_a_rotation_counts_in_the_other(
        self, tmp_path: Path, deaf_s: float
    ) -> None:
        """Some recorders live and write nothing, which is why they are rotated."""
        world = World(tmp_path, session_duration_s=20).started(20 - deaf_s)
        world.recorders[0].deaf = True
        world.run(deaf_s + 15)
        world.supervisor.stop()
        assert_what_stands_counts_once(world)


class TestClock:
    def test_set_back_in_a_handover_the_handover_is_tried_again(self, tmp_path: Path) -> None:
        world = World(tmp_path, session_duration_s=20).started(22)
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

    @pytest.mark.parametrize(("seconds", "recordings"), [(-100, 1), (-121, 2)])
    def test_set_back_by_more_than_two_minutes_a_new_recording_begins(
        self, tmp_path: Path, seconds: int, recordings: int
    ) -> None:
        world = World(tmp_path).started(10)
        world.set_clock(seconds)
        world.run(20)
        assert len(world.recorders) == recordings
        world.supervisor.stop()
        assert_what_stands_counts_once(world)

    def test_set_back_while_nothing_records_no_recording_is_cut_short(self, tmp_path: Path) -> None:
        world = World(tmp_path).started(10)
        world.free = 5
        world.run(3)
        world.set_clock(-3600)
        world.run(3)
        world.free = 10**12
        world.run(30)
        assert len(world.recorders) == 2
        assert len(world.running) == 1
