"""The same message in two recordings: how duplicates are recognised, and which one counts.

Recordings overlap for some seconds while one takes over from the other. A message that is in both
has the same publish time and payload in each, and log times that differ by little
(`COPY_HORIZON_NS` at most); it counts once, at its earliest log time. Inside one recording nothing
is a duplicate, however alike two messages are.
"""

from __future__ import annotations

from collections import deque
from itertools import groupby
from typing import TYPE_CHECKING, NamedTuple

from ros2_memory.core.spans import COPY_HORIZON_NS, lies_inside, overlap_spans

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Ns
    from ros2_memory.storage.base import Record


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
    return overlap_spans((bag.first, bag.last, bag.bag.recording) for bag in bags)


def deduplicate_forward(
    messages: Iterable[StoredMessage], spans: Sequence[tuple[Ns, Ns]]
) -> Iterator[StoredMessage]:
    """Yields an ascending stream without the later duplicates.

    Where one recording holds a message n times and another m times, max(n, m) remain.
    """
    recent: deque[tuple[Ns, Copy]] = deque()
    counts: dict[Copy, dict[Path, int]] = {}
    for message in messages:
        if not lies_inside(spans, message.time):
            yield message
            continue
        while recent and recent[0][0] < message.time - COPY_HORIZON_NS:
            counts.pop(recent.popleft()[1], None)
        key = copy_key(message.record)
        by_recording = counts.setdefault(key, {})
        before = max(by_recording.values(), default=0)
        recording = message.bag.recording
        by_recording[recording] = by_recording.get(recording, 0) + 1
        if by_recording[recording] > before:
            recent.append((message.time, key))
            yield message


def deduplicate_backward(
    messages: Iterable[StoredMessage], spans: Sequence[tuple[Ns, Ns]]
) -> Iterator[StoredMessage]:
    """Yields a descending stream without the duplicates that `deduplicate_forward` leaves out.

    Messages in the spans are held for a slice of time and the one before it, in which all earlier
    duplicates are. Where messages that are all alike, their publish times too, follow each other
    for longer than the horizon, other ones may be left out.
    """

    def slice_of(message: StoredMessage) -> int | None:
        return message.time // COPY_HORIZON_NS if lies_inside(spans, message.time) else None

    newer: list[StoredMessage] = []
    for number, slice_messages in groupby(messages, key=slice_of):
        if number is None:
            yield from _without_copies(newer, [], spans)
            newer = []
            yield from slice_messages
        else:
            older = [*slice_messages]
            yield from _without_copies(newer, older, spans)
            newer = older
    yield from _without_copies(newer, [], spans)


def _without_copies(
    messages: Sequence[StoredMessage],
    older: Sequence[StoredMessage],
    spans: Sequence[tuple[Ns, Ns]],
) -> Iterator[StoredMessage]:
    """Returns which messages of a slice count, given those of the one before it; newest first."""
    kept = {id(message) for message in deduplicate_forward(reversed([*messages, *older]), spans)}
    return (message for message in messages if id(message) in kept)
