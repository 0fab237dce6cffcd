"""The numbers of fields of a topic in a window: how many, their sum, the least and the greatest.

Whole bags count by their digests, which know the sum exactly and bounds that nothing exceeds. The
least number of many bags, and when it was, is in one of the few whose bound is as low: these are
read.
"""

from __future__ import annotations

import json
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
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import COPY_HORIZON_NS
from ros2_memory.core.timebase import MIN_NS
from ros2_memory.counts.segment_fold import SegmentFold
from ros2_memory.history.bag_groups import DigestKind

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from ros2_memory.analysis.payload_templates import Bytes, PayloadTemplate
    from ros2_memory.catalogue.field_columns import FieldColumn
    from ros2_memory.catalogue.lookup import SegmentDigests
    from ros2_memory.core.model import JsonValue
    from ros2_memory.core.timebase import Ns
    from ros2_memory.counts.segment_fold import Digested, Folded
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


class NumberTable(NamedTuple):
    """The numbers of each field in many short times, in order.

    Attributes:
        first: log times of the first message of each time.
        last: of the last.
        numbers: of each time those of each field.
    """

    first: list[Ns]
    last: list[Ns]
    numbers: list[Numbers]


class FieldReader:
    """Reads the numbers of some fields (dot-paths) of a topic.

    Args:
        view: the call's.
        topic: its name.
        fields: dot-paths.
        by_digests: whether digests are asked, which know a field by its extracted name alone.

    Attributes:
        failures: of messages that cannot be decoded.
    """

    def __init__(
        self, view: View, topic: str, fields: Sequence[str], *, by_digests: bool = True
    ) -> None:
        self._view = view
        self._topic = topic
        types = view.snapshot.timeline.types_of(topic)
        own_path = view.memory.extractor.own_path
        self._fields = tuple(
            own_path(field, types[0]) if by_digests and len(types) == 1 else field
            for field in fields
        )
        self._kind = f"numbers {json.dumps(self._fields)}"
        self.failures: list[UndecodableError] = []
        self._decoder = BulkDecoder(self._decode, self._template, self._apply)

    def over(self, window: TimeWindow, edges: Sequence[Ns]) -> Folded[NumberTable]:
        """Returns the numbers in a window, of times that no edge cuts.

        Raises:
            QueryTimeoutError: the call's time runs out before any result.
        """
        kind = DigestKind(self._kind, self._look_up, _encoded, _decoded)
        fold = SegmentFold(
            kind,
            self.numbers,
            _table,
            name=kind.name,
            edges=edges,
            cut_ns=0,
            failures=self.failures,
        )
        return fold.over(self._view, self._topic, window)

    def between(self, first: Ns, last: Ns) -> Numbers | None:
        """Returns the numbers between two log times (inclusive); None without a message."""
        window = TimeWindow(first, last + 1)
        kept = self._kept_in(window)
        if (first, last) in kept:
            return kept[first, last]
        with self._view.notes.isolated():
            numbers, _ = self.numbers(self._view.stream.messages([self._topic], window))
            if numbers is not None and self._view.notes.complete and not self.failures:
                kept[first, last] = numbers
        return numbers

    def _kept_in(self, window: TimeWindow) -> dict[Span, Numbers]:
        """Returns what was read between two times, where nothing but one segment decides that."""
        wider = TimeWindow(max(window.start - COPY_HORIZON_NS, MIN_NS), window.stop)
        segments = self._view.snapshot.timeline.segments_in(wider)
        digests = self._view.bags.digests_of(segments[0]) if len(segments) == 1 else None
        if digests is None or not segments[0].is_closed:
            return {}
        return digests.derived(f"{self._kind} of {self._topic} between", dict)

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

    def _look_up(
        self, digests: SegmentDigests, topic: str, among: Sequence[int]
    ) -> Mapping[int, Numbers]:
        """Returns the numbers of bags whose digests have the sums of all fields."""
        return _numbers_of(
            [digests.catalogue.field_column(topic, field, among) for field in self._fields]
        )


def numbers_in(value: JsonValue) -> Iterator[float]:
    """Yields the numbers of a field; not those of a summary in place of an array."""
    if isinstance(value, dict) and value.keys() <= _SUMMARY:
        return  # its numbers are counts, not the field's values
    for leaf in leaves(value):
        if isinstance(leaf, bool) or not isinstance(leaf, int | float):
            continue
        if -_LARGEST <= leaf <= _LARGEST:
            yield leaf


def _numbers_of(columns: Sequence[FieldColumn]) -> dict[int, Numbers]:
    """Returns, by entry, the numbers of all fields, where the sums of all are known."""
    found: dict[int, list[FieldNumbers]] = {}
    for column in columns:
        known = (column.size >= 0) & np.isfinite(column.total)
        rows = zip(*(each[known].tolist() for each in column), strict=True)
        for number, low, high, count, total, each in rows:
            # Of one number in every message the first message is the first that has it.
            exact = low == high and each > 0
            one = (
                FieldNumbers(count, total, low, _AT_FIRST, high, _AT_FIRST)
                if exact
                else FieldNumbers(count, total, low, None, high, None)
            )
            found.setdefault(number, []).append(one)
    return {number: tuple(each) for number, each in found.items() if len(each) == len(columns)}


_AT_FIRST: Final[Ns] = -1
"""Means the time of the first message, which `_table` inserts."""


def _numbers(times: Sequence[Ns], samples: Sequence[Sequence[float]]) -> FieldNumbers:
    """Returns the numbers of one field, of which each message has some."""
    count = sum(map(len, samples))
    if not count:
        return FieldNumbers(0, 0.0)
    low, low_at = min((min(some), at) for some, at in zip(samples, times, strict=True) if some)
    high, later = max((max(some), -at) for some, at in zip(samples, times, strict=True) if some)
    total = math.fsum(number for some in samples for number in some)
    return FieldNumbers(count, total, low, low_at, high, -later)


def _table(found: Sequence[Digested[Numbers]]) -> NumberTable:
    table = NumberTable([], [], [])
    for numbers, first, last in found:
        table.first.append(first)
        table.last.append(last)
        table.numbers.append(
            tuple(
                each._replace(low_at=first, high_at=first) if each.low_at == _AT_FIRST else each
                for each in numbers
            )
        )
    return table


def _encoded(numbers: Numbers) -> bytes:
    return json.dumps(numbers).encode()


def _decoded(text: bytes) -> Numbers:
    return tuple(FieldNumbers(*each) for each in json.loads(text))
