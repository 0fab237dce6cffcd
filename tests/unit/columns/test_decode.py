"""Decoding whole bags as columns, compared with rosbags leaf by leaf."""

import random
import struct
import tempfile
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.storage.mcap_reader import McapReader
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
from tests.support.examples import LONG, examples
from tests.support.leaves import Comparison
from tests.support.shared_bags import REAL, needs_real
from tests.unit.columns.decoded_bags import bag_of, decoded_alike, tables_of
from tests.unit.columns.drawn_tables import message_in
from tests.unit.columns.drawn_types import DrawnTypes, drawn_types


def bags_below(folder: Path) -> list[Path]:
    """The bags of a folder: of a short run those of which there is one of a kind."""
    reader = Rosbag2Reader()
    files = sorted(file for file in folder.rglob("*") if file.is_file() and reader.reads(file))
    if LONG:
        return files
    first = {file.parent: file for file in reversed(files)}
    return sorted(file for file in first.values() if file.stat().st_size < 120_000)


@needs_real
@pytest.mark.parametrize("path", bags_below(REAL), ids=lambda path: path.name)
def test_bags_of_public_robots_are_decoded_as_rosbags_does(
    path: Path, fallbacks: list[str]
) -> None:
    decoded_alike(Rosbag2Reader(), path)
    assert fallbacks == []


@settings(max_examples=examples(75))
@given(
    types=drawn_types(),
    seed=st.integers(0, 2**32),
    longest=st.sampled_from((0, 1, 3, 12)),
    is_little=st.sampled_from((True, True, True, False)),
    is_idl=st.booleans(),
)
def test_messages_of_any_definition_are_decoded_as_rosbags_does(
    types: DrawnTypes, seed: int, longest: int, is_little: bool, is_idl: bool
) -> None:
    chance = random.Random(seed)
    store = types.store()
    payloads = [
        bytes(
            store.serialize_cdr(
                message_in(store, types.root, chance, longest=longest),
                types.root,
                little_endian=is_little,
            )
        )
        for _ in range(chance.randint(1, 6))
    ]
    if sum(map(len, payloads)) > 1 << 20:
        return
    with tempfile.TemporaryDirectory() as folder:
        path = bag_of(Path(folder) / "drawn.mcap", types, payloads, is_idl=is_idl)
        reader = McapReader()
        [table] = tables_of(reader, path)
        assert table.left_out.get("") is None
        comparison = Comparison()
        comparison.table(table, [store.deserialize_cdr(each, types.root) for each in payloads])
        assert comparison.wrong == []


@settings(max_examples=examples(75))
@given(types=drawn_types(), seed=st.integers(0, 2**32))
def test_damaged_payloads_are_decoded_or_left_out_as_rosbags_decides(
    types: DrawnTypes, seed: int
) -> None:
    chance = random.Random(seed)
    store = types.store()
    payloads = []
    for _ in range(4):
        payload = bytearray(
            store.serialize_cdr(message_in(store, types.root, chance, longest=3), types.root)
        )
        at = chance.randrange(4, max(len(payload), 5))
        match chance.randrange(5):
            case 0:
                del payload[at:]
            case 1:
                payload[at : at + 4] = struct.pack("<I", chance.choice((2**32 - 1, 40, 0, 2**31)))
            case 2:
                payload += bytes(chance.randrange(9))
            case 3:
                payload[at:] = bytes([chance.choice((0, 1, 255, 65))]) * (len(payload) - at)
            case _:
                pass
        payloads.append(bytes(payload))
    with tempfile.TemporaryDirectory() as folder:
        path = bag_of(Path(folder) / "damaged.mcap", types, payloads)
        decoded_alike(McapReader(), path)
