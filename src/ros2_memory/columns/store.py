"""The columns of closed bags in one SQLite file that outlives the process.

Everything here is derived: deleting the file changes no answer, only how long it takes.

- A bag is stored whole or not at all, in parts for each topic (`part`), column by column
  (`part_column`). Once the ten minutes that it begins in are over, and then the hour, larger parts
  replace them. They have the rows of all bags of the recording that begin in that time.
- A part names the bags that it has rows of. Rows of a bag that is no longer in `bag` do not count.
- The zones of a column in all parts lie next to each other (`zone`), so that a search reads them
  at once, without unpacking any column.
- What is computed from whole parts, such as the path of the poses in them, is stored with them
  (`fragment`).

A bag is identified by its path below the bag directory, its size and mtime, and the mtime of the
sidecar that says which of its messages count. Its number is never used twice.
"""

from __future__ import annotations

import json
import os
from functools import partial
from itertools import chain
from sys import intern
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias, TypeVar

import numpy as np

from ros2_memory.columns.database import Database
from ros2_memory.columns.pack import Packed
from ros2_memory.columns.stored import Layout, Topic
from ros2_memory.columns.writing import (
    BELOW,
    KEY,
    UNUSED_SUMMARIES,
    Level,
    ReadBag,
    Writing,
    bytes_of_topics,
    delete_bags,
    thin_parts,
    zone_of,
)
from ros2_memory.core.bag_summary import BagSummary, SummarySchema
from ros2_memory.core.model import BagFile, BagState
from ros2_memory.core.timebase import MIN_NS, Ns
from ros2_memory.index.bag_rows import BagRows
from ros2_memory.index.timeline import SEGMENT_BAGS
from ros2_memory.storage.base import Channel, Definition, IntArray, Mask, Schema

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
"""Bags that are looked up by their paths; for more of them all stored ones are read."""

T = TypeVar("T")
DefinitionOf: TypeAlias = "Callable[[Channel], Definition | None]"
Key: TypeAlias = "tuple[str, int, Ns, Ns, Ns, Ns]"
"""A `BagKey`, of which a week has 60,000, as SQLite returns it."""


class BagKey(NamedTuple):
    """Identifies the bytes of a bag.

    The file is known by its path below the bag directory and by what `stat` says; the first and
    last log time tell it from another file that was given the same size and mtime.
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


_CODE: Final = "2 * id + (hashed > 0)"
"""A stored bag as one number, since the bags of a week are read; -1 stands for one not stored."""


class StoredBags(NamedTuple):
    """How some bags are stored.

    Attributes:
        numbers: of the bags; -1 for those that are not stored.
        hashed: whether copies of a bag's messages can be recognised.
    """

    numbers: IntArray
    hashed: Mask


class State(NamedTuple):
    """Tells whether the store has changed: then one of these numbers has.

    Attributes:
        part: the newest part.
        deletion: the newest deletion; while it is the same, no stored bag was deleted.
        change: the newest change by this connection.
        others: the newest change by other connections.
    """

    part: int
    deletion: int
    change: int
    others: int


class Written(NamedTuple):
    """What `ColumnStore.put` stored.

    Attributes:
        bags: how many bags are stored.
        parts: the numbers of their new parts.
    """

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
        dropped: the paths of its columns that were dropped, since the bags' share was used up.
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


def _keys_of(group: BagRows, bag_dir: str) -> list[Key]:
    return [
        (relative(file, bag_dir), *stamps)
        for file, stamps in zip(group.files(), group.stamps.tolist(), strict=True)
    ]


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

    # Reading

    def state(self) -> State:
        """Returns the state of now."""

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
                f" iif(definitions IN ('', ?), {_CODE}, -1) FROM bag WHERE size >= 0"
                " ORDER BY first_ns, last_ns, path",
                (self._definitions,),
            )
            root, deletion = f"{bag_dir}{os.sep}", self._deletion(connection)
            groups: list[BagRows] = []
            while chunk := rows.fetchmany(SEGMENT_BAGS):
                bags: list[BagFile] = []
                codes: list[int] = []
                for path, size, mtime, schema, counts, first, last, sidecar, code in chunk:
                    summary = BagSummary(schemas[schema], counts)
                    span = (first, last, sidecar)
                    bags.append(BagFile(root + path, size, mtime, BagState.CLOSED, summary, *span))
                    codes.append(code)
                groups.append(BagRows(bags, (deletion, np.array(codes))))
            return groups

        return self.read(ask, [])

    def _deletion(self, connection: sqlite3.Connection) -> int:
        [number] = connection.execute("SELECT max(id) FROM deletion").fetchone()
        return self.offset + int(number or 0)

    def stored_bags(
        self, groups: Sequence[BagRows], bag_dir: str, deletion: int
    ) -> Iterator[StoredBags]:
        """Yields how the bags of each group are stored.

        Args:
            groups: the bags.
            bag_dir: the bag directory.
            deletion: that of the present `state`; what was loaded at it is still true.
        """
        loaded = [group.take_store_rows(deletion) for group in groups]
        keys_of_groups = [
            _keys_of(group, bag_dir) if codes is None else []
            for group, codes in zip(groups, loaded, strict=True)
        ]
        asked = [*chain.from_iterable(keys_of_groups)]
        code_of = self._codes_of(asked) if asked else {}
        for known, keys in zip(loaded, keys_of_groups, strict=True):
            codes = known
            if codes is None:
                codes = np.array([code_of.get(key, -1) for key in keys], np.int64)
            is_stored = codes >= 0
            numbers = np.where(is_stored, (codes >> 1) + self.offset, -1)
            yield StoredBags(numbers, is_stored & (codes & 1 > 0))

    def _codes_of(self, keys: Sequence[Key]) -> dict[Key, int]:
        """Returns the codes of the bags that are stored; of others too if many are asked for."""
        query = f"SELECT {_CODE}, {KEY} FROM bag WHERE definitions IN ('', ?)"
        given = [self._definitions]
        if len(keys) <= _FEW:
            query += " AND path IN (SELECT value FROM json_each(?))"
            given.append(json.dumps([path for path, *_ in keys]))
        none: dict[Key, int] = {}
        return self._select(
            lambda rows: {tuple(key): code for code, *key in rows}, none, query, *given
        )

    def numbers(self) -> IntArray:
        """Returns the numbers of all bags, unfinished ones included."""
        return (
            np.array(self._select_column(list[int](), "SELECT id FROM bag"), np.int64) + self.offset
        )

    def below(self, level: Level) -> frozenset[int]:
        """Returns the numbers of the bags that have parts below a level."""
        return frozenset(
            self.offset + bag for bag in self._select_column(list[int](), BELOW, level)
        )

    def dropped(self) -> dict[str, Ns]:
        """Returns the topics with dropped columns, and the earliest log time (ns) of these."""
        query = (
            "SELECT name, min(first_ns) FROM part JOIN topic ON topic.id = part.topic"
            " WHERE dropped <> '' GROUP BY name ORDER BY name"
        )
        return self._select(dict, {}, query)

    def oldest(self) -> Ns | None:
        """Returns the earliest log time (ns) of any bag; None without one."""
        return next(
            iter(self._select_column(list[Ns | None](), "SELECT min(first_ns) FROM bag")), None
        )

    def beginning_before(self, before: Ns) -> list[BagKey]:
        """Returns the bags whose first message is earlier than a log time (ns)."""
        query = f"SELECT {KEY} FROM bag WHERE first_ns < ?"
        return self._select(lambda rows: [*map(BagKey._make, rows)], [], query, before)

    def paths(self) -> list[str]:
        """Returns the paths of all bags, unfinished ones included."""
        return self._select_column([], "SELECT path FROM bag")

    def topics(self) -> dict[int, Topic]:
        """Returns all topics that were ever stored, by their numbers."""

        def ask(connection: sqlite3.Connection) -> dict[int, Topic]:
            topics = {
                number: topic for number, topic in self._topics.items() if self.is_current(number)
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
        """Returns the parts of a topic, of all its types, that are newer than part `after`."""

        def ask(connection: sqlite3.Connection) -> list[PartHead]:
            rows = connection.execute(
                "SELECT id, topic, first_ns, last_ns, bags, messages, dropped, level FROM part"
                " WHERE topic IN (SELECT id FROM topic WHERE name = ?)"
                " AND id > ? ORDER BY first_ns, id",
                (topic, max(after - self.offset, 0)),
            ).fetchall()
            # One array for all: thousands of small ones would fragment the memory.
            texts = [bags[1:-1] for *_, bags, _, _, _ in rows]
            all_bags = np.fromstring(",".join(texts), np.int64, sep=",") + self.offset
            heads: list[PartHead] = []
            begin = 0
            for number, topic_id, first, last, bags, messages, dropped, level in rows:
                end = begin + bags.count(",") + 1
                head = PartHead(
                    self.offset + number,
                    self.offset + topic_id,
                    first,
                    last,
                    all_bags[begin:end],
                    messages,
                    tuple(json.loads(dropped)) if dropped else (),
                    level > Level.BAG,
                )
                heads.append(head)
                begin = end
            return heads

        return self.read(ask, [])

    def zones(self, topic: int, path: str, parts: range) -> dict[int, Packed]:
        """Returns the zones of a column of a topic, without its data, by the numbers of the parts.

        Args:
            topic: the number of the topic.
            path: of the column.
            parts: the numbers to look for; those that are found ascend.
        """

        def ask(connection: sqlite3.Connection) -> dict[int, Packed]:
            rows = connection.execute(
                "SELECT part, codec, count, error, least, greatest, nulls, words FROM zone"
                " WHERE topic = ? AND path = ? AND part >= ? AND part < ? ORDER BY part",
                (topic - self.offset, path, parts.start - self.offset, parts.stop - self.offset),
            )
            return {
                part + self.offset: Packed(intern(codec), count, zone_of(*zone), error)
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
        return next(iter(self._select_column(list[bytes](), query, part - self.offset, path)), None)

    def fragments(
        self, kind: str, key: FragmentKey, also_before: Ns = 0
    ) -> list[tuple[FragmentKey, bytes]]:
        """Returns a stored fragment, and those of its kind and settings that begin before it.

        Args:
            kind: of the fragments.
            key: of the fragment.
            also_before: how long (ns) before it the others begin at most.

        Returns:
            The newest first.
        """
        key_parts = self._ids(key.parts)
        return self._select(
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
        """Returns the log times (ns) at which only fragments of other settings begin.

        Args:
            reading: the present settings, with which names of kinds end. Kinds whose names end
                with nothing do not depend on settings.

        Returns:
            The newest first.
        """
        query = (
            "SELECT DISTINCT start_ns FROM (SELECT start_ns FROM fragment"
            " WHERE kind NOT LIKE '% '"
            " GROUP BY substr(kind, 1, instr(kind, ' ')), start_ns"
            " HAVING max(substr(kind, instr(kind, ' ') + 1) = ?) = 0)"
            " ORDER BY start_ns DESC"
        )
        return self._select_column([], query, reading)

    def listings(self) -> dict[str, str]:
        """Returns what each `metadata.yaml` lists, by its folder's path as in a `BagKey`."""
        return self._select(dict, {}, "SELECT folder, listed FROM listing")

    def _select(
        self, make: Callable[[sqlite3.Cursor], T], unknown: T, query: str, *given: str | int
    ) -> T:
        """Returns what is made of the rows of a query; `unknown` if the file cannot be read."""
        return self.read(lambda connection: make(connection.execute(query, given)), unknown)

    def _select_column(self, nothing: list[T], query: str, *given: str | int) -> list[T]:
        """Returns the one column of a query; `nothing` if the file cannot be read."""
        return self._select(lambda rows: [value for (value,) in rows], nothing, query, *given)

    def _ids(self, parts: Iterable[int]) -> str:
        return json.dumps([part - self.offset for part in parts])

    def _numbers_of(self, ids: str) -> tuple[int, ...]:
        return tuple(number + self.offset for number in json.loads(ids))

    # Writing

    def put_fragments(self, kind: str, fragments: Sequence[tuple[FragmentKey, bytes]]) -> bool:
        """Stores fragments whose parts are still stored.

        Each replaces the fragments of the same start and settings that share a part with it; the
        one of the same parts, too, since that may be damaged.
        """

        def write(connection: sqlite3.Connection) -> None:
            for key, data in fragments:
                if all(map(self.is_current, key.parts)):
                    identity = (kind, key.settings, key.start)
                    _insert_fragment(connection, identity, self._ids(key.parts), data)

        return self.write(write)

    def put_listings(self, listings: dict[str, str]) -> bool:
        """Replaces all listings; returns whether the file has the new ones now."""

        def write(connection: sqlite3.Connection) -> None:
            connection.execute("DELETE FROM listing")
            connection.executemany(
                "INSERT INTO listing (folder, listed) VALUES (?, ?)", listings.items()
            )

        if self.listings() == listings:
            return True
        return self.write(write)

    def put(self, bags: Sequence[ReadBag], tables: Sequence[Table], level: Level) -> Written:
        """Stores bags of one recording in common parts, which replace their old ones.

        Args:
            bags: the bags; see `Writing`.
            tables: all of their messages.
            level: of the parts.
        """
        writing = Writing(bags, self._definitions, level)

        def write(connection: sqlite3.Connection) -> bool:
            writing.begin(connection)
            return writing.add(connection, tables) and writing.end(connection)

        if not self.write(write):
            return Written(0, ())
        return Written(writing.stored, [self.offset + part for part in writing.parts])

    def renew(self, key: BagKey, bag: BagFile) -> bool:
        """Gives a stored bag the mtime of its new sidecar; returns whether it did.

        It does so only if the bag was stored with as many messages of each topic as it has now.
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

        The bag counts as stored only once the last group is written. If that is not reached, its
        rows are deleted.

        Args:
            to_store: the bag; its `is_current` is called for each group.
            groups: all of its messages; errors of the iterator are raised here.
            budget: how many bytes the parts may take.
        """
        long = Writing([to_store], self._definitions, Level.HOUR, budget)
        if not self.write(long.begin):
            return False
        is_whole = False
        try:
            goes_on = all(self.write(partial(long.add, tables=tables)) for tables in groups)
            is_whole = goes_on and self.write(long.end)
        finally:
            if not is_whole:
                self.write(long.delete_unfinished)
        return is_whole

    def thin(self, shares: Sequence[tuple[Sequence[int], int]], max_share: float) -> bool:
        """Drops the columns of the largest topics of parts that take more than their share.

        Args:
            shares: groups of parts, and how many bytes each group may take in any case. It may take
                more while all parts together take less than `max_share`.
            max_share: of the bytes of all bags.
        """

        def write(connection: sqlite3.Connection) -> None:
            usual = bytes_of_topics(connection)
            stored, taken = _query_merged_bytes(connection)
            for parts, share in shares:
                if all(map(self.is_current, parts)):
                    numbers = [part - self.offset for part in parts]
                    spare = round(max_share * stored) - taken
                    taken -= thin_parts(connection, numbers, usual, share, spare)

        return not shares or self.write(write)

    def delete(self, paths: Sequence[str]) -> bool:
        """Deletes bags, and the parts and summaries that no other bag has."""

        def write(connection: sqlite3.Connection) -> None:
            delete_bags(connection, paths)
            connection.execute(UNUSED_SUMMARIES)

        return self.write(write)

    def merged_bytes(self) -> tuple[int, int]:
        """Returns the bytes of the bags that are in whole parts, and those of their columns."""
        return self.read(_query_merged_bytes, (0, 0))

    def used_bytes(self) -> int:
        """Returns the bytes of the pages in use."""

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
    """Stores a fragment if all of its parts are stored; see `ColumnStore.put_fragments`.

    Args:
        connection: to the store.
        identity: the fragment's kind, settings and start.
        parts: the ids of its parts, as JSON.
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
        # A fragment that was made before all of these parts existed is not asked for again.
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
