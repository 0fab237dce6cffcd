"""Batches of MCAP files that are damaged, lie, or are made as few writers make them."""

import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType

from ros2_memory.core.errors import BagContradictionError, BagError
from ros2_memory.core.model import TimeWindow
from ros2_memory.storage.base import Batch, Record
from ros2_memory.storage.errors import UnreadableError
from ros2_memory.storage.mcap import bulk
from ros2_memory.storage.mcap.bulk import ReadChunks
from ros2_memory.storage.mcap.chunk import Pairs
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import McapLayout, Msg, boolean, text, write_mcap
from tests.support.examples import examples
from tests.support.mcap_surgery import SMALL, chatter, damaged

EVERYTHING = TimeWindow.everything()
TOPICS = ("/chatter", "/bumper")


def all_of(items: Iterator[Record] | Iterator[Batch]) -> tuple[list[object], list[BagError]]:
    """What an iterator yields, and what it raises meanwhile."""
    found: list[object] = []
    errors: list[BagError] = []
    while True:
        try:
            found.append(next(items))
        except StopIteration:
            return found, errors
        except BagError as error:
            errors.append(error)


def records_in(batches: Iterable[object]) -> Counter[object]:
    return Counter[object](
        batch.record(nth)  # type: ignore[attr-defined]
        for batch in batches
        for nth in range(batch.sizes.size)  # type: ignore[attr-defined]
    )


@settings(max_examples=examples(150))
@given(
    st.integers(0, 2**32),
    st.sampled_from([SMALL, McapLayout(chunk_size=400, compression=CompressionType.ZSTD)]),
)
def test_of_a_damaged_file_batches_hold_what_records_do(seed: int, how: McapLayout) -> None:
    messages = [*chatter(12), *(boolean(time, True) for time in range(5, 9))]
    with tempfile.TemporaryDirectory() as folder:
        path = write_mcap(Path(folder) / "a.mcap", messages, how)
        path.write_bytes(damaged(path.read_bytes(), seed))
        records, errors = all_of(McapReader().records(path, TOPICS, EVERYTHING))
        batches, others = all_of(McapReader().batches(path, TOPICS, EVERYTHING))
    found, expected = records_in(batches), Counter[object](records)
    contradicted = any(isinstance(error, BagContradictionError) for error in errors)
    # Where indexes lie, the rest is read in the order of the file, up to where that is damaged:
    # messages beyond may have come before by their times.
    if not contradicted:
        assert found == expected
    assert bool(errors) == bool(others)


def test_a_place_past_all_that_can_be_counted_is_damage() -> None:
    content = ReadChunks((), bytes(200), [100, 100])
    pairs = Pairs(*np.array([[1], [0], [2**63 - 1], [1]]))
    with pytest.raises(UnreadableError, match="a message is not where its index says"):
        bulk.compared(content, pairs)


def test_compressed_messages_are_decompressed(tmp_path: Path) -> None:
    plain = [text(time, f"message {time}") for time in range(9)]
    packed = [
        Msg(each.topic, each.type, each.log_time, zstandard.compress(each.payload))
        if each.log_time % 2
        else each
        for each in plain
    ]
    path = write_mcap(tmp_path / "a.mcap", packed, SMALL)
    batches = list(McapReader().batches(path, TOPICS, EVERYTHING))
    found = {
        time: batch.payload(nth)
        for batch in batches
        for nth, time in enumerate(batch.log_times.tolist())
    }
    assert found == {each.log_time: each.payload for each in plain}


def test_no_buffer_has_more_than_its_share_of_small_chunks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_mcap(tmp_path / "a.mcap", chatter(40), SMALL)
    monkeypatch.setattr(bulk, "BATCH_BYTES", 1500)
    batches = list(McapReader().batches(path, TOPICS, EVERYTHING))
    assert len(batches) > 3
    assert max(len(batch.buffer) for batch in batches) <= 1500
    assert [time for batch in batches for time in batch.log_times.tolist()] == list(range(40))
