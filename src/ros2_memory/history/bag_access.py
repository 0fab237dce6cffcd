"""Reads single bags within one call, and notes what cannot be read."""

from __future__ import annotations

import time
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Final, NamedTuple, TypeVar
from zlib import crc32

from ros2_memory.bag_dir.layout import is_thinned
from ros2_memory.columns.decode import Group, undecoded
from ros2_memory.columns.fill import is_settled
from ros2_memory.columns.scanner import DECODED_BYTES
from ros2_memory.columns.table import MOST_DECODED_NUMBERS
from ros2_memory.core.errors import (
    BagContradictionError,
    BagError,
    BagVanishedError,
    QueryTimeoutError,
    UndecodableError,
)
from ros2_memory.core.model import BagFile, BagState, TimeWindow
from ros2_memory.core.spans import overlaps_any
from ros2_memory.core.text import Reason
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Deadline, Ns
from ros2_memory.history.context import Call, Memory, Note, Notes

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.columns.table import Table
    from ros2_memory.storage.base import Channel, Record

T = TypeVar("T")
_DEADLINE_CHECK_INTERVAL: Final = 256
"""Messages between two looks at the deadline."""
_DELETED: Final = Reason(
    "was deleted before it could be read", "bag", many="were deleted before they could be read"
)
_AWAY: Final = Reason(
    "could not be read, as its disk has been unmounted",
    "bag",
    many="could not be read, as their disk has been unmounted",
)
_NOT_WHOLE: Final = Reason("could not be read whole", "bag")
_NOT_TO_ITS_END: Final = Reason("could not be read to its end", "bag")


class StoredMessage(NamedTuple):
    """An undecoded message and the bag that it is in."""

    bag: BagFile
    record: Record

    @property
    def recording(self) -> Path:
        """The recording that the bag is of."""
        return self.bag.recording

    @property
    def time(self) -> Ns:
        """Log time."""
        return self.record.log_time

    @property
    def topic(self) -> str:
        """Name of the topic."""
        return self.record.channel.topic

    @property
    def type(self) -> str:
        """Name of the message type."""
        return self.record.channel.type

    @property
    def identity(self) -> tuple[Ns, int]:
        """Publish time and CRC-32 of the payload: copies of a message of a topic share these."""
        return self.record.publish_time, crc32(self.record.payload)

    @property
    def is_undated(self) -> bool:
        """Whether the recorder had no publish time: it is 0, or the log time."""
        return self.record.publish_time in {0, self.time}


class Reading:
    """How a part of a call read bags.

    Attributes:
        is_final: whether all that it needed could be read, of bags that are closed. Then what
            follows from it may be remembered.
    """

    is_final = False


class BagAccess:
    """Reads the bags of one snapshot, with a deadline.

    A damaged bag raises nothing: a note reports it, and the other bags answer.

    Args:
        memory: has the bags.
        call: asks for them.
        reach: as in `View`.

    Attributes:
        snapshot: the index as the call began.
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
        self._lost = 0  # how often a part of a bag could not be read

    def end_early(self, left_s: float) -> None:
        """Ends reading `left_s` before the call's deadline, but not before half of its time."""
        deadline = self.call.deadline
        at_s = deadline.at_s - min(left_s, deadline.budget_s / 2)
        self._deadline = replace(deadline, at_s=at_s)

    def finish_within(self, budget_s: float) -> None:
        """Restores the call's deadline, or sets a later one if less than `budget_s` is left."""
        deadline = self.call.deadline
        is_enough = deadline.left_s() >= budget_s
        self._deadline = deadline if is_enough else Deadline.after(budget_s)

    def check_deadline(self) -> None:
        """Checks that the call has time left.

        Raises:
            QueryTimeoutError: its time is over.
        """
        if self._deadline.expired():
            budget_s = self.call.deadline.budget_s
            raise QueryTimeoutError(
                f"the question needs more than {budget_s:g} s; {self.filling_progress()}"
                "ask about a shorter window or a single topic"
            )

    @contextmanager
    def watched(self) -> Iterator[Reading]:
        """Watches what the block reads; what failed before it does not count."""
        notes, call, reading = self.notes, self.call, Reading()
        complete, added, used_active = notes.complete, notes.added, call.used_active
        notes.complete, call.used_active = True, False
        try:
            yield reading
            could_read_all = notes.complete and notes.added == added
            reading.is_final = could_read_all and not call.used_active
        finally:
            notes.complete &= complete
            call.used_active |= used_active

    def filling_progress(self) -> str:
        """Returns a clause on the bags that are not stored as columns, for a lack of time.

        These bags are read for every question, which takes long. Empty if they are less than 1 % of
        all bags: then they are not the cause.
        """
        coverage = self.memory.scanner.coverage(self.snapshot.timeline)
        if coverage is None:
            return ""
        bags = self.snapshot.timeline.closed
        missing = len([bag for bag in coverage.missing if bag.state is BagState.CLOSED])
        if missing * 100 <= bags:
            return ""
        return (
            f"the store of columns, which makes such questions quick, has {bags - missing} of "
            f"{bags} bags so far: wait for it, or "
        )

    def track_sources(self, messages: Iterator[StoredMessage]) -> Iterator[StoredMessage]:
        """Yields the messages, and records for the reply from which kinds of bags they are.

        A bag that a crash left open makes the answer incomplete. A reply that uses a bag which is
        still being written says so.
        """
        for message in messages:
            self._track_source(message.bag)
            yield message

    def _track_source(self, bag: BagFile) -> None:
        if bag.state is BagState.INCOMPLETE:
            self.notes.complete = False
        elif bag.state is BagState.ACTIVE:
            self.call.used_active = True

    def track_thinned(self, first: Ns, last: Ns) -> None:
        """Records for the reply if what was read between two log times is of a thinned day.

        Where a saved moment has all messages, it is not.
        """
        read = TimeWindow(first, last + 1)
        for part in map(read.intersect, self.call.asked or (read,)):
            if not part.empty:
                thinned_times = self.snapshot.timeline.thinned_times
                self.call.used_thinned |= overlaps_any(thinned_times, part.start, part.stop - 1)

    def track_all_sources(self) -> None:
        """Records that the answer is about all bags, including bags that are being written."""
        if any(aside.until is not None for aside in self.snapshot.active):
            self.call.used_active = True

    def channels(self, bag: BagFile) -> Sequence[Channel]:
        """Returns the channels that a bag declares; none, with a note, if it is damaged."""
        self.check_deadline()
        try:
            return self.memory.reader.channels(bag.path)
        except BagError as error:
            self._note_unreadable(bag, error, TimeWindow.everything())
            return ()

    def decoded(
        self, messages: Iterable[StoredMessage], failures: list[UndecodableError] | None = None
    ) -> Iterator[tuple[StoredMessage, object]]:
        """Yields messages with what they decode to, without those that `decode` does not."""
        for stored in messages:
            message = self.decode(stored, failures)
            if message is not None:
                yield stored, message

    def decode(
        self, stored: StoredMessage | None, failures: list[UndecodableError] | None = None
    ) -> object:
        """Returns the decoded message; None if its type or its bytes are not understood.

        None, too, if there is no message. If `failures` is given, the reason is added to it. The
        caller has to report it, and the answer is not remembered.
        """
        try:
            return None if stored is None else self.memory.reader.decode(stored.record)
        except UndecodableError as error:
            if failures is not None:
                self.notes.added += 1
                # The raised error would keep the message alive by its traceback.
                failures.append(UndecodableError(error.topic, error.type_name, error.reason))
            return None

    def _note_unreadable(self, bag: BagFile, error: BagError, window: TimeWindow) -> None:
        """Notes that a bag, or a part of it, is not in the answer, if it lies in the window."""
        self._lost += 1
        self.memory.scanner.met_damage(bag, error)
        lost = error.lost or (bag.start, bag.end)
        kind, reason = _NOT_TO_ITS_END if error.lost is None else _NOT_WHOLE, error.reason
        if isinstance(error, BagVanishedError):
            is_away = any(aside.path in bag.path.parents for aside in self.snapshot.damaged)
            kind, reason = _AWAY if is_away else _DELETED, ""
        # All messages of a bag that contradicts itself were read.
        if window.overlaps(*lost) and not isinstance(error, BagContradictionError):
            self.notes.add_lack(Note(kind, bag.file, reason, *lost))

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

        Messages before `since` are read only to recognise copies: there is no note on them.
        """
        self.check_deadline()
        part, is_thin = _indexed_part(bag, window), is_thinned(bag.file)
        records = self.memory.reader.records(bag.path, topics, part, newest_first=newest_first)
        for count, record in enumerate(self._readable(bag, records, TimeWindow(since, MAX_NS)), 1):
            if is_thin:
                self.track_thinned(record.log_time, record.log_time)
            if count % _DEADLINE_CHECK_INTERVAL == 0:
                self.check_deadline()
            yield StoredMessage(bag, record)

    def _readable(self, bag: BagFile, items: Iterator[T], window: TimeWindow) -> Iterator[T]:
        """Yields what can be read of a bag; behind a lost part the reader continues.

        The stage "read" is the time of the reader, without that of the caller between items. There
        are notes on what is lost in the window.
        """
        clock, spent = time.perf_counter_ns, 0
        try:
            while True:
                begin = clock()
                try:
                    item = next(items, None)
                except BagError as error:
                    self._note_unreadable(bag, error, window)
                    if error.lost is None:
                        return
                    continue
                finally:
                    spent += clock() - begin
                if item is None:
                    return
                yield item
        finally:
            self.call.stages.add("read", spent)

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

        What was read whole of a bag that does not change any more is remembered.

        Args:
            bag: the bag.
            topic: of the messages.
            window: of log time.
            hashed: whether tables have the hashes of all payloads, not only of latched channels.
            columns: whether they have more than times.
            around: whether all messages of the bag are read, to recognise copies. There are notes
                on the window alone.
        """
        self.check_deadline()
        part = _indexed_part(bag, TimeWindow.everything() if around else window)
        cache = self.memory.scanner.caches.decoded
        key = (bag.identity, topic, part, hashed, columns)
        is_lasting = is_settled(bag, self.memory.bag_dir, self.snapshot.scanned_at)
        cached = cache.get(key) if is_lasting else None
        groups: Iterator[list[Table]] = iter(cached or ())
        if cached is None:
            read_now = undecoded(
                self.memory.reader,
                bag.path,
                part,
                topics=[topic],
                hashed=lambda channel: hashed or channel.latched,
                columns=columns,
                most_numbers=MOST_DECODED_NUMBERS,
            )
            groups = map(Group.tables, read_now)
        to_cache: list[list[Table]] = []
        size, lost_before = 0, self._lost
        for tables in self._readable(bag, groups, window):
            self._track_source(bag)
            size += 1000 + sum(table.memory_bytes for table in tables)
            if is_lasting and size <= DECODED_BYTES:
                to_cache.append(tables)
            yield from tables
            self.check_deadline()
        # Each answer has to note what is lost.
        if is_lasting and size <= DECODED_BYTES and self._lost == lost_before:
            cache.put(key, to_cache, size)


def _indexed_part(bag: BagFile, window: TimeWindow) -> TimeWindow:
    """Returns the part of a window that the snapshot covers: an active bag has grown since."""
    if bag.state is not BagState.ACTIVE:
        return window
    return window.intersect(TimeWindow.until(bag.end))
