"""When to begin anew: after a death, after a session, after a silence. Pure decisions."""

from __future__ import annotations

from typing import Final

SILENT_SPLITS: Final = 3
"""Splits without growth after which a robot counts as silent."""
_LONGEST_DOUBLING: Final = 16


class Backoff:
    """How long to wait before the next attempt: twice as long each time, up to a cap.

    An attempt that lasted at least `stable_s` was none of a series of failures: the wait after it
    is the first again. All in seconds.
    """

    def __init__(self, first_s: float = 1.0, cap_s: float = 60.0, stable_s: float = 60.0) -> None:
        self._first_s = first_s
        self._cap_s = cap_s
        self._stable_s = stable_s
        self._failures = 0

    def failed(self, lasted_s: float) -> float:
        """The wait after an attempt that ended after `lasted_s`."""
        if lasted_s >= self._stable_s:
            self._failures = 0
        doublings = min(self._failures, _LONGEST_DOUBLING)
        wait_s = min(self._first_s * (1 << doublings), self._cap_s)
        self._failures += 1
        return wait_s


class SilenceWatch:
    """Tells when a recording should be closed because its robot has fallen silent.

    A split is closed only by a message that comes after its time, so the last messages before a
    silence would stay unreadable for as long as it lasts. A recording that grew and then stood
    still is rotated once: the one after it must grow before it can be rotated for silence again.

    A robot that speaks now and then, and is silent for longer than three splits in between, would
    begin a recording with every word. So each rotation for silence doubles the patience, up to a
    session; one that lived its session sets it back.
    """

    def __init__(self, split_duration_s: float, session_duration_s: float) -> None:
        self._first_s = SILENT_SPLITS * split_duration_s
        self._cap_s = max(session_duration_s, self._first_s)
        self._patience_s = self._first_s
        self._settled_at_s = 0.0
        self._grew_at_s = 0.0
        self._bytes = 0
        self._grown = False

    def began(self, now_s: float, settle_s: float) -> None:
        """A recording began; what it writes within `settle_s` says nothing of the robot.

        Those are its headers, and the latched messages that every recording receives again.
        """
        self._settled_at_s = now_s + settle_s
        self._grew_at_s = self._settled_at_s
        self._bytes = 0
        self._grown = False

    def is_silent(self, now_s: float, bytes_written: int) -> bool:
        """Whether to rotate, given what the recording has written so far (it never shrinks)."""
        if bytes_written > self._bytes:
            self._bytes = bytes_written
            if now_s >= self._settled_at_s:
                self._grew_at_s = now_s
                self._grown = True
        return self._grown and now_s - self._grew_at_s >= self._patience_s

    def rotated(self, *, for_silence: bool) -> None:
        """The recording was rotated, for silence or because its session was over."""
        doubled_s = min(2 * self._patience_s, self._cap_s)
        self._patience_s = doubled_s if for_silence else self._first_s


def session_over(age_s: float, session_duration_s: float) -> bool:
    """Whether a recording has lived long enough.

    Every split repeats the list of all splits before it, so a recording that is never rotated
    grows with the square of its age.
    """
    return age_s >= session_duration_s
