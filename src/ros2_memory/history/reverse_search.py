"""Searching the history backwards for the last time that a condition held."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from ros2_memory.analysis.testable import can_be_untestable, untestable
from ros2_memory.core.errors import (
    InvalidArgumentsError,
    QueryTimeoutError,
    UndecodableError,
)
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.text import Reason
from ros2_memory.core.timebase import MIN_NS
from ros2_memory.history.candidates import CandidateBags
from ros2_memory.history.coverage import matching_topics, moment, undecodable_in
from ros2_memory.history.duplicates import COPY_HORIZON_NS
from ros2_memory.history.unseen import is_searched, note_unread

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ros2_memory.analysis.conditions import Condition
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.candidates import SearchWindow
    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.history.view import View


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
        said = self._view.noted_things()
        try:
            for stretch in candidates.stretches():
                for found in self._messages(stretch):
                    if self.matches(found):
                        self._view.retract_notes_before(found.time, said)
                        self._view.seek_first(found)
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
            (topic, type_name), (failure, _) = next(iter(self._failures.items()))
            if len(self._failures) > 1:
                self.note_undecodable()
            raise undecodable_in(self._view, window, topic, type_name, failure)
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
        found = self._view.newest(topic, TimeWindow.everything())
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
            for held in self._view.holdings(stretch.topics, wider)
            if held.bag.file in stretch.bags or stretch.recordings != {held.bag.recording}
        ]
        return self._view.stream(stretch.topics, window, newest_first=True, among=among)

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
            self._view.complete = False
            reason = Reason(f"could not be decoded: {error.reason}", "topic", of="messages of ")
            self._view.note_thing(reason, f"{topic} ({type_name})")

    def _out_of_time(self, back_to: Ns) -> QueryTimeoutError:
        budget_s = self._view.call.deadline.budget_s
        return QueryTimeoutError(
            f"no match back to {moment(back_to)}, and {budget_s:g} s are over; "
            f"{self._view.behind()}to go on from there, ask again with before={moment(back_to)}",
            searched_back_to=back_to,
        )


def unsearched(view: View, window: TimeWindow | None = None) -> tuple[str, ...]:
    """Why a search of a window (or of everything) without a match was not complete.

    Empty where it was.
    """
    searched = window or TimeWindow.everything()
    if is_searched(view, searched):
        return ()
    note_unread(view, searched, nothing=True)
    return view.notes
