"""Writes MCAP files: closed, indexed, checked, synced; also rewrites files without some."""

from __future__ import annotations

import os
from collections import Counter
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cache
from itertools import chain, islice
from typing import IO, TYPE_CHECKING, Final

from mcap import records as mcap_records
from mcap.writer import CompressionType, IndexType, Writer

from ros2_memory.core.errors import BagError, EpisodicError
from ros2_memory.storage.base import ROS2_PROFILE, BagWriter, Channel, Record, Rewritten, Schema
from ros2_memory.storage.errors import (
    MAX_CHUNK_MB,
    MAX_CHUNKS,
    UnreadableError,
    max_decompressed_bytes,
    reading,
    reason_of,
)
from ros2_memory.storage.file_io import OpenFile
from ros2_memory.storage.mcap.bag_file import McapBags
from ros2_memory.storage.mcap.records import is_finished
from ros2_memory.storage.mcap.salvage import ContentDigest, Salvage, is_of_rosbag2
from ros2_memory.storage.sqlite_bag import cut_sqlite
from ros2_memory.typestore import full_name

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path

    from ros2_memory.core.bag_summary import BagSummary
    from ros2_memory.core.timebase import Ns

_LARGEST_CHUNK_BYTES: Final = 512 << 10
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
        self._max_chunk_mb = max_chunk_mb

    def write(
        self,
        path: Path,
        records: Iterable[Record],
        *,
        dense: bool = False,
    ) -> None:
        """Writes a bag that holds these messages; a `dense` one has no message indexes."""
        with _written(path) as stream:
            writer = _writer(stream, dense=dense)
            received = iter(records)
            first = [*islice(received, 1)]
            is_ros2 = all(record.channel.encoding == "cdr" for record in first)
            writer.start(ROS2_PROFILE if is_ros2 else "", LIBRARY)

            @cache
            def schema_id(schema: Schema) -> int:
                number: int = writer.register_schema(schema.name, schema.encoding, schema.text)
                return number

            @cache
            def channel_id(channel: Channel) -> int:
                schema, metadata = schema_id(_exported(channel)), dict(channel.metadata)
                return writer.register_channel(channel.topic, channel.encoding, schema, metadata)

            for record in chain(first, received):
                number = channel_id(record.channel)
                writer.add_message(number, record.log_time, record.payload, record.publish_time)
            writer.finish()

    def rewrite(self, source: Path, target: Path) -> Rewritten:
        """Writes all that can be read of a file that was cut short into one that is whole."""
        with _written(target) as stream:
            with reading(source), OpenFile(source) as file:
                salvage = Salvage(file, self._max_chunk_mb << 20)
                copy = _Copy(_writer(stream, file.size))
                digest = ContentDigest()
                for record in salvage.records():
                    if digest.add(record):
                        copy.put(record)
            copy.finish()
            stream.flush()
            notes = self._compare(source, target, digest)
        return Rewritten(digest.messages, salvage.lost_bytes, notes, digest.last)

    def cut(
        self,
        source: Path,
        target: Path,
        takes: Callable[[str, Ns, Ns], bool],
    ) -> Counter[str]:
        """Writes a whole file again without some messages."""
        if source.suffix.lower() == ".db3":
            with _written(target) as stream, reading(source):
                return cut_sqlite(source, target, stream, takes)
        taken = Counter[str]()
        with _written(target) as stream:
            with reading(source), OpenFile(source) as file:
                if not is_finished(file):
                    raise UnreadableError("its writer did not finish it")
                salvage = Salvage(file, self._max_chunk_mb << 20)
                copy, digest = _Copy(_writer(stream, file.size)), ContentDigest()
                for record in _without(salvage, takes, taken):
                    if is_of_rosbag2(record):
                        continue
                    if digest.add(record):
                        copy.put(record)
                    elif isinstance(record, mcap_records.Message):
                        raise UnreadableError("damaged: a message without a channel or a time")
                was = sum(topic.count for topic in self._bags().summarize(source).topics)
                if salvage.lost_bytes or was != digest.messages + taken.total():
                    raise UnreadableError("damaged: not all of its messages can be read")
            copy.finish()
            stream.flush()
            self._require_content(target, digest)
        return taken

    def _bags(self) -> McapBags:
        return McapBags(cache_mb=1, max_chunk_mb=self._max_chunk_mb)

    def _require_content(self, target: Path, digest: ContentDigest) -> BagSummary:
        """Reads a target back, compares it with what was to be written, and returns its summary."""
        after = self._bags().summarize(target)
        if not after.complete or after.notes:
            raise UnreadableError(f"what was written is not whole ({'; '.join(after.notes)})")
        written = ContentDigest()
        with OpenFile(target) as file:
            for record in Salvage(file, self._max_chunk_mb << 20).records():
                written.add(record)
        if written.digests != digest.digests:
            raise UnreadableError("what was written is not what could be read")
        return after

    def _compare(self, source: Path, target: Path, digest: ContentDigest) -> tuple[str, ...]:
        """Compares the target, read back, with the source; returns the notes on the source."""
        with reading(source):
            before = self._bags().summarize(source)
        if self._require_content(target, digest).topics != before.topics:
            raise UnreadableError("what was written is not what could be read")
        return before.notes


def _without(
    salvage: Salvage, takes: Callable[[str, Ns, Ns], bool], taken: Counter[str]
) -> Iterator[mcap_records.McapRecord]:
    """Yields all records but the messages that are taken, which are counted by topic."""
    topics: dict[int, str] = {}
    for record in salvage.records():
        if isinstance(record, mcap_records.Channel):
            topics.setdefault(record.id, record.topic)
        elif isinstance(record, mcap_records.Message):
            topic = topics.get(record.channel_id)
            if topic is not None and takes(topic, record.log_time, record.publish_time):
                taken[topic] += 1
                continue
        yield record


class _Copy:
    """Writes the records of another file; the writer gives schemas and channels new ids."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._started = False
        self._schemas: dict[int, int] = {0: 0}
        self._channels: dict[int, int] = {}

    def put(self, record: mcap_records.McapRecord) -> None:
        """Writes one record, whose schema or channel must have come before."""
        if isinstance(record, mcap_records.Header):
            library = record.library.removesuffix(_REWRITTEN)
            self._start(record.profile, f"{library}{_REWRITTEN}")
            return
        self._start(ROS2_PROFILE, LIBRARY)
        if isinstance(record, mcap_records.Message):
            self._writer.add_message(
                self._channels[record.channel_id],
                record.log_time,
                record.data,
                record.publish_time,
                record.sequence,
            )
        elif isinstance(record, mcap_records.Schema):
            self._schemas[record.id] = self._writer.register_schema(
                record.name, record.encoding, record.data
            )
        elif isinstance(record, mcap_records.Channel):
            self._channels[record.id] = self._writer.register_channel(
                record.topic,
                record.message_encoding,
                self._schemas.get(record.schema_id, 0),
                record.metadata,
            )
        elif isinstance(record, mcap_records.Metadata):
            self._writer.add_metadata(record.name, record.metadata)
        elif isinstance(record, mcap_records.Attachment):
            self._writer.add_attachment(
                record.create_time, record.log_time, record.name, record.media_type, record.data
            )

    def finish(self) -> None:
        """Writes the summary section and the footer."""
        self._start(ROS2_PROFILE, LIBRARY)
        self._writer.finish()

    def _start(self, profile: str, library: str) -> None:
        if not self._started:
            self._started = True
            self._writer.start(profile, library)


def _exported(channel: Channel) -> Schema:
    """Returns the schema of a channel; a ROS 2 type gets the name that rosbag2 gives it."""
    schema = channel.schema
    if channel.encoding != "cdr" or schema.encoding not in _ROS2_ENCODINGS:
        return schema
    return replace(schema, name=full_name(schema.name))


def _writer(stream: IO[bytes], source_bytes: int = 0, *, dense: bool = False) -> Writer:
    if not dense:
        # Of a large source larger ones: of a file no more chunks than `MAX_CHUNKS` are read.
        chunk_bytes = max(CHUNK_BYTES, max_decompressed_bytes(source_bytes) // MAX_CHUNKS)
        return Writer(stream, min(chunk_bytes, _LARGEST_CHUNK_BYTES), CompressionType.ZSTD)
    indexes = IndexType.ALL & ~IndexType.MESSAGE
    return Writer(stream, _LARGEST_CHUNK_BYTES, CompressionType.ZSTD, indexes)


@contextmanager
def _written(path: Path) -> Iterator[IO[bytes]]:
    """Yields a stream into a new file, which is synced at the end, and deleted after a failure.

    Raises:
        BagError: any other exception of the block than an `EpisodicError`.
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
