"""What messages state, as facts: of one message, and of many as columns.

A fact has a kind, a name and a value. It is an object in view (with its score), a boolean (0 or 1),
the level of a diagnostic status, the status of a goal, how low a battery is, or whether a velocity
is commanded. Or it is a sentence: an error, or a log entry of WARN and above. `columns.stated`
reads the same facts from whole tables.
"""

from __future__ import annotations

import math
from collections import Counter
from itertools import chain
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.core.arrays import (
    Flags,
    Floats,
    Ints,
    joined_codes,
    merged_times,
    numbered,
    places_among,
    stable_order,
)
from ros2_memory.core.text import shortened
from ros2_memory.messages.detections import detections_of

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from ros2_memory.core.model import JsonValue
    from ros2_memory.core.reply import JsonObject
    from ros2_memory.core.timebase import Ns

LOG: Final = "rcl_interfaces/msg/Log"
DIAGNOSTICS: Final = "diagnostic_msgs/msg/DiagnosticArray"
GOALS: Final = "action_msgs/msg/GoalStatusArray"
BATTERY: Final = "sensor_msgs/msg/BatteryState"
VELOCITIES: Final = frozenset({"geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"})

LABEL: Final = "label"
FLAG: Final = "flag"
"""Its name is its dot-path."""
STATUS: Final = "status"
GOAL: Final = "goal"
"""Its name is its id in hexadecimal digits."""
CHARGE: Final = "charge"
COMMAND: Final = "command"
ERROR: Final = "error"
REPORT: Final = "report"
STATES: Final = frozenset({FLAG, STATUS, GOAL, CHARGE, COMMAND})
"""Kinds whose values hold until another message says otherwise."""

MOST: Final = {LABEL: 256, FLAG: 512, STATUS: 512, GOAL: 512}
"""How many facts of a kind in one message are tracked; the rest is counted."""
LOW_CHARGES: Final = (0.2, 0.1, 0.05)
"""Fractions of a full battery. The value of a charge is how many of them it is below."""
_UNSURE_CHARGE: Final = 0.02
"""A charge less than this above a fraction is not known: what a battery reports trembles."""

_PERCENT: Final = 100
FULL_CHARGE: Final = 1.05
"""A charge up to this is a fraction (a full battery may report a little more than 1), else percent.
"""
_WARN: Final = 30
_ERROR: Final = 40
_LOG_WORDS: Final = ((50, "fatal"), (_ERROR, "error"), (_WARN, "warning"))
_ERROR_STATUS: Final = 2
_STALE_STATUS: Final = 3
_STILL: Final = 1e-3
"""A commanded velocity (m/s, rad/s) below this is zero: controllers publish -0.0 and 1e-17."""
_MAX_CHARS: Final = 120
_MAX_ERROR_CHARS: Final = 160
_MEASUREMENT_PACKAGES: Final = ("geometry_msgs/", "nav_msgs/", "sensor_msgs/", "tf2_msgs/")
"""Packages whose messages are measurements: they contain no events."""


class Word(NamedTuple):
    """What a fact is about; `text` describes its value."""

    kind: str
    name: str = ""
    text: str = ""


Fact: TypeAlias = tuple[Word, float]
"""What a fact is about, and its value; NaN for a sentence, and for a label without a score."""


class State(NamedTuple):
    """The tracked facts of one message, and how many more it has."""

    facts: tuple[Fact, ...] = ()
    beyond: int = 0


def has_events(type_name: str) -> bool:
    """Returns whether messages of a type can contain events."""
    return type_name == BATTERY or not type_name.startswith(_MEASUREMENT_PACKAGES)


def has_errors(type_name: str) -> bool:
    """Returns whether messages of a type can report errors."""
    return type_name in {LOG, DIAGNOSTICS}


def has_changes(type_name: str) -> bool:
    """Returns whether messages of a type have states other than booleans and labels."""
    return type_name in _FACTS_OF_TYPE


def state_of(value: JsonValue, type_name: str) -> State:
    """Returns the facts of an extracted message of a type."""
    facts: Iterator[Fact] = iter(())
    if type_name in _FACTS_OF_TYPE:
        facts = _FACTS_OF_TYPE[type_name](value)
    if has_events(type_name) and not has_errors(type_name):
        facts = chain(facts, _labels(value), _flags(value, ""))
    tracked: list[Fact] = []
    counts: Counter[str] = Counter()
    for word, number in facts:
        counts[word.kind] += 1
        if counts[word.kind] <= MOST.get(word.kind, math.inf):
            tracked.append((word, number))
    return State(tuple(tracked), counts.total() - len(tracked))


def source_of(value: JsonValue, type_name: str) -> str:
    """Returns which of several sources of a topic an extracted message is from; empty if unknown.

    For diagnostics that is the node, by the first status; for a battery, its location.
    """
    names: list[JsonValue] = []
    if type_name == DIAGNOSTICS:
        names = [status.get("name") for status in _entries(value, "status")]
    elif type_name == BATTERY and isinstance(value, dict):
        names = [value.get("location")]
    return shortened(next((name for name in names if isinstance(name, str)), ""), _MAX_CHARS)


def battery_of(topic: str, location: str) -> str:
    """Returns the name of a battery, by its `source_of`."""
    return f"{topic} ({location})" if location else topic


def charge_of(value: JsonValue) -> float | None:
    """Returns how full the battery of an extracted message is, 0 to 1.

    None if the message says NaN or a negative number. Some drivers publish percent, although the
    message definition asks for a fraction.
    """
    charge = value.get("percentage") if isinstance(value, dict) else None
    if not isinstance(charge, float) or not 0 <= charge <= _PERCENT:
        return None
    return charge / _PERCENT if charge > FULL_CHARGE else min(charge, 1.0)


def charge_levels(charges: Floats) -> Ints:
    """Returns how many of `LOW_CHARGES` each charge is below; -1 if that is not known."""
    with np.errstate(invalid="ignore"):
        fractions = np.where(charges > FULL_CHARGE, charges / _PERCENT, charges)
        levels = np.sum([fractions < low for low in LOW_CHARGES], axis=0, dtype=np.int64)
        unsure = np.sum([fractions < low + _UNSURE_CHARGE for low in LOW_CHARGES], axis=0)
        is_known = (charges >= 0) & (charges <= _PERCENT) & (levels == unsure)
        return np.where(is_known, levels, -1)


def is_still(numbers: Floats, error: float = 0.0) -> Flags:
    """Returns which numbers of a command count as zero, even if they are off by `error`."""
    with np.errstate(invalid="ignore"):
        return np.abs(numbers) + error < _STILL


def _labels(value: JsonValue) -> Iterator[Fact]:
    """Yields the labels of detections, in order, with the best score of each."""
    best: dict[str, float] = {}
    for detection in detections_of(value):
        score = math.nan if detection.score is None else detection.score
        known = best.setdefault(detection.label, score)
        if math.isnan(known) or score > known:
            best[detection.label] = score
    for label, score in best.items():
        yield Word(LABEL, label), score


def _flags(value: JsonValue, path: str) -> Iterator[Fact]:
    """Yields the booleans of an object and of the objects in it, but not in lists."""
    if isinstance(value, bool):
        yield Word(FLAG, path), value
    elif isinstance(value, dict):
        for name, inner in value.items():
            yield from _flags(inner, f"{path}.{name}" if path else name)


def _log_entry(value: JsonValue) -> Iterator[Fact]:
    """Yields a log entry of WARN and above as a report, and one of ERROR and above as an error."""
    if not isinstance(value, dict):
        return
    level, name, message = value.get("level"), value.get("name"), value.get("msg")
    if not isinstance(level, int) or level < _WARN:
        return
    if level >= _ERROR:
        yield _error(name, message), math.nan
    word = next(word for least, word in _LOG_WORDS if level >= least)
    who = f"{word} of {name}" if isinstance(name, str) and name else word
    text = f"{who}: {message}" if isinstance(message, str) else who
    yield Word(REPORT, shortened(text, _MAX_CHARS)), math.nan


def _diagnostics(value: JsonValue) -> Iterator[Fact]:
    """Yields the level of each status in a `DiagnosticArray`, and its message if it is an error."""
    for status in _entries(value, "status"):
        name, level, message = status.get("name"), status.get("level"), status.get("message")
        if not isinstance(level, int):
            continue
        if isinstance(name, str):
            text = message if level and isinstance(message, str) else ""
            word = Word(STATUS, shortened(name, _MAX_CHARS), shortened(text, _MAX_CHARS))
            yield word, level
        if level >= _ERROR_STATUS and level != _STALE_STATUS:
            yield _error(name, message), math.nan


def _error(*parts: JsonValue) -> Word:
    """Returns an error as a sentence: the name of who reports it, and the message."""
    text = ": ".join(part for part in parts if isinstance(part, str) and part)
    return Word(ERROR, shortened(text, _MAX_ERROR_CHARS))


def _goals(value: JsonValue) -> Iterator[Fact]:
    """Yields the status of each goal in a `GoalStatusArray`, by the goal's id."""
    for goal in _entries(value, "status_list"):
        status, info = goal.get("status"), goal.get("goal_info")
        goal_id = info.get("goal_id") if isinstance(info, dict) else None
        uuid = goal_id.get("uuid") if isinstance(goal_id, dict) else None
        if isinstance(status, int) and isinstance(uuid, list):
            parts = (part for part in uuid if isinstance(part, int))
            yield Word(GOAL, "".join(f"{part:02x}" for part in parts)), status


def _entries(value: JsonValue, key: str) -> Iterator[JsonObject]:
    """Yields the objects in the list under a key."""
    listed = value.get(key) if isinstance(value, dict) else None
    for entry in listed if isinstance(listed, list) else ():
        if isinstance(entry, dict):
            yield entry


def _charge(value: JsonValue) -> Iterator[Fact]:
    charge = charge_of(value)
    level = -1 if charge is None else int(charge_levels(np.array([charge]))[0])
    if level >= 0:
        yield Word(CHARGE, source_of(value, BATTERY)), level


def _command(value: JsonValue) -> Iterator[Fact]:
    yield Word(COMMAND), not all(abs(number) < _STILL for number in _floats(value))


def _floats(value: JsonValue) -> Iterator[float]:
    """Yields the floats of a value; a null, which was NaN, as NaN."""
    if isinstance(value, dict):
        for inner in value.values():
            yield from _floats(inner)
    elif isinstance(value, float):
        yield value
    elif value is None:
        yield math.nan


_FACTS_OF_TYPE: Final = {
    LOG: _log_entry,
    DIAGNOSTICS: _diagnostics,
    GOALS: _goals,
    BATTERY: _charge,
    **dict.fromkeys(VELOCITIES, _command),
}


class Facts(NamedTuple):
    """Facts of many messages, in order of the messages.

    Attributes:
        rows: for each fact, the index of its message, ascending.
        codes: for each fact, the index of its word.
        values: for each fact, its value (see `Fact`).
        words: what facts are about, each once.
    """

    rows: Ints
    codes: Ints
    values: Floats
    words: Sequence[Word]

    @classmethod
    def of(cls, facts: Sequence[tuple[int, Fact]]) -> Facts:
        """Returns facts as arrays; each comes with the index of its message."""
        words, codes = numbered(word for _, (word, _) in facts)
        values = np.array([value for _, (_, value) in facts], np.float64)
        return cls(np.array([row for row, _ in facts], np.int64), codes, values, words)

    def of_kinds(self, kinds: Collection[str]) -> Facts:
        """Returns the facts of these kinds."""
        is_wanted = np.array([word.kind in kinds for word in self.words], np.bool_)
        return self if is_wanted.all() else self._select(is_wanted[self.codes])

    def at(self, rows: Ints) -> Facts:
        """Returns the facts of the messages `rows` (ascending), which become messages 0, 1, ..."""
        place, is_among = places_among(self.rows, rows)
        return self._replace(rows=place)._select(is_among)

    def _select(self, which: Flags) -> Facts:
        return Facts(self.rows[which], self.codes[which], self.values[which], self.words)


NOTHING: Final = Facts.of(())


def joined_facts(parts: Sequence[Facts]) -> Facts:
    """Returns the facts of all parts, whose messages are numbered alike, by message."""
    parts = [part for part in parts if part.rows.size]
    if len(parts) <= 1:
        return parts[0] if parts else NOTHING
    codes, words = joined_codes((part.codes, part.words) for part in parts)
    rows = np.concatenate([part.rows for part in parts])
    order = stable_order(rows)
    values = np.concatenate([part.values for part in parts])
    return Facts(rows[order], codes[order], values[order], words)


class Stated(NamedTuple):
    """What messages of a topic state, in the order of their log times.

    Attributes:
        times: log times of the messages that can be decoded.
        facts: the facts of these messages.
        undecodable: log times of the other messages.
        beyond: the most facts of one message that are not tracked.
    """

    times: Ints
    facts: Facts = NOTHING
    undecodable: Ints = np.empty(0, np.int64)
    beyond: int = 0

    def at(self, rows: Ints) -> Stated:
        """Returns what decodable messages state, by their indices."""
        return self._replace(times=self.times[rows], facts=self.facts.at(rows))


def stated_by(times: Sequence[Ns], states: Sequence[State | None]) -> Stated:
    """Returns what messages state, by their log times and states; None if one is not decodable."""
    decodable = [state for state in states if state is not None]
    is_decodable = np.array([state is not None for state in states], np.bool_)
    all_times = np.array(times, np.int64)
    return Stated(
        all_times[is_decodable],
        Facts.of([(row, fact) for row, state in enumerate(decodable) for fact in state.facts]),
        all_times[~is_decodable],
        max((state.beyond for state in decodable), default=0),
    )


def joined_stated(parts: Sequence[Stated]) -> Stated:
    """Returns what the messages of all parts state; parts may overlap in time."""
    if len(parts) == 1:
        return parts[0]
    times, _, places = merged_times([part.times for part in parts])
    renumbered = [
        part.facts._replace(rows=place[part.facts.rows])
        for place, part in zip(places, parts, strict=True)
    ]
    return Stated(
        times,
        joined_facts(renumbered),
        np.sort(np.concatenate([part.undecodable for part in parts])),
        max(part.beyond for part in parts),
    )
