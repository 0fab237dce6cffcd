"""Access to single bags within one call: what is read of them, and notes on those that fail."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.layout import is_thinned
from ros2_memory.columns.decode import Group, undecoded
from ros2_memory.columns.fill import is_settled
from ros2_memory.columns.scanner import DECODED_BYTES
from ros2_memory.core.errors import (
    BagContradictionError,
    BagError,
    BagVanishedError,
    QueryTimeoutError,
    UndecodableError,
)
from ros2_memory.core.model import BagFile, BagState, TimeWindow
from ros2_memory.core.text import Reason
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Deadline, Ns
from ros2_memory.history.context import Call, Memory, Note, Notes, short_name
from ros2_memory.history.stored_message import StoredMessage

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.columns.table import Table
    from ros2_memory.storage.base import Channel, Record

_DEADLINE_CHECK_INTERVAL: Final = 256
"""Messages between two looks at the deadline."""
_DELETED: Final = Reason(
    "was deleted before it could be read", "bag", many="were deleted before they could be read"
)
_CONTRADICTS_ITSELF: Final = Reason("contradicts itself", "bag", many="contradict themselves")
_NOT_WHOLE: Final = Reason("could not be read whole", "bag")
_NOT_TO_ITS_END: Final = Reason("could not be read to its end", "bag")


class BagAccess:
    """Reads the bags of one snapshot, with a deadline.

    A bag that cannot be read raises nothing here: a note reports it, and the other bags answer.

    Attributes:
        snapshot: the index as it was when the call began; the same for the whole call.
        notes: what the reply reports besides its answer.
    """

    def __init__(self, memory: Memory, call: Call, reach: Ns | None) -> None:
        self.memory = memory
        self.call = call
        with call.stages.timed("index"):
            self.snapshot = memory.snapshot(reach)
        call.saw(self.snapshot)
        self.notes = Notes()
        self._deadline = call.deadline

    def end_early(self, left_s: float) -> None:
        """Ends reading so long before the call's time is over, or after half of it."""
        deadline = self.call.deadline
        at_s = deadline.at_s - min(left_s, deadline.budget_s / 2)
        self._deadline = replace(deadline, at_s=at_s)

    def finish_within(self, budget_s: float) -> None:
        """Gives a call the rest of its time, at least so much, to say what it found."""
        deadline = self.call.deadline
        is_enough = deadline.left_s() >= budget_s
        self._deadline = deadline if is_enough else Deadline.after(budget_s)

    def check_deadline(self) -> None:
        """Checks that the call has time left.

        Raises:
            QueryTimeoutError: it has none.
        """
        if self._deadline.expired():
            budget_s = self.call.deadline.budget_s
            raise QueryTimeoutError(
                f"the question needs more than {budget_s:g} s; {self.filling_progress()}"
                "ask about a shorter window or a single topic"
            )

    def filling_progress(self) -> str:
        """Returns how many bags are stored as columns, as part of a sentence on lack of time.

        Others are read for every question, which takes long where there are many. Empty where that
        is less than 1 % of them: then it is not the cause.
        """
        coverage = self.memory.scanner.coverage(self.snapshot.timeline)
        if coverage is None:
            return ""
        bags = self.snapshot.timeline.closed
        missing = sum(bag.state is BagState.CLOSED for bag in coverage.missing)
        if missing * 100 <= bags:
            return ""
        return (
            f"the store of columns, which makes such questions quick, has {bags - missing} of "
            f"{bags} bags so far: wait for it, or "
        )

    def track_sources(self, messages: Iterator[StoredMessage]) -> Iterator[StoredMessage]:
        """Yields the messages, and records what kind of bags they are from.

        A bag that a crash left open makes the answer incomplete; of one that is still being
        written the reply has to report that it was used.
        """
        for message in messages:
            self._track_source(message.bag)
            yield message

    def _track_source(self, bag: BagFile) -> None:
        if bag.state is BagState.INCOMPLETE:
            self.notes.complete = False
        elif bag.state is BagState.ACTIVE:
            self.call.used_active = True

    def track_all_sources(self) -> None:
        """Records that an answer is about all bags of the index, also those being written."""
        if any(aside.until is not None for aside in self.snapshot.active):
            self.call.used_active = True

    def channels(self, bag: BagFile) -> Sequence[Channel]:
        """Returns the channels one bag declares; none, with a note, where it is damaged."""
        self.check_deadline()
        try:
            return self.memory.reader.channels(bag.path)
        except BagError as error:
            self._note_unreadable(bag, error, TimeWindow.everything())
            return ()

    def decode(
        self, stored: StoredMessage, failures: list[UndecodableError] | None = None
    ) -> object:
        """Returns the decoded message; None where its type or its bytes are not understood.

        Why is added to `failures`, if they are given: who gives them reports them, and such an
        answer is not remembered.
        """
        try:
            return self.memory.reader.decode(stored.record)
        except UndecodableError as error:
            if failures is not None:
                self.notes.added += 1
                # A new one, since the one that was raised keeps the message by its traceback.
                failures.append(UndecodableError(error.topic, error.type_name, error.reason))
            return None

    def _note_unreadable(self, bag: BagFile, error: BagError, window: TimeWindow) -> None:
        """Notes that a bag, or a part of it, is not in the answer; unless it is of no such time."""
        self.memory.scanner.met_damage(bag, error)
        is_whole = isinstance(error, BagContradictionError)
        first, until = (bag.start, bag.end) if is_whole or error.lost is None else error.lost
        if not window.overlaps(first, until):
            return
        if not is_whole:
            self.notes.complete = False
        kind, reason = _NOT_TO_ITS_END if error.lost is None else _NOT_WHOLE, error.reason
        if isinstance(error, BagVanishedError):
            kind, reason = _DELETED, ""
        elif is_whole:
            kind = _CONTRADICTS_ITSELF
        self.notes.add(Note(kind, short_name(bag.path), reason, first, until))

    def read(
        self,
        bag: BagFile,
        topics: Sequence[str],
        window: TimeWindow,
        *,
        newest_first: bool = False,
        since: Ns = MIN_NS,
    ) -> Iterator[StoredMessage]:
        """Yields one bag's messages in log-time order; a note reports what cannot be read.

        There is no note where all that is lost lies before `since`: that part is read to recognise
        copies only.
        """
        self.check_deadline()
        part, reader = _indexed_part(bag, window), self.memory.reader
        records: Iterator[Record] | None = None
        is_thin = is_thinned(bag.file)
        # The time between two records is the reader's; what happens at `yield` is the caller's.
        clock, spent, count = time.perf_counter_ns, 0, 0
        while True:
            begin = clock()
            try:
                if records is None:
                    records = reader.records(bag.path, topics, part, newest_first=newest_first)
                for record in records:
                    spent += clock() - begin
                    count += 1
                    if is_thin:
                        self.call.note_thinned(record.log_time, record.log_time)
                    if count % _DEADLINE_CHECK_INTERVAL == 0:
                        self.check_deadline()
                    yield StoredMessage(bag, record)
                    begin = clock()
            except BagError as error:
                self._note_unreadable(bag, error, TimeWindow(since, MAX_NS))
                if error.lost is None:
                    return
                # Only part of the bag is lost: the reader continues after it.
            else:
                return
            finally:
                self.call.stages.add("read", spent)
                spent = 0

    def tables(
        self,
        bag: BagFile,
        topic: str,
        window: TimeWindow,
        *,
        hashed: bool = False,
        columns: bool = True,
        around: bool = False,
    ) -> Iterator[Table]:
        """Yields one bag's messages of a topic in a window as tables; a note reports what is lost.

        With `around` all messages of the bag are yielded, and notes are still on the window alone:
        what lies around it is read to recognise copies only, or not, if these are known.
        With `hashed` they have the hashes of all payloads, else those of latched channels alone.
        Without `columns` they have times, and rows for messages that cannot be decoded, too.

        What was read whole of a bag that does not change is remembered.
        """
        self.check_deadline()
        part = _indexed_part(bag, TimeWindow.everything() if around else window)
        remembered = self.memory.scanner.caches.decoded
        key = (bag.identity, topic, part, hashed, columns)
        is_lasting = is_settled(bag, self.memory.index.bag_dir, self.snapshot.scanned_at)
        remembered_tables = remembered.get(key) if is_lasting else None
        read_now = undecoded(
            self.memory.reader,
            bag.path,
            part,
            topics=[topic],
            hashed=lambda channel: hashed or channel.latched,
            columns=columns,
        )
        read_groups = map(Group.tables, read_now)
        groups = read_groups if remembered_tables is None else iter(remembered_tables)
        read: list[list[Table]] = []
        size = 0
        while True:
            try:
                with self.call.stages.timed("read"):
                    tables = next(groups, None)
            except BagError as error:
                is_lasting = False  # each answer notes what is lost
                self._note_unreadable(bag, error, window)
                if error.lost is None:
                    return
                continue
            if tables is None:
                break
            self._track_source(bag)
            size += 1000 + sum(table.memory_bytes for table in tables)
            if size <= DECODED_BYTES:
                read.append(tables)
            yield from tables
            self.check_deadline()
        if is_lasting and remembered_tables is None and size <= DECODED_BYTES:
            remembered.put(key, read, size)


def _indexed_part(bag: BagFile, window: TimeWindow) -> TimeWindow:
    """Returns the part of a window that the snapshot covers: an active bag grows meanwhile."""
    if bag.state is not BagState.ACTIVE:
        return window
    return window.intersect(TimeWindow.until(bag.end))
