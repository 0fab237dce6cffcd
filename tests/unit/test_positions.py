"""Positions come from whatever carries one, and refusals name what does."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from ros2_memory.core.model import TimeWindow
from ros2_memory.core.regions import Circle, Place, Rectangle
from ros2_memory.history.context import Call, Memory, QuerySettings
from ros2_memory.history.view import View
from ros2_memory.places.local_map import fixes_in
from tests.support.bags import (
    Msg,
    boolean,
    header,
    make,
    odom,
    point,
    quaternion,
    text,
    tf,
    transform,
    write_mcap,
)
from tests.support.memories import asked, each_way, memory_of, with_store
from tests.support.noting_reader import NotingReader

if TYPE_CHECKING:
    from pathlib import Path

S = 10**9
T0_S = 1_784_000_000
T0 = T0_S * S
YAW = math.radians(30)


def pose_stamped(ns: int, x: float, y: float, topic: str = "/pose") -> Msg:
    pose = make("geometry_msgs/msg/Pose", position=point(x, y), orientation=quaternion(YAW))
    body = make("geometry_msgs/msg/PoseStamped", header=header(ns, "map"), pose=pose)
    return Msg(topic, "geometry_msgs/msg/PoseStamped", ns, body)


def with_covariance(ns: int, x: float, y: float) -> Msg:
    pose = make("geometry_msgs/msg/Pose", position=point(x, y), orientation=quaternion(YAW))
    spread = make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36))
    body = make(
        "geometry_msgs/msg/PoseWithCovarianceStamped", header=header(ns, "map"), pose=spread
    )
    return Msg("/amcl_pose", "geometry_msgs/msg/PoseWithCovarianceStamped", ns, body)


def turtle(ns: int, x: float, y: float) -> Msg:
    body = make(
        "turtlesim/msg/Pose", x=x, y=y, theta=YAW, linear_velocity=0.5, angular_velocity=-0.25
    )
    return Msg("/turtle1/pose", "turtlesim/msg/Pose", ns, body)


def vehicle(ns: int, x: float, y: float) -> Msg:
    def triple(*parts: float) -> Any:
        return np.array(parts, dtype=np.float32)

    body = make(
        "px4_msgs/msg/VehicleOdometry",
        timestamp=ns // 1000,
        timestamp_sample=ns // 1000,
        pose_frame=1,
        position=triple(x, y, -2.0),
        q=triple(math.cos(YAW / 2), 0.0, 0.0, math.sin(YAW / 2)),
        velocity_frame=3,
        velocity=triple(0.5, 0.0, 0.0),
        angular_velocity=triple(0.0, 0.0, -0.25),
        position_variance=triple(0.0, 0.0, 0.0),
        orientation_variance=triple(0.0, 0.0, 0.0),
        velocity_variance=triple(0.0, 0.0, 0.0),
        reset_counter=0,
        quality=100,
    )
    return Msg("/fmu/out/vehicle_odometry", "px4_msgs/msg/VehicleOdometry", ns, body)


def local(ns: int, x: float, y: float) -> Msg:
    body = make(
        "px4_msgs/msg/VehicleLocalPosition",
        timestamp=ns // 1000,
        xy_valid=True,
        x=x,
        y=y,
        z=-2.0,
        heading=YAW,
    )
    kind = "px4_msgs/msg/VehicleLocalPosition"
    return Msg("/fmu/out/vehicle_local_position", kind, ns, body)


def walking(ns: int, x: float, y: float) -> Msg:
    turn = np.array([math.cos(YAW / 2), 0.0, 0.0, math.sin(YAW / 2)], np.float32)
    body = make(
        "unitree_go/msg/SportModeState",
        error_code=0,
        imu_state=make("unitree_go/msg/IMUState", quaternion=turn),
        mode=3,
        gait_type=1,
        position=np.array([x, y, 0.3], np.float32),
        body_height=0.3,
        velocity=np.array([0.5, 0.0, 0.0], np.float32),
        yaw_speed=0.0,
        range_obstacle=np.zeros(4, np.float32),
        foot_force=np.zeros(4, np.int16),
    )
    return Msg("/sportmodestate", "unitree_go/msg/SportModeState", ns, body)


def tracked(ns: int, x: float, y: float) -> Msg:
    body = transform(ns, "world", "robot", (x, y, 0.0), YAW)
    return Msg("/vicon/robot", "geometry_msgs/msg/TransformStamped", ns, body)


def fix(ns: int, north: float, east: float, status: int = 0) -> Msg:
    body = make(
        "sensor_msgs/msg/NavSatFix",
        header=header(ns, "gps"),
        status=make("sensor_msgs/msg/NavSatStatus", status=status, service=1),
        latitude=48.1234567 + north,
        longitude=11.7654321 + east,
        altitude=519.5,
        position_covariance=np.zeros(9),
        position_covariance_type=0,
    )
    return Msg("/fix", "sensor_msgs/msg/NavSatFix", ns, body)


CARRIERS = {
    "/pose": (pose_stamped, "map", 0.0),
    "/amcl_pose": (with_covariance, "map", 0.0),
    "/turtle1/pose": (turtle, None, 0.0),
    "/fmu/out/vehicle_odometry": (vehicle, "NED", -2.0),
    "/fmu/out/vehicle_local_position": (local, None, -2.0),
    "/sportmodestate": (walking, None, 0.3),
    "/vicon/robot": (tracked, "world", 0.0),
}


@lru_cache(maxsize=2)
def remembered(bag_dir: Path, recalls: bool) -> Memory:
    return memory_of(bag_dir, recalls=recalls)


def ask(bag_dir: Path, recalls: bool, tool: str, **given: Any) -> Any:
    limits = QuerySettings(**given.pop("limits", {}))
    return asked(replace(remembered(bag_dir, recalls), limits=limits), bag_dir, tool, **given)


def driven(topic: str) -> list[Msg]:
    """60 s at 0.5 m/s, ten times a second, to the side."""
    made = CARRIERS[topic][0]
    return [made(T0 + n * S // 10, 1.0 + n * 0.05, 2.0) for n in range(601)]


@each_way
@pytest.mark.parametrize("topic", CARRIERS)
def test_whatever_carries_a_position_answers_where_and_how_far(
    tmp_path: Path, recalls: bool, topic: str
) -> None:
    messages = driven(topic)
    for split in range(3):
        path = tmp_path / "rec" / f"rec_{split}.mcap"
        write_mcap(path, messages[201 * split : 201 * split + 201])
    _, frame, z = CARRIERS[topic]
    here = ask(tmp_path, recalls, "get_position_at", topic=topic, timestamp=T0_S + 10)
    assert (here["x"], here["y"], here["z"]) == pytest.approx((6.0, 2.0, z), abs=1e-4)
    assert here["yaw_deg"] == pytest.approx(30.0, abs=0.01)
    assert here["frame_id"] == frame
    assert "latitude" not in here
    way = ask(tmp_path, recalls, "trajectory_summary", topic=topic, start=T0_S, end=T0_S + 60)
    assert way["distance_m"] == pytest.approx(30.0, rel=0.002)
    near = ask(
        tmp_path,
        recalls,
        "find_last_match",
        topic=topic,
        condition_type="near_position",
        value={"x": 6.0, "y": 2.0},
    )
    assert near["timestamp"] == pytest.approx(T0_S + 11, abs=0.11)
    visits = ask(
        tmp_path, recalls, "visits", x=6.0, y=2.0, radius_m=0.5, limits={"pose_topic": topic}
    )
    assert visits["total"] == 1


@each_way
@pytest.mark.parametrize("topic", ["/turtle1/pose", "/fmu/out/vehicle_odometry"])
def test_whatever_carries_a_velocity_answers_how_fast(
    tmp_path: Path, recalls: bool, topic: str
) -> None:
    write_mcap(tmp_path / "rec" / "rec_0.mcap", driven(topic))
    reply = ask(tmp_path, recalls, "get_velocity_at", topic=topic, timestamp=T0_S + 10)
    assert reply["linear"] == {"x": 0.5, "y": 0.0, "z": 0.0}
    assert reply["angular"] == {"x": 0.0, "y": 0.0, "z": -0.25}
    assert reply["frame_id"] == ("body FRD" if "vehicle" in topic else None)


def test_fields_of_a_vehicles_odometry_read_as_a_point_and_angles(tmp_path: Path) -> None:
    write_mcap(tmp_path / "rec" / "rec_0.mcap", [vehicle(T0, 1.0, 2.0)])
    given = {"topic": "/fmu/out/vehicle_odometry", "timestamp": T0_S}
    value = ask(tmp_path, False, "get_topic_at_time", **given)["value"]
    assert value["position"] == {"x": 1.0, "y": 2.0, "z": -2.0}
    assert value["orientation"]["yaw_deg"] == pytest.approx(30.0, abs=0.01)
    part = ask(tmp_path, False, "get_topic_at_time", **given, fields=["position.x", "q"])["value"]
    assert part["position.x"] == 1.0
    assert len(part["q"]) == 4


@each_way
def test_a_satellite_fix_is_reported_in_degrees(tmp_path: Path, recalls: bool) -> None:
    write_mcap(tmp_path / "rec" / "rec_0.mcap", [fix(T0 + n * S, n * 1e-5, 0.0) for n in range(9)])
    assert ask(tmp_path, recalls, "get_position_at", topic="/fix", timestamp=T0_S + 2) == {
        "x": None,
        "y": None,
        "z": None,
        "yaw_deg": None,
        "latitude": 48.1234767,
        "longitude": 11.7654321,
        "altitude": 519.5,
        "timestamp": T0_S + 2.0,
        "topic": "/fix",
        "frame_id": "gps",
    }
    way = {"topic": "/fix", "start": T0_S, "end": T0_S + 9}
    refused = ask(tmp_path, recalls, "trajectory_summary", **way)
    assert "latitude and longitude in degrees, and no position in metres" in refused["detail"]
    near = {"topic": "/fix", "condition_type": "near_position", "value": {"x": 48.12, "y": 11.77}}
    refused = ask(tmp_path, recalls, "find_last_match", **near)
    assert "degrees" in refused["detail"]
    only = ask(tmp_path, recalls, "get_position_at", timestamp=T0_S + 2)
    assert only["topic"] == "/fix"
    assert only["notes"][0].startswith("by /fix, the only topic for it: data.pose_topic is /odom")


GLOBAL = "px4_msgs/msg/VehicleGlobalPosition"


@pytest.mark.parametrize("kind", [GLOBAL, "geographic_msgs/msg/GeoPointStamped"])
def test_degrees_of_an_unlisted_type_are_named_and_reported(tmp_path: Path, kind: str) -> None:
    if kind == GLOBAL:
        body = make(kind, timestamp=0, lat=54.5, lon=10.25, alt=40.0)
    else:
        there = make("geographic_msgs/msg/GeoPoint", latitude=54.5, longitude=10.25, altitude=40.0)
        body = make(kind, header=header(T0, "earth"), position=there)
    write_mcap(tmp_path / "bag.mcap", [text(T0, "up"), Msg("/where", kind, T0, body)])
    at = {"timestamp": T0_S}
    detail = ask(tmp_path, False, "get_position_at", **at)["detail"]
    assert f"latitude and longitude are on /where ({kind}): give topic" in detail
    found = ask(tmp_path, False, "get_position_at", topic="/where", **at)
    assert (found["latitude"], found["longitude"], found["altitude"]) == (54.5, 10.25, 40.0)
    assert found["x"] is None
    way = {"topic": "/where", "start": T0_S, "end": T0_S + 1}
    assert "in degrees" in ask(tmp_path, False, "trajectory_summary", **way)["detail"]


def test_numbers_that_are_no_degrees_are_no_position(tmp_path: Path) -> None:
    scaled = make(GLOBAL, timestamp=0, lat=545000000.0, lon=102500000.0, alt=40.0)
    write_mcap(tmp_path / "bag.mcap", [Msg("/where", GLOBAL, T0, scaled)])
    refused = ask(tmp_path, False, "get_position_at", topic="/where", timestamp=T0_S)
    assert "carries no position" in refused["detail"]


def test_numbers_without_a_fix_are_told_where_they_count(tmp_path: Path) -> None:
    states = [fix(T0 + n * S, 0.0, 0.0, -1 if n == 4 else 0) for n in range(9)]
    write_mcap(tmp_path / "bag.mcap", states)
    height = {"topic": "/fix", "fields": ["altitude"], "start": T0_S}
    for given in ({}, {"by": "hour"}):
        reply = ask(tmp_path, False, "get_topic_in_range", end=T0_S + 8, **height, **given)
        told = [note for note in reply["notes"] if note.startswith(f"until {T0_S + 4}")]
        assert "have no fix (fix_status -1)" in told[0]
    before = ask(tmp_path, False, "get_topic_in_range", end=T0_S + 3, **height)
    assert not any("no fix" in note for note in before.get("notes", ()))


def test_numbers_without_a_fix_are_looked_for_in_the_window_alone(tmp_path: Path) -> None:
    for n in range(9):
        write_mcap(tmp_path / f"bag_{n}.mcap", [fix(T0 + n * S, 0.0, 0.0, 0)])
    reader = NotingReader()
    memory = memory_of(tmp_path, reader=reader)
    memory.index.snapshot()
    reader.asked.clear()
    given = {"topic": "/fix", "fields": ["altitude"], "start": T0_S + 8, "end": T0_S + 9}
    reply = asked(memory, tmp_path, "get_topic_in_range", **given)
    assert "altitude" in str(reply)
    assert not {*reader.names} & {f"bag_{n}.mcap" for n in range(5)}


def test_the_axes_of_a_north_east_down_frame_are_told(tmp_path: Path) -> None:
    write_mcap(tmp_path / "bag.mcap", [vehicle(T0 + n * S, n, 0.0) for n in range(9)])
    topic, above = "/fmu/out/vehicle_odometry", {"condition_type": "above", "value": 1.0}
    note = "in NED x is north, y east and z down: yaw_deg is clockwise from north, seen from above"
    for tool, given in (
        ("get_position_at", {"timestamp": T0_S + 1}),
        ("trajectory_summary", {"start": T0_S, "end": T0_S + 5}),
        ("find_matches", {"topic": topic, **above, "field": "position.z"}),
        ("find_last_match", {"topic": topic, **above, "field": "position.z"}),
    ):
        assert note in ask(tmp_path, False, tool, **given)["notes"]


ABOUT_POSES: list[tuple[str, dict[str, Any]]] = [
    ("get_position_at", {"timestamp": T0_S + 1}),
    ("trajectory_summary", {"start": T0_S, "end": T0_S + 5}),
    ("visits", {"x": 0.0, "y": 0.0}),
]


def test_a_position_without_a_fix_says_so_and_is_in_no_map(tmp_path: Path) -> None:
    states = [fix(T0 + n * S, n * 1e-5, 0.0, -1 if n < 5 else 0) for n in range(9)]
    write_mcap(tmp_path / "rec" / "rec_0.mcap", states)
    memory = memory_of(tmp_path)
    for at, has_fix in ((4, False), (5, True)):
        found = asked(memory, tmp_path, "get_position_at", timestamp=T0 / S + at, topic="/fix")
        assert found["latitude"] == pytest.approx(48.1234567 + at * 1e-5)
        assert any(note.startswith("no fix") for note in found.get("notes", ())) != has_fix
    _, fixes = fixes_in(View(memory, Call()), "/fix", TimeWindow.everything())
    assert [at for at, _ in fixes] == [T0 + n * S for n in range(5, 9)]


@pytest.mark.parametrize(("tool", "given"), ABOUT_POSES)
def test_where_the_pose_topic_is_not_recorded_the_one_with_poses_is_named(
    tmp_path: Path, tool: str, given: dict[str, Any]
) -> None:
    others = [text(T0, "up", "/rosout"), boolean(T0, True)]
    two = [pose_stamped(T0 + S, 1.0, 2.0, name) for name in ("/pose", "/slam")]
    write_mcap(tmp_path / "rec" / "rec_0.mcap", [*others, *two])
    reply = ask(tmp_path, False, tool, **given)
    assert (reply["error"], reply["reason"]) == ("no_data", "topic_not_recorded")
    assert "data.pose_topic is /odom, which these bags do not have" in reply["detail"]
    assert "poses are on /pose (geometry_msgs/msg/PoseStamped)" in reply["detail"]
    assert "set data.pose_topic to one of them" in reply["detail"]
    assert "/rosout" not in reply["detail"]


@each_way
@pytest.mark.parametrize(
    ("tool", "given"),
    [
        ("trajectory_summary", {"start": T0_S, "end": T0_S + 5}),
        ("visits", {"x": 0.0, "y": 0.0}),
        ("recap", {"start": T0_S, "end": T0_S + 5}),
        ("get_velocity_at", {"timestamp": T0_S + 1}),
    ],
)
def test_nobody_is_sent_to_a_satellite_fix_that_the_tool_then_refuses(
    tmp_path: Path, recalls: bool, tool: str, given: dict[str, Any]
) -> None:
    write_mcap(tmp_path / "rec" / "rec_0.mcap", [fix(T0 + n * S, n * 1e-5, 0.0) for n in range(9)])
    reply = ask(tmp_path, recalls, tool, **given)
    detail = reply["notes"][0] if tool == "recap" else reply["detail"]
    assert "data.pose_topic=/fix" not in detail
    assert "give topic" not in detail
    in_degrees = "(sensor_msgs/msg/NavSatFix): get_position_at answers them by topic"
    assert (in_degrees in detail) == (tool != "get_velocity_at")
    assert "data.pose_topic is /odom" in detail


@pytest.mark.parametrize(("tool", "given"), ABOUT_POSES)
def test_a_topic_of_an_unlisted_type_is_named_where_its_messages_have_poses(
    tmp_path: Path, tool: str, given: dict[str, Any]
) -> None:
    write_mcap(tmp_path / "rec" / "rec_0.mcap", [text(T0, "up"), local(T0 + S, 1.0, 2.0)])
    detail = ask(tmp_path, False, tool, **given)["detail"]
    assert "poses are on /fmu/out/vehicle_local_position" in detail
    assert "set data.pose_topic=/fmu/out/vehicle_local_position" in detail
    assert "/chatter" not in detail


def test_where_a_satellite_receiver_has_degrees_alone_the_place_is_by_transforms(
    tmp_path: Path,
) -> None:
    seconds = range(9)
    messages = [fix(T0 + n * S, n * 1e-5, 0.0) for n in seconds]
    messages += [
        tf(T0 + n * S, transform(T0 + n * S, "odom", "base_link", (n, 0.0, 0.0))) for n in seconds
    ]
    write_mcap(tmp_path / "rec" / "rec_0.mcap", messages)
    told = ask(tmp_path, False, "get_position_at", timestamp=T0_S + 3)
    assert (told["x"], told["frame_id"]) == (3.0, "odom")
    assert told["latitude"] is not None
    [visit] = ask(tmp_path, False, "visits", x=3.0, y=0.0, radius_m=0.5)["visits"]
    assert visit["arrived"] == T0_S + 3
    of_topic = ask(tmp_path, False, "get_position_at", timestamp=T0_S + 3, topic="/fix")
    assert of_topic["x"] is None


def moved(tenths: range) -> list[Msg]:
    """The body driving at 1 m/s in the map, ten transforms a second, from 1 m on."""
    return [
        tf(
            T0 + n * S // 10,
            transform(T0 + n * S // 10, "map", "odom", (1.0, 0.0, 0.0)),
            transform(T0 + n * S // 10, "odom", "base_link", (n / 10, 0.0, 0.0)),
        )
        for n in tenths
    ]


FIXES = [fix(T0 + n * S, n * 1e-5, 0.0) for n in range(60)]
BODY_NOTE = "by transforms, of base_link: no topic has the robot's poses"


@each_way
@pytest.mark.parametrize("others", [[], FIXES, [*FIXES, *(replace(f, topic="/b") for f in FIXES)]])
def test_a_position_by_transforms_is_that_of_the_newest_one(
    tmp_path: Path, recalls: bool, others: list[Msg]
) -> None:
    write_mcap(tmp_path / "rec" / "rec_0.mcap", [*moved(range(600)), *others])
    for asked_s, known_s in ((20.04, 20.0), (20.54, 20.5), (59.96, 59.9)):
        reply = ask(tmp_path, recalls, "get_position_at", timestamp=T0_S + asked_s)
        assert (reply["timestamp"], reply["x"]) == pytest.approx((T0_S + known_s, 1 + known_s))
        assert (reply["topic"], reply["frame_id"], reply["notes"]) == ("/tf", "map", [BODY_NOTE])
        assert ("latitude" in reply) == (others == FIXES and known_s == 20.0)
    given = {"timestamp": T0_S + 20.04, "frame_id": "odom"}
    assert ask(tmp_path, recalls, "get_position_at", **given)["x"] == 20.0
    before = ask(tmp_path, recalls, "get_position_at", timestamp=T0_S + 60.5)
    assert (before["reason"], "x" in before) == ("outside_range", False)
    near = ask(tmp_path, recalls, "get_position_at", timestamp=T0_S + 60.5, tolerance_s=1)
    assert near["timestamp"] == pytest.approx(T0_S + 59.9)
    limits = {"now": "latest"}
    ago = ask(tmp_path, recalls, "get_position_seconds_ago", seconds_ago=9.96, limits=limits)
    assert (ago["x"], ago["age_s"]) == pytest.approx((50.9, 10.0))


@each_way
def test_in_a_gap_of_transforms_no_position_is_known(tmp_path: Path, recalls: bool) -> None:
    messages = [*moved(range(100)), *moved(range(400, 600)), *FIXES]
    write_mcap(tmp_path / "rec" / "rec_0.mcap", messages)
    for given in ({}, {"frame_id": "odom"}, {"topic": "/tf"}):
        reply = ask(tmp_path, recalls, "get_position_at", timestamp=T0_S + 25, **given)
        assert (reply["error"], reply["reason"]) == ("no_data", "gap")
        assert "no message of /tf within 10 s" in reply["detail"]
        assert "latitude and longitude are on /fix" in reply["detail"]
    reply = ask(tmp_path, recalls, "get_position_at", timestamp=T0_S + 25, topic="/fix")
    assert (reply["x"], reply["latitude"]) == (None, 48.1237067)


def test_slow_transforms_have_no_position_between_them_as_poses_have_none(tmp_path: Path) -> None:
    write_mcap(tmp_path / "rec" / "rec_0.mcap", moved(range(0, 600, 10)))
    reply = ask(tmp_path, False, "get_position_at", timestamp=T0_S + 20.5)
    assert reply["reason"] == "between_messages"
    reply = ask(tmp_path, False, "get_position_at", timestamp=T0_S + 20.5, tolerance_s=1)
    assert (reply["timestamp"], reply["x"]) == (T0_S + 20, 21.0)
    refused = ask(tmp_path, False, "get_velocity_at", timestamp=T0_S + 1)["detail"]
    assert "transforms are on /tf: get_position_at and trajectory_summary answer by" in refused


@each_way
def test_transforms_that_are_asked_for_answer_beside_poses(tmp_path: Path, recalls: bool) -> None:
    poses = [odom(T0 + n * S // 10, -9.0, 0.0) for n in range(600)]
    write_mcap(tmp_path / "rec" / "rec_0.mcap", [*moved(range(600)), *poses])
    span = {"start": T0_S, "end": T0_S + 30}
    given = {"timestamp": T0_S + 20}
    assert ask(tmp_path, recalls, "get_position_at", **given)["x"] == -9.0
    assert ask(tmp_path, recalls, "trajectory_summary", **span)["distance_m"] == 0.0
    at = ask(tmp_path, recalls, "get_position_at", topic="/tf", **given)
    way = ask(tmp_path, recalls, "trajectory_summary", topic="/tf", **span)
    assert (at["x"], way["distance_m"]) == (21.0, 30.0)
    assert at["notes"] == ["by transforms, of base_link"]


@each_way
@pytest.mark.parametrize("others", [[], FIXES, [pose_stamped(T0, 9.0, 9.0, "/goal_pose")]])
def test_every_tool_that_places_the_robot_takes_its_transforms(
    tmp_path: Path, recalls: bool, others: list[Msg]
) -> None:
    bumped = [boolean(T0 + n * S, n > 5) for n in range(60)]
    write_mcap(tmp_path / "rec" / "rec_0.mcap", [*moved(range(600)), *others, *bumped])
    near = {"x": 11.0, "y": 0.0, "radius_m": 1.0}
    span = {"start": T0_S, "end": T0_S + 59}
    other = {"with_start": T0_S + 30, "with_end": T0_S + 59}
    asked_for: list[tuple[str, dict[str, Any]]] = [
        ("get_position_at", {"timestamp": T0_S + 20}),
        ("visits", near),
        ("visits", {**near, "by": "hour", **span}),
        ("recap", span),
        ("recap", {**span, "where": near}),
        ("recap", {"around": T0_S + 6, "seconds_before": 3}),
        ("trajectory_summary", span),
        ("trajectory_summary", {**span, "by": "hour"}),
        ("trajectory_summary", {**span, "by": "place"}),
        ("trajectory_summary", {**span, "where": near}),
        ("compare", {"start": T0_S, "end": T0_S + 29, **other}),
        ("find_matches", {"topic": "/bumper", "condition_type": "equals", "value": True, **span}),
    ]
    limits = {"places": (Place("door", "map", Circle(11.0, 0.0, 1.0)),)}
    found = [ask(tmp_path, recalls, tool, **given, limits=limits) for tool, given in asked_for]
    for reply, (tool, given) in zip(found, asked_for, strict=True):
        assert BODY_NOTE in reply["notes"], (tool, given, reply)
    position, visits, by_hour, _, there, before, way, metres, of_place, inside, apart, match = found
    assert (position["x"], visits["total"], by_hour["all"][2]) == (21.0, 1, 1)
    assert (there["distance_m"], inside["distance_m"]) == pytest.approx((2.0, 2.0), abs=0.1)
    assert (before["robot"]["x"], match["sightings"][0]["robot"]["x"]) == (7.0, 7.0)
    assert (way["distance_m"], metres["all"][1]) == pytest.approx((59.0, 59.0), abs=0.1)
    assert of_place["rows"][0] == ["door", 2.0, 2.0]
    assert (apart["frame_id"], apart["farthest_apart"]["this"]["away_m"]) == ("map", 30.0)


@each_way
def test_the_path_by_transforms_is_that_by_poses(tmp_path: Path, recalls: bool) -> None:
    """A drive and a standstill at 10 Hz; corrections of the map, of 5 cm, are no way of it."""
    transforms: list[Msg] = []
    poses: list[Msg] = []
    for nth in range(300):
        at, x = T0 + nth * S // 10, min(nth / 10, 10.0)
        odometry = transform(at, "odom", "base_link", (x, 0.0, 0.0))
        drift = transform(at, "map", "odom", (0.0, nth // 10 % 2 * 0.05, 0.0))
        transforms += [tf(at, odometry), tf(at, drift)]
        poses.append(odom(at, x, 0.0, 0.0))
    write_mcap(tmp_path / "tf" / "rec_0" / "rec_0_0.mcap", transforms)
    write_mcap(tmp_path / "poses" / "rec_0" / "rec_0_0.mcap", poses)
    door = Place("door", "map", Circle(10.0, 0.3, 1.0))
    span = {"start": T0_S, "end": T0_S + 30}
    where = {"x": 5.0, "y": 0.0, "radius_m": 1.0}
    by: dict[str, Any] = {}
    for each, limits in (("tf", {"places": (door,)}), ("poses", {"map_frame": "odom"})):
        by[each] = {
            tool: ask(tmp_path / each, recalls, tool, **given, limits=limits)
            for tool, given in (
                ("trajectory_summary", span),
                ("recap", span),
                ("visits", {"where": where, **span}),
            )
        }
    for tool, keys in (
        ("trajectory_summary", ("distance_m", "max_speed", "duration_s")),
        ("recap", ("distance_m", "stood_s")),
        ("visits", ("total", "entries", "exits", "minutes")),
    ):
        one, other = by["tf"][tool], by["poses"][tool]
        assert [one[key] for key in keys] == pytest.approx([other[key] for key in keys], abs=0.11)
        assert one["notes"][0].startswith("by transforms, of base_link"), tool
    assert by["tf"]["trajectory_summary"]["frame_id"] == "odom"
    [stop] = [each for each in by["tf"]["recap"]["events"] if each["text"].startswith("stood")]
    assert stop["in"] == "door"
    there = ask(tmp_path / "tf", recalls, "visits", limits={"places": (door,)})["places"]
    assert (there[0]["place"], there[0]["entries"]) == ("door", 1)


def test_bodies_of_other_robots_are_named(tmp_path: Path) -> None:
    messages = [
        tf(T0 + n * S, *(transform(T0 + n * S, *pair, (x, 0.0, 0.0)) for pair, x in edges))
        for n in range(9)
        for edges in [
            [
                (("map", "one/base_link"), n),
                (("one/base_link", "one/arm/base_link"), 0.1 * n),
                (("map", "two/base_link"), 5.0),
            ]
        ]
    ]
    write_mcap(tmp_path / "rec_0" / "rec_0_0.mcap", messages)
    notes = ask(tmp_path, False, "visits", x=5.0, y=0.0)["notes"]
    assert "by transforms, of one/base_link: no topic has the robot's poses" in notes
    assert "not of two/base_link, as of other robots" in notes


def test_a_path_by_transforms_has_a_bound_but_visits_have_none(tmp_path: Path) -> None:
    for nth in range(130):
        at = T0 + nth * 10 * S
        moved = [
            tf(at + n * S, transform(at + n * S, "odom", "base_link", (0, 0, 0))) for n in range(2)
        ]
        write_mcap(tmp_path / "rec_0" / f"rec_0_{nth}.mcap", moved)
    refused = ask(tmp_path, False, "trajectory_summary", start=T0_S, end=T0_S + 1300)
    assert refused["error"] == "invalid_arguments"
    assert "read from 128 bags at most: these are 130; ask about a shorter" in refused["detail"]
    assert ask(tmp_path, False, "visits", x=0.0, y=0.0)["total"] == 1


def test_the_body_is_placed_in_the_map_and_in_a_named_place(tmp_path: Path) -> None:
    at = T0 + S
    chain = (
        transform(at, "map", "odom", (5.0, 0.0, 0.0)),
        transform(at, "odom", "base_link", (1.0, 0.0, 0.0), YAW),
        transform(at, "base_link", "arm", (0.0, 9.0, 0.0)),
    )
    write_mcap(tmp_path / "rec" / "rec_0.mcap", [tf(at, *chain)])
    hall = Place("hall", "map", Rectangle(0.0, 9.0, -2.0, 2.0))
    limits = {"places": (hall, Place("door", "map", Circle(6.0, 0.0, 0.5)))}
    found = ask(tmp_path, False, "get_position_at", timestamp=T0_S + 1, limits=limits)
    assert (found["x"], found["frame_id"]) == (6.0, "map")
    assert (found["in"], found["also_in"]) == ("door", ["hall"])
    assert found["yaw_deg"] == pytest.approx(30)
    asked_for = {"timestamp": T0_S + 1, "frame_id": "odom"}
    assert ask(tmp_path, False, "get_position_at", **asked_for)["x"] == 1.0
    assert "error" in ask(tmp_path, False, "get_position_at", timestamp=T0_S + 300)


def test_where_no_topic_has_velocities_the_tool_that_computes_them_is_named(tmp_path: Path) -> None:
    poses = [pose_stamped(T0 + n * S, float(n), 0.0, "/pose") for n in range(5)]
    write_mcap(tmp_path / "rec" / "rec_0.mcap", poses)
    detail = ask(tmp_path, False, "get_velocity_at", timestamp=T0_S + 2)["detail"]
    assert "nor another with velocities; poses are on /pose" in detail
    assert "trajectory_summary returns speeds from them, by topic" in detail
    detail = ask(tmp_path, False, "get_velocity_at", topic="/pose", timestamp=T0_S + 2)["detail"]
    assert "no topic recorded does; trajectory_summary returns speeds from its poses" in detail
    way = {"topic": "/pose", "start": T0_S, "end": T0_S + 4}
    assert ask(tmp_path, False, "trajectory_summary", **way)["avg_speed"] == 1.0


@each_way
def test_the_only_topic_of_poses_serves_every_tool_that_places_the_robot(
    tmp_path: Path, recalls: bool
) -> None:
    driven = [pose_stamped(T0 + n * S, float(n), 0.0, "/pose") for n in range(6)]
    write_mcap(tmp_path / "rec" / "rec_0.mcap", [*driven, boolean(T0 + 4 * S, True)])
    near = {"x": 2.0, "y": 0.0, "radius_m": 1.2}
    span = {"start": T0_S, "end": T0_S + 5}
    in_region = {"where": near, "topic": "/bumper", "condition_type": "equals", "value": True}
    found = {
        "visits": ask(tmp_path, recalls, "visits", **near),
        "recap": ask(tmp_path, recalls, "recap", **span),
        "trajectory_summary": ask(tmp_path, recalls, "trajectory_summary", **span, where=near),
        "find_matches": ask(tmp_path, recalls, "find_matches", **in_region),
    }
    for tool, reply in found.items():
        assert any(note.startswith("by /pose, the only topic") for note in reply["notes"]), tool
    assert found["visits"]["total"] == 1
    assert found["recap"]["distance_m"] == 5.0
    assert found["trajectory_summary"]["distance_m"] == pytest.approx(2.4, abs=0.1)
    assert found["find_matches"]["total"] == 0  # at 4 m
    chosen = QuerySettings(pose_topic="/base")
    refused = asked(replace(memory_of(tmp_path), limits=chosen), tmp_path, "visits", **near)
    assert "set data.pose_topic=/pose" in refused["detail"]


def test_once_the_usual_topic_of_poses_is_recorded_it_places_the_robot(tmp_path: Path) -> None:
    """A bag without /odom is placed by /pose; with /odom in a later one it is no longer."""
    driven = [pose_stamped(T0 + n * S, float(n), 0.0, "/pose") for n in range(6)]
    write_mcap(tmp_path / "rec" / "rec_0.mcap", driven)
    near = {"x": 2.0, "y": 0.0, "radius_m": 1.2, "start": T0_S, "end": T0_S + 60}
    recalls = with_store(memory_of(tmp_path), tmp_path)
    assert asked(recalls, tmp_path, "visits", **near)["total"] == 1
    write_mcap(tmp_path / "rec" / "rec_1.mcap", [odom(T0 + n * S, 2.0, 0.0) for n in range(20, 26)])
    [known] = asked(recalls, tmp_path, "visits", **near)["visits"]
    assert known["arrived"] == T0_S + 20


def test_a_topic_without_a_position_is_refused_with_those_that_have_one(tmp_path: Path) -> None:
    write_mcap(tmp_path / "rec" / "rec_0.mcap", [odom(T0, 1.0, 2.0), boolean(T0, True)])
    reply = ask(tmp_path, False, "get_position_at", topic="/bumper", timestamp=T0_S)
    assert reply["error"] == "invalid_arguments"
    assert "carries no position; give a topic that does, such as /odom" in reply["detail"]
