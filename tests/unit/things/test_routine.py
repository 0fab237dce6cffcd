"""Where a thing that moves usually is: told where it is right more often than the last place."""

from collections.abc import Callable
from typing import Final, TypeAlias

import numpy as np
import pytest
from numpy.typing import NDArray

from ros2_memory.results import UsualPlace
from ros2_memory.things.routine import usual_places

HOUR: Final = 3600 * 10**9
DAY: Final = 24 * HOUR
PLACES: Final = np.array([[1000, 1000], [4000, 2000], [7000, 5000], [2000, 8000]])
DAYS: Final = 30

Drawn: TypeAlias = "tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]"
Whereabouts: TypeAlias = "Callable[[np.random.Generator, int, int, int], int]"


def at_random(chance: np.random.Generator, _day: int, _hour: int, before: int) -> int:
    return int(chance.integers(len(PLACES))) if chance.random() < 0.15 else before


def seldom_moved(chance: np.random.Generator, _day: int, _hour: int, before: int) -> int:
    return int(chance.integers(len(PLACES))) if chance.random() < 0.01 else before


def mostly_at_home(chance: np.random.Generator, _day: int, _hour: int, _before: int) -> int:
    return 0 if chance.random() < 0.8 else int(chance.integers(len(PLACES)))


def month(seed: int, whereabouts: Whereabouts) -> Drawn:
    """Returns when (ns) and where (mm) a thing was seen, and its place in each hour."""
    chance = np.random.default_rng(seed)
    times, seen, places = [], [], [0]
    for hour in range(DAYS * 24):
        places.append(whereabouts(chance, hour // 24, hour % 24, places[-1]))
        if 7 <= hour % 24 < 23 and chance.random() < 0.35:
            times.append(hour * HOUR + int(chance.integers(HOUR)))
            seen.append(PLACES[places[-1]] + chance.normal(0, 80, 2).astype(np.int64))
    return np.array(times), np.array(seen), np.array(places[1:])


def told(drawn: Drawn, at: int) -> tuple[UsualPlace, ...] | None:
    times, seen, _ = drawn
    return usual_places(times[times < at], seen[times < at], at, lambda _: 0)


@pytest.mark.parametrize("whereabouts", [at_random, seldom_moved, mostly_at_home])
def test_without_a_routine_none_is_told(whereabouts: Whereabouts) -> None:
    """One of twenty may be found by chance."""
    found = [told(month(seed, whereabouts), DAYS * DAY) for seed in range(20)]
    assert sum(bool(each) for each in found) <= 1
