"""Writes bags, topics and parts into the tables of a store.

A part has the rows of one topic in some bags of a recording, column by column. Beside the columns
of the topic's layout it has `#log_time` and `#bag` (the number of each row's bag). If other
recordings may have copies of its messages, it also has `#payload_hash`, `#delay` (the time from
publishing to receiving a message) and the zone of `#publish_time`; in rows of bags without copies
the hash is `UNHASHED` and the delay 0. The owners of the elements of a sequence have its path with
`#` behind it.
"""

from __future__ import annotations

import json
from collections import defaultdict
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.columns.pack import Packed, compress, pack, step_of
from ros2_memory.columns.stored import Layout, columns_in
from ros2_memory.columns.table import UNHASHED, Table, Zone
from ros2_memory.core.arrays import run_starts
from ros2_memory.core.timebase import NS_PER_S, Ns

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from ros2_memory.columns.store import BagKey
    from ros2_memory.core.model import BagFile
    from ros2_memory.storage.base import IntArray

PART_NS: Final[Ns] = 3600 * NS_PER_S
"""Bags of one recording that begin in the same hour become one part for each topic."""


class Level(IntEnum):
    """The slot of the clock whose bags, of one recording, are in a part together.

    The newest bags are stored at once, each in parts of its own. Parts of a higher level replace
    them later: a few large parts are read sooner than many small ones.
    """

    BAG = 0
    TEN_MINUTES = 1
    HOUR = 2

    @property
    def length(self) -> Ns:
        """The length of a slot (ns); 0 for a single bag."""
        return (0, 600 * NS_PER_S, PART_NS)[self]


_MOST_ROWS: Final = 24_576
"""Of a part, about: a question about one message unpacks whole columns."""
KEY: Final = "path, size, mtime_ns, sidecar_ns, first_ns, last_ns"
"""The columns that identify a bag, in the order of a `BagKey`."""
BELOW: Final = "SELECT value FROM part, json_each(part.bags) WHERE level < ?"
"""Selects the bags that have parts below a level."""
_MOST_INTEGER: Final = 2**63 - 1

LOG_TIME: Final = "#log_time"
PUBLISH_TIME: Final = "#publish_time"
PAYLOAD_HASH: Final = "#payload_hash"
BAG: Final = "#bag"
DELAY: Final = "#delay"
ZONE_ALONE: Final = "zone"
"""The codec of a column that only has a zone."""
DROPPED: Final = "dropped"
"""The codec of a column whose bytes were dropped, since they are beyond the bags' share."""
UNUSED_SUMMARIES: Final = "DELETE FROM summary WHERE id NOT IN (SELECT summary FROM bag)"
_NEVER_DROPPED: Final = frozenset({LOG_TIME, DELAY, PAYLOAD_HASH, BAG})


def _packed_columns(table: Table, bags: IntArray) -> dict[str, Packed]:
    """Returns the columns of a part by their paths; their data is compressed.

    Args:
        table: the rows.
        bags: the number of each row's bag.
    """
    packed = {LOG_TIME: pack(table.log_times), BAG: pack(bags)}
    if table.payload_hashes is not None:
        is_hashed = table.payload_hashes != UNHASHED
        packed[PAYLOAD_HASH] = pack(table.payload_hashes)
        packed[DELAY] = pack(np.where(is_hashed, table.log_times - table.publish_times, 0))
        # A table without columns may have log times in place of publish times.
        if is_hashed.all() or "" not in table.left_out:
            published = Zone(int(table.publish_times.min()), int(table.publish_times.max()))
            packed[PUBLISH_TIME] = Packed(ZONE_ALONE, len(table), published)
    for path, column in columns_in(table):
        packed[path] = pack(column, step_of(path, table.definition))
    for path, whole in packed.items():
        if whole.data:
            packed[path] = replace(whole, data=compress(whole.data))
    return packed


class ReadBag(NamedTuple):
    """A bag to be stored.

    Attributes:
        key: of the bag.
        bag: the bag, for its times.
        hashed: whether its tables have the hashes of all payloads.
        is_current: returns whether the bag may still be stored; called inside the transaction.
        number: of the bag in its tables.
    """

    key: BagKey
    bag: BagFile
    hashed: bool = False
    is_current: Callable[[], bool] = lambda: True
    number: int = 0


@dataclass
class Writing:
    """Bags of one recording that are written in common parts, by one transaction or by several.

    `begin`, `add` and `end` return whether writing may go on: False if the file was replaced, or
    a bag was deleted or has changed.

    Attributes:
        bags: the bags.
        definitions: as `ColumnStore` has them.
        level: of the parts.
        budget: how many bytes the parts may take; None for any number. With a budget, each part has
            an hour.
        stored: how many of the bags are stored.
        parts: the ids of their new parts.
    """

    bags: Sequence[ReadBag]
    definitions: str
    level: Level
    budget: int | None = None
    stored: int = 0
    parts: list[int] = field(default_factory=list)
    _new: dict[int, ReadBag] = field(default_factory=dict)
    _lacking: set[int] = field(default_factory=set)
    _connection: sqlite3.Connection | None = None

    def begin(self, connection: sqlite3.Connection) -> bool:
        """Inserts the bags in place of those with their paths, as unfinished: with the size -1.

        A bag that has parts of this level already stays as it is: another program has stored it. A
        bag that has changed meanwhile is left out.
        """
        rows = connection.execute(
            f"SELECT {KEY}, hashed FROM bag"
            " WHERE definitions IN ('', ?) AND path IN (SELECT value FROM json_each(?))"
            f" AND id NOT IN ({BELOW})",
            (self.definitions, json.dumps([bag.key.path for bag in self.bags]), self.level),
        )
        is_hashed = {tuple(key): bool(hashed) for *key, hashed in rows}
        new: list[ReadBag] = []
        self.stored = 0
        for bag in self.bags:
            if bag.key in is_hashed and (is_hashed[bag.key] or not bag.hashed):
                self.stored += 1
            elif bag.is_current():
                new.append(bag)
        delete_bags(connection, [bag.key.path for bag in new])
        self._connection, self.parts = connection, []
        self._new = {_insert_bag(connection, bag): bag for bag in new}
        return True

    def add(self, connection: sqlite3.Connection, tables: Sequence[Table]) -> bool:
        """Inserts some of their messages, in parts for each topic.

        Rows of bags that are stored, or that were left out, are left out.
        """
        if not self._may_go_on(connection):
            return False
        ids = np.zeros(max(bag.number for bag in self.bags) + 1, np.int64)
        ids[[bag.number for bag in self._new.values()]] = [*self._new]
        parts: list[int] = []
        for table in tables:
            if "" in table.left_out:  # it may have columns with other definitions
                self._lacking.update(np.unique(table.bag_numbers).tolist())
            is_new = ids[table.bag_numbers] > 0
            if is_new.any():
                topic = _topic_of(connection, table)
                rows = table if is_new.all() else table.rows(np.flatnonzero(is_new))
                for piece in _pieces_of(rows, by_hour=self.budget is not None):
                    bags = ids[piece.bag_numbers]
                    parts.append(_insert_part(connection, topic, piece, bags, self.level))
        if self.budget is not None:
            messages = sum(_messages_of(bag.bag) for bag in self.bags)
            share = round(self.budget / max(messages, 1) * sum(map(len, tables)))
            thin_parts(connection, parts, bytes_of_topics(connection), share)
        self.parts += parts
        return True

    def end(self, connection: sqlite3.Connection) -> bool:
        """Gives the bags their sizes: now they are stored."""
        if not self._may_go_on(connection):
            return False
        for number, bag in self._new.items():
            definitions = self.definitions if bag.number in self._lacking else ""
            connection.execute(
                "UPDATE bag SET size = ?, definitions = ? WHERE id = ?",
                (bag.key.size, definitions, number),
            )
        self.stored += len(self._new)
        return True

    def delete_unfinished(self, connection: sqlite3.Connection) -> None:
        """Deletes the parts that were written."""
        if self._exist(connection):
            delete_bags(connection, [bag.key.path for bag in self._new.values()])

    def _may_go_on(self, connection: sqlite3.Connection) -> bool:
        return self._exist(connection) and all(bag.is_current() for bag in self._new.values())

    def _exist(self, connection: sqlite3.Connection) -> bool:
        # Meanwhile the file may have been lost, or another program may have deleted a bag.
        query = "SELECT count(*) FROM bag WHERE id IN (SELECT value FROM json_each(?))"
        [found] = connection.execute(query, (json.dumps([*self._new]),)).fetchone()
        return connection is self._connection and found == len(self._new)


def bytes_of_topics(connection: sqlite3.Connection) -> dict[int, float]:
    """Returns how many bytes the parts of each topic take, dropped columns included."""
    return dict(connection.execute("SELECT topic, total(bytes) FROM part GROUP BY topic"))


def thin_parts(
    connection: sqlite3.Connection,
    parts: Sequence[int],
    usual: Mapping[int, float],
    share: int,
    spare: int | None = None,
) -> int:
    """Drops the columns of the largest topics of some parts; returns how many bytes they took.

    The largest topics in the whole store are dropped first: else each topic would lack its columns
    in some parts.

    Args:
        connection: to the store.
        parts: their numbers.
        usual: as `bytes_of_topics`.
        share: how many bytes the parts may take in any case.
        spare: how many bytes they may take more than now (if negative, less), where that is more.
    """
    sizes: dict[int, dict[int, int]] = defaultdict(dict)
    total = 0
    for part, topic, size in connection.execute(
        "SELECT id, topic, bytes FROM part WHERE id IN (SELECT value FROM json_each(?))"
        " AND dropped = ''",
        (json.dumps(parts),),
    ):
        sizes[topic][part] = size
        total += size
    left = share if spare is None else max(share, total + spare)
    dropped = 0
    for topic in sorted(sizes, key=lambda topic: usual[topic]):
        left -= sum(sizes[topic].values())
        if left >= 0:
            continue
        for part, size in sizes[topic].items():
            if _drop_columns(connection, topic, part):
                dropped += size
    return dropped


def _drop_columns(connection: sqlite3.Connection, topic: int, part: int) -> bool:
    """Drops the columns of a part, but for times, hashes and zones; returns whether it had any."""
    rows = connection.execute(
        "SELECT path FROM part_column WHERE part = ? AND (length(data) > 0 OR same NOT NULL)",
        (part,),
    )
    paths = [path for (path,) in rows if path not in _NEVER_DROPPED]
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
    _note_deletion(connection)  # so that what is remembered of the part is read again
    return True


def _note_deletion(connection: sqlite3.Connection) -> None:
    """Replaces the one row of `deletion` by a new one, whose number tells that rows changed."""
    connection.execute("DELETE FROM deletion")
    connection.execute("INSERT INTO deletion DEFAULT VALUES")


def _pieces_of(table: Table, *, by_hour: bool) -> Iterator[Table]:
    """Yields a table in pieces of about `_MOST_ROWS`, and of one hour each if `by_hour`.

    Rows of one log time stay together.
    """
    times = table.log_times
    edges = np.searchsorted(times, times[_MOST_ROWS::_MOST_ROWS])
    if by_hour:
        edges = np.append(edges, run_starts(times // PART_NS))
    edges = np.unique(edges)
    if not edges.any():
        yield table
        return
    for rows in np.split(np.arange(len(table)), edges[edges > 0]):
        yield table.rows(rows)


def _messages_of(bag: BagFile) -> int:
    return sum(topic.count for topic in bag.summary.topics)


def _insert_bag(connection: sqlite3.Connection, to_store: ReadBag) -> int:
    """Inserts a bag as an unfinished one; returns its id."""
    bag = to_store.bag
    summary = _find_or_insert(connection, "summary", topics=bag.summary.schema.to_json())
    return _insert(
        connection,
        "bag",
        **to_store.key._replace(size=-1)._asdict(),
        messages=_messages_of(bag),
        hashed=to_store.hashed,
        definitions="",
        summary=summary,
        counts=bag.summary.data,
    )


def _insert_part(
    connection: sqlite3.Connection, topic: int, table: Table, bags: IntArray, level: Level
) -> int:
    """Inserts the rows of a table as a part; returns its id.

    Args:
        connection: to the store.
        topic: the id of the topic.
        table: the rows.
        bags: the id of each row's bag.
        level: of the part.
    """
    columns = _packed_columns(table, bags)
    path_of: dict[bytes, str] = {}  # equal data is stored once
    for path, packed in columns.items():
        path_of.setdefault(packed.data, path)
    number = _insert(
        connection,
        "part",
        topic=topic,
        first_ns=int(table.log_times[0]),
        last_ns=int(table.log_times[-1]),
        messages=len(table),
        bags=json.dumps(np.unique(bags).tolist()),
        dropped="",
        bytes=sum(map(len, path_of)),
        level=level,
    )
    for path, packed in columns.items():
        least, greatest, nulls, words = packed.zone
        zone = (_bound(least), _bound(greatest), nulls, words)
        connection.execute(
            "INSERT INTO zone (topic, path, part, codec, count, error, least, greatest, nulls,"
            " words) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
            (topic, path, number, packed.codec, packed.count, packed.error, *zone),
        )
        # Numbers that are all rounded to one take no bytes, but are no constant.
        if packed.data or packed.codec.split()[-1] not in {"constant", ZONE_ALONE}:
            first = path_of[packed.data] if packed.data else path
            same, data = (None, packed.data) if first == path else (first, None)
            connection.execute(
                "INSERT INTO part_column (part, path, same, data) VALUES (?, ?, ?, ?)",
                (number, path, same, data),
            )
    return number


def _bound(number: float | None) -> float | str | None:
    """Returns a bound of a zone for SQLite: a uint64 beyond its integers as text."""
    if number is None or type(number) is float:
        return number
    return str(number) if number > _MOST_INTEGER else number


def zone_of(
    least: float | str | None, greatest: float | str | None, nulls: int, words: str | None
) -> Zone:
    """Returns the zone that has these values in the table `zone`."""
    least = int(least) if isinstance(least, str) else least
    greatest = int(greatest) if isinstance(greatest, str) else greatest
    return Zone(least, greatest, nulls, words)


def _topic_of(connection: sqlite3.Connection, table: Table) -> int:
    """Returns the id of a table's topic, which is inserted if it is new."""
    channel, schema = table.channel, table.channel.schema
    definition = _find_or_insert(
        connection, "definition", type=schema.name, encoding=schema.encoding, text=schema.text
    )
    return _find_or_insert(
        connection,
        "topic",
        name=channel.topic,
        encoding=channel.encoding,
        latched=channel.latched,
        definition=definition,
        layout=Layout.of(table).to_json(),
    )


def _find_or_insert(connection: sqlite3.Connection, table: str, **values: str | bytes | int) -> int:
    """Returns the id of the row with these values, which is inserted if there is none."""
    given = tuple(values.values())
    where = " AND ".join(f"{name} = ?" for name in values)
    row = connection.execute(f"SELECT id FROM {table} WHERE {where}", given).fetchone()
    if row is not None:
        return int(row[0])
    return _insert(connection, table, **values)


def _insert(connection: sqlite3.Connection, table: str, **values: str | bytes | int) -> int:
    """Inserts a row; returns its id."""
    names, marks = ", ".join(values), ", ".join("?" * len(values))
    query = f"INSERT INTO {table} ({names}) VALUES ({marks}) RETURNING id"
    [(number,)] = connection.execute(query, tuple(values.values()))
    return int(number)


def delete_bags(connection: sqlite3.Connection, paths: Sequence[str]) -> None:
    """Deletes bags, and the parts whose bags are all deleted."""
    deleted = connection.execute(
        "DELETE FROM bag WHERE path IN (SELECT value FROM json_each(?)) RETURNING id",
        (json.dumps(paths),),
    ).fetchall()
    if not deleted:
        return
    parts_of_topic: dict[int, list[int]] = defaultdict(list)
    for part, topic in connection.execute(
        "SELECT id, topic FROM part WHERE NOT EXISTS"
        " (SELECT 1 FROM json_each(part.bags) JOIN bag ON bag.id = value)"
    ):
        parts_of_topic[topic].append(part)
    for topic, parts in parts_of_topic.items():
        _delete_zones(connection, topic, parts)
        ids = [(part,) for part in parts]
        connection.executemany(
            "DELETE FROM fragment WHERE id IN (SELECT fragment FROM fragment_part WHERE part = ?)",
            ids,
        )
        connection.executemany("DELETE FROM part_column WHERE part = ?", ids)
        connection.executemany("DELETE FROM part WHERE id = ?", ids)
    connection.execute("DELETE FROM fragment_part WHERE fragment NOT IN (SELECT id FROM fragment)")
    _note_deletion(connection)


def _delete_zones(connection: sqlite3.Connection, topic: int, parts: Sequence[int]) -> None:
    """Deletes the zones of some parts of a topic.

    The table is ordered by topic, path and part. So the paths of the topic are listed first, one by
    one; to delete by part alone would read all zones of the topic.
    """
    connection.execute(
        "WITH RECURSIVE known (path) AS (SELECT min(path) FROM zone WHERE topic = :topic"
        " UNION ALL SELECT (SELECT min(path) FROM zone WHERE topic = :topic"
        " AND path > known.path) FROM known WHERE known.path IS NOT NULL)"
        " DELETE FROM zone WHERE topic = :topic AND path IN (SELECT path FROM known)"
        " AND part IN (SELECT value FROM json_each(:parts))",
        {"topic": topic, "parts": json.dumps(parts)},
    )
