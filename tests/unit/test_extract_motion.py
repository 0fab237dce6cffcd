"""Where a message is, how fast, when, and what it says of frames."""

from __future__ import annotations

import math
from typing import Any

from ros2_memory.core.model import Pose, Twist
from tests.support import bags
from tests.unit.test_extract import EXTRACTOR, NS, ODOMETRY, decoded, odometry


def quaternion(x: float, y: float, z: float, w: float) -> object:
    return bags.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def test_the_pose_of_odometry_is_in_its_headers_frame_and_its_twist_in_the_childs() -> None:
    assert EXTRACTOR.pose(odometry(), ODOMETRY) == Pose(
        (1.23456, -2.0, 0.0), (0.0, 0.0, math.sin(0.25), math.cos(0.25)), "odom"
    )
    assert EXTRACTOR.twist(odometry(), ODOMETRY) == Twist(
        (0.3, 0.0, 0.0), (0.0, 0.0, 0.1), "base_link"
    )


def test_a_twist_is_in_its_headers_frame_or_in_none() -> None:
    twist = bags.twist(1.0, 0.0)
    assert EXTRACTOR.twist(twist, "geometry_msgs/msg/Twist") == Twist(
        (1.0, 0.0, 0.0), (0.0, 0.0, 0.0), ""
    )
    stamped = bags.make(
        "geometry_msgs/msg/TwistStamped", header=bags.header(NS, "base_link"), twist=twist
    )
    found = EXTRACTOR.twist(stamped, "geometry_msgs/msg/TwistStamped")
    assert found is not None
    assert found.frame_id == "base_link"


def test_json_in_the_likeness_of_a_message_has_its_pose_twist_and_stamp() -> None:
    vector = {"x": 1, "y": 0, "z": 0}
    message = {
        "header": {"frame_id": "odom", "stamp": {"sec": 1, "nanosec": 2}},
        "child_frame_id": "base_link",
        "pose": {"pose": {"position": vector, "orientation": {"x": 0, "y": 0, "z": 0, "w": 2}}},
        "twist": {"twist": {"linear": vector, "angular": vector}},
    }
    for type_name in (ODOMETRY, "json"):
        assert EXTRACTOR.pose(message, type_name) == Pose(
            (1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), "odom"
        )
        assert EXTRACTOR.twist(message, type_name) == Twist(
            (1.0, 0.0, 0.0), (1.0, 0.0, 0.0), "base_link"
        )


def tf_message(*transforms: object) -> object:
    return decoded(bags.tf(NS, *transforms))


def test_the_transforms_of_a_message_keep_stamp_and_log_time() -> None:
    message = tf_message(
        bags.transform(NS, "odom", "base_link", (1.0, 2.0, 0.0), 0.5),
        bags.transform(NS + 5, "/base_link", "/laser", (0.1, 0.0, 0.2)),
    )
    first, second = EXTRACTOR.transforms(message, NS + 9, static=True)
    assert (first.parent, first.child, first.stamp, first.log_time, first.static) == (
        "odom",
        "base_link",
        NS,
        NS + 9,
        True,
    )
    assert first.transform.translation == (1.0, 2.0, 0.0)
    assert first.transform.rotation == (0.0, 0.0, math.sin(0.25), math.cos(0.25))
    assert (second.parent, second.child, second.stamp) == ("base_link", "laser", NS + 5)


def test_transforms_that_tf_refuses_are_left_out() -> None:
    good = bags.transform(NS, "odom", "base_link", (0.0, 0.0, 0.0))
    bad: list[Any] = [bags.transform(NS, "a", "b", (0.0, 0.0, 0.0)) for _ in range(2)]
    bad[0].transform.rotation = quaternion(0.0, 0.0, 0.0, 0.0)
    bad[1].transform.rotation = quaternion(math.nan, 0.0, 0.0, 1.0)
    message = tf_message(
        *bad,
        bags.transform(NS, "a", "b", (math.nan, 0.0, 0.0)),
        bags.transform(NS, "a", "b", (0.0, math.inf, 0.0)),
        bags.transform(NS, "same", "/same", (0.0, 0.0, 0.0)),
        bags.transform(NS, "", "b", (0.0, 0.0, 0.0)),
        bags.transform(NS, "a", "", (0.0, 0.0, 0.0)),
        good,
    )
    left = EXTRACTOR.transforms(message, NS, static=False)
    # an edge without a parent is part of what was recorded, though no lookup goes through it
    assert [edge.child for edge in left] == ["b", "base_link"]
