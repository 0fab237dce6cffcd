"""Bags in time order, and what follows from them."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.bag_summary import BagSummary, TopicSummary
from ros2_memory.core.model import BagFile, BagState, TimeWindow
from ros2_memory.core.timebase import MAX_NS, MIN_NS
from ros2_memory.index import timeline as timelines
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.index.timeline import Timeline
from tests.support.listed_bags import odom_bag

S = 10**9
ODOM = "nav_msgs/msg/Odometry"


def _bag(
    name: str, *topics: tuple[str, int, int], silent: tuple[str, ...] = (), type_name: str = ODOM
) -> BagFile:
    """A bag whose topics are given as (name, first, last)."""
    summary = BagSummary(
        tuple(
            TopicSummary(topic, type_name, "cdr", 2, first, last, latched=topic == "/tf_static")
            for topic, first, last in topics
        ),
        silent=silent,
    )
    return BagFile(name, 1, 1, BagState.CLOSED, summary, summary.start, summary.end)


def test_what_is_absent_within_a_bag_leaves_the_other_topics_of_it_alone() -> None:
    bag = _bag("rec/rec_0.mcap", ("/odom", 0, 800 * S), ("/seen", 0, 800 * S))
    absences = (("/seen", ((100 * S, 400 * S, 100),)),)
    summary = BagSummary(bag.summary.topics, absences=absences)
    snapshot = Snapshot(Timeline.of([bag._replace(summary=summary)]))
    assert [snapshot.longest_silence(topic) for topic in ("/odom", "/seen")] == [0, 300 * S]


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
    chance = random.Random(seed)
    pool = [_random_bag(chance, number) for number in range(3 * size)]
    present = set(chance.sample(range(len(pool)), chance.choice([0, 1, size, 2 * size])))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(timelines, "SEGMENT_BAGS", size)
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


def _random_bag(chance: random.Random, number: int) -> BagFile:
    start = chance.randrange(3000)
    long = chance.random() < 0.05
    topics = chance.sample(["/odom", "/tf", "/tf_static", "/scan"], chance.randint(1, 3))
    spans = [(topic, start, start + chance.randrange(2000 if long else 20)) for topic in topics]
    type_name = chance.choice([ODOM, "std_msgs/msg/String"])
    name = chance.choice(NAMES).format(number)
    bag = _bag(name, *spans, silent=("/idle",), type_name=type_name)
    if chance.random() < 0.8:
        return bag
    odd = BagSummary(bag.summary.topics, silent=("/idle",), notes=("odd",))
    return bag._replace(summary=odd, size=2**62, mtime_ns=chance.choice([MIN_NS, MAX_NS]))


def _assert_holds(timeline: Timeline, bags: list[BagFile], windows: list[tuple[int, int]]) -> None:
    ordered = sorted(bags, key=lambda bag: (bag.start, bag.end, bag.path))
    held = [(bag, topic) for bag in ordered for topic in bag.summary.topics]
    names = sorted({topic.topic for _, topic in held})
    assert [*timeline.bags] == [*reversed([*reversed(timeline.bags)])] == ordered
    in_turn = range(-len(bags), len(bags))
    assert [timeline.bags[at] for at in in_turn] == 2 * timeline.bags[:] == 2 * ordered
    assert [timeline.bags.recording(at) for at in range(len(bags))] == [
        bag.recording for bag in ordered
    ]
    for rows in (segment.bags for segment in timeline.segments):
        odd = [bag for bag in rows if bag.summary.notes]
        some = rows.some(rows.with_schema(lambda schema: schema.notes))
        assert [*(some or ())] == odd
        assert (some is rows) == (len(odd) == len(rows))
        assert rows.files() == [bag.file for bag in rows]
    snapshot = Snapshot(timeline)
    assert snapshot.earliest == min((bag.start for bag in bags), default=None)
    assert snapshot.latest == max((bag.end for bag in bags), default=None)
    assert timeline.silent == {name for bag in bags for name in bag.summary.silent}
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
        assert timeline.overlapping(window) == tuple(
            bag for bag in overlaps if bag.start < window.stop and bag.end >= start
        )
        assert [*timeline.extents("/odom", window)] == [
            (bag, topic.first, topic.last)
            for bag, topic in held
            if topic.topic == "/odom"
            and length
            and topic.first < window.stop
            and topic.last >= start
        ]


T0 = 1_784_023_200 * S
DAY = 24 * 3600 * S


@pytest.mark.parametrize(
    ("start", "stop", "found"),
    [(0, 5, []), (12, 15, ["open"]), (25, 26, ["open"]), (31, 33, []), (40, 41, ["odd"])],
)
def test_what_is_amiss_in_a_window_reaches_on_to_the_end_of_an_open_file(
    start: int, stop: int, found: list[str]
) -> None:
    bags = (
        odom_bag("/r/good", T0, T0 + 50 * S),
        odom_bag(
            "/r/open", T0 + 10 * S, T0 + 20 * S, state=BagState.INCOMPLETE, written=T0 + 30 * S
        ),
        odom_bag("/r/odd", T0 + 40 * S, T0 + 41 * S, written=T0 + DAY, notes=("torn",)),
    )
    window = TimeWindow(T0 + start * S, T0 + stop * S)
    assert [each.path.name for each in Snapshot(Timeline.of(bags)).timeline.faulty(window)] == found
