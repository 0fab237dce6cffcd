"""A bag that moments keep is one bag, whichever of its names the index meets first."""

import os
import shutil
from pathlib import Path

import pytest

from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.core.errors import BagVanishedError
from ros2_memory.core.model import TimeWindow
from ros2_memory.history.context import Call, SnapshotSource
from ros2_memory.index.bag_rows import BagRows
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.queries import list_recorded_topics
from ros2_memory.recorder.index_manager import IndexManager
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import odom, write_mcap
from tests.support.clocks import FixedClock
from tests.support.memories import memory_of
from tests.support.plain_text_bags import PlainReader, plain

S = 10**9
NOW = 1_800_000_000 * S
LONG_AGO = NOW - 3600 * S


class Start:
    """A bag directory that was indexed before, and an index that begins anew over it."""

    def __init__(self, bag_dir: Path) -> None:
        self.bag_dir = bag_dir
        self.known: list[BagRows] = []
        for split in range(6):
            plain(bag_dir / "rec" / f"rec_{split}.mcap", [split * 10, split * 10 + 9])
        self.age()

    def age(self, at: int = LONG_AGO) -> None:
        """Gives every file and directory the same mtime."""
        for path in (self.bag_dir, *self.bag_dir.rglob("*")):
            os.utime(path, ns=(at, at))

    def remember(self) -> None:
        """Knows from then on all bags as they are."""
        self.known = [segment.bags for segment in self.read().timeline.segments]

    def index(self, *, knowing: bool = True) -> IndexManager:
        """An index that has scanned nothing yet."""
        return IndexManager(
            self.bag_dir,
            PlainReader(),
            FixedClock(NOW),
            refresh_s=5.0,
            split_duration_s=10.0,
            known=lambda: self.known if knowing else [],
        )

    def read(self) -> Snapshot:
        """The snapshot of an index that reads everything."""
        return self.index(knowing=False).refresh()


def keep(start: Start, moment: str, *splits: int) -> None:
    """Links some of the known bags into a moment."""
    folder = start.bag_dir / "moments" / moment / "rec"
    folder.mkdir(parents=True)
    for split in splits:
        os.link(start.bag_dir / "rec" / f"rec_{split}.mcap", folder / f"rec_{split}.mcap")


def found(index: SnapshotSource) -> list[str]:
    return [bag.file for bag in index.refresh().bags]


@pytest.fixture
def start(tmp_path: Path) -> Start:
    begun = Start(tmp_path)
    begun.remember()
    return begun


class TestAQuestionMeanwhile:
    """The index looks every few seconds; a bag may have gone from where it was since."""

    def test_a_kept_bag_is_read_under_its_other_name(self, tmp_path: Path) -> None:
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


class TestTheIndex:
    """Bags that the catalogue knows are taken over unread; what is kept is weighed beside them."""

    def test_it_answers_when_the_other_has_gone_under_a_running_index(self, start: Start) -> None:
        index = start.index()
        before = index.refresh()
        keep(start, "one", 1, 2)
        keep(start, "two", 2, 3)
        index.refresh()
        for split in (1, 2):
            (start.bag_dir / "rec" / f"rec_{split}.mcap").unlink()
        after = index.refresh()
        assert [bag[5:7] for bag in after.bags] == [bag[5:7] for bag in before.bags]
        assert [bag.file for bag in after.bags][1:3] == [
            f"{start.bag_dir}/moments/one/rec/rec_{split}.mcap" for split in (1, 2)
        ]
        start.remember()
        assert found(start.index()) == [bag.file for bag in after.bags]
        shutil.rmtree(start.bag_dir / "moments/one")
        assert len(index.refresh().bags) == 5
        assert [*index.refresh().bags] == [*start.read().bags]


class TestOtherNames:
    def test_a_hard_link_beside_its_original_is_no_second_bag(self, tmp_path: Path) -> None:
        recorded = write_mcap(tmp_path / "rec/rec_0.mcap", [odom(S, 1.0, 2.0)])
        memory = memory_of(tmp_path)
        assert found(memory.index) == [str(recorded)]
        linked = tmp_path / "rec/rec_0_link.mcap"
        os.link(recorded, linked)
        (tmp_path / "z/backup").mkdir(parents=True)
        os.link(recorded, tmp_path / "z/backup/rec_0.mcap")
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
        assert len(memory.index.refresh().bags) == 1
