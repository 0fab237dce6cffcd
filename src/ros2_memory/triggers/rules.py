"""A rule: what makes it fire, and what is then kept. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from ros2_memory.core.model import TimeWindow
from ros2_memory.core.text import match_topics
from ros2_memory.core.timebase import MAX_NS, MIN_NS

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ros2_memory.analysis.conditions import Condition
    from ros2_memory.core.timebase import Ns


GLOB_MARKS: Final = "*?["
"""What makes a topic of a rule a glob."""


class RuleKind(StrEnum):
    """What a rule watches."""

    MESSAGE = "message"
    SILENT = "silent"
    RECORDER_RESTART = "recorder_restart"


@dataclass(frozen=True, slots=True, kw_only=True)
class Rule:
    """When to keep something, and how much.

    Attributes:
        name: unique among the rules.
        kind: what it watches.
        topic: the name or glob of the topics; None for a restart of the recorder.
        condition: what a message must meet; None for the other kinds.
        hold: for how long the condition, or the silence, must hold before it fires.
        before: how much is kept of the time before the match began.
        after: how much is kept of the time after it fired.
        label: what its moments are called.
        max_bytes: how much its moments may take together.
        max_per_hour: how many moments it may begin in an hour.
    """

    name: str
    kind: RuleKind = RuleKind.MESSAGE
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
        return [each for each in topics if each == self.topic]

    def window(self, first: Ns, fired: Ns) -> TimeWindow:
        """Returns what is kept of a match that began at `first` and made the rule fire."""
        return TimeWindow(max(first - self.before, MIN_NS + 1), min(fired + self.after, MAX_NS - 1))
