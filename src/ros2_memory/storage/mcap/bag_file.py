"""The MCAP room: summaries, messages and log times of `.mcap` files.

Fast because it decompresses a chunk only for a message that is wanted, and takes log times and
places from the message indexes; whole because it falls back to the messages themselves wherever a
file's own indexes are missing or wrong (see `mcap_index`).
"""

from __future__ import annotations

import struct
from bisect import bisect_left
from operator import attrgetter
from typing import TYPE_CHECKING, Final

import numpy as np
from mcap.opcode import Opcode

from ros2_memory.core.bag_summary import READ_WITHOUT_INDEXES
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MAX_NS
from ros2_memory.storage.base import Channel, Closing, Held, Record, bag_summary
from ros2_memory.storage.cache import ByteLru
from ros2_memory.storage.errors import (
    MAX_CHUNK_MB,
    ContradictionError,
    LostError,
    UnreadableError,
    as_unreadable,
    reason_of,
)
from ros2_memory.storage.file_io import OpenFile
from ros2_memory.storage.mcap.chunk import (
    NO_MESSAGES,
    NOT_THERE,
    Column,
    joined,
    walk_chunk,
)
from ros2_memory.storage.mcap.index import (
    McapIndex,
    chunk_columns,
    chunk_data,
    index_from_summary,
    proven_columns,
    require_channels,
    require_declared,
)
from ros2_memory.storage.mcap.merge import Rows, SortedRun, merged
from ros2_memory.storage.mcap.records import MESSAGE, RECORD, closing_of, is_finished, profile_of
from ros2_memory.storage.mcap.scan import index_by_scan
from ros2_memory.storage.mcap.summary import Chunk, DoubtError
from ros2_memory.storage.zstd_bag import plain_payload

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.core.model import BagSummary
    from ros2_memory.core.timebase import Ns


_LARGE_BYTES: Final = 8 << 20
_CONTRADICTED_BYTES: Final = 1 << 20
_PROVEN_BYTES: Final = 32 << 20
"""Chunks that take more, together, are not read only to hold their message indexes against them."""


class _ContradictedError(UnreadableError):
    """The message indexes of a chunk do not agree with its records.

    `chunk` is the one in place of whose messages this is raised; None before any was read.
    `believed` are the chunks by their places as they were taken to be.
    """

    def __init__(self, reason: str, chunk: Chunk | None = None) -> None:
        super().__init__(reason)
        self.chunk = chunk
        self.believed: dict[int, Chunk] = {}


class McapBags:
    """Reads MCAP files. Safe to use from several threads at once.

    What goes wrong is raised as it comes; the adapters translate it (`faults.reading`).

    Args:
        cache_mb: what indexes and decompressed chunks may take of memory between calls.
        max_chunk_mb: what one chunk may hold, decompressed.
    """

    def __init__(self, cache_mb: int = 64, max_chunk_mb: int = MAX_CHUNK_MB) -> None:
        self._max_chunk_bytes = max_chunk_mb << 20
        self._found: ByteLru[McapIndex | Column] = ByteLru((cache_mb << 20) // 2)
        self._data: ByteLru[bytes] = ByteLru((cache_mb << 20) // 2)
        self._contradicted: ByteLru[str] = ByteLru(_CONTRADICTED_BYTES)

    def closing(self, path: Path) -> Closing:
        """Whether the writer has finished the file."""
        with OpenFile(path) as file:
            return closing_of(file)

    def summarize(self, path: Path) -> BagSummary:
        """Topics with exact counts and first and last log times."""
        with OpenFile(path) as file:
            index = self._proven(file, self._index(file))
        held = [
            Held(index.channels[number], total.count, total.first, total.last)
            for number, total in index.totals.items()
        ]
        declared = index.channels.values()
        return bag_summary(
            held, declared, complete=index.complete, notes=index.notes, set_back=index.set_back
        )

    def channels(self, path: Path) -> Sequence[Channel]:
        """The channels declared in the file."""
        with OpenFile(path) as file:
            return list(self._index(file).channels.values())

    def profile(self, path: Path) -> str:
        """The profile that the header of the file holds."""
        with OpenFile(path) as file:
            return profile_of(file)

    def records(
        self, path: Path, topics: Collection[str], window: TimeWindow, *, newest_first: bool
    ) -> Iterator[Record | LostError]:
        """The messages of `topics` inside the window, in order.

        An error stands for the messages of a damaged chunk, where the first of them would.
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
                # Raised in place of a run: what came before it lies before all that it can hold.
                index = self._distrust(file, index, error)
                yield ContradictionError(index.contradiction, window.start, window.stop - 1)
                left, passed = _parted(window, error.chunk, newest_first=newest_first)
                if hidden := _hidden(index, error, _wanted(index, topics), passed):
                    yield hidden
                runs = self._runs(file, index, topics, left, newest_first=newest_first)
                yield from merged(runs, newest_first=newest_first)

    def newest(self, path: Path, topic: str, window: TimeWindow) -> Record | None:
        """The latest message of the topic inside the window: what `records` begins with.

        Most questions about a moment ask for it, so it does without the merging of many.
        """
        if window.empty:
            return None
        with OpenFile(path) as file:
            index = self._index(file)
            if index.contradiction:
                raise ContradictionError(index.contradiction, window.start, window.stop - 1)
            wanted = _wanted(index, {topic})
            if index.loose:
                runs = self._runs(file, index, {topic}, window, newest_first=True)
                first = next(merged(runs, newest_first=True), None)
                if isinstance(first, LostError):
                    raise first
                return first
            return self._newest_of(file, index, wanted, window)

    def _newest_of(
        self, file: OpenFile, index: McapIndex, wanted: dict[int, Channel], window: TimeWindow
    ) -> Record | None:
        """The latest message inside the window of a file that has all of them in chunks."""
        within = [each for each in index.chunks if _overlaps(each, window)] if wanted else []
        within.sort(key=attrgetter("end"), reverse=True)
        best: tuple[Ns, int, int, bytes] | None = None
        for chunk in within:
            if best is not None and chunk.end < best[0]:
                break
            if not self._holds_any(file, chunk, wanted):
                continue
            data = self._chunk_data(file, chunk)
            for column in self._chunk_columns(file, chunk, wanted, data):
                times, places = column.between(window.start, window.stop)
                if times.size:
                    found = int(times[-1]), chunk.offset, int(places[-1]), data
                    best = found if best is None else max(best, found)
        if best is None:
            return None
        time, _, place, data = best
        return _from_bytes(data, wanted, self._max_chunk_bytes)(place, time)

    def log_times(self, path: Path, topic: str, window: TimeWindow) -> list[Ns]:
        """The log times of a topic's messages inside the window, ascending.

        They are held against the messages where the chunks take no more than `_PROVEN_BYTES`.
        """
        with OpenFile(path) as file:
            index = self._index(file)
            try:
                columns = self._columns(file, index, topic, window)
            except _ContradictedError as error:
                index = self._distrust(file, index, error)
                columns = self._columns(file, index, topic, window)
        parts = [column.between(window.start, window.stop).times for column in columns]
        if window.empty or not parts:
            return []
        times = np.sort(np.concatenate(parts))
        return [int(time) for time in times.tolist()]

    def _columns(
        self, file: OpenFile, index: McapIndex, topic: str, window: TimeWindow
    ) -> list[Column]:
        """The messages of a topic in the chunks that overlap the window, and outside of chunks."""
        wanted = _wanted(index, {topic})
        columns = [index.loose[channel] for channel in wanted if channel in index.loose]
        chunks = list(self._holding(file, index, wanted, window))
        few = sum([chunk.length for chunk in chunks]) <= _PROVEN_BYTES
        for chunk in chunks:
            data = self._data_if_whole(file, chunk) if few else None
            columns += self._chunk_columns(file, chunk, wanted, data)
        return columns

    def _runs(
        self,
        file: OpenFile,
        index: McapIndex,
        topics: Collection[str],
        window: TimeWindow,
        *,
        newest_first: bool,
    ) -> Iterator[SortedRun[Record | LostError]]:
        wanted = _wanted(index, topics)

        large: dict[int, bytes] = {}

        def chunk_run(chunk: Chunk) -> SortedRun[Record | LostError]:
            def rows() -> Rows[Record | LostError] | None:
                # Of a chunk that cannot be read, only what its index says was wanted is lost.
                try:
                    with as_unreadable():
                        data = self._chunk_data(file, chunk)
                except UnreadableError as error:
                    lost = self._lost(file, chunk, wanted, window, str(error))
                    return _lost(lost, newest_first=newest_first) if lost else None
                columns = self._chunk_columns(file, chunk, wanted, data)
                column = joined([each.between(window.start, window.stop) for each in columns])
                if not column.times.size:
                    return None
                fetch = self._fetching(file, chunk, data, wanted, large)
                return _rows(column, fetch, newest_first=newest_first)

            return SortedRun(chunk.start, chunk.end, chunk.offset, rows)

        for chunk in self._holding(file, index, wanted, window):
            yield chunk_run(chunk)
        loose = [column for channel, column in index.loose.items() if channel in wanted]
        column = joined([part.between(window.start, window.stop) for part in loose])
        if column.times.size:
            fetch = _from_file(file, wanted, self._max_chunk_bytes)
            rows = _rows(column, fetch, newest_first=newest_first)
            yield SortedRun(int(column.times[0]), int(column.times[-1]), 0, lambda: rows)

    def _fetching(
        self,
        file: OpenFile,
        chunk: Chunk,
        data: bytes,
        wanted: dict[int, Channel],
        last: dict[int, bytes],
    ) -> Callable[[int, Ns], Record]:
        """Fetches messages of a chunk; of the large ones only the `last` used stays unpacked.

        Those that overlap in time would otherwise all be held at once.
        """
        if len(data) <= _LARGE_BYTES:
            return _from_bytes(data, wanted, self._max_chunk_bytes)

        def fetch(place: int, time: Ns) -> Record:
            held = last.get(chunk.offset)
            if held is None:
                last.clear()
                held = last[chunk.offset] = self._chunk_data(file, chunk)
            return _from_bytes(held, wanted, self._max_chunk_bytes)(place, time)

        return fetch

    def _index(self, file: OpenFile) -> McapIndex:
        index = self._found.get(file.key)
        if not isinstance(index, McapIndex):
            reason = self._contradicted.get(file.key)
            if reason is not None:
                return self._keep(file, self._without_indexes(file, reason))
            index = self._keep(file, _index_of(file, self._max_chunk_bytes))
        return index

    def _keep(self, file: OpenFile, index: McapIndex) -> McapIndex:
        self._found.put(file.key, index, index.bytes_held)
        return index

    def _lost(
        self,
        file: OpenFile,
        chunk: Chunk,
        wanted: Collection[int],
        window: TimeWindow,
        reason: str,
    ) -> LostError | None:
        """What is lost of the window with a chunk that cannot be read; None where nothing is."""
        try:
            with as_unreadable():
                columns = self._chunk_columns(file, chunk, wanted, None)
        except UnreadableError:
            first, last = max(chunk.start, window.start), min(chunk.end, window.stop - 1)
            return LostError(reason, first, last)
        times = joined([each.between(window.start, window.stop) for each in columns]).times
        return LostError(reason, int(times[0]), int(times[-1])) if times.size else None

    def _holding(
        self, file: OpenFile, index: McapIndex, wanted: Collection[int], window: TimeWindow
    ) -> Iterator[Chunk]:
        """The chunks that overlap the window and hold messages of one of the channels.

        Raises:
            _ContradictedError: a chunk index names other channels than its chunk holds.
        """
        for chunk in index.chunks if wanted else ():
            if _overlaps(chunk, window) and self._holds_any(file, chunk, wanted):
                yield chunk

    def _holds_any(self, file: OpenFile, chunk: Chunk, wanted: Collection[int]) -> bool:
        """Whether a chunk holds messages of one of the channels; not by its chunk index alone.

        Raises:
            _ContradictedError: that names other channels than the message indexes do.
        """
        if chunk.index_places is not None and not chunk.channels.issuperset(wanted):
            key = file.key, chunk.offset, -1
            if self._found.get(key) is None:
                try:
                    require_channels(file, chunk)
                except (UnreadableError, struct.error) as error:
                    raise _ContradictedError(reason_of(error)) from error
                self._found.put(key, NO_MESSAGES, NO_MESSAGES.bytes_held)
        return not chunk.channels.isdisjoint(wanted)

    def _chunk_columns(
        self, file: OpenFile, chunk: Chunk, wanted: Collection[int], data: bytes | None
    ) -> list[Column]:
        """The messages of the wanted channels in a chunk, held against its records.

        Without `data`, the records, what the message indexes say is given as it stands.

        Raises:
            _ContradictedError: the message indexes do not agree with the records.
        """
        columns: list[Column] = []
        missing: list[int] = []
        for channel in chunk.channels.intersection(wanted):
            column = self._found.get((file.key, chunk.offset, channel))
            if isinstance(column, Column):
                columns.append(column)
            else:
                missing.append(channel)
        if not missing:
            return columns
        if chunk.index_places is None:
            read = walk_chunk(self._chunk_data(file, chunk) if data is None else data).columns
        elif data is None:
            return [*columns, *chunk_columns(file, chunk, missing).values()]
        else:
            try:
                read = proven_columns(file, chunk, missing, data)
            except (UnreadableError, ValueError, struct.error) as error:
                raise _ContradictedError(reason_of(error), chunk) from error
        for channel, found in read.items():
            self._found.put((file.key, chunk.offset, channel), found, found.bytes_held)
        return [*columns, *(read[channel] for channel in missing)]

    def _data_if_whole(self, file: OpenFile, chunk: Chunk) -> bytes | None:
        """The records of a chunk; None where they cannot be read."""
        try:
            with as_unreadable():
                return self._chunk_data(file, chunk)
        except UnreadableError:
            return None

    def _proven(self, file: OpenFile, index: McapIndex) -> McapIndex:
        """The index, its first and last times held against the messages.

        A bag is chosen for a question by these times, and is not looked into where they are wrong.
        """
        ends = sorted({end for each in index.totals.values() for end in (each.first, each.last)})
        left = _PROVEN_BYTES
        for chunk in index.chunks:
            try:
                self._holds_any(file, chunk, index.channels)
            except _ContradictedError as error:
                return self._distrust(file, index, error)
            nth = bisect_left(ends, chunk.start)
            if chunk.index_places is None or nth == len(ends) or ends[nth] > chunk.end:
                continue
            left -= chunk.length
            if left < 0:
                break
            data = self._data_if_whole(file, chunk)
            if data is None:
                continue
            try:
                columns = self._chunk_columns(file, chunk, chunk.channels, data)
                _require_declared(index, data, columns)
            except _ContradictedError as error:
                return self._distrust(file, index, error)
        return index

    def _distrust(self, file: OpenFile, index: McapIndex, error: _ContradictedError) -> McapIndex:
        """The index of the messages themselves, in place of one that was found to be wrong."""
        error.believed = {chunk.offset: chunk for chunk in index.chunks}
        reason = f"{error}; {READ_WITHOUT_INDEXES}"
        # Kept apart from the index: not every read that takes this anew would find it out again.
        self._contradicted.put(file.key, reason, len(reason) + len(file.key.path) + 200)
        return self._keep(file, self._without_indexes(file, reason))

    def _without_indexes(self, file: OpenFile, reason: str) -> McapIndex:
        found = index_by_scan(file, self._max_chunk_bytes, reason)
        return found._replace(contradiction=reason)

    def _chunk_data(self, file: OpenFile, chunk: Chunk) -> bytes:
        key = (file.key, chunk.offset)
        data = self._data.get(key)
        if data is None:
            data = chunk_data(file, chunk, self._max_chunk_bytes)
            self._data.put(key, data, len(data))
        return data


def _index_of(file: OpenFile, max_chunk_bytes: int) -> McapIndex:
    if not is_finished(file):
        return index_by_scan(file, max_chunk_bytes)
    try:
        return index_from_summary(file)
    except DoubtError as doubt:
        return index_by_scan(file, max_chunk_bytes, str(doubt))


def _require_declared(index: McapIndex, data: bytes, columns: Sequence[Column]) -> None:
    """Holds what the index takes a chunk's messages for against what the chunk says.

    Raises:
        _ContradictedError: they differ.
    """
    if index.declared is None:
        return
    try:
        with as_unreadable():
            require_declared(index.declared, data, columns)
    except UnreadableError as error:
        raise _ContradictedError(reason_of(error)) from error


def _wanted(index: McapIndex, topics: Collection[str]) -> dict[int, Channel]:
    """The channels of the topics that hold messages."""
    return {
        number: channel
        for number, channel in index.channels.items()
        if channel.topic in topics and number in index.totals
    }


def _overlaps(chunk: Chunk, window: TimeWindow) -> bool:
    return chunk.start < window.stop and chunk.end >= window.start


def _parted(
    window: TimeWindow, chunk: Chunk | None, *, newest_first: bool
) -> tuple[TimeWindow, TimeWindow]:
    """The window from a chunk on, in the order of reading, and the part of it before that."""
    if chunk is None:
        return window, TimeWindow(window.start, window.start)
    at = chunk.end + 1 if newest_first else chunk.start
    at = min(max(at, window.start), window.stop)
    before, behind = TimeWindow(window.start, at), TimeWindow(at, window.stop)
    return (before, behind) if newest_first else (behind, before)


def _hidden(
    index: McapIndex, error: _ContradictedError, wanted: Collection[int], passed: TimeWindow
) -> LostError | None:
    """What lies in a part of a window that was read by indexes which did not know of it."""
    hidden = [
        chunk
        for chunk in index.chunks
        if _overlaps(chunk, passed) and not chunk.channels.isdisjoint(wanted)
        if not _knew(error.believed.get(chunk.offset), chunk)
    ]
    if not hidden:
        return None
    first = max(min(chunk.start for chunk in hidden), passed.start)
    last = min(max(chunk.end for chunk in hidden), passed.stop - 1)
    return LostError(str(error), first, last)


def _knew(believed: Chunk | None, chunk: Chunk) -> bool:
    """Whether an index was right on which times and channels a chunk holds."""
    if believed is None:
        return False
    within = believed.start <= chunk.start and chunk.end <= believed.end
    return within and chunk.channels <= believed.channels


def _lost(lost: LostError, *, newest_first: bool) -> Rows[Record | LostError]:
    return Rows([lost.last if newest_first else lost.first], [0], lambda _place, _time: lost)


def _rows(
    column: Column, fetch: Callable[[int, Ns], Record | LostError], *, newest_first: bool
) -> Rows[Record | LostError]:
    times, places = column
    if newest_first:
        times, places = times[::-1], places[::-1]
    return Rows(times.tolist(), places.tolist(), fetch)


def _from_bytes(
    data: bytes, channels: dict[int, Channel], max_bytes: int
) -> Callable[[int, Ns], Record]:
    """Fetches messages from a decompressed chunk."""
    unpack = MESSAGE.unpack_from
    last = len(data) - MESSAGE.size

    def fetch(place: int, time: Ns) -> Record:
        if not 0 <= place <= last:
            raise UnreadableError(NOT_THERE)
        opcode, length, number, _, log_time, publish_time = unpack(data, place)
        end = place + RECORD.size + length
        if opcode != Opcode.MESSAGE or log_time != time or end > len(data):
            raise UnreadableError(NOT_THERE)
        payload = data[place + MESSAGE.size : end]
        return _record(channels, number, log_time, publish_time, payload, max_bytes=max_bytes)

    return fetch


def _from_file(
    file: OpenFile, channels: dict[int, Channel], max_bytes: int
) -> Callable[[int, Ns], Record]:
    """Fetches messages that stand outside chunks."""

    def fetch(place: int, time: Ns) -> Record:
        head = MESSAGE.unpack(file.read(place, MESSAGE.size))
        payload = file.read(place + MESSAGE.size, head[1] + RECORD.size - MESSAGE.size)
        return _record(channels, head[2], time, head[5], payload, max_bytes=max_bytes)

    return fetch


def _record(
    channels: dict[int, Channel],
    number: int,
    log_time: Ns,
    publish_time: Ns,
    payload: bytes,
    *,
    max_bytes: int,
) -> Record:
    channel = channels.get(number)
    if channel is None:
        raise UnreadableError("damaged: a message is not of the channel that its index says")
    if channel.encoding == "cdr":
        payload = plain_payload(payload, max_bytes)
    return Record(channel, log_time, publish_time if publish_time < MAX_NS else log_time, payload)
