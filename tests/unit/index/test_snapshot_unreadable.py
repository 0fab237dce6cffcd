"""What a snapshot tells of clocks, and of files that cannot be read."""

from __future__ import annotations

import pytest

from ros2_memory.core.model import BagState, TimeWindow
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.index.timeline import Timeline
from tests.support.listed_bags import odom_bag

S = 10**9
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
