"""Where a message is, how fast, when, and what it says of frames."""

from __future__ import annotations

import math
from typing import Any

from ros2_memory.core.model import Pose, Twist
from tests.support import bags
from tests.unit.test_extract import EXTRACTOR, NS, ODOMETRY, decoded


def quaternion(x: float, y: float, z: float, w: float) -> object:
    return bags.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


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
