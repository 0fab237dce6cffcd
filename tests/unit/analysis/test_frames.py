"""The frames of one bag as arrays: equal to the transform tree's answers, one by one."""

from __future__ import annotations

import math
from dataclasses import replace
from random import Random

import numpy as np
import pytest

from ros2_memory.analysis.frames import HOLD_NS, Frames, edges_of
from ros2_memory.analysis.transform_tree import FrameGraph
from ros2_memory.core.errors import NoDataError
from ros2_memory.core.model import StampedTransform, Transform

S = 10**9


def turn(yaw: float) -> tuple[float, float, float, float]:
    return (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))


def moving(
    parent: str, child: str, at: int, x: float = 0.0, yaw: float = 0.0, late: int = 0
) -> StampedTransform:
    return StampedTransform(
        parent, child, at, at + late, Transform((x, x / 2, 0.1), turn(yaw)), static=False
    )


def static(parent: str, child: str, x: float = 0.0, yaw: float = 0.0) -> StampedTransform:
    return StampedTransform(parent, child, 0, 0, Transform((x, 0.0, 0.5), turn(yaw)), static=True)


def drawn(draw: Random) -> list[StampedTransform]:
    """Some seconds of odometry and of corrections, with a silence longer than tf2's buffer."""
    found = []
    for parent, child, step in (("map", "odom", S), ("odom", "base", S // 5)):
        at = draw.randrange(S)
        for _ in range(60):
            at += draw.choice([step, step, 3 * step, 11 * S if draw.random() < 0.05 else step])
            found.append(moving(parent, child, at, draw.uniform(-3, 3), draw.uniform(-4, 4)))
    return found


@pytest.mark.parametrize("seed", range(20))
def test_a_pose_inside_of_the_bag_is_that_of_the_transform_tree(seed: int) -> None:
    draw = Random(seed)
    transforms = drawn(draw)
    mount = static("base", "camera", 0.3, 1.0)
    frames = Frames([mount], edges_of(transforms), "map", "stamp")
    graph = FrameGraph([mount, *transforms])
    first = max(min(e.stamp for e in transforms if e.child == c) for c in ("odom", "base"))
    last = min(max(e.stamp for e in transforms if e.child == c) for c in ("odom", "base"))
    times = np.array(sorted(draw.randrange(first, last) for _ in range(200)), np.int64)
    found = frames.poses("camera", times)
    assert found is not None
    points = np.stack(found.points((np.ones(200), np.ones(200), np.ones(200))), axis=1)
    for at, valid, point in zip(times.tolist(), found.valid.tolist(), points, strict=True):
        try:
            expected = graph.lookup("map", "camera", at)
        except NoDataError:
            assert not valid or any(abs(one.stamp - at) <= HOLD_NS for one in transforms)
            continue
        one = frames.pose("camera", at)
        assert valid
        assert one is not None
        assert one.translation == pytest.approx(expected.translation, abs=1e-9)
        assert abs(sum(a * b for a, b in zip(one.rotation, expected.rotation, strict=True))) > (
            1 - 1e-12
        )
        assert np.isfinite(point).all()


def test_the_first_and_last_transform_hold_a_little_beyond_the_bag() -> None:
    frames = Frames([], edges_of([moving("map", "odom", 10 * S, 1.0)]), "map")
    assert frames.pose("odom", 10 * S - HOLD_NS) is not None
    assert frames.pose("odom", 10 * S + HOLD_NS) is not None
    assert frames.pose("odom", 10 * S + HOLD_NS + 1) is None


def test_a_child_that_changes_its_parent_is_looked_up_time_by_time() -> None:
    transforms = [
        moving("map", "odom", 1 * S, 1.0),
        moving("map", "odom", 2 * S, 2.0),
        moving("earth", "odom", 3 * S, 5.0),
        moving("map", "odom", 4 * S, 2.0),
    ]
    frames = Frames([static("map", "earth", 10.0)], edges_of(transforms), "map", "stamp")
    places = [frames.pose("odom", at) for at in (3 * S // 2, 3 * S, 4 * S)]
    assert [each and each.translation[0] for each in places] == [1.5, 15.0, 2.0]


def test_stamps_of_another_clock_are_not_used() -> None:
    transforms = [moving("map", "odom", at * S, at, late=900 * S) for at in (1, 2)]
    frames = Frames([], edges_of(transforms), "map")
    assert [frames.pose("odom", at * S) is not None for at in (1, 901)] == [False, True]


def test_a_transform_holds_a_little_into_a_gap_that_tf2_does_not_bridge() -> None:
    frames = Frames([], edges_of([moving("map", "odom", at * S, at) for at in (10, 40)]), "map")
    at = [12, 13, 37, 38]
    found = frames.poses("odom", np.array([each * S for each in at], np.int64))
    assert found is not None
    assert found.valid.tolist() == [True, False, False, True]
    assert found.translation[0][found.valid].tolist() == [10.0, 40.0]


def test_a_static_transform_holds_until_the_next_one_of_its_child() -> None:
    later = replace(static("base", "camera", 5.0), log_time=20 * S)
    frames = Frames([static("base", "camera", 1.0), later], {}, "base")
    found = frames.poses("camera", np.array([-S, 19 * S, 20 * S, 30 * S], np.int64))
    assert found is not None
    assert found.valid.all()
    assert found.translation[0].tolist() == [1.0, 1.0, 5.0, 5.0]


def test_frames_without_a_connection_have_no_pose() -> None:
    frames = Frames([static("base", "camera")], {}, "map")
    assert frames.poses("camera", np.array([1], np.int64)) is None
    assert not frames.reaches("camera")
    assert frames.pose("map", 1) is not None
