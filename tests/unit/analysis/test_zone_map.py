"""What rules a bag out by its places, one by one and all at once."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis.zone_map import EVERYWHERE, UNBOUNDED, Box, Boxes, ZoneMap
from ros2_memory.catalogue.codec import decode_zone_box, decode_zone_map, encode_zone_map

_axis = st.tuples(st.floats(-50, 50), st.floats(0, 20)).map(lambda pair: (pair[0], sum(pair)))
_boxes = st.tuples(_axis, _axis, _axis | st.just((math.inf, -math.inf))).map(
    lambda axes: Box(*axes[0], *axes[1], *axes[2])
)
_evidence = st.just(UNBOUNDED) | st.just(ZoneMap()) | _boxes.map(lambda box: ZoneMap(box=box))


@given(
    st.lists(_evidence, max_size=12),
    st.floats(-80, 80),
    st.floats(-80, 80),
    st.none() | st.floats(-80, 80),
    st.floats(0, 30),
)
def test_all_boxes_at_once_agree_with_each_alone(
    pieces: list[ZoneMap], x: float, y: float, z: float | None, reach: float
) -> None:
    numbered = dict(enumerate(pieces, start=100))
    alone = {n for n, each in numbered.items() if each.can_contain_place(x, y, z, reach)}
    assert Boxes({n: _box(each) for n, each in numbered.items()}).meeting(x, y, z, reach) == alone


def _box(zones: ZoneMap) -> Box | None:
    return EVERYWHERE if zones.open else zones.box


@given(_evidence, st.sampled_from(["", "dock\ncup\n", None]))
def test_the_box_of_a_stored_zone_map_is_the_same_alone(zones: ZoneMap, words: str | None) -> None:
    packed = encode_zone_map(replace(zones, words=words, texts=True))
    assert decode_zone_box(packed) == _box(decode_zone_map(packed))
    with pytest.raises(ValueError, match="not a zone map"):
        decode_zone_box(packed[:3])


def test_a_place_on_the_edge_of_a_box_is_not_ruled_out() -> None:
    box = Boxes({1: Box(0.1, 0.3, 0.0, 0.0, 0.0, 0.0), 2: None})
    assert box.meeting(0.1 - 0.5, 0.0, None, 0.5) == {1}
    assert box.meeting(0.3 + 0.5, 0.0, 0.0, 0.5) == {1}
    assert box.meeting(0.3 + 0.51, 0.0, None, 0.5) == set()
