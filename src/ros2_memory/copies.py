"""The same message in two recordings: how copies are recognised, and how one of them is kept.

Recordings overlap for some seconds while one takes over from the other. A message that stands in
both carries the same publish time and payload in each, and log times that differ by little
(`COPY_HORIZON_NS` at most); it counts once, at its earliest log time. Inside one recording nothing
is a copy, however alike two messages are.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.timebase import MAX_NS, NS_PER_S, Ns

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.model import BagFile
    from ros2_memory.storage.base import Record

COPY_HORIZON_NS: Final[Ns] = 2 * NS_PER_S


class Found(NamedTuple):
    """One undecoded message and the bag it stands in."""

    bag: BagFile
    record: Record

    @property
    def time(self) -> Ns:
        """Log time."""
        return self.record.log_time


class Holding(NamedTuple):
    """A bag that holds messages of the topics asked for; `first` and `last` are inclusive."""

    first: Ns
    last: Ns
    bag: BagFile


class Copy(NamedTuple):
    """What two copies of one message share."""

    topic: str
    publish_time: Ns
    size: int
    digest: int


def copy_key(record: Record) -> Copy:
    """The identity of a message across recordings."""
    payload = record.payload
    return Copy(record.channel.topic, record.publish_time, len(payload), hash(payload))


def contested(holdings: Iterable[Holding]) -> list[tuple[Ns, Ns]]:
    """The half-open spans in which bags of different recordings can hold copies, merged.

    Two bags contest the time that both hold, widened by the horizon at both ends.
    """
    return contested_spans((held.first, held.last, held.bag.recording) for held in holdings)


def contested_spans(held: Iterable[tuple[Ns, Ns, Path]]) -> list[tuple[Ns, Ns]]:
    """As `contested`, of first and last log time (inclusive) and recording."""
    spans: list[tuple[Ns, Ns]] = []
    open_ones: list[tuple[Ns, Path]] = []
    for first, last, recording in sorted(held, key=lambda each: each[0]):
        open_ones = [each for each in open_ones if each[0] + COPY_HORIZON_NS >= first]
        spans.extend(
            (first - COPY_HORIZON_NS, min(other, last) + COPY_HORIZON_NS + 1)
            for other, folder in open_ones
            if folder != recording
        )
        open_ones.append((last, recording))
    return united(spans)


def united(spans: Iterable[tuple[Ns, Ns]]) -> list[tuple[Ns, Ns]]:
    """Half-open spans, sorted, those that touch made one."""
    united: list[tuple[Ns, Ns]] = []
    for start, stop in sorted(spans):
        if united and start <= united[-1][1]:
            united[-1] = (united[-1][0], max(united[-1][1], stop))
        else:
            united.append((start, stop))
    return united


def _inside(spans: Sequence[tuple[Ns, Ns]], moment: Ns) -> bool:
    index = bisect_right(spans, (moment, MAX_NS)) - 1
    return index >= 0 and moment < spans[index][1]


def once_forward(found: Iterable[Found], spans: Sequence[tuple[Ns, Ns]]) -> Iterator[Found]:
    """An ascending stream without the later copies.

    Where one recording holds a message n times and another m times, max(n, m) remain.
    """
    recent: deque[tuple[Ns, Copy]] = deque()
    counts: dict[Copy, dict[Path, int]] = {}
    for each in found:
        if not _inside(spans, each.time):
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


def once_backward(found: Iterable[Found], spans: Sequence[tuple[Ns, Ns]]) -> Iterator[Found]:
    """A descending stream without the later copies: held back until no earlier one can come."""
    held: deque[list[Found]] = deque()  # a list of one; emptied where an earlier copy replaced it
    by_key: dict[Copy, list[list[Found]]] = {}
    for each in found:
        while held and (not held[0] or held[0][0].time > each.time + COPY_HORIZON_NS):
            yield from _released(held.popleft(), by_key)
        slot = [each]
        if _inside(spans, each.time):
            slots = by_key.setdefault(copy_key(each.record), [])
            later = next((s for s in slots if s and s[0].bag.recording != each.bag.recording), None)
            if later is not None:
                slots.remove(later)
                later.clear()
            slots.append(slot)
        held.append(slot)
    for slot in held:
        yield from slot


def _released(slot: list[Found], by_key: dict[Copy, list[list[Found]]]) -> list[Found]:
    if slot:
        key = copy_key(slot[0].record)
        remaining = [each for each in by_key.get(key, []) if each is not slot]
        if remaining:
            by_key[key] = remaining
        else:
            by_key.pop(key, None)
    return slot
