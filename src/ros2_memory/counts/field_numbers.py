"""The numbers of fields in messages: how many, their sum, the least and the greatest."""

from __future__ import annotations

import math
import sys
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from ros2_memory.analysis.conditions import leaves
from ros2_memory.core.errors import UndecodableError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from ros2_memory.core.model import JsonValue
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.bag_groups import Span
    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.history.view import View
    from ros2_memory.storage.base import Record

_Sample: TypeAlias = tuple[list[float], ...]
"""The numbers of each field in one message."""

_LARGEST: Final = sys.float_info.max
_SUMMARY: Final = frozenset({"bytes", "numbers"})
"""The keys of a summary in place of numbers that are too many to show."""


class FieldNumbers(NamedTuple):
    """The numbers of one field in some messages.

    Attributes:
        size: how many.
        total: their sum.
        low: the least; where `low_at` is None, only a bound.
        low_at: when it was first.
        high: the greatest; where `high_at` is None, only a bound.
        high_at: when it was first.
    """

    size: int
    total: float
    low: float = math.inf
    low_at: Ns | None = None
    high: float = -math.inf
    high_at: Ns | None = None


Numbers: TypeAlias = tuple[FieldNumbers, ...]
"""Of each field that is asked for."""


class FieldReader:
    """Reads the numbers of some fields (dot-paths) in messages of a topic.

    Args:
        view: the call's.
        fields: dot-paths.

    Attributes:
        failures: of messages that cannot be decoded.
    """

    def __init__(self, view: View, fields: Sequence[str]) -> None:
        self._view = view
        self._fields = tuple(fields)
        self.failures: list[UndecodableError] = []

    def numbers(self, messages: Iterable[StoredMessage]) -> tuple[Numbers | None, Span | None]:
        """Returns the numbers of messages in order, and the first and the last of their times."""
        times: list[Ns] = []
        samples: list[_Sample] = []
        for found in messages:
            try:
                samples.append(self._decode(found.record))
            except UndecodableError as error:
                # A new one, since the one that was raised keeps the message by its traceback.
                self.failures.append(UndecodableError(error.topic, error.type_name, error.reason))
            else:
                times.append(found.time)
        if not times:
            return None, None
        fields = range(len(self._fields))
        numbers = tuple(_numbers(times, [each[at] for each in samples]) for at in fields)
        return numbers, (times[0], times[-1])

    def _decode(self, record: Record) -> _Sample:
        message = self._view.memory.reader.decode(record)
        at = partial(self._view.memory.extractor.exact_at, message, record.channel.type)
        return tuple([*numbers_in(at(field))] for field in self._fields)


def numbers_in(value: JsonValue) -> Iterator[float]:
    """Yields the numbers of a field; not those of a summary in place of an array."""
    if isinstance(value, dict) and value.keys() <= _SUMMARY:
        return  # its numbers are counts, not the field's values
    for leaf in leaves(value):
        if isinstance(leaf, bool) or not isinstance(leaf, int | float):
            continue
        if -_LARGEST <= leaf <= _LARGEST:
            yield leaf


def _numbers(times: Sequence[Ns], samples: Sequence[Sequence[float]]) -> FieldNumbers:
    """Returns the numbers of one field, of which each message has some."""
    count = sum(map(len, samples))
    if not count:
        return FieldNumbers(0, 0.0)
    low, low_at = min((min(some), at) for some, at in zip(samples, times, strict=True) if some)
    high, later = max((max(some), -at) for some, at in zip(samples, times, strict=True) if some)
    total = math.fsum(number for some in samples for number in some)
    return FieldNumbers(count, total, low, low_at, high, -later)
