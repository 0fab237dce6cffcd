"""Parts, whose columns are unpacked when they are asked for, and their layouts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ros2_memory.columns.layout import Layout
from ros2_memory.columns.pack import decompressed, unpack
from ros2_memory.columns.stored import lazy_columns
from ros2_memory.columns.table import Column, Elements, Table, Texts, column_bytes, joined
from ros2_memory.columns.writing import pack_rows
from ros2_memory.storage.base import Channel, Schema

CHANNEL = Channel("/objects", "cdr", Schema("demo_msgs/msg/Objects"))


def table(rows: int = 40, first: int = 0) -> Table:
    """Objects with labels, places and texts, in sequences of sequences."""
    nth, twice = np.arange(first, first + rows), np.arange(2 * rows)
    words = Elements(twice, {"": Texts.of([f"Word {n % 3}" for n in range(2 * rows)])})
    objects = Elements(
        twice // 2,
        {"label": Texts.of(["Cup", "chair"] * rows), "length": twice % 7},
        {"hypotheses": words, "hypotheses2.inner": words},
    )
    return Table(
        CHANNEL,
        nth * 20_000_000,
        nth * 20_000_000 - 1_000,
        nth * 100,
        {
            "speed": nth / 3.0,
            "mode": np.full(rows, 7, np.uint8),
            "header.frame_id": Texts.of(["map"] * rows),
            "ranges.length": np.full(rows, 2, np.uint32),
        },
        {"objects": objects, "ranges": Elements(twice // 2, {"": twice / 4.0})},
        {"image": "images have no columns"},
    )


def unpacked(*given: Table) -> Table:
    """The tables as they come back from a part."""
    layout = Layout.of(given[0], None)
    rows = joined([replace(one, bags=np.full(len(one), nth)) for nth, one in enumerate(given)])
    packed = pack_rows(layout, rows, rows.bag_numbers).columns

    def load(path: str) -> Column:
        one = packed[path]
        data = decompressed(one.data) if one.data else b""
        return unpack(one.codec, one.count, one.zone.least, data)

    columns, elements = lazy_columns(Layout.from_json(layout.to_json()), load, ())
    return replace(joined(given), columns=columns, elements=elements)


def test_what_is_unpacked_of_a_constant_column_is_one_value() -> None:
    back = unpacked(table(rows=1000))
    assert column_bytes(back.columns["mode"]) == 1
    assert column_bytes(back.columns["header.frame_id"]) < 100
    assert column_bytes(back.columns["speed"]) == 8 * 1000
    assert back.columns["speed"] is back.columns["speed"]
