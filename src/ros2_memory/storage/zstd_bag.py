"""Bag files that rosbag2 compressed as a whole: `.mcap.zstd`, `.db3.zstd`."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Final

import zstandard

from ros2_memory.storage.base import Closing
from ros2_memory.storage.errors import MAX_TIMES_PACKED, UnreadableError, most_unpacked
from ros2_memory.storage.file_io import EMPTY_FILE, OpenFile, open_regular
from ros2_memory.storage.zstd import begins_as_zstd, ends_whole

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

# As large as a block: what stands before a damaged one is not lost with it.
_PIECE: Final = zstandard.DECOMPRESSION_RECOMMENDED_OUTPUT_SIZE


def closing_of_zstd(path: Path) -> Closing:
    """Closed when the file is made of whole frames; what is not zstd at all counts as closed."""
    with OpenFile(path) as file:
        if file.size and not begins_as_zstd(file):
            return Closing.CLOSED
        return Closing.CLOSED if ends_whole(file) else Closing.OPEN


def unpack(path: Path, folder: Path, reserve: Callable[[int], None]) -> tuple[Path, str]:
    """Decompresses a bag file into the folder, as far as it can be read.

    Args:
        path: the compressed file.
        folder: where the bag is written, under its name without `.zstd`.
        reserve: called with a number of bytes before as many are written.

    Returns:
        The bag, and a note on where the compressed file ends early (empty where it does not).

    Raises:
        UnreadableError: nothing of it can be decompressed, or there is no room for it.
    """
    with OpenFile(path) as file:
        if not file.size:
            raise UnreadableError(EMPTY_FILE)
        if not begins_as_zstd(file):
            raise UnreadableError("not a zstd file: it does not begin as one")
        whole = ends_whole(file)
    target = folder / path.stem
    damage = _unpack(path, target, _harmless(reserve, path.stat().st_size))
    if not target.stat().st_size:
        raise UnreadableError(f"nothing of it can be decompressed ({damage or 'it ends early'})")
    if damage:
        return target, f"its compressed file is damaged ({damage}); what comes after is lost"
    return target, "" if whole else "its compressed file ends early"


def _harmless(reserve: Callable[[int], None], packed: int) -> Callable[[int], None]:
    """`reserve`, up to what a file of this size may unpack to.

    Its caller raises `UnreadableError` for more.
    """
    left = most_unpacked(packed)

    def reserve_some(size: int) -> None:
        nonlocal left
        left -= size
        if left < 0:
            raise UnreadableError(f"it unpacks to more than {MAX_TIMES_PACKED} times its size")
        reserve(size)

    return reserve_some


def _unpack(path: Path, target: Path, reserve: Callable[[int], None]) -> str:
    """Writes what can be decompressed; what is wrong with the rest, or nothing."""
    with os.fdopen(open_regular(path), "rb") as packed, target.open("wb") as out:
        reader = zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True)
        while True:
            try:
                piece = reader.read(_PIECE)
            except zstandard.ZstdError as error:
                return str(error)
            if not piece:
                return ""
            reserve(len(piece))
            out.write(piece)
