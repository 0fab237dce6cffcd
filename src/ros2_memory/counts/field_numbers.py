"""The numbers of fields in messages: how many, their sum, the least and the greatest."""

from __future__ import annotations

import math
import sys
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.analysis.bulk_decode import BulkDecoder
from ros2_memory.analysis.conditions import leaves
from ros2_memory.analysis.payload_templates import template_for
from ros2_memory.core.errors import UndecodableError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from ros2_memory.analysis.payload_templates import Bytes, PayloadTemplate
    from ros2_memory.core.model import JsonValue
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.bag_groups import Span
    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.history.view import View
    from ros2_memory.storage.base import Record

Floats: TypeAlias = "NDArray[np.float64]"
_Sample: TypeAlias = tuple[list[float], ...]
"""The numbers of each field in one message."""

_MOST_AT_ONCE: Final = 1024
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
        self._decoder = BulkDecoder(self._decode, self._template, self._apply)

    def numbers(self, messages: Iterable[StoredMessage]) -> tuple[Numbers | None, Span | None]:
        """Returns the numbers of messages in order, and the first and the last of their times."""
        times: list[Ns] = []
        samples: list[_Sample] = []
        rest = iter(messages)
        while some := list(islice(rest, _MOST_AT_ONCE)):
            decoded = self._decoder.decode([each.record for each in some])
            for found, sample in zip(some, decoded, strict=True):
                if isinstance(sample, UndecodableError):
                    self.failures.append(sample)
                else:
                    times.append(found.time)
                    samples.append(sample)
        if not times:
            return None, None
        fields = range(len(self._fields))
        numbers = tuple(_numbers(times, [each[at] for each in samples]) for at in fields)
        return numbers, (times[0], times[-1])

    def _decode(self, record: Record) -> _Sample:
        message = self._view.memory.reader.decode(record)
        at = partial(self._view.memory.extractor.exact_at, message, record.channel.type)
        return tuple([*numbers_in(at(field))] for field in self._fields)

    def _template(self, record: Record, _: _Sample) -> PayloadTemplate | None:
        """Returns the template of a message, where it has all fields."""
        template = template_for(self._view.memory.reader, self._view.memory.extractor, record)
        if template is None or not {*self._fields} <= {path for path, _ in template.fields}:
            return None
        return template

    def _apply(
        self, template: PayloadTemplate, _: _Sample, _records: Sequence[Record], rows: Bytes
    ) -> Iterator[_Sample]:
        offsets = dict(template.fields)
        blocks = [template.block(rows, offsets[field]) for field in self._fields]
        if all(np.isfinite(each).all() for each in blocks):
            return zip(*(each.tolist() for each in blocks), strict=True)
        found = (
            [[each for each in row if math.isfinite(each)] for row in block.tolist()]
            for block in blocks
        )
        return zip(*found, strict=True)


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
