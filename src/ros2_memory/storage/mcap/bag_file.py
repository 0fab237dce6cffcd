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
from mcap.opcode import Opcode
from mcap.records import Header

from ros2_memory.core.bag_summary import READ_WITHOUT_INDEXES, BagSummary
from ros2_memory.core.large_reads import LargeReads
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MAX_NS, Ns
from ros2_memory.storage.base import (
    Batch,
    Channel,
    ChannelTotal,
    Closing,
    Record,
    batched,
    summarize_channels,
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
    loose_place,
    read_groups,
)
from ros2_memory.storage.mcap.chunk import (
    NO_MESSAGES,
    NOT_THERE,
    Chunk,
    Column,
    Pairs,
    declarations_of,
    in_file_order,
    index_groups,
    joined,
    pairs_in,
    require_indexed,
    walk_chunk,
)
from ros2_memory.storage.mcap.index import (
    OTHER_DECLARED,
    DoubtError,
    McapIndex,
    chunk_columns,
    chunk_data,
    index_from_summary,
)
from ros2_memory.storage.mcap.merge import RunRows, SortedRun, merged
from ros2_memory.storage.mcap.records import (
    MESSAGE,
    RECORD,
    BodyStream,
    Declarations,
    closing_of,
    file_records,
    is_finished,
)
from ros2_memory.storage.mcap.scan import index_by_scan
from ros2_memory.storage.zstd_bag import FRAME_MAGIC, Uncompressed, uncompressed_payload

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.storage.base import IntArray


_LARGE_BYTES: Final = 8 << 20
_REASONS_BYTES: Final = 1 << 20
_VERIFIED_BYTES: Final = 32 << 20
"""Chunks that take more, together, are not read only to verify their message indexes."""
_COMPARED: Final = -1
"""In place of a channel: all indexes of a chunk were found right."""
_YES: Final = NO_MESSAGES
_NEXT_BUT_ONE: Final = 2


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
        self._limit = SizeLimit(max_chunk_mb << 20, (large or LargeReads()).acquire)
        self._uncompressed = partial(uncompressed_payload, limit=self._limit)
        self._indexes: ByteLru[McapIndex | Column] = ByteLru((cache_mb << 20) // 2)
        self._chunks: ByteLru[bytes] = ByteLru((cache_mb << 20) // 2)
        self._contradictions: ByteLru[str] = ByteLru(_REASONS_BYTES)

    def closing(self, path: Path) -> Closing:
        """Returns whether the writer has finished the file."""
        with OpenFile(path) as file:
            return closing_of(file)

    def summarize(self, path: Path) -> BagSummary:
        """Returns topics with exact counts and first and last log times."""
        with OpenFile(path) as file:
            index = self._verified(file, self._index(file))
        totals = [
            ChannelTotal(
                index.channels[number],
                total.count,
                total.first,
                total.last,
                index.absences.get(number, ()),
            )
            for number, total in index.totals.items()
        ]
        return summarize_channels(
            totals,
            index.channels.values(),
            complete=index.complete,
            notes=index.notes,
            set_back=index.set_back,
            pauses=index.pauses,
        )

    def channels(self, path: Path) -> Sequence[Channel]:
        """Returns the channels declared in the file."""
        with OpenFile(path) as file:
            return list(self._index(file).channels.values())

    def profile(self, path: Path) -> str:
        """Returns the profile in the header of the file; empty if there is no header."""
        with OpenFile(path) as file:
            first = next(file_records(file), None)
            if first is None or first.opcode != Opcode.HEADER:
                return ""
            header: Header = Header.read(BodyStream(first.body(file)))
            return header.profile

    def records(
        self, path: Path, topics: Collection[str], window: TimeWindow, *, newest_first: bool
    ) -> Iterator[Record | LostError]:
        """Yields the messages of `topics` inside the window, in order.

        An error is yielded in place of the messages of a damaged chunk, where the first would be.
        """
        if window.empty:
            return
        with OpenFile(path) as file:
            index = self._index(file)
            if index.contradiction:
                yield ContradictionError(index.contradiction, window.start, window.stop - 1)
            try:
                runs = self._runs(file, index, topics, window, newest_first=newest_first)
                yield from merged(runs, newest_first=newest_first)
            except _ContradictedError as error:
                # Raised in place of a run: what was yielded lies before all that the run can hold.
                right = self._distrust(file, error)
                yield ContradictionError(right.contradiction, window.start, window.stop - 1)
                left, passed = _split_window(window, error.chunk, newest_first=newest_first)
                if overlooked := _overlooked(index, right, _wanted(right, topics), passed):
                    yield LostError(str(error), *overlooked)
                runs = self._runs(file, right, topics, left, newest_first=newest_first)
                yield from merged(runs, newest_first=newest_first)

    def batches(
        self, path: Path, topics: Collection[str], window: TimeWindow, bare: Collection[str]
    ) -> Iterator[Batch | LostError]:
        """Yields the messages of `records`, many at once; see `BagReader.batches`.

        An error is yielded in place of the messages of a damaged chunk.
        """
        if window.empty:
            return
        with OpenFile(path) as file:
            index = self._index(file)
            if index.contradiction:
                yield ContradictionError(index.contradiction, window.start, window.stop - 1)
            wanted = _wanted(index, topics)
            read = {number for number, channel in wanted.items() if channel.topic not in bare}
            passed: dict[int, Chunk] = {}
            try:
                yield from self._batches(file, index, wanted, read, window, passed=passed)
                column = _loose(index, wanted, window)
                fetch = _fetch_loose(file, wanted, self._uncompressed)
                pairs = zip(column.places.tolist(), column.times.tolist(), strict=True)
                yield from batched((loose_place(place), fetch(place, at)) for place, at in pairs)
            except _ContradictedError as error:
                index = self._distrust(file, error)
                yield ContradictionError(index.contradiction, window.start, window.stop - 1)
                wanted = _wanted(index, topics)
                for chunk in _with_any(index, wanted, window):
                    before = passed.get(chunk.offset)
                    yield from self._batches_of_chunk(file, chunk, wanted, window, before)

    def _batches(
        self,
        file: OpenFile,
        index: McapIndex,
        wanted: dict[int, Channel],
        read: Collection[int],
        window: TimeWindow,
        *,
        passed: dict[int, Chunk],
    ) -> Iterator[Batch | LostError]:
        """Yields the messages of chunks, and adds these to `passed`.

        Chunks without a channel that is to be `read` are known by their indexes alone.

        Raises:
            _ContradictedError: the indexes of a chunk do not agree with its records.
        """
        chunks = [*_with_any(index, wanted, window)]
        indexed = [chunk for chunk in chunks if chunk.index_places is not None]
        together = [chunk for chunk in indexed if not chunk.channels.isdisjoint(read)]
        if wanted:
            # Those of which all is wanted are compared when they are read.
            whole = {chunk.offset for chunk in together if chunk.channels <= wanted.keys()}
            self._require_beside(file, index, window, passed=whole)
        for group in read_groups(file, together, self._limit):
            yield from self._batches_of_group(file, group, wanted, window, passed)
            del group  # before the next is read
        for chunk in chunks:
            if chunk.index_places is None:
                yield from self._batches_of_chunk(file, chunk, wanted, window, None)
        unread = [chunk for chunk in indexed if chunk.channels.isdisjoint(read)]
        yield from bare_batches(file, unread, wanted, window)
        passed.update({chunk.offset: chunk for chunk in unread})

    def _batches_of_group(
        self,
        file: OpenFile,
        group: ReadChunks,
        wanted: dict[int, Channel],
        window: TimeWindow,
        passed: dict[int, Chunk],
    ) -> Iterator[Batch | LostError]:
        """Yields the messages of chunks that were read together; if that failed, one by one."""
        if group.buffer is not None:
            with suppress(UnreadableError, ValueError, IndexError):
                pairs = pairs_in(group.chunks, group.indexes, wanted)
                batches = batches_of(group, pairs, wanted, window, self._uncompressed)
                passed.update({chunk.offset: chunk for chunk in group.chunks})
                yield from batches
                return
        for chunk in group.chunks:
            yield from self._batches_of_chunk(file, chunk, wanted, window, None)
            passed[chunk.offset] = chunk

    def _batches_of_chunk(
        self,
        file: OpenFile,
        chunk: Chunk,
        wanted: dict[int, Channel],
        window: TimeWindow,
        before: Chunk | None,
    ) -> Iterator[Batch | LostError]:
        """Yields the messages of one chunk, but for those that `before` had in its indexes.

        Raises:
            _ContradictedError: the indexes of the chunk do not agree with its records; then nothing
                was yielded.
        """
        try:
            with as_unreadable():
                data = self._chunk_data(file, chunk)
        except UnreadableError as error:
            lost = self._lost(file, chunk, wanted, window, str(error))
            if lost is not None:
                yield lost
            return
        try:
            pairs = _pairs(file, chunk, wanted, data)
            if before is not None:
                earlier = _pairs(file, before, wanted, data)
                pairs = pairs.taken(~np.isin(pairs.offsets, earlier.offsets))
            content = ReadChunks([chunk], data, [len(data)])
            batches = batches_of(content, pairs, wanted, window, self._uncompressed)
        except (UnreadableError, ValueError, IndexError) as error:
            if chunk.index_places is None:
                raise
            raise _ContradictedError(reason_of(error)) from error
        yield from batches

    def _runs(
        self,
        file: OpenFile,
        index: McapIndex,
        topics: Collection[str],
        window: TimeWindow,
        *,
        newest_first: bool,
    ) -> Iterator[SortedRun[Record | LostError]]:
        """Yields a run for each chunk with messages of the topics, and one for all loose messages.

        Raises:
            _ContradictedError: the indexes of a chunk do not agree with its records; also raised
                when a run is read.
        """
        wanted = _wanted(index, topics)
        # Of large chunks only the last used stays decompressed: all that overlap in time would
        # otherwise be in memory at once.
        last_used = lru_cache(1)(partial(self._chunk_data, file))

        def fetch_large(chunk: Chunk, place: int, time: Ns) -> Record:
            return _fetch_from_chunk(last_used(chunk), wanted, self._uncompressed)(place, time)

        def rows_of(chunk: Chunk) -> RunRows[Record | LostError] | None:
            last_used.cache_clear()  # before the next is decompressed
            try:
                with as_unreadable():
                    data = last_used(chunk)
            except UnreadableError as error:
                # Only what is wanted by the chunk's index is lost.
                lost = self._lost(file, chunk, wanted, window, str(error))
                return None if lost is None else _lost_rows(lost, newest_first=newest_first)
            columns = self._chunk_columns(file, chunk, wanted, data)
            column = joined([indexed.between(window.start, window.stop) for indexed in columns])
            if not column.times.size:
                return None
            if len(data) <= _LARGE_BYTES:
                fetch = _fetch_from_chunk(data, wanted, self._uncompressed)
            else:
                fetch = partial(fetch_large, chunk)
            return _rows(column, fetch, newest_first=newest_first)

        if wanted:
            self._require_beside(file, index, window)
        for chunk in _with_any(index, wanted, window):
            yield SortedRun(chunk.start, chunk.end, chunk.offset, partial(rows_of, chunk))
        column = _loose(index, wanted, window)
        if column.times.size:
            fetch = _fetch_loose(file, wanted, self._uncompressed)
            rows = _rows(column, fetch, newest_first=newest_first)
            yield SortedRun(int(column.times[0]), int(column.times[-1]), 0, lambda: rows)

    def _index(self, file: OpenFile) -> McapIndex:
        index = self._indexes.get(file.key)
        if isinstance(index, McapIndex):
            return index
        reason = self._contradictions.get(file.key)
        if reason is not None:
            return self._index_without_indexes(file, reason)
        if not is_finished(file):
            return self._cache_index(file, index_by_scan(file, self._limit))
        try:
            index = index_from_summary(file)
        except DoubtError as doubt:
            index = index_by_scan(file, self._limit, str(doubt))
        except UnreadableError as error:
            return self._distrust(file, error)
        return self._cache_index(file, index)

    def _cache_index(self, file: OpenFile, index: McapIndex) -> McapIndex:
        self._indexes.put(file.key, index, index.memory_bytes)
        return index

    def _lost(
        self,
        file: OpenFile,
        chunk: Chunk,
        wanted: Collection[int],
        window: TimeWindow,
        reason: str,
    ) -> LostError | None:
        """Returns what of the window is lost with a chunk that cannot be read; None if nothing."""
        try:
            with as_unreadable():
                columns = self._chunk_columns(file, chunk, wanted, None)
        except UnreadableError:
            first, last = max(chunk.start, window.start), min(chunk.end, window.stop - 1)
            return LostError(reason, first, last)
        times = joined([column.between(window.start, window.stop) for column in columns]).times
        return LostError(reason, int(times[0]), int(times[-1])) if times.size else None

    def _chunk_columns(
        self, file: OpenFile, chunk: Chunk, wanted: Collection[int], data: bytes | None
    ) -> list[Column]:
        """Returns the messages of the wanted channels in a chunk, compared with its records.

        Without `data`, the decompressed records, the message indexes are believed.

        Raises:
            _ContradictedError: the message indexes do not agree with the records.
        """
        columns: list[Column] = []
        missing: list[int] = []
        for channel in chunk.channels.intersection(wanted):
            column = self._indexes.get((file.key, chunk.offset, channel))
            if isinstance(column, Column):
                columns.append(column)
            else:
                missing.append(channel)
        if not missing:
            return columns
        if chunk.index_places is None:
            data = self._chunk_data(file, chunk) if data is None else data
            read = walk_chunk(data).pairs.columns(missing)
        else:
            try:
                read = chunk_columns(file, chunk, missing)
                for channel, fresh in read.items():
                    if data is not None:
                        require_indexed(fresh.of_channel(channel), data, fresh.places)
            except (UnreadableError, ValueError, IndexError, struct.error) as error:
                raise _ContradictedError(reason_of(error), chunk) from error
        for channel, fresh in read.items():
            if data is not None:
                self._indexes.put((file.key, chunk.offset, channel), fresh, fresh.memory_bytes)
        return [*columns, *read.values()]

    def _require_beside(
        self,
        file: OpenFile,
        index: McapIndex,
        window: TimeWindow,
        *,
        passed: Collection[int] = (),
    ) -> None:
        """Compares the chunks beside a window with their records, each once.

        Not those at the offsets `passed`, which are compared anyway.

        Raises:
            _ContradictedError: the indexes of one of them do not agree with its records.
        """
        for chunk in _beside(index, window):
            if chunk.index_places is None or chunk.offset in passed:
                continue
            if self._indexes.get((file.key, chunk.offset, _COMPARED)):
                continue
            data = self._readable_data(file, chunk)
            if data is None:
                continue
            try:
                self._compared(file, chunk, data)
            except _ContradictedError as error:
                raise _ContradictedError(str(error)) from error
            del data  # before the next is read

    def _compared(self, file: OpenFile, chunk: Chunk, data: bytes) -> IntArray:
        """Returns where a chunk's messages begin in its records, ascending, compared with these.

        Raises:
            _ContradictedError: the indexes do not agree with the records.
        """
        try:
            pairs = _pairs(file, chunk, chunk.channels, data)
            require_indexed(pairs, data, pairs.offsets)
            places = in_file_order(pairs.offsets)
        except (UnreadableError, ValueError, IndexError) as error:
            raise _ContradictedError(reason_of(error), chunk) from error
        self._indexes.put((file.key, chunk.offset, _COMPARED), _YES, _YES.memory_bytes)
        return places

    def _readable_data(self, file: OpenFile, chunk: Chunk) -> bytes | None:
        """Returns the records of a chunk; None if they cannot be read."""
        try:
            with as_unreadable():
                return self._chunk_data(file, chunk)
        except UnreadableError:
            return None

    def _verified(self, file: OpenFile, index: McapIndex) -> McapIndex:
        """Returns the index if its first and last times agree with the messages; else another.

        A bag is chosen for a question by these times: a wrong one would hide its messages.
        """
        totals = index.totals.values()
        ends = sorted({end for total in totals for end in (total.first, total.last)})
        odd = (*index.chunks[:1], *index.chunks[-1:], *_out_of_order(index.chunks))
        looked_at = {chunk.offset for chunk in odd}
        left = _VERIFIED_BYTES
        try:
            for chunk in index.chunks:
                nth = bisect_left(ends, chunk.start)
                is_end = nth < len(ends) and ends[nth] <= chunk.end
                if chunk.index_places is None or not (is_end or chunk.offset in looked_at):
                    continue
                left -= chunk.length
                if left < 0:
                    break
                data = self._readable_data(file, chunk)
                if data is None:
                    continue
                places = self._compared(file, chunk, data)
                if index.declared is not None:
                    _require_declared(index.declared, data, places)
                del data  # before the next is read
        except _ContradictedError as error:
            return self._distrust(file, error)
        return index

    def _distrust(self, file: OpenFile, error: UnreadableError) -> McapIndex:
        """Returns an index of the messages themselves, in place of one that was found wrong."""
        reason = f"{error}; {READ_WITHOUT_INDEXES}"
        # Kept apart from the index: not every read that follows would find it out again.
        self._contradictions.put(file.key, reason, len(reason) + len(file.key.path) + 200)
        return self._index_without_indexes(file, reason)

    def _index_without_indexes(self, file: OpenFile, reason: str) -> McapIndex:
        index = index_by_scan(file, self._limit, reason)
        return self._cache_index(file, index._replace(contradiction=reason))

    def _chunk_data(self, file: OpenFile, chunk: Chunk) -> bytes:
        key = (file.key, chunk.offset)
        data = self._chunks.get(key)
        if data is None:
            data = chunk_data(file, chunk, self._limit)
            self._chunks.put(key, data, len(data))
        return data


def _pairs(file: OpenFile, chunk: Chunk, wanted: Collection[int], data: bytes) -> Pairs:
    """Returns the messages of the wanted channels in a chunk, by its indexes if it has some.

    Raises:
        UnreadableError: it has other indexes than it should.
    """
    if chunk.index_places is None:
        pairs = walk_chunk(data).pairs
        return pairs.taken(np.isin(pairs.channels, sorted(wanted)))
    [(chunks, indexes)] = index_groups(file, [chunk])
    return pairs_in(chunks, indexes, wanted)


def _require_declared(declared: Declarations, data: bytes, places: IntArray) -> None:
    """Compares what a summary section declares with what a chunk declares and holds.

    Args:
        declared: the schemas and channels of the summary section.
        data: the decompressed records of the chunk, which its checksum protects.
        places: where its messages begin in these, ascending.

    Raises:
        _ContradictedError: the chunk declares a channel otherwise, or holds more messages.
    """
    try:
        with as_unreadable():
            agrees = all(
                declared.agrees(*declaration) for declaration in declarations_of(data, places)
            )
    except UnreadableError as error:
        raise _ContradictedError(reason_of(error)) from error
    if not agrees:
        raise _ContradictedError(OTHER_DECLARED)


def _wanted(index: McapIndex, topics: Collection[str]) -> dict[int, Channel]:
    """Returns the channels of the topics that have messages."""
    return {
        number: channel
        for number, channel in index.channels.items()
        if channel.topic in topics and number in index.totals
    }


def _loose(index: McapIndex, wanted: Collection[int], window: TimeWindow) -> Column:
    """Returns the wanted messages outside chunks."""
    loose = [column for channel, column in index.loose.items() if channel in wanted]
    return joined([column.between(window.start, window.stop) for column in loose])


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
    if chunk is None:
        return window, TimeWindow(window.start, window.start)
    at = chunk.end + 1 if newest_first else chunk.start
    at = min(max(at, window.start), window.stop)
    before, behind = TimeWindow(window.start, at), TimeWindow(at, window.stop)
    return (before, behind) if newest_first else (behind, before)


def _overlooked(
    believed: McapIndex, index: McapIndex, wanted: Collection[int], passed: TimeWindow
) -> tuple[Ns, Ns] | None:
    """Returns between which log times messages were missed, in a part read by wrong indexes."""
    believed_at = {chunk.offset: chunk for chunk in believed.chunks}
    chunks = [
        chunk
        for chunk in _with_any(index, wanted, passed)
        if not _describes(believed_at.get(chunk.offset), chunk)
    ]
    if not chunks:
        return None
    first = max(min(chunk.start for chunk in chunks), passed.start)
    return first, min(max(chunk.end for chunk in chunks), passed.stop - 1)


def _describes(believed: Chunk | None, chunk: Chunk) -> bool:
    """Returns whether an index had all times and channels of a chunk."""
    if believed is None:
        return False
    is_within = believed.start <= chunk.start and chunk.end <= believed.end
    return is_within and chunk.channels <= believed.channels


def _out_of_order(chunks: Sequence[Chunk]) -> Iterator[Chunk]:
    """Yields chunks that follow each other in the file, and whose times are the other way round."""
    for before, after in pairwise(sorted(chunks, key=attrgetter("offset"))):
        if after.end < before.start:
            yield from (before, after)


def _lost_rows(lost: LostError, *, newest_first: bool) -> RunRows[Record | LostError]:
    """Returns a loss as the one message of its run."""
    at = lost.last if newest_first else lost.first
    return RunRows([at], [0], lambda _place, _time: lost)


def _rows(
    column: Column, fetch: Callable[[int, Ns], Record | LostError], *, newest_first: bool
) -> RunRows[Record | LostError]:
    times, places = column
    if newest_first:
        times, places = times[::-1], places[::-1]
    return RunRows(times.tolist(), places.tolist(), fetch)


def _fetch_from_chunk(
    data: bytes, channels: dict[int, Channel], uncompressed: Uncompressed
) -> Callable[[int, Ns], Record]:
    """Returns what fetches messages from a decompressed chunk."""
    unpack = MESSAGE.unpack_from
    last = len(data) - MESSAGE.size

    def fetch(place: int, time: Ns) -> Record:
        if not 0 <= place <= last:
            raise UnreadableError(NOT_THERE)
        opcode, length, number, _, log_time, publish_time = unpack(data, place)
        end = place + RECORD.size + length
        if opcode != Opcode.MESSAGE or log_time != time or end > len(data):
            raise UnreadableError(NOT_THERE)
        channel = _channel(channels, number)
        payload = data[place + MESSAGE.size : end]
        return _record(channel, log_time, publish_time, payload, uncompressed)

    return fetch


def _fetch_loose(
    file: OpenFile, channels: dict[int, Channel], uncompressed: Uncompressed
) -> Callable[[int, Ns], Record]:
    """Returns what fetches messages outside of chunks."""

    def fetch(place: int, time: Ns) -> Record:
        head = MESSAGE.unpack(file.read(place, MESSAGE.size))
        _, length, number, _, _, published = head
        channel = _channel(channels, number)
        payload = file.read(place + MESSAGE.size, length + RECORD.size - MESSAGE.size)
        return _record(channel, time, published, payload, uncompressed)

    return fetch


def _channel(channels: dict[int, Channel], number: int) -> Channel:
    channel = channels.get(number)
    if channel is None:
        raise UnreadableError("damaged: a message is not of the channel that its index says")
    return channel


def _record(
    channel: Channel, log_time: Ns, publish_time: Ns, payload: bytes, uncompressed: Uncompressed
) -> Record:
    if payload.startswith(FRAME_MAGIC):
        payload = uncompressed(channel, payload)
    published = publish_time if 0 < publish_time < MAX_NS else log_time
    return Record(channel, log_time, published, payload)
