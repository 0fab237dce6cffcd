"""Events on a topic: objects came into view and left, booleans toggled, errors were reported.

What else changed, and only matters before another event, is in `state_changes`.

Collected message by message or by whole bags; where a history is cut into bags changes nothing, as
long as nothing is left out for being too much.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.analysis.intervals import IntervalBuilder, IntervalPart, IntervalTable, joined
from ros2_memory.analysis.state_changes import (
    NO_CHANGES,
    StateChanges,
    StateChangesBuilder,
    StateLevel,
    has_levels,
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
"""Intervals, toggles and errors of one topic in one bag that are stored; the rest is counted."""
MAX_HELD: Final = 20_000
"""Toggles and errors of a topic in all bags together, which a question about a week may hold."""
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


class Toggle(NamedTuple):
    """A boolean that is `value` from `time` on, and was the opposite before."""

    path: str
    time: Ns
    value: bool


class ReportedError(NamedTuple):
    """An error, and the log times of its first and last report (inclusive)."""

    text: str
    first: Ns
    last: Ns
    reports: int


class KnownFlag(NamedTuple):
    """A boolean's value at the first message of a bag that has it, and at the last."""

    path: str
    at: Ns
    first: bool
    last: bool


@dataclass(frozen=True, slots=True)
class TopicEvents:
    """The events of one topic in one bag, to be joined with those before and after.

    Attributes:
        first: log time of the first message.
        last: of the last.
        visible: the intervals in which objects were visible.
        known: each boolean's value at either end.
        toggles: in order.
        errors: by the time of their first report.
        left_out: intervals, toggles and errors beyond what is stored: the longest intervals are,
            and the earliest of the others.
        undecodable: messages that cannot be decoded; where there are no others, `first` is after
            `last`.
        beyond: labels and booleans of one message that are not tracked, at most.
        changes: what else changed.
    """

    first: Ns
    last: Ns
    visible: IntervalTable = _NOTHING_VISIBLE
    known: tuple[KnownFlag, ...] = ()
    toggles: tuple[Toggle, ...] = ()
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
    def all_left_out(self) -> int:
        """Events of any kind beyond what is stored, changes included."""
        return self.left_out + self.changes.left_out


NO_EVENTS: Final = TopicEvents(0, 0)
"""The events of messages that have none."""


def has_events(type_name: str) -> bool:
    """Returns whether messages of a type can contain events."""
    return type_name in _MEASURED_WITH_EVENTS or not type_name.startswith(_MEASUREMENT_PACKAGES)


def has_errors(type_name: str) -> bool:
    """Returns whether messages of a type can report errors."""
    return type_name in _ERROR_LEVELS


def state_of(
    value: JsonValue, type_name: str, detections: Sequence[Detection] | None = None
) -> State:
    """Returns what an extracted message of a type states.

    `detections` are those in it, where they are known already.
    """
    levels = levels_of(value, type_name) if has_levels(type_name) else ()
    if not has_events(type_name):
        return State(levels=levels) if levels else EMPTY_STATE
    errors = tuple(_errors_in(value, _ERROR_LEVELS.get(type_name)))
    if type_name in _ERROR_LEVELS:
        reports = reports_of(value, type_name)
        state = State(errors=errors, levels=levels, reports=reports)
        return EMPTY_STATE if state.is_empty else state
    best = _best_scores(detections_of(value) if detections is None else detections)
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


class TopicEventsBuilder:
    """Takes the messages of one topic, or whole bags of them, in log-time order."""

    def __init__(self) -> None:
        self._parts: list[IntervalPart] = []
        self._rows = 0
        self._builder: IntervalBuilder | None = None
        self._known: dict[str, KnownFlag] = {}
        self._toggles: list[Toggle] = []
        self._errors: dict[str, ReportedError] = {}
        self._left_out = 0
        self._undecodable = 0
        self._beyond = 0
        self._changes = StateChangesBuilder()

    def add_undecodable(self) -> None:
        """Takes the next message, which cannot be decoded."""
        self._undecodable += 1

    def add(self, time: Ns, state: State) -> None:
        """Takes the next message."""
        if self._builder is None:
            self._builder = IntervalBuilder(MAX_SEEN)
        self._builder.add(time, state.labels, state.scores)
        if state is EMPTY_STATE:  # as of most messages
            return
        self._beyond = max(self._beyond, state.beyond)
        for path, value in state.flags:
            self._add_flag(KnownFlag(path, time, value, value))
        for text in state.errors:
            self._add_error(ReportedError(text, time, time, 1))
        if state.levels or state.reports:
            self._changes.add(time, state.levels, state.reports)

    def add_empty(self, times: Sequence[Ns]) -> None:
        """Takes the next messages, as `add` does with `EMPTY_STATE` one by one."""
        if not times:
            return
        if self._builder is None:
            self._builder = IntervalBuilder(MAX_SEEN)
        self._builder.add_empty(times)

    def join(self, events: TopicEvents) -> None:
        """Takes all messages of a bag that come next, as if they were added one by one."""
        self._undecodable += events.undecodable
        if events.first > events.last:
            return
        self._close_part()
        self._take(IntervalPart(events.first, events.last, events.visible))
        if events.known:
            toggles = [
                Toggle(known.path, known.at, known.first)
                for known in events.known
                if self._is_toggled(known)
            ]
            for toggle in sorted([*toggles, *events.toggles], key=lambda toggle: toggle.time):
                self._add_toggle(toggle)
            for known in events.known:
                self._remember_flag(known)
        for error in events.errors:
            self._add_error(error)
        self._left_out += events.left_out
        self._beyond = max(self._beyond, events.beyond)
        if events.changes is not NO_CHANGES:
            self._changes.join(events.changes)

    def join_uneventful(self, first: Ns, last: Ns) -> None:
        """Takes all messages of a bag that come next and report nothing, by the times of two."""
        self._close_part()
        self._take(IntervalPart(first, last, _NOTHING_VISIBLE))

    def events(self, at_most: int | None = None) -> TopicEvents | None:
        """Returns the events so far, `at_most` of each kind; None without a message."""
        self._close_part()
        if not self._parts:
            return TopicEvents(1, 0, undecodable=self._undecodable) if self._undecodable else None
        first, last, visible = self._merge_parts()
        errors = sorted(self._errors.values(), key=lambda each: (each.first, each.text))
        counts = (visible.size, len(self._toggles), len(errors))
        left_out = 0 if at_most is None else sum(max(0, many - at_most) for many in counts)
        return TopicEvents(
            first,
            last,
            visible if at_most is None else visible.most_lasting(at_most),
            tuple(self._known.values()),
            tuple(self._toggles[:at_most]),
            tuple(errors[:at_most]),
            self._left_out + left_out,
            self._undecodable,
            self._beyond,
            self._changes.changes(at_most),
        )

    def _close_part(self) -> None:
        """Takes over what was added message by message."""
        part = None if self._builder is None else self._builder.part()
        if self._builder is not None and part is not None:
            self._left_out += self._builder.left_out
            self._builder = None
            self._take(part)

    def _take(self, part: IntervalPart) -> None:
        self._parts.append(part)
        self._rows += part.visible.size
        if self._rows > 2 * MAX_SEEN:
            self._merge_parts()

    def _merge_parts(self) -> IntervalPart:
        """Returns all parts as one, without more intervals than may be held."""
        part = self._parts[0] if len(self._parts) == 1 else joined(self._parts)
        visible = part.visible.most_lasting(MAX_SEEN)
        self._left_out += part.visible.size - visible.size
        self._parts, self._rows = [part._replace(visible=visible)], visible.size
        return self._parts[0]

    def _is_toggled(self, known: KnownFlag) -> bool:
        before = self._known.get(known.path)
        return before is not None and before.last != known.first

    def _add_flag(self, known: KnownFlag) -> None:
        if self._is_toggled(known):
            self._add_toggle(Toggle(known.path, known.at, known.first))
        self._remember_flag(known)

    def _remember_flag(self, known: KnownFlag) -> None:
        before = self._known.get(known.path)
        if before is None and len(self._known) >= MAX_HELD:
            self._left_out += 1
            return
        if before is None:
            self._known[known.path] = known
        elif before.last != known.last:
            self._known[known.path] = before._replace(last=known.last)

    def _add_toggle(self, toggle: Toggle) -> None:
        """Adds a toggle, or counts it where there are too many."""
        if len(self._toggles) < MAX_HELD:
            self._toggles.append(toggle)
        else:
            self._left_out += 1

    def _add_error(self, error: ReportedError) -> None:
        before = self._errors.get(error.text)
        if before is None and len(self._errors) >= MAX_HELD:
            self._left_out += 1
            return
        self._errors[error.text] = (
            error
            if before is None
            else before._replace(last=error.last, reports=before.reports + error.reports)
        )


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
