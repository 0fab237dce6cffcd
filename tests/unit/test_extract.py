import math
from random import Random
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.errors import ConfigError, InvalidArgumentsError
from ros2_memory.extract import SchemaExtractor
from tests.support import bags
from tests.support.memories import shipped_extractor, shipped_schemas
from tests.unit.columns.drawn_tables import message

EXTRACTOR = shipped_extractor()
ODOMETRY = "nav_msgs/msg/Odometry"
DETECTIONS = "ros2_vision_interfaces/msg/VisionDetectionArray"
NS = 1_752_500_000_123_456_789


def decoded(message: bags.Msg) -> object:
    """The message as a reader gives it: through its bytes."""
    return bags.typestore().deserialize_cdr(message.payload, message.type)


def odometry() -> object:
    return decoded(bags.odom(NS, 1.23456, -2.0, 0.5, vx=0.3, wz=0.1))


def detections(*labels: str) -> object:
    return decoded(bags.detections(NS, labels, at=(1.23456, 2.0, 3.0)))


def shown(message: object, type_name: str, *fields: str) -> Any:
    return EXTRACTOR.shown(message, type_name, fields).value


def test_more_detections_than_the_limit_are_thinned_with_a_note_and_whole_for_conditions() -> None:
    many = detections(*(f"thing {n}" for n in range(80)))
    extracted = EXTRACTOR.shown(many, DETECTIONS)
    assert extracted.notes == ("detections: 50 of 80 values, evenly spaced",)
    exact = EXTRACTOR.exact(many, DETECTIONS)
    assert isinstance(exact, dict)
    assert isinstance(exact["detections"], list)
    assert len(exact["detections"]) == 80


def test_a_type_without_an_entry_is_shown_with_all_its_fields() -> None:
    body = bags.make(
        "sensor_msgs/msg/Temperature",
        header=bags.header(1_500_000_000, "engine"),
        temperature=21.5,
        variance=0.0,
    )
    assert shown(body, "sensor_msgs/msg/Temperature") == {
        "header": {"stamp": 1.5, "frame_id": "engine"},
        "temperature": 21.5,
        "variance": 0,
    }


def test_a_type_named_as_before_2019_is_found_in_the_map() -> None:
    assert shown(odometry(), "nav_msgs/Odometry") == shown(odometry(), ODOMETRY)


def test_fields_that_a_message_lacks_are_null_with_a_note() -> None:
    extracted = EXTRACTOR.shown({"status": "on", "skill": "scene"}, DETECTIONS)
    assert extracted.value == {"skill": "scene", "detections": None}
    assert extracted.notes == ("detections: this message has no such field",)


def test_fields_over_a_list_take_an_element_or_map_over_all() -> None:
    seen = detections("cup", "mug")
    paths = ("detections.label", "detections.1.label", "detections.2.label", "detections.point.x")
    assert shown(seen, DETECTIONS, *paths) == {
        "detections.label": ["cup", "mug"],
        "detections.1.label": "mug",
        "detections.2.label": None,
        "detections.point.x": [1.2346, 1.2346],
    }
    assert shown(detections(), DETECTIONS, "detections.label") == {"detections.label": []}


def test_an_element_of_an_array_is_found_by_the_name_beside_it() -> None:
    message = {"names": ["a", "b", [1]], "positions": [1.0, 2.0]}
    fields = ["positions.b", "positions.c"]
    assert shown(message, "json", *fields) == {"positions.b": 2.0, "positions.c": None}


def test_the_full_path_to_the_quaternions_of_a_list_gives_their_components() -> None:
    pose = bags.make(
        "geometry_msgs/msg/Pose", position=bags.point(1.0, 2.0), orientation=bags.quaternion(0.0)
    )
    header = bags.header(NS, "map")
    stamped = bags.make("geometry_msgs/msg/PoseStamped", header=header, pose=pose)
    path = bags.make("nav_msgs/msg/Path", header=header, poses=[stamped])
    both = shown(path, "nav_msgs/msg/Path", "poses.orientation", "poses.pose.orientation")
    assert both["poses.orientation"] == [{"roll_deg": 0, "pitch_deg": 0, "yaw_deg": 0}]
    assert both["poses.pose.orientation"] == [{"x": 0, "y": 0, "z": 0, "w": 1}]


def test_an_unknown_field_of_an_unmapped_type_is_refused_with_what_the_message_has() -> None:
    with pytest.raises(InvalidArgumentsError, match="json has no field 'c'; its fields are: a, b"):
        EXTRACTOR.shown({"a": 1, "b": 2}, "json", ["c"])
    with pytest.raises(InvalidArgumentsError, match="it has no fields"):
        EXTRACTOR.shown("text", "json", ["c"])
    with pytest.raises(InvalidArgumentsError, match=r"k39 and 10 more$"):
        EXTRACTOR.shown({f"k{n}": n for n in range(50)}, "json", ["c"])


@given(st.recursive(st.text(max_size=300), lambda inner: st.lists(inner, max_size=30)))
def test_no_list_of_texts_is_too_long_to_be_shown(message: object) -> None:
    extracted = SchemaExtractor({}, 50, max_chars=800).shown(message, "json")
    assert len(repr(extracted.value)) <= 1600


@pytest.mark.parametrize("path", ["", "pose..x", "pose/x", ".pose", "pose.", "__dict__"])
def test_a_malformed_path_is_refused_with_its_type_and_field(path: str) -> None:
    with pytest.raises(ConfigError, match=r"message schema a_msgs/msg/A: where: .* is not a dot-"):
        SchemaExtractor({"a_msgs/msg/A": {"where": path}}, 50)


def quaternion(x: float, y: float, z: float, w: float) -> object:
    return bags.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def test_transforms_that_tf_refuses_are_left_out() -> None:
    edges = [("same", "/same"), ("", "b"), ("a", ""), ("odom", "base_link")]
    moved = [(math.nan, 0.0, 0.0), (0.0, math.inf, 0.0)]
    made: list[Any] = [
        *(bags.transform(NS, "a", "b", xyz) for xyz in [*moved, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)]),
        *(bags.transform(NS, *edge, (0.0, 0.0, 0.0)) for edge in edges),
    ]
    made[2].transform.rotation = quaternion(0.0, 0.0, 0.0, 0.0)
    made[3].transform.rotation = quaternion(math.nan, 0.0, 0.0, 1.0)
    # Of another length it is a rotation, too.
    made[-1].transform.rotation = quaternion(0.0, 0.0, 0.0, 2.0)

    left = EXTRACTOR.transforms(decoded(bags.tf(NS, *made)), NS, static=False)
    # an edge without a parent is part of what was recorded, though no lookup goes through it
    assert [edge.child for edge in left] == ["b", "base_link"]


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


@pytest.mark.parametrize("type_name", shipped_schemas())
def test_every_path_leads_to_a_field_of_the_real_definition(type_name: str) -> None:
    for seed in range(20):  # lists may be empty
        extracted = EXTRACTOR.shown(message(type_name, Random(seed), is_odd=False), type_name)
        assert "no such field" not in str(extracted.notes)


def test_the_types_of_the_specification_stand_exactly_so() -> None:
    assert {name: shipped_schemas()[name] for name in SPEC} == SPEC
