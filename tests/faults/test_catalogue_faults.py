"""Whatever becomes of the catalogue under a running server: answers stay right, and it returns."""

from __future__ import annotations

import os
import shutil
import sqlite3
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import anyio
import pytest
import structlog

from ros2_memory.catalogue.digest import Digester
from ros2_memory.catalogue.lookup import DigestCache
from ros2_memory.catalogue.store import FILE, FOLDER
from ros2_memory.columns.database import RETRY_S
from ros2_memory.core.errors import BagError
from ros2_memory.serving.backfill import (
    BACKLOG,
    RETRY_NS,
    Backfill,
    Progress,
    keep_backfilled,
)
from tests.faults.world import NOW, fill_up, plainly, served, told, write_bag, write_bags
from tests.support.clocks import SettableClock
from tests.support.processes import PATIENCE_S

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from ros2_memory.catalogue.digest import Digest


def delete(path: Path) -> None:
    path.unlink()


def delete_all(path: Path) -> None:
    shutil.rmtree(path.parent)


def truncate(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def empty(path: Path) -> None:
    os.truncate(path, 0)


def garbage(path: Path) -> None:
    path.write_bytes(os.urandom(path.stat().st_size))


def garbage_behind_the_head(path: Path) -> None:
    with path.open("r+b") as file:
        file.seek(4096)
        file.write(os.urandom(path.stat().st_size - 4096))


def _other(path: Path) -> Path:
    other = path.with_name("other")
    with closing(sqlite3.connect(other)) as base:
        base.execute("CREATE TABLE rooms (number INTEGER, name TEXT)")
        base.commit()
    return other


def replace_by_another(path: Path) -> None:
    _other(path).rename(path)


def overwrite_by_another(path: Path) -> None:
    shutil.copyfile(_other(path), path)


def become_a_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def delete_log(path: Path) -> None:
    path.with_name(f"{path.name}-wal").unlink()


def delete_index_of_log(path: Path) -> None:
    path.with_name(f"{path.name}-shm").unlink()


def overwrite_log(path: Path) -> None:
    path.with_name(f"{path.name}-wal").write_bytes(os.urandom(9000))


FAULTS: tuple[Callable[[Path], None], ...] = (
    delete,
    delete_all,
    truncate,
    empty,
    garbage,
    garbage_behind_the_head,
    replace_by_another,
    overwrite_by_another,
    become_a_folder,
    delete_log,
    delete_index_of_log,
    overwrite_log,
)


def warned(logs: Sequence[Mapping[str, object]]) -> list[object]:
    return [each["event"] for each in logs if each["log_level"] in {"warning", "error"}]


def trouble_of(filler: Backfill) -> str | None:
    return filler.catalogue.trouble


def filled_anew(filler: Backfill) -> None:
    """What the server's background does, round after round."""
    for _ in range(2):
        filler.look_after()
        fill_up(filler)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
def test_answers_stay_right_and_the_catalogue_comes_back(
    tmp_path: Path, fault: Callable[[Path], None]
) -> None:
    memory, filler = served(tmp_path)
    # In two steps: the newest come first, so that every entry gets another number the next time.
    for first in (0, 3):
        write_bags(tmp_path, 3, first=first)
        fill_up(filler)
    right = plainly(tmp_path, count=6)
    path = tmp_path / FOLDER / FILE
    fault(path)
    with structlog.testing.capture_logs() as logs:
        assert told(memory, count=6) == right
        # Digested after the fault, so that numbers of entries would be met a second time.
        filled_anew(filler)
        write_bag(tmp_path, 6)
        filled_anew(filler)
    right = plainly(tmp_path, count=7)
    assert told(memory, count=7) == right
    assert len(warned(logs)) <= 2, logs
    if path.is_file():
        assert trouble_of(filler) is None
    assert filler.progress().waiting == 0
    again, filler = served(tmp_path)
    filled_anew(filler)
    assert told(again, count=7) == right
    assert again.recall is not None
    assert_sound(again.recall.catalogue.path)


def assert_sound(path: Path | None) -> None:
    if path is not None:
        with closing(sqlite3.connect(path)) as base:
            assert base.execute("PRAGMA integrity_check").fetchall() == [("ok",)]


def test_an_older_copy_of_the_catalogue_put_in_its_place_misleads_nobody(tmp_path: Path) -> None:
    write_bags(tmp_path, 4)
    memory, filler = served(tmp_path)
    fill_up(filler)
    path = tmp_path / FOLDER / FILE
    copy = tmp_path / "copy"
    with closing(sqlite3.connect(path)) as base, closing(sqlite3.connect(copy)) as target:
        base.backup(target)
    write_bags(tmp_path, 4, first=4)
    fill_up(filler)
    right = plainly(tmp_path, count=8)
    assert told(memory, count=8) == right
    copy.rename(path)
    filled_anew(filler)
    write_bags(tmp_path, 4, first=8)
    filled_anew(filler)
    assert told(memory, count=12) == plainly(tmp_path)


def test_a_catalogue_locked_by_another_keeps_no_question_waiting(tmp_path: Path) -> None:
    write_bags(tmp_path)
    memory, filler = served(tmp_path)
    fill_up(filler)
    path = tmp_path / FOLDER / FILE
    write_bag(tmp_path, 12)
    right = plainly(tmp_path, count=13)
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        with structlog.testing.capture_logs() as logs:
            for bag in filler.waiting():
                assert not filler.digest(bag)
                assert not filler.digest(bag)
            assert told(memory, count=13) == right
        assert warned(logs) == ["database_failed"]
        assert trouble_of(filler) == "cannot be used: database is locked"
    with structlog.testing.capture_logs() as logs:
        fill_up(filler)
    assert "database_works_again" in [each["event"] for each in logs]
    assert trouble_of(filler) is None
    assert filler.progress().waiting == 0
    assert told(memory, count=13) == right


def test_a_catalogue_locked_at_the_start_is_gone_back_to(tmp_path: Path) -> None:
    write_bags(tmp_path)
    memory, filler = served(tmp_path)
    fill_up(filler)
    path = tmp_path / FOLDER / FILE
    right = plainly(tmp_path)
    assert memory.recall is not None
    memory.recall.catalogue.close()
    memory, filler = served(tmp_path)
    assert memory.recall is not None
    base = memory.recall.catalogue
    passed = [0.0]
    base._monotonic = lambda: time.monotonic() + passed[0]
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("PRAGMA locking_mode = EXCLUSIVE")
        other.execute("BEGIN EXCLUSIVE")
        assert told(memory) == right
        assert trouble_of(filler) == "is kept in memory: another program has locked its file"
        fill_up(filler)
        passed[0] += RETRY_S
        filler.look_after()
        assert filler.catalogue.path is None
    passed[0] += RETRY_S
    filler.look_after()
    assert memory.recall.catalogue.path == path
    assert trouble_of(filler) is None
    assert told(memory) == right
    assert filler.progress().waiting == 0


class Busy(sqlite3.Connection):
    """A base that fails in passing, whatever it is asked."""

    def execute(self, *_: object) -> NoReturn:
        error = sqlite3.OperationalError("disk I/O error")
        error.sqlite_errorcode = sqlite3.SQLITE_IOERR
        raise error


class Refusing(Digester):
    def digest(self, path: Path) -> Digest:
        raise BagError(str(path), "no digest of it can be made")


class Counted(Backfill):
    """A filler that counts the rounds in which it was looked after."""

    rounds = 0

    def look_after(self, *, thorough: bool = False) -> None:
        self.rounds += 1
        super().look_after(thorough=thorough)


def test_what_could_not_be_asked_once_is_asked_again(tmp_path: Path) -> None:
    """A failure that passes must not be taken for "nothing is known" for ever."""
    write_bags(tmp_path)
    memory, filler = served(tmp_path)
    fill_up(filler)
    assert memory.recall is not None
    base = memory.recall.catalogue
    opened = base._opened
    assert opened is not None
    recall = DigestCache(memory.recall.catalogue, tmp_path)
    [run] = memory.index.snapshot().timeline.segments
    as_of = recall.catalogue.newest()
    base._opened = replace(opened, connection=Busy(":memory:"))
    assert not recall.digests_for(run, as_of).numbers
    base._opened = opened
    notes = recall.digests_for(run, as_of)
    assert notes.whole
    base._opened = replace(opened, connection=Busy(":memory:"))
    assert notes.relatched("/tf_static") == {}
    base._opened = opened
    assert len(notes.relatched("/tf_static")) == 12


async def test_bags_that_cannot_be_digested_have_the_helper_started_no_second_time(
    tmp_path: Path,
) -> None:
    write_bags(tmp_path, BACKLOG + 1)
    memory, _ = served(tmp_path)
    filler = Counted(memory, Refusing(memory.reader), tmp_path)
    started = tmp_path / "started"
    helper = ["sh", "-c", f"echo once >> {started}"]
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(keep_backfilled, filler, helper, 0.001)
        with anyio.fail_after(PATIENCE_S):
            while filler.progress().waiting:
                await anyio.sleep(0.01)
            begun = filler.rounds
            # The one under way may yet start it; from the next on nothing waits.
            while filler.rounds < begun + 2:
                await anyio.sleep(0.01)
            starts = len(started.read_text().split())
            while filler.rounds < begun + 7:
                await anyio.sleep(0.01)
        tasks.cancel_scope.cancel()
    assert len(started.read_text().split()) == starts <= 2


def test_a_bag_that_could_not_be_digested_is_tried_again_later(tmp_path: Path) -> None:
    write_bags(tmp_path, 2)
    memory, _ = served(tmp_path)
    clock = SettableClock(NOW.now())
    memory = replace(memory, clock=clock)
    refusing = Backfill(memory, Refusing(memory.reader), tmp_path)
    fill_up(refusing)
    assert refusing.progress() == Progress(2, 0, 2)
    clock.at += RETRY_NS
    assert refusing.progress() == Progress(2, 2, 0)


def test_an_empty_bag_directory_purges_nothing(tmp_path: Path) -> None:
    """A server may start before the disk of the bags is mounted."""
    bag_dir, away = tmp_path / "bags", tmp_path / "away"
    write_bags(bag_dir, 3)
    memory, filler = served(bag_dir)
    fill_up(filler)
    (bag_dir / "rec").rename(away)
    filler.prune()
    assert memory.recall is not None
    assert len(memory.recall.catalogue.paths()) == 3
    away.rename(bag_dir / "rec")
    assert filler.progress().waiting == 0
