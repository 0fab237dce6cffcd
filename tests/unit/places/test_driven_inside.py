"""What the robot drove while it was in a place, waypoints in another frame, the farthest pose."""

import math
from functools import partial
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.core.timebase import Deadline
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.view import TimeRange
from ros2_memory.queries import trajectory_summary
from tests.support.bags import odom, tf, transform, write_mcap
from tests.support.examples import examples
from tests.support.memories import asked, each_way, memory_of
from tests.support.moving_map import BEGIN, S
from tests.support.rooms import BEGIN as ROOMS_BEGIN
from tests.support.rooms import ROOMS, asked_of, draw, write

ALL = TimeRange(BEGIN / S, BEGIN / S + 1000)


def in_both_frames(memory: Memory, span: dict[str, float]) -> tuple[Any, Any]:
    """What was driven, with waypoints in the frame of the poses, and in the map."""
    own = asked(memory, "trajectory_summary", **span)
    return own, asked(memory, "trajectory_summary", frame_id="map", **span)


@each_way
def test_a_robot_that_turns_on_a_straight_way_has_its_own_heading_at_the_edge_of_a_place(
    tmp_path: Path, recalls: bool
) -> None:
    """Drives 0.5 m/s along x, and turns 0.3 rad/s meanwhile, as a holonomic robot may."""
    messages = [odom(BEGIN + n * S // 10, n / 20, 0.0, 0.03 * n) for n in range(900)]
    write_mcap(tmp_path / "rec" / "rec_0.mcap", messages)
    memory = memory_of(tmp_path, recalls=recalls)
    window = {"start": BEGIN / S, "end": BEGIN / S + 90}
    where = {"x": [15, 20], "y": [-1, 1]}
    inside = asked(memory, "trajectory_summary", where=where, **window)
    assert len(inside["waypoints"]) == 2
    for each in inside["waypoints"]:
        there = asked(memory, "get_position_at", timestamp=each["timestamp"])
        assert each["yaw_deg"] == there["yaw_deg"]


SECONDS = 200


@settings(max_examples=examples(8))
@given(
    seed=st.integers(0, 10_000),
    stored=st.booleans(),
    x=st.floats(-3, 15),
    first=st.integers(0, 120),
    rooms=st.lists(st.sampled_from([*ROOMS]), max_size=2, unique=True),
)
def test_it_is_the_pose_of_the_window_or_of_a_place_that_is_farthest(
    seed: int, stored: bool, x: float, first: int, rooms: list[str]
) -> None:
    world = draw(seed, SECONDS)
    with TemporaryDirectory() as name:
        write(world, Path(name))
        memory = asked_of(Path(name), stored=stored)
        bounds = {"start": ROOMS_BEGIN + first, "end": ROOMS_BEGIN + first + 60}
        given: dict[str, Any] = {"where": ", ".join(rooms)} if rooms else {}
        point = {"x": x, "y": 1.0}
        reply = asked(memory, "trajectory_summary", farthest_from=point, **bounds, **given)
        poses = {
            nth: math.hypot(world.x[nth] - x, 1.0)
            for nth in range(first, first + 61)
            if not rooms or world.room(nth) in rooms
        }
        if not poses:
            assert "farthest" not in reply
            return
        farthest = reply["farthest"]
        assert farthest["distance_m"] == pytest.approx(max(poses.values()), abs=0.001)
        at = round(farthest["timestamp"] - ROOMS_BEGIN)
        assert poses[at] == pytest.approx(max(poses.values()), abs=1e-6)
        assert (farthest["x"], farthest["frame_id"]) == (world.x[at], "odom")
        assert farthest["from"] == {"x": pytest.approx(x, abs=1e-3), "y": 1.0}
        assert farthest.get("in") == world.room(at)


@pytest.fixture
def memory(tmp_path: Path) -> Memory:
    write(draw(1, 60), tmp_path)
    return asked_of(tmp_path, stored=False)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"farthest_from": "attic"}, "farthest_from: no place is named"),
        ({"farthest_from": "kitchen, hall"}, "farthest_from has several places; give one"),
        ({"farthest_from": {"x": 1}}, "farthest_from was"),
        ({"farthest_from": "hall", "topic": "/other"}, "/other"),
        ({"farthest_from": "hall", "by": "hour"}, "farthest_from cannot be combined with by"),
        ({"farthest_from": {"x": 1, "y": 2}, "frame_id": "moon"}, 'frame_id was "moon"'),
    ],
)
def test_what_is_no_point_is_named(memory: Memory, given: dict[str, Any], said: str) -> None:
    span = {"start": ROOMS_BEGIN, "end": ROOMS_BEGIN + 60}
    reply = asked(memory, "trajectory_summary", **span, **given)
    assert said in reply["detail"]


@each_way
def test_a_path_by_transforms_is_whole_where_a_bag_reaches_from_1970_to_now(
    tmp_path: Path, recalls: bool
) -> None:
    """The clock was set while it was recorded: of half a million hours two have messages."""
    times = [20 * S, *(BEGIN + n * S // 10 for n in range(300))]
    poses = [tf(at, transform(at, "odom", "base_link", (1.0, 0, 0))) for at in times]
    write_mcap(tmp_path / "rec" / "rec_0.mcap", poses)
    memory = memory_of(tmp_path, recalls=recalls)
    # Each look at the clock takes 10 ms.
    call = Call(Deadline.after(20.0, partial(next, count(0.0, 0.01))))
    found = trajectory_summary(memory, call, TimeRange(0.0, BEGIN / S + 30))
    assert found.trajectory.poses == 301
    assert "out of time" not in str(found.notes)
