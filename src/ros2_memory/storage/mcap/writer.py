"""Writes MCAP files: closed, indexed, checked, synced. Also copies bags without some messages."""

from __future__ import annotations

import os
from collections import Counter
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cache
from itertools import chain
from typing import IO, TYPE_CHECKING, Final

from mcap import records as mcap_records
from mcap.writer import CompressionType, IndexType, Writer

from ros2_memory.core.errors import BagError, EpisodicError
from ros2_memory.core.model import SQLITE
from ros2_memory.storage.base import ROS2_PROFILE, BagWriter, Channel, Record, Rewritten, Schema
from ros2_memory.storage.errors import (
    MAX_CHUNK_MB,
    MAX_CHUNKS,
    SizeLimit,
    UnreadableError,
    max_decompressed_bytes,
    reading,
    reason_of,
)
from ros2_memory.storage.file_io import OpenFile
from ros2_memory.storage.mcap.bag_file import McapBags
from ros2_memory.storage.mcap.records import is_finished
from ros2_memory.storage.mcap.salvage import ContentDigest, Salvage, is_rosbag2_metadata
from ros2_memory.storage.sqlite_bag import cut_sqlite
from ros2_memory.typestore import full_name

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path

    from ros2_memory.core.bag_summary import BagSummary
    from ros2_memory.core.timebase import Ns

_LARGEST_CHUNK_BYTES: Final = 512 << 10
"""Of dense files and of large sources, a few times what a reader decompresses at once."""
CHUNK_BYTES: Final = 64 << 10
"""Small, since a reader decompresses a whole chunk for one message."""
LIBRARY: Final = "ros2-memory"
_REWRITTEN: Final = f", rewritten by {LIBRARY}"
_ROS2_ENCODINGS: Final = frozenset(("ros2msg", "ros2idl", ""))
"""Empty if the recorder found no definition."""


class McapWriter(BagWriter):
    """Writes `.mcap` files, chunks compressed with zstd.

    Args:
        max_chunk_mb: decompressed size up to which a chunk of a source is read, in MiB.
    """

    def __init__(self, max_chunk_mb: int = MAX_CHUNK_MB) -> None:
        self._limit = SizeLimit(max_chunk_mb << 20)

    def write(
        self,
        path: Path,
        records: Iterable[Record],
        *,
        dense: bool = False,
    ) -> None:
        """Writes a bag of these messages; a `dense` one has no message indexes."""
        with _new_file(path) as stream:
            if dense:
                indexes = IndexType.ALL & ~IndexType.MESSAGE
                writer = Writer(stream, _LARGEST_CHUNK_BYTES, CompressionType.ZSTD, indexes)
            else:
                writer = Writer(stream, CHUNK_BYTES, CompressionType.ZSTD)

            @cache
            def schema_id(schema: Schema) -> int:
                number: int = writer.register_schema(schema.name, schema.encoding, schema.text)
                return number

            @cache
            def channel_id(channel: Channel) -> int:
                schema, metadata = schema_id(_rosbag2_schema(channel)), dict(channel.metadata)
                return writer.register_channel(channel.topic, channel.encoding, schema, metadata)

            received = iter(records)
            first = next(received, None)
            is_ros2 = first is None or first.channel.encoding == "cdr"
            writer.start(ROS2_PROFILE if is_ros2 else "", LIBRARY)
            for record in chain([] if first is None else [first], received):
                number = channel_id(record.channel)
                writer.add_message(number, record.log_time, record.payload, record.publish_time)
            writer.finish()

    def rewrite(self, source: Path, target: Path) -> Rewritten:
        """Writes all that can be read of a file that was cut short into a whole file."""
        with _new_file(target) as stream:
            with reading(source), OpenFile(source) as file:
                salvage = Salvage(file, self._limit)
                copy = _Copy(stream, file.size)
                for record in salvage.records():
                    copy.put(record)
            copy.finish()
            with reading(source):
                before = self._bags().summarize(source)
            if self._verify(target, copy.digest).topics != before.topics:
                raise UnreadableError("what was written is not what could be read")
        return Rewritten(copy.digest.messages, salvage.lost_bytes, before.notes, copy.digest.last)

    def cut(
        self,
        source: Path,
        target: Path,
        leaves_out: Callable[[str, Ns, Ns], bool],
    ) -> Counter[str]:
        """Copies a whole file without some messages."""
        with _new_file(target) as stream:
            if source.suffix.lower() == SQLITE:
                with reading(source):
                    return cut_sqlite(source, target, stream, leaves_out, self._limit.max_bytes)
            with reading(source), OpenFile(source) as file:
                if not is_finished(file):
                    raise UnreadableError("its writer did not finish it")
                copy = _Copy(stream, file.size)
                salvage = Salvage(file, self._limit)
                left_out = _copy_without(leaves_out, salvage, copy)
                count = sum(topic.count for topic in self._bags().summarize(source).topics)
                if salvage.lost_bytes or count != copy.digest.messages + left_out.total():
                    raise UnreadableError("damaged: not all of its messages can be read")
            copy.finish()
            self._verify(target, copy.digest)
        return left_out

    def _bags(self) -> McapBags:
        return McapBags(1, self._limit)

    def _verify(self, target: Path, digest: ContentDigest) -> BagSummary:
        """Reads a new file back, compares it with what was to be written, returns its summary."""
        after = self._bags().summarize(target)
        if not after.complete or after.notes:
            raise UnreadableError(f"what was written is not whole ({'; '.join(after.notes)})")
        written = ContentDigest()
        with OpenFile(target) as file:
            for record in Salvage(file, self._limit).records():
                written.add(record)
        if written.digests != digest.digests:
            raise UnreadableError("what was written is not what could be read")
        return after


def _copy_without(
    leaves_out: Callable[[str, Ns, Ns], bool], salvage: Salvage, copy: _Copy
) -> Counter[str]:
    """Copies records without some messages; returns how many of each topic were left out.

    Raises:
        UnreadableError: a message has no channel or no possible time.
    """
    topics: dict[int, str] = {}
    left_out = Counter[str]()
    for record in salvage.records():
        if isinstance(record, mcap_records.Message):
            topic = topics.get(record.channel_id)
            if topic is not None and leaves_out(topic, record.log_time, record.publish_time):
                left_out[topic] += 1
            elif not copy.put(record):
                raise UnreadableError("damaged: a message without a channel or a time")
        elif not is_rosbag2_metadata(record):
            if isinstance(record, mcap_records.Channel):
                topics.setdefault(record.id, record.topic)
            copy.put(record)
    return left_out


class _Copy:
    """Writes the records of another file; the writer gives schemas and channels new ids.

    Args:
        stream: the new file.
        source_bytes: the size of the other file.

    Attributes:
        digest: of the bytes that were written.
    """

    def __init__(self, stream: IO[bytes], source_bytes: int) -> None:
        # A large source makes larger chunks: a reader takes `MAX_CHUNKS` of a file at most.
        chunk_bytes = max(CHUNK_BYTES, max_decompressed_bytes(source_bytes) // MAX_CHUNKS)
        chunk_bytes = min(chunk_bytes, _LARGEST_CHUNK_BYTES)
        self.digest = ContentDigest()
        self._stream = stream
        self._writer = Writer(stream, chunk_bytes, CompressionType.ZSTD)
        self._started = False
        self._schemas: dict[int, int] = {0: 0}
        self._channels: dict[int, int] = {}

    def put(self, record: mcap_records.McapRecord) -> bool:
        """Writes a record; returns False for one that is left out, as `ContentDigest.add` does."""
        if not self.digest.add(record):
            return False
        if isinstance(record, mcap_records.Header):
            library = record.library.removesuffix(_REWRITTEN)
            self._start(record.profile, f"{library}{_REWRITTEN}")
            return True
        self._start(ROS2_PROFILE, LIBRARY)
        match record:
            case mcap_records.Message():
                self._writer.add_message(
                    self._channels[record.channel_id],
                    record.log_time,
                    record.data,
                    record.publish_time,
                    record.sequence,
                )
            case mcap_records.Schema():
                self._schemas[record.id] = self._writer.register_schema(
                    record.name, record.encoding, record.data
                )
            case mcap_records.Channel():
                self._channels[record.id] = self._writer.register_channel(
                    record.topic,
                    record.message_encoding,
                    self._schemas.get(record.schema_id, 0),
                    record.metadata,
                )
            case mcap_records.Metadata():
                self._writer.add_metadata(record.name, record.metadata)
            case mcap_records.Attachment():
                self._writer.add_attachment(
                    record.create_time, record.log_time, record.name, record.media_type, record.data
                )
        return True

    def finish(self) -> None:
        """Writes the summary section and the footer, so that the file can be read."""
        self._start(ROS2_PROFILE, LIBRARY)
        self._writer.finish()
        self._stream.flush()

    def _start(self, profile: str, library: str) -> None:
        if not self._started:
            self._started = True
            self._writer.start(profile, library)


def _rosbag2_schema(channel: Channel) -> Schema:
    """Returns the schema of a channel; a ROS 2 type gets the name that rosbag2 gives it."""
    schema = channel.schema
    if channel.encoding != "cdr" or schema.encoding not in _ROS2_ENCODINGS:
        return schema
    return replace(schema, name=full_name(schema.name))


@contextmanager
def _new_file(path: Path) -> Iterator[IO[bytes]]:
    """Yields a stream into a new file, which is synced at the end, and deleted after a failure.

    Raises:
        BagError: the block raised another exception than an `EpisodicError`.
    """
    try:
        stream = path.open("xb")
    except OSError as error:
        raise BagError(str(path), f"it cannot be made: {error.strerror or error}") from error
    try:
        with stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
    # The library lets every exception pass, such as struct.error for a negative time.
    except Exception as error:
        with suppress(OSError):
            path.unlink()
        if isinstance(error, EpisodicError):
            raise
        if isinstance(error, OSError):
            reason = f"it cannot be written: {error.strerror or error}"
            raise BagError(str(path), reason) from error
        raise BagError(str(path), reason_of(error)) from error
