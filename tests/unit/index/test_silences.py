from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ros2_memory.core.bag_summary import BagSummary, TopicSummary
from ros2_memory.core.model import BagFile, BagState
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.index.timeline import Timeline

if TYPE_CHECKING:
    from collections.abc import Sequence

S = 10**9
BEGIN = 1_784_000_000 * S


def split(number: int, topics: Sequence[TopicSummary], folder: str = "rec") -> BagFile:
    start, end = min(each.first for each in topics), max(each.last for each in topics)
    name = str(Path("/bags") / folder / f"{folder}_{number}.mcap")
    return BagFile(name, 1, BEGIN, BagState.CLOSED, BagSummary(topics), start, end)


def test_what_is_absent_within_a_bag_leaves_the_other_topics_of_it_alone() -> None:
    topics = [
        TopicSummary(topic, "std_msgs/msg/Bool", "cdr", 500, BEGIN, BEGIN + 800 * S)
        for topic in ("/odom", "/seen")
    ]
    absences = (("/seen", ((BEGIN + 100 * S, BEGIN + 400 * S, 100),)),)
    bag = split(0, topics)._replace(summary=BagSummary(topics, absences=absences))
    snapshot = Snapshot(Timeline.of([bag]))
    assert [snapshot.longest_silence(topic.topic) for topic in topics] == [0, 300 * S]
