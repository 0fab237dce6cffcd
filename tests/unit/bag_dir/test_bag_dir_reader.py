"""The reader of a bag directory: what counts elsewhere is left out, the rest is as in the files.

What counts is in `handover.json`; a bag that moments keep counts once.
"""

import json
import os
import random
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory import queries
from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.bag_dir.handover_file import (
    Counting,
    CutClock,
    Handover,
    Overlap,
    read_handover,
    write_handover,
)
from ros2_memory.bag_dir.layout import HANDOVER_FILE
from ros2_memory.core.errors import BagVanishedError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MAX_NS, MIN_NS
from ros2_memory.history.context import Call, Memory, SnapshotSource
from ros2_memory.queries import list_recorded_topics
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import McapLayout, Msg, boolean, odom, text, write_mcap
from tests.support.examples import examples
from tests.support.memories import memory_of

T0 = 1_700_000_000 * 10**9
S = 10**9
LATE = 24_000


def taken_over(bag_dir: Path) -> tuple[Path, Path]:
    """Two recordings that both hold what was published in the seconds 6 to 10."""

    def message(n: int, late: int) -> Msg:
        at = T0 + n * S // 2
        return replace(boolean(at + late, data=True), publish_time=at)

    old = write_mcap(bag_dir / "a" / "a_0.mcap", [message(n, 0) for n in range(20)])
    new = write_mcap(bag_dir / "b" / "b_0.mcap", [message(n, LATE) for n in range(12, 40)])
    return old, new


def cut(bag_dir: Path, at: int) -> None:
    overlap = {"log_from": None, "log_until": None}
    end, begin = Overlap(**overlap, files=("a_0.mcap",)), Overlap(**overlap, files=("b_0.mcap",))
    write_handover(bag_dir / "a", Handover(next="b", counts_until=at, end=end))
    write_handover(bag_dir / "b", Handover(previous="a", counts_from=at, begin=begin))


def counting(bag_dir: Path) -> Memory:
    return memory_of(bag_dir, reader=BagDirReader(McapReader()))


def test_a_latched_message_received_again_is_not_cut_off(tmp_path: Path) -> None:
    docked = text(T0, "docked", "/dock")
    again = replace(docked, log_time=T0 + 9 * S, publish_time=T0)
    layout = McapLayout(latched=frozenset({"/dock"}))
    new = write_mcap(tmp_path / "b" / "b_0.mcap", [again], layout)
    begin = Overlap(None, None, ("b_0.mcap",))
    write_handover(tmp_path / "b", Handover(previous="a", counts_from=T0 + 8 * S, begin=begin))
    assert BagDirReader(McapReader()).summarize(new).count == 1


def test_a_sidecar_that_cannot_be_read_hides_nothing_and_is_named(tmp_path: Path) -> None:
    old, _ = taken_over(tmp_path)
    (tmp_path / "a" / "handover.json").write_text("[")
    summary = BagDirReader(McapReader()).summarize(old)
    assert summary.count == 20
    assert "handover.json" in summary.notes[-1]
    assert "handover.json" in queries.data_time_range(counting(tmp_path), Call()).notes[0]


def test_every_message_is_read_where_counts_are_compared_with_the_files(tmp_path: Path) -> None:
    old, _ = taken_over(tmp_path)
    cut(tmp_path, T0 + 8 * S)
    reader = BagDirReader(McapReader(), tmp_path, every_message=True)
    assert reader.summarize(old).count == 20
    assert len(list(reader.records(old, ["/bumper"], TimeWindow.everything()))) == 20


@pytest.mark.parametrize("seed", range(examples(40)))
def test_a_summary_states_what_a_reading_gives(tmp_path: Path, seed: int) -> None:
    draw = random.Random(seed)

    def moment() -> int:
        return T0 + draw.randrange(examples(40)) * S // 4

    def message(topic: str) -> Msg:
        at = moment()
        body = boolean(at, data=True) if draw.random() < 0.7 else text(at, "also of this name")
        return replace(body, topic=topic, publish_time=at - draw.randrange(-2, 3) * S // 4)

    messages = [message(draw.choice(["/bumper", "/other"])) for _ in range(60)]
    layout = McapLayout(chunk_size=draw.choice([200, 1000, 1 << 20]))
    bag = write_mcap(tmp_path / "a" / "a_0.mcap", messages, layout)

    def overlap() -> Overlap:
        start, stop = sorted((moment(), moment()))
        return Overlap(draw.choice([None, start]), draw.choice([None, stop]), ("a_0.mcap",))

    write_handover(
        tmp_path / "a",
        Handover(
            previous="z",
            counts_from=draw.choice([None, moment(), moment()]),
            begin=overlap(),
            next="b",
            counts_until=draw.choice([None, moment(), moment()]),
            end=overlap(),
        ),
    )
    reader = BagDirReader(McapReader())
    found: dict[tuple[str, str], list[int]] = {}
    for record in reader.records(bag, ["/bumper", "/other"], TimeWindow.everything()):
        found.setdefault((record.channel.topic, record.channel.type), []).append(record.log_time)
    assert {
        (each.topic, each.type): (each.count, each.first, each.last)
        for each in reader.summarize(bag).topics
    } == {key: (len(times), times[0], times[-1]) for key, times in found.items()}


def found(index: SnapshotSource) -> list[str]:
    return [bag.file for bag in index.refresh().bags]


# The index looks every few seconds; a bag may have gone from where it was since.


def test_a_kept_bag_is_read_under_its_other_name(tmp_path: Path) -> None:
    recorded = write_mcap(tmp_path / "rec/rec_0.mcap", [odom(S, 1.0, 2.0)])
    linked = tmp_path / "moments/one/rec/rec_0.mcap"
    linked.parent.mkdir(parents=True)
    os.link(recorded, linked)
    reader = BagDirReader(McapReader(), tmp_path)
    everything = TimeWindow.everything()

    def read(path: Path) -> tuple[object, ...]:
        return (
            [each.log_time for each in reader.records(path, ["/odom"], everything)],
            next(reader.records(path, ["/odom"], everything, newest_first=True), None) is not None,
            [channel.topic for channel in reader.channels(path)],
        )

    before = read(recorded)
    assert before == ([S], True, ["/odom"])
    begun = reader.records(recorded, ["/odom"], everything)
    recorded.unlink()
    assert [each.log_time for each in begun] == [S]
    assert read(recorded) == before
    # The index is told how it is.
    with pytest.raises(BagVanishedError):
        reader.summarize(recorded)
    os.link(linked, recorded)
    linked.unlink()
    assert read(linked) == before
    recorded.unlink()
    with pytest.raises(BagVanishedError):
        read(recorded)


def test_a_hard_link_beside_its_original_is_no_second_bag(tmp_path: Path) -> None:
    recorded = write_mcap(tmp_path / "rec/rec_0.mcap", [odom(S, 1.0, 2.0)])
    memory = memory_of(tmp_path)
    assert found(memory.index) == [str(recorded)]
    linked = tmp_path / "rec/rec_0_link.mcap"
    os.link(recorded, linked)
    saved = tmp_path / "moments/one/rec/rec_0.mcap"
    saved.parent.mkdir(parents=True)
    os.link(recorded, saved)
    for index in (memory.index, memory_of(tmp_path).index):
        assert found(index) == [str(recorded)]
    [row] = list_recorded_topics(memory, Call())
    assert row.count == 1
    # One with an earlier name takes over.
    outer = tmp_path / "a.mcap"
    os.link(recorded, outer)
    assert found(memory.index) == [str(outer)]
    outer.unlink()
    recorded.unlink()
    assert found(memory.index) == [str(linked)]
    linked.unlink()
    assert found(memory.index) == [str(saved)]
    saved.unlink()
    assert found(memory.index) == []


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
