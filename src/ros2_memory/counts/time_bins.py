"""Bins of time: days, hours of the day and weekdays in local time; what of a span falls into each.

A window is cut where local days (or hours) begin; each piece belongs to one bin. Where clocks are
changed, a day has 23 or 25 hours, the hour that is skipped has no piece, and the one that occurs
twice is one piece of two hours: the pieces always cover the window exactly, so sums over bins are
those of the window.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from datetime import date
from typing import TYPE_CHECKING, Final, Literal, TypeAlias

import numpy as np

from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.timebase import NS_PER_S, Ns
from ros2_memory.results import Usual

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import ArrayLike, NDArray

    from ros2_memory.core.arrays import Flags, Ints
    from ros2_memory.core.model import TimeWindow

ClockBin: TypeAlias = Literal["day", "hour", "weekday"]
Offset: TypeAlias = "Callable[[int], int]"
"""Returns how many seconds local time is ahead of UTC at a Unix second."""

MOST_BINS: Final = 62
"""Days that one answer lists: two months."""
MOST_DAYS: Final = 1_000
"""Days that are counted by hour or by weekday."""

_HOUR_S: Final = 3_600
_DAY_S: Final = 86_400
_EPOCH: Final = date(1970, 1, 1).toordinal()
_WEEKDAYS: Final = (
    "Monday",
    "Tuesday",
    "Wednesday",
    "Thursday",
    "Friday",
    "Saturday",
    "Sunday",
)


def local_offset(at_s: int) -> int:
    """Returns the offset of this machine's zone (or of TZ); 0 for years without a calendar."""
    try:
        return time.localtime(at_s).tm_gmtoff
    except (OverflowError, ValueError, OSError):
        return 0


@dataclass(frozen=True, slots=True)
class TimeBins:
    """A window cut into pieces, each of which belongs to a bin, or to several.

    Attributes:
        names: of the bins, in order.
        edges: where pieces begin, and where the last one ends; they ascend.
        member: for each piece and each bin, whether the piece belongs to the bin.
        day_of: for each piece, the number of its local day since the epoch; None where pieces may
            lie in several days.
    """

    names: tuple[str, ...]
    edges: Ints
    member: Flags
    day_of: Ints | None

    def pieces(self, times: ArrayLike) -> NDArray[np.intp]:
        """Returns the piece of each time; times outside of the window count to its ends."""
        found = np.searchsorted(self.edges, np.asarray(times, np.int64), side="right") - 1
        return np.clip(found, 0, len(self.member) - 1)

    def among(self, times: ArrayLike) -> Flags:
        """Returns for each time and each bin whether it is in the bin; as `pieces` for others."""
        return self.member[self.pieces(times)]

    def lengths(self, starts: ArrayLike, stops: ArrayLike) -> Ints:
        """Returns how much (ns) of half-open spans falls into each bin, all spans together.

        What lies outside of the window does not count.
        """
        begin = np.asarray(starts, np.int64)
        until = _passed(self.edges, begin) - _passed(
            self.edges, np.maximum(begin, np.asarray(stops, np.int64))
        )
        return np.diff(until) @ self.member.astype(np.int64)


def _passed(edges: Ints, times: Ints) -> Ints:
    """Returns for each edge how long ago the times before it were, added up.

    Sums may wrap around; so do their differences, which are what is wanted.
    """
    ordered = np.sort(times)
    before = np.searchsorted(ordered, edges)
    sums = np.concatenate((np.zeros(1, np.int64), np.cumsum(ordered)))
    return before.astype(np.int64) * edges - sums[before]


def time_bins(window: TimeWindow, by: ClockBin, offset: Offset = local_offset) -> TimeBins:
    """Returns the bins of a window, which must not be empty.

    Raises:
        InvalidArgumentsError: there would be too many.
    """
    _check_length(window, by)
    unit = _HOUR_S if by == "hour" else _DAY_S
    starts = [window.start]
    at = window.start // NS_PER_S
    last = (window.stop - 1) // NS_PER_S
    while (at := _next_edge(at, unit, offset)) <= last:
        if at * NS_PER_S > window.start:
            starts.append(at * NS_PER_S)
    locals_s = [start // NS_PER_S + offset(start // NS_PER_S) for start in starts]
    days = [local // _DAY_S for local in locals_s]
    if by == "day":
        keys = days
    elif by == "weekday":
        keys = [_weekday(day) for day in days]
    else:
        keys = [local % _DAY_S // _HOUR_S for local in locals_s]
    known = sorted(set(keys))
    if len(known) > MOST_BINS + 1:  # a window of so many days touches one day more
        raise _too_long(by, MOST_BINS)
    return TimeBins(
        tuple(_name(key, by) for key in known),
        np.array([*starts, window.stop], np.int64),
        np.array(keys)[:, None] == np.array(known),
        np.array(days, np.int64),
    )


def _check_length(window: TimeWindow, by: ClockBin) -> None:
    days = (window.stop - window.start) // (_DAY_S * NS_PER_S)
    most = MOST_BINS if by == "day" else MOST_DAYS
    if days > most:
        raise _too_long(by, most)


def _too_long(by: ClockBin, most: int) -> InvalidArgumentsError:
    other = ", or by weekday" if by == "day" else ""
    return InvalidArgumentsError(
        f"by {by} takes at most {most} days: ask about a shorter window{other}"
    )


def _next_edge(at: int, unit: int, offset: Offset) -> int:
    """Returns the first Unix second after this one in which another local day (or hour) begins."""
    while True:
        ahead = offset(at)
        following = at - (at + ahead) % unit + unit
        if offset(following) == ahead:
            return following
        # Clocks are changed on the way: the first second of the new time.
        low, high = at, following
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if offset(middle) == ahead else (low, middle)
        if (high + offset(high)) // unit != (high - 1 + ahead) // unit:
            return high
        at = high


def _weekday(day: int) -> int:
    return date.fromordinal(_EPOCH + day).weekday()


def day_name(day: int) -> str:
    """Returns the date of a local day, numbered since the epoch."""
    return date.fromordinal(_EPOCH + day).isoformat()


def _name(key: int, by: ClockBin) -> str:
    if by == "day":
        return day_name(key)
    return _WEEKDAYS[key] if by == "weekday" else f"{key:02d}:00"


@dataclass(frozen=True, slots=True)
class TrueIntervals:
    """Intervals in which something was true, in order.

    Attributes:
        starts: when each began.
        stops: when it ended.
        begun: whether it is known that each began then; else it held before, or that is not known.
    """

    starts: Ints
    stops: Ints
    begun: Flags

    @classmethod
    def of(cls, spans: Sequence[tuple[Ns, Ns, bool]]) -> TrueIntervals:
        """Returns them of tuples."""
        starts, stops, begun = zip(*spans, strict=True) if spans else ((), (), ())
        return cls(np.array(starts, np.int64), np.array(stops, np.int64), np.array(begun, np.bool_))


def first_of_days(bins: TimeBins, times: ArrayLike) -> list[Ns]:
    """Returns the first of these times in each local day that has one, in order.

    None of bins whose pieces may lie in several days.
    """
    if bins.day_of is None:
        return []
    ordered = np.sort(np.asarray(times, np.int64))
    days = bins.day_of[bins.pieces(ordered)]
    _, first = np.unique(days, return_index=True)
    return [int(each) for each in ordered[first]]


def usual_time(times: Sequence[Ns], of_days: int, offset: Offset = local_offset) -> Usual:
    """Returns the usual time of day of one time from each of several days, of so many recorded."""
    clock = sorted((at // NS_PER_S + offset(at // NS_PER_S)) % _DAY_S for at in times)
    median = (clock[(len(clock) - 1) // 2] + clock[len(clock) // 2]) // 2
    return Usual(median, clock[0], clock[-1], len(clock), of_days)
