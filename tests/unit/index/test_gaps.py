"""Where nothing was recorded, by the summaries of bags."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.index.snapshot import Snapshot
from ros2_memory.index.timeline import Timeline
from tests.support.listed_bags import odom_bag

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ros2_memory.core.model import BagFile

S = 10**9
BEGIN = 1_784_000_000 * S


def bag(file: str, times: Sequence[float]) -> BagFile:
    """A bag with a message of one topic at each of these seconds."""
    first, last = BEGIN + round(times[0] * S), BEGIN + round(times[-1] * S)
    return odom_bag(f"/bags/{file}.mcap", first, last, count=len(times))


def every(period: float, begin: float, stop: float) -> list[float]:
    return [begin + n * period for n in range(round((stop - begin) / period) + 1)]


def gaps(bags: Iterable[BagFile]) -> list[tuple[float, float]]:
    return [
        ((start - BEGIN) / S, (end - BEGIN) / S) for start, end in Snapshot(Timeline.of(bags)).gaps
    ]


def test_what_is_published_seldom_leaves_no_gap() -> None:
    seldom = [bag("a/a_0", every(5, 0, 60)), bag("b/b_0", every(5, 70, 130))]
    assert gaps(seldom) == []
    assert gaps([*seldom, bag("c/c_0", every(5, 150, 200))]) == [(130.0, 150.0)]


@given(
    st.lists(
        st.tuples(st.integers(0, 400), st.integers(2, 60), st.booleans()), min_size=1, max_size=12
    )
)
def test_gaps_are_where_none_of_the_recordings_has_a_message(
    drawn: list[tuple[int, int, bool]],
) -> None:
    """Recordings that overlap, lie apart, or lie in each other; cut into two splits, or not."""
    bags: list[BagFile] = []
    heard: set[float] = set()
    for number, (begin, length, cut) in enumerate(drawn):
        times = every(0.25, begin, begin + length)
        heard |= {*times}
        parts = [times[: len(times) // 2], times[len(times) // 2 :]] if cut else [times]
        bags += (bag(f"r{number}/r{number}_{n}", part) for n, part in enumerate(parts))
    in_order = sorted(heard)
    assert gaps(bags) == [
        (before, after) for before, after in pairwise(in_order) if after - before > 1
    ]
