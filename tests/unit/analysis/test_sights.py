from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis.sights import (
    Beside,
    Hit,
    Look,
    PlacedDetection,
    Score,
    Sights,
    SightsBuilder,
    Spot,
    Unplaced,
    decode_joined,
    decode_sights,
    encode_sights,
    joined,
    no_sights,
)

HERE = (0.0, 0.0, 0.0)
SECOND = 10**9


def sights_of(
    *messages: list[PlacedDetection], robot: tuple[float, float, float] | None = HERE
) -> Sights:
    builder = SightsBuilder()
    for nth, things in enumerate(messages):
        builder.add("/detections", nth * SECOND, robot, things)
    return builder.sights()


def mug(x: float, y: float = 0.0, score: float | None = None) -> PlacedDetection:
    return PlacedDetection("mug", (x, y, 0.7), score)


def test_detections_that_lie_together_are_one_spot_at_their_mean() -> None:
    found = sights_of([mug(1.0, 0.1)], [mug(1.2, -0.1)], [mug(1.1)])
    [spot] = found.spots
    assert [int(spot[each]) for each in (Spot.N, Spot.X, Spot.Y, Spot.Z)] == [3, 1100, 0, 700]
    assert (spot[Spot.FIRST], spot[Spot.LAST]) == (0, 2 * SECOND)
    assert spot[Spot.DEV] == 115  # the root of (2 * (0.1^2 + 0.1^2)) / 3, in mm


def test_two_detections_of_one_message_are_never_one_spot() -> None:
    found = sights_of(*[[mug(1.0), mug(1.3)]] * 5)
    assert sorted(found.spots[:, Spot.X].tolist()) == [1000, 1300]
    assert found.spots[:, Spot.TOGETHER].tolist() == [2, 2]


def test_one_message_with_more_of_a_label_than_the_others_does_not_make_more_of_it() -> None:
    found = sights_of([mug(1.0), mug(3.0)], *[[mug(1.0)]] * 5)
    assert set(found.spots[:, Spot.TOGETHER].tolist()) == {1}


def test_spots_that_grew_together_are_one_where_no_message_has_both() -> None:
    far_apart_at_first = [[mug(1.0)], [mug(1.8)], *[[mug(1.3)]] * 8, *[[mug(1.5)]] * 8]
    found = sights_of(*far_apart_at_first)
    assert found.spots[:, Spot.N].tolist() == [18]


def test_a_look_counts_every_message_from_a_pose_whether_it_saw_anything_or_not() -> None:
    found = sights_of([mug(1.0)], [], [], [mug(1.0)])
    [look] = found.looks
    assert look[Look.N] == 4
    assert found.hits.tolist() == [[0, 0, 2]]


def test_looks_differ_by_place_and_direction() -> None:
    builder = SightsBuilder()
    for nth, pose in enumerate(
        [(0.1, 0.1, 0.05), (0.2, 0.2, 0.1), (0.3, 0.1, 0.05), (0.1, 0.1, 1)]
    ):
        builder.add("/detections", nth, pose, [])
    looks = builder.sights().looks
    assert looks[:, Look.N].tolist() == [2, 1, 1]
    assert looks[0, Look.X] == 150
    assert looks[0, Look.YAW] == 43  # the mean of 2.9 and 5.7 degrees


def test_without_a_pose_of_the_robot_a_detection_counts_and_no_look_does() -> None:
    found = sights_of([mug(1.0)], robot=None)
    assert len(found.looks) == 0
    assert found.hits.tolist() == [[0, -1, 1]]


def test_detections_without_a_place_are_counted_apart() -> None:
    found = sights_of(
        [PlacedDetection("mug", None)], [PlacedDetection("mug", (math.inf, 0, 0)), mug(1.0)]
    )
    assert found.spots[:, Spot.N].tolist() == [1]
    assert found.unplaced[:, Unplaced.N].tolist() == [2]


def test_scores_are_counted_in_bins_and_the_best_is_kept() -> None:
    found = sights_of([mug(1.0, score=0.52)], [mug(1.0, score=0.54)], [mug(1.0, score=7.0)])
    assert found.spots[0, Spot.BEST] == 7000
    assert found.scores[:, [Score.BIN, Score.N]].tolist() == [[10, 2], [19, 1]]


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


def test_what_moves_through_a_bag_makes_a_bounded_number_of_spots() -> None:
    found = sights_of(*[[mug(float(nth))] for nth in range(200)])
    assert len(found.spots) == 64
    assert found.unplaced[:, Unplaced.N].tolist() == [136]


def test_joined_sights_name_bags_topics_and_labels_once() -> None:
    one = sights_of([mug(1.0), PlacedDetection("cup", (3, 0, 0))])
    builder = SightsBuilder()
    builder.add("/other", 5, HERE, [])
    builder.add("/detections", 7, HERE, [PlacedDetection("cup", (3, 0, 0)), mug(1.0)])
    both = joined([one, builder.sights()])
    assert both.topics == ("/detections", "/other")
    assert both.labels == ("mug", "cup")
    assert both.spots[:, Spot.BAG].tolist() == [0, 0, 1, 1]
    assert both.spots[:, Spot.LABEL].tolist() == [0, 1, 1, 0]
    assert both.hits[:, Hit.LOOK].tolist() == [0, 0, 2, 2]
    assert both.bags == 2


coordinates = st.floats(-20, 20, allow_nan=False)
things = st.builds(
    PlacedDetection,
    st.sampled_from(["mug", "Mug", "cup"]),
    st.none() | st.tuples(coordinates, coordinates, coordinates),
    st.none() | st.floats(0, 1),
)
messages = st.lists(
    st.tuples(
        st.sampled_from(["/a", "/b"]),
        st.integers(0, 2**62),
        st.none() | st.tuples(coordinates, coordinates, st.floats(-4, 4)),
        st.lists(things, max_size=6),
    ),
    max_size=20,
)


def built(
    bag: list[tuple[str, int, tuple[float, float, float] | None, list[PlacedDetection]]],
) -> Sights:
    builder = SightsBuilder()
    for topic, time, robot, seen in bag:
        builder.add(topic, time, robot, seen)
        if robot is not None and seen:
            builder.add_fix(time, robot, seen[0].score)
    return builder.sights()


@given(messages)
def test_sights_survive_being_stored(
    bag: list[tuple[str, int, None, list[PlacedDetection]]],
) -> None:
    sights = built([*bag])
    assert decode_sights(encode_sights(sights)) == sights


@given(messages, messages, messages)
def test_joining_is_associative(
    a: list[tuple[str, int, None, list[PlacedDetection]]],
    b: list[tuple[str, int, None, list[PlacedDetection]]],
    c: list[tuple[str, int, None, list[PlacedDetection]]],
) -> None:
    one, two, three = built([*a]), built([*b]), built([*c])
    assert joined([joined([one, two]), three]) == joined([one, joined([two, three])])
    assert joined([no_sights(), one]).spots.shape == one.spots.shape


@given(st.lists(messages, max_size=5))
def test_stored_bags_are_decoded_together_as_they_are_joined_one_by_one(
    bags: list[list[tuple[str, int, None, list[PlacedDetection]]]],
) -> None:
    every = [built([*bag]) for bag in bags]
    found, which, frames = decode_joined([encode_sights(each) for each in every])
    assert which == [nth for nth, each in enumerate(every) if each.topics]
    assert found == joined(every[nth] for nth in which)
    assert frames == [every[nth].frame_id for nth in which]


def test_fixes_are_numbered_by_bag_and_kept_where_no_detector_published() -> None:
    builder = SightsBuilder()
    builder.add_fix(3 * SECOND, (1.0, -2.0, math.pi / 2), 0.25)
    alone = builder.sights("map")
    assert decode_sights(encode_sights(alone)) == alone
    both, which, frames = decode_joined(
        [encode_sights(sights_of([mug(1.0)])), encode_sights(alone)]
    )
    assert both.fixes.tolist() == [[1, 3 * SECOND, 1000, -2000, 900, 250]]
    assert (both.bags, which, frames) == (2, [0, 1], ["", "map"])


@pytest.mark.parametrize(
    "packed",
    [b"nothing", b"\xff\n", b'[0,"",["/a"],[],[[9,9]]]\n12345'],
)
def test_other_bytes_are_no_sights(packed: bytes) -> None:
    with pytest.raises(ValueError, match=r"not sights|Expecting|codec"):
        decode_sights(packed)


def test_a_bag_without_a_detector_costs_nothing() -> None:
    assert encode_sights(no_sights()) == b""
    assert decode_sights(b"") == no_sights()
    assert np.array_equal(no_sights().spots, np.zeros((0, len(Spot))))


def test_what_is_seen_at_the_end_of_64_bits_has_a_time_that_fits() -> None:
    builder = SightsBuilder()
    builder.add("/detections", 2**63 - 1, HERE, [mug(1.0)])
    [spot] = builder.sights().spots
    assert spot[Spot.LAST] == 2**63 - 808
