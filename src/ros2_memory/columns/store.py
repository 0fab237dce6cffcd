"""The columns of closed bags in one SQLite file that outlives the process.

Everything here is derived: deleting the file changes no answer, only how long it takes. A bag is
stored whole or not at all, as parts for each topic (`part`), column by column (`part_column`). Once
the ten minutes that it begins in are over, and then the hour, larger parts take their place: they
have the rows of all bags of its recording that begin there. What is known of a column without
unpacking it lies apart from the parts (`zone`), next to that of the same column in the other parts:
a search reads it at once. A part names the bags that it has rows of: rows of a bag that is not in
`bag` any more do not count. What follows from whole parts, as the path of the poses in them, is
stored with them (`fragment`).

A bag is known by its path below the bag directory, its size and mtime, and the mtime of the sidecar
that says which of its messages count. Its number is never used twice.
"""

from __future__ import annotations

import json
import os
from functools import partial
from itertools import accumulate, islice, pairwise
from sys import intern
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias, TypeVar

import numpy as np

from ros2_memory.columns.database import Database
from ros2_memory.columns.pack import Packed
from ros2_memory.columns.stored import Layout, Topic
from ros2_memory.columns.writing import (
    BELOW,
    UNUSED_SUMMARIES,
    Layouts,
    Level,
    LongBag,
    ReadBag,
    bytes_of_topics,
    delete_bags,
    insert_bags,
    thin_parts,
    zone_of,
)
from ros2_memory.core.bag_summary import BagSummary, SummarySchema
from ros2_memory.core.model import BagFile, BagState
from ros2_memory.core.timebase import MIN_NS, Ns
from ros2_memory.index.bag_rows import BagRows
from ros2_memory.index.timeline import SEGMENT_BAGS
from ros2_memory.storage.base import Channel, Definition, IntArray, Schema

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.columns.fragments import FragmentKey
    from ros2_memory.columns.table import Table

FILE: Final = "columns.sqlite"
LONG_NS: Final[Ns] = 2 * Level.TEN_MINUTES.length
"""A bag that lasts longer becomes parts of an hour at once."""

_FEW: Final = 2048
"""Bags that are looked up one by one; for more of them all stored ones are read."""

T = TypeVar("T")
DefinitionOf: TypeAlias = "Callable[[Channel], Definition | None]"
Key: TypeAlias = "tuple[str, int, Ns, Ns, Ns, Ns]"
"""A `BagKey`, of which a week has 60,000, as SQLite returns it."""


class BagKey(NamedTuple):
    """Identifies the bytes of a bag: a file below the bag directory, as `stat` showed it.

    And its first and last log time: another file may have been given the size and mtime of it.
    """

    path: str
    size: int
    mtime_ns: Ns
    sidecar_ns: Ns
    first_ns: Ns
    last_ns: Ns

    @classmethod
    def of(cls, bag: BagFile, bag_dir: Path) -> BagKey:
        """Returns the key of a bag of the index."""
        path, *rest = bag.identity
        return cls(relative(path, str(bag_dir)), *rest)


def relative(path: str, bag_dir: str) -> str:
    """Returns a file's path below the bag directory, so that this can be moved.

    A file elsewhere keeps its whole path. Takes strings: `pathlib` is slow for 60,000 files.
    """
    inner = path.removeprefix(f"{bag_dir.rstrip(os.sep)}{os.sep}")
    # SQLite stores text as UTF-8, which the bytes of a file name need not be.
    return inner if inner.isascii() else inner.encode("utf-8", "backslashreplace").decode()


_KEY: Final = ", ".join(BagKey._fields)
_ROW: Final = "2 * id + (hashed > 0)"
"""A bag in one number, of which a week is read."""


class State(NamedTuple):
    """What changes with every change of the store.

    Attributes:
        part: the newest part.
        deletion: the newest deletion: while it is the same, what was stored is stored.
        change: the newest change, of this connection.
        others: likewise, of other connections.
    """

    part: int
    deletion: int
    change: int
    others: int


class Written(NamedTuple):
    """How many bags are stored, and the numbers of the parts that were made of them."""

    bags: int
    parts: Sequence[int]


class PartHead(NamedTuple):
    """What is known of a part without reading a column.

    Attributes:
        number: of the part.
        topic: of its topic.
        first: the earliest log time (ns), inclusive.
        last: the latest, inclusive.
        bags: the numbers of the bags that its rows are of, ascending.
        messages: how many rows it has.
        dropped: the paths of its columns that were dropped, as the bags' share was used up.
        is_whole: whether it has all bags of its recording that begin in its slot of the clock.
    """

    number: int
    topic: int
    first: Ns
    last: Ns
    bags: IntArray
    messages: int
    dropped: tuple[str, ...]
    is_whole: bool


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
        super().__init__(paths, sources=sources, waits_for=waits_for)
        self._definition_of = definition_of
        self._definitions = definitions
        self._topics: dict[int, Topic] = {}
        self._layouts = Layouts()

    # Reading

    def state(self) -> State:
        """Returns what tells whether anything has changed."""

        def ask(connection: sqlite3.Connection) -> State:
            [part] = connection.execute("SELECT max(id) FROM part").fetchone()
            [others] = connection.execute("PRAGMA data_version").fetchone()
            newest = self.offset + int(part or 0)
            return State(newest, self._deletion(connection), connection.total_changes, others)

        return self.read(ask, State(-1, -1, -1, -1))

    def known_bags(self, bag_dir: Path) -> list[BagRows]:
        """Returns the bags that are stored, as they were indexed, in order of time."""

        def ask(connection: sqlite3.Connection) -> list[BagRows]:
            schemas = {
                number: SummarySchema.from_json(topics)
                for number, topics in connection.execute("SELECT id, topics FROM summary")
            }
            rows = connection.execute(
                "SELECT path, size, mtime_ns, summary, counts, first_ns, last_ns, sidecar_ns,"
                f" iif(definitions IN ('', ?), {_ROW}, -1) FROM bag WHERE size >= 0"
                " ORDER BY first_ns, last_ns, path",
                (self._definitions,),
            )
            root, closed, summary_of = f"{bag_dir}{os.sep}", BagState.CLOSED, BagSummary.decoded
            deletion, parts = self._deletion(connection), list[BagRows]()
            while some := rows.fetchmany(SEGMENT_BAGS):
                bags = (
                    BagFile(
                        root + path, size, mtime, closed, summary_of(schemas[schema], counts), *span
                    )
                    for path, size, mtime, schema, counts, *span, _ in some
                )
                parts.append(BagRows(bags, (deletion, np.array([row[-1] for row in some]))))
            return parts

        return self.read(ask, [])

    def _deletion(self, connection: sqlite3.Connection) -> int:
        [number] = connection.execute("SELECT max(id) FROM deletion").fetchone()
        return self.offset + int(number or 0)

    def rows_of(self, parts: Sequence[BagRows], bag_dir: str, deletion: int) -> Iterator[IntArray]:
        """Yields twice the number less the `offset` of each bag; -1 where it is not stored.

        One more where copies of its messages can be recognised. `deletion` is that of the `state`
        of the moment: what was loaded with it is taken over once.
        """
        loaded = [bags.take_store_rows(deletion) for bags in parts]
        keys = [
            (relative(file, bag_dir), *stamps)
            for bags, rows in zip(parts, loaded, strict=True)
            if rows is None
            for file, stamps in zip(bags.files(), bags.stamps.tolist(), strict=True)
        ]
        stored: dict[Key, int] = {}
        if keys:
            query = f"SELECT {_ROW}, {_KEY} FROM bag WHERE definitions IN ('', ?)"
            given = [self._definitions]
            if len(keys) <= _FEW:
                query += " AND path IN (SELECT value FROM json_each(?))"
                given.append(json.dumps([path for path, *_ in keys]))
            stored = self._asked(
                lambda read: {row[1:]: row[0] for row in read}, stored, query, *given
            )
        asked = iter([stored.get(key, -1) for key in keys])
        for bags, rows in zip(parts, loaded, strict=True):
            yield np.fromiter(islice(asked, len(bags)), np.int64) if rows is None else rows

    def numbers(self) -> IntArray:
        """Returns the numbers of all bags that are stored, or were in part."""
        none: list[int] = []
        ids = self._asked(lambda rows: [row for (row,) in rows], none, "SELECT id FROM bag")
        return np.array(ids, np.int64) + self.offset

    def below(self, level: Level) -> frozenset[int]:
        """Returns the numbers of the bags that have parts below a level."""
        return self._asked(
            lambda rows: frozenset(self.offset + row for (row,) in rows), frozenset(), BELOW, level
        )

    def dropped(self) -> dict[str, Ns]:
        """Returns the topics of which columns were dropped, with the log time (ns) of the first."""
        query = (
            "SELECT name, min(first_ns) FROM part JOIN topic ON topic.id = part.topic"
            " WHERE dropped <> '' GROUP BY name ORDER BY name"
        )
        return self._asked(dict, {}, query)

    def oldest(self) -> Ns | None:
        """Returns the earliest log time (ns) of any bag; None without one."""
        query, none = "SELECT min(first_ns) FROM bag", list[tuple[Ns | None]]()
        return next((first for (first,) in self._asked(list, none, query)), None)

    def beginning_before(self, before: Ns) -> list[BagKey]:
        """Returns the bags whose first message is earlier than a log time (ns)."""
        query = f"SELECT {_KEY} FROM bag WHERE first_ns < ?"
        return self._asked(lambda rows: [*map(BagKey._make, rows)], [], query, before)

    def paths(self) -> list[str]:
        """Returns the paths of all bags, also of those that are stored in part."""
        return self._asked(lambda rows: [path for (path,) in rows], [], "SELECT path FROM bag")

    def topics(self) -> dict[int, Topic]:
        """Returns all topics that were ever stored, by their numbers."""

        def ask(connection: sqlite3.Connection) -> dict[int, Topic]:
            topics = {
                topic_number: topic
                for topic_number, topic in self._topics.items()
                if self.is_current(topic_number)
            }
            rows = connection.execute(
                "SELECT topic.id, name, topic.encoding, latched, layout, type,"
                " definition.encoding, text"
                " FROM topic JOIN definition ON definition.id = definition WHERE topic.id > ?",
                (max(topics, default=self.offset) - self.offset,),
            )
            for number, name, encoding, latched, layout, *schema in rows:
                channel = Channel(name, encoding, Schema(*schema), bool(latched))
                topic = Topic(channel, Layout.from_json(layout), self._definition_of)
                topics[self.offset + number] = topic
            self._topics = topics
            return topics

        return self.read(ask, {})

    def topic(self, number: int) -> Topic | None:
        """Returns a topic by its number; None where there is none."""
        return self._topics.get(number) or self.topics().get(number)

    def parts(self, topic: str, after: int = 0) -> list[PartHead]:
        """Returns the parts of a topic, of all its types, that are newer than a part."""

        def ask(connection: sqlite3.Connection) -> list[PartHead]:
            rows = connection.execute(
                "SELECT bags, id, topic, first_ns, last_ns, messages, dropped, level FROM part"
                " WHERE topic IN (SELECT id FROM topic WHERE name = ?)"
                " AND id > ? ORDER BY first_ns, id",
                (topic, max(after - self.offset, 0)),
            ).fetchall()
            # Thousands of small arrays would keep other memory from going back: one has all.
            texts = [bags[1:-1] for bags, *_ in rows]
            all_bags = np.fromstring(",".join(texts), np.int64, sep=",") + self.offset
            ends = accumulate((text.count(",") + 1 for text in texts), initial=0)
            bags_of_parts = [all_bags[begin:end] for begin, end in pairwise(ends)]
            return [
                PartHead(
                    self.offset + number,
                    self.offset + topic_number,
                    first,
                    last,
                    numbers,
                    messages,
                    tuple(json.loads(dropped)) if dropped else (),
                    level > Level.BAG,
                )
                for numbers, (
                    _,
                    number,
                    topic_number,
                    first,
                    last,
                    messages,
                    dropped,
                    level,
                ) in zip(bags_of_parts, rows, strict=True)
            ]

        return self.read(ask, [])

    def zones(self, topic: int, path: str, parts: range) -> dict[int, Packed]:
        """Returns what is known of a column in parts of a topic with these numbers.

        By the numbers, which ascend; without values.
        """

        def ask(connection: sqlite3.Connection) -> dict[int, Packed]:
            rows = connection.execute(
                "SELECT part, codec, count, error, least, greatest, nulls, words FROM zone"
                " WHERE topic = ? AND path = ? AND part >= ? AND part < ? ORDER BY part",
                (topic - self.offset, path, parts.start - self.offset, parts.stop - self.offset),
            )
            return {
                part + self.offset: Packed(intern(codec), count, error, zone_of(*zone), b"")
                for part, codec, count, error, *zone in rows
            }

        return self.read(ask, {})

    def part_data(self, part: int, path: str) -> bytes | None:
        """Returns the compressed bytes of a column; None where its part was deleted."""
        query = (
            "SELECT coalesce(own.data, other.data) FROM part_column AS own"
            " LEFT JOIN part_column AS other ON other.part = own.part AND other.path = own.same"
            " WHERE own.part = ? AND own.path = ?"
        )
        none: bytes | None = None
        return self._asked(
            lambda rows: next((data for (data,) in rows), None),
            none,
            query,
            *(part - self.offset, path),
        )

    def fragments(
        self, kind: str, key: FragmentKey, also_before: Ns = 0
    ) -> list[tuple[FragmentKey, bytes]]:
        """Returns a fragment of a kind, if it is stored, and those that begin so long before it.

        They are of the same settings, the newest first.
        """
        key_parts = self._ids(key.parts)
        return self._asked(
            lambda rows: [
                (key._replace(start=start, parts=self._numbers_of(parts)), data)
                for start, parts, data in rows
                if start < key.start or parts == key_parts
            ],
            [],
            "SELECT start_ns, parts, data FROM fragment"
            " WHERE kind = ? AND settings = ? AND start_ns BETWEEN ? AND ? ORDER BY start_ns DESC",
            *(kind, key.settings, max(key.start - also_before, MIN_NS), key.start),
        )

    def fragments_of_others(self, reading: str) -> list[Ns]:
        """Returns where slices begin whose fragments all depend on other settings, newest first.

        `reading` ends the name of a kind that depends on these; nothing does of one that depends
        on none.
        """
        query = (
            "SELECT DISTINCT start_ns FROM (SELECT start_ns FROM fragment"
            " WHERE kind NOT LIKE '% '"
            " GROUP BY substr(kind, 1, instr(kind, ' ')), start_ns"
            " HAVING max(substr(kind, instr(kind, ' ') + 1) = ?) = 0)"
            " ORDER BY start_ns DESC"
        )
        return self._asked(lambda rows: [start for (start,) in rows], [], query, reading)

    def listings(self) -> dict[str, str]:
        """Returns what each `metadata.yaml` lists, by its folder's path as in a `BagKey`."""
        return self._asked(dict, {}, "SELECT folder, listed FROM listing")

    def _asked(
        self, make: Callable[[sqlite3.Cursor], T], unknown: T, query: str, *given: str | int
    ) -> T:
        """Returns what is made of the rows of a query; `unknown` where the file cannot be read."""
        return self.read(lambda connection: make(connection.execute(query, given)), unknown)

    def _ids(self, parts: Iterable[int]) -> str:
        return json.dumps([part - self.offset for part in parts])

    def _numbers_of(self, ids: str) -> tuple[int, ...]:
        return tuple(number + self.offset for number in json.loads(ids))

    # Writing

    def put_fragments(self, kind: str, fragments: Sequence[tuple[FragmentKey, bytes]]) -> bool:
        """Stores fragments in place of those of the same time, settings and some of the parts.

        Not those of a part that is not stored any more. What was stored of the same parts may be
        damaged, so others take its place, too.
        """

        def write(connection: sqlite3.Connection) -> None:
            for key, data in fragments:
                if all(map(self.is_current, key.parts)):
                    identity = (kind, key.settings, key.start)
                    _insert_fragment(connection, identity, self._ids(key.parts), data)

        return self.write(write)

    def put_listings(self, listings: dict[str, str]) -> bool:
        """Replaces all that `listings` returns; returns whether the file has them then."""

        def write(connection: sqlite3.Connection) -> None:
            connection.execute("DELETE FROM listing")
            connection.executemany("INSERT INTO listing VALUES (?, ?)", listings.items())

        if self.listings() == listings:
            return True
        return self.write(write)

    def put(self, bags: Sequence[ReadBag], tables: Sequence[Table], level: Level) -> Written:
        """Stores bags of one recording in the same parts, in place of what they were stored with.

        One with parts of this level stays as it is: another program has stored it. One that
        changed meanwhile is left out.

        Args:
            bags: those of the tables, by their numbers there.
            tables: with all of their messages.
            level: of the parts.
        """
        written = Written(0, ())

        def write(connection: sqlite3.Connection) -> None:
            nonlocal written
            rows = connection.execute(
                f"SELECT {_KEY}, hashed FROM bag"
                " WHERE definitions IN ('', ?) AND path IN (SELECT value FROM json_each(?))"
                f" AND id NOT IN ({BELOW})",
                (self._definitions, json.dumps([bag.key.path for bag in bags]), level),
            )
            stored = {BagKey(*key): bool(hashed) for *key, hashed in rows}
            missing = {
                number: bag
                for number, bag in enumerate(bags)
                if bag.key not in stored or (bag.hashed and not stored[bag.key])
            }
            new = {number: bag for number, bag in missing.items() if bag.is_current()}
            delete_bags(connection, [bag.key.path for bag in new.values()])
            parts = insert_bags(
                connection, new, tables, self._definitions, self._layouts, level=level
            )
            done = len(bags) - len(missing) + len(new)
            written = Written(done, [self.offset + row for row in parts])

        return written if self.write(write) else Written(0, ())

    def renew(self, key: BagKey, bag: BagFile) -> bool:
        """Keeps what is stored of a bag whose sidecar is another one now; returns whether it did.

        Only if it was stored with as many messages of each topic as it has now.
        """

        def write(connection: sqlite3.Connection) -> bool:
            cursor = connection.execute(
                "UPDATE bag SET sidecar_ns = :sidecar_ns WHERE sidecar_ns <> :sidecar_ns"
                " AND path = :path AND size = :size AND mtime_ns = :mtime_ns AND counts = :counts"
                " AND summary = (SELECT id FROM summary WHERE topics = :topics)",
                {
                    **key._asdict(),
                    "counts": bag.summary.data,
                    "topics": bag.summary.schema.to_json(),
                },
            )
            return cursor.rowcount > 0

        return self.write(write)

    def put_long(
        self, to_store: ReadBag, groups: Iterable[Sequence[Table]], *, budget: int
    ) -> bool:
        """Stores a bag as parts, group by group; returns whether it did.

        A bag that is stored in part is none: it has its key only once the last group is written.
        Its rows go where that is not reached.

        Args:
            to_store: the bag; whether it is current is asked with each group.
            groups: all of its messages, in several goes. What they raise is raised here.
            budget: how many bytes the parts may take.
        """
        long = LongBag(to_store, self._definitions, budget)
        if not self.write(long.begin):
            return False
        is_whole = False
        try:
            goes_on = all(self.write(partial(long.add, tables=tables)) for tables in groups)
            is_whole = goes_on and self.write(long.end)
        finally:
            if not is_whole:
                self.write(long.delete_half)
        return is_whole

    def thin(self, shares: Sequence[tuple[Sequence[int], int]], max_share: float) -> bool:
        """Drops the columns of the largest topics of some parts, beyond what these may take.

        Args:
            shares: the numbers of parts, and how many bytes these may take in any case; more as
                long as all parts take less than their share.
            max_share: of the bytes of all bags.
        """

        def write(connection: sqlite3.Connection) -> None:
            usual = bytes_of_topics(connection)
            stored, taken = _query_merged_bytes(connection)
            for parts, at_least in shares:
                if all(map(self.is_current, parts)):
                    numbers = [part - self.offset for part in parts]
                    spare = round(max_share * stored) - taken
                    taken -= thin_parts(connection, numbers, usual, at_least, spare)

        return not shares or self.write(write)

    def delete(self, paths: Sequence[str]) -> bool:
        """Deletes bags, and the parts and summaries that are of none that is left."""

        def write(connection: sqlite3.Connection) -> None:
            delete_bags(connection, paths)
            # Those that state pauses are of one bag alone.
            connection.execute(UNUSED_SUMMARIES)

        return self.write(write)

    def merged_bytes(self) -> tuple[int, int]:
        """Returns the bytes of the bags that are in whole parts, and those of their columns."""
        return self.read(_query_merged_bytes, (0, 0))

    def used_bytes(self) -> int:
        """Returns the bytes of the file that hold something."""

        def ask(connection: sqlite3.Connection) -> int:
            pages, free, size = (
                int(connection.execute(f"PRAGMA {name}").fetchone()[0])
                for name in ("page_count", "freelist_count", "page_size")
            )
            return (pages - free) * size

        return self.read(ask, 0)


def _insert_fragment(
    connection: sqlite3.Connection, identity: tuple[str, str, Ns], parts: str, data: bytes
) -> None:
    """Stores a fragment if all of its parts are stored, in place of others of some of them.

    Args:
        connection: to the store.
        identity: the fragment's kind, settings and start.
        parts: the numbers of its parts in the file, as JSON.
        data: of the fragment.
    """
    inserted = connection.execute(
        "INSERT INTO fragment (kind, settings, start_ns, parts, data)"
        " SELECT ?, ?, ?, ?, ? WHERE json_array_length(?) ="
        " (SELECT count(*) FROM part WHERE id IN (SELECT value FROM json_each(?)))"
        " ON CONFLICT DO UPDATE SET data = excluded.data"
        " WHERE data <> excluded.data RETURNING id",
        (*identity, parts, data, parts, parts),
    ).fetchall()
    for (number,) in inserted:
        # What followed before there were all of these parts is not asked for again.
        older = connection.execute(
            "DELETE FROM fragment WHERE kind = ? AND settings = ? AND start_ns = ?"
            " AND id <> ? AND id IN (SELECT fragment FROM fragment_part"
            " WHERE part IN (SELECT value FROM json_each(?))) RETURNING id",
            (*identity, number, parts),
        ).fetchall()
        connection.executemany("DELETE FROM fragment_part WHERE fragment = ?", older)
        connection.execute(
            "INSERT OR IGNORE INTO fragment_part SELECT value, ? FROM json_each(?)",
            (number, parts),
        )


def _query_merged_bytes(connection: sqlite3.Connection) -> tuple[int, int]:
    [bags] = connection.execute(
        f"SELECT total(size) FROM bag WHERE size > 0 AND id NOT IN ({BELOW})", (Level.TEN_MINUTES,)
    ).fetchone()
    # With "+" the index on levels is not used: nearly all parts are of these.
    [columns] = connection.execute(
        "SELECT total(bytes) FROM part WHERE +level > 0 AND dropped = ''"
    ).fetchone()
    return int(bags), int(columns)
