"""Bags that a wrong clock dated, and the span that is reported without them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.bag_summary import BagSummary, TopicSummary
from ros2_memory.core.model import BagFile, BagState
from ros2_memory.core.timebase import FUTURE_NS, MAX_NS
from ros2_memory.index.clock_faults import (
    FIRST_BAGS_NS,
    Dating,
    FaultyClock,
    check_dates,
    max_plausible,
)
from ros2_memory.index.segment import Segment
from ros2_memory.index.split_order import StepBack
from ros2_memory.index.timeline import Timeline

S = 10**9
HOUR = 3600 * S
DAY = 24 * HOUR
NOW = 1_790_000_000 * S


def bag(name: str, start: int, end: int | None = None, *, written: int = NOW) -> BagFile:
    end = start + 10 * S if end is None else end
    summary = BagSummary((TopicSummary("/odom", "nav_msgs/msg/Odometry", "cdr", 2, start, end),))
    return BagFile(f"/bags/rec/{name}", 1, written, BagState.CLOSED, summary, start, end)


def dating(
    *bags: BagFile, now: int = NOW, steps: tuple[StepBack, ...] = (), size: int = 256
) -> Dating:
    ordered = sorted(bags, key=lambda each: (each.start, each.end, each.file))
    groups = [ordered[at : at + size] for at in range(0, len(ordered), size)]
    return check_dates(Timeline([Segment(group) for group in groups]), steps, now)


def kinds(found: Dating) -> dict[str, FaultyClock]:
    return {fault.bag.path.name: fault.kind for fault in found.faults}


GOOD = [bag(f"good{n}", NOW - HOUR + n * 10 * S) for n in range(4)]
SPAN = (GOOD[0].start, GOOD[-1].end)


def span(found: Dating) -> tuple[int | None, int | None]:
    return found.earliest, found.latest


@pytest.mark.parametrize(
    ("wrong", "kind"),
    [
        (bag("zero", 0), FaultyClock.UNSET),
        (bag("boot", 40 * S), FaultyClock.UNSET),
        (bag("set within it", 20 * S, NOW - HOUR), FaultyClock.UNSET),
        (bag("after now", NOW + DAY), FaultyClock.AHEAD),
        (bag("max", NOW - HOUR, MAX_NS), FaultyClock.AHEAD),
    ],
    ids=lambda each: each.path.name if isinstance(each, BagFile) else "",
)
def test_a_bag_of_a_wrong_clock_is_named_and_does_not_stretch_the_span(
    wrong: BagFile, kind: FaultyClock
) -> None:
    found = dating(*GOOD, wrong)
    assert span(found) == SPAN
    assert kinds(found) == {wrong.path.name: kind}


def test_where_all_bags_are_in_the_future_this_machines_clock_may_be_behind() -> None:
    found = dating(*GOOD, now=GOOD[0].start - DAY)
    assert span(found) == SPAN
    assert set(kinds(found).values()) == {FaultyClock.AHEAD}
    assert found.misdated == frozenset()
    assert found.note is not None


def test_a_clock_that_is_not_set_now_tells_nothing_of_the_future() -> None:
    assert max_plausible(5 * S) == MAX_NS
    found = dating(*GOOD, bag("boot", 2 * S), now=15 * S)
    assert (span(found), kinds(found)) == (SPAN, {"boot": FaultyClock.UNSET})


def test_a_clock_that_falls_back_by_years_in_a_recording_leaves_its_last_splits_out() -> None:
    strays = [bag(f"stray{n}", NOW - 900 * DAY + n * 10 * S) for n in range(2)]
    step = StepBack(GOOD[-1], strays[0], 900 * DAY)
    found = dating(*GOOD, *strays, steps=(step,))
    assert span(found) == SPAN
    assert found.misdated == {each.file for each in strays}


def test_a_clock_that_was_ahead_for_a_while_leaves_its_first_splits_out() -> None:
    later = [bag(f"n{n}", NOW - 9 * DAY + n * 10 * S) for n in range(4)]
    ahead = bag("ahead", NOW - 2 * DAY)
    found = dating(ahead, *later, steps=(StepBack(ahead, later[0], 7 * DAY),))
    assert span(found) == (later[0].start, later[-1].end)
    assert found.misdated == {ahead.file}


def test_the_files_own_date_tells_whether_a_clock_may_have_been_simulated() -> None:
    found = dating(*GOOD, bag("sim", 5 * S), bag("boot", 6 * S, written=20 * S))
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
    found = dating(sound, *(bag(f"{n}", *sorted(each)) for n, each in enumerate(spans)), size=size)
    assert found.earliest is not None
    assert found.latest is not None
    assert FIRST_BAGS_NS <= found.earliest <= sound.start
    assert sound.end <= found.latest <= max_plausible(NOW)
