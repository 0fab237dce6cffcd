"""What messages state, as facts: of one message, and of many as columns.

A fact is of a kind, is about a name, and has a value: an object in view (with its score), a boolean
(0 or 1), the level of a diagnostic status, the status of a goal, how low a battery is, whether a
velocity is commanded; or it is a sentence: an error, or a log entry of WARN and above. The same
facts are read from whole tables in `columns.stated`.
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
"""Named by its dot-path."""
STATUS: Final = "status"
GOAL: Final = "goal"
"""Named by its id in hexadecimal digits."""
CHARGE: Final = "charge"
COMMAND: Final = "command"
ERROR: Final = "error"
REPORT: Final = "report"
STATES: Final = frozenset({FLAG, STATUS, GOAL, CHARGE, COMMAND})
"""Kinds whose values hold until another message says otherwise."""

MOST: Final = {LABEL: 256, FLAG: 512, STATUS: 512, GOAL: 512}
"""Facts of a kind in one message that are tracked; the rest is counted."""
LOW_CHARGES: Final = (0.2, 0.1, 0.05)
"""Fractions of a full battery; the value of its charge is how many of them it is below."""
_UNSURE_CHARGE: Final = 0.02
"""So little above such a fraction says nothing: the charge that a battery reports trembles."""

_PERCENT: Final = 100
FULL_CHARGE: Final = 1.05
"""Up to here a charge is a fraction, of a full battery that reports a little more."""
_WARN: Final = 30
_ERROR: Final = 40
_LOG_WORDS: Final = ((50, "fatal"), (_ERROR, "error"), (_WARN, "warning"))
_ERROR_STATUS: Final = 2
_STALE_STATUS: Final = 3
_STILL: Final = 1e-3
"""A commanded velocity (m/s, rad/s) below which it is zero: controllers publish -0.0 and 1e-17."""
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
"""NaN is the value of a sentence, and of a label without a score."""


class State(NamedTuple):
    """The facts of one message, and how many more it has than are tracked."""

    facts: tuple[Fact, ...] = ()
    beyond: int = 0


def has_events(type_name: str) -> bool:
    """Returns whether messages of a type can contain events."""
    return type_name == BATTERY or not type_name.startswith(_MEASUREMENT_PACKAGES)


def has_errors(type_name: str) -> bool:
    """Returns whether messages of a type can report errors."""
    return type_name in {LOG, DIAGNOSTICS}


def has_changes(type_name: str) -> bool:
    """Returns whether messages of a type can show what changed, besides booleans."""
    return type_name in _OF_TYPE


def state_of(value: JsonValue, type_name: str) -> State:
    """Returns what an extracted message of a type states."""
    facts: Iterator[Fact] = iter(())
    if type_name in _OF_TYPE:
        facts = _OF_TYPE[type_name](value)
    if has_events(type_name) and not has_errors(type_name):
        facts = chain(facts, _labels(value), _flags(value, ""))
    kept: list[Fact] = []
    counts: Counter[str] = Counter()
    for word, number in facts:
        counts[word.kind] += 1
        if counts[word.kind] <= MOST.get(word.kind, math.inf):
            kept.append((word, number))
    return State(tuple(kept), counts.total() - len(kept))


def charge_of(value: JsonValue) -> float | None:
    """Returns how full the battery of an extracted message is, 0 to 1; None if it is not known.

    That is where it is NaN or negative. Some drivers publish percent where the message asks for a
    fraction.
    """
    charge = value.get("percentage") if isinstance(value, dict) else None
    if not isinstance(charge, float) or not 0 <= charge <= _PERCENT:
        return None
    return charge / _PERCENT if charge > FULL_CHARGE else min(charge, 1.0)


def charge_levels(charges: Floats) -> Ints:
    """Returns below how many of `LOW_CHARGES` each charge is; -1 where that is not known."""
    with np.errstate(invalid="ignore"):
        part = np.where(charges > FULL_CHARGE, charges / _PERCENT, charges)
        levels = np.sum([part < least for least in LOW_CHARGES], axis=0, dtype=np.int64)
        surely = np.sum([part < least + _UNSURE_CHARGE for least in LOW_CHARGES], axis=0)
        is_known = (charges >= 0) & (charges <= _PERCENT) & (levels == surely)
        return np.where(is_known, levels, -1)


def is_still(numbers: Floats, error: float = 0.0) -> Flags:
    """Returns which numbers of a command are zero even if they are off by `error`."""
    with np.errstate(invalid="ignore"):
        return np.abs(numbers) + error < _STILL


def _labels(value: JsonValue) -> Iterator[Fact]:
    """Yields the labels of detections, in order, with the best score of each."""
    best: dict[str, float] = {}
    for detection in detections_of(value):
        score = math.nan if detection.score is None else detection.score
        best_so_far = best.get(detection.label, math.nan)
        best[detection.label] = (
            score if math.isnan(best_so_far) or score > best_so_far else best_so_far
        )
    return ((Word(LABEL, label), score) for label, score in best.items())


def _flags(value: JsonValue, path: str) -> Iterator[Fact]:
    """Yields the booleans of an object and of nested objects; none of lists."""
    if isinstance(value, bool):
        yield Word(FLAG, path), value
    elif isinstance(value, dict):
        for name, inner in value.items():
            yield from _flags(inner, f"{path}.{name}" if path else name)


def _log_entry(value: JsonValue) -> Iterator[Fact]:
    """Yields an entry as an error, and with how bad it is as a report."""
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
    """Returns an error as a sentence: who reports it, and what."""
    text = ": ".join(part for part in parts if isinstance(part, str) and part)
    return Word(ERROR, shortened(text, _MAX_ERROR_CHARS))


def _goals(value: JsonValue) -> Iterator[Fact]:
    for goal in _entries(value, "status_list"):
        status, info = goal.get("status"), goal.get("goal_info")
        goal_id = info.get("goal_id") if isinstance(info, dict) else None
        uuid = goal_id.get("uuid") if isinstance(goal_id, dict) else None
        if isinstance(status, int) and isinstance(uuid, list):
            parts = (part for part in uuid if isinstance(part, int))
            yield Word(GOAL, "".join(f"{part:02x}" for part in parts)), status


def _entries(value: JsonValue, key: str) -> Iterator[JsonObject]:
    listed = value.get(key) if isinstance(value, dict) else None
    for entry in listed if isinstance(listed, list) else ():
        if isinstance(entry, dict):
            yield entry


def _charge(value: JsonValue) -> Iterator[Fact]:
    charge = charge_of(value)
    level = -1 if charge is None else int(charge_levels(np.array([charge]))[0])
    if level >= 0:
        yield Word(CHARGE), level


def _command(value: JsonValue) -> Iterator[Fact]:
    yield Word(COMMAND), not all(abs(number) < _STILL for number in _floats(value))


def _floats(value: JsonValue) -> Iterator[float]:
    """Yields the floats of a value; what is no number counts as one that is not zero."""
    if isinstance(value, dict):
        for inner in value.values():
            yield from _floats(inner)
    elif isinstance(value, float):
        yield value
    elif value is None:
        yield math.nan


_OF_TYPE: Final = {
    LOG: _log_entry,
    DIAGNOSTICS: _diagnostics,
    GOALS: _goals,
    BATTERY: _charge,
    **dict.fromkeys(VELOCITIES, _command),
}


class Facts(NamedTuple):
    """Facts of many messages, by message, and in a message in its order.

    Attributes:
        rows: the message of each, ascending.
        codes: what it is about, by the place in `words`.
        values: see `Fact`.
        words: each once.
    """

    rows: Ints
    codes: Ints
    values: Floats
    words: Sequence[Word]

    @classmethod
    def of(cls, facts: Sequence[tuple[int, Fact]]) -> Facts:
        """Returns facts, each given with its row."""
        words, codes = numbered(word for _, (word, _) in facts)
        values = np.array([value for _, (_, value) in facts], np.float64)
        return cls(np.array([row for row, _ in facts], np.int64), codes, values, words)

    def of_kinds(self, kinds: Collection[str]) -> Facts:
        """Returns those of some kinds."""
        wanted = np.array([word.kind in kinds for word in self.words], np.bool_)
        return self if wanted.all() else self._where(wanted[self.codes])

    def at(self, rows: Ints) -> Facts:
        """Returns those of some messages, which ascend and become the messages 0, 1, 2, ..."""
        place, is_among = places_among(self.rows, rows)
        return self._replace(rows=place)._where(is_among)

    def _where(self, kept: Flags) -> Facts:
        return Facts(self.rows[kept], self.codes[kept], self.values[kept], self.words)


NOTHING: Final = Facts.of(())


def joined_facts(parts: Sequence[Facts]) -> Facts:
    """Returns the facts of all parts, by their messages."""
    parts = [part for part in parts if part.rows.size]
    if len(parts) <= 1:
        return parts[0] if parts else NOTHING
    codes, words = joined_codes((part.codes, part.words) for part in parts)
    rows = np.concatenate([part.rows for part in parts])
    order = np.argsort(rows, kind="stable")
    values = np.concatenate([part.values for part in parts])
    return Facts(rows[order], codes[order], values[order], words)


class Stated(NamedTuple):
    """What messages of a topic state, in the order of their log times.

    Attributes:
        times: log times of the messages that can be decoded.
        facts: of these.
        undecodable: log times of the others.
        beyond: facts of one message that are not tracked, at most.
    """

    times: Ints
    facts: Facts = NOTHING
    undecodable: Ints = np.empty(0, np.int64)
    beyond: int = 0

    def at(self, rows: Ints) -> Stated:
        """Returns what some of the messages that can be decoded state."""
        return self._replace(times=self.times[rows], facts=self.facts.at(rows))


def stated_by(times: Sequence[Ns], states: Sequence[State | None]) -> Stated:
    """Returns what messages state, one by one; None is one that cannot be decoded."""
    decodable = [state for state in states if state is not None]
    decoded = np.array([state is not None for state in states], np.bool_)
    all_times = np.array(times, np.int64)
    return Stated(
        all_times[decoded],
        Facts.of([(row, fact) for row, state in enumerate(decodable) for fact in state.facts]),
        all_times[~decoded],
        max((state.beyond for state in decodable), default=0),
    )


def joined_stated(parts: Sequence[Stated]) -> Stated:
    """Returns what the messages of all parts state, which may overlap in time."""
    if len(parts) == 1:
        return parts[0]
    times, _, places = merged_times([part.times for part in parts])
    moved = [
        part.facts._replace(rows=place[part.facts.rows])
        for place, part in zip(places, parts, strict=True)
    ]
    return Stated(
        times,
        joined_facts(moved),
        np.sort(np.concatenate([part.undecodable for part in parts])),
        max(part.beyond for part in parts),
    )
