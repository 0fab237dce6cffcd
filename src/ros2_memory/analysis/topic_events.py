"""The events that follow from what the messages of a topic state.

Objects come into view and leave, states change, errors and warnings are reported. How a history is
cut into bags changes nothing, unless there are so many events that some are left out.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from itertools import islice, pairwise
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.facts import ERROR, LABEL, REPORT, STATES, Stated
from ros2_memory.analysis.intervals import SILENCE_NS, IntervalTable, united_tables, visible_in
from ros2_memory.core.arrays import joined_codes, run_starts, stable_order
from ros2_memory.core.timebase import NS_PER_S, Ns

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence


MAX_EVENTS: Final = 20_000
"""How many states, changes, errors or reports of a topic a question may have in memory."""
MAX_INTERVALS: Final = 100_000
"""How many intervals, which take less memory."""
REPEATED_NS: Final = 2 * NS_PER_S
"""A log entry that follows a similar one within this time belongs to the same report."""
_ERRORS_APART_NS: Final = 600 * NS_PER_S
"""An error that comes again after a longer pause is another one: the robot went on meanwhile."""

_BYTES: Final = 190
"""About how much memory a state, a change or a report takes."""
_NOTHING_VISIBLE: Final = IntervalTable()
_DIGITS: Final = re.compile(r"\d+")


class KnownState(NamedTuple):
    """A state and its values in the first message that has it (at log time `at`), and in the last.

    `kind`, `name` and `text` are as in `facts.Word`; `text` describes the first value.
    """

    kind: str
    name: str
    at: Ns
    first: int
    last: int
    text: str = ""


class Change(NamedTuple):
    """A state that has `value` from log time `time` on, and had another value before."""

    kind: str
    name: str
    time: Ns
    value: int
    text: str = ""


class Report(NamedTuple):
    """Similar sentences: the first one, the log times of the first and the last, and how many."""

    text: str
    first: Ns
    last: Ns
    reports: int


@dataclass(frozen=True, slots=True)
class TopicEvents:
    """The events of one topic in a part of a history.

    Attributes:
        first: log time of the first message; after `last` if no message can be decoded.
        last: log time of the last message.
        visible: the intervals in which objects were visible.
        known: the states, with their values at both ends.
        changes: the changes of states, in order of time.
        errors: the errors, in order of their first report.
        reports: the log entries of WARN and above, in order; similar ones differ in digits alone.
        left_out: how many events and states are left out because there are too many. The longest
            intervals and the earliest other events stay.
        undecodable: how many messages cannot be decoded.
        beyond: the most facts of one message that are not tracked.
    """

    first: Ns
    last: Ns
    visible: IntervalTable = _NOTHING_VISIBLE
    known: tuple[KnownState, ...] = ()
    changes: tuple[Change, ...] = ()
    errors: tuple[Report, ...] = ()
    reports: tuple[Report, ...] = ()
    left_out: int = 0
    undecodable: int = 0
    beyond: int = 0

    @property
    def is_empty(self) -> bool:
        """Whether there is no message, not even an undecodable one."""
        return self.first > self.last and not self.undecodable

    @property
    def memory_bytes(self) -> int:
        """About how much memory the events take."""
        lists = (self.known, self.changes, self.errors, self.reports, self.visible.labels)
        return _BYTES * (1 + sum(map(len, lists))) + len(self.visible.rows)

    def of_kind(self, kind: str) -> tuple[Sequence[KnownState], Sequence[Change]]:
        """Returns the states of a kind, and their changes."""
        return (
            [state for state in self.known if state.kind == kind],
            [change for change in self.changes if change.kind == kind],
        )

    def without_sights(self) -> TopicEvents:
        """Returns the events without intervals and errors."""
        return replace(self, visible=_NOTHING_VISIBLE, errors=())

    def limited(self, at_most: int, intervals: int) -> TopicEvents:
        """Returns at most so many intervals, and `at_most` changes, errors and reports each."""
        lists = (self.changes, self.errors, self.reports)
        left_out = sum(max(0, len(events) - at_most) for events in lists)
        return replace(
            self,
            visible=self.visible.most_lasting(intervals),
            changes=self.changes[:at_most],
            errors=self.errors[:at_most],
            reports=self.reports[:at_most],
            left_out=self.left_out + left_out + max(0, self.visible.size - intervals),
        )


NO_EVENTS: Final = TopicEvents(1, 0)


def events_of(stated: Stated) -> TopicEvents:
    """Returns the events of the messages of one topic."""
    times, undecodable = stated.times, stated.undecodable.size
    if not times.size:
        return replace(NO_EVENTS, undecodable=undecodable)
    seen = stated.facts.of_kinds({LABEL})
    labels = [word.name for word in seen.words]
    log = _StateLog()
    log.add(_new_states(stated))
    return TopicEvents(
        int(times[0]),
        int(times[-1]),
        visible_in(times, seen.rows, seen.codes, seen.values, labels),
        log.states,
        tuple(log.changes),
        _merge_errors(_reports_of(stated, ERROR)),
        _merge_log_entries(_reports_of(stated, REPORT)),
        0,
        undecodable,
        stated.beyond,
    )


def joined_events(parts: Sequence[TopicEvents]) -> TopicEvents:
    """Joins the events of consecutive parts of a history.

    At most `MAX_INTERVALS` intervals and `MAX_EVENTS` of other events stay.
    """
    undecodable = sum(part.undecodable for part in parts)
    parts = [part for part in parts if part.first <= part.last]
    if not parts:
        return replace(NO_EVENTS, undecodable=undecodable)
    log = _StateLog()
    for part in parts:
        log.add(part.known, part.changes)
        log.limit(MAX_EVENTS)
    whole = TopicEvents(
        parts[0].first,
        parts[-1].last,
        joined_visible(parts),
        log.states,
        tuple(log.changes),
        _merge_errors(error for part in parts for error in part.errors),
        _merge_log_entries(report for part in parts for report in part.reports),
        log.left_out + sum(part.left_out for part in parts),
        undecodable,
        max(part.beyond for part in parts),
    )
    return whole.limited(MAX_EVENTS, MAX_INTERVALS)


def joined_visible(parts: Sequence[TopicEvents]) -> IntervalTable:
    """Returns when objects were visible in consecutive parts: they may stay so in the next one."""
    follows = [after.first - before.last <= SILENCE_NS for before, after in pairwise(parts)]
    return united_tables([part.visible for part in parts], [False, *follows])


class _StateLog:
    """The states of consecutive messages, or of consecutive parts, and their changes.

    Attributes:
        changes: the changes, in order of time part by part.
        left_out: how many states were left out.
    """

    def __init__(self) -> None:
        self._states: dict[tuple[str, str], KnownState] = {}
        self.changes: list[Change] = []
        self.left_out = 0

    @property
    def states(self) -> tuple[KnownState, ...]:
        """The states, with their first and last values."""
        return tuple(self._states.values())

    def add(self, states: Iterable[KnownState], changes: Iterable[Change] = ()) -> None:
        """Adds the next states, and the changes within them."""
        between: list[Change] = []
        for state in states:
            key = state.kind, state.name
            before = self._states.get(key)
            if before is None:
                self._states[key] = state
                continue
            self._states[key] = before._replace(last=state.last)
            if before.last != state.first:
                between.append(Change(*key, state.at, state.first, state.text))
        self.changes += sorted([*between, *changes], key=lambda change: change.time)

    def limit(self, at_most: int) -> None:
        """Leaves out states that were added after the first `at_most`."""
        self.left_out += max(len(self._states) - at_most, 0)
        self._states = dict(islice(self._states.items(), at_most))


def _new_states(stated: Stated) -> Iterator[KnownState]:
    """Yields each state when a message first has it, and when its value differs, in order."""
    facts = stated.facts.of_kinds(STATES)
    names, _ = joined_codes([(facts.codes, [word[:2] for word in facts.words])])
    order = stable_order(names)
    values = facts.values.astype(np.int64)
    new = np.sort(order[run_starts(names[order], values[order])])
    codes, times = facts.codes[new].tolist(), stated.times[facts.rows[new]].tolist()
    for code, at, value in zip(codes, times, values[new].tolist(), strict=True):
        kind, name, text = facts.words[code]
        yield KnownState(kind, name, at, value, value, text)


def _reports_of(stated: Stated, kind: str) -> list[Report]:
    """Returns a report of each sentence of a kind."""
    facts = stated.facts.of_kinds({kind})
    cells = zip(facts.codes.tolist(), stated.times[facts.rows].tolist(), strict=True)
    return [Report(facts.words[code].name, time, time, 1) for code, time in cells]


def _merge_errors(errors: Iterable[Report]) -> tuple[Report, ...]:
    """Merges equal errors that follow within `_ERRORS_APART_NS`, in order of the first."""
    merged = _merge_reports(errors, str, _ERRORS_APART_NS)
    return tuple(sorted(merged, key=lambda error: (error.first, error.text)))


def _merge_log_entries(reports: Iterable[Report]) -> tuple[Report, ...]:
    """Merges log entries that differ in digits alone and follow within `REPEATED_NS`."""
    return tuple(_merge_reports(reports, lambda text: _DIGITS.sub("#", text), REPEATED_NS))


def _merge_reports(
    reports: Iterable[Report], key_of: Callable[[str], str], within: Ns
) -> list[Report]:
    """Merges each report with the newest one of the same key that is at most `within` before it."""
    merged: list[Report] = []
    newest: dict[str, int] = {}
    for report in reports:
        key = key_of(report.text)
        nth = newest.get(key)
        if nth is not None and report.first - merged[nth].last <= within:
            before = merged[nth]
            merged[nth] = before._replace(last=report.last, reports=before.reports + report.reports)
        else:
            newest[key] = len(merged)
            merged.append(report)
    return merged
