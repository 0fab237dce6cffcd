"""Time: integer nanoseconds inside, float seconds outside, and the conversions between them.

Inside, a time is an `Ns` (nanoseconds since the Unix epoch) and a window is half-open. Outside, a
time is a float of Unix seconds; one that comes in may be ISO 8601 (`unix_from_text`). A float64
near the present resolves about 0.24 microseconds, so a time in a reply is rounded *up* to whole
microseconds (`unix_rounded_up`) and a time in a query is granted `AT_OR_BEFORE_SLACK_NS`: a
timestamp fed back finds its own message.
"""

from __future__ import annotations

import math
import re
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from datetime import time as clock_time
from typing import TYPE_CHECKING, Final, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Callable

Ns: TypeAlias = int
"""Nanoseconds: since the Unix epoch, or of a duration."""

Span: TypeAlias = tuple[Ns, Ns]
"""A first and a last time, or a start and the stop behind it."""

NS_PER_S: Final = 1_000_000_000
NS_PER_MS: Final = 1_000_000
NS_PER_US: Final = 1_000
AT_OR_BEFORE_SLACK_NS: Final[Ns] = NS_PER_US
"""Tolerance of "at or before t", because t was converted to a float of seconds."""
START_SLACK_NS: Final[Ns] = 2 * AT_OR_BEFORE_SLACK_NS
"""Tolerance of "from t on": a timestamp fed back was also rounded up past its own message."""

_WEEKDAYS: Final = ("Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun")
_DIGITS: Final = re.compile(r"[0-9]{9,}(\.[0-9]+)?")
_DATE_WITHOUT_DASHES: Final = re.compile(r"(?:19|20)\d\d(?:0[1-9]|1[0-2])(?:0[1-9]|[12]\d|3[01])")
# Not every text that `datetime` reads: it takes 17840232 for a day of the year 1784.
_ISO: Final = re.compile(r"(?:[0-9]{4}-|[0-9]{8}T)[-+0-9:.,TWZ ]*")
_SECONDS: Final = re.compile(r":\d\d:\d\d(?:[.,](\d+))?")
_END_OF_DAY: Final = re.compile(r"(?<=[T ])24:00(?::00)?(?![:.,0-9])")
"""Midnight as the end of a day in ISO 8601, which `datetime` does not read."""
_MIDNIGHT: Final = re.compile(r"24(?::?00){1,2}")
"""The same without a date."""
_BETWEEN_HOURS: Final = re.compile("-|to|and|,")
_LONGEST_TIME: Final = 64
_MINUTE_S: Final = 60.0
_END_S: Final = 1.125e-6
"""How long before its end a span ends, so that a time in a query, which is granted a microsecond
and is a float of seconds, reaches no message at the end itself."""

MIN_NS: Final[Ns] = -(2**63)
MAX_NS: Final[Ns] = 2**63 - 1
"""The range of times: what a signed 64-bit nanosecond clock (and SQLite) can hold."""

FUTURE_NS: Final[Ns] = 60 * NS_PER_S
"""Dates this little ahead of the clock come from a clock that is being corrected."""


def ns_from_unix(seconds: float) -> Ns:
    """Returns nanoseconds for Unix (or plain) seconds, rounded to nearest, limited to 64 bits.

    Raises:
        ValueError: `seconds` is NaN or infinite.
    """
    if not math.isfinite(seconds):
        raise ValueError(f"{seconds} is not a finite number of seconds")
    whole = math.floor(seconds)
    return limited(whole * NS_PER_S + round((seconds - whole) * NS_PER_S))


def limited(time: Ns) -> Ns:
    """Returns the nearest time of 64 bits: a file may be dated after 2262."""
    return min(max(time, MIN_NS), MAX_NS)


def unix_from_ns(ns: Ns) -> float:
    """Returns the Unix (or plain) seconds nearest to `ns`."""
    return ns / NS_PER_S


def unix_rounded_up(ns: Ns) -> float:
    """Returns Unix seconds rounded up to whole microseconds, as replies have them."""
    return -(-ns // NS_PER_US) / 1e6


def ms_from_ns(ns: Ns) -> float:
    """Returns milliseconds, for log events."""
    return ns / NS_PER_MS


def ms_since(begun: Ns) -> float:
    """Returns the milliseconds since `time.perf_counter_ns()` was so much, for log events."""
    return round(ms_from_ns(time.perf_counter_ns() - begun), 3)


def iso_local(ns: Ns) -> str | None:
    """Returns ISO 8601 local time with offset; None for years that the calendar does not have.

    Rounded up to microseconds, as `unix_rounded_up`; whole seconds have no decimals.
    """
    try:
        return _with_offset(ns).isoformat()
    except (OverflowError, ValueError, OSError):
        return None


def local_time(ns: Ns) -> datetime:
    """Returns local time, rounded up to microseconds, which `unix_from_text` reads as ISO 8601.

    It has its offset only where clocks were set back, and it occurs twice.

    Raises:
        ValueError, OverflowError, OSError: the calendar does not have its year.
    """
    local = _with_offset(ns)
    naive = local.replace(tzinfo=None)
    return naive if naive.timestamp() == naive.replace(fold=1).timestamp() else local


def _with_offset(ns: Ns) -> datetime:
    whole = datetime.fromtimestamp(ns // NS_PER_S, tz=UTC)
    fraction = timedelta(microseconds=-(-(ns % NS_PER_S) // NS_PER_US))
    return (whole + fraction).astimezone()


def local_text(ns: Ns) -> str | None:
    """Returns `local_time` as `Tue 2026-11-17 14:05:03`, rounded down to seconds; else as above."""
    try:
        local = local_time(ns // NS_PER_S * NS_PER_S)
    except (OverflowError, ValueError, OSError):
        return None
    return f"{_WEEKDAYS[local.weekday()]} {local.isoformat(sep=' ')}"


def unix_from_text(text: str) -> float:
    """Returns the Unix seconds of a time that is written as ISO 8601.

    Without an offset it is local time, by the zone of this machine (or of TZ), and a date alone is
    its midnight. A local time that occurs twice, since clocks were set back, is the first of the
    two; one that clocks skipped counts by the offset before (both as in RFC 5545). A weekday may
    precede it, as in replies. Unix seconds in quotes are read, too, if they have nine digits or
    more: fewer could be a date.

    Raises:
        ValueError: it is neither, no such day exists, or it is another weekday; the message
            completes "the time, which".
    """
    weekday, written = _without_weekday(text.strip() if len(text) <= _LONGEST_TIME else "")
    if _DIGITS.fullmatch(written):
        return float(written)
    begins, is_end = _END_OF_DAY.subn("00:00", written if _ISO.fullmatch(written) else "")
    try:
        read = datetime.fromisoformat(begins)
        seconds = (read + timedelta(days=is_end)).timestamp()
    except (ValueError, OverflowError, OSError):
        raise ValueError("is not a valid time in ISO 8601, such as 2026-11-20T14:05:00") from None
    if weekday is not None and weekday != _WEEKDAYS[read.weekday()]:
        raise ValueError(f"is a {_WEEKDAYS[read.weekday()]}, not a {weekday}")
    return seconds


def hours_from_text(text: str) -> tuple[clock_time, clock_time]:
    """Returns two local times of day of a text, such as 19:00-22:00 or 19:00 to 24:00.

    Raises:
        ValueError: it is something else; the message completes "the hours, which".
    """
    parts = _BETWEEN_HOURS.split(text) if len(text) <= _LONGEST_TIME else ()
    try:
        begin, end = (part.strip() for part in parts)
        ends = "00:00" if _MIDNIGHT.fullmatch(end) else end
        first, last = clock_time.fromisoformat(begin), clock_time.fromisoformat(ends)
    except ValueError:
        raise ValueError("is not two times of day") from None
    if first.tzinfo is not None or last.tzinfo is not None:
        raise ValueError("has an offset from UTC: these hours are local, so leave it out")
    return first, last


def require_no_date(seconds: float) -> None:
    """Checks that Unix seconds are no date without dashes.

    Raises:
        ValueError: they are; the message completes "the time, which".
    """
    digits = str(seconds).removesuffix(".0")
    if _DATE_WITHOUT_DASHES.fullmatch(digits):
        date = f"{digits[:4]}-{digits[4:6]}-{digits[6:]}"
        raise ValueError(f"as Unix seconds is in 1970; the date is {date}")


def rest_of_text_s(text: str) -> float:
    """Returns how long a time as text lasts after its first moment (s), less `_END_S`.

    Its last decimal is all part of it: 14:05:03.74 lasts 10 ms, up to, but not at, 14:05:03.75, and
    14:05:03 all of its second. One without seconds is exact, as Unix seconds are.
    """
    match = _SECONDS.search(text)
    return max(10.0 ** -len(match[1] or "") - _END_S, 0.0) if match else 0.0


def rounded_off_s(text: str) -> float:
    """Returns how much `local_text` may have rounded off a time as text (s).

    Only what it writes has a weekday; other times end where they say.
    """
    weekday, written = _without_weekday(text.strip())
    return rest_of_text_s(written) if weekday else 0.0


def window_end_s(text: str, end_s: float, start_s: float | None) -> float:
    """Returns the Unix seconds at which a window ends by a text that is the time `end_s`.

    A date alone is the end of its local day, and a minute or a second its own end where the window
    starts with it; see also `rounded_off_s`.
    """
    named_s = _named_span_s(_without_weekday(text.strip())[1])
    goes_on = named_s > _MINUTE_S or start_s == end_s
    return end_s + (named_s if goes_on else rounded_off_s(text))


def _named_span_s(written: str) -> float:
    """Returns how long what a text names, up to a local day, goes on after its begin (s).

    Less `_END_S`; 0 for Unix seconds, and what is no ISO 8601.
    """
    if _SECONDS.search(written) or not _ISO.fullmatch(written):
        return rest_of_text_s(written)
    if ":" in written:
        return _MINUTE_S - _END_S
    read = datetime.fromisoformat(written)
    if (read.hour, read.minute) != (0, 0) or "T" in written.upper():
        return 0.0
    return (read + timedelta(days=1)).timestamp() - read.timestamp() - _END_S


def _without_weekday(text: str) -> tuple[str | None, str]:
    first, _, rest = text.partition(" ")
    weekday = first.rstrip(",").title()
    return (weekday, rest.strip()) if weekday in _WEEKDAYS else (None, text)


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

    def within(self, budget_s: float) -> Deadline:
        """Returns a deadline `budget_s` seconds from now, or this one if that is earlier."""
        at_s = min(self.at_s, self._monotonic() + budget_s)
        return Deadline(at_s, min(self.budget_s, budget_s), self._monotonic)

    def left_s(self) -> float:
        """Returns the seconds that are left; none or fewer where the time is up."""
        return self.at_s - self._monotonic()

    def expired(self) -> bool:
        """Returns whether the time is up."""
        return self._monotonic() >= self.at_s
