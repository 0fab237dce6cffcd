"""A bag that moments keep is one bag, whichever of its names the index meets first."""

import os
from pathlib import Path

import pytest

from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.core.errors import BagVanishedError
from ros2_memory.core.model import TimeWindow
from ros2_memory.history.context import Call, SnapshotSource
from ros2_memory.queries import list_recorded_topics
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import odom, write_mcap
from tests.support.memories import memory_of

S = 10**9


def found(index: SnapshotSource) -> list[str]:
    return [bag.file for bag in index.refresh().bags]


# The index looks every few seconds; a bag may have gone from where it was since.


def test_a_kept_bag_is_read_under_its_other_name(tmp_path: Path) -> None:
    recorded = write_mcap(tmp_path / "rec/rec_0.mcap", [odom(S, 1.0, 2.0)])
    linked = tmp_path / "moments/one/rec/rec_0.mcap"
    linked.parent.mkdir(parents=True)
    os.link(recorded, linked)
    reader = BagDirReader(McapReader(), tmp_path)
    everything = TimeWindow.everything()

    def read(path: Path) -> tuple[object, ...]:
        return (
            [each.log_time for each in reader.records(path, ["/odom"], everything)],
            reader.newest(path, "/odom", everything) is not None,
            [channel.topic for channel in reader.channels(path)],
        )

    before = read(recorded)
    assert before == ([S], True, ["/odom"])
    begun = reader.records(recorded, ["/odom"], everything)
    recorded.unlink()
    assert [each.log_time for each in begun] == [S]
    assert read(recorded) == before
    # The index is told how it is.
    with pytest.raises(BagVanishedError):
        reader.summarize(recorded)
    os.link(linked, recorded)
    linked.unlink()
    assert read(linked) == before
    recorded.unlink()
    with pytest.raises(BagVanishedError):
        read(recorded)


def test_a_hard_link_beside_its_original_is_no_second_bag(tmp_path: Path) -> None:
    recorded = write_mcap(tmp_path / "rec/rec_0.mcap", [odom(S, 1.0, 2.0)])
    memory = memory_of(tmp_path)
    assert found(memory.index) == [str(recorded)]
    linked = tmp_path / "rec/rec_0_link.mcap"
    os.link(recorded, linked)
    saved = tmp_path / "moments/one/rec/rec_0.mcap"
    saved.parent.mkdir(parents=True)
    os.link(recorded, saved)
    for index in (memory.index, memory_of(tmp_path).index):
        assert found(index) == [str(recorded)]
    [row] = list_recorded_topics(memory, Call())
    assert row.count == 1
    # One with an earlier name takes over.
    outer = tmp_path / "a.mcap"
    os.link(recorded, outer)
    assert found(memory.index) == [str(outer)]
    outer.unlink()
    recorded.unlink()
    assert found(memory.index) == [str(linked)]
    linked.unlink()
    assert found(memory.index) == [str(saved)]
    saved.unlink()
    assert found(memory.index) == []
