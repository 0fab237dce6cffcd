"""Parts: the rows of one topic in some bags of a recording, stored column by column.

Beside the columns of the topic's layout a part has `#log_time`, `#bag` (the number of each row's
bag) and, where copies of a message of some bag may lie in other recordings, `#payload_hash`,
`#delay` (how much later a message was received than published) and the zone of `#publish_time`. In
rows of its other bags the hash is `UNHASHED` and the delay 0. The owners of the elements of a
sequence lie under its path and `#`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, repeat
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.columns.layout import columns_in
from ros2_memory.columns.pack import Packed, compressed, pack
from ros2_memory.columns.steps import EXACT
from ros2_memory.columns.table import Table, Zone, joined

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from ros2_memory.columns.layout import Layout
    from ros2_memory.core.timebase import Ns
    from ros2_memory.storage.base import IntArray

LOG_TIME: Final = "#log_time"
PUBLISH_TIME: Final = "#publish_time"
PAYLOAD_HASH: Final = "#payload_hash"
BAG: Final = "#bag"
DELAY: Final = "#delay"
ZONE_ALONE: Final = "zone"
"""The codec of a column of which there is never more than the zone."""
DROPPED: Final = "dropped"
"""The codec of a column of which only the zone is stored: its topic is beyond its share."""
ALWAYS: Final = frozenset({LOG_TIME, DELAY, PAYLOAD_HASH, BAG})
UNHASHED: Final = -1
"""In place of the hash of a payload that was not hashed."""


@dataclass(frozen=True)
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

    @cached_property
    def first_of(self) -> dict[bytes, str]:
        """By data, the path of the first column that has it: it is stored once."""
        paths = reversed([*self.columns.items()])
        return {packed.data: path for path, packed in paths if packed.data}

    @property
    def size(self) -> int:
        """How many bytes its data takes."""
        return sum(map(len, self.first_of))


def packed_part(layout: Layout, tables: Sequence[tuple[Table, IntArray]]) -> PackedPart:
    """Returns the rows of some bags as one part.

    Args:
        layout: of the topic, type and definition that all these tables are of.
        tables: each with the number of the bag of each row, of which it has one at least.
    """
    if len(tables) == 1:
        return pack_rows(layout, *tables[0])
    stops = np.cumsum([len(table) for table, _ in tables])
    # The place of a row becomes its number among all rows: so its bag is known once sorted.
    is_hashed = any(table.payload_hashes is not None for table, _ in tables)
    numbered = [
        replace(
            table,
            places=np.arange(stop - len(table), stop),
            payload_hashes=_hashes(table) if is_hashed else None,
        )
        for (table, _), stop in zip(tables, stops.tolist(), strict=True)
    ]
    whole = joined(numbered)
    return pack_rows(layout, whole, np.concatenate([bags for _, bags in tables])[whole.places])


def pack_rows(layout: Layout, table: Table, bags: IntArray) -> PackedPart:
    """Returns the rows of a table of a layout, each with the number of its bag, as a part."""
    common: dict[str, IntArray] = {LOG_TIME: table.log_times, BAG: bags}
    packed: dict[str, Packed] = {}
    if table.payload_hashes is not None:
        is_hashed = table.payload_hashes != UNHASHED
        common[PAYLOAD_HASH] = table.payload_hashes
        common[DELAY] = np.where(is_hashed, table.log_times - table.publish_times, 0)
        # Those of a table without columns may be log times.
        if is_hashed.all() or "" not in table.left_out:
            published = Zone(int(table.publish_times.min()), int(table.publish_times.max()))
            packed[PUBLISH_TIME] = Packed(ZONE_ALONE, len(table), 0.0, published, b"")
    steps = (kind.step for kind in layout.slots.values())
    columns = [*common.values(), *(column for _, column in columns_in(table))]
    packs = map(pack, columns, chain(repeat(EXACT, len(common)), steps))
    packed.update(zip((*common, *layout.slots), packs, strict=True))
    return PackedPart(
        int(table.log_times[0]),
        int(table.log_times[-1]),
        len(table),
        tuple(np.unique(bags).tolist()),
        {
            path: replace(column, data=compressed(column.data)) if column.data else column
            for path, column in packed.items()
        },
    )


def _hashes(table: Table) -> IntArray:
    hashes = table.payload_hashes
    return np.full(len(table), UNHASHED) if hashes is None else hashes
