from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis.clock_steps import ClockStep, step_over
from ros2_memory.analysis.poses import Poses
from tests.unit.analysis.motion.posed import posed

S = 10**9


def poses(begin: float, x: float, speed_mps: float) -> Poses:
    """Poses of one second."""
    tenths = range(11)
    return posed(
        (round((begin + at / 10) * S), (x + speed_mps * at / 10, 0.0, 0.0)) for at in tenths
    )


def over(moved_m: float, *, length: float = 8.0, before: float = 0.5, after: float = 0.5) -> object:
    first = poses(99.0, 0.0, before)
    second = poses(100 + length, float(first.positions[-1, 0]) + moved_m, after)
    return step_over((100 * S, round((100 + length) * S)), first, second)


@given(
    by=st.floats(2.5, 86_400),
    speed=st.floats(0.2, 2.0),
    period=st.floats(0.01, 0.4),
)
def test_a_step_is_as_long_as_the_clock_was_set(by: float, speed: float, period: float) -> None:
    found = over(speed * period, length=by + period, before=speed, after=speed)
    assert isinstance(found, ClockStep)
    assert abs(found.by - round(by * S)) < S / 100
