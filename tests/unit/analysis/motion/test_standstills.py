"""Where a robot stood still, or slowed down suddenly."""

import math
import random
from itertools import chain, count, pairwise
from typing import NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.analysis.motion.standstills import DROP_SLOT_NS, SpeedDrop, speed_drops
from ros2_memory.analysis.poses import Poses as PoseArrays
from ros2_memory.core.timebase import NS_PER_S
from tests.support.examples import LONG
from tests.unit.analysis.motion.posed import posed, stood_in, way_of

Poses = list[tuple[int, tuple[float, float, float]]]
S = NS_PER_S


class World(NamedTuple):
    """A robot that drives along x, and the times (s) at which it stands, in closed form."""

    poses: Poses
    standing: list[tuple[float, float]]
    period: float


def world(
    legs: list[tuple[float, float]], *, hz: float = 50, begin: float = 100.0, noise: float = 0.0
) -> World:
    """Legs of (seconds, metres per second), one after another, from `begin` on.

    `noise`: standard deviation (m) of what is added to each axis of each pose.
    """
    edges = [begin]
    places = [0.0]
    for seconds, speed in legs:
        edges.append(edges[-1] + seconds)
        places.append(places[-1] + seconds * speed)
    draw = random.Random(7)
    poses: Poses = []
    leg = 0
    for nth in range(int((edges[-1] - begin) * hz) + 1):
        time = begin + nth / hz
        while leg + 1 < len(legs) and time >= edges[leg + 1]:
            leg += 1
        x = places[leg] + (time - edges[leg]) * legs[leg][1]
        dx, dy, dz = (draw.gauss(0, noise) for _ in range(3))
        poses.append((round(time * S), (x + dx, 2.0 + dy, dz)))
    standing = [span for span, leg in zip(pairwise(edges), legs, strict=True) if leg[1] == 0]
    return World(poses, standing, 1 / hz)


def standstills_of(poses: Poses, blocks: int = 10**6) -> list[tuple[float, float]]:
    """The standstills (s), found in slices of so many blocks of the clock; mostly in one."""
    return [(each.start / S, each.end / S) for each in stood_in(posed(poses), blocks=blocks)[0]]


def stood(standstills: list[tuple[float, float]]) -> float:
    return sum(end - start for start, end in standstills)


LEGS = st.lists(
    st.tuples(
        st.one_of(st.just(0.0), st.floats(2.9, 4.1), st.floats(4.1, 30.0)),
        st.floats(1.0, 6.0),
        st.sampled_from([-1.0, -0.4, 0.03, 0.05, 0.1, 0.5, 1.5]),
    ),
    min_size=1,
    max_size=5,
)


@st.composite
def worlds(draw: st.DrawFn, noise: float = 0.0) -> World:
    """Standstills of 2.9 s and more at any phase, between drives."""
    legs = [(1.5, 0.5)]
    for standing, driving, speed in draw(LEGS):
        legs += [(standing, 0.0)] if standing else []
        legs += [(driving, speed)]
    return world(
        legs,
        hz=draw(st.sampled_from([10, 20, 33, 50])),
        begin=draw(st.floats(100.0, 110.0)),
        noise=noise,
    )


@settings(max_examples=150 if LONG else 15)
@given(worlds())
def test_a_standstill_of_any_phase_is_exact_to_a_message(made: World) -> None:
    period = made.period + 1e-6
    found = standstills_of(made.poses)
    for start, end in found:
        began, ended = min(made.standing, key=lambda span: abs(span[0] - start))
        assert abs(start - began) <= period
        assert abs(end - ended) <= period
    long = [span for span in made.standing if span[1] - span[0] >= 3 + 2 * period]
    possible = [span for span in made.standing if span[1] - span[0] >= 3 - 2 * period]
    assert len(long) <= len(found) <= len(possible)


@pytest.mark.parametrize("speed", [0.004, 0.005, 0.008])
@pytest.mark.parametrize("noise", [0.0, 0.001])
def test_a_creep_between_two_stops_is_parted_from_both(speed: float, noise: float) -> None:
    made = world([(20.0, 0.0), (60.0, speed), (20.0, 0.0)], hz=20, noise=noise)
    found = standstills_of(made.poses)
    assert stood(found) == pytest.approx(40, abs=14)
    assert all(end <= 127 or start >= 173 for start, end in found)


def test_a_standstill_that_drifts_away_ends_where_the_next_one_begins() -> None:
    found = standstills_of(world([(2400.0, 0.002)], hz=5).poses)
    assert len(found) > 4
    assert all(end == start for (_, end), (start, _) in pairwise(found))
    assert stood(found) == pytest.approx(2400, abs=1)


@st.composite
def restless(draw: st.DrawFn) -> Poses:
    """A robot that stands under noise of any size at any rate, whose position may toggle."""
    rate = draw(st.sampled_from([1, 2, 4, 5, 10, 20, 50]))
    noise = draw(st.sampled_from([0.0, 0.003, 0.01, 0.015, 0.02, 0.03, 0.2]))
    toggle = draw(st.sampled_from([0.0, 0.01, 0.03, 0.05]))
    chance = random.Random(draw(st.integers(0, 10_000)))
    begin = draw(st.integers(100 * S, 101 * S))
    poses: Poses = []
    for nth in range(min(60 * rate, 1500)):
        x = chance.gauss(0, noise) + chance.choice([0.0, toggle])
        poses.append((begin + nth * S // rate, (x, chance.gauss(0, noise), 0.0)))
    return poses


@settings(max_examples=150 if LONG else 15)
@given(
    st.one_of(restless(), *(worlds(noise=each).map(lambda made: made.poses) for each in (0, 0.01))),
    st.integers(1, 40),
)
def test_standstills_under_any_noise_are_in_order_and_the_same_in_slices_of_any_length(
    poses: Poses, blocks: int
) -> None:
    found = standstills_of(poses)
    assert all(start < end for start, end in found)
    edges = [poses[0][0] / S, *chain.from_iterable(found), poses[-1][0] / S]
    assert edges == sorted(edges)
    assert standstills_of(poses, blocks) == found


BEGIN = 1_784_000_000 * S
Pose = tuple[int, tuple[float, float, float], tuple[float, float, float, float]]


def driven(*legs: tuple[float, float, float], rate: int = 20) -> list[Pose]:
    """Poses of a robot that goes for so many seconds at a speed (m/s), and turns by a rate (rad/s).

    Heading and speed change at once.
    """
    poses: list[Pose] = []
    x = y = heading = 0.0
    at = BEGIN
    for lasts_s, speed, turn in legs:
        for _ in range(round(lasts_s * rate)):
            rotation = (0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))
            poses.append((at, (x, y, 0.0), rotation))
            at += S // rate
            x += speed / rate * math.cos(heading)
            y += speed / rate * math.sin(heading)
            heading += turn / rate
    return poses


def found(poses: list[Pose]) -> list[SpeedDrop]:
    return [*speed_drops(turned(poses))]


def turned(poses: list[Pose]) -> PoseArrays:
    return posed(((at, place) for at, place, _ in poses), [turn for *_, turn in poses])


@pytest.mark.parametrize(
    "poses",
    [
        [],
        driven((5, 0.5, 0), (5, 0.4, 0), (5, 0.3, 0), (5, 0.25, 0)),  # slower, not much at a time
        driven((5, 0.5, 0), (2, 0.0, 0.8), (5, 0.5, 0)),  # to turn
        driven((5, 0.8, 0), (0.4, 0.6, 0), (0.4, 0.4, 0), (0.4, 0.2, 0), (0.5, 0, 0), (4, 0, 0.5)),
        driven((5, 0.1, 0), (2, 0.0, 0), (5, 0.1, 0)),  # hardly moved
        driven((5, 0.5, 0), (0.6, 0.0, 0), (5, 0.5, 0)),  # for a moment
        driven((5, 0.0, 0), (0.5, 0.5, 0), (5, 0.0, 0)),  # moved for a moment
        driven((20, 0.5, 0), (20, 0.0, 0), rate=1),  # too seldom
        [  # a single position is wrong
            (at, (x + 5 * (at == BEGIN + 5 * S), y, z), turn)
            for at, (x, y, z), turn in driven((10, 0.3, 0))
        ],
        [  # the position jumps back
            (at, (x - 0.2 * (at >= BEGIN + 5.2 * S), y, z), turn)
            for at, (x, y, z), turn in driven((10, 0.4, 0))
        ],
    ],
    ids=count(),
)
def test_what_is_no_sudden_loss_of_speed(poses: list[Pose]) -> None:
    assert found(poses) == []


@given(
    legs=st.lists(
        st.tuples(
            st.floats(0.3, 6), st.sampled_from([0.0, 0.05, 0.2, 0.5]), st.sampled_from([0.0, 0.5])
        ),
        min_size=1,
        max_size=8,
    ),
    blocks=st.integers(1, 8),
    silent=st.booleans(),
)
def test_slices_of_any_length_change_no_drop(
    legs: list[tuple[float, float, float]], blocks: int, silent: bool
) -> None:
    poses = driven(*legs, rate=10)
    if silent:
        poses = [each for each in poses if (each[0] - BEGIN) // DROP_SLOT_NS % 17 > 1]
    assert stood_in(turned(poses), blocks=blocks)[1] == found(poses)


@pytest.mark.parametrize("seed", [11, 64, 65, 70, 92])
def test_noise_of_rare_poses_does_not_part_a_standstill(seed: int) -> None:
    """Two poses a second, each off by 1 cm; the robot brakes at 123 s, and goes on at 140 s."""
    draw = random.Random(seed)
    poses: Poses = []
    x = 0.0
    for nth in range(130):
        time = 100 + nth / 2
        x += 0.25 * min(1, max(0, (125 - time) / 2, (time - 140) / 2))
        poses.append((round(time * S), (x + draw.gauss(0, 0.01), draw.gauss(0, 0.01), 0.0)))
    [whole] = standstills_of(poses)
    assert whole == pytest.approx((124, 140), abs=0.5)
    assert standstills_of(poses, blocks=3) == [whole]


def wandering(made: World, hz: float, noise: float, lasts_s: float) -> Poses:
    """The poses with noise (m) on x and y that is correlated over so many seconds."""
    drawn = random.Random(11)
    stays = math.exp(-1 / hz / lasts_s)
    wander = [drawn.gauss(0, noise), drawn.gauss(0, noise)]
    poses: Poses = []
    for time, (x, y, z) in made.poses:
        added = noise * math.sqrt(1 - stays * stays)
        wander = [stays * off + drawn.gauss(0, added) for off in wander]
        poses.append((time, (x + wander[0], y + wander[1], z)))
    return poses


@pytest.mark.parametrize("hz", [2, 10, 30])
@pytest.mark.parametrize("noise", [0.005, 0.02, 0.03])
@pytest.mark.parametrize("lasts_s", [0.2, 1.0, 10.0])
def test_a_robot_whose_position_wanders_at_rest_stands_still(
    hz: float, noise: float, lasts_s: float
) -> None:
    """As by visual SLAM, AMCL or a satellite receiver, whose messages state no speed."""
    made = world([(20.0, 0.6), (60.0, 0.0), (20.0, 0.6), (90.0, 0.0), (20.0, 0.6)], hz=hz)
    poses = wandering(made, hz, noise, lasts_s)
    found = standstills_of(poses, blocks=150)
    assert [end - start for start, end in found] == pytest.approx([60, 90], abs=3.5)
    assert found == standstills_of(poses, blocks=3)
    path = way_of(posed(poses), fastest_mps=5.0).totals
    assert path.distance_m == pytest.approx(36, rel=0.1)


@pytest.mark.parametrize("noise", [0.0, 0.005, 0.01, 0.02])
@pytest.mark.parametrize("lasts_s", [0.2, 1.0, 10.0])
def test_a_creep_of_5_cm_a_second_is_motion_also_where_the_position_wanders(
    noise: float, lasts_s: float
) -> None:
    made = world([(5.0, 0.5), (120.0, 0.05), (5.0, 0.5)], hz=10)
    poses = wandering(made, 10, noise, lasts_s)
    assert standstills_of(poses) == []
    assert way_of(posed(poses), fastest_mps=5.0).totals.distance_m == pytest.approx(11, rel=0.15)


def test_a_robot_that_drives_to_and_fro_within_a_hand_s_breadth_does_not_stand() -> None:
    poses = [(nth * S // 10, (0.05 * math.sin(nth / 10 * 1.5), 0.0, 0.0)) for nth in range(1200)]
    assert standstills_of(poses) == []
    assert way_of(posed(poses), fastest_mps=5.0).totals.distance_m == pytest.approx(5.7, rel=0.03)
