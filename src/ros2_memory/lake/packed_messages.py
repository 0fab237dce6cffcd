"""The messages of one channel of a bag as bytes, and back: both times and the payload of each.

What the bytes are, once decompressed (numbers are little-endian and lie in planes, the lowest byte
of each first, as they then compress best)::

    1       format
    1       0: times alone; 1: payloads, too
    4       n, the number of messages
    8 n     log times, each since the one before
    8 n     publish times, each since the log time
    4 n     the bytes of each payload
    ...     the payloads, in planes where all have one size, else one after the other

This is no derived data that a later version makes again: it is read for as long as the lake is.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.columns.pack import byte_planes, compressed, decompressed, from_planes
from ros2_memory.storage.base import Batch, Channel, IntArray

if TYPE_CHECKING:
    from collections.abc import Sequence


_FORMAT: Final = 1
_HEAD: Final = struct.Struct("<BBI")


def packed_messages(
    log_times: IntArray, publish_times: IntArray, payloads: Sequence[bytes] | None
) -> bytes:
    """Returns messages in order of their log times as bytes; without payloads where there are none.

    `payloads` are of messages in the same order.
    """
    parts = [
        _HEAD.pack(_FORMAT, payloads is not None, len(log_times)),
        byte_planes(np.diff(log_times, prepend=np.int64(0)), 8),
        byte_planes(publish_times - log_times, 8),
    ]
    if payloads is not None:
        sizes = np.array([len(payload) for payload in payloads], np.int64)
        joined = b"".join(payloads)
        if len(sizes) and (sizes == sizes[0]).all():
            rows = np.frombuffer(joined, np.uint8).reshape(len(sizes), -1)
            joined = rows.T.tobytes()
        parts += [byte_planes(sizes, 4), joined]
    return compressed(b"".join(parts))


def unpacked_messages(data: bytes, channel: Channel) -> Batch:
    """Returns the messages that were packed so; all payloads are empty where none were packed.

    Raises:
        ValueError: the bytes are damaged, or of a later format.
    """
    content = decompressed(data)
    try:
        form, is_whole, count = _HEAD.unpack_from(content)
    except struct.error as error:
        raise ValueError("packed messages are cut short") from error
    if form != _FORMAT:
        raise ValueError(f"messages are packed in format {form}, this program reads {_FORMAT}")
    at = _HEAD.size
    logged = np.cumsum(from_planes(content, at, count, 8).astype(np.int64))
    published = logged + from_planes(content, at + 8 * count, count, 8).astype(np.int64)
    at += 16 * count
    sizes, payloads = np.zeros(count, np.int64), b""
    if is_whole:
        sizes = from_planes(content, at, count, 4).astype(np.int64)
        payloads = content[at + 4 * count :]
        if len(payloads) != sizes.sum():
            raise ValueError("packed messages are cut short")
        if count and (sizes == sizes[0]).all():
            planes = np.frombuffer(payloads, np.uint8).reshape(-1, count)
            payloads = planes.T.tobytes()
    starts = np.cumsum(sizes) - sizes
    return Batch(channel, logged, published, np.arange(count), payloads, starts, sizes)
