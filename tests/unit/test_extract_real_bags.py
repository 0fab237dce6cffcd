"""Every message of public robots' bags, as replies show it."""

from __future__ import annotations

import json
from functools import cache
from typing import TYPE_CHECKING

import pytest

from ros2_memory.core.model import TimeWindow
from ros2_memory.messages.conversions import names_of
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.memories import shipped_extractor, shipped_schemas
from tests.support.shared_bags import REAL, needs_real

if TYPE_CHECKING:
    pass

EXTRACTOR = shipped_extractor()
MAX_REPLY_CHARS = 24_000
SETS = ("rosbags_rs_94types_mcap", "cougars_auv_mcap", "rerun_sensors_mcap")


@cache
def messages(name: str) -> list[tuple[str, object]]:
    """Type and message of everything in the bags of a set."""
    reader = McapReader()
    return [
        (record.channel.type, reader.decode(record))
        for path in sorted((REAL / name).glob("*.mcap"))
        for topics in [{each.topic for each in reader.summarize(path).topics}]
        for record in reader.records(path, topics, TimeWindow.everything())
    ]


@needs_real
@pytest.mark.parametrize("name", SETS)
def test_every_message_is_shown_as_strict_json_that_fits_a_reply(name: str) -> None:
    # Of some thousand messages of few types every seventh.
    every = messages(name)
    for type_name, message in every[:: 7 if len(every) > 1000 else 1]:
        value = EXTRACTOR.shown(message, type_name).value
        text = json.dumps(value, allow_nan=False)
        assert len(text) < MAX_REPLY_CHARS
        assert "__msgtype__" not in text
        assert isinstance(EXTRACTOR.exact(message, type_name), dict)
        EXTRACTOR.transforms(message, 0, static=False)


@needs_real
def test_each_field_of_each_type_can_be_asked_for_alone() -> None:
    for type_name, message in messages("rosbags_rs_94types_mcap"):
        for path in (*names_of(message), *shipped_schemas().get(type_name, ())):
            value = EXTRACTOR.shown(message, type_name, [path]).value
            assert isinstance(value, dict)
            assert list(value) == [path]


@needs_real
def test_constants_of_definitions_are_not_shown() -> None:
    for type_name, message in messages("rosbags_rs_94types_mcap"):
        assert all(not name.isupper() for name in names_of(message)), type_name


@needs_real
def test_pictures_and_clouds_are_shown_as_summaries() -> None:
    data = {}
    for type_name, message in messages("rerun_sensors_mcap"):
        if type_name.rpartition("/")[2] in {"Image", "CompressedImage", "PointCloud2"}:
            value = EXTRACTOR.exact(message, type_name)
            assert isinstance(value, dict)
            data[type_name] = value["data"]
    assert data["sensor_msgs/msg/Image"] == {
        "bytes": 921600,
        "encoding": "rgb8",
        "shape": [480, 640, 3],
    }
    compressed, cloud = data["sensor_msgs/msg/CompressedImage"], data["sensor_msgs/msg/PointCloud2"]
    assert isinstance(compressed, dict)
    assert compressed["encoding"] == "jpeg"
    assert isinstance(cloud, dict)
    assert (cloud["points"], cloud["shape"]) == (200, [1, 200])
