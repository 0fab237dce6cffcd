"""Fields of messages, and what is converted."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from ros2_memory.messages.conversions import (
    ABSENT,
    descend,
    field_of,
    field_table_of,
    names_of,
    nanoseconds,
    parse_path,
    view,
    xyz,
    xyzw,
)
from tests.support import bags

if TYPE_CHECKING:
    from collections.abc import Callable


def quaternion(x: float, y: float, z: float, w: float) -> object:
    return bags.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def image(encoding: str, height: int = 2, width: int = 4, size: int = 24) -> object:
    return bags.make(
        "sensor_msgs/msg/Image",
        header=bags.header(0, "camera"),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=size // height,
        data=np.zeros(size, dtype=np.uint8),
    )


@pytest.mark.parametrize(
    ("encoding", "shape"),
    [
        ("rgb8", [2, 4, 3]),
        ("bgr16", [2, 4, 3]),
        ("rgba8", [2, 4, 4]),
        ("bgra8", [2, 4, 4]),
        ("mono8", [2, 4, 1]),
        ("16UC1", [2, 4, 1]),
        ("32FC3", [2, 4, 3]),
        ("bayer_rggb8", [2, 4, 1]),
        ("yuv422", [2, 4]),
        ("", [2, 4]),
    ],
)
def test_an_image_is_its_size_encoding_and_shape(encoding: str, shape: list[int]) -> None:
    assert view(image(encoding), "data") == {"bytes": 24, "encoding": encoding, "shape": shape}


def test_a_point_cloud_is_its_size_and_points() -> None:
    cloud = bags.make(
        "sensor_msgs/msg/PointCloud2",
        header=bags.header(0, ""),
        height=2,
        width=100,
        fields=[],
        is_bigendian=False,
        point_step=16,
        row_step=1600,
        data=np.zeros(3200, dtype=np.uint8),
        is_dense=True,
    )
    assert view(cloud, "data") == {"bytes": 3200, "points": 200, "shape": [2, 100]}


def test_a_map_is_its_size_and_shape() -> None:
    origin = bags.make(
        "geometry_msgs/msg/Pose", position=bags.point(0, 0), orientation=bags.quaternion(0)
    )
    info = bags.make(
        "nav_msgs/msg/MapMetaData",
        map_load_time=bags.stamp(0),
        resolution=0.05,
        width=3,
        height=2,
        origin=origin,
    )
    grid = bags.make(
        "nav_msgs/msg/OccupancyGrid",
        header=bags.header(0, "map"),
        info=info,
        data=np.zeros(6, dtype=np.int8),
    )
    assert view(grid, "data") == {"bytes": 6, "shape": [2, 3]}


def test_a_definition_of_another_shape_under_a_standard_name_is_not_taken_for_it() -> None:
    store = get_typestore(Stores.EMPTY)
    texts = {
        "geometry_msgs/msg/Quaternion": "string x\nfloat64 y\n",
        "sensor_msgs/msg/Image": "string data\n",
    }
    for name, text in texts.items():
        store.register(get_types_from_msg(text, name))
    own = store.types["geometry_msgs/msg/Quaternion"](x="a", y=1.0)
    assert view(own, "x") == "a"
    assert view(own, "yaw_deg") is ABSENT
    picture = view(store.types["sensor_msgs/msg/Image"](data="abc"), "data")
    assert picture == {"bytes": 3, "encoding": None, "shape": []}


def test_points_are_read_from_messages_and_from_json_alike() -> None:
    assert xyz(bags.point(1.0, 2.0, 3.0)) == (1.0, 2.0, 3.0)
    assert xyz({"x": 1, "y": 2.5, "z": 0}) == (1.0, 2.5, 0.0)
    assert xyzw({"x": 0, "y": 0, "z": 0, "w": 1}) == (0.0, 0.0, 0.0, 1.0)


@pytest.mark.parametrize(
    "node",
    [
        None,
        ABSENT,
        3.0,
        [1.0, 2.0, 3.0],
        {"x": 1.0, "y": 2.0},
        {"x": "1", "y": 2.0, "z": 3.0},
        {"x": True, "y": 2.0, "z": 3.0},
        {"x": 10**400, "y": 2.0, "z": 3.0},
    ],
)
def test_what_is_not_shaped_like_a_point_is_none(node: object) -> None:
    assert xyz(node) is None


@pytest.mark.parametrize(
    ("node", "time"),
    [
        (bags.stamp(1_752_500_000_123_456_789), 1_752_500_000_123_456_789),
        (bags.make("builtin_interfaces/msg/Duration", sec=-1, nanosec=500_000_000), -500_000_000),
        ({"sec": 2, "nanosec": 5}, 2_000_000_005),
        ({"sec": 2, "nsec": 5}, 2_000_000_005),
        ({"secs": 2, "nsecs": 5}, 2_000_000_005),
        ({"sec": 2}, None),
        ({"sec": 2.5, "nsec": 0}, None),
        ({"sec": 10**20, "nsec": 0}, None),
        (12.5, None),
        (ABSENT, None),
    ],
)
def test_a_time_is_read_from_messages_and_from_json_alike(node: object, time: int | None) -> None:
    assert nanoseconds(node) == time


@dataclass
class Plain:
    width: int
    UNIT: ClassVar[int] = 1


def register(name: str, definition: str) -> Callable[..., object]:
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(definition, name))
    return store.types[name]


def test_the_constants_of_a_definition_are_no_fields() -> None:
    build = register("demo_msgs/msg/Mode", "uint8 IDLE=0\nuint8 BUSY=1\nuint8 mode\n")
    assert names_of(build(mode=1)) == ("mode",)
    assert field_of(build(mode=1), "BUSY") is ABSENT
    assert field_of(build(mode=1), "__msgtype__") is ABSENT
    assert names_of(Plain(1)) == ("width",)


def test_a_field_named_like_a_word_of_python_keeps_its_name() -> None:
    build = register("demo_msgs/msg/Trip", "string from\nstring to\n")
    trip = build(from_="kitchen", to="hall")
    assert names_of(trip) == ("from", "to")
    assert field_of(trip, "from") == "kitchen"


@pytest.mark.parametrize("name", ["sort", "shape", "T", "__class__", "_private", "payload"])
def test_only_fields_are_walked_never_what_python_adds(name: str) -> None:
    for node in ([3, 1], np.zeros(2), "text", 1.5, None, SimpleNamespace(_private=1)):
        assert field_of(node, name) is ABSENT


def test_an_object_of_another_decoder_is_walked_by_its_attributes() -> None:
    node = SimpleNamespace(pose=SimpleNamespace(x=1.0))
    assert names_of(node) == ("pose",)
    assert descend(node, ("pose", "x")) == 1.0
    assert field_table_of(object()) is None


@pytest.mark.parametrize(
    ("path", "segments"),
    [
        ("pose.pose.position", ("pose", "pose", "position")),
        ("poses.0.x", ("poses", "0", "x")),
        ("data", ("data",)),
        ("", None),
        (".", None),
        ("pose..x", None),
        ("pose.", None),
        (" pose", None),
        ("pose.__class__", None),
        ("0.x", None),
        ("pose[0]", None),
    ],
)
def test_a_dot_path_is_names_and_numbers_joined_by_dots(
    path: str, segments: tuple[str, ...] | None
) -> None:
    assert parse_path(path) == segments


def test_the_numbers_of_an_array_are_reached_by_number_and_have_no_fields() -> None:
    scan = SimpleNamespace(ranges=np.array([1.5, 2.5]), none=np.zeros(0))
    assert descend(scan, ("ranges", "1")) == 2.5
    assert descend(scan, ("ranges", "size")) is ABSENT
    assert descend(scan, ("none", "x")) == []
