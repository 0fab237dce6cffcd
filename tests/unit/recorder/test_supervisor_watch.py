"""What the supervisor notices and tells: silence, lost directories, words of the recorder."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from ros2_memory.bag_dir.handover_file import read_handover
from ros2_memory.bag_dir.state_files import read_losses
from ros2_memory.core.timebase import MAX_NS, MIN_NS
from ros2_memory.recorder.sessions import Required
from tests.support.simulated_recorders import (
    PlayedHousekeeper,
    World,
    assert_what_stands_counts_once,
    events,
)

pytestmark = pytest.mark.usefixtures("no_flushing")

UNKNOWN = "[WARN] [1.0] [rosbag2_recorder]: Topic '/arm' has unknown type 'arm_msgs/msg/Arm' ."


class TestWatch:
    def test_a_robot_that_falls_silent_has_its_last_split_closed_once(self, tmp_path: Path) -> None:
        world = World(tmp_path).started(18)
        world.silent = True
        [reported] = world.logged(300, "no_growth")
        assert world.heartbeat()["last_error"] == reported["reason"]
        assert len(world.recorders) == 2
        assert world.recorders[0].status == 0
        world.silent = False
        world.run(20)
        world.silent = True
        world.run(100)
        assert len(world.recorders) == 3
        world.supervisor.stop()
        assert_what_stands_counts_once(world)

    def test_a_directory_that_vanished_is_reported_and_recording_goes_on_elsewhere(
        self, tmp_path: Path
    ) -> None:
        world = World(tmp_path).started(8)
        shutil.rmtree(world.recorders[0].directory)
        assert len(world.logged(4, "recording_vanished")) == 1
        assert [recorder.status for recorder in world.recorders] == [0, None]
        assert world.supervisor.is_recording

    @pytest.mark.parametrize("loser", ["old", "new"])
    def test_a_directory_that_vanished_in_a_handover_leaves_the_other(
        self, tmp_path: Path, loser: str
    ) -> None:
        world = World(tmp_path, session_duration_s=20).started(22)
        old, new = world.recorders
        shutil.rmtree((old if loser == "old" else new).directory)
        world.run(2)
        kept = new if loser == "old" else old
        assert kept.status is None
        assert not read_handover(kept.directory).handover.hides_all
        world.run(20)
        world.supervisor.stop()
        assert_what_stands_counts_once(world)

    def test_a_warning_that_repeats_is_reported_once_for_each_topic(self, tmp_path: Path) -> None:
        world = World(tmp_path).started(2)
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

    def test_a_refused_publisher_is_reported_with_what_it_means(self, tmp_path: Path) -> None:
        world = World(tmp_path).started(2)
        world.recorders[0].lines.append(
            "[WARN] [1.5] [rosbag2_recorder]: A new publisher for subscribed topic /scan was found "
            "offering RMW_QOS_POLICY_RELIABILITY_BEST_EFFORT, but rosbag already subscribed"
        )
        [reported] = world.logged(3, "qos_refused")
        assert str(reported["reason"]).startswith(
            "/scan: messages of this publisher are not recorded"
        )
        assert world.heartbeat()["last_error"] == reported["reason"]

    @pytest.mark.parametrize(("topic", "found"), [("/door", {"refused"}), ("/other", set())])
    def test_what_comes_of_another_type_than_subscribed_is_noted_as_missing(
        self, tmp_path: Path, topic: str, found: set[str]
    ) -> None:
        """No QoS would fit it, and no new recording subscribes to it while the old one has it."""
        world = World(tmp_path)
        world.before_start = lambda directory: world.orders.reception.overrides(directory.name)
        world.started(6)
        world.recorders[0].lines.append(
            f"[ERROR] [1.5] [ROSBAG2_TRANSPORT]: Topic '{topic}' has more than one type "
            "associated. Only topics with one type are supported"
        )
        world.run(40)
        assert len(world.recorders) == 1
        losses = read_losses(tmp_path, MIN_NS, MAX_NS)
        assert {loss.by for loss in losses if loss.topic == topic} == found


class TestHeartbeat:
    def test_one_that_cannot_be_written_is_reported_once_and_recording_goes_on(
        self, tmp_path: Path
    ) -> None:
        world = World(tmp_path).started(2)
        (tmp_path / ".recorder.json.tmp").mkdir()
        assert len(world.logged(20, "heartbeat_not_written")) == 1
        assert world.supervisor.is_recording

    def test_bytes_count_recordings_that_ended_too(self, tmp_path: Path) -> None:
        world = World(tmp_path, session_duration_s=20).started()
        sizes = []
        for _ in range(12):
            world.run(5)
            sizes.append(world.heartbeat()["bytes_written"])
        assert sizes == sorted(sizes, key=lambda size: int(str(size)))
        on_disk = sum(path.stat().st_size for path in tmp_path.glob("*/*.mcap"))
        assert abs(int(str(sizes[-1])) - on_disk) < 20_000
        assert world.heartbeat()["interval_s"] == 5.0


class TestOffers:
    def test_a_topic_that_nobody_offers_is_named_once(self, tmp_path: Path) -> None:
        world = World(tmp_path, expected=("/bumper", "/lidar")).started()
        with capture_logs() as logs:
            world.run(29)
            assert not events(logs, "topic_not_offered")
            world.run(60)
        assert [each["topics"] for each in events(logs, "topic_not_offered")] == [["/lidar"]]

    def test_nodes_that_have_gone_are_reported_until_they_come_back(self, tmp_path: Path) -> None:
        world = World(tmp_path, subscribe_timeout_s=6).started(12)
        world.silent, world.defaults = True, {"topics": ()}
        [said] = world.logged(90, "topic_silent")
        assert said["topics"] == ["/bumper", "/door"]
        assert world.heartbeat()["silent"] == ["/bumper", "/door"]


class TestWaiting:
    def test_a_recorder_that_never_received_anything_says_what_it_waits_for(
        self, tmp_path: Path
    ) -> None:
        world = World(tmp_path, advice=lambda: "look at the network", silent=True).started(29)
        assert world.heartbeat()["state"] == "recording"
        [reported] = world.logged(30, "recording_waits")
        beat = world.heartbeat()
        assert beat["state"] == "waiting"
        assert beat["waiting_for"] == reported["reason"]
        assert "2 topics are subscribed to; look at the network" in beat["waiting_for"]
        world.silent = False
        world.run(10)
        assert (world.heartbeat()["state"], world.heartbeat()["waiting_for"]) == ("recording", None)

    def test_a_recording_of_long_splits_waits_for_one_of_them(self, tmp_path: Path) -> None:
        world = World(tmp_path, split_duration_s=60, silent=True).started(58)
        assert world.heartbeat()["state"] == "recording"
        world.run(10)
        assert world.heartbeat()["state"] == "waiting"

    @pytest.mark.parametrize(
        ("simulated", "topics", "heard", "expected"),
        [
            (True, ("/odom",), (), "/clock"),
            (False, (), (), "no publisher offers any of the listed topics"),
            # The recorder's own log is no sign of the robot.
            (False, ("/rosout",), ("/rosout",), "no publisher offers any of the listed topics"),
        ],
    )
    def test_simulated_time_and_a_wrong_domain_are_told_apart(
        self,
        tmp_path: Path,
        simulated: bool,
        topics: tuple[str, ...],
        heard: tuple[str, ...],
        expected: str,
    ) -> None:
        how = {"topics": topics, "heard": heard}
        world = World(
            tmp_path, expected=("/rosout", "/odom"), simulated=simulated, defaults=how
        ).started(40)
        assert world.heartbeat()["state"] == "waiting"
        assert expected in world.heartbeat()["waiting_for"]


def test_every_topic_that_may_be_of_an_unknown_type_is_named(tmp_path: Path) -> None:
    world = World(tmp_path, expected=("/bumper", "/door", "/grip", "/arm")).started(2)
    world.recorders[0].lines.append(UNKNOWN)
    [reported] = world.logged(30, "topics_not_recorded")
    assert "not recorded: /arm;" in reported["reason"]
    assert "of those that a glob selects, others of the same type" in reported["reason"]
    assert reported["reason"].endswith("nor these, if anybody offers them: /grip")


def test_a_topic_of_an_unknown_type_that_is_dropped_is_no_fault(tmp_path: Path) -> None:
    world = World(tmp_path / "bags", expected=("/bumper", "/door", "/arm", "/never")).started(2)
    world.recorders[0].lines.append(UNKNOWN)
    world.run(20)
    world.topics_path.write_text("topics: [/bumper, /door]\n")
    with capture_logs() as logs:
        world.run(15)
    assert events(logs, "topics_changed")
    assert not events(logs, "topics_not_recorded")


def test_what_is_said_of_a_topic_is_not_why_a_recorder_died(tmp_path: Path) -> None:
    world = World(tmp_path, expected=("/bumper", "/door", "/arm"))
    world.defaults["lines"] = [UNKNOWN]
    world.started(20)
    assert "/arm" in str(world.heartbeat()["last_error"])
    world.recorders[0].die(-9)
    world.run(20)
    assert len(world.recorders) == 2
    assert world.heartbeat()["last_error"] == "ros2 bag record was killed (SIGKILL)"
    assert world.heartbeat()["unknown_types"] == ["/arm"]


class TestShortfall:
    """Topics that are offered and not recorded, as the heartbeat has them."""

    def test_a_topic_that_is_offered_and_never_comes_is_named_with_advice(
        self, tmp_path: Path
    ) -> None:
        world = World(
            tmp_path,
            session_duration_s=20,
            advice=lambda: "look at the users",
            defaults={"heard": ("/bumper",)},
        ).started(25)
        assert world.heartbeat()["unheard"] == []
        with capture_logs() as logs:
            world.run(60)
        beat = world.heartbeat()
        assert (beat["state"], beat["unheard"]) == ("recording", ["/door"])
        assert beat["advice"] == "look at the users"
        assert [each["topics"] for each in events(logs, "topics_unheard")] == [["/door"]]
        world.running[-1].heard = ("/bumper", "/door")
        world.run(15)
        assert (world.heartbeat()["unheard"], world.heartbeat()["advice"]) == ([], None)

    def test_services_and_actions_may_be_unused(self, tmp_path: Path) -> None:
        world = World(tmp_path)
        world.defaults |= {"topics": ("/bumper", "/go/_action/feedback"), "heard": ("/bumper",)}
        world.started(60)
        assert world.heartbeat()["unheard"] == []

    @pytest.mark.parametrize("still", [("/bumper",), ()])
    def test_a_regular_topic_that_stops_is_silent_until_it_comes(
        self, tmp_path: Path, still: tuple[str, ...]
    ) -> None:
        world = World(tmp_path).started(60)
        assert world.heartbeat()["fell_silent"] == []
        world.running[-1].heard = still
        world.defaults["heard"] = still
        world.run(30)
        stopped = sorted({"/bumper", "/door"} - {*still})
        assert world.heartbeat()["fell_silent"] == stopped
        world.run(60)
        assert world.heartbeat()["fell_silent"] == stopped
        for recorder in world.running:
            recorder.heard = ("/bumper", "/door")
        world.run(20)
        assert world.heartbeat()["fell_silent"] == []

    def test_a_slow_topic_that_is_written_with_its_split_is_not_silent(
        self, tmp_path: Path
    ) -> None:
        world = World(
            tmp_path,
            split_duration_s=10,
            required=[Required("/bumper", 3.5)],
            defaults={"buffers": True},
        ).started(60)
        for _ in range(60):
            world.run(1)
            beat = world.heartbeat()
            assert (beat["fell_silent"], beat["unheard"], beat["required_missing"]) == ([], [], [])

    def test_required_topics_are_missed_by_name_and_rate(self, tmp_path: Path) -> None:
        required = [Required("/bumper", 3.0), Required("/d*", 5.0), Required("/never")]
        world = World(tmp_path, required=required).started(20)
        assert world.heartbeat()["required_missing"] == []
        world.run(40)
        rate, never = world.heartbeat()["required_missing"]
        assert rate.startswith("/door: 4")
        assert rate.endswith("Hz, and 5 are required")
        assert never == "/never: no publisher offers it"
        world.running[-1].heard = ("/door",)
        world.run(30)
        assert world.heartbeat()["required_missing"][0].startswith("/bumper: it came regularly")

    def test_a_child_that_lives_and_writes_nothing_is_replaced_once(self, tmp_path: Path) -> None:
        world = World(tmp_path, defaults={"deaf": True}).started(10)
        world.defaults["deaf"] = False
        world.run(40)
        assert [each.deaf for each in world.running] == [False]
        assert world.heartbeat()["state"] == "recording"

    def test_a_robot_that_says_nothing_is_not_asked_again_and_again(self, tmp_path: Path) -> None:
        world = World(tmp_path, silent=True).started(300)
        assert len(world.recorders) == 2


class TestChangedList:
    def test_a_changed_list_begins_a_recording_and_loses_nothing(self, tmp_path: Path) -> None:
        world = World(tmp_path / "bags", expected=("/bumper", "/door")).started(20)
        world.defaults |= {"topics": ("/bumper", "/lidar"), "heard": ("/bumper", "/lidar")}
        world.topics_path.write_text("topics: [/bumper, /lidar]\n")
        with capture_logs() as logs:
            world.run(15)
        [changed] = events(logs, "topics_changed")
        assert changed["added"] == ["/lidar"]
        assert "/door" in changed["dropped"]
        assert not events(logs, "rotated_without")
        beat = world.heartbeat()
        assert (beat["listed"], beat["subscribed"]) == (["/bumper", "/lidar"],) * 2
        assert (len(world.recorders), beat["missing"], beat["silent"]) == (2, [], [])
        world.run(60)
        assert world.heartbeat()["fell_silent"] == []
        assert len(world.recorders) == 2
        world.supervisor.stop()
        assert_what_stands_counts_once(world)

    def test_a_refused_list_changes_nothing_and_is_named(self, tmp_path: Path) -> None:
        world = World(tmp_path / "bags", expected=("/bumper", "/door")).started(20)
        before = world.heartbeat()["listed"]
        world.topics_path.write_text("topics: [no slash]\n")
        [refused] = world.logged(30, "topics_refused")
        beat = world.heartbeat()
        assert beat["list_refused"] == refused["reason"] == beat["last_error"]
        assert "'no slash' cannot be recorded" in beat["list_refused"]
        assert (beat["listed"], beat["recovered"], len(world.recorders)) == (before, False, 1)
        world.topics_path.write_text("topics: [/bumper, /door]\n")
        world.run(20)
        beat = world.heartbeat()
        assert (beat["list_refused"], beat["listed"]) == (None, ["/bumper", "/door"])

    def test_a_file_that_is_touched_or_written_in_steps_is_no_change(self, tmp_path: Path) -> None:
        world = World(tmp_path / "bags", expected=("/bumper",))
        whole = world.topics_path.read_text()
        world.started(20)
        world.topics_path.write_text("topics:\n")
        world.run(1.5)
        world.topics_path.write_text(whole)
        world.run(20)
        assert (len(world.recorders), world.heartbeat()["last_error"]) == (1, None)


def test_topics_that_nobody_has_offered_are_named_once_a_recorder_has_looked(
    tmp_path: Path,
) -> None:
    world = World(
        tmp_path, expected=("/odom", "/gone", "/bumper"), defaults={"topics": ("/bumper",)}
    ).started()
    assert world.heartbeat()["missing"] == []
    world.run(7)
    assert world.heartbeat()["missing"] == ["/gone", "/odom"]
    world.defaults["topics"] = ("/odom",)
    world.running[0].die()
    world.run(10)
    assert world.heartbeat()["missing"] == ["/gone"]


def test_an_error_has_its_time_and_is_past_once_recording_goes_on(tmp_path: Path) -> None:
    world = World(tmp_path).started(20)
    world.running[0].die()
    world.run(0.25)
    beat = world.heartbeat()
    assert (beat["state"], beat["recordings"]) == ("starting", [])
    assert "was killed" in beat["last_error"]
    assert (beat["last_error_at"], beat["recovered"]) == (world.wall, False)
    world.run(20)
    later = world.heartbeat()
    assert (later["last_error"], later["recovered"]) == (beat["last_error"], True)
    assert later["last_error_at"] == beat["last_error_at"]


def test_an_error_that_lasts_is_not_past(tmp_path: Path) -> None:
    housekeeper = PlayedHousekeeper()
    world = World(tmp_path, housekeeper=housekeeper).started()
    housekeeper.failed = {"apply": "the list cannot be read"}
    world.run(30)
    assert (world.heartbeat()["last_error"], world.heartbeat()["recovered"]) == (
        "the list cannot be read",
        False,
    )
    housekeeper.failed = {}
    world.run(10)
    assert world.heartbeat()["recovered"] is True
