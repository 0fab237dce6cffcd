"""Many bags read as one history: in log-time order, each message once, what was skipped named.

Besides the overlap of recordings (see `copies`), a new recording receives the latched messages
again: a new log time, the original publish time. Such a message counts once too, at its earliest
log time, however long ago that is.
"""

from __future__ import annotations

import heapq
import time
from collections import deque
from itertools import islice
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.copies import (
    COPY_HORIZON_NS,
    Copy,
    Found,
    Holding,
    contested,
    copy_key,
    once_backward,
    once_forward,
)
from ros2_memory.errors import BagError, BagVanishedError, QueryTimeoutError
from ros2_memory.model import BagFile, BagState, TimeWindow
from ros2_memory.sampling import evenly
from ros2_memory.timebase import MIN_NS, NS_PER_S, Ns

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.memory import Call, Memory
    from ros2_memory.storage.base import Channel

RECEIVED_AGAIN_NS: Final[Ns] = NS_PER_S
"""A latched message logged this long after it was published may have been received before."""
_CHECK_EVERY: Final = 256


class Census(NamedTuple):
    """Log times of the earliest and latest message (inclusive), and how many there are."""

    first: Ns
    last: Ns
    count: int


class View:
    """One call's consistent sight of the memory: a snapshot, a deadline, and notes on the way."""

    def __init__(self, memory: Memory, call: Call, reach: Ns | None = None) -> None:
        self.memory = memory
        self.call = call
        with call.stages.timed("index"):
            self.snapshot = memory.index.snapshot(reach)
        self._notes: dict[str, None] = {}
        self._first_copies: dict[Copy, Ns] = {}
        self.complete = True

    @property
    def notes(self) -> tuple[str, ...]:
        """What was skipped so far, each thing once."""
        return tuple(self._notes)

    def note(self, sentence: str) -> None:
        """Adds a sentence for the reply."""
        self._notes.setdefault(sentence)

    def check_deadline(self) -> None:
        """Gives up when the call's time is over.

        Raises:
            QueryTimeoutError: it is.
        """
        deadline = self.call.deadline
        if deadline.expired():
            raise QueryTimeoutError(
                f"the question needs more than {deadline.budget_s:g} s; "
                "ask about a shorter window or a single topic"
            )

    def holdings(self, topics: Iterable[str], window: TimeWindow) -> list[Holding]:
        """The bags that hold messages of these topics in the window, in bag order."""
        spans: dict[Path, Holding] = {}
        for topic in topics:
            for bag, summary in self.snapshot.holding(topic, window):
                known = spans.get(bag.path)
                first = min(known.first, summary.first) if known else summary.first
                last = max(known.last, summary.last) if known else summary.last
                spans[bag.path] = Holding(first, last, bag)
        return sorted(spans.values(), key=lambda held: (held.first, held.last, held.bag.path))

    def stream(
        self,
        topics: Sequence[str],
        window: TimeWindow,
        *,
        newest_first: bool = False,
        among: Sequence[Holding] | None = None,
    ) -> Iterator[Found]:
        """The messages of the topics in the window in log-time order, each one once.

        `among` narrows the search to some of the bags.

        Raises:
            QueryTimeoutError: the deadline passed on the way.
        """
        wider = TimeWindow(max(window.start - COPY_HORIZON_NS, MIN_NS), window.stop)
        holdings = self.holdings(topics, wider) if among is None else among
        spans = contested(holdings)
        if spans:
            merged = self._merged(holdings, topics, wider, newest_first=newest_first)
            once = (once_backward if newest_first else once_forward)(merged, spans)
            found = (each for each in once if window.contains(each.time))
        else:
            found = self._merged(holdings, topics, window, newest_first=newest_first)
        if self._received_twice(topics):
            return (each for each in found if not self._received_again(each))
        return found

    def newest(self, topic: str, window: TimeWindow) -> Found | None:
        """The latest message of the topic in the window."""
        return next(self.stream([topic], window, newest_first=True), None)

    def oldest(self, topic: str, window: TimeWindow) -> Found | None:
        """The earliest message of the topic in the window."""
        return next(self.stream([topic], window), None)

    def pick(self, topic: str, window: TimeWindow, at_most: int) -> tuple[int, list[Found]]:
        """How many messages the window holds, and `at_most` of them, evenly spaced.

        The first and the last are always among them. Reads payloads of the chosen ones only,
        except where recordings overlap or latched messages may have been received again.
        """
        groups = self._groups(topic, window)
        sizes = [group.count() for group in groups]
        total = sum(sizes)
        chosen: list[Found] = []
        begin, position = 0, 0
        indices = evenly(total, at_most)
        for group, size in zip(groups, sizes, strict=True):
            local = []
            while position < len(indices) and indices[position] < begin + size:
                local.append(indices[position] - begin)
                position += 1
            chosen.extend(group.fetch(local))
            begin += size
        return total, chosen

    def census(self, topic: str) -> dict[str, Census]:
        """What is recorded of a topic under each of its types, each message counted once."""
        stated: dict[str, Census] = {}
        for _, each in self.snapshot.holding(topic):
            known = stated.get(each.type, Census(each.first, each.last, 0))
            stated[each.type] = Census(
                min(known.first, each.first), max(known.last, each.last), known.count + each.count
            )
        everything = TimeWindow.everything()
        if self._received_twice([topic]):
            return _counted(self.stream([topic], everything))
        holdings = self.holdings([topic], everything)
        for span in contested(holdings):
            window = TimeWindow(*span)
            involved = [held for held in holdings if window.overlaps(held.first, held.last)]
            standing = _counted(self._merged(involved, [topic], window, newest_first=False))
            merged = self._merged(involved, [topic], window, newest_first=False)
            for type_name, once in _counted(once_forward(merged, [span])).items():
                both, known = standing[type_name], stated[type_name]
                last = once.last if both.last == known.last else known.last
                stated[type_name] = Census(known.first, last, known.count - both.count + once.count)
        return stated

    def _groups(self, topic: str, window: TimeWindow) -> list[_Group]:
        holdings = self.holdings([topic], window)
        if self._received_twice([topic]) and holdings:
            return [_Group(self, topic, window, holdings)]
        groups: list[list[Holding]] = []
        reach = MIN_NS
        for held in holdings:
            if groups and _belongs(held, groups[-1], reach):
                groups[-1].append(held)
            else:
                groups.append([held])
            reach = max(reach, held.last)
        return [_Group(self, topic, window, group) for group in groups]

    def _received_twice(self, topics: Iterable[str]) -> bool:
        """Whether a latched message of these topics may have been received by two recordings."""
        return any(
            self.snapshot.is_latched(topic)
            and len({bag.recording for bag, _ in self.snapshot.holding(topic)}) > 1
            for topic in topics
        )

    def _received_again(self, found: Found) -> bool:
        record = found.record
        if not record.channel.latched or found.time - record.publish_time <= RECEIVED_AGAIN_NS:
            return False
        key = copy_key(record)
        if key not in self._first_copies:
            topic = record.channel.topic
            window = TimeWindow(max(record.publish_time - COPY_HORIZON_NS, MIN_NS), found.time)
            holdings = self.holdings([topic], window)
            earlier = self._merged(holdings, [topic], window, newest_first=False)
            self._first_copies[key] = next(
                (
                    each.time
                    for each in earlier
                    if each.bag.recording != found.bag.recording and copy_key(each.record) == key
                ),
                found.time,
            )
        return found.time > self._first_copies[key]

    def _merged(
        self,
        holdings: Sequence[Holding],
        topics: Sequence[str],
        window: TimeWindow,
        *,
        newest_first: bool,
    ) -> Iterator[Found]:
        """All messages in order, opening a bag only when the stream reaches it."""
        sign = -1 if newest_first else 1
        waiting = deque(
            sorted(
                enumerate(holdings),
                key=lambda held: (
                    (-held[1].last, -held[0]) if newest_first else (held[1].first, held[0])
                ),
            )
        )
        heap: list[tuple[int, int, Found, Iterator[Found]]] = []

        def push(rank: int, source: Iterator[Found]) -> None:
            found = next(source, None)
            if found is not None:
                heapq.heappush(heap, (sign * found.time, rank, found, source))

        while heap or waiting:
            while waiting and (
                not heap or _edge(waiting[0][1], newest_first=newest_first) <= heap[0][0]
            ):
                index, held = waiting.popleft()
                push(sign * index, self.read(held.bag, topics, window, newest_first=newest_first))
            if heap:
                _, rank, found, source = heapq.heappop(heap)
                yield found
                push(rank, source)

    def log_times(self, bag: BagFile, topic: str, window: TimeWindow) -> Sequence[Ns]:
        """The log times of one bag's messages; empty, with a note, where they cannot be read."""
        self.check_deadline()
        with self.call.stages.timed("read"):
            try:
                return self.memory.reader.log_times(bag.path, topic, window)
            except BagError as error:
                self.skip(bag, error)
                return ()

    def channels(self, bag: BagFile) -> Sequence[Channel]:
        """The channels one bag declares; none, with a note, where they cannot be read."""
        self.check_deadline()
        try:
            return self.memory.reader.channels(bag.path)
        except BagError as error:
            self.skip(bag, error)
            return ()

    def skip(self, bag: BagFile, error: BagError) -> None:
        """Notes that a bag, or the rest of it, is not part of the answer."""
        self.complete = False
        name = short_name(bag.path)
        if isinstance(error, BagVanishedError):
            self.note(f"{name} was deleted before it could be read")
        else:
            self.note(f"{name} could not be read to its end: {error.reason}")

    def read(
        self,
        bag: BagFile,
        topics: Sequence[str],
        window: TimeWindow,
        *,
        newest_first: bool = False,
    ) -> Iterator[Found]:
        """One bag's messages; a bag that fails ends early with a note, and disturbs no other."""
        self.check_deadline()
        if bag.state is BagState.INCOMPLETE:
            self.complete = False
            self.note(
                f"{short_name(bag.path)} was left open by a crash; what is readable of it is used"
            )
        clock, spent, count = time.perf_counter_ns, 0, 0
        begin = clock()
        try:
            for record in self.memory.reader.records(
                bag.path, topics, window, newest_first=newest_first
            ):
                spent += clock() - begin
                count += 1
                if count % _CHECK_EVERY == 0:
                    self.check_deadline()
                yield Found(bag, record)
                begin = clock()
        except BagError as error:
            self.skip(bag, error)
        finally:
            self.call.stages.add("read", spent)


class _Group:
    """Bags of one topic whose messages must be ordered, and told apart, together."""

    def __init__(
        self, view: View, topic: str, window: TimeWindow, holdings: Sequence[Holding]
    ) -> None:
        self._view = view
        self._topic = topic
        self._window = window
        self._holdings = holdings
        self._one_recording = len({held.bag.recording for held in holdings}) == 1
        self._places: list[Place] | None = None

    def count(self) -> int:
        """How many messages of the window the group holds."""
        if not self._one_recording:
            return sum(1 for _ in self._once())
        held = self._holdings[0]
        if len(self._holdings) == 1 and self._window.covers(held.first, held.last):
            stated = self._view.snapshot.holding(self._topic)
            return sum(each.count for bag, each in stated if bag is held.bag)
        return len(self._located())

    def fetch(self, indices: Sequence[int]) -> Iterator[Found]:
        """The messages at these positions of the group, which must ascend."""
        if not indices:
            return
        if not self._one_recording:
            wanted = set(indices)
            yield from (each for index, each in enumerate(self._once()) if index in wanted)
            return
        places = self._located()
        for index in indices:
            place = places[index]
            moment = TimeWindow(place.time, place.time + 1)
            bag = self._holdings[place.rank].bag
            at_once = self._view.read(bag, [self._topic], moment)
            yield from islice(at_once, place.nth, place.nth + 1)

    def _once(self) -> Iterator[Found]:
        return self._view.stream([self._topic], self._window, among=self._holdings)

    def _located(self) -> list[Place]:
        if self._places is None:
            places = [
                Place(moment, rank, nth)
                for rank, held in enumerate(self._holdings)
                for moment, nth in _numbered(
                    self._view.log_times(held.bag, self._topic, self._window)
                )
            ]
            self._places = sorted(places) if len(self._holdings) > 1 else places
        return self._places


class Place(NamedTuple):
    """Where a message of a group stands: the nth of its bag at exactly that log time."""

    time: Ns
    rank: int
    nth: int


def _numbered(times: Iterable[Ns]) -> Iterator[tuple[Ns, int]]:
    before, nth = None, 0
    for moment in times:
        nth = nth + 1 if moment == before else 0
        before = moment
        yield moment, nth


def _counted(found: Iterable[Found]) -> dict[str, Census]:
    """A census by message type of an ascending stream."""
    counted: dict[str, Census] = {}
    for each in found:
        known = counted.get(each.record.channel.type)
        first, count = (known.first, known.count) if known else (each.time, 0)
        counted[each.record.channel.type] = Census(first, each.time, count + 1)
    return counted


def _edge(held: Holding, *, newest_first: bool) -> Ns:
    """The first moment at which a bag can have something for the stream, in the heap's sign."""
    return -held.last if newest_first else held.first


def _belongs(held: Holding, group: Sequence[Holding], reach: Ns) -> bool:
    """Whether a bag can hold messages before, or copies of, the end of a group.

    Splits of one recording that only share a timestamp stay apart: bag order already orders them.
    """
    if all(each.bag.recording == held.bag.recording for each in group):
        return held.first < reach
    return held.first <= reach + COPY_HORIZON_NS


def short_name(path: Path) -> str:
    """A bag as a reply names it: recording and file, never a path of the machine."""
    return f"{path.parent.name}/{path.name}"
