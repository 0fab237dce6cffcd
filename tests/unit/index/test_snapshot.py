"""Bags in time order, and what follows from them: gaps above all."""

from collections.abc import Sequence
from itertools import pairwise
from random import Random
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ros2_memory.core.bag_summary import BagSummary, SummarySchema, TopicSummary
from ros2_memory.core.model import BagFile, BagState, TimeWindow
from ros2_memory.core.pauses import noteworthy, pauses_among
from ros2_memory.core.timebase import MAX_NS, MIN_NS
from ros2_memory.index import timeline as timelines
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.index.timeline import Timeline
from tests.support.examples import examples
from tests.support.listed_bags import odom_bag

S = 10**9

ODOM = "nav_msgs/msg/Odometry"


def _bag(name: str, *topics: tuple[str, int, int], type_name: str = ODOM) -> BagFile:
    """A bag whose topics are given as (name, first, last)."""
    summary = BagSummary.packed(
        [
            TopicSummary(topic, type_name, "cdr", 2, first, last, latched=topic == "/tf_static")
            for topic, first, last in topics
        ],
        SummarySchema(silent=("/idle",)),
    )
    return BagFile(name, 1, 1, BagState.CLOSED, summary, summary.start, summary.end)


def test_what_is_absent_within_a_bag_leaves_the_other_topics_of_it_alone() -> None:
    bag = _bag("rec/rec_0.mcap", ("/odom", 0, 800 * S), ("/seen", 0, 800 * S))
    absences = (("/seen", ((100 * S, 400 * S, 100),)),)
    summary = BagSummary.packed(bag.summary.topics, SummarySchema(absences=absences))
    snapshot = Snapshot(Timeline.of([bag._replace(summary=summary)]))
    assert [snapshot.longest_silence(topic) for topic in ("/odom", "/seen")] == [0, 300 * S]


def test_a_bag_in_which_the_clock_was_set_ahead_shares_no_time_with_the_months_between() -> None:
    """Else each scan of these months would compare all of their messages with those of others."""
    jump, now = 100 * S, 200 * 86_400 * S
    others = [
        _bag(f"/b/rec/rec_{n}.mcap", ("/odom", n * now // 50, (n + 1) * now // 50))
        for n in range(50)
    ]
    boot = _bag("/b/boot/boot_0.mcap", ("/odom", 0, now))
    schema = SummarySchema(pauses=((jump, now - jump),))
    boot = boot._replace(summary=BagSummary.packed(boot.summary.topics, schema))
    halves = [
        _bag(f"/b/boot/boot_{n}.mcap", ("/odom", *half))
        for n, half in enumerate([(0, jump), (now - jump, now)])
    ]
    shared = Timeline.of([*others, *halves]).shared_times
    assert Timeline.of([*others, boot]).shared_times == shared
    assert sum(stop - start for start, stop in shared) < 3 * jump


NAMES = ("rec/{}.mcap", "rec/rec_{:021}.mcap.zstd", "/bägs/._{}", "/{}", "a/{}.db3", "b/x{}y")

bag_times = st.tuples(st.integers(0, 3000), st.integers(0, 200))


@given(
    seed=st.integers(0, 2**32),
    size=st.sampled_from([4, 16]),
    rounds=st.integers(1, 4),
    windows=st.lists(bag_times),
)
def test_a_timeline_that_changed_is_the_timeline_of_what_it_holds(
    seed: int, size: int, rounds: int, windows: list[tuple[int, int]]
) -> None:
    chance = Random(seed)
    pool = [_random_bag(chance, number) for number in range(3 * size)]
    present = set(chance.sample(range(len(pool)), chance.choice([0, 1, size, 2 * size])))
    with patch.object(timelines, "SEGMENT_BAGS", size):
        timeline = Timeline.of(pool[number] for number in present)
        for _ in range(rounds):
            assert all(timeline.extents("/odom", TimeWindow.everything()))
            chosen = set(chance.sample(range(len(pool)), chance.choice([0, 1, 3, 2 * size])))
            removed, added = present & chosen, chosen - present
            present = (present - removed) | added
            timeline = timeline.changed(
                [pool[number] for number in removed], [pool[number] for number in added]
            )
        _assert_holds(timeline, [pool[number] for number in present], windows)


@pytest.mark.parametrize("size", [1, 2, 3])
def test_a_gap_behind_a_long_bag_is_found_wherever_segments_are_cut(
    size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(timelines, "SEGMENT_BAGS", size)
    bags = [
        odom_bag("/b/one/one_0.mcap", 0, 9 * S, count=91),
        odom_bag("/b/long/long_0.mcap", 9 * S, 100 * S, count=911),
        odom_bag("/b/rec/rec_0.mcap", 10 * S, 50 * S, count=401),
        odom_bag("/b/rec/rec_1.mcap", 110 * S, 150 * S, count=401),
    ]
    assert Snapshot(Timeline.of(bags)).gaps == [(100 * S, 110 * S)]


@pytest.mark.parametrize("arrival", ["in time", "backwards", "by name", "thinned"])
def test_a_timeline_has_few_segments_in_whatever_order_bags_come_and_go(
    arrival: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each segment costs a question some time: bags copied backwards had one each."""
    monkeypatch.setattr(timelines, "SEGMENT_BAGS", 16)
    bags = [odom_bag(f"/b/rec/rec_{n}.mcap", n * 10 * S, n * 10 * S + 9 * S) for n in range(320)]
    timeline = Timeline.of(bags if arrival == "thinned" else [])
    ways = {"backwards": bags[::-1], "by name": sorted(bags, key=lambda bag: bag.file)}
    for nth, bag in enumerate(ways.get(arrival, bags)):
        if arrival != "thinned":
            timeline = timeline.changed((), [bag])
        elif nth % 16:
            timeline = timeline.changed([bag], ())
    assert len(timeline.segments) <= (len(timeline.bags) // 8 or 1) + 3


def _random_bag(chance: Random, number: int) -> BagFile:
    start = chance.randrange(3000)
    long = chance.random() < 0.05
    topics = chance.sample(["/odom", "/tf", "/tf_static", "/scan"], chance.randint(1, 3))
    spans = [(topic, start, start + chance.randrange(2000 if long else 20)) for topic in topics]
    type_name = chance.choice([ODOM, "std_msgs/msg/String"])
    bag = _bag(chance.choice(NAMES).format(number), *spans, type_name=type_name)
    return bag._replace(size=2**62, mtime_ns=chance.choice([1, MIN_NS, MAX_NS]))


def _assert_holds(timeline: Timeline, bags: list[BagFile], windows: list[tuple[int, int]]) -> None:
    ordered = sorted(bags, key=lambda bag: (bag.start, bag.end, bag.path))
    held = [(bag, topic) for bag in ordered for topic in bag.summary.topics]
    names = sorted({topic.topic for _, topic in held})
    assert [*timeline.bags] == [*reversed([*reversed(timeline.bags)])] == ordered
    assert [timeline.bags[at] for at in range(len(bags))] == ordered
    recordings = [timeline.bags.recording(at) for at in range(len(bags))]
    assert recordings == [bag.recording for bag in ordered]
    snapshot = Snapshot(timeline)
    assert snapshot.earliest == min((bag.start for bag in bags), default=None)
    assert snapshot.latest == max((bag.end for bag in bags), default=None)

    assert timeline.silent == ({"/idle"} if bags else set())
    assert timeline.transient_local == {topic.topic for _, topic in held if topic.latched}
    assert timeline.types == {
        name: tuple(sorted({topic.type for _, topic in held if topic.topic == name}))
        for name in names
    }
    for name in (*names, "/nothing"):
        assert [*timeline.extents(name, TimeWindow.everything())] == [
            (bag, topic.first, topic.last) for bag, topic in held if topic.topic == name
        ]
    for start, length in windows:
        window = TimeWindow(start, start + length)
        overlaps = ordered if length else []
        inside = [bag for bag in overlaps if bag.start < window.stop and bag.end >= start]
        assert [*timeline.overlapping(window)] == inside
        assert [*timeline.extents("/odom", window)] == [
            (bag, topic.first, topic.last)
            for bag in inside
            for topic in bag.summary.topics
            if topic.topic == "/odom" and topic.first < window.stop and topic.last >= start
        ]


Times = NDArray[np.float64]
BEGIN = 1_784_000_000 * S

RATES = (200.0, 100.0, 50.0, 20.0, 10.0)

HOUR_S = 3600.0


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
        summary = BagSummary.packed(rows, SummarySchema(pauses=found))
        file = f"/bags/rec/rec_{number}.mcap"
        bags.append(BagFile(file, 1, 1, BagState.CLOSED, summary, first, last))
    return bags


def gaps(bags: Sequence[BagFile]) -> list[tuple[float, float]]:
    found = Snapshot(Timeline.of(bags)).gaps
    return [((start - BEGIN) / S, (end - BEGIN) / S) for start, end in found]


def without(times: Times, spans: Sequence[tuple[float, float]]) -> Times:
    inside = [(times >= start) & (times < end) for start, end in spans]
    return times[~np.any(inside, axis=0)] if spans else times


@settings(max_examples=examples(30))
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


def bag_at(file: str, times: Sequence[float]) -> BagFile:
    """A bag_at with a message of one topic at each of these seconds."""
    first, last = BEGIN + round(times[0] * S), BEGIN + round(times[-1] * S)
    return odom_bag(f"/bags/{file}.mcap", first, last, count=len(times))


def beats(period: float, begin: float, stop: float) -> list[float]:
    return [begin + n * period for n in range(round((stop - begin) / period) + 1)]


def test_what_is_published_seldom_leaves_no_gap() -> None:
    seldom = [bag_at("a/a_0", beats(5, 0, 60)), bag_at("b/b_0", beats(5, 70, 130))]
    assert gaps(seldom) == []
    assert gaps([*seldom, bag_at("c/c_0", beats(5, 150, 200))]) == [(130.0, 150.0)]


def test_rare_topics_alone_leave_no_gap_at_each_split() -> None:
    assert gaps([bag_at(f"a/a_{n}", [12 * n]) for n in range(9)]) == []
    assert gaps([bag_at("a/a_0", [0]), bag_at("a/a_1", [12]), bag_at("a/a_2", [40])]) == [
        (12.0, 40.0)
    ]


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
        bags += (bag_at(f"r{number}/r{number}_{n}", part) for n, part in enumerate(parts))
    in_order = sorted(heard)
    assert gaps(bags) == [
        (before, after) for before, after in pairwise(in_order) if after - before > 1
    ]
