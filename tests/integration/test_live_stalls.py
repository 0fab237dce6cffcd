"""Rotations while either recorder is stopped again and again: what a file holds counts, and once.

Three rotations; EPISODIC_LONG=1 makes it 100. EPISODIC_SEED chooses other stalls.
"""

import os
import random
import signal
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

import pytest

from tests.support.examples import LONG
from tests.support.live_recorder import (
    NS_PER_S,
    LiveRecorder,
    await_moment,
    bag_files,
    machine,
    ticks,
)
from tests.support.real_recorder import RealRecorder
from tests.support.ros_processes import publishing_robot

ROTATIONS: Final = 100 if LONG else 3
SEED: Final = int(os.environ.get("EPISODIC_SEED", "13"))
HZ: Final = 50.0
LONGEST_STALL_S: Final = 1.0
LONGEST_PAUSE_S: Final = 1.5


class Rotated(NamedTuple):
    """The ticks of `/odom` by how often each recording holds them, and how often they count."""

    held: dict[str, Counter[int]]
    counting: dict[str, Counter[int]]


@pytest.fixture(scope="module")
def rotated(real_recorder: RealRecorder, tmp_path_factory: pytest.TempPathFactory) -> Rotated:
    folder = tmp_path_factory.mktemp("stalls")
    with (
        machine(folder, real_recorder) as site,
        publishing_robot(
            site.env, folder / "truth.json", "--topics", "/odom", "--hz", str(HZ)
        ) as robot,
    ):
        t0 = robot.t0
        recorder = site.record(
            "stalls",
            "recording.split_duration_s=2",
            "recording.session_duration_s=4",
            topics=["/odom"],
        )
        recorder.wait_for("subscribed")
        stall_until_rotated(recorder, random.Random(SEED))
        recorder.stop()
        held, counting = (
            {
                folder.name: numbers(folder, t0, counting=counting)
                for folder in recorder.bag_dir.glob("*_*")
            }
            for counting in (False, True)
        )
    return Rotated(held, counting)


def stall_until_rotated(recorder: LiveRecorder, chance: random.Random) -> None:
    """Stops one of its recorders after the other, by chance."""
    while len(recorder.events("rotated")) < ROTATIONS:
        assert recorder.process.poll() is None, recorder.log.read_text()
        children = recorder.children()
        if not children:
            continue
        child = chance.choice(children)
        # It may end at any moment.
        with suppress(ProcessLookupError):
            os.kill(child.pid, signal.SIGSTOP)
            await_moment(time.time_ns() + round(chance.uniform(0.05, LONGEST_STALL_S) * NS_PER_S))
            os.kill(child.pid, signal.SIGCONT)
        await_moment(time.time_ns() + round(chance.uniform(0.0, LONGEST_PAUSE_S) * NS_PER_S))


def numbers(recording: Path, t0: int, *, counting: bool) -> Counter[int]:
    files = [path for path in bag_files(recording.parent) if path.parent == recording]
    return Counter(tick.number for tick in ticks(files, t0, HZ, counting=counting))


def test_what_any_file_holds_counts_and_nothing_counts_twice(rotated: Rotated) -> None:
    held = Counter[int]()
    for each in rotated.held.values():
        held |= each
    counting = sum(rotated.counting.values(), Counter[int]())
    assert counting == held


def test_recordings_overlapped(rotated: Rotated) -> None:
    stored = sum(each.total() for each in rotated.held.values())
    assert stored > sum(each.total() for each in rotated.counting.values())
    assert len(rotated.held) >= ROTATIONS
