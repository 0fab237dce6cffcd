"""Where a thing that moves usually is."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.things.routine import _cluster_places

MM = st.integers(-20, 20).map(lambda step: 250 * step)


@given(st.lists(st.tuples(MM, MM), min_size=1, max_size=40))
def test_a_position_joins_the_nearest_place_within_a_metre(xy_mm: list[tuple[int, int]]) -> None:
    places: list[list[tuple[int, int]]] = []
    numbers = []
    for position in xy_mm:
        centres = [[sum(axis) / len(axis) for axis in zip(*place, strict=True)] for place in places]
        apart = [math.dist(centre, position) for centre in centres]
        nearest = min(range(len(apart)), key=apart.__getitem__, default=0)
        if not apart or apart[nearest] > 1000:
            nearest = len(places)
            places.append([])
        places[nearest].append(position)
        numbers.append(nearest)
    found, centres_found = _cluster_places(np.array(xy_mm))
    assert found.tolist() == numbers
    assert centres_found.tolist() == [np.mean(place, axis=0).tolist() for place in places]
