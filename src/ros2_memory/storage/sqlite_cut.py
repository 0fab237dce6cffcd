"""Writes the `.db3` files of rosbag2 again without some of their messages.

The copy is changed, and then rewritten as a whole (`VACUUM`), so that no page of it holds what
was deleted.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sqlite3
from collections import Counter
from contextlib import closing
from typing import TYPE_CHECKING, Final

from ros2_memory.storage.errors import MAX_CHUNK_MB, UnreadableError
from ros2_memory.storage.file_io import open_regular
from ros2_memory.storage.sqlite_bag import (
    JOURNALS,
    guard,
    require_plain_tables,
    require_short_texts,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Collection
    from pathlib import Path
    from typing import IO

    from ros2_memory.core.timebase import Ns

_MORE_WORK: Final = 8
"""`VACUUM` and the comparison go through a file so many times more often than a reader."""
_TRIGGERS: Final = "SELECT count(*) FROM sqlite_master WHERE type = 'trigger'"
_HAS_METADATA: Final = (
    "SELECT count(*) FROM sqlite_master WHERE type = 'table' AND name = 'metadata'"
)


def cut_sqlite(
    source: Path,
    target: Path,
    stream: IO[bytes],
    takes: Callable[[str, Ns, Ns], bool],
    edit_metadata: Callable[[str], str],
) -> Counter[str]:
    """Writes a file again without some messages; returns how many of each topic.

    Args:
        source: a file without a journal.
        target: the new file.
        stream: into the target, which is empty.
        takes: whether a message is left out, by topic, log time, and log time again: the format
            has no other.
        edit_metadata: returns the text of an embedded metadata.yaml as it is to be.

    Raises:
        UnreadableError: the source has a journal or is no plain bag, or the target is not right.
    """
    if any(source.with_name(source.name + suffix).exists() for suffix in JOURNALS):
        raise UnreadableError("its writer did not finish it: a journal lies beside it")
    with os.fdopen(open_regular(source), "rb") as original:
        shutil.copyfileobj(original, stream)
    stream.flush()
    size = target.stat().st_size
    taken = Counter[str]()
    with closing(sqlite3.connect(target, isolation_level=None)) as base:
        guard(base, MAX_CHUNK_MB << 20, _MORE_WORK * size)
        require_plain_tables(base)
        if base.execute(_TRIGGERS).fetchone()[0]:
            raise UnreadableError("not a rosbag2 file: it has triggers")
        # No journal may lie beside the file: it would hold what is deleted.
        base.execute("PRAGMA journal_mode = DELETE")
        base.execute("PRAGMA journal_mode = MEMORY")
        base.execute("PRAGMA secure_delete = ON")
        require_short_texts(base, "topics", ("name",))
        topics = dict(base.execute("SELECT id, name FROM topics").fetchall())
        going: list[tuple[int]] = []
        for row, number, at in base.execute("SELECT rowid, topic_id, timestamp FROM messages"):
            topic = topics.get(number)
            if topic is not None and takes(str(topic), at, at):
                taken[str(topic)] += 1
                going.append((row,))
        before = _digest(base, without={row for (row,) in going})
        base.execute("BEGIN")
        base.executemany("DELETE FROM messages WHERE rowid = ?", going)
        if base.execute(_HAS_METADATA).fetchone()[0]:
            require_short_texts(base, "metadata", ("metadata",))
            rows = base.execute("SELECT rowid, metadata FROM metadata").fetchall()
            base.executemany(
                "UPDATE metadata SET metadata = ? WHERE rowid = ?",
                [(edit_metadata(str(text)), row) for row, text in rows],
            )
        base.execute("COMMIT")
        base.execute("VACUUM")
        if base.execute("PRAGMA integrity_check(1)").fetchone()[0] != "ok":
            raise UnreadableError("what was written is not whole")
        if _digest(base) != before:
            raise UnreadableError("what was written is not what was read")
    return taken


def _digest(base: sqlite3.Connection, without: Collection[int] = ()) -> bytes:
    """Returns a digest of all messages but these rows, in order."""
    digest = hashlib.blake2b()
    rows = base.execute("SELECT rowid, * FROM messages ORDER BY rowid")
    for row in rows:
        if row[0] not in without:
            *numbers, payload = row
            digest.update(repr(numbers).encode())
            digest.update(payload if isinstance(payload, bytes) else repr(payload).encode())
    return digest.digest()
