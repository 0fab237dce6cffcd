"""A sidecar that cannot be read for a moment is not taken for one that is not there."""

import errno
import os
from pathlib import Path

import pytest

from ros2_memory.bag_dir import handover_file as handovers
from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.bag_dir.handover_file import (
    Counting,
    Handover,
    read_handover,
    write_handover,
)
from ros2_memory.core.errors import BagUnreachableError, RecorderError
from ros2_memory.core.model import TimeWindow
from ros2_memory.recorder.handover import settle_handover
from ros2_memory.storage.mcap_reader import McapReader
from tests.faults.world import write_bag
from tests.support.fakes import broken
from tests.support.handovers import recover_handovers

HIDDEN = Handover(state=Counting.VOID)


def test_messages_that_do_not_count_do_not_come_in_because_the_disk_fails(tmp_path: Path) -> None:
    path = write_bag(tmp_path, 0)
    write_handover(path.parent, HIDDEN)
    everything = TimeWindow.everything()
    reader = BagDirReader(McapReader())
    with broken(handovers, "read_small_file", errno.EIO):
        with pytest.raises(BagUnreachableError, match=r"handover\.json cannot be read: Input"):
            reader.summarize(path)
        with pytest.raises(BagUnreachableError):
            list(reader.records(path, ["/odom"], everything))
    assert list(reader.records(path, ["/odom"], everything)) == []
    assert reader.summarize(path).empty


def test_a_handover_is_not_settled_from_what_a_failing_disk_hides(tmp_path: Path) -> None:
    path = write_bag(tmp_path, 0)
    old, new = path.parent, tmp_path / "rec_2"
    new.mkdir()
    begun = Handover(next="rec_2", notes=("a note",))
    write_handover(old, begun)
    write_handover(new, Handover(state=Counting.PENDING, previous="rec"))
    with broken(os, "open", errno.EIO, where=lambda path, *_: str(path).endswith(".mcap")):
        with pytest.raises(BagUnreachableError, match="Input/output error"):
            settle_handover(old, new, McapReader())
        recover_handovers(tmp_path, McapReader())
    assert read_handover(old).handover == begun
    broken_disk = broken(handovers, "read_small_file", errno.EIO)
    with broken_disk, pytest.raises(RecorderError, match="cannot be read"):
        settle_handover(old, new, McapReader())
    assert read_handover(old).handover == begun
    settle_handover(old, new, McapReader())
    assert read_handover(new).handover.state is Counting.COUNTS


def test_a_handover_that_did_not_begin_is_settled_once_the_disk_gives_its_sidecar(
    tmp_path: Path,
) -> None:
    old, new = tmp_path / "rec", tmp_path / "rec_2"
    old.mkdir()
    write_handover(old, Handover(next="rec_2"))
    broken_disk = broken(handovers, "read_small_file", errno.EIO)
    with broken_disk, pytest.raises(RecorderError, match="cannot be read"):
        settle_handover(old, new, McapReader(), ("rec",))
    assert settle_handover(old, new, McapReader(), ("rec",))
    assert read_handover(old).handover.next is None
