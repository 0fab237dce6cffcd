"""Searches closed splits for what makes rules fire.

Only bags with topics that a rule names are opened, and only messages of these are decoded. A rule
over silences needs the times in a bag's summary alone, unless the bag is so long that a silence
could lie within it.
"""

from __future__ import annotations

import hashlib
import heapq
from functools import partial
from itertools import count
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.analysis.conditions import refusal_for
from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.bag_dir.state_files import LatchedMark, RuleRecord
from ros2_memory.core.errors import BagError, BagUnreachableError, UndecodableError
from ros2_memory.core.timebase import NS_PER_S, Ns
from ros2_memory.triggers.rules import RuleFold, RuleKind

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from ros2_memory.bag_dir.state_files import TriggerState
    from ros2_memory.core.model import BagFile, JsonValue, TimeWindow
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.storage.base import BagReader, Record
    from ros2_memory.triggers.rules import Firing, Rule
    from ros2_memory.triggers.splits import SearchChain, SearchPart

_BURST_NS: Final[Ns] = 5 * NS_PER_S
"""In so much time a new subscriber receives what its publishers repeat."""
_MARKED_RECORDINGS: Final = 3
"""Recordings whose latched messages are remembered: the newest ones, which can still overlap."""


class _Event(NamedTuple):
    """A message of a topic, in a recording; without a record only its time counts."""

    time: Ns
    topic: str
    recording: str
    record: Record | None


class SplitSearch:
    """Searches on behalf of some rules.

    Args:
        reader: gives the messages that count, and decodes them.
        extractor: gives the values that conditions are tested on.
        rules: what to search for.
    """

    def __init__(
        self,
        reader: BagReader,
        extractor: SchemaExtractor,
        rules: Sequence[Rule],
    ) -> None:
        self._reader = reader
        self._extractor = extractor
        self._rules = [each for each in rules if each.kind is not RuleKind.RECORDER_RESTART]
        self._watching: dict[str, tuple[Rule, ...]] = {}
        self._tested: set[tuple[str, str]] = set()

    def search(
        self, chain: SearchChain, state: TriggerState, is_over: Callable[[], bool]
    ) -> tuple[list[Firing], Ns | None]:
        """Searches a chain and changes the state; returns what fired, in order.

        With it the log time at which the search stopped since its time was over; None where all is
        searched.

        Raises:
            BagUnreachableError: the disk fails; the state is useless then.
        """
        records = {
            each.name: state.rules.setdefault(each.name, RuleRecord()) for each in self._rules
        }
        folds = {each.name: RuleFold(each, records[each.name].runs) for each in self._rules}
        if not chain.goes_on:
            for fold in folds.values():
                fold.end()
        fired: list[Firing] = []
        stopped: Ns | None = None
        previous: Ns | None = None
        for event in _merged(self._opened(part, records) for part in chain.parts):
            if previous is not None and event.time > previous and is_over():
                stopped = event.time
                break
            previous = event.time
            fired += self._take(event, folds, records, state)
        until = max(each.window.stop for each in chain.parts)
        known = until if stopped is None else min(stopped, until)
        for fold in folds.values():
            fired += fold.reach(known)
        return fired, stopped

    def _take(
        self,
        event: _Event,
        folds: dict[str, RuleFold],
        records: dict[str, RuleRecord],
        state: TriggerState,
    ) -> Iterator[Firing]:
        record = event.record
        rules = self._rules_of(event.topic)
        latched = record is not None and record.channel.latched
        if record is not None and latched:
            rules = tuple(each for each in rules if each.kind is not RuleKind.SILENT)
            if _is_repeat(event, record, state):
                return
        value, error = self._value(record, rules)
        for rule in rules:
            matches: bool | None = False
            if rule.condition is not None and record is not None:
                matches = None if error is not None else rule.condition.matches(value)
                self._report(rule, event.topic, matches, error or value, records[rule.name])
            fired = folds[rule.name].take(event.topic, event.time, matches=matches, latched=latched)
            if fired is not None:
                yield fired

    def _value(
        self, record: Record | None, rules: Sequence[Rule]
    ) -> tuple[JsonValue, UndecodableError | None]:
        """Returns what the conditions of rules are tested on, or why there is nothing."""
        if record is None or all(each.condition is None for each in rules):
            return None, None
        try:
            return self._extractor.exact(self._reader.decode(record), record.channel.type), None
        except UndecodableError as error:
            return None, error

    def _report(
        self,
        rule: Rule,
        topic: str,
        matches: bool | None,
        seen: JsonValue | UndecodableError,
        record: RuleRecord,
    ) -> None:
        """Notes why messages cannot make a rule fire; whether any could, once for each topic."""
        if isinstance(seen, UndecodableError):
            record.problem = f"not all could be searched: {seen}"
        elif (rule.name, topic) not in self._tested and rule.condition is not None:
            self._tested.add((rule.name, topic))
            if not matches and rule.condition.can_be_refused:
                refusal = refusal_for(rule.condition, seen)
                record.problem = None if refusal is None else f"{topic}: {refusal}"

    def _rules_of(self, topic: str) -> tuple[Rule, ...]:
        known = self._watching.get(topic)
        if known is None:
            known = tuple(each for each in self._rules if each.selects([topic]))
            self._watching[topic] = known
        return known

    def _opened(
        self, part: SearchPart, records: dict[str, RuleRecord]
    ) -> list[tuple[Ns, Callable[[], Iterator[_Event]]]]:
        """Returns the bags of a part that matter, each with the time from which it matters."""
        return [
            (max(bag.start, part.window.start), partial(self._events, bag, part, records))
            for bag in part.bags
            if any(self._rules_of(each.topic) for each in bag.summary.topics)
        ]

    def _events(
        self, bag: BagFile, part: SearchPart, records: dict[str, RuleRecord]
    ) -> Iterator[_Event]:
        """Yields the messages of a bag in a window, in order of log time.

        What cannot be read of it is reported as a problem of the rules.
        """
        topics = list(dict.fromkeys(each.topic for each in bag.summary.topics))
        latched = {each.topic for each in bag.summary.topics if each.latched}
        read: list[str] = []
        times: list[tuple[Ns, str]] = []
        for topic in topics:
            rules = self._rules_of(topic)
            if not rules:
                continue
            if topic not in latched and all(each.condition is None for each in rules):
                times += ((time, topic) for time in self._times(rules, bag, topic, part.window))
            else:
                read.append(topic)
        try:
            found = self._reader.records(bag.path, read, part.window) if read else iter(())
            yield from heapq.merge(
                (_Event(each.log_time, each.channel.topic, part.recording, each) for each in found),
                (_Event(time, topic, part.recording, None) for time, topic in sorted(times)),
                key=lambda event: event.time,
            )
        except BagUnreachableError:
            raise
        except BagError as error:
            for topic in topics:
                for rule in self._rules_of(topic):
                    records[
                        rule.name
                    ].problem = f"not all could be searched: {bag.path.name}: {error.reason}"

    def _times(
        self, rules: Sequence[Rule], bag: BagFile, topic: str, window: TimeWindow
    ) -> Sequence[Ns]:
        """Returns the times of a topic's messages, as far as they can matter to rules."""
        spans = [(each.first, each.last) for each in bag.summary.topics if each.topic == topic]
        first, last = min(each[0] for each in spans), max(each[1] for each in spans)
        shortest = min(
            (each.hold for each in rules if each.kind is RuleKind.SILENT), default=last - first + 1
        )
        if window.covers(first, last) and last - first < shortest:
            return (first, last) if last > first else (first,)
        return self._reader.log_times(bag.path, topic, window)


def _is_repeat(event: _Event, record: Record, state: TriggerState) -> bool:
    """Whether a latched message was received before, in another recording; remembers it if not.

    Every recording receives those of a topic again. What it receives in its first seconds and was
    published long before was so before, whether a recorder saw it or not. Where a format keeps no
    publish time, the first message in a recording is a repeat if it is like the last one.
    """
    mark = state.latched.setdefault(event.topic, LatchedMark())
    payload = hashlib.blake2b(record.payload, digest_size=8).hexdigest()
    others = [each for name, each in mark.published.items() if name != event.recording]
    begun = mark.begun.setdefault(event.recording, event.time)
    if record.publish_time in {0, record.log_time}:
        is_repeat = event.recording not in mark.published and payload == mark.payload
    else:
        is_late = record.publish_time < record.log_time - SILENCE_NS
        is_repeat = (bool(others) and record.publish_time <= max(others)) or (
            is_late and event.time - begun < _BURST_NS
        )
    known = mark.published.pop(event.recording, record.publish_time)
    mark.published[event.recording] = max(known, record.publish_time)
    while len(mark.published) > _MARKED_RECORDINGS:
        oldest = next(iter(mark.published))
        del mark.published[oldest]
        mark.begun.pop(oldest, None)
    if not is_repeat:
        mark.payload = payload
    return is_repeat


def _merged(
    recordings: Iterable[list[tuple[Ns, Callable[[], Iterator[_Event]]]]],
) -> Iterator[_Event]:
    """Merges the events of bags in order of time; a bag is opened when its time has come."""
    bags = sorted((each for part in recordings for each in part), key=lambda each: each[0])
    number = count()
    waiting: list[tuple[Ns, int, _Event, Iterator[_Event]]] = []
    at = 0
    while waiting or at < len(bags):
        while at < len(bags) and (not waiting or bags[at][0] <= waiting[0][0]):
            events = bags[at][1]()
            at += 1
            first = next(events, None)
            if first is not None:
                heapq.heappush(waiting, (first.time, next(number), first, events))
        if not waiting:
            return
        _, order, event, events = waiting[0]
        yield event
        following = next(events, None)
        if following is None:
            heapq.heappop(waiting)
        else:
            heapq.heapreplace(waiting, (following.time, order, following, events))
