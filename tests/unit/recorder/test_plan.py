"""One recording takes over from another: the steps, the cut, and that no message is lost to it."""

from __future__ import annotations

from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.bag_dir.handover_file import CutClock, Handover
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.recorder.handover import complete_sidecars
from ros2_memory.recorder.policies import ClockReading, set_back

T0 = 1_795_150_000 * NS_PER_S
S = NS_PER_S


@pytest.mark.parametrize(
    ("wall_s", "expected"), [(1.0, False), (0.95, False), (0.85, True), (-5.0, True), (9.0, False)]
)
def test_only_a_clock_that_falls_behind_at_once_was_set_back(wall_s: float, expected: bool) -> None:
    assert set_back(ClockReading(10.0, T0), ClockReading(11.0, T0 + round(wall_s * S))) is expected


class Receiver(NamedTuple):
    """When a recorder received, in seconds of the wall clock, and by how much later it did."""

    start: float
    stop: float
    delay_s: float


class Publisher(NamedTuple):
    """Publishes at multiples of its period, by a clock that is off by `skew_s`."""

    period_s: float
    phase_s: float
    skew_s: float


@given(
    publisher=st.builds(Publisher, st.floats(0.003, 0.3), st.floats(0, 0.3), st.floats(-0.9, 0.9)),
    subscribed_s=st.floats(0.2, 5),
    delays=st.tuples(st.floats(0, 0.002), st.floats(0, 0.002)),
    ends_after_s=st.floats(0.0, 5.0),
)
def test_every_message_counts_exactly_once_whatever_the_publisher_and_the_delays(
    publisher: Publisher,
    subscribed_s: float,
    delays: tuple[float, float],
    ends_after_s: float,
) -> None:
    old, new = complete_sidecars(
        Handover(),
        "a",
        "b",
        began=T0,
        both=T0 + round(subscribed_s * S),
        ended=T0 + round((subscribed_s + 2) * S),
        old_files=["a.mcap"],
        new_files=["b.mcap"],
        simulated=False,
        clock=CutClock.PUBLISH,
    )
    recorders = {
        "a.mcap": (old, Receiver(-10.0, subscribed_s + 2 + ends_after_s, delays[0])),
        # A second later at most: it said that it had subscribed after it had.
        "b.mcap": (new, Receiver(subscribed_s - 0.1, 20.0, delays[1])),
    }
    moment = -5 + publisher.phase_s
    while moment < 15:
        counted = 0
        for file, (handover, receiver) in recorders.items():
            received = moment + receiver.delay_s
            if not receiver.start <= received < receiver.stop:
                continue
            published = T0 + round((moment + publisher.skew_s) * S)
            logged = T0 + round(received * S)
            counted += not any(
                each.excludes(published, logged) for each in handover.exclusions(file)
            )
        assert counted == 1, moment
        moment += publisher.period_s
