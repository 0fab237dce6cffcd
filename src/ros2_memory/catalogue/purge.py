"""Deletes bags from a catalogue file, so that no byte of it reveals their content.

Deleting rows is not enough: answers were computed from them, payloads and models are shared between
bags, and SQLite leaves deleted rows in free pages and in its write-ahead log. A model is what the
first bag said of a topic; where no bag that is left says so, another is chosen, and what was packed
with it is compressed again.
"""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from typing import TYPE_CHECKING

from ros2_memory.catalogue.packing import MAX_MODEL_BYTES, packed, unpacked
from ros2_memory.catalogue.sql import COUNTS, TABLES, delete_entries
from ros2_memory.columns.forget import PATIENCE_S, leftovers, rewrite
from ros2_memory.core.errors import BagError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


def purge(file: Path, bags: Sequence[str]) -> None:
    """Deletes bags from a catalogue file, and deletes catalogues that were set aside.

    Args:
        file: the catalogue; nothing is done if it is absent or of another version.
        bags: their paths, as entries name them.

    Raises:
        BagError: it cannot be changed, or another program uses it all the time.
    """
    try:
        for each in leftovers(file):
            each.unlink(missing_ok=True)
        if file.is_file() and not file.is_symlink():
            _purge(file, bags)
    except (OSError, sqlite3.Error, ValueError, LookupError) as error:
        reason = f"the catalogue may still contain deleted data ({error}); delete the file"
        raise BagError(str(file), f"{file.name}: {reason}") from error


def _purge(file: Path, bags: Sequence[str]) -> None:
    address = f"{file.absolute().as_uri()}?mode=rw"
    with closing(
        sqlite3.connect(address, uri=True, timeout=PATIENCE_S, isolation_level=None)
    ) as base:
        if base.execute("PRAGMA user_version").fetchone()[0] != TABLES.version:
            raise ValueError("it is of another version")
        base.execute("PRAGMA secure_delete = ON")
        base.execute("BEGIN IMMEDIATE")
        try:
            listed = json.dumps(bags)
            rows = base.execute(
                "SELECT id FROM bags WHERE path IN (SELECT value FROM json_each(?))", (listed,)
            )
            delete_entries(base, [row[0] for row in rows.fetchall()])
            base.execute("DELETE FROM remembered")
            for topic, kind, model in base.execute("SELECT * FROM models").fetchall():
                _renew_model(base, topic, kind, model)
            base.execute("COMMIT")
        except BaseException:
            base.execute("ROLLBACK")
            raise
        rewrite(base)


def _renew_model(base: sqlite3.Connection, topic: int, kind: str, model: bytes) -> None:
    """Replaces a model that no remaining row equals, and compresses the rows against another."""
    if kind != COUNTS:  # of answers, which were deleted
        base.execute("DELETE FROM models WHERE topic = ? AND kind = ?", (topic, kind))
        return
    # Of counts, whose topic is their schema.
    rows = base.execute(
        f"SELECT id, {kind} FROM bags WHERE shape = ? AND length({kind}) > 0 ORDER BY id",
        (topic,),
    )
    plain: list[tuple[int, bytes]] = []
    for number, stored in rows:
        said = unpacked(stored, model)
        if said[:MAX_MODEL_BYTES] == model:
            return
        plain.append((number, said))
    base.execute("DELETE FROM models WHERE topic = ? AND kind = ?", (topic, kind))
    if not plain:
        return
    new = plain[0][1][:MAX_MODEL_BYTES]
    base.execute("INSERT INTO models VALUES (?, ?, ?)", (topic, kind, new))
    base.executemany(
        f"UPDATE bags SET {kind} = ? WHERE id = ?",
        [(packed(said, new), number) for number, said in plain],
    )
