"""The bag files of a recording while it is being written."""

from pathlib import Path

import pytest

from ros2_memory.recorder.sessions import SplitChanges, Splits
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import boolean, write_mcap

T0 = 1_795_150_800 * 10**9


@pytest.fixture
def splits(tmp_path: Path) -> Splits:
    return Splits(tmp_path / "rec_1", McapReader())


def test_splits_that_close_at_once_are_reported_in_the_order_of_recording(splits: Splits) -> None:
    """A directory lists its files in any order, and names are numbered without leading zeros."""
    for number in reversed(range(14)):
        at = T0 + number * 10**9
        write_mcap(splits.directory / f"rec_1_{number}.mcap", [boolean(at, True, "/a")])
    assert splits.observe(0).closed == tuple(f"rec_1_{number}.mcap" for number in range(14))


def test_bytes_written_never_shrink_though_splits_are_deleted(splits: Splits) -> None:
    path = write_mcap(splits.directory / "rec_1_0.mcap", [boolean(T0, True)])
    splits.observe(0)
    before = splits.bytes_written
    path.unlink()
    splits.observe(1)
    assert splits.bytes_written == before > 0
    assert splits.names() == {"rec_1_0.mcap"}


def test_a_closed_split_that_cannot_be_read_is_reported_and_counts_as_closed(
    splits: Splits,
) -> None:
    splits.directory.mkdir()
    (splits.directory / "rec_1_0.mcap").write_bytes(b"a text file of that name")
    changes = splits.observe(0)
    assert (changes.closed, len(changes.faults)) == (("rec_1_0.mcap",), 1)
    assert splits.observe(1) == SplitChanges()
