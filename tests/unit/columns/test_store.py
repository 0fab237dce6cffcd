"""The file of the store may be anything at any time; what its rows mean is pinned, and shown."""

import hashlib
import re
import sqlite3
import struct
from contextlib import closing
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from random import Random
from typing import Any

import pytest

from ros2_memory.columns import forget as forgetting
from ros2_memory.columns.database import TABLES, Database
from ros2_memory.columns.fill import StoreLimits
from ros2_memory.columns.forget import forget
from ros2_memory.columns.pack import FORMAT, decompress
from ros2_memory.columns.scanner import Scanner
from ros2_memory.columns.store import ColumnStore
from ros2_memory.columns.units import GoneError
from ros2_memory.core.errors import BagError
from tests.support.bags import (
    battery,
    boolean,
    command,
    detections,
    diagnostics,
    goals,
    log_entry,
    odom,
    set_mtime,
    text,
    tf,
    tf_of,
    transform,
    write_mcap,
)
from tests.support.column_worlds import World, check_all, store_file
from tests.support.fakes import files_limited_to
from tests.support.memories import ROOT

S = 10**9
T0 = 1_700_000_400 * S
ZSTD = b"\x28\xb5\x2f\xfd"


def write_bags(bag_dir: Path) -> None:
    for number in range(4):
        start = T0 + number * 10 * S
        messages = [odom(start + n * S // 2, n / 7, number / 3) for n in range(20)]
        messages += [detections(start + S, ["cup", f"thing {number}"]), battery(start + 2 * S, 0.7)]
        messages += [text(start + 3 * S, ""), text(start + 4 * S, "Straße")]
        path = write_mcap(bag_dir / "rec" / f"rec_{number}.mcap", messages)
        set_mtime(path, T0)


@pytest.fixture
def world(tmp_path: Path) -> World:
    """Four bags, all of them stored."""
    write_bags(tmp_path)
    world = World.of(tmp_path)
    world.fill()
    return world


def write_all_that_is_derived(bag_dir: Path) -> None:
    """A minute of each thing that the store derives rows from, and half of it in a copy."""
    messages = []
    for n in range(120):
        at = T0 + n * S // 2
        x = min(max(n - 20, 0), 60) / 20
        messages += [odom(at, x, 0.1), tf_of(at, "map", "odom", (1.0, 0.0, 0.0))]
        messages += [boolean(at + 1, data=n % 40 < 9), battery(at + 2, 0.3 - n / 500)]
        messages += [command(at + 3, 0.1 if 20 < n < 80 else 0.0)]
        messages += [detections(at + 4, ["cup"] if n % 30 < 9 else [], at=(1.0, 2.0, 0.5))]
        if n % 10 == 0:
            messages += [text(at + 5, "docked" if n < 20 else "driving")]
            level = n // 10 % 6 * 10
            messages += [log_entry(at + 6, level, "nav", f"entry of level {level}")]
            messages += [diagnostics(at + 7, motors=(n // 10 % 4, "hot"))]
            messages += [goals(at + 8, {1: 2 if n < 50 else 4, 2: 6 if n > 80 else 2})]
    turned = transform(T0, "base_link", "camera", (0.1, 0.0, 0.4), yaw=0.3)
    messages.append(tf(T0, turned, topic="/tf_static"))
    half = len(messages) // 2
    for folder, some in (("rec", messages), ("beside", messages[half:])):
        path = write_mcap(bag_dir / folder / f"{folder}_0.mcap", some)
        set_mtime(path, T0)


def stored_rows(file: Path) -> str:
    """A hash of all that is in a store, but for how it is compressed and what files looked like.

    And but for the order in which fragments were made.
    """
    digest = hashlib.sha256()
    with closing(sqlite3.connect(file)) as base:
        of_bags = "id, path, first_ns, last_ns, messages, hashed, definitions, summary, counts"
        some = {"bag": of_bags, "fragment": "kind || parts, start_ns, data"}
        tables = "bag", "summary", "topic", "definition", "part", "part_column", "zone", "fragment"
        for table in tables:
            columns = some.get(table, "*")
            for row in base.execute(f"SELECT {columns} FROM {table} ORDER BY 1, 2"):  # noqa: S608
                values = [
                    decompress(value)
                    if isinstance(value, bytes) and value.startswith(ZSTD)
                    else value
                    for value in row
                ]
                digest.update(repr((table, values)).encode())
    return digest.hexdigest()[:16]


def test_rows_of_this_format_do_not_change_their_meaning(tmp_path: Path) -> None:
    write_all_that_is_derived(tmp_path)
    world = World.of(tmp_path)
    world.fill_alone()
    alone = stored_rows(store_file(tmp_path))
    world.fill()
    hashes = alone, stored_rows(store_file(tmp_path))
    assert (FORMAT, *hashes) == (46, "d08746b62ce85680", "eb4b99c79a7c6e6a"), (
        "the store has other rows of the same bags than before: raise FORMAT in columns/pack.py, "
        "so that stores are filled anew, and pin the new number and hashes here"
    )


@pytest.mark.parametrize("statement", ["PRAGMA user_version = 99", "DROP TABLE part_column"])
def test_a_file_of_another_version_or_without_a_table_is_set_aside_and_made_anew(
    world: World, tmp_path: Path, statement: str
) -> None:
    world.store.close()
    with closing(sqlite3.connect(store_file(tmp_path))) as base:
        base.execute(statement)
    again = World.of(tmp_path)
    assert check_all(again) == 4 * 24
    assert again.fill() == 4
    assert check_all(again) == 4 * 24
    assert store_file(tmp_path).with_name("columns.sqlite.aside").exists()


@pytest.mark.parametrize("replaced", ["columns.sqlite-wal", "columns.sqlite"])
def test_what_is_read_while_the_files_are_replaced_does_not_count(
    world: World, tmp_path: Path, replaced: str
) -> None:
    failures = world.store.failures

    def read(connection: sqlite3.Connection) -> int:
        path = store_file(tmp_path).with_name(replaced)
        path.unlink()
        if path.suffix != ".sqlite":  # as a program does that takes the file for a new one
            path.touch()
        return int(connection.execute("SELECT count(*) FROM part").fetchone()[0])

    assert world.store.read(read, -1) == -1
    assert world.store.failures > failures
    assert world.stored() == set()
    assert check_all(world) == 4 * 24


@pytest.mark.parametrize(
    "damage",
    [
        "part_column SET data = x'00' WHERE data NOT NULL",
        "part_column SET data = substr(data, 1, 12) WHERE data NOT NULL",
        "zone SET codec = replace(codec, 'int64', 'int46')",
        "zone SET least = 9e999 WHERE codec = 'int64 constant'",
    ],
)
def test_a_column_that_turns_out_damaged_fails_one_question_and_no_other(
    tmp_path: Path, damage: str
) -> None:
    write_bags(tmp_path)
    World.of(tmp_path).fill()
    with closing(sqlite3.connect(store_file(tmp_path))) as base:
        base.execute(f"UPDATE {damage}")
        base.commit()
    world = World.of(tmp_path)
    with pytest.raises(GoneError):
        check_all(world)
    assert check_all(world) == 4 * 24
    assert world.fill() == 4
    assert check_all(world) == 4 * 24


def test_two_questions_that_find_one_damage_set_one_file_aside(world: World) -> None:
    part = world.store.parts("/odom")[0].number
    world.store.give_up(part, ValueError("damaged"))
    assert world.fill() == 4
    world.store.give_up(part, ValueError("damaged"))
    assert len(world.stored()) == 4


def test_where_the_folder_cannot_be_written_the_next_one_is_used_or_memory(tmp_path: Path) -> None:
    bag_dir = tmp_path / "bags"
    write_bags(bag_dir)
    (tmp_path / "file").write_text("no folder")
    refused = tmp_path / "file" / "columns.sqlite"
    cache = tmp_path / "cache" / "columns.sqlite"
    world = World.of(bag_dir)
    scanner = Scanner(ColumnStore([refused, cache], world.memory.reader.definition), world.bag_dir)
    assert scanner.store is not None
    assert scanner.store.path == cache
    in_memory = World.of(bag_dir, files=[refused])
    assert in_memory.store.path is None
    assert in_memory.fill() == 4
    assert check_all(in_memory) == 4 * 24
    assert len(in_memory.stored()) == 4


def test_a_part_that_is_deleted_is_not_one_that_lacks_a_column(
    world: World, tmp_path: Path
) -> None:
    scanner, [head, *_] = Scanner(world.store, tmp_path), world.store.parts("/odom")
    assert scanner.packed(head, ["#log_time"], "no such column") is None
    assert world.store.delete(world.store.paths())
    with pytest.raises(GoneError):
        scanner.packed(head, ["#log_time"], "#log_time")


def write_secret(bag_dir: Path, number: int) -> Path:
    """A minute, in which thrice something is said that only this minute has, and a topic is new."""
    start = T0 + number * 60 * S
    draw = Random(number)
    messages = [odom(start + n * S, draw.uniform(-9, 9), draw.random()) for n in range(60)]
    for n in range(60):
        said = f"secret{number:04d}x{n}" if n % 20 == 0 else "hum"
        messages.append(text(start + n * S + 5, said))
    alone = battery(start + S, 0.5) if number == 3 else text(start + S, "hum")
    messages.append(replace(alone, topic=f"/only/{number:04d}"))
    return write_mcap(bag_dir / "rec" / f"rec_{number}.mcap", messages)


SECRETS = (
    *(b"secret0003", b"0003x0", b"0003x20", b"0003x40", b"/only/0003", b"rec/rec_3.mcap"),
    (T0 + 3 * 60 * S).to_bytes(8, "big"),
)
"""What one bag alone says: texts of its messages, a topic, its name, and when it begins."""


def values(file: Path) -> dict[str, list[bytes]]:
    """All that the rows of each table hold, as SQLite writes it."""
    found: dict[str, list[bytes]] = {}
    with closing(sqlite3.connect(file)) as base:
        for (table,) in base.execute("SELECT name FROM sqlite_schema WHERE type = 'table'"):
            rows = base.execute(f"SELECT * FROM {table}")  # noqa: S608 - of the file itself
            found[table] = [as_written(value) for row in rows for value in row]
    return found


def as_written(value: object) -> bytes:
    """A value in SQLite's file: of numbers those that take 8 bytes, which tell something."""
    if isinstance(value, str):
        return value.encode()
    if isinstance(value, float):
        return b"" if value.is_integer() else struct.pack(">d", value)
    if isinstance(value, int):
        return value.to_bytes(8, "big", signed=True) if abs(value) >= 1 << 47 else b""
    return value if isinstance(value, bytes) else b""


def slices_of(values: list[bytes]) -> set[bytes]:
    """Slices of 6 to 24 bytes: of some values only a later part may be left."""
    slices = (value[at : at + 24] for value in values for at in range(0, len(value), 24))
    return {some for some in slices if len(some) >= 6}


def bytes_of(folder: Path) -> bytes:
    """All files of a folder: those of SQLite, and whatever else lies there."""
    return b"".join(path.read_bytes() for path in sorted(folder.iterdir()) if path.is_file())


def all_unpacked(file: Path) -> bytes:
    """What all columns hold."""
    with closing(sqlite3.connect(file)) as base:
        columns = base.execute("SELECT data FROM part_column WHERE data IS NOT NULL").fetchall()
    return b"".join(decompress(blob) for (blob,) in columns)


@pytest.mark.parametrize("merged", [True, False])
def test_no_byte_of_a_forgotten_bag_is_left(tmp_path: Path, merged: bool) -> None:
    for number in range(14):
        write_secret(tmp_path, number)
    world = World.of(tmp_path)
    world.fill() if merged else world.fill_alone()
    file = store_file(tmp_path)
    before = {table: slices_of(some) for table, some in values(file).items()}
    there = bytes_of(file.parent) + all_unpacked(file)
    assert [secret for secret in SECRETS if secret not in there] == []
    # Copies that were set aside go, too.
    for name in ("columns.sqlite.aside", ".columns.sqlite.77.tmp", ".columns.sqlite.77.tmp-wal"):
        file.with_name(name).write_bytes(SECRETS[0])
    # The store stays open in a server, so that its log lies beside it.
    forget(file, tmp_path, ["rec/rec_3.mcap"])
    left = bytes_of(file.parent)
    # What bags have in common lies in the rows of the others, too, at other places.
    kept = b"\n".join(value for some in values(file).values() for value in some)
    gone = {
        table: slices
        for table, some in before.items()
        if (slices := {part for part in some if part not in kept})
    }
    of_bags = {"bag", "summary", "topic", "definition", "part", "part_column", "zone"}
    assert gone.keys() == of_bags | ({"fragment"} if merged else set())
    assert [part for some in gone.values() for part in some if part in left] == []
    assert [secret for secret in SECRETS if secret in left + all_unpacked(file)] == []
    assert "rec/rec_3.mcap" not in world.stored()
    assert "rec/rec_12.mcap" in world.stored()
    assert check_all(world) == 14 * 121
    world.fill()
    assert len(world.stored()) == 14


def test_others_may_read_between_two_steps_in_which_pages_go_back_to_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    database = Database([tmp_path / "columns.sqlite"])
    unused: list[int] = []

    def fill_and_empty(connection: sqlite3.Connection) -> None:
        connection.execute("INSERT INTO part_column VALUES (1, 'x', NULL, zeroblob(4000000))")
        connection.execute("DELETE FROM part_column")

    def read(_: float = 0) -> None:
        pragma = "PRAGMA freelist_count"
        unused.append(database.read(lambda opened: opened.execute(pragma).fetchone()[0], -1))

    assert database.write(fill_and_empty)
    read()
    monkeypatch.setattr("ros2_memory.columns.database.time.sleep", read)
    database.release_pages()
    assert 0 < unused[-1] <= 256
    assert [before - after for before, after in pairwise(unused)] == [256] * 3
    database.close()


def test_what_another_program_reads_all_the_time_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_secret(tmp_path, 0)
    world = World.of(tmp_path)
    world.fill()
    monkeypatch.setattr(forgetting, "PATIENCE_S", 0.2)
    file = store_file(tmp_path)
    with closing(sqlite3.connect(file, isolation_level=None)) as reader:
        reader.execute("BEGIN")
        reader.execute("SELECT count(*) FROM bag").fetchone()
        with pytest.raises(BagError, match=r"may still contain deleted data .*delete the file"):
            forget(file, tmp_path, ["rec/rec_0.mcap"])
    assert world.stored() == set()
    forget(file, tmp_path, [])
    assert b"secret0000" not in bytes_of(file.parent)


def test_a_store_of_another_version_is_named(tmp_path: Path) -> None:
    file = store_file(tmp_path)
    file.parent.mkdir()
    with closing(sqlite3.connect(file)) as base:
        base.execute("PRAGMA user_version = 99")
    with pytest.raises(BagError, match="another version"):
        forget(file, tmp_path, [])
    forget(file.with_name("none.sqlite"), tmp_path, [])
    assert not file.with_name("none.sqlite").exists()


def test_a_full_disk_is_named_and_nothing_is_lost(tmp_path: Path) -> None:
    for number in range(8):
        write_secret(tmp_path, number)
    world = World.of(tmp_path)
    world.fill()
    world.store.close()
    with files_limited_to(100_000), pytest.raises(BagError, match="disk I/O error"):
        forget(store_file(tmp_path), tmp_path, ["rec/rec_3.mcap"])
    assert len(World.of(tmp_path).stored()) == 8


def test_a_topic_that_is_stored_later_is_taken_for_none_that_was_forgotten(tmp_path: Path) -> None:
    write_mcap(tmp_path / "rec" / "rec_0.mcap", [text(T0, "hum", "/said")])
    world = World.of(tmp_path)
    world.fill()
    assert check_all(world) == 1  # by now the server knows the topic by its number
    forget(store_file(tmp_path), tmp_path, ["rec/rec_0.mcap"])
    (tmp_path / "rec" / "rec_0.mcap").unlink()
    write_mcap(tmp_path / "rec" / "rec_1.mcap", [battery(T0 + n, n / 9) for n in range(9)])
    world.fill()
    assert check_all(world) == 9
    assert world.stored() == {"rec/rec_1.mcap"}


@cache
def section() -> str:
    text = (ROOT / "docs/reference/files.md").read_text()
    return text.partition("## The store of columns")[2]


def test_columns_that_are_dropped_and_bytes_of_each_topic(tmp_path: Path) -> None:
    draw = Random(3)
    for number in range(3):
        start = T0 + number * 3000 * S
        messages = [battery(start + n * S, 0.9 - number / 10 - n / 1000) for n in range(5)]
        messages += [
            odom(start + n * S // 100, draw.uniform(-9, 9), draw.uniform(-9, 9)) for n in range(300)
        ]
        path = write_mcap(tmp_path / "rec" / f"rec_{number}.mcap", messages)
        set_mtime(path, T0)
    World.of(tmp_path, limits=StoreLimits(max_share=0.0)).fill()

    def answer(question: str) -> list[Any]:
        match = re.search(re.escape(question) + r"\n\n```sql\n(.+?);\n```", section(), re.DOTALL)
        assert match is not None
        with closing(sqlite3.connect(store_file(tmp_path))) as base:
            return base.execute(match[1]).fetchall()

    dropped = answer("Of which topics are columns dropped, and since when?")
    assert dropped == [("/odom", "2023-11-14 22:20:00", 3)]
    sizes = dict(answer("How many bytes does each topic take?"))
    assert sizes.keys() == {"/battery_state", "/odom"}


def test_all_tables_are_described() -> None:
    assert [table for table in TABLES if f"`{table}`" not in section()] == []
