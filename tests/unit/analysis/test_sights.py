from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis.sights import (
    NO_YAW,
    Hit,
    Look,
    Sights,
    Spot,
    Unplaced,
)
from tests.support.sights import (
    Message,
    PlacedDetection,
    no_sights,
    rows_of_tables,
    sights_of_messages,
    whole,
)

SECOND = 10**9


def mug(x: float, y: float = 0.0, score: float | None = None) -> PlacedDetection:
    return PlacedDetection("mug", (x, y, 0.7), score)


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


def built(topic: str, seen: list[tuple[int, None, list[PlacedDetection]]]) -> Sights:
    ordered = sorted(seen, key=lambda each: each[0])
    return sights_of_messages([Message(topic, *each) for each in ordered])


@given(messages)
def test_nothing_that_was_detected_is_lost(
    seen: list[tuple[int, None, list[PlacedDetection]]],
) -> None:
    found = built("/a", seen)
    count = sum(len(detections) for *_, detections in seen)
    assert int(found.spots[:, Spot.N].sum() + found.unplaced[:, Unplaced.N].sum()) == count
    assert int(found.hits[:, Hit.N].sum()) == int(found.spots[:, Spot.N].sum())
    from_somewhere = found.looks[found.looks[:, Look.YAW] != NO_YAW]
    assert int(from_somewhere[:, Look.N].sum()) == sum(robot is not None for _, robot, _ in seen)
    assert int(found.looks[:, Look.N].sum()) == len(seen)


@given(messages, messages)
def test_sights_are_joined_in_any_order(
    one: list[tuple[int, None, list[PlacedDetection]]],
    other: list[tuple[int, None, list[PlacedDetection]]],
) -> None:
    parts = [built("/a", one), built("/b", other), no_sights()]
    forward, backward = whole(parts), whole(parts[::-1])
    assert forward.topics == backward.topics
    assert rows_of_tables(forward) == rows_of_tables(backward)
