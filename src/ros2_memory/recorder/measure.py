"""Measures how topics arrive: of one closed split, and since the start."""

from __future__ import annotations

import re
import struct
from bisect import bisect_right
from collections import Counter, deque
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from statistics import fmean, median_low
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

from ros2_memory.bag_dir.state_files import Loss
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MAX_NS, NS_PER_S, Ns, ns_from_unix

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.storage.base import BagReader, Schema

HOUR_NS: Final[Ns] = 3600 * NS_PER_S
RECENT: Final = 6
"""After so many splits nothing is waited for any more."""
FEWEST: Final = 10
"""Messages that show a cadence."""
REGULAR: Final = 0.9
"""The part of all steps that must be of one length, or nothing is expected."""
LONGEST_NS: Final[Ns] = 5 * NS_PER_S
"""A longer hole is a publisher that was silent, and reported as that."""
MOST_MISSING: Final = 10_000
_TOLERANCE: Final = 0.25
_FIELD: Final = re.compile(r"^[ \t]*(\w\S*)[ \t]+(\w+)\b(?![ \t]*=)", re.MULTILINE)
"""Type and name of each field; a constant has a value behind a `=`."""
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
    """Where one message lies: its counter or stamp (ns), and its log time."""

    value: int
    log_time: Ns


class Progress(NamedTuple):
    """The messages of a topic in one split, at least one, by log time, and what shows holes."""

    kind: Kind
    positions: Sequence[Position]


class Hole(NamedTuple):
    """Messages that are missing between two that are not.

    An open one may still turn out to be a late message: too few follow to tell.
    """

    before: Position
    after: Position
    missing: int
    is_open: bool


@dataclass(slots=True)
class _Series:
    """What the recordings have of a topic, by value; the first message is settled."""

    kind: Kind
    positions: list[Position]
    heard: int = 0
    """How many splits had been measured when it last came."""


class LossCounter:
    """What is missing in the splits of one bag directory, measured one after the other."""

    def __init__(self) -> None:
        self._measured = 0
        # Of each recording, how many splits had been measured when it was last heard of, and up to
        # which log time it has been.
        self._recordings: dict[str, tuple[int, Ns]] = {}
        self._series: dict[str, _Series] = {}
        self._lately: deque[Loss] = deque(maxlen=10_000)
        self._counted: set[str] = set()

    def begin(self, recording: str) -> None:
        """Notes that a recording begins, which may have what another one misses."""
        self._recordings[recording] = self._measured, 0

    def unclear(self, topics: Collection[str] | None = None) -> None:
        """Notes that a split does not show what it has of these topics; None: of any."""
        for topic in [*self._series] if topics is None else topics:
            self._series.pop(topic, None)

    def measured(self, recording: str, split: Mapping[str, Progress]) -> list[Loss]:
        """Takes the next split of a recording; returns the losses that are certain by now."""
        self._measured += 1
        _, reached = self._recordings.get(recording, (0, 0))
        ends = (progress.positions[-1].log_time for progress in split.values())
        self._recordings[recording] = self._measured, max(reached, *ends, 0)
        for topic, progress in split.items():
            self._add(topic, progress)
        self._recordings = {
            name: (heard, reached)
            for name, (heard, reached) in self._recordings.items()
            if self._measured - heard < RECENT
        }
        return self._settle(min(reached for _, reached in self._recordings.values()))

    def flush(self) -> list[Loss]:
        """Returns what no further split will fill."""
        return self._settle(MAX_NS)

    def reported(self, topic: str, start: Ns, stop: Ns, lost: int) -> list[Loss]:
        """Takes rosbag2's own count of a topic; returns it where nothing else counts the topic."""
        if topic in self._counted:
            return []
        loss = Loss(topic, start, stop, lost, "rosbag2")
        self._lately.append(loss)
        return [loss]

    def in_last_hour(self, now: Ns) -> dict[str, int]:
        """Returns how many messages of each topic are missing of the last hour."""
        lost = Counter[str]()
        for loss in self._lately:
            if loss.stop > now - HOUR_NS:
                lost[loss.topic] += loss.lost
        return dict(lost)

    def _add(self, topic: str, progress: Progress) -> None:
        """Puts what a split has of a topic together with what is known of it."""
        positions, series = progress.positions, self._series.get(topic)
        steps = enumerate(pairwise(positions), 1)
        back = [index for index, (before, after) in steps if before.value >= after.value]
        if len(back) > 1:  # several publishers
            self.unclear([topic])
            return
        last = positions[-1]
        if back and last.value < positions[back[0] - 1].value:
            # Its publisher began anew. Else what it had sent before came again, as latched.
            series, positions = None, positions[back[0] :]
        elif series is not None and last.value < series.positions[0].value:
            series = None  # likewise, or the clock was set back
        known = [] if series is None else series.positions
        by_value = dict(sorted((*known, *positions), reverse=True))
        merged = [
            Position(value, log_time)
            for value, log_time in sorted(by_value.items())
            if not known or value >= known[0].value
        ]
        self._series[topic] = _Series(progress.kind, merged, self._measured)

    def _settle(self, until: Ns) -> list[Loss]:
        """Returns the losses up to a log time that all recordings have reached."""
        losses: list[Loss] = []
        for topic, series in self._series.items():
            positions, is_over = series.positions, until == MAX_NS
            is_over |= self._measured - series.heard >= RECENT
            settled = max(
                (index for index, position in enumerate(positions) if position.log_time <= until),
                default=0,
            )
            series_holes = holes(positions, series.kind)
            if series_holes is not None:
                self._counted.add(topic)
            for hole in series_holes or ():
                if hole.after.value > positions[settled].value:
                    break
                if hole.is_open and not is_over:
                    settled = positions.index(hole.before)
                    break
                losses.append(
                    Loss(
                        topic, hole.before.log_time, hole.after.log_time, hole.missing, series.kind
                    )
                )
            series.positions = positions[settled:]
        self._lately += losses
        return losses


class ValueReader(NamedTuple):
    """What shows holes in messages of a type: a counter, or stamps (ns).

    `value_of` takes a payload, and raises `struct.error` for one that does not fit.
    """

    kind: Kind
    value_of: Callable[[bytes], int]


def reader_of(schema: Schema) -> ValueReader | None:
    """Returns what shows holes in messages of this type; None where nothing does."""
    if schema.encoding != "ros2msg":
        return None
    fields = _FIELD.findall(schema.text.decode(errors="replace").partition("\n===")[0])
    before: list[str] = []
    for kind, name in fields:
        if name in _COUNTERS and (form := _FORMS.get(kind)) in _COUNTED:
            value_of = partial(_counter, before=tuple(before), form=form)
            return ValueReader("counter", value_of)
        if kind not in {"string", *_FORMS, *_HEADERS, *_TIMES}:
            break
        before.append(kind)
    first_type, _ = fields[0] if fields else ("", "")
    return ValueReader("stamps", _stamp) if first_type in _HEADERS else None


def holes(positions: Sequence[Position], kind: Kind) -> list[Hole] | None:
    """Returns the holes between messages, in the order of their positions.

    None where no cadence is to be seen, so that nothing can be expected: few messages, irregular
    ones, or several publishers.

    A message that was stamped late leaves a wide step, too, but then the next ones follow in a
    burst. So what counts is how far behind the cadence the messages after the step remain.
    """
    steps = [(before, after, after.value - before.value) for before, after in pairwise(positions)]
    lengths = [length for _, _, length in steps if length > 0]
    if len(positions) < FEWEST or len(steps) - len(lengths) > 1:
        return None
    usual = 1 if kind == "counter" else median_low(lengths)
    allowed = 0.0 if kind == "counter" else _TOLERANCE * usual
    regular = [length for length in lengths if abs(length - usual) <= allowed]
    if len(regular) < REGULAR * len(steps):
        return None
    period = fmean(regular)  # Jitter cancels out in it, and does not in a median.
    holes_found: list[Hole] = []
    for index, (before, after, length) in enumerate(steps):
        missing = round(length / period) - 1
        wide = length > (2 - _TOLERANCE) * period
        short = after.log_time - before.log_time <= LONGEST_NS and missing <= MOST_MISSING
        if not (wide and short):
            continue
        enough = 1 if kind == "counter" else missing + FEWEST
        later = positions[index + 1 : index + 1 + enough]
        behind = (
            min(position.value - nth * period for nth, position in enumerate(later, 1))
            - before.value
        )
        if (missing := round(behind / period)) > 0:
            holes_found.append(Hole(before, after, missing, len(later) < enough))
    return holes_found


def _stamp(payload: bytes) -> int:
    seconds, nanoseconds = struct.unpack_from("<iI", payload, 4)
    return int(seconds) * NS_PER_S + int(nanoseconds)


def _counter(payload: bytes, before: Sequence[str], form: str) -> int:
    at = 0
    for kind in before:
        if kind in _FORMS:
            size = struct.calcsize(_FORMS[kind])
            at = _aligned(at, size) + size
            continue
        at = _aligned(at, 4)
        if kind != "string":
            at += 8
        if kind == "string" or kind in _HEADERS:
            at += 4 + int(struct.unpack_from("<I", payload, 4 + at)[0])
    return int(struct.unpack_from(form, payload, 4 + _aligned(at, struct.calcsize(form)))[0])


def _aligned(at: int, size: int) -> int:
    return -(-at // size) * size


HOLD_S: Final = 2.0
"""A queue holds what arrives within so many seconds."""
MESSAGE_BYTES: Final = 256
"""What a queued message takes besides its payload, in bytes: sample, change and allocation."""

# Enumerations are numbers up to Iron (rmw/types.h), names since.
_RELIABLE: Final = frozenset({"reliable", "1"})
_LATCHED: Final = frozenset({"transient_local", "1"})
_POLICY: Final = re.compile(r"\b(reliability|durability): *(\w+)")


class OfferedQos(NamedTuple):
    """What all publishers of a topic offer: `reliable`, and `latched` (transient local)."""

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
        """What one of its messages may take in a queue, in bytes."""
        return self.largest + MESSAGE_BYTES

    def joined(self, newer: TopicFlow) -> TopicFlow:
        """Returns the newer flow, with peaks of this one that fade by a tenth with each split."""
        return newer._replace(
            burst=max(newer.burst, self.burst * 9 // 10),
            largest=max(newer.largest, self.largest * 9 // 10),
        )


def offered_by_all(texts: Collection[str]) -> OfferedQos | None:
    """Returns what all publishers offer, by rosbag2's `offered_qos_profiles` in one bag.

    Best effort if any publisher is, volatile if any is; None where the texts list no publisher, as
    those of other programs.
    """
    # Parsing YAML takes longer than all else that is measured.
    policies = [policy for text in texts for policy in _POLICY.findall(text)]
    reliability, durability = (
        [value for name, value in policies if name == wanted]
        for wanted in ("reliability", "durability")
    )
    if not reliability:
        return None
    return OfferedQos(
        reliable=_RELIABLE.issuperset(reliability),
        latched=len(durability) == len(reliability) and _LATCHED.issuperset(durability),
        publishers=len(reliability),
    )


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
        """Returns both as one."""
        return Arrival(
            min(self.first, later.first),
            max(self.last, later.last),
            self.messages + later.messages,
            max(self.pause, later.pause, later.first - self.last),
        )


class SplitMeasure(NamedTuple):
    """How the topics of one split arrived.

    Attributes:
        flows: of those whose offered QoS the split states.
        progress: of those with one publisher, whose messages show what is missing.
        arrivals: of all topics that have a message.
    """

    flows: Mapping[str, TopicFlow]
    progress: Mapping[str, Progress]
    arrivals: Mapping[str, Arrival]

    @property
    def start(self) -> Ns:
        """The first log time, where there is a message."""
        return min(arrival.first for arrival in self.arrivals.values())

    @property
    def end(self) -> Ns:
        """The last log time, where there is a message."""
        return max(arrival.last for arrival in self.arrivals.values())


def measure_split(reader: BagReader, path: Path, *, end_only: bool = False) -> SplitMeasure:
    """Returns how each topic of a closed split arrived.

    `end_only`: of a small split, too, only the last seconds are measured, and no holes.

    Raises:
        BagError: the split cannot be read.
        OSError: it is not there.
    """
    offers: dict[str, list[str]] = {}
    readers: dict[str, ValueReader] = {}
    for channel in reader.channels(path):
        texts = offers.setdefault(channel.topic, [])
        texts += [text for name, text in channel.metadata if name == "offered_qos_profiles"]
        if value_reader := reader_of(channel.schema):
            readers[channel.topic] = value_reader
    window = TimeWindow.everything()
    is_whole = not end_only and path.stat().st_size <= SPLIT_BYTES
    if not is_whole and not (summary := reader.summarize(path)).empty:
        window = TimeWindow.before(summary.end, TAIL_NS)
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
                position = Position(readers[topic].value_of(record.payload), logged)
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
        topic: Progress(readers[topic].kind, of_topic)
        for topic, of_topic in positions.items()
        if is_whole and topic in readers and topic in flows and flows[topic].offered.publishers == 1
    }
    return SplitMeasure(flows, progress, arrivals)


def burst_of(published: Sequence[Ns]) -> int:
    """Returns the most messages within `HOLD_S`, of times of one or more.

    A shorter topic is assumed to continue at its rate: it may have just started.
    """
    ordered = sorted(published)
    counts = (nth - bisect_right(ordered, at - _HOLD_NS) for nth, at in enumerate(ordered, 1))
    most, lasted = max(counts), ordered[-1] - ordered[0]
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
        if not split.arrivals:
            return
        end = split.end
        self._newest = end if end < self._newest - _SET_BACK_NS else max(self._newest, end)
        self._splits = [
            measured
            for measured in (*self._splits, split)
            if self._newest - MEASURED_NS < measured.end <= self._newest
        ]
        for topic, arrival in split.arrivals.items():
            topic_state = self._topics.get(topic)
            if topic_state is None or arrival.last < topic_state.arrival.last - _SET_BACK_NS:
                self._topics[topic] = _Topic(arrival)
                self._silent.discard(topic)
                continue
            joined = topic_state.arrival.joined(arrival)
            if joined.last > topic_state.arrival.last:
                self._silent.discard(topic)
            if max(arrival.pause, arrival.first - topic_state.arrival.last) > topic_state.patience:
                topic_state.arrival, topic_state.paused = arrival, arrival.first
            else:
                topic_state.arrival = joined

    def silent(self, idle: Ns) -> frozenset[str]:
        """Returns the topics that came regularly, and have stopped: for ten periods, 10 s at least.

        One that was found silent stays so until it comes again, also if `idle` is shorter then.
        `idle`: for how long (ns) nothing has come at all.
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
        if not self._splits:
            return {}
        start = min(split.start for split in self._splits)
        duration_s = max(self._newest + idle - start, 1) / NS_PER_S
        counts = Counter[str]()
        for split in self._splits:
            for name, arrival in split.arrivals.items():
                counts[name] += arrival.messages
        return {name: count / duration_s for name, count in counts.items()}
