"""Gaps, against what publishers sent: all stalls of a recorder are found, and nothing else is."""

from __future__ import annotations

from itertools import pairwise
from random import Random
from typing import TYPE_CHECKING, Final

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from ros2_memory.core.bag_summary import BagSummary, TopicSummary
from ros2_memory.core.model import BagFile, BagState
from ros2_memory.core.pauses import noteworthy, pauses_among
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.index.timeline import Timeline
from tests.support.examples import examples
from tests.support.listed_bags import odom_bag

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Times = NDArray[np.float64]

S: Final = 10**9
BEGIN: Final = 1_784_000_000 * S
RATES: Final = (200.0, 100.0, 50.0, 20.0, 10.0)
HOUR_S: Final = 3600.0


def published(hz: float, length: float, draw: Random) -> Times:
    """When a busy publisher sent: its clock drifts, each message jitters, one in 500 is skipped."""
    chance = np.random.default_rng(draw.getrandbits(32))
    period = 1 / (hz * draw.uniform(0.95, 1.0))
    times = np.arange(draw.random() * period, length, period)
    times += np.abs(chance.normal(0, 0.15, times.size)) * period
    times += chance.exponential(0.05, times.size) * (chance.random(times.size) < 0.001)
    return np.sort(times[chance.random(times.size) > 0.002])


def split_up(topics: Sequence[Times], split: float, length: float) -> list[BagFile]:
    """The splits of a recording, each as its file states it."""
    bags: list[BagFile] = []
    for number in range(int(length / split) + 1):
        inside = [
            BEGIN + np.rint(times[(times >= number * split) & (times < (number + 1) * split)] * S)
            for times in topics
        ]
        held = {
            nth: np.sort(times.astype(np.int64)) for nth, times in enumerate(inside) if times.size
        }
        if not held:
            continue
        every = np.concatenate([*held.values()])
        first, last = int(every.min()), int(every.max())
        counts = [times.size for times in held.values()]
        found = noteworthy(pauses_among(every, every, np.ones_like(every)), counts, last - first)
        rows = [
            TopicSummary(f"/{nth}", "T", "cdr", times.size, int(times[0]), int(times[-1]))
            for nth, times in held.items()
        ]
        summary = BagSummary(rows, pauses=found)
        file = f"/bags/rec/rec_{number}.mcap"
        bags.append(BagFile(file, 1, 1, BagState.CLOSED, summary, first, last))
    return bags


def gaps(bags: Sequence[BagFile]) -> list[tuple[float, float]]:
    found = Snapshot(Timeline.of(bags)).gaps
    return [((start - BEGIN) / S, (end - BEGIN) / S) for start, end in found]


def without(times: Times, spans: Sequence[tuple[float, float]]) -> Times:
    for start, end in spans:
        times = times[(times < start) | (times >= end)]
    return times


@settings(max_examples=examples(30), deadline=None)
@given(seed=st.integers(0, 2**32), split=st.sampled_from([4.0, 10.0, 60.0, 300.0, HOUR_S]))
@example(seed=379, split=4.0)
@example(seed=41590, split=4.0)
def test_stalls_of_0_6_s_are_gaps_and_nothing_else_is(seed: int, split: float) -> None:
    draw = Random(seed)
    length = 300.0
    rates = draw.sample(RATES, draw.randint(2, len(RATES)))
    topics = [published(hz, length, draw) for hz in rates]
    topics.append(np.arange(0.3, length, draw.choice([1.0, 5.0, 30.0])))
    begins = sorted(draw.sample(range(5, int(length) - 5, 6), draw.randint(0, 12)))
    stalls = [(float(at), at + draw.uniform(0.6, 5.0)) for at in begins]
    # Of one topic alone. Where only one other is frequent, at another time: a stall in it could
    # as well be a silence of that other.
    alone = [
        (start, start + 2.0)
        for start in np.arange(10.0, length - 8, 50).tolist()
        if len(rates) > 2 or not any(begin < start + 2.0 and start < end for begin, end in stalls)
    ]
    quick = int(np.argmax([times.size for times in topics]))
    recorded = [without(times, stalls) for times in topics]
    recorded[quick] = without(recorded[quick], alone)
    sent = np.sort(np.concatenate(recorded))
    expected = [
        (before, after)
        for before, after in pairwise(sent.tolist())
        if any(before < end and start < after for start, end in stalls) and after - before > 0.55
    ]
    found = gaps(split_up(recorded, split, length))
    assert len(found) == len(expected)
    period = 2 / sorted(rates, reverse=True)[1]
    for (start, end), (before, after) in zip(found, expected, strict=True):
        assert abs((end - start) - (after - before)) <= period


def bag(file: str, times: Sequence[float]) -> BagFile:
    """A bag with a message of one topic at each of these seconds."""
    first, last = BEGIN + round(times[0] * S), BEGIN + round(times[-1] * S)
    return odom_bag(f"/bags/{file}.mcap", first, last, count=len(times))


def beats(period: float, begin: float, stop: float) -> list[float]:
    return [begin + n * period for n in range(round((stop - begin) / period) + 1)]


def test_what_is_published_seldom_leaves_no_gap() -> None:
    seldom = [bag("a/a_0", beats(5, 0, 60)), bag("b/b_0", beats(5, 70, 130))]
    assert gaps(seldom) == []
    assert gaps([*seldom, bag("c/c_0", beats(5, 150, 200))]) == [(130.0, 150.0)]


def test_rare_topics_alone_leave_no_gap_at_each_split() -> None:
    assert gaps([bag(f"a/a_{n}", [12 * n]) for n in range(9)]) == []
    assert gaps([bag("a/a_0", [0]), bag("a/a_1", [12]), bag("a/a_2", [40])]) == [(12.0, 40.0)]


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
        times = beats(0.25, begin, begin + length)
        heard |= {*times}
        parts = [times[: len(times) // 2], times[len(times) // 2 :]] if cut else [times]
        bags += (bag(f"r{number}/r{number}_{n}", part) for n, part in enumerate(parts))
    in_order = sorted(heard)
    assert gaps(bags) == [
        (before, after) for before, after in pairwise(in_order) if after - before > 1
    ]
