"""What a scan yields is what the bags say, whatever of them is stored, and since when."""

from __future__ import annotations

import os
import random
import sqlite3
import tempfile
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.columns.units import GoneError
from ros2_memory.core.model import TimeWindow
from ros2_memory.history.context import Call
from ros2_memory.history.scan import scan
from ros2_memory.history.view import View
from tests.support.bags import odom, text, write_mcap
from tests.support.column_worlds import EVERYTHING, World, check_all, check_rows, times
from tests.support.examples import examples
from tests.support.random_histories import write_history

if TYPE_CHECKING:
    from random import Random

S = 10**9
T0 = 1_700_000_000 * S


def change_something(bag_dir: Path, aside: Path, draw: Random) -> None:
    """A bag comes late, changes, is renamed, or goes."""
    _change_something(bag_dir, aside, draw)
    for folder in [bag_dir, *bag_dir.iterdir()]:
        # Two changes within one tick of the clock would look like one.
        os.utime(folder, ns=(T0, folder.stat().st_mtime_ns - draw.randrange(1, 9) * S))


def _change_something(bag_dir: Path, aside: Path, draw: Random) -> None:
    bags = sorted(bag_dir.glob("rec_*/*.mcap"))
    late = sorted(aside.glob("*/*.mcap"))
    kind = draw.choice(["late", "late", "changed", "renamed", "deleted", "touched"])
    if kind == "late" and late:
        path = draw.choice(late)
        (bag_dir / path.parent.name).mkdir(exist_ok=True)
        path.rename(bag_dir / path.parent.name / path.name)
    elif kind == "changed" and bags:
        path = draw.choice(bags)
        start = draw.choice([T0, 3 * S])
        messages = [odom(start + n * S, n / 7, 0.5) for n in range(draw.randint(1, 9))]
        write_mcap(path, messages)
        os.utime(path, ns=(T0, T0 + draw.randrange(S)))
    elif kind == "renamed" and bags:
        path = draw.choice(bags)
        path.rename(path.with_name(f"{path.stem}9.mcap"))
    elif kind == "deleted" and bags:
        draw.choice(bags).unlink()
    elif kind == "touched" and bags:
        os.utime(draw.choice(bags), ns=(T0, T0 + draw.randrange(S)))


def some_late(bag_dir: Path, aside: Path, draw: Random) -> None:
    for path in sorted(bag_dir.glob("rec_*/*.mcap")):
        if draw.random() < 0.3:
            (aside / path.parent.name).mkdir(parents=True, exist_ok=True)
            path.rename(aside / path.parent.name / path.name)


def store_some(world: World, draw: Random) -> None:
    """Stores some of what waits in any order, and makes parts at any time."""
    timeline = world.memory.index.snapshot().timeline
    waiting = world.filling.waiting(timeline)
    draw.shuffle(waiting)
    for bag in waiting[: draw.randint(0, len(waiting))]:
        world.filling.fill(bag, timeline)
        if draw.random() < 0.3:
            world.filling.merge(timeline)
    if draw.random() < 0.3:
        world.prune()


@settings(max_examples=examples(60))
@given(seed=st.integers(0, 2**32))
def test_any_history_that_is_stored_in_any_order_has_the_same_rows(seed: int) -> None:
    draw = random.Random(seed)
    with tempfile.TemporaryDirectory() as folder:
        bag_dir, aside = Path(folder, "bags"), Path(folder, "aside")
        bag_dir.mkdir()
        write_history(bag_dir, draw)
        some_late(bag_dir, aside, draw)
        world = World.of(bag_dir)
        check_all(world.unstored())
        for _ in range(draw.randint(1, 5)):
            store_some(world, draw)
            check_all(world)
            change_something(bag_dir, aside, draw)
        world.fill()
        check_all(world)
        again = World.of(bag_dir)
        check_all(again)
        begin = draw.choice([0, 1_700_000_000 * S]) + draw.randrange(60) * S
        window = TimeWindow(begin, begin + draw.randrange(1, 40) * S)
        check_all(again, window)
        for topic in again.topics():
            check_rows(again, topic, window, newest_first=True)


def cut(bag_dir: Path, cuts: list[int], count: int = 40) -> None:
    """One recording of one robot, cut into splits at these messages."""
    messages = [
        message
        for n in range(count)
        for message in (odom(T0 + n * 50 * S, n / 3, -n / 7), text(T0 + n * 50 * S + 1, f"w{n}"))
    ]
    edges = [0, *sorted({*cuts}), len(messages)]
    for number, (begin, end) in enumerate(pairwise(edges)):
        if begin < end:
            path = bag_dir / "rec_0" / f"rec_0_{number}.mcap"
            os.utime(write_mcap(path, messages[begin:end]), ns=(T0, T0))


@settings(max_examples=examples(40))
@given(cuts=st.lists(st.integers(1, 79), max_size=12), seed=st.integers(0, 2**32))
def test_one_history_has_the_same_rows_wherever_it_is_cut(cuts: list[int], seed: int) -> None:
    draw = random.Random(seed)
    with tempfile.TemporaryDirectory() as folder:
        bag_dir = Path(folder)
        cut(bag_dir, cuts)
        world = World.of(bag_dir)
        store_some(world, draw)
        store_some(world, draw)
        expected = [T0 + n * 50 * S for n in range(40)]
        assert times(world, "/odom") == expected
        assert check_all(world) == 80
        world.fill()
        assert len(world.stored()) == len(world.memory.index.snapshot().bags)
        assert times(world, "/odom") == expected
        assert check_all(world) == 80


@pytest.mark.parametrize("newest_first", [False, True])
def test_tables_come_in_the_order_of_time(tmp_path: Path, newest_first: bool) -> None:
    cut(tmp_path, [10, 30, 31, 60])
    world = World.of(tmp_path)
    world.fill()
    view = View(world.memory, Call())
    found = scan(view, "/odom", EVERYTHING, newest_first=newest_first)
    firsts = [int(rows.times[0]) for rows in found]
    assert len(firsts) > 1
    assert firsts == sorted(firsts, reverse=newest_first)
    assert check_rows(world, "/odom", newest_first=newest_first) == 40


def test_parts_that_another_process_makes_meanwhile_hide_no_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cut(tmp_path, [10, 30, 31, 60])
    world, other = World.of(tmp_path), World.of(tmp_path)
    world.fill(merge=False)
    assert check_rows(world, "/odom") == 40
    splits = world.store.splits

    def after_a_merge() -> frozenset[int]:
        other.filling.merge(other.memory.index.snapshot().timeline)
        return splits()

    monkeypatch.setattr(world.store, "splits", after_a_merge)
    assert check_rows(world, "/odom") == 40
    assert splits() == frozenset()


@pytest.mark.parametrize("name", ["parts", "splits", "topics", "split_data", "state", "bags"])
def test_a_store_that_fails_while_it_is_asked_hides_no_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    cut(tmp_path, [10, 30, 31, 60])
    World.of(tmp_path).fill(merge=name != "split_data")
    world = World.of(tmp_path)
    whole = getattr(world.store, name)
    read = world.store.read
    failing = [True]

    def busy(*given: object) -> object:
        def fail(_: sqlite3.Connection) -> object:
            error = sqlite3.OperationalError("database is locked")
            error.sqlite_errorcode = sqlite3.SQLITE_BUSY
            raise error

        if failing:
            failing.clear()
            with monkeypatch.context() as patch:
                patch.setattr(world.store, "read", lambda _, unknown: read(fail, unknown))
                return whole(*given)
        return whole(*given)

    monkeypatch.setattr(world.store, name, busy)
    with suppress(GoneError):  # then it says so
        assert check_rows(world, "/odom") == 40
    assert not failing
    assert check_rows(world, "/odom") == 40
