"""What a scan yields is what the bags say, whatever of them is stored, and since when."""

import sqlite3
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from ros2_memory.columns.units import GoneError
from ros2_memory.columns.zones import PartZones
from ros2_memory.history.context import Call
from ros2_memory.history.scan import open_scan, scan
from ros2_memory.history.view import View
from ros2_memory.queries import find_last_match
from ros2_memory.storage.base import Batch
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import odom, text, write_mcap, write_splits
from tests.support.column_worlds import EVERYTHING, World, check_rows, store_file
from tests.support.memories import memory_of

S = 10**9
T0 = 1_700_000_000 * S


def test_columns_of_a_bag_that_take_too_much_are_not_held_and_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    most = 50_000
    monkeypatch.setattr("ros2_memory.columns.scan._MOST_BYTES", most)
    said = [text(T0 + nth * S, f"{nth:02d}" + "a" * 10_000) for nth in range(20)]
    write_mcap(tmp_path / "rec" / "rec_0.mcap", said)
    memory = memory_of(tmp_path)
    tables = [rows.table for rows in scan(View(memory, Call()), "/chatter", EVERYTHING)]
    assert sum(map(len, tables)) == len(said)
    assert sum(table.memory_bytes for table in tables) < most
    found = find_last_match(memory, Call(), "/chatter", "contains", "07a")
    assert (found.found and found.found.sample.time) == said[7].log_time


def test_a_long_bag_beside_many_short_ones_is_decoded_once_more_at_most(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ros2_memory.history.bag_access.DECODED_BYTES", 0)
    reads = Counter[str]()

    class CountingReader(McapReader):
        def batches(self, path: Path, *given: Any, **options: Any) -> Iterator[Batch]:
            reads[path.parent.name] += 1
            return super().batches(path, *given, **options)

    hour = range(0, 3600, 30)
    write_mcap(tmp_path / "long" / "long_0.mcap", [text(T0 + n * S, f"{n}") for n in hour])
    for n in hour:
        said = [text(T0 + n * S + S // 3, f"short {n}")]
        write_mcap(tmp_path / "short" / f"short_{n}.mcap", said)
    memory = memory_of(tmp_path, reader=CountingReader())
    memory.index.snapshot()
    reads.clear()
    rows = scan(View(memory, Call()), "/chatter", EVERYTHING)
    assert sum(map(len, rows)) == 2 * len(hour)
    assert reads["long"] <= 2


def test_a_file_that_is_replaced_while_a_scan_is_read_hides_no_row(tmp_path: Path) -> None:
    write_mcap(tmp_path / "rec" / "rec_0.mcap", [text(T0, "hello")])
    write_mcap(tmp_path / "rec" / "rec_1.mcap", [odom(T0 + S, 0.0, 0.0)])
    world = World.of(tmp_path)
    first, second = world.memory.index.snapshot().timeline.bags
    world.fill_alone([first])

    def may_say(parts: PartZones) -> bool:
        return "data" in parts.topic.layout.slots

    opened = open_scan(View(world.memory, Call()), "/chatter", EVERYTHING, may_match=may_say)
    store_file(tmp_path).unlink()
    world.store.look_after()
    world.fill_alone([second])  # its topic has the id that the other one had
    with pytest.raises(GoneError):
        [*opened.rows()]
    assert check_rows(world, "/chatter") == check_rows(world, "/odom") == 1


@pytest.mark.parametrize("name", ["parts", "topics", "part_data", "state", "rows_of"])
def test_a_store_that_fails_while_it_is_asked_hides_no_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    write_splits(tmp_path, [odom(T0 + n * 50 * S, n / 3, -n / 7) for n in range(40)], 500)
    World.of(tmp_path).fill()
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
