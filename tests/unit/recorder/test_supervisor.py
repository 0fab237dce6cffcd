"""What the supervisor does and tells as time passes, and what it screens before it is served.

No process runs, no second is waited for.
"""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

import pytest
from structlog.testing import capture_logs

from ros2_memory.bag_dir.handover_file import read_handover
from ros2_memory.bag_dir.layout import SCREENED_FILE, utc_stamp
from ros2_memory.bag_dir.state_files import (
    SCREENED,
    append_deleted,
    deleted_of,
    read_losses,
    read_withheld,
)
from ros2_memory.core.errors import RecorderError
from ros2_memory.core.spans import united
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S
from ros2_memory.recorder import handover
from ros2_memory.recorder.background import Background
from ros2_memory.recorder.policies import ClockReading, SilenceWatch, set_back
from ros2_memory.recorder.process import topics
from ros2_memory.recorder.reception import Reception
from ros2_memory.recorder.sessions import Required
from ros2_memory.storage.mcap.writer import McapWriter
from tests.support.bags import McapLayout
from tests.support.fakes import broken, failing
from tests.support.housekeepers import keeper_of, recording_now
from tests.support.screened_bags import ScreenedBags, off, on, privacy, words
from tests.support.simulated_recorders import (
    TOPICS,
    PlayedHousekeeper,
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
    return World(tmp_path).started(3)


def test_a_recorder_whose_words_for_its_start_are_not_known_records_once_it_subscribes(
    tmp_path: Path,
) -> None:
    world = World(tmp_path, defaults={"ready_s": 10**9}).started(130)
    assert world.supervisor.is_recording
    assert len(world.recorders) == 1


def test_a_recorder_that_cannot_begin_leaves_the_reason_and_nothing_that_looks_begun(
    tmp_path: Path,
) -> None:
    world = World(tmp_path)
    world.refuse = "no more processes"
    with pytest.raises(RecorderError, match="no more processes"):
        world.supervisor.start()
    beat = world.heartbeat()
    left = (beat["state"], beat["recordings"], beat["last_error"])
    assert left == ("stopped", [], "no more processes")


def test_no_recording_has_the_name_of_one_whose_files_were_deleted(tmp_path: Path) -> None:
    world = World(tmp_path)
    name = f"rec_{utc_stamp(world.wall)}"
    append_deleted(tmp_path, [deleted_of(name, [(f"{name}_0.mcap", 1, 2)])])
    assert world.started().heartbeat()["recordings"] == [f"{name}_2"]


def test_a_topic_that_appears_while_both_record_is_waited_for_again(tmp_path: Path) -> None:
    world = rotating(tmp_path, 24)
    old, new = world.recorders
    for recorder in (old, new):
        recorder.lines.append("[INFO] [1.0] [rosbag2_recorder]: Subscribed to topic '/late'")
        world.run(2)
    world.run(2.5)
    assert old.asked_to_end == 0
    world.run(3)
    assert old.status == 0


def test_what_is_excluded_of_latched_topics_is_not_asked_for_by_the_next_recording(
    tmp_path: Path,
) -> None:
    excluded = patch.object(PlayedHousekeeper, "excluded_latched", return_value={"/map"})
    with excluded, patch.object(Reception, "skip_latched") as skipped:
        world = rotating(tmp_path, 25)
        for recorder in world.running:
            recorder.die()
        world.run(3)
    assert [call.args[0] for call in skipped.mock_calls] == [(), {"/map"}, ()]


@patch.object(handover, "SUBSCRIBE_TIMEOUT_S", 6.0)
def test_a_topic_that_went_away_does_not_hold_a_rotation_up_for_ever(tmp_path: Path) -> None:
    world = rotating(tmp_path, 19)
    world.defaults = {"topics": ("/bumper",)}
    [said] = world.logged(12.25, "rotated_without")
    assert world.recorders[0].status == 0
    assert "does not subscribe to /door yet" in said["reason"]
    assert world.heartbeat()["last_error"] is None
    assert_each_counts_once(world)


def test_a_split_that_the_old_recorder_opens_while_it_ends_counts_once(tmp_path: Path) -> None:
    world = rotating(tmp_path, defaults={"obeys_after": 40})
    world.run(40)
    assert_each_counts_once(world)


@pytest.mark.parametrize(
    ("is_deaf", "after_s"),
    [
        *((False, at_s) for at_s in (10.0, 20.5, 21.25, 21.75, 22.5, 23.75, 24.5, 26.0, 26.5)),
        *((True, at_s) for at_s in (21.25, 22.5, 24.5, 26.5)),
    ],
)
def test_a_stop_at_any_moment_of_a_handover_loses_and_doubles_nothing(
    tmp_path: Path, after_s: float, is_deaf: bool
) -> None:
    """Nor is anything hidden that the new one alone has."""
    world = rotating(tmp_path, after_s - 0.5)
    world.recorders[0].deaf = is_deaf
    world.run(0.5)
    world.supervisor.stop()
    assert world.running == []
    (assert_what_stands_counts_once if is_deaf else assert_each_counts_once)(world)


@pytest.mark.parametrize("killed", ["old", "new", "all"])
@pytest.mark.parametrize(
    ("after_s", "obeys_after"),
    [(20.5, 1), (21.25, 8), (22.5, 1), (24.0, 8), (25.0, 1), (26.25, 8), (27.5, 1)],
)
def test_kills_at_any_moment_of_a_handover_lose_and_double_nothing(
    tmp_path: Path, after_s: float, obeys_after: int, killed: str
) -> None:
    """`all`: the daemon, too; what it left is settled by the next one."""
    world = rotating(tmp_path)
    world.recorders[0].obeys_after = obeys_after
    world.run(after_s)
    doomed = world.recorders[:1] if killed == "old" else world.recorders[1:]
    for recorder in world.recorders if killed == "all" else doomed:
        if recorder.status is None:
            recorder.die()
    if killed == "all":
        before, world = world, World(tmp_path)
        world.wall = before.wall
        world.supervisor.start()
    world.run(12)
    assert_what_stands_counts_once(world)


def test_a_process_that_nothing_ends_is_named(world: World) -> None:
    [recorder] = world.recorders
    recorder.obeys_after, recorder.patience_s = 10**9, 0.05
    with capture_logs() as logs:
        world.supervisor.stop()
    (said,) = events(logs, "recorder_not_ended")
    assert "process 100" in said["reason"]


# Publishers on a busy machine discover seconds later who has subscribed.
@pytest.mark.parametrize(
    ("which", "at_s", "deaf_s"), [(0, 21.75, 0.75), (1, 21.75, 0.75), (1, 20.5, 4)]
)
def test_what_one_missed_in_a_rotation_counts_in_the_other(
    tmp_path: Path, which: int, at_s: float, deaf_s: float
) -> None:
    world = rotating(tmp_path, at_s)
    world.recorders[which].deaf = True
    world.run(deaf_s)
    world.recorders[which].deaf = False
    # Compared as soon as the first split of the new one is closed, long before it ends.
    world.run(15)
    assert len(world.running) == 1
    stands = {at for at in world.published(counting=False) if at < world.wall - 7 * NS_PER_S}
    counts = world.published(counting=True)
    assert {counts[at] for at in stands} == {1}
    assert_each_counts_once(world)


def test_a_clock_that_is_set_back_in_a_handover_has_it_tried_again(tmp_path: Path) -> None:
    world = rotating(tmp_path, 22)
    world.set_clock(-5)
    world.run(15)
    world.supervisor.stop()
    first, second, third = (recorder.directory for recorder in world.recorders)
    assert read_handover(second).handover.hides_all
    assert read_handover(first).handover.next == third.name
    # Some seconds were lived twice, and their publish times stand twice in one recording.
    lived_s = round(world.mono - 1_000) - 1
    counts = world.published(counting=True)
    assert set(counts) == set(world.published(counting=False))
    assert sum(counts.values()) == pytest.approx(4 * lived_s, abs=4)


@pytest.mark.parametrize(
    ("steps", "recordings"), [([-100.0], 1), ([-121.0], 2), ([-3600.0, -0.5], 3)]
)
def test_a_clock_that_is_set_back_by_more_than_two_minutes_begins_a_new_recording(
    world: World, steps: list[float], recordings: int
) -> None:
    """Which is tried again where the clock is set back once more meanwhile."""
    world.run(7)
    for seconds in steps:
        world.set_clock(seconds)
        world.run(3)
    world.run(20)
    assert (len(world.recorders), len(world.running)) == (recordings, 1)
    if recordings < 3:
        assert_what_stands_counts_once(world)


def test_a_clock_that_is_set_back_while_nothing_records_cuts_no_recording_short(
    world: World,
) -> None:
    world.run(7)
    world.free = 5
    world.run(3)
    world.set_clock(-3600)
    world.run(3)
    world.free = 10**12
    world.run(30)
    assert len(world.recorders) == 2
    assert len(world.running) == 1


UNKNOWN = "[WARN] [1.0] [rosbag2_recorder]: Topic '/arm' has unknown type 'arm_msgs/msg/Arm' ."
SEVERAL_TYPES = (
    "[ERROR] [1.5] [ROSBAG2_TRANSPORT]: Topic '{}' has more than one type associated. "
    "Only topics with one type are supported"
)


def test_a_robot_that_falls_silent_has_its_last_split_closed_once(world: World) -> None:
    world.run(15)
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
    assert_what_stands_counts_once(world)


def test_a_directory_that_vanished_is_reported_and_recording_goes_on_elsewhere(
    world: World,
) -> None:
    world.run(5)
    shutil.rmtree(world.recorders[0].directory)
    assert len(world.logged(4, "recording_vanished")) == 1
    assert [recorder.status for recorder in world.recorders] == [0, None]
    assert world.supervisor.is_recording


def test_a_split_that_is_deleted_while_its_folder_is_read_is_no_missing_folder(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Retention runs in another thread."""
    world.run(30)
    directory, scandir = world.recorders[0].directory, os.scandir
    first, *_, newest = sorted(directory.glob("*.mcap"))

    @contextmanager
    def listed_before(path: Path) -> Iterator[Iterator[os.DirEntry[str]]]:
        with scandir(path) as entries:
            found = [*entries]
        if path == directory:
            first.unlink(missing_ok=True)
        yield iter(found)

    monkeypatch.setattr(os, "scandir", listed_before)
    assert world.logged(4, "recording_vanished") == []
    assert not first.exists()
    assert newest.exists()
    assert [recorder.status for recorder in world.recorders] == [None]


@pytest.mark.parametrize("loser", ["old", "new"])
def test_a_directory_that_vanished_in_a_handover_leaves_the_other(
    tmp_path: Path, loser: str
) -> None:
    world = rotating(tmp_path, 22)
    old, new = world.recorders
    shutil.rmtree((old if loser == "old" else new).directory)
    world.run(2)
    kept = new if loser == "old" else old
    assert kept.status is None
    assert not read_handover(kept.directory).handover.hides_all
    world.run(20)
    assert_what_stands_counts_once(world)


def test_a_warning_that_repeats_is_reported_once_for_each_topic_with_what_it_means(
    world: World,
) -> None:
    with capture_logs() as logs:
        for _ in range(40):
            world.recorders[0].lines += map(SEVERAL_TYPES.format, ("/cam1", "/cam2"))
            world.run(0.5)
    assert len(events(logs, "several_types")) == 2
    assert "/cam2" in world.heartbeat()["last_error"]
    world.recorders[0].lines.append(
        "[WARN] [1.5] [rosbag2_recorder]: A new publisher for subscribed topic /scan was found "
        "offering RMW_QOS_POLICY_RELIABILITY_BEST_EFFORT, but rosbag already subscribed"
    )
    [reported] = world.logged(3, "qos_refused")
    assert reported["reason"].startswith("/scan: messages of this publisher are not recorded")
    assert world.heartbeat()["last_error"] == reported["reason"]
    # Many other warnings hide none.
    others = [f"[WARN] [1.5] [rmw]: Failed to parse the hash of {'x' * n}" for n in range(300)]
    world.recorders[0].lines += [*others, UNKNOWN]
    assert world.logged(3, "unknown_type")


@pytest.mark.parametrize(("topic", "is_received"), [("/door", True), ("/other", False)])
def test_while_publishers_disagree_on_a_type_messages_are_missing_and_not_later(
    tmp_path: Path, topic: str, is_received: bool
) -> None:
    """The recorder repeats it of every topic of the robot, those that it need not record as well.

    No QoS would fit them, and a new recording subscribes to none of several types.
    """
    world = World(tmp_path, expected=("/door", "/other"), required=[Required("/other")])
    world.before_start = lambda directory: world.orders.reception.overrides(directory.name)
    world.started(30)
    begun = world.wall
    with capture_logs() as logs:
        for _ in range(60):
            for disputed in (topic, "/on/no/list/at_all"):
                world.running[-1].lines.append(SEVERAL_TYPES.format(disputed))
            world.run(0.5)
    over, beat = world.wall, world.heartbeat()
    assert [topic in each["reason"] for each in events(logs, "several_types")] == [True]
    assert (beat["unknown_types"], "/on" in beat["last_error"]) == ([topic][is_received:], False)
    if not is_received:
        assert "/other" not in beat["missing"]
        assert beat["required_missing"] == [
            "/other: ros2 bag record does not know its type, or knows several"
        ]
    world.run(60)
    assert world.heartbeat()["unknown_types"] == []
    assert len(world.recorders) == 1
    losses = read_losses(tmp_path, MIN_NS, MAX_NS)
    assert {(loss.topic, loss.by) for loss in losses} == {(topic, "refused")}
    times = united((loss.start, loss.stop) for loss in losses)
    [(first, last)] = times
    assert begun - 11 * NS_PER_S < first <= begun
    assert over - 6 * NS_PER_S < last < over + 6 * NS_PER_S


def test_a_topic_whose_publishers_have_another_type_now_is_subscribed_to_again(
    tmp_path: Path,
) -> None:
    """A new recording does so once the old one, whose subscription has the other type, has ended.

    It does not wait for that subscription.
    """
    world = World(tmp_path)
    world.before_start = lambda directory: world.orders.reception.overrides(directory.name)
    world.started(60)
    [old] = world.running
    old.heard = world.defaults["topics"] = world.defaults["heard"] = ("/bumper",)
    with capture_logs() as logs:
        while old.status is None and world.mono < 1_100:
            for recorder in world.running:
                recorder.lines.append(SEVERAL_TYPES.format("/door"))
            world.run(0.5)
        [new] = world.running
        new.heard = TOPICS
        world.run(2)
        assert world.heartbeat()["unknown_types"] == ["/door"]
        new.lines.append("[INFO] [1.0] [rosbag2_recorder]: Subscribed to topic '/door'")
        world.run(2)
        assert world.heartbeat()["unknown_types"] == []
        world.run(400)
    assert [len(events(logs, name)) for name in ("asking_again", "rotated")] == [1, 1]
    assert not events(logs, "rotated_without")
    assert world.heartbeat()["fell_silent"] == []


def test_while_publishers_keep_disagreeing_a_recording_that_never_subscribed_is_not_rotated(
    tmp_path: Path,
) -> None:
    world = World(tmp_path)
    world.before_start = lambda directory: world.orders.reception.overrides(directory.name)
    world.started(60)
    [old] = world.running
    old.heard = world.defaults["topics"] = world.defaults["heard"] = ("/bumper",)
    with capture_logs() as logs:
        while world.mono < 1_500:
            for recorder in world.running:
                recorder.lines.append(SEVERAL_TYPES.format("/door"))
            world.run(0.5)
    assert [len(events(logs, name)) for name in ("asking_again", "rotated")] == [1, 1]
    assert world.heartbeat()["unknown_types"] == ["/door"]


def test_a_heartbeat_that_cannot_be_written_is_reported_once_and_recording_goes_on(
    world: World,
) -> None:
    (world.bag_dir / ".recorder.json.tmp").mkdir()
    assert len(world.logged(20, "heartbeat_not_written")) == 1
    assert world.supervisor.is_recording


def test_bytes_in_the_heartbeat_count_recordings_that_ended_too(tmp_path: Path) -> None:
    world = rotating(tmp_path)
    sizes = []
    for _ in range(12):
        world.run(5)
        sizes.append(world.heartbeat()["bytes_written"])
    assert sizes == sorted(sizes)
    on_disk = sum(path.stat().st_size for path in tmp_path.glob("*/*.mcap"))
    assert abs(sizes[-1] - on_disk) < 20_000
    assert world.heartbeat()["interval_s"] == 5.0


def test_topics_that_nobody_offers_are_named_once_a_recorder_has_looked(tmp_path: Path) -> None:
    expected, offered = ("/odom", "/gone", "/bumper"), {"topics": ("/bumper",)}
    world = World(tmp_path, expected=expected, defaults=dict(offered)).started()
    assert world.heartbeat()["missing"] == []
    with capture_logs() as logs:
        world.run(29)
        assert world.heartbeat()["missing"] == ["/gone", "/odom"]
        assert not events(logs, "topic_not_offered")
        world.run(60)
    assert [each["topics"] for each in events(logs, "topic_not_offered")] == [["/gone", "/odom"]]
    world.defaults["topics"] = ("/odom",)
    world.running[0].die()
    world.run(10)
    assert world.heartbeat()["missing"] == ["/gone"]


@patch.object(handover, "SUBSCRIBE_TIMEOUT_S", 6.0)
def test_nodes_that_have_gone_are_reported(world: World) -> None:
    world.run(9)
    world.silent, world.defaults = True, {"topics": ()}
    [said] = world.logged(90, "topic_silent")
    assert said["topics"] == ["/bumper", "/door"]
    assert world.heartbeat()["silent"] == ["/bumper", "/door"]


def test_a_recorder_that_never_received_anything_says_what_it_waits_for(tmp_path: Path) -> None:
    world = World(
        tmp_path, split_duration_s=60, advice=lambda: "look at the network", silent=True
    ).started(58)  # a recording of long splits waits for one of them
    assert world.heartbeat()["state"] == "recording"
    [reported] = world.logged(10, "recording_waits")
    beat = world.heartbeat()
    assert beat["state"] == "waiting"
    assert beat["waiting_for"] == reported["reason"]
    assert "2 topics are subscribed to; look at the network" in beat["waiting_for"]
    world.silent = False
    world.run(10)
    assert (world.heartbeat()["state"], world.heartbeat()["waiting_for"]) == ("recording", None)


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
    tmp_path: Path,
    simulated: bool,
    topics: tuple[str, ...],
    heard: tuple[str, ...],
    expected: str,
) -> None:
    world = World(
        tmp_path,
        expected=("/rosout", "/odom"),
        simulated=simulated,
        defaults={"topics": topics, "heard": heard},
    ).started(40)
    assert world.heartbeat()["state"] == "waiting"
    assert expected in world.heartbeat()["waiting_for"]


def test_what_is_said_of_a_topic_is_not_why_a_recorder_died(tmp_path: Path) -> None:
    world = World(tmp_path, expected=("/bumper", "/door", "/arm"))
    world.defaults["lines"] = [UNKNOWN]
    world.started(20)
    assert "/arm" in world.heartbeat()["last_error"]
    world.recorders[0].die(-9)
    world.run(20)
    assert len(world.recorders) == 2
    assert world.heartbeat()["last_error"] == "ros2 bag record was killed (SIGKILL)"
    assert world.heartbeat()["unknown_types"] == ["/arm"]


# Topics that are offered and not recorded, as the heartbeat has them.


def test_a_topic_that_is_offered_and_never_comes_is_named_with_advice(tmp_path: Path) -> None:
    world = World(
        tmp_path,
        session_duration_s=20,
        advice=lambda: "look at the users",
        # Services and actions may be unused.
        defaults={"topics": (*TOPICS, "/go/_action/feedback"), "heard": ("/bumper",)},
    ).started(25)
    assert world.heartbeat()["unheard"] == []
    [unheard] = world.logged(60, "topics_unheard")
    assert unheard["topics"] == ["/door"]
    beat = world.heartbeat()
    assert (beat["state"], beat["unheard"]) == ("recording", ["/door"])
    assert beat["last_error"] is None
    assert beat["advice"] == "look at the users"
    world.running[-1].heard = ("/bumper", "/door")
    world.run(15)
    assert (world.heartbeat()["unheard"], world.heartbeat()["advice"]) == ([], None)


@pytest.mark.parametrize("still", [("/bumper",), ()])
def test_a_regular_topic_that_stops_is_silent_until_it_comes(
    world: World, still: tuple[str, ...]
) -> None:
    stopped = sorted({*TOPICS} - {*still})
    for heard, run_s, silent in (
        (TOPICS, 57, []),
        (still, 30, stopped),
        (still, 60, stopped),
        (TOPICS, 20, []),
    ):
        world.defaults["heard"] = heard
        for recorder in world.running:
            recorder.heard = heard
        world.run(run_s)
        assert world.heartbeat()["fell_silent"] == silent


def test_a_slow_topic_that_is_written_with_its_split_is_not_silent(tmp_path: Path) -> None:
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


def test_required_topics_are_missed_by_name_and_rate(tmp_path: Path) -> None:
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


def test_a_topic_that_is_too_slow_is_missed_through_rotations(tmp_path: Path) -> None:
    world = rotating(tmp_path, 40, required=[Required("/bumper", 4.3), Required("/door", 3.7)])
    for _ in range(60):
        world.run(1)
        [missed] = world.heartbeat()["required_missing"]
        assert missed.startswith("/bumper: 4")


@pytest.mark.parametrize("dies", [False, True])
def test_a_changed_list_begins_a_recording_and_loses_nothing_though_its_first_recorder_dies(
    tmp_path: Path, dies: bool
) -> None:
    world = World(tmp_path / "bags", expected=("/bumper", "/door")).started(20)
    world.defaults |= {"topics": ("/bumper", "/lidar"), "heard": ("/bumper", "/lidar")}
    world.topics_path.write_text("topics: [/bumper, /lidar]\n")
    with capture_logs() as logs:
        world.run(5)
        if dies:
            world.recorders[1].die()
        world.run(30)
    [changed] = events(logs, "topics_changed")
    assert changed["added"] == ["/lidar"]
    assert "/door" in changed["dropped"]
    assert not events(logs, "rotated_without")
    beat = world.heartbeat()
    assert (beat["listed"], beat["subscribed"]) == (["/bumper", "/lidar"],) * 2
    assert (len(world.recorders), beat["missing"], beat["silent"]) == (2 + dies, [], [])
    world.run(60)
    assert world.heartbeat()["fell_silent"] == []
    assert len(world.recorders) == 2 + dies
    assert_what_stands_counts_once(world)


def test_a_refused_list_changes_nothing_and_is_named(tmp_path: Path) -> None:
    world = World(tmp_path / "bags", expected=("/bumper", "/door")).started(20)
    before, whole = world.heartbeat()["listed"], world.topics_path.read_text()
    # One that is touched, or written in steps, is the same.
    for text, run_s in (("topics:\n", 1.5), (whole, 20)):
        world.topics_path.write_text(text)
        world.run(run_s)
    assert world.heartbeat()["last_error"] is None
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


def test_a_death_is_told_with_its_time_and_last_words_and_is_past_once_recording_goes_on(
    world: World,
) -> None:
    world.run(17)
    world.recorders[0].lines.append("terminate called after throwing")
    world.recorders[0].die(-6)
    [died] = world.logged(0.25, "recorder_died")
    assert died["log_level"] == "error"
    assert "was killed (SIGABRT)" in died["reason"]
    assert "terminate called" in died["reason"]
    beat = world.heartbeat()
    assert (beat["state"], beat["recordings"]) == ("starting", [])
    told = (died["reason"], world.wall, False)
    assert (beat["last_error"], beat["last_error_at"], beat["recovered"]) == told
    world.run(20)
    later = world.heartbeat()
    assert (later["last_error"], later["last_error_at"], later["recovered"]) == (*told[:2], True)


def silent_at(watch: SilenceWatch, written: dict[float, int], until_s: float) -> float | None:
    """The first moment, in steps of half a second, at which the watch calls for a rotation."""
    size = 0
    for half in range(round(until_s * 2) + 1):
        now = half / 2
        size = max(size, *(total for moment, total in written.items() if moment <= now), 0)
        if watch.is_silent(now, size):
            return now
    return None


def test_each_rotation_for_silence_doubles_the_patience_up_to_a_session() -> None:
    """One that lived for its session sets it back."""
    watch = SilenceWatch(split_duration_s=10, session_duration_s=100)
    moments = []
    for for_silence in (True, True, True, False, True):
        watch.note_begin(0)
        # What is written in the first seconds are headers and latched messages.
        moments.append(silent_at(watch, {0: 0, 4.5: 90, 10: 100}, 300))
        watch.note_rotation(for_silence=for_silence)
    assert moments == [40, 70, 110, 110, 40]


@pytest.mark.parametrize(
    ("wall_s", "expected"), [(1.0, False), (0.95, False), (0.85, True), (-5.0, True), (9.0, False)]
)
def test_only_a_clock_that_falls_behind_at_once_was_set_back(wall_s: float, expected: bool) -> None:
    later = ClockReading(11.0, round(wall_s * NS_PER_S))
    assert set_back(ClockReading(10.0, 0), later) is expected


OPEN = McapLayout(latched=frozenset({"/privacy_mode"}), finish=False, chunk_size=400)


@pytest.mark.parametrize("unknown", [False, True])
def test_over_rotations_what_is_not_excluded_counts_once(tmp_path: Path, unknown: bool) -> None:
    bags = ScreenedBags(tmp_path, privacy(excludes_unknown=unknown))
    house = keeper_of(tmp_path, screening=bags.screening)
    world = rotating(tmp_path, housekeeper=house)
    for _ in range(12):
        world.run(5)
        withheld = read_withheld(tmp_path)
        newest = world.heartbeat()["recordings"][-1]
        assert withheld.holds(newest, f"{newest}_0.mcap") or (tmp_path / newest).exists()
    world.supervisor.stop()
    if unknown:
        assert not world.published(counting=False)
    else:
        assert_each_counts_once(world)
    names = [each.name for each in tmp_path.glob("rec_*")]
    assert len(names) > 2
    assert not any(read_withheld(tmp_path).holds_some(each) for each in names)
    # Compared when they were released, and not before.
    assert all(read_handover(tmp_path / each).handover.compared for each in sorted(names)[1:])


def test_a_recording_that_cannot_be_held_back_does_not_begin(tmp_path: Path) -> None:
    house = keeper_of(tmp_path, screening=ScreenedBags(tmp_path).screening)
    world = rotating(tmp_path, 15, housekeeper=house)
    with broken(SCREENED, "write"):
        world.run(15)
        assert len(world.recorders) == 1
        assert "screened.json: No space left" in world.heartbeat()["last_error"]
    world.run(80)
    assert len(world.recorders) > 1
    world.supervisor.stop()


def test_what_a_crash_left_open_is_repaired_and_then_screened(tmp_path: Path) -> None:
    bags = ScreenedBags(tmp_path / "bags")
    house = keeper_of(bags.bag_dir, screening=bags.screening)
    name = bags.begin(0)
    bags.split([off(-2), *words(0, 10)])
    bags.split(words(10, 20), OPEN)
    bags.end()
    assert len(bags.served()) == 1
    assert bags.screening.problem() is None
    house.apply()
    bags.step()
    assert [path.name for path in bags.served()] == [f"{name}_{n}.mcap" for n in range(2)]


@patch.object(McapWriter, "cut", failing())
def test_the_budget_may_delete_what_is_held_back_in_a_recording_that_ended(tmp_path: Path) -> None:
    bags = ScreenedBags(tmp_path / "bags")
    name = bags.begin(0)
    held = bags.split([on(0), *words(0, 10)])
    bags.split([off(13), *words(10, 30)])
    bags.end()
    recording_now(bags.bag_dir, name)
    keeper_of(bags.bag_dir, max_bytes=1).apply()
    assert held.exists()
    recording_now(bags.bag_dir)
    keeper_of(bags.bag_dir, max_bytes=1).apply()
    assert not held.exists()


def test_a_step_runs_in_the_background_and_its_fault_is_reported(tmp_path: Path) -> None:
    bags = ScreenedBags(tmp_path / "bags")
    house = keeper_of(bags.bag_dir, background=Background(), screening=bags.screening)
    bags.split([off(-2), *words(0, 10)])
    house.screen(())
    house.wait()
    assert len(bags.served()) == 1
    (bags.bag_dir / SCREENED_FILE).write_text("{")
    background = Background()
    house = keeper_of(bags.bag_dir, screening=bags.new(), background=background)
    house.screen(())
    assert "screened.json" in background.faults()["screen"]
    house.finish()
    assert "screened.json" in background.faults()["screen"]


def test_the_pattern_of_a_list_of_topics_is_made_once_and_not_with_each_tick(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, pattern = list[str](), topics._pattern

    def noted(entry: str) -> str:
        made.append(entry)
        return pattern(entry)

    monkeypatch.setattr(topics, "_pattern", noted)
    World(tmp_path / "bags", expected=[f"/part_{number}/state" for number in range(50)]).started(
        100
    )
    assert len(made) == len({*made}) > 50
