"""Reads the `.db3` files of rosbag2: summaries, messages and log times.

Every schema version since 2018 has the tables `topics` and `messages`; newer columns, and message
definitions, are looked up in each file. A hostile file can call an endless query a table, or have
pages that lead back to themselves, and sqlite runs both: `guard` and `require_plain_tables` bound
what it may do. `rosbags` takes 5.5 ms to open a bag, nearly all of it for the YAML of QoS.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import sqlite3
import stat
from collections import Counter
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from itertools import zip_longest
from typing import IO, TYPE_CHECKING, Final

import numpy as np

from ros2_memory.core.bag_summary import READ_WITHOUT_INDEXES
from ros2_memory.core.errors import BagContradictionError, sqlite_code
from ros2_memory.core.large_reads import LARGE_BYTES
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.text import counted
from ros2_memory.core.timebase import MAX_NS, Ns
from ros2_memory.storage.base import (
    Batch,
    Channel,
    Record,
    Schema,
    batched,
)
from ros2_memory.storage.cache import ByteLru, shared, unshared_bytes
from ros2_memory.storage.contents import Tally
from ros2_memory.storage.errors import (
    MANY_TOPICS,
    MAX_CHUNK_MB,
    MAX_DEFINITION_BYTES,
    MAX_NAMES_CHARS,
    MAX_TEXTS_BYTES,
    MAX_TOPICS,
    Lost,
    SizeLimit,
    UnreadableError,
)
from ros2_memory.storage.file_io import EMPTY_FILE, OpenFile, open_regular
from ros2_memory.storage.mcap.records import offered_as_latched
from ros2_memory.storage.zstd_bag import uncompressed_payload
from ros2_memory.typestore import full_name

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.core.bag_summary import BagSummary

JOURNALS: Final = ("-wal", "-journal")
_CACHE_BYTES: Final = 16 << 20
_ROWS: Final = """
    SELECT CASE WHEN typeof(topic_id) = 'integer' THEN topic_id END, timestamp,
        typeof(timestamp) = 'integer' AND typeof(data) = 'blob'
    FROM messages NOT INDEXED ORDER BY rowid LIMIT ?
"""
"""Topic id, log time, and whether the types of a row are those of a message."""
_ROWS_AT_ONCE: Final = 1 << 16
# Without payloads, so that sorting needs no memory for them; they are read row by row.
_ASCENDING: Final = """
    SELECT timestamp, rowid, topic_id FROM messages
    WHERE timestamp >= ? AND timestamp < ? AND topic_id IN (SELECT value FROM json_each(?))
    ORDER BY timestamp, rowid
"""
_DESCENDING: Final = _ASCENDING.replace("timestamp, rowid\n", "timestamp DESC, rowid DESC\n")
_FIRST_ROWS: Final = (
    "FROM (SELECT timestamp, rowid, topic_id FROM messages NOT INDEXED ORDER BY rowid LIMIT {})"
)
_ALL_ROWS: Final = -1
"""As a limit of a query."""
_WRONG_INDEX: Final = f"its index by time is damaged; {READ_WITHOUT_INDEXES}"
_METADATA: Final = (
    ("offered_qos_profiles", "offered_qos_profiles"),
    ("type_description_hash", "topic_type_hash"),
)
"""Columns of the table of topics, and what an MCAP file calls them in a channel's metadata."""
_TOPIC_TEXTS: Final = ("name", "type", "serialization_format", *dict(_METADATA))
_DEFINITION_TEXTS: Final = ("topic_type", "encoding", "encoded_message_definition")
_DEFINITIONS: Final = """
    SELECT topic_type, encoding, substr(encoded_message_definition, 1, ?)
    FROM message_definitions LIMIT ?
"""
_TEXT: Final = partial(str, encoding="utf-8", errors="replace")
"""A name that is not UTF-8 must not hide the others."""
_PAYLOAD: Final = "SELECT data, timestamp, topic_id FROM messages WHERE rowid = ?"


_STEP: Final = 10_000
"""Instructions of the virtual machine of sqlite between two calls of the progress handler."""
_INSTRUCTIONS: Final = 20_000_000
_INSTRUCTIONS_PER_BYTE: Final = 50
"""Instructions that a connection may take, for any file and for each byte of it."""
_TABLES: Final = ("topics", "messages", "message_definitions")
_NOT_TABLES: Final = """
    SELECT name FROM sqlite_master
    WHERE lower(name) IN (SELECT value FROM json_each(?))
    AND (type != 'table' OR rootpage = 0)
"""
_COMPUTED_COLUMNS: Final = "SELECT count(*) FROM pragma_table_xinfo(?) WHERE hidden != 0"


_MESSAGE_COLUMNS: Final = {"topic_id", "timestamp", "data"}


@dataclass(slots=True)
class _Topics:
    """The topics of a file.

    Attributes:
        channels: the channels by topic id.
        is_indexed_right: whether the indexes agree with the table of messages; None if they were
            not compared yet.
        readable: how many rows of the table can be read, if it ends early.
    """

    channels: Mapping[int, Channel]
    is_indexed_right: bool | None = None
    readable: int = _ALL_ROWS

    @property
    def ends_early(self) -> bool:
        """Whether messages are lost; known once the indexes were compared."""
        return self.readable != _ALL_ROWS


class SqliteBags:
    """Reads sqlite3 bag files without a journal or WAL beside them.

    Nothing is written or locked; a connection is opened for each call. Safe to use from several
    threads at once. Exceptions are raised as they come; the adapter translates them
    (`errors.reading`).

    Args:
        limit: up to which a message, or another value of a file, is read.
    """

    def __init__(self, limit: SizeLimit) -> None:
        self._limit = limit
        self._known: ByteLru[_Topics] = ByteLru(_CACHE_BYTES)

    def is_finished(self, path: Path) -> bool:
        """Returns whether the file has content, and no journal or WAL beside it."""
        with OpenFile(path) as file:
            return file.size > 0 and not journals_beside(path)

    def summarize(self, path: Path) -> BagSummary:
        """Returns topics with exact counts and first and last log times."""
        with self._opened(path) as (base, topics):
            is_right = self._is_indexed_right(base, topics)
            tally = Tally()
            without_time = without_topic = 0
            cursor = base.execute(_ROWS, (topics.readable,))
            while rows := cursor.fetchmany(_ROWS_AT_ONCE):
                numbers: list[int] = []
                times: list[Ns] = []
                for number, time, is_message in rows:
                    if not is_message:
                        raise UnreadableError(
                            "damaged: messages without an integer timestamp or a binary payload"
                        )
                    if not 0 <= time < MAX_NS:
                        without_time += 1
                    elif number not in topics.channels:
                        without_topic += 1
                    else:
                        numbers.append(number)
                        times.append(time)
                if numbers:
                    zeros = np.zeros(len(times), np.int64)
                    tally.add(np.array(numbers, np.int64), np.array(times, np.int64), zeros)
        notes = [] if is_right else [_WRONG_INDEX]
        if topics.ends_early:
            notes = [f"damaged: only its first {counted(topics.readable, 'message')} can be read"]
        if without_topic:
            notes.append(f"left out: {counted(without_topic, 'message')} of no topic")
        if without_time:
            reason = "without a possible log time"
            notes.append(f"left out: {counted(without_time, 'message')} {reason}")
        is_complete = not topics.ends_early
        return tally.contents().summary(topics.channels, tuple(notes), complete=is_complete)

    def channels(self, path: Path) -> Sequence[Channel]:
        """Returns the topics declared in the file."""
        with self._opened(path) as (_, topics):
            return list(topics.channels.values())

    def records(
        self, path: Path, topics: Collection[str], window: TimeWindow, *, newest_first: bool
    ) -> Iterator[Record | Lost]:
        """Yields the messages of `topics` inside the window, in order.

        A `Lost` is yielded first if the indexes of the file are wrong; no message is lost with it.
        And one in place of each message that is larger than allowed.
        """
        if window.empty:
            return
        with self._opened(path) as (base, declared):
            wanted = {
                number: channel
                for number, channel in declared.channels.items()
                if channel.topic in topics
            }
            is_right = self._is_indexed_right(base, declared)
            if not is_right and not declared.ends_early:
                yield Lost(_WRONG_INDEX, window.start, window.stop - 1, BagContradictionError)
            for time, row, number in _ordered_rows(
                base, wanted, window, declared.readable, newest_first=newest_first, indexed=is_right
            ):
                try:
                    stored, *stored_key = base.execute(_PAYLOAD, (row,)).fetchone() or (None,)
                except sqlite3.DataError:
                    yield Lost(self._limit.refusal("a message"), time, time)
                    continue
                if not isinstance(stored, bytes):
                    raise UnreadableError("damaged: a message without a binary payload")
                if stored_key != [time, number]:
                    raise UnreadableError("damaged: a message is not the one that an index names")
                if len(stored) > LARGE_BYTES:
                    self._limit.take_turn()
                payload = uncompressed_payload(wanted[number], stored, self._limit)
                yield Record(wanted[number], time, time, payload)

    def batches(
        self, path: Path, topics: Collection[str], window: TimeWindow, bare: Collection[str]
    ) -> Iterator[Batch | Lost]:
        """Yields the messages of `records`, many at once; see `BagReader.batches`."""
        del bare
        if path.stat().st_size > LARGE_BYTES:
            self._limit.take_turn()
        yield from batched(enumerate(self.records(path, topics, window, newest_first=False)))

    def _is_indexed_right(self, base: sqlite3.Connection, topics: _Topics) -> bool:
        """Returns whether the indexes of a file agree with its table; compares them once."""
        if topics.is_indexed_right is None:
            everything = TimeWindow.everything()
            try:
                by_index = _ordered_rows(base, topics.channels, everything, indexed=True)
                by_table = _ordered_rows(base, topics.channels, everything, indexed=False)
                rows = zip_longest(by_index, by_table)
                topics.is_indexed_right = all(indexed == stored for indexed, stored in rows)
            except sqlite3.DatabaseError:
                # An index may be malformed where the table is not.
                topics.is_indexed_right = False
            if not topics.is_indexed_right:
                topics.readable = _readable_rows(base)
        return topics.is_indexed_right

    @contextmanager
    def _opened(self, path: Path) -> Iterator[tuple[sqlite3.Connection, _Topics]]:
        """Yields a connection to a file, and its topics."""
        with OpenFile(path) as file:
            if not file.size:
                raise UnreadableError(EMPTY_FILE)
            key, file_bytes = file.key, file.size
        # Immutable: nothing is locked, and no file appears beside the bag.
        address = f"{path.absolute().as_uri()}?mode=ro&immutable=1"
        # A generator of records may be resumed on another thread.
        with closing(sqlite3.connect(address, uri=True, check_same_thread=False)) as base:
            # SQLite opens by name, and has by now: it must be the file that was opened above.
            if path.lstat().st_ino != key.inode:
                raise UnreadableError("it was replaced while it was being opened")
            base.text_factory = _TEXT
            # Else sqlite reads nothing of a file that was cut short.
            base.execute("PRAGMA writable_schema = ON")
            guard(base, self._limit.max_bytes, file_bytes)
            topics = self._known.get(key)
            if topics is None:
                require_plain_tables(base)
                topics = _Topics(_read_channels(base))
                self._known.put(key, topics, 1000 + unshared_bytes(topics.channels))
            yield base, topics


def _read_channels(base: sqlite3.Connection) -> dict[int, Channel]:
    """Returns the topics of a file as channels, by topic id.

    Raises:
        UnreadableError: it is no bag, or declares more than any robot does.
    """
    columns = _columns(base, "topics")
    if not {"id", "name", "type"} <= columns or not _columns(base, "messages") >= _MESSAGE_COLUMNS:
        raise UnreadableError("not a rosbag2 file: it lacks the tables topics and messages")
    texts = [name for name in _TOPIC_TEXTS if name in columns]
    require_short_texts(base, "topics", texts)
    definitions = _definitions(base)
    # From a list of names above.
    query = f"SELECT id, {', '.join(texts)} FROM topics ORDER BY id LIMIT ?"  # noqa: S608
    channels: dict[int, Channel] = {}
    for number, *values in base.execute(query, (MAX_TOPICS + 1,)):
        row = {name: str(value or "") for name, value in zip(texts, values, strict=True)}
        channel = Channel(
            row["name"],
            # Before the column existed there was one format.
            row.get("serialization_format") or "cdr",
            definitions.get(row["type"], Schema(full_name(row["type"]))),
            offered_as_latched(row.get("offered_qos_profiles", "")),
            tuple((key, row[name]) for name, key in _METADATA if row.get(name)),
        )
        channels[int(number)] = shared(channel)
    if len(channels) > MAX_TOPICS:
        raise UnreadableError(MANY_TOPICS)
    names_chars = sum(len(channel.topic) + len(channel.type) for channel in channels.values())
    if names_chars > MAX_NAMES_CHARS:
        raise UnreadableError("its topics and types have longer names than any can have")
    return channels


def _ordered_rows(
    base: sqlite3.Connection,
    wanted: Collection[int],
    window: TimeWindow,
    readable: int = _ALL_ROWS,
    *,
    newest_first: bool = False,
    indexed: bool,
) -> sqlite3.Cursor:
    """Returns log time, rowid and topic id of messages, in order; by an index if `indexed`."""
    query = _DESCENDING if newest_first else _ASCENDING
    arguments = (max(window.start, 0), window.stop, json.dumps(list(wanted)))
    if not indexed:
        query = query.replace("FROM messages", _FIRST_ROWS.format(readable), 1)
    return base.execute(query, arguments)


def _readable_rows(base: sqlite3.Connection) -> int:
    """Returns how many rows of the table of messages can be read; `_ALL_ROWS` if it is whole.

    Raises:
        sqlite3.DatabaseError: none can be read, or the file is not at fault.
    """
    count = 0
    try:
        for row in base.execute("SELECT rowid FROM messages NOT INDEXED ORDER BY rowid"):
            with suppress(sqlite3.DataError):  # larger than allowed: that one alone is lost
                payload, *_ = base.execute(_PAYLOAD, row).fetchone() or (None,)
                if payload is None:  # the rest of a page that was cut reads as zeros
                    return count
            count += 1
    except sqlite3.DatabaseError as error:
        if not count or sqlite_code(error) != sqlite3.SQLITE_CORRUPT:
            raise
        return count
    return _ALL_ROWS


def _columns(base: sqlite3.Connection, table: str) -> set[str]:
    rows = base.execute("SELECT name FROM pragma_table_info(?)", (table,))
    return {str(name) for (name,) in rows}


def _definitions(base: sqlite3.Connection) -> dict[str, Schema]:
    """Returns the definitions in the file, by type name; none before schema version 4."""
    if not _columns(base, "message_definitions") >= set(_DEFINITION_TEXTS):
        return {}
    require_short_texts(base, "message_definitions", _DEFINITION_TEXTS)
    rows = base.execute(_DEFINITIONS, (MAX_DEFINITION_BYTES + 1, MAX_TOPICS))
    return {
        str(name): Schema(
            full_name(str(name)), str(encoding), str(text).encode()[: MAX_DEFINITION_BYTES + 1]
        )
        for name, encoding, text in rows
        if encoding in {"ros2msg", "ros2idl"}
    }


def journals_beside(path: Path) -> list[Path]:
    """Returns the journal and WAL with content that the file itself lacks.

    A link counts, and is refused when it is opened.
    """
    journals: list[Path] = []
    for suffix in JOURNALS:
        journal = path.with_name(path.name + suffix)
        with suppress(OSError):
            status = journal.lstat()
            if stat.S_ISLNK(status.st_mode) or (stat.S_ISREG(status.st_mode) and status.st_size):
                journals.append(journal)
    return journals


def copy_with_journal(path: Path, folder: Path, reserve: Callable[[int], None]) -> tuple[Path, str]:
    """Returns a copy of the file to which sqlite has applied the journal or WAL beside it.

    Applied in place, it would be written into the folder of bags.

    Args:
        path: the file.
        folder: the folder for the copy.
        reserve: called with a number of bytes before as many are written.

    Returns:
        The copy, and a note.
    """
    for source in (path, *journals_beside(path)):
        reserve(2 * source.stat().st_size)
        with (
            os.fdopen(open_regular(source), "rb") as plain,
            (folder / source.name).open("wb") as out,
        ):
            shutil.copyfileobj(plain, out)
    copy = folder / path.name
    with closing(sqlite3.connect(copy)) as base:
        guard(base, MAX_CHUNK_MB << 20, copy.stat().st_size)
        base.execute("PRAGMA journal_mode=DELETE").fetchall()
        base.execute("SELECT name FROM sqlite_master LIMIT 1").fetchall()
    return copy, "its writer did not finish it: its journal was replayed"


def guard(base: sqlite3.Connection, max_value_bytes: int, size: int) -> None:
    """Bounds the memory of a connection, and how long it works in all.

    Args:
        base: the connection.
        max_value_bytes: the size of one value; sqlite refuses more before it allocates it.
        size: the size of the file. To go through every row of a bag once takes about one
            instruction a byte; statements are interrupted after many times that.
    """
    base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max_value_bytes)
    steps_left = (_INSTRUCTIONS + _INSTRUCTIONS_PER_BYTE * size) // _STEP

    def interrupts() -> bool:
        nonlocal steps_left
        steps_left -= 1
        return steps_left < 0

    base.set_progress_handler(interrupts, _STEP)


def require_plain_tables(base: sqlite3.Connection) -> None:
    """Refuses a file with views, virtual tables or computed columns in place of tables.

    Raises:
        UnreadableError: there is one.
    """
    not_plain = [name for (name,) in base.execute(_NOT_TABLES, (json.dumps(_TABLES),))]
    for name in _TABLES:
        (computed,) = base.execute(_COMPUTED_COLUMNS, (name,)).fetchone()
        if computed:
            not_plain.append(name)
    if not_plain:
        raise UnreadableError(f"not a rosbag2 file: its {not_plain[0]} is not a plain table")


def require_short_texts(base: sqlite3.Connection, table: str, columns: Sequence[str]) -> None:
    """Refuses a table whose texts take more than any recorder writes, before they are read.

    Raises:
        UnreadableError: they do.
    """
    # As blobs: the length of a text ends at its first NUL.
    sizes = " + ".join(f"ifnull(length(CAST({name} AS BLOB)), 0)" for name in columns)
    (size,) = base.execute(f"SELECT total({sizes}) FROM {table}").fetchone()  # noqa: S608
    if size > MAX_TEXTS_BYTES:
        raise UnreadableError(f"the texts of its table {table} are longer than any can be")


_MORE_WORK: Final = 8
"""`VACUUM` and the comparison go through a file so many times more often than a reader."""
_TRIGGERS: Final = "SELECT name FROM sqlite_master WHERE type = 'trigger'"
_LEFT_OUT: Final = "FROM messages NOT INDEXED WHERE leaves_out(topic_id, timestamp)"
_METADATA_TABLE: Final = "SELECT name FROM sqlite_master WHERE type = 'table' AND name = 'metadata'"


def cut_sqlite(
    source: Path,
    target: Path,
    stream: IO[bytes],
    leaves_out: Callable[[str, Ns, Ns], bool],
    max_message_bytes: int,
) -> Counter[str]:
    """Copies a file without some messages; returns how many of each topic were left out.

    Args:
        source: a file without a journal.
        target: the new file.
        stream: into the target, which is empty.
        leaves_out: whether a message is left out, by topic, log time and publish time; the format
            has log times only, which are passed twice.
        max_message_bytes: a source with a larger message is refused.

    Raises:
        UnreadableError: the source has a journal or is no plain bag, or the target is not right.
    """
    if journals_beside(source):
        raise UnreadableError("its writer did not finish it: a journal lies beside it")
    with os.fdopen(open_regular(source), "rb") as original:
        shutil.copyfileobj(original, stream)
    stream.flush()
    with closing(sqlite3.connect(target, isolation_level=None)) as base:
        guard(base, max_message_bytes, _MORE_WORK * target.stat().st_size)
        require_plain_tables(base)
        if base.execute(_TRIGGERS).fetchall():
            raise UnreadableError("not a rosbag2 file: it has triggers")
        return _delete_messages(base, leaves_out)


def _delete_messages(
    base: sqlite3.Connection, leaves_out: Callable[[str, Ns, Ns], bool]
) -> Counter[str]:
    """Deletes messages for good, and verifies the others; returns how many of each topic.

    Raises:
        UnreadableError: the file has other messages then, or is not whole.
    """
    # Beside the file a journal would hold what is deleted, and in memory all of the file. Who made
    # the file deletes it after a failure.
    base.execute("PRAGMA journal_mode = DELETE")
    base.execute("PRAGMA journal_mode = OFF")
    base.execute("PRAGMA secure_delete = ON")
    require_short_texts(base, "topics", ("name",))
    base.text_factory = _TEXT
    topics = {number: str(name) for number, name in base.execute("SELECT id, name FROM topics")}

    def leaves_out_row(number: int, time: Ns) -> bool:
        return number in topics and leaves_out(topics[number], time, time)

    base.create_function("leaves_out", 2, leaves_out_row)
    left_out = Counter[str]()
    for number, count in base.execute(f"SELECT topic_id, count(*) {_LEFT_OUT} GROUP BY topic_id"):
        left_out[topics[number]] += count
    before = _digest(base, "WHERE NOT leaves_out(topic_id, timestamp)")
    base.execute("BEGIN")
    base.execute(f"DELETE {_LEFT_OUT}")
    if base.execute(_METADATA_TABLE).fetchall():
        base.execute("DELETE FROM metadata")
    base.execute("COMMIT")
    base.execute("VACUUM")
    if base.execute("PRAGMA integrity_check(1)").fetchone() != ("ok",):
        raise UnreadableError("what was written is not whole")
    if _digest(base) != before:
        raise UnreadableError("what was written is not what was read")
    return left_out


def _digest(base: sqlite3.Connection, where: str = "") -> bytes:
    """Returns a digest of all messages in order, or of those that meet a condition."""
    digest = hashlib.blake2b()
    for *numbers, payload in base.execute(
        f"SELECT rowid, * FROM messages {where} ORDER BY rowid"  # noqa: S608
    ):
        digest.update(repr(numbers).encode())
        digest.update(payload if isinstance(payload, bytes) else repr(payload).encode())
    return digest.digest()
