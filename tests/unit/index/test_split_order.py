"""The order in which splits were written, and what it tells of clocks and of what lies between."""

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.model import BagFile
from ros2_memory.index.segment import Segment
from ros2_memory.index.split_order import steps_of
from ros2_memory.index.timeline import Timeline
from tests.support.listed_bags import odom_bag

S = 10**9


def bag(name: str, start_s: int, end_s: int) -> BagFile:
    return odom_bag(f"/bags/rec/{name}", start_s * S, end_s * S)


def split(number: int, start_s: int, end_s: int) -> BagFile:
    return bag(f"rec_{number}.mcap", start_s, end_s)


def in_parts(bags: list[BagFile], size: int) -> list[Segment]:
    ordered = sorted(bags, key=lambda each: (each.start, each.end))
    return [Segment(ordered[at : at + size]) for at in range(0, len(ordered), size)]


def steps(bags: list[BagFile], size: int = 256) -> list[tuple[str, str, int]]:
    found = steps_of(Timeline(in_parts(bags, size)))
    return [(step.before.path.name, step.after.path.name, step.by) for step in found]


@given(
    st.lists(st.integers(0, 40), min_size=2, max_size=20),
    st.integers(1, 6),
)
def test_steps_are_those_between_neighbours_however_the_history_is_parted(
    starts: list[int], size: int
) -> None:
    bags = [split(n, start, start + 3) for n, start in enumerate(starts)]
    expected = [
        (a.path.name, b.path.name, a.end - b.start)
        for a, b in pairwise(bags)
        if a.end - b.start > S
    ]
    assert sorted(steps(bags, size)) == sorted(expected)


def test_dates_with_microseconds_are_numbers_of_splits() -> None:
    days = [20261128025306000000 + day * 10**12 for day in range(4)]
    bags = [split(number, 10 * nth, 10 * nth + 9) for nth, number in enumerate(days)]
    late = split(days[-1] + 1, 12, 15)
    expected = [(bags[-1].path.name, late.path.name, 39 * S - 12 * S)]
    assert steps([*bags, late]) == steps([*bags, late], 2) == expected
