"""Dates of bags: a clock that was wrong or set back, the order of splits, and what has none."""

import struct
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import IndexType

from ros2_memory.bag_dir.layout import named_start
from ros2_memory.core.model import BagFile, TimeWindow
from ros2_memory.core.timebase import FUTURE_NS, MAX_NS, MIN_NS
from ros2_memory.index.clock_faults import FIRST_BAGS_NS, check_dates, max_plausible
from ros2_memory.index.segment import Segment
from ros2_memory.index.snapshot import unreadable_bounds, unreadable_span
from ros2_memory.index.split_order import Neighbours, StepBack, steps_of
from ros2_memory.index.timeline import MAX_FILE_NS, Timeline
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import McapLayout, Msg, odom, text, write_mcap
from tests.support.examples import examples
from tests.support.listed_bags import odom_bag
from tests.support.mcap_surgery import chunks_of
from tests.support.memories import asked, memory_of

S = 10**9
HOUR = 3600 * S
DAY = 24 * HOUR
NOW = 1_790_000_000 * S


def bag(name: str, start: int, end: int | None = None, *, written: int = NOW) -> BagFile:
    end = start + 10 * S if end is None else end
    return odom_bag(f"/bags/rec/{name}", start, end, written=written)


def parted(bags: Sequence[BagFile], size: int = 256) -> Timeline:
    """A history in segments of so many bags."""
    ordered = sorted(bags, key=lambda each: (each.start, each.end, each.file))
    groups = [ordered[at : at + size] for at in range(0, len(ordered), size)]
    return Timeline([Segment(group) for group in groups])


GOOD = [bag(f"good{n}", NOW - HOUR + n * 10 * S) for n in range(4)]


def test_a_clock_that_falls_back_by_years_in_a_recording_leaves_its_last_splits_out() -> None:
    strays = [bag(f"stray{n}", NOW - 900 * DAY + n * 10 * S) for n in range(2)]
    step = StepBack(GOOD[-1], strays[0], 900 * DAY)
    found = check_dates(parted([*GOOD, *strays]), (step,), NOW)
    assert (found.earliest, found.latest) == (GOOD[0].start, GOOD[-1].end)
    assert found.misdated == {each.file for each in strays}


@pytest.mark.parametrize("later", [3, 30])
def test_what_was_recorded_two_days_later_is_not_dated_by_a_clock_that_was_set_back_by_two(
    later: int,
) -> None:
    wrong = bag("rec_0", NOW - 2 * DAY)
    others = [bag(f"other{n}", NOW - 2 * DAY + HOUR + n * 10 * S) for n in range(later)]
    right = [bag(f"rec_{n}", NOW - 4 * DAY + n * 10 * S) for n in range(1, 8)]
    step = StepBack(wrong, right[0], 2 * DAY)
    found = check_dates(parted([wrong, *others, *right]), (step,), NOW)
    assert found.latest == others[-1].end
    assert found.misdated.isdisjoint(each.file for each in others)
    before = [bag(f"other{n}", NOW - 4 * DAY - HOUR + n * 10 * S) for n in range(later)]
    ahead = [bag(f"rec_{n}", NOW - 2 * DAY + n * 10 * S) for n in range(50)]
    found = check_dates(
        parted([*before, *ahead, right[0]]), (step._replace(before=ahead[-1]),), NOW
    )
    assert (found.earliest, found.misdated) == (before[0].start, frozenset({right[0].file}))


@pytest.mark.parametrize("others", [10, 100])
@pytest.mark.parametrize("apart", [-HOUR, HOUR])
def test_a_clock_that_falls_back_into_another_recording_misdates_its_own_alone(
    others: int, apart: int
) -> None:
    first = NOW - 2 * DAY
    other = [odom_bag(f"/bags/b/b_{n}", first + n * S, first + (n + 1) * S) for n in range(others)]
    right = [bag(f"rec_{n}", NOW - HOUR + n * 10 * S) for n in range(30)]
    wrong = [bag(f"rec_{n}", first - apart + n * 10 * S) for n in range(30, 35)]
    step = StepBack(right[-1], wrong[0], right[-1].end - wrong[0].start)
    found = check_dates(parted([*other, *right, *wrong]), (step,), NOW)
    assert found.misdated == {each.file for each in wrong}
    assert (found.earliest, found.latest) == (first, right[-1].end)


def test_the_files_own_date_tells_whether_a_clock_may_have_been_simulated() -> None:
    odd = [bag("sim", 5 * S), bag("boot", 6 * S, written=20 * S)]
    found = check_dates(parted([*GOOD, *odd]), (), NOW)
    assert [fault.reason for fault in found.faults] == [
        (
            "its messages are dated from 5 on, its file 1790000000: the clock was not set, or was"
            " simulated; left out of earliest and latest"
        ),
        "dated from 6 on: the clock was not set; left out of earliest and latest",
    ]


MOMENTS = st.sampled_from(
    [0, 5 * S, FIRST_BAGS_NS - 1, FIRST_BAGS_NS, NOW - DAY, NOW, NOW + FUTURE_NS, NOW + DAY, MAX_NS]
) | st.integers(0, MAX_NS)

SPANS = st.lists(st.tuples(MOMENTS, MOMENTS), min_size=1, max_size=12)


@given(SPANS, st.integers(1, 5), st.data())
def test_one_sound_bag_keeps_all_others_from_spoiling_the_span(
    spans: list[tuple[int, int]], size: int, data: st.DataObject
) -> None:
    start = data.draw(st.integers(FIRST_BAGS_NS, NOW))
    sound = bag("sound", start, data.draw(st.integers(start, NOW)))
    others = (bag(f"{n}", *sorted(each)) for n, each in enumerate(spans))
    found = check_dates(parted([sound, *others], size), (), NOW)
    assert found.earliest is not None
    assert found.latest is not None
    assert FIRST_BAGS_NS <= found.earliest <= sound.start
    assert sound.end <= found.latest <= max_plausible(NOW)


@given(
    st.lists(st.integers(0, 40), min_size=2, max_size=20),
    st.integers(1, 6),
    st.sampled_from([0, 20261128025306000000]),
)
def test_steps_are_those_between_neighbours_however_the_history_is_parted(
    starts: list[int], size: int, first: int
) -> None:
    """Dates with microseconds are numbers of splits, too."""
    bags = [
        bag(f"rec_{first + n}.mcap", start * S, (start + 3) * S) for n, start in enumerate(starts)
    ]
    expected = [StepBack(a, b, a.end - b.start) for a, b in pairwise(bags) if a.end - b.start > S]
    assert sorted(steps_of(parted(bags, size))) == sorted(expected)


OWN = "rec_20260921T130000Z"

"""Begun 4400 s before NOW."""


def test_a_recording_tells_when_it_began_only_in_the_names_that_the_recorder_gives() -> None:
    assert named_start(OWN) == 1_789_995_600 * S
    assert named_start(f"{OWN}_2") == 1_789_995_600 * S
    assert named_start("rec_20269921T130000Z") is None
    assert named_start("rosbag2_2025_09_10-13_03_56") is None


TIMES = st.integers(MIN_NS, MAX_NS)
NEIGHBOURS = st.builds(Neighbours, st.none() | TIMES, st.none() | TIMES)


@given(st.sampled_from([OWN, "someones"]), NEIGHBOURS, st.none() | TIMES, TIMES, st.booleans())
def test_messages_of_a_file_that_cannot_be_read_lie_between_its_neighbours_and_fit_64_bits(
    recording: str, near: Neighbours, written: int | None, now: int, growing: bool
) -> None:
    """What may be there includes all that is likely, up to the last write."""
    likely = unreadable_span(recording, near, written, now, growing=growing)
    possible = unreadable_bounds(recording, near, written, now)
    before, after = near
    if likely is None:
        assert before is after is None
    else:
        assert MIN_NS <= likely.start <= likely.stop <= MAX_NS
        if before is not None and after is not None:
            assert likely.start == min(before, after)
            assert likely.stop == min(max(before, after) + 1, MAX_NS)
        elif not growing:
            assert likely.stop - likely.start <= MAX_FILE_NS + 1 or recording == OWN
    if possible is not None and not growing:
        assert likely is not None
        assert MIN_NS <= possible.start <= likely.start
        assert likely.stop <= possible.stop <= MAX_NS


def test_a_copy_of_yesterday_may_hold_anything_from_before_it_was_made() -> None:
    before = TimeWindow(MIN_NS, NOW - HOUR + 60 * S)
    assert unreadable_bounds("someones", Neighbours(), NOW - HOUR, NOW) == before

    for near, written in (
        *((Neighbours(), no_date) for no_date in (None, 5 * S)),
        # Times that contradict each other bound nothing.
        (Neighbours(200 * S, 100 * S), NOW),
        (Neighbours(NOW), NOW - HOUR),
    ):
        assert unreadable_bounds("rec", near, written, NOW) is None


BEGIN = 1_784_000_000 * S
CRC_AT = 9 + 3 * 8
"""Of a chunk's checksum, behind its length, two times and a size."""
LAYOUTS = {
    "indexed": McapLayout(chunk_size=200),
    "without indexes": McapLayout(chunk_size=200, index_types=IndexType.NONE),
    "cut off": McapLayout(chunk_size=200, finish=False),
    "without chunks": McapLayout(chunk_size=None),
}


def message(seconds: float) -> Msg:
    return text(BEGIN + round(seconds * S), "x" * 100)


@settings(max_examples=examples(40))
@given(
    times=st.lists(st.integers(0, 100), min_size=1, max_size=30),
    name=st.sampled_from(list(LAYOUTS)),
)
def test_it_is_never_more_than_the_times_of_a_topic_go_back(times: list[int], name: str) -> None:
    most = max(max(times[: at + 1]) - time for at, time in enumerate(times))
    with TemporaryDirectory() as folder:
        path = write_mcap(Path(folder) / "a.mcap", map(message, times), LAYOUTS[name])
        found, _ = McapReader().summarize(path).schema.set_back or (0, 0)
    assert found <= most * S
    assert found == 0 or found > S
    if name == "without chunks":
        assert found == (most * S if most > 1 else 0)


def test_it_is_listed_and_told_where_it_matters_and_changes_no_span(tmp_path: Path) -> None:
    messages = [message(n) for n in range(20)] + [message(n - 30) for n in range(20, 50)]
    write_mcap(tmp_path / "a.mcap", messages, LAYOUTS["indexed"])
    memory = memory_of(tmp_path)
    reply = asked(memory, "data_time_range")
    [fault] = reply["clock_faults"]
    assert "set back by 29 s or more while it was being written" in fault["reason"]
    assert reply["earliest"] == BEGIN / S - 10
    window = {"topic": messages[0].topic, "start": BEGIN / S, "end": BEGIN / S + 10}
    assert "set back" in str(asked(memory, "get_topic_in_range", **window)["notes"])


def test_a_time_that_damage_made_is_no_clock_that_was_set_back(tmp_path: Path) -> None:
    times = [BEGIN + n * S // 10 for n in range(100)]
    path = write_mcap(tmp_path / "rec" / "rec_0.mcap", [odom(at, at / S, 0.0) for at in times])
    write_mcap(tmp_path / "rec" / "rec_1.mcap", [odom(times[-1] + n, 0.0, 0.0) for n in range(9)])
    damage_time(path, times[50], times[20])
    damage_time(path, times[99], times[99] + 5 * S)
    memory = memory_of(tmp_path)
    reply = asked(memory, "data_time_range")
    assert "is not where its index says" in str(reply["notes"])
    for said in (reply, asked(memory, "memory_status")):
        assert "clock was set" not in str(said)
        assert "clock_steps" not in said or not said["clock_steps"]
    way = asked(memory, "trajectory_summary", start=BEGIN / S, end=times[98] / S)
    assert way["distance_m"] == pytest.approx(9.8, abs=0.2)


def damage_time(path: Path, was: int, becomes: int) -> None:
    """Changes the log time of a message in a chunk without a checksum."""
    content = bytearray(path.read_bytes())
    [chunk] = chunks_of(path)
    struct.pack_into("<I", content, chunk.chunk_start_offset + CRC_AT, 0)
    struct.pack_into("<Q", content, content.index(struct.pack("<QQ", was, was)), becomes)
    path.write_bytes(content)


@pytest.mark.parametrize("months_between", [0, 8])
@pytest.mark.parametrize("is_split", [False, True])
@pytest.mark.parametrize("wrong", [60 * S, BEGIN - 200 * DAY])
def test_what_was_recorded_before_the_clock_was_set_ahead_by_years_begins_no_memory(
    tmp_path: Path, wrong: int, is_split: bool, months_between: int
) -> None:
    """A computer without a battery dates its first messages by the day on which it was built.

    So it does at each start, also with months of other recordings behind that day.
    """
    for nth in range(months_between):
        at = BEGIN - 190 * DAY + nth * 25 * DAY
        others = [odom(at + n * S // 10, 1.0, 0.0) for n in range(20)]
        write_mcap(tmp_path / f"month_{nth}" / f"month_{nth}_0.mcap", others)
    before = [wrong + n * S // 10 for n in range(100)]
    after = [BEGIN + n * S // 10 for n in range(200)]
    states = {at: text(at + 1000, "idle", topic="/mission") for at in (before[0], after[50])}
    messages = [
        message
        for at in [*before, *after]
        for message in (odom(at, at % HOUR / S, 0.0), *filter(None, [states.get(at)]))
    ]
    files = [messages[:51], messages[51:101], messages[101:]] if is_split else [messages]
    for number, some in enumerate(files):
        write_mcap(tmp_path / "rec" / f"rec_{number}.mcap", some)
    memory = memory_of(tmp_path)
    reply = asked(memory, "data_time_range")
    earliest = BEGIN - 190 * DAY if months_between else after[0]
    assert (reply["earliest"], reply["latest"]) == (earliest / S, after[-1] / S)
    assert months_between or not reply["gaps"]
    assert reply["clock_steps"] == []
    names = [fault["file"] for fault in reply["clock_faults"]]
    assert names == [f"rec/rec_{number}.mcap" for number in range(2 if is_split else 1)]
    assert all("the clock was set" in fault["reason"] for fault in reply["clock_faults"])
    window = {"start": after[0] / S, "end": after[-1] / S}
    held = asked(memory, "get_topic_in_range", topic="/mission", changes=True, **window)
    assert [change["start"] for change in held["changes"]] == [(after[50] + 1000) / S]
    by_day = asked(memory, "trajectory_summary", by="hour", max_waypoints=0, **window)
    assert by_day["all"][0] == pytest.approx(20, abs=0.2)
    found = asked(memory, "get_position_at", timestamp=before[10] / S)
    assert found["timestamp"] == before[10] / S
