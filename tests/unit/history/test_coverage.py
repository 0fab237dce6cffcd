"""What a window touched and could not be read, in sentences."""

from __future__ import annotations

from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.bag_summary import BagSummary, TopicSummary
from ros2_memory.core.model import BagFile, BagState, SetAside, TimeWindow
from ros2_memory.history.coverage import unread_spans
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.index.timeline import Timeline

S = 10**9
T0 = 1_784_023_200 * S
DAY = 24 * 3600 * S


def split(
    number: int, *, state: BagState = BagState.CLOSED, notes: tuple[str, ...] = ()
) -> BagFile:
    start, end = T0 + number * 10 * S, T0 + number * 10 * S + 9 * S
    topics = (TopicSummary("/odom", "nav_msgs/msg/Odometry", "cdr", 2, start, end),)
    summary = BagSummary(topics, notes=notes)
    return BagFile(f"/b/rec/rec_{number}.mcap", 1, end, state, summary, start, end)


def torn(number: int, written: int | None = T0 + DAY, folder: str = "rec") -> SetAside:
    return SetAside(Path(f"/b/{folder}/{folder}_{number}.mcap"), "torn", written)


def told(snapshot: Snapshot, start: float, stop: float, *, nothing: bool = False) -> list[str]:
    window = TimeWindow(T0 + round(start * S), T0 + round(stop * S))
    return list(unread_spans(snapshot, window, nothing=nothing))


def test_a_file_of_which_the_time_is_unknown_is_reported_where_nothing_was_found() -> None:
    snapshot = Snapshot(
        Timeline.of((split(0),)), damaged=(torn(7, None, "alone"),), scanned_at=T0 + DAY
    )
    assert told(snapshot, 0, 9) == []
    assert told(snapshot, 0, 9, nothing=True) == [
        "1 bag file could not be read and may hold more: alone/alone_7.mcap (torn)"
    ]


def test_many_files_are_counted_and_the_last_ones_named() -> None:
    lost = tuple(torn(number) for number in range(1, 9))
    snapshot = Snapshot(Timeline.of((split(0), split(9))), damaged=lost, scanned_at=T0 + DAY)
    assert told(snapshot, 0, 100) == [
        (
            "8 bag files could not be read and may hold more: rec/rec_6.mcap (torn), "
            "rec/rec_7.mcap (torn), rec/rec_8.mcap (torn) and 5 more"
        )
    ]


def test_beside_an_answer_that_there_is_nothing_each_file_is_named_that_may_hold_it() -> None:
    active = SetAside(Path("/b/copied/copied_0.db3"), "still being written")
    timeline = Timeline.of((split(0), split(1)))
    snapshot = Snapshot(timeline, active=(active,), scanned_at=T0 + 3 * DAY)
    assert told(snapshot, 0, 9) == []
    named = ["still being written and not included: copied/copied_0.db3"]
    assert told(snapshot, 0, 9, nothing=True) == named


def test_of_closed_bags_that_are_odd_in_many_ways_the_newest_are_reported() -> None:
    odd = [split(number, notes=(f"way {number}",)) for number in range(5)]
    snapshot = Snapshot(Timeline.of(tuple(odd)), scanned_at=T0 + DAY)
    assert told(snapshot, 0, 60) == [
        "rec/rec_2.mcap: way 2",
        "rec/rec_3.mcap: way 3",
        "rec/rec_4.mcap: way 4",
        "2 older bags are odd too",
    ]


@given(
    lost=st.sets(st.integers(0, 40), max_size=30),
    reason=st.text(min_size=1, max_size=3000),
    window=st.tuples(st.integers(-100, 500), st.integers(-100, 500)),
    nothing=st.booleans(),
)
def test_what_is_reported_stays_short_however_much_was_lost(
    lost: set[int], reason: str, window: tuple[int, int], nothing: bool
) -> None:
    asides = tuple(SetAside(Path(f"/b/rec/rec_{n}.mcap"), reason, T0) for n in sorted(lost))
    bags = tuple(split(n, notes=(reason,)) for n in range(41) if n not in lost)
    snapshot = Snapshot(Timeline.of(bags), damaged=asides, scanned_at=T0 + DAY)
    sentences = told(snapshot, *sorted(window), nothing=nothing)
    assert len(sentences) <= 5
    assert sum(map(len, sentences)) < 2000
