"""When a recording begins anew, what a full disk asks for, and how silent topics are described."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.recorder.policies import (
    Backoff,
    SilenceWatch,
    SpaceAction,
    describe_silent_topics,
    resume_bytes,
    space_action,
)


class TestBackoff:
    def test_doubles_up_to_its_cap(self) -> None:
        backoff = Backoff()
        waits = [backoff.failed() for _ in range(9)]
        assert waits == [1, 2, 4, 8, 16, 32, 60, 60, 60]

    def test_a_recorder_that_died_for_days_still_has_a_wait(self) -> None:
        backoff = Backoff()
        assert {backoff.failed() for _ in range(5000)} >= {60}


def silent_at(watch: SilenceWatch, written: dict[float, int], until_s: float) -> float | None:
    """The first moment, in steps of half a second, at which the watch calls for a rotation."""
    size = 0
    for half in range(round(until_s * 2) + 1):
        now = half / 2
        size = max(size, *(total for moment, total in written.items() if moment <= now), 0)
        if watch.is_silent(now, size):
            return now
    return None


class TestSilence:
    def watch(self, session_s: float = 600) -> SilenceWatch:
        watch = SilenceWatch(split_duration_s=10, session_duration_s=session_s)
        watch.began(0, 5)
        return watch

    def test_three_splits_without_growth_after_some_growth_call_for_a_rotation(self) -> None:
        assert silent_at(self.watch(), {0: 0, 7: 100, 20: 200}, 100) == 50

    def test_a_robot_that_never_spoke_is_left_alone(self) -> None:
        assert silent_at(self.watch(), {0: 0}, 1000) is None

    def test_headers_and_latched_messages_of_a_young_recording_are_no_speech(self) -> None:
        assert silent_at(self.watch(), {0: 0, 1: 500, 4.5: 900}, 1000) is None

    def test_growth_goes_on_and_nothing_is_called_for(self) -> None:
        steady = {float(t): t for t in range(0, 400, 29)}
        assert silent_at(self.watch(), steady, 400) is None

    def test_each_rotation_for_silence_doubles_the_patience_up_to_a_session(self) -> None:
        watch = self.watch(session_s=100)
        moments = []
        for _ in range(4):
            watch.began(0, 5)
            moments.append(silent_at(watch, {0: 0, 10: 100}, 300))
            watch.rotated(for_silence=True)
        assert moments == [40, 70, 110, 110]

    def test_a_session_that_lived_sets_the_patience_back(self) -> None:
        watch = self.watch()
        watch.rotated(for_silence=True)
        watch.rotated(for_silence=True)
        watch.rotated(for_silence=False)
        watch.began(0, 5)
        assert silent_at(watch, {0: 0, 10: 100}, 300) == 40

    def test_after_a_rotation_it_waits_for_growth_again(self) -> None:
        watch = self.watch()
        assert silent_at(watch, {0: 0, 10: 100}, 300) == 40
        watch.rotated(for_silence=True)
        watch.began(40, 5)
        assert [now for now in range(40, 400) if watch.is_silent(now, 0)] == []


class TestSpace:
    @pytest.mark.parametrize(
        ("free", "paused", "room_requested", "expected"),
        [
            (1000, False, False, SpaceAction.NONE),
            (999, False, False, SpaceAction.MAKE_ROOM),
            (999, False, True, SpaceAction.PAUSE),
            (1000, False, True, SpaceAction.NONE),
            (0, True, True, SpaceAction.STAY_PAUSED),
            (1199, True, True, SpaceAction.STAY_PAUSED),
            (1200, True, True, SpaceAction.RESUME),
        ],
    )
    def test_first_room_is_made_then_recording_pauses_and_resumes_by_itself(
        self, free: int, paused: bool, room_requested: bool, expected: SpaceAction
    ) -> None:
        assert space_action(free, 1000, paused=paused, room_requested=room_requested) is expected

    @pytest.mark.parametrize(
        ("free", "paused", "expected"),
        [
            (999, False, SpaceAction.WAIT),
            (500, False, SpaceAction.WAIT),
            (499, False, SpaceAction.PAUSE),
            (1000, False, SpaceAction.NONE),
            (1199, True, SpaceAction.STAY_PAUSED),
        ],
    )
    def test_room_that_is_being_made_is_waited_for_while_half_the_least_is_free(
        self, free: int, paused: bool, expected: SpaceAction
    ) -> None:
        assert (
            space_action(free, 1000, paused=paused, room_requested=True, making_room=True)
            is expected
        )

    @given(st.integers(0, 10**13), st.integers(0, 10**12))
    def test_what_it_resumes_with_is_never_what_it_pauses_for(self, free: int, least: int) -> None:
        if space_action(free, least, paused=True, room_requested=True) is SpaceAction.RESUME:
            assert space_action(free, least, paused=False, room_requested=True) is SpaceAction.NONE

    def test_a_least_of_nothing_never_pauses(self) -> None:
        assert space_action(0, 0, paused=False, room_requested=False) is SpaceAction.NONE
        assert resume_bytes(0) == 0


def test_nothing_is_reported_where_all_topics_were_heard() -> None:
    assert describe_silent_topics(["/odom"], ["/odom", "/tf"], "ask") is None
    assert describe_silent_topics([], [], "ask") is None
