"""How far, how fast and where a robot drove, by poses with noise, gaps, resets and turns."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.analysis.motion.trajectory import Trajectory
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.history.context import Call
from ros2_memory.history.view import TimeRange
from ros2_memory.insights.recap import recap
from ros2_memory.queries import trajectory_summary
from ros2_memory.tools.replies import Replies
from tests.support.bags import Msg, odom, write_mcap
from tests.support.examples import examples
from tests.support.memories import memory_of
from tests.unit.analysis.motion.posed import posed, way_of

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

S = NS_PER_S
BEGIN = 1_784_000_000 * S
LONG_S = 900

Points = np.ndarray[tuple[int, int], np.dtype[np.float64]]


def line(speed: float, hertz: float, seconds: float) -> Points:
    x = np.arange(round(seconds * hertz) + 1) * speed / hertz
    return np.column_stack([x, 0 * x, 0 * x])


def arc(speed: float, hertz: float, seconds: float, radius: float = 0.5) -> Points:
    angle = line(speed, hertz, seconds)[:, 0] / radius
    return np.column_stack([radius * np.sin(angle), radius * (1 - np.cos(angle)), 0 * angle])


def through(corners: Sequence[tuple[float, float, float]], speed: float, hertz: float) -> Points:
    """Along straight lines from corner to corner."""
    ends = np.array(corners, dtype=np.float64)
    reached = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(ends, axis=0), axis=1))))
    way = np.arange(int(reached[-1] / speed * hertz) + 1) * speed / hertz
    return np.column_stack([np.interp(way, reached, ends[:, axis]) for axis in range(3)])


def noisy(points: Points, sigma: float, seed: int = 1, axes: int = 3) -> Points:
    draw = np.random.default_rng(seed)
    off = draw.normal(0.0, sigma, points.shape)
    off[:, axes:] = 0.0
    return points + off


def plain_sum(points: Points) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def summarise(points: Points, hertz: float, cuts: Sequence[int] | None = None) -> Trajectory:
    """Measured in slices of the clock, or in parts cut at these poses."""
    rows = [(BEGIN + round(nth * S / hertz), place) for nth, place in enumerate(points.tolist())]
    return way_of(posed(rows), 10.0, cuts).trajectory()


# Standing


@pytest.mark.parametrize(("hertz", "axes"), [(20, 2), (5, 3), (1, 3)])
def test_long_standing_with_10_mm_of_noise_is_no_way(hertz: int, axes: int) -> None:
    poses = noisy(np.zeros((LONG_S * hertz, 3)), 0.010, axes=axes)
    assert plain_sum(poses) > 15
    whole, in_bags = summarise(poses, hertz), summarise(poses, hertz, range(0, len(poses), 500))
    assert whole.totals.distance_m < 0.1
    assert in_bags.totals.distance_m < 0.1
    assert whole.is_noisy
    assert whole.totals.path_sum_m == pytest.approx(plain_sum(poses), rel=1e-9)
    assert whole.max_speed is not None
    assert whole.max_speed < 0.01


def test_a_robot_that_creeps_in_its_noise_gets_where_it_gets() -> None:
    poses = noisy(line(0.002, 50, LONG_S), 0.005)
    for found in (summarise(poses, 50), summarise(poses, 50, range(0, len(poses), 500))):
        assert found.totals.distance_m == pytest.approx(1.8, rel=0.05)


# Driving


@pytest.mark.parametrize(("speed", "hertz"), [(0.03, 20), (0.1, 50), (0.5, 20), (2.0, 50)])
def test_without_noise_lines_and_arcs_have_their_length(speed: float, hertz: int) -> None:
    for poses in (line(speed, hertz, 60), arc(speed, hertz, 60)):
        found = summarise(poses, hertz)
        assert found.totals.distance_m == pytest.approx(60 * speed, rel=0.002)
        assert found.totals.distance_m == pytest.approx(found.totals.path_sum_m, rel=1e-9)
        assert not found.is_noisy
        assert found.max_speed == pytest.approx(speed, rel=0.002)


@pytest.mark.parametrize(("speed", "hertz"), [(0.1, 50), (0.15, 20), (0.5, 30), (2.0, 20)])
def test_with_5_mm_of_noise_a_way_is_within_3_percent(speed: float, hertz: int) -> None:
    for seed, poses in enumerate(
        (
            line(speed, hertz, 100),
            arc(speed, hertz, 100),
            through([(0, 0, 0), (10, 0, 0)] * 3, speed, hertz),
            through([(0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0)] * 3, speed, hertz),
            through([(0, 0, 0), (0, 0, 8), (5, 0, 12)], speed, hertz),
        )
    ):
        for axes in (2, 3):
            found = summarise(noisy(poses, 0.005, seed, axes), hertz)
            truth = plain_sum(poses) if seed != 1 else 100 * speed
            assert found.totals.distance_m == pytest.approx(truth, rel=0.03)
            assert found.max_speed == pytest.approx(speed, rel=0.2)


@pytest.mark.parametrize(
    ("leg_m", "speed", "least", "most"),
    [(0.1, 0.1, -0.14, -0.12), (0.2, 0.1, -0.075, -0.05), (1.0, 0.5, -0.03, -0.015)],
)
def test_short_legs_come_out_as_much_too_short_as_the_docs_say(
    leg_m: float, speed: float, least: float, most: float
) -> None:
    poses = through([(0, 0, 0), (leg_m, 0, 0)] * round(60 * speed / leg_m), speed, 50)
    for seed in range(2):
        found = summarise(noisy(poses, 0.005, seed, axes=2), 50)
        assert least < found.totals.distance_m / plain_sum(poses) - 1 < most


def test_short_stops_and_goes_come_out_as_much_too_long_as_the_docs_say() -> None:
    x = np.cumsum(np.tile(np.repeat([0.0, 0.3], 100), 30)) / 50
    poses = np.column_stack([x, 0 * x, 0 * x])
    for seed in range(2):
        found = summarise(noisy(poses, 0.005, seed, axes=2), 50)
        assert 0 < found.totals.distance_m / x[-1] - 1 < 0.04


def test_poses_at_one_hertz_keep_the_turns_between_them() -> None:
    corners = [(0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (2.0, 2.0, 0.0), (0.0, 2.0, 0.0)] * 5
    poses = through(corners, 0.5, 1)
    assert summarise(poses, 1).totals.distance_m == pytest.approx(plain_sum(poses), rel=1e-9)
    circle = arc(0.5, 1, 300)
    assert summarise(circle, 1).totals.distance_m == pytest.approx(plain_sum(circle), rel=1e-9)
    shuttle = np.array([(10.0 * (nth % 2), 0.0, 0.0) for nth in range(40)])
    assert summarise(shuttle, 1).totals.distance_m == 390.0


# Parts


def cuts_of(poses: Points, count: int, seed: int) -> list[int]:
    return sorted(np.random.default_rng(seed).choice(len(poses), count, replace=False).tolist())


@settings(max_examples=examples(30), deadline=None)
@given(
    st.sampled_from([20, 50]),
    st.floats(0.1, 2.0),
    st.integers(1, 40),
    st.integers(0, 10**6),
    st.booleans(),
)
def test_other_cuts_of_a_history_differ_by_half_a_percent_at_most(
    hertz: int, speed: float, count: int, seed: int, curved: bool
) -> None:
    poses = noisy((arc if curved else line)(speed, hertz, 120), 0.005, seed)
    whole = summarise(poses, hertz).totals.distance_m
    assert summarise(poses, hertz, cuts_of(poses, count, seed)).totals.distance_m == pytest.approx(
        whole, rel=0.005
    )


@settings(max_examples=examples(20), deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 300))
def test_without_noise_any_cuts_give_the_same_length(seed: int, count: int) -> None:
    poses = arc(0.5, 20, 60)
    found = summarise(poses, 20, cuts_of(poses, count, seed))
    assert found.totals.distance_m == pytest.approx(plain_sum(poses), rel=1e-9)


# Speed


def test_one_correction_of_the_position_is_not_the_highest_speed() -> None:
    for hertz in (2, 20):
        poses = line(0.5, hertz, 60)
        poses[len(poses) // 2 :, 1] += 0.35
        found = summarise(poses, hertz)
        assert found.max_speed == pytest.approx(0.5, rel=0.1)
        assert found.max_speed_from == "positions"


def test_a_burst_of_speed_that_lasts_is_the_highest() -> None:
    fast = line(1.5, 20, 3)[1:]
    fast[:, 0] += 6.0
    poses = np.concatenate([line(0.3, 20, 20), fast])
    assert summarise(noisy(poses, 0.002), 20).max_speed == pytest.approx(1.5, rel=0.05)


# Gaps, jumps and resets


def test_slow_poses_follow_each_other_up_to_five_usual_periods() -> None:
    for missing, gaps in ((4, 0), (5, 1)):
        x = [float(n) for n in range(30) if not 10 < n <= 10 + missing]
        rows = [(BEGIN + round(place * 2 * S), (place + 5, 0.0, 0.0)) for place in x]
        found = way_of(posed(rows), 10.0).trajectory()
        assert found.totals.gaps == gaps
        assert found.totals.distance_m + found.totals.gap_m == pytest.approx(29.0)
        assert found.totals.gap_m == (missing + 1 if gaps else 0)


def history(
    folder: Path, legs: Sequence[tuple[float, float, float]], *, split_s: float = 5.0
) -> list[list[Msg]]:
    """Odometry at 20 Hz along x: legs of (begin in seconds, from, to) at 1 m/s, in bags."""
    bags: list[list[Msg]] = []
    for begin, start, end in legs:
        steps = round(abs(end - start) * 20)
        run = [
            odom(BEGIN + round((begin + nth / 20) * S), start + (end - start) * nth / steps, 0.0)
            for nth in range(steps + 1)
        ]
        size = round(split_s * 20)
        bags += [run[at : at + size] for at in range(0, len(run), size)]
    for nth, messages in enumerate(bags):
        write_mcap(folder / f"run_{nth}.mcap", messages)
    return bags


def replies(folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """What trajectory_summary and recap say of everything."""
    memory = memory_of(folder)
    span = TimeRange(start_s=BEGIN / S - 1, end_s=BEGIN / S + 1000)
    shown = Replies(folder, 24_000)
    way = json.loads(shown.answer(trajectory_summary(memory, Call(), span)).text)
    told = json.loads(shown.answer(recap(memory, Call(), span)).text)
    return way, told


@pytest.mark.parametrize(("noise_m", "doubted"), [(1.0, True), (0.02, False)])
def test_noise_that_cannot_be_taken_off_is_noted(
    tmp_path: Path, noise_m: float, doubted: bool
) -> None:
    poses = noisy(line(1.0, 1, 300), noise_m, axes=2).tolist()
    messages = [odom(BEGIN + nth * S, x + 50, y) for nth, (x, y, _) in enumerate(poses)]
    for nth in range(3):
        write_mcap(tmp_path / f"bag_{nth}.mcap", messages[nth * 101 : nth * 101 + 101])
    for reply in replies(tmp_path):
        notes = [each for each in reply.get("notes", []) if "distance_m may be too long" in each]
        assert bool(notes) == doubted


@pytest.mark.parametrize(
    ("later", "driven_m", "gap_m", "note"),
    [
        ((50, 0.0, 10.0), 20.0, None, "odometry restarted 1 time"),
        ((18, 13.0, 20.0), 17.0, 3.0, "1 gap "),
        ((10.05, 60.0, 65.0), 15.0, None, "1 jump of 50.00 m"),
        # As long a pause as five poses take is a part of the way; home within it is a reset.
        ((11.0, 10.5, 20.0), 20.0, None, ""),
        ((10.02, 0.5, 10.0), 19.5, None, "odometry restarted 1 time"),
    ],
)
def test_what_a_gap_a_jump_or_a_reset_leads_across_is_not_driven(
    tmp_path: Path,
    later: tuple[float, float, float],
    driven_m: float,
    gap_m: float | None,
    note: str,
) -> None:
    history(tmp_path, [(0, 0.0, 10.0), later])
    for reply in replies(tmp_path):
        assert (reply["distance_m"], reply.get("gap_m")) == (driven_m, gap_m)
        assert not note or any(note in each for each in reply["notes"])


@pytest.mark.parametrize("split", [None, 0, 2, -3], ids=["one part", "at it", "after", "before"])
@pytest.mark.parametrize("noise_m", [0.0, 0.003])
@pytest.mark.parametrize(
    ("out_m", "pause_s"), [(3.0, 1.0), (3.0, 0.5), (0.8, 0.1), (10.0, 1.0), (3.0, 3.0)]
)
def test_a_step_back_to_the_origin_that_nothing_near_it_is_like_is_a_reset(
    out_m: float, pause_s: float, noise_m: float, split: int | None
) -> None:
    # 1 m/s at 10 Hz; odometry begins at 0 again, within the time and the speed of driving.
    out, again = line(1.0, 10, out_m), line(1.0, 10, 10)
    poses = noisy(np.concatenate([out, again]), noise_m, axes=2).tolist()
    at = [*np.arange(len(out)) / 10, *(out_m + pause_s + np.arange(len(again)) / 10)]
    rows = [(BEGIN + round(s * S), place) for s, place in zip(at, poses, strict=True)]
    cuts = [] if split is None else [len(out) + split]
    found = way_of(posed(rows), 10.0, cuts).trajectory()
    assert found.totals.distance_m == pytest.approx(out_m + 10, rel=0.02 if noise_m else 1e-9)
    assert found.max_speed == pytest.approx(1.0, rel=0.1)
    assert len(found.totals.resets) == 1


def fast(seconds: float, top: float, hertz: float) -> Points:
    """From rest to rest along x at 1 m/s^2 at most, ending at the origin."""
    at = np.arange(round(seconds * hertz) + 1) / hertz
    x = 0.5 * top * seconds * (1 + np.cos(np.pi * np.minimum(at / seconds, 1))) / 2
    return np.column_stack([x, 0 * x, 0 * x])


@pytest.mark.parametrize("hertz", [0.5, 2, 50])
def test_driving_through_the_origin_and_stopping_there_is_no_reset(hertz: float) -> None:
    rest = np.zeros((max(round(3 * hertz), 3), 3))
    home = fast(4.0, 2.0, hertz)
    stood = rest + home[0]
    for poses in (
        line(2.0, hertz, 20) - 20.0 * np.array([1, 0, 0]),
        through([(-5, 0, 0), (5, 0, 0)] * 4, 1.0, hertz),
        arc(1.0, hertz, 60, radius=2),
        np.concatenate([stood, home, rest]),
        np.concatenate([stood, home, rest, stood, home, rest])[: len(stood) + len(home) + 2],
        through([(2, 0, 0), (0, 0, 0), (0, 2, 0)], 0.02, hertz),
    ):
        for cuts in (None, range(0, len(poses), 7), range(0, len(poses), 40)):
            found = summarise(poses, hertz, cuts)
            assert found.totals.resets == ()
            assert found.totals.distance_m == pytest.approx(plain_sum(poses), rel=1e-6)


def test_a_spike_that_comes_back_to_the_origin_is_no_reset() -> None:
    poses = np.zeros((3000, 3))
    poses[250::500, 0] = 0.5
    assert summarise(poses, 50).totals.resets == ()
    at_zero = np.column_stack([np.full(3000, 0.6), np.zeros((3000, 2))])
    at_zero[250::500] = 0.0
    assert summarise(at_zero, 50).totals.resets == ()


@pytest.mark.parametrize("lost", [5, 10, 45])
def test_messages_lost_on_the_way_home_are_no_reset(lost: int) -> None:
    poses = np.concatenate([line(1.0, 50, 5)[::-1], np.zeros((100, 3))])
    last = 250 - lost
    rows = [(BEGIN + nth * S // 50, place) for nth, place in enumerate(poses.tolist())]
    found = way_of(posed([*rows[: last + 1], *rows[250:]]), 10.0).trajectory()
    assert found.totals.resets == ()
    assert found.totals.distance_m == pytest.approx(5.0)


# Waypoints


@pytest.mark.parametrize("split_s", [3.0, 7.0])
def test_a_turning_point_is_a_waypoint(tmp_path: Path, split_s: float) -> None:
    legs = [(10.0 * nth, 10.0 * (nth % 2), 10.0 * ((nth + 1) % 2)) for nth in range(5)]
    history(tmp_path, legs, split_s=split_s)
    way, _ = replies(tmp_path)
    assert way["distance_m"] == 50.0
    turns = [round(point["x"], 6) for point in way["waypoints"]]
    # Where a leg ends and the next one begins there are two messages.
    assert [x for x, before in zip(turns, [None, *turns], strict=False) if x != before] == [
        0.0,
        10.0,
        0.0,
        10.0,
        0.0,
        10.0,
    ]
    for point in way["waypoints"]:
        at = round(point["timestamp"] - BEGIN / S, 1)
        assert point["x"] == pytest.approx(10 - abs(10 - at % 20), abs=0.11)


def test_where_a_robot_stopped_on_its_way_are_waypoints_with_their_times() -> None:
    x = np.concatenate([np.arange(200) / 20, np.full(1200, 10.0), 10 + np.arange(200) / 20])
    poses = np.column_stack([x, 0 * x, 0 * x])
    for found in (summarise(poses, 20), summarise(poses, 20, range(0, 1600, 130))):
        stops = [point for point in found.waypoints if abs(point.position[0] - 10) < 0.3]
        times = [(point.time - BEGIN) / S for point in stops]
        assert min(times) == pytest.approx(10, abs=0.5)
        assert max(times) == pytest.approx(70, abs=0.5)
