"""What the two ends of an MCAP file say: that it is one, its profile, that it was finished."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ros2_memory.storage.base import Closing
from ros2_memory.storage.errors import UnreadableError
from ros2_memory.storage.file_io import EMPTY_FILE
from ros2_memory.storage.mcap.records import MAGIC, MAGIC_SIZE, RECORD, Opcode

if TYPE_CHECKING:
    from ros2_memory.storage.file_io import OpenFile

_MOST_PROFILE_BYTES: Final = 256
_LENGTH_BYTES: Final = 4


def closing_of(file: OpenFile) -> Closing:
    """Open while the closing magic is missing; what is not MCAP at all counts as closed."""
    if file.size and not begins_as_mcap(file):
        return Closing.CLOSED
    return Closing.CLOSED if _ends_as_mcap(file) else Closing.OPEN


def is_finished(file: OpenFile) -> bool:
    """Whether it is MCAP and its writer finished it."""
    return _ends_as_mcap(file) and begins_as_mcap(file)


def _ends_as_mcap(file: OpenFile) -> bool:
    whole = file.size >= 2 * MAGIC_SIZE
    return whole and file.read(file.size - MAGIC_SIZE, MAGIC_SIZE) == MAGIC


def begins_as_mcap(file: OpenFile) -> bool:
    """Whether it begins with MCAP's magic, or with as much of it as the file has bytes."""
    return MAGIC.startswith(file.read(0, min(file.size, MAGIC_SIZE)))


def require_mcap(file: OpenFile) -> None:
    """Refuses what cannot be read as MCAP from its beginning.

    Raises:
        UnreadableError: it is no MCAP file, or ends within its magic.
    """
    if not file.size:
        raise UnreadableError(EMPTY_FILE)
    if not begins_as_mcap(file):
        raise UnreadableError("not an MCAP file: it does not begin as one")
    if file.size < MAGIC_SIZE:
        raise UnreadableError(f"only its first {file.size} bytes had reached the disk")


def profile_of(file: OpenFile) -> str:
    """The profile that the header record holds; empty where there is no header.

    Raises:
        UnreadableError: it is no MCAP file, or its header is damaged.
    """
    require_mcap(file)
    text_at = MAGIC_SIZE + RECORD.size + _LENGTH_BYTES
    if file.size < text_at:
        return ""
    head = file.read(MAGIC_SIZE, RECORD.size + _LENGTH_BYTES)
    if head[0] != Opcode.HEADER:
        return ""
    length = int.from_bytes(head[RECORD.size :], "little")
    if length > _MOST_PROFILE_BYTES:
        raise UnreadableError("damaged: its profile is longer than any can be")
    return file.read(text_at, length).decode()
