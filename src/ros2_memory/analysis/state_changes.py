"""State that changes on a topic, for what happened before an event.

Levels are small integers by name: of each diagnostic status, of each goal of an action, how low a
battery is, and whether a velocity is commanded. Log entries of WARN and above are reports. Both are
collected message by message or by whole bags; where a history is cut into bags changes nothing, as
long as nothing is left out for being too much.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.core.text import shortened
from ros2_memory.core.timebase import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from ros2_memory.core.model import JsonValue
    from ros2_memory.core.timebase import Ns

LOG: Final = "rcl_interfaces/msg/Log"
DIAGNOSTICS: Final = "diagnostic_msgs/msg/DiagnosticArray"
GOALS: Final = "action_msgs/msg/GoalStatusArray"
BATTERY: Final = "sensor_msgs/msg/BatteryState"
VELOCITIES: Final = frozenset({"geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"})

STATUS: Final = "status "
GOAL: Final = "goal "
CHARGE: Final = "charge"
COMMAND: Final = "command"
"""Names of levels: of a diagnostic status and a goal, what follows is its own name."""

ACTIVE_GOAL: Final = frozenset({1, 2, 3})
"""Accepted, executing, canceling (action_msgs/msg/GoalStatus)."""
LOW_CHARGES: Final = (0.2, 0.1, 0.05)
"""Fractions of a full battery; the level of its charge is how many of them it is below."""

_PERCENTAGE: Final = "percentage"
_PERCENT: Final = 100
_WARN: Final = 30
_LOG_WORDS: Final = ((50, "fatal"), (40, "error"), (_WARN, "warning"))
_STILL: Final = 1e-3
"""A commanded velocity (m/s, rad/s) below which it is zero: controllers publish -0.0 and 1e-17."""
_MAX_LEVELS: Final = 512
"""Levels in one message that are tracked; the rest is left out."""
_MAX_HELD: Final = 20_000
"""Levels, changes and reports of a topic in all bags together."""
_MAX_CHARS: Final = 120
_REPEATED_NS: Final = 2 * NS_PER_S
"""A log entry that follows its like sooner is the same report."""
_DIGITS: Final = re.compile(r"\d+")


class StateLevel(NamedTuple):
    """A level reported in one message; `text` describes it."""

    name: str
    value: int
    text: str = ""


class KnownLevel(NamedTuple):
    """A level at the first message of a bag that has it, and at the last."""

    name: str
    at: Ns
    first: int
    last: int
    text: str = ""


class LevelChange(NamedTuple):
    """A level that is `value` from `time` on, and was another before."""

    name: str
    time: Ns
    value: int
    text: str = ""


class Report(NamedTuple):
    """Log entries alike but for their numbers, and the log times of the first and last of them."""

    text: str
    first: Ns
    last: Ns
    reports: int


@dataclass(frozen=True, slots=True)
class StateChanges:
    """The changes of state on one topic in one bag, to be joined with those before and after.

    Attributes:
        known: each level's value at either end.
        changes: in order of time.
        reports: by the time of the first of each.
        left_out: levels, changes and reports beyond what is stored: the earliest are.
    """

    known: tuple[KnownLevel, ...] = ()
    changes: tuple[LevelChange, ...] = ()
    reports: tuple[Report, ...] = ()
    left_out: int = 0

    @property
    def is_empty(self) -> bool:
        """Whether no message has a level or a report."""
        return not (self.known or self.reports or self.left_out)


NO_CHANGES: Final = StateChanges()


def has_levels(type_name: str) -> bool:
    """Returns whether messages of a type can contain levels."""
    return type_name in {DIAGNOSTICS, GOALS, BATTERY} or type_name in VELOCITIES


def levels_of(value: JsonValue, type_name: str) -> tuple[StateLevel, ...]:
    """Returns the levels in an extracted message of a type."""
    if type_name == DIAGNOSTICS:
        return tuple(_statuses(value))[: _MAX_LEVELS + 1]
    if type_name == GOALS:
        return tuple(_goals(value))[: _MAX_LEVELS + 1]
    if type_name == BATTERY:
        charge = charge_of(value)
        return () if charge is None else _charge(charge)
    if type_name in VELOCITIES:
        return _command(_floats(value))
    return ()


def follow_numbers(type_name: str) -> bool:
    """Returns whether the levels of messages of a type depend on floats in them."""
    return type_name == BATTERY or type_name in VELOCITIES


def levels_by_number(
    type_name: str, names: Sequence[str], rows: Iterable[Sequence[float]]
) -> Iterator[tuple[StateLevel, ...]]:
    """Yields the levels of messages that differ by their floats alone.

    A row has the floats of one message, `names` are those of their fields.
    """
    if type_name in VELOCITIES:
        yield from map(_command, rows)
        return
    column = names.index(_PERCENTAGE) if _PERCENTAGE in names else None
    for row in rows:
        yield () if column is None else _charge(row[column])


def reports_of(value: JsonValue, type_name: str) -> tuple[str, ...]:
    """Returns a log entry of WARN and above as a sentence: how bad it is, who reports it, what."""
    if type_name != LOG or not isinstance(value, dict):
        return ()
    level, name, message = value.get("level"), value.get("name"), value.get("msg")
    if not isinstance(level, int) or level < _WARN:
        return ()
    word = next(word for least, word in _LOG_WORDS if level >= least)
    who = f"{word} of {name}" if isinstance(name, str) and name else word
    return (shortened(f"{who}: {message}" if isinstance(message, str) else who, _MAX_CHARS),)


class StateChangesBuilder:
    """Takes the levels and reports of one topic, or whole bags of them, in log-time order."""

    def __init__(self) -> None:
        self._known: dict[str, KnownLevel] = {}
        self._changes: list[LevelChange] = []
        self._reports: list[Report] = []
        self._newest: dict[str, int] = {}
        self._left_out = 0

    def add(self, time: Ns, levels: Sequence[StateLevel], reports: Sequence[str]) -> None:
        """Takes the next message."""
        for name, value, text in levels[:_MAX_LEVELS]:
            self._add_level(KnownLevel(name, time, value, value, text))
        self._left_out += len(levels[_MAX_LEVELS:])
        for text in reports:
            self._add_report(Report(text, time, time, 1))

    def join(self, bag: StateChanges) -> None:
        """Takes all messages of a bag that come next, as if they were added one by one."""
        inside = [
            LevelChange(known.name, known.at, known.first, known.text)
            for known in bag.known
            if self._is_changed(known)
        ]
        for change in sorted([*inside, *bag.changes], key=lambda each: each.time):
            self._add_change(change)
        for known in bag.known:
            self._remember(known)
        for report in bag.reports:
            self._add_report(report)
        self._left_out += bag.left_out

    def changes(self, at_most: int | None = None) -> StateChanges:
        """Returns the changes so far, `at_most` of each kind."""
        if not (self._known or self._reports or self._left_out):
            return NO_CHANGES
        counts = (len(self._changes), len(self._reports))
        left_out = 0 if at_most is None else sum(max(0, many - at_most) for many in counts)
        return StateChanges(
            tuple(self._known.values()),
            tuple(self._changes[:at_most]),
            tuple(self._reports[:at_most]),
            self._left_out + left_out,
        )

    def _is_changed(self, known: KnownLevel) -> bool:
        before = self._known.get(known.name)
        return before is not None and before.last != known.first

    def _add_level(self, known: KnownLevel) -> None:
        if self._is_changed(known):
            self._add_change(LevelChange(known.name, known.at, known.first, known.text))
        self._remember(known)

    def _remember(self, known: KnownLevel) -> None:
        before = self._known.get(known.name)
        if before is None and len(self._known) >= _MAX_HELD:
            self._left_out += 1
            return
        self._known[known.name] = known if before is None else before._replace(last=known.last)

    def _add_change(self, change: LevelChange) -> None:
        if len(self._changes) < _MAX_HELD:
            self._changes.append(change)
        else:
            self._left_out += 1

    def _add_report(self, report: Report) -> None:
        """Adds a report to the newest like it, where that is recent, or else as another."""
        like = _DIGITS.sub("#", report.text)
        nth = self._newest.get(like)
        if nth is not None and report.first - self._reports[nth].last <= _REPEATED_NS:
            before = self._reports[nth]
            self._reports[nth] = before._replace(
                last=report.last, reports=before.reports + report.reports
            )
        elif len(self._reports) < _MAX_HELD:
            self._newest[like] = len(self._reports)
            self._reports.append(report)
        else:
            self._left_out += 1


def _statuses(value: JsonValue) -> Iterator[StateLevel]:
    listed = value.get("status") if isinstance(value, dict) else None
    for each in listed if isinstance(listed, list) else ():
        if not isinstance(each, dict):
            continue
        name, level, message = each.get("name"), each.get("level"), each.get("message")
        if isinstance(name, str) and isinstance(level, int):
            text = message if level and isinstance(message, str) else ""
            yield StateLevel(
                STATUS + shortened(name, _MAX_CHARS), level, shortened(text, _MAX_CHARS)
            )


def _goals(value: JsonValue) -> Iterator[StateLevel]:
    listed = value.get("status_list") if isinstance(value, dict) else None
    for each in listed if isinstance(listed, list) else ():
        status = each.get("status") if isinstance(each, dict) else None
        info = each.get("goal_info") if isinstance(each, dict) else None
        goal_id = info.get("goal_id") if isinstance(info, dict) else None
        uuid = goal_id.get("uuid") if isinstance(goal_id, dict) else None
        if isinstance(status, int) and isinstance(uuid, list):
            parts = (part for part in uuid if isinstance(part, int))
            yield StateLevel(GOAL + "".join(f"{part:02x}" for part in parts), status)


def charge_of(value: JsonValue) -> float | None:
    """Returns how full the battery of an extracted message is, 0 to 1; None if it is not known."""
    charge = value.get(_PERCENTAGE) if isinstance(value, dict) else None
    return _fraction(charge) if isinstance(charge, float) else None


def _fraction(charge: float) -> float | None:
    """Returns a charge from 0 to 1; None for NaN and what is negative, which mean unknown.

    Some drivers publish percent where the message asks for a fraction.
    """
    if not 0 <= charge <= _PERCENT:
        return None
    return charge / _PERCENT if charge > 1 else charge


def _charge(charge: float) -> tuple[StateLevel, ...]:
    part = _fraction(charge)
    if part is None:
        return ()
    return (StateLevel(CHARGE, sum(part < least for least in LOW_CHARGES)),)


def _command(numbers: Iterable[float]) -> tuple[StateLevel, ...]:
    return (StateLevel(COMMAND, int(not all(abs(number) < _STILL for number in numbers))),)


def _floats(value: JsonValue) -> Iterator[float]:
    """Yields the floats of a value; what is no number counts as one that is not zero."""
    if isinstance(value, dict):
        for inner in value.values():
            yield from _floats(inner)
    elif isinstance(value, float):
        yield value
    elif value is None:
        yield math.nan
