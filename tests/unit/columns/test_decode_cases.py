"""What decoding a bag as columns does with long, hostile, many, odd and bulky messages."""

import random
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
import pytest

from ros2_memory.columns import decode
from ros2_memory.columns.decode import Group, undecoded
from ros2_memory.columns.table import Table
from ros2_memory.core.errors import BagError
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import (
    McapLayout,
    Msg,
    text,
    write_mcap,
)
from tests.support.leaves import Comparison
from tests.support.mcap_surgery import SMALL, chatter, spoil_chunk
from tests.unit.columns.decoded_bags import (
    bag_of,
    tables_of,
)
from tests.unit.columns.drawn_tables import message
from tests.unit.columns.drawn_types import DrawnField, DrawnTypes


def groups_of(path: Path) -> Iterator[list[Table]]:
    return map(Group.tables, undecoded(McapReader(), path))


def numbers(table: Table, path: str) -> list[object]:
    column = table.columns[path]
    assert isinstance(column, np.ndarray)
    return list(column.tolist())


LONG_TYPES: Final = DrawnTypes(
    (
        ("Point", (DrawnField("x", "float64"), DrawnField("kind", "uint8"))),
        ("Named", (DrawnField("label", "string"), DrawnField("points", "Point", -1))),
        (
            "Long",
            (
                DrawnField("points", "Point", -1),
                DrawnField("named", "Named", -1),
                DrawnField("scan", "float32", -1),
                DrawnField("answer", "int32"),
            ),
        ),
    )
)


@pytest.mark.parametrize("rows", [1, 40])
def test_what_follows_long_sequences_is_read_where_it_is(
    tmp_path: Path, rows: int, fallbacks: list[str]
) -> None:
    store = LONG_TYPES.store()
    named, part, long = (
        store.types[f"drawn_msgs/msg/{name}"] for name in ("Named", "Point", "Long")
    )
    messages = [
        long(
            [part(float(nth), nth % 200) for nth in range(700 + row)],
            [named("n" * (nth % 7), [part(0.5, 1)] * (nth % 4)) for nth in range(30)],
            np.arange(2000 - row, dtype=np.float32),
            42,
        )
        for row in range(rows)
    ]
    payloads = [bytes(store.serialize_cdr(each, LONG_TYPES.root)) for each in messages]
    path = bag_of(tmp_path / "long.mcap", LONG_TYPES, payloads)
    reader = McapReader()
    [table] = tables_of(reader, path)
    comparison = Comparison()
    comparison.table(table, messages)
    assert comparison.wrong == []
    assert numbers(table, "answer") == [42] * rows
    assert len(table.elements["named"].elements["points"]) == rows * 43
    assert numbers(table, "scan.length")[0] == 2000
    assert fallbacks == []


def test_images_have_times_alone_and_their_chunks_are_not_read(tmp_path: Path) -> None:
    kind = "sensor_msgs/msg/Image"
    images = [Msg("/camera", kind, time, message(kind, random.Random(1))) for time in range(10)]
    messages = [*images, *(text(time, "x") for time in range(10, 20))]
    path = write_mcap(tmp_path / "a.mcap", messages, McapLayout(chunk_size=1000))
    spoil_chunk(path, 0)
    [tables] = groups_of(path)
    by_topic = {table.channel.topic: table for table in tables}
    assert by_topic["/camera"].log_times.tolist() == list(range(10))
    assert by_topic["/camera"].columns == {}
    assert "" in by_topic["/camera"].left_out
    assert len(by_topic["/chatter"]) == 10


def test_large_messages_of_large_files_have_times_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    messages = [text(1, "x" * 100_000, "/long"), text(2, "x", "/short")]
    path = write_mcap(tmp_path / "a.mcap", messages)
    [tables] = groups_of(path)
    assert all(table.columns for table in tables)
    monkeypatch.setattr(decode, "LARGE_FILE_BYTES", 1000)
    [tables] = groups_of(path)
    assert {table.channel.topic: bool(table.columns) for table in tables} == {
        "/long": False,
        "/short": True,
    }


def test_an_array_longer_than_any_message_has_no_columns(tmp_path: Path) -> None:
    endless = DrawnTypes((("Endless", (DrawnField("numbers", "float64", 10**18),)),))
    [[table]] = groups_of(bag_of(tmp_path / "a.mcap", endless, [b"\0\1\0\0\7"]))
    assert table.log_times.tolist() == [10]
    assert f"numbers is an array of {10**18} elements" in table.left_out[""]


@pytest.mark.parametrize("broken", [[], [b"\x00\x01\x00\x00\xff\xff\xff\x7f"]])
def test_what_a_damaged_chunk_loses_is_raised_and_all_the_rest_follows(
    tmp_path: Path, broken: list[bytes]
) -> None:
    """Also where a message of it cannot be decoded."""
    messages = [*chatter(20), *(Msg("/chatter", "std_msgs/msg/String", 20, b) for b in broken)]
    path = write_mcap(tmp_path / "a.mcap", messages, SMALL)
    spoil_chunk(path, 1)
    groups = groups_of(path)
    with pytest.raises(BagError) as caught:
        next(groups)
    assert caught.value.lost is not None
    [table] = next(groups)
    first, last = caught.value.lost
    assert ("cannot be decoded" in table.left_out.get("", "")) is bool(broken)
    assert set(table.log_times.tolist()) == {*range(len(messages))} - {*range(first, last + 1)}
    assert list(groups) == []
