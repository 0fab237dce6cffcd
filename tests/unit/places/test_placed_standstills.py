"""Standstills of two windows, gathered at places."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.places.placed_standstills import PlacedStandstill, stood_at
from tests.support.examples import examples

S = 10**9

stands = st.lists(
    st.builds(
        PlacedStandstill,
        st.floats(0, 3),
        st.floats(0, 3),
        st.integers(0, 10**9),
        st.integers(1, 10**9),
    ),
    max_size=8,
)


@settings(max_examples=examples(40))
@given(stands, stands)
def test_every_standstill_is_of_one_place_and_near_to_it(
    one: list[PlacedStandstill], two: list[PlacedStandstill]
) -> None:
    found = stood_at(one, two)
    for side, given_ones in enumerate((one, two)):
        seconds = sum(at.seconds[side] or 0.0 for at in found)
        assert seconds == pytest.approx(sum(each.duration for each in given_ones) / S)
        for each in given_ones:
            assert min(math.dist(at.place, (each.x, each.y)) for at in found) <= 0.5
    assert {at.place for at in found} <= {(each.x, each.y) for each in (*one, *two)}
    assert [at.seconds for at in stood_at(two, one)] == [at.seconds[::-1] for at in found]
