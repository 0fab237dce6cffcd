"""Time: integer nanoseconds inside, float seconds outside, and the conversions between them.

Inside, a time is an `Ns` (nanoseconds since the Unix epoch) and a window is half-open. Outside, a
time is a float of Unix seconds. A float64 near the present resolves about 0.24 microseconds, so a
time in a reply is rounded *up* to whole microseconds (`unix_rounded_up`) and a time in a query is
granted `AT_OR_BEFORE_SLACK_NS`: a timestamp fed back finds its own message.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Callable

Ns: TypeAlias = int
"""Nanoseconds: since the Unix epoch, or of a duration."""

NS_PER_S: Final = 1_000_000_000
NS_PER_MS: Final = 1_000_000
NS_PER_US: Final = 1_000
AT_OR_BEFORE_SLACK_NS: Final[Ns] = NS_PER_US
"""Tolerance of "at or before t", because t was converted to a float of seconds."""
START_SLACK_NS: Final[Ns] = 2 * AT_OR_BEFORE_SLACK_NS
"""Tolerance of "from t on": a timestamp fed back was also rounded up past its own message."""

MIN_NS: Final[Ns] = -(2**63)
MAX_NS: Final[Ns] = 2**63 - 1
"""The range of times: what a signed 64-bit nanosecond clock (and SQLite) can hold."""


def ns_from_unix(seconds: float) -> Ns:
    """Returns nanoseconds for Unix (or plain) seconds, rounded to nearest, limited to 64 bits.

    Raises:
        ValueError: `seconds` is NaN or infinite.
    """
    if not math.isfinite(seconds):
        raise ValueError(f"{seconds} is not a finite number of seconds")
    whole = math.floor(seconds)
    ns = whole * NS_PER_S + round((seconds - whole) * NS_PER_S)
    return min(max(ns, MIN_NS), MAX_NS)


def unix_from_ns(ns: Ns) -> float:
    """Returns the Unix (or plain) seconds nearest to `ns`."""
    return ns / NS_PER_S


def unix_rounded_up(ns: Ns) -> float:
    """Returns Unix seconds rounded up to whole microseconds, as replies have them."""
    return -(-ns // NS_PER_US) / 1e6


def ms_from_ns(ns: Ns) -> float:
    """Returns milliseconds, for log events."""
    return ns / NS_PER_MS


def iso_local(ns: Ns) -> str | None:
    """Returns ISO 8601 local time with offset; None for years that the calendar does not have."""
    try:
        return datetime.fromtimestamp(ns // NS_PER_S, tz=UTC).astimezone().isoformat()
    except (OverflowError, ValueError, OSError):
        return None


class Clock(ABC):
    """The present time. Read once for each call, so that one answer has one present."""

    @abstractmethod
    def now(self) -> Ns:
        """Returns the present time."""


class WallClock(Clock):
    """The clock of the system."""

    def now(self) -> Ns:
        """Returns the present time by the system's clock."""
        return time.time_ns()


@dataclass(frozen=True, slots=True)
class Deadline:
    """The monotonic time (s) at which a query must give up; `Deadline.never()` has none."""

    at_s: float
    budget_s: float
    _monotonic: Callable[[], float] = field(default=time.monotonic, repr=False)

    @classmethod
    def after(cls, budget_s: float, monotonic: Callable[[], float] = time.monotonic) -> Deadline:
        """Returns a deadline `budget_s` seconds from now."""
        return cls(monotonic() + budget_s, budget_s, monotonic)

    @classmethod
    def never(cls) -> Deadline:
        """Returns a deadline that never expires."""
        return cls(math.inf, math.inf)

    def expired(self) -> bool:
        """Returns whether the time is up."""
        return self._monotonic() >= self.at_s
