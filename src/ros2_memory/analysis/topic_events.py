"""The events that follow from what the messages of a topic state.

Objects came into view and left, a state changed, errors and warnings were reported. Where a history
is cut changes nothing, as long as nothing is left out for being too much.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.facts import ERROR, LABEL, REPORT, STATES, Stated
from ros2_memory.analysis.intervals import IntervalPart, IntervalTable, join_parts, visible_in
from ros2_memory.core.arrays import joined_codes
from ros2_memory.core.timebase import MAX_NS, NS_PER_S, Ns

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence


MAX_PER_BAG: Final = 64
"""Intervals, changes and errors of one topic in one bag that a lake holds; the rest is counted."""
MAX_HELD: Final = 20_000
"""Changes, errors and the like of a topic that a question about a week may hold."""
MAX_SEEN: Final = 100_000
"""Intervals likewise; they are held as numbers."""
REPEATED_NS: Final = 2 * NS_PER_S
"""A log entry that follows its like sooner is the same report."""

_BYTES: Final = 190
"""About how much memory a change, an error or a state takes, and what each topic's events do."""
_NOTHING_VISIBLE: Final = IntervalTable()
_DIGITS: Final = re.compile(r"\d+")


class KnownState(NamedTuple):
    """A state: its value in the first message that has it, and in the last; see `facts.Word`."""

    kind: str
    name: str
    at: Ns
    first: int
    last: int
    text: str = ""


class Change(NamedTuple):
    """A state that is `value` from `time` on, and was another before."""

    kind: str
    name: str
    time: Ns
    value: int
    text: str = ""


class Report(NamedTuple):
    """Sentences that are alike, and the log times of the first and last of them (inclusive)."""

    text: str
    first: Ns
    last: Ns
    reports: int


@dataclass(frozen=True, slots=True)
class TopicEvents:
    """The events of one topic in some time, to be joined with those before and after.

    Attributes:
        first: log time of the first message.
        last: of the last.
        visible: the intervals in which objects were visible.
        known: each state's value at either end.
        changes: of states, in order.
        errors: by the time of their first report.
        reports: log entries of WARN and above, likewise: those alike but for their numbers.
        left_out: events and states beyond what is kept: the longest intervals are, and the earliest
            of the others.
        undecodable: messages that cannot be decoded; where there are no others, `first` is after
            `last`.
        beyond: facts of one message that are not tracked, at most.
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
    def memory_bytes(self) -> int:
        """About how much memory it takes."""
        lists = (self.known, self.changes, self.errors, self.reports, self.visible.labels)
        return _BYTES * (1 + sum(map(len, lists))) + len(self.visible.rows)

    def of_kind(self, kind: str) -> tuple[Sequence[KnownState], Sequence[Change]]:
        """Returns the states of a kind, and their changes."""
        return (
            [state for state in self.known if state.kind == kind],
            [change for change in self.changes if change.kind == kind],
        )

    def without_sights(self) -> TopicEvents:
        """Returns states, changes and reports alone: what was visible, and errors, are left out."""
        return replace(self, visible=_NOTHING_VISIBLE, errors=())

    def limited(self, at_most: int, intervals: int) -> TopicEvents:
        """Returns these with so many intervals, and so many of each other kind, at most."""
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


def events_of(stated: Stated) -> TopicEvents | None:
    """Returns the events of messages in order of log time; None without any."""
    times, undecodable = stated.times, stated.undecodable.size
    if not times.size:
        return TopicEvents(1, 0, undecodable=undecodable) if undecodable else None
    seen = stated.facts.of_kinds({LABEL})
    labels = [word.name for word in seen.words]
    states, changes = _states_and_changes(stated)
    return TopicEvents(
        int(times[0]),
        int(times[-1]),
        visible_in(times, seen.rows, seen.codes, seen.values, labels),
        states,
        changes,
        _merge_errors(_reports_of(stated, ERROR)),
        _merge_log_entries(_reports_of(stated, REPORT)),
        0,
        undecodable,
        stated.beyond,
    )


def joined_events(parts: Sequence[TopicEvents]) -> TopicEvents | None:
    """Returns the events of times that follow each other as those of one; None without a message.

    Where they are too many, the longest intervals are kept, and the earliest of the others.
    """
    undecodable = sum(part.undecodable for part in parts)
    parts = [part for part in parts if part.first <= part.last]
    if not parts:
        return TopicEvents(1, 0, undecodable=undecodable) if undecodable else None
    seen = [IntervalPart(part.first, part.last, part.visible) for part in parts]
    states, changes, more = _joined_states(parts)
    whole = TopicEvents(
        parts[0].first,
        parts[-1].last,
        join_parts(seen).visible,
        states,
        changes,
        _merge_errors(error for part in parts for error in part.errors),
        _merge_log_entries(report for part in parts for report in part.reports),
        more + sum(part.left_out for part in parts),
        undecodable,
        max(part.beyond for part in parts),
    )
    return whole.limited(MAX_HELD, MAX_SEEN)


def _states_and_changes(stated: Stated) -> tuple[tuple[KnownState, ...], tuple[Change, ...]]:
    """Returns what each state was first and last, and its changes."""
    facts = stated.facts.of_kinds(STATES)
    names, _ = joined_codes([(facts.codes, [word[:2] for word in facts.words])])
    order = np.argsort(names, kind="stable")
    values = facts.values.astype(np.int64)
    is_new = (np.diff(names[order], prepend=-1) != 0) | (np.diff(values[order], prepend=0) != 0)
    news = np.sort(order[is_new])
    columns = facts.codes[news], stated.times[facts.rows[news]], values[news]
    rows = zip(*(column.tolist() for column in columns), strict=True)
    states: dict[tuple[str, str], KnownState] = {}
    words = facts.words
    changes = _changed(
        states,
        (
            KnownState(words[code].kind, words[code].name, at, value, value, words[code].text)
            for code, at, value in rows
        ),
    )
    return tuple(states.values()), tuple(changes)


def _changed(
    states: dict[tuple[str, str], KnownState], following: Iterable[KnownState]
) -> list[Change]:
    """Returns the changes from states to what follows them, which `states` then have, too."""
    changes: list[Change] = []
    for held in following:
        before = states.get(held[:2])
        states[held[:2]] = held if before is None else before._replace(last=held.last)
        if before is not None and before.last != held.first:
            changes.append(Change(held.kind, held.name, held.at, held.first, held.text))
    return changes


def _joined_states(
    parts: Sequence[TopicEvents],
) -> tuple[tuple[KnownState, ...], tuple[Change, ...], int]:
    """Returns the states in times that follow each other, and the changes in and between them.

    The changes are in order of time, part by part. With them how much more was held than is kept.
    """
    states: dict[tuple[str, str], KnownState] = {}
    changes: list[Change] = []
    left_out = 0
    for part in parts:
        between = _changed(states, part.known)
        left_out += max(len(states) - MAX_HELD, 0)
        states = dict(islice(states.items(), MAX_HELD))
        changes += sorted([*between, *part.changes], key=lambda change: change.time)
    return tuple(states.values()), tuple(changes), left_out


def _reports_of(stated: Stated, kind: str) -> list[Report]:
    """Returns each sentence of a kind as a report."""
    facts = stated.facts.of_kinds({kind})
    cells = zip(facts.codes.tolist(), stated.times[facts.rows].tolist(), strict=True)
    return [Report(facts.words[code].name, time, time, 1) for code, time in cells]


def _merge_errors(reports: Iterable[Report]) -> tuple[Report, ...]:
    alike = _merge_reports(reports, str, MAX_NS)
    return tuple(sorted(alike, key=lambda error: (error.first, error.text)))


def _merge_log_entries(reports: Iterable[Report]) -> tuple[Report, ...]:
    return tuple(_merge_reports(reports, lambda text: _DIGITS.sub("#", text), REPEATED_NS))


def _merge_reports(
    reports: Iterable[Report], likeness: Callable[[str], str], apart: Ns
) -> list[Report]:
    """Returns reports in order, each joined to the newest one like it, where that is recent."""
    joined: list[Report] = []
    newest: dict[str, int] = {}
    for report in reports:
        alike = likeness(report.text)
        nth = newest.get(alike)
        if nth is not None and report.first - joined[nth].last <= apart:
            before = joined[nth]
            joined[nth] = before._replace(last=report.last, reports=before.reports + report.reports)
        else:
            newest[alike] = len(joined)
            joined.append(report)
    return joined
