"""Compresses the digests of one topic, which are mostly the same from bag to bag.

What is stored is compressed against a model: the first of its kind that was stored of the topic. So
what equals the model takes some ten bytes, and names and texts that both have take nearly none.
"""

from __future__ import annotations

import zlib
from typing import Final

MAX_MODEL_BYTES: Final = 4096
"""Longer models are cut off: the compressor looks back no farther."""

_WINDOW_BITS: Final = -12  # without a header: 4 KiB
_LEVEL: Final = 9
_MEMORY_LEVEL: Final = 8


def packed(plain: bytes, model: bytes) -> bytes:
    """Returns bytes that `unpacked` turns into the same again; `model` must be the same."""
    if not plain:
        return b""
    packer = zlib.compressobj(
        _LEVEL, zlib.DEFLATED, _WINDOW_BITS, _MEMORY_LEVEL, zlib.Z_DEFAULT_STRATEGY, model
    )
    return packer.compress(plain) + packer.flush()


def unpacked(stored: bytes, model: bytes) -> bytes:
    """Returns the bytes that were packed.

    Raises:
        ValueError: the bytes are not what `packed` returned.
    """
    if not stored:
        return b""
    unpacker = zlib.decompressobj(_WINDOW_BITS, model)
    try:
        plain = unpacker.decompress(stored)
    except zlib.error as error:
        raise ValueError(f"not what was packed: {error}") from error
    if not unpacker.eof or unpacker.unused_data:
        raise ValueError("not what was packed: some of it is missing, or more follows")
    return plain
