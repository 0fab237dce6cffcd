"""Events on a topic: objects came into view and left, booleans toggled, errors were reported.

What else changed, and only matters before another event, is in `state_changes`. Where a history is
cut changes nothing, as long as nothing is left out for being too much.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.analysis.intervals import IntervalPart, IntervalTable, joined
from ros2_memory.analysis.state_changes import (
    NO_CHANGES,
    Change,
    Held,
    StateChanges,
    StateLevel,
    has_levels,
    joined_held,
    joined_reports,
    levels_of,
    reports_of,
)
from ros2_memory.core.text import shortened
from ros2_memory.messages.detections import detections_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.core.model import JsonValue
    from ros2_memory.core.timebase import Ns
    from ros2_memory.messages.detections import Detection

MAX_PER_BAG: Final = 64
"""Intervals, toggles and errors of one topic in one bag that a lake holds; the rest is counted."""
MAX_HELD: Final = 20_000
"""Toggles, errors, changes and the like of a topic that a question about a week may hold."""
MAX_SEEN: Final = 100_000
"""Intervals likewise; they are held as numbers."""
MAX_FLAGS: Final = 512
"""Booleans of one message that are tracked; the rest is counted."""
MAX_LABELS: Final = 256
"""Labels of one message, likewise."""

_ERROR_LEVEL: Final = 2
_STALE_LEVEL: Final = 3
_ERROR_LEVELS: Final = {
    "rcl_interfaces/msg/Log": 40,
    "diagnostic_msgs/msg/DiagnosticArray": _ERROR_LEVEL,
}
_MAX_TEXT_CHARS: Final = 160
_BYTES: Final = 600
"""About how much memory a toggle, an error or a level takes, and what each topic's events do."""
_MEASURED_WITH_EVENTS: Final = frozenset({"sensor_msgs/msg/BatteryState"})
_MEASUREMENT_PACKAGES: Final = ("geometry_msgs/", "nav_msgs/", "sensor_msgs/", "tf2_msgs/")
"""Packages whose messages are measurements: they contain no events."""


class State(NamedTuple):
    """What one message states: labels of objects, booleans by dot-path, errors as sentences.

    `beyond` is how many more labels and booleans it has; `levels` and `reports` are those of
    `state_changes`. `scores` has the best one of each label, or is empty where none has one.
    """

    labels: tuple[str, ...] = ()
    flags: tuple[tuple[str, bool], ...] = ()
    errors: tuple[str, ...] = ()
    beyond: int = 0
    levels: tuple[StateLevel, ...] = ()
    reports: tuple[str, ...] = ()
    scores: tuple[float | None, ...] = ()

    @property
    def is_empty(self) -> bool:
        """Whether the message states nothing."""
        return not (self.labels or self.flags or self.errors or self.levels or self.reports)


EMPTY_STATE: Final = State()
_NOTHING_VISIBLE: Final = IntervalTable()


class ReportedError(NamedTuple):
    """An error, and the log times of its first and last report (inclusive)."""

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
        known: each boolean's value at either end.
        toggles: in order.
        errors: by the time of their first report.
        left_out: intervals, toggles and errors beyond what is kept: the longest intervals are,
            and the earliest of the others.
        undecodable: messages that cannot be decoded; where there are no others, `first` is after
            `last`.
        beyond: labels and booleans of one message that are not tracked, at most.
        changes: what else changed.
    """

    first: Ns
    last: Ns
    visible: IntervalTable = _NOTHING_VISIBLE
    known: tuple[Held, ...] = ()
    toggles: tuple[Change, ...] = ()
    errors: tuple[ReportedError, ...] = ()
    left_out: int = 0
    undecodable: int = 0
    beyond: int = 0
    changes: StateChanges = NO_CHANGES

    @property
    def is_empty(self) -> bool:
        """Whether there were only messages without an event."""
        has_events = self.visible.rows or self.known or self.errors or self.undecodable
        return not has_events and self.changes.is_empty

    @property
    def memory_bytes(self) -> int:
        """About how much memory it takes."""
        changes = self.changes
        lists = (self.known, self.toggles, self.errors, changes.known, changes.changes)
        more = sum(map(len, lists)) + len(changes.reports) + len(self.visible.labels)
        return _BYTES * (1 + more) + len(self.visible.rows)

    @property
    def all_left_out(self) -> int:
        """Events of any kind beyond what is kept, changes included."""
        return self.left_out + self.changes.left_out

    def limited(self, at_most: int, intervals: int) -> TopicEvents:
        """Returns these with so many intervals, and so many of each other kind, at most."""
        changes = self.changes
        if changes is not NO_CHANGES:
            more = _beyond(at_most, changes.changes, changes.reports)
            changes = StateChanges(
                changes.known,
                changes.changes[:at_most],
                changes.reports[:at_most],
                changes.left_out + more,
            )
        left_out = _beyond(at_most, self.toggles, self.errors)
        return replace(
            self,
            visible=self.visible.most_lasting(intervals),
            toggles=self.toggles[:at_most],
            errors=self.errors[:at_most],
            left_out=self.left_out + left_out + max(0, self.visible.size - intervals),
            changes=changes,
        )


def _beyond(at_most: int, *kinds: Sequence[object]) -> int:
    return sum(max(0, len(kind) - at_most) for kind in kinds)


def has_events(type_name: str) -> bool:
    """Returns whether messages of a type can contain events."""
    return type_name in _MEASURED_WITH_EVENTS or not type_name.startswith(_MEASUREMENT_PACKAGES)


def has_errors(type_name: str) -> bool:
    """Returns whether messages of a type can report errors."""
    return type_name in _ERROR_LEVELS


def state_of(value: JsonValue, type_name: str) -> State:
    """Returns what an extracted message of a type states."""
    levels = levels_of(value, type_name) if has_levels(type_name) else ()
    if not has_events(type_name):
        return State(levels=levels) if levels else EMPTY_STATE
    errors = tuple(_errors_in(value, _ERROR_LEVELS.get(type_name)))
    if type_name in _ERROR_LEVELS:
        reports = reports_of(value, type_name)
        state = State(errors=errors, levels=levels, reports=reports)
        return EMPTY_STATE if state.is_empty else state
    best = _best_scores(detections_of(value))
    labels = tuple(best)
    flags = tuple(_flags_in(value, ""))
    if not (labels or flags or levels):
        return EMPTY_STATE
    beyond = len(labels[MAX_LABELS:]) + len(flags[MAX_FLAGS:])
    scores = tuple(best.values())[:MAX_LABELS]
    if all(score is None for score in scores):
        scores = ()
    return State(labels[:MAX_LABELS], flags[:MAX_FLAGS], errors, beyond, levels, scores=scores)


def _best_scores(detections: Sequence[Detection]) -> dict[str, float | None]:
    """Returns the labels of detections, in order, with the best score of each."""
    best: dict[str, float | None] = {}
    for each in detections:
        known = best.get(each.label)
        if known is None or (each.score is not None and each.score > known):
            best[each.label] = each.score
    return best


def joined_events(parts: Sequence[TopicEvents]) -> TopicEvents | None:
    """Returns the events of times that follow each other as those of one; None without a message.

    Where they are too many, the longest intervals are kept, and the earliest of the others.
    """
    undecodable = sum(part.undecodable for part in parts)
    parts = [part for part in parts if part.first <= part.last]
    if not parts:
        return TopicEvents(1, 0, undecodable=undecodable) if undecodable else None
    seen = [IntervalPart(part.first, part.last, part.visible) for part in parts]
    visible = (seen[0] if len(seen) == 1 else joined(seen)).visible
    known, toggles, more = joined_held((part.known, part.toggles) for part in parts)
    errors: dict[str, ReportedError] = {}
    for error in (error for part in parts for error in part.errors):
        before = errors.setdefault(error.text, error)
        if before is not error:
            reports = before.reports + error.reports
            errors[error.text] = before._replace(last=error.last, reports=reports)
    whole = TopicEvents(
        parts[0].first,
        parts[-1].last,
        visible,
        known,
        tuple(toggles),
        tuple(sorted(errors.values(), key=lambda each: (each.first, each.text))),
        more + sum(part.left_out for part in parts),
        undecodable,
        max(part.beyond for part in parts),
        _joined_changes([part.changes for part in parts]),
    )
    return whole.limited(MAX_HELD, MAX_SEEN)


def _joined_changes(parts: Sequence[StateChanges]) -> StateChanges:
    parts = [part for part in parts if part is not NO_CHANGES]
    if not parts:
        return NO_CHANGES
    known, changes, more = joined_held((part.known, part.changes) for part in parts)
    reports = joined_reports(report for part in parts for report in part.reports)
    left_out = more + sum(part.left_out for part in parts)
    return StateChanges(known, tuple(changes), tuple(reports), left_out)


def _flags_in(value: JsonValue, path: str) -> Iterator[tuple[str, bool]]:
    """Yields the booleans of an object and of nested objects, by dot-path; none of lists."""
    if isinstance(value, bool):
        yield path, value
    elif isinstance(value, dict):
        for name, inner in value.items():
            yield from _flags_in(inner, f"{path}.{name}" if path else name)


def _errors_in(value: JsonValue, least: int | None) -> Iterator[str]:
    """Yields the errors in a log entry or a list of diagnostics: who reports it, and what."""
    if least is None:
        return
    status = value.get("status") if isinstance(value, dict) else None
    for each in status if isinstance(status, list) else [value]:
        if not isinstance(each, dict):
            continue
        level, name = each.get("level"), each.get("name")
        message = each.get("msg", each.get("message"))
        if (
            isinstance(level, int)
            and level >= least
            and not (level == _STALE_LEVEL and least == _ERROR_LEVEL)
        ):
            text = ": ".join(part for part in (name, message) if isinstance(part, str) and part)
            yield shortened(text, _MAX_TEXT_CHARS)
