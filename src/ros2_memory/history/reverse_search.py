"""Searching the history backwards for the last time that a condition held."""

from __future__ import annotations

import heapq
import time
from typing import TYPE_CHECKING, NamedTuple

from ros2_memory.analysis.testable import can_be_untestable, untestable
from ros2_memory.core.errors import InvalidArgumentsError, QueryTimeoutError, UndecodableError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.text import Reason
from ros2_memory.core.timebase import MIN_NS
from ros2_memory.history.coverage import is_covered, note_unread, unix_text
from ros2_memory.history.duplicates import COPY_HORIZON_NS
from ros2_memory.history.no_data import matching_topics, undecodable_in
from ros2_memory.history.notes import Note

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.analysis.conditions import Condition
    from ros2_memory.catalogue.lookup import SegmentDigests
    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.history.view import View
    from ros2_memory.index.segment import Segment


def last_match(view: View, pattern: str, condition: Condition, until: Ns) -> StoredMessage | None:
    """The newest match before a moment; what could not be tested is noted.

    Raises:
        InvalidArgumentsError: no value of the topics can meet the condition.
        QueryTimeoutError: the call's time is over; says how far back was searched.
    """
    return Search(view, pattern, condition).newest(until)


class Search:
    """One condition on the topics of a name or glob.

    Attributes:
        topics: the recorded topics that are meant.

    Raises:
        NoDataError: there is no such topic.
    """

    def __init__(self, view: View, pattern: str, condition: Condition) -> None:
        self._view = view
        self._condition = condition
        self.topics = matching_topics(view, pattern)
        self._failures: dict[tuple[str, str], tuple[UndecodableError, Ns]] = {}
        self._tested = False
        self._back_to: Ns | None = None

    def candidates(self, until: Ns) -> CandidateBags:
        """The bags that may hold a match before a moment."""
        return CandidateBags(self._view, self.topics, self._condition, until)

    def newest(self, until: Ns) -> StoredMessage | None:
        """The newest match before a moment, as `last_match` gives it."""
        candidates = self.candidates(until)
        said = self._view.notes.keys()
        try:
            for stretch in candidates.stretches():
                for found in self._messages(stretch):
                    if self.matches(found):
                        self._view.notes.retract_before(found.time, said)
                        self._view.stream.find_first_copy(found)
                        self.note_undecodable()
                        return found
                    self._back_to = found.time
                self._back_to = stretch.window.start
        except QueryTimeoutError as error:
            if self._back_to is None:
                raise
            raise self._out_of_time(self._back_to) from error
        self.close(candidates, TimeWindow(MIN_NS, until), found=False)
        return None

    def close(self, candidates: CandidateBags, window: TimeWindow, *, found: bool) -> None:
        """Ends a search that looked everywhere in a window: notes what could not be tested.

        Raises:
            InvalidArgumentsError: nothing was found, and no value of the topics can be a match.
            NoDataError: nothing was found, since no message could be decoded.
        """
        if not found and self._failures and not self._tested and not candidates.ruled_out:
            failure, _ = next(iter(self._failures.values()))
            if len(self._failures) > 1:
                self.note_undecodable()
            raise undecodable_in(self._view, window, failure)
        self.note_undecodable()
        if not found:
            self._require_testable()

    def _require_testable(self) -> None:
        """Refuses to call "never" what no value of these topics can meet.

        Raises:
            InvalidArgumentsError: the newest value of none of the topics has what is tested.
        """
        if not can_be_untestable(self._condition):
            return
        first: str | None = None
        for topic in self.topics:
            reason = self._refusal(topic)
            if reason is None:
                return
            first = first or reason
        raise InvalidArgumentsError(f"{self.topics[0]}: {first}")

    def _refusal(self, topic: str) -> str | None:
        found = self._view.stream.newest(topic, TimeWindow.everything())
        if found is None:
            return None
        try:
            message = self._view.memory.reader.decode(found.record)
        except UndecodableError:
            return None
        value = self._view.memory.extractor.exact(message, found.record.channel.type)
        return untestable(self._condition, value)

    def _messages(self, stretch: SearchWindow) -> Iterator[StoredMessage]:
        """The messages of a stretch, newest first.

        Of bags that are ruled out those are read which may hold the original of a copy. Of topics
        none is: a stretch of a topic may be as short as a message, and there may be thousands.
        """
        window = stretch.window
        wider = TimeWindow(max(window.start - COPY_HORIZON_NS, MIN_NS), window.stop)
        among = [
            held
            for held in self._view.stream.overlapping_bags(stretch.topics, wider)
            if held.bag.file in stretch.bags or stretch.recordings != {held.bag.recording}
        ]
        return self._view.stream.messages(stretch.topics, window, newest_first=True, among=among)

    def matches(self, found: StoredMessage) -> bool | None:
        """Whether a message meets the condition; None where it cannot be decoded."""
        begin = time.perf_counter_ns()
        channel = found.record.channel
        memory = self._view.memory
        try:
            message = memory.reader.decode(found.record)
            value = memory.extractor.exact(message, channel.type)
            self._tested = True
            return self._condition.matches(value)
        except UndecodableError as error:
            # One that was raised keeps all that was on the way, the message with it.
            alone = UndecodableError(error.topic, error.type_name, error.reason)
            self._failures.setdefault((channel.topic, channel.type), (alone, found.time))
            return None
        finally:
            self._view.call.stages.add("extract", time.perf_counter_ns() - begin)

    def note_undecodable(self, since: Ns = MIN_NS) -> None:
        """Notes what could not be tested since a moment, of a search newest first."""
        for (topic, type_name), (error, newest) in self._failures.items():
            if newest < since:
                continue
            self._view.notes.complete = False
            reason = Reason(f"could not be decoded: {error.reason}", "topic", of="messages of ")
            self._view.notes.add(Note(reason, f"{topic} ({type_name})"))

    def _out_of_time(self, back_to: Ns) -> QueryTimeoutError:
        budget_s = self._view.call.deadline.budget_s
        return QueryTimeoutError(
            f"no match back to {unix_text(back_to)}, and {budget_s:g} s are over; "
            f"{self._view.bags.backfill_progress()}to go on from there, ask again with "
            f"before={unix_text(back_to)}",
            searched_back_to=back_to,
        )


def unsearched(view: View, window: TimeWindow | None = None) -> tuple[str, ...]:
    """Why a search of a window (or of everything) without a match was not complete.

    Empty where it was.
    """
    searched = window or TimeWindow.everything()
    if is_covered(view, searched):
        return ()
    note_unread(view, searched, nothing=True)
    return view.notes.sentences()


class SearchWindow(NamedTuple):
    """A half-open span of time, and what in it is not ruled out: the topics, and the files."""

    window: TimeWindow
    topics: tuple[str, ...]
    bags: frozenset[str]
    recordings: frozenset[Path]


class _Candidate(NamedTuple):
    """A bag that may hold a match on a topic between two log times (inclusive)."""

    first: Ns
    last: Ns
    topic: str
    bag: BagFile


class CandidateBags:
    """Looks for bags that may hold a match on any of the topics.

    Attributes:
        ruled_out: whether a bag was passed over; each of its messages could be decoded.
    """

    def __init__(self, view: View, topics: Sequence[str], condition: Condition, until: Ns) -> None:
        self._view = view
        self._topics = topics
        self._condition = condition
        self._until = until
        self.ruled_out = False

    def stretches(self) -> Iterator[SearchWindow]:
        """The stretches in which a match may lie before `until`, newest first, none twice."""
        group: list[_Candidate] = []
        start = until = self._until
        for each in self._newest_first():
            if group and each.last < start:
                yield _stretch(group, start, until)
                group, until = [], start
            group.append(each)
            start = min(start, each.first)
        if group:
            yield _stretch(group, start, until)

    def _newest_first(self) -> Iterator[_Candidate]:
        """The bags that may hold a match, by the time of their last message of the topic."""
        runs = [
            (-run.spans[topic][1], -rank, order, topic, run)
            for rank, run in enumerate(self._view.snapshot.runs)
            for order, topic in enumerate(self._topics)
            if topic in run.spans and run.spans[topic][0] < self._until
        ]
        heapq.heapify(runs)
        waiting: list[tuple[Ns, int, _Candidate]] = []
        count = 0
        while runs or waiting:
            if runs and (not waiting or runs[0][0] <= waiting[0][0]):
                *_, topic, run = heapq.heappop(runs)
                self._view.bags.check_deadline()
                for each in self._in_run(run, topic):
                    count += 1
                    heapq.heappush(waiting, (-each.last, count, each))
            else:
                yield heapq.heappop(waiting)[2]

    def _in_run(self, run: Segment, topic: str) -> Iterator[_Candidate]:
        notes = self._view.bags.digests_of(run)
        known = {} if notes is None else notes.numbers
        possible: Collection[int] = ()
        if notes is not None and known:
            if self._condition.can_match(notes.zone_map(topic)):
                possible = self._possible(notes, topic)
            if notes.whole and not possible:
                self.ruled_out = True
                return
        for bag, first, last in run.extents(topic):
            if first >= self._until:
                continue
            number = known.get(bag.file)
            if number is None or number in possible:
                yield _Candidate(first, last, topic, bag)
            else:
                self.ruled_out = True

    def _possible(self, notes: SegmentDigests, topic: str) -> Collection[int]:
        """The entries that may hold a match."""
        place = self._condition.place
        if place is not None:
            boxes = notes.boxes(topic)
            return boxes.meeting(place.x, place.y, place.z, place.tolerance_m)
        said = notes.zone_maps(topic)
        return {number for number, each in said.items() if self._condition.can_match(each)}


def _stretch(group: Sequence[_Candidate], start: Ns, until: Ns) -> SearchWindow:
    stop = min(until, max(each.last for each in group) + 1)
    bags = [each.bag for each in group]
    return SearchWindow(
        TimeWindow(start, stop),
        tuple(sorted({each.topic for each in group})),
        frozenset(bag.file for bag in bags),
        frozenset(bag.recording for bag in bags),
    )
