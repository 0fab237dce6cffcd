"""One call's sight of single bags: what is read of them, and what is said of those that fail."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.layout import is_carried
from ros2_memory.catalogue.lookup import bags_without_entry
from ros2_memory.core.errors import (
    BagContradictionError,
    BagError,
    BagVanishedError,
    QueryTimeoutError,
)
from ros2_memory.core.model import BagState, TimeWindow
from ros2_memory.core.text import Reason
from ros2_memory.core.timebase import MAX_NS, MIN_NS
from ros2_memory.history.duplicates import StoredMessage

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.catalogue.lookup import SegmentDigests
    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.index.segment import Segment
    from ros2_memory.storage.base import Channel, Record

_CHECK_EVERY: Final = 256
_DELETED: Final = Reason(
    "was deleted before it could be read", "bag", many="were deleted before they could be read"
)
_CONTRADICTS_ITSELF: Final = Reason("contradicts itself", "bag", many="contradict themselves")
_NOT_WHOLE: Final = Reason("could not be read whole", "bag")
_NOT_TO_ITS_END: Final = Reason("could not be read to its end", "bag")


class _Thing(NamedTuple):
    """What is wrong with one thing, and the last log time at which it is."""

    detail: str
    last: Ns


class BagAccess:
    """A snapshot, what the catalogue says of it, a deadline, and notes on the way."""

    def __init__(self, memory: Memory, call: Call, reach: Ns | None = None) -> None:
        self.memory = memory
        self.call = call
        with call.stages.timed("index"):
            self.snapshot = memory.index.snapshot(reach)
        self._as_of: int | None = None
        self._notes: dict[str | Reason, None] = {}
        self._things: dict[Reason, dict[str, _Thing]] = {}
        self._remarks: dict[str, tuple[str, ...]] = {}
        self.complete = True

    @property
    def notes(self) -> tuple[str, ...]:
        """What was skipped so far: each thing once, and one sentence for each reason."""
        # In which order bags are found damaged depends on what the catalogue knows.
        told = {reason: self._told(reason) for reason in self._things}
        sentences = iter(sorted(reason.sentence(those) for reason, those in told.items() if those))
        return tuple(
            each if isinstance(each, str) else next(sentences)
            for each in self._notes
            if isinstance(each, str) or told[each]
        )

    def _told(self, reason: Reason) -> dict[str, str]:
        """By name, the details of the things that no remark on their bag gives already."""
        return {
            name: each.detail
            for name, each in self._things[reason].items()
            if each.detail not in self._remarks.get(name, ())
        }

    def note_remarks(self, bags: Iterable[BagFile]) -> None:
        """Remembers that sentences give what the summaries of these bags remark."""
        self._remarks |= {short_name(bag.path): bag.summary.remarks for bag in bags}

    def note(self, sentence: str) -> None:
        """Adds a sentence for the reply."""
        self._notes.setdefault(sentence)

    def note_thing(self, reason: Reason, name: str, detail: str = "", last: Ns = MAX_NS) -> None:
        """Adds a thing to the sentence on a reason.

        `last`: no part of it lies after this log time.
        """
        self._notes.setdefault(reason)
        things = self._things.setdefault(reason, {})
        known = things.get(name)
        if known is None or known.last < last:
            things[name] = _Thing(detail, last)

    def has_noted(self, bag: BagFile) -> bool:
        """Whether sentences on what was read of a bag give all that its summary remarks."""
        name = short_name(bag.path)
        if name in self._remarks:
            return False
        told = {things[name].detail for things in self._things.values() if name in things}
        return told.issuperset(bag.summary.remarks)

    def noted_things(self) -> frozenset[tuple[Reason, str]]:
        """The things that sentences are on so far."""
        return frozenset((reason, name) for reason, held in self._things.items() for name in held)

    def check_deadline(self) -> None:
        """Gives up when the call's time is over.

        Raises:
            QueryTimeoutError: it is.
        """
        deadline = self.call.deadline
        if deadline.expired():
            raise QueryTimeoutError(
                f"the question needs more than {deadline.budget_s:g} s; {self.behind()}"
                "ask about a shorter window or a single topic"
            )

    def behind(self) -> str:
        """How far the catalogue is, for a sentence on lack of time; empty where that is no cause.

        Bags without an entry are read for every question, which takes long where they are many.
        """
        recall = self.memory.recall
        closed = sum(bag.state is BagState.CLOSED for bag in self.snapshot.bags)
        if recall is None or not closed:
            return ""
        missing = len(bags_without_entry(self.snapshot.runs, recall))
        if missing * 100 <= closed:
            return ""
        return (
            f"the catalogue, which makes such questions quick, has {closed - missing} of {closed} "
            "bags so far: wait for it, or "
        )

    def recalled(self, run: Segment) -> SegmentDigests | None:
        """What the catalogue says of a run of the snapshot; None without a catalogue."""
        recall = self.memory.recall
        if recall is None:
            return None
        settled = recall.settled(run)
        if settled is not None:
            return settled
        if self._as_of is None:
            # Once for each question, and only where the catalogue may have come to know more.
            self._as_of = recall.as_of()
        return recall.notes(run, self._as_of)

    def entry(self, bag: BagFile) -> tuple[SegmentDigests, int] | None:
        """The notes that speak of a bag and the number of its entry; None where it has none."""
        notes = self.recalled(self.snapshot.run_of(bag))
        number = None if notes is None else notes.numbers.get(bag.file)
        return None if notes is None or number is None else (notes, number)

    def used(self, found: Iterator[StoredMessage]) -> Iterator[StoredMessage]:
        """The messages; where one stands in a bag that a crash left open, they are not all.

        Remembers whether one stands in a bag that is still being written.
        """
        for each in found:
            if each.bag.state is BagState.INCOMPLETE:
                self.complete = False
            elif each.bag.state is BagState.ACTIVE:
                self.call.sources.active = True
            yield each

    def count_all(self) -> None:
        """As `used` for an answer that is about all bags as the index knows them."""
        if any(aside.until is not None for aside in self.snapshot.active):
            self.call.sources.active = True

    def log_times(self, bag: BagFile, topic: str, window: TimeWindow) -> Sequence[Ns]:
        """The log times of one bag's messages; empty, with a note, where they cannot be read."""
        self.check_deadline()
        with self.call.stages.timed("read"):
            try:
                return self.memory.reader.log_times(bag.path, topic, _known(bag, window))
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

    def skip(self, bag: BagFile, error: BagError, since: Ns = MIN_NS) -> None:
        """Notes that a bag, or some of it, is not part of the answer, be it since a moment."""
        self.complete &= isinstance(error, BagContradictionError)
        last = bag.end if error.lost is None else error.lost[1]
        if last < since:
            return
        name = short_name(bag.path)
        if isinstance(error, BagVanishedError):
            self.note_thing(_DELETED, name, last=last)
        elif isinstance(error, BagContradictionError):
            self.note_thing(_CONTRADICTS_ITSELF, name, error.reason, last)
        else:
            reason = _NOT_TO_ITS_END if error.lost is None else _NOT_WHOLE
            self.note_thing(reason, name, error.reason, last)

    def retract_notes_before(
        self, moment: Ns, said: Collection[tuple[Reason, str]] = frozenset()
    ) -> None:
        """Takes back the notes on what could not be read where all of it lies before a moment.

        For a question that did not need it: how far back is read besides what is asked for depends
        on what the catalogue knows. What was `said` before (`noted_things`) stands.
        """
        for reason, things in self._things.items():
            self._things[reason] = {
                name: each
                for name, each in things.items()
                if each.last >= moment or (reason, name) in said
            }

    def read(
        self,
        bag: BagFile,
        topics: Sequence[str],
        window: TimeWindow,
        *,
        newest_first: bool = False,
        since: Ns = MIN_NS,
    ) -> Iterator[StoredMessage]:
        """One bag's messages; what of it cannot be read is noted, and disturbs no other.

        Not noted is what is lost before `since` alone: what is read there is read for copies only.
        """
        self.check_deadline()
        kept = self._kept(bag, topics)
        if kept is None:
            known = _known(bag, window)
            return self._read(bag, topics, known, newest_first=newest_first, since=since)
        ordered = reversed(kept) if newest_first else iter(kept)
        return (StoredMessage(bag, each) for each in ordered if window.contains(each.log_time))

    def _read(
        self,
        bag: BagFile,
        topics: Sequence[str],
        window: TimeWindow,
        *,
        newest_first: bool,
        since: Ns,
    ) -> Iterator[StoredMessage]:
        records: Iterator[Record] | None = None
        clock, spent, count = time.perf_counter_ns, 0, 0
        while True:
            begin = clock()
            try:
                if records is None:
                    reader = self.memory.reader
                    records = reader.records(bag.path, topics, window, newest_first=newest_first)
                for record in records:
                    spent += clock() - begin
                    count += 1
                    if count % _CHECK_EVERY == 0:
                        self.check_deadline()
                    yield StoredMessage(bag, record)
                    begin = clock()
            except BagError as error:
                self.skip(bag, error, since)
                if error.lost is None:
                    return
            else:
                return
            finally:
                self.call.stages.add("read", spent)
                spent = 0

    def newest_in(self, bag: BagFile, topic: str, window: TimeWindow) -> StoredMessage | None:
        """What `read` gives first when it reads newest first; for less."""
        if self._kept(bag, [topic]) is not None:
            return next(self.read(bag, [topic], window, newest_first=True), None)
        self.check_deadline()
        begin = time.perf_counter_ns()
        try:
            record = self.memory.reader.newest(bag.path, topic, _known(bag, window))
        except BagVanishedError as error:
            self.skip(bag, error)
            return None
        except BagError:
            # Others of its messages may be whole.
            return next(self.read(bag, [topic], window, newest_first=True), None)
        finally:
            self.call.stages.add("read", time.perf_counter_ns() - begin)
        return None if record is None else StoredMessage(bag, record)

    def _kept(self, bag: BagFile, topics: Sequence[str]) -> Sequence[Record] | None:
        """All the bag's messages of one topic of which the catalogue keeps them; else None."""
        if self.memory.recall is None or len(topics) != 1:
            return None
        [topic] = topics
        if is_carried(bag.path):  # of which recording a message was its channel says
            return None
        static = topic in self.memory.limits.tf_static_topics
        if not static and not self.snapshot.is_transient_local(topic):
            return None
        entry = self.entry(bag)
        if entry is None:
            return None
        notes, number = entry
        return notes.kept(topic).get(number)


def _known(bag: BagFile, window: TimeWindow) -> TimeWindow:
    """The part of a window in which the index knows the bag: one being written grows meanwhile."""
    if bag.state is not BagState.ACTIVE:
        return window
    return window.intersect(TimeWindow.until(bag.end))


def short_name(path: Path) -> str:
    """A bag as a reply names it: recording and file, never a path of the machine."""
    return f"{path.parent.name}/{path.name}"
