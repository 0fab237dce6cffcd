from collections.abc import Sequence
from itertools import count
from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis.silences import (
    SHORTEST_NS,
    Pacing,
    Silence,
    Spacing,
    joined_pacings,
    silences,
    usual_periods,
)
from ros2_memory.core.spans import united

S = 10**9
MINUTE, HOUR = 60 * S, 3600 * S
ODOM, SEEN = "/odom", "/seen"


class Activity(NamedTuple):
    """When bags hold a topic, and how often."""

    runs: Sequence[tuple[int, int]]
    pacing: Pacing


def heard(*runs: tuple[int, int]) -> Activity:
    """A topic that is recorded once in a second during runs."""
    length = sum(last - first for first, last in runs)
    spacings = {0: Spacing(len(runs), length, max(length // S, 1))}
    return Activity(runs, Pacing(spacings, length // S, length))


def found(odom: Activity, seen: Activity) -> list[Silence]:
    periods = usual_periods({ODOM: odom.pacing, SEEN: seen.pacing})
    return silences(periods, {ODOM: odom.runs, SEEN: seen.runs}, [(ODOM, SEEN)])


DAY = (0, 9 * HOUR)
GAPPED = (0, 2 * HOUR), (5 * HOUR, 9 * HOUR)
DRIVES = tuple((at * HOUR, at * HOUR + 20 * MINUTE) for at in range(9))
SLOW = Activity(
    ((0, HOUR), (HOUR + 3 * MINUTE, 9 * HOUR)),
    Pacing({0: Spacing(9, 9 * HOUR, 3240)}, 3240, 9 * HOUR),
)
BURST = Activity(((0, HOUR), (5 * HOUR, 9 * HOUR)), Pacing({0: Spacing(3, 6 * S, 6)}, 30, 5 * HOUR))


@pytest.mark.parametrize(
    ("odom", "seen", "expected"),
    [
        (heard(DAY), heard((0, HOUR), (3 * HOUR, 9 * HOUR)), (HOUR, 3 * HOUR, 2 * HOUR)),
        (heard(DAY), heard((0, HOUR)), (HOUR, 9 * HOUR, 8 * HOUR, True)),
        # The newest message of all ends it.
        (heard(DAY), heard((0, HOUR), (9 * HOUR, 9 * HOUR)), (HOUR, 9 * HOUR, 8 * HOUR)),
        # Before its first message a topic was not there.
        (heard(DAY), heard((HOUR, 9 * HOUR)), None),
        # Without any topic it is a gap: it does not count, and does not part a silence.
        (heard(*GAPPED), heard(*GAPPED), None),
        (heard(*GAPPED), heard((0, HOUR), (6 * HOUR, 9 * HOUR)), (HOUR, 6 * HOUR, 2 * HOUR)),
        # It begins where the robot is on again.
        (
            heard(*GAPPED),
            heard((0, 2 * HOUR - S), (6 * HOUR, 9 * HOUR)),
            (5 * HOUR, 6 * HOUR, HOUR),
        ),
        # Half a minute is none, nor are twenty periods.
        (heard(DAY), heard((0, HOUR), (HOUR + 30 * S, 9 * HOUR)), None),
        (heard(DAY), SLOW, None),
        # What is published when something happens has no rate.
        (heard(DAY), BURST, None),
        # It is mostly silent by habit.
        (heard(DAY), heard(*((at, at + 10 * MINUTE) for at, _ in DRIVES)), None),
        # Of one that starts late each time only what is much longer counts.
        (
            heard(*DRIVES),
            heard(*((first + MINUTE, last) for first, last in DRIVES if first != 5 * HOUR)),
            (5 * HOUR, 6 * HOUR + MINUTE, 21 * MINUTE),
        ),
    ],
    ids=count(),
)
def test_a_topic_is_silent_while_others_are_heard(
    odom: Activity, seen: Activity, expected: tuple[int, int, int] | None
) -> None:
    assert found(odom, seen) == ([] if expected is None else [Silence(SEEN, *expected)])


RUNS = st.lists(st.tuples(st.integers(0, 400), st.integers(1, 60)), min_size=1, max_size=12)


def all_of(parts: Sequence[Activity]) -> Activity:
    runs = united((run for part in parts for run in part.runs), SHORTEST_NS)
    return Activity(runs, joined_pacings([part.pacing for part in parts]))


@given(RUNS, RUNS)
def test_a_silence_lies_between_messages_while_others_are_heard(
    drawn: list[tuple[int, int]], others: list[tuple[int, int]]
) -> None:
    seen = all_of([heard((a * S, (a + n) * S)) for a, n in drawn])
    odom = all_of([heard((a * S, (a + n) * S)) for a, n in others])
    for each in found(odom, seen):
        own, other = (seen, odom) if each.topic == SEEN else (odom, seen)
        assert all(last <= each.start or first >= each.end for first, last in own.runs)
        on = [max(0, min(b, each.end) - max(a, each.start)) for a, b in other.runs]
        # Runs that are half a minute apart count as one.
        assert 30 * S < each.length <= sum(on) + 30 * S * (len(on) + 1)
