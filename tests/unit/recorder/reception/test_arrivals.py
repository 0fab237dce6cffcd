"""Which topics have stopped, and how often the others come."""

from __future__ import annotations

from ros2_memory.recorder.measure import Arrival, Arrivals, SplitMeasure

S = 10**9


def split(start: int, stop: int, **hz: int) -> SplitMeasure:
    """A split of so many seconds, with topics of so many messages a second."""
    arrivals = {
        topic: Arrival(start * S, stop * S, (stop - start) * rate, S // rate)
        for topic, rate in hz.items()
    }
    return SplitMeasure({}, {}, arrivals)


def test_who_was_silent_once_is_not_regular_for_an_hour() -> None:
    arrivals = Arrivals()
    for start in (*range(0, 60, 10), *range(100, 160, 10)):
        arrivals.measured(split(start, start + 10, teleop=10, odom=50))
    arrivals.measured(split(160, 190, odom=50))
    assert arrivals.silent(0) == frozenset()
    for start in range(190, 4000, 10):
        arrivals.measured(split(start, start + 10, teleop=10, odom=50))
    assert arrivals.silent(20 * S) == {"odom", "teleop"}


def test_a_clock_that_was_set_back_begins_anew() -> None:
    arrivals = Arrivals()
    for start in (*range(7000, 7060, 10), *range(0, 60, 10)):
        arrivals.measured(split(start, start + 10, odom=50))
    assert (arrivals.silent(0), arrivals.rates_hz(0)) == (frozenset(), {"odom": 50.0})
    assert arrivals.silent(11 * S) == {"odom"}
