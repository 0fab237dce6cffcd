"""What the message indexes of a chunk amount to, read in two ways."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.timebase import MAX_NS
from ros2_memory.storage.errors import UnreadableError
from ros2_memory.storage.mcap.chunk import Extent, columns_from_index, extents_from_index

PAIRS = st.lists(st.tuples(st.integers(0, MAX_NS - 1), st.integers(0, 2**20)), max_size=20)
BASE = 1_000


def region_of(indexes: dict[int, list[tuple[int, int]]]) -> tuple[bytes, dict[int, int]]:
    """The message index records of a chunk, and where each channel's begins in the file."""
    region, offsets = b"", {}
    for channel, pairs in indexes.items():
        offsets[channel] = BASE + len(region)
        body = b"".join(struct.pack("<QQ", *pair) for pair in pairs)
        region += struct.pack("<BQHI", 0x07, len(body) + 6, channel, len(body)) + body
    return region, offsets


@given(st.dictionaries(st.integers(0, 2**16 - 1), PAIRS, max_size=4))
def test_extents_are_what_the_columns_amount_to(indexes: dict[int, list[tuple[int, int]]]) -> None:
    region, offsets = region_of(indexes)
    columns = columns_from_index(region, offsets, BASE)
    expected = {
        channel: Extent(column.times.size, int(column.times[0]), int(column.times[-1]))
        for channel, column in columns.items()
        if column.times.size
    }
    assert extents_from_index(region, offsets, BASE) == expected


@pytest.mark.parametrize("read", [columns_from_index, extents_from_index])
@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda region: b"\x05" + region[1:], "not what its chunk index says"),
        (lambda region: region[:9] + b"\x09\x00" + region[11:], "not what its chunk index says"),
        (lambda region: region[:1] + b"\xff" + region[2:], "not what its chunk index says"),
        (lambda region: region[:10], "not where its chunk index says"),
        (lambda region: region[:15] + b"\xff" * 8 + region[23:], "impossible log times"),
    ],
)
def test_both_ways_refuse_a_damaged_index(read: object, spoil: object, reason: str) -> None:
    region, offsets = region_of({3: [(10, 0), (20, 40)]})
    assert callable(read)
    assert callable(spoil)
    with pytest.raises(UnreadableError, match=reason):
        read(spoil(region), offsets, BASE)


@pytest.mark.parametrize("read", [columns_from_index, extents_from_index])
def test_an_index_that_ends_inside_a_pair_is_refused(read: object) -> None:
    record = struct.pack("<BQHI", 0x07, 6 + 24, 3, 24) + bytes(24)
    assert callable(read)
    with pytest.raises(UnreadableError, match="not what its chunk index says"):
        read(record, {3: BASE}, BASE)
