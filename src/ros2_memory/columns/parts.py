"""Parts: the rows of one topic in some bags of a recording, stored column by column.

Beside the columns of the topic's layout a part has `#log_time`, `#bag` (the number of each row's
bag) and, where copies of a message may lie in other recordings, `#publish_time` and
`#payload_hash`. The owners of the elements of a sequence lie under its path and `#`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.columns.blob import pack_table
from ros2_memory.columns.pack import Known, Packed, compressed, pack
from ros2_memory.columns.stored import Lazily, Times, joined_stored, lazy_table

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from ros2_memory.columns.layout import Layout
    from ros2_memory.columns.stored import StoredTable, Topic
    from ros2_memory.columns.table import Column, Table
    from ros2_memory.core.timebase import Ns
    from ros2_memory.storage.base import IntArray

LOG_TIME: Final = "#log_time"
PUBLISH_TIME: Final = "#publish_time"
PAYLOAD_HASH: Final = "#payload_hash"
BAG: Final = "#bag"
DROPPED: Final = "dropped"
"""The codec of a column of which only the zone is stored: its topic is beyond its share."""
_ALWAYS: Final = frozenset({LOG_TIME, PUBLISH_TIME, PAYLOAD_HASH, BAG})


@dataclass(frozen=True, slots=True)
class PackedPart:
    """A part as it is stored.

    Attributes:
        first: the earliest log time (ns), inclusive.
        last: the latest, inclusive.
        messages: how many rows.
        bags: the numbers of the bags that its rows are of, ascending.
        columns: by their paths, packed; the data is compressed.
    """

    first: Ns
    last: Ns
    messages: int
    bags: tuple[int, ...]
    columns: Mapping[str, Packed]

    @property
    def size(self) -> int:
        """How many bytes its data takes."""
        return sum(len(packed.data) for packed in self.columns.values())

    def without_data(self) -> PackedPart:
        """Returns the part with the zones of its columns alone, and the times of its messages."""
        columns = {
            path: packed
            if path in _ALWAYS or not packed.data
            else replace(packed, codec=DROPPED, data=b"")
            for path, packed in self.columns.items()
        }
        return replace(self, columns=columns)


def packed_part(layout: Layout, tables: Sequence[tuple[int, StoredTable]]) -> PackedPart:
    """Returns the rows of some bags as one part.

    Args:
        layout: of the topic, type and definition that all these tables are of.
        tables: each with the number of its bag, and at least one row.
    """
    numbered: list[StoredTable] = []
    count = 0
    for _, table in tables:
        # The place of a row becomes its number among all rows: so its bag is known once sorted.
        numbered.append(replace(table, places=np.arange(count, count + len(table))))
        count += len(table)
    bags = np.repeat(
        np.array([bag for bag, _ in tables], np.int64), [len(table) for _, table in tables]
    )
    whole = joined_stored(numbered)
    return pack_rows(layout, whole, bags[whole.places])


def pack_rows(layout: Layout, table: Table, bags: IntArray) -> PackedPart:
    """Returns the rows of a table, each with the number of its bag, as a part."""
    columns = {LOG_TIME: pack(table.log_times), BAG: pack(bags)}
    if table.payload_hashes is not None:
        columns[PUBLISH_TIME] = pack(table.publish_times)
        columns[PAYLOAD_HASH] = pack(table.payload_hashes)
    columns.update(pack_table(layout, table))
    return PackedPart(
        int(table.log_times[0]),
        int(table.log_times[-1]),
        len(table),
        tuple(np.unique(bags).tolist()),
        {
            path: replace(packed, data=compressed(packed.data)) if packed.data else packed
            for path, packed in columns.items()
        },
    )


def part_table(
    number: int,
    topic: Topic,
    columns: Mapping[str, Packed],
    load: Callable[[str], Column],
) -> StoredTable:
    """Returns a part as a table whose columns are loaded when they are first asked for.

    Its times are all 0: `PartUnit` loads the true ones.

    Args:
        number: of the topic.
        topic: of the part.
        columns: what is known of each column; their data is not needed.
        load: returns a column by its path.
    """

    def known(path: str) -> Known:
        return Known(columns[path].error, columns[path].zone)

    none = np.broadcast_to(np.int64(0), (columns[LOG_TIME].count,))
    kept = Times(none, none, none)
    table = lazy_table(number, topic, kept, known, load)
    dropped = {path for path, packed in columns.items() if packed.codec == DROPPED}
    if not dropped:
        return table
    reason = "beyond the share of the store (store.max_share)"
    there = [path for path in table.columns if path not in dropped]
    sequences = [path for path in table.elements if f"{path}#" not in dropped]
    return replace(
        table,
        columns=Lazily(there, table.columns.__getitem__),
        elements=Lazily(sequences, table.elements.__getitem__),
        left_out={**table.left_out, **dict.fromkeys(dropped, reason)},
    )
