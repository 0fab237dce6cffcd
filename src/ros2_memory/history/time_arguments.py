"""Times that a question names, as log times: a moment or a window, and the memory's now.

Seconds come in as floats of Unix seconds or of a duration. "Ago" counts from the wall clock or,
for replayed and simulated bags (`data.now: latest`), from the newest recorded moment. The clock
is read once for each call.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ros2_memory.core.errors import (
    InvalidArgumentsError,
    NoDataError,
    NoDataReason,
)
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import (
    AT_OR_BEFORE_SLACK_NS,
    MAX_NS,
    MIN_NS,
    START_SLACK_NS,
    Ns,
    ns_from_unix,
)
from ros2_memory.history.coverage import unix_text
from ros2_memory.history.no_data import require_bags
from ros2_memory.history.view import View

if TYPE_CHECKING:
    from ros2_memory.history.context import Call, Memory


@dataclass(frozen=True, slots=True)
class AtTime:
    """A moment: at Unix seconds, or so many seconds before now. Exactly one is set."""

    at_s: float | None = None
    ago_s: float | None = None


@dataclass(frozen=True, slots=True)
class TimeRange:
    """An inclusive window: from `start_s` to `end_s`, or the last so many seconds."""

    start_s: float | None = None
    end_s: float | None = None
    last_s: float | None = None


def open_moment(memory: Memory, call: Call, moment: AtTime) -> tuple[View, Ns, Ns | None]:
    """Returns the view for a moment, the moment, and now where the question was relative.

    Raises:
        InvalidArgumentsError: the seconds are not finite, or negative where they count back.
        NoDataError: the memory holds nothing, or no recorded time can lie so far back.
    """
    if moment.at_s is not None:
        at = ns_argument("timestamp", moment.at_s)
        view, now = _open(memory, call, at), None
    else:
        ago = ns_argument("seconds_ago", moment.ago_s or 0.0)
        if ago < 0:
            raise InvalidArgumentsError("seconds_ago must be 0 or more: it counts back from now")
        view, now = _open_now(memory, call, ago)
        at = MIN_NS if ago == MAX_NS else now - ago
    if at > MIN_NS:
        return view, at, now
    earliest = view.snapshot.earliest
    begins = "" if earliest is None else f"; the memory begins at {unix_text(earliest)}"
    raise NoDataError(
        NoDataReason.OUTSIDE_RANGE, f"no recorded time lies so far back (before 1678){begins}"
    )


def open_span(memory: Memory, call: Call, span: TimeRange) -> tuple[View, TimeWindow]:
    """Returns the view for a window, and the window.

    Raises:
        InvalidArgumentsError: the bounds are missing, reversed, not finite or of no length.
        NoDataError: the memory holds nothing.
    """
    if span.last_s is not None:
        length = ns_argument("seconds", span.last_s)
        if length <= 0:
            raise InvalidArgumentsError("seconds must be more than 0: the length of the window")
        view, now = _open_now(memory, call, 0)
        return view, clamped(view, last_window(now, length))
    if span.start_s is None or span.end_s is None:
        raise InvalidArgumentsError("start and end must both be given, as Unix seconds")
    window = TimeWindow.from_unix(span.start_s, span.end_s)
    view = _open(memory, call, window.stop)
    return view, clamped(view, window)


def last_window(now: Ns, length: Ns) -> TimeWindow:
    """Returns the window of a length up to now, with the slack of a float of seconds."""
    return TimeWindow(max(now - length, MIN_NS), min(now + AT_OR_BEFORE_SLACK_NS + 1, MAX_NS))


def clamped(view: View, window: TimeWindow) -> TimeWindow:
    """Returns the window without what lies before both the epoch and the memory."""
    earliest = view.snapshot.earliest
    floor = min(0, 0 if earliest is None else earliest) - START_SLACK_NS
    return TimeWindow(max(window.start, floor), max(window.stop, floor + 1))


def ns_argument(name: str, value_s: float) -> Ns:
    """Returns an argument in seconds as nanoseconds.

    Raises:
        InvalidArgumentsError: it is not finite; the sentence names the argument.
    """
    try:
        return ns_from_unix(value_s)
    except ValueError as error:
        raise InvalidArgumentsError(f"{name}: {error}") from error


def _open(memory: Memory, call: Call, reach: Ns | None) -> View:
    view = View(memory, call, reach)
    require_bags(view)
    return view


def _open_now(memory: Memory, call: Call, ago: Ns) -> tuple[View, Ns]:
    """Returns the view for a moment before now, and now."""
    wall = memory.clock.now()
    view = _open(memory, call, None if memory.limits.now == "latest" else wall - ago)
    return view, memory.now(wall, view.snapshot.latest)
