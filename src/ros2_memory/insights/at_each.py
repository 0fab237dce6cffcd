"""One question about several moments, or the same local hours of each day.

Each is answered as if it were asked alone.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import replace
from datetime import datetime, time, timedelta
from itertools import chain, starmap
from typing import TYPE_CHECKING, Final

from ros2_memory.core.errors import (
    InvalidArgumentsError,
    NoDataError,
    NoDataReason,
    QueryTimeoutError,
)
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.text import counted
from ros2_memory.core.timebase import (
    NS_PER_S,
    START_SLACK_NS,
    Ns,
    Span,
    ns_from_unix,
)
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

    Where there is nothing at one of the moments, `NothingAt` takes its place. Where there is
    nothing at any, for one and the same reason, that is raised as for a single moment.
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
            # A traceback has this frame, which has the failures: they would stay for long.
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
    snapshot = memory.snapshot(min(search_window(span, wall).stop, wall))
    whole = search_window(span, memory.now(wall, snapshot.latest, call))
    start, end = whole.asked()
    first, last = recorded_reach(snapshot, whole) or (0, -1)
    # Up to midnight is no part of the next day.
    asked = TimeWindow(start, max(end, start + 1)).intersect(TimeWindow(first, last + 1))
    windows = hours_of_days(asked, *between)
    begins = {window.start for window in windows}
    fixed_memory = replace(memory, fixed=snapshot)
    answers: list[InWindow] = []
    notes: tuple[str, ...] = ()
    for window in windows:
        answer: OneAnswer
        try:
            # Of all hours of a day, what comes as they end is of the next ones.
            early = START_SLACK_NS if window.stop in begins else 0
            part = replace(window, stop=window.stop - early)
            answer = ask(fixed_memory, TimeRange.over(part))
        except NoDataError as error:
            if error.reason is NoDataReason.TOPIC_NOT_RECORDED:
                raise
            answer = NothingAt(window.start, error.reason, error.detail, notes=error.notes)
        except QueryTimeoutError:
            if not answers:
                raise
            days_left = counted(len(windows) - len(answers), "day is", "days are")
            notes = (f"out of time: the last {days_left} left out; ask about a shorter window",)
            break
        answers.append(InWindow(window.start, window.stop, answer))
    nothing = [day.answer for day in answers if isinstance(day.answer, NothingAt)]
    if not answers:
        detail = "nothing is recorded between these hours in this window"
        raise NoDataError(NoDataReason.OUTSIDE_RANGE, detail)
    if len(nothing) == len(answers):
        newest = nothing[-1]
        detail = f"none between these hours on any day; on the last {newest.detail}"
        raise NoDataError(newest.reason, detail, newest.notes)
    return InEach(tuple(answers), is_all=len(answers) == len(windows), notes=notes)


def hours_of_days(window: TimeWindow, begins: time, ends: time) -> list[TimeWindow]:
    """Returns what lies between two local times of day in a window, in order.

    Raises:
        InvalidArgumentsError: it has too many days.
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
    over = timedelta(days=ends <= begins)
    # The hours of the day before may go on after midnight.
    days = [first + timedelta(days=nth) for nth in range(-1, (last - first).days + 1)]
    bounds = ((datetime.combine(day, begins), datetime.combine(day + over, ends)) for day in days)
    times = chain.from_iterable(starmap(_times_between, bounds))
    hours = (window.intersect(TimeWindow(*span)) for span in times)
    # All hours of a day that begin in an hour that clocks repeat are in two parts, and so are those
    # of the day before: one of these lies between them.
    return sorted((part for part in hours if not part.empty), key=lambda part: part.start)


def _times_between(begin: datetime, end: datetime) -> list[Span]:
    """Returns when it is between two local times: twice where clocks that go back repeat one."""
    (first, again), (stop, stop_again) = _moments(begin), _moments(end)
    if (first, stop) == (again, stop_again):
        return [(first, stop)]
    back = _change_between(first, again) if first < again else _change_between(stop, stop_again)
    return [(first, min(stop, back)), (max(again, back), stop_again)]


def _moments(local: datetime) -> Span:
    """Returns when it is a local time first and last; for one that clocks skip, when they do."""
    first, last = (ns_from_unix(local.replace(fold=fold).timestamp()) for fold in (0, 1))
    # By the time before clocks are put forward, what is skipped is later than by that after.
    return (first, last) if first <= last else (_change_between(last, first),) * 2


def _change_between(before: Ns, after: Ns) -> Ns:
    """Returns when clocks are put forward or back between two moments, to a second."""
    seconds = range(before // NS_PER_S, after // NS_PER_S)
    offset = local_offset(seconds.start)
    passed_s = bisect_left(seconds, True, key=lambda at: local_offset(at) != offset)
    return (seconds.start + passed_s) * NS_PER_S
