"""All tables of a bag in one blob, and tables that unpack a column when it is asked for."""

from __future__ import annotations

import hashlib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from ros2_memory.columns.blob import Entry, pack_table, pack_tables, unpack_tables
from ros2_memory.columns.decode import decoded
from ros2_memory.columns.layout import Layout
from ros2_memory.columns.pack import FORMAT, compressed, decompressed
from ros2_memory.columns.stored import Topic, joined_stored
from ros2_memory.columns.table import Elements, Table, Texts, joined
from ros2_memory.core.errors import BagError
from ros2_memory.storage.base import Channel, Schema
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.shared_bags import BAGS, needs_real

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from ros2_memory.columns.stored import StoredTable
    from ros2_memory.columns.table import Column

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


def stored(given: Table, **how: bool) -> StoredTable:
    layout = Layout.of(given, None)
    blob = pack_tables([Entry(3, layout, given)], **how)
    (back,) = unpack_tables(blob, {3: Topic(CHANNEL, Layout.from_json(layout.to_json()))})
    return back


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


def check(given: Table, back: StoredTable) -> None:
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
            if zone.words is not None:
                folded = "\n".join(dict.fromkeys(word.casefold() for word in column.words))
                assert zone.words == folded
            continue
        numbers: Any = column
        there = numbers[~np.isnan(numbers)]
        assert zone.nulls == len(numbers) - len(there)
        assert zone.least == (there.min() if len(there) else None)
        assert zone.greatest == (there.max() if len(there) else None)


def test_a_table_comes_back_with_all_it_has() -> None:
    given = table()
    back = stored(given)
    assert back.log_times.tolist() == given.log_times.tolist()
    assert back.channel == given.channel
    assert back.left_out == given.left_out
    assert back.payload_hashes is None
    check(given, back)


def test_errors_are_stated_of_what_was_rounded_alone() -> None:
    back = stored(table())
    assert (
        back.error("objects.label")
        == back.error("mode")
        == back.error("objects.hypotheses.")
        == 0.0
    )
    assert 0.0 < back.error("orientation.w") <= 2.5e-5
    assert 0.0 < back.error("objects.position.x") <= 0.5e-4


def test_an_unknown_column_has_no_zone() -> None:
    assert stored(table()).zone("colour") is None
    with pytest.raises(KeyError):
        stored(table()).columns["colour"]


def test_publish_times_come_back_where_payloads_are_hashed() -> None:
    given = table()
    assert stored(given).publish_times.tolist() == given.log_times.tolist()
    hashed = replace(given, payload_hashes=np.arange(len(given)))
    assert stored(hashed).publish_times.tolist() == given.publish_times.tolist()


def test_places_come_back_where_they_are_asked_for() -> None:
    given = table()
    assert stored(given, places=True).places.tolist() == given.places.tolist()
    assert stored(given).places.tolist() == [0] * len(given)


def test_without_places_messages_of_one_log_time_keep_their_order() -> None:
    times = np.array([5, 5, 9])
    one = Table(CHANNEL, times, times, np.array([30, 50, 60]))
    other = Table(CHANNEL, times, times, np.array([40, 20, 70]))
    layout = Layout({})
    blob = pack_tables([Entry(1, layout, one), Entry(2, layout, other)])
    topic = Topic(CHANNEL, layout)
    back = unpack_tables(blob, {1: topic, 2: topic})
    assert [part.places.tolist() for part in back] == [[1, 3, 0], [2, 0, 1]]


def test_hashes_of_payloads_come_back() -> None:
    times = np.array([5, 6, 9])
    given = Table(CHANNEL, times, times, times, payload_hashes=np.array([2**32 - 1, 0, 77]))
    hashes = stored(given).payload_hashes
    assert hashes is not None
    assert hashes.tolist() == [2**32 - 1, 0, 77]


def test_tables_that_are_not_wanted_need_no_layout() -> None:
    layout = Layout.of(table(), None)
    blob = pack_tables([Entry(1, layout, table(3)), Entry(2, layout, table(5))])
    (back,) = unpack_tables(blob, {2: Topic(CHANNEL, layout)}, lambda number: number == 2)
    check(table(5), back)


def test_a_table_without_rows_comes_back() -> None:
    check(table(0), stored(table(0)))
    check(table(1), stored(table(1)))


def test_a_blob_without_tables_is_one() -> None:
    assert unpack_tables(pack_tables([]), {}) == []


def test_a_table_of_another_layout_is_refused() -> None:
    layout = Layout.of(table(), None)
    with pytest.raises(ValueError, match="other columns"):
        pack_tables([Entry(1, Layout({}), table())])
    with pytest.raises(ValueError, match="other columns"):
        pack_table(Layout(layout.columns, layout.sequences), table())
    with pytest.raises(ValueError, match="other columns"):
        unpack_tables(pack_tables([Entry(1, layout, table())]), {1: Topic(CHANNEL, Layout({}))})


def test_a_blob_of_another_format_is_refused() -> None:
    raw = decompressed(pack_tables([]))
    with pytest.raises(ValueError, match="format"):
        unpack_tables(compressed(bytes([FORMAT + 1]) + raw[1:]), {})


def test_layouts_read_what_they_write() -> None:
    layout = Layout.of(table(), None)
    assert Layout.from_json(layout.to_json()) == layout
    for text in ("", "[]", "{}", '{"columns": {"x": "float64 coarse"}}', '{"columns": 3}'):
        with pytest.raises(ValueError, match=r"Expecting|no step|not the layout"):
            Layout.from_json(text)


def test_columns_are_unpacked_once_by_whoever_asks_first() -> None:
    back = stored(table(2_000))
    with ThreadPoolExecutor(2) as threads:
        found = list(threads.map(lambda _: dict(leaves(back)), range(8)))
    for path, column in found[0].items():
        assert all(differences(column, other[path]) == 0.0 for other in found)
    assert back.columns["speed"] is back.columns["speed"]


def test_tables_that_are_joined_and_packed_again_know_their_first_errors_and_zones() -> None:
    given = [table(40), table(60, 40), table(1, 99)]
    whole = joined_stored([stored(part) for part in given])
    again = stored(whole)
    exact = joined(given)
    for path, column in leaves(exact):
        if not path.endswith("#"):
            assert differences(column, dict(leaves(whole))[path]) <= whole.error(path)
            assert differences(column, dict(leaves(again))[path]) <= again.error(path)
            assert again.zone(path) == whole.zone(path) == stored(exact).zone(path)
    assert again.error("orientation.w") >= whole.error("orientation.w") > 0.0


def test_a_column_that_rounded_to_one_value_is_packed_again_as_that_value() -> None:
    times = np.arange(3)
    positions: Mapping[str, Column] = {"position.x": np.array([1.00001, 1.00002, 1.00004])}
    once = stored(Table(CHANNEL, times, times, times, positions))
    again = stored(joined_stored([once, once]))
    assert np.asarray(once.columns["position.x"]).tolist() == [1.0] * 3
    assert np.asarray(again.columns["position.x"]).tolist() == [1.0] * 6
    zone = again.zone("position.x")
    assert zone is not None
    assert zone.least == 1.00001
    assert again.error("position.x") >= 0.00004 - 1e-12


@needs_real
@pytest.mark.parametrize(
    "path", sorted(BAGS.glob("*/*/*.mcap")), ids=lambda path: f"{path.parent.name}-{path.stem}"
)
def test_tables_of_shared_bags_come_back(path: Path) -> None:
    reader = McapReader()
    groups = decoded(reader, path, hashed=lambda channel: len(channel.topic) % 2 == 0)
    while True:
        try:
            tables = next(groups, None)
        except BagError:
            continue
        if tables is None:
            return
        entries = [
            Entry(nth, Layout.of(some, reader.definition(some.channel)), some)
            for nth, some in enumerate(tables)
        ]
        topics = {nth: Topic(some.channel, layout) for nth, layout, some in entries}
        back = unpack_tables(pack_tables(entries), topics)
        for some, other in zip(tables, back, strict=True):
            assert other.log_times.tolist() == some.log_times.tolist()
            published = some.log_times if some.payload_hashes is None else some.publish_times
            assert other.publish_times.tolist() == published.tolist()
            check(some, other)


def test_blobs_of_this_format_do_not_change() -> None:
    layout = Layout.of(table(), None)
    hashed = replace(table(), payload_hashes=np.arange(len(table())) * 7919)
    raw = decompressed(pack_tables([Entry(1, layout, table()), Entry(2, layout, hashed)]))
    assert (FORMAT, hashlib.sha256(raw).hexdigest()[:16]) == (1, "eebae0cf046d63d9"), (
        "blobs are other bytes than before: raise FORMAT in columns/pack.py, so that stores are "
        "filled anew, and pin the new number and hash here"
    )
