"""Where the robot was farthest from a point: compared with the poses themselves."""

from __future__ import annotations

import math
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.support.bags import odom, write_mcap
from tests.support.examples import examples
from tests.support.memories import asked, memory_of, with_store
from tests.support.moving_map import BEGIN as MAP_BEGIN
from tests.support.moving_map import write_moving_map
from tests.support.rooms import BEGIN, ROOMS, S, asked_of, draw, write

if TYPE_CHECKING:
    from ros2_memory.history.context import Memory

SECONDS = 200


@settings(max_examples=examples(8), deadline=None, suppress_health_check=[HealthCheck.too_slow])
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
        bounds = {"start": BEGIN + first, "end": BEGIN + first + 60}
        given: dict[str, Any] = {"where": ", ".join(rooms)} if rooms else {}
        point = {"x": x, "y": 1.0}
        reply = asked(
            memory, Path(name), "trajectory_summary", farthest_from=point, **bounds, **given
        )
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
        at = round(farthest["timestamp"] - BEGIN)
        assert poses[at] == pytest.approx(max(poses.values()), abs=1e-6)
        assert (farthest["x"], farthest["frame_id"]) == (world.x[at], "odom")
        assert farthest["from"] == {"x": pytest.approx(x, abs=1e-3), "y": 1.0}
        assert farthest.get("in") == world.room(at)


def test_where_there_is_a_map_the_point_is_in_it(tmp_path: Path) -> None:
    truth = write_moving_map(tmp_path, 3, seconds=60)
    memory = with_store(memory_of(tmp_path), tmp_path)
    span = {"start": MAP_BEGIN / S + 1, "end": MAP_BEGIN / S + 60}
    times = [at / S for at in truth.times if at >= MAP_BEGIN + S]  # transforms lead there from then
    reply = asked(memory, tmp_path, "trajectory_summary", farthest_from={"x": 0, "y": 0}, **span)
    farthest = reply["farthest"]
    assert (reply["frame_id"], farthest["frame_id"]) == ("odom", "map")
    positions = [
        row
        for nth in range(0, len(times), 20)
        for row in asked(
            memory,
            tmp_path,
            "get_position_at",
            timestamps=times[nth : nth + 20],
            frame_id="map",
        )["results"]
    ]
    away = [math.hypot(row["x"], row["y"]) for row in positions]
    assert len(away) == len(times)
    assert farthest["distance_m"] == pytest.approx(max(away), abs=0.01)


@pytest.fixture
def memory(tmp_path: Path) -> Memory:
    write(draw(1, 60), tmp_path)
    return asked_of(tmp_path, stored=False)


def test_the_middle_of_a_named_place_is_a_point(memory: Memory, tmp_path: Path) -> None:
    span = {"start": BEGIN, "end": BEGIN + 60}
    named, point = (
        asked(memory, tmp_path, "trajectory_summary", farthest_from=each, **span)["farthest"]
        for each in ("kitchen", {"x": 1.5, "y": 0.0})
    )
    assert named == point


def test_a_single_pose_far_away_is_none_that_the_robot_was_at(tmp_path: Path) -> None:
    x = [Random(nth).uniform(0, 3) for nth in range(50)]
    x[20] = 900.0
    poses = [odom((BEGIN * S) + nth * S, each, 0.0) for nth, each in enumerate(x)]
    write_mcap(tmp_path / "rec" / "rec_0.mcap", poses)
    memory = with_store(memory_of(tmp_path), tmp_path)
    for each in (memory, memory_of(tmp_path)):
        reply = asked(
            each,
            tmp_path,
            "trajectory_summary",
            farthest_from={"x": 0, "y": 0},
            start=BEGIN,
            end=BEGIN + 60,
        )
        assert reply["farthest"]["distance_m"] < 3


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
def test_what_is_no_point_is_named(
    memory: Memory, tmp_path: Path, given: dict[str, Any], said: str
) -> None:
    span = {"start": BEGIN, "end": BEGIN + 60}
    reply = asked(memory, tmp_path, "trajectory_summary", **span, **given)
    assert said in reply["detail"]
