"""What is packed is unpacked the same, and what is damaged is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis.zone_map import UNBOUNDED, Box, ZoneMap
from ros2_memory.catalogue.codec import (
    decode_counts,
    decode_zone_map,
    encode_counts,
    encode_zone_map,
)
from ros2_memory.catalogue.packing import packed, unpacked

NUMBERS = st.integers() | st.floats(allow_nan=False)
BOUNDS = st.floats(allow_nan=False)
ZONE_MAPS = st.builds(
    ZoneMap,
    words=st.none() | st.text(max_size=40),
    texts=st.booleans(),
    booleans=st.sampled_from([(), (False,), (True,), (False, True)]),
    low=BOUNDS,
    high=BOUNDS,
    numbers=st.none() | st.lists(NUMBERS, max_size=5).map(tuple),
    box=st.none() | st.builds(Box, *[BOUNDS] * 6),
) | st.just(UNBOUNDED)  # fmt: skip


TOPIC = st.tuples(*[st.integers(-(2**63), 2**63 - 1)] * 3)


@given(
    bags=st.integers(0, 3).flatmap(
        lambda size: st.lists(st.lists(TOPIC, min_size=size, max_size=size), min_size=1, max_size=3)
    )
)
def test_counts_and_times_of_bags_come_back_as_they_were(
    bags: list[list[tuple[int, int, int]]],
) -> None:
    encoded = [encode_counts(np.array(bag, "<i8").tobytes()) for bag in bags]
    topics = len(bags[0])
    assert decode_counts(encoded, topics).tolist() == [[[*each] for each in bag] for bag in bags]
    with pytest.raises(ValueError, match="not the numbers of bags"):
        decode_counts(encoded, topics + 1)


@given(plain=st.binary(max_size=300), model=st.binary(min_size=1, max_size=300))
def test_what_is_packed_is_unpacked_the_same(plain: bytes, model: bytes) -> None:
    assert unpacked(packed(plain, model), model) == plain


def test_what_equals_its_model_takes_nearly_nothing() -> None:
    model = bytes(range(256))
    assert len(packed(model, model)) < 12


def test_other_bytes_than_packed_ones_are_refused() -> None:
    model = bytes(range(200))
    whole = packed(bytes(range(100, 220)), model)
    for wrong in (whole[:-2], whole + b"x", b"\xff" * 9):
        with pytest.raises(ValueError, match="not what was packed"):
            unpacked(wrong, model)


@given(ZONE_MAPS)
def test_a_zone_map_that_is_stored_is_the_same_but_for_a_larger_box(zones: ZoneMap) -> None:
    stored = decode_zone_map(encode_zone_map(zones))
    assert repr(replace(stored, box=None)) == repr(replace(zones, box=None))
    if zones.box is None:
        assert stored.box is None
        return
    assert stored.box is not None
    for nth, (bound, exact) in enumerate(zip(stored.box, zones.box, strict=True)):
        assert bound >= exact if nth % 2 else bound <= exact
        if abs(exact) < 1e38:
            assert bound == pytest.approx(exact, rel=1e-6, abs=1e-44)


def test_other_bytes_are_no_zone_map() -> None:
    whole = encode_zone_map(ZoneMap(box=Box(0, 1, 0, 1, 0, 1)))
    for wrong in (b"", b"abc", whole[:20], whole[:-4]):
        with pytest.raises(ValueError, match=r"zone map|Expecting"):
            decode_zone_map(wrong)
