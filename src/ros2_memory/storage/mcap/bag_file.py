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
from ros2_memory.core.large_reads import LargeReads
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MAX_NS, Ns, Span
from ros2_memory.storage.base import (
    Batch,
    Channel,
    Closing,
    IntArray,
    Record,
)
from ros2_memory.storage.cache import ByteLru
from ros2_memory.storage.errors import (
    MAX_CHUNK_MB,
    ContradictionError,
    LostError,
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
    compared,
    read_groups,
    require_declared,
)
from ros2_memory.storage.mcap.chunk import (
    Chunk,
    Pairs,
    believed_pairs,
    chunk_data,
    pairs_in,
    walk_chunk,
)
from ros2_memory.storage.mcap.index import (
    DoubtError,
    McapIndex,
    index_from_summary,
)
from ros2_memory.storage.mcap.merge import RunRows, SortedRun, merged
from ros2_memory.storage.mcap.records import (
    MESSAGE,
    RECORD,
    closing_of,
    is_finished,
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
_NEXT_BUT_ONE: Final = 2
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
        max_chunk_mb: decompressed size up to which a chunk is read, in MiB.
        large: the turn to hold much of a bag.
    """

    def __init__(
        self,
        cache_mb: int = 64,
        max_chunk_mb: int = MAX_CHUNK_MB,
        large: LargeReads | None = None,
    ) -> None:
        self.limit = SizeLimit(max_chunk_mb << 20, (large or LargeReads()).acquire)
        # Many programs write chunks of 4 MiB.
        self.chunks: ByteLru[bytes] = ByteLru((cache_mb << 20) * 3 // 4)
        self.indexes: ByteLru[McapIndex | Pairs] = ByteLru((cache_mb << 20) // 4)
        # How the indexes of files were found wrong, "" where they are right: by the hashes of their
        # keys, since to fill a store each file of a history is read twice.
        self._verdicts: dict[int, str] = {}

    def verdict(self, file: OpenFile) -> str | None:
        """Returns how the indexes of a file were found wrong; None if nothing is known."""
        return self._verdicts.get(hash(file.key))

    def judge(self, file: OpenFile, verdict: str = "") -> None:
        """Remembers how the indexes of a file were found wrong, or that they are right."""
        if len(self._verdicts) >= _MOST_VERDICTS:
            self._verdicts.clear()
        self._verdicts[hash(file.key)] = verdict

    def closing(self, path: Path) -> Closing:
        """Returns whether the writer has finished the file."""
        with OpenFile(path) as file:
            return closing_of(file)

    def summarize(self, path: Path) -> BagSummary:
        """Returns topics with exact counts and first and last log times."""
        with OpenFile(path, at_once=True) as file:
            index = _Reading(self, file, has_totals=True).verified()
        return index.contents.summary(index.channels, index.notes, complete=index.complete)

    def channels(self, path: Path) -> Sequence[Channel]:
        """Returns the channels declared in the file."""
        with OpenFile(path) as file:
            return list(_Reading(self, file).index.channels.values())

    def records(
        self, path: Path, topics: Collection[str], window: TimeWindow, *, newest_first: bool
    ) -> Iterator[Record | LostError]:
        """Yields the messages of `topics` inside the window, in order.

        An error is yielded in place of the messages of a damaged chunk, where the first would be.
        """
        if not window.empty:
            with OpenFile(path) as file:
                yield from _Reading(self, file, topics, window).records(newest_first=newest_first)

    def batches(
        self, path: Path, topics: Collection[str], window: TimeWindow, bare: Collection[str]
    ) -> Iterator[Batch | LostError]:
        """Yields the messages of `records`, many at once; see `BagReader.batches`.

        An error is yielded in place of the messages of a damaged chunk.
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
            return self._index_without_indexes(verdict)
        if not is_finished(file):
            return self._remembered(index_by_scan(file, bags.limit))
        try:
            index = index_from_summary(file, is_sound=not has_totals and verdict is not None)
            bags.judge(file)
        except DoubtError as doubt:
            index = index_by_scan(file, bags.limit, str(doubt))
        except UnreadableError as error:
            return self._without_indexes(error)
        return self._remembered(index)

    def _remembered(self, index: McapIndex) -> McapIndex:
        self._bags.indexes.put(self._file.key, index, index.memory_bytes)
        return index

    def _without_indexes(self, error: UnreadableError) -> McapIndex:
        """Returns an index of the messages themselves, in place of one that was found wrong."""
        reason = f"{error}; {READ_WITHOUT_INDEXES}"
        # Kept apart from the index: not every read that follows would find it out again.
        self._bags.judge(self._file, reason)
        return self._index_without_indexes(reason)

    def _index_without_indexes(self, reason: str) -> McapIndex:
        index = index_by_scan(self._file, self._bags.limit, reason)
        return self._remembered(index._replace(contradiction=reason))

    def verified(self) -> McapIndex:
        """Returns the index if its first and last times agree with the messages; else another.

        A bag is chosen for a question by these times: a wrong one would hide its messages.
        """
        index, declared = self.index, self.index.declared
        if declared is None:  # it was made of the messages
            return index
        totals = index.contents.totals.values()
        ends = sorted({end for total in totals for end in (total.first, total.last)})
        odd = (*index.chunks[:1], *index.chunks[-1:], *_out_of_order(index.chunks))
        looked_at = {chunk.offset for chunk in odd}
        left = _VERIFIED_BYTES
        chosen: list[Chunk] = []
        for chunk in index.chunks:
            nth = bisect_left(ends, chunk.start)
            is_end = nth < len(ends) and ends[nth] <= chunk.end
            if not (is_end or chunk.offset in looked_at):
                continue
            left -= chunk.length
            if left < 0:
                break
            chosen.append(chunk)
        for group in read_groups(self._file, chosen, self._bags.limit):
            try:
                require_declared(group, declared)
            except UnreadableError:
                for chunk in group.chunks:
                    try:
                        content = self._content(chunk)
                    except UnreadableError:
                        continue
                    try:
                        require_declared(content, declared)
                    except UnreadableError as error:
                        return self._without_indexes(error)
        return index

    def records(self, *, newest_first: bool) -> Iterator[Record | LostError]:
        """Yields the messages in order, and errors where some are lost."""
        if self.index.contradiction:
            yield self._contradiction()
        try:
            yield from merged(self._runs(newest_first=newest_first), newest_first=newest_first)
        except _ContradictedError as error:
            # Raised in place of a run: what was yielded lies before all that the run can hold.
            believed, self.index = self.index, self._without_indexes(error)
            yield self._contradiction()
            self._window, passed = _split_window(
                self._window, error.chunk, newest_first=newest_first
            )
            if overlooked := _overlooked(believed, self.index, self._wanted, passed):
                yield LostError(str(error), *overlooked)
            yield from merged(self._runs(newest_first=newest_first), newest_first=newest_first)

    def batches(self, bare: Collection[str]) -> Iterator[Batch | LostError]:
        """Yields the messages many at once, and errors where some are lost."""
        if self.index.contradiction:
            yield self._contradiction()
        passed: dict[int, Chunk] = {}
        try:
            yield from self._batches(bare, passed)
        except _ContradictedError as error:
            self.index = self._without_indexes(error)
            yield self._contradiction()
            for chunk in _with_any(self.index, self._wanted, self._window):
                yield from self._batches_of_chunk(chunk, passed.get(chunk.offset))

    def _contradiction(self) -> ContradictionError:
        return ContradictionError(
            self.index.contradiction, self._window.start, self._window.stop - 1
        )

    @property
    def _wanted(self) -> dict[int, Channel]:
        """The channels of the topics that have messages."""
        used = self.index.used
        return {
            number: channel
            for number, channel in self.index.channels.items()
            if channel.topic in self._topics and number in used
        }

    def _batches(
        self, bare: Collection[str], passed: dict[int, Chunk]
    ) -> Iterator[Batch | LostError]:
        """Yields the messages of chunks, and adds these to `passed`.

        Chunks that have only `bare` topics of those wanted are known by their indexes alone.

        Raises:
            _ContradictedError: the indexes of a chunk do not agree with its records.
        """
        file, wanted, window = self._file, self._wanted, self._window
        read = {number for number, channel in wanted.items() if channel.topic not in bare}
        chunks = [*_with_any(self.index, wanted, window)]
        indexed = [chunk for chunk in chunks if chunk.index_places is not None]
        together = [chunk for chunk in indexed if not chunk.channels.isdisjoint(read)]
        if wanted:
            # Those of which all is wanted are compared when they are read.
            self._require_beside(
                {chunk.offset for chunk in together if chunk.channels <= wanted.keys()}
            )
        for group in read_groups(file, together, self._bags.limit):
            yield from self._batches_of_group(group, passed)
            del group  # before the next is read
        for chunk in chunks:
            if chunk.index_places is None:
                yield from self._batches_of_chunk(chunk)
        unread = [chunk for chunk in indexed if chunk.channels.isdisjoint(read)]
        yield from bare_batches(file, unread, wanted, window)
        passed.update({chunk.offset: chunk for chunk in unread})

    def _batches_of_group(
        self, group: ReadChunks, passed: dict[int, Chunk]
    ) -> Iterator[Batch | LostError]:
        """Yields the messages of chunks that were read together; if that failed, one by one."""
        if group.buffer:
            with suppress(UnreadableError, ValueError, IndexError):
                pairs = pairs_in(group.chunks, group.indexes, self._wanted)
                batches = self._batches_of(group, pairs)
                passed.update({chunk.offset: chunk for chunk in group.chunks})
                yield from batches
                return
        for chunk in group.chunks:
            yield from self._batches_of_chunk(chunk)
            passed[chunk.offset] = chunk

    def _batches_of_chunk(
        self, chunk: Chunk, before: Chunk | None = None
    ) -> Iterator[Batch | LostError]:
        """Yields the messages of one chunk, but for those that `before` had in its indexes.

        Raises:
            _ContradictedError: the indexes of the chunk do not agree with its records; then nothing
                was yielded.
        """
        try:
            content = self._content(chunk)
        except UnreadableError as error:
            lost = self._lost(chunk, str(error))
            if lost is not None:
                yield lost
            return
        pairs = self._pairs(content)
        pairs = pairs.taken(np.isin(pairs.channels, [*self._wanted]))
        if before is not None:
            known = self._believed(before, before.channels).offsets
            pairs = pairs.taken(~np.isin(pairs.offsets, known))
        yield from self._batches_of(content, pairs)

    def _batches_of(self, content: ReadChunks, pairs: Pairs) -> Iterator[Batch]:
        return batches_of(content, pairs, self._wanted, self._window, self._uncompressed)

    def _runs(self, *, newest_first: bool) -> Iterator[SortedRun[Record | LostError]]:
        """Yields a run for each chunk with messages of the topics, and one for all loose messages.

        Raises:
            _ContradictedError: the indexes of a chunk do not agree with its records; also raised
                when a run is read.
        """
        wanted = self._wanted
        # Of large chunks only the last used stays decompressed: all that overlap in time would
        # otherwise be in memory at once.
        last_used = lru_cache(1)(self._content)

        def rows_of(chunk: Chunk) -> RunRows[Record | LostError] | None:
            last_used.cache_clear()  # before the next is decompressed
            try:
                content = last_used(chunk)
            except UnreadableError as error:
                # Only what is wanted by the chunk's index is lost.
                lost = self._lost(chunk, str(error))
                if lost is None:
                    return None
                at = lost.last if newest_first else lost.first
                return RunRows([at], [0], lambda _place, _time: lost)
            column = self._inside(self._pairs(content, wanted), wanted)
            times, places = (part[:: -1 if newest_first else 1].tolist() for part in column)
            if not times:
                return None
            if len(content.buffer) <= _LARGE_BYTES:
                return RunRows(times, places, partial(self._record, content.buffer, wanted))
            del content
            return RunRows(
                times, places, lambda *at: self._record(last_used(chunk).buffer, wanted, *at)
            )

        if wanted:
            self._require_beside()
        for chunk in _with_any(self.index, wanted, self._window):
            yield SortedRun(chunk.start, chunk.end, chunk.offset, partial(rows_of, chunk))

    def _inside(self, pairs: Pairs, wanted: Collection[int]) -> tuple[IntArray, IntArray]:
        """Returns log times and offsets of the wanted messages inside the window, in order."""
        channels, numbers = pairs.channels, [*wanted]
        # One alone, as in most questions, is compared in a tenth of the time.
        is_wanted = channels == numbers[0] if len(numbers) == 1 else np.isin(channels, numbers)
        times, places = pairs.times[is_wanted], pairs.offsets[is_wanted]
        if (times[1:] <= times[:-1]).any():
            order = np.lexsort((places, times))
            times, places = times[order], places[order]
        first, last = times.searchsorted((self._window.start, min(self._window.stop, MAX_NS)))
        return times[first:last], places[first:last]

    def _lost(self, chunk: Chunk, reason: str) -> LostError | None:
        """Returns what of the window is lost with a chunk that cannot be read; None if nothing."""
        window = self._window
        first, last = max(chunk.start, window.start), min(chunk.end, window.stop - 1)
        with suppress(UnreadableError), as_unreadable():
            times, _ = self._inside(self._believed(chunk, self._wanted), self._wanted)
            if not times.size:
                return None
            first, last = int(times[0]), int(times[-1])
        return LostError(reason, first, last)

    def _require_beside(self, passed: Collection[int] = ()) -> None:
        """Compares the chunks beside the window with their records, each once.

        Not those at the offsets `passed`, which are compared anyway.

        Raises:
            _ContradictedError: the indexes of one of them do not agree with its records.
        """
        for chunk in _beside(self.index, self._window):
            if chunk.index_places is not None and chunk.offset not in passed:
                try:
                    self._pairs(self._content(chunk))
                except _ContradictedError as error:
                    raise _ContradictedError(str(error)) from error
                except UnreadableError:
                    continue

    def _pairs(self, content: ReadChunks, wanted: Collection[int] | None = None) -> Pairs:
        """Returns the messages of a chunk, compared with its decompressed records.

        Those of all channels, or at least of the `wanted` ones.

        Raises:
            _ContradictedError: the indexes do not agree with the records.
            UnreadableError: the records cannot be read.
        """
        [chunk] = content.chunks
        channels = chunk.channels if wanted is None else chunk.channels.intersection(wanted)
        key = (self._file.key, chunk.offset, channels)
        pairs = self._bags.indexes.get(key)
        if isinstance(pairs, Pairs):
            return pairs
        if chunk.index_places is None:
            pairs = walk_chunk(content.buffer).pairs
        else:
            try:
                pairs = believed_pairs(chunk, content.indexes[0], channels)
                compared(content, pairs)
            except (UnreadableError, ValueError, IndexError, struct.error) as error:
                raise _ContradictedError(reason_of(error), chunk) from error
        self._bags.indexes.put(key, pairs, 4 * pairs.times.nbytes + 600)
        return pairs

    def _content(self, chunk: Chunk) -> ReadChunks:
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
        return ReadChunks([chunk], data, [len(data)], [self._index_of(chunk)])

    def _index_of(self, chunk: Chunk) -> bytes:
        return self._file.read(chunk.offset + chunk.length, chunk.index_length)

    def _believed(self, chunk: Chunk, wanted: Collection[int]) -> Pairs:
        return believed_pairs(chunk, self._index_of(chunk), wanted)

    def _record(self, data: bytes, channels: Mapping[int, Channel], place: int, time: Ns) -> Record:
        """Returns a message of a decompressed chunk, whose place was compared with its records."""
        _, length, number, _, _, published = MESSAGE.unpack_from(data, place)
        channel = channels[number]
        payload = data[place + MESSAGE.size : place + RECORD.size + length]
        if payload.startswith(FRAME_MAGIC):
            payload = self._uncompressed(channel, payload)
        return Record(channel, time, published if 0 < published < MAX_NS else time, payload)


def _with_any(index: McapIndex, wanted: Collection[int], window: TimeWindow) -> Iterator[Chunk]:
    """Yields the chunks that overlap the window and have messages of one of the channels."""
    for chunk in index.chunks:
        if window.overlaps(chunk.start, chunk.end) and not chunk.channels.isdisjoint(wanted):
            yield chunk


def _beside(index: McapIndex, window: TimeWindow) -> list[Chunk]:
    """Returns the chunks that may hold messages of a window of which their indexes know nothing.

    In the order of the file the times of chunks ascend, mostly, and one follows the other. Where
    all indexes of a chunk agree on wrong times, no chunk has the times of its messages: such a
    hole is looked for at both ends of the window, and between two chunks that overlap it. Where
    neighbours agree on it, no hole need be there, but the times of the file do not go on.
    """
    chunks, start, last = index.chunks, window.start, window.stop - 1
    inside = [n for n, chunk in enumerate(chunks) if chunk.start <= last and chunk.end >= start]
    beside = {n + 1 for n, following in pairwise(inside) if following - n == _NEXT_BUT_ONE}
    for seam in index.seams:
        if seam.first <= last and seam.last >= start:
            beside.update((seam.nth, seam.nth + 1))
    for at in (start, last):
        if not any(chunks[n].start <= at <= chunks[n].end for n in inside):
            before = [(chunk.end, n) for n, chunk in enumerate(chunks) if chunk.end < at]
            nth = max(before)[1] if before else -1
            beside.update((nth, nth + 1))
    return [chunks[n] for n in sorted(beside) if 0 <= n < len(chunks)]


def _split_window(
    window: TimeWindow, chunk: Chunk | None, *, newest_first: bool
) -> tuple[TimeWindow, TimeWindow]:
    """Splits a window at a chunk: what is left to read, and what was read before it."""
    at = window.stop if newest_first else window.start
    if chunk is not None:
        at = chunk.end + 1 if newest_first else chunk.start
        at = min(max(at, window.start), window.stop)
    before, behind = TimeWindow(window.start, at), TimeWindow(at, window.stop)
    return (before, behind) if newest_first else (behind, before)


def _overlooked(
    believed: McapIndex, index: McapIndex, wanted: Collection[int], passed: TimeWindow
) -> Span | None:
    """Returns between which log times messages were missed, in a part read by wrong indexes."""
    believed_at = {chunk.offset: chunk for chunk in believed.chunks}
    chunks = [
        chunk
        for chunk in _with_any(index, wanted, passed)
        if (known := believed_at.get(chunk.offset)) is None
        or not (known.start <= chunk.start and chunk.end <= known.end)
        or not chunk.channels <= known.channels
    ]
    if not chunks:
        return None
    first = max(min(chunk.start for chunk in chunks), passed.start)
    return first, min(max(chunk.end for chunk in chunks), passed.stop - 1)


def _out_of_order(chunks: Sequence[Chunk]) -> Iterator[Chunk]:
    """Yields chunks that follow each other in the file, and whose times are the other way round."""
    for before, after in pairwise(sorted(chunks, key=attrgetter("offset"))):
        if after.end < before.start:
            yield from (before, after)
