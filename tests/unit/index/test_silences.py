from __future__ import annotations

import random
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from ros2_memory.core.bag_summary import BagSummary, TopicSummary
from ros2_memory.core.model import BagFile, BagState
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.index.timeline import Timeline
from tests.support.bags import (
    McapLayout,
    Msg,
    boolean,
    text,
    write_db3,
    write_mcap,
    write_splits,
)
from tests.support.memories import asked, each_way, memory_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

S = 10**9
BEGIN = 1_784_000_000 * S
SPLIT = 10


def split(number: int, topics: Sequence[TopicSummary], folder: str = "rec") -> BagFile:
    start, end = min(each.first for each in topics), max(each.last for each in topics)
    name = str(Path("/bags") / folder / f"{folder}_{number}.mcap")
    return BagFile(name, 1, BEGIN, BagState.CLOSED, BagSummary(topics), start, end)


def at(topic: str, number: int, hz: float, type_name: str = "std_msgs/msg/Bool") -> TopicSummary:
    """What a split holds of a topic that is published at a rate."""
    start = BEGIN + number * SPLIT * S
    count = round(SPLIT * hz)
    return TopicSummary(topic, type_name, "cdr", count, start, start + round((count - 1) * S / hz))


def day(splits: int, blind: range) -> Iterator[BagFile]:
    """A robot whose detector is blind for some of the splits, and that logs now and then."""
    draw = random.Random(7)
    for number in range(splits):
        topics = [at("/odom", number, 50), at("/battery", number, 0.5)]
        if number not in blind:
            topics.append(at("/seen", number, 1))
        if draw.random() < 0.2:
            topics.append(at("/rosout", number, 3, "rcl_interfaces/msg/Log"))
        if draw.random() < 0.1:
            start = BEGIN + number * SPLIT * S
            topics.append(TopicSummary("/bump", "b", "cdr", 3, start + S, start + 2 * S))
        yield split(number, topics)


def test_the_blind_time_of_a_detector_is_found_and_nothing_else() -> None:
    bags = [*day(1200, range(500, 600))]
    [silence] = Snapshot(Timeline.of(bags)).silences
    assert silence.topic == "/seen"
    assert silence.start == BEGIN + 4999 * S
    assert silence.end == BEGIN + 6000 * S


def test_a_topic_of_two_types_is_heard_under_either() -> None:
    bags = [
        split(n, [at("/odom", n, 50), at("/seen", n, 1, "a" if n % 2 else "b")]) for n in range(100)
    ]
    assert Snapshot(Timeline.of(bags)).silences == ()


def test_what_is_absent_within_a_bag_leaves_the_other_topics_of_it_alone() -> None:
    topics = [
        TopicSummary(topic, "std_msgs/msg/Bool", "cdr", 500, BEGIN, BEGIN + 800 * S)
        for topic in ("/odom", "/seen")
    ]
    absences = (("/seen", ((BEGIN + 100 * S, BEGIN + 400 * S, 100),)),)
    bag = split(0, topics)._replace(summary=BagSummary(topics, absences=absences))
    snapshot = Snapshot(Timeline.of([bag]))
    assert [snapshot.longest_silence(topic.topic) for topic in topics] == [0, 300 * S]


def test_bags_that_a_wrong_clock_dated_show_no_silence() -> None:
    bags = [*day(600, range(0))]
    unset = TopicSummary("/odom", "std_msgs/msg/Bool", "cdr", 3000, 0, 60 * S)
    dated = [*bags, split(0, [unset], "early")]
    assert Snapshot(Timeline.of(dated), scanned_at=BEGIN + 10**6 * S).silences == ()


def published() -> Iterator[Msg]:
    """Twenty minutes, for two of which a topic is silent; another one has two types in turn."""
    for second in range(1200):
        ns = BEGIN + second * S
        yield boolean(ns, True, "/on")
        if not 400 <= second < 520:
            yield boolean(ns + S // 3, True, "/seen")
        body = text(ns, "a") if second // 200 % 2 else boolean(ns, True)
        yield replace(body, topic="/mixed")
        if second % 70 == 0:
            yield text(ns, "b", "/slow")


@each_way
@pytest.mark.parametrize("form", ["splits", "indexed", "scanned", "sqlite3"])
def test_a_silence_within_a_long_bag_is_found_as_one_across_splits(
    tmp_path: Path, form: str, recalls: bool
) -> None:
    messages = [*published()]
    whole = tmp_path / "rec" / "rec_0.mcap"
    if form == "splits":
        write_splits(tmp_path, messages)
    elif form == "sqlite3":
        write_db3(whole.with_suffix(".db3"), messages)
    else:
        write_mcap(whole, messages, McapLayout(chunk_size=None if form == "scanned" else 20_000))
    storage = "rosbag2" if form == "sqlite3" else "mcap"
    memory = memory_of(tmp_path, storage=storage, recalls=recalls)
    [silence] = asked(memory, tmp_path, "data_time_range")["silences"]
    assert (silence["topic"], silence["silent_s"]) == ("/seen", 121)
    assert silence["start"] == pytest.approx(BEGIN / S + 399.333, abs=1e-3)
