"""The poses of a topic in a window: those of all its messages, each once, in order of time."""

from __future__ import annotations

import math
from itertools import pairwise
from random import Random
from typing import TYPE_CHECKING

import numpy as np
import pytest

from ros2_memory.analysis.poses import Poses, joined_poses
from ros2_memory.core.errors import InvalidArgumentsError, UndecodableError
from ros2_memory.core.model import TimeWindow
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.poses import pose_rows, poses_of
from ros2_memory.history.view import View
from tests.support.bags import odom, write_mcap
from tests.support.column_worlds import EVERYTHING, World
from tests.support.memories import memory_of
from tests.support.shared_bags import REAL, RECORDED, needs_real, needs_recorded
from tests.unit.history.cut_histories import cut, draw_recordings, fill_some, write

if TYPE_CHECKING:
    from pathlib import Path


S = 10**9
T0 = 1_700_000_000 * S


def read(view: View, topic: str, window: TimeWindow) -> Poses | None:
    """The poses by decoding each message; None where some message has none."""
    extractor, found = view.memory.extractor, []
    for each in view.stream.messages([topic], window):
        type_name = each.record.channel.type
        try:
            message = view.memory.reader.decode(each.record)
        except UndecodableError:
            continue
        pose, twist = extractor.pose(message, type_name), extractor.twist(message, type_name)
        if pose is None:
            return None
        found.append((each.time, pose, None if twist is None else math.hypot(*twist.linear)))
    return poses_of(found)


def scanned(view: View, topic: str, window: TimeWindow) -> Poses:
    blocks = [*pose_rows(view, topic, window, [])]
    assert all(before.last < after.first for before, after in pairwise(blocks))
    return joined_poses([each.poses for each in blocks])


def assert_alike(found: Poses, expected: Poses) -> None:
    assert found.times.tolist() == expected.times.tolist()
    np.testing.assert_allclose(found.positions, expected.positions, atol=1.1e-4)
    np.testing.assert_allclose(found.turns, expected.turns, atol=1e-4)
    np.testing.assert_allclose(found.speeds, expected.speeds, atol=1e-4)
    assert found.frames.values() == expected.frames.values()


def check(memory: Memory, window: TimeWindow = EVERYTHING) -> int:
    """Compares the poses of all topics; returns how many topics have poses."""
    count = 0
    for topic in View(memory, Call()).snapshot.timeline.topics():
        view = View(memory, Call())
        expected = read(view, topic, window)
        if expected is None:
            with pytest.raises(InvalidArgumentsError):
                scanned(view, topic, window)
            continue
        assert_alike(scanned(view, topic, window), expected)
        count += len(expected) > 0
    return count


@pytest.mark.parametrize("seed", range(6))
def test_poses_of_a_history_that_is_cut_anywhere(tmp_path: Path, seed: int) -> None:
    draw = Random(seed)
    write(tmp_path, cut(draw_recordings(draw), [draw.random() for _ in range(5)]))
    world = World.of(tmp_path)
    fill_some(world, draw)
    assert check(world.memory) == 1
    view = View(world.memory, Call())
    times = [each.time for each in view.stream.messages(["/odom"], EVERYTHING)]
    assert check(world.memory, TimeWindow(times[len(times) // 3], times[len(times) // 2])) == 1


def test_only_whole_parts_have_numbers(tmp_path: Path) -> None:
    write_mcap(tmp_path / "rec/rec_0.mcap", [odom(T0 + n * S, n, 0) for n in range(20)])
    world = World.of(tmp_path)
    world.fill()
    view = View(world.memory, Call())
    [whole] = pose_rows(view, "/odom", EVERYTHING, [])
    [cut_off] = pose_rows(view, "/odom", TimeWindow(T0 + S, T0 + 9 * S), [])
    assert whole.parts is not None
    assert cut_off.parts is None
    assert len(cut_off.poses) == 8


@needs_recorded
@pytest.mark.parametrize("name", ["session_mcap", "session_sqlite3", "session_killed"])
def test_poses_of_recorded_sessions(name: str) -> None:
    storage = "sqlite3" if "sqlite" in name else "mcap"
    assert check(memory_of(RECORDED / name, storage=storage)) > 0


@needs_real
def test_poses_of_public_robots() -> None:
    found = 0
    for folder in sorted(REAL.iterdir()):
        if folder.is_dir():
            memory = memory_of(folder)
            found += check(memory) if memory.index.snapshot().bags else 0
    assert found > 0
