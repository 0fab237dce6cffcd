"""What the adapters of `BagReader` for files share: all but which names they read."""

from __future__ import annotations

import json
import struct
from contextlib import contextmanager, suppress
from functools import partial
from typing import TYPE_CHECKING, Final

from rosbags.serde.utils import SIZEMAP

from ros2_memory.core.errors import UndecodableError
from ros2_memory.core.large_reads import LargeReads
from ros2_memory.core.model import BAG_KINDS, COMPRESSED, MCAP, SQLITE
from ros2_memory.storage.base import SEQUENCE, BagReader, Batch, Channel, Definition, Record
from ros2_memory.storage.errors import (
    MAX_CHUNK_MB,
    Lost,
    SizeLimit,
    UnreadableError,
    raise_if_lost,
    reading,
)
from ros2_memory.storage.file_io import OpenFile
from ros2_memory.storage.mcap.bag_file import McapBags
from ros2_memory.storage.scratch import Scratch
from ros2_memory.storage.sqlite_bag import SqliteBags, copy_with_journal, journals_beside
from ros2_memory.storage.zstd_bag import FRAME_MAGIC, is_finished_zstd, unpack
from ros2_memory.typestore import MessageType, Typestores

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.core.bag_summary import BagSummary
    from ros2_memory.core.model import TimeWindow

_HEADER_BYTES: Final = 4
"""The encapsulation header of CDR."""
_LENGTH_BYTES: Final = 4
"""The length of a string or a sequence, before its content."""
# A float128 is not aligned to its own size.
_SIZES: Final[Mapping[str, int]] = {
    str(name): size for name, size in SIZEMAP.items() if name != "float128"
}

MAX_OBJECTS: Final = 200_000
"""Texts and messages in one message; each is an object when it is decoded."""
_COUNTED_FROM_BYTES: Final = 256 << 10


class _StoppedError(Exception):
    """There are more objects than are counted, or the payload does not fit its definition."""


def has_too_many_objects(definition: Definition, payload: bytes) -> bool:
    """Returns whether decoding a payload would make more than `MAX_OBJECTS` objects.

    One byte of a payload can become an object of a hundred bytes. The length that a sequence states
    counts. Decoding finds out whether the payload fits its definition otherwise.
    """
    if len(payload) < _COUNTED_FROM_BYTES:
        return False
    counter = _ObjectCounter(payload)
    with suppress(_StoppedError, struct.error, IndexError):
        counter.count(definition, 1)
    return counter.objects > MAX_OBJECTS


class _ObjectCounter:
    """Counts texts and messages in a CDR payload, in either byte order.

    Each method steps past what it counts. They raise `_StoppedError` when they know enough.
    """

    def __init__(self, payload: bytes) -> None:
        self.objects = 0
        self._payload = payload
        self._length_of = struct.Struct("<I" if payload[1] & 1 else ">I")
        self._position = _HEADER_BYTES

    def count(self, kind: str | Definition, elements: int) -> None:
        if isinstance(kind, str) and kind in _SIZES:
            if elements:  # without elements there is no padding either
                self._skip(_SIZES[kind], _SIZES[kind] * elements)
            return
        if isinstance(kind, str) and kind != "string":
            raise _StoppedError
        self.objects += elements
        if self.objects > MAX_OBJECTS:
            raise _StoppedError
        for _ in range(elements):
            if isinstance(kind, Definition):
                self._count_fields(kind)
            else:
                self._skip(1, self._read_length())

    def _count_fields(self, definition: Definition) -> None:
        if not definition.fields:
            self._skip(1, 1)  # the dummy byte of an empty message
        for field in definition.fields:
            length = self._read_length() if field.length == SEQUENCE else field.length
            self.count(field.kind, 1 if length is None else length)

    def _read_length(self) -> int:
        at = self._skip(_LENGTH_BYTES, _LENGTH_BYTES)
        (length,) = self._length_of.unpack_from(self._payload, at)
        return int(length)

    def _skip(self, alignment: int, size: int) -> int:
        """Steps past an aligned value, and returns where it begins."""
        padding = -(self._position - _HEADER_BYTES) % alignment
        begin = self._position + padding
        self._position = begin + size
        if self._position > len(self._payload):
            raise _StoppedError
        return begin


_MAX_DECODERS: Final = 10_000
_MAX_JSON_BYTES: Final = 4 << 20
"""A byte of JSON can become thirty of memory."""
_EMPTY_MESSAGE_BYTES: Final = 8
"""The CDR header, the one byte of a message without fields, and padding."""


def _decode_json(payload: bytes) -> object:
    if len(payload) > _MAX_JSON_BYTES:
        raise UnreadableError(f"it is longer than the {_MAX_JSON_BYTES >> 20} MiB that are read")
    return json.loads(payload)


def _decode_cdr(message_type: MessageType, payload: bytes) -> object:
    """Decodes a payload, unless it has more than `MAX_OBJECTS` objects."""
    # The recorder may not have found the text of an empty definition.
    if not message_type.fields.fields and len(payload) > _EMPTY_MESSAGE_BYTES:
        raise UnreadableError(
            "the definition in the bag is empty and the message is not; put the package's .msg"
            " or .action folder into reader.custom_msg_paths"
        )
    if has_too_many_objects(message_type.fields, payload):
        raise UnreadableError(f"it states more than {MAX_OBJECTS} texts or messages")
    return message_type.deserialize(payload)


def _why_undecodable(record: Record, error: Exception) -> str:
    """Returns the reason of an `UndecodableError` for an error that decoding raised."""
    if record.payload[:4] == FRAME_MAGIC and record.channel.encoding == "cdr":
        return "its compressed payload is damaged or too large"
    words = " ".join(str(error).split())[:160] or type(error).__name__
    if isinstance(error, UnreadableError):
        return f"the payload is not decoded: {words}"
    if record.channel.encoding == "json":
        return f"the payload is not JSON: {words}"
    return f"the payload does not fit the definition: {words}"


def _format_of(path: Path) -> str:
    """Returns the suffix of a bag file without `.zstd`: `.mcap` of `a.mcap.zstd`."""
    return path.with_suffix("").suffix if path.suffix == COMPRESSED else path.suffix


MUCH_DECODED_BYTES: Final = 1 << 20
"""A larger message counts as large: decoded it may take thirty times as much."""


class FileReader(BagReader):
    """Reads `.mcap` and `.db3` files, also compressed as a whole (`.zstd`).

    Args:
        custom_msg_paths: folders of `.msg` files for types that a bag holds no definition of.
        cache_mb: memory that indexes and decompressed chunks may take between calls, in MiB.
        unpack_max_mb: disk space that decompressed files may take in the folder for temporary
            files, in MiB.
        max_chunk_mb: decompressed size up to which a chunk or a message is read, in MiB.
        large: the turn to hold much of a bag.

    Raises:
        ConfigError: one of the paths cannot be used.
    """

    def __init__(
        self,
        custom_msg_paths: Sequence[Path | str] = (),
        cache_mb: int = 64,
        unpack_max_mb: int = 1024,
        max_chunk_mb: int = MAX_CHUNK_MB,
        large: LargeReads | None = None,
    ) -> None:
        self._typestores = Typestores(custom_msg_paths)
        # By identity, since to hash a channel hashes its definition. The channel is kept beside its
        # decoder, or the reason why it has none, so that no other object gets its identity.
        self._decoders: dict[int, tuple[Channel, Callable[[bytes], object] | str]] = {}
        self._limit = SizeLimit(max_chunk_mb << 20, (large or LargeReads()).acquire)
        self._formats: dict[str, McapBags | SqliteBags] = {
            MCAP: McapBags(cache_mb, self._limit),
            SQLITE: SqliteBags(self._limit),
        }
        self._scratch = Scratch(unpack_max_mb << 20)

    def reads(self, path: Path) -> bool:
        """Returns whether the name ends with one of the four suffixes."""
        return _format_of(path) in self._formats

    def is_finished(self, path: Path) -> bool:
        """Checks closing magic for MCAP, journals beside a `.db3`, whole frames for `.zstd`."""
        with reading(path):
            if _format_of(path) not in self._formats:
                with OpenFile(path):
                    return True
            if path.suffix == COMPRESSED:
                return is_finished_zstd(path)
            return self._formats[path.suffix].is_finished(path)

    @contextmanager
    def _open(self, path: Path) -> Iterator[tuple[McapBags | SqliteBags, Path, str]]:
        """Yields what reads a file, the path to read, and a note on why it is not complete, or "".

        The path is the file itself, or a temporary copy: decompressed or with its journal applied.
        """
        if not self.reads(path):
            raise UnreadableError(f"not of a kind that is read ({', '.join(BAG_KINDS)})")
        bags = self._formats[_format_of(path)]
        sources = [path]
        if path.suffix == COMPRESSED:
            fill = partial(unpack, path)
        elif isinstance(bags, SqliteBags) and journals_beside(path):
            sources += journals_beside(path)
            fill = partial(copy_with_journal, path)
        else:
            yield bags, path, ""
            return
        keys = []
        for source in sources:
            with OpenFile(source) as file:
                keys.append(file.key)
        with self._scratch.use(tuple(keys), fill) as (copy, note):
            yield bags, copy, note

    def summarize(self, path: Path) -> BagSummary:
        """Returns topics with exact counts and exact first and last log times."""
        with reading(path), self._open(path) as (bags, file, note):
            summary = bags.summarize(file)
        return summary.with_notes((note, *summary.notes), is_whole=False) if note else summary

    def records(
        self,
        path: Path,
        topics: Collection[str],
        window: TimeWindow,
        *,
        newest_first: bool = False,
    ) -> Iterator[Record]:
        """Yields the undecoded messages of `topics` inside the window, by log time."""

        def read() -> Iterator[Record | Lost]:
            with reading(path), self._open(path) as (bags, file, _):
                yield from bags.records(file, topics, window, newest_first=newest_first)

        # Raised outside of the generator, which could not continue behind lost messages.
        return map(partial(raise_if_lost, path), read())

    def batches(
        self,
        path: Path,
        topics: Collection[str],
        window: TimeWindow,
        *,
        bare: Collection[str] = (),
    ) -> Iterator[Batch]:
        """Yields the messages of `topics` inside the window, many at once."""

        def read() -> Iterator[Batch | Lost]:
            with reading(path), self._open(path) as (bags, file, _):
                yield from bags.batches(file, topics, window, bare)

        return map(partial(raise_if_lost, path), read())

    def channels(self, path: Path) -> Sequence[Channel]:
        """Returns every channel that is declared in the file."""
        with reading(path), self._open(path) as (bags, file, _):
            return bags.channels(file)

    def undecodable(self, channel: Channel) -> str | None:
        """Returns why no message of this channel can be decoded, or None."""
        decoder = self._decoder(channel)
        return decoder if isinstance(decoder, str) else None

    def decode(self, record: Record) -> object:
        """Decodes the message of a record."""
        if len(record.payload) > MUCH_DECODED_BYTES:
            self._limit.take_turn()
        channel = record.channel
        decoder = self._decoder(channel)
        if isinstance(decoder, str):
            raise UndecodableError(channel.topic, channel.type, decoder)
        try:
            return decoder(record.payload)
        # rosbags raises whatever the generated code runs into; a payload may hold anything.
        except Exception as error:
            reason = _why_undecodable(record, error)
            raise UndecodableError(channel.topic, channel.type, reason) from error

    def encode(self, channel: Channel, message: object) -> bytes:
        """Encodes a decoded message of a channel."""
        message_type = self._type_of(channel)
        reason = f"messages encoded as {channel.encoding} are not written"
        if channel.encoding != "cdr" or isinstance(message_type, str):
            raise UndecodableError(channel.topic, channel.type, reason)
        try:
            return message_type.serialize(message)
        # rosbags raises whatever the generated code runs into, as for `decode`.
        except Exception as error:
            reason = f"the message is not encoded: {' '.join(str(error).split())[:160]}"
            raise UndecodableError(channel.topic, channel.type, reason) from error

    def definition(self, channel: Channel) -> Definition | None:
        """Returns the fields of the channel's messages; None if not CDR, or of no known type."""
        if channel.encoding != "cdr":
            return None
        message_type = self._type_of(channel)
        return None if isinstance(message_type, str) else message_type.fields

    def _decoder(self, channel: Channel) -> Callable[[bytes], object] | str:
        """Returns what decodes the payloads of a channel, or the reason why nothing does."""
        cached = self._decoders.get(id(channel))
        if cached is not None:
            _, decoder = cached
            return decoder
        decoder = self._build_decoder(channel)
        if len(self._decoders) >= _MAX_DECODERS:
            self._decoders.clear()
        self._decoders[id(channel)] = (channel, decoder)
        return decoder

    def _build_decoder(self, channel: Channel) -> Callable[[bytes], object] | str:
        if channel.encoding == "json":
            return _decode_json
        if channel.encoding != "cdr":
            return f"its message encoding {channel.encoding!r} is not read (cdr and json are)"
        message_type = self._type_of(channel)
        if isinstance(message_type, str):
            return message_type
        compiled = message_type.compiled()
        return compiled if isinstance(compiled, str) else partial(_decode_cdr, compiled)

    def _type_of(self, channel: Channel) -> MessageType | str:
        """Returns the message type of a channel, or the reason why there is none."""
        schema = channel.schema
        return self._typestores.lookup(schema.name, schema.encoding, schema.text)
