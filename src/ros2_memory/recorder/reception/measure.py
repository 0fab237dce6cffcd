"""Measures how the topics of one closed split arrived: their QoS, bursts, sizes and holes."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import NS_PER_S, Ns, ns_from_unix
from ros2_memory.recorder.reception.continuity import Position, reader_of
from ros2_memory.recorder.reception.losses import Progress
from ros2_memory.recorder.reception.profiles import HOLD_S, TopicFlow, offered_by_all

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.storage.base import BagReader

SPLIT_BYTES: Final = 64 * 2**20
"""Of a larger split only the last seconds are measured, and no holes, to spare the processor."""
TAIL_NS: Final[Ns] = 4 * NS_PER_S
_HOLD_NS: Final[Ns] = ns_from_unix(HOLD_S)
_FEWEST: Final = 5
"""Messages that show a rate, where a topic did not last for `HOLD_S`."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """The messages of a topic, by log time; `pause` is the longest time between two."""

    first: Ns
    last: Ns
    messages: int = 1
    pause: Ns = 0

    @property
    def period(self) -> Ns:
        """The time between two messages; 0 for one alone."""
        return (self.last - self.first) // max(1, self.messages - 1)

    def joined(self, later: Arrival) -> Arrival:
        """Returns both as one."""
        return Arrival(
            min(self.first, later.first),
            max(self.last, later.last),
            self.messages + later.messages,
            max(self.pause, later.pause, later.first - self.last),
        )


@dataclass(frozen=True, slots=True)
class SplitMeasure:
    """How the topics of one split arrived.

    Attributes:
        flows: of those whose offered QoS the split states.
        progress: of those with one publisher, whose messages show what is missing.
        unclear: the other topics that have a message.
        span: first and last log time; None for a split without a message.
        arrivals: of all topics that have a message.
    """

    flows: Mapping[str, TopicFlow]
    progress: Mapping[str, Progress]
    unclear: Collection[str]
    span: tuple[Ns, Ns] | None
    arrivals: Mapping[str, Arrival] = field(default_factory=dict)


def measure_split(reader: BagReader, path: Path, *, end_only: bool = False) -> SplitMeasure:
    """Returns how each topic of a closed split arrived.

    `end_only`: of a small split, too, only the last seconds are measured, and no holes.

    Raises:
        BagError: the split cannot be read.
        OSError: it is not there.
    """
    offers: dict[str, list[str]] = {}
    for channel in reader.channels(path):
        texts = offers.setdefault(channel.topic, [])
        texts += [text for name, text in channel.metadata if name == "offered_qos_profiles"]
    window = TimeWindow.everything()
    is_whole = not end_only and path.stat().st_size <= SPLIT_BYTES
    if not is_whole:
        summary = reader.summarize(path)
        if not summary.empty:
            window = TimeWindow(summary.end - TAIL_NS, summary.end + 1)
    times: dict[str, list[Ns]] = {}
    largest: dict[str, int] = {}
    arrivals: dict[str, Arrival] = {}
    readers = {
        channel.topic: found
        for channel in reader.channels(path)
        if (found := reader_of(channel.schema)) is not None
    }
    positions: dict[str, list[Position]] = {}
    span: tuple[Ns, Ns] | None = None
    for record in reader.records(path, offers, window):
        topic = record.channel.topic
        times.setdefault(topic, []).append(record.publish_time or record.log_time)
        largest[topic] = max(largest.get(topic, 0), len(record.payload))
        arrival, known_arrival = Arrival(record.log_time, record.log_time), arrivals.get(topic)
        arrivals[topic] = arrival if known_arrival is None else known_arrival.joined(arrival)
        span = (record.log_time if span is None else span[0], record.log_time)
        known = readers.get(topic)
        if known is not None:
            try:
                value = known[1](record.payload)
            except struct.error:
                del readers[topic]
                continue
            positions.setdefault(topic, []).append(Position(value, record.log_time))
    flows: dict[str, TopicFlow] = {}
    for topic, published in times.items():
        offered = offered_by_all(offers[topic])
        if offered is not None:
            flows[topic] = TopicFlow(offered, burst_of(published), largest[topic])
    progress = {
        topic: Progress(readers[topic][0], found)
        for topic, found in positions.items()
        if is_whole and topic in readers and topic in flows and flows[topic].offered.publishers == 1
    }
    return SplitMeasure(flows, progress, times.keys() - progress.keys(), span, arrivals)


def burst_of(published: Sequence[Ns]) -> int:
    """Returns the most messages within `HOLD_S`.

    A shorter topic is assumed to continue at its rate: it may have just started.
    """
    ordered = sorted(published)
    most, first = 0, 0
    for last, at in enumerate(ordered):
        while at - ordered[first] >= _HOLD_NS:
            first += 1
        most = max(most, last - first + 1)
    lasted = ordered[-1] - ordered[0] if ordered else 0
    if len(ordered) >= _FEWEST and 0 < lasted < _HOLD_NS:
        return max(most, -(-(len(ordered) - 1) * _HOLD_NS // lasted))
    return most
