"""When a recording begins anew, and when a robot has fallen silent."""

import pytest

from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.recorder.policies import ClockReading, SilenceWatch, set_back


def silent_at(watch: SilenceWatch, written: dict[float, int], until_s: float) -> float | None:
    """The first moment, in steps of half a second, at which the watch calls for a rotation."""
    size = 0
    for half in range(round(until_s * 2) + 1):
        now = half / 2
        size = max(size, *(total for moment, total in written.items() if moment <= now), 0)
        if watch.is_silent(now, size):
            return now
    return None


def test_each_rotation_for_silence_doubles_the_patience_up_to_a_session() -> None:
    """One that lived for its session sets it back."""
    watch = SilenceWatch(split_duration_s=10, session_duration_s=100)
    moments = []
    for for_silence in (True, True, True, False, True):
        watch.note_begin(0)
        # What is written in the first seconds are headers and latched messages.
        moments.append(silent_at(watch, {0: 0, 4.5: 90, 10: 100}, 300))
        watch.note_rotation(for_silence=for_silence)
    assert moments == [40, 70, 110, 110, 40]


@pytest.mark.parametrize(
    ("wall_s", "expected"), [(1.0, False), (0.95, False), (0.85, True), (-5.0, True), (9.0, False)]
)
def test_only_a_clock_that_falls_behind_at_once_was_set_back(wall_s: float, expected: bool) -> None:
    later = ClockReading(11.0, round(wall_s * NS_PER_S))
    assert set_back(ClockReading(10.0, 0), later) is expected
