"""Rules over closed splits: when a rule fires, what is kept then, and the search for matches.

When a rule fires is a fold over messages in order of time, with its state carried on.

A match begins with a message that meets the condition. It ends as a sighting does: with a message
of the topic that does not meet it, or when the topic is silent for longer than its `pause_of`. On a
latched topic, whose publisher sends only when something changes, a silence ends nothing. A match
also ends at a gap, where the recorder did not run. A message that cannot be decoded neither begins
nor ends a match.

A rule fires once in each match: when it begins, or once it has held for as long as the rule asks.
A silence begins with the last message of a topic that had one since the last gap.

How the stream is cut into calls changes nothing: `reach` says only how far it is known.

Only bags with topics that a rule names are opened, and only messages of these topics are decoded; a
rule for silences needs the log times alone.
"""

from __future__ import annotations

import hashlib
import heapq
import time
from collections import defaultdict, deque
from dataclasses import KW_ONLY, dataclass
from functools import cache
from operator import attrgetter
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.facts import source_of
from ros2_memory.analysis.intervals import PACED, SILENCE_NS, pause_of
from ros2_memory.analysis.refusals import refusal_for
from ros2_memory.bag_dir.layout import named_start, split_number
from ros2_memory.bag_dir.state_files import LatchedMark, RuleRecord, RunRecord, TriggerState
from ros2_memory.core.bag_summary import OUT_OF_ORDER_NS
from ros2_memory.core.errors import BagError, UndecodableError
from ros2_memory.core.model import COMPRESSED, BagFile, JsonValue, TimeWindow
from ros2_memory.core.spans import COPY_HORIZON_NS
from ros2_memory.core.text import match_topics
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S, Ns
from ros2_memory.retention.disk import FailingFiles

if TYPE_CHECKING:
    from collections.abc import (
        Callable,
        Collection,
        Iterable,
        Iterator,
        Mapping,
        MutableMapping,
        Sequence,
    )

    from ros2_memory.analysis.conditions import Condition
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.storage.base import BagReader, Channel, Record
    from ros2_memory.triggers import RuleKind


LEAST_NEAR_NS: Final[Ns] = 60 * NS_PER_S
"""Recordings that take over from each other overlap by less, ..."""
_SPLITS_NEAR: Final = 3
"""... and by less than so many splits."""
_BURST_NS: Final[Ns] = 5 * NS_PER_S
"""A new subscriber receives the messages that its publishers repeat within so much time."""
_MARKED_RECORDINGS: Final = 3
"""Latched messages of so many recordings are remembered: the newest ones, which may overlap."""


class Firing(NamedTuple):
    """A rule fired at a log time, for a match that began at `first` on a topic."""

    rule: str
    topic: str
    first: Ns
    at: Ns


@dataclass(frozen=True, slots=True, kw_only=True)
class Rule:
    """When to keep something, and how much.

    Attributes:
        kind: whether it fires for messages, for silences, or when the recorder restarts.
        topic: the name or glob of the topics; None for a restart.
        condition: what a message must meet; None for the other kinds.
        hold: for how long the condition, or the silence, must hold before it fires.
        before: how much is kept of the time before the match began.
        after: how much is kept of the time after it fired.
        max_bytes: how much its moments may take together.
    """

    name: str
    kind: RuleKind
    topic: str | None = None
    condition: Condition | None = None
    hold: Ns = 0
    before: Ns
    after: Ns
    label: str
    max_bytes: int
    max_per_hour: int

    def window(self, first: Ns, fired: Ns) -> TimeWindow:
        """Returns the window to save for a match that began at `first` and made the rule fire."""
        return TimeWindow(max(first - self.before, MIN_NS + 1), min(fired + self.after, MAX_NS - 1))

    def take(
        self,
        runs: MutableMapping[str, RunRecord],
        topic: str,
        time: Ns,
        *,
        matches: bool | None,
        latched: bool = False,
        pause: Ns = SILENCE_NS,
    ) -> Firing | None:
        """Updates `runs` by the next message of a topic; returns whether the rule fires.

        Args:
            runs: the matches that go on, by topic; for a rule over silences, since when each topic
                is silent.
            topic: the topic of the message.
            time: the log time of the message.
            matches: whether the message meets the condition; None if it cannot be decoded.
            latched: whether the value of the message holds until the next one.
            pause: the longest pause before the message in which a match goes on.
        """
        run = runs.get(topic)
        if run is not None and time < run.last - SILENCE_NS:
            run = None  # the clock was set back
        if self.kind == "silent":
            last = time if run is None else max(time, run.last)
            runs[topic] = RunRecord(last, last)
            return self._fire(topic, run, time)
        fired = None
        if run is not None and run.lasts:
            # The value held until now, whatever it is from now on.
            fired = self._fire(topic, run, time)
        elif run is not None and abs(time - run.last) > pause:
            run = None
        if matches is False:
            run = None
        elif matches and run is None:
            run = RunRecord(time, time, lasts=latched)
        if run is None:
            runs.pop(topic, None)
            return fired
        runs[topic] = run
        run.last = max(run.last, time)
        if matches and fired is None:
            fired = self._fire(topic, run, time)
        return fired

    def reach(self, runs: Mapping[str, RunRecord], until: Ns) -> Iterator[Firing]:
        """Yields the firings of silences and lasting matches that go on at a log time."""
        for topic, run in runs.items():
            if self.kind == "silent" or run.lasts:
                fired = self._fire(topic, run, until)
                if fired is not None:
                    yield fired

    def _fire(self, topic: str, run: RunRecord | None, time: Ns) -> Firing | None:
        """Returns the firing of a match that has held for long enough at a log time, once."""
        if run is None or run.fired or time - run.first < self.hold:
            return None
        run.fired = True
        # Without the source: names of topics have no spaces.
        return Firing(self.name, topic.partition(" ")[0], run.first, run.first + self.hold)


def _source_of(event: _Event, value: JsonValue | UndecodableError) -> str:
    """Returns whose match a message goes on or ends: its topic's, or its `source_of`."""
    if event.record is None or isinstance(value, UndecodableError):
        return event.topic
    source = source_of(value, event.record.channel.type)
    return f"{event.topic} {source}" if source else event.topic


class SearchPart(NamedTuple):
    """A part of a recording (see `parts_of`) that can be searched: bags that touch a window."""

    name: str
    window: TimeWindow
    bags: tuple[BagFile, ...]


class SearchResult(NamedTuple):
    """What a search fired, in order, and the log time up to which it came.

    `is_complete`: whether it searched the whole chain before its time was over.
    """

    firings: list[Firing]
    until: Ns
    is_complete: bool


class SearchChain(NamedTuple):
    """Parts of recordings that took over from each other, in order.

    `goes_on`: the first part follows the part that was searched last, without a gap.
    """

    parts: tuple[SearchPart, ...]
    goes_on: bool


def parts_of(
    recording: str, bags: Iterable[BagFile], searched: Mapping[str, Ns]
) -> dict[str, list[BagFile]]:
    """Returns the splits among the closed bags of a recording, by part.

    A part is searched in order of time. Another one (`rec_A#7`, by its first split) begins where
    the clock was set back, and behind a split that cannot be read, also the first: that may still
    come. `searched` has until which log time each part was searched.
    """
    splits: dict[int, BagFile] = {}
    for bag in bags:
        number = split_number(recording, bag.path.name.removesuffix(COMPRESSED))
        if number is not None:
            splits[number] = bag
    parts: dict[str, list[BagFile]] = {}
    part, end = recording, MIN_NS
    last = MAX_NS if recording in searched else -1
    for nth, bag in sorted(splits.items()):
        # Behind a split that was searched and then deleted, nothing begins.
        is_unsearched = bag.start >= searched.get(part, MIN_NS) - OUT_OF_ORDER_NS
        name = f"{recording}#{nth}"
        if name in searched or (nth > last + 1 and is_unsearched) or _was_set_back(bag, end):
            part, end = name, MIN_NS
        parts.setdefault(part, []).append(bag)
        end, last = max(end, bag.end), nth
    return parts


def recording_of(part: str) -> str:
    """Returns the recording of a part, see `parts_of`."""
    return part.partition("#")[0]


def _was_set_back(bag: BagFile, end: Ns) -> bool:
    """Whether a split begins before `end`, and not just with a latched message that came again."""
    if bag.start >= end - OUT_OF_ORDER_NS:
        return False
    firsts = (topic.first for topic in bag.summary.topics if not topic.latched)
    return min(firsts, default=end) < end - OUT_OF_ORDER_NS


def chains_to_search(
    closed: Mapping[str, Sequence[BagFile]],
    live: Collection[str],
    searched: Mapping[str, Ns],
    previous: Callable[[str], str | None],
    split_ns: Ns,
) -> list[SearchChain]:
    """Returns the parts of recordings that can be searched now.

    Args:
        closed: the closed bags by part, see `parts_of`, in the order in which the recordings began.
        live: the recordings that are being written.
        searched: until which log time each part was searched.
        previous: returns the recording that one took over from, or None.
        split_ns: how long one bag is.
    """
    ends = {part: max(bag.end for bag in bags) for part, bags in closed.items()}
    newest = {recording_of(part): part for part in closed}
    written = {newest.get(name, name): ends.get(newest.get(name, "")) for name in live}
    limits = horizons(ends, written, split_ns)
    chains: list[SearchChain] = []
    last: str | None = None
    for name, bags in closed.items():
        start = searched.get(name, MIN_NS)
        window = TimeWindow(start, max(start, min(limits[name], ends[name] + 1)))
        touched = tuple(bag for bag in bags if bag.reaches_into(window))
        if window.empty or not touched:
            continue
        part = SearchPart(name, window, touched)
        is_known = name in searched
        predecessor = None if is_known else previous(name)
        if last is not None and (is_known or predecessor == recording_of(last)):
            chains[-1] = SearchChain((*chains[-1].parts, part), chains[-1].goes_on)
        else:
            chains.append(SearchChain((part,), is_known or predecessor in searched))
        last = name
    return chains


def horizons(ends: Mapping[str, Ns], live: Mapping[str, Ns | None], split_ns: Ns) -> dict[str, Ns]:
    """Returns for each recording the log time up to which it is complete.

    Messages of a live recording may still come, and affect it and the recordings near its end.

    Args:
        ends: the last log time in the closed bags of each recording.
        live: the same for each recording that is being written; None if none of its bags is closed.
        split_ns: how long one bag is.
    """
    reached: dict[str, Ns] = {}
    for name, last in live.items():
        end = named_start(name) if last is None else last
        if end is not None:
            reached[name] = end - OUT_OF_ORDER_NS
    near = max(LEAST_NEAR_NS, _SPLITS_NEAR * split_ns)
    limits: dict[str, Ns] = {}
    for name, end in ends.items():
        others = reached.items()
        untils = (until for other, until in others if other == name or abs(until - end) <= near)
        limits[name] = min(untils, default=MAX_NS)
    return limits


class _Event(NamedTuple):
    """A message of a topic, in a recording; without a record only its time counts."""

    time: Ns
    topic: str
    recording: str
    record: Record | None


@dataclass(eq=False, repr=False)
class SplitSearch:
    """Searches bags for messages and silences that make rules fire."""

    reader: BagReader
    extractor: SchemaExtractor
    rules: Sequence[Rule]
    _: KW_ONLY
    monotonic: Callable[[], float] = time.monotonic

    def __post_init__(self) -> None:
        """Starts with nothing known."""
        self._failing = FailingFiles(self.monotonic)
        self._rules = [rule for rule in self.rules if rule.kind != "recorder_restart"]
        self._rules_of = cache(self._find_rules)
        self._tested: set[tuple[str, str]] = set()
        # By `_source_of`, the log times of its newest messages.
        self._times = defaultdict[str, deque[Ns]](lambda: deque(maxlen=PACED))

    def search(
        self, chain: SearchChain, state: TriggerState, is_over: Callable[[], bool]
    ) -> SearchResult:
        """Searches a chain until `is_over`, and carries the state on.

        Raises:
            BagUnreachableError: the disk fails to read a bag, and may recover; the state is
                useless then.
        """
        for rule in self._rules:
            record = state.rules.setdefault(rule.name, RuleRecord())
            if not chain.goes_on:
                record.runs.clear()  # the recorder did not run on
        firings: list[Firing] = []
        until, is_complete = max(part.window.stop for part in chain.parts), True
        previous: Ns | None = None
        bags = (
            self._events(bag, part, state)
            for part in chain.parts
            for bag in part.bags
            if any(self._rules_of(topic.topic) for topic in bag.summary.topics)
        )
        for event in heapq.merge(*bags, key=attrgetter("time")):
            if not event.topic:
                continue
            # Messages of one log time are searched together: the next search begins after them.
            if previous is not None and event.time > previous and is_over():
                until, is_complete = event.time, False
                break
            previous = event.time
            firings += self._firings_at(event, state)
        for rule in self._rules:
            firings += rule.reach(state.rules[rule.name].runs, until)
        return SearchResult(firings, until, is_complete)

    def _firings_at(self, event: _Event, state: TriggerState) -> Iterator[Firing]:
        """Yields what a message fires; nothing for a repeated latched message."""
        record, latched = event.record, False
        value: JsonValue | UndecodableError = None
        rules = self._rules_of(event.topic)
        if record is not None:
            latched = record.channel.latched
            if latched and _mark_received(record, event.recording, state):
                return
            if any(rule.kind == "message" for rule in rules):
                try:
                    value = self.extractor.exact(self.reader.decode(record), record.channel.type)
                except UndecodableError as error:
                    value = error
        said_by = _source_of(event, value)
        pause = self._pause_before(said_by, event.time)
        times = self._times[said_by]
        # Recordings that take over from each other both have some.
        if not times or abs(event.time - times[-1]) > COPY_HORIZON_NS:
            times.append(event.time)
        for rule in rules:
            if latched and rule.kind == "silent":
                continue  # its publisher is silent until something changes
            matches = None if record is None else self._test(rule, record.channel, value, state)
            runs = state.rules[rule.name].runs
            source = event.topic if rule.kind == "silent" else said_by
            if source != event.topic:
                self._drop_ended(runs, f"{event.topic} ", event.time)
            fired = rule.take(
                runs, source, event.time, matches=matches, latched=latched, pause=pause
            )
            if fired is not None:
                yield fired

    def _pause_before(self, source: str, time: Ns) -> Ns:
        """Returns through how long a pause before a message of a source its match goes on."""
        times = self._times[source]
        # Mostly it is shorter, and need not be computed.
        is_long = times and time - times[-1] > SILENCE_NS
        return pause_of(np.array(times, np.int64)) if is_long else SILENCE_NS

    def _drop_ended(self, runs: MutableMapping[str, RunRecord], begin: str, time: Ns) -> None:
        """Drops the matches of nodes that are silent, by the begin of their names: none goes on."""
        for name, run in [*runs.items()]:
            is_of_topic = name.startswith(begin) and not run.lasts
            if is_of_topic and time - run.last > self._pause_before(name, time):
                del runs[name]

    def _test(
        self, rule: Rule, channel: Channel, value: JsonValue | UndecodableError, state: TriggerState
    ) -> bool | None:
        """Returns whether a value meets a rule's condition.

        None if the rule has no condition, or the value could not be decoded or does not say.

        Stores a problem in the rule's record if the message cannot make the rule fire. Whether any
        message of its type could is tested once for each topic.
        """
        record = state.rules[rule.name]
        if rule.condition is None:
            return None
        if isinstance(value, UndecodableError):
            record.problem = f"not all could be searched: {value}"
            return None
        condition = rule.condition.of_type(channel.type, self.extractor)
        if condition.is_unstated(value):
            return None
        matches = condition.matches(value)
        topic = channel.topic
        if (rule.name, topic) not in self._tested:
            self._tested.add((rule.name, topic))
            if not matches and condition.can_be_refused:
                refusal, known = refusal_for(condition, value), record.problem or ""
                if refusal is not None:
                    record.problem = f"{topic}: {refusal}"
                elif known.startswith(f"{topic}: "):  # of another condition, or of another type
                    record.problem = None
        return matches

    def _find_rules(self, topic: str) -> tuple[Rule, ...]:
        return tuple(rule for rule in self._rules if match_topics((topic,), rule.topic or ""))

    def _events(self, bag: BagFile, part: SearchPart, state: TriggerState) -> Iterator[_Event]:
        """Yields the messages of a bag in a window, in order of log time.

        The first event has no topic: `heapq.merge` takes it before the bag is opened, so that bags
        are opened one after the other. A part that cannot be read becomes a problem of the rules.
        """
        yield _Event(max(bag.start, part.window.start), "", recording_of(part.name), None)
        topics = {topic.topic for topic in bag.summary.topics if self._rules_of(topic.topic)}
        try:
            yield from self._messages(bag, part, topics)
        except BagError as error:
            if self._failing.may_recover(bag.path, error):
                raise
            problem = f"not all could be searched: {bag.path.name}: {error.reason}"
            for topic in topics:
                for rule in self._rules_of(topic):
                    state.rules[rule.name].problem = problem

    def _messages(
        self, bag: BagFile, part: SearchPart, topics: Collection[str]
    ) -> Iterator[_Event]:
        """Yields the messages of topics, without records if no rule tests their values.

        Raises:
            BagError: the bag cannot be read.
        """
        latched = {topic.topic for topic in bag.summary.topics if topic.latched}
        read: list[str] = []
        times: list[tuple[Ns, str]] = []
        for topic in topics:
            if topic in latched or any(rule.kind == "message" for rule in self._rules_of(topic)):
                read.append(topic)
                continue
            for batch in self.reader.batches(bag.path, [topic], part.window, bare=[topic]):
                times += ((time, topic) for time in batch.log_times.tolist())
        records = self.reader.records(bag.path, read, part.window) if read else ()
        recording = recording_of(part.name)
        with_records = (
            _Event(record.log_time, record.channel.topic, recording, record) for record in records
        )
        bare = (_Event(time, topic, recording, None) for time, topic in sorted(times))
        yield from heapq.merge(with_records, bare, key=attrgetter("time"))


def _mark_received(record: Record, recording: str, state: TriggerState) -> bool:
    """Marks a latched message as received; returns whether another recording received it before."""
    mark = state.latched.setdefault(record.channel.topic, LatchedMark())
    payload = hashlib.blake2b(record.payload, digest_size=8).hexdigest()
    mark.begun.setdefault(recording, record.log_time)
    is_repeat = _is_repeat(record, recording, payload, mark)
    if not is_repeat:
        mark.payload = payload
    # Put in again, so that the recordings used last come last.
    latest = mark.published.pop(recording, record.publish_time)
    mark.published[recording] = max(latest, record.publish_time)
    while len(mark.published) > _MARKED_RECORDINGS:
        oldest = next(iter(mark.published))
        del mark.published[oldest]
        mark.begun.pop(oldest, None)
    return is_repeat


def _is_repeat(record: Record, recording: str, payload: str, mark: LatchedMark) -> bool:
    """Returns whether a latched message was sent before, and this recording received it again.

    A message that a recording receives in its first seconds, and that was published long before,
    is repeated, whether another recording has it or not. If a format keeps no publish time, the
    first message of a recording is repeated if its payload is that of the last message.
    """
    logged, published = record.log_time, record.publish_time
    if published in {0, logged}:
        return recording not in mark.published and payload == mark.payload
    is_late = published < logged - SILENCE_NS
    if is_late and logged - mark.begun[recording] < _BURST_NS:
        return True
    # Elsewhere, times later than now are from before the clock was set back: they prove nothing,
    # unless this message has one, too, as under a simulated log clock.
    latest = logged + SILENCE_NS
    return any(
        published <= elsewhere and (elsewhere <= latest or published > latest)
        for other, elsewhere in mark.published.items()
        if other != recording
    )
