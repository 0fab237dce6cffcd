"""What is done about a full disk and a clock set back, and what is said of silent topics."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.recorder.handover.plan import ClockReading
from ros2_memory.recorder.watchdog import (
    Space,
    resume_bytes,
    silence_told,
    space,
    time_was_set_back,
)


class TestSpace:
    @pytest.mark.parametrize(
        ("free", "paused", "room_made", "expected"),
        [
            (1000, False, False, Space.ENOUGH),
            (999, False, False, Space.MAKE_ROOM),
            (999, False, True, Space.PAUSE),
            (1000, False, True, Space.ENOUGH),
            (0, True, True, Space.STAY_PAUSED),
            (1199, True, True, Space.STAY_PAUSED),
            (1200, True, True, Space.RESUME),
        ],
    )
    def test_first_room_is_made_then_recording_pauses_and_resumes_by_itself(
        self, free: int, paused: bool, room_made: bool, expected: Space
    ) -> None:
        assert space(free, 1000, paused=paused, room_made=room_made) is expected

    @pytest.mark.parametrize(
        ("free", "paused", "expected"),
        [
            (999, False, Space.WAIT),
            (500, False, Space.WAIT),
            (499, False, Space.PAUSE),
            (1000, False, Space.ENOUGH),
            (1199, True, Space.STAY_PAUSED),
        ],
    )
    def test_room_that_is_being_made_is_waited_for_while_half_the_least_is_free(
        self, free: int, paused: bool, expected: Space
    ) -> None:
        assert space(free, 1000, paused=paused, room_made=True, making=True) is expected

    @given(st.integers(0, 10**13), st.integers(0, 10**12))
    def test_what_it_resumes_with_is_never_what_it_pauses_for(self, free: int, least: int) -> None:
        if space(free, least, paused=True, room_made=True) is Space.RESUME:
            assert space(free, least, paused=False, room_made=True) is Space.ENOUGH

    def test_a_least_of_nothing_never_pauses(self) -> None:
        assert space(0, 0, paused=False, room_made=False) is Space.ENOUGH
        assert resume_bytes(0) == 0


@pytest.mark.parametrize(
    ("wall_s", "expected"), [(0.2, False), (-100.0, False), (-121.0, True), (5000.0, False)]
)
def test_only_a_clock_set_back_by_minutes_calls_for_a_new_recording(
    wall_s: float, expected: bool
) -> None:
    before = ClockReading(10.0, 10**18)
    now = ClockReading(10.2, 10**18 + round(wall_s * NS_PER_S))
    assert time_was_set_back(before, now) is expected


class TestSilentTopics:
    def test_nothing_is_said_where_all_were_heard(self) -> None:
        assert silence_told(["/odom"], ["/odom", "/tf"]) is None
        assert silence_told([], []) is None

    def test_the_silent_ones_are_named(self) -> None:
        said = silence_told(["/b", "/odom", "/a"], ["/odom"])
        assert said is not None
        assert said.endswith("/a, /b")

    def test_silence_of_all_of_them_points_at_the_transport(self) -> None:
        said = silence_told(["/odom", "/tf"], [])
        assert said is not None
        assert "FASTDDS_BUILTIN_TRANSPORTS=UDPv4" in said
