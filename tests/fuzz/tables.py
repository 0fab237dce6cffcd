"""Mutations of sqlite bags: missing tables, wrong types, and schemas that are made to do harm."""

import random
import sqlite3
import struct
from collections.abc import Iterable
from contextlib import closing, suppress
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory

from tests.fuzz.good import Good
from tests.fuzz.mutant import Mutant, mutant_of

_TABLES = ("topics", "messages", "message_definitions", "metadata", "schema")
_COLUMNS = (
    "topics.name",
    "topics.type",
    "topics.serialization_format",
    "topics.id",
    "messages.topic_id",
    "messages.timestamp",
    "messages.data",
    "messages.id",
    "message_definitions.encoding",
    "message_definitions.encoded_message_definition",
    "message_definitions.topic_type",
)
_ODD_VALUES = (
    "NULL",
    "''",
    "'text'",
    "x'ff00'",
    "-1",
    "0",
    "1.5",
    "9223372036854775807",
    "-9223372036854775808",
    "1e308",
    "zeroblob(100000)",
    "CAST(x'fffe' AS TEXT)",
    "'1784023200000000000'",
    "x'28b52ffd'",
)
_FOREVER = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"


def missing_tables(rng: Random, good: Good) -> Mutant:
    """Tables or columns that are not there, or are called something else."""
    statements = []
    for _ in range(rng.choice((1, 1, 2))):
        table = rng.choice(_TABLES[:3])
        _, column = rng.choice(_COLUMNS).split(".")
        statements.append(
            rng.choice(
                (
                    f"DROP TABLE {table}",
                    f"ALTER TABLE {table} RENAME TO other",
                    f"DELETE FROM {table}",
                    f"ALTER TABLE {table} DROP COLUMN {column}",
                    f"ALTER TABLE {table} RENAME COLUMN {column} TO other",
                    "DROP INDEX timestamp_idx",
                    f"DROP TABLE {table}; CREATE TABLE {table}(id)",
                    f"DROP TABLE {table}; CREATE TABLE {table}(id, name, type, topic_id)",
                )
            )
        )
    return _edited(good, statements)


def wrong_types(rng: Random, good: Good) -> Mutant:
    """Values of types that no writer stores there, in one row or in all."""
    statements = []
    for _ in range(rng.choice((1, 1, 3))):
        table, column = rng.choice(_COLUMNS).split(".")
        rows = rng.choice(("", "", f" WHERE rowid % {rng.choice((2, 5, 50))} = 0"))
        statements.append(
            f"UPDATE OR IGNORE {table} SET {column} = {rng.choice(_ODD_VALUES)}{rows}"
        )
    rebuilt = (
        "CREATE TABLE free AS SELECT * FROM {0}; DROP TABLE {0}; ALTER TABLE free RENAME TO {0}"
    )
    before = [rebuilt.format(table) for table in _TABLES[:3] if rng.random() < 0.7]
    return _edited(good, [*before, *statements])


def hostile_schema(rng: Random, good: Good) -> Mutant:
    """Views, generated columns, triggers and virtual tables where plain tables should be."""
    fields = "i AS id, 1 AS topic_id, i AS timestamp, x'00010000' AS data"
    views = (
        f"CREATE VIEW messages AS {_FOREVER} SELECT {fields} FROM n",
        (
            "CREATE VIEW messages AS SELECT a.id, a.topic_id, a.timestamp, a.data FROM m a, m b,"
            " m c, m d, m e"
        ),
        (
            f"CREATE VIEW messages AS {_FOREVER} SELECT i AS id, 1 AS topic_id, i AS timestamp,"
            " zeroblob(900000000) AS data FROM n LIMIT 20"
        ),
        (
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp,"
            " data BLOB AS (zeroblob(900000000)));"
            "INSERT INTO messages(id, topic_id, timestamp) SELECT id, topic_id, timestamp FROM m"
        ),
        (
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data) ;"
            "INSERT INTO messages SELECT id, topic_id, timestamp, zeroblob(300000) FROM m"
        ),
        "CREATE VIRTUAL TABLE messages USING fts5(id, topic_id, timestamp, data)",
        "CREATE VIEW messages AS SELECT * FROM messages",
    )
    others = (
        (
            f"ALTER TABLE topics RENAME TO t; CREATE VIEW topics AS {_FOREVER} SELECT i AS id,"
            " '/t' || i AS name, 'std_msgs/msg/String' AS type FROM n"
        ),
        (
            "ALTER TABLE message_definitions RENAME TO d; CREATE VIEW message_definitions AS"
            f" {_FOREVER} SELECT 'a' AS topic_type, 'ros2msg' AS encoding,"
            " printf('%.*c', 1000000, 'x') AS encoded_message_definition FROM n"
        ),
        "CREATE TRIGGER harm AFTER INSERT ON messages BEGIN DELETE FROM messages; END",
        "CREATE INDEX odd ON messages(data); CREATE INDEX part ON messages(id) WHERE id > 5",
    )
    if rng.random() < 0.3:
        return _edited(good, [rng.choice(others)])
    return _edited(good, ["ALTER TABLE messages RENAME TO m", rng.choice(views)])


def looping_pages(rng: Random, good: Good) -> Mutant:
    """Trees of pages that lead back into themselves, so that reading one would never end."""
    data = bytearray(good.plain)
    size = int.from_bytes(data[16:18], "big") or 4096
    size = 65536 if size == 1 else size
    if len(data) < 3 * size or size < 512:
        return _edited(good, [])
    count = len(data) // size
    page = rng.randrange(1, count)
    kind = rng.choice((5, 2))
    cells = rng.choice((2, 50, (size - 20) // 8))
    if rng.random() < 0.5:
        # Many pages: each is made an interior page that leads to the others again and again.
        for each in range(1, count):
            if data[each * size] in {2, 5, 10, 13} and rng.random() < 0.5:
                _interior(rng, data, each, size, kind, cells, count)
    else:
        _interior(rng, data, page, size, kind, cells, count, to=page + 1)
    return mutant_of(good, bytes(data))


def _interior(
    rng: random.Random,
    data: bytearray,
    page: int,
    size: int,
    kind: int,
    cells: int,
    count: int,
    to: int | None = None,
) -> None:
    """Overwrites a page with an interior one of a b-tree (sqlite's file format, 1.6)."""
    start = page * size
    body = bytearray(size)
    body[0] = kind
    struct.pack_into(">H", body, 3, cells)
    struct.pack_into(">I", body, 8, to or rng.randrange(2, count + 1))
    for n in range(cells):
        at = size - 6 * (n + 1)
        if at < 12 + 2 * cells:
            struct.pack_into(">H", body, 3, n)
            break
        struct.pack_into(">H", body, 12 + 2 * n, at)
        struct.pack_into(">I", body, at, to or rng.randrange(2, count + 1))
        body[at + 4] = min(n, 127)
    struct.pack_into(">H", body, 5, max(12, size - 6 * cells))
    data[start : start + size] = body


def odd_journals(rng: Random, good: Good) -> Mutant:
    """A journal or WAL beside the bag that is none, or is another bag's."""
    mutant = mutant_of(good, good.plain)
    beside = rng.choice(("-wal", "-journal", "-shm"))
    magic = rng.choice(
        (b"", b"\x37\x7f\x06\x82", b"\x37\x7f\x06\x83", b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7")
    )
    content = magic + rng.randbytes(rng.choice((0, 24, 1000, 100_000)))
    if rng.random() < 0.2:
        content = good.plain
    mutant.files[mutant.bag + beside] = content
    return mutant


def _edited(good: Good, statements: Iterable[str]) -> Mutant:
    """The bag after these statements, as far as each can be run."""
    told = []
    with TemporaryDirectory() as folder:
        path = Path(folder) / "bag.db3"
        path.write_bytes(good.plain)
        with closing(sqlite3.connect(path, isolation_level=None)) as base:
            for statement in statements:
                with suppress(sqlite3.Error):
                    base.executescript(statement)
                    told.append(statement)
        return mutant_of(good, path.read_bytes(), "; ".join(told)[:200])
