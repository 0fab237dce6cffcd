"""A damaged chunk costs its own messages, and is reported where these were looked for.

A damaged index costs none, and is reported too.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from ros2_memory import queries
from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.core.errors import BagError
from ros2_memory.core.model import TimeWindow
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.view import View
from ros2_memory.insights.sightings import find_matches
from ros2_memory.results import Match
from ros2_memory.storage.base import BagReader
from ros2_memory.storage.mcap_reader import McapReader
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
from tests.support.bags import McapLayout, Msg, odom, text, write_mcap
from tests.support.mcap_surgery import SMALL, chatter, chunks_of, spoil_chunk
from tests.support.memories import memory_of, with_store

S = 10**9
T0 = 1_700_000_000 * S
LATCHED = McapLayout(chunk_size=1, latched=frozenset({"/dock"}))
EVERYTHING = TimeWindow.everything()


def damaged_bag(path: Path) -> tuple[Path, range]:
    """A bag of 40 messages at 0, 1, 2 ... ns, and which of them are in a damaged chunk."""
    write_mcap(path, chatter(40), SMALL)
    lost = chunks_of(path)[3]
    spoil_chunk(path, 3)
    return path, range(lost.message_start_time, lost.message_end_time + 1)


@pytest.mark.parametrize("newest_first", [False, True])
@pytest.mark.parametrize(
    "made",
    [
        lambda _: McapReader(),
        lambda _: Rosbag2Reader(),
        lambda _: BagDirReader(McapReader()),
        lambda root: BagDirReader(McapReader(), root),
    ],
)
def test_reading_goes_on_behind_a_damaged_chunk(
    tmp_path: Path, made: Callable[[Path], BagReader], newest_first: bool
) -> None:
    path, lost = damaged_bag(tmp_path / "rec" / "rec_0.mcap")
    records = made(tmp_path).records(path, ["/chatter"], EVERYTHING, newest_first=newest_first)
    before: list[int] = []
    with pytest.raises(BagError) as caught:
        before.extend(each.log_time for each in iter(partial(next, records), None))
    assert caught.value.lost == (lost[0], lost[-1])
    whole = [time for time in range(40) if time not in lost]
    if newest_first:
        whole.reverse()
    assert [*before, *(each.log_time for each in records)] == whole
    assert before == whole[: len(before)]
    assert all((time > lost[-1]) == newest_first for time in before)


def overlapping(folder: Path) -> Memory:
    """A damaged bag up to 1 s, one of its recording from 2 s on, and one that overlaps this."""
    first = write_mcap(folder / "a" / "a_0.mcap", [text(S, "hello")])
    spoil_chunk(first, 0)
    write_mcap(folder / "a" / "a_1.mcap", [text(2 * S, "person"), text(20 * S, "person")])
    write_mcap(folder / "b" / "b_0.mcap", [text(S // 2, "nobody"), text(3 * S, "nobody")])
    return memory_of(folder)


def asked(memory: Memory, pattern: str, wanted: str) -> Match:
    return queries.find_last_match(memory, Call(), pattern, "contains", wanted)


def test_a_chunk_damaged_before_the_match_is_reported_neither_with_a_catalogue_nor_without(
    tmp_path: Path,
) -> None:
    """What overlaps has the search look further back for copies than it was asked to."""
    plain = overlapping(tmp_path)
    found = queries.find_last_match(plain, Call(), "/*", "contains", "person", before_s=10.0)
    assert found.found is not None
    assert not any("could not be read" in note for note in found.notes)
    recalled = with_store(plain, tmp_path)
    again = queries.find_last_match(recalled, Call(), "/*", "contains", "person", before_s=10.0)
    assert repr(again) == repr(found)
    # A query of what may be in it reports it.
    assert "a_0.mcap could not be read whole" in asked(plain, "/*", "hello").notes[0]


def test_where_the_first_reception_of_a_latched_match_cannot_be_read_is_reported(
    tmp_path: Path,
) -> None:
    dock = text(10 * S, "docked", "/dock")
    other = text(9 * S, "undocked", "/dock")
    first = write_mcap(tmp_path / "a" / "a_0.mcap", [other, dock], LATCHED)
    spoil_chunk(first, 1)
    again = Msg("/dock", dock.type, 100 * S, dock.body, 10 * S)
    write_mcap(tmp_path / "b" / "b_0.mcap", [again], LATCHED)
    plain = memory_of(tmp_path)
    for memory in (plain, with_store(plain, tmp_path)):
        found = asked(memory, "/dock", "docked")
        assert found.found is not None
        assert found.found.sample.time == 100 * S
        assert "a_0.mcap could not be read whole" in found.notes[0]


@pytest.mark.parametrize("newest_first", [False, True])
def test_what_is_read_for_copies_alone_is_not_reported_when_it_is_damaged(
    tmp_path: Path, newest_first: bool
) -> None:
    memory = overlapping(tmp_path)
    view = View(memory, Call())
    found = view.stream.messages(["/chatter"], TimeWindow(2 * S, 4 * S), newest_first=newest_first)
    assert len(list(found)) == 2
    assert view.notes.sentences() == ()
    list(view.stream.messages(["/chatter"], TimeWindow(S, 4 * S), newest_first=newest_first))
    assert len(view.notes.sentences()) == 1


def test_sightings_report_what_is_damaged_in_the_time_that_they_span(tmp_path: Path) -> None:
    memory = overlapping(tmp_path)
    for each in (memory, with_store(memory, tmp_path)):

        def is_damage_noted(memory: Memory = each, **given: Any) -> bool:
            notes = find_matches(memory, Call(), "/*", "contains", "person", **given).notes
            return any("a_0.mcap could not be read whole" in note for note in notes)

        assert not is_damage_noted(start_s=2.0)
        assert is_damage_noted(start_s=0.5)
        assert is_damage_noted(limit=5)
        assert is_damage_noted(end_s=10.0, limit=5)
        assert not is_damage_noted(limit=1)


def test_a_bag_that_pauses_and_one_whose_chunks_overlap_are_read_by_their_indexes(
    tmp_path: Path,
) -> None:
    pauses = [odom(T0 + n * S // 100 + n // 100 * 2 * S, 0.0, 0.0) for n in range(500)]
    late = [odom(T0 + (n - n % 7 // 5 * 9) * S // 100, 0.0, 0.0) for n in range(20, 500)]
    for name, messages in (("pauses", pauses), ("late", late)):
        path = tmp_path / f"{name}.mcap"
        write_mcap(path, messages, McapLayout(chunk_size=10_000))
        reader = McapReader()
        for n in range(0, 500, 20):
            reader.newest(path, "/odom", TimeWindow(T0, T0 + n * S // 50))
        assert reader.summarize(path).notes == ()
