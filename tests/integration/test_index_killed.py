"""A kill at any moment of an index run leaves what the next start can go on from."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from ros2_memory import queries
from ros2_memory.bootstrap import build_backfill, build_memory
from ros2_memory.catalogue.store import FILE, FOLDER
from ros2_memory.config import load_settings
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.history.context import Call
from tests.support.bags import detections, odom, tf, transform, write_mcap
from tests.support.clocks import FixedClock
from tests.support.housekeepers import recorded_before
from tests.support.memories import memory_of
from tests.support.processes import until

if TYPE_CHECKING:
    from ros2_memory.history.context import Memory

BAGS = 60
T0 = 1_700_000_000 * NS_PER_S


def write_bags(bag_dir: Path) -> None:
    recorded_before(bag_dir)
    for number in range(BAGS):
        start = T0 + number * 10 * NS_PER_S
        messages = [odom(start + n * NS_PER_S // 2, number + n / 20, 0.0) for n in range(20)]
        fixed = transform(start, "base_link", f"laser_{number % 3}", (0.1, 0.0, 0.0))
        messages.append(tf(start, fixed, topic="/tf_static"))
        messages.append(detections(start, ["cup", f"thing{number}"]))
        path = write_mcap(bag_dir / "rec" / f"rec_{number}.mcap", messages)
        os.utime(path, ns=(start, start))


def answers(memory: Memory) -> list[str]:
    asked = [
        queries.list_recorded_topics(memory, Call()),
        queries.frames(memory, Call()),
        *(
            queries.find_last_match(memory, Call(), "/vision/*", "contains", wanted)
            for wanted in ("thing7", "never", "cup")
        ),
    ]
    return [repr(answer) for answer in asked]


@pytest.mark.parametrize("seed", range(6))
def test_after_a_kill_every_answer_is_right_and_the_rest_gets_done(
    tmp_path: Path, seed: int
) -> None:
    write_bags(tmp_path)
    environment = os.environ | {"MEMORY_BAG_DIR": str(tmp_path)}
    command = [sys.executable, "-m", "ros2_memory.cli", "index"]
    child = subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)
    catalogue = tmp_path / FOLDER / FILE
    draw = random.Random(seed)
    until(lambda: catalogue.exists() or child.poll() is not None)
    time.sleep(draw.uniform(0, 0.3))
    child.send_signal(signal.SIGKILL)
    child.wait()

    settings = load_settings((), {"MEMORY_BAG_DIR": str(tmp_path)})
    now = FixedClock(T0 + 1_000_000 * NS_PER_S)
    memory = replace(build_memory(settings), clock=now)
    expected = answers(memory_of(tmp_path, clock=now))
    assert answers(memory) == expected
    assert memory.recall is not None
    assert memory.recall.catalogue.path == catalogue

    subprocess.run(command, env=environment, check=True, stderr=subprocess.DEVNULL)
    assert build_backfill(settings, memory).progress().waiting == 0
    assert answers(memory) == expected
