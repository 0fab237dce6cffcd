from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis.clock_steps import ClockStep, Elapsed, step_over
from ros2_memory.analysis.poses import NO_POSES, Poses
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


def test_one_pose_has_no_speed() -> None:
    first, second = poses(99.0, 0.0, 0.5), poses(108.0, 0.5, 0.5)
    assert step_over((100 * S, 108 * S), first.rows(slice(-1, None)), second) is None
    assert step_over((100 * S, 108 * S), first, NO_POSES) is None


@given(
    by=st.floats(2.5, 86_400),
    speed=st.floats(0.2, 2.0),
    period=st.floats(0.01, 0.4),
)
def test_a_step_is_as_long_as_the_clock_was_set(by: float, speed: float, period: float) -> None:
    found = over(speed * period, length=by + period, before=speed, after=speed)
    assert isinstance(found, ClockStep)
    assert abs(found.by - round(by * S)) < S / 100


@given(
    steps=st.lists(st.tuples(st.integers(0, 1000 * S), st.integers(2 * S, 90 * S)), max_size=6),
    times=st.lists(st.integers(0, 1000 * S), min_size=2, max_size=6),
)
def test_what_a_clock_skipped_is_no_time_that_passed(
    steps: list[tuple[int, int]], times: list[int]
) -> None:
    """A clock that is set ahead at moments of a true time: what it shows gives the true time."""

    def shown(t: int) -> int:
        return t + sum(by for moment, by in steps if moment < t)

    def last_shown(moment: int, nth: int) -> int:
        # Of steps at one moment each follows on those before it.
        same = sum(by for other, by in steps[:nth] if other == moment)
        return shown(moment) + same

    elapsed = Elapsed(
        ClockStep(last_shown(moment, nth), by) for nth, (moment, by) in enumerate(steps)
    )
    ordered = sorted(times)
    for start, stop in pairwise(ordered):
        assert elapsed.between(shown(start), shown(stop)) == stop - start
