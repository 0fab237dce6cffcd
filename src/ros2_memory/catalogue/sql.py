"""Reads, writes and deletes rows of the catalogue's tables.

Statements are built from constants of this package; values are always parameters. Everything
raises what sqlite3 raises.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Final

from ros2_memory.catalogue.codec import (
    encode_counts,
)
from ros2_memory.catalogue.packing import MAX_MODEL_BYTES, packed
from ros2_memory.columns.database import ROW_ID_BITS, Tables

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Sequence

    from ros2_memory.catalogue.digest import Digest, TopicDigest

TABLES: Final = Tables(
    version=15,
    names=(
        "bags",
        "held",
        "shapes",
        "models",
        "configs",
    ),
    statements="""
CREATE TABLE bags (id INTEGER PRIMARY KEY AUTOINCREMENT, config INTEGER NOT NULL,
  path TEXT NOT NULL, size INTEGER NOT NULL, mtime INTEGER NOT NULL, sidecar INTEGER NOT NULL,
  shape INTEGER NOT NULL, counts BLOB NOT NULL, UNIQUE (config, path));
CREATE TABLE configs (id INTEGER PRIMARY KEY, text TEXT NOT NULL UNIQUE);
CREATE TABLE shapes (id INTEGER PRIMARY KEY, text TEXT NOT NULL UNIQUE);
CREATE TABLE topics (id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE);
CREATE TABLE held (id INTEGER PRIMARY KEY, relatched INTEGER, undecodable TEXT);
CREATE TABLE models (topic INTEGER NOT NULL, kind TEXT NOT NULL, bytes BLOB NOT NULL,
  PRIMARY KEY (topic, kind)) WITHOUT ROWID;
CREATE TABLE remembered (question TEXT PRIMARY KEY, oldest INTEGER NOT NULL, answer BLOB NOT NULL)
  WITHOUT ROWID;
""",
)
"""In `held` the high bits of an id (see `ROW_ID_BITS`) are the topic's: its rows lie together."""

NO_TOPIC: Final = 0
"""The topic of models that belong to no topic."""
_AMONG: Final = "IN (SELECT value FROM json_each(?))"
OF_CONFIGS: Final = f"config {_AMONG}"

# Columns for `topic_rows`. Those of one word are packed, and the word is the kind of their model.
UNDECODABLE: Final = "coalesce(undecodable, '{}')"
RELATCHED: Final = "relatched"
COUNTS: Final = "counts"
"""Its models have the number of a shape as their topic."""


def entry_rows(
    connection: sqlite3.Connection, configs: str, paths: Sequence[str]
) -> list[sqlite3.Row]:
    """Returns row id, path, size, mtime and sidecar's mtime of the entries of these files.

    `configs` is a JSON list of the ids of configurations, as is `OF_CONFIGS`' parameter.
    """
    return connection.execute(
        f"SELECT id, path, size, mtime, sidecar FROM bags WHERE {OF_CONFIGS} AND path {_AMONG}",
        (configs, json.dumps(paths)),
    ).fetchall()


def existing_rows(connection: sqlite3.Connection, row_ids: Sequence[int]) -> list[sqlite3.Row]:
    """Returns those of these row ids that an entry has."""
    return connection.execute(
        f"SELECT id FROM bags WHERE id {_AMONG}", (json.dumps(row_ids),)
    ).fetchall()


def topic_rows(
    connection: sqlite3.Connection, columns: str, topic: str, row_ids: Sequence[int]
) -> list[sqlite3.Row]:
    """Returns the row id and these columns of what entries hold of a topic."""
    number = topic_number(connection, topic)
    base = number << ROW_ID_BITS
    return connection.execute(
        f"SELECT id - ?, {columns} FROM held WHERE id IN (SELECT value + ? FROM json_each(?))",
        (base, base, json.dumps(row_ids)),
    ).fetchall()


def topic_number(connection: sqlite3.Connection, topic: str) -> int:
    """Returns the number of a topic; `NO_TOPIC` where no entry has it."""
    row = connection.execute("SELECT id FROM topics WHERE name = ?", (topic,)).fetchone()
    return NO_TOPIC if row is None else int(row[0])


def model_of(connection: sqlite3.Connection, topic: int, kind: str) -> bytes:
    """Returns the model that a kind and topic is packed with, if any."""
    row = connection.execute(
        "SELECT bytes FROM models WHERE topic = ? AND kind = ?", (topic, kind)
    ).fetchone()
    return b"" if row is None else bytes(row[0])


def packed_by_model(connection: sqlite3.Connection, topic: int, kind: str, plain: bytes) -> bytes:
    """Packs a value; the first of its kind becomes the model."""
    model = model_of(connection, topic, kind)
    if plain and not model:
        model = plain[:MAX_MODEL_BYTES]
        connection.execute("INSERT INTO models VALUES (?, ?, ?)", (topic, kind, model))
    return packed(plain, model)


def any_is_gone(connection: sqlite3.Connection, row_ids: Sequence[int]) -> bool:
    """Returns whether an entry was deleted since it was read.

    Then nothing that was computed from it may be stored.
    """
    gone = "SELECT value FROM json_each(?) WHERE value NOT IN (SELECT id FROM bags) LIMIT 1"
    return connection.execute(gone, (json.dumps(row_ids),)).fetchone() is not None


def delete_entries(connection: sqlite3.Connection, row_ids: Sequence[int]) -> None:
    """Deletes entries with all that belongs to them, and the cached answers that used them."""
    if not row_ids:
        return
    listed = json.dumps(row_ids)
    # Topic by topic: the primary keys begin with the topic.
    for (topic,) in connection.execute("SELECT id FROM topics").fetchall():
        connection.execute(
            "DELETE FROM held WHERE id IN (SELECT value + ? FROM json_each(?))",
            (topic << ROW_ID_BITS, listed),
        )
    connection.execute(f"DELETE FROM bags WHERE id {_AMONG}", (listed,))
    connection.execute("DELETE FROM remembered WHERE oldest NOT IN (SELECT id FROM bags)")


def renew_entry(connection: sqlite3.Connection, row_id: int, sidecar: int) -> None:
    """Gives an entry another mtime of its sidecar (ns), and a new row id.

    Deletes the cached answers that used it.
    """
    columns = "config, path, size, mtime, shape, counts"
    row = connection.execute(f"SELECT {columns} FROM bags WHERE id = ?", (row_id,)).fetchone()
    connection.execute("DELETE FROM bags WHERE id = ?", (row_id,))
    cursor = connection.execute(
        f"INSERT INTO bags ({columns}, sidecar) VALUES (?, ?, ?, ?, ?, ?, ?)", (*row, sidecar)
    )
    new = cursor.lastrowid
    for (topic,) in connection.execute("SELECT id FROM topics").fetchall():
        base = topic << ROW_ID_BITS
        connection.execute("UPDATE held SET id = ? + ? WHERE id = ? + ?", (base, new, base, row_id))
    connection.execute("DELETE FROM remembered WHERE oldest NOT IN (SELECT id FROM bags)")


def insert_entry(
    connection: sqlite3.Connection, config: str, key: tuple[str, int, int, int], digest: Digest
) -> None:
    """Inserts an entry; `key` is path, size, mtime and sidecar's mtime."""
    schema = _id_of(connection, "shapes", "text", digest.summary.schema.to_json())
    counts = encode_counts(digest.summary.numbers)
    own = _id_of(connection, "configs", "text", config)
    cursor = connection.execute(
        "INSERT INTO bags (config, path, size, mtime, sidecar, shape, counts)"
        " VALUES (?, ?, ?, ?, ?, ?, ?)",
        (own, *key, schema, packed_by_model(connection, schema, COUNTS, counts)),
    )
    bag = int(cursor.lastrowid or 0)
    for topic in digest.topics:
        number = _id_of(connection, "topics", "name", topic.topic)
        _insert_topic(connection, (number, bag), topic)


def _insert_topic(connection: sqlite3.Connection, key: tuple[int, int], topic: TopicDigest) -> None:
    number, bag = key
    connection.execute(
        "INSERT INTO held VALUES (?, ?, ?)",
        (
            number << ROW_ID_BITS | bag,
            topic.relatched,
            json.dumps(dict(topic.undecodable)) if topic.undecodable else None,
        ),
    )


def _id_of(connection: sqlite3.Connection, table: str, column: str, text: str) -> int:
    """Returns the id of a text that many entries share, which is inserted where it is new."""
    connection.execute(f"INSERT OR IGNORE INTO {table} ({column}) VALUES (?)", (text,))
    row = connection.execute(f"SELECT id FROM {table} WHERE {column} = ?", (text,)).fetchone()
    return int(row[0])
