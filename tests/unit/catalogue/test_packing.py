"""What is packed is unpacked the same, and what is damaged is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.catalogue.codec import (
    decode_counts,
    encode_counts,
)
from ros2_memory.catalogue.packing import packed, unpacked

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
