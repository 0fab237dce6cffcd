"""What numbers the fields of a topic held: how many, between which bounds, and their sum.

A field is a dot-path in the extracted value. Over a list it goes on in every element, so
`detections.score` holds the scores of all detections; indices and keys that look like one are no
part of it. Ranges never leave out a number, so they rule conditions out; where they are exact they
answer what the mean is, and which bags have to be read for the least number of many.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.core.timebase import unix_from_ns

if TYPE_CHECKING:
    from ros2_memory.analysis.payload_templates import Bytes, PayloadTemplate
    from ros2_memory.core.model import JsonValue

MAX_FIELDS: Final = 48
"""Fields of one topic of which ranges are kept; where there are more, none are."""
_MOST_WAITING: Final = 4_096
"""Numbers of single messages that are held before their bounds are taken."""
_SUMMARY: Final = frozenset({"bytes", "numbers"})
"""The keys of a summary in place of numbers that are too many to show."""


class FieldRange(NamedTuple):
    """The numbers of one field in some messages.

    Attributes:
        low: none is less.
        high: none is greater.
        size: how many there are; None where only the bounds are known.
        total: their sum; 0 where only the bounds are known.
        each: how many every single message has; 0 where that differs, or is not known.
    """

    low: float
    high: float
    size: int | None = None
    total: float = 0.0
    each: int = 0


ANYTHING: Final = FieldRange(-math.inf, math.inf)


@dataclass(slots=True)
class _Numbers:
    low: float = math.inf
    high: float = -math.inf
    count: int = 0
    parts: list[float] = field(default_factory=list)
    each: int = 0
    messages: int = 0
    bounded_only: bool = False

    def bound(self, low: float, high: float) -> None:
        """Adds numbers of which only the bounds are known."""
        self.low, self.high, self.bounded_only = min(self.low, low), max(self.high, high), True

    def add(
        self,
        bounds: tuple[float, float],
        total: float,
        count: int,
        each: int,
        messages: int,
    ) -> None:
        """Adds numbers of some messages: their sum, how many, and in each message."""
        self.low, self.high = min(self.low, bounds[0]), max(self.high, bounds[1])
        self.each = each if self.messages == 0 or self.each == each else 0
        self.count += count
        self.messages += messages
        self.parts.append(total)

    def range(self, messages: int) -> FieldRange:
        if self.bounded_only or not math.isfinite(total := math.fsum(self.parts)):
            return FieldRange(self.low, self.high)
        each = self.each if self.messages == messages else 0
        return FieldRange(self.low, self.high, self.count, total, each)


class FieldRangesBuilder:
    """Takes extracted values, and keeps the range of each field."""

    def __init__(self) -> None:
        self._found: dict[str, _Numbers] | None = {}
        self._messages = 0
        # Numbers of single messages, and how many each of them has: their bounds are taken at once.
        self._waiting: dict[str, tuple[list[float], list[int]]] = {}
        self._waiting_numbers = 0

    def give_up(self) -> None:
        """Takes a message whose value is not known: no field is known any more."""
        self._found = None
        self._waiting = {}

    def add(self, value: JsonValue) -> None:
        """Takes the exact value of one message."""
        if self._found is None:
            return
        numbers: dict[str, list[float]] = {}
        _collect(value, "", numbers)
        self._messages += 1
        for path, some in numbers.items():
            waiting = self._waiting.get(path)
            if waiting is None:
                self._waiting[path] = (some, [len(some)])
            else:
                waiting[0].extend(some)
                waiting[1].append(len(some))
            self._waiting_numbers += len(some)
        if self._waiting_numbers > _MOST_WAITING or len(self._waiting) > MAX_FIELDS:
            self._take_waiting()

    def _take_waiting(self) -> None:
        waiting, self._waiting, self._waiting_numbers = self._waiting, {}, 0
        for path, (numbers, counts) in waiting.items():
            if math.isfinite(sum(numbers)):
                each = counts[0] if counts.count(counts[0]) == len(counts) else 0
                bounds = min(numbers), max(numbers)
                total = math.fsum(numbers)
                self._numbers(path).add(bounds, total, len(numbers), each, len(counts))
            else:
                self._add(path, np.array(numbers, np.float64), len(counts))

    def add_rows(self, template: PayloadTemplate, rows: Bytes) -> None:
        """Takes many messages of a template, the first of which was added as a value."""
        if self._found is None or not len(rows):
            return
        messages = len(rows)
        self._messages += messages
        for path, offsets in template.fields:
            self._add(path, template.block(rows, offsets), messages)
        for path, constant in template.constants:
            total, each = math.fsum(constant) * messages, len(constant)
            bounds = min(constant), max(constant)
            self._numbers(path).add(bounds, total, each * messages, each, messages)
        for path, offsets in template.times:
            times = np.concatenate([template.nanoseconds(rows, offset) for offset in offsets])
            ends = unix_from_ns(int(times.min())), unix_from_ns(int(times.max()))
            total = unix_from_ns(sum(times.tolist()))  # may take more than 64 bits
            self._numbers(path).add(ends, total, times.size, len(offsets), messages)
        for path in template.angles:
            self._numbers(path).bound(-math.inf, math.inf)

    def ranges(self) -> dict[str, FieldRange] | None:
        """Returns the range of each field that has a number; None where they are not known."""
        self._take_waiting()
        if self._found is None:
            return None
        return {
            path: self._found[path].range(self._messages)
            for path in sorted(self._found)
            if self._found[path].low <= self._found[path].high
        }

    def _numbers(self, path: str) -> _Numbers:
        found = self._found if self._found is not None else {}
        if path not in found:
            found[path] = _Numbers()
            if len(found) > MAX_FIELDS:
                self._found = None
        return found[path]

    def _add(
        self, path: str, numbers: np.ndarray[tuple[int, ...], np.dtype[np.float64]], messages: int
    ) -> None:
        with np.errstate(invalid="ignore", over="ignore"):
            total = float(numbers.sum())
        if math.isfinite(total):
            bounds = float(numbers.min()), float(numbers.max())
            each = numbers.size // messages
            self._numbers(path).add(bounds, total, numbers.size, each, messages)
            return
        rest = numbers[~np.isnan(numbers)]
        if rest.size:
            self._numbers(path).bound(float(rest.min()), float(rest.max()))
        elif path in (self._found or {}):
            self._numbers(path).bounded_only = True


def _collect(value: JsonValue, path: str, into: dict[str, list[float]]) -> None:
    """Adds each number by its field, rounded to a float; NaN too."""
    if isinstance(value, dict):
        for name, inner in value.items():
            if isinstance(inner, float):
                into.setdefault(joined(path, name), []).append(inner)
            elif inner is not None and not isinstance(inner, str | bool):
                _collect(inner, joined(path, name), into)
    elif isinstance(value, list):
        for inner in value:
            _collect(inner, path, into)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        try:
            number = float(value)
        except OverflowError:  # JSON may hold whole numbers of any length
            number = math.inf if value > 0 else -math.inf
        into.setdefault(path, []).append(number)


@lru_cache(4096)
def joined(path: str, name: str) -> str:
    """Returns the dot-path of a key below another."""
    if _is_index(name):
        return path
    plain = name.replace(".", "\0")  # no dot-path leads there
    return f"{path}.{plain}" if path else plain


def field_named(dot_path: str) -> str:
    """Returns the field whose numbers a dot-path leads to, or that it leads into."""
    return ".".join(each for each in dot_path.split(".") if not _is_index(each))


def _is_index(name: str) -> bool:
    return name.removeprefix("-").isdecimal()
