"""Decides when to restart, rotate, make room and pause. Pure."""

from __future__ import annotations

import signal
from typing import Final, NamedTuple

from ros2_memory.core.timebase import NS_PER_MS, NS_PER_S, Ns
from ros2_memory.recorder.process.command import MESSAGES_LOST

FIRST_WAIT_S: Final = 1.0
MAX_WAIT_S: Final = 60.0
SILENT_SPLITS: Final = 3
"""A robot counts as silent after so many splits without growth."""
SETTLE_S: Final = 5.0
"""A recording first writes headers, and latched messages that every recording receives again: for
so long they do not end a silence."""
WAITING_S: Final = 30.0
"""A recorder that has recorded nothing for so long, and for a split, is waiting."""
OWN_TOPICS: Final = frozenset(
    {"/rosout", "/parameter_events", "/events/write_split", MESSAGES_LOST}
)
"""Topics that a recorder publishes itself: they do not show that it hears the robot."""
RESUME_FACTOR: Final = 1.2
"""Paused recording resumes when this many times the least free space is free."""
SET_BACK_NS: Final[Ns] = 120 * NS_PER_S
"""If the wall clock is set back by more, a new recording begins.

A message that comes long enough after the first one closes a split, so the open split would stay
open until the clock has caught up.
"""

STEP_NS: Final[Ns] = 100 * NS_PER_MS
"""A clock that falls behind by so much at once was set back; a slewed clock does so slowly."""


class ClockReading(NamedTuple):
    """The monotonic and the wall clock, read at the same time."""

    monotonic_s: float
    wall: Ns


def set_back(earlier: ClockReading, later: ClockReading, by_ns: Ns = STEP_NS) -> bool:
    """Whether the wall clock was set back by more than `by_ns` between two close readings.

    A clock that is set forward does no harm: one cut still separates the messages before the step
    from those after it.
    """
    passed = round((later.monotonic_s - earlier.monotonic_s) * NS_PER_S)
    return passed - (later.wall - earlier.wall) > by_ns


class Backoff:
    """The wait before the next attempt: it doubles with each failure, up to `MAX_WAIT_S`.

    A recorder that lived for long may have written nothing: its life alone does not reset the wait.
    """

    def __init__(self) -> None:
        self._wait_s = FIRST_WAIT_S

    def next_wait_s(self) -> float:
        """Returns the wait after a failure, and doubles the next one."""
        wait_s = self._wait_s
        self._wait_s = min(2 * wait_s, MAX_WAIT_S)
        return wait_s

    def reset(self) -> None:
        """Ends a series of failures: the next wait is the first again."""
        self._wait_s = FIRST_WAIT_S


class SilenceWatch:
    """Decides when to close a recording because its robot has fallen silent.

    Only a later message closes a split, so the last messages before a silence would stay unreadable
    until it ends. A recording that grew and then stopped growing is rotated once: the next one must
    grow before it can be rotated for silence again. A recording that never grew though topics are
    offered is rotated as well, unless the one before did not grow either: some recorders live and
    write nothing (rosbag2 issue 2463).

    A robot that publishes now and then would begin a recording with every message. So each rotation
    for silence doubles the patience, up to a session; a recording that lived for its whole session
    resets it.
    """

    def __init__(self, split_duration_s: float, session_duration_s: float) -> None:
        self._first_s = SILENT_SPLITS * split_duration_s
        self._cap_s = max(session_duration_s, self._first_s)
        self._patience_s = self._first_s
        self._settled_at_s = 0.0
        self._grew_at_s: float | None = None
        self._has_grown = False
        self._must_grow = False
        self._bytes = 0

    def note_begin(self, now_s: float) -> None:
        """Notes that a recording began."""
        self._settled_at_s = now_s + SETTLE_S
        self._grew_at_s = None if self._must_grow else now_s
        self._has_grown = self._must_grow = False
        self._bytes = 0

    def is_silent(self, now_s: float, bytes_written: int, *, offered: bool = False) -> bool:
        """Whether to rotate for silence.

        Args:
            now_s: the monotonic time.
            bytes_written: the size of the recording, which never shrinks.
            offered: whether publishers offer a topic of the robot.
        """
        if bytes_written > self._bytes:
            self._bytes = bytes_written
            if now_s >= self._settled_at_s:
                self._grew_at_s, self._has_grown = now_s, True
        if self._grew_at_s is None or not (self._has_grown or offered):
            return False
        least_s = 0.0 if self._has_grown else WAITING_S
        return now_s - self._grew_at_s >= max(self._patience_s, least_s)

    def note_rotation(self, *, for_silence: bool) -> None:
        """Notes that the recording was rotated."""
        self._must_grow = for_silence or not self._has_grown
        doubled_s = min(2 * self._patience_s, self._cap_s)
        self._patience_s = doubled_s if for_silence else self._first_s


def describe_death(status: int, last_output: str) -> str:
    """Returns a sentence on a `ros2 bag record` that ended by itself.

    `status` is its exit code, or minus the number of the signal that killed it.
    """
    if status >= 0:
        ended = f"ended by itself with status {status}"
    else:
        signal_names = {number.value: number.name for number in signal.Signals}
        ended = f"was killed ({signal_names.get(-status, f'signal {-status}')})"
    said = f"; last it said: {last_output}" if last_output else ""
    return f"ros2 bag record {ended}{said}"
