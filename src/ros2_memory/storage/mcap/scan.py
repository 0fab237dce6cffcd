"""Indexes an MCAP file by reading it once from front to back.

For files without a summary section to rely on, and for files that end early: every whole record
counts, and so do the messages of a last, partial chunk as far as the file reaches.
"""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from mcap.opcode import Opcode

from ros2_memory.core.bag_summary import ENDS_EARLY, NONE_LOST
from ros2_memory.core.text import counted
from ros2_memory.storage.contents import Tally
from ros2_memory.storage.errors import SizeLimit, UnreadableError, as_unreadable
from ros2_memory.storage.mcap.chunk import Chunk, ChunkContent, ChunkOpener, MessageTable
from ros2_memory.storage.mcap.index import OTHER_DECLARED, McapIndex, disagreements
from ros2_memory.storage.mcap.records import (
    MAGIC_SIZE,
    MESSAGE,
    Declarations,
    FileRecord,
    file_records,
    is_finished,
    statistics,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mcap.records import Statistics

    from ros2_memory.core.timebase import Ns
    from ros2_memory.storage.contents import Extent
    from ros2_memory.storage.file_io import OpenFile

_UNCHUNKED_BYTES: Final = 64 << 10
"""The most bytes of a part of messages outside chunks: for one message all of it is read."""
_DECLARED: Final = frozenset((Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS))


def index_by_scan(file: OpenFile, limit: SizeLimit, note: str = "") -> McapIndex:
    """Returns the index of the messages that can be read.

    Args:
        file: the open file.
        limit: up to which chunks and messages are read; larger ones are noted.
        note: why the summary section was not used; empty where no user needs to know.

    Raises:
        UnreadableError: the file is not MCAP, or is empty.
    """
    scan = _Scan(file, limit, ChunkOpener(file, limit))
    for record in file_records(file):
        scan.add(record)
    return scan.index(note)


@dataclass(slots=True)
class _Unchunked:
    """A part of the file with messages outside chunks, which is indexed like a chunk."""

    begin: int
    end: int = 0
    channels: array[int] = field(default_factory=lambda: array("H"))
    times: array[int] = field(default_factory=lambda: array("Q"))
    offsets: array[int] = field(default_factory=lambda: array("q"))


@dataclass(slots=True)
class _Scan:
    """One scan of a file.

    Attributes:
        file: the open file.
        limit: up to which a message outside chunks is read.
        opener: decompresses the chunks.
        read_to: where the last readable record ends.
        data_ended: whether the data section is over, so that the summary section follows.
        repeated: schemas and channels of the summary section.
        declared: those of the data section, outside chunks.
        in_chunks: those in chunks. They win over the others: a checksum protects them.
        redeclared: whether a schema or channel was declared twice, differently.
        chunks: the chunks with messages, and the parts of messages outside chunks.
        tally: counts the messages.
        unchunked: the part of messages outside chunks that is still growing.
        stated: the statistics, if the file has them.
        message_count: how many messages were met, also with impossible log times.
        damaged: why each damaged record cannot be read.
        partial_bytes: of a last, compressed chunk that was read in part.
    """

    file: OpenFile
    limit: SizeLimit
    opener: ChunkOpener
    read_to: int = MAGIC_SIZE
    data_ended: bool = False
    repeated: Declarations = field(default_factory=Declarations)
    declared: Declarations = field(default_factory=Declarations)
    in_chunks: Declarations = field(default_factory=Declarations)
    redeclared: bool = False
    chunks: list[Chunk] = field(default_factory=list)
    tally: Tally = field(default_factory=Tally)
    unchunked: _Unchunked = field(default_factory=lambda: _Unchunked(0))
    stated: Statistics | None = None
    message_count: int = 0
    damaged: list[str] = field(default_factory=list)
    partial_bytes: int = 0

    def add(self, record: FileRecord) -> None:
        """Adds a record; a damaged one is noted, since the records behind it may be whole."""
        if record.end > self.file.size:
            self._close_unchunked()
            self._add_cut_chunk(record)
            return
        self.data_ended = self.data_ended or record.opcode == Opcode.DATA_END
        try:
            if record.opcode == Opcode.MESSAGE:
                self._add_message(record)
            elif record.opcode == Opcode.CHUNK:
                self._close_unchunked()
                self._add_chunk(record)
            elif record.opcode in _DECLARED:
                declarations = self.repeated if self.data_ended else self.declared
                self._declare(record.opcode, record.body(self.file), declarations)
        except UnreadableError as error:
            self.damaged.append(str(error))
        self.read_to = record.end

    def _add_message(self, record: FileRecord) -> None:
        self.limit.require("a message", record.end - record.offset)
        if not self.unchunked.times or record.end > self.unchunked.begin + _UNCHUNKED_BYTES:
            self._close_unchunked()
            self.unchunked = _Unchunked(record.offset)
        _, _, channel, _, log_time, _ = MESSAGE.unpack(record.head)
        self.unchunked.channels.append(channel)
        self.unchunked.times.append(log_time)
        self.unchunked.offsets.append(record.offset - self.unchunked.begin)
        self.unchunked.end = record.end
        self.message_count += 1

    def _declare(self, opcode: int, body: bytes, declarations: Declarations) -> None:
        with as_unreadable():
            if opcode == Opcode.STATISTICS:
                self.stated = statistics(body)
                return
            self.redeclared = self.redeclared or not declarations.agrees(opcode, body)
            declarations.add(opcode, body)

    def _add_chunk(self, record: FileRecord) -> None:
        opened = self.opener.open(record)
        if opened.content.usable < len(opened.data):
            self.damaged.append("damaged: a chunk has bytes that are not a record")
        self._add_content(opened.content, record.offset, record.end)

    def _add_cut_chunk(self, record: FileRecord) -> None:
        """Adds the chunk that the file ends in."""
        try:
            opened = self.opener.open(record)
        except UnreadableError:
            return
        usable = opened.content.usable
        if not usable:
            return
        self._add_content(opened.content, record.offset, self.file.size, usable)
        if opened.is_compressed:
            self.partial_bytes = self.file.size - record.offset
            self.read_to = self.file.size
        else:
            self.read_to = self.file.size - len(opened.data) + usable

    def _add_content(
        self, content: ChunkContent, begin: int, end: int, usable: int | None = None
    ) -> None:
        """Adds the content of the chunk from `begin` to `end` in the file."""
        for opcode, body in content.declarations:
            try:
                self._declare(opcode, body, self.in_chunks)
            except UnreadableError as error:
                self.damaged.append(str(error))
        self.message_count += content.message_count
        if content.messages.times.size:
            first, last, channels = self._count(content.messages)
            chunk = Chunk(begin, end - begin, first, last, channels, usable=usable)
            self.chunks.append(chunk)

    def _close_unchunked(self) -> None:
        """Adds the part of messages outside chunks, if there is one, and begins a new one."""
        part, self.unchunked = self.unchunked, _Unchunked(0)
        messages = MessageTable.of_chunk(part.channels, part.times, part.offsets)
        if messages.times.size:
            first, last, channels = self._count(messages)
            length = part.end - part.begin
            chunk = Chunk(part.begin, length, first, last, channels, is_unchunked=True)
            self.chunks.append(chunk)

    def _count(self, messages: MessageTable) -> tuple[Ns, Ns, frozenset[int]]:
        """Counts messages; returns their first and last log time, and their channels."""
        self.tally.add(messages.channels, messages.times, messages.chunks)
        channels = frozenset(messages.channels.tolist())
        return int(messages.times.min()), int(messages.times.max()), channels

    def index(self, note: str) -> McapIndex:
        """Returns the index of the messages found; `note` comes before its other notes."""
        complete = self.data_ended and is_finished(self.file)
        self._close_unchunked()
        contents = self.tally.contents()
        # The summary section is overruled by the data section, and that by the chunks.
        declarations = self.repeated
        differs_in_data = declarations.update(self.declared)
        differs_in_chunks = declarations.update(self.in_chunks)
        channels = declarations.channels()
        totals = {number: total for number, total in contents.totals.items() if number in channels}
        notes = self._notes(contents.totals, totals, complete=complete)
        if note:
            notes.insert(0, note)
        if (differs_in_data or differs_in_chunks) and not note.startswith(OTHER_DECLARED):
            notes.append(OTHER_DECLARED)
        if self.redeclared:
            notes.append("it declares a channel or a type twice, differently: the last one is used")
        return McapIndex(
            channels,
            tuple(self.chunks),
            contents._replace(totals=totals),
            complete=complete,
            notes=tuple(notes),
        )

    def _notes(
        self, all_totals: Mapping[int, Extent], totals: Mapping[int, Extent], *, complete: bool
    ) -> list[str]:
        """Returns sentences on what is missing or wrong.

        Args:
            all_totals: the messages of each channel, also of channels that are not declared.
            totals: the messages of declared channels.
            complete: whether the writer finished the file.
        """
        notes = [] if complete else [self._end_note()]
        timed = sum(total.count for total in all_totals.values())
        orphans = timed - sum(total.count for total in totals.values())
        untimed = self.message_count - timed
        if orphans:
            notes.append(f"left out: {counted(orphans, 'message')} of no declared channel")
        if self.damaged:
            records = counted(len(self.damaged), "damaged record")
            notes.append(f"left out: {records} ({self.damaged[0]})")
        if untimed:
            notes.append(f"left out: {counted(untimed, 'message')} without a possible log time")
        # Statistics that count what was left out are right.
        if self.stated is not None and not notes:
            notes.extend(disagreements(self.stated, totals))
        return notes

    def _end_note(self) -> str:
        if self.partial_bytes:
            return (
                f"{ENDS_EARLY}: of its last chunk, {self.partial_bytes} compressed bytes,"
                " only a part could be read"
            )
        if self.data_ended:
            return f"{ENDS_EARLY}, behind its messages: {NONE_LOST}"
        unread = self.file.size - self.read_to
        if unread:
            return f"{ENDS_EARLY}: the last {unread} bytes could not be read"
        return f"{ENDS_EARLY}: its writer did not finish it"
