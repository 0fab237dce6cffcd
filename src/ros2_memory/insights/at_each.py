"""One question about several moments, or about the same local hours of each day.

Each moment or day is answered as if it were the only one.
"""

from __future__ import annotations

from bisect import bisect_left
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
from ros2_memory.core.timebase import NS_PER_S, START_SLACK_NS, Ns, Span, ns_from_unix
from ros2_memory.counts.bins import local_offset
from ros2_memory.history.coverage import recorded_reach
from ros2_memory.history.view import AtTime, TimeRange, ns_argument, search_window
from ros2_memory.results import AtEach, InEach, InWindow, MomentAnswer, NothingAt, OneAnswer

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ros2_memory.history.context import Call, Memory

MOST_WINDOWS: Final = 31
"""Days whose hours one call asks about."""


def at_each(
    memory: Memory, moments: Sequence[AtTime], ask: Callable[[Memory, AtTime], MomentAnswer]
) -> AtEach:
    """Returns the answers for several moments, all from one snapshot of the index.

    A moment without an answer has `NothingAt` in its place. If all have none for one and the same
    reason, that error is raised as for a single moment.
    """
    reach = max(ns_argument("timestamps", moment.end_s) for moment in moments)
    fixed = replace(memory, fixed=memory.snapshot(reach))
    answers: list[MomentAnswer | NothingAt] = []
    failures: list[NoDataError] = []
    for moment in moments:
        try:
            answers.append(ask(fixed, moment))
        except NoDataError as error:
            at = ns_argument("timestamps", moment.at_s or 0.0)
            answers.append(NothingAt(at, error.reason, error.detail, notes=error.notes))
            # A traceback refers to this frame, and the frame to the failures: break the cycle.
            failures.append(error.with_traceback(None))
    if len(failures) == len(answers) and len({failure.detail for failure in failures}) == 1:
        raise failures.pop(0)
    return AtEach(tuple(answers))


def in_each(
    memory: Memory,
    call: Call,
    span: TimeRange,
    between: tuple[time, time],
    ask: Callable[[Memory, TimeRange], OneAnswer],
) -> InEach:
    """Returns the answers for the same local hours of each day of a window, in order.

    The second time may be on the next day. The window ends where the recording does. All answers
    come from one snapshot of the index.

    Raises:
        InvalidArgumentsError: the window has too many days, or is around a moment.
        NoDataError: nothing is recorded in these hours.
        QueryTimeoutError: the call's time runs out before any answer.
    """
    if span.around_s is not None:
        raise InvalidArgumentsError("between cannot be combined with around: one moment is asked")
    wall = memory.clock.now()
    snapshot = memory.snapshot(min(search_window(span, wall).stop, wall))
    whole = search_window(span, memory.now(snapshot.latest, call))
    start, end = whole.asked()
    first, last = recorded_reach(snapshot, whole) or (0, -1)
    # A window up to midnight has nothing of the next day.
    asked = TimeWindow(start, max(end, start + 1)).intersect(TimeWindow(first, last + 1))
    windows = hours_of_days(asked, *between)
    if not windows:
        detail = "nothing is recorded between these hours in this window"
        raise NoDataError(NoDataReason.OUTSIDE_RANGE, detail)
    begins = {window.start for window in windows}
    fixed_memory = replace(memory, fixed=snapshot)
    answers: list[InWindow] = []
    notes: tuple[str, ...] = ()
    for window in windows:
        # A message at the end of these hours counts, unless the next ones begin then.
        early = START_SLACK_NS if window.stop in begins else 0
        span_of_day = TimeRange.over(replace(window, stop=window.stop - early))
        try:
            answers.append(_answer_day(fixed_memory, window, span_of_day, ask))
        except QueryTimeoutError:
            if not answers:
                raise
            days_left = counted(len(windows) - len(answers), "day is", "days are")
            notes = (f"out of time: the last {days_left} left out; ask about a shorter window",)
            break
    nothing = [day.answer for day in answers if isinstance(day.answer, NothingAt)]
    if len(nothing) == len(answers):
        newest = nothing[-1]
        detail = f"none between these hours on any day; on the last {newest.detail}"
        raise NoDataError(newest.reason, detail, newest.notes)
    return InEach(tuple(answers), is_all=len(answers) == len(windows), notes=notes)


def _answer_day(
    memory: Memory,
    window: TimeWindow,
    span: TimeRange,
    ask: Callable[[Memory, TimeRange], OneAnswer],
) -> InWindow:
    """Returns the answer for the hours of one day, which may be that there is nothing.

    Raises:
        NoDataError: the topic is not recorded on any day.
    """
    answer: OneAnswer
    try:
        answer = ask(memory, span)
    except NoDataError as error:
        if error.reason is NoDataReason.TOPIC_NOT_RECORDED:
            raise
        answer = NothingAt(window.start, error.reason, error.detail, notes=error.notes)
    return InWindow(window.start, window.stop, answer)


def hours_of_days(window: TimeWindow, begins: time, ends: time) -> list[TimeWindow]:
    """Returns the parts of a window between two local times of day, in order.

    Raises:
        InvalidArgumentsError: the window has too many days.
    """
    if window.empty:
        return []
    first, last = (
        datetime.fromtimestamp(at // NS_PER_S).astimezone().date()
        for at in (window.start, window.stop - 1)
    )
    if (last - first).days >= MOST_WINDOWS:
        raise InvalidArgumentsError(
            f"between takes at most {MOST_WINDOWS} days: ask about a shorter window, or by hour"
        )
    nights = timedelta(days=1 if ends <= begins else 0)
    parts = []
    # From the day before: its hours may go on after midnight.
    for nth in range(-1, (last - first).days + 1):
        day = first + timedelta(days=nth)
        begin, end = datetime.combine(day, begins), datetime.combine(day + nights, ends)
        for span in _times_between(begin, end):
            part = window.intersect(TimeWindow(*span))
            if not part.empty:
                parts.append(part)
    # Where clocks go back, two parts of one day have a part of the other day between them.
    return sorted(parts, key=lambda part: part.start)


def _times_between(begin: datetime, end: datetime) -> list[Span]:
    """Returns the times (ns) between two local times. Where clocks go back, there may be two."""
    (first, again), (stop, stop_again) = _moments(begin), _moments(end)
    if (first, stop) == (again, stop_again):
        return [(first, stop)]
    back = _change_between(first, again) if first < again else _change_between(stop, stop_again)
    return [(first, min(stop, back)), (max(again, back), stop_again)]


def _moments(local: datetime) -> Span:
    """Returns the first and the last moment (ns) with a local time.

    A local time that clocks skip has the moment of the change.
    """
    first, last = (ns_from_unix(local.replace(fold=fold).timestamp()) for fold in (0, 1))
    if first <= last:
        return first, last
    # Clocks skip it: by the old offset the moment is later than by the new one.
    change = _change_between(last, first)
    return change, change


def _change_between(before: Ns, after: Ns) -> Ns:
    """Returns when clocks change between two moments (ns), to a second."""
    seconds = range(before // NS_PER_S, after // NS_PER_S)
    offset = local_offset(seconds.start)
    passed_s = bisect_left(seconds, True, key=lambda at: local_offset(at) != offset)
    return (seconds.start + passed_s) * NS_PER_S
