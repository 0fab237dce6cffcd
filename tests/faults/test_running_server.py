"""A running server whose files are taken, filled, locked and given back.

What is promised of each: right answers or honest ones meanwhile, the reason in `/health`, and
everything as it was when the fault is over, without a restart. With `FAULTS_ALL=1` every fault of
the store is tried on a server, which takes a minute, and otherwise a few.
"""

import json
import os
import resource
import sqlite3
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import Any

from tests.faults import test_store_faults as faults
from tests.faults.running import Running, serving
from tests.faults.small_disk import filled, mount, needs_mounts, small_disk, unmount
from tests.faults.world import write_bag, write_bags
from tests.support.column_worlds import store_file
from tests.support.processes import until

COUNT = 12
FAULTS = (
    faults.FAULTS
    if os.environ.get("FAULTS_ALL")
    else (faults.delete, faults.garbage, faults.overwrite_by_another)
)


def is_ready(running: Running, bags: int) -> bool:
    """Whether nothing is amiss, and all these bags are stored."""
    reply = running.health()
    store = reply.get("store", {})
    known = (store.get("bags"), store.get("waiting"), store.get("state"))
    return reply["status"] == "ok" and known == (bags, 0, "ready")


def holds(path: Path, bags: int) -> bool:
    """Whether another program finds a whole store there, with so many bags in it."""
    try:
        with closing(sqlite3.connect(f"file:{path}?mode=rw", uri=True)) as base:
            [(count,)] = base.execute("SELECT count(*) FROM bag WHERE size >= 0").fetchall()
            return bool(count == bags) and base.execute("PRAGMA quick_check").fetchone() == ("ok",)
    except sqlite3.Error:
        return False


def recovers(running: Running, bags: int) -> None:
    until(partial(is_ready, running, bags))


def problem(running: Running, words: str) -> str | None:
    """The problem in `/health` that has these words."""
    reply = running.health()
    assert reply["status"] == ("degraded" if reply.get("problems") else "ok")
    return next((each for each in reply.get("problems", ()) if words in each), None)


def says(running: Running, words: str) -> None:
    until(partial(problem, running, words))


def is_honest(answer: str) -> bool:
    """Whether an answer claims nothing of what cannot be seen: it is an error, or has a note."""
    reply: Any = json.loads(answer)
    return isinstance(reply, dict) and ("error" in reply or bool(reply.get("notes")))


def is_to_be_asked_again(answer: str) -> bool:
    """Whether an answer says that the store was lost under it."""
    reply: Any = json.loads(answer)
    return isinstance(reply, dict) and "deleted while they were read" in reply.get("detail", "")


def test_the_store_comes_back_whatever_becomes_of_it(tmp_path: Path) -> None:
    bag_dir = tmp_path / "bags"
    write_bags(bag_dir, COUNT)
    path = store_file(bag_dir)
    with serving(bag_dir, tmp_path / "log") as running:
        recovers(running, COUNT)
        right = running.ask_all(COUNT)
        for fault in FAULTS:
            fault(path)
            for given, expected in zip(running.ask_all(COUNT), right, strict=True):
                assert given == expected or is_to_be_asked_again(given), fault.__name__
            if path.is_dir():
                path.rmdir()
            until(partial(holds, path, COUNT))
            recovers(running, COUNT)
            assert running.ask_all(COUNT) == right, fault.__name__
    with serving(bag_dir, tmp_path / "log") as running:
        recovers(running, COUNT)
        assert running.ask_all(COUNT) == right
    faults.assert_sound(path, COUNT)


def test_a_store_that_another_program_holds_is_said_and_waited_for(tmp_path: Path) -> None:
    bag_dir = tmp_path / "bags"
    write_bags(bag_dir, COUNT)
    path = store_file(bag_dir)
    with serving(bag_dir, tmp_path / "log") as running:
        recovers(running, COUNT)
        with closing(sqlite3.connect(path, isolation_level=None)) as other:
            other.execute("BEGIN EXCLUSIVE")
            before = len(running.logged("database_failed"))
            write_bag(bag_dir, COUNT)
            says(running, "the store of columns cannot be used: database is locked")
            answers = running.ask_all(COUNT + 1)
        recovers(running, COUNT + 1)
        assert running.ask_all(COUNT + 1) == answers
        assert "thing12" in answers[3]
        # Once by the server, and by its child that stored the first bags, if that still ran.
        assert len(running.logged("database_failed")) - before in {1, 2}


def test_a_bag_directory_that_is_renamed_away_and_back_is_the_same_again(tmp_path: Path) -> None:
    bag_dir, away = tmp_path / "bags", tmp_path / "away"
    write_bags(bag_dir, COUNT)
    with serving(bag_dir, tmp_path / "log") as running:
        recovers(running, COUNT)
        right = running.ask_all(COUNT)
        bag_dir.rename(away)
        says(running, "the bag directory does not exist")
        for answer in running.ask_all(COUNT):
            assert is_honest(answer), answer
        assert not bag_dir.exists()
        away.rename(bag_dir)
        recovers(running, COUNT)
        assert running.ask_all(COUNT) == right


@needs_mounts
def test_a_disk_that_is_unmounted_and_mounted_again_loses_nothing(tmp_path: Path) -> None:
    bag_dir, kept = tmp_path / "bags", tmp_path / "kept"
    kept.mkdir()
    cache = {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    with small_disk(bag_dir, "16m"):
        mount(kept, "--bind", str(bag_dir))
        try:
            write_bags(bag_dir, COUNT)
            # The store in the cache folder is the one that could be pruned meanwhile.
            told = ("recorder=none", "logging.level=debug")
            with serving(bag_dir, tmp_path / "log", *told, **cache) as running:
                recovers(running, COUNT)
                right = running.ask_all(COUNT)
                unmount(bag_dir)
                says(running, "the disk of the bags has been unmounted")
                for answer in running.ask_all(COUNT):
                    assert is_honest(answer), answer
                assert not list(bag_dir.iterdir())
                assert sum(event["bags"] for event in running.logged("bags_stored")) == COUNT
                mount(bag_dir, "--bind", str(kept))
                recovers(running, COUNT)
                assert running.ask_all(COUNT) == right
                assert sum(event["bags"] for event in running.logged("bags_stored")) == COUNT
        finally:
            unmount(kept)


@needs_mounts
def test_a_full_disk_under_the_store_is_said_and_got_over(tmp_path: Path) -> None:
    bag_dir = tmp_path / "bags"
    write_bags(bag_dir, COUNT)
    with small_disk(tmp_path / "cache", "4m") as cache, ExitStack() as stack:
        place = {"XDG_CACHE_HOME": str(cache)}
        full = stack.enter_context(ExitStack())
        full.enter_context(filled(cache))
        running = stack.enter_context(serving(bag_dir, tmp_path / "log", "recorder=none", **place))
        says(running, "the store of columns is kept in memory: no file can be written for it")
        right = running.ask_all(COUNT)
        full.close()
        recovers(running, COUNT)
        assert running.ask_all(COUNT) == right
        full.enter_context(filled(cache))
        write_bags(bag_dir, 8, first=COUNT)
        says(running, "database or disk is full")
        until(lambda: running.health()["bags"] == COUNT + 8)
        right = running.ask_all(COUNT + 8)
        full.close()
        recovers(running, COUNT + 8)
        assert running.ask_all(COUNT + 8) == right
        assert f"thing{COUNT + 7}" in right[3]


def test_too_many_open_files_are_said_and_got_over(tmp_path: Path) -> None:
    bag_dir = tmp_path / "bags"
    write_bags(bag_dir, COUNT)
    with serving(bag_dir, tmp_path / "log") as running:
        recovers(running, COUNT)
        right = running.ask_all(COUNT)
        pid = running.process.pid
        limits = resource.prlimit(pid, resource.RLIMIT_NOFILE)
        most = max(int(each.name) for each in Path(f"/proc/{pid}/fd").iterdir())
        # One more is enough to be asked, and to ask with; none is left for a bag.
        resource.prlimit(pid, resource.RLIMIT_NOFILE, (most + 2, limits[1]))
        answers = running.ask_all(COUNT)
        resource.prlimit(pid, resource.RLIMIT_NOFILE, limits)
        for given, expected in zip(answers, right, strict=True):
            assert given == expected or is_honest(given), given
        recovers(running, COUNT)
        assert running.ask_all(COUNT) == right


def test_after_a_crash_by_a_truncated_shared_memory_file_the_next_start_is_right(
    tmp_path: Path,
) -> None:
    """The system ends a program whose mapped file is cut: nothing can be done but to start anew."""
    bag_dir = tmp_path / "bags"
    write_bags(bag_dir, COUNT)
    path = store_file(bag_dir)
    with serving(bag_dir, tmp_path / "log") as running:
        recovers(running, COUNT)
        right = running.ask_all(COUNT)
        os.truncate(path.with_name(f"{path.name}-shm"), 0)
    with serving(bag_dir, tmp_path / "log") as running:
        recovers(running, COUNT)
        assert running.ask_all(COUNT) == right
