"""A privacy mode beside the real `ros2 bag record`: over a rotation, and a kill of everything."""

from __future__ import annotations

import signal
import struct
import subprocess
from typing import TYPE_CHECKING

import pytest
from mcap.reader import make_reader

from ros2_memory.bag_dir.state_files import read_gate
from ros2_memory.core.timebase import WallClock
from ros2_memory.recorder.index_manager import IndexManager
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.live_recorder import LiveRecorder, Machine, machine
from tests.support.processes import PATIENCE_S
from tests.support.ros_processes import end, ros_environment, wait_for

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from tests.support.real_recorder import RealRecorder

RULES = """
rules:
  privacy: {topic: /privacy_mode, condition_type: equals, value: true, field: value}
"""
TOPICS = ("/odom", "/privacy_mode")


@pytest.fixture
def site(real_recorder: RealRecorder, tmp_path: Path) -> Iterator[Machine]:
    with ros_environment(tmp_path, real=real_recorder) as env, machine(tmp_path, env) as found:
        yield found


@pytest.fixture
def robot(site: Machine, tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    truth = tmp_path / "truth"
    argv = [site.env["ROS2_LIVE_PYTHON"], "-P", "-m", "tests.integration.private_robot", str(truth)]
    known = {**site.env, "PYTHONPATH": site.env["ROS2_LIVE_PYTHONPATH"]}
    process = subprocess.Popen(argv, env=known, stdin=subprocess.DEVNULL)
    try:
        wait_for(truth.exists, "the robot", alive=process)
        yield process
    finally:
        end(process)


def numbers(path: Path) -> set[int]:
    with path.open("rb") as stream:
        found = [each.data for _, _, each in make_reader(stream).iter_messages(topics=["/odom"])]
    # After an empty frame_id the point follows at the next multiple of eight.
    return {int(struct.unpack_from("<d", data, 4 + 16)[0]) for data in found}


class Server:
    """What a query server would find, with the split that is being written."""

    def __init__(self, bag_dir: Path) -> None:
        self._index = IndexManager(
            bag_dir,
            McapReader(),
            WallClock(),
            refresh_s=0.1,
            split_duration_s=2.0,
            include_active=True,
        )

    def finds(self) -> set[int]:
        found: set[int] = set()
        for bag in self._index.refresh().bags:
            found |= numbers(bag.path)
        return found


def test_nothing_of_it_is_ever_served(
    site: Machine, robot: subprocess.Popen[bytes], tmp_path: Path
) -> None:
    rules = tmp_path / "exclusions.yaml"
    rules.write_text(RULES)
    truth = tmp_path / "truth"
    given = (
        f"recording.exclude_when={rules}",
        "recording.split_duration_s=2",
        "recording.session_duration_s=8",
    )

    def turned(count: int, sign: signal.Signals) -> int:
        robot.send_signal(sign)
        wait_for(lambda: len(truth.read_text().splitlines()) == count, "a change", alive=robot)
        return int(truth.read_text().splitlines()[-1])

    def served(recorder: LiveRecorder, enough: Callable[[set[int]], bool], what: str) -> None:
        server = Server(recorder.bag_dir)

        def is_enough() -> bool:
            found = server.finds()
            assert not {*filter(private.__contains__, found)}, "what is private is served"
            return enough(found)

        wait_for(is_enough, what, timeout_s=PATIENCE_S, alive=recorder.process)

    def has_excluded_a_split() -> bool:
        """Of what this recorder began: more than the second in which the mode was not known."""
        began = {each["recording"] for each in recorder.events("recorder_started")}
        return any(
            each["messages"] > 80 and each["recording"] in began
            for each in recorder.events("messages_excluded")
        )

    private = range(0)
    recorder = site.record("private", *given, topics=TOPICS)
    served(recorder, lambda found: len(found) > 100, "two seconds")
    first = turned(2, signal.SIGUSR1)
    private = range(first, 2**60)
    wait_for(has_excluded_a_split, "a split that is excluded", alive=recorder.process)
    recorder.wait_for("rotated", len(recorder.events("rotated")) + 1)
    recorder.kill(with_children=True)
    assert max(Server(recorder.bag_dir).finds()) < first
    recorder = site.record("private", *given, topics=TOPICS)
    wait_for(has_excluded_a_split, "another split that is excluded", alive=recorder.process)
    last = turned(3, signal.SIGUSR2)
    private = range(first, last)
    served(recorder, lambda found: max(found, default=0) > last + 100, "what came after it")
    recorder.stop()
    found = Server(recorder.bag_dir).finds()
    # The margin of a second is 50 messages; all else is there but for what a kill lost.
    assert not found & {*range(first - 30, last + 30)}
    assert {*range(first - 100, first - 60)} <= found
    assert {*range(last + 60, last + 100)} <= found
    everywhere = set().union(*map(numbers, recorder.bag_dir.rglob("rec_*.mcap")))
    assert everywhere == found
    gate = read_gate(recorder.bag_dir)
    assert not any(gate.holds_some(each.name) for each in recorder.bag_dir.glob("rec_*"))
