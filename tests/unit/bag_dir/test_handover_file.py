"""`handover.json`: which messages of two recordings count, and what may stand in the file."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.bag_dir.handover_file import (
    Counting,
    CutClock,
    Handover,
    Overlap,
    read_handover,
    write_handover,
)
from ros2_memory.bag_dir.layout import HANDOVER_FILE
from ros2_memory.core.timebase import MAX_NS, MIN_NS

MOMENTS = st.integers(MIN_NS, MAX_NS)
OVERLAPS = st.builds(
    Overlap,
    st.none() | MOMENTS,
    st.none() | MOMENTS,
    st.lists(st.text(min_size=1, max_size=5), max_size=3).map(tuple),
)
NAMES = st.none() | st.from_regex(r"rec_[0-9]{1,3}", fullmatch=True)
HANDOVERS = st.builds(
    Handover,
    state=st.sampled_from(Counting),
    clock=st.sampled_from(CutClock),
    previous=NAMES,
    counts_from=st.none() | MOMENTS,
    begin=st.none() | OVERLAPS,
    next=NAMES,
    counts_until=st.none() | MOMENTS,
    end=st.none() | OVERLAPS,
    notes=st.lists(st.text(max_size=9), max_size=2).map(tuple),
)

FULL = Handover(
    previous="rec_1",
    counts_from=1_000,
    begin=Overlap(900, 1_100, ("rec_2_0.mcap",)),
    next="rec_3",
    counts_until=9_000,
    end=Overlap(8_900, 9_500, ("rec_2_7.mcap", "rec_2_8.mcap")),
    notes=("a note",),
)


@given(handover=HANDOVERS)
def test_what_is_written_is_read(
    tmp_path_factory: pytest.TempPathFactory, handover: Handover
) -> None:
    folder = tmp_path_factory.mktemp("recording")
    write_handover(folder, handover)
    assert read_handover(folder) == (handover, None)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"format": 2}, "format is 2"),
        ({"state": "maybe"}, "state: Input should be 'counts', 'pending' or 'void'"),
        ({"previous": "../elsewhere"}, "previous: Value error, it must be the name of"),
        *(({"next": name}, "name of a recording") for name in ("..", ".", "/etc", "")),
        ({"counts_from_ns": True}, "counts_from_ns: Input should be a valid integer"),
        ({"counts_until_ns": 2**63}, "counts_until_ns: Input should be less than"),
        ({"begin": []}, "begin: Input should be a dictionary"),
        ({"end": {"files": "x"}}, "end.log_from_ns: Field required"),
    ],
)
def test_what_it_cannot_mean_is_told_and_then_everything_counts(
    tmp_path: Path, change: dict[str, object], reason: str
) -> None:
    write_handover(tmp_path, FULL)
    path = tmp_path / HANDOVER_FILE
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    handover, problem = read_handover(tmp_path)
    assert handover == Handover()
    assert problem is not None
    assert reason in problem


@pytest.mark.parametrize("text", [b"", b"[1]", b"{", b"\xff", b"[" * 100_000, b" " * (2 << 20)])
def test_any_bytes_are_read_without_failing(tmp_path: Path, text: bytes) -> None:
    (tmp_path / HANDOVER_FILE).write_bytes(text)
    handover, problem = read_handover(tmp_path)
    assert handover == Handover()
    assert problem is not None
