"""Bags that a wrong clock dated, and the span that is reported without them."""

from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.model import BagFile
from ros2_memory.core.timebase import FUTURE_NS, MAX_NS
from ros2_memory.index.clock_faults import (
    FIRST_BAGS_NS,
    Dating,
    check_dates,
    max_plausible,
)
from ros2_memory.index.segment import Segment
from ros2_memory.index.split_order import StepBack
from ros2_memory.index.timeline import Timeline
from tests.support.listed_bags import odom_bag

S = 10**9
HOUR = 3600 * S
DAY = 24 * HOUR
NOW = 1_790_000_000 * S


def bag(name: str, start: int, end: int | None = None, *, written: int = NOW) -> BagFile:
    end = start + 10 * S if end is None else end
    return odom_bag(f"/bags/rec/{name}", start, end, written=written)


def dating(
    *bags: BagFile, now: int = NOW, steps: tuple[StepBack, ...] = (), size: int = 256
) -> Dating:
    ordered = sorted(bags, key=lambda each: (each.start, each.end, each.file))
    groups = [ordered[at : at + size] for at in range(0, len(ordered), size)]
    return check_dates(Timeline([Segment(group) for group in groups]), steps, now)


GOOD = [bag(f"good{n}", NOW - HOUR + n * 10 * S) for n in range(4)]
SPAN = (GOOD[0].start, GOOD[-1].end)


def span(found: Dating) -> tuple[int | None, int | None]:
    return found.earliest, found.latest


def test_a_clock_that_falls_back_by_years_in_a_recording_leaves_its_last_splits_out() -> None:
    strays = [bag(f"stray{n}", NOW - 900 * DAY + n * 10 * S) for n in range(2)]
    step = StepBack(GOOD[-1], strays[0], 900 * DAY)
    found = dating(*GOOD, *strays, steps=(step,))
    assert span(found) == SPAN
    assert found.misdated == {each.file for each in strays}


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
