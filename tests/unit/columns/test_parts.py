"""Parts, whose columns are unpacked when they are asked for."""

from __future__ import annotations

import gc
import weakref
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from ros2_memory.columns.decode import decoded, pieces
from ros2_memory.columns.layout import Layout
from ros2_memory.columns.pack import decompressed, folded, unpack
from ros2_memory.columns.parts import packed_part, part_table
from ros2_memory.columns.stored import StoredTable, Topic
from ros2_memory.columns.table import Column, Elements, Table, Texts, column_bytes, joined
from ros2_memory.core.errors import BagError
from ros2_memory.storage.base import Channel, Schema
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.shared_bags import BAGS, needs_real

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


START = 1_768_176_000_000_000_000
CHANNEL = Channel("/objects", "cdr", Schema("demo_msgs/msg/Objects"))


def table(rows: int = 40, first: int = 0) -> Table:
    """Objects with labels, places and texts, in sequences of sequences."""
    nth = np.arange(first, first + rows)
    log_times = START + nth * 20_000_000 + nth * 7919 % 4001
    owners = np.repeat(np.arange(rows), 2)
    hypotheses = Elements(
        np.arange(2 * rows), {"": Texts.of([f"Word {n % 3}" for n in range(2 * rows)])}
    )
    objects = Elements(
        owners,
        {
            "label": Texts.of([("Cup", "chair")[n % 2] for n in range(2 * rows)]),
            "position.x": np.sqrt(np.arange(2 * rows) + first),
        },
        {"hypotheses": hypotheses},
    )
    return Table(
        CHANNEL,
        log_times,
        log_times - 1_000 - nth * 31 % 77,
        nth * 100,
        {
            "speed": np.sqrt(nth + 0.3).astype(np.float32),
            "orientation.w": 1.0 / (1.0 + nth),
            "charge": np.where(nth % 5, nth / 3, np.nan),
            "is_moving": nth % 4 > 1,
            "mode": np.full(rows, 7, np.uint8),
            "header.frame_id": Texts.of(["map"] * rows),
        },
        {"objects": objects},
        {"image": "images have no columns"},
    )


def part(*given: Table) -> StoredTable:
    """The tables as they come back from a part."""
    layout = Layout.of(given[0], None)
    numbered = [(one, np.full(len(one), number)) for number, one in enumerate(given)]
    packed = packed_part(layout, numbered).columns

    def load(path: str) -> Column:
        one = packed[path]
        data = decompressed(one.data) if one.data else b""
        return unpack(one.codec, one.count, one.zone.least, data)

    topic = Topic(CHANNEL, Layout.from_json(layout.to_json()))
    messages = sum(map(len, given))
    return part_table(topic, packed.get, load, messages=messages)


def differences(column: Column, back: Column) -> float:
    """The greatest absolute difference of numbers; infinite where others differ at all."""
    if isinstance(column, Texts) or isinstance(back, Texts):
        assert isinstance(column, Texts)
        assert isinstance(back, Texts)
        return 0.0 if column.values() == back.values() else np.inf
    assert column.dtype == back.dtype
    numbers: Any = column
    others: Any = back
    same = (numbers == others) | (np.isnan(numbers) & np.isnan(others))
    if same.all():
        return 0.0
    return float(np.abs(numbers[~same].astype(float) - others[~same].astype(float)).max())


def leaves(rows: Table | Elements, around: str = "") -> Iterator[tuple[str, Column]]:
    for path, column in rows.columns.items():
        yield f"{around}{path}", column
    for path, elements in rows.elements.items():
        yield f"{around}{path}#", elements.owners
        yield from leaves(elements, f"{around}{path}.")


def check_part(given: Table, back: StoredTable) -> None:
    """All columns are within the stated errors, and zones are those of the given ones."""
    others = dict(leaves(back))
    assert dict(leaves(given)).keys() == others.keys()
    for path, column in leaves(given):
        if path.endswith("#"):
            assert differences(column, others[path]) == 0.0
            continue
        assert differences(column, others[path]) <= back.error(path)
        zone = back.zone(path)
        assert zone is not None
        if isinstance(column, Texts):
            assert zone.words == folded(column.words)
            continue
        numbers: Any = column
        there = numbers[~np.isnan(numbers)]
        assert zone.nulls == len(numbers) - len(there)
        assert zone.least == (there.min() if len(there) else None)
        assert zone.greatest == (there.max() if len(there) else None)


def test_a_part_states_its_zones_and_the_errors_of_what_was_rounded_alone() -> None:
    given = table()
    back = part(given)
    check_part(given, back)
    assert back.error("objects.label") == back.error("mode") == 0.0
    assert back.error("objects.hypotheses.") == 0.0
    assert 0.0 < back.error("orientation.w") <= 2.5e-5
    assert 0.0 < back.error("objects.position.x") <= 0.5e-4


def test_what_is_unpacked_of_a_constant_column_is_one_value() -> None:
    back = part(table(rows=1000))
    assert column_bytes(back.columns["mode"]) == 1
    assert column_bytes(back.columns["header.frame_id"]) < 100
    assert column_bytes(back.columns["speed"]) == 4 * 1000


def test_a_table_is_freed_when_nobody_holds_it_without_the_garbage_collector() -> None:
    """Each question opens thousands of them."""

    def load(path: str) -> Column:
        return loaded.pop(path)

    loaded: dict[str, Column] = {"objects#": np.arange(3), "objects.label": Texts.of(["cup"] * 3)}
    told, loads = Topic(CHANNEL, Layout.of(table(), None)), weakref.ref(load)
    gc.disable()
    try:
        back = part_table(told, lambda _: None, load, messages=3)
        assert back.elements["objects"].columns["label"]
        del back, load
        assert loads() is None
    finally:
        gc.enable()


def test_a_part_of_several_tables_is_that_of_all_their_rows() -> None:
    given = [table(40), table(60, 40), table(1, 99)]
    check_part(joined(given), part(*given))


def test_a_table_of_another_layout_is_refused() -> None:
    layout = Layout.of(table(), None)
    with pytest.raises(ValueError, match="other columns"):
        packed_part(Layout(layout.columns, layout.sequences), [(table(), np.ones(40, np.int64))])


def test_layouts_read_what_they_write() -> None:
    layout = Layout.of(table(), None)
    assert Layout.from_json(layout.to_json()) == layout
    for text in ("", "[]", "{}", '{"columns": {"x": "float64 coarse"}}', '{"columns": 3}'):
        with pytest.raises(ValueError, match=r"Expecting|no step|not the layout"):
            Layout.from_json(text)


def test_columns_are_unpacked_once_by_whoever_asks_first() -> None:
    back = part(table(2_000))
    with ThreadPoolExecutor(2) as threads:
        found = list(threads.map(lambda _: dict(leaves(back)), range(8)))
    for path, column in found[0].items():
        assert all(differences(column, other[path]) == 0.0 for other in found)
    assert back.columns["speed"] is back.columns["speed"]


@needs_real
@pytest.mark.parametrize(
    "path", sorted(BAGS.glob("*/*/*.mcap")), ids=lambda path: f"{path.parent.name}-{path.stem}"
)
def test_tables_of_shared_bags_come_back(path: Path) -> None:
    reader = McapReader()
    groups = decoded(reader, pieces(reader, path))
    while True:
        try:
            tables = next(groups, None)
        except BagError:
            continue
        if tables is None:
            return
        for some in tables:
            if len(some):
                check_part(some, part(some))
