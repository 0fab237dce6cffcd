"""What the times of a question mean: a moment or a window of the memory, and its now.

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
from ros2_memory.history.no_data import moment as told
from ros2_memory.history.no_data import require_bags
from ros2_memory.history.view import View

if TYPE_CHECKING:
    from ros2_memory.history.context import Call, Memory


@dataclass(frozen=True, slots=True)
class AtTime:
    """A moment asked about: at Unix seconds, or so many seconds before now. Exactly one is set."""

    at_s: float | None = None
    ago_s: float | None = None


@dataclass(frozen=True, slots=True)
class TimeRange:
    """An inclusive window asked about: from `start_s` to `end_s`, or the last so many seconds."""

    start_s: float | None = None
    end_s: float | None = None
    last_s: float | None = None


def _now(memory: Memory, view: View) -> Ns:
    """What "ago" counts from; asked once for each call."""
    require_bags(view)
    if memory.limits.now == "wall" or view.snapshot.latest is None:
        return memory.clock.now()
    return view.snapshot.latest


def open_moment(memory: Memory, call: Call, moment: AtTime) -> tuple[View, Ns, Ns | None]:
    """The view for a moment, the moment itself, and now where the question was relative."""
    if moment.at_s is not None:
        at = ns_argument("timestamp", moment.at_s)
        view = View(memory, call, at)
        require_bags(view)
        return view, _on_the_clock(view, at), None
    ago = ns_argument("seconds_ago", moment.ago_s or 0.0)
    if ago < 0:
        raise InvalidArgumentsError("seconds_ago must be 0 or more: it counts back from now")
    view, now = _relative(memory, call, ago)
    return view, _on_the_clock(view, MIN_NS if ago == MAX_NS else now - ago), now


def _on_the_clock(view: View, at: Ns) -> Ns:
    """The moment, unless it lies before all that a recorded time can be.

    Raises:
        NoDataError: it does.
    """
    if at > MIN_NS:
        return at
    earliest = view.snapshot.earliest
    begins = "" if earliest is None else f"; the memory begins at {told(earliest)}"
    raise NoDataError(
        NoDataReason.OUTSIDE_RANGE, f"no recorded time lies so far back (before 1678){begins}"
    )


def _relative(memory: Memory, call: Call, ago: Ns) -> tuple[View, Ns]:
    if memory.limits.now == "latest":
        view = View(memory, call)
        return view, _now(memory, view)
    now = memory.clock.now()
    view = View(memory, call, now - ago)
    require_bags(view)
    return view, now


def open_span(memory: Memory, call: Call, span: TimeRange) -> tuple[View, TimeWindow]:
    """The view for a window, and the window itself.

    Raises:
        InvalidArgumentsError: the bounds are missing, reversed, not finite or of no length.
        NoDataError: the memory holds nothing.
    """
    if span.last_s is not None:
        length = ns_argument("seconds", span.last_s)
        if length <= 0:
            raise InvalidArgumentsError("seconds must be more than 0: the length of the window")
        view, now = _relative(memory, call, 0)
        stop = min(now + AT_OR_BEFORE_SLACK_NS + 1, MAX_NS)
        return view, clamped(view, TimeWindow(max(now - length, MIN_NS), stop))
    if span.start_s is None or span.end_s is None:
        raise InvalidArgumentsError("start and end must both be given, as Unix seconds")
    window = TimeWindow.from_unix(span.start_s, span.end_s)
    view = View(memory, call, window.stop)
    require_bags(view)
    return view, clamped(view, window)


def clamped(view: View, window: TimeWindow) -> TimeWindow:
    """The window without what lies before both the epoch and the memory."""
    earliest = view.snapshot.earliest
    floor = min(0, 0 if earliest is None else earliest) - START_SLACK_NS
    return TimeWindow(max(window.start, floor), max(window.stop, floor + 1))


def ns_argument(name: str, value_s: float) -> Ns:
    """Nanoseconds of an argument in seconds.

    Raises:
        InvalidArgumentsError: it is not finite; the sentence names the argument.
    """
    try:
        return ns_from_unix(value_s)
    except ValueError as error:
        raise InvalidArgumentsError(f"{name}: {error}") from error
