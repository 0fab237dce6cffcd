"""Kills, other processes and two servers while columns are stored: the same answers throughout."""

import multiprocessing
import os
import random
import shutil
import signal
import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import closing
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest

from ros2_memory.columns import database
from ros2_memory.columns.writing import Writing
from tests.support.column_worlds import World, check_all, store_file
from tests.support.examples import LONG
from tests.support.memories import asked, assert_same_counts, clause
from tests.unit.columns.test_fill import T0, S, decode_in_groups, write_bag, write_long_bag

KILLS = 100 if LONG else 2
SPANNED = {"get_topic_in_range", "find_matches"}
ROWS = 12 * 21 + 120
# Not forked: SQLite must not have a file open across that.
SPAWNED = multiprocessing.get_context("spawn")


def write_bags(bag_dir: Path, first: int = 0) -> None:
    """Twelve minutes of one recording, and a bag of an hour, which is stored in several goes."""
    for number in range(first, first + 12):
        write_bag(bag_dir, number)
    write_long_bag(bag_dir / "long")


class StatementCounter:
    """Counts the statements of all connections; kills its process at one of them."""

    def __init__(self, kill_at: int = 0) -> None:
        self.count = 0
        self._kill_at = kill_at
        self._connect = database._connect

    def connect(self, target: str) -> sqlite3.Connection:
        connection = self._connect(target)
        connection.set_trace_callback(self._trace)
        return connection

    def _trace(self, _: str) -> None:
        self.count += 1
        if self.count == self._kill_at:
            os.kill(os.getpid(), signal.SIGKILL)


def fill_up(bag_dir: Path, kill_at: int = 0) -> int:
    """Stores everything, of long bags group by group; returns how many statements that took."""
    counter = StatementCounter(kill_at)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(database, "_connect", counter.connect)
        decode_in_groups(patch)
        World.of(bag_dir).fill()
    return counter.count


def started(bag_dir: Path, kill_at: int = 0) -> BaseProcess:
    process = SPAWNED.Process(target=fill_up, args=(bag_dir, kill_at), daemon=True)
    process.start()
    return process


ASKED: tuple[tuple[str, Mapping[str, object]], ...] = (
    ("list_recorded_topics", {}),
    ("data_time_range", {}),
    ("get_topic_in_range", {"topic": "/odom", "fields": ["position.x"], "by": "hour"}),
    ("get_topic_in_range", {"topic": "/odom", "fields": ["position.x"], "max_samples": 5}),
    (
        "find_matches",
        clause("/odom", "above", 8, field="position.x", by="day"),
    ),
    *(("find_last_match", clause("/chatter", "contains", word)) for word in ("word 3", "never")),
)


def answers(world: World) -> list[object]:
    """What tools answer of everything."""
    spans = {"start": T0 / S - 3600, "end": T0 / S + 7200}
    return [
        asked(world.memory, name, **given, **(spans if name in SPANNED else {}))
        for name, given in ASKED
    ]


def assert_same_answers(world: World, right: Sequence[object]) -> None:
    for reply, expected in zip(answers(world), right, strict=True):
        assert_same_counts(reply, expected)


def assert_whole(bag_dir: Path) -> None:
    """Each bag is stored whole or not at all, and what is stored of it once."""
    with closing(sqlite3.connect(store_file(bag_dir))) as base:
        assert base.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        rows = base.execute(
            "SELECT bag.path, bag.messages, bag.size,"
            " (SELECT count(DISTINCT level) FROM part, json_each(part.bags) WHERE value = bag.id)"
            " FROM bag"
        ).fetchall()
    for path, _, size, kinds in rows:
        assert size < 0 or kinds == 1, path


@pytest.mark.parametrize("first", [0, 70])
def test_a_kill_at_any_statement_leaves_bags_whole_or_not_at_all_and_the_same_answers(
    tmp_path: Path, first: int
) -> None:
    whole = tmp_path / "whole"
    write_bags(whole, first)
    statements = fill_up(whole)
    assert check_all(World.of(whole)) == ROWS
    right = answers(World.of(whole).unstored())
    draw = random.Random()
    for _ in range(KILLS):
        kill_at = draw.randint(1, statements)
        bag_dir = tmp_path / f"killed at {kill_at} of {statements}"
        write_bags(bag_dir, first)
        process = started(bag_dir, kill_at)
        process.join()
        assert process.exitcode == -signal.SIGKILL
        if store_file(bag_dir).exists():
            killed = World.of(bag_dir)
            assert check_all(killed) == ROWS
            assert_same_answers(killed, right)
            assert_whole(bag_dir)
        fill_up(bag_dir)
        world = World.of(bag_dir)
        assert len(world.stored()) == 13
        assert_whole(bag_dir)
        assert check_all(world) == ROWS
        assert_same_answers(world, right)
        shutil.rmtree(bag_dir)


def test_another_process_has_the_same_answers_while_one_fills(tmp_path: Path) -> None:
    write_bags(tmp_path)
    asking = World.of(tmp_path)
    assert check_all(asking) == ROWS
    process = started(tmp_path)
    while process.is_alive():
        assert check_all(asking) == ROWS
    process.join()
    assert process.exitcode == 0
    assert check_all(asking) == ROWS
    assert len(asking.stored()) == 13


def test_the_end_of_a_long_bag_is_noticed_without_another_change(tmp_path: Path) -> None:
    """Its last rows are there before it is whole, and what is known then must not stay."""
    write_long_bag(tmp_path)
    asking, filling = World.of(tmp_path), World.of(tmp_path)
    assert asking.stored() == set()
    found: list[set[str]] = []

    def end(self: Writing, connection: sqlite3.Connection) -> bool:
        found.append(asking.stored())
        return whole(self, connection)

    with pytest.MonkeyPatch.context() as patch:
        whole = Writing.end
        patch.setattr(Writing, "end", end)
        decode_in_groups(patch)
        assert filling.fill_alone() == 1
    assert found == [set()]
    assert asking.stored() == filling.stored() != set()


def test_two_servers_that_fill_at_once_store_each_bag_once(tmp_path: Path) -> None:
    write_bags(tmp_path)
    processes = [started(tmp_path) for _ in range(2)]
    for process in processes:
        process.join()
        assert process.exitcode == 0
    world = World.of(tmp_path)
    world.fill()
    assert len(world.stored()) == 13
    assert_whole(tmp_path)
    with closing(sqlite3.connect(store_file(tmp_path))) as base:
        assert base.execute("SELECT sum(messages) FROM part").fetchone() == (ROWS,)
    assert check_all(world) == ROWS
