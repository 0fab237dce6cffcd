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
from datetime import UTC, date, datetime, timedelta
from datetime import time as clock_time
from typing import TYPE_CHECKING, Final, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Callable

Ns: TypeAlias = int
"""Nanoseconds: since the Unix epoch, or of a duration."""

Span: TypeAlias = tuple[Ns, Ns]
"""A first and a last time, or a start and the stop behind it."""

NS_PER_HOUR: Final = 3_600_000_000_000
NS_PER_DAY: Final = 24 * NS_PER_HOUR
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
_SECONDS: Final = re.compile(r"(?::\d\d:|\d[T ]\d{4})\d\d(?:[.,](\d+))?")
_MINUTES: Final = re.compile(r"[T ]\d\d:?\d\d")
_END_OF_DAY: Final = re.compile(r"(?<=[T ])24:00(?::00)?(?![:.,0-9])")
"""Midnight as the end of a day in ISO 8601, which `datetime` does not read."""
_MIDNIGHT: Final = re.compile(r"24(?::?00){1,2}")
"""The same without a date."""
_ONE_DIGIT: Final = re.compile(r"^(?=\d(?!\d))")
"""The begin of an hour such as 9:30."""
_BETWEEN_HOURS: Final = re.compile("-|to|and|,")
_LONGEST_TIME: Final = 64
_DATE_CHARS: Final = len("2026-11-20")
_MINUTE_S: Final = 60.0
_END_S: Final = 1.125e-6
"""How long before the next day, minute or second a written one ends: a query's end is granted a
microsecond and is rounded to a float of seconds, and must not reach a message at the next one."""

MIN_NS: Final[Ns] = -(2**63)
MAX_NS: Final[Ns] = 2**63 - 1
"""The range of times: what a signed 64-bit nanosecond clock (and SQLite) can hold."""

FUTURE_NS: Final[Ns] = 60 * NS_PER_S
"""A date that is ahead of the clock by no more comes from a clock that is being corrected."""


def ns_from_unix(seconds: float) -> Ns:
    """Converts Unix (or plain) seconds to nanoseconds, rounded to nearest, limited to 64 bits.

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
    """Returns the milliseconds since a reading of `time.perf_counter_ns()`, for log events."""
    return round(ms_from_ns(time.perf_counter_ns() - begun), 3)


def utc_day(ns: Ns) -> date:
    """Returns the day (UTC) of a time."""
    return datetime.fromtimestamp(ns // NS_PER_S, tz=UTC).date()


def iso_local(ns: Ns) -> str | None:
    """Returns ISO 8601 local time with offset; None for years that the calendar does not have.

    The time is rounded up to microseconds as by `unix_rounded_up`; whole seconds have no decimals.
    """
    try:
        return _with_offset(ns).isoformat()
    except (OverflowError, ValueError, OSError):
        return None


def local_time(ns: Ns) -> datetime:
    """Returns local time, rounded up to microseconds, whose ISO form `unix_from_text` reads.

    It has an offset only if the local time occurs twice, because clocks were set back.

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
    """Returns local time rounded down to seconds, as `Tue 2026-11-17 14:05:03`.

    It has an offset if the local time occurs twice. None for years that the calendar does not have.
    """
    try:
        local = local_time(ns // NS_PER_S * NS_PER_S)
    except (OverflowError, ValueError, OSError):
        return None
    return f"{_WEEKDAYS[local.weekday()]} {local.isoformat(sep=' ')}"


def unix_from_text(text: str) -> float:
    """Returns the Unix seconds of a time that is written in ISO 8601.

    Without an offset it is local time, by the zone of this machine (or of TZ); a date alone is its
    midnight. A local time that occurs twice, because clocks were set back, is the first of the two;
    one that clocks skipped counts by the offset before (both as in RFC 5545). A weekday may stand
    before it, as in replies. A text of nine digits or more is read as Unix seconds; fewer could be
    a date.

    Raises:
        ValueError: the text has no such form, or names a day that does not exist, or another
            weekday; the message completes "the time, which".
    """
    weekday, written = _split_weekday(text.strip() if len(text) <= _LONGEST_TIME else "")
    if _DIGITS.fullmatch(written):
        return float(written)
    iso = written if _ISO.fullmatch(written) else ""
    iso, days_later = _END_OF_DAY.subn("00:00", iso)
    try:
        moment = datetime.fromisoformat(iso)
        seconds = (moment + timedelta(days=days_later)).timestamp()
    except (ValueError, OverflowError, OSError):
        raise ValueError("is not a valid time in ISO 8601, such as 2026-11-20T14:05:00") from None
    if weekday is not None and weekday != _WEEKDAYS[moment.weekday()]:
        raise ValueError(f"is a {_WEEKDAYS[moment.weekday()]}, not a {weekday}")
    return seconds


def hours_from_text(text: str) -> tuple[clock_time, clock_time]:
    """Returns the two local times of day in a text such as `19:00-22:00` or `19:00 to 24:00`.

    Raises:
        ValueError: the text has no such form; the message completes "the hours, which".
    """
    parts = _BETWEEN_HOURS.split(text) if len(text) <= _LONGEST_TIME else ()
    try:
        begin, end = (_ONE_DIGIT.sub("0", part.strip()) for part in parts)
        if _MIDNIGHT.fullmatch(end):
            end = "00:00"
        first, last = clock_time.fromisoformat(begin), clock_time.fromisoformat(end)
    except ValueError:
        raise ValueError("is not two times of day") from None
    if first.tzinfo is not None or last.tzinfo is not None:
        raise ValueError("has an offset from UTC: these hours are local, so leave it out")
    return first, last


def require_no_date(seconds: float) -> None:
    """Checks that a number was not meant as a date, such as 20261120.

    Raises:
        ValueError: it has the digits of a date; the message completes "the time, which".
    """
    digits = str(seconds).removesuffix(".0")
    if _DATE_WITHOUT_DASHES.fullmatch(digits):
        day = f"{digits[:4]}-{digits[4:6]}-{digits[6:]}"
        raise ValueError(f"as Unix seconds is in 1970; the date is {day}")


def rest_of_text_s(text: str) -> float:
    """Returns how many seconds a written time lasts after its first moment, less `_END_S`.

    It lasts as long as its last decimal: 14:05:03.74 up to, but not including, 14:05:03.75, and
    14:05:03 a second. A time without seconds, and Unix seconds, are moments: 0.
    """
    match = _SECONDS.search(text)
    if match is None:
        return 0.0
    decimals = len(match[1] or "")
    return max(10.0**-decimals - _END_S, 0.0)


def rounded_off_s(text: str) -> float:
    """Returns how many seconds `local_text` may have rounded off a written time.

    Only a time that `local_text` wrote has a weekday; any other one ends where it says.
    """
    weekday, written = _split_weekday(text.strip())
    return rest_of_text_s(written) if weekday else 0.0


def window_end_s(text: str, end_s: float, start_s: float | None) -> float:
    """Returns the Unix seconds at which a window ends whose end is written as `text`.

    A date alone includes its local day. A minute or a second includes all of itself if the window
    also starts there; else the window ends at its first moment, but for what `local_text` rounded
    off.

    Args:
        text: the end as it was written.
        end_s: the first moment of the end (Unix s).
        start_s: where the window starts (Unix s).
    """
    _, written = _split_weekday(text.strip())
    span_s = _written_span_s(written)
    is_date = span_s > _MINUTE_S
    return end_s + (span_s if is_date or start_s == end_s else rounded_off_s(text))


def _written_span_s(written: str) -> float:
    """Returns how many seconds the written day, minute or second lasts, less `_END_S`.

    0 for Unix seconds, and for any text that is not ISO 8601.
    """
    if _SECONDS.search(written) or not _ISO.fullmatch(written):
        return rest_of_text_s(written)
    if _MINUTES.search(written):
        return _MINUTE_S - _END_S
    if len(written) > _DATE_CHARS:  # an hour
        return 0.0
    midnight = datetime.fromisoformat(written)
    return (midnight + timedelta(days=1)).timestamp() - midnight.timestamp() - _END_S


def _split_weekday(text: str) -> tuple[str | None, str]:
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
        """Returns the system's time."""
        return time.time_ns()


@dataclass(frozen=True, slots=True)
class StoppedClock(Clock):
    """The time at which a question was asked, so that it is one question, to one or all robots."""

    at: Ns

    def now(self) -> Ns:
        """Returns that time."""
        return self.at


@dataclass(frozen=True, slots=True)
class Deadline:
    """The time at which a query must give up.

    Attributes:
        at_s: by the monotonic clock; infinite if it never has to.
        budget_s: how long the query may take in all.
    """

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
        """Returns a deadline `budget_s` seconds from now, or this one if it is earlier."""
        at_s = min(self.at_s, self._monotonic() + budget_s)
        return Deadline(at_s, min(self.budget_s, budget_s), self._monotonic)

    def left_s(self) -> float:
        """Returns the seconds that are left: 0 or less if the time is up."""
        return self.at_s - self._monotonic()

    def expired(self) -> bool:
        """Returns whether the time is up."""
        return self.left_s() <= 0
