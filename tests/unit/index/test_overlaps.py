"""Recordings that overlap in time: which are answered together, and which are one."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.bag_dir.handover_file import Handover, write_handover
from ros2_memory.core.spans import overlap_spans
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S
from ros2_memory.history.context import Call, Memory
from ros2_memory.index import recordings, timeline
from ros2_memory.index.recordings import Overlapping, overlapping_recordings
from ros2_memory.queries import list_recorded_topics
from tests.support.bags import odom, text, write_mcap
from tests.support.listed_bags import odom_bag
from tests.support.memories import memory_of

T0 = 1_700_000_000


def robot(folder: Path, spans: Mapping[str, Sequence[tuple[float, float]]]) -> Memory:
    """Bags of odometry at 10 Hz, by recording, from and until so many seconds."""
    for recording, times in spans.items():
        for number, (first, last) in enumerate(times):
            tenths = range(round(first * 10), round(last * 10) + 1)
            messages = [odom((T0 * 10 + n) * NS_PER_S // 10, 0.0, 0.0) for n in tenths]
            write_mcap(folder / recording / f"{number}.mcap", messages)
    return memory_of(folder)


def overlapping(memory: Memory) -> tuple[Overlapping, ...]:
    index = memory.index
    return overlapping_recordings(index.refresh(), index.joined_with)


def pairs(found: tuple[Overlapping, ...]) -> list[tuple[str, str, float, float]]:
    return [
        (one.first.name, one.second.name, one.start / NS_PER_S - T0, one.end / NS_PER_S - T0)
        for one in found
    ]


@pytest.mark.parametrize("side", ["previous", "next"])
def test_however_long_a_handover_took_its_recordings_are_one(tmp_path: Path, side: str) -> None:
    taken = robot(tmp_path, {"a": [(0, 60)], "b": [(5, 60)]})
    assert len(overlapping(taken)) == 1
    if side == "next":
        write_handover(tmp_path / "a", Handover(next="b"))
    else:
        write_handover(tmp_path / "b", Handover(previous="a"))
    assert overlapping(taken) == ()


def test_what_is_kept_of_a_recording_is_a_part_of_it(tmp_path: Path) -> None:
    spans = {"a": [(0, 10)], "moments/20261120T080000Z-cup/a": [(5, 15)], "b": [(8, 20)]}
    taken = robot(tmp_path, spans)
    assert pairs(overlapping(taken)) == [("a", "b", 8.0, 15.0)]
    write_handover(tmp_path / "b", Handover(previous="a"))
    assert overlapping(taken) == ()


def test_two_robots_are_found_behind_however_many_handovers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recordings, "_MAX_READ", 3)
    joined = {f"a{number}": [(number * 10, number * 10 + 20)] for number in range(5)}
    taken = robot(tmp_path, {**joined, "b": [(100, 150)], "c": [(100, 150)]})
    for number in range(1, 5):
        write_handover(tmp_path / f"a{number}", Handover(previous=f"a{number - 1}"))
    assert pairs(overlapping(taken)) == [("b", "c", 100.0, 150.0)]


halves_of_seconds = st.integers(0, 120).map(lambda number: number * NS_PER_S // 2)
drawn_bags = st.lists(
    st.tuples(st.integers(0, 3), st.just(MIN_NS) | halves_of_seconds, halves_of_seconds)
)


@given(drawn_bags, st.integers(1, 8))
def test_times_that_recordings_share_are_those_of_all_their_bags(
    drawn: Sequence[tuple[int, int, int]], size: int
) -> None:
    bags = [
        odom_bag(f"/bags/r{recording}/{number}.mcap", start, start + length)
        for number, (recording, start, length) in enumerate(drawn)
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(timeline, "SEGMENT_BAGS", size)
        shared = timeline.Timeline.of(bags).shared_times
    assert shared == overlap_spans((bag.start, bag.end, bag.recording) for bag in bags)


def test_recordings_may_overlap_where_the_range_of_times_ends(tmp_path: Path) -> None:
    for name, before in (("a", NS_PER_S), ("b", NS_PER_S // 2)):
        said = [text(MAX_NS - 1 - before, name), text(MAX_NS - 1, name)]
        write_mcap(tmp_path / name / f"{name}_0.mcap", said)
    [topic] = list_recorded_topics(memory_of(tmp_path), Call())
    assert topic.count == 4
