"""What a sqlite file may do to its reader: nothing that takes more than its size can explain.

A file that anybody may have written can call an endless query a table, or have pages that lead
back to themselves; sqlite runs both for as long as it is let.
"""

from __future__ import annotations

import json
import sqlite3
from typing import Final

from ros2_memory.storage.errors import UnreadableError

_STEP: Final = 10_000
"""Instructions of sqlite's machine between two looks at how many there were."""
_ALWAYS_ALLOWED: Final = 20_000_000
_FOR_EACH_BYTE: Final = 50
_READ: Final = ("topics", "messages", "message_definitions")
_ODD: Final = """
    SELECT name, type FROM sqlite_master
    WHERE lower(name) IN (SELECT value FROM json_each(?))
    AND (type != 'table' OR rootpage = 0)
"""
_COMPUTED: Final = "SELECT count(*) FROM pragma_table_xinfo(?) WHERE hidden != 0"


def guard(base: sqlite3.Connection, max_value_bytes: int, size: int) -> None:
    """Bounds what a connection holds at once, and how long it works in all.

    Args:
        base: the connection.
        max_value_bytes: what one value may hold; sqlite refuses more before it allocates it.
        size: the size of the file. Going once through every row of a bag takes about one
            instruction for a byte; after many times that, statements are interrupted.
    """
    base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max_value_bytes)
    left = (_ALWAYS_ALLOWED + _FOR_EACH_BYTE * size) // _STEP

    def worked() -> bool:
        nonlocal left
        left -= 1
        return left < 0

    base.set_progress_handler(worked, _STEP)


def require_plain_tables(base: sqlite3.Connection) -> None:
    """Refuses views, virtual tables and computed columns where a bag has tables.

    Raises:
        UnreadableError: there is one.
    """
    odd = base.execute(_ODD, (json.dumps(_READ),)).fetchall()
    computed = [name for name in _READ if base.execute(_COMPUTED, (name,)).fetchone()[0]]
    if odd or computed:
        name = odd[0][0] if odd else computed[0]
        raise UnreadableError(f"not a rosbag2 file: its {name} is no plain table")
