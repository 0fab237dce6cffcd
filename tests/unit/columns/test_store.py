"""The file of the store may be anything at any time, and what its rows mean is pinned."""

import hashlib
import os
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from unittest.mock import Mock

import pytest

from ros2_memory.columns.pack import FORMAT, decompressed
from ros2_memory.columns.scanner import Scanner
from ros2_memory.columns.store import FILE, ColumnStore
from ros2_memory.columns.units import GoneError
from tests.support.bags import (
    battery,
    boolean,
    command,
    detections,
    diagnostics,
    goals,
    log_entry,
    odom,
    text,
    tf,
    transform,
    write_mcap,
)
from tests.support.column_worlds import World, check_all, store_file

S = 10**9
T0 = 1_700_000_400 * S
ZSTD = b"\x28\xb5\x2f\xfd"


def write_bags(bag_dir: Path, count: int = 4) -> list[Path]:
    paths = []
    for number in range(count):
        start = T0 + number * 10 * S
        messages = [odom(start + n * S // 2, n / 7, number / 3) for n in range(20)]
        messages += [detections(start + S, ["cup", f"thing {number}"]), battery(start + 2 * S, 0.7)]
        messages += [text(start + 3 * S, ""), text(start + 4 * S, "Straße")]
        path = write_mcap(bag_dir / "rec" / f"rec_{number}.mcap", messages)
        os.utime(path, ns=(T0, T0))
        paths.append(path)
    return paths


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
        messages += [odom(at, x, 0.1), tf(at, transform(at, "map", "odom", (1.0, 0.0, 0.0)))]
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
        os.utime(path, ns=(T0, T0))


def stored_rows(file: Path) -> str:
    """A hash of all that is in a store, but for how it is compressed and what files looked like."""
    digest = hashlib.sha256()
    with closing(sqlite3.connect(file)) as base:
        tables = {
            "bag": "id, path, first_ns, last_ns, messages, hashed, definitions, summary, counts",
            "summary": "*",
            "topic": "*",
            "definition": "*",
            "part": "*",
            "part_column": "*",
            "zone": "*",
            "fragment": "id, start_ns, parts, data",
            "fragment_part": "*",
        }
        for table, columns in tables.items():
            for row in base.execute(f"SELECT {columns} FROM {table} ORDER BY 1, 2"):  # noqa: S608
                values = [
                    decompressed(value)
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
    assert (FORMAT, *hashes) == (36, "315b7d65fb734fce", "6f7e0f9c3ba76436"), (
        "the store has other rows of the same bags than before: raise FORMAT in columns/pack.py, "
        "so that stores are filled anew, and pin the new number and hashes here"
    )


@pytest.mark.parametrize(
    "statement",
    ["PRAGMA user_version = 99", "DROP TABLE part_column"],
)
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


def replace_log(path: Path) -> None:
    """What another program does that takes the file for a new one."""
    log = path.with_name(f"{path.name}-wal")
    log.unlink()
    log.touch()


def delete_file(path: Path) -> None:
    path.unlink()


@pytest.mark.parametrize("fault", [replace_log, delete_file])
def test_what_is_read_while_the_files_are_replaced_does_not_count(
    world: World, tmp_path: Path, fault: Callable[[Path], None]
) -> None:
    failures = world.store.failures

    def read(connection: sqlite3.Connection) -> int:
        fault(store_file(tmp_path))
        return int(connection.execute("SELECT count(*) FROM part").fetchone()[0])

    assert world.store.read(read, -1) == -1
    assert world.store.failures > failures
    assert world.stored() == set()
    assert check_all(world) == 4 * 24


@pytest.mark.parametrize("damaged", ["x'00'", "substr(data, 1, 12)"])
def test_a_column_that_turns_out_damaged_fails_one_question_and_no_other(
    tmp_path: Path, damaged: str
) -> None:
    write_bags(tmp_path)
    World.of(tmp_path).fill()
    with closing(sqlite3.connect(store_file(tmp_path))) as base:
        base.execute(f"UPDATE part_column SET data = {damaged} WHERE data NOT NULL")  # noqa: S608
        base.commit()
    world = World.of(tmp_path)
    with pytest.raises(GoneError):
        check_all(world)
    assert check_all(world) == 4 * 24
    assert world.fill() == 4
    assert check_all(world) == 4 * 24


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
    in_memory = World.of(bag_dir, file=refused)
    assert in_memory.store.path is None
    assert in_memory.fill() == 4
    assert check_all(in_memory) == 4 * 24
    assert len(in_memory.stored()) == 4


@pytest.mark.parametrize(("lost", "taken"), [("", 4), ("*-shm", 0)], ids=["whole", "no index"])
def test_where_a_store_is_copied_from_nothing_changes(
    world: World, tmp_path: Path, lost: str, taken: int
) -> None:
    """Also where its program was killed, so that its write-ahead log is there still."""
    assert world.store.path is not None
    folder = tmp_path / "strangers"
    shutil.copytree(world.store.path.parent, folder, ignore=shutil.ignore_patterns(lost))
    before = {path: path.read_bytes() for path in folder.iterdir()}
    store = ColumnStore([tmp_path / "cache" / FILE], Mock(), sources=[folder / FILE])
    assert len(store.paths()) == taken
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_a_part_that_is_deleted_is_not_one_that_lacks_a_column(
    world: World, tmp_path: Path
) -> None:
    scanner, [head, *_] = Scanner(world.store, tmp_path), world.store.parts("/odom")
    assert scanner.packed(head, ["#log_time"], "no such column") is None
    assert world.store.delete(world.store.paths())
    with pytest.raises(GoneError):
        scanner.packed(head, ["#log_time"], "#log_time")
