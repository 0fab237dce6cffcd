"""Clocks that tests read and set."""

from dataclasses import dataclass

from ros2_memory.core.timebase import Clock, Ns


@dataclass(frozen=True)
class FixedClock(Clock):
    """A clock that always returns the same time."""

    at: Ns

    def now(self) -> Ns:
        return self.at


@dataclass
class SettableClock(Clock):
    """A clock that a test sets."""

    at: Ns

    def now(self) -> Ns:
        return self.at
