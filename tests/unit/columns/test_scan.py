"""What a scan yields is what the bags say, whatever of them is stored or known without columns."""

import json
import sqlite3
from collections.abc import Iterator
from contextlib import suppress
from itertools import product
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.columns.fill import StoreLimits
from ros2_memory.columns.stored import Letters, PartZones
from ros2_memory.columns.table import Texts
from ros2_memory.columns.units import GoneError
from ros2_memory.core.text import caseless
from ros2_memory.history.conditions import Sought
from ros2_memory.history.context import Call
from ros2_memory.history.scan import open_scan, scan
from ros2_memory.history.view import View
from ros2_memory.queries import find_last_match
from tests.support.bags import Msg, odom, text, write_mcap, write_splits
from tests.support.column_worlds import EVERYTHING, World, check_rows, store_file
from tests.support.examples import examples
from tests.support.memories import asked, assert_same_counts, remembered

S = 10**9
T0 = 1_700_000_400 * S


def test_columns_of_a_bag_that_take_too_much_are_not_held_and_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    most = 50_000
    monkeypatch.setattr("ros2_memory.columns.scan._MOST_BYTES", most)
    said = [text(T0 + nth * S, f"{nth:02d}" + "a" * 10_000) for nth in range(20)]
    memory = remembered(tmp_path, said)
    tables = [rows.table for rows in scan(View(memory, Call()), "/chatter", EVERYTHING)]
    assert sum(map(len, tables)) == len(said)
    assert sum(table.memory_bytes for table in tables) < most
    found = find_last_match(memory, Call(), Sought("/chatter", "contains", "07a"))
    assert (found.found and found.found.sample.time) == said[7].log_time


@pytest.mark.parametrize("name", ["parts", "topics", "part_data", "state", "stored_bags"])
def test_a_store_that_fails_while_it_is_asked_hides_no_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    write_splits(tmp_path, [odom(T0 + n * 50 * S, n / 3, -n / 7) for n in range(40)], 500)
    World.of(tmp_path).fill()
    world = World.of(tmp_path)
    whole, read = getattr(world.store, name), world.store.read

    def fail(_: sqlite3.Connection) -> object:
        error = sqlite3.OperationalError("database is locked")
        error.sqlite_errorcode = sqlite3.SQLITE_BUSY
        raise error

    def busy_once(*given: object) -> object:
        monkeypatch.undo()
        with monkeypatch.context() as patch:
            patch.setattr(world.store, "read", lambda _, unknown: read(fail, unknown))
            return whole(*given)

    monkeypatch.setattr(world.store, name, busy_once)
    with suppress(GoneError):  # then it says so
        assert check_rows(world, "/odom") == 40
    assert getattr(world.store, name) == whole
    assert check_rows(world, "/odom") == 40


LABELS = ("mug", "big mug", "Tasse", "Straße", "ÉCLAIR", "x7", "éclair_2")


@given(
    st.lists(st.text("aAbé ß7_-\"\\'{[:\n\0", max_size=12), max_size=8),
    st.text("abés7_ -", min_size=1, max_size=4),
)
def test_letters_rule_out_no_text_that_has_them(texts: list[str], needle: str) -> None:
    column, folded = Texts.of(texts), caseless(needle)
    letters = Letters.of(column)
    assert letters is not None
    may = letters.may_have(folded)
    has = np.array([folded in caseless(word) for word in column.values()], np.bool_)
    assert may.size == len(texts)
    assert not (has & ~may).any()
    if folded.isalpha():
        assert (may == has).all()


def write_world(folder: Path, draw: Random) -> None:
    """A robot that drives, stands still, and tells in JSON what it sees; some bags are missing."""
    every = draw.choice([4, 10])
    for number in range(40):
        start = T0 + number * 60 * S
        if draw.random() < 0.05:
            continue
        messages: list[Msg] = []
        for at in range(start, start + 60 * S, every * S):
            x = draw.choice([0.0, 1.25, draw.gauss(0.0, 1.0), float("nan")])
            messages.append(odom(at + draw.randrange(S), x, draw.gauss(0, 1e-5), 0.3))
            seen = [{"label": draw.choice(LABELS), "at": draw.random()}] * draw.randrange(3)
            data = json.dumps({"stamp": at / S, "seen": seen}, ensure_ascii=draw.random() < 0.5)
            messages.append(text(at + draw.randrange(S), data, "/seen"))
        messages.sort(key=lambda message: message.log_time)
        write_mcap(folder / "rec" / f"rec_{number}.mcap", messages)


def questions(draw: Random) -> Iterator[tuple[str, dict[str, Any]]]:
    start = T0 / S + draw.choice([0, 600, 1234.5])
    window = {"start": start, "end": start + draw.choice([1800, 5000])}
    for fields in (["position.x"], ["position.y", "orientation.yaw_deg"]):
        asking = {"topic": "/odom", "fields": fields, **window}
        yield "get_topic_in_range", {**asking, "by": "hour"}
        yield "get_topic_in_range", asking
    sought = "mug", "MUG", "big mug", "tasse", "straße", "éclair", "x7", "see", "none", "7"
    for value, kind in product(sought, ("contains", "contains_word")):
        condition = {"topic": "/seen", "condition_type": kind, "value": value}
        yield "find_matches", {**condition, "by": "hour", **window}


@pytest.mark.parametrize("seed", range(examples(2)))
def test_what_is_known_of_parts_changes_no_answer(seed: int) -> None:
    with TemporaryDirectory() as name:
        folder = Path(name)
        write_world(folder, Random(seed))
        world = World.of(folder, limits=StoreLimits(max_share=[10.0, 0.001][seed % 2]))
        world.fill()
        plain = world.unstored().memory
        started = World.of(folder).memory  # what it knows it has from the store
        for tool, asks in questions(Random(seed)):
            expected = asked(plain, tool, **asks)
            assert expected.get("error") != "invalid_arguments", expected
            assert_same_counts(asked(started, tool, **asks), expected, of_means=0.02)


def test_a_file_that_is_replaced_while_a_scan_is_read_hides_no_row(tmp_path: Path) -> None:
    write_mcap(tmp_path / "rec" / "rec_0.mcap", [text(T0, "hello")])
    write_mcap(tmp_path / "rec" / "rec_1.mcap", [odom(T0 + S, 0.0, 0.0)])
    world = World.of(tmp_path)
    first, second = world.memory.index.snapshot().timeline.bags
    world.fill_alone([first])

    def may_say(parts: PartZones) -> bool:
        return "data" in parts.topic.layout.paths

    opened = open_scan(View(world.memory, Call()), "/chatter", EVERYTHING, may_match=may_say)
    store_file(tmp_path).unlink()
    world.store.look_after()
    world.fill_alone([second])  # its topic has the id that the other one had
    with pytest.raises(GoneError):
        [*opened.rows()]
    assert check_rows(world, "/chatter") == check_rows(world, "/odom") == 1
