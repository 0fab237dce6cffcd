"""Parts: the rows of one topic in some bags of a recording, stored column by column.

Beside the columns of the topic's layout a part has `#log_time`, `#bag` (the number of each row's
bag) and, where copies of a message may lie in other recordings, `#publish_time` and
`#payload_hash`. The owners of the elements of a sequence lie under its path and `#`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.columns.blob import Lazily, StoredTable, lazy_elements
from ros2_memory.columns.pack import Packed, compressed, pack
from ros2_memory.columns.steps import EXACT
from ros2_memory.columns.table import joined

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from ros2_memory.columns.blob import Layout, Topic
    from ros2_memory.columns.table import Column, Elements, Table
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


def packed_part(layout: Layout, tables: Sequence[tuple[int, Table]]) -> PackedPart:
    """Returns the rows of some bags as one part.

    Args:
        layout: of the topic, type and definition that all these tables are of.
        tables: each with the number of its bag; at least one has a row.
    """
    numbered, count = [], 0
    for _, table in tables:
        # The place of a row becomes its number among all rows: so its bag is known once sorted.
        numbered.append(replace_places(table, count))
        count += len(table)
    bags = np.repeat(
        np.array([bag for bag, _ in tables], np.int64), [len(table) for _, table in tables]
    )
    whole = joined(numbered)
    return pack_rows(layout, whole, bags[whole.places])


def pack_rows(layout: Layout, table: Table, bags: IntArray) -> PackedPart:
    """Returns the rows of a table, each with the number of its bag, as a part."""
    columns = {LOG_TIME: pack(table.log_times), BAG: pack(bags)}
    if table.payload_hashes is not None:
        columns[PUBLISH_TIME] = pack(table.publish_times)
        columns[PAYLOAD_HASH] = pack(table.payload_hashes)
    columns.update(_packed(layout, table, ""))
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


def _packed(layout: Layout, rows: Table | Elements, before: str) -> Iterator[tuple[str, Packed]]:
    for name, kind in layout.columns.items():
        yield f"{before}{name}".rstrip("."), pack(rows.columns[name], kind.step)
    for name, inner in layout.sequences.items():
        elements = rows.elements[name]
        yield f"{before}{name}#", pack(elements.owners, EXACT)
        yield from _packed(inner, elements, f"{before}{name}.")


def part_table(
    number: int,
    topic: Topic,
    columns: Mapping[str, Packed],
    load: Callable[[str], Column],
    times: IntArray,
) -> StoredTable:
    """Returns a part as a table whose columns are loaded when they are first asked for.

    Args:
        number: of the topic.
        topic: of the part.
        columns: what is known of each column; their data is not needed.
        load: returns a column by its path.
        times: the log times of its rows.
    """
    left_out = dict(topic.layout.left_out)
    elements = lazy_elements(topic.layout, "", lambda path: load(path.rstrip(".")))
    # A topic is dropped whole: its sequences have owners, or it has no sequence.
    sequences = [path for path in elements if columns[f"{path}#"].codec != DROPPED]
    for path, packed in columns.items():
        if packed.codec == DROPPED:
            left_out[path.rstrip("#")] = "beyond the share of the store (store.max_share)"
    there = [path for path in topic.layout.columns if columns[path].codec != DROPPED]
    return StoredTable(
        topic.channel,
        times,
        times,
        np.broadcast_to(np.int64(0), times.shape),
        Lazily(there, load),
        Lazily(sequences, elements.__getitem__),
        left_out,
        number=number,
        known=lambda path: columns[path.rstrip(".")],
    )


def replace_places(table: Table, first: int) -> Table:
    """Returns a table whose places count on from a number, in the order of its rows."""
    return replace(table, places=np.arange(first, first + len(table)))
