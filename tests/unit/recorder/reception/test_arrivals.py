"""Which topics have stopped, and how often the others come."""

from __future__ import annotations

from ros2_memory.recorder.reception.measure import Arrival, Arrivals, SplitMeasure

S = 10**9


def split(start: int, stop: int, **hz: int) -> SplitMeasure:
    """A split of so many seconds, with topics of so many messages a second."""
    arrivals = {
        topic: Arrival(start * S, stop * S - S // rate, (stop - start) * rate, S // rate)
        for topic, rate in hz.items()
    }
    return SplitMeasure({}, {}, (), (start * S, stop * S), arrivals)


def test_a_regular_topic_is_silent_after_ten_periods_and_ten_seconds() -> None:
    arrivals = Arrivals()
    for start in range(0, 60, 10):
        arrivals.measured(split(start, start + 10, odom=50, scan=1))
    assert arrivals.silent(9 * S) == frozenset()
    assert arrivals.silent(11 * S) == {"odom", "scan"}
    arrivals.measured(split(60, 70, odom=50))
    assert arrivals.silent(0) == {"scan"}


def test_who_was_silent_once_is_not_regular_for_an_hour() -> None:
    arrivals = Arrivals()
    for start in (*range(0, 60, 10), *range(100, 160, 10)):
        arrivals.measured(split(start, start + 10, teleop=10, odom=50))
    arrivals.measured(split(160, 190, odom=50))
    assert arrivals.silent(0) == frozenset()
    for start in range(190, 4000, 10):
        arrivals.measured(split(start, start + 10, teleop=10, odom=50))
    assert arrivals.silent(20 * S) == {"odom", "teleop"}


def test_rates_are_those_of_the_newest_half_minute_and_of_the_silence_after_it() -> None:
    arrivals = Arrivals()
    assert arrivals.rates_hz(0) == {}
    for start in range(0, 60, 10):
        arrivals.measured(split(start, start + 10, odom=50 if start < 30 else 20))
    assert arrivals.rates_hz(0) == {"odom": 20.0}
    assert arrivals.rates_hz(30 * S) == {"odom": 10.0}


def test_a_clock_that_was_set_back_begins_anew() -> None:
    arrivals = Arrivals()
    for start in (*range(7000, 7060, 10), *range(0, 60, 10)):
        arrivals.measured(split(start, start + 10, odom=50))
    assert (arrivals.silent(0), arrivals.rates_hz(0)) == (frozenset(), {"odom": 50.0})
    assert arrivals.silent(11 * S) == {"odom"}
