"""Measures how topics arrive: of one closed split, and since the start."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import NS_PER_S, Ns, ns_from_unix
from ros2_memory.recorder.reception.losses import Position, Progress, reader_of
from ros2_memory.recorder.reception.profiles import HOLD_S, TopicFlow, offered_by_all

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.recorder.reception.losses import Kind
    from ros2_memory.storage.base import BagReader

SPLIT_BYTES: Final = 64 * 2**20
"""Of a larger split only the last seconds are measured, and no holes, to spare the processor."""
TAIL_NS: Final[Ns] = 4 * NS_PER_S
_HOLD_NS: Final[Ns] = ns_from_unix(HOLD_S)
_FEWEST: Final = 5
"""Messages that show a rate, where a topic did not last for `HOLD_S`."""

MEASURED_NS: Final[Ns] = 30 * NS_PER_S
"""Rates are those of the newest data of this length; a topic is regular after as long."""
SILENT_PERIODS: Final = 10
LEAST_SILENCE_NS: Final[Ns] = 10 * NS_PER_S
"""Shorter pauses are no silence, however often a topic comes: splits show no more."""
IRREGULAR_NS: Final[Ns] = 3600 * NS_PER_S
"""After a silence a topic does not count as regular for so long."""
_REGULAR: Final = 20
"""Messages that make a topic regular."""
_SET_BACK_NS: Final[Ns] = 60 * NS_PER_S
"""A newer split that ends so much earlier was recorded after the clock was set back."""


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
    readers: dict[str, tuple[Kind, Callable[[bytes], int]]] = {}
    for channel in reader.channels(path):
        texts = offers.setdefault(channel.topic, [])
        texts += [text for name, text in channel.metadata if name == "offered_qos_profiles"]
        if found := reader_of(channel.schema):
            readers[channel.topic] = found
    window = TimeWindow.everything()
    is_whole = not end_only and path.stat().st_size <= SPLIT_BYTES
    if not is_whole and not (summary := reader.summarize(path)).empty:
        window = TimeWindow(summary.end - TAIL_NS, summary.end + 1)
    times: dict[str, list[Ns]] = {}
    largest: dict[str, int] = {}
    arrivals: dict[str, Arrival] = {}
    positions: dict[str, list[Position]] = {}
    for record in reader.records(path, offers, window):
        topic, logged = record.channel.topic, record.log_time
        times.setdefault(topic, []).append(record.publish_time or logged)
        largest[topic] = max(largest.get(topic, 0), len(record.payload))
        arrival = Arrival(logged, logged)
        arrivals[topic] = arrivals[topic].joined(arrival) if topic in arrivals else arrival
        if topic in readers:
            try:
                position = Position(readers[topic][1](record.payload), logged)
            except struct.error:
                del readers[topic]
            else:
                positions.setdefault(topic, []).append(position)
    flows = {
        topic: TopicFlow(offered, burst_of(published), largest[topic])
        for topic, published in times.items()
        if (offered := offered_by_all(offers[topic])) is not None
    }
    progress = {
        topic: Progress(readers[topic][0], found)
        for topic, found in positions.items()
        if is_whole and topic in readers and topic in flows and flows[topic].offered.publishers == 1
    }
    ends = [(arrival.first, arrival.last) for arrival in arrivals.values()]
    span = (min(first for first, _ in ends), max(last for _, last in ends)) if ends else None
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


@dataclass(slots=True)
class _Topic:
    arrival: Arrival
    paused: Ns | None = None
    """When its last silence ended."""

    @property
    def patience(self) -> Ns:
        return max(LEAST_SILENCE_NS, SILENT_PERIODS * self.arrival.period)

    def is_regular(self, now: Ns) -> bool:
        arrival = self.arrival
        if arrival.messages < _REGULAR or arrival.last - arrival.first < MEASURED_NS:
            return False
        return self.paused is None or now - self.paused > IRREGULAR_NS


class Arrivals:
    """How the topics of closed splits came; times are log times, in ns."""

    def __init__(self) -> None:
        self._topics: dict[str, _Topic] = {}
        self._splits: list[SplitMeasure] = []
        self._newest: Ns = 0
        self._silent = set[str]()

    def measured(self, split: SplitMeasure) -> None:
        """Takes the next closed split."""
        if split.span is None:
            return
        end = split.span[1]
        self._newest = end if end < self._newest - _SET_BACK_NS else max(self._newest, end)
        self._splits = [
            each
            for each in (*self._splits, split)
            if each.span is not None and self._newest - MEASURED_NS < each.span[1] <= self._newest
        ]
        for topic, arrival in split.arrivals.items():
            known = self._topics.get(topic)
            if known is None or arrival.last < known.arrival.last - _SET_BACK_NS:
                self._topics[topic] = _Topic(arrival)
                continue
            joined = known.arrival.joined(arrival)
            if joined.last > known.arrival.last:
                self._silent.discard(topic)
            if max(arrival.pause, arrival.first - known.arrival.last) > known.patience:
                known.arrival, known.paused = arrival, arrival.first
            else:
                known.arrival = joined

    def silent(self, idle: Ns) -> frozenset[str]:
        """Returns the topics that came regularly, and have stopped.

        That is for ten periods, and 10 s at least. `idle`: for how long nothing has come at all.
        """
        now = self._newest + idle
        self._silent |= {
            name
            for name, topic in self._topics.items()
            if topic.is_regular(now) and now - topic.arrival.last > topic.patience
        }
        return frozenset(self._silent)

    def rates_hz(self, idle: Ns) -> Mapping[str, float]:
        """Returns the messages a second of each topic in the newest data; see `silent`."""
        starts = [each.span[0] for each in self._splits if each.span is not None]
        if not starts:
            return {}
        duration_s = max(self._newest + idle - min(starts), 1) / NS_PER_S
        counts: dict[str, int] = {}
        for split in self._splits:
            for name, arrival in split.arrivals.items():
                counts[name] = counts.get(name, 0) + arrival.messages
        return {name: count / duration_s for name, count in counts.items()}
