"""State that changes on a topic, for what happened before an event.

Levels are small integers by name: of each diagnostic status, of each goal of an action, how low a
battery is, and whether a velocity is commanded. Log entries of WARN and above are reports.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.core.text import shortened
from ros2_memory.core.timebase import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import NDArray

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
MAX_LEVELS: Final = 512
"""Levels in one message that are tracked; the rest is left out."""
_MAX_HELD: Final = 20_000
"""Levels, or booleans, of a topic in all bags together."""
_MAX_CHARS: Final = 120
REPEATED_NS: Final = 2 * NS_PER_S
"""A log entry that follows its like sooner is the same report."""
_DIGITS: Final = re.compile(r"\d+")


class StateLevel(NamedTuple):
    """A level reported in one message; `text` describes it."""

    name: str
    value: int
    text: str = ""


class Held(NamedTuple):
    """A level or a boolean: its value in the first message that has it, and in the last."""

    name: str
    at: Ns
    first: int
    last: int
    text: str = ""


class Change(NamedTuple):
    """A level or a boolean that is `value` from `time` on, and was another before."""

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
    """The changes of state on one topic in some time, to be joined with those before and after.

    Attributes:
        known: each level's value at either end.
        changes: in order of time.
        reports: by the time of the first of each.
        left_out: levels, changes and reports beyond what is held: the earliest are.
    """

    known: tuple[Held, ...] = ()
    changes: tuple[Change, ...] = ()
    reports: tuple[Report, ...] = ()
    left_out: int = 0

    @property
    def is_empty(self) -> bool:
        """Whether no message has a level or a report."""
        return not (self.known or self.reports or self.left_out)


NO_CHANGES: Final = StateChanges()


def joined_held(
    parts: Iterable[tuple[Sequence[Held], Sequence[Change]]],
) -> tuple[tuple[Held, ...], list[Change], int]:
    """Returns what was held in times that follow each other, and the changes in and between them.

    The changes are in order of time, part by part. With them how much more was held than is kept.
    """
    known: dict[str, Held] = {}
    found: list[Change] = []
    left_out = 0
    for held, changes in parts:
        between = [
            Change(each.name, each.at, each.first, each.text)
            for each in held
            if each.name in known and known[each.name].last != each.first
        ]
        found += sorted([*between, *changes], key=lambda change: change.time)
        for each in held:
            before = known.get(each.name)
            if before is None and len(known) >= _MAX_HELD:
                left_out += 1
            else:
                known[each.name] = each if before is None else before._replace(last=each.last)
    return tuple(known.values()), found, left_out


def joined_reports(reports: Iterable[Report]) -> list[Report]:
    """Returns reports in order, each joined to the newest one like it, where that is recent."""
    found: list[Report] = []
    newest: dict[str, int] = {}
    for report in reports:
        alike = like(report.text)
        nth = newest.get(alike)
        if nth is not None and report.first - found[nth].last <= REPEATED_NS:
            before = found[nth]
            found[nth] = before._replace(last=report.last, reports=before.reports + report.reports)
        else:
            newest[alike] = len(found)
            found.append(report)
    return found


def charge_levels(charges: NDArray[np.float64]) -> NDArray[np.int64]:
    """Returns the level of each charge of a battery; -1 where it is not known."""
    with np.errstate(invalid="ignore"):
        part = np.where(charges > 1, charges / _PERCENT, charges)
        levels = np.sum([part < least for least in LOW_CHARGES], axis=0, dtype=np.int64)
        return np.where((charges >= 0) & (charges <= _PERCENT), levels, -1)


def is_still(numbers: NDArray[np.float64], error: float = 0.0) -> NDArray[np.bool_]:
    """Returns which numbers of a command are zero even if they are off by `error`."""
    with np.errstate(invalid="ignore"):
        return np.abs(numbers) + error < _STILL


def has_levels(type_name: str) -> bool:
    """Returns whether messages of a type can contain levels."""
    return type_name in {DIAGNOSTICS, GOALS, BATTERY} or type_name in VELOCITIES


def levels_of(value: JsonValue, type_name: str) -> tuple[StateLevel, ...]:
    """Returns the levels in an extracted message of a type."""
    if type_name == DIAGNOSTICS:
        return tuple(_statuses(value))[: MAX_LEVELS + 1]
    if type_name == GOALS:
        return tuple(_goals(value))[: MAX_LEVELS + 1]
    if type_name == BATTERY:
        charge = charge_of(value)
        return () if charge is None else _charge(charge)
    if type_name in VELOCITIES:
        return _command(_floats(value))
    return ()


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


def like(report: str) -> str:
    """Returns what is equal for reports that differ in their numbers alone."""
    return _DIGITS.sub("#", report)


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
