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
from ros2_memory.core.model import BAG_KINDS, COMPRESSED
from ros2_memory.storage.base import SEQUENCE, BagReader, Batch, Channel, Definition, Record
from ros2_memory.storage.errors import (
    MAX_CHUNK_MB,
    LostError,
    UnreadableError,
    raise_if_lost,
    reading,
)
from ros2_memory.storage.file_io import OpenFile
from ros2_memory.storage.mcap.bag_file import McapBags
from ros2_memory.storage.scratch import Scratch
from ros2_memory.storage.sqlite_bag import SqliteBags, copy_with_journal, journals_beside
from ros2_memory.storage.zstd_bag import FRAME_MAGIC, closing_of_zstd, unpack
from ros2_memory.typestore import MessageType, Typestores

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.core.bag_summary import BagSummary
    from ros2_memory.core.model import TimeWindow
    from ros2_memory.storage.base import Closing

_HEADER_BYTES: Final = 4
# A float128 is not aligned to its own size.
_SIZES: Final[Mapping[str, int]] = {
    str(name): size for name, size in SIZEMAP.items() if name != "float128"
}

MAX_OBJECTS: Final = 200_000
"""Texts and messages in one message; each is an object when it is decoded."""
_COUNTED_FROM_BYTES: Final = 256 << 10


class _StoppedError(Exception):
    """There are more objects than are counted, or the payload does not fit its definition."""


def holds_too_many(definition: Definition, payload: bytes) -> bool:
    """Returns whether decoding a payload would make more than `MAX_OBJECTS` objects.

    One byte of it can become an object of a hundred. The length that a sequence states counts. A
    payload that does not fit its definition otherwise is left to decoding, which names the fault.
    """
    if len(payload) < _COUNTED_FROM_BYTES:
        return False
    walk = _Walk(payload)
    with suppress(_StoppedError, struct.error, IndexError):
        walk.message(definition)
    return walk.objects > MAX_OBJECTS


class _Walk:
    """Goes through the fields of a payload, in either byte order, and counts texts and messages."""

    def __init__(self, payload: bytes) -> None:
        self.objects = 0
        self._payload = payload
        self._length_of = struct.Struct("<I" if payload[1] & 1 else ">I")
        self._position = _HEADER_BYTES

    def message(self, definition: Definition) -> None:
        self._count()
        if not definition.fields:
            self._advance(1, 1)
        for field in definition.fields:
            if field.length is None:
                self._one(field.kind)
            else:
                length = self._length() if field.length == SEQUENCE else field.length
                self._elements(field.kind, length)

    def _elements(self, kind: str | Definition, count: int) -> None:
        """Goes past some elements: at once where all have one size."""
        if isinstance(kind, str) and kind in _SIZES:
            if count:  # without elements there is no padding either
                self._advance(_SIZES[kind], _SIZES[kind] * count)
            return
        if isinstance(kind, Definition) and self.objects + count > MAX_OBJECTS:
            # Each is an object: none of them needs to be read.
            self.objects += count
            raise _StoppedError
        for _ in range(count):
            self._one(kind)

    def _one(self, kind: str | Definition) -> None:
        if isinstance(kind, Definition):
            self.message(kind)
        elif kind == "string":
            self._count()
            self._advance(1, self._length())
        elif kind in _SIZES:
            self._advance(_SIZES[kind], _SIZES[kind])
        else:
            raise _StoppedError

    def _length(self) -> int:
        at = self._advance(4, 4)
        length: int = self._length_of.unpack_from(self._payload, at)[0]
        return length

    def _advance(self, alignment: int, size: int) -> int:
        """Goes past an aligned value, and returns where it begins."""
        at = self._position + -(self._position - _HEADER_BYTES) % alignment
        self._position = at + size
        if self._position > len(self._payload):
            raise _StoppedError
        return at

    def _count(self) -> None:
        self.objects += 1
        if self.objects > MAX_OBJECTS:
            raise _StoppedError


_MAX_KNOWN = 10_000
_MAX_JSON_BYTES = 4 << 20
"""A byte of JSON can become thirty of memory."""
_EMPTY_MESSAGE_BYTES = 8
"""The CDR header, the one byte of a message without fields, and padding."""


def _json(payload: bytes) -> object:
    if len(payload) > _MAX_JSON_BYTES:
        raise UnreadableError(f"it is longer than the {_MAX_JSON_BYTES >> 20} MiB that are read")
    return json.loads(payload)


def _deserialized(message_type: MessageType, payload: bytes) -> object:
    """Decodes a payload, unless it holds more than `MAX_OBJECTS` objects."""
    # The recorder may not have found the text of an empty definition.
    if not message_type.fields.fields and len(payload) > _EMPTY_MESSAGE_BYTES:
        raise UnreadableError(
            "the definition in the bag is empty and the message is not; put the package's .msg"
            " folder into reader.custom_msg_paths"
        )
    if holds_too_many(message_type.fields, payload):
        raise UnreadableError(f"it states more than {MAX_OBJECTS} texts or messages")
    return message_type.deserialize(payload)


def _reason(record: Record, error: Exception) -> str:
    if record.payload[:4] == FRAME_MAGIC and record.channel.encoding == "cdr":
        return "its compressed payload is damaged or too large"
    words = " ".join(str(error).split())[:160] or type(error).__name__
    if isinstance(error, UnreadableError):
        return f"the payload is not decoded: {words}"
    if record.channel.encoding == "json":
        return f"the payload is not JSON: {words}"
    return f"the payload does not fit the definition: {words}"


def _format_of(path: Path) -> str:
    """Returns the suffix of a bag's file, or of the file that is compressed there."""
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
        large = large or LargeReads()
        self._typestores = Typestores(custom_msg_paths)
        # By identity, since hashing a channel hashes its definition; the channel is kept, so that
        # its identity is not given to another.
        self._known: dict[int, tuple[Channel, Callable[[bytes], object] | str]] = {}
        self._large = large
        self._formats: dict[str, McapBags | SqliteBags] = {
            ".mcap": McapBags(cache_mb, max_chunk_mb, large),
            ".db3": SqliteBags(max_chunk_mb, large),
        }
        self._scratch = Scratch(unpack_max_mb << 20)

    def reads(self, path: Path) -> bool:
        """Returns whether the name ends with one of the four suffixes."""
        return _format_of(path) in self._formats

    def closing(self, path: Path) -> Closing:
        """Checks closing magic for MCAP, journals beside a `.db3`, whole frames for `.zstd`."""
        with reading(path):
            if path.suffix == COMPRESSED:
                return closing_of_zstd(path)
            return self._formats[path.suffix].closing(path)

    @contextmanager
    def _open(self, path: Path) -> Iterator[tuple[McapBags | SqliteBags, Path, str]]:
        """Yields what reads a file, where that is, and a note on why it is not complete, or "".

        That is the file itself, or a temporary copy, decompressed or with its journal applied.
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
        return summary.replaced(complete=False, notes=(note, *summary.notes)) if note else summary

    def records(
        self,
        path: Path,
        topics: Collection[str],
        window: TimeWindow,
        *,
        newest_first: bool = False,
    ) -> Iterator[Record]:
        """Yields the undecoded messages of `topics` inside the window, by log time."""

        def read() -> Iterator[Record | LostError]:
            with reading(path), self._open(path) as (bags, file, _):
                yield from bags.records(file, topics, window, newest_first=newest_first)

        # Mapped outside of the generator: one that has raised could not go on behind lost messages.
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

        def read() -> Iterator[Batch | LostError]:
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
            self._large.acquire()
        channel = record.channel
        decoder = self._decoder(channel)
        if isinstance(decoder, str):
            raise UndecodableError(channel.topic, channel.type, decoder)
        try:
            return decoder(record.payload)
        # rosbags raises whatever the generated code runs into; a payload may hold anything.
        except Exception as error:
            reason = _reason(record, error)
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
        found = self._type_of(channel)
        return None if isinstance(found, str) else found.fields

    def _decoder(self, channel: Channel) -> Callable[[bytes], object] | str:
        _, cached = self._known.get(id(channel), (channel, None))
        if cached is not None:
            return cached
        decoder: Callable[[bytes], object] | str = _json
        if channel.encoding == "cdr":
            usable = self._type_of(channel)
            usable = usable if isinstance(usable, str) else usable.compiled()
            decoder = usable if isinstance(usable, str) else partial(_deserialized, usable)
        elif channel.encoding != "json":
            decoder = f"its message encoding {channel.encoding!r} is not read (cdr and json are)"
        if len(self._known) >= _MAX_KNOWN:
            self._known.clear()
        self._known[id(channel)] = (channel, decoder)
        return decoder

    def _type_of(self, channel: Channel) -> MessageType | str:
        schema = channel.schema
        return self._typestores.lookup(schema.name, schema.encoding, schema.text)
