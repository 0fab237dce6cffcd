"""Messages decoded by a template give what they give one by one."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from ros2_memory.analysis.payload_templates import template_for
from ros2_memory.core.model import TimeWindow
from ros2_memory.history.context import Call
from ros2_memory.insights.sightings import find_matches
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import (
    Msg,
    detections,
    odom,
    text,
    tf,
    transform,
    write_mcap,
)
from tests.support.memories import extractor, memory_of

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.core.model import JsonValue
    from ros2_memory.storage.base import CdrLayout, Record

S = 10**9
T0 = 1_700_000_000 * S

ODD = (math.nan, math.inf, -math.inf, 1e300, 0.0)


class OneByOne(McapReader):
    """Tells no layout, so that every message is decoded."""

    def layout(self, record: Record) -> CdrLayout | None:
        return None


@pytest.mark.parametrize("seed", range(4))
def test_a_position_is_found_in_the_same_messages_either_way(tmp_path: Path, seed: int) -> None:
    draw = random.Random(seed)
    messages: list[Msg] = []
    for n in range(150):
        at = T0 + n * S
        x, y = draw.uniform(-2, 2), draw.choice([0.0, 1.0, *ODD])
        messages.append(odom(at, x, y, vx=0.3))
        labels = draw.choice([["cup"], ["cup", "person"], []])
        messages.append(detections(at, labels, at=(x, 0.5, draw.choice([0.0, math.nan]))))
        child = draw.choice(["base_link", "arm"])
        messages.append(tf(at, transform(at, "odom", child, (x, y, 0.0), 0.2)))
    write_mcap(tmp_path / "a" / "a_0.mcap", messages)
    near: list[JsonValue] = [{"x": 0.3, "y": 0.4}, {"x": 0.0, "y": 1.0, "z": 0.0}]
    far: JsonValue = {"x": 50.0, "y": 0.0}
    for place in (*near, far):
        at_once, singly = (
            # Extractors of their own: what is known of messages is known for an extractor.
            replace(memory_of(tmp_path, reader=reader), extractor=extractor.__wrapped__())
            for reader in (McapReader(), OneByOne())
        )
        found = [
            find_matches(each, Call(), "/*", "near_position", place, limit=200)
            for each in (at_once, singly)
        ]
        assert found[0].sightings == found[1].sightings
        assert found[0].total == found[1].total
        assert bool(found[0].sightings) == (place is not far)


def first_record(tmp_path: Path, *messages: Msg) -> tuple[McapReader, Record]:
    path = write_mcap(tmp_path / "bag.mcap", messages)
    reader = McapReader()
    return reader, next(reader.records(path, [messages[0].topic], TimeWindow.everything()))


def test_the_numbers_of_an_odometry_are_found_where_they_lie(tmp_path: Path) -> None:
    reader, record = first_record(tmp_path, odom(T0, 1.5, -2.5, 0.5, vx=0.25))
    template = template_for(reader, extractor(), record)
    assert template is not None
    _, rows = template.matching(record, [record], [0])
    assert template.frame_id == "odom"
    [pose] = template.poses(rows)
    assert pose is not None
    assert pose.position == (1.5, -2.5, 0.0)
    assert pose.orientation == pytest.approx((0.0, 0.0, math.sin(0.25), math.cos(0.25)), abs=1e-12)


def test_messages_that_differ_in_more_than_numbers_do_not_match_a_template(tmp_path: Path) -> None:
    reader, record = first_record(tmp_path, odom(T0, 1.0, 0.0))
    template = template_for(reader, extractor(), record)
    assert template is not None
    payload = record.payload.replace(b"odom", b"abcd")
    others = [record, record._replace(payload=payload), record._replace(payload=payload[:-8])]
    chosen, rows = template.matching(record, others, [0, 1, 2])
    assert (chosen, len(rows)) == ([0], 1)


def test_a_message_without_a_layout_has_no_template(tmp_path: Path) -> None:
    reader, record = first_record(tmp_path, text(T0, "no numbers in it"))
    assert (
        template_for(reader, extractor(), record._replace(payload=record.payload + b"12345678"))
        is None
    )
    big_endian = record._replace(payload=b"\x00\x00" + record.payload[2:])
    assert reader.layout(big_endian) is None
