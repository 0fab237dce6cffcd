"""Where a thing that moves usually is."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.things.routine import _cluster_places, _HourlyPlaces

MM = st.integers(-20, 20).map(lambda step: 250 * step)


@given(st.lists(st.tuples(MM, MM, st.sampled_from([0, 2700])), min_size=1, max_size=40))
def test_a_position_joins_the_nearest_place_within_a_metre(
    seen_mm: list[tuple[int, int, int]],
) -> None:
    places: list[list[tuple[int, int, int]]] = []
    numbers = []
    for position in seen_mm:
        centres = [[sum(axis) / len(axis) for axis in zip(*place, strict=True)] for place in places]
        apart = [math.dist(centre, position) for centre in centres]
        nearest = min(range(len(apart)), key=apart.__getitem__, default=0)
        if not apart or apart[nearest] > 1000:
            nearest = len(places)
            places.append([])
        places[nearest].append(position)
        numbers.append(nearest)
    found, centres_found = _cluster_places(np.array(seen_mm))
    assert found.tolist() == numbers
    assert centres_found.tolist() == [np.mean(place, axis=0).tolist() for place in places]


@given(st.integers(0, 2**32 - 1))
def test_a_place_is_predicted_by_the_hours_before_alone(seed: int) -> None:
    """Those of many hours together are what each has by a history that ends there."""
    chance = np.random.default_rng(seed)
    hours, size = np.cumsum(chance.uniform(0.5, 9.0, 30)), 4
    whole = _HourlyPlaces(hours, chance.integers(0, size, len(hours)), size)
    rows = np.arange(5, len(hours))
    predicted = np.stack(whole.predict(rows, hours[rows]))
    assert np.allclose(predicted.sum(axis=2), 1.0)
    for nth, row in enumerate(rows.tolist()):
        before = _HourlyPlaces(hours[:row], whole.places[:row], size)
        alone = np.stack(before.predict(rows[[nth]], hours[[row]]))
        assert np.allclose(predicted[:, nth], alone[:, 0])
        at_least_one = np.bincount(whole.places[:row], minlength=size) + 1.0 / size
        shares = before.place_shares(rows[[nth]])[0]
        assert np.allclose(shares, at_least_one / at_least_one.sum())
