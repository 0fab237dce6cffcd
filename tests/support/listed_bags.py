"""Bags as the index lists them, without their files."""

from ros2_memory.core.bag_summary import BagSummary, SummarySchema, TopicSummary
from ros2_memory.core.model import BagFile, BagState
from ros2_memory.core.timebase import Ns


def odom_bag(
    file: str,
    start: Ns,
    end: Ns,
    *,
    count: int = 2,
    written: Ns = 1,
    notes: tuple[str, ...] = (),
) -> BagFile:
    """A bag of odometry from its first to its last message."""
    topics = (TopicSummary("/odom", "nav_msgs/msg/Odometry", "cdr", count, start, end),)
    summary = BagSummary.packed(topics, SummarySchema(notes=notes))
    return BagFile(file, 1, written, BagState.CLOSED, summary, start, end)
