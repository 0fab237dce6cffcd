"""Silences: a topic with a usual rate has no message although the robot is on. Pure decisions.

Everything is decided from the summaries of bags, which state when a bag holds a topic, and never
from messages. The rules hold over the whole memory:

- A topic has a usual rate if bags that hold it hold messages all along. Its period is the mean
  period of the bags around the median. A topic that is published on events has no usual rate.
- It is silent if it has no message for `SHORTEST_NS` and for `SILENT_PERIODS` of its periods,
  between two of its messages or after the last one. Before the first one it is not silent.
- The robot is on if a third of the topics with a usual rate that are recorded together with the
  silent one are heard. While it is off nothing is recorded: that is a gap, and no part of a
  silence. A gap of more than `LONGEST_OFF_NS` ends a silence, since what follows may be a recording
  of another robot.
- A topic that is silent more often than `SELDOM` times, and longer than it is heard, has the habit
  of being silent: no silence is reported. If it is heard for less than `HABIT_NS` between two (a
  topic that starts late each time), only silences that last `UNUSUAL` times the median count.

The numbers of the parts of a memory add up exactly, however it is cut into parts.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import defaultdict
from functools import cache
from operator import itemgetter
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.core.pauses import SHORTEST_SILENCE_NS, SILENT_PERIODS
from ros2_memory.core.spans import united
from ros2_memory.core.timebase import MAX_NS, NS_PER_S, Ns, Span

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

SHORTEST_NS: Final = SHORTEST_SILENCE_NS

SELDOM: Final = 2
HABIT_NS: Final = 3600 * NS_PER_S
UNUSUAL: Final = 10
LONGEST_OFF_NS: Final = 7 * 86_400 * NS_PER_S
_HEARD_ONE_IN: Final = 3
"""The robot is on if one in so many of the topics is heard."""


class Spacing(NamedTuple):
    """Sums over bags of about the same period: the bags, their spans, and their intervals."""

    bags: int = 0
    span: Ns = 0
    intervals: int = 0


class Pacing(NamedTuple):
    """How often bags hold a topic.

    Attributes:
        spacings: sums over bags with enough messages, by a bin of the logarithm of the period.
        messages: the messages of the topic in all bags.
        length: the length (ns) of all bags that hold the topic.
    """

    spacings: Mapping[int, Spacing]
    messages: int
    length: Ns


class Silence(NamedTuple):
    """A topic had no message from `start` to `end` although the robot was on.

    `length` is how long (ns) the robot was on meanwhile. If it `goes_on`, the topic was not heard
    again.
    """

    topic: str
    start: Ns
    end: Ns
    length: Ns
    goes_on: bool = False

    def within(self, start: Ns, end: Ns) -> Silence | None:
        """Returns the part between two log times (inclusive); None if there is none.

        How long the robot was on in a part is not known: its length is at most that of the part.
        """
        first, last = max(self.start, start), min(self.end, end)
        if first >= last:
            return None
        goes_on = self.goes_on or last < self.end
        return Silence(self.topic, first, last, min(self.length, last - first), goes_on)


def joined_pacings(parts: Sequence[Pacing]) -> Pacing:
    """Returns the pacing of a topic in several parts of a memory together."""
    spacings: dict[int, Spacing] = {}
    for part in parts:
        for octave, added in part.spacings.items():
            bags, span, intervals = spacings.get(octave, Spacing())
            spacings[octave] = Spacing(
                bags + added.bags, span + added.span, intervals + added.intervals
            )
    return Pacing(
        spacings, sum(part.messages for part in parts), sum(part.length for part in parts)
    )


def shortest_silence(period: Ns) -> Ns:
    """Returns how long (ns) a topic with this period must have no message to be silent."""
    return max(SHORTEST_NS, SILENT_PERIODS * period)


def usual_period(pacing: Pacing) -> Ns | None:
    """Returns the usual time (ns) between two messages; None for a topic without a usual rate."""
    half = sum(spacing.bags for spacing in pacing.spacings.values()) / 2
    bags = 0
    for _, spacing in sorted(pacing.spacings.items()):
        bags += spacing.bags
        if bags >= half:
            period = spacing.span // spacing.intervals
            return period if 2 * pacing.messages * period >= pacing.length else None
    return None


def usual_periods(pacings: Mapping[str, Pacing]) -> dict[str, Ns]:
    """Returns the usual period of each topic that has one."""
    periods = ((topic, usual_period(pacing)) for topic, pacing in pacings.items())
    return {topic: period for topic, period in periods if period is not None}


def silences(
    periods: Mapping[str, Ns],
    runs_of: Mapping[str, Sequence[Span]],
    together: Iterable[Iterable[str]],
    gaps: Sequence[Span] = (),
) -> list[Silence]:
    """Returns the silences of all topics, in order of time.

    Args:
        periods: the usual period of each topic that has one.
        runs_of: for each topic, the spans in which it was heard, in order. Bags without the topic
            part them only if they last longer than `SHORTEST_NS`.
        together: the topics of each bag; bags with the same topics may be left out.
        gaps: the spans in which nothing was recorded, in order, short pauses too.
    """
    bags_with: defaultdict[str, tuple[frozenset[str], ...]] = defaultdict(tuple)
    for names in {frozenset(periods.keys() & topics) for topics in together}:
        for topic in names:
            bags_with[topic] += (names,)
    companions = cache(lambda bags: frozenset[str]().union(*bags))
    robot_on: dict[frozenset[str], list[Span]] = {}
    reported: list[Silence] = []
    for topic, period in periods.items():
        others = companions(bags_with[topic])
        if others not in robot_on:
            robot_on[others] = robot_on_times([runs_of[other] for other in sorted(others)])
        limit = shortest_silence(period)
        runs = united(runs_of[topic], limit)
        all_silences = _silences_of(topic, runs, robot_on[others], limit, gaps)
        reported += _without_habit([*all_silences], runs)
    return sorted(reported, key=lambda silence: (silence.start, silence.end, silence.topic))


def robot_on_times(runs_of_topics: Sequence[Sequence[Span]]) -> list[Span]:
    """Returns the spans in which one in `_HEARD_ONE_IN` of the topics is heard.

    One topic, the silent one, is not counted among them.
    """
    enough = max(1, math.ceil((len(runs_of_topics) - 1) / _HEARD_ONE_IN))
    changes: list[tuple[Ns, int]] = []
    for runs in runs_of_topics:
        for first, last in runs:
            # Negative, so that a run that begins when another ends is sorted before.
            changes += [(first, -1), (last, 1)]
    spans: list[Span] = []
    count, since = 0, 0
    for at, change in sorted(changes):
        before, count = count, count - change
        if before < enough <= count:
            since = at
        elif count < enough <= before:
            spans.append((since, at))
    return united(spans, SHORTEST_NS)


def prolonged_silence(
    silence: Silence, robot_on: Sequence[Span], runs: Sequence[Span], gaps: Sequence[Span]
) -> Silence:
    """Returns a silence of deleted bags, with what later bags show of it.

    Args:
        silence: the silence, which went on at the end of the deleted bags.
        robot_on: when the robot was on, in order.
        runs: the spans in which the topic is heard in later bags, in order.
        gaps: the spans in which nothing was recorded, in order.
    """
    heard_again = next((first for first, _ in runs if first >= silence.end), MAX_NS)
    missed = _missed(silence.end, heard_again, robot_on, 0, gaps)
    end = missed.spans[-1][1] if missed.spans else silence.end
    goes_on = heard_again == MAX_NS and not missed.is_parted
    return Silence(silence.topic, silence.start, end, silence.length + missed.length, goes_on)


def _silences_of(
    topic: str, runs: Sequence[Span], robot_on: Sequence[Span], limit: Ns, gaps: Sequence[Span]
) -> Iterator[Silence]:
    """Yields the silences of a topic that are longer than a limit (ns)."""
    _, last_heard = runs[-1]
    end = max(last_heard, robot_on[-1][1] if robot_on else last_heard)
    nexts = [first for first, _ in runs[1:]]
    for (_, start), stop in zip(runs, [*nexts, end], strict=True):
        missed = _missed(start, stop, robot_on, limit, gaps)
        if missed.spans:
            goes_on = start == last_heard and not missed.is_parted
            first, last = missed.spans[0][0], missed.spans[-1][1]
            yield Silence(topic, first, last, missed.length, goes_on)


class _Missed(NamedTuple):
    """When a topic was absent although the robot was on.

    Attributes:
        spans: the spans in which it was, in order.
        length: how long (ns) the robot was on in them.
        is_parted: whether the robot was off so long that another robot may follow.
    """

    spans: list[Span]
    length: Ns
    is_parted: bool


def _missed(
    start: Ns, stop: Ns, robot_on: Sequence[Span], limit: Ns, gaps: Sequence[Span]
) -> _Missed:
    """Returns when a topic that is absent from `start` to `stop` was missed longer than a limit."""
    spans: list[Span] = []
    length, until, is_parted = 0, start, False
    for on_from, on_to in robot_on[bisect_right(robot_on, start, key=itemgetter(1)) :]:
        is_parted = on_from - until > LONGEST_OFF_NS
        if on_from >= stop or is_parted:
            break
        until = on_to
        first, last = max(on_from, start), min(on_to, stop)
        recorded = last - first - length_in(gaps, first, last)
        if recorded > limit:
            spans.append((first, last))
            length += recorded
    return _Missed(spans, length, is_parted)


def length_in(gaps: Sequence[Span], first: Ns, last: Ns) -> Ns:
    """Returns how much (ns) of the time between two log times lies in gaps, which are in order."""
    begin = bisect_right(gaps, first, key=itemgetter(1))
    end = bisect_left(gaps, last, key=itemgetter(0))
    return sum(min(last, until) - max(first, start) for start, until in gaps[begin:end])


def _without_habit(silences: Sequence[Silence], runs: Sequence[Span]) -> Sequence[Silence]:
    """Returns the silences of a topic that are not its habit."""
    if len(silences) <= SELDOM:
        return silences
    lengths = sorted(silence.length for silence in silences)
    heard_ns = sum(last - first for first, last in runs)
    if heard_ns < sum(lengths):
        return ()
    if heard_ns >= HABIT_NS * len(silences):
        return silences
    median = lengths[(len(lengths) - 1) // 2]
    return [silence for silence in silences if silence.length >= UNUSUAL * median]
