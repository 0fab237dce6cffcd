"""The same message in two recordings: how duplicates are recognised, and which one counts.

Recordings overlap for some seconds while one takes over from the other. A message that is in both
has the same publish time and payload in each, and log times that differ by little
(`COPY_HORIZON_NS` at most); it counts once, at its earliest log time. Inside one recording nothing
is a duplicate, however alike two messages are.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.core.spans import COPY_HORIZON_NS, lies_inside, overlap_spans
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.core.model import BagFile
    from ros2_memory.storage.base import Record

_LONGEST_ROW_NS: Final[Ns] = 3 * COPY_HORIZON_NS
"""Bounds memory for a topic whose messages are all alike, their publish times too."""


class StoredMessage(NamedTuple):
    """An undecoded message and the bag that it is in."""

    bag: BagFile
    record: Record

    @property
    def time(self) -> Ns:
        """Log time."""
        return self.record.log_time

    @property
    def topic(self) -> str:
        """The name of its topic."""
        return self.record.channel.topic

    @property
    def type(self) -> str:
        """The name of its type."""
        return self.record.channel.type


class BagSpan(NamedTuple):
    """A bag and the log times of its first and last message of some topics, both inclusive."""

    first: Ns
    last: Ns
    bag: BagFile


class Copy(NamedTuple):
    """What the duplicates of one message share."""

    topic: str
    publish_time: Ns
    size: int
    digest: int


def copy_key(record: Record) -> Copy:
    """Returns the identity of a message across recordings."""
    payload = record.payload
    return Copy(record.channel.topic, record.publish_time, len(payload), hash(payload))


def bag_overlaps(bags: Iterable[BagSpan]) -> list[tuple[Ns, Ns]]:
    """Returns the half-open spans in which bags of different recordings can hold duplicates.

    That is the time that both hold, widened by the horizon at both ends; spans that touch are
    merged.
    """
    return overlap_spans((each.first, each.last, each.bag.recording) for each in bags)


def deduplicate_forward(
    found: Iterable[StoredMessage], spans: Sequence[tuple[Ns, Ns]]
) -> Iterator[StoredMessage]:
    """Yields an ascending stream without the later duplicates.

    Where one recording holds a message n times and another m times, max(n, m) remain.
    """
    recent: deque[tuple[Ns, Copy]] = deque()
    counts: dict[Copy, dict[Path, int]] = {}
    for each in found:
        if not lies_inside(spans, each.time):
            yield each
            continue
        while recent and recent[0][0] < each.time - COPY_HORIZON_NS:
            counts.pop(recent.popleft()[1], None)
        key = copy_key(each.record)
        by_recording = counts.setdefault(key, {})
        before = max(by_recording.values(), default=0)
        recording = each.bag.recording
        by_recording[recording] = by_recording.get(recording, 0) + 1
        if by_recording[recording] > before:
            recent.append((each.time, key))
            yield each


def deduplicate_backward(
    found: Iterable[StoredMessage], spans: Sequence[tuple[Ns, Ns]]
) -> Iterator[StoredMessage]:
    """Yields a descending stream without the duplicates that `deduplicate_forward` leaves out.

    A message is held until no earlier duplicate can come. Where duplicates follow each other for
    longer than `_LONGEST_ROW_NS`, with never a pause of `COPY_HORIZON_NS`, other ones may be left
    out.
    """
    held: deque[tuple[StoredMessage, _Row | None]] = deque()
    rows: dict[Copy, _Row] = {}
    for each in found:
        while held and (held[0][1] is None or held[0][1].is_over(each.time)):
            yield from _released(*held.popleft(), rows)
        if not lies_inside(spans, each.time):
            held.append((each, None))
            continue
        key = copy_key(each.record)
        row = rows.get(key)
        if row is None or row.is_over(each.time):
            row = rows[key] = _Row(key)
        row.messages.append(each)
        held.append((each, row))
    for each, row in held:
        yield from _released(each, row, rows)


class _Row:
    """Duplicates that follow each other without a long pause, newest first."""

    def __init__(self, key: Copy) -> None:
        self.key = key
        self.messages: list[StoredMessage] = []
        self._kept: set[int] | None = None

    def is_over(self, now: Ns) -> bool:
        """Whether no message at a moment or before it can belong to the row."""
        if self._kept is not None:
            return True
        first, last = self.messages[-1].time, self.messages[0].time
        return now < max(first - COPY_HORIZON_NS, last - _LONGEST_ROW_NS)

    def keeps(self, found: StoredMessage) -> bool:
        """Whether one of its messages counts; call it when the row is over."""
        if len(self.messages) == 1:
            return True
        if self._kept is None:
            everywhere = [(MIN_NS, MAX_NS)]
            self._kept = {
                id(each) for each in deduplicate_forward(reversed(self.messages), everywhere)
            }
        return id(found) in self._kept


def _released(
    each: StoredMessage, row: _Row | None, rows: dict[Copy, _Row]
) -> Iterator[StoredMessage]:
    if row is None or row.keeps(each):
        yield each
    if row is not None and rows.get(row.key) is row:
        del rows[row.key]
