"""What is asked of the catalogue's tables, and written to them, in SQL.

Statements are put together from constants of this room; values are always parameters. Raises what
sqlite3 raises.
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
    encode_topic_events,
    packed_standstills,
)

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Sequence

    from ros2_memory.catalogue.digest import Digest
    from ros2_memory.catalogue.topic_digest import TopicDigest
    from ros2_memory.core.bag_summary import BagSummary
    from ros2_memory.storage.base import Record

_OPEN, _TEXTS, _FALSE, _TRUE = 1, 2, 4, 8
EVIDENCE: Final = "flags, words, low, high, numbers, min_x, max_x, min_y, max_y, min_z, max_z"
TOPIC: Final = "(SELECT id FROM topics WHERE name = ?)"
AMONG: Final = "IN (SELECT value FROM json_each(?))"


def numbers_of(base: sqlite3.Connection, config: str, paths: Sequence[str]) -> list[int]:
    """The numbers of the entries of these files."""
    rows = base.execute(
        f"SELECT id FROM bags WHERE config = ? AND path {AMONG}", (config, json.dumps(paths))
    )
    return [row[0] for row in rows.fetchall()]


def keys_rows(base: sqlite3.Connection, config: str, paths: Sequence[str]) -> list[sqlite3.Row]:
    """Number, path, size, mtime and sidecar's mtime of the entries of these files."""
    return base.execute(
        f"SELECT id, path, size, mtime, sidecar FROM bags WHERE config = ? AND path {AMONG}",
        (config, json.dumps(paths)),
    ).fetchall()


def kept_rows(base: sqlite3.Connection, topic: str, numbers: Sequence[int]) -> list[sqlite3.Row]:
    """Entry, channel, log time, publish time and payload of the messages kept, in order."""
    return base.execute(
        "SELECT bag, channel, log_time, publish_time, payloads.bytes FROM kept"
        " JOIN payloads ON payloads.id = kept.payload"
        f" WHERE topic = {TOPIC} AND bag {AMONG} ORDER BY bag, nth",
        (topic, json.dumps(numbers)),
    ).fetchall()


def held_rows(
    base: sqlite3.Connection, columns: str, topic: str, numbers: Sequence[int]
) -> list[sqlite3.Row]:
    """The entry and these columns of what entries hold of a topic."""
    return base.execute(
        f"SELECT bag, {columns} FROM held WHERE topic = {TOPIC} AND bag {AMONG}",
        (topic, json.dumps(numbers)),
    ).fetchall()


def drop(base: sqlite3.Connection, numbers: Sequence[int]) -> None:
    """Deletes entries."""
    if not numbers:
        return
    listed = json.dumps(numbers)
    for (topic,) in base.execute("SELECT id FROM topics").fetchall():
        for table in ("held", "tales", "kept"):
            base.execute(f"DELETE FROM {table} WHERE topic = ? AND bag {AMONG}", (topic, listed))
    base.execute(f"DELETE FROM bags WHERE id {AMONG}", (listed,))
    base.execute("DELETE FROM remembered WHERE oldest NOT IN (SELECT id FROM bags)")


def put(
    base: sqlite3.Connection, config: str, key: tuple[str, int, int, int], digest: Digest
) -> None:
    """Inserts an entry; `key` is path, size, mtime and sidecar's mtime."""
    shape = _number(base, "shapes", "text", encode_schema(digest.summary.shape))
    cursor = base.execute(
        "INSERT INTO bags (config, path, size, mtime, sidecar, shape, counts)"
        " VALUES (?, ?, ?, ?, ?, ?, ?)",
        (config, *key, shape, digest.summary.numbers),
    )
    number = int(cursor.lastrowid or 0)
    for topic in digest.topics:
        _put_topic(base, number, topic)
        _put_tale(base, number, topic, digest.summary)


def _put_topic(base: sqlite3.Connection, bag: int, topic: TopicDigest) -> None:
    evidence, edges = topic.evidence, topic.edges
    number = _number(base, "topics", "name", topic.topic)
    flags = (
        evidence.open * _OPEN
        | evidence.texts * _TEXTS
        | (False in evidence.booleans) * _FALSE
        | (True in evidence.booleans) * _TRUE
    )
    pairs = None if edges is None else _number(base, "edges", "pairs", json.dumps(edges.pairs))
    base.execute(
        f"INSERT INTO held VALUES ({', '.join('?' * 19)})",
        (
            number,
            bag,
            flags,
            evidence.words,
            evidence.low,
            evidence.high,
            None if evidence.numbers is None else json.dumps(evidence.numbers),
            *(evidence.box or (None,) * 6),
            None if topic.poses is None else encode_poses(topic.poses),
            pairs,
            None if edges is None else edges.first_stamp,
            None if edges is None else edges.last_stamp,
            topic.kept is not None,
            json.dumps(dict(topic.undecodable)) if topic.undecodable else None,
        ),
    )
    for nth, record in enumerate(topic.kept or ()):
        _put_record(base, (bag, number, nth), record)


def _put_tale(base: sqlite3.Connection, bag: int, topic: TopicDigest, summary: BagSummary) -> None:
    """Inserts where a topic's poses stand still and what its messages say, if there is any."""
    story = b"" if topic.story is None else encode_topic_events(topic.story)
    spans = [(each.first, each.last) for each in summary.of(topic.topic)]
    quiet = TopicEvents(min(first for first, _ in spans), max(last for _, last in spans))
    if topic.standstills is None and topic.story == quiet:
        return
    base.execute(
        f"INSERT INTO tales VALUES ({TOPIC}, ?, ?, ?)",
        (
            topic.topic,
            bag,
            None if topic.standstills is None else packed_standstills(topic.standstills),
            None if topic.story == quiet else story,
        ),
    )


def tale_rows(
    base: sqlite3.Connection, column: str, topic: str, numbers: Sequence[int]
) -> list[sqlite3.Row]:
    """The entry and a column of what is told of a topic, where there is something in it."""
    return base.execute(
        f"SELECT bag, {column} FROM tales"
        f" WHERE topic = {TOPIC} AND bag {AMONG} AND {column} IS NOT NULL",
        (topic, json.dumps(numbers)),
    ).fetchall()


def _put_record(base: sqlite3.Connection, place: tuple[int, int, int], record: Record) -> None:
    channel, payload = record.channel, record.payload
    schema = channel.schema
    described = repr((channel.topic, channel.encoding, channel.latched, schema)).encode()
    channel_hash = hashlib.sha256(described).digest()
    base.execute(
        "INSERT OR IGNORE INTO channels (hash, topic, encoding, latched, schema_name,"
        " schema_encoding, schema_text) VALUES (?, ?, ?, ?, ?, ?, ?)",
        (
            channel_hash,
            channel.topic,
            channel.encoding,
            channel.latched,
            schema.name,
            schema.encoding,
            schema.text,
        ),
    )
    payload_hash = hashlib.sha256(payload).digest()
    base.execute(
        "INSERT OR IGNORE INTO payloads (hash, bytes) VALUES (?, ?)", (payload_hash, payload)
    )
    base.execute(
        "INSERT INTO kept VALUES (?, ?, ?, ?, ?, (SELECT id FROM channels WHERE hash = ?),"
        " (SELECT id FROM payloads WHERE hash = ?))",
        (*place, record.log_time, record.publish_time, channel_hash, payload_hash),
    )


def _number(base: sqlite3.Connection, table: str, column: str, text: str) -> int:
    """The number of a text that many entries share."""
    base.execute(f"INSERT OR IGNORE INTO {table} ({column}) VALUES (?)", (text,))
    row = base.execute(f"SELECT id FROM {table} WHERE {column} = ?", (text,)).fetchone()
    return int(row[0])


def evidence_of(row: sqlite3.Row) -> ZoneMap:
    """The evidence in the columns `EVIDENCE` of a row."""
    _, flags, words, low, high, numbers, *box = row
    if flags & _OPEN:
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
