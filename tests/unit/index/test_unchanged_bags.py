"""Bags that the catalogue knows are taken over unread, and woken by whatever happens to them."""

import os
import random
from pathlib import Path

import pytest

from ros2_memory.index.bag_rows import BagRows
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.recorder.index_manager import IndexManager
from tests.support.clocks import FixedClock
from tests.support.examples import examples
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

    def index(self, *, knowing: bool = True) -> tuple[IndexManager, PlainReader]:
        """An index that has scanned nothing yet, and its reader."""
        reader = PlainReader(".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
        index = IndexManager(
            self.bag_dir,
            reader,
            FixedClock(NOW),
            refresh_s=5.0,
            split_duration_s=10.0,
            known=lambda: self.known if knowing else [],
        )
        return index, reader

    def read(self) -> Snapshot:
        """The snapshot of an index that reads everything."""
        return self.index(knowing=False)[0].refresh()


@pytest.fixture
def start(tmp_path: Path) -> Start:
    begun = Start(tmp_path)
    begun.remember()
    return begun


@pytest.mark.parametrize("seed", range(examples(40)))
def test_whatever_happens_to_known_bags_the_index_is_that_of_one_that_read_them(
    start: Start, seed: int
) -> None:
    chance = random.Random(seed)
    (index, _), (other, _) = start.index(), start.index(knowing=False)
    assert index.refresh() == other.refresh()
    for step in range(6):
        number = chance.randrange(8)
        path = start.bag_dir / "rec" / f"rec_{number}.mcap{chance.choice(['', '', '.zstd'])}"
        if path.exists() and chance.random() < 0.5:
            path.unlink()
        else:
            times = sorted(chance.sample(range(100), chance.randint(0, 3)))
            plain(path, times, closed=chance.random() < 0.8)
        start.age(LONG_AGO + step * S + S)
        assert index.refresh() == other.refresh()
