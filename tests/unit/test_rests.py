from __future__ import annotations

import math
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.rests import Rest, RestBuilder, RestCollector
from ros2_memory.timebase import NS_PER_S

Poses = list[tuple[int, tuple[float, float, float]]]


def rests_of(poses: Poses) -> tuple[Rest, ...]:
    builder = RestBuilder()
    for time, position in poses:
        builder.add(time, position)
    return builder.rests()


def driven(*legs: tuple[float, float], hz: int = 20, begin_s: float = 100.25) -> Poses:
    """Poses along x: legs of (seconds, metres per second), one after another."""
    poses: Poses = []
    x, time = 0.0, begin_s
    for duration, speed in legs:
        for _ in range(round(duration * hz)):
            poses.append((round(time * NS_PER_S), (x, 0.0, 0.0)))
            time += 1 / hz
            x += speed / hz
    return poses


@st.composite
def histories(draw: st.DrawFn) -> tuple[Poses, list[int]]:
    """Poses with rests, drives, silences and sub-threshold creeping; and where they are cut."""
    time = draw(st.integers(0, 3 * NS_PER_S))
    x = 0.0
    poses: Poses = []
    steps = draw(
        st.lists(
            st.tuples(
                st.sampled_from([0, 10**7, 2 * 10**8, 9 * 10**8, NS_PER_S, 26 * 10**8, 10**10]),
                st.sampled_from([0.0, 0.0, 0.0, 0.01, 0.049, 0.2, -1.0]),
            ),
            min_size=1,
            max_size=60,
        )
    )
    for wait, step in steps:
        time += wait
        x += step
        poses.append((time, (x, -x / 2, 0.0)))
    cuts = sorted(draw(st.sets(st.integers(1, len(poses)), max_size=8)))
    return poses, cuts


@given(histories())
def test_where_a_history_is_cut_into_bags_changes_nothing(
    history: tuple[Poses, list[int]],
) -> None:
    poses, cuts = history
    builder = RestBuilder()
    for begin, end in zip([0, *cuts], [*cuts, len(poses)], strict=True):
        collector = RestCollector()
        for time, position in poses[begin:end]:
            collector.add(time, position)
        digest = collector.digest()
        if digest is not None:
            builder.join(digest)
    assert builder.rests() == rests_of(poses)


@given(histories())
def test_rests_are_in_order_apart_and_slow(history: tuple[Poses, list[int]]) -> None:
    poses, _ = history
    rests = rests_of(poses)
    for rest in rests:
        assert rest.start < rest.end
        assert rest.box.diagonal <= 0.05 * (rest.end - rest.start) / NS_PER_S + 1e-9
        for time, position in poses:
            if rest.start <= time < rest.end:
                assert rest.box.with_place(position) == rest.box
    assert all(one.end <= other.start for one, other in pairwise(rests))


def test_a_stop_is_found_to_the_second() -> None:
    [rest] = rests_of(driven((10, 0.5), (8, 0.0), (10, 0.5)))
    assert math.isclose(rest.start / NS_PER_S, 110.25, abs_tol=1.0)
    assert math.isclose(rest.end / NS_PER_S, 118.25, abs_tol=1.0)
    assert math.isclose(rest.box.centre[0], 5.0, abs_tol=0.03)


def test_a_robot_that_drives_never_rests() -> None:
    assert rests_of(driven((30, 0.1))) == ()


def test_poses_once_a_second_of_a_robot_that_drives_are_no_rest() -> None:
    assert rests_of(driven((30, 0.5), hz=1)) == ()


def test_poses_once_a_second_of_a_robot_that_stands_are_one_rest() -> None:
    [rest] = rests_of(driven((30, 0.0), hz=1))
    assert rest.end - rest.start == 29 * NS_PER_S


def test_a_silence_ends_a_rest() -> None:
    poses = driven((5, 0.0)) + driven((5, 0.0), begin_s=200)
    assert [round((rest.end - rest.start) / NS_PER_S) for rest in rests_of(poses)] == [5, 5]


def test_a_single_pose_is_no_rest() -> None:
    assert rests_of([(NS_PER_S, (0.0, 0.0, 0.0))]) == ()


def test_without_poses_there_is_no_digest() -> None:
    assert RestCollector().digest() is None
