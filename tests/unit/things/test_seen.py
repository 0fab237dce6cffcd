"""What detectors saw, ten minutes after the other: however it is cut, and stored once."""

from __future__ import annotations

import math
import sqlite3
from collections import deque
from contextlib import closing
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from ros2_memory.columns import scan
from ros2_memory.columns.scanner import Scanner
from ros2_memory.columns.sights import JoinedSights, joined
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.view import View
from ros2_memory.things import placing, seen
from ros2_memory.things.find import find_things
from ros2_memory.things.seen import SIGHTS_NS, Watching
from tests.support.bags import McapLayout, text, write_mcap, write_splits
from tests.support.column_worlds import EVERYTHING, World, store_file
from tests.support.sights import rows_of_tables
from tests.unit.things.test_find import AWAY, BEGIN, HERE, looked

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.results import Thing
    from tests.support.bags import Msg

APART_S = SIGHTS_NS // 10**9


def day() -> list[Msg]:
    """A robot that looks at a mug, turns round, and looks at a cup in other ten minutes."""
    later = looked(APART_S, APART_S + 40, HERE, ("cup", 2.0, -1.0), ("mug", 3.0, 0.5))
    return [*looked(0, 30, HERE, ("mug", 3.0, 0.5)), *looked(30, 60, AWAY), *later]


def sights_in(memory: Memory) -> JoinedSights:
    stretches = [one for some in Watching(View(memory, Call())).newest_first() for one in some]
    parts = [part.packed for stretch in stretches for part in stretch.sights]
    sections = [0 for stretch in stretches for _ in stretch.sights for _ in stretch.sessions]
    return joined(parts, sections, sections)


def things_in(memory: Memory) -> tuple[Thing, ...]:
    return find_things(memory, Call()).things


def made_in(bag_dir: Path) -> World:
    """A store of all bags, with the sights that follow from its parts."""
    world = World.of(bag_dir)
    world.fill()
    make(world.memory)
    return world


def make(memory: Memory, *, is_joined: bool = False) -> None:
    assert memory.scanner is not None
    deque(Watching(View(memory, Call())).made(EVERYTHING, is_joined=is_joined), maxlen=0)
    memory.scanner.write_fragments()


def another(world: World) -> Memory:
    """The memory of another process over the same store."""
    return replace(world.memory, scanner=Scanner(world.store, world.bag_dir))


def stored(bag_dir: Path) -> int:
    with closing(sqlite3.connect(store_file(bag_dir))) as base:
        [[count]] = base.execute("SELECT count(*) FROM fragment WHERE kind LIKE 'sights%'")
    return int(count)


def test_sights_are_the_same_however_a_history_is_cut(tmp_path: Path) -> None:
    found = []
    for split_s in (3.0, 10.0, 47.0, 5000.0):
        write_splits(tmp_path / f"{split_s}", day(), split_s)
        found.append(sights_in(World.of(tmp_path / f"{split_s}").memory))
    for other in found[1:]:
        assert other.labels == found[0].labels == ("cup", "mug")
        assert rows_of_tables(other) == rows_of_tables(found[0])


def test_another_process_finds_stored_sights_and_reads_no_messages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_splits(tmp_path, day())
    plain = things_in(World.of(tmp_path).memory)
    world = made_in(tmp_path)
    assert {thing.label for thing in plain} == {"cup", "mug"}
    monkeypatch.delattr(placing, "sights_of")  # there is nothing to be made
    assert things_in(another(world)) == plain


def test_a_latched_text_that_each_recording_received_hinders_no_storing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scan, "STRETCH_NS", 14_400 * 10**9)
    layout = McapLayout(latched=frozenset({"/tf_static", "/robot_description"}))
    for nth in range(3):
        messages = looked(nth * APART_S, nth * APART_S + 60, HERE, ("mug", 3.0, 0.5))
        said = text(messages[0].log_time, "<robot/>", "/robot_description")
        said = replace(said, publish_time=BEGIN * 10**9)
        write_mcap(tmp_path / f"rec_{nth}" / f"rec_{nth}_0.mcap", [said, *messages], layout)
    plain = things_in(World.of(tmp_path).memory)
    world = made_in(tmp_path)
    assert [thing.label for thing in plain] == ["mug"]
    monkeypatch.delattr(placing, "sights_of")
    assert things_in(another(world)) == plain


def test_joined_sights_say_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(seen, "STRETCH_NS", 3 * SIGHTS_NS)
    for nth in range(9):
        begin = nth * APART_S - 20  # each recording begins before its ten minutes
        things = ("mug", 3.0, 0.5), (f"cup {nth}", 2.0, -1.0)
        write_splits(tmp_path / f"rec_{nth}", looked(begin, begin + 60, HERE, *things), 20.0)
    plain = World.of(tmp_path).memory
    sights, things_there, starts = sights_in(plain), things_in(plain), starts_in(plain)
    world = made_in(tmp_path)
    make(world.memory, is_joined=True)
    # Of more spots than are wanted no more are yielded than those of ten minutes.
    assert starts_in(another(world), most=1) == starts
    monkeypatch.delattr(placing, "sights_of")
    for memory in (another(world), another(with_joined_alone(world))):
        assert rows_of_tables(sights_in(memory)) == rows_of_tables(sights)
        assert things_in(memory) == things_there
        assert 2 < len(starts_in(memory)) < len(starts)


def starts_in(memory: Memory, most: float = math.inf) -> list[int]:
    watching = Watching(View(memory, Call()))
    return [part[0].starts[0] for part in watching.newest_first(most=most)]


def with_joined_alone(world: World) -> World:
    """The same store without the sights of the single ten minutes that are joined."""
    with closing(sqlite3.connect(store_file(world.bag_dir))) as base, base:
        base.execute(
            "DELETE FROM fragment WHERE kind LIKE 'sights %' AND start_ns <"
            " (SELECT max(start_ns) FROM fragment WHERE kind LIKE 'sights-joined %')"
        )
    return world


def test_sights_go_with_the_parts_that_they_follow_from(tmp_path: Path) -> None:
    write_splits(tmp_path, day())
    world = made_in(tmp_path)
    assert stored(tmp_path) == 2
    first = [path for path in world.store.paths() if path.endswith(("_0.mcap", "_1.mcap"))]
    world.store.delete(first)
    assert stored(tmp_path) == 2  # their part has other bags
    world.store.delete([path for path in world.store.paths() if "_60" not in path])
    assert stored(tmp_path) == 1


def test_sights_are_made_again_where_a_late_bag_comes_beside_their_parts(tmp_path: Path) -> None:
    write_splits(tmp_path, looked(0, 20, HERE, ("mug", 3.0, 0.5)))
    world = made_in(tmp_path)
    assert [thing.label for thing in things_in(world.memory)] == ["mug"]
    late = looked(30, 50, HERE, ("vase", 2.0, -1.5))
    write_splits(tmp_path, [message for message in late if message.log_time >= BEGIN * 10**9])
    assert {thing.label for thing in things_in(another(world))} == {"mug", "vase"}
    world.fill()
    make(world.memory)
    assert {thing.label for thing in things_in(another(world))} == {"mug", "vase"}


@pytest.mark.parametrize("apart_s", [0, 3 * 10**8])
def test_a_bag_of_odd_times_has_the_sights_of_its_messages_alone(
    tmp_path: Path, apart_s: int
) -> None:
    odd = [
        *looked(0, 10, HERE, ("mug", 3.0, 0.5)),
        *looked(apart_s + 20, apart_s + 30, HERE, ("cup", 2.0, 0.0)),
    ]
    write_splits(tmp_path, odd, split_s=10.0**10)
    world = World.of(tmp_path)
    assert sights_in(world.memory).labels == ("cup", "mug")
