"""What is known of the bag directory."""

import os
import threading
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from structlog.testing import capture_logs

from ros2_memory.core.model import BagFile, SetAside
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.recorder.index_manager import IndexManager
from tests.support.bags import set_mtime
from tests.support.clocks import SettableClock
from tests.support.plain_text_bags import PlainReader, plain

S = 10**9
NOW = 1_800_000_000 * S
LONG_AGO = NOW - 3600 * S


class Yard:
    """A bag directory, its index, and a hand on the clock and on every mtime."""

    def __init__(self, bag_dir: Path, *kinds: str) -> None:
        self.bag_dir = bag_dir
        self.clock = SettableClock(NOW)
        self.reader = PlainReader(*kinds)
        self.index = IndexManager(
            bag_dir, self.reader, self.clock, refresh_s=5.0, split_duration_s=10.0
        )

    def split(self, number: int, times: Sequence[int] = (), **how: Any) -> Path:
        return plain(self.bag_dir / "rec" / f"rec_{number}.mcap", times, **how)

    def age(self) -> None:
        """Gives every file and directory the same mtime."""
        for path in (self.bag_dir, *self.bag_dir.rglob("*")):
            os.utime(path, ns=(LONG_AGO, LONG_AGO), follow_symlinks=False)

    def scan_after(self, seconds: float = 0.0) -> Snapshot:
        self.clock.at += round(seconds * S)
        return self.index.refresh()


@pytest.fixture
def yard(tmp_path: Path) -> Yard:
    (tmp_path / "bags").mkdir()
    return Yard(tmp_path / "bags")


def _names(files: Iterable[BagFile | SetAside]) -> list[str]:
    return [each.path.name for each in files]


def test_a_rescan_reads_what_is_new_and_nothing_else(yard: Yard) -> None:
    for number in range(3):
        yard.split(number, [number])
    yard.age()
    yard.scan_after()
    new = yard.split(3, [3])
    set_mtime(new, LONG_AGO)
    for _ in range(3):
        assert len(yard.scan_after(10).bags) == 4
    assert yard.reader.summaries == {f"rec_{split}.mcap": 1 for split in range(4)}
    assert yard.reader.closings == yard.reader.summaries


@pytest.mark.parametrize(
    ("plain_closed", "packed_closed", "answers"),
    [
        (True, False, "rec_0.mcap"),
        (False, True, "rec_0.mcap.zstd"),
        (False, False, "rec_0.mcap"),
    ],
)
def test_of_a_bag_that_lies_there_compressed_too_only_one_is_indexed(
    tmp_path: Path, plain_closed: bool, packed_closed: bool, answers: str
) -> None:
    yard = Yard(tmp_path, ".mcap", ".mcap.zstd")
    plain(tmp_path / "rec_0.mcap", [1, 2], closed=plain_closed)
    plain(tmp_path / "rec_0.mcap.zstd", [1, 2], closed=packed_closed)
    yard.age()
    snapshot = yard.index.refresh()
    assert _names(snapshot.bags) == [answers]
    assert snapshot.active == snapshot.damaged == snapshot.unread == ()


def test_a_form_that_is_not_read_is_no_complaint_until_it_is_kept_beside_the_other(
    tmp_path: Path,
) -> None:
    yard = Yard(tmp_path, ".mcap")
    plain(tmp_path / "rec_0.mcap", [1])
    plain(tmp_path / "rec_1.mcap.zstd", [1])
    yard.age()
    set_mtime(plain(tmp_path / "rec_0.mcap.zstd", [1]), NOW)
    snapshot = yard.scan_after()
    assert _names(snapshot.bags) == ["rec_0.mcap"]
    assert _names(snapshot.unread) == ["rec_1.mcap.zstd"]
    assert _names(yard.scan_after(31).unread) == ["rec_0.mcap.zstd", "rec_1.mcap.zstd"]


def test_a_snapshot_is_kept_until_it_is_older_than_refresh_s(yard: Yard) -> None:
    first = yard.index.snapshot()
    yard.clock.at += 5 * S - 1
    assert yard.index.snapshot() is first
    yard.clock.at += 1
    assert yard.index.snapshot().scanned_at == NOW + 5 * S


def test_a_question_that_reaches_past_the_newest_end_looks_for_newer_bags(yard: Yard) -> None:
    yard.split(0, [0, 9])
    first = yard.index.snapshot(reach=9)
    yard.split(1, [10, 19])
    assert yard.index.snapshot() is first
    assert yard.index.snapshot(reach=9) is first
    assert _names(yard.index.snapshot(reach=10).bags) == ["rec_0.mcap", "rec_1.mcap"]


def test_callers_that_come_during_a_scan_share_its_result(yard: Yard) -> None:
    yard.split(0, [0, 9])
    yard.age()
    reading, go_on = threading.Event(), threading.Event()

    def hold(path: Path) -> None:
        reading.set()
        go_on.wait(10)

    yard.reader.before_summary = hold
    with ThreadPoolExecutor(8) as pool:
        first = pool.submit(yard.index.snapshot)
        assert reading.wait(10)
        others = [pool.submit(yard.index.snapshot) for _ in range(7)]
        go_on.set()
        snapshots = {id(future.result(10)) for future in (first, *others)}
    assert len(snapshots) == 1
    assert yard.reader.summaries.total() == 1


def test_a_scan_that_fails_on_a_defect_loses_nothing(yard: Yard) -> None:
    for number in range(3):
        yard.split(number, [number])
    yard.age()

    def fail(path: Path) -> None:
        raise ZeroDivisionError

    yard.reader.before_summary = fail
    with pytest.raises(ZeroDivisionError):
        yard.index.snapshot()
    yard.reader.before_summary = bool
    assert len(yard.index.snapshot().bags) == 3


def test_a_scan_that_changed_something_is_one_log_event(yard: Yard) -> None:
    yard.split(0, [0, 9])
    (yard.bag_dir / "rec" / "rec_1.mcap").touch()
    yard.age()
    with capture_logs() as events:
        yard.scan_after()
        yard.scan_after(5)
    damaged, scanned = events
    assert damaged["event"] == "bag_damaged"
    assert (damaged["reason"], Path(damaged["path"]).name) == ("the file is empty", "rec_1.mcap")
    counts = [scanned[key] for key in ("event", "bags", "added", "removed", "damaged", "active")]
    assert counts == ["index_scanned", 1, 1, 0, 1, 0]
