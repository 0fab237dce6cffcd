"""The index of an MCAP file by reading it once from front to back.

For files without a summary to rely on, and for files that end early: every whole record counts,
and the messages of a last, partial chunk as far as they reach.
"""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np
from mcap.opcode import Opcode

from ros2_memory.core.timebase import MAX_NS
from ros2_memory.storage.base import Closing
from ros2_memory.storage.errors import (
    MAX_CHUNKS,
    MAX_SECTION_BYTES,
    MAX_TIMES_PACKED,
    MESSAGE_BYTES,
    UnreadableError,
    as_unreadable,
    most_unpacked,
    too_large,
)
from ros2_memory.storage.mcap.chunk import (
    Walked,
    column_of,
    packed_chunk,
    unpacked,
    unpacked_in_part,
    walk,
)
from ros2_memory.storage.mcap.index import (
    OTHER_DECLARED,
    McapIndex,
    Total,
    add_column,
    beyond_disorder,
    disagreements,
)
from ros2_memory.storage.mcap.records import (
    MAGIC_SIZE,
    MESSAGE,
    MESSAGE_FIELDS,
    RECORD,
    Declarations,
    Statistics,
    closing_of,
    require_mcap,
    statistics,
)
from ros2_memory.storage.mcap.summary import Chunk

if TYPE_CHECKING:
    from ros2_memory.core.timebase import Ns
    from ros2_memory.storage.file_io import OpenFile
    from ros2_memory.storage.mcap.chunk import ChunkHead, Column

_BLOCK: Final = 256 * 1024


def index_by_scan(file: OpenFile, max_chunk_bytes: int, note: str = "") -> McapIndex:
    """The index of the messages that can be read.

    Args:
        file: the open file.
        max_chunk_bytes: what a chunk may hold, decompressed; larger ones are left out and noted.
        note: why the summary section was not used, where that is worth telling.

    Raises:
        UnreadableError: it is no MCAP file, or is empty.
    """
    require_mcap(file)
    scan = _Scan(file, max_chunk_bytes, closed=closing_of(file) is Closing.CLOSED)
    scan.run()
    return scan.index(note)


@dataclass(slots=True)
class _Scan:
    file: OpenFile
    max_chunk_bytes: int
    position: int = MAGIC_SIZE
    closed: bool = False
    data_ended: bool = False
    # By the summary section, by the records before it, and by chunks, which a checksum protects.
    repeated: Declarations = field(default_factory=Declarations)
    declared: Declarations = field(default_factory=Declarations)
    in_chunks: Declarations = field(default_factory=Declarations)
    redeclared: bool = False
    chunks: list[Chunk] = field(default_factory=list)
    totals: dict[int, Total] = field(default_factory=dict)
    loose: dict[int, tuple[array[int], array[int]]] = field(default_factory=dict)
    stated: Statistics | None = None
    messages: int = 0
    damaged: list[str] = field(default_factory=list)
    partial: int = 0  # bytes of a last, compressed chunk that was read in part
    back: Ns = 0  # as `set_back` of `McapIndex`, however little
    unpacked: int = 0  # bytes that the chunks so far have come to
    _block: bytes = b""
    _block_at: int = 0

    def run(self) -> None:
        """Reads on until the footer, or until what follows is no whole record."""
        size = self.file.size
        while self.position + RECORD.size <= size:
            opcode, length = RECORD.unpack(self._peek(self.position, RECORD.size))
            end = self.position + RECORD.size + length
            if opcode in {0, Opcode.FOOTER}:
                return
            if end > size:
                if opcode == Opcode.CHUNK:
                    self._cut_chunk(size)
                return
            if opcode == Opcode.MESSAGE and length < MESSAGE_FIELDS:
                return
            self._record(opcode, end)
            self.position = end

    def _record(self, opcode: int, end: int) -> None:
        if opcode == Opcode.MESSAGE:
            if end - self.position > self.max_chunk_bytes:
                self.damaged.append(too_large("a message", self.max_chunk_bytes))
                return
            head = MESSAGE.unpack(self._peek(self.position, MESSAGE.size))
            times, places = self.loose.setdefault(head[2], (array("Q"), array("q")))
            times.append(head[4])
            places.append(self.position)
            self.messages += 1
            return
        self.data_ended = self.data_ended or opcode == Opcode.DATA_END
        try:
            if opcode == Opcode.CHUNK:
                self._whole_chunk(end)
            elif opcode in {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS}:
                self._declare(
                    opcode, self._body(end), self.repeated if self.data_ended else self.declared
                )
        except UnreadableError as error:
            # Those behind it may be whole.
            self.damaged.append(str(error))

    def _declare(self, opcode: int, body: bytes, among: Declarations) -> None:
        with as_unreadable():
            if opcode == Opcode.STATISTICS:
                self.stated = statistics(body)
                return
            self.redeclared = self.redeclared or not among.agrees(opcode, body)
            among.add(opcode, body)

    def _body(self, end: int) -> bytes:
        start = self.position + RECORD.size
        if end - start > MAX_SECTION_BYTES:
            raise UnreadableError("damaged: a record is larger than any can be")
        return self.file.read(start, end - start)

    def _whole_chunk(self, end: int) -> None:
        self._require_harmless()
        with as_unreadable():
            data = unpacked(*self._packed(end), self.max_chunk_bytes)
        self.unpacked += len(data)
        walked = walk(data)
        self.unpacked += MESSAGE_BYTES * walked.messages
        if walked.usable < len(data):
            self.damaged.append("damaged: a chunk holds something that is no record")
        self._take(walked, end, None)

    def _cut_chunk(self, size: int) -> None:
        """The chunk inside which the file ends."""
        try:
            self._require_harmless()
            head, packed = self._packed(size)
            with as_unreadable():
                walked = walk(unpacked_in_part(head, packed, self.max_chunk_bytes))
        except UnreadableError:
            return
        if not walked.usable:
            return
        self._take(walked, size, walked.usable)
        if head.compression:
            self.partial = size - self.position
            self.position = size
        else:
            self.position += RECORD.size + head.data_at + walked.usable

    def _require_harmless(self) -> None:
        """Looks into no more chunks where those so far came to more than a robot's ever do."""
        if len(self.chunks) >= MAX_CHUNKS:
            raise UnreadableError(f"it has more than {MAX_CHUNKS} chunks")
        if self.unpacked > most_unpacked(self.file.size):
            raise UnreadableError(
                f"its chunks hold more than {MAX_TIMES_PACKED} times what the file does"
            )

    def _packed(self, end: int) -> tuple[ChunkHead, bytes]:
        body_at = self.position + RECORD.size
        return packed_chunk(self.file, body_at, end - body_at, self.max_chunk_bytes)

    def _take(self, walked: Walked, end: int, usable: int | None) -> None:
        for opcode, body in walked.declarations:
            try:
                self._declare(opcode, body, self.in_chunks)
            except UnreadableError as error:
                self.damaged.append(str(error))
        self.messages += walked.messages
        held = {channel: column for channel, column in walked.columns.items() if column.times.size}
        for channel, column in held.items():
            known = self.totals.get(channel)
            if known is not None:
                self.back = max(self.back, known.last - int(column.times[0]))
            add_column(self.totals, channel, column)
        if held:
            self.chunks.append(
                Chunk(
                    self.position,
                    end - self.position,
                    min(int(column.times[0]) for column in held.values()),
                    max(int(column.times[-1]) for column in held.values()),
                    frozenset(held),
                    usable=usable,
                )
            )

    def _peek(self, offset: int, length: int) -> bytes:
        """A few bytes, by way of a block: small records lie close together."""
        at = offset - self._block_at
        if at < 0 or at + length > len(self._block):
            self._block = self.file.read(offset, min(_BLOCK, self.file.size - offset))
            self._block_at, at = offset, 0
        return self._block[at : at + length]

    def index(self, note: str) -> McapIndex:
        """What was found."""
        columns = {channel: column_of(*lists) for channel, lists in self.loose.items()}
        back = max([self.back, *(_back_in(times) for times, _ in self.loose.values())])
        for channel, column in columns.items():
            add_column(self.totals, channel, column)
        declarations = self.repeated
        differing = declarations.update(self.declared)
        differing = declarations.update(self.in_chunks) or differing
        channels = declarations.channels()
        known = {channel: total for channel, total in self.totals.items() if channel in channels}
        notes = [note, *self._notes(known)] if note else self._notes(known)
        if differing and not note.startswith(OTHER_DECLARED):
            notes.append(OTHER_DECLARED)
        if self.redeclared:
            notes.append("it declares a channel or a type in more than one way: the last counts")
        return McapIndex(
            channels,
            tuple(self.chunks),
            known,
            _held(columns),
            complete=self.data_ended and self.closed,
            notes=tuple(notes),
            set_back=beyond_disorder(back),
        )

    def _notes(self, known: dict[int, Total]) -> list[str]:
        notes = []
        if not (self.data_ended and self.closed):
            notes.append(self._end_note())
        if self.damaged:
            notes.append(f"{len(self.damaged)} damaged records were left out ({self.damaged[0]})")
        counted = sum(total.count for total in self.totals.values())
        orphans = counted - sum(total.count for total in known.values())
        if orphans:
            notes.append(f"{orphans} messages belong to no declared channel and were left out")
        if self.messages > counted:
            notes.append(f"{self.messages - counted} messages bear no possible log time")
        # Where something was left out, the statistics count it rightly.
        if self.stated is not None and not notes:
            notes.extend(disagreements(self.stated, known))
        return notes

    def _end_note(self) -> str:
        if self.partial:
            return (
                f"the file ends early: of its last chunk, {self.partial} compressed bytes, only a"
                " part could be read"
            )
        if self.data_ended:
            return "the file ends early, behind its messages: none is lost"
        unread = self.file.size - self.position
        if unread:
            return f"the file ends early: the last {unread} bytes could not be read"
        return "the file ends early: its writer did not finish it"


def _held(columns: dict[int, Column]) -> dict[int, Column]:
    return {channel: column for channel, column in columns.items() if column.times.size}


def _back_in(times: array[int]) -> Ns:
    """By how much possible log times go back in this order, at most."""
    written = np.array([time for time in times if time <= MAX_NS], np.int64)
    if not written.size:
        return 0
    return int((np.maximum.accumulate(written) - written).max())
