from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis.sights import (
    NO_YAW,
    Beside,
    Fix,
    Hit,
    Look,
    Score,
    Sights,
    Spot,
    Unplaced,
    fixes_of,
)
from tests.support.sights import (
    Message,
    PlacedDetection,
    no_sights,
    rows_of_tables,
    sights_of_messages,
    whole,
)

HERE = (0.0, 0.0, 0.0)
SECOND = 10**9


def sights_of(
    *messages: list[PlacedDetection], robot: tuple[float, float, float] | None = HERE
) -> Sights:
    times = np.linspace(0, 9 * SECOND, max(len(messages), 10)).astype(np.int64).tolist()
    return sights_of_messages(
        [
            Message("/detections", time, robot, things)
            for time, things in zip(times, messages, strict=False)
        ]
    )


def mug(x: float, y: float = 0.0, score: float | None = None) -> PlacedDetection:
    return PlacedDetection("mug", (x, y, 0.7), score)


def test_detections_that_lie_together_are_one_spot_at_their_mean() -> None:
    found = sights_of([mug(1.0, 0.1)], [mug(1.2, -0.1)], [mug(1.1)])
    [spot] = found.spots
    assert [int(spot[each]) for each in (Spot.N, Spot.X, Spot.Y, Spot.Z)] == [3, 1100, 0, 700]
    assert (spot[Spot.FIRST], spot[Spot.LAST]) == (0, 2 * SECOND)
    assert spot[Spot.DEV] == 115  # the root of (2 * (0.1^2 + 0.1^2)) / 3, in mm


def test_spots_that_grew_together_are_one_where_no_message_has_both() -> None:
    far_apart_at_first = [[mug(1.0)], [mug(1.8)], *[[mug(1.3)]] * 8, *[[mug(1.5)]] * 8]
    found = sights_of(*far_apart_at_first)
    assert found.spots[:, Spot.N].tolist() == [18]


def test_a_score_that_is_no_number_is_none() -> None:
    found = sights_of([mug(1.0, score=math.inf)], [mug(1.0, score=0.5)])
    assert found.spots[0, Spot.BEST] == 500
    assert found.scores[:, [Score.BIN, Score.N]].tolist() == [[10, 1]]


def test_other_labels_beside_a_detection_of_the_same_message_are_counted() -> None:
    cup = PlacedDetection("cup", (1.2, 0.0, 0.7))
    found = sights_of([mug(1.0), cup], [mug(1.0)], [cup, mug(3.0)])
    by_spot = {
        (
            found.labels[found.spots[row[Beside.SPOT], Spot.LABEL]],
            found.labels[row[Beside.LABEL]],
        ): (int(row[Beside.N]))
        for row in found.beside
    }
    assert by_spot == {("mug", "cup"): 1, ("cup", "mug"): 1}


def test_labels_beside_a_detection_are_counted_in_a_crowd_too() -> None:
    crowd = [PlacedDetection("box", (3.0 + nth, 0.0, 0.7)) for nth in range(200)]
    cup = PlacedDetection("cup", (1.2, 0.0, 0.7))
    found = sights_of([cup, *crowd, mug(1.0)])
    names = [found.labels[label] for label in found.beside[:, Beside.LABEL].tolist()]
    assert sorted(names) == ["cup", "mug"]


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


def test_fixes_are_kept_where_no_detector_published() -> None:
    poses, sigma = np.array([[1.0, -2.0, math.pi / 2]]), np.array([0.25])
    alone = fixes_of(np.array([13 * SECOND]), poses, sigma)
    both = whole([sights_of([mug(1.0)]), alone])
    assert both.fixes[:].tolist() == [[1, 13 * SECOND, 1000, -2000, 900, 250]]
    assert both.fixes[:, Fix.SIGMA] == [250]
    assert len(both.epochs) == 2


def test_what_is_seen_at_the_end_of_64_bits_has_a_time_that_fits() -> None:
    [spot] = sights_of_messages([Message("/detections", 2**63 - 1, HERE, [mug(1.0)])]).spots
    assert spot[Spot.LAST] == 2**63 - 808


def test_numbers_of_more_than_32_bits_are_packed() -> None:
    far = (9e6, -9e6, 1.0)  # m: in mm that is more
    messages = [
        Message("/detections", nth * SECOND, pose, []) for nth, pose in enumerate([HERE, far])
    ]
    both = whole([sights_of_messages(messages), sights_of([mug(1.0)])])
    assert sorted(both.looks[:, Look.X].tolist()) == [0, 0, 9 * 10**9]
