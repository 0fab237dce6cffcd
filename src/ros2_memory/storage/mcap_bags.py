"""The MCAP room: summaries, messages and log times of `.mcap` files.

Fast because it decompresses a chunk only for a message that is wanted, and takes log times and
places from the message indexes; whole because it falls back to the messages themselves wherever a
file's own indexes are missing or wrong (see `mcap_index`).
"""

from __future__ import annotations

from operator import attrgetter
from typing import TYPE_CHECKING, Final

import numpy as np
from mcap.opcode import Opcode

from ros2_memory.storage.base import Channel, Closing, Record
from ros2_memory.storage.faults import LostError, UnreachableError, UnreadableError, damage
from ros2_memory.storage.limits import MAX_CHUNK_MB
from ros2_memory.storage.lru import ByteLru, Shared
from ros2_memory.storage.mcap_chunk import Column, joined, walk
from ros2_memory.storage.mcap_file import closing_of, is_finished, profile_of
from ros2_memory.storage.mcap_index import (
    McapIndex,
    chunk_columns,
    chunk_data,
    index_from_summary,
)
from ros2_memory.storage.mcap_records import MESSAGE, RECORD
from ros2_memory.storage.mcap_scan import index_by_scan
from ros2_memory.storage.mcap_summary import Chunk, DoubtError
from ros2_memory.storage.merge import Rows, Run, merged
from ros2_memory.storage.open_file import OpenFile
from ros2_memory.storage.summary import Held, bag_summary
from ros2_memory.storage.zstd import plain_payload
from ros2_memory.timebase import MAX_NS

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.model import BagSummary, TimeWindow
    from ros2_memory.storage.open_file import FileKey
    from ros2_memory.timebase import Ns


_LARGE_BYTES: Final = 8 << 20


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
        self._shared: Shared[Channel] = Shared(attrgetter("bytes_held"))
        self._finished: FileKey | None = None
        self._last_shared: tuple[Mapping[int, Channel], Mapping[int, Channel]] = {}, {}

    def closing(self, path: Path) -> Closing:
        """Whether the writer has finished the file."""
        with OpenFile(path) as file:
            if is_finished(file):
                # A bag is mostly asked for its summary next.
                self._finished = file.key
                return Closing.CLOSED
            return closing_of(file)

    def summarize(self, path: Path) -> BagSummary:
        """Topics with exact counts and first and last log times."""
        with OpenFile(path) as file:
            index = self._index(file)
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
            runs = self._runs(file, topics, window, newest_first=newest_first)
            yield from merged(runs, newest_first=newest_first)

    def newest(self, path: Path, topic: str, window: TimeWindow) -> Record | None:
        """The latest message of the topic inside the window: what `records` begins with.

        Most questions about a moment ask for it, so it does without the merging of many.
        """
        if window.empty:
            return None
        with OpenFile(path) as file:
            index = self._index(file)
            wanted = _wanted(index, {topic})
            if index.loose:
                runs = self._runs(file, {topic}, window, newest_first=True)
                first = next(merged(runs, newest_first=True), None)
                if isinstance(first, LostError):
                    raise first
                return first
            overlapping = list(_overlapping(index, wanted, window))
            overlapping.sort(key=attrgetter("end"), reverse=True)
            best: tuple[Ns, int, int, bytes] | None = None
            for chunk in overlapping:
                if best is not None and chunk.end < best[0]:
                    break
                for column in self._chunk_columns(file, chunk, wanted):
                    times, places = column.between(window.start, window.stop)
                    if times.size:
                        data = self._chunk_data(file, chunk)
                        found = int(times[-1]), chunk.offset, int(places[-1]), data
                        best = found if best is None else max(best, found)
            if best is None:
                return None
            time, _, place, data = best
            return _from_bytes(data, wanted, self._max_chunk_bytes)(place, time)

    def log_times(self, path: Path, topic: str, window: TimeWindow) -> list[Ns]:
        """The log times of a topic's messages inside the window, ascending."""
        with OpenFile(path) as file:
            index = self._index(file)
            wanted = _wanted(index, {topic})
            columns = [index.loose[channel] for channel in wanted if channel in index.loose]
            for chunk in _overlapping(index, wanted, window):
                columns += self._chunk_columns(file, chunk, wanted)
        parts = [column.between(window.start, window.stop).times for column in columns]
        if window.empty or not parts:
            return []
        times = np.sort(np.concatenate(parts))
        return [int(time) for time in times.tolist()]

    def _runs(
        self, file: OpenFile, topics: Collection[str], window: TimeWindow, *, newest_first: bool
    ) -> Iterator[Run[Record | LostError]]:
        index = self._index(file)
        wanted = _wanted(index, topics)

        large: dict[int, bytes] = {}

        def chunk_run(chunk: Chunk) -> Run[Record | LostError]:
            def rows() -> Rows[Record | LostError]:
                # Of a chunk whose index cannot be read it is not known what of it was wanted.
                first, last = max(chunk.start, window.start), min(chunk.end, window.stop - 1)
                try:
                    with damage():
                        columns = self._chunk_columns(file, chunk, wanted)
                        column = joined([p.between(window.start, window.stop) for p in columns])
                        if not column.times.size:
                            return Rows([], [], _nothing)
                        first, last = int(column.times[0]), int(column.times[-1])
                        data = self._chunk_data(file, chunk)
                except UnreachableError:
                    raise
                except UnreadableError as error:
                    return _lost(LostError(str(error), first, last), newest_first=newest_first)
                fetch = self._fetching(file, chunk, data, wanted, large)
                return _rows(column, fetch, newest_first=newest_first)

            return Run(chunk.start, chunk.end, chunk.offset, rows)

        for chunk in _overlapping(index, wanted, window):
            yield chunk_run(chunk)
        loose = [column for channel, column in index.loose.items() if channel in wanted]
        column = joined([part.between(window.start, window.stop) for part in loose])
        if column.times.size:
            fetch = _from_file(file, wanted, self._max_chunk_bytes)
            rows = _rows(column, fetch, newest_first=newest_first)
            yield Run(int(column.times[0]), int(column.times[-1]), 0, lambda: rows)

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
            finished = file.key == self._finished or is_finished(file)
            index = _index_of(file, self._max_chunk_bytes, finished=finished)
            index = index._replace(channels=self._shared_of(index.channels))
            self._found.put(file.key, index, index.bytes_held)
        return index

    def _shared_of(self, channels: Mapping[int, Channel]) -> Mapping[int, Channel]:
        """The channels, one object for all equal ones; the next bag mostly has these very ones."""
        given, shared = self._last_shared
        if channels is not given:
            shared = {number: self._shared.of(each) for number, each in channels.items()}
            self._last_shared = channels, shared
        return shared

    def _chunk_columns(self, file: OpenFile, chunk: Chunk, wanted: Collection[int]) -> list[Column]:
        columns: list[Column] = []
        missing: list[int] = []
        for channel in chunk.channels.intersection(wanted):
            column = self._found.get((file.key, chunk.offset, channel))
            if isinstance(column, Column):
                columns.append(column)
            else:
                missing.append(channel)
        if missing:
            if chunk.index_places is not None:
                read = chunk_columns(file, chunk, missing)
            else:
                read = walk(self._chunk_data(file, chunk)).columns
            for channel, found in read.items():
                self._found.put((file.key, chunk.offset, channel), found, found.bytes_held)
            columns += [read[channel] for channel in missing]
        return columns

    def _chunk_data(self, file: OpenFile, chunk: Chunk) -> bytes:
        key = (file.key, chunk.offset)
        data = self._data.get(key)
        if data is None:
            data = chunk_data(file, chunk, self._max_chunk_bytes)
            self._data.put(key, data, len(data))
        return data


def _index_of(file: OpenFile, max_chunk_bytes: int, *, finished: bool) -> McapIndex:
    if not finished:
        return index_by_scan(file, max_chunk_bytes)
    try:
        return index_from_summary(file)
    except DoubtError as doubt:
        return index_by_scan(file, max_chunk_bytes, str(doubt))


def _wanted(index: McapIndex, topics: Collection[str]) -> dict[int, Channel]:
    """The channels of the topics that hold messages."""
    return {
        number: channel
        for number, channel in index.channels.items()
        if channel.topic in topics and number in index.totals
    }


def _overlapping(index: McapIndex, wanted: Collection[int], window: TimeWindow) -> Iterator[Chunk]:
    start, stop = window.start, window.stop
    for chunk in index.chunks:
        if chunk.start < stop and chunk.end >= start and not chunk.channels.isdisjoint(wanted):
            yield chunk


def _lost(lost: LostError, *, newest_first: bool) -> Rows[Record | LostError]:
    return Rows([lost.last if newest_first else lost.first], [0], lambda _place, _time: lost)


def _rows(
    column: Column, fetch: Callable[[int, Ns], Record | LostError], *, newest_first: bool
) -> Rows[Record | LostError]:
    times, places = column
    if newest_first:
        times, places = times[::-1], places[::-1]
    return Rows(times.tolist(), places.tolist(), fetch)


def _nothing(_place: int, _time: Ns) -> Record:
    raise UnreadableError("damaged: a message is not where its index says")


def _from_bytes(
    data: bytes, channels: dict[int, Channel], max_bytes: int
) -> Callable[[int, Ns], Record]:
    """Fetches messages from a decompressed chunk."""
    unpack = MESSAGE.unpack_from
    last = len(data) - MESSAGE.size

    def fetch(place: int, time: Ns) -> Record:
        if not 0 <= place <= last:
            raise UnreadableError("damaged: a message is not where its index says")
        opcode, length, number, _, log_time, publish_time = unpack(data, place)
        end = place + RECORD.size + length
        if opcode != Opcode.MESSAGE or log_time != time or end > len(data):
            raise UnreadableError("damaged: a message is not where its index says")
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
