"""A clock that is set back while one bag is being written."""

import struct
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import IndexType

from ros2_memory.history.context import Call
from ros2_memory.history.view import TimeRange
from ros2_memory.queries import data_time_range, topic_range
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import McapLayout, Msg, odom, text, write_mcap
from tests.support.examples import examples
from tests.support.mcap_surgery import chunks_of
from tests.support.memories import asked, memory_of

S: Final = 10**9
T0: Final = 1_784_000_000 * S
STEP: Final = 30
CRC_AT: Final = 9 + 3 * 8
"""Of a chunk's checksum, behind its length, two times and a size."""
LAYOUTS: Final = {
    "indexed": McapLayout(chunk_size=200),
    "without indexes": McapLayout(chunk_size=200, index_types=IndexType.NONE),
    "cut off": McapLayout(chunk_size=200, finish=False),
    "without chunks": McapLayout(chunk_size=None),
}


def message(seconds: float) -> Msg:
    return text(T0 + round(seconds * S), "x" * 100)


def set_back(path: Path, messages: list[Msg], layout: McapLayout) -> int:
    write_mcap(path, messages, layout)
    by, _ = McapReader().summarize(path).schema.set_back or (0, 0)
    return by


@pytest.fixture(params=list(LAYOUTS))
def layout(request: pytest.FixtureRequest) -> McapLayout:
    return LAYOUTS[request.param]


@settings(max_examples=examples(40), deadline=None)
@given(
    times=st.lists(st.integers(0, 100), min_size=1, max_size=30),
    name=st.sampled_from(list(LAYOUTS)),
)
def test_it_is_never_more_than_the_times_of_a_topic_go_back(times: list[int], name: str) -> None:
    most = max(max(times[: at + 1]) - time for at, time in enumerate(times))
    with TemporaryDirectory() as folder:
        found = set_back(Path(folder) / "a.mcap", [message(each) for each in times], LAYOUTS[name])
    assert found <= most * S
    assert found == 0 or found > S
    if name == "without chunks":
        assert found == (most * S if most > 1 else 0)


def test_it_is_listed_and_told_where_it_matters_and_changes_no_span(tmp_path: Path) -> None:
    messages = [message(n) for n in range(20)] + [message(n - STEP) for n in range(20, 50)]
    write_mcap(tmp_path / "a.mcap", messages, LAYOUTS["indexed"])
    memory = memory_of(tmp_path)
    [fault] = data_time_range(memory, Call()).clock_faults
    assert "set back by 29 s or more while it was being written" in fault.reason
    assert data_time_range(memory, Call()).earliest == T0 - 10 * S
    result = topic_range(
        memory, Call(), messages[0].topic, TimeRange(start_s=T0 / S, end_s=T0 / S + 10)
    )
    assert any("set back" in note for note in result.notes)


def test_a_time_that_damage_made_is_no_clock_that_was_set_back(tmp_path: Path) -> None:
    times = [T0 + n * S // 10 for n in range(100)]
    path = write_mcap(tmp_path / "rec" / "rec_0.mcap", [odom(at, at / S, 0.0) for at in times])
    write_mcap(tmp_path / "rec" / "rec_1.mcap", [odom(times[-1] + n, 0.0, 0.0) for n in range(9)])
    damage_time(path, times[50], times[20])
    damage_time(path, times[99], times[99] + 5 * S)
    memory = memory_of(tmp_path)
    reply = asked(memory, tmp_path, "data_time_range")
    assert "is not where its index says" in str(reply["notes"])
    for said in (reply, asked(memory, tmp_path, "memory_status")):
        assert "clock was set" not in str(said)
        assert "clock_steps" not in said or not said["clock_steps"]
    way = asked(memory, tmp_path, "trajectory_summary", start=T0 / S, end=times[98] / S)
    assert way["distance_m"] == pytest.approx(9.8, abs=0.2)


def damage_time(path: Path, was: int, becomes: int) -> None:
    """Changes the log time of a message in a chunk without a checksum."""
    content = bytearray(path.read_bytes())
    [chunk] = chunks_of(path)
    struct.pack_into("<I", content, chunk.chunk_start_offset + CRC_AT, 0)
    struct.pack_into("<Q", content, content.index(struct.pack("<QQ", was, was)), becomes)
    path.write_bytes(content)
