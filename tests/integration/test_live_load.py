"""The real recorder under load, and by a simulated clock: what it keeps, and what that costs.

Seconds of each; EPISODIC_LONG=1 makes it an hour of 10 topics at 200 Hz, and two simulated days.
"""

import os
import time
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final

from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.bag_dir.state_files import read_losses
from ros2_memory.core.model import TimeWindow
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.examples import LONG
from tests.support.live_recorder import (
    NS_PER_S,
    bag_files,
    machine,
    number_of,
    publishing,
)
from tests.support.real_recorder import RealRecorder
from tests.support.ros_processes import wait_for
from tests.timing import each_in_time

LOAD_S: Final = 3600 if LONG else 8
LOAD: Final = [f"/sensor_{number}" for number in range(10 if LONG else 3)]
HZ: Final = 200 if LONG else 50
SIMULATED: Final = ["/odom", "/rare"]
SPEED: Final = 100.0
SIMULATED_S: Final = 2 * 86_400 if LONG else 1200
SIMULATED_SPLIT_S: Final = 600 if LONG else 300
MOST_DAEMON_MB: Final = 150


def resident_mb(pid: int) -> float:
    """Resident memory in MB; 0 where the process is gone."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except OSError:
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def numbers(bag_dir: Path, topics: Sequence[str]) -> dict[str, Counter[int]]:
    """How often each number of each topic counts in the closed splits."""
    reader = BagDirReader(McapReader())
    found: dict[str, Counter[int]] = {}
    for path in bag_files(bag_dir):
        for record in reader.records(path, topics, TimeWindow.everything()):
            found.setdefault(record.channel.topic, Counter())[number_of(record.payload)] += 1
    return found


def missing(found: Counter[int]) -> int:
    """How many numbers between the first and the last are in no split."""
    return max(found) - min(found) + 1 - len(found)


@each_in_time
def test_what_is_lost_under_load_is_counted(real_recorder: RealRecorder, tmp_path: Path) -> None:
    """Publishers keep what waits, as what they overwrite is lost before anybody can count it."""
    with (
        machine(tmp_path, real_recorder) as site,
        publishing(site.env, *(f"{topic}:{HZ}:reliable:deep" for topic in LOAD)),
    ):
        recorder = site.record(
            "load", *(() if LONG else ("recording.split_duration_s=2",)), topics=LOAD
        )
        recorder.wait_for("subscribed", len(LOAD))
        daemon_mb, began = 0.0, time.monotonic()

        def over() -> bool:
            nonlocal daemon_mb
            daemon_mb = max(daemon_mb, resident_mb(recorder.process.pid))
            return time.monotonic() - began >= LOAD_S

        wait_for(over, "the end", timeout_s=LOAD_S + 60, alive=recorder.process)
        recorder.stop()
    found = numbers(recorder.bag_dir, LOAD)
    counted = Counter[str]()
    for loss in read_losses(recorder.bag_dir, 0, time.time_ns()):
        counted[loss.topic] += loss.lost
    assert {topic: missing(each) for topic, each in found.items()} == {
        topic: counted[topic] for topic in LOAD
    }
    assert all(set(each.values()) == {1} for each in found.values())
    assert daemon_mb < MOST_DAEMON_MB


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
        wait_for(
            lambda: len(bag_files(recorder.bag_dir)) > SIMULATED_S // SIMULATED_SPLIT_S,
            "that much simulated time",
            timeout_s=SIMULATED_S / SPEED + 120,
            alive=recorder.process,
        )
        recorder.stop()
    found = numbers(recorder.bag_dir, SIMULATED)
    times = [
        record.log_time / NS_PER_S
        for path in bag_files(recorder.bag_dir)
        for record in McapReader().records(path, ["/rare"], TimeWindow.everything())
    ]
    assert max(times) < 2 * SIMULATED_S
    assert max(later - before for before, later in pairwise(sorted(times))) < SIMULATED_SPLIT_S
    assert all(set(each.values()) == {1} for each in found.values())
