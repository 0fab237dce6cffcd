"""Measures how topics arrive: their losses, QoS, bursts, rates and silences.

Closed splits are measured one by one; `LossCounter` and `Arrivals` follow the topics across splits.
"""

from __future__ import annotations

import re
import struct
from bisect import bisect_right
from collections import Counter, defaultdict, deque
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from statistics import fmean, median_low
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

from ros2_memory.bag_dir.state_files import Loss
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import Spans, united
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_HOUR, NS_PER_S, Ns, ns_from_unix
from ros2_memory.index.segment import TopicTotals

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.storage.base import BagReader, Channel, Record, Schema

RECENT: Final = 6
"""A message, or a recording, that is missing for so many splits does not come any more."""
FEWEST: Final = 10
"""Fewer messages show no cadence."""
_SETTLED_KEPT: Final = 30
"""So many older messages show the cadence of a topic that has few in a split."""
REGULAR: Final = 0.9
"""The share of all steps that must be of one length, or there is no cadence."""
LONGEST_NS: Final[Ns] = 5 * NS_PER_S
"""After a longer hole the publisher was silent, which is reported elsewhere."""
MOST_MISSING: Final = 10_000
"""More missing messages are a jump of the counter or the stamp."""
_TOLERANCE: Final = 0.25
"""So far, in periods, a regular step may be from the median."""
_FIELD: Final = re.compile(r"^[ \t]*(\w\S*)[ \t]+(\w+)\b(?![ \t]*=)", re.MULTILINE)
"""The type and the name of a field; a constant has a `=` as well."""
_HEADERS: Final = frozenset({"std_msgs/Header", "std_msgs/msg/Header", "Header"})
_TIMES: Final = frozenset(
    f"builtin_interfaces/{middle}{name}" for middle in ("", "msg/") for name in ("Time", "Duration")
)
_COUNTERS: Final = frozenset(
    {
        "seq",
        "sequence",
        "sequence_number",
        "sequence_id",
        "seq_num",
        "seq_id",
        "counter",
        "msg_counter",
        "message_counter",
        "packet_counter",
        "frame_counter",
        "frame_number",
    }
)
_FORMS: Final = {
    "bool": "?",
    "byte": "B",
    "char": "B",
    "int8": "b",
    "uint8": "B",
    "int16": "<h",
    "uint16": "<H",
    "int32": "<i",
    "uint32": "<I",
    "float32": "<f",
    "int64": "<q",
    "uint64": "<Q",
    "float64": "<d",
}
_COUNTED: Final = frozenset({"<H", "<I", "<Q", "<i", "<q"})

Kind = Literal["counter", "stamps"]


class Position(NamedTuple):
    """The counter or stamp (ns) of one message, and its log time."""

    value: int
    log_time: Ns


class Progress(NamedTuple):
    """The positions of a topic's messages in one split, at least one, by log time."""

    kind: Kind
    positions: Sequence[Position]


class Hole(NamedTuple):
    """Messages that are missing between two others.

    `is_open`: too few messages follow to tell whether they only come late.
    """

    before: Position
    after: Position
    missing: int
    is_open: bool


@dataclass(slots=True)
class _Series:
    """The newest messages of a topic, by value.

    `heard` is the number of splits that had been measured when the topic last came. What is missing
    up to the value `settled` was counted.
    """

    kind: Kind
    positions: list[Position]
    heard: int
    settled: int


class _Reached(NamedTuple):
    """How many splits had been measured when a recording last came, and its newest log time."""

    measured: int
    log_time: Ns


class LossCounter:
    """Counts the messages that are missing in the splits of one bag directory."""

    def __init__(self) -> None:
        self._measured = 0
        self._recordings: dict[str, _Reached] = {}
        self._series: dict[str, _Series] = {}
        self._lately: deque[Loss] = deque(maxlen=10_000)
        self._counted: set[str] = set()

    def begin(self, recording: str) -> None:
        """Notes that a recording begins, which may have messages that another one misses."""
        self._recordings[recording] = _Reached(self._measured, 0)

    def forget(self, topics: Collection[str] | None = None) -> None:
        """Forgets what is known of topics, all if None: a split does not show their messages."""
        for topic in [*self._series] if topics is None else topics:
            self._series.pop(topic, None)
            self._counted.discard(topic)

    def add_split(self, recording: str, split: Mapping[str, Progress]) -> list[Loss]:
        """Adds the next split of a recording; returns the losses that are certain by now."""
        self._measured += 1
        _, reached = self._recordings.get(recording, (0, 0))
        ends = [progress.positions[-1].log_time for progress in split.values()]
        self._recordings[recording] = _Reached(self._measured, max([reached, *ends]))
        for topic, progress in split.items():
            self._add(topic, progress)
        self._recordings = {
            name: reached
            for name, reached in self._recordings.items()
            if self._measured - reached.measured < RECENT
        }
        return self._settle(min(reached.log_time for reached in self._recordings.values()))

    def flush(self) -> list[Loss]:
        """Returns the losses that only a further split could disprove; none comes."""
        return self._settle(MAX_NS)

    def add_reported(self, topic: str, start: Ns, stop: Ns, lost: int) -> list[Loss]:
        """Adds rosbag2's own count of a topic; returns it unless the topic is counted already."""
        if topic in self._counted:
            return []
        loss = Loss(topic, start, stop, lost, "rosbag2")
        self._lately.append(loss)
        return [loss]

    def in_last_hour(self, now: Ns) -> dict[str, int]:
        """Returns how many messages of each topic are missing in the last hour.

        What is dated an hour or more after now is of a clock that was set back.
        """
        lost = Counter[str]()
        for loss in self._lately:
            if abs(loss.stop - now) < NS_PER_HOUR:
                lost[loss.topic] += loss.lost
        return dict(lost)

    def _add(self, topic: str, progress: Progress) -> None:
        """Merges the messages that a split has of a topic with those of other splits."""
        positions, series = progress.positions, self._series.get(topic)
        steps = enumerate(pairwise(positions), 1)
        back = [index for index, (before, after) in steps if before.value >= after.value]
        if len(back) > 1:  # several publishers
            self.forget([topic])
            return
        last = positions[-1]
        if back and last.value < positions[back[0] - 1].value:
            # The publisher began anew. Otherwise an earlier message came again, as latched.
            series, positions = None, positions[back[0] :]
        elif series is not None and last.value < series.settled:
            series = None  # it began anew between two splits, or the clock was set back
        known = [] if series is None else series.positions
        settled = min(positions).value if series is None else series.settled
        earliest: dict[int, Ns] = {}
        for value, log_time in (*known, *(new for new in positions if new.value >= settled)):
            earliest[value] = min(log_time, earliest.get(value, log_time))
        merged = [Position(value, earliest[value]) for value in sorted(earliest)]
        self._series[topic] = _Series(progress.kind, merged, self._measured, settled)

    def _settle(self, until: Ns) -> list[Loss]:
        """Returns the losses up to a log time that all recordings have reached, each once."""
        losses: list[Loss] = []
        for topic, series in self._series.items():
            is_over = until == MAX_NS or self._measured - series.heard >= RECENT
            topic_holes = holes(series.positions, series.kind)
            if topic_holes is not None:
                self._counted.add(topic)
            positions = enumerate(series.positions)
            reached = (index for index, position in positions if position.log_time <= until)
            settled = max(reached, default=0)
            for hole in topic_holes or ():
                if hole.before.value < series.settled:
                    continue
                if hole.after.value > series.positions[settled].value:
                    break
                if hole.is_open and not is_over:
                    settled = series.positions.index(hole.before)
                    break
                # The clock may have been set back between them.
                start, stop = sorted((hole.before.log_time, hole.after.log_time))
                losses.append(Loss(topic, start, stop, hole.missing, series.kind))
            series.settled = max(series.settled, series.positions[settled].value)
            series.positions = series.positions[max(0, settled - _SETTLED_KEPT) :]
        self._lately += losses
        return losses


class ValueReader(NamedTuple):
    """Reads the counter, or the stamp (ns), of messages of a type.

    `value_of` takes a payload, and raises `struct.error` if it is too short.
    """

    kind: Kind
    value_of: Callable[[bytes], int]


def value_reader(schema: Schema) -> ValueReader | None:
    """Returns what reads the counter or stamp of a type; None if it has neither."""
    if schema.encoding != "ros2msg":
        return None
    fields = _FIELD.findall(schema.text.decode(errors="replace").partition("\n===")[0])
    before: list[str] = []
    for kind, name in fields:
        form = _FORMS.get(kind)
        if name in _COUNTERS and form in _COUNTED:
            return ValueReader("counter", partial(_counter, before=tuple(before), form=form))
        if kind not in {"string", *_FORMS, *_HEADERS, *_TIMES}:
            break
        before.append(kind)
    if fields and fields[0][0] in _HEADERS:
        return ValueReader("stamps", _stamp)
    return None


def holes(positions: Sequence[Position], kind: Kind) -> list[Hole] | None:
    """Returns the holes between messages; None if the messages have no cadence.

    A message that was stamped late leaves a wide step, too, but then the next ones follow in a
    burst. So a hole counts by how far the messages after it stay behind the cadence.
    """
    period = _cadence(positions, kind)
    if period is None:
        return None
    holes: list[Hole] = []
    for index, (before, after) in enumerate(pairwise(positions), 1):
        length = after.value - before.value
        missing = round(length / period) - 1
        is_silence = after.log_time - before.log_time > LONGEST_NS or missing > MOST_MISSING
        if is_silence or length <= (2 - _TOLERANCE) * period:
            continue
        enough = 1 if kind == "counter" else missing + FEWEST
        later = positions[index : index + enough]
        due = [position.value - nth * period for nth, position in enumerate(later, 1)]
        missing = round((min(due) - before.value) / period)
        if missing > 0:
            holes.append(Hole(before, after, missing, len(later) < enough))
    return holes


def _cadence(positions: Sequence[Position], kind: Kind) -> float | None:
    """Returns the usual step from message to message; None of few, irregular or mixed messages."""
    steps = [after.value - before.value for before, after in pairwise(positions)]
    forward = [step for step in steps if step > 0]
    # A second step back comes from a second publisher.
    if len(positions) < FEWEST or len(steps) - len(forward) > 1:
        return None
    usual = 1 if kind == "counter" else median_low(forward)
    allowed = 0.0 if kind == "counter" else _TOLERANCE * usual
    regular = [step for step in forward if abs(step - usual) <= allowed]
    if len(regular) < REGULAR * len(steps):
        return None
    return fmean(regular)  # jitter cancels out in a mean, and not in a median


def _stamp(payload: bytes) -> int:
    """Returns the stamp (ns) of a CDR message that begins with a header."""
    seconds, nanoseconds = struct.unpack_from("<iI", payload, 4)
    return int(seconds) * NS_PER_S + int(nanoseconds)


def _counter(payload: bytes, before: Sequence[str], form: str) -> int:
    """Returns the counter behind fields of the types `before`; CDR has 4 bytes in front."""
    offset = 0
    for kind in before:
        if kind in _FORMS:
            size = struct.calcsize(_FORMS[kind])
            offset = _aligned(offset, size) + size
            continue
        offset = _aligned(offset, 4)
        if kind != "string":
            offset += 8  # a time
        if kind == "string" or kind in _HEADERS:
            offset += 4 + int(struct.unpack_from("<I", payload, 4 + offset)[0])
    offset = _aligned(offset, struct.calcsize(form))
    return int(struct.unpack_from(form, payload, 4 + offset)[0])


def _aligned(offset: int, size: int) -> int:
    return -(-offset // size) * size


HOLD_S: Final = 2.0
"""A queue holds the messages of so many seconds."""
MESSAGE_BYTES: Final = 256
"""A queued message takes so much besides its payload: sample, change and allocation."""

# Enumerations are numbers up to Iron (rmw/types.h), names since.
_RELIABLE: Final = frozenset({"reliable", "1"})
_LATCHED: Final = frozenset({"transient_local", "1"})
# Patterns: parsing YAML would take longer than all else that is measured.
_RELIABILITY: Final = re.compile(r"\breliability: *(\w+)")
_DURABILITY: Final = re.compile(r"\bdurability: *(\w+)")


class OfferedQos(NamedTuple):
    """The QoS that all publishers of a topic offer; `latched` is transient local."""

    reliable: bool
    latched: bool
    publishers: int = 1


class TopicFlow(NamedTuple):
    """How a topic arrives.

    Attributes:
        burst: the most messages within `HOLD_S`.
        largest: the largest payload in bytes.
    """

    offered: OfferedQos
    burst: int
    largest: int

    @property
    def message_bytes(self) -> int:
        """The bytes that one of its messages may take in a queue."""
        return self.largest + MESSAGE_BYTES

    def joined(self, newer: TopicFlow) -> TopicFlow:
        """Returns the newer flow; the peaks of this one fade by a tenth with each split."""
        return newer._replace(
            burst=max(newer.burst, self.burst * 9 // 10),
            largest=max(newer.largest, self.largest * 9 // 10),
        )


def offered_by_all(texts: Collection[str]) -> OfferedQos | None:
    """Returns the QoS that all publishers offer; None if no publisher is listed.

    It is best effort if any publisher is, and volatile if any is.

    Args:
        texts: rosbag2's `offered_qos_profiles` of the topic's channels in one bag.
    """
    reliability = [value for text in texts for value in _RELIABILITY.findall(text)]
    durability = [value for text in texts for value in _DURABILITY.findall(text)]
    if not reliability:
        return None
    return OfferedQos(
        reliable=_RELIABLE.issuperset(reliability),
        latched=len(durability) == len(reliability) and _LATCHED.issuperset(durability),
        publishers=len(reliability),
    )


SPLIT_BYTES: Final = 64 * 2**20
"""Only the end of a larger split is read, and no holes are sought, to spare the processor."""
TAIL_NS: Final[Ns] = 4 * NS_PER_S
"""The length of that end."""
_HOLD_NS: Final[Ns] = ns_from_unix(HOLD_S)
_FEWEST: Final = 5
"""So many messages show a rate, even if they did not last for `HOLD_S`."""

MEASURED_NS: Final[Ns] = 30 * NS_PER_S
"""Rates are measured over the newest data of this length; a topic is regular after as long."""
SILENT_PERIODS: Final = 10
LEAST_SILENCE_NS: Final[Ns] = 10 * NS_PER_S
"""A shorter pause is no silence, however often a topic comes: splits do not show it."""
IRREGULAR_NS: Final[Ns] = NS_PER_HOUR
"""A topic does not count as regular for so long after a silence."""
_REGULAR: Final = 20
"""Messages that make a topic regular."""
_SET_BACK_NS: Final[Ns] = 60 * NS_PER_S
"""A newer split that ends so much earlier was recorded after the clock was set back."""


class Arrival(NamedTuple):
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
        """Returns the arrival of the messages of both."""
        return Arrival(
            min(self.first, later.first),
            max(self.last, later.last),
            self.messages + later.messages,
            max(self.pause, later.pause, later.first - self.last),
        )


class SplitMeasure(NamedTuple):
    """How the topics of one split arrived.

    Attributes:
        flows: topics whose offered QoS the split states, and that have a message in what was read.
        progress: topics with one publisher, whose messages have a counter or a stamp.
        arrivals: all topics that have a message; pauses are those in what was read.
    """

    flows: dict[str, TopicFlow]
    progress: dict[str, Progress]
    arrivals: dict[str, Arrival]

    @property
    def start(self) -> Ns:
        """The first log time, where there is a message."""
        return min(arrival.first for arrival in self.arrivals.values())

    @property
    def end(self) -> Ns:
        """The last log time, where there is a message."""
        return max(arrival.last for arrival in self.arrivals.values())


@dataclass(slots=True)
class _Messages:
    """The messages of one topic in a split."""

    offered_texts: list[str] = field(default_factory=list)
    value_reader: ValueReader | None = None
    published: list[Ns] = field(default_factory=list)
    largest: int = 0
    last: Ns = MAX_NS
    pause: Ns = 0
    positions: list[Position] = field(default_factory=list)

    def add_channel(self, channel: Channel) -> None:
        metadata = channel.metadata
        self.offered_texts += [text for name, text in metadata if name == "offered_qos_profiles"]
        self.value_reader = value_reader(channel.schema) or self.value_reader

    def add(self, record: Record) -> None:
        logged = record.log_time
        self.published.append(record.publish_time or logged)
        self.largest = max(self.largest, len(record.payload))
        self.pause, self.last = max(self.pause, logged - self.last), logged
        if self.value_reader is not None:
            try:
                value = self.value_reader.value_of(record.payload)
            except struct.error:
                self.value_reader = None
            else:
                self.positions.append(Position(value, logged))


def measure_split(reader: BagReader, path: Path, *, end_only: bool = False) -> SplitMeasure:
    """Returns how each topic of a closed split arrived.

    `end_only` reads only the last seconds of a small split, too, and seeks no holes.

    Raises:
        BagError: the split cannot be read.
        OSError: the split does not exist.
    """
    topics: defaultdict[str, _Messages] = defaultdict(_Messages)
    for channel in reader.channels(path):
        topics[channel.topic].add_channel(channel)
    window, summary = TimeWindow.everything(), reader.summarize(path)
    is_whole = not end_only and path.stat().st_size <= SPLIT_BYTES
    if not is_whole and not summary.empty:
        window = TimeWindow.before(summary.end, TAIL_NS)
    for record in reader.records(path, [*topics], window):
        topics[record.channel.topic].add(record)
    split = SplitMeasure({}, {}, {})
    # Latched messages may be written again with the times that they had.
    begun = min((total.first for total in summary.topics if not total.latched), default=MIN_NS)
    for total in summary.topics:
        first, last = max(total.first, begun), max(total.last, begun)
        arrival = Arrival(first, last, total.count, topics[total.topic].pause)
        known = split.arrivals.get(total.topic)  # of another type
        split.arrivals[total.topic] = arrival if known is None else known.joined(arrival)
    for topic, messages in topics.items():
        offered = offered_by_all(messages.offered_texts)
        if offered is None or not messages.published:
            continue
        burst = largest_burst(messages.published, summary.end - messages.last)
        split.flows[topic] = TopicFlow(offered, burst, messages.largest)
        if is_whole and messages.value_reader is not None and offered.publishers == 1:
            split.progress[topic] = Progress(messages.value_reader.kind, messages.positions)
    return split


def largest_burst(published: Sequence[Ns], silent: Ns) -> int:
    """Returns the most messages within `HOLD_S`, by their publish times; there must be one.

    A topic that did not last for `HOLD_S` may have just started: its rate is extrapolated, unless
    it has been `silent` for longer than it lasted (ns), as after a burst of a log.
    """
    ordered = sorted(published)
    counts = [nth - bisect_right(ordered, time - _HOLD_NS) for nth, time in enumerate(ordered, 1)]
    lasted = ordered[-1] - ordered[0]
    if len(ordered) >= _FEWEST and silent < lasted < _HOLD_NS:
        extrapolated = -(-(len(ordered) - 1) * _HOLD_NS // lasted)
        return max(*counts, extrapolated)
    return max(counts)


@dataclass(slots=True)
class _Topic:
    """A topic since its last silence, which ended at the log time `resumed`.

    `latched`: whether all of its publishers are transient local.
    """

    arrival: Arrival
    resumed: Ns | None = None
    latched: bool = False

    @property
    def patience(self) -> Ns:
        return max(LEAST_SILENCE_NS, SILENT_PERIODS * self.arrival.period)

    def is_regular(self, now: Ns) -> bool:
        arrival = self.arrival
        if arrival.messages < _REGULAR or arrival.last - arrival.first < MEASURED_NS:
            return False
        totals = TopicTotals(arrival.first, arrival.last, arrival.messages)
        if self.latched and totals.is_rare:
            return False  # its publisher is silent until something changes
        return self.resumed is None or now - self.resumed > IRREGULAR_NS


class Arrivals:
    """How the topics of closed splits came; times are log times, in ns."""

    def __init__(self) -> None:
        self._topics: dict[str, _Topic] = {}
        self._splits: list[SplitMeasure] = []
        self._newest: Ns = 0
        self._silent = set[str]()

    def add_split(self, split: SplitMeasure) -> None:
        """Adds the next closed split."""
        if not split.arrivals:
            return
        end = split.end
        if end < self._newest - _SET_BACK_NS:
            self._set_back(self._newest - split.start, self._topics.keys() - split.arrivals.keys())
            self._newest = end
        self._newest = max(self._newest, end)
        self._splits = [
            measured
            for measured in (*self._splits, split)
            if self._newest - MEASURED_NS < measured.end <= self._newest
        ]
        for name, arrival in split.arrivals.items():
            topic = self._topics.get(name)
            if topic is None or arrival.last < topic.arrival.last - _SET_BACK_NS:
                self._topics[name] = _Topic(arrival)
                self._silent.discard(name)
                continue
            last, patience = topic.arrival.last, topic.patience
            topic.arrival = topic.arrival.joined(arrival)
            if topic.arrival.last > last:
                self._silent.discard(name)
            if max(arrival.pause, arrival.first - last) > patience:
                topic.arrival, topic.resumed = arrival, arrival.first
        for name, flow in split.flows.items():
            self._topics[name].latched = flow.offered.latched

    def _set_back(self, by: Ns, topics: Collection[str]) -> None:
        """Has the clock set back for topics that have not come since: else none would be silent."""
        for name in topics:
            arrival = self._topics[name].arrival
            self._topics[name].arrival = arrival._replace(
                first=arrival.first - by, last=arrival.last - by
            )

    def silent_topics(self, idle: Ns) -> frozenset[str]:
        """Returns the regular topics that have not come for ten periods, and for 10 s at least.

        A silent topic stays silent until it comes again.

        Args:
            idle: how long nothing at all has come (ns).
        """
        now = self._newest + idle
        for name, topic in self._topics.items():
            if topic.is_regular(now) and now - topic.arrival.last > topic.patience:
                self._silent.add(name)
        return frozenset(self._silent)

    def rates_hz(self, idle: Ns) -> Mapping[str, float]:
        """Returns the messages a second of each topic in the newest data.

        A topic without a message there has the rate of one that comes at this moment.

        Args:
            idle: how long nothing at all has come (ns).
        """
        if not self._splits:
            return {}
        start = min(split.start for split in self._splits)
        now = self._newest + idle
        duration = max(now - start, 1)
        counts, spans = Counter[str](), defaultdict[str, Spans](list)
        for split in self._splits:
            for name, arrival in split.arrivals.items():
                counts[name] += arrival.messages
                spans[name].append((arrival.first, arrival.last))
        rates = {
            name: NS_PER_S / max(now - topic.arrival.last, MEASURED_NS)
            for name, topic in self._topics.items()
        }
        for name, of_topic in spans.items():
            # In a rotation two recordings have the same messages.
            twice = _length(of_topic) - _length(united(of_topic))
            rates[name] = counts[name] * NS_PER_S / (duration + twice)
        return rates


def _length(spans: Spans) -> Ns:
    return sum(stop - start for start, stop in spans)
