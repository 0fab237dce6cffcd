"""A rule: what makes it fire, and what is then kept. Pure.

When it fires is a fold over messages in order of time, with its state carried on.

A match begins with a message that meets the condition, and ends as a sighting does: with a message
of the topic that does not, or where the topic is silent for longer than `SILENCE_NS`; on a latched
topic, whose publisher sends only when something changes, a silence ends nothing. It ends at a gap,
where the recorder did not run on. A message that cannot be decoded neither begins nor ends one.

A rule fires once in each match: when it begins, or once it has held for as long as the rule asks.
A silence begins with the last message of a topic that had one since the last gap.

How the stream is cut into calls changes nothing: `reach` says only how far it is known.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.bag_dir.state_files import RunRecord
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.text import match_topics
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, MutableMapping

    from ros2_memory.analysis.conditions import Condition


GLOB_MARKS: Final = "*?["
"""What makes a topic of a rule a glob."""


class Firing(NamedTuple):
    """A rule fired at a log time, for a match that began at `first` on a topic."""

    rule: str
    topic: str
    first: Ns
    at: Ns


@dataclass(frozen=True, slots=True, kw_only=True)
class Rule:
    """When to keep something, and how much.

    Attributes:
        name: unique among the rules.
        topic: the name or glob of the topics; None for a restart of the recorder.
        condition: what a message must meet; None for a rule over silences, and for a restart.
        hold: for how long the condition, or the silence, must hold before it fires.
        before: how much is kept of the time before the match began.
        after: how much is kept of the time after it fired.
        label: what its moments are called.
        max_bytes: how much its moments may take together.
        max_per_hour: how many moments it may begin in an hour.
    """

    name: str
    topic: str | None = None
    condition: Condition | None = None
    hold: Ns = 0
    before: Ns
    after: Ns
    label: str
    max_bytes: int
    max_per_hour: int

    def selects(self, topics: Iterable[str]) -> list[str]:
        """Returns those of the topics that the rule watches."""
        if self.topic is None:
            return []
        if any(mark in self.topic for mark in GLOB_MARKS):
            return match_topics(topics, self.topic)
        return [topic for topic in topics if topic == self.topic]

    def window(self, first: Ns, fired: Ns) -> TimeWindow:
        """Returns what is kept of a match that began at `first` and made the rule fire."""
        return TimeWindow(max(first - self.before, MIN_NS + 1), min(fired + self.after, MAX_NS - 1))

    def take(
        self,
        runs: MutableMapping[str, RunRecord],
        topic: str,
        time: Ns,
        *,
        matches: bool | None,
        latched: bool = False,
    ) -> Firing | None:
        """Takes the next message of a topic, and changes the matches that go on.

        Args:
            runs: the matches that go on, by topic; for a rule over silences, since when each topic
                is silent.
            topic: the topic of the message.
            time: its log time.
            matches: whether it meets the condition; None where it cannot be decoded.
            latched: whether its value holds until the next message.
        """
        run = runs.get(topic)
        if run is not None and time < run.last - SILENCE_NS:
            run = None  # the clock was set back
        if self.condition is None:
            fired = None if run is None else self._fire(topic, run, time)
            spoke = time if run is None else max(time, run.last)
            runs[topic] = RunRecord(spoke, spoke)
            return fired
        fired = None
        if run is not None and run.lasts:
            # Its value held until now, whatever it is from now on.
            fired = self._fire(topic, run, time)
        elif run is not None and abs(time - run.last) > SILENCE_NS:
            run = None
        if matches is False:
            run = None
        elif matches and run is None:
            run = RunRecord(time, time, lasts=latched)
        if run is None:
            runs.pop(topic, None)
            return fired
        runs[topic] = run
        run.last = max(run.last, time)
        if matches:
            fired = fired or self._fire(topic, run, time)
        return fired

    def reach(self, runs: Mapping[str, RunRecord], until: Ns) -> Iterator[Firing]:
        """Yields what fires because nothing more came before a moment."""
        for topic, run in runs.items():
            if self.condition is None or run.lasts:
                fired = self._fire(topic, run, until)
                if fired is not None:
                    yield fired

    def _fire(self, topic: str, run: RunRecord, time: Ns) -> Firing | None:
        if run.fired or time - run.first < self.hold:
            return None
        run.fired = True
        return Firing(self.name, topic, run.first, run.first + self.hold)
