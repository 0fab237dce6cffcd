"""Decides when to start again, rotate, make room and pause. Pure."""

from __future__ import annotations

import signal
from typing import Final, NamedTuple

from ros2_memory.core.timebase import NS_PER_MS, NS_PER_S, Ns
from ros2_memory.recorder.process.command import MESSAGES_LOST

FIRST_WAIT_S: Final = 1.0
MAX_WAIT_S: Final = 60.0
SILENT_SPLITS: Final = 3
"""Splits without growth after which a robot counts as silent."""
WAITING_S: Final = 30.0
"""A recorder that has recorded nothing for so long, and for a split, waits for something."""
OWN_TOPICS: Final = frozenset(
    {"/rosout", "/parameter_events", "/events/write_split", MESSAGES_LOST}
)
"""Topics that each recorder publishes itself: they do not show that it hears the robot."""
RESUME_FACTOR: Final = 1.2
"""Recording that was paused resumes when this many times the least free space is free again."""
SET_BACK_NS: Final[Ns] = 120 * NS_PER_S
"""A wall clock that is set back by more would keep the open split open until it has caught up.

A split is closed by the time of a message that comes long enough after its first. A smaller step is
waited out.
"""

STEP_NS: Final[Ns] = 100 * NS_PER_MS
"""A clock that falls behind by so much at once was set back; a slewed one falls behind slowly."""


class ClockReading(NamedTuple):
    """Both clocks, read at the same time: seconds that never step, and the wall clock."""

    monotonic_s: float
    wall: Ns


def set_back(earlier: ClockReading, later: ClockReading, by_ns: Ns = STEP_NS) -> bool:
    """Whether the wall clock was set back by more than `by_ns` between two readings close together.

    A clock that is set forward does no harm: messages published before and after the step are still
    on either side of one cut.
    """
    passed = round((later.monotonic_s - earlier.monotonic_s) * NS_PER_S)
    return passed - (later.wall - earlier.wall) > by_ns


class Backoff:
    """How long to wait before the next attempt: twice as long each time, up to a cap.

    What shows that an attempt was good ends a series of failures: the wait after it is the first
    again. How long it lasted shows nothing: a recorder may live for minutes and write nothing.
    """

    def __init__(self) -> None:
        self._wait_s = FIRST_WAIT_S

    def failed(self) -> float:
        """Returns the wait in seconds after an attempt that failed."""
        wait_s = self._wait_s
        self._wait_s = min(2 * wait_s, MAX_WAIT_S)
        return wait_s

    def succeeded(self) -> None:
        """Notes that an attempt was good."""
        self._wait_s = FIRST_WAIT_S


class SilenceWatch:
    """Decides when to close a recording because its robot has fallen silent.

    A split is closed only by a message that comes after its time, so the last messages before a
    silence would stay unreadable for as long as it lasts. A recording that grew and then stopped
    growing is rotated once: the next one must grow before it can be rotated for silence again. So
    is one that never grew though topics are offered, unless the one before did not grow either:
    some recorders live and write nothing (rosbag2 issue 2463), and another one does.

    A robot that publishes now and then, and is silent for longer than three splits in between,
    would begin a recording with every message. So each rotation for silence doubles the patience,
    up to a session; a recording that lived for its whole session resets it.
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

    def began(self, now_s: float, settle_s: float) -> None:
        """Notes that a recording began; what it writes within `settle_s` is not the robot's.

        Those are its headers, and the latched messages that every recording receives again.
        """
        self._settled_at_s = now_s + settle_s
        self._grew_at_s = None if self._must_grow else now_s
        self._has_grown = self._must_grow = False
        self._bytes = 0

    def is_silent(self, now_s: float, bytes_written: int, *, offered: bool = False) -> bool:
        """Whether to rotate, given what the recording has written so far (it never shrinks).

        `offered`: whether publishers offer any topic of the robot.
        """
        if bytes_written > self._bytes:
            self._bytes = bytes_written
            if now_s >= self._settled_at_s:
                self._grew_at_s, self._has_grown = now_s, True
        if self._grew_at_s is None or not (self._has_grown or offered):
            return False
        least_s = 0.0 if self._has_grown else WAITING_S
        return now_s - self._grew_at_s >= max(self._patience_s, least_s)

    def rotated(self, *, for_silence: bool) -> None:
        """Notes that the recording was rotated, for silence or because its session was over."""
        self._must_grow = for_silence or not self._has_grown
        doubled_s = min(2 * self._patience_s, self._cap_s)
        self._patience_s = doubled_s if for_silence else self._first_s


def describe_death(status: int, last_output: str) -> str:
    """Describes a `ros2 bag record` that ended by itself.

    `status` is its exit code, or minus the number of the signal that killed it.
    """
    if status >= 0:
        ended = f"ended by itself with status {status}"
    else:
        signal_names = {number.value: number.name for number in signal.Signals}
        ended = f"was killed ({signal_names.get(-status, f'signal {-status}')})"
    said = f"; last it said: {last_output}" if last_output else ""
    return f"ros2 bag record {ended}{said}"
