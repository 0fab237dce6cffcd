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
    parse_path,
)

if TYPE_CHECKING:
    from collections.abc import Callable


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
