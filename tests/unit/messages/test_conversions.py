"""Fields of messages, and what is converted."""

from types import SimpleNamespace

import numpy as np
import pytest

from ros2_memory.messages.conversions import (
    ABSENT,
    descend,
    view,
    xyz,
)
from tests.support import bags


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


@pytest.mark.parametrize(
    "node", [None, [1.0, 2.0, 3.0], {"x": True, "y": 2.0, "z": 3.0}, {"x": 10**400, "y": 2, "z": 3}]
)
def test_what_is_not_shaped_like_a_point_is_none(node: object) -> None:
    assert xyz(node) is None


def test_the_numbers_of_an_array_are_reached_by_number_and_have_no_fields() -> None:
    scan = SimpleNamespace(ranges=np.array([1.5, 2.5]), none=np.zeros(0))
    assert descend(scan, ("ranges", "1")) == 2.5
    assert descend(scan, ("ranges", "size")) is ABSENT
    assert descend(scan, ("none", "x")) == []
