"""Decodes the payload of a record into a message."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from ros2_memory.core.errors import UndecodableError
from ros2_memory.storage.cdr_layout import MAX_OBJECTS, holds_too_many, layout_of
from ros2_memory.storage.errors import UnreadableError
from ros2_memory.storage.zstd_bag import FRAME_MAGIC
from ros2_memory.typestore import Typestores, full_name

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from rosbags.interfaces.typing import Typesdict

    from ros2_memory.storage.base import CdrLayout, Channel, Record

_MAX_KNOWN = 10_000
_MAX_JSON_BYTES = 4 << 20
"""A byte of JSON can become thirty of memory."""
_EMPTY_MESSAGE_BYTES = 8
"""The CDR header, the one byte of a message without fields, and padding."""


class Decoding:
    """Decodes CDR by message definition, and JSON. Safe to use from several threads at once.

    Args:
        custom_msg_paths: see `Typestores`.

    Raises:
        ConfigError: one of the paths cannot be used.
    """

    def __init__(self, custom_msg_paths: Sequence[Path | str] = ()) -> None:
        self._typestores = Typestores(custom_msg_paths)
        # By identity, since hashing a channel hashes its definition; the channel is kept, so that
        # its identity is not given to another.
        self._known: dict[int, tuple[Channel, Callable[[bytes], object] | str]] = {}

    def undecodable(self, channel: Channel) -> str | None:
        """Returns why no message of this channel can be decoded, or None."""
        decoder = self._decoder(channel)
        return decoder if isinstance(decoder, str) else None

    def decode(self, record: Record) -> object:
        """Decodes a record: an attribute object for CDR, a plain value for JSON.

        Raises:
            UndecodableError: the channel cannot be decoded, or the bytes do not fit its type.
        """
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

    def layout(self, record: Record) -> CdrLayout | None:
        """Returns where the numbers of a message lie; None if it must be decoded."""
        channel = record.channel
        if channel.encoding != "cdr":
            return None
        schema = channel.schema
        definitions = self._typestores.lookup(schema.name, schema.encoding, schema.text).definitions
        if definitions is None:
            return None
        return layout_of(definitions, full_name(schema.name), record.payload)

    def _decoder(self, channel: Channel) -> Callable[[bytes], object] | str:
        known = self._known.get(id(channel))
        if known is not None:
            return known[1]
        decoder = self._find(channel)
        if len(self._known) >= _MAX_KNOWN:
            self._known.clear()
        self._known[id(channel)] = (channel, decoder)
        return decoder

    def _find(self, channel: Channel) -> Callable[[bytes], object] | str:
        if channel.encoding == "json":
            return _json
        if channel.encoding != "cdr":
            return f"its message encoding {channel.encoding!r} is not read (cdr and json are)"
        schema = channel.schema
        found = self._typestores.lookup(schema.name, schema.encoding, schema.text)
        if found.deserialize is None or found.definitions is None:
            return found.reason or "its definition cannot be used"
        if found.fieldless:
            return _fieldless(found.deserialize)
        return _bounded(found.deserialize, found.definitions, full_name(schema.name))


def _json(payload: bytes) -> object:
    if len(payload) > _MAX_JSON_BYTES:
        raise UnreadableError(f"it is longer than the {_MAX_JSON_BYTES >> 20} MiB that are read")
    value: object = json.loads(payload)
    return value


def _bounded(
    deserialize: Callable[[bytes], object], definitions: Typesdict, root: str
) -> Callable[[bytes], object]:
    """Returns a decoder that refuses messages of more than `MAX_OBJECTS` objects."""

    def decode(payload: bytes) -> object:
        if holds_too_many(definitions, root, payload):
            raise UnreadableError(f"it holds more than {MAX_OBJECTS} texts or messages")
        return deserialize(payload)

    return decode


def _fieldless(deserialize: Callable[[bytes], object]) -> Callable[[bytes], object]:
    """Returns a decoder for an empty definition, whose text the recorder may not have found."""

    def decode(payload: bytes) -> object:
        if len(payload) > _EMPTY_MESSAGE_BYTES:
            raise UnreadableError(
                "the definition in the bag is empty and the message is not; put the package's .msg"
                " folder into reader.custom_msg_paths"
            )
        return deserialize(payload)

    return decode


def _reason(record: Record, error: Exception) -> str:
    if record.payload[:4] == FRAME_MAGIC and record.channel.encoding == "cdr":
        return "its compressed payload is damaged or too large"
    words = " ".join(str(error).split())[:160] or type(error).__name__
    if isinstance(error, UnreadableError):
        return f"the payload is not decoded: {words}"
    if record.channel.encoding == "json":
        return f"the payload is not JSON: {words}"
    return f"the payload does not fit the definition: {words}"
