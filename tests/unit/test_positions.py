"""Positions come from whatever carries one, and refusals name what does."""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ros2_memory.core.model import TimeWindow
from ros2_memory.core.regions import Circle, Place, Rectangle
from ros2_memory.core.timebase import Deadline
from ros2_memory.history.context import Call, QuerySettings
from ros2_memory.history.scan import read_until_late
from ros2_memory.history.view import View
from ros2_memory.places.local_map import fixes_in
from tests.support import bags
from tests.support.bags import (
    Msg,
    along_x,
    boolean,
    detections,
    header,
    make,
    odom,
    point,
    quaternion,
    text,
    tf,
    tf_of,
    transform,
    write_mcap,
)
from tests.support.memories import Remember, asked, clause, memory_of, remembered

S = 10**9
T0_S = 1_784_000_000
T0 = T0_S * S


VEHICLE = "/fmu/out/vehicle_odometry"


def vehicle(ns: int, x: float, topic: str = VEHICLE) -> Msg:
    def floats(*parts: float) -> Any:
        return np.array(parts, dtype=np.float32)

    variances = ("position_variance", "orientation_variance", "velocity_variance")
    body = make(
        "px4_msgs/msg/VehicleOdometry",
        timestamp=ns // 1000,
        timestamp_sample=ns // 1000,
        pose_frame=1,
        position=floats(x, 0.0, -2.0),
        q=floats(1.0, 0.0, 0.0, 0.0),
        velocity_frame=3,
        velocity=floats(0.5, 0.0, 0.0),
        angular_velocity=floats(0.0, 0.0, -0.25),
        reset_counter=0,
        quality=100,
        **dict.fromkeys(variances, np.zeros(3, np.float32)),
    )
    return Msg(topic, "px4_msgs/msg/VehicleOdometry", ns, body)


def fix(ns: int, north: float, east: float = 0.0, status: int = 0) -> Msg:
    return bags.fix(ns, 48.1234567 + north, 11.7654321 + east, 519.5, status)


FIXES = [fix(T0 + n * S, n * 1e-5) for n in range(60)]


GLOBAL = "px4_msgs/msg/VehicleGlobalPosition"


def test_numbers_that_are_no_degrees_are_no_position(tmp_path: Path) -> None:
    scaled = make(GLOBAL, timestamp=0, lat=545000000.0, lon=102500000.0, alt=40.0)
    memory = remembered(tmp_path, [Msg("/where", GLOBAL, T0, scaled)])
    refused = asked(memory, "get_position_at", topic="/where", timestamp=T0_S)
    assert "carries no position" in refused["detail"]


def test_latitude_and_longitude_of_a_receiver_of_px4_are_its_position(remember: Remember) -> None:
    type_name, degrees = "px4_msgs/msg/SensorGps", {"latitude_deg": 48.1, "longitude_deg": 11.7}
    messages = [
        Msg(
            "/gps",
            type_name,
            T0 + n * S,
            make(type_name, timestamp=n, **degrees, altitude_msl_m=520.0 + n, fix_type=fix_type),
        )
        for n, fix_type in enumerate([3, 1, 6])
    ]
    memory = remember(messages)
    for n, has_fix in enumerate([True, False, True]):
        found = asked(memory, "get_position_at", timestamp=T0_S + n, topic="/gps")
        assert (found["latitude"], found["longitude"]) == (48.1, 11.7)
        assert found["altitude"] == 520.0 + n
        assert any(note.startswith("no fix") for note in found.get("notes", ())) != has_fix
    refused = asked(memory, "get_position_at", timestamp=T0_S)
    assert "latitude and longitude are on /gps (px4_msgs/msg/SensorGps)" in refused["detail"]


def test_a_position_without_a_fix_says_so_and_is_in_no_map_and_its_numbers_are_told(
    tmp_path: Path,
) -> None:
    states = [fix(T0 + n * S, n * 1e-5, status=-1 if n == 4 else 0) for n in range(9)]
    memory = remembered(tmp_path, states)
    for at, has_fix in ((4, False), (5, True)):
        found = asked(memory, "get_position_at", timestamp=T0_S + at, topic="/fix")
        assert found["latitude"] == pytest.approx(48.1234567 + at * 1e-5)
        assert any(note.startswith("no fix") for note in found.get("notes", ())) != has_fix
    view = View(memory, Call())
    fixes = fixes_in(view, "/fix", TimeWindow.everything())
    assert [at for at, _ in fixes] == [T0 + n * S for n in range(9) if n != 4]
    height = {"topic": "/fix", "fields": ["altitude"], "start": T0_S}
    for given in ({}, {"by": "hour"}):
        reply = asked(memory, "get_topic_in_range", end=T0_S + 8, **height, **given)
        told = [note for note in reply["notes"] if note.startswith(f"until {T0_S + 4}")]
        assert "have no fix (fix_status -1)" in told[0]
    before = asked(memory, "get_topic_in_range", end=T0_S + 3, **height)
    assert not any("no fix" in note for note in before.get("notes", ()))


def test_an_element_of_an_array_that_is_shown_as_a_point_is_its_axis(remember: Remember) -> None:
    """As in the fields that are shown."""
    poses = [vehicle(T0 + n * S, n) for n in range(9)]
    of_vehicle = partial(asked, remember(poses), topic=VEHICLE)
    for field, value, last in (
        ("velocity.0", 0.5, 8),
        ("position.0", 5, 5),
        ("position.2", 1, None),
    ):
        given = {"field": field, "condition_type": "equals", "value": value}
        found = of_vehicle("find_last_match", **given)
        assert (None if found is None else found["timestamp"] - T0_S) == last
    shown = of_vehicle("get_topic_at_time", timestamp=T0_S, fields=["velocity.0"])
    assert shown["value"] == {"velocity.0": 0.5}


def test_the_axes_of_a_north_east_down_frame_are_told(tmp_path: Path) -> None:
    memory = remembered(tmp_path, [vehicle(T0 + n * S, n) for n in range(9)])
    above = clause("/*odometry", "above", 1.0, field="position.z")
    note = "in NED x is north, y east and z down: yaw is clockwise from north, seen from above"
    for tool, given in (
        ("get_position_at", {"timestamp": T0_S + 1}),
        ("trajectory_summary", {"start": T0_S, "end": T0_S + 5}),
        ("find_matches", above),
        ("find_last_match", above),
    ):
        assert note in asked(memory, tool, **given)["notes"]
    other = [vehicle(T0 + n * S, n, "/r2/odometry") for n in range(9)]
    write_mcap(tmp_path / "other.mcap", other)
    assert asked(memory, "find_matches", **above)["notes"].count(note) == 1


def test_the_local_position_of_px4_is_in_north_east_down(remember: Remember) -> None:
    """Its messages name no frame: by its definition it is that one."""
    type_name = "px4_msgs/msg/VehicleLocalPosition"

    def flown(n: int) -> Msg:
        numbers = {"x": n / 2, "y": 3.0, "z": -2.0, "heading": 0.0}
        return Msg(
            "/flown", type_name, T0 + n * S, make(type_name, timestamp=n, xy_valid=True, **numbers)
        )

    memory = remember([flown(n) for n in range(20)])
    note = "in NED x is north, y east and z down: yaw is clockwise from north, seen from above"
    for tool, given in (
        ("get_position_at", {"timestamp": T0_S + 4, "topic": "/flown"}),
        ("trajectory_summary", {"start": T0_S, "end": T0_S + 19, "topic": "/flown"}),
    ):
        reply = asked(memory, tool, **given)
        assert reply["frame_id"] == "NED"
        assert note in reply["notes"]
    near = {"condition_type": "near_position", "value": {"x": 2.0, "y": 3.0}}
    reply = asked(memory, "find_matches", topic="/flown", **near)
    assert reply["total"] == 1
    assert any("in NED (/flown)" in note for note in reply["notes"])


def localised(n: int, topic: str) -> Msg:
    """A localiser's pose of the robot."""
    type_name = "geometry_msgs/msg/PoseWithCovarianceStamped"
    pose = make("geometry_msgs/msg/Pose", position=point(n, 0), orientation=quaternion(0))
    spread = make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36))
    at = T0 + n * S
    return Msg(topic, type_name, at, make(type_name, header=header(at, "map"), pose=spread))


@pytest.mark.parametrize(
    ("odometry", "others", "is_taken"),
    [
        (["/amr7/odom"], ["/amr7/amcl_pose"], True),
        (["/base_controller/odom"], ["/amcl_pose"], True),
        (["/odometry/filtered"], ["/odometry/global", "/odometry/gps"], True),
        (["/r1/odometry/local"], ["/r1/odometry/global"], True),
        (["/odometry/filtered", "/odometry/local"], [], False),
        (["/r1/odometry/filtered"], ["/r2/amcl_pose"], False),
        (["/r1/odom"], ["/r2/amcl_pose"], False),
        (["/r1/odom", "/r2/odom"], ["/r1/amcl_pose"], False),
        (["/amr7/wheels"], ["/amr7/amcl_pose"], False),
    ],
)
def test_the_only_odometry_in_a_namespace_places_the_robot_also_beside_its_localiser(
    tmp_path: Path, odometry: list[str], others: list[str], is_taken: bool
) -> None:
    messages = [odom(T0 + n * S, n / 2, 0.0, topic=topic) for n in range(9) for topic in odometry]
    messages += [localised(n, topic) for n in range(9) for topic in others]
    memory = remembered(tmp_path, messages)
    reply = asked(memory, "get_position_at", timestamp=T0_S + 4)
    assert ("error" not in reply) == is_taken
    if is_taken:
        assert (reply["topic"], reply["x"]) == (odometry[0], 2.0)
        assert "the only odometry: data.pose_topic is /odom" in reply["notes"][0]
        way = asked(memory, "trajectory_summary", start=T0_S, end=T0_S + 8)
        assert way["distance_m"] == pytest.approx(4.0, abs=0.01)
    else:
        assert (
            "set data.pose_topic (for a fleet: fleet.pose_topics) to one of them" in reply["detail"]
        )


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
    remember: Remember, tool: str, given: dict[str, Any]
) -> None:
    reply = asked(remember(FIXES[:9]), tool, **given)
    detail = reply["notes"][0] if tool == "recap" else reply["detail"]
    assert "data.pose_topic=/fix" not in detail
    assert "give topic" not in detail
    in_degrees = "(sensor_msgs/msg/NavSatFix): get_position_at answers them by topic"
    assert (in_degrees in detail) == (tool != "get_velocity_at")
    assert "data.pose_topic is /odom" in detail


def test_a_pose_in_degrees_has_its_heading(remember: Remember) -> None:
    of = "geographic_msgs/msg/Geo"
    at = make(f"{of}Point", latitude=38.7, longitude=-9.1, altitude=40.0)
    pose = make(f"{of}Pose", position=at, orientation=quaternion(math.radians(30)))
    body = make(f"{of}PoseStamped", header=header(T0, "earth"), pose=pose)
    memory = remember([Msg("/geopose", f"{of}PoseStamped", T0, body)])
    found = asked(memory, "get_position_at", timestamp=T0_S, topic="/geopose")
    assert (found["latitude"], found["x"], found["yaw_deg"]) == (38.7, None, pytest.approx(30))


def moved(tenths: range) -> list[Msg]:
    """The body driving at 1 m/s in the map, ten transforms a second, from 1 m on."""
    return [
        tf(
            at := T0 + n * S // 10,
            transform(at, "map", "odom", (1.0, 0.0, 0.0)),
            transform(at, "odom", "base_link", (n / 10, 0.0, 0.0)),
        )
        for n in tenths
    ]


def test_in_a_gap_of_transforms_no_position_is_known(remember: Remember) -> None:
    messages = [*moved(range(100)), *moved(range(400, 600)), *FIXES]
    memory = remember(messages)
    for given in ({}, {"frame_id": "odom"}, {"topic": "/tf"}):
        reply = asked(memory, "get_position_at", timestamp=T0_S + 25, **given)
        assert reply["reason"] == "gap"
        assert "no message of /tf within 10 s" in reply["detail"]
        assert "latitude and longitude are on /fix" in reply["detail"]
    reply = asked(memory, "get_position_at", timestamp=T0_S + 25, topic="/fix")
    assert (reply["x"], reply["latitude"]) == (None, 48.1237067)
    reply = asked(memory, "get_position_at", timestamp=T0_S + 250)
    assert reply["reason"] == "outside_range"
    assert "/fix" not in reply["detail"]


def test_slow_transforms_have_no_position_between_them_as_poses_have_none(tmp_path: Path) -> None:
    memory = remembered(tmp_path, moved(range(0, 600, 10)))
    reply = asked(memory, "get_position_at", timestamp=T0_S + 20.5)
    assert reply["reason"] == "between_messages"
    reply = asked(memory, "get_position_at", timestamp=T0_S + 20.5, tolerance_s=1)
    assert (reply["timestamp"], reply["x"]) == (T0_S + 20, 21.0)
    refused = asked(memory, "get_velocity_at", timestamp=T0_S + 1)["detail"]
    assert "transforms are on /tf: get_position_at and trajectory_summary answer by" in refused


def test_a_refusal_names_the_field_that_a_type_of_no_known_velocity_has(tmp_path: Path) -> None:
    """As that of a Doppler log, which was told to have none."""
    kind, at = "sensor_msgs/msg/JointState", np.array([0.1])
    joints = make(
        kind, header=header(T0, ""), name=["thruster"], position=at, velocity=at, effort=at
    )
    memory = remembered(tmp_path, [Msg("/dvl", kind, T0, joints)])
    refused = asked(memory, "get_velocity_at", timestamp=T0_S + 0.05, topic="/dvl")["detail"]
    assert "(get_topic_in_range shows its field velocity)" in refused


def carried_by(parent: str, begin_s: int, y: float) -> list[Msg]:
    """Half a minute of transforms of the body, driving at 1 m/s."""
    times = [T0 + begin_s * S + n * S // 10 for n in range(301)]
    return [tf_of(at, parent, "base_link", (n / 10, y, 0.0)) for n, at in enumerate(times)]


def test_a_body_that_another_run_hangs_below_another_frame_is_placed_in_both(
    tmp_path: Path,
) -> None:
    runs = {"one": carried_by("odom", 0, 0.0), "two": carried_by("map", 3600, 5.0)}
    for name, messages in runs.items():
        write_mcap(tmp_path / name / f"{name}_0.mcap", messages)
    memory = memory_of(tmp_path)
    for begin_s, y, frame in ((0, 0.0, "odom"), (3600, 5.0, "map")):
        reply = asked(memory, "get_position_at", timestamp=T0_S + begin_s + 10)
        assert (reply["x"], reply["y"], reply["frame_id"]) == (10.0, y, frame)
        span = {"start": T0_S + begin_s, "end": T0_S + begin_s + 30}
        reply = asked(memory, "trajectory_summary", **span)
        assert (reply["distance_m"], reply["frame_id"], reply["poses"]) == (30.0, frame, 301)
    reply = asked(memory, "trajectory_summary", start=T0_S, end=T0_S + 3630)
    assert (reply["distance_m"], reply["poses"]) == (60.0, 602)
    assert "poses in several frames were joined: odom, map" in reply["notes"]
    reply = asked(memory, "visits", x=10.0, y=5.0)
    assert (reply["frame_id"], reply["total"]) == ("map", 1)


def test_transforms_that_do_not_place_the_body_are_named(tmp_path: Path) -> None:
    """The second run has the arm alone: it is not the robot's way, and no lack of messages."""
    arm = [
        tf(at := T0 + (3600 + n) * S, transform(at, "shoulder", "hand", (0.1 * n, 0.0, 0.0)))
        for n in range(30)
    ]
    for name, messages in {"one": carried_by("odom", 0, 0.0), "two": arm}.items():
        write_mcap(tmp_path / name / f"{name}_0.mcap", messages)
    memory = memory_of(tmp_path)
    reply = asked(memory, "trajectory_summary", start=T0_S, end=T0_S + 3630)
    assert reply["distance_m"] == 30.0
    left_out = "transforms of two are left out: none of them moves the robot's body"
    assert left_out in reply["notes"]
    reply = asked(memory, "trajectory_summary", start=T0_S + 3600, end=T0_S + 3630)
    assert reply["reason"] == "frame_unknown"
    assert "there are: hand, shoulder" in reply["detail"]
    assert left_out in reply["notes"]


def test_transforms_on_topics_that_are_not_configured_are_named_where_a_frame_is_unknown(
    tmp_path: Path,
) -> None:
    """Two robots in one recording: the transforms of the second are in its namespace."""
    messages = [
        tf(
            T0 + n * S,
            transform(T0 + n * S, "map", f"{frames}odom", (1.0, 0.0, 0.0)),
            transform(T0 + n * S, f"{frames}odom", f"{frames}base_link", (0.1 * n, 0.0, 0.0)),
            topic=topic,
        )
        for n in range(9)
        for topic, frames in (("/tf", "r1/"), ("/r2/tf", ""))
    ]
    messages += [odom(T0 + n * S, 0.1 * n, 0.0, topic="/r2/odom") for n in range(9)]
    messages.sort(key=lambda message: message.log_time)
    limits = QuerySettings(pose_topic="/r2/odom")
    memory = remembered(tmp_path, messages, limits=limits)
    hint = "transforms are recorded on /r2/tf, too: add them to data.tf_topics"
    refused = asked(memory, "get_position_at", timestamp=T0_S + 2, frame_id="map")
    assert hint in refused["detail"]
    assert "base_link" not in refused["detail"]  # of the other robot
    unknown = asked(memory, "get_transform_at", parent="map", child="base_link", timestamp=T0_S + 2)
    assert unknown["reason"] == "frame_unknown"
    assert hint in unknown["detail"]
    both = remembered(tmp_path, messages, limits=replace(limits, tf_topics=("/tf", "/r2/tf")))
    there = asked(both, "get_position_at", timestamp=T0_S + 2, frame_id="map")
    assert there["x"] == pytest.approx(1.2)


def test_what_was_read_as_time_ran_out_is_in_the_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of three slices of five minutes the second is read as time runs out."""
    begin = T0 - T0 % (300 * S)
    memory = remembered(tmp_path, along_x(begin, 900, mps=0.1))
    monkeypatch.setattr(Call, "partial_after", lambda *_: Deadline.after(0))
    reply = asked(memory, "trajectory_summary", start=begin / S, end=begin / S + 900)
    assert (reply["start"], reply["poses"]) == (begin / S + 300, 600)
    assert f"the path is known back to {begin // S + 300}" in str(reply["notes"])


def test_a_reply_without_visits_says_since_when_it_is_known_where_the_robot_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory = remembered(tmp_path, along_x(T0, 600, mps=0.1))

    def late(*given: Any) -> tuple[list[Any], int]:
        return read_until_late(*given)[0], T0 + 300 * S

    monkeypatch.setattr("ros2_memory.places.robot_tracks.read_until_late", late)
    within, point = {"start": T0_S, "end": T0_S + 600}, {"x": 0.0, "y": 0.0}
    notes = str(asked(memory, "trajectory_summary", farthest_from=point, **within)["notes"])
    assert f"where the robot was is known back to {T0 // S + 300}" in notes
    assert "visits" not in notes


def test_a_lost_transform_of_the_body_is_told_where_other_frames_have_newer_ones(
    tmp_path: Path,
) -> None:
    turning = [
        tf(at := T0 + n * S // 10 + S // 50, transform(at, "base_link", "gimbal", (0.1, 0.0, 0.0)))
        for n in range(50)
    ]
    driven = [message for n, message in enumerate(moved(range(50))) if n != 30]
    memory = remembered(tmp_path, sorted([*driven, *turning], key=lambda message: message.log_time))
    reply = asked(memory, "get_position_at", timestamp=T0_S + 3.03)
    assert reply["reason"] == "between_messages"
    assert "no transform of base_link in map within 0.1 s before" in reply["detail"]
    assert "the nearest older one is 0.13 s before it" in reply["detail"]
    assert "ask with tolerance_s of at least 0.130" in reply["detail"]
    reply = asked(memory, "get_position_at", timestamp=T0_S + 3.03, tolerance_s=0.13)
    assert reply["timestamp"] == pytest.approx(T0_S + 2.9)


def test_poses_that_no_transform_connects_with_the_map_are_said_to_have_transforms_beside(
    tmp_path: Path,
) -> None:
    messages = [*moved(range(90)), *(vehicle(T0 + n * S, n) for n in range(9))]
    messages.sort(key=lambda message: message.log_time)
    yard = Place("yard", "map", Rectangle(0, 3, -1, 1))
    limits = QuerySettings(pose_topic=VEHICLE, places=(yard,))
    memory = remembered(tmp_path, messages, limits=limits)
    hint = "transforms place base_link there: data.pose_topic=/tf answers by them"
    for tool, given in (
        ("get_position_at", {"timestamp": T0_S + 1, "frame_id": "map"}),
        ("trajectory_summary", {"start": T0_S, "end": T0_S + 5, "frame_id": "map"}),
        ("visits", {"where": "yard"}),
    ):
        refused = asked(memory, tool, **given)
        assert refused["error"] == "invalid_arguments"
        assert refused["detail"].endswith(hint)
    [note] = [note for note in asked(memory, "visits")["notes"] if "yard" in note]
    assert note.endswith(hint)
    by_transforms = remembered(tmp_path, messages, limits=replace(limits, pose_topic="/tf"))
    assert asked(by_transforms, "visits", where="yard")["total"] == 1


@pytest.mark.parametrize("body", ["body", "base", "spot/body"])
def test_a_frame_that_the_map_corrects_is_not_the_body(tmp_path: Path, body: str) -> None:
    messages = [
        tf(
            at := T0 + n * S // 10,
            transform(at, "map", "vision", (1.0, 0.0, 0.0)),
            transform(at, "vision", body, (n / 10, 0.0, 0.0)),
            transform(at, body, "odom", (-n / 10, 0.0, 0.0)),
        )
        for n in range(100)
    ]
    memory = remembered(tmp_path, messages)
    reply = asked(memory, "get_position_at", timestamp=T0_S + 5, topic="/tf")
    assert (reply["x"], reply["notes"]) == (6.0, [f"by transforms, of {body}"])


def test_other_transforms_are_no_pose_of_the_robot(remember: Remember) -> None:
    """Its localiser goes on ten times a second, its odometry once, and not from 20 to 40 s."""
    messages: list[Msg] = []
    for tenth in range(600):
        at = T0 + tenth * S // 10
        messages.append(tf_of(at, "map", "odom", (1.0, 0.0, 0.0)))
        if tenth % 10 == 0 and not 200 < tenth < 400:
            messages.append(tf(at + 1, transform(at, "odom", "base_link", (tenth / 10, 0.0, 0.0))))
    memory = remember(messages)
    refused = asked(memory, "get_position_at", timestamp=T0_S + 10.5)
    assert refused["reason"] == "between_messages"
    assert "no transform of base_link in map within 0.1 s" in refused["detail"]
    assert refused["detail"].endswith("ask with tolerance_s of at least 0.500")
    reply = asked(memory, "get_position_at", timestamp=T0_S + 10.5, tolerance_s=0.5)
    assert reply["x"] == 11.0
    refused = asked(memory, "trajectory_summary", start=T0_S + 25, end=T0_S + 35)
    assert refused["detail"].startswith("no message of /tf between")
    assert refused["detail"].endswith("places base_link")


def test_odometry_is_that_of_the_robot_whatever_it_is_called(tmp_path: Path) -> None:
    """The name of a goalkeeper contains "goal"; poses of goals are not the robot's."""
    poses = [odom(T0 + n * S // 10, n / 10, topic="/goalkeeper/odom") for n in range(100)]
    memory = remembered(tmp_path, [*poses, *moved(range(100))])
    assert asked(memory, "get_position_at", timestamp=T0_S + 5)["topic"] == "/goalkeeper/odom"


def test_what_placed_the_robot_before_its_poses_were_recorded_is_named(tmp_path: Path) -> None:
    """Odometry was taken into the list after ten seconds: before, transforms placed the robot."""
    odometry = [odom(T0 + n * S // 10, n / 10) for n in range(100, 200)]
    memory = remembered(tmp_path, [*moved(range(200)), *odometry])
    window = {"start": T0_S + 2, "end": T0_S + 8}
    hint = "before its first message poses are on /tf: give topic"
    for tool, given in (("get_position_at", {"timestamp": T0_S + 5}), ("recap", window)):
        assert hint in str(asked(memory, tool, **given))
    assert hint in asked(memory, "trajectory_summary", **window)["detail"]
    reply = asked(memory, "trajectory_summary", **window, topic="/tf")
    assert reply["distance_m"] == pytest.approx(6.0)
    late = asked(memory, "get_position_at", timestamp=T0_S + 60)["detail"]
    assert "no message of /odom" in late
    assert hint not in late


def test_positions_that_are_no_numbers_are_not_said_to_be_missing(tmp_path: Path) -> None:
    poses = [odom(T0 + n * S, math.nan if 20 <= n < 40 else n) for n in range(60)]
    memory = remembered(tmp_path, poses)
    for given in ({"where": {"x": [0, 9], "y": [-1, 1]}}, {"by": "hour"}):
        refused = asked(memory, "trajectory_summary", start=T0_S + 25, end=T0_S + 35, **given)
        assert refused["detail"].endswith("has a valid position")


def slam_pose(ns: int, x: float, turn: object) -> Msg:
    pose = make("geometry_msgs/msg/Pose", position=point(x, 0.0), orientation=turn)
    body = make("geometry_msgs/msg/PoseStamped", header=header(ns, "map"), pose=pose)
    return Msg("/slam/pose", "geometry_msgs/msg/PoseStamped", ns, body, ns)


NO_TURN = make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=0.0)


def test_a_null_pose_of_lost_tracking_is_no_position(remember: Remember) -> None:
    def told(n: int) -> Msg:
        is_lost = 20 <= n < 40
        place, turn = (0.0, NO_TURN) if is_lost else (5.0 + 0.1 * n, quaternion(0.0))
        return slam_pose(T0 + n * S, place, turn)

    memory = remember([*map(told, range(60))])
    reply = asked(memory, "get_position_at", timestamp=T0_S + 30)
    assert (reply["x"], reply["y"], reply["yaw_deg"]) == (None, None, None)
    assert "all zeros, as where tracking is lost" in str(reply["notes"])
    assert asked(memory, "visits", x=0.0, y=0.0, radius_m=1.0)["total"] == 0
    path = asked(memory, "trajectory_summary", start=T0_S, end=T0_S + 60)
    assert (path["poses"], path["gap_m"]) == (40, pytest.approx(2.1))


def test_a_position_without_a_rotation_is_one(remember: Remember) -> None:
    beacon = [slam_pose(T0 + n * S, 0.1 * n, NO_TURN) for n in range(1, 9)]
    memory = remember([odom(T0, 0.0), *beacon])
    assert asked(memory, "get_position_at", timestamp=T0_S)["x"] == 0.0
    reply = asked(memory, "get_position_at", timestamp=T0_S + 5, topic="/slam/pose")
    assert (reply["x"], reply["yaw_deg"]) == (0.5, None)


def test_bodies_of_other_robots_are_named(tmp_path: Path) -> None:
    messages = [
        tf(
            at := T0 + n * S,
            transform(at, "map", "one/base_link", (n, 0.0, 0.0)),
            transform(at, "one/base_link", "one/arm/base_link", (0.1 * n, 0.0, 0.0)),
            transform(at, "map", "two/base_link", (5.0, 0.0, 0.0)),
        )
        for n in range(9)
    ]
    memory = remembered(tmp_path, messages)
    notes = asked(memory, "visits", x=5.0, y=0.0)["notes"]
    assert "by transforms, of one/base_link: no topic has the robot's poses" in notes
    assert "not of two/base_link, as of other robots" in notes


def test_what_happened_is_in_places_of_several_frames_the_smallest_first(tmp_path: Path) -> None:
    placed = [tf_of(T0, "map", "odom", (10.0, 0.0, 0.0), topic="/tf_static")]
    messages = [*placed, detections(T0 + 30 * S, ["cup"], at=(0.1, 0.0, 0.0))]
    for n in range(60):
        at = T0 + n * S
        body = transform(at, "odom", "base_link", (3.0, 0.0, 0.0))
        messages += [odom(at, 3.0, 0.0), tf(at, body), boolean(at, n == 30)]
    places = (
        Place("pen", "odom", Circle(3.0, 0.0, 1.0)),
        Place("dock", "map", Circle(13.0, 0.0, 0.5)),
        Place("yard", "map", Circle(13.0, 0.0, 9.0)),
        Place("hall", "map", Circle(3.0, 0.0, 0.5)),
        Place("lab", "site", Circle(3.0, 0.0, 0.5)),
    )
    memory = remembered(tmp_path, messages, limits=QuerySettings(places=places))
    there = asked(memory, "get_position_at", timestamp=T0_S + 1)
    events = asked(memory, "recap", start=T0_S, end=T0_S + 59)["events"]
    assert len(events) >= 3
    seen = clause("/vision/*", "contains", "cup")
    [cup] = asked(memory, "find_matches", **seen)["sightings"]
    for at in (there, *(event for event in events if "in" in event), cup["place"]):
        assert (at["in"], at["also_in"]) == ("dock", ["pen", "yard"])


def test_a_frame_that_is_known_at_other_times_alone_is_no_data_and_says_when_it_is_known(
    tmp_path: Path,
) -> None:
    """What was found stays, where the robot was is left out."""
    messages = along_x(T0, 60, mps=0.1)
    messages += [tf_of(T0 + n * S, "map", "odom", (5, 0, 0)) for n in range(20)]
    messages += [text(T0 + n * S + 1, "hello") for n in (10, 50)]
    memory = remembered(tmp_path, messages)
    later = {"start": T0_S + 40, "end": T0_S + 59}
    for tool, given in (
        ("get_position_at", {"timestamp": T0_S + 50}),
        ("trajectory_summary", later),
    ):
        answer = asked(memory, tool, frame_id="map", **given)
        assert answer["reason"] == "outside_range"
        assert answer["detail"].startswith("no transform leads to map from odom then: ")
        assert f"at {T0_S + 19}" in answer["detail"]
        answer = asked(memory, tool, frame_id="moon", **given)
        assert answer["error"] == "invalid_arguments"
    both = asked(memory, "get_position_at", timestamps=[T0_S + 10, T0_S + 50], frame_id="map")
    assert [each.get("x", each.get("error")) for each in both["results"]] == [6.0, "no_data"]
    said = clause("/chatter", "contains", "hello")
    answer = asked(memory, "find_matches", frame_id="map", **said)
    newest, oldest = answer["sightings"]
    assert (newest["robot"], oldest["robot"]["x"]) == (None, 6.0)
    assert "where the robot was is left out where no transform leads to map then" in answer["notes"]
    around = asked(memory, "recap", around=T0_S + 50, frame_id="map")
    assert "robot" not in around["state"]


def test_a_position_says_where_it_is_not_known_which_place_that_is(tmp_path: Path) -> None:
    """The newest pose is newer than the newest transform to the map, as it mostly is: by 1 s."""
    messages = along_x(T0, 70, mps=0.1)
    messages += [tf_of(T0 + n * S, "map", "odom", (50, 0, 0)) for n in range(50)]
    den = Place("den", "map", Circle(55.0, 0.0, 5.0))
    memory = remembered(tmp_path, messages, limits=QuerySettings(places=(den,)))
    for second in (30, 50):
        known = asked(memory, "get_position_at", timestamp=T0_S + second)
        assert (known["in"], known.get("notes")) == ("den", None)
    later = asked(memory, "get_position_at", timestamp=T0_S + 60)
    assert "in" not in later
    assert later["notes"] == ["in which place is not known: no transform leads to map then"]
    bare = remembered(tmp_path / "bare", [odom(T0, 0.0)], limits=QuerySettings(places=(den,)))
    assert "notes" not in asked(bare, "get_position_at", timestamp=T0_S)


def test_coordinates_beside_a_place_are_in_its_frame_in_compare_as_in_visits(
    tmp_path: Path,
) -> None:
    messages = along_x(T0, 120, mps=0.1)
    messages += [tf_of(T0 + n * S, "map", "odom", (50, 0, 0)) for n in range(120)]
    den = Place("den", "odom", Circle(9.0, 0.0, 0.5))
    memory = remembered(tmp_path, messages, limits=QuerySettings(places=(den,)))
    where = {"den": "den", "spot": {"x": 3.0, "y": 0.0, "radius_m": 1.0}}
    first = {"start": T0_S, "end": T0_S + 59}
    second = {"with_start": T0_S + 60, "with_end": T0_S + 119}
    [visit] = asked(memory, "visits", where=where, **first)["visits"]
    minutes = asked(memory, "compare", where=where, **first, **second)["minutes"]
    assert minutes["spot"] == {"this": pytest.approx(visit["duration_s"] / 60, abs=0.01), "with": 0}


@pytest.mark.parametrize("names", [("den", "other"), ("other", "den")])
def test_coordinates_and_a_place_of_one_name_are_two_rows(
    tmp_path: Path, names: tuple[str, str]
) -> None:
    messages = along_x(T0, 120, mps=0.1)
    den = Place("den", "odom", Circle(9.0, 0.0, 1.0))
    memory = remembered(tmp_path, messages, limits=QuerySettings(places=(den,)))
    both = {"den": {"x": 3.0, "y": 0.0, "radius_m": 1.0}, "other": "den"}
    where = {name: both[name] for name in names}
    compared = asked(
        memory,
        "compare",
        where=where,
        start=T0_S,
        end=T0_S + 59,
        with_start=T0_S + 60,
        with_end=T0_S + 119,
    )
    third = pytest.approx(1 / 3, abs=0.01)
    assert compared["minutes"] == {
        "den": {"this": third, "with": 0},
        "other": {"this": 0, "with": third},
    }
    rows = [row[0] for row in asked(memory, "visits", where=where, by="place")["rows"]]
    assert [name for name in rows if name in both] == [*names]


def test_of_several_topics_of_poses_the_refusal_says_which_is_best(tmp_path: Path) -> None:
    """Of two filters, the one in the map follows a satellite receiver."""
    poses = [replace(odom(T0), topic=topic) for topic in ("/filters/global", "/filters/local")]
    refused = asked(remembered(tmp_path, poses), "get_position_at", timestamp=T0_S)
    assert refused["detail"].endswith(
        "poses are on /filters/global (nav_msgs/msg/Odometry), /filters/local "
        "(nav_msgs/msg/Odometry): set data.pose_topic (for a fleet: fleet.pose_topics) to one of "
        "them (best to odometry that no localisation corrects), or give topic where the tool takes "
        "it"
    )
    beside = asked(remembered(tmp_path, [*poses, *moved(range(5))]), "visits", x=1.0, y=0.0)
    assert ", or to /tf to place the robot by transforms, or give topic" in beside["detail"]


@pytest.mark.parametrize("topic", ["/odom", "/tf"])
def test_a_pose_that_a_rare_correction_of_the_map_does_not_reach_yet_gives_way_to_one_before(
    tmp_path: Path, topic: str
) -> None:
    """Odometry comes 20 times a second, and the map is corrected twice a second."""
    messages: list[Msg] = []
    for nth in range(100):
        at, x = T0 + nth * S // 20, nth * 0.05
        body = transform(at, "odom", "base_link", (x, 0.0, 0.0), 0.0)
        messages += [odom(at, x, 0.0, 0.0), tf(at, body)]
        if nth % 10 == 1:
            messages.append(tf_of(at, "map", "odom", (3.0, 0.0, 0.0), 0.0))
    ask = partial(
        asked, remembered(tmp_path, messages), "get_position_at", topic=topic, frame_id="map"
    )
    refused = ask(timestamp=T0_S + 4.95, tolerance_s=0.3)
    assert "no transform" in refused["detail"]
    assert "ask with tolerance_s of at least 0.4" in refused["detail"]
    by_default: list[dict[str, float]] = [{}] if topic == "/odom" else []
    for tolerance in [{"tolerance_s": 0.45}, *by_default]:
        found = ask(timestamp=T0_S + 4.95, **tolerance)
        assert (found["timestamp"], found["x"]) == (T0_S + 4.55, pytest.approx(7.55))
