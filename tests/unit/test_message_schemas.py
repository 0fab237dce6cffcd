"""The shipped schema map, held against the real definitions of its types."""

from functools import cache

import pytest
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc, Typesdict
from rosbags.typesys import get_types_from_msg

from tests.support import bags
from tests.support.memories import shipped_schemas
from tests.unit.columns.drawn_tables import VISION_MSGS

SPEC = {
    "nav_msgs/msg/Odometry": {
        "position": "pose.pose.position",
        "orientation": "pose.pose.orientation",
        "linear_velocity": "twist.twist.linear",
        "angular_velocity": "twist.twist.angular",
    },
    "sensor_msgs/msg/LaserScan": {"ranges": "ranges"},
    "ros2_vision_interfaces/msg/VisionDetectionArray": {
        "skill": "skill",
        "detections": "detections",
    },
    "ros2_vision_interfaces/msg/StampedString": {"value": "data"},
}


@cache
def definitions() -> Typesdict:
    known = dict(bags.typestore().fielddefs)
    for name, text in VISION_MSGS.items():
        known.update(get_types_from_msg(text, name))
    return known


def leads_somewhere(type_name: str, path: str) -> bool:
    """Whether each segment names a field of the definition before it."""
    for segment in path.split("."):
        fields = dict(definitions()[type_name][1]) if type_name in definitions() else {}
        if segment not in fields:
            return False
        type_name = element_type(fields[segment])
    return True


def element_type(description: FieldDesc) -> str:
    """The message type of a field or of its elements; empty for numbers and strings."""
    if description[0] in {Nodetype.ARRAY, Nodetype.SEQUENCE}:
        description = description[1][0]
    return description[1] if isinstance(description[1], str) else ""


@pytest.mark.parametrize("type_name", shipped_schemas())
def test_every_path_leads_to_a_field_of_the_real_definition(type_name: str) -> None:
    assert type_name in definitions()
    wrong = {
        name: path
        for name, path in shipped_schemas()[type_name].items()
        if not leads_somewhere(type_name, path)
    }
    assert wrong == {}


def test_the_types_of_the_specification_stand_exactly_so() -> None:
    assert {name: shipped_schemas()[name] for name in SPEC} == SPEC
