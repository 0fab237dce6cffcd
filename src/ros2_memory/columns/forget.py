"""Deletes bags from a store of columns, so that no byte of its file reveals their content.

Deleting rows is not enough:

- A part keeps the rows of a deleted bag, in its zones and words too, until its last bag is deleted.
- SQLite's `secure_delete` overwrites deleted rows in place, but not the copies that stay in a page
  when rows move to another one. So the whole file is written again.
- The write-ahead log has everything that was written last. So it is emptied.
"""

from __future__ import annotations

import sqlite3
import time
from contextlib import closing
from typing import TYPE_CHECKING, Final

from ros2_memory.columns.database import PRAGMAS, is_busy
from ros2_memory.columns.pack import FORMAT
from ros2_memory.columns.writing import UNUSED_SUMMARIES, delete_bags
from ros2_memory.core.errors import BagError
from ros2_memory.core.spans import overlaps_any, united

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from ros2_memory.core.model import TimeWindow

PATIENCE_S: Final = 10.0
"""How long to wait for other programs that use the file."""
_PAUSE_S: Final = 0.05


def forget(
    file: Path, bag_dir: Path, bags: Sequence[str], times: Sequence[TimeWindow] = ()
) -> None:
    """Deletes bags from a store, and deletes stores that were set aside.

    It also deletes bags whose files are gone, and the bags that share a part with a deleted one,
    which will be stored again.

    Args:
        file: the store; it may be absent.
        bag_dir: the bag directory.
        bags: their paths below it.
        times: bags with messages in these windows are deleted, too.

    Raises:
        BagError: the file cannot be changed, is of another version, or another program uses it all
            the time.
    """
    try:
        for leftover in leftovers(file):
            leftover.unlink(missing_ok=True)
        if file.is_file() and not file.is_symlink():
            address = f"{file.absolute().as_uri()}?mode=rw"
            with closing(
                sqlite3.connect(address, uri=True, timeout=PATIENCE_S, isolation_level=None)
            ) as base:
                _delete_bags_and_unused(base, bag_dir, bags, times)
                rewrite(base)
    except (OSError, sqlite3.Error, ValueError) as error:
        reason = f"the columns may still contain deleted data ({error}); delete the file"
        raise BagError(str(file), f"{file.name}: {reason}") from error


def leftovers(file: Path) -> list[Path]:
    """Returns the files of a database that were set aside, and unfinished copies of it."""
    return [*file.parent.glob(f"{file.name}.aside*"), *file.parent.glob(f".{file.name}.*.tmp*")]


def rewrite(base: sqlite3.Connection) -> None:
    """Writes a database again without deleted rows, and empties its write-ahead log.

    Raises:
        sqlite3.Error: there is no space for that, or other programs read it all the time.
    """
    give_up_s = time.monotonic() + PATIENCE_S
    for statement in ("VACUUM", "PRAGMA wal_checkpoint(TRUNCATE)"):
        while not _executed(base, statement):
            if time.monotonic() > give_up_s:
                raise sqlite3.OperationalError("other programs use it all the time")
            time.sleep(_PAUSE_S)


def _delete_bags_and_unused(
    base: sqlite3.Connection, bag_dir: Path, bags: Sequence[str], times: Sequence[TimeWindow]
) -> None:
    if base.execute("PRAGMA user_version").fetchone()[0] != FORMAT:
        raise ValueError("it is of another version")
    for pragma in PRAGMAS:
        base.execute(f"PRAGMA {pragma}")
    base.execute("BEGIN IMMEDIATE")  # closing the connection rolls back
    stored = base.execute("SELECT path, first_ns, last_ns FROM bag").fetchall()
    spans = united((time.start, time.stop) for time in times)
    gone = [
        path
        for path, first, last in stored
        if overlaps_any(spans, first, last) or not (bag_dir / path).exists()
    ]
    delete_bags(base, [*bags, *gone])
    # Deleting these may leave another part that lacks a bag of its ten minutes.
    while sharing := _bags_sharing_parts(base):
        delete_bags(base, sharing)
    _delete_unused(base)
    base.execute("COMMIT")


def _bags_sharing_parts(base: sqlite3.Connection) -> list[str]:
    """Returns the bags that have rows in a part which also has rows of deleted bags."""
    rows = base.execute(
        "SELECT DISTINCT bag.path FROM part, json_each(part.bags) JOIN bag ON bag.id = value"
        " WHERE EXISTS (SELECT 1 FROM json_each(part.bags) AS other"
        " WHERE other.value NOT IN (SELECT id FROM bag))"
    )
    return [path for (path,) in rows]


def _delete_unused(base: sqlite3.Connection) -> None:
    """Deletes the topics, definitions and summaries that only deleted bags had."""
    base.execute("DELETE FROM listing")  # of `metadata.yaml`, which is read again
    base.execute("DELETE FROM topic WHERE id NOT IN (SELECT topic FROM part)")
    base.execute("DELETE FROM definition WHERE id NOT IN (SELECT definition FROM topic)")
    base.execute(UNUSED_SUMMARIES)


def _executed(base: sqlite3.Connection, statement: str) -> bool:
    """Executes a statement; returns False if another program holds a lock."""
    try:
        rows = base.execute(statement).fetchall()
    except sqlite3.OperationalError as error:
        if not is_busy(error):
            raise
        return False
    # A checkpoint returns whether it was blocked, VACUUM nothing.
    return not any(is_blocked for is_blocked, *_ in rows)
