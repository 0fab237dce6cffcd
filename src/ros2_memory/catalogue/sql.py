"""Reads, writes and deletes rows of the catalogue's tables.

Statements are put together from constants of this room; values are always parameters. Everything
raises what sqlite3 raises.
"""

from __future__ import annotations

import hashlib
import json
from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.topic_events import TopicEvents
from ros2_memory.analysis.zone_map import UNBOUNDED, Box, ZoneMap
from ros2_memory.catalogue.codec import (
    encode_poses,
    encode_schema,
    encode_standstills,
    encode_topic_events,
)
from ros2_memory.catalogue.field_columns import encode_field_ranges
from ros2_memory.catalogue.map_digest import encode_map_track

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Sequence

    from ros2_memory.catalogue.digest import Digest
    from ros2_memory.catalogue.map_digest import MapDigest
    from ros2_memory.catalogue.topic_digest import TopicDigest
    from ros2_memory.core.bag_summary import BagSummary
    from ros2_memory.storage.base import Record

_UNBOUNDED, _TEXTS, _FALSE, _TRUE = 1, 2, 4, 8
QUIET: Final = 0
"""Stands in `EVENTS` for messages without an event: `tales` has no row of these."""
_TOPIC: Final = "(SELECT id FROM topics WHERE name = ?)"
_AMONG: Final = "IN (SELECT value FROM json_each(?))"

# Columns for `topic_rows`.
ZONE_MAP: Final = "flags, words, low, high, numbers, min_x, max_x, min_y, max_y, min_z, max_z"
EVENTS: Final = f"""coalesce((
  SELECT story FROM tales WHERE tales.topic = held.topic AND tales.bag = held.bag), {QUIET})"""
EDGES: Final = "(SELECT pairs FROM edges WHERE id = held.edges), first_stamp, last_stamp"
STANDSTILLS: Final = "rests"
UNDECODABLE: Final = "coalesce(undecodable, '{}')"


def entry_rows(
    connection: sqlite3.Connection, config: str, paths: Sequence[str]
) -> list[sqlite3.Row]:
    """Returns row id, path, size, mtime and sidecar's mtime of the entries of these files."""
    return connection.execute(
        f"SELECT id, path, size, mtime, sidecar FROM bags WHERE config = ? AND path {_AMONG}",
        (config, json.dumps(paths)),
    ).fetchall()


def topic_rows(
    connection: sqlite3.Connection, columns: str, topic: str, row_ids: Sequence[int]
) -> list[sqlite3.Row]:
    """Returns the row id and these columns of what entries hold of a topic."""
    table = "tales" if columns == STANDSTILLS else "held"
    return connection.execute(
        f"SELECT bag, {columns} FROM {table} WHERE topic = {_TOPIC} AND bag {_AMONG}",
        (topic, json.dumps(row_ids)),
    ).fetchall()


def message_rows(
    connection: sqlite3.Connection, topic: str, row_ids: Sequence[int]
) -> list[sqlite3.Row]:
    """Returns row id, channel, log time, publish time and payload of stored messages, in order."""
    return connection.execute(
        "SELECT bag, channel, log_time, publish_time, payloads.bytes FROM kept"
        " JOIN payloads ON payloads.id = kept.payload"
        f" WHERE topic = {_TOPIC} AND bag {_AMONG} ORDER BY bag, nth",
        (topic, json.dumps(row_ids)),
    ).fetchall()


def delete_entries(connection: sqlite3.Connection, row_ids: Sequence[int]) -> None:
    """Deletes entries with all that belongs to them, and the cached answers that used them."""
    if not row_ids:
        return
    listed = json.dumps(row_ids)
    # Topic by topic: the primary keys begin with the topic.
    for (topic,) in connection.execute("SELECT id FROM topics").fetchall():
        for table in ("held", "tales", "ranges", "kept"):
            connection.execute(
                f"DELETE FROM {table} WHERE topic = ? AND bag {_AMONG}", (topic, listed)
            )
    connection.execute(f"DELETE FROM maps WHERE bag {_AMONG}", (listed,))
    connection.execute(f"DELETE FROM bags WHERE id {_AMONG}", (listed,))
    connection.execute("DELETE FROM remembered WHERE oldest NOT IN (SELECT id FROM bags)")


def insert_entry(
    connection: sqlite3.Connection, config: str, key: tuple[str, int, int, int], digest: Digest
) -> None:
    """Inserts an entry; `key` is path, size, mtime and sidecar's mtime."""
    schema = _id_of(connection, "shapes", "text", encode_schema(digest.summary.schema))
    cursor = connection.execute(
        "INSERT INTO bags (config, path, size, mtime, sidecar, shape, counts)"
        " VALUES (?, ?, ?, ?, ?, ?, ?)",
        (config, *key, schema, digest.summary.numbers),
    )
    bag = int(cursor.lastrowid or 0)
    if digest.in_map is not None:
        _insert_map(connection, bag, digest.in_map)
    for topic in digest.topics:
        number = _id_of(connection, "topics", "name", topic.topic)
        _insert_topic(connection, (number, bag), topic)
        _insert_events(connection, (number, bag), topic, digest.summary)
        _insert_ranges(connection, (number, bag), topic)
        for nth, record in enumerate(topic.kept or ()):
            _insert_record(connection, (bag, number, nth), record)


def _insert_map(connection: sqlite3.Connection, bag: int, digest: MapDigest) -> None:
    connection.execute(
        "INSERT INTO maps VALUES (?, ?, ?, ?)",
        (bag, digest.statics, encode_map_track(digest), digest.sights),
    )


def map_rows(
    connection: sqlite3.Connection, columns: str, row_ids: Sequence[int]
) -> list[sqlite3.Row]:
    """Returns row id, key of the static transforms, and these columns of map digests."""
    return connection.execute(
        f"SELECT bag, statics, {columns} FROM maps WHERE bag {_AMONG}", (json.dumps(row_ids),)
    ).fetchall()


def _insert_topic(connection: sqlite3.Connection, key: tuple[int, int], topic: TopicDigest) -> None:
    zones, edges = topic.zone_map, topic.edges
    flags = (
        zones.open * _UNBOUNDED
        | zones.texts * _TEXTS
        | (False in zones.booleans) * _FALSE
        | (True in zones.booleans) * _TRUE
    )
    pairs = None if edges is None else _id_of(connection, "edges", "pairs", json.dumps(edges.pairs))
    connection.execute(
        f"INSERT INTO held VALUES ({', '.join('?' * 19)})",
        (
            *key,
            flags,
            zones.words,
            zones.low,
            zones.high,
            None if zones.numbers is None else json.dumps(zones.numbers),
            *(zones.box or (None,) * 6),
            None if topic.poses is None else encode_poses(topic.poses),
            pairs,
            None if edges is None else edges.first_stamp,
            None if edges is None else edges.last_stamp,
            topic.kept is not None,
            json.dumps(dict(topic.undecodable)) if topic.undecodable else None,
        ),
    )


def _insert_events(
    connection: sqlite3.Connection, key: tuple[int, int], topic: TopicDigest, summary: BagSummary
) -> None:
    """Inserts the topic's standstills and events; no row where there are none."""
    spans = [(each.first, each.last) for each in summary.of(topic.topic)]
    quiet = TopicEvents(min(first for first, _ in spans), max(last for _, last in spans))
    if topic.standstills is None and topic.events == quiet:
        return
    connection.execute(
        "INSERT INTO tales VALUES (?, ?, ?, ?)",
        (
            *key,
            None if topic.standstills is None else encode_standstills(topic.standstills),
            None if topic.events == quiet else encode_topic_events(topic.events),
        ),
    )


def _insert_ranges(
    connection: sqlite3.Connection, key: tuple[int, int], topic: TopicDigest
) -> None:
    """Inserts the ranges of the topic's fields; no row where it has no number."""
    if topic.fields is None or topic.fields:
        text, packed = encode_field_ranges(topic.fields)
        fields = _id_of(connection, "fields", "text", text)
        connection.execute("INSERT INTO ranges VALUES (?, ?, ?, ?)", (*key, fields, packed))


def range_rows(
    connection: sqlite3.Connection, topic: str, row_ids: Sequence[int]
) -> list[sqlite3.Row]:
    """Returns row id, text of the fields and numbers of the ranges of a topic in entries.

    NULL for entries of bags in which it has no number; none for those that were deleted.
    """
    return connection.execute(
        "SELECT bags.id, text, numbers FROM json_each(?) JOIN bags ON bags.id = value"
        f" LEFT JOIN ranges ON topic = {_TOPIC} AND bag = bags.id"
        " LEFT JOIN fields ON fields.id = ranges.fields",
        (json.dumps(row_ids), topic),
    ).fetchall()


def _insert_record(
    connection: sqlite3.Connection, key: tuple[int, int, int], record: Record
) -> None:
    """Inserts a message; equal channels and payloads of all bags are stored once."""
    channel, schema = record.channel, record.channel.schema
    described_schema = (schema.name, schema.encoding, schema.text)
    described = (channel.topic, channel.encoding, channel.latched, *described_schema)
    channel_hash = hashlib.sha256(repr(described).encode()).digest()
    connection.execute(
        "INSERT OR IGNORE INTO channels (hash, topic, encoding, latched, schema_name,"
        " schema_encoding, schema_text) VALUES (?, ?, ?, ?, ?, ?, ?)",
        (channel_hash, *described),
    )
    payload_hash = hashlib.sha256(record.payload).digest()
    connection.execute(
        "INSERT OR IGNORE INTO payloads (hash, bytes) VALUES (?, ?)",
        (payload_hash, record.payload),
    )
    connection.execute(
        "INSERT INTO kept VALUES (?, ?, ?, ?, ?, (SELECT id FROM channels WHERE hash = ?),"
        " (SELECT id FROM payloads WHERE hash = ?))",
        (*key, record.log_time, record.publish_time, channel_hash, payload_hash),
    )


def _id_of(connection: sqlite3.Connection, table: str, column: str, text: str) -> int:
    """Returns the id of a text that many entries share, which is inserted where it is new."""
    connection.execute(f"INSERT OR IGNORE INTO {table} ({column}) VALUES (?)", (text,))
    row = connection.execute(f"SELECT id FROM {table} WHERE {column} = ?", (text,)).fetchone()
    return int(row[0])


def zone_map(row: sqlite3.Row) -> ZoneMap:
    """Decodes the columns `ZONE_MAP` of a row."""
    _, flags, words, low, high, numbers, *box = row
    if flags & _UNBOUNDED:
        return UNBOUNDED
    return ZoneMap(
        words=words,
        texts=bool(flags & _TEXTS),
        booleans=(False,) * bool(flags & _FALSE) + (True,) * bool(flags & _TRUE),
        low=low,
        high=high,
        numbers=None if numbers is None else tuple(json.loads(numbers)),
        box=None if box[0] is None else Box(*box),
    )
