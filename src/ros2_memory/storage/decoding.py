"""Decodes the payload of a record into a message."""

from __future__ import annotations

import json
from functools import partial
from typing import TYPE_CHECKING

from ros2_memory.core.errors import UndecodableError
from ros2_memory.storage.errors import UnreadableError
from ros2_memory.storage.object_count import MAX_OBJECTS, holds_too_many
from ros2_memory.storage.zstd_bag import FRAME_MAGIC
from ros2_memory.typestore import Typestores

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from ros2_memory.storage.base import Channel, Definition, Record
    from ros2_memory.typestore import MessageType

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
        self._definitions: dict[int, tuple[Channel, Definition | None]] = {}

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

    def encode(self, channel: Channel, message: object) -> bytes:
        """Returns a decoded CDR message, changed since, as a payload.

        Raises:
            UndecodableError: it is not of the channel's type.
        """
        schema = channel.schema
        found = self._typestores.lookup(schema.name, schema.encoding, schema.text)
        reason = f"messages encoded as {channel.encoding} are not written"
        if channel.encoding != "cdr" or isinstance(found, str):
            raise UndecodableError(channel.topic, channel.type, reason)
        try:
            return found.serialize(message)
        # rosbags raises whatever the generated code runs into, as for `decode`.
        except Exception as error:
            reason = f"the message is not encoded: {' '.join(str(error).split())[:160]}"
            raise UndecodableError(channel.topic, channel.type, reason) from error

    def definition(self, channel: Channel) -> Definition | None:
        """Returns the fields of a channel's messages; None if they are not CDR of a known type."""
        known = self._definitions.get(id(channel))
        if known is not None:
            return known[1]
        schema = channel.schema
        found: Definition | None = None
        if channel.encoding == "cdr":
            kind = self._typestores.lookup(schema.name, schema.encoding, schema.text)
            found = None if isinstance(kind, str) else kind.fields
        if len(self._definitions) >= _MAX_KNOWN:
            self._definitions.clear()
        self._definitions[id(channel)] = (channel, found)
        return found

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
        found = found if isinstance(found, str) else found.compiled()
        return found if isinstance(found, str) else partial(_deserialized, found)


def _json(payload: bytes) -> object:
    if len(payload) > _MAX_JSON_BYTES:
        raise UnreadableError(f"it is longer than the {_MAX_JSON_BYTES >> 20} MiB that are read")
    value: object = json.loads(payload)
    return value


def _deserialized(found: MessageType, payload: bytes) -> object:
    """Decodes a payload, unless it holds more than `MAX_OBJECTS` objects."""
    # The recorder may not have found the text of an empty definition.
    if found.fieldless and len(payload) > _EMPTY_MESSAGE_BYTES:
        raise UnreadableError(
            "the definition in the bag is empty and the message is not; put the package's .msg"
            " folder into reader.custom_msg_paths"
        )
    if holds_too_many(found.definitions, found.name, payload):
        raise UnreadableError(f"it states more than {MAX_OBJECTS} texts or messages")
    return found.deserialize(payload)


def _reason(record: Record, error: Exception) -> str:
    if record.payload[:4] == FRAME_MAGIC and record.channel.encoding == "cdr":
        return "its compressed payload is damaged or too large"
    words = " ".join(str(error).split())[:160] or type(error).__name__
    if isinstance(error, UnreadableError):
        return f"the payload is not decoded: {words}"
    if record.channel.encoding == "json":
        return f"the payload is not JSON: {words}"
    return f"the payload does not fit the definition: {words}"
