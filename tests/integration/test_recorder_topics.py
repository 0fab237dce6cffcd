"""Which topics the real recorder records: a list that changes, and children that write nothing."""

import json
import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ros2_memory.core.timebase import NS_PER_S
from tests.support.live_recorder import Machine, bag_files, machine, ticks
from tests.support.real_recorder import RealRecorder
from tests.support.ros_processes import Robot, publishing_robot
from tests.timing import each_in_time

TOPICS = ("/odom", "/tf", "/cmd_vel", "/px4/position")


@contextmanager
def recorded_robot(folder: Path, real_recorder: RealRecorder) -> Iterator[tuple[Machine, Robot]]:
    options = ("--topics", *TOPICS, "--hz", "50")
    with (
        machine(folder, real_recorder) as site,
        publishing_robot(site.env, folder / "truth.json", *options) as robot,
    ):
        yield site, robot


@each_in_time
def test_a_changed_list_loses_nothing_of_topics_that_stay(
    real_recorder: RealRecorder, tmp_path: Path
) -> None:
    with recorded_robot(tmp_path, real_recorder) as (site, robot):
        recorder = site.record("listed", "recording.split_duration_s=2", topics=("/odom", "/tf"))
        recorder.wait_for("split_closed", 4)
        # The first recording has rosbag2's own queues of ten messages, soon overrun.
        recorder.wait_for("rotated")
        begun = time.time_ns()
        before = len(recorder.events("rotated"))
        file = tmp_path / "listed" / "topics.yaml"
        file.write_text("topics: [/odom, /cmd_vel]\n")
        [changed] = recorder.wait_for("topics_changed")
        assert (changed["added"], changed["dropped"]) == (["/cmd_vel"], ["/tf"])
        recorder.wait_for("rotated", before + 1)
        recorder.wait_for_beat(
            lambda beat: {*beat.subscribed} == {"/odom", "/cmd_vel"}, "the new list"
        )
        file.write_text("topics: nonsense\n")
        recorder.wait_for_beat(lambda beat: beat.list_refused is not None, "a refusal")
        recorder.wait_for("split_closed", len(recorder.events("split_closed")) + 2)
        recorder.stop()
        robot.stop()
        t0 = int(json.loads((tmp_path / "truth.json").read_text())["t0_ns"])
        first = (begun - t0) * 50 // NS_PER_S
        recorded = ticks(bag_files(recorder.bag_dir), t0, 50)
        numbers = [each.number for each in recorded if each.number > first]
        assert numbers == [*range(numbers[0], numbers[-1] + 1)]


@each_in_time
def test_a_child_that_lives_and_writes_nothing_is_replaced(
    real_recorder: RealRecorder, tmp_path: Path
) -> None:
    """As rosbag2 issue 2463 has it; meanwhile a topic of an unknown type is named as such."""
    with recorded_robot(tmp_path, real_recorder) as (site, _):
        recorder = site.record(
            "stuck",
            "recording.split_duration_s=2",
            "recording.required=[/px4/*, {topic: /odom, min_hz: 10}]",
            topics=TOPICS,
        )
        recorder.wait_for("subscribed", 3)
        [stuck] = recorder.children()
        os.kill(stuck.pid, signal.SIGSTOP)
        try:
            recorder.wait_for("no_growth")
            recorder.wait_for("split_closed")
            assert recorder.children()[-1].pid != stuck.pid
            # Until the next heartbeat /odom is missing, too: the stuck child got nothing of it.
            missing = ("/px4/position: ros2 bag record does not know its type, or knows several",)
            beat = recorder.wait_for_beat(
                lambda beat: beat.required_missing == missing, "what is required"
            )
            assert (beat.unknown_types, beat.missing) == (("/px4/position",), ())
        finally:
            with suppress(ProcessLookupError):
                os.kill(stuck.pid, signal.SIGCONT)
