"""What a digest says of a bag is what reading the bag says."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis.motion.trajectory import PoseCollector, TrajectoryBuilder
from ros2_memory.catalogue.codec import (
    decode_poses,
    encode_poses,
)
from ros2_memory.catalogue.digest import Digester
from ros2_memory.catalogue.topic_digest import MAX_STORED
from ros2_memory.core.bag_summary import SummarySchema
from ros2_memory.core.model import Pose
from tests.support.bags import Msg, boolean, odom, text, tf, transform
from tests.support.fakes import FakeReader
from tests.support.memories import extractor

if TYPE_CHECKING:
    from ros2_memory.catalogue.digest import Digest
    from ros2_memory.catalogue.topic_digest import TopicDigest

S = 10**9
MS = 10**6
T0 = 1_700_000_000 * S
BAG = Path("rec/rec_0.mcap")


def digest_of(messages: list[Msg]) -> Digest:
    reader = FakeReader()
    reader.add(BAG, messages)
    return Digester(reader, extractor(), 10.0).digest(BAG)


def topic_of(messages: list[Msg]) -> TopicDigest:
    [topic] = digest_of(messages).topics
    return topic


def test_one_message_that_cannot_be_decoded_leaves_poses_and_edges_unknown() -> None:
    broken = Msg("/chatter", "std_msgs/msg/String", T0 + S, b"\x00\x01\x00\x00\xff\xff\xff\x7f")
    seen = topic_of([text(T0, "hello"), broken])
    assert seen.poses is None
    assert seen.edges is None


# Poses

coordinates = st.one_of(st.floats(-3, 3), st.sampled_from([math.nan, math.inf, 1e300, 50.0, -50.0]))
steps = st.tuples(
    st.integers(0, 250 * MS),
    coordinates,
    st.floats(-1, 1),
    st.one_of(st.none(), st.floats(-2, 2), st.just(math.nan)),
    st.sampled_from(["odom", "map"]),
)


@given(st.lists(st.lists(steps, max_size=12), max_size=5))
def test_digests_of_bags_joined_give_what_all_their_poses_give(
    bags: list[list[tuple[int, float, float, float | None, str]]],
) -> None:
    whole, joined = TrajectoryBuilder(10.0), TrajectoryBuilder(10.0)
    time = T0
    positions = []
    for bag in bags:
        collector = PoseCollector(10.0)
        for step, x, y, speed, frame in bag:
            time += step
            pose = Pose((x, y, 0.0), None, frame)
            positions.append((x, y, 0.0))
            whole.add(time, pose, speed)
            collector.add(time, pose, speed)
        joined.join(decode_poses(encode_poses(collector.digest())))
    told, expected = joined.result(), whole.result()
    assert joined.frames == whole.frames
    assert told.totals.distance_m == pytest.approx(expected.totals.distance_m, rel=1e-12, abs=1e-12)
    assert told.totals.jumped_m == pytest.approx(expected.totals.jumped_m, rel=1e-12)
    assert (told.poses, told.invalid, told.totals.jumps) == (
        expected.poses,
        expected.invalid,
        expected.totals.jumps,
    )
    assert (told.totals.duration_s, told.max_speed_from) == (
        expected.totals.duration_s,
        expected.max_speed_from,
    )
    assert told.max_speed == pytest.approx(expected.max_speed, rel=1e-12)
    assert [told.waypoints[:1], told.waypoints[-1:]] == [
        expected.waypoints[:1],
        expected.waypoints[-1:],
    ]
    assert told.waypoint_error_m <= 0.05 or len(told.waypoints) == 50


def test_the_path_of_joined_bags_is_within_the_stated_error() -> None:
    joined = TrajectoryBuilder(10.0, 2000)
    driven = []
    for bag in range(40):
        collector = PoseCollector(10.0)
        for n in range(100):
            t = bag * 10 + n / 10
            place = (5 * math.sin(t / 8), 5 * math.sin(t / 4), 0.0)
            driven.append(place)
            collector.add(T0 + int(t * S), Pose(place, None))
        joined.join(collector.digest())
    found = joined.result()
    assert found.waypoint_error_m <= 0.05
    line = [point.position for point in found.waypoints]
    for x, y, _ in driven:
        nearest = min(_off((x, y), a, b) for a, b in pairwise(line))
        assert nearest <= found.waypoint_error_m + 1e-9


def _off(p: tuple[float, float], a: tuple[float, ...], b: tuple[float, ...]) -> float:
    dx, dy = b[0] - a[0], b[1] - a[1]
    squared = dx * dx + dy * dy
    along = 0.0 if squared == 0 else ((p[0] - a[0]) * dx + (p[1] - a[1]) * dy) / squared
    along = min(max(along, 0.0), 1.0)
    return math.hypot(p[0] - a[0] - along * dx, p[1] - a[1] - along * dy)


def test_a_topic_without_poses_has_no_digest_of_them() -> None:
    assert topic_of([boolean(T0, True)]).poses is None


# The rest


def test_edges_are_all_pairs_and_the_stamps_of_the_ends() -> None:
    seen = topic_of(
        [
            tf(T0 + 5 * S, transform(T0 + 2 * S, "odom", "base_link", (0, 0, 0))),
            tf(T0 + 6 * S, transform(T0, "map", "odom", (0, 0, 0))),
            tf(T0 + 7 * S, transform(T0 + 4 * S, "odom", "base_link", (0, 0, 0))),
        ]
    )
    assert seen.edges is not None
    assert seen.edges.pairs == (("map", "odom"), ("odom", "base_link"))
    assert (seen.edges.first_stamp, seen.edges.last_stamp) == (T0 + 2 * S, T0 + 4 * S)


def test_few_latched_messages_are_stored_whole_and_many_are_not() -> None:
    fixed = transform(T0, "base_link", "laser", (0.1, 0, 0))
    sent = [tf(T0 + n, fixed, topic="/tf_static") for n in range(MAX_STORED + 1)]
    few = topic_of(sent[:MAX_STORED])
    assert few.kept is not None
    assert [record.log_time for record in few.kept] == [T0 + n for n in range(MAX_STORED)]
    assert (
        topic_of([tf(T0 + n, fixed, topic="/tf_static") for n in range(MAX_STORED + 1)]).kept
        is None
    )
    assert topic_of([text(T0, "not latched")]).kept is None


def test_a_summary_schema_is_the_same_after_it_was_encoded() -> None:
    summary = digest_of([odom(T0, 0, 0), text(T0 + S, "a"), text(T0 + 2 * S, "b")]).summary
    assert SummarySchema.from_json(summary.schema.to_json()) == summary.schema


def test_bytes_that_are_no_digest_are_refused() -> None:
    with pytest.raises(ValueError, match="not a digest"):
        decode_poses(b"123")
