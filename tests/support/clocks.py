"""Clocks that tests read and set, and the time zone that they are read in."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import pytest

from ros2_memory.core.timebase import Clock, Ns


@contextmanager
def in_zone(name: str) -> Iterator[None]:
    """Has this process's days begin and end as they do in a time zone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TZ", name)
        time.tzset()
        yield
    time.tzset()


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
