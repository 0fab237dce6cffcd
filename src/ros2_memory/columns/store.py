"""The columns of closed bags in one SQLite file that outlives the process.

Everything here is derived: deleting the file changes no answer, only how long it takes. A bag is
stored whole or not at all. Until the ten minutes that it begins in are over, its columns lie in one
row (`split`). Then those of one recording become parts, one for each topic (`part`), column by
column (`part_column`). A part has rows of several bags, and names them: rows of a bag that is not
in `bag` any more do not count.

A bag is known by its path below the bag directory, its size and mtime, and the mtime of the sidecar
that says which of its messages count. Its number is never used twice.
"""

from __future__ import annotations

import json
import math
import os
from collections import defaultdict
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.columns.blob import Entry, pack_tables, unpack_tables
from ros2_memory.columns.database import Database, Tables
from ros2_memory.columns.layout import Layout
from ros2_memory.columns.pack import FORMAT, Packed
from ros2_memory.columns.parts import pack_rows, packed_part
from ros2_memory.columns.stored import Topic
from ros2_memory.columns.table import Zone
from ros2_memory.core.timebase import NS_PER_S, Ns
from ros2_memory.storage.base import Channel, Schema

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.columns.parts import PackedPart
    from ros2_memory.columns.stored import StoredTable
    from ros2_memory.columns.table import Table
    from ros2_memory.core.model import BagFile
    from ros2_memory.storage.base import Definition, IntArray

FILE: Final = "columns.sqlite"
PART_NS: Final[Ns] = 600 * NS_PER_S
"""Bags of one recording that begin in the same ten minutes become one part for each topic."""
LONG_NS: Final[Ns] = 2 * PART_NS
"""A bag that lasts longer becomes parts at once."""

TABLES: Final = Tables(
    version=FORMAT,
    names=("bag", "topic", "definition", "split", "part", "part_column", "deletion"),
    # Deleted rows are overwritten, and pages that become free go back to the disk.
    pragmas=("page_size = 8192", "auto_vacuum = INCREMENTAL", "secure_delete = ON"),
    statements="""
CREATE TABLE bag (id INTEGER PRIMARY KEY AUTOINCREMENT, path TEXT NOT NULL UNIQUE,
  size INTEGER NOT NULL, mtime_ns INTEGER NOT NULL, sidecar_ns INTEGER NOT NULL,
  first_ns INTEGER NOT NULL, last_ns INTEGER NOT NULL, messages INTEGER NOT NULL,
  hashed INTEGER NOT NULL, definitions TEXT NOT NULL);
CREATE TABLE topic (id INTEGER PRIMARY KEY, name TEXT NOT NULL, encoding TEXT NOT NULL,
  latched INTEGER NOT NULL, definition INTEGER NOT NULL, layout TEXT NOT NULL,
  UNIQUE (name, encoding, latched, definition, layout));
CREATE TABLE definition (id INTEGER PRIMARY KEY, type TEXT NOT NULL, encoding TEXT NOT NULL,
  text BLOB NOT NULL, UNIQUE (type, encoding, text));
CREATE TABLE split (bag INTEGER PRIMARY KEY, tables BLOB NOT NULL);
CREATE TABLE part (id INTEGER PRIMARY KEY AUTOINCREMENT, topic INTEGER NOT NULL,
  first_ns INTEGER NOT NULL, last_ns INTEGER NOT NULL, messages INTEGER NOT NULL,
  bags TEXT NOT NULL);
CREATE INDEX part_of_topic ON part (topic);
CREATE TABLE part_column (part INTEGER NOT NULL, path TEXT NOT NULL, codec TEXT NOT NULL,
  count INTEGER NOT NULL, least, greatest, nulls INTEGER NOT NULL, error REAL NOT NULL,
  words TEXT, data BLOB, PRIMARY KEY (part, path)) WITHOUT ROWID;
CREATE TABLE deletion (id INTEGER PRIMARY KEY AUTOINCREMENT);
""",
)

_MOST_INTEGER: Final = 2**63 - 1
DefinitionOf: TypeAlias = "Callable[[Channel], Definition | None]"


class BagKey(NamedTuple):
    """Identifies the bytes of a bag: a file below the bag directory, as `stat` showed it."""

    path: str
    size: int
    mtime_ns: Ns
    sidecar_ns: Ns

    @classmethod
    def of(cls, bag: BagFile, bag_dir: Path) -> BagKey:
        """Returns the key of a bag of the index."""
        return cls(relative(bag.file, str(bag_dir)), bag.size, bag.mtime_ns, bag.sidecar_ns)


def relative(file: str, bag_dir: str) -> str:
    """Returns the path of a bag below the bag directory; itself where it lies elsewhere."""
    return file.removeprefix(f"{bag_dir}{os.sep}")


class State(NamedTuple):
    """What changes with every change of the store: the newest of what it ever had."""

    bag: int
    part: int
    deletion: int


class StoredBag(NamedTuple):
    """A bag that is stored: its number, and whether copies of its messages can be recognised."""

    number: int
    key: BagKey
    hashed: bool


@dataclass(frozen=True, slots=True, eq=False)
class PartHead:
    """What is known of a part without reading a column.

    Attributes:
        number: of the part.
        topic: of its topic.
        first: the earliest log time (ns), inclusive.
        last: the latest, inclusive.
        messages: how many rows.
        bags: the numbers of the bags that its rows are of, ascending.
    """

    number: int
    topic: int
    first: Ns
    last: Ns
    messages: int
    bags: IntArray


class ColumnStore(Database):
    """Stores the columns of bags, and finds them again.

    Safe for several threads and several processes. No error of the file is raised: if it fails,
    no bag is stored.

    Args:
        paths: where the file may lie; see `Database`.
        sources: other files that may be copied to a path that has none yet; only read.
        waits_for: a directory; until it exists, nothing is opened or made.
        definition_of: returns the definition of a channel, as `BagReader.definition`.
        definitions: tells the configured message definitions apart. Bags with messages that these
            could not decode are stored only for them.
    """

    def __init__(
        self,
        paths: Sequence[Path] | Callable[[], Sequence[Path]],
        definition_of: DefinitionOf,
        *,
        definitions: str = "",
        sources: Sequence[Path] = (),
        waits_for: Path | None = None,
    ) -> None:
        super().__init__(paths, TABLES, sources=sources, waits_for=waits_for)
        self._definition_of = definition_of
        self._definitions = definitions
        self._topics: dict[int, Topic] = {}

    # Reading

    def state(self) -> State:
        """Returns what tells whether anything has changed."""

        def ask(connection: sqlite3.Connection) -> State:
            row = connection.execute(
                "SELECT (SELECT max(id) FROM bag), (SELECT max(id) FROM part),"
                " (SELECT max(id) FROM deletion)"
            ).fetchone()
            return State(*(self.offset + int(number or 0) for number in row))

        return self.read(ask, State(-1, -1, -1))

    def bags(self, paths: Sequence[str] | None = None) -> dict[str, StoredBag]:
        """Returns the bags that are stored, by their paths; among some, or all of them."""

        def ask(connection: sqlite3.Connection) -> dict[str, StoredBag]:
            among = "" if paths is None else "AND path IN (SELECT value FROM json_each(?))"
            rows = connection.execute(
                "SELECT path, size, mtime_ns, sidecar_ns, id, hashed FROM bag"
                f" WHERE definitions IN ('', ?) {among}",
                (self._definitions, *(() if paths is None else (json.dumps(paths),))),
            )
            return {
                row[0]: StoredBag(self.offset + row[4], BagKey(*row[:4]), bool(row[5]))
                for row in rows
            }

        return self.read(ask, {})

    def splits(self) -> frozenset[int]:
        """Returns the numbers of the bags that are not in parts yet."""

        def ask(connection: sqlite3.Connection) -> frozenset[int]:
            return frozenset(
                self.offset + row[0] for row in connection.execute("SELECT bag FROM split")
            )

        return self.read(ask, frozenset())

    def hashed(self) -> frozenset[int]:
        """Returns the numbers of the splits in which copies of messages can be recognised."""

        def ask(connection: sqlite3.Connection) -> frozenset[int]:
            rows = connection.execute(
                "SELECT id FROM bag WHERE hashed AND id IN (SELECT bag FROM split)"
            )
            return frozenset(self.offset + row[0] for row in rows)

        return self.read(ask, frozenset())

    def oldest(self) -> Ns | None:
        """Returns the earliest log time (ns) of any bag; None without one."""

        def ask(connection: sqlite3.Connection) -> Ns | None:
            found: Ns | None = connection.execute("SELECT min(first_ns) FROM bag").fetchone()[0]
            return found

        return self.read(ask, None)

    def beginning_before(self, before: Ns) -> list[BagKey]:
        """Returns the bags whose first message is earlier than a log time (ns)."""

        def ask(connection: sqlite3.Connection) -> list[BagKey]:
            rows = connection.execute(
                "SELECT path, size, mtime_ns, sidecar_ns FROM bag WHERE first_ns < ?", (before,)
            )
            return [BagKey(*row) for row in rows]

        return self.read(ask, [])

    def paths(self) -> list[str]:
        """Returns the paths of all bags, also of those that are stored in part."""

        def ask(connection: sqlite3.Connection) -> list[str]:
            return [path for (path,) in connection.execute("SELECT path FROM bag")]

        return self.read(ask, [])

    def topics(self) -> dict[int, Topic]:
        """Returns all topics that were ever stored, by their numbers."""

        def ask(connection: sqlite3.Connection) -> dict[int, Topic]:
            known = self._topics
            rows = connection.execute(
                "SELECT topic.id, name, topic.encoding, latched, layout, type,"
                " definition.encoding, text"
                " FROM topic JOIN definition ON definition.id = definition WHERE topic.id > ?",
                (max(known, default=0),),
            )
            added: dict[int, Topic] = {}
            for number, name, encoding, latched, layout, *schema in rows:
                channel = Channel(name, encoding, Schema(*schema), bool(latched))
                definition = self._definition_of(channel)
                added[number] = Topic(channel, Layout.from_json(layout), definition)
            self._topics = {**known, **added} if added else known
            return self._topics

        return self.read(ask, {})

    def parts(self, topic: str, after: int = 0) -> list[PartHead]:
        """Returns the parts of a topic, of all its types, in the order of their first messages.

        Args:
            topic: its name.
            after: a part; those that are newer are returned.
        """

        def ask(connection: sqlite3.Connection) -> list[PartHead]:
            rows = connection.execute(
                "SELECT id, topic, first_ns, last_ns, messages, bags FROM part"
                " WHERE topic IN (SELECT id FROM topic WHERE name = ?) AND id > ?"
                " ORDER BY first_ns, id",
                (topic, max(after - self.offset, 0)),
            )
            return [
                PartHead(
                    self.offset + number,
                    of_topic,
                    first,
                    last,
                    messages,
                    np.array(json.loads(bags), np.int64) + self.offset,
                )
                for number, of_topic, first, last, messages, bags in rows
            ]

        return self.read(ask, [])

    def part_columns(self, part: int) -> dict[str, Packed]:
        """Returns what is known of each column of a part, without its values."""

        def ask(connection: sqlite3.Connection) -> dict[str, Packed]:
            rows = connection.execute(
                "SELECT path, codec, count, error, least, greatest, nulls, words FROM part_column"
                " WHERE part = ?",
                (part - self.offset,),
            )
            return {
                path: Packed(codec, count, error, Zone(least, greatest, nulls, words), b"")
                for path, codec, count, error, least, greatest, nulls, words in rows
            }

        return self.read(ask, {})

    def part_data(self, part: int, path: str) -> bytes | None:
        """Returns the compressed bytes of a column; None if it is gone, or was never stored."""

        def ask(connection: sqlite3.Connection) -> bytes | None:
            row = connection.execute(
                "SELECT data FROM part_column WHERE part = ? AND path = ?",
                (part - self.offset, path),
            ).fetchone()
            return None if row is None else row[0]

        return self.read(ask, None)

    def split_data(self, bag: int) -> bytes | None:
        """Returns the packed tables of a bag; None if they are gone, or in parts by now."""

        def ask(connection: sqlite3.Connection) -> bytes | None:
            row = connection.execute(
                "SELECT tables FROM split WHERE bag = ?", (bag - self.offset,)
            ).fetchone()
            return None if row is None else row[0]

        return self.read(ask, None)

    # Writing

    def put(
        self,
        key: BagKey,
        bag: BagFile,
        tables: Sequence[Table],
        *,
        hashed: bool,
        is_current: Callable[[], bool] = lambda: True,
    ) -> bool:
        """Stores a bag, in place of what its path was stored with; returns whether it did.

        Args:
            key: of the bag.
            bag: the bag, for its times.
            tables: all of its messages.
            hashed: whether all tables have the hashes of their payloads.
            is_current: whether the bag may be stored, asked once nobody else can write.
        """
        stored = False

        def write(connection: sqlite3.Connection) -> None:
            nonlocal stored
            stored = is_current()
            if not stored:
                return
            _delete(connection, [key.path])
            definitions = self._definitions if _lacks_definitions(tables) else ""
            number = _insert_bag(connection, key, bag, definitions, hashed=hashed)
            entries = [Entry(*_topic_of(connection, table), table) for table in tables]
            connection.execute(
                "INSERT INTO split VALUES (?, ?)", (number, pack_tables(entries, places=False))
            )

        return self.write(write) and stored

    def put_long(
        self,
        key: BagKey,
        bag: BagFile,
        groups: Iterable[Sequence[Table]],
        *,
        hashed: bool,
        is_current: Callable[[], bool] = lambda: True,
    ) -> bool:
        """Stores a bag as parts, group by group; returns whether it did.

        A bag that is stored in part is none: it has its key only once the last group is written.
        Arguments are as for `put`.
        """
        number = 0
        stored = lacks_definitions = False

        def begin(connection: sqlite3.Connection) -> None:
            nonlocal number
            _delete(connection, [key.path])
            number = _insert_bag(connection, key._replace(size=-1), bag, "", hashed=hashed)

        def end(connection: sqlite3.Connection) -> None:
            nonlocal stored
            stored = is_current()
            size = key.size if stored else -1
            definitions = self._definitions if lacks_definitions else ""
            connection.execute(
                "UPDATE bag SET size = ?, definitions = ? WHERE id = ?", (size, definitions, number)
            )

        if not self.write(begin):
            return False
        for tables in groups:
            lacks_definitions |= _lacks_definitions(tables)
            parts = [part for table in tables if len(table) for part in _in_parts(table)]
            if not self.write(partial(_insert_rows, parts=parts, bag=number)):
                return False
        return self.write(end) and stored

    def merge(self, bags: Sequence[int], budget: int) -> bool:
        """Makes parts of bags of one recording; returns whether it did.

        Args:
            bags: their numbers. Nothing is done unless each of them is a split.
            budget: how many bytes the parts may take; the columns of the largest topics are
                dropped beyond that.
        """
        topics = self.topics()

        def write(connection: sqlite3.Connection) -> None:
            numbers = [bag - self.offset for bag in bags]
            rows = connection.execute(
                "SELECT bag, tables FROM split WHERE bag IN (SELECT value FROM json_each(?))"
                " ORDER BY bag",
                (json.dumps(numbers),),
            ).fetchall()
            if len(rows) < len(numbers):
                return  # another program merges them
            found: dict[int, list[tuple[int, StoredTable]]] = defaultdict(list)
            for bag, blob in rows:
                for table in unpack_tables(blob, topics):
                    if len(table):
                        found[table.number].append((bag, table))
            packed = {
                topic: packed_part(topics[topic].layout, tables) for topic, tables in found.items()
            }
            for topic, part in _within(packed, budget).items():
                _insert_part(connection, topic, part)
            connection.execute(
                "DELETE FROM split WHERE bag IN (SELECT value FROM json_each(?))",
                (json.dumps(numbers),),
            )

        return self.write(write)

    def delete(self, paths: Sequence[str]) -> bool:
        """Deletes bags, and the parts that have rows of none that is left."""
        return self.write(partial(_delete, paths=paths))

    def used_bytes(self) -> int:
        """Returns the bytes of the file that hold something."""

        def ask(connection: sqlite3.Connection) -> int:
            pages, free, size = (
                int(connection.execute(f"PRAGMA {name}").fetchone()[0])
                for name in ("page_count", "freelist_count", "page_size")
            )
            return (pages - free) * size

        return self.read(ask, 0)


def _within(parts: Mapping[int, PackedPart], budget: int) -> dict[int, PackedPart]:
    """Returns parts without the data of the largest, as many as are beyond the budget (bytes)."""
    found: dict[int, PackedPart] = {}
    for topic in sorted(parts, key=lambda topic: parts[topic].size):
        part = parts[topic]
        budget -= part.size
        found[topic] = part if budget >= 0 else part.without_data()
    return found


def _in_parts(table: Table) -> Iterator[Table]:
    """Yields the rows of a table by the ten minutes that they are in."""
    slots = table.log_times // PART_NS
    edges = np.flatnonzero(np.diff(slots)) + 1
    for rows in np.split(np.arange(len(table)), edges):
        yield table.rows(rows)


def _insert_rows(connection: sqlite3.Connection, parts: Sequence[Table], bag: int) -> None:
    for table in parts:
        topic, layout = _topic_of(connection, table)
        part = pack_rows(layout, table, np.full(len(table), bag, np.int64))
        _insert_part(connection, topic, part)


def _lacks_definitions(tables: Sequence[Table]) -> bool:
    """Returns whether other definitions may decode what these could not."""
    return any("" in table.left_out for table in tables)


def _insert_bag(
    connection: sqlite3.Connection, key: BagKey, bag: BagFile, definitions: str, *, hashed: bool
) -> int:
    messages = sum(topic.count for topic in bag.summary.topics)
    cursor = connection.execute(
        "INSERT INTO bag (path, size, mtime_ns, sidecar_ns, first_ns, last_ns, messages, hashed,"
        " definitions) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
        (*key, bag.start, bag.end, messages, hashed, definitions),
    )
    return int(cursor.lastrowid or 0)


def _insert_part(connection: sqlite3.Connection, topic: int, part: PackedPart) -> None:
    cursor = connection.execute(
        "INSERT INTO part (topic, first_ns, last_ns, messages, bags) VALUES (?, ?, ?, ?, ?)",
        (topic, part.first, part.last, part.messages, json.dumps(part.bags)),
    )
    connection.executemany(
        "INSERT INTO part_column VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
        [
            (
                cursor.lastrowid,
                path,
                packed.codec,
                packed.count,
                _storable(packed.zone.least),
                _storable(packed.zone.greatest),
                packed.zone.nulls,
                packed.error,
                packed.zone.words,
                packed.data or None,
            )
            for path, packed in part.columns.items()
        ],
    )


def _storable(bound: int | float | None) -> int | float | None:  # noqa: PYI041 - unlike
    """Returns the bound of a zone as SQLite can store it: a uint64 may be too large."""
    if isinstance(bound, int) and bound > _MOST_INTEGER:
        return math.nextafter(float(bound), math.inf)
    return bound


def _topic_of(connection: sqlite3.Connection, table: Table) -> tuple[int, Layout]:
    """Returns the number of a table's topic, which is inserted if it is new, and its layout."""
    channel, layout = table.channel, Layout.of(table, table.definition)
    schema = channel.schema
    definition = _number_of(
        connection,
        "definition",
        {"type": schema.name, "encoding": schema.encoding, "text": schema.text},
    )
    topic = _number_of(
        connection,
        "topic",
        {
            "name": channel.topic,
            "encoding": channel.encoding,
            "latched": channel.latched,
            "definition": definition,
            "layout": layout.to_json(),
        },
    )
    return topic, layout


def _number_of(
    connection: sqlite3.Connection, table: str, values: Mapping[str, str | bytes | int]
) -> int:
    """Returns the id of the row with these values, which is inserted if it is new."""
    given = tuple(values.values())
    where = " AND ".join(f"{name} = ?" for name in values)
    row = connection.execute(f"SELECT id FROM {table} WHERE {where}", given).fetchone()
    if row is not None:
        return int(row[0])
    names, marks = ", ".join(values), ", ".join("?" * len(given))
    cursor = connection.execute(f"INSERT INTO {table} ({names}) VALUES ({marks})", given)
    return int(cursor.lastrowid or 0)


def _delete(connection: sqlite3.Connection, paths: Sequence[str]) -> None:
    numbers = [
        row[0]
        for row in connection.execute(
            "SELECT id FROM bag WHERE path IN (SELECT value FROM json_each(?))",
            (json.dumps(paths),),
        )
    ]
    if not numbers:
        return
    connection.executemany("DELETE FROM bag WHERE id = ?", [(number,) for number in numbers])
    connection.executemany("DELETE FROM split WHERE bag = ?", [(number,) for number in numbers])
    # A part goes with the last of its bags.
    gone = connection.execute(
        "SELECT id FROM part WHERE NOT EXISTS"
        " (SELECT 1 FROM json_each(part.bags) JOIN bag ON bag.id = value)"
    ).fetchall()
    connection.executemany("DELETE FROM part_column WHERE part = ?", gone)
    connection.executemany("DELETE FROM part WHERE id = ?", gone)
    connection.execute("INSERT INTO deletion DEFAULT VALUES")
