"""A privacy mode beside the real `ros2 bag record`: over a rotation, and a kill of everything."""

import signal
import struct
import subprocess
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from ros2_memory.bag_dir.state_files import read_withheld
from ros2_memory.core.timebase import WallClock
from ros2_memory.recorder.index_manager import IndexManager
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.live_recorder import LiveRecorder, Machine
from tests.support.processes import until
from tests.support.ros_processes import running

RULES = """
rules:
  privacy: {topic: /privacy_mode, condition_type: equals, value: true, field: value}
"""
TOPICS = ("/odom", "/privacy_mode")


@pytest.fixture
def robot(site: Machine, tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    truth = tmp_path / "truth"
    with running(site.env, "tests.integration.private_robot", str(truth)) as process:
        until(truth.exists, "the robot", alive=process)
        yield process


def numbers(path: Path) -> frozenset[int]:
    status = path.stat()
    return numbers_of(path, (status.st_ino, status.st_size, status.st_mtime_ns))


@cache
def numbers_of(path: Path, _state: tuple[int, ...]) -> frozenset[int]:
    """Remembered for each state of a file: all are looked at again and again."""
    with path.open("rb") as stream:
        found = [each.data for _, _, each in make_reader(stream).iter_messages(topics=["/odom"])]
    # After an empty frame_id the point follows at the next multiple of eight.
    return frozenset(int(struct.unpack_from("<d", data, 4 + 16)[0]) for data in found)


def turned(robot: subprocess.Popen[bytes], truth: Path, sign: signal.Signals) -> int:
    """Sends the robot a signal; returns the number from which on it counts."""
    lines = truth.read_text().splitlines()
    robot.send_signal(sign)
    until(lambda: truth.read_text().splitlines() != lines, "a change", alive=robot)
    return int(truth.read_text().splitlines()[-1])


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

    def index(bag_dir: Path) -> IndexManager:
        """What a query server would find, with the split that is being written."""
        how: dict[str, Any] = {"refresh_s": 0.1, "split_duration_s": 2.0, "include_active": True}
        return IndexManager(bag_dir, McapReader(), WallClock(), **how)

    def found_by(index: IndexManager) -> set[int]:
        return set[int]().union(*(numbers(bag.path) for bag in index.refresh().bags))

    def served(recorder: LiveRecorder, enough: Callable[[set[int]], bool], what: str) -> None:
        server = index(recorder.bag_dir)

        def is_enough() -> bool:
            found = found_by(server)
            assert not {*filter(private.__contains__, found)}, "what is private is served"
            return enough(found)

        until(is_enough, what, alive=recorder.process)

    def has_excluded_a_split() -> bool:
        """Of what this recorder began: more than the second in which the mode was not known.

        In that come 50 messages at most; on a busy machine the robot sends fewer in each second.
        """
        began = {each["recording"] for each in recorder.events("recorder_started")}
        return any(
            each["messages"] > 60 and each["recording"] in began
            for each in recorder.events("messages_excluded")
        )

    private = range(0)
    recorder = site.record("private", *given, topics=TOPICS)
    served(recorder, lambda found: len(found) > 100, "two seconds")
    first = turned(robot, truth, signal.SIGUSR1)
    private = range(first, 2**60)
    until(has_excluded_a_split, "a split that is excluded", alive=recorder.process)
    recorder.wait_for("rotated", len(recorder.events("rotated")) + 1)
    recorder.kill(with_children=True)
    assert max(found_by(index(recorder.bag_dir))) < first
    recorder = site.record("private", *given, topics=TOPICS)
    until(has_excluded_a_split, "another split that is excluded", alive=recorder.process)
    last = turned(robot, truth, signal.SIGUSR2)
    private = range(first, last)
    served(recorder, lambda found: max(found, default=0) > last + 150, "what came after it")
    recorder.stop()
    found = found_by(index(recorder.bag_dir))
    # The margin of a second is 50 messages or fewer, which a busy machine receives up to half a
    # second late; all else is there but for what a kill lost.
    assert not found & {*range(first - 20, last + 20)}
    assert {*range(first - 150, first - 75)} <= found
    assert {*range(last + 75, last + 150)} <= found
    everywhere = set().union(*map(numbers, recorder.bag_dir.rglob("rec_*.mcap")))
    assert everywhere == found
    withheld = read_withheld(recorder.bag_dir)
    assert not any(withheld.holds_some(each.name) for each in recorder.bag_dir.glob("rec_*"))
