"""The recorded and the public bags, on machines that have them."""

from __future__ import annotations

from functools import cache
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import pytest

from ros2_memory.columns.decode import Group, undecoded
from ros2_memory.core.errors import BagError, UndecodableError
from ros2_memory.core.model import TimeWindow
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader

if TYPE_CHECKING:
    from ros2_memory.columns.table import Table
    from ros2_memory.storage.base import Channel, Record

BAGS = Path(__file__).resolve().parents[3] / "shared" / "bags"
RECORDED = BAGS / "recorded"
REAL = BAGS / "real"

# `tests/conftest.py` skips what is marked so where the path is not there, and counts it.
needs_recorded = pytest.mark.shared(RECORDED)
needs_real = pytest.mark.shared(REAL)

_SAMPLED_ROWS: Final = 12


@cache
def shared_samples(folder: str) -> list[tuple[Table, list[object]]]:
    """Some rows of each topic and type in the shared bags, and their messages."""
    reader = Rosbag2Reader()
    seen: set[tuple[str, str, bytes]] = set()
    found = []
    for path in sorted([*(BAGS / folder).rglob("*.mcap"), *(BAGS / folder).rglob("*.db3")]):
        try:
            groups = map(Group.tables, undecoded(reader, path, skip_undecodable=True))
            tables = {_key_of(table.channel): table for table in chain(*groups)}
        except BagError:
            continue
        new = {
            key: table
            for key, table in tables.items()
            if key not in seen and "" not in table.left_out and len(table)
        }
        seen |= new.keys()
        records: dict[tuple[str, str, bytes], list[Record]] = {key: [] for key in new}
        topics = {table.channel.topic for table in new.values()}
        for record in reader.records(path, topics, TimeWindow.everything()) if topics else ():
            if _key_of(record.channel) in records:
                records[_key_of(record.channel)].append(record)
        found += [_sampled(reader, table, records[key]) for key, table in new.items()]
    return found


def _key_of(channel: Channel) -> tuple[str, str, bytes]:
    return channel.topic, channel.type, channel.schema.text


def _sampled(
    reader: Rosbag2Reader, table: Table, records: list[Record]
) -> tuple[Table, list[object]]:
    rows = np.unique(np.linspace(0, len(table) - 1, _SAMPLED_ROWS).astype(np.int64))
    if len(records) > len(table):
        records = [record for record in records if _is_decodable(reader, record)]
    assert len(records) == len(table)
    return table.rows(rows), [reader.decode(records[row]) for row in rows]


def _is_decodable(reader: Rosbag2Reader, record: Record) -> bool:
    try:
        reader.decode(record)
    except UndecodableError:
        return False
    return True
