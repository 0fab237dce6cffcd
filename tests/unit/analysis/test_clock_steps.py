from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis.clock_steps import ClockStep, holes, step_over
from ros2_memory.analysis.motion.odometry import TimedPosition

S = 10**9


def poses(begin: float, x: float, speed_mps: float) -> list[TimedPosition]:
    """Poses of one second."""
    return [
        TimedPosition(round((begin + at / 10) * S), (x + speed_mps * at / 10, 0.0, 0.0))
        for at in range(11)
    ]


def over(moved_m: float, *, length: float = 8.0, before: float = 0.5, after: float = 0.5) -> object:
    first = poses(99.0, 0.0, before)
    second = poses(100 + length, first[-1].position[0] + moved_m, after)
    return step_over((100 * S, round((100 + length) * S)), first, second)


def test_time_that_moved_nothing_did_not_pass() -> None:
    assert over(0.05) == ClockStep(100 * S, round(7.9 * S))


def test_a_robot_that_drove_on_shows_that_it_did() -> None:
    assert over(4.0) is None
    assert over(1.3) is None


def test_a_robot_that_stands_on_one_side_shows_nothing() -> None:
    assert over(0.0, before=0.0) is None
    assert over(0.0, after=0.05) is None


def test_one_pose_has_no_speed() -> None:
    first, second = poses(99.0, 0.0, 0.5), poses(108.0, 0.5, 0.5)
    assert step_over((100 * S, 108 * S), first[-1:], second) is None
    assert step_over((100 * S, 108 * S), first, []) is None


def test_holes_are_two_seconds_long_in_whatever_order_times_come() -> None:
    assert holes([5 * S, 0, S, 3 * S, 6 * S + 1]) == [(S, 3 * S), (3 * S, 5 * S)]
    assert holes([0, 2 * S - 1]) == []


@given(
    by=st.floats(2.5, 86_400),
    speed=st.floats(0.2, 2.0),
    period=st.floats(0.01, 0.4),
)
def test_a_step_is_as_long_as_the_clock_was_set(by: float, speed: float, period: float) -> None:
    found = over(speed * period, length=by + period, before=speed, after=speed)
    assert isinstance(found, ClockStep)
    assert abs(found.by - round(by * S)) < S / 100
