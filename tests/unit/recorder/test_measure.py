"""How topics arrive: holes, from counters and stamps, across splits; which have stopped."""

import struct
from collections.abc import Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.bag_dir.state_files import Loss
from ros2_memory.core.timebase import NS_PER_HOUR
from ros2_memory.recorder.measure import (
    Arrival,
    Arrivals,
    LossCounter,
    Position,
    Progress,
    SplitMeasure,
    holes,
    value_reader,
)
from ros2_memory.storage.base import Schema

NS = 10**9
PERIOD = NS // 50
T0 = 1_795_000_000 * NS
HEADER = "std_msgs/Header header\nfloat64 x\n===\nMSG: std_msgs/Header\nstring frame_id\n"


def at(ticks: list[int]) -> list[Position]:
    return [Position(T0 + tick * PERIOD, T0 + tick * PERIOD + 1000) for tick in ticks]


def progress(ticks: list[int]) -> dict[str, Progress]:
    return {"/odom": Progress("stamps", at(ticks))}


def stamped(late: dict[int, float], lost: set[int], jitter: list[float]) -> list[Position]:
    """Returns 400 messages on a cadence; who is late stamps all that were due at once, in order."""
    found: list[Position] = []
    earliest = 0.0
    for tick in range(400):
        due = tick + jitter[tick % len(jitter)]
        earliest = max(earliest + 0.002, due + late.get(tick, 0.0))
        if tick not in lost:
            at = T0 + round(earliest * PERIOD)
            found.append(Position(at, at + 1000))
    return found


JITTER = st.lists(st.floats(-0.05, 0.05), min_size=7, max_size=30)
# Late now and then: a topic that is seldom on time has no cadence.
LATE = st.dictionaries(st.integers(1, 12).map(lambda n: n * 30), st.floats(0.5, 6.0), max_size=3)


@given(late=LATE, jitter=JITTER)
def test_who_is_late_and_catches_up_at_once_lost_nothing(
    late: dict[int, float], jitter: list[float]
) -> None:
    assert holes(stamped(late, set(), jitter), "stamps") == []


@given(late=st.integers(80, 99), by=st.floats(0.8, 6.0), jitter=JITTER, lost=st.booleans())
def test_a_late_message_at_the_end_of_a_split_is_told_by_the_next_split(
    late: int, by: float, jitter: list[float], lost: bool
) -> None:
    positions = stamped({late: by}, {97, 98, 99} if lost else set(), jitter)
    counter = LossCounter()
    cut = 100 - 3 * lost
    losses = [
        loss
        for part in (positions[:cut], positions[cut:250], positions[250:])
        for loss in counter.add_split("a", {"/odom": Progress("stamps", part)})
    ]
    counted = sum(loss.lost for loss in [*losses, *counter.flush()])
    # Where the late ones come while others are lost, the steps before and after may hide one.
    hidden = lost and 96.4 < late + by < 98.6
    assert 3 * lost - hidden <= counted <= 3 * lost


def test_nothing_is_expected_of_what_has_no_cadence() -> None:
    irregular = [0, 1, 5, 6, 15, 17, 30, 31, 50, 52, 80, 81]
    two_publishers = [tick for first in range(50) for tick in (first, first + 20)]
    for ticks in (irregular, [0, 1, 3], two_publishers):
        assert holes(at(ticks), "stamps") is None


def test_a_hole_between_two_splits_counts_and_only_once() -> None:
    counter = LossCounter()
    assert counter.add_split("a", progress([*range(100)])) == []
    [loss] = counter.add_split("a", progress([*range(103, 200)]))
    assert counter.add_split("a", progress([*range(200, 300)])) == []
    found = (loss.topic, loss.start, loss.lost, loss.by)
    assert found == ("/odom", T0 + 99 * PERIOD + 1000, 3, "stamps")
    assert counter.in_last_hour(loss.stop) == {"/odom": 3}
    assert counter.in_last_hour(loss.stop + NS_PER_HOUR) == {}


@given(order=st.permutations(["old", "old", "old", "new", "new", "new"]), taken=st.booleans())
def test_a_hole_waits_for_the_other_recording_of_a_long_handover(
    order: list[str], taken: bool
) -> None:
    """Whichever splits are closed first: the new recording has what the old one stalled over."""
    counter = LossCounter()
    splits: dict[str, list[Iterable[int]]] = {
        "old": [range(100), [*range(100, 110), *range(190, 200)], range(200, 300)],
        "new": [range(60, 100), {*range(100, 200)} - {150 * taken}, range(200, 400)],
    }
    for name in splits:
        counter.begin(name)
    losses = [
        loss
        for name in order
        for loss in counter.add_split(name, progress(sorted(splits[name].pop(0))))
    ]
    assert sum(each.lost for each in [*losses, *counter.flush()]) == taken


def test_a_recording_that_brings_nothing_is_not_waited_for_for_ever() -> None:
    counter = LossCounter()
    counter.begin("dead")
    kept = [each for each in range(800) if each != 5]
    losses = [
        loss
        for first in range(0, 799, 100)
        for loss in counter.add_split("live", progress(kept[first : first + 100]))
    ]
    assert [each.lost for each in losses] == [1]


def test_nothing_is_missing_between_splits_around_one_that_was_not_measured() -> None:
    counter = LossCounter()
    for first, unclear in ((0, {"/odom", "/tf"}), (200, None), (400, {"/tf"})):
        assert counter.add_split("a", progress([*range(first, first + 100)])) == []
        counter.forget(unclear)
    assert [each.lost for each in counter.add_split("a", progress([*range(510, 600)]))] == [10]


@pytest.mark.parametrize(
    ("text", "payload", "kind", "value"),
    [
        (HEADER, struct.pack("<iiI", 0, 3, 5), "stamps", 3 * NS + 5),
        ("uint32 seq\nfloat64 x\n", struct.pack("<iI", 0, 41), "counter", 41),
        (
            "uint8 a\nuint64 sequence\n",
            b"\0\0\0\0\1" + bytes(7) + struct.pack("<Q", 9),
            "counter",
            9,
        ),
        (
            "std_msgs/Header header # when\nuint32 SIZE=3\nuint32 frame_number\n",
            bytes(4) + struct.pack("<iII", 1, 2, 4) + b"map\0" + struct.pack("<I", 77),
            "counter",
            77,
        ),
        (
            "string name\nuint16 counter\n",
            bytes(4) + struct.pack("<I", 2) + b"a\0" + b"\5\0",
            "counter",
            5,
        ),
    ],
)
def test_counters_and_stamps_are_found_by_the_definition(
    text: str, payload: bytes, kind: str, value: int
) -> None:
    found = value_reader(Schema("a/msg/B", "ros2msg", text.encode()))
    assert found is not None
    assert (found[0], found[1](payload)) == (kind, value)


@pytest.mark.parametrize(
    "text", ["string data\n", "float64[] seq\n", "geometry_msgs/Pose p\nuint32 seq\n", ""]
)
def test_other_types_show_nothing(text: str) -> None:
    assert value_reader(Schema("a/msg/B", "ros2msg", text.encode())) is None
    assert value_reader(Schema("a/msg/B", "ros2idl", b"uint32 seq\n")) is None


def test_a_counter_that_begins_anew_loses_nothing_and_is_followed_from_there() -> None:
    counter = LossCounter()

    def counts(values: Iterable[int], first: int) -> dict[str, Progress]:
        at = [Position(value, T0 + (first + nth) * PERIOD) for nth, value in enumerate(values)]
        return {"/odom": Progress("counter", at)}

    assert counter.add_split("a", counts(range(500, 600), 0)) == []
    assert counter.add_split("a", counts([*range(600, 640), *range(40)], 100)) == []
    assert [each.lost for each in counter.add_split("a", counts(range(45, 100), 190))] == [5]
    assert counter.add_split("a", counts(range(50), 300)) == []
    assert counter.flush() == []


def test_what_a_counter_misses_where_the_clock_was_set_back_is_between_both_times() -> None:
    counter = LossCounter()
    losses: list[Loss] = []
    for begin, first in ((0, 0), (105, -60)):
        at = [Position(begin + nth, T0 + (first + nth) * PERIOD) for nth in range(100)]
        losses += counter.add_split("a", {"/odom": Progress("counter", at)})
    [loss] = losses
    assert (loss.lost, loss.start, loss.stop) == (5, T0 - 60 * PERIOD, T0 + 99 * PERIOD)


def test_what_is_latched_and_comes_again_in_a_rotation_hides_no_loss() -> None:
    counter = LossCounter()
    counter.begin("old")
    assert counter.add_split("old", progress([*range(100)])) == []
    counter.begin("new")
    again = [Position(value, T0 + 205 * PERIOD) for value, _ in at([*range(90, 130)])]
    new = [*at([*range(205, 210)]), *again, *at([*range(210, 300)])]
    old = progress([tick for tick in range(100, 215) if not 180 <= tick < 190])
    losses = counter.add_split("new", {"/odom": Progress("stamps", new)})
    losses += counter.add_split("old", old)
    assert [loss.lost for loss in [*losses, *counter.flush()]] == [10]


def arriving(start: int, stop: int, **hz: int) -> SplitMeasure:
    """A split of so many seconds, with topics of so many messages a second."""
    arrivals = {
        topic: Arrival(start * NS, stop * NS, (stop - start) * rate, NS // rate)
        for topic, rate in hz.items()
    }
    return SplitMeasure({}, {}, arrivals)


def test_who_was_silent_once_is_not_regular_for_an_hour() -> None:
    arrivals = Arrivals()
    for start in (*range(0, 60, 10), *range(100, 160, 10)):
        arrivals.add_split(arriving(start, start + 10, teleop=10, odom=50))
    arrivals.add_split(arriving(160, 190, odom=50))
    assert arrivals.silent_topics(0) == frozenset()
    for start in range(190, 4000, 10):
        arrivals.add_split(arriving(start, start + 10, teleop=10, odom=50))
    assert arrivals.silent_topics(20 * NS) == {"odom", "teleop"}


def test_a_clock_that_was_set_back_begins_anew() -> None:
    arrivals = Arrivals()
    for start in (*range(7000, 7060, 10), *range(0, 60, 10)):
        arrivals.add_split(arriving(start, start + 10, odom=50))
    assert (arrivals.silent_topics(0), arrivals.rates_hz(0)) == (frozenset(), {"odom": 50.0})
    assert arrivals.silent_topics(11 * NS) == {"odom"}
