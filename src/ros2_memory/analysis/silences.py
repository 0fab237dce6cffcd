"""Silences: a topic with a usual rate has no message although the robot is on. Pure decisions.

All is decided from when bags hold a topic, as their summaries state, never from messages. What
counts is one rule over the whole memory:

- A topic has a usual rate if bags that hold it hold messages all along. Its period is the mean
  period of the bags around the median. What is published when something happens has none.
- It is silent where it has no message for `SHORTEST_NS` and `PERIODS` of its periods, between two
  of its messages or after the last. Before the first it was not there yet.
- The robot is on where a third of the topics are heard that have a usual rate and are recorded
  together with it. Where it is not, nothing was recorded: that is a gap, and no part of a silence.
  A gap of more than `LONGEST_OFF_NS` ends a silence: what follows may be another robot's recording.
- A topic that is silent more often than `SELDOM` times, and for longer than it is heard, has
  silence as its habit: none of them is reported. Of one that is heard for less than `HABIT_NS`
  between two, as one that starts late each time, only those count that last `UNUSUAL` times as long
  as half of them do.

What parts of a memory have adds up exactly, in whichever parts it is cut.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from itertools import accumulate
from operator import itemgetter
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.core.pauses import SHORTEST_SILENCE_NS, SILENT_PERIODS
from ros2_memory.core.spans import united
from ros2_memory.core.timebase import MAX_NS, NS_PER_S, Ns, Span

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

SHORTEST_NS: Final = SHORTEST_SILENCE_NS
PERIODS: Final = SILENT_PERIODS
SELDOM: Final = 2
HABIT_NS: Final = 3600 * NS_PER_S
UNUSUAL: Final = 10
LONGEST_OFF_NS: Final = 7 * 86_400 * NS_PER_S
_TOGETHER: Final = 3
"""The robot is on where one in so many of the topics is heard."""


class Spacing(NamedTuple):
    """What bags of about the same period add up to: their number, and their spans and intervals."""

    bags: int = 0
    span: Ns = 0
    intervals: int = 0


class Pacing(NamedTuple):
    """How often some bags hold a topic.

    Attributes:
        spacings: those of bags with enough messages, by the octave of the period or a part of it.
        messages: in all bags.
        length: of the bags that hold the topic, in all.
    """

    spacings: Mapping[int, Spacing]
    messages: int
    length: Ns


class Silence(NamedTuple):
    """A topic had no message although the robot was on.

    `length` is how long the robot was on between `start` and `end`. With `goes_on` the topic was
    not heard again.
    """

    topic: str
    start: Ns
    end: Ns
    length: Ns
    goes_on: bool = False

    def within(self, start: Ns, end: Ns) -> Silence | None:
        """Returns the part in a window with inclusive bounds; None if there is none.

        How long the robot was on in a part is not known: the whole part counts, if that is less.
        """
        first, last = max(self.start, start), min(self.end, end)
        if first >= last:
            return None
        goes_on = self.goes_on or last < self.end
        return Silence(self.topic, first, last, min(self.length, last - first), goes_on)


def joined(parts: Sequence[Pacing]) -> Pacing:
    """Returns the pacing in all of these parts together."""
    spacings: dict[int, Spacing] = {}
    for part in parts:
        for octave, spacing in part.spacings.items():
            both = zip(spacings.get(octave, Spacing()), spacing, strict=True)
            spacings[octave] = Spacing(*map(sum, both))
    return Pacing(
        spacings, sum(part.messages for part in parts), sum(part.length for part in parts)
    )


def shortest_silence(period: Ns) -> Ns:
    """Returns how long a topic with this period must have no message to count as silent."""
    return max(SHORTEST_NS, PERIODS * period)


def usual_period(pacing: Pacing) -> Ns | None:
    """Returns the usual time between two messages; None for a topic without a usual rate."""
    octaves = sorted(pacing.spacings)
    bags = [*accumulate(pacing.spacings[octave].bags for octave in octaves)]
    if not bags:
        return None
    median = next(
        octave for octave, upto in zip(octaves, bags, strict=True) if 2 * upto >= bags[-1]
    )
    spacing = pacing.spacings[median]
    period = spacing.span // spacing.intervals
    return period if 2 * pacing.messages * period >= pacing.length else None


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
        periods: the usual ones, by topic.
        runs_of: by topic, in the whole memory, from its first message to its last, in order, parted
            where bag after bag holds none for more than `SHORTEST_NS`.
        together: the topics of each bag; of bags with the same topics once is enough.
        gaps: when nothing was recorded, in order: also pauses of less than `SHORTEST_NS`.
    """
    companions: dict[str, set[str]] = {}
    for names in {frozenset(periods.keys() & topics) for topics in together}:
        for topic in names:
            companions.setdefault(topic, set()).update(names)
    robot_on: dict[frozenset[str], list[Span]] = {}
    reported: list[Silence] = []
    for topic, period in periods.items():
        others = frozenset(companions.get(topic, ()))
        if others not in robot_on:
            robot_on[others] = heard([runs_of[other] for other in sorted(others)])
        limit = shortest_silence(period)
        runs = united(runs_of[topic], limit)
        found = _silences_of(topic, runs, robot_on[others], limit, gaps)
        reported += _without_habit([*found], runs)
    return sorted(reported, key=lambda silence: (silence.start, silence.end, silence.topic))


def heard(topics: Sequence[Sequence[Span]]) -> list[Span]:
    """Returns when one in `_TOGETHER` of the topics is heard besides one that is silent."""
    enough = max(1, -(-(len(topics) - 1) // _TOGETHER))
    changes = sorted(
        change for runs in topics for first, last in runs for change in ((first, -1), (last, 1))
    )
    spans: list[Span] = []
    count, since = 0, 0
    for at, change in changes:
        before, count = count, count - change
        if before < enough <= count:
            since = at
        elif count < enough <= before:
            spans.append((since, at))
    return united(spans, SHORTEST_NS)


def prolonged(
    silence: Silence, robot_on: Sequence[Span], runs: Sequence[Span], gaps: Sequence[Span]
) -> Silence:
    """Returns a silence that goes on as it went on in later bags.

    Args:
        silence: as bags showed it that were deleted.
        robot_on: when the robot was on, in order.
        runs: of its topic, in later bags.
        gaps: as for `silences`.
    """
    again = next((first for first, _ in runs if first >= silence.end), MAX_NS)
    missed, length, is_parted = _missed(silence.end, again, robot_on, 0, gaps)
    end = missed[-1][1] if missed else silence.end
    goes_on = again == MAX_NS and not is_parted
    return Silence(silence.topic, silence.start, end, silence.length + length, goes_on)


def _silences_of(
    topic: str, runs: Sequence[Span], robot_on: Sequence[Span], limit: Ns, gaps: Sequence[Span]
) -> Iterator[Silence]:
    """Yields where a topic is absent for longer than a limit while the robot is on."""
    _, last_heard = runs[-1]
    end = max(last_heard, robot_on[-1][1] if robot_on else last_heard)
    nexts = [first for first, _ in runs[1:]]
    for (_, start), stop in zip(runs, [*nexts, end], strict=True):
        missed, length, is_parted = _missed(start, stop, robot_on, limit, gaps)
        if missed:
            goes_on = start == last_heard and not is_parted
            yield Silence(topic, missed[0][0], missed[-1][1], length, goes_on)


def _missed(
    start: Ns, stop: Ns, robot_on: Sequence[Span], limit: Ns, gaps: Sequence[Span]
) -> tuple[list[Span], Ns, bool]:
    """Returns when a topic was missed that is absent from a start to a stop.

    As spans in which the robot was on for longer than a limit, in order; for how long it was on in
    them; and whether it was off for so long that what follows is not known to be the same robot.
    """
    missed: list[Span] = []
    length, until, is_parted = 0, start, False
    for on_from, on_to in robot_on[bisect_right(robot_on, start, key=itemgetter(1)) :]:
        # What follows so long a time is another robot's, perhaps.
        is_parted = on_from - until > LONGEST_OFF_NS
        if on_from >= stop or is_parted:
            break
        until = on_to
        first, last = max(on_from, start), min(on_to, stop)
        recorded = last - first - length_in(gaps, first, last)
        if recorded > limit:
            missed.append((first, last))
            length += recorded
    return missed, length, is_parted


def length_in(gaps: Sequence[Span], first: Ns, last: Ns) -> Ns:
    """Returns how much of a time lies in gaps."""
    begin = bisect_right(gaps, first, key=itemgetter(1))
    end = bisect_left(gaps, last, key=itemgetter(0))
    return sum(min(last, until) - max(first, start) for start, until in gaps[begin:end])


def _without_habit(silences: Sequence[Silence], runs: Sequence[Span]) -> Sequence[Silence]:
    """Returns those silences of a topic that are not its habit."""
    if len(silences) <= SELDOM:
        return silences
    lengths = sorted(silence.length for silence in silences)
    heard = sum(last - first for first, last in runs)
    if heard < sum(lengths):
        return ()
    if heard >= HABIT_NS * len(silences):
        return silences
    usual = lengths[(len(lengths) - 1) // 2]
    return [silence for silence in silences if silence.length >= UNUSUAL * usual]
