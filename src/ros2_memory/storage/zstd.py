"""Zstandard data in memory: one frame, and messages that rosbag2 compressed one by one."""

from __future__ import annotations

from typing import Final

import zstandard

from ros2_memory.storage.faults import UnreadableError

FRAME_MAGIC: Final = b"\x28\xb5\x2f\xfd"
MAX_MESSAGE_BYTES: Final = 256 << 20


def unpacked_zstd(packed: bytes, max_bytes: int) -> bytes:
    """One zstd frame, decompressed.

    Raises:
        UnreadableError: it holds, or states to hold, more than `max_bytes`.
    """
    stated = zstandard.frame_content_size(packed)
    if stated > max_bytes:
        raise UnreadableError(f"compressed data is larger than the {max_bytes >> 20} MiB allowed")
    # A decompressor is not safe to share between threads; one costs a few microseconds.
    decompressor = zstandard.ZstdDecompressor()
    if stated >= 0:
        return decompressor.decompress(packed)
    with decompressor.stream_reader(packed) as stream:
        data = stream.read(max_bytes + 1)
    if len(data) > max_bytes:
        raise UnreadableError(f"compressed data is larger than the {max_bytes >> 20} MiB allowed")
    return data


def plain_payload(payload: bytes) -> bytes:
    """A serialized message as it was before rosbag2's message compression.

    Nothing but the frame's magic says that a payload is compressed; no CDR message begins so. One
    that cannot be decompressed is given as it stands, for decoding to say so.
    """
    if payload[:4] != FRAME_MAGIC:
        return payload
    try:
        return unpacked_zstd(payload, MAX_MESSAGE_BYTES)
    except (UnreadableError, zstandard.ZstdError, MemoryError):
        return payload
