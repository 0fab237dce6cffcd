"""What is written into the tables of a store: bags, their topics and their parts."""

from __future__ import annotations

import json
from collections import defaultdict
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.columns.layout import Layout
from ros2_memory.columns.parts import DROPPED, ZONE_ALONE, pack_rows
from ros2_memory.columns.table import Zone
from ros2_memory.core.timebase import NS_PER_S, Ns

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Callable, Collection, Iterator, Mapping, Sequence

    from ros2_memory.columns.parts import PackedPart
    from ros2_memory.columns.store import BagKey
    from ros2_memory.columns.table import Table
    from ros2_memory.core.model import BagFile
    from ros2_memory.storage.base import Schema

PART_NS: Final[Ns] = 600 * NS_PER_S
"""Bags of one recording that begin in the same ten minutes become one part for each topic."""
_MOST_INTEGER: Final = 2**63 - 1
_WEIGHT_OF_FIRST: Final = 0.25
"""What a byte of the topics that come first counts: before large ones, not before all the small."""
_MOST_LAYOUTS: Final = 4_096


class Share(NamedTuple):
    """What parts may take: so many bytes, and topics of which types come first."""

    size: int
    first: Collection[str] = ()


class LongBag:
    """A bag that is written in several transactions.

    Attributes:
        goes_on: whether it may be written on, as the last transaction found.

    Args:
        key: of the bag.
        bag: the bag.
        definitions: as `ColumnStore` has them.
        is_current: whether the bag may be stored.
        share: what its parts may take.
    """

    def __init__(
        self,
        key: BagKey,
        bag: BagFile,
        definitions: str,
        is_current: Callable[[], bool],
        share: Share,
    ) -> None:
        self.goes_on = False
        self._key = key
        self._bag = bag
        self._definitions = definitions
        self._is_current = is_current
        self._share = share
        self._lacks_definitions = False
        self._number = 0
        self._layouts = Layouts()

    def begin(self, connection: sqlite3.Connection, *, hashed: bool) -> None:
        """Inserts the bag with a key that none has, in place of what its path was stored with."""
        self.goes_on = self._is_current()
        if self.goes_on:
            delete_bags(connection, [self._key.path])
            half = self._key._replace(size=-1)
            self._number = insert_bag(connection, half, self._bag, "", hashed=hashed)

    def add(self, connection: sqlite3.Connection, tables: Sequence[Table]) -> None:
        """Inserts some of its messages, as parts of ten minutes each."""
        if not self._may_go_on(connection):
            return
        self._lacks_definitions |= lacks_definitions(tables)
        packed: dict[int, list[PackedPart]] = defaultdict(list)
        for table in tables:
            topic, layout = topic_of(connection, table, self._layouts)
            for rows in _in_parts(table) if len(table) else ():
                numbers = np.full(len(rows), self._number, np.int64)
                packed[topic].append(pack_rows(layout, rows, numbers))
        part = sum(len(table) for table in tables) / max(_messages_of(self._bag), 1)
        share = self._share._replace(size=round(self._share.size * part))
        insert_parts(connection, within(connection, packed, share))

    def end(self, connection: sqlite3.Connection) -> None:
        """Gives the bag its key: now it is stored."""
        if self._may_go_on(connection):
            definitions = self._definitions if self._lacks_definitions else ""
            connection.execute(
                "UPDATE bag SET size = ?, definitions = ? WHERE id = ?",
                (self._key.size, definitions, self._number),
            )

    def delete_half(self, connection: sqlite3.Connection) -> None:
        """Deletes what was written of it."""
        rows = connection.execute("SELECT path FROM bag WHERE id = ?", (self._number,))
        delete_bags(connection, [path for (path,) in rows.fetchall()])

    def _may_go_on(self, connection: sqlite3.Connection) -> bool:
        # Meanwhile it may have been deleted, or another program may store it.
        row = connection.execute("SELECT 1 FROM bag WHERE id = ?", (self._number,)).fetchone()
        self.goes_on = row is not None and self._is_current()
        return self.goes_on


def within(
    connection: sqlite3.Connection, parts: Mapping[int, Sequence[PackedPart]], share: Share
) -> dict[int, list[PackedPart]]:
    """Returns the parts of topics; of the largest that are beyond the share no data.

    Those that are the largest in all parts, so that not each topic has some parts without data.
    Topics of the types that come first lose theirs after others that are as large.
    """
    rows = connection.execute(
        "SELECT topic.id FROM topic JOIN definition ON definition.id = topic.definition"
        " WHERE type IN (SELECT value FROM json_each(?))",
        (json.dumps([*share.first]),),
    )
    weights = {topic: _WEIGHT_OF_FIRST for (topic,) in rows}
    sizes = {topic: sum(part.size for part in parts[topic]) for topic in parts}
    usual: dict[int, float] = dict(
        connection.execute("SELECT topic, total(bytes) FROM part GROUP BY topic")
    )
    budget = share.size
    found: dict[int, list[PackedPart]] = {}

    def rank(topic: int) -> float:
        return weights.get(topic, 1.0) * (sizes[topic] + usual.get(topic, 0))

    for topic in sorted(parts, key=rank):
        budget -= sizes[topic]
        kept = budget >= 0
        found[topic] = [part if kept else part.without_data() for part in parts[topic]]
    return found


def _in_parts(table: Table) -> Iterator[Table]:
    """Yields the rows of a table by the ten minutes that they are in."""
    slots = table.log_times // PART_NS
    edges = np.flatnonzero(np.diff(slots)) + 1
    for rows in np.split(np.arange(len(table)), edges):
        yield table.rows(rows)


def lacks_definitions(tables: Sequence[Table]) -> bool:
    """Returns whether other definitions may decode what these could not."""
    return any("" in table.left_out for table in tables)


def _messages_of(bag: BagFile) -> int:
    return sum(topic.count for topic in bag.summary.topics)


def insert_bag(
    connection: sqlite3.Connection, key: BagKey, bag: BagFile, definitions: str, *, hashed: bool
) -> int:
    """Inserts a bag; returns its number."""
    summary = _number_of(connection, "summary", {"topics": bag.summary.schema.to_json()})
    times = (bag.start, bag.end, _messages_of(bag))
    cursor = connection.execute(
        "INSERT INTO bag (path, size, mtime_ns, sidecar_ns, first_ns, last_ns, messages, hashed,"
        " definitions, summary, counts) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
        (*key, *times, hashed, definitions, summary, bag.summary.packed),
    )
    return int(cursor.lastrowid or 0)


def insert_parts(connection: sqlite3.Connection, parts: Mapping[int, Sequence[PackedPart]]) -> None:
    """Inserts parts, by the numbers of their topics."""
    for topic, some in parts.items():
        for part in some:
            _insert_part(connection, topic, part)


def _insert_part(connection: sqlite3.Connection, topic: int, part: PackedPart) -> None:
    paths = [path for path, packed in part.columns.items() if packed.codec == DROPPED]
    dropped, size = json.dumps(paths) if paths else "", part.size + part.dropped_bytes
    cursor = connection.execute(
        "INSERT INTO part (topic, first_ns, last_ns, messages, bags, dropped, bytes)"
        " VALUES (?, ?, ?, ?, ?, ?, ?)",
        (topic, part.first, part.last, part.messages, json.dumps(part.bags), dropped, size),
    )
    number = cursor.lastrowid
    connection.executemany(
        "INSERT INTO part_column VALUES (?, ?, ?)",
        [
            (number, path, packed.data)
            for path, packed in part.columns.items()
            # Numbers that are rounded to one take no bytes, but are no constant.
            if packed.data or packed.codec.split()[-1] not in {"constant", DROPPED, ZONE_ALONE}
        ],
    )
    connection.executemany(
        "INSERT INTO zone VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
        [
            (
                topic,
                path,
                number,
                packed.codec,
                packed.count,
                packed.error,
                _storable(packed.zone.least),
                _storable(packed.zone.greatest),
                packed.zone.nulls,
                packed.zone.words,
            )
            for path, packed in part.columns.items()
        ],
    )


def _storable(bound: int | float | None) -> float | str | None:  # noqa: PYI041 - unlike
    """Returns the bound of a zone as SQLite can store it: of a uint64 above its integers a text."""
    return str(bound) if isinstance(bound, int) and bound > _MOST_INTEGER else bound


def zone_of(
    least: float | str | None, greatest: float | str | None, nulls: int, words: str | None
) -> Zone:
    """Returns the zone that was stored so."""
    low, high = (int(bound) if isinstance(bound, str) else bound for bound in (least, greatest))
    return Zone(low, high, nulls, words)


class Layouts:
    """Remembers the layouts of tables: those of one schema that leave out the same are the same."""

    def __init__(self) -> None:
        self._known: dict[tuple[Schema, tuple[tuple[str, str], ...]], tuple[Layout, str]] = {}

    def of(self, table: Table) -> tuple[Layout, str]:
        """Returns the layout of a table, and its JSON."""
        key = (table.channel.schema, tuple(sorted(table.left_out.items())))
        known = self._known.get(key)
        if known is None or not known[0].fits(table):
            layout = Layout.of(table, table.definition)
            known = self._known[key] = (layout, layout.to_json())
            if len(self._known) > _MOST_LAYOUTS:
                del self._known[next(iter(self._known))]
        return known


def topic_of(connection: sqlite3.Connection, table: Table, layouts: Layouts) -> tuple[int, Layout]:
    """Returns the number of a table's topic, which is inserted if it is new, and its layout."""
    channel, (layout, described) = table.channel, layouts.of(table)
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
            "layout": described,
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


def delete_bags(connection: sqlite3.Connection, paths: Sequence[str]) -> None:
    """Deletes bags, and the parts that have rows of none that is left."""
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
    connection.execute("INSERT INTO deletion DEFAULT VALUES")
