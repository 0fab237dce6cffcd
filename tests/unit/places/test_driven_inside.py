"""What the robot drove while it was in a place, waypoints in another frame, the farthest pose."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.regions import Place, Rectangle
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.view import TimeRange
from ros2_memory.places.driven_inside import driven_inside
from ros2_memory.queries import trajectory_summary
from tests.support.bags import odom, tf, transform, write_mcap
from tests.support.examples import examples
from tests.support.memories import asked, each_way, memory_of, with_store
from tests.support.moving_map import BEGIN, MovingMap, S, write_moving_map
from tests.support.rooms import BEGIN as ROOMS_BEGIN
from tests.support.rooms import ROOMS, asked_of, draw, write

LEFT = {"x": [-1, 2], "y": [-1, 4]}
ALL = TimeRange(BEGIN / S, BEGIN / S + 1000)


def in_places(memory: Memory) -> Memory:
    places = (Place("left half", "map", Rectangle(-1, 2, -1, 4)),)
    return replace(memory, limits=replace(memory.limits, places=places))


def driven(truth: MovingMap, low: float, high: float) -> float:
    """Metres that were driven in the map between two x."""
    return sum(
        math.dist(before, after)
        for before, after in pairwise(truth.places)
        if low <= (before[0] + after[0]) / 2 <= high
    )


@pytest.mark.parametrize("split_s", [3.7, 300.0])
def test_metres_count_while_the_robot_is_in_a_place_and_corrections_of_the_map_add_none(
    tmp_path: Path, split_s: float
) -> None:
    truth = write_moving_map(tmp_path, 3, seconds=200, split_s=split_s)
    memory = in_places(memory_of(tmp_path))
    found = driven_inside(memory, Call(), ALL, where="left half")
    # In odom the drift of the map, which corrects it, is driven too.
    assert found.distance_m == pytest.approx(driven(truth, -1, 2), rel=0.1, abs=0.5)
    assert found.max_speed == pytest.approx(0.4, abs=0.1)
    assert (found.where, found.frame_id) == ("left half", "odom")
    whole = trajectory_summary(memory, Call(), ALL).trajectory.totals.distance_m
    right = driven_inside(memory, Call(), ALL, where={"x": [2, 6], "y": [-1, 4]})
    assert found.distance_m + right.distance_m == pytest.approx(whole, rel=0.02)


def test_a_reply_has_the_visits_and_where_each_was_entered(tmp_path: Path) -> None:
    write_moving_map(tmp_path, 3, seconds=200)
    memory = in_places(memory_of(tmp_path))
    span = {"start": BEGIN / S, "end": BEGIN / S + 1000}
    reply = asked(memory, tmp_path, "trajectory_summary", where="Left half", **span)
    there = asked(memory, tmp_path, "visits", where="left half", limit=100, **span)
    assert reply["where"] == "left half"
    assert reply["visits"] == there["total"] > 2
    assert reply["duration_s"] / 60 == pytest.approx(there["minutes"], abs=0.01)
    assert reply["avg_speed"] == pytest.approx(reply["distance_m"] / reply["duration_s"], abs=1e-3)
    assert sum(point.get("entered", False) for point in reply["waypoints"]) == there["total"]
    none = asked(memory, tmp_path, "trajectory_summary", where=LEFT, max_waypoints=0, **span)
    assert none["waypoints"] == []
    assert none["distance_m"] == reply["distance_m"]
    never = {"x": 90, "y": 90, "radius_m": 1}
    nowhere = asked(memory, tmp_path, "trajectory_summary", where=never, **span)
    assert (nowhere["visits"], nowhere["distance_m"], nowhere["start"]) == (0, 0, None)
    by = asked(memory, tmp_path, "trajectory_summary", where=never, by="day", **span)
    assert (by["rows"][0][-1], by["all"][-1]) == (0, 0)


def test_waypoints_are_in_the_own_frame_of_poses_or_in_the_one_asked_for(tmp_path: Path) -> None:
    write_moving_map(tmp_path, 3, seconds=60)
    memory = memory_of(tmp_path)
    span = {"start": BEGIN / S, "end": BEGIN / S + 1000}
    own = asked(memory, tmp_path, "trajectory_summary", **span)
    moved = asked(memory, tmp_path, "trajectory_summary", frame_id="map", **span)
    inside = asked(memory, tmp_path, "trajectory_summary", where=LEFT, frame_id="map", **span)
    assert own["frame_id"] == "odom"
    assert moved["frame_id"] == inside["frame_id"] == "map"
    assert moved["distance_m"] == own["distance_m"]
    assert [each["timestamp"] for each in moved["waypoints"]] == [
        each["timestamp"] for each in own["waypoints"]
    ]
    # Before the first correction no transform leads to the map, and the first one holds.
    for each in moved["waypoints"][1::4]:
        there = asked(
            memory, tmp_path, "get_position_at", timestamp=each["timestamp"], frame_id="map"
        )
        for name in ("x", "y", "yaw_deg"):
            assert each[name] == pytest.approx(there[name], abs=0.02)
    assert all(-1.1 <= each["x"] <= 2.1 for each in inside["waypoints"])
    with pytest.raises(InvalidArgumentsError, match="no transform leads there"):
        trajectory_summary(memory, Call(), ALL, frame_id="moon")


@each_way
def test_no_drawn_way_leads_across_a_jump_of_the_map(tmp_path: Path, recalls: bool) -> None:
    """Drives straight on in odometry, while the map is corrected by 10 m to the side, once."""
    messages = []
    for step in range(600):
        at, off_m = BEGIN + step * S // 10, 0.0 if step < 300 else 10.0
        pose = transform(at, "odom", "base_link", (step * 0.03, 0.0, 0.0))
        messages += [
            odom(at, step * 0.03, 0.0, vx=0.3),
            tf(at, transform(at, "map", "odom", (0.0, off_m, 0.0)), pose),
        ]
    write_mcap(tmp_path / "rec" / "rec_0.mcap", messages)
    memory = memory_of(tmp_path, recalls=recalls)
    span = {"start": BEGIN / S, "end": BEGIN / S + 100}
    own = asked(memory, tmp_path, "trajectory_summary", **span)
    moved = asked(memory, tmp_path, "trajectory_summary", frame_id="map", **span)
    assert [each.get("jump", False) for each in own["waypoints"]] == [False, False]
    assert [(each["y"], each.get("jump", False)) for each in moved["waypoints"]] == [
        (0.0, False),
        (10.0, True),
    ]
    note = "map jumped before 1 waypoint: the line to there was not driven"
    assert note in moved["notes"]
    assert note not in own["notes"]


def test_the_metres_of_a_stop_are_none_and_speeds_are_those_inside(tmp_path: Path) -> None:
    """Drives 1 m/s to x = 10, stands there for 10 s, and drives on at 0.2 m/s."""
    messages = []
    for step in range(300):
        seconds = step / 10
        x = min(seconds, 10.0) + max(0.0, seconds - 20.0) * 0.2
        messages.append(odom(BEGIN + step * S // 10, x, 0.0))
    write_mcap(tmp_path / "bag.mcap", messages)
    memory = memory_of(tmp_path)

    def between(low: float, high: float) -> tuple[float, float | None]:
        found = driven_inside(memory, Call(), ALL, where={"x": [low, high], "y": [-1, 1]})
        return found.distance_m, found.max_speed

    assert between(2, 6) == pytest.approx((4.0, 1.0), abs=0.02)
    assert between(10, 11) == pytest.approx((1.0, 0.2), abs=0.05)
    assert between(9, 12) == pytest.approx((2.98, 1.0), abs=0.05)


def test_a_jump_out_of_a_place_and_back_adds_nothing_to_what_few_poses_drove_inside(
    tmp_path: Path,
) -> None:
    # 0.2 m/s along x, and one pose that is 80 m away.
    places = [(0.2 * n if n != 4 else 80.0) for n in range(9)]
    messages = [odom(BEGIN + n * S, x, 0.0) for n, x in enumerate(places)]
    write_mcap(tmp_path / "rec" / "rec_0.mcap", messages)
    where = {"x": [-1, 2], "y": [-1, 1]}
    span = {"start": BEGIN / S, "end": BEGIN / S + 8}
    reply = asked(memory_of(tmp_path), tmp_path, "trajectory_summary", where=where, **span)
    assert reply["distance_m"] == pytest.approx(1.2, abs=0.05)
    assert reply["max_speed"] == pytest.approx(0.2, abs=0.05)


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
    inside = asked(memory, tmp_path, "trajectory_summary", where=where, **window)
    assert len(inside["waypoints"]) == 2
    for each in inside["waypoints"]:
        there = asked(memory, tmp_path, "get_position_at", timestamp=each["timestamp"])
        assert each["yaw_deg"] == there["yaw_deg"]


SECONDS = 200


@settings(max_examples=examples(8), suppress_health_check=[HealthCheck.too_slow])
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
        at = round(farthest["timestamp"] - ROOMS_BEGIN)
        assert poses[at] == pytest.approx(max(poses.values()), abs=1e-6)
        assert (farthest["x"], farthest["frame_id"]) == (world.x[at], "odom")
        assert farthest["from"] == {"x": pytest.approx(x, abs=1e-3), "y": 1.0}
        assert farthest.get("in") == world.room(at)


def test_where_there_is_a_map_the_point_is_in_it(tmp_path: Path) -> None:
    truth = write_moving_map(tmp_path, 3, seconds=60)
    memory = with_store(memory_of(tmp_path), tmp_path)
    span = {"start": BEGIN / S + 1, "end": BEGIN / S + 60}
    times = [at / S for at in truth.times if at >= BEGIN + S]  # transforms lead there from then
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
    span = {"start": ROOMS_BEGIN, "end": ROOMS_BEGIN + 60}
    named, point = (
        asked(memory, tmp_path, "trajectory_summary", farthest_from=each, **span)["farthest"]
        for each in ("kitchen", {"x": 1.5, "y": 0.0})
    )
    assert named == point


def test_a_single_pose_far_away_is_none_that_the_robot_was_at(tmp_path: Path) -> None:
    x = [Random(nth).uniform(0, 3) for nth in range(50)]
    x[20] = 900.0
    poses = [odom((ROOMS_BEGIN * S) + nth * S, each, 0.0) for nth, each in enumerate(x)]
    write_mcap(tmp_path / "rec" / "rec_0.mcap", poses)
    memory = with_store(memory_of(tmp_path), tmp_path)
    for each in (memory, memory_of(tmp_path)):
        reply = asked(
            each,
            tmp_path,
            "trajectory_summary",
            farthest_from={"x": 0, "y": 0},
            start=ROOMS_BEGIN,
            end=ROOMS_BEGIN + 60,
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
    span = {"start": ROOMS_BEGIN, "end": ROOMS_BEGIN + 60}
    reply = asked(memory, tmp_path, "trajectory_summary", **span, **given)
    assert said in reply["detail"]
