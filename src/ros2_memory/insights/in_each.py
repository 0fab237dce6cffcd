"""One question about the same local hours of each day: an answer for each of these windows."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, time, timedelta
from typing import TYPE_CHECKING, Final

from ros2_memory.core.errors import (
    InvalidArgumentsError,
    NoDataError,
    NoDataReason,
    QueryTimeoutError,
)
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.text import counted
from ros2_memory.core.timebase import ns_from_unix, unix_from_ns
from ros2_memory.history.coverage import recorded_reach
from ros2_memory.history.view import TimeRange, search_window
from ros2_memory.insights.at_each import OneSnapshot
from ros2_memory.results import InEach, InWindow, NothingAt

if TYPE_CHECKING:
    from collections.abc import Callable

    from ros2_memory.history.context import Call, Memory
    from ros2_memory.results import OneAnswer

MOST_WINDOWS: Final = 31
"""Days whose hours one call asks about."""


def in_each(
    memory: Memory,
    call: Call,
    span: TimeRange,
    between: tuple[time, time],
    ask: Callable[[Memory, TimeRange], OneAnswer],
) -> InEach:
    """Returns the answers for some local hours of each day of a window, in order.

    The second time may be on the next day. The window ends where the recording does. All answers
    are of one snapshot of the index.

    Raises:
        InvalidArgumentsError: the window has too many days, or is around a moment.
        NoDataError: nothing is recorded in these hours.
        QueryTimeoutError: the call's time runs out before any answer.
    """
    if span.around_s is not None:
        raise InvalidArgumentsError("between cannot be combined with around: one moment is asked")
    wall = memory.clock.now()
    snapshot = memory.index.snapshot(min(search_window(span, wall).stop, wall))
    whole = search_window(span, memory.now(wall, snapshot.latest, call))
    first, last = recorded_reach(snapshot, whole) or (0, -1)
    windows = hours_of_days(whole.intersect(TimeWindow(first, last + 1)), *between)
    fixed = replace(memory, index=OneSnapshot(memory.index, snapshot))
    found: list[InWindow] = []
    notes: tuple[str, ...] = ()
    for window in windows:
        answer: OneAnswer
        try:
            answer = ask(fixed, TimeRange.over(window))
        except NoDataError as error:
            answer = NothingAt(window.start, error.reason, error.detail, notes=error.notes)
        except QueryTimeoutError:
            if not found:
                raise
            left = counted(len(windows) - len(found), "day is", "days are")
            notes = (f"out of time: the last {left} left out; ask about a shorter window",)
            break
        found.append(InWindow(window.start, window.stop, answer))
    if all(isinstance(each.answer, NothingAt) for each in found):
        detail = "nothing is recorded between these hours in this window"
        raise NoDataError(NoDataReason.OUTSIDE_RANGE, detail)
    return InEach(tuple(found), notes=notes)


def hours_of_days(window: TimeWindow, begins: time, ends: time) -> list[TimeWindow]:
    """Returns what lies between two local times of day in a window, in order.

    Raises:
        InvalidArgumentsError: it has too many days.
    """
    if window.empty:
        return []
    first, last = (
        datetime.fromtimestamp(unix_from_ns(at)).astimezone().date()
        for at in (window.start, window.stop - 1)
    )
    if (last - first).days >= MOST_WINDOWS:
        raise InvalidArgumentsError(
            f"between takes at most {MOST_WINDOWS} days: ask about a shorter window, or by hour"
        )
    over = timedelta(days=ends <= begins)
    # The hours of the day before may go on after midnight.
    days = [first + timedelta(days=nth) for nth in range(-1, (last - first).days + 1)]
    spans = [
        TimeWindow(*(ns_from_unix(datetime.combine(*at).timestamp()) for at in ends_of_day))
        for ends_of_day in (((day, begins), (day + over, ends)) for day in days)
    ]
    return [part for span in spans if not (part := window.intersect(span)).empty]
