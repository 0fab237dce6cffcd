"""One question about several moments, or about the same local hours of each day.

Each moment or day is answered as if it were the only one.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import defaultdict
from dataclasses import replace
from datetime import datetime, time
from itertools import chain
from typing import TYPE_CHECKING, Final

from ros2_memory.core.errors import (
    InvalidArgumentsError,
    NoDataError,
    NoDataReason,
    QueryTimeoutError,
)
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import Spans, united
from ros2_memory.core.text import counted
from ros2_memory.core.timebase import NS_PER_S, START_SLACK_NS
from ros2_memory.counts.bins import local_offset
from ros2_memory.history.coverage import recorded_reach
from ros2_memory.history.view import AtTime, TimeRange, ns_argument, search_window
from ros2_memory.results import AtEach, InEach, InWindow, MomentAnswer, NothingAt, OneAnswer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from ros2_memory.history.context import Call, Memory

MOST_WINDOWS: Final = 31
"""Days whose hours one call asks about."""
_DAY_S: Final = 86_400


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
            failures.append(error.detached())
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
    first, last = recorded_reach(snapshot, whole)
    # A window up to midnight has nothing of the next day.
    asked = TimeWindow(start, max(end, start + 1)).intersect(TimeWindow(first, last + 1))
    windows = hours_of_days(asked, *between) if snapshot.bags else []
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
    begin_s, end_s = (of.hour * 3600 + of.minute * 60 + of.second for of in (begins, ends))
    length_s = (end_s - begin_s) % _DAY_S or _DAY_S
    spans_by_day: defaultdict[int, Spans] = defaultdict(list)
    for stretch in _stretches_of_one_clock(window):
        offset_s = local_offset(stretch.start // NS_PER_S)
        today = (stretch.start // NS_PER_S + offset_s) // _DAY_S
        # From the day before: its hours may go on after midnight.
        for day in (today - 1, today, today + 1):
            begin = (day * _DAY_S + begin_s - offset_s) * NS_PER_S
            part = stretch.intersect(TimeWindow(begin, begin + length_s * NS_PER_S))
            if not part.empty:
                spans_by_day[day].append((part.start, part.stop))
    # Where clocks go back, two parts of one day have a part of the other day between them.
    parts = sorted(chain.from_iterable(map(united, spans_by_day.values())))
    return [TimeWindow(*part) for part in parts]


def _stretches_of_one_clock(window: TimeWindow) -> Iterator[TimeWindow]:
    """Yields consecutive parts of a window, of a day at most, in which clocks do not change."""
    start = window.start
    while start < window.stop:
        seconds = range(start // NS_PER_S, start // NS_PER_S + _DAY_S)
        offset_s = local_offset(seconds.start)
        lasts_s = bisect_left(seconds, True, key=lambda at: local_offset(at) != offset_s)
        stop = min((seconds.start + lasts_s) * NS_PER_S, window.stop)
        yield TimeWindow(start, stop)
        start = stop
