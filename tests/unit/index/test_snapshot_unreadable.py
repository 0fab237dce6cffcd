"""What a snapshot tells of clocks, and of files that cannot be read."""

from __future__ import annotations

import pytest

from ros2_memory.core.bag_summary import BagSummary, TopicSummary
from ros2_memory.core.model import BagFile, BagState, TimeWindow
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.index.timeline import Timeline

S = 10**9
T0 = 1_784_023_200 * S
DAY = 24 * 3600 * S


def bag(
    file: str,
    start: int,
    end: int,
    *,
    state: BagState = BagState.CLOSED,
    written: int = 0,
    notes: tuple[str, ...] = (),
) -> BagFile:
    topics = (TopicSummary("/odom", "nav_msgs/msg/Odometry", "cdr", 2, start, end),)
    return BagFile(file, 1, written, state, BagSummary(topics, notes=notes), start, end)


@pytest.mark.parametrize(
    ("start", "stop", "found"),
    [(0, 5, []), (12, 15, ["open"]), (25, 26, ["open"]), (31, 33, []), (40, 41, ["odd"])],
)
def test_what_is_amiss_in_a_window_reaches_on_to_the_end_of_an_open_file(
    start: int, stop: int, found: list[str]
) -> None:
    bags = (
        bag("/r/good", T0, T0 + 50 * S),
        bag("/r/open", T0 + 10 * S, T0 + 20 * S, state=BagState.INCOMPLETE, written=T0 + 30 * S),
        bag("/r/odd", T0 + 40 * S, T0 + 41 * S, written=T0 + DAY, notes=("torn",)),
    )
    window = TimeWindow(T0 + start * S, T0 + stop * S)
    assert [each.path.name for each in Snapshot(Timeline.of(bags)).timeline.faulty(window)] == found
