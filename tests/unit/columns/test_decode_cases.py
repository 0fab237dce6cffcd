"""What decoding a bag as columns does with long, hostile, many, odd and bulky messages."""

import random
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
import pytest

from ros2_memory.columns import decode
from ros2_memory.columns.decode import Group, undecoded
from ros2_memory.columns.stored import columns_in
from ros2_memory.columns.table import UNHASHED, Table, Texts, order_of
from ros2_memory.core.errors import BagError
from ros2_memory.storage.base import Channel
from ros2_memory.storage.mcap import bulk
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import (
    McapLayout,
    Msg,
    detections,
    header,
    make,
    odom,
    point,
    quaternion,
    text,
    tf,
    write_mcap,
)
from tests.support.bags import transform as transform_of
from tests.support.examples import examples
from tests.support.leaves import Comparison
from tests.support.mcap_surgery import SMALL, chatter, spoil_chunk
from tests.unit.columns.decoded_bags import (
    bag_of,
    compared,
    tables_of,
)
from tests.unit.columns.drawn_tables import message
from tests.unit.columns.drawn_types import DrawnField, DrawnTypes


def path_message(ns: int, points: int) -> Msg:
    """A path whose poses have frames of various lengths, and which something follows in a type."""
    kind, turn = "geometry_msgs/msg/PoseStamped", quaternion(0.1)
    poses = []
    for nth in range(points):
        pose = make("geometry_msgs/msg/Pose", position=point(nth, 0.5), orientation=turn)
        frame = "map" if nth % 3 else "odometry"
        poses.append(make(kind, header=header(ns + nth, frame), pose=pose))
    made = make("nav_msgs/msg/Path", header=header(ns, "map"), poses=poses)
    return Msg("/plan", "nav_msgs/msg/Path", ns, made)


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


def test_small_groups_hold_together_what_one_group_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    messages = []
    for nth in range(40):
        parts = [transform_of(nth, "odom", f"link{n}", (0.0, 1.0, n)) for n in range(nth % 3)]
        messages += [
            odom(nth * 10, nth / 7, -1.0),
            tf(nth * 10 + 1, *parts),
            text(nth * 10 + 2, f"text {nth // 4}"),
            detections(nth * 10 + 3, ["cup", "person"][: nth % 3]),
        ]
    # Out of order, so that later groups reach back in time.
    messages = [*messages[:50], *messages[90:], *messages[50:90]]
    path = write_mcap(tmp_path / "a.mcap", messages, McapLayout(chunk_size=1500))
    [whole] = groups_of(path)
    monkeypatch.setattr(decode, "GROUP_BYTES", 1)
    assert len(list(groups_of(path))) == 1  # one buffer
    monkeypatch.setattr(decode, "GROUP_BYTES", 8000)
    monkeypatch.setattr(bulk, "BATCH_BYTES", 4000)
    assert len(list(groups_of(path))) > 5
    tables = tables_of(McapReader(), path)
    assert compared(McapReader(), path, tables).wrong == []
    assert {len(table) for table in tables} == {len(table) for table in whole}


def drawn_bag(path: Path, draw: random.Random) -> Path:
    """Some messages of few times and odd payloads, in chunks of any size, some latched."""
    payloads = [text(0, "ok").payload, text(0, "a long text").payload, b"", b"\0\3\0\0\2\0\0\0a\0"]
    messages: list[Msg] = []
    for _ in range(draw.randrange(25)):
        time, nth = draw.randrange(6), draw.choice([0, 0, 0, 1, 1, 2, 3])
        messages += draw.choice(
            [
                [Msg("/chatter", "std_msgs/msg/String", time, payloads[nth])],
                [odom(time, draw.random(), 0.0), path_message(time, draw.choice([0, 5, 40]))],
                [detections(time, ["cup", "person"][: draw.randrange(3)])],
            ]
        )
    latched = frozenset(draw.sample(["/chatter", "/plan", "/odom"], draw.randrange(3)))
    chunk_size = draw.choice([50, 600, 100_000])
    return write_mcap(path, messages, McapLayout(chunk_size=chunk_size, latched=latched))


def is_hashed(channel: Channel, *, every: bool) -> bool:
    return every or channel.latched


def rows_by_bag(tables: Iterable[Table], bag: int | None = None) -> dict[object, object]:
    """By bag and topic the rows; those of all tables are of `bag`, if it is given."""
    rows: dict[object, object] = {}
    for table in tables:
        for number in np.unique(table.bag_numbers).tolist():
            part = table.rows(np.flatnonzero(table.bag_numbers == number))
            hashes = np.full(len(part), UNHASHED)
            hashes = hashes if part.payload_hashes is None else part.payload_hashes
            times = [part.log_times, part.publish_times, part.places, hashes]
            columns = {
                path: column.values() if isinstance(column, Texts) else column.tolist()
                for path, column in columns_in(part)
            }
            key = (number if bag is None else bag, part.channel.topic, part.channel.latched)
            assert key not in rows
            reason = part.left_out.get("")
            rows[key] = reason, repr([column.tolist() for column in times]), repr(columns)
    return rows


def test_bags_that_are_decoded_together_have_the_rows_that_each_has_alone(tmp_path: Path) -> None:
    reader = McapReader()
    for seed in range(examples(60)):
        draw = random.Random(seed)
        paths = [
            drawn_bag(tmp_path / f"{seed}_{n}.mcap", draw) for n in range(draw.randrange(1, 5))
        ]
        together = Group(reader, draw.random() < 0.4)
        alone: dict[object, object] = {}
        read = partial(undecoded, reader, skip_undecodable=together.skip_undecodable)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(decode, "_HELD_BYTES", draw.choice([1, 300, 2000, 4 << 20]))
            for nth, path in enumerate(paths):
                hashed = partial(is_hashed, every=draw.random() < 0.5)
                for group in read(path, hashed=hashed, number=nth):
                    together.take(group)
                for group in read(path, hashed=hashed):
                    alone |= rows_by_bag(group.tables(), nth)
            tables = together.tables()
        orders = [order_of(table.log_times, table.bag_numbers, table.places) for table in tables]
        assert orders == [None] * len(tables)
        assert rows_by_bag(tables) == alone, seed


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
