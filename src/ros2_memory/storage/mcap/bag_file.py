"""Reads MCAP files: summaries, messages and log times.

It is fast because it decompresses a chunk only for a message that is wanted, and takes log times
and offsets from the message indexes (a cold point query takes 0.6 ms, with the `mcap` library
13.5 ms; `python -m benchmarks` measures both). It finds every message because it falls back to the
messages themselves where the indexes of a file are missing or wrong (see `mcap.index`).
"""

from __future__ import annotations

import struct
from bisect import bisect_left
from contextlib import suppress
from functools import lru_cache, partial
from itertools import pairwise
from operator import attrgetter
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.core.bag_summary import READ_WITHOUT_INDEXES, BagSummary
from ros2_memory.core.errors import BagContradictionError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MAX_NS, Ns, Span
from ros2_memory.storage.base import (
    Batch,
    Channel,
    IntArray,
    Record,
)
from ros2_memory.storage.cache import ByteLru
from ros2_memory.storage.errors import (
    Lost,
    SizeLimit,
    UnreadableError,
    as_unreadable,
    reason_of,
)
from ros2_memory.storage.file_io import OpenFile
from ros2_memory.storage.mcap.bulk import (
    ReadChunks,
    bare_batches,
    batches_of,
    message_heads,
    read_groups,
    require_declared,
)
from ros2_memory.storage.mcap.chunk import (
    Chunk,
    MessageTable,
    chunk_data,
    index_behind,
    read_indexes,
    read_trusted_index,
    walk_chunk,
)
from ros2_memory.storage.mcap.index import (
    DoubtError,
    McapIndex,
    checked_index,
    trusted_index,
)
from ros2_memory.storage.mcap.merge import RunRows, SortedRun, merged
from ros2_memory.storage.mcap.records import (
    MESSAGE,
    RECORD,
    is_finished,
    starts_as_mcap,
)
from ros2_memory.storage.mcap.scan import index_by_scan
from ros2_memory.storage.zstd_bag import FRAME_MAGIC, uncompressed_payload

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence
    from pathlib import Path

_LARGE_BYTES: Final = 8 << 20
_VERIFIED_BYTES: Final = 32 << 20
"""Chunks that take more, together, are not read only to verify their message indexes."""
_MOST_VERDICTS: Final = 100_000
_TABLE_BYTES: Final = 600
"""About what a cached table of messages takes besides its columns."""
_EVERYTHING: Final = TimeWindow.everything()


class _ContradictedError(UnreadableError):
    """The message indexes of a chunk do not agree with its records.

    Attributes:
        chunk: the chunk in place of whose messages this is raised; None before any was read.
    """

    def __init__(self, reason: str, chunk: Chunk | None = None) -> None:
        super().__init__(reason)
        self.chunk = chunk


class McapBags:
    """Reads MCAP files. Safe to use from several threads at once.

    Exceptions are raised as they come; the adapters translate them (`errors.reading`).

    Args:
        cache_mb: memory that indexes and decompressed chunks may take between calls, in MiB.
        limit: up to which a chunk is read.
    """

    def __init__(self, cache_mb: int, limit: SizeLimit) -> None:
        self.limit = limit
        # Many programs write chunks of 4 MiB.
        self.chunks: ByteLru[bytes] = ByteLru((cache_mb << 20) * 3 // 4)
        self.indexes: ByteLru[McapIndex | MessageTable] = ByteLru((cache_mb << 20) // 4)
        # By hashes of file keys, which are small: to fill a store each file of a history is read
        # twice.
        self._verdicts: dict[int, str] = {}

    def verdict(self, file: OpenFile) -> str | None:
        """Returns how the indexes of a file are wrong; "" if right, None if they were not read."""
        return self._verdicts.get(hash(file.key))

    def set_verdict(self, file: OpenFile, verdict: str) -> None:
        """Remembers how the indexes of a file are wrong; "" means that they are right."""
        if len(self._verdicts) >= _MOST_VERDICTS:
            self._verdicts.clear()
        self._verdicts[hash(file.key)] = verdict

    def is_finished(self, path: Path) -> bool:
        """Returns whether the writer has finished the file."""
        with OpenFile(path) as file:
            return is_finished(file) or not starts_as_mcap(file)

    def summarize(self, path: Path) -> BagSummary:
        """Returns topics with exact counts and first and last log times."""
        with OpenFile(path, at_once=True) as file:
            index = _Reading(self, file, has_totals=True).verified_index()
        return index.contents.summary(index.channels, index.notes, complete=index.complete)

    def channels(self, path: Path) -> Sequence[Channel]:
        """Returns the channels declared in the file."""
        with OpenFile(path) as file:
            return list(_Reading(self, file).index.channels.values())

    def records(
        self, path: Path, topics: Collection[str], window: TimeWindow, *, newest_first: bool
    ) -> Iterator[Record | Lost]:
        """Yields the messages of `topics` inside the window, in order.

        A `Lost` is yielded in place of the messages of a damaged chunk, where the first would be.
        """
        if not window.empty:
            with OpenFile(path) as file:
                yield from _Reading(self, file, topics, window).records(newest_first=newest_first)

    def batches(
        self, path: Path, topics: Collection[str], window: TimeWindow, bare: Collection[str]
    ) -> Iterator[Batch | Lost]:
        """Yields the messages of `records`, many at once; see `BagReader.batches`.

        A `Lost` is yielded in place of the messages of a damaged chunk.
        """
        if not window.empty:
            with OpenFile(path, at_once=window == _EVERYTHING) as file:
                yield from _Reading(self, file, topics, window).batches(bare)


class _Reading:
    """One reading of an open file: messages of some topics in a window of log time."""

    def __init__(
        self,
        bags: McapBags,
        file: OpenFile,
        topics: Collection[str] = (),
        window: TimeWindow = _EVERYTHING,
        *,
        has_totals: bool = False,
    ) -> None:
        self._bags = bags
        self._file = file
        self._topics = topics
        self._window = window
        self._uncompressed = partial(uncompressed_payload, limit=bags.limit)
        self.index = self._known_index(has_totals=has_totals)

    def _known_index(self, *, has_totals: bool) -> McapIndex:
        file, bags = self._file, self._bags
        index = bags.indexes.get(file.key)
        if isinstance(index, McapIndex) and (index.contents.totals or not has_totals):
            return index
        verdict = bags.verdict(file)
        if verdict:
            return self._scan_contradicted(verdict)
        if not is_finished(file):
            return self._cache(index_by_scan(file, bags.limit))
        try:
            is_checked = verdict is not None
            index = trusted_index(file) if is_checked and not has_totals else checked_index(file)
        except DoubtError as doubt:
            index = index_by_scan(file, bags.limit, str(doubt))
        except UnreadableError as error:
            return self._index_without(error)
        else:
            bags.set_verdict(file, "")
        return self._cache(index)

    def _cache(self, index: McapIndex) -> McapIndex:
        """Caches the index of the file, and returns it."""
        self._bags.indexes.put(self._file.key, index, index.memory_bytes)
        return index

    def _index_without(self, error: UnreadableError) -> McapIndex:
        """Returns an index of the messages themselves, after an error in the file's own indexes."""
        contradiction = f"{error}; {READ_WITHOUT_INDEXES}"
        # Not in the cached index alone: when that is gone, not every read finds it out again.
        self._bags.set_verdict(self._file, contradiction)
        return self._scan_contradicted(contradiction)

    def _scan_contradicted(self, contradiction: str) -> McapIndex:
        """Scans a file whose indexes are wrong, and returns the index of its messages."""
        index = index_by_scan(self._file, self._bags.limit, contradiction)
        return self._cache(index._replace(contradiction=contradiction))

    def verified_index(self) -> McapIndex:
        """Compares the index with the chunks at the first and last times of channels.

        A bag is chosen for a question by these times: a wrong one would hide its messages.

        Returns:
            The index, or an index of the messages themselves if it is wrong.
        """
        declared = self.index.declared
        if declared is None:  # the index comes from the messages themselves
            return self.index
        chunks = _chunks_to_verify(self.index)
        for group in read_groups(self._file, chunks, self._bags.limit):
            # What cannot be read is lost, which says nothing about the indexes.
            try:
                if group.is_read:
                    require_declared(group, declared)
            except UnreadableError as fault:
                return self._index_without(fault)
        return self.index

    def records(self, *, newest_first: bool) -> Iterator[Record | Lost]:
        """Yields the messages in order, and errors where some are lost."""
        if self.index.contradiction:
            yield self._contradiction()
        try:
            yield from merged(self._runs(newest_first=newest_first))
        except _ContradictedError as error:
            # Raised in place of a run: what was yielded lies before all messages of the run.
            wrong, self.index = self.index, self._index_without(error)
            yield self._contradiction()
            self._window, read = _split_window(self._window, error.chunk, newest_first=newest_first)
            missed = _missed_span(wrong, self.index, self._wanted, read)
            if missed is not None:
                yield Lost(str(error), *missed)
            yield from merged(self._runs(newest_first=newest_first))

    def batches(self, bare: Collection[str]) -> Iterator[Batch | Lost]:
        """Yields the messages many at once, and errors where some are lost."""
        if self.index.contradiction:
            yield self._contradiction()
        yielded: dict[int, Chunk] = {}
        try:
            yield from self._batches(bare, yielded)
        except _ContradictedError as error:
            self.index = self._index_without(error)
            yield self._contradiction()
            for chunk in _chunks_of(self.index, self._wanted, self._window):
                yield from self._batches_of_chunk(chunk, yielded.get(chunk.offset))

    def _contradiction(self) -> Lost:
        first, last = self._window.start, self._window.stop - 1
        return Lost(self.index.contradiction, first, last, BagContradictionError)

    @property
    def _wanted(self) -> dict[int, Channel]:
        """The channels of the topics, by number."""
        return {
            number: channel
            for number, channel in self.index.channels.items()
            if channel.topic in self._topics
        }

    def _batches(self, bare: Collection[str], yielded: dict[int, Chunk]) -> Iterator[Batch | Lost]:
        """Yields the messages of all chunks.

        Args:
            bare: topics whose payloads are not needed: a chunk that is wanted for them alone is
                not read, only its indexes.
            yielded: receives each chunk when its messages were yielded, by offset.

        Raises:
            _ContradictedError: the indexes of a chunk do not agree with its records.
        """
        file, wanted, window = self._file, self._wanted, self._window
        with_payload = {number for number, channel in wanted.items() if channel.topic not in bare}
        unindexed: list[Chunk] = []
        read: list[Chunk] = []
        unread: list[Chunk] = []
        for chunk in _chunks_of(self.index, wanted, window):
            if chunk.index_places is None:
                unindexed.append(chunk)
            elif chunk.channels.isdisjoint(with_payload):
                unread.append(chunk)
            else:
                read.append(chunk)
        if wanted:
            # If all channels of a chunk are wanted, it is compared when it is read.
            self._verify_beside({chunk.offset for chunk in read if chunk.channels <= wanted.keys()})
        for group in read_groups(file, read, self._bags.limit):
            yield from self._batches_of_group(group, yielded)
            del group  # before the next is read
        for chunk in unindexed:
            yield from self._batches_of_chunk(chunk)
        yield from bare_batches(file, unread, wanted, window)
        yielded.update({chunk.offset: chunk for chunk in unread})

    def _batches_of_group(
        self, group: ReadChunks, yielded: dict[int, Chunk]
    ) -> Iterator[Batch | Lost]:
        """Yields the messages of chunks that were read together; if that failed, one by one."""
        if group.is_read:
            with suppress(UnreadableError, ValueError, IndexError):
                messages = read_indexes(group.chunks, group.indexes, self._wanted)
                batches = self._batches_of(group, messages)
                yielded.update({chunk.offset: chunk for chunk in group.chunks})
                yield from batches
                return
        for chunk in group.chunks:
            yield from self._batches_of_chunk(chunk)
            yielded[chunk.offset] = chunk

    def _batches_of_chunk(
        self, chunk: Chunk, yielded: Chunk | None = None
    ) -> Iterator[Batch | Lost]:
        """Yields the messages of one chunk, without those in the indexes of `yielded`.

        Raises:
            _ContradictedError: the indexes of the chunk do not agree with its records; then nothing
                was yielded.
        """
        try:
            content = self._read_chunk(chunk)
        except UnreadableError as error:
            lost = self._lost_with(chunk, str(error))
            if lost is not None:
                yield lost
            return
        messages = self._verified_messages(content)
        messages = messages.select(np.isin(messages.channels, [*self._wanted]))
        if yielded is not None:
            known = read_trusted_index(yielded, index_behind(self._file, yielded), yielded.channels)
            messages = messages.select(~np.isin(messages.offsets, known.offsets))
        yield from self._batches_of(content, messages)

    def _batches_of(self, content: ReadChunks, messages: MessageTable) -> Iterator[Batch]:
        return batches_of(content, messages, self._wanted, self._window, self._uncompressed)

    def _runs(self, *, newest_first: bool) -> Iterator[SortedRun[Record | Lost]]:
        """Yields a run for each chunk with messages of the topics.

        Raises:
            _ContradictedError: the indexes of a chunk do not agree with its records; also raised
                when a run is read.
        """
        wanted = self._wanted
        # Of large chunks only the last used stays decompressed: all that overlap in time would
        # otherwise be in memory at once.
        read_chunk = lru_cache(1)(self._read_chunk)

        def read_rows(chunk: Chunk) -> RunRows[Record | Lost] | None:
            """Returns the wanted messages of a chunk, or the error in their place, if any."""
            read_chunk.cache_clear()  # before the next is decompressed
            try:
                content = read_chunk(chunk)
            except UnreadableError as error:
                lost = self._lost_with(chunk, str(error))
                if lost is None:
                    return None
                key = -lost.last if newest_first else lost.first
                return RunRows([key], [0], lambda _place: lost)
            times, places = self._inside(self._verified_messages(content, wanted))
            if not times.size:
                return None
            if newest_first:
                times, places = -times[::-1], places[::-1]
            kept = content if len(content.buffer) <= _LARGE_BYTES else None

            def fetch(place: int) -> Record:
                return self._record((kept or read_chunk(chunk)).buffer, wanted, place)

            return RunRows(times.tolist(), places.tolist(), fetch)

        if wanted:
            self._verify_beside()
        for chunk in _chunks_of(self.index, wanted, self._window):
            key, rank = chunk.start, chunk.offset
            if newest_first:
                key, rank = -chunk.end, -chunk.offset
            yield SortedRun(key, rank, partial(read_rows, chunk))

    def _inside(self, messages: MessageTable) -> tuple[IntArray, IntArray]:
        """Returns log times and offsets of the messages inside the window, in order."""
        times, offsets = messages.times, messages.offsets
        if (times[1:] <= times[:-1]).any():
            order = np.lexsort((offsets, times))
            times, offsets = times[order], offsets[order]
        first, last = times.searchsorted((self._window.start, min(self._window.stop, MAX_NS)))
        return times[first:last], offsets[first:last]

    def _lost_with(self, chunk: Chunk, reason: str) -> Lost | None:
        """Returns the error for a chunk that cannot be read; None if it has no wanted message."""
        window = self._window
        first, last = max(chunk.start, window.start), min(chunk.end, window.stop - 1)
        with suppress(UnreadableError), as_unreadable():
            messages = read_trusted_index(chunk, index_behind(self._file, chunk), self._wanted)
            times, _ = self._inside(messages)
            if not times.size:
                return None
            first, last = int(times[0]), int(times[-1])
        return Lost(reason, first, last)

    def _verify_beside(self, verified: Collection[int] = ()) -> None:
        """Compares the chunks beside the window with their records, each once.

        Args:
            verified: offsets of chunks that are compared anyway.

        Raises:
            _ContradictedError: the indexes of one of them do not agree with its records.
        """
        for chunk in _chunks_beside(self.index, self._window):
            if chunk.index_places is None or chunk.offset in verified:
                continue
            try:
                self._verified_messages(self._read_chunk(chunk))
            except _ContradictedError as error:
                # Without the chunk: nothing was yielded, so all of the window is left to read.
                raise _ContradictedError(str(error)) from error
            except UnreadableError:
                continue

    def _verified_messages(
        self, content: ReadChunks, wanted: Collection[int] | None = None
    ) -> MessageTable:
        """Returns the messages of one chunk, compared with its decompressed records.

        Args:
            content: the chunk.
            wanted: the channels that are needed; None for all.

        Raises:
            _ContradictedError: the indexes do not agree with the records.
            UnreadableError: the records cannot be read.
        """
        [chunk] = content.chunks
        channels = chunk.channels if wanted is None else chunk.channels.intersection(wanted)
        key = (self._file.key, chunk.offset, channels)
        messages = self._bags.indexes.get(key)
        if isinstance(messages, MessageTable):
            return messages
        if chunk.index_places is None:
            messages = walk_chunk(content.buffer).messages
            messages = messages.select(np.isin(messages.channels, [*channels]))
        else:
            try:
                messages = read_trusted_index(chunk, content.indexes[0], channels)
                message_heads(content, messages)
            except (UnreadableError, ValueError, IndexError, struct.error) as error:
                raise _ContradictedError(reason_of(error), chunk) from error
        columns_bytes = sum(column.nbytes for column in messages)
        self._bags.indexes.put(key, messages, columns_bytes + _TABLE_BYTES)
        return messages

    def _read_chunk(self, chunk: Chunk) -> ReadChunks:
        """Returns a chunk, decompressed, with its message indexes.

        Raises:
            UnreadableError: it cannot be read.
        """
        key = (self._file.key, chunk.offset)
        data = self._bags.chunks.get(key)
        if data is None:
            with as_unreadable():
                data = chunk_data(self._file, chunk, self._bags.limit)
            self._bags.chunks.put(key, data, len(data))
        return ReadChunks([chunk], data, [len(data)], [index_behind(self._file, chunk)])

    def _record(self, data: bytes, channels: Mapping[int, Channel], place: int) -> Record:
        """Returns the message at a verified place of a decompressed chunk."""
        _, length, number, _, time, published = MESSAGE.unpack_from(data, place)
        channel = channels[number]
        payload = data[place + MESSAGE.size : place + RECORD.size + length]
        if payload.startswith(FRAME_MAGIC):
            payload = self._uncompressed(channel, payload)
        return Record(channel, time, published if 0 < published < MAX_NS else time, payload)


def _chunks_to_verify(index: McapIndex) -> list[Chunk]:
    """Returns the chunks that decide about first and last times, up to `_VERIFIED_BYTES`.

    These are the first and the last chunk, chunks out of order, and each chunk with the first or
    last message of a channel.
    """
    ends: set[Ns] = set()
    for total in index.contents.totals.values():
        ends.update((total.first, total.last))
    sorted_ends = sorted(ends)
    odd = {chunk.offset for chunk in (*index.chunks[:1], *index.chunks[-1:])}
    for before, after in pairwise(sorted(index.chunks, key=attrgetter("offset"))):
        if after.end < before.start:
            odd.update((before.offset, after.offset))
    chunks: list[Chunk] = []
    size = 0
    for chunk in index.chunks:
        nth = bisect_left(sorted_ends, chunk.start)
        has_end = nth < len(sorted_ends) and sorted_ends[nth] <= chunk.end
        if not has_end and chunk.offset not in odd:
            continue
        size += chunk.length
        if size > _VERIFIED_BYTES:
            break
        chunks.append(chunk)
    return chunks


def _chunks_of(index: McapIndex, wanted: Collection[int], window: TimeWindow) -> Iterator[Chunk]:
    """Yields the chunks that overlap the window and have messages of one of the channels."""
    for chunk in index.chunks:
        if window.overlaps(chunk.start, chunk.end) and not chunk.channels.isdisjoint(wanted):
            yield chunk


def _chunks_beside(index: McapIndex, window: TimeWindow) -> list[Chunk]:
    """Returns the chunks whose indexes may hide messages of a window.

    In the order of the file the times of chunks ascend, mostly, and one follows the other. Where
    all indexes of a chunk agree on wrong times, no chunk has the times of its messages. Such a hole
    is looked for at both ends of the window, and between two chunks that overlap it. Where
    neighbours agree on wrong times there may be no hole, but a seam.
    """
    chunks, start, last = index.chunks, window.start, window.stop - 1
    inside = [nth for nth, chunk in enumerate(chunks) if window.overlaps(chunk.start, chunk.end)]
    beside: set[int] = set()
    for before, after in pairwise(inside):
        between = range(before + 1, after)
        if len(between) == 1:
            beside.update(between)
    for seam in index.seams:
        if window.overlaps(seam.first, seam.last):
            beside.update((seam.nth, seam.nth + 1))
    for at in (start, last):
        if any(chunks[nth].start <= at <= chunks[nth].end for nth in inside):
            continue
        earlier = [(chunk.end, nth) for nth, chunk in enumerate(chunks) if chunk.end < at]
        _, nth = max(earlier, default=(0, -1))
        beside.update((nth, nth + 1))
    return [chunks[nth] for nth in sorted(beside) if 0 <= nth < len(chunks)]


def _split_window(
    window: TimeWindow, chunk: Chunk | None, *, newest_first: bool
) -> tuple[TimeWindow, TimeWindow]:
    """Splits a window at a chunk that is in doubt: the part left to read, and the part read."""
    if newest_first:
        at = window.stop if chunk is None else chunk.end + 1
    else:
        at = window.start if chunk is None else chunk.start
    at = min(max(at, window.start), window.stop)
    before, behind = TimeWindow(window.start, at), TimeWindow(at, window.stop)
    return (before, behind) if newest_first else (behind, before)


def _missed_span(
    wrong: McapIndex, right: McapIndex, wanted: Collection[int], read: TimeWindow
) -> Span | None:
    """Returns the log times between which a read by the wrong index missed messages, if any.

    Args:
        wrong: the index that was used.
        right: the index of the messages themselves.
        wanted: the channels.
        read: the part of the window that was read by the wrong index.
    """
    stated = {chunk.offset: chunk for chunk in wrong.chunks}
    missed: list[Chunk] = []
    for chunk in _chunks_of(right, wanted, read):
        known = stated.get(chunk.offset)
        if (
            known is None
            or chunk.start < known.start
            or chunk.end > known.end
            or not chunk.channels <= known.channels
        ):
            missed.append(chunk)
    if not missed:
        return None
    first = min(chunk.start for chunk in missed)
    last = max(chunk.end for chunk in missed)
    return max(first, read.start), min(last, read.stop - 1)
