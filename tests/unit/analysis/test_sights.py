from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.analysis.sights import (
    NO_YAW,
    Hit,
    Look,
    Spot,
    Unplaced,
)
from tests.support.examples import examples
from tests.support.sights import (
    Message,
    PlacedDetection,
    sights_of_messages,
)

SECOND = 10**9


coordinates = st.floats(-20, 20, allow_nan=False)
things = st.builds(
    PlacedDetection,
    st.sampled_from(["mug", "Mug", "cup"]),
    st.none() | st.tuples(coordinates, coordinates, coordinates),
    st.none() | st.floats(0, 1),
)
messages = st.lists(
    st.tuples(
        st.integers(0, 60 * SECOND),
        st.none() | st.tuples(coordinates, coordinates, st.floats(-4, 4)),
        st.lists(things, max_size=6),
    ),
    max_size=20,
)


@settings(max_examples=examples(60))
@given(messages)
def test_nothing_that_was_detected_is_lost(
    seen: list[tuple[int, None, list[PlacedDetection]]],
) -> None:
    ordered = sorted(seen, key=lambda each: each[0])
    found = sights_of_messages([Message("/a", *each) for each in ordered])
    count = sum(len(detections) for *_, detections in seen)
    assert int(found.spots[:, Spot.N].sum() + found.unplaced[:, Unplaced.N].sum()) == count
    assert int(found.hits[:, Hit.N].sum()) == int(found.spots[:, Spot.N].sum())
    from_somewhere = found.looks[found.looks[:, Look.YAW] != NO_YAW]
    assert int(from_somewhere[:, Look.N].sum()) == sum(robot is not None for _, robot, _ in seen)
    assert int(found.looks[:, Look.N].sum()) == len(seen)
