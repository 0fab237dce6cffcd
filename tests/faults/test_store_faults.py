"""Whatever becomes of the store's file under a running server: answers stay right, it returns."""

import os
import shutil
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import NoReturn
from unittest.mock import patch

import anyio
import anyio.lowlevel
import pytest
import structlog

from ros2_memory.columns import database, fill
from ros2_memory.columns.decode import undecoded
from ros2_memory.columns.fill import RETRY_NS, Progress
from ros2_memory.columns.units import GoneError
from ros2_memory.core.errors import BagError
from ros2_memory.serving.backfill import BACKLOG, Backfill, keep_backfilled
from tests.faults.world import NOW, fill_up, plainly, served, store_of, told, write_bag, write_bags
from tests.support.clocks import SettableClock
from tests.support.column_worlds import store_file
from tests.support.processes import PATIENCE_S


def delete(path: Path) -> None:
    path.unlink()


def delete_all(path: Path) -> None:
    shutil.rmtree(path.parent)


def _empty_log(path: Path) -> None:
    """Has what is in the write-ahead log in the file alone, so that damage to this is met."""
    with closing(sqlite3.connect(path)) as base:
        base.execute("PRAGMA wal_checkpoint(TRUNCATE)")


def truncate(path: Path) -> None:
    _empty_log(path)
    os.truncate(path, path.stat().st_size // 2)


def empty(path: Path) -> None:
    _empty_log(path)
    os.truncate(path, 0)


def garbage(path: Path) -> None:
    _empty_log(path)
    path.write_bytes(os.urandom(path.stat().st_size))


def garbage_behind_the_head(path: Path) -> None:
    _empty_log(path)
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


def filled_anew(filler: Backfill) -> None:
    """What the server's background does, round after round."""
    for _ in range(2):
        filler.look_after()
        fill_up(filler)


def assert_sound(path: Path | None, bags: int) -> None:
    """Another program finds an intact store there, with so many bags."""
    assert path is not None
    with closing(sqlite3.connect(f"{path.as_uri()}?mode=rw", uri=True)) as base:
        assert base.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        assert base.execute("SELECT count(*) FROM bag WHERE size >= 0").fetchone() == (bags,)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
def test_answers_stay_right_and_the_store_comes_back(
    tmp_path: Path, fault: Callable[[Path], None]
) -> None:
    memory, filler = served(tmp_path)
    # In two steps: the newest come first, so that every bag gets another number the next time.
    for first in (0, 3):
        write_bags(tmp_path, 3, first=first)
        fill_up(filler)
    right = plainly(tmp_path, count=6)
    path = store_file(tmp_path)
    fault(path)
    with structlog.testing.capture_logs() as logs:
        # What is asked when the loss is noticed may have to be asked again, and says so.
        for given, expected in zip(told(memory, count=6), right, strict=True):
            assert given in {expected, repr(GoneError())}
        assert told(memory, count=6) == right
        # Stored after the fault, so that numbers of bags would be met a second time.
        filled_anew(filler)
        write_bag(tmp_path, 6)
        filled_anew(filler)
    right = plainly(tmp_path, count=7)
    assert told(memory, count=7) == right
    assert len(warned(logs)) <= 2, logs
    if path.is_file():
        assert store_of(filler).trouble is None
    assert filler.progress() == Progress(7, 7)
    assert_sound(store_of(filler).path, 7)
    again, filler = served(tmp_path)
    filled_anew(filler)
    assert filler.progress() == Progress(7, 7)
    assert told(again, count=7) == right
    assert_sound(store_of(filler).path, 7)


def test_an_older_copy_of_the_store_put_in_its_place_misleads_nobody(tmp_path: Path) -> None:
    write_bags(tmp_path, 4)
    memory, filler = served(tmp_path)
    fill_up(filler)
    path = store_file(tmp_path)
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
    assert filler.progress() == Progress(12, 12)
    assert told(memory) == plainly(tmp_path)


def test_a_store_locked_at_the_start_is_gone_back_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_bags(tmp_path)
    _, filler = served(tmp_path)
    fill_up(filler)
    path = store_file(tmp_path)
    right = plainly(tmp_path)
    store_of(filler).close()
    memory, filler = served(tmp_path)
    store = store_of(filler)
    monkeypatch.setattr(database, "RETRY_S", 0.0)
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("PRAGMA locking_mode = EXCLUSIVE")
        other.execute("BEGIN EXCLUSIVE")
        assert told(memory) == right
        assert store.trouble == "is kept in memory: another program has locked its file"
        fill_up(filler)
        filler.look_after()
        assert store.path is None
    filler.look_after()
    assert store_of(filler).path == path
    assert store_of(filler).trouble is None
    assert told(memory) == right
    assert filler.progress() == Progress(12, 12)


class Counted(Backfill):
    """A filler that counts the rounds in which it was looked after."""

    rounds = 0

    def look_after(self, *, thorough: bool = False) -> None:
        self.rounds += 1
        super().look_after(thorough=thorough)


def refused(_reader: object, path: Path, **_: object) -> NoReturn:
    raise BagError(str(path), "no columns can be made of it")


@patch.object(fill, "undecoded", refused)
async def test_bags_that_cannot_be_stored_have_the_helper_started_no_second_time(
    tmp_path: Path,
) -> None:
    write_bags(tmp_path, BACKLOG + 1)
    memory, served_by = served(tmp_path)
    filler = Counted(memory, served_by.filling)
    started = tmp_path / "started"
    helper = ["sh", "-c", f"echo once >> {started}"]
    async with anyio.create_task_group() as tasks:
        filler.helper = helper
        tasks.start_soon(keep_backfilled, filler, 0.001)
        with anyio.fail_after(PATIENCE_S):
            while filler.progress().waiting:
                await anyio.lowlevel.checkpoint()
            begun = filler.rounds
            # The one under way may yet start it; from the next on nothing waits.
            while filler.rounds < begun + 2:
                await anyio.lowlevel.checkpoint()
            starts = len(started.read_text().split())
            while filler.rounds < begun + 7:
                await anyio.lowlevel.checkpoint()
        tasks.cancel_scope.cancel()
    assert filler.progress() == Progress(BACKLOG + 1, refused=BACKLOG + 1)
    assert len(started.read_text().split()) == starts <= 2


def test_a_bag_that_could_not_be_stored_is_tried_again_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_bags(tmp_path, 2)
    clock = SettableClock(NOW.now())
    _, filler = served(tmp_path, clock)
    monkeypatch.setattr(fill, "undecoded", refused)
    fill_up(filler)
    assert filler.progress() == Progress(2, refused=2)
    monkeypatch.setattr(fill, "undecoded", undecoded)
    fill_up(filler)
    assert filler.progress() == Progress(2, refused=2)
    clock.at += RETRY_NS
    assert filler.progress() == Progress(2, waiting=2)
    fill_up(filler)
    assert filler.progress() == Progress(2, 2)
