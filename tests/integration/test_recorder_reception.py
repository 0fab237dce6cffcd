"""The real recorder: queues deep enough for a stall, weaker QoS, load, and a simulated clock.

Seconds of load; EPISODIC_LONG=1 makes it an hour of 10 topics at 200 Hz, and two simulated days.
"""

import os
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import yaml
from mcap.reader import make_reader

from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.bag_dir.state_files import read_losses
from ros2_memory.core.model import TimeWindow
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.examples import LONG
from tests.support.live_recorder import (
    NS_PER_S,
    LiveRecorder,
    Machine,
    await_moment,
    bag_files,
    machine,
    number_of,
    publishing,
    stall,
)
from tests.support.processes import until
from tests.support.real_recorder import RealRecorder
from tests.support.ros_processes import end
from tests.timing import each_in_time

STALLS_S = (0.2, 0.3, 0.5, 1.0)
LOSING_S = 3.0
"""A stall of 1 s may lose nothing: DDS keeps it. One of 5 s is taken for a silent publisher."""
MOST_STALLS = 5


def numbers(bag_dir: Path, recordings: str = "rec_*") -> dict[str, list[int]]:
    """The numbers of the messages of each topic that any closed split has, ascending."""
    found: dict[str, set[int]] = {}
    for split in bag_dir.glob(f"{recordings}/*.mcap"):
        with suppress(Exception), split.open("rb") as stream:  # what is still being written
            for _, channel, message in make_reader(stream).iter_messages():
                found.setdefault(channel.topic, set()).add(number_of(message.data))
    return {topic: sorted(each) for topic, each in found.items()}


def overrides(recorder: LiveRecorder) -> dict[str, dict[str, object]]:
    found: dict[str, dict[str, object]] = yaml.safe_load(
        (recorder.bag_dir / "recorder.qos.yaml").read_text()
    )
    return found


@each_in_time
def test_a_stalled_recorder_loses_nothing_once_its_queues_are_deep(
    real_recorder: RealRecorder, tmp_path: Path
) -> None:
    """Reliable, best effort and with a deadline: one rotation after the first closed split.

    The queues hold two seconds: more than the stalls, and what the machine adds to them.
    """
    robot = ("/odom:100:reliable", "/scan:50:best_effort", "/watched:20:reliable:deadline")
    topics = ("/odom", "/scan", "/watched", "/tf_static")
    with machine(tmp_path, real_recorder) as site, publishing(site.env, *robot):
        recorder = site.record("deep", "recording.split_duration_s=1", topics=topics)
        [deepened] = recorder.wait_for("queues_deepened")
        assert "/odom" in deepened["reason"]
        assert "/scan" in deepened["reason"]
        [rotated] = recorder.wait_for("rotated")
        for seconds in STALLS_S:
            before = len(recorder.events("split_closed"))
            stall(recorder, seconds)
            recorder.wait_for("split_closed", before + 1)
        recorder.stop()
    profiles = overrides(recorder)
    assert {topic: each["reliability"] for topic, each in profiles.items()} == {
        **dict.fromkeys(topics, "reliable"),
        "/scan": "best_effort",
    }
    assert int(str(profiles["/odom"]["depth"])) >= 200
    # A deadline that is asked for refuses every publisher without one.
    assert "deadline" not in profiles["/watched"]
    after, found = numbers(recorder.bag_dir, rotated["next"]), numbers(recorder.bag_dir)
    assert found.keys() == {*topics} - {"/tf_static"}
    for topic, each in found.items():
        received = each[each.index(after[topic][0]) :]
        assert len(received) > 50, topic
        assert received == [*range(received[0], received[-1] + 1)], topic


def test_a_publisher_that_comes_with_weaker_qos_is_recorded_at_once(site: Machine) -> None:
    """And not with the next rotation, ten minutes later."""
    with publishing(site.env, "/odom:100:reliable") as robot:
        recorder = site.record("weaker", "recording.split_duration_s=1", topics=("/odom",))
        recorder.wait_for("rotated")
        assert overrides(recorder)["/odom"]["reliability"] == "reliable"
        end(robot)
        with publishing(site.env, "--first", "1000000", "/odom:100:best_effort"):
            [asked] = recorder.wait_for("asking_again")
            assert "/odom" in asked["reason"]
            until(
                lambda: numbers(recorder.bag_dir).get("/odom", [0])[-1] >= 1_000_000,
                "messages of the new publisher",
                alive=recorder.process,
            )
            recorder.stop()


@each_in_time
def test_what_is_lost_under_load_is_counted_to_the_message(
    real_recorder: RealRecorder, tmp_path: Path
) -> None:
    """It stalls until messages are missing in its files: how many DDS keeps is for DDS to say."""
    with (
        machine(tmp_path, real_recorder) as site,
        publishing(site.env, *(f"{topic}:{HZ}:reliable" for topic in LOAD)),
    ):
        recorder = site.record("load", "recording.split_duration_s=3", topics=LOAD)

        def missing() -> dict[str, int]:
            """How many numbers between the first and the last of each topic are in no file."""
            found = numbers(recorder.bag_dir).items()
            return {topic: each[-1] - each[0] + 1 - len(each) for topic, each in found}

        recorder.wait_for("subscribed", len(LOAD))
        recorder.wait_for_beat(bool, "a heartbeat")
        await_moment(time.time_ns() + LOAD_S * NS_PER_S)
        for _ in range(MOST_STALLS):
            closed = len(recorder.events("split_closed"))
            stall(recorder, LOSING_S)
            recorder.wait_for("rotated")  # what the last recording holds is in closed files
            recorder.wait_for("split_closed", closed + 2)
            if any(missing().values()):
                break
        recorder.wait_for("messages_missing")
        daemon_mb = resident_mb(recorder.process.pid)
        recorder.stop()
    counted = Counter[str]()
    for loss in read_losses(recorder.bag_dir, 0, time.time_ns()):
        counted[loss.topic] += loss.lost
    lost = {topic: count for topic, count in missing().items() if count}
    assert recorder.heartbeat.lost == counted == lost != {}
    assert daemon_mb < MOST_DAEMON_MB


LOAD_S = 3600 if LONG else 0
LOAD = [f"/sensor_{number}" for number in range(10 if LONG else 3)]
HZ = 200 if LONG else 50
SIMULATED = ["/odom", "/rare"]
SPEED = 100.0
SIMULATED_S = 2 * 86_400 if LONG else 1200
SIMULATED_SPLIT_S = 600 if LONG else 300
MOST_DAEMON_MB = 150


def resident_mb(pid: int) -> float:
    """Resident memory in MB; 0 where the process is gone."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except OSError:
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def counted(bag_dir: Path, topics: Sequence[str]) -> dict[str, Counter[int]]:
    """How often each number of each topic counts in the closed splits."""
    reader = BagDirReader(McapReader())
    found: dict[str, Counter[int]] = {}
    for path in bag_files(bag_dir):
        for record in reader.records(path, topics, TimeWindow.everything()):
            found.setdefault(record.channel.topic, Counter())[number_of(record.payload)] += 1
    return found


@each_in_time
def test_simulated_time_is_recorded_by_its_clock(
    real_recorder: RealRecorder, tmp_path: Path
) -> None:
    """Rotations and losses among it: the wall clock that paces them runs at another speed."""
    topics = ("/odom:1:reliable:deep", "/rare:0.1:reliable:deep")
    with (
        machine(tmp_path, real_recorder) as site,
        publishing(site.env, "--speed", f"{SPEED:g}", *topics),
    ):
        recorder = site.record(
            "simulated",
            "recording.use_sim_time=true",
            f"recording.split_duration_s={SIMULATED_SPLIT_S}",
            f"recording.session_duration_s={2 * SIMULATED_SPLIT_S}",
            topics=SIMULATED,
        )
        until(
            lambda: len(bag_files(recorder.bag_dir)) > SIMULATED_S // SIMULATED_SPLIT_S,
            "that much simulated time",
            timeout_s=SIMULATED_S / SPEED + 120,
            alive=recorder.process,
        )
        recorder.stop()
    found = counted(recorder.bag_dir, SIMULATED)
    times = [
        record.log_time / NS_PER_S
        for path in bag_files(recorder.bag_dir)
        for record in McapReader().records(path, ["/rare"], TimeWindow.everything())
    ]
    assert max(times) < 2 * SIMULATED_S
    assert max(later - before for before, later in pairwise(sorted(times))) < SIMULATED_SPLIT_S
    assert all(set(each.values()) == {1} for each in found.values())
