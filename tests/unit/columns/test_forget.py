"""What is forgotten leaves no byte in the store's files, nor do bags that retention deleted."""

import sqlite3
import struct
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest

from ros2_memory.columns import forget as forgetting
from ros2_memory.columns.forget import forget
from ros2_memory.columns.pack import decompressed
from ros2_memory.core.errors import BagError
from ros2_memory.core.timebase import NS_PER_S
from tests.support.bags import battery, odom, text, write_mcap
from tests.support.column_worlds import World, check_all, store_file
from tests.support.fakes import files_limited_to

S = NS_PER_S
T0 = 1_700_000_400 * S


def write_bag(bag_dir: Path, number: int) -> Path:
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


def secrets(number: int) -> list[bytes]:
    """What one bag alone says: texts of its messages, a topic, its name, and when it begins."""
    texts = [f"secret{number:04d}", f"{number:04d}x0", f"{number:04d}x20", f"{number:04d}x40"]
    texts += [f"/only/{number:04d}", f"rec/rec_{number}.mcap"]
    return [*(each.encode() for each in texts), (T0 + number * 60 * S).to_bytes(8, "big")]


def packed(file: Path) -> list[bytes]:
    """All that is packed."""
    with closing(sqlite3.connect(file)) as base:
        columns = base.execute("SELECT data FROM part_column WHERE data IS NOT NULL").fetchall()
    return [bytes(blob) for (blob,) in columns]


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


def unpacked(file: Path) -> bytes:
    """All that is packed, unpacked."""
    return b"".join(map(decompressed, packed(file)))


DERIVED = {
    True: {"part", "part_column", "fragment", "zone"},
    False: {"part", "part_column", "zone"},
}


@pytest.mark.parametrize("merged", DERIVED)
def test_no_byte_of_a_forgotten_bag_is_left(tmp_path: Path, merged: bool) -> None:
    for number in range(14):
        write_bag(tmp_path, number)
    world = World.of(tmp_path)
    world.fill() if merged else world.fill_alone()
    file = store_file(tmp_path)
    before = {table: slices_of(some) for table, some in values(file).items()}
    there = bytes_of(file.parent) + unpacked(file)
    assert [secret for secret in secrets(3) if secret not in there] == []
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
    assert gone.keys() == {"bag", "summary", "topic", "definition", *DERIVED[merged]}
    assert [part for some in gone.values() for part in some if part in left] == []
    assert [secret for secret in secrets(3) if secret in left + unpacked(file)] == []
    assert "rec/rec_3.mcap" not in world.stored()
    assert "rec/rec_12.mcap" in world.stored()
    assert check_all(world) == 14 * 121
    world.fill()
    assert len(world.stored()) == 14


def test_copies_that_were_set_aside_go_too(tmp_path: Path) -> None:
    write_bag(tmp_path, 0)
    World.of(tmp_path).fill()
    file = store_file(tmp_path)
    for name in ("columns.sqlite.aside", ".columns.sqlite.77.tmp", ".columns.sqlite.77.tmp-wal"):
        file.with_name(name).write_bytes(b"secret0000")
    forget(file, tmp_path, ["rec/rec_0.mcap"])
    assert b"secret0000" not in bytes_of(file.parent)


def test_what_another_program_reads_all_the_time_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_bag(tmp_path, 0)
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
        write_bag(tmp_path, number)
    world = World.of(tmp_path)
    world.fill()
    world.store.close()
    with files_limited_to(100_000), pytest.raises(BagError, match="disk I/O error"):
        forget(store_file(tmp_path), tmp_path, ["rec/rec_3.mcap"])
    assert len(World.of(tmp_path).stored()) == 8


def test_servers_notice_what_was_forgotten(tmp_path: Path) -> None:
    for number in range(2):
        write_bag(tmp_path, number)
    world = World.of(tmp_path)
    world.fill()
    assert check_all(world) == 242
    state = world.store.state()
    forget(store_file(tmp_path), tmp_path, ["rec/rec_0.mcap"])
    assert world.store.state().deletion > state.deletion
    assert check_all(world) == 242
    assert world.stored() == set()


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
