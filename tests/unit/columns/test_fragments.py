"""What follows from parts: stored once, by stretches of the clock, found by other processes."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from ros2_memory.columns import scan
from ros2_memory.columns.fragments import FragmentKind, from_bytes, to_bytes
from ros2_memory.columns.pack import compress
from ros2_memory.columns.scan import Stretch
from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MAX_NS, NS_PER_S
from ros2_memory.history.context import Call
from ros2_memory.history.driven_path import slices_of_path
from ros2_memory.history.scan import joined_back, open_scan
from ros2_memory.history.view import View
from tests.support.bags import Msg, odom, tf_of, write_mcap
from tests.support.column_worlds import EVERYTHING, World, store_file
from tests.support.examples import examples

S = NS_PER_S
T0 = 1_700_000_400 * S


class Words(NamedTuple):
    """A value to store: some words."""

    words: str

    @property
    def memory_bytes(self) -> int:
        return 100


WORDS: FragmentKind[Words] = FragmentKind("words", (Words,))


def counted(bag_dir: Path, where: str, *given: bytes) -> int:
    with closing(sqlite3.connect(store_file(bag_dir))) as base:
        query = f"SELECT count(*) FROM fragment WHERE {where}"  # noqa: S608 - constants
        return int(base.execute(query, given).fetchone()[0])


@dataclass(frozen=True, slots=True)
class Whole:
    """A value of whatever a fragment may consist of."""

    words: Words | None
    data: bytes
    rows: tuple[object, ...]
    arrays: dict[str, NDArray[Any]]


arrays = st.sampled_from(["int64", "uint64", "uint32", "float64", "float32", "bool"]).flatmap(
    lambda name: hnp.arrays(
        name,
        st.sampled_from([(0,), (7,), (300,), (100, 3), (7, 2, 40)]),
        elements=hnp.from_dtype(np.dtype(name)),
        fill=st.sampled_from([0, 1]) if name != "bool" else st.booleans(),
    )
)

values = st.integers() | st.floats(allow_nan=False) | st.text() | st.none()

words = st.none() | st.builds(Words, st.text())

rows = st.one_of(
    [
        st.lists(row).map(tuple)
        for row in (values, words, words | values, st.tuples(words, values), st.just(()))
    ]
)

wholes = st.builds(
    Whole,
    words,
    st.binary(),
    rows,
    st.dictionaries(st.text(), arrays | st.just(np.arange(1000) / 10_000), max_size=3),
)


@settings(max_examples=examples(60), suppress_health_check=[HealthCheck.too_slow])
@given(wholes)
def test_a_fragment_is_the_same_once_it_was_stored(whole: Whole) -> None:
    classes = (Whole, Words)
    found = from_bytes(to_bytes(whole, classes), classes)
    assert isinstance(found, Whole)
    assert replace(found, arrays={}) == replace(whole, arrays={})
    for (name, array), (own, back) in zip(whole.arrays.items(), found.arrays.items(), strict=True):
        assert name == own
        assert (back.dtype, back.shape) == (array.dtype, array.shape)
        assert back.flags.c_contiguous
        np.testing.assert_array_equal(back, array)
        if array.dtype.kind == "f":
            assert np.array_equal(np.signbit(back[array == 0]), np.signbit(array[array == 0]))


@given(st.lists(st.none() | st.integers(0, 400), min_size=1))
def test_arrays_in_rows_are_the_same_once_they_were_stored(sizes: list[int | None]) -> None:
    stored = tuple(None if size is None else np.ones((size, 2)) * size for size in sizes)
    found = from_bytes(to_bytes(Whole(None, b"", stored, {}), (Whole,)), (Whole,))
    assert isinstance(found, Whole)
    for array, back in zip(stored, found.rows, strict=True):
        np.testing.assert_array_equal(array, back)


def test_a_damaged_fragment_is_made_again_and_takes_its_place(tmp_path: Path) -> None:
    for number in range(10):
        write_mcap(tmp_path / "rec" / f"rec_{number}.mcap", driven(number))
    world = World.of(tmp_path)
    world.fill()
    world.store.close()
    before = counted(tmp_path, "1")
    for data in (b"\0", compress(b"[]\n"), compress(b"[0]"), b""):
        with closing(sqlite3.connect(store_file(tmp_path), isolation_level=None)) as base:
            base.execute("UPDATE fragment SET data = ?", (data,))
        damaged = "kind LIKE 'path %' AND data = ?"
        assert counted(tmp_path, damaged, data) > 0
        again = World.of(tmp_path)
        slices = slices_of_path(View(again.memory, Call()), "/odom", EVERYTHING, [])
        assert sum(path.poses for _, path in slices) == 600
        again.memory.scanner.write_fragments()
        again.store.close()
        assert counted(tmp_path, damaged, data) == 0
        assert counted(tmp_path, "1") == before


def driven(number: int) -> list[Msg]:
    """Odometry of 300 s."""
    return [odom(T0 + (number * 60 + n) * 5 * S, number + n / 300, 0.1) for n in range(60)]


@patch.object(scan, "STRETCH_NS", 1200 * S)
def test_what_was_made_in_time_is_told_before_the_time_is_over(tmp_path: Path) -> None:
    for number in range(12):
        write_mcap(tmp_path / f"rec_{number // 6}" / f"{number}.mcap", driven(number))
    world = World.of(tmp_path)
    world.fill()
    view = View(world.memory, Call())
    opened = open_scan(view, "/odom", TimeWindow(T0, T0 + 3600 * S))

    def made(stretch: Stretch) -> Iterator[tuple[int, Words]]:
        yield stretch.window.start, Words("one")
        if stretch.parts is not None:
            raise QueryTimeoutError("no time")

    found: list[int] = []
    with pytest.raises(QueryTimeoutError):
        found += (start for start, _ in joined_back(view, opened, WORDS, made))
    newest = next(one for one in opened.stretches() if one.parts is not None)
    assert found[-1] == newest.window.start


def test_stretches_follow_each_other_up_to_a_message_dated_at_the_end_of_64_bits(
    tmp_path: Path,
) -> None:
    write_mcap(tmp_path / "rec" / "0.mcap", driven(0))
    write_mcap(tmp_path / "far" / "0.mcap", [replace(driven(0)[0], log_time=MAX_NS - 1)])
    world = World.of(tmp_path)
    world.fill()
    stretches = open_scan(View(world.memory, Call()), "/odom", EVERYTHING).stretches()
    edges = [EVERYTHING.stop, *(stretch.window.start for stretch in stretches)]
    assert edges == sorted(edges, reverse=True)
    assert [stretch.window.stop for stretch in stretches] == edges[:-1]
    assert edges[-1] == EVERYTHING.start


def test_what_could_not_be_decoded_is_said_again_of_what_is_stored(tmp_path: Path) -> None:
    for number in range(14):
        start = T0 + number * 300 * S
        fixed = tf_of(start, "map", "odom", (1, 0, 0), topic="/tf_static")
        torn = Msg("/tf_static", "tf2_msgs/msg/TFMessage", start + S, b"\0\1\0\0\xff\xff\xff\x7f")
        messages = [fixed, *[torn] * (number == 2), *driven(number)]
        write_mcap(tmp_path / "rec" / f"{number}.mcap", messages)
    world = World.of(tmp_path)
    world.fill()
    for memory in (world.unstored().memory, world.memory, World.of(tmp_path).memory):
        view = View(memory, Call())
        assert view.sessions.static(view.sessions.session_of(tmp_path / "rec"))
        assert not view.notes.complete
        [said] = [one for one in view.notes.sentences() if "could not be decoded" in one]
        assert said.startswith("messages of /tf_static could not be decoded: ")
