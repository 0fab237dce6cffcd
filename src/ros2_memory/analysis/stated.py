"""What the messages of one topic state, as columns, and the events that follow from them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.analysis.intervals import visible_in
from ros2_memory.analysis.state_changes import (
    MAX_LEVELS,
    NO_CHANGES,
    Change,
    Held,
    Report,
    StateChanges,
    joined_reports,
)
from ros2_memory.analysis.topic_events import ReportedError, TopicEvents

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from ros2_memory.analysis.topic_events import State
    from ros2_memory.core.timebase import Ns

    Ints: TypeAlias = "NDArray[np.int64]"
    Floats: TypeAlias = "NDArray[np.float64]"
    Word: TypeAlias = tuple[str, str]


class Facts(NamedTuple):
    """Things that messages state, by message, and in a message in its order.

    Attributes:
        rows: the message of each, ascending.
        codes: what it is about, by the place in `words`.
        values: NaN where there is none.
        words: names, each with a text that describes the value; each once.
    """

    rows: Ints
    codes: Ints
    values: Floats
    words: Sequence[Word]

    @classmethod
    def of(cls, found: Sequence[tuple[int, Word, float]]) -> Facts:
        """Returns facts, each given with its row."""
        known: dict[Word, int] = {}
        codes = [known.setdefault(word, len(known)) for _, word, _ in found]
        return cls(
            np.array([row for row, _, _ in found], np.int64),
            np.array(codes, np.int64),
            np.array([value for _, _, value in found], np.float64),
            tuple(known),
        )

    def at(self, rows: Ints) -> Facts:
        """Returns those of some messages, which ascend and become the messages 0, 1, 2, ..."""
        place = np.searchsorted(rows, self.rows)
        kept = place < rows.size
        kept[kept] = rows[place[kept]] == self.rows[kept]
        return self._replace(rows=place[kept], codes=self.codes[kept], values=self.values[kept])


NOTHING: Final = Facts.of(())


def joined_facts(parts: Sequence[Facts]) -> Facts:
    """Returns the facts of all parts, by their messages."""
    parts = [part for part in parts if part.rows.size]
    if len(parts) <= 1:
        return parts[0] if parts else NOTHING
    known: dict[Word, int] = {}
    codes = []
    for part in parts:
        new = [known.setdefault(word, len(known)) for word in part.words]
        codes.append(np.array(new, np.int64)[part.codes])
    rows = np.concatenate([part.rows for part in parts])
    order = np.argsort(rows, kind="stable")
    values = np.concatenate([part.values for part in parts])
    return Facts(rows[order], np.concatenate(codes)[order], values[order], tuple(known))


class Stated(NamedTuple):
    """What messages of a topic state, in the order of their log times.

    Attributes:
        times: log times of the messages that can be decoded.
        labels: of objects in view, with their scores.
        flags: booleans, by dot-path.
        levels: see `state_changes`.
        errors: sentences; reports of one are facts each.
        reports: likewise.
        undecodable: log times of the others.
        beyond: labels and booleans of one message that are not tracked, at most.
        more_levels: messages with more levels than are tracked.
    """

    times: Ints
    labels: Facts = NOTHING
    flags: Facts = NOTHING
    levels: Facts = NOTHING
    errors: Facts = NOTHING
    reports: Facts = NOTHING
    undecodable: Ints = np.empty(0, np.int64)
    beyond: int = 0
    more_levels: int = 0

    @property
    def facts(self) -> tuple[Facts, ...]:
        """All kinds of facts."""
        return self.labels, self.flags, self.levels, self.errors, self.reports

    def at(self, rows: Ints) -> Stated:
        """Returns what some of the messages that can be decoded state."""
        kinds = [kind.at(rows) if kind.rows.size else kind for kind in self.facts]
        return self._replace(times=self.times[rows]).with_facts(kinds)

    def unchanging(self, first: Ns, last: Ns) -> Stated | None:
        """Returns the same by two messages, without looking at times, where all state the same.

        None where some message states something else than the first.
        """
        if any(kind.rows.size for kind in (self.labels, self.errors, self.reports)):
            return None
        begins = np.zeros(1, np.int64)
        for kind in (self.flags, self.levels):
            order = np.argsort(kind.codes, kind="stable")
            is_first = np.diff(kind.codes[order], prepend=-1) != 0
            changes = (np.diff(kind.values[order], prepend=0.0) != 0) & ~is_first
            if len({name for name, _ in kind.words}) < len(kind.words):
                return None
            if changes.any() or kind.rows[order][is_first].any():
                return None
        stated = self.with_facts([kind.at(begins) for kind in self.facts])
        return stated._replace(times=np.array([first, last], np.int64))

    def with_facts(self, kinds: Sequence[Facts]) -> Stated:
        """Returns the same with other facts, in the order of `facts`."""
        labels, flags, levels, errors, reports = kinds
        return self._replace(
            labels=labels, flags=flags, levels=levels, errors=errors, reports=reports
        )


def stated_by(times: Sequence[Ns], states: Sequence[State | None]) -> Stated:
    """Returns what messages state, one by one; None is one that cannot be decoded."""
    known = [state for state in states if state is not None]
    decoded = np.array([state is not None for state in states], np.bool_)
    all_times = np.array(times, np.int64)
    none = math.nan
    return Stated(
        all_times[decoded],
        Facts.of(
            [
                (row, (label, ""), none if score is None else score)
                for row, state in enumerate(known)
                for label, score in zip(
                    state.labels, state.scores or [None] * len(state.labels), strict=True
                )
            ]
        ),
        Facts.of([(row, (p, ""), v) for row, state in enumerate(known) for p, v in state.flags]),
        Facts.of(
            [
                (row, (level.name, level.text), level.value)
                for row, state in enumerate(known)
                for level in state.levels[:MAX_LEVELS]
            ]
        ),
        Facts.of([(row, (e, ""), none) for row, state in enumerate(known) for e in state.errors]),
        Facts.of([(row, (e, ""), none) for row, state in enumerate(known) for e in state.reports]),
        all_times[~decoded],
        max((state.beyond for state in known), default=0),
        sum(len(state.levels) > MAX_LEVELS for state in known),
    )


def joined_stated(parts: Sequence[Stated]) -> Stated:
    """Returns what the messages of all parts state, which may overlap in time."""
    if len(parts) == 1:
        return parts[0]
    times = np.concatenate([part.times for part in parts])
    order = np.argsort(times, kind="stable")
    place = np.empty(order.size, np.int64)
    place[order] = np.arange(order.size)
    begins = np.cumsum([0, *(part.times.size for part in parts)]).tolist()
    moved: list[list[Facts]] = []
    for begin, part in zip(begins, parts, strict=False):
        rows = [place[begin + kind.rows] for kind in part.facts]
        kinds = zip(part.facts, rows, strict=True)
        moved.append([kind._replace(rows=of_kind) for kind, of_kind in kinds])
    whole = Stated(
        times[order],
        undecodable=np.sort(np.concatenate([part.undecodable for part in parts])),
        beyond=max(part.beyond for part in parts),
        more_levels=sum(part.more_levels for part in parts),
    )
    return whole.with_facts([joined_facts(kinds) for kinds in zip(*moved, strict=True)])


def events_of(stated: Stated) -> TopicEvents | None:
    """Returns the events of messages in order of log time; None without any."""
    times, undecodable = stated.times, stated.undecodable.size
    if not times.size:
        return TopicEvents(1, 0, undecodable=undecodable) if undecodable else None
    names = [name for name, _ in stated.labels.words]
    seen = stated.labels
    known, toggles = _held(stated.flags, times)
    return TopicEvents(
        int(times[0]),
        int(times[-1]),
        visible_in(times, seen.rows, seen.codes, seen.values, names),
        tuple(each._replace(first=bool(each.first), last=bool(each.last)) for each in known),
        tuple(each._replace(value=bool(each.value)) for each in toggles),
        _errors(stated.errors, times),
        0,
        undecodable,
        stated.beyond,
        _changes(stated),
    )


def _held(facts: Facts, times: Ints) -> tuple[list[Held], list[Change]]:
    """Returns what each level or boolean was first and last, and its changes."""
    if not facts.rows.size:
        return [], []
    ids: dict[str, int] = {}
    of_code = np.array([ids.setdefault(name, len(ids)) for name, _ in facts.words], np.int64)
    name = of_code[facts.codes]
    order = np.argsort(name, kind="stable")
    begins = np.flatnonzero(np.diff(name[order], prepend=-1))
    values = facts.values.astype(np.int64)
    is_change = np.diff(values[order], prepend=0) != 0
    is_change[begins] = False
    at = times[facts.rows]

    def listed(nth: Ints) -> list[tuple[Word, Ns, int]]:
        words = [facts.words[code] for code in facts.codes[nth].tolist()]
        return [*zip(words, at[nth].tolist(), values[nth].tolist(), strict=True)]

    first = order[begins]
    last = values[order[np.append(begins[1:], order.size) - 1]][np.argsort(first)].tolist()
    known = [
        Held(name, time, value, end, text)
        for ((name, text), time, value), end in zip(listed(np.sort(first)), last, strict=True)
    ]
    changes = [
        Change(name, time, value, text)
        for (name, text), time, value in listed(np.sort(order[is_change]))
    ]
    return known, changes


def _errors(facts: Facts, times: Ints) -> tuple[ReportedError, ...]:
    found: dict[int, ReportedError] = {}
    for row, code in zip(facts.rows.tolist(), facts.codes.tolist(), strict=True):
        time = int(times[row])
        before = found.get(code, ReportedError(facts.words[code][0], time, time, 0))
        found[code] = before._replace(last=time, reports=before.reports + 1)
    return tuple(sorted(found.values(), key=lambda each: (each.first, each.text)))


def _changes(stated: Stated) -> StateChanges:
    known, changes = _held(stated.levels, stated.times)
    facts = stated.reports
    reports = joined_reports(
        Report(facts.words[code][0], time, time, 1)
        for code, time in zip(facts.codes.tolist(), stated.times[facts.rows].tolist(), strict=True)
    )
    if not (known or reports or stated.more_levels):
        return NO_CHANGES
    return StateChanges(tuple(known), tuple(changes), tuple(reports), stated.more_levels)
