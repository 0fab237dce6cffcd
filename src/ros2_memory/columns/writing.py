"""Parts, and what else is written into the tables of a store: bags and topics.

A part is the rows of one topic in some bags of a recording, column by column. Beside the columns of
the topic's layout it has `#log_time`, `#bag` (the number of each row's bag) and, where copies of a
message of some bag may lie in other recordings, `#payload_hash`, `#delay` (how much later a message
was received than published) and the zone of `#publish_time`. In rows of its other bags the hash is
`UNHASHED` and the delay 0. The owners of the elements of a sequence lie under its path and `#`.
"""

from __future__ import annotations

import json
from collections import defaultdict
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from itertools import chain, repeat
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.columns.pack import Packed, compressed, pack
from ros2_memory.columns.steps import EXACT
from ros2_memory.columns.stored import Layout, columns_in
from ros2_memory.columns.table import UNHASHED, Table, Zone
from ros2_memory.core.timebase import NS_PER_S, Ns

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from ros2_memory.columns.store import BagKey
    from ros2_memory.core.model import BagFile
    from ros2_memory.storage.base import IntArray, Schema

PART_NS: Final[Ns] = 3600 * NS_PER_S
"""Bags of one recording that begin in the same hour become one part for each topic."""


class Level(IntEnum):
    """What the bags of a part have in common, but for their recording.

    A part of a level takes the place of those below it. Few large parts are read and followed from
    sooner than many small ones; the newest bags are stored at once all the same.
    """

    BAG = 0
    TEN_MINUTES = 1
    HOUR = 2

    @property
    def length(self) -> Ns:
        """How long (ns) the slots of the clock are in which the bags begin; 0 of one bag."""
        return (0, 600 * NS_PER_S, PART_NS)[self]


_MOST_ROWS: Final = 24_576
"""Of a part, about: who asks about one message unpacks columns of all."""
BELOW: Final = "SELECT value FROM part, json_each(part.bags) WHERE level < ?"
"""Selects the bags that have parts below a level."""
_MOST_INTEGER: Final = 2**63 - 1
_MOST_LAYOUTS: Final = 4_096

LOG_TIME: Final = "#log_time"
PUBLISH_TIME: Final = "#publish_time"
PAYLOAD_HASH: Final = "#payload_hash"
BAG: Final = "#bag"
DELAY: Final = "#delay"
ZONE_ALONE: Final = "zone"
"""The codec of a column of which there is never more than the zone."""
DROPPED: Final = "dropped"
"""The codec of a column of which only the zone is stored: the rest is beyond the bags' share."""
UNUSED_SUMMARIES: Final = "DELETE FROM summary WHERE id NOT IN (SELECT summary FROM bag)"
ALWAYS: Final = frozenset({LOG_TIME, DELAY, PAYLOAD_HASH, BAG})


@dataclass(frozen=True)
class PackedPart:
    """A part as it is stored.

    Attributes:
        first: the earliest log time (ns), inclusive.
        last: the latest, inclusive.
        messages: how many rows.
        bags: the numbers of the bags that its rows are of, ascending.
        columns: by their paths, packed; the data is compressed.
    """

    first: Ns
    last: Ns
    messages: int
    bags: tuple[int, ...]
    columns: Mapping[str, Packed]

    @cached_property
    def first_of(self) -> dict[bytes, str]:
        """By data, the path of the first column that has it: it is stored once."""
        paths = reversed([*self.columns.items()])
        return {packed.data: path for path, packed in paths if packed.data}

    @property
    def size(self) -> int:
        """How many bytes its data takes."""
        return sum(map(len, self.first_of))


def pack_rows(layout: Layout, table: Table, bags: IntArray) -> PackedPart:
    """Returns the rows of a table of a layout, each with the number of its bag, as a part."""
    common: dict[str, IntArray] = {LOG_TIME: table.log_times, BAG: bags}
    packed: dict[str, Packed] = {}
    if table.payload_hashes is not None:
        is_hashed = table.payload_hashes != UNHASHED
        common[PAYLOAD_HASH] = table.payload_hashes
        common[DELAY] = np.where(is_hashed, table.log_times - table.publish_times, 0)
        # Those of a table without columns may be log times.
        if is_hashed.all() or "" not in table.left_out:
            published = Zone(int(table.publish_times.min()), int(table.publish_times.max()))
            packed[PUBLISH_TIME] = Packed(ZONE_ALONE, len(table), 0.0, published, b"")
    steps = (kind.step for kind in layout.slots.values())
    columns = [*common.values(), *(column for _, column in columns_in(table))]
    packs = map(pack, columns, chain(repeat(EXACT, len(common)), steps))
    packed.update(zip((*common, *layout.slots), packs, strict=True))
    return PackedPart(
        int(table.log_times[0]),
        int(table.log_times[-1]),
        len(table),
        tuple(np.unique(bags).tolist()),
        {
            path: replace(column, data=compressed(column.data)) if column.data else column
            for path, column in packed.items()
        },
    )


class ReadBag(NamedTuple):
    """A bag to be stored.

    Attributes:
        key: of the bag.
        bag: the bag, for its times.
        hashed: whether tables have the hashes of all its payloads.
        is_current: whether the bag may be stored, asked once nobody else can write.
    """

    key: BagKey
    bag: BagFile
    hashed: bool = False
    is_current: Callable[[], bool] = lambda: True


class LongBag:
    """A bag that is written in several transactions.

    What writes returns whether it may be written on, as that transaction found.

    Args:
        to_store: the bag.
        definitions: as `ColumnStore` has them.
        budget: how many bytes its parts may take.
    """

    def __init__(self, to_store: ReadBag, definitions: str, budget: int) -> None:
        self._bag = to_store
        self._definitions = definitions
        self._share = budget / max(_messages_of(to_store.bag), 1)
        self._lacks_definitions = False
        self._number = 0
        self._connection: sqlite3.Connection | None = None
        self._layouts = Layouts()

    def begin(self, connection: sqlite3.Connection) -> bool:
        """Inserts the bag with a key that none has, in place of what its path was stored with."""
        if not self._bag.is_current():
            return False
        key = self._bag.key
        self._connection = connection
        delete_bags(connection, [key.path])
        self._number = insert_bag(connection, self._bag._replace(key=key._replace(size=-1)), "")
        return True

    def add(self, connection: sqlite3.Connection, tables: Sequence[Table]) -> bool:
        """Inserts some of its messages, as parts of an hour each."""
        if not self._may_go_on(connection):
            return False
        self._lacks_definitions |= any(map(lacks_definitions, tables))
        parts: list[int] = []
        for table in tables:
            topic, layout = topic_of(connection, table, self._layouts)
            pieces = map(_in_parts, _by_hour(table)) if len(table) else ()
            for rows in chain.from_iterable(pieces):
                part = pack_rows(layout, rows, np.full(len(rows), self._number, np.int64))
                parts.append(_insert_part(connection, topic, part, Level.HOUR))
        share = round(self._share * sum(map(len, tables)))
        thin_parts(connection, parts, bytes_of_topics(connection), share)
        return True

    def end(self, connection: sqlite3.Connection) -> bool:
        """Gives the bag its key: now it is stored."""
        if not self._may_go_on(connection):
            return False
        definitions = self._definitions if self._lacks_definitions else ""
        connection.execute(
            "UPDATE bag SET size = ?, definitions = ? WHERE id = ?",
            (self._bag.key.size, definitions, self._number),
        )
        return True

    def delete_half(self, connection: sqlite3.Connection) -> None:
        """Deletes the parts of it that were written, where it is not stored whole."""
        if self._is_there(connection):
            delete_bags(connection, [self._bag.key.path])

    def _may_go_on(self, connection: sqlite3.Connection) -> bool:
        return self._is_there(connection) and self._bag.is_current()

    def _is_there(self, connection: sqlite3.Connection) -> bool:
        # Meanwhile the file may have been lost, or another program may have deleted the bag.
        row = connection.execute("SELECT 1 FROM bag WHERE id = ?", (self._number,)).fetchone()
        return connection is self._connection and row is not None


def bytes_of_topics(connection: sqlite3.Connection) -> dict[int, float]:
    """Returns how many bytes the parts of each topic take, with those that were dropped."""
    return dict(connection.execute("SELECT topic, total(bytes) FROM part GROUP BY topic"))


def thin_parts(
    connection: sqlite3.Connection,
    parts: Sequence[int],
    usual: Mapping[int, float],
    at_least: int,
    spare: int = -(2**62),
) -> int:
    """Drops the columns of the largest topics of some parts; returns how many bytes they took.

    Those that are the largest in all parts, so that not each topic has some parts without data.

    Args:
        connection: to the store.
        parts: their numbers.
        usual: as `bytes_of_topics`.
        at_least: how many bytes they may take in any case.
        spare: how many they may take more than now; of less than 0, by how many less.
    """
    sizes: dict[int, dict[int, int]] = defaultdict(dict)
    for part, topic, size in connection.execute(
        "SELECT id, topic, bytes FROM part WHERE id IN (SELECT value FROM json_each(?))"
        " AND dropped = ''",
        (json.dumps(parts),),
    ):
        sizes[topic][part] = size
    of_topic = {topic: sum(by_part.values()) for topic, by_part in sizes.items()}
    left, dropped = max(sum(of_topic.values()) + spare, at_least), 0
    for topic in sorted(sizes, key=lambda topic: usual[topic]):
        left -= of_topic[topic]
        for part, size in sizes[topic].items() if left < 0 else ():
            dropped += size * _drop_columns(connection, topic, part)
    return dropped


def _drop_columns(connection: sqlite3.Connection, topic: int, part: int) -> bool:
    """Leaves of a part the zones of its columns, and its times; returns whether it had more."""
    rows = connection.execute(
        "SELECT path FROM part_column WHERE part = ? AND (length(data) > 0 OR same NOT NULL)",
        (part,),
    )
    paths = [path for (path,) in rows if path not in ALWAYS]
    if not paths:
        return False
    listed = json.dumps(paths)
    connection.execute(
        f"UPDATE zone SET codec = '{DROPPED}' WHERE topic = ? AND part = ?"
        " AND path IN (SELECT value FROM json_each(?))",
        (topic, part, listed),
    )
    connection.execute(
        "DELETE FROM part_column WHERE part = ? AND path IN (SELECT value FROM json_each(?))",
        (part, listed),
    )
    connection.execute("UPDATE part SET dropped = ? WHERE id = ?", (listed, part))
    # Who knows the part looks again.
    _number_deletion(connection)
    return True


def _number_deletion(connection: sqlite3.Connection) -> None:
    """Gives the newest deletion the next number; the table has no other."""
    connection.execute("DELETE FROM deletion")
    connection.execute("INSERT INTO deletion DEFAULT VALUES")


def _by_hour(table: Table) -> Iterator[Table]:
    """Yields the rows of a table by the hour that they are in."""
    edges = np.flatnonzero(np.diff(table.log_times // PART_NS)) + 1
    for rows in np.split(np.arange(len(table)), edges):
        yield table.rows(rows)


def _in_parts(table: Table) -> Iterator[Table]:
    """Yields the rows of a table in as many parts as need be; those of one time are in one."""
    times = table.log_times
    edges = np.unique(np.searchsorted(times, times[_MOST_ROWS::_MOST_ROWS]))
    if not edges.any():
        yield table
        return
    for rows in np.split(np.arange(len(table)), edges[edges > 0]):
        yield table.rows(rows)


def lacks_definitions(table: Table) -> bool:
    """Returns whether a table has no columns: with other definitions it may have some."""
    return "" in table.left_out


def _messages_of(bag: BagFile) -> int:
    return sum(topic.count for topic in bag.summary.topics)


def insert_bag(connection: sqlite3.Connection, to_store: ReadBag, definitions: str) -> int:
    """Inserts a bag; returns its number."""
    key, bag, hashed, _ = to_store
    summary = _number_of(connection, "summary", topics=bag.summary.schema.to_json())
    cursor = connection.execute(
        "INSERT INTO bag (path, size, mtime_ns, sidecar_ns, first_ns, last_ns, messages, hashed,"
        " definitions, summary, counts) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
        (*key, _messages_of(bag), hashed, definitions, summary, bag.summary.data),
    )
    return int(cursor.lastrowid or 0)


def insert_bags(
    connection: sqlite3.Connection,
    bags: Mapping[int, ReadBag],
    tables: Sequence[Table],
    definitions: str,
    layouts: Layouts,
    *,
    level: Level,
) -> list[int]:
    """Inserts bags of one recording, in parts for each topic; returns the ids of these.

    Args:
        connection: to the store.
        bags: by their numbers in the tables.
        tables: with all messages of these bags, each of another topic or layout; and of others,
            which are left out.
        definitions: as `ColumnStore` has them.
        layouts: of tables before these.
        level: of the parts.
    """
    lacking = {
        number
        for table in filter(lacks_definitions, tables)
        for number in np.unique(table.bag_numbers).tolist()
    }
    ids = np.zeros(max(bags, default=0) + 1, np.int64)
    for number, bag in bags.items():
        ids[number] = insert_bag(connection, bag, definitions if number in lacking else "")
    parts: list[int] = []
    for table in tables:
        is_stored = np.isin(table.bag_numbers, [*bags])
        if is_stored.any():
            topic, layout = topic_of(connection, table, layouts)
            rows = table if is_stored.all() else table.rows(np.flatnonzero(is_stored))
            for piece in _in_parts(rows):
                part = pack_rows(layout, piece, ids[piece.bag_numbers])
                parts.append(_insert_part(connection, topic, part, level))
    return parts


def _insert_part(connection: sqlite3.Connection, topic: int, part: PackedPart, level: Level) -> int:
    cursor = connection.execute(
        "INSERT INTO part (topic, first_ns, last_ns, messages, bags, dropped, bytes, level)"
        " VALUES (?, ?, ?, ?, ?, '', ?, ?)",
        (topic, part.first, part.last, part.messages, json.dumps(part.bags), part.size, level),
    )
    number = int(cursor.lastrowid or 0)
    columns: list[tuple[int, str, str | None, bytes | None]] = []
    for path, packed in part.columns.items():
        # Numbers that are rounded to one take no bytes, but are no constant.
        if packed.data or packed.codec.split()[-1] not in {"constant", ZONE_ALONE}:
            first = part.first_of.get(packed.data, path)
            own = (None, packed.data) if first == path else (first, None)
            columns.append((number, path, *own))
    connection.executemany("INSERT INTO part_column VALUES (?, ?, ?, ?)", columns)
    marks = ", ".join("?" * 10)
    connection.executemany(
        f"INSERT INTO zone VALUES ({marks})",
        [
            (topic, path, number, packed.codec, packed.count, packed.error, *_stored(packed.zone))
            for path, packed in part.columns.items()
        ],
    )
    return number


def _stored(zone: Zone) -> tuple[int | float | str | None, ...]:
    """Returns a zone as SQLite can store it: bounds of a uint64 above its integers as texts."""
    bounds: list[int | float | None] = [zone.least, zone.greatest]
    stored = (
        str(bound) if isinstance(bound, int) and bound > _MOST_INTEGER else bound
        for bound in bounds
    )
    return (*stored, zone.nulls, zone.words)


def zone_of(
    least: float | str | None, greatest: float | str | None, nulls: int, words: str | None
) -> Zone:
    """Returns the zone that was stored so."""
    least = int(least) if isinstance(least, str) else least
    greatest = int(greatest) if isinstance(greatest, str) else greatest
    return Zone(least, greatest, nulls, words)


class Layouts:
    """Remembers the layouts of tables: those of one schema that leave out the same are the same."""

    def __init__(self) -> None:
        self._known: dict[tuple[Schema, tuple[tuple[str, str], ...]], tuple[Layout, str]] = {}

    def of(self, table: Table) -> tuple[Layout, str]:
        """Returns the layout of a table, and its JSON."""
        key = (table.channel.schema, tuple(sorted(table.left_out.items())))
        layout, text = self._known.get(key, (None, ""))
        if layout is None or not layout.fits(table):
            layout = Layout.of(table, table.definition)
            text = layout.to_json()
            self._known[key] = (layout, text)
            if len(self._known) > _MOST_LAYOUTS:
                del self._known[next(iter(self._known))]
        return layout, text


def topic_of(connection: sqlite3.Connection, table: Table, layouts: Layouts) -> tuple[int, Layout]:
    """Returns the number of a table's topic, which is inserted if it is new, and its layout."""
    channel, (layout, described) = table.channel, layouts.of(table)
    schema = channel.schema
    definition = _number_of(
        connection, "definition", type=schema.name, encoding=schema.encoding, text=schema.text
    )
    topic = _number_of(
        connection,
        "topic",
        name=channel.topic,
        encoding=channel.encoding,
        latched=channel.latched,
        definition=definition,
        layout=described,
    )
    return topic, layout


def _number_of(connection: sqlite3.Connection, table: str, **values: str | bytes | int) -> int:
    """Returns the id of the row with these values, which is inserted if it is new."""
    given = tuple(values.values())
    where = " AND ".join(f"{name} = ?" for name in values)
    row = connection.execute(f"SELECT id FROM {table} WHERE {where}", given).fetchone()
    if row is not None:
        return int(row[0])
    names, marks = ", ".join(values), ", ".join("?" * len(given))
    cursor = connection.execute(f"INSERT INTO {table} ({names}) VALUES ({marks})", given)
    return int(cursor.lastrowid or 0)


def delete_bags(connection: sqlite3.Connection, paths: Sequence[str]) -> None:
    """Deletes bags, and the parts that have rows of none that is left."""
    deleted = connection.execute(
        "DELETE FROM bag WHERE path IN (SELECT value FROM json_each(?)) RETURNING id",
        (json.dumps(paths),),
    ).fetchall()
    if not deleted:
        return
    # A part goes with the last of its bags.
    gone = connection.execute(
        "SELECT id, topic FROM part WHERE NOT EXISTS"
        " (SELECT 1 FROM json_each(part.bags) JOIN bag ON bag.id = value)"
    ).fetchall()
    for topic in {topic for _, topic in gone}:
        parts = json.dumps([part for part, of_topic in gone if of_topic == topic])
        # By the paths that the topic has: zones are ordered by these, and parts come last.
        connection.execute(
            "WITH RECURSIVE known (path) AS (SELECT min(path) FROM zone WHERE topic = :topic"
            " UNION ALL SELECT (SELECT min(path) FROM zone WHERE topic = :topic"
            " AND path > known.path) FROM known WHERE known.path IS NOT NULL)"
            " DELETE FROM zone WHERE topic = :topic AND path IN (SELECT path FROM known)"
            " AND part IN (SELECT value FROM json_each(:parts))",
            {"topic": topic, "parts": parts},
        )
    numbers = [(part,) for part, _ in gone]
    connection.executemany(
        "DELETE FROM fragment WHERE id IN (SELECT fragment FROM fragment_part WHERE part = ?)",
        numbers,
    )
    connection.execute("DELETE FROM fragment_part WHERE fragment NOT IN (SELECT id FROM fragment)")
    connection.executemany("DELETE FROM part_column WHERE part = ?", numbers)
    connection.executemany("DELETE FROM part WHERE id = ?", numbers)
    _number_deletion(connection)
