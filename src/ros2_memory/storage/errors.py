"""Where everything foreign becomes the error tree.

Reading bytes that anybody may have written raises whatever the libraries and the interpreter make
of them: struct.error, ZstdError, sqlite3.Error, lz4's RuntimeError, MemoryError, UnicodeDecodeError
and more. The rooms below the adapters let all of it pass, and say `UnreadableError` for what they
find wrong themselves; `reading` names the file.
"""

from __future__ import annotations

import errno
import sqlite3
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, TypeVar

from ros2_memory.core.errors import (
    BagContradictionError,
    BagError,
    BagUnreachableError,
    BagVanishedError,
    EpisodicError,
)

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from ros2_memory.core.timebase import Ns

T = TypeVar("T")

# Not ESTALE and ENODEV: a server or a disk that went may come back with all its files.
_GONE = {errno.ENOENT, errno.ENOTDIR}
_OF_THE_DISK = {
    sqlite3.SQLITE_IOERR,
    sqlite3.SQLITE_CANTOPEN,
    sqlite3.SQLITE_NOMEM,
    sqlite3.SQLITE_FULL,
    sqlite3.SQLITE_PERM,
}


class UnreadableError(Exception):
    """Bytes of a bag that cannot be read; the text is the reason, without the file's name."""


class UnreachableError(UnreadableError):
    """As `UnreadableError`, where the fault is not the file's and may pass."""


class LostError(UnreadableError):
    """Messages that cannot be read, while those around them may be.

    `first` and `last` are log times: none of the lost ones lies outside of them.
    """

    def __init__(self, reason: str, first: Ns, last: Ns) -> None:
        super().__init__(reason)
        self.first = first
        self.last = last


class ContradictionError(LostError):
    """Indexes that contradict the messages: these are read without them, from `first` to `last`."""


def raise_if_lost(path: Path, item: T | LostError) -> T:
    """The item itself.

    Raises:
        BagContradictionError: it says that the indexes of `path` are not believed.
        BagError: it stands for messages of `path` that are lost.
    """
    if isinstance(item, ContradictionError):
        raise BagContradictionError(str(path), str(item), (item.first, item.last))
    if isinstance(item, LostError):
        raise BagError(str(path), str(item), (item.first, item.last))
    return item


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Raises every exception of its block as an `EpisodicError` about `path`.

    Raises:
        BagVanishedError: the file or a folder above it is gone.
        BagUnreachableError: the fault is not the file's, and may pass.
        BagError: anything else; its text ends with the reason.
    """
    try:
        yield
    except EpisodicError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.errno in _GONE:
            raise BagVanishedError(str(path), "the file is not there any more") from error
        error_type = BagUnreachableError if _may_pass(error) else BagError
        raise error_type(str(path), reason_of(error)) from error


@contextmanager
def as_unreadable() -> Iterator[None]:
    """Raises `UnreadableError` for whatever damaged bytes raise, where others may be whole.

    What the disk or the machine lacks (OSError, MemoryError) passes: whole bytes raise it too.
    """
    try:
        yield
    except (UnreadableError, OSError, MemoryError):
        raise
    except Exception as error:
        raise UnreadableError(reason_of(error)) from error


def reason_of(error: Exception) -> str:
    """One line that says why the bytes cannot be read."""
    if isinstance(error, UnreadableError):
        return str(error)
    if isinstance(error, OSError):
        return f"it cannot be opened or read: {error.strerror or error}"
    if isinstance(error, MemoryError):
        return "there is not enough memory to read it"
    if _sqlite_code(error) in _OF_THE_DISK:
        return f"it cannot be opened or read: {error}"
    words = " ".join(str(error).split())[:160]
    return f"damaged: {words} ({type(error).__name__})" if words else type(error).__name__


def _may_pass(error: Exception) -> bool:
    """Whether the same bytes may be read later."""
    if isinstance(error, (OSError, MemoryError, UnreachableError)):
        return True
    return _sqlite_code(error) in _OF_THE_DISK


def _sqlite_code(error: Exception) -> int | None:
    """SQLite's primary code; None of any other error."""
    code: object = getattr(error, "sqlite_errorcode", None)
    return code & 0xFF if isinstance(code, int) else None


MAX_CHUNK_MB: Final = 64
"""What one chunk or one message may hold, unpacked, unless the configuration says otherwise."""
MAX_SECTION_BYTES: Final = 64 << 20
"""What one record, and a summary section, may hold: it is held in memory as a whole."""
MAX_CHUNK_MESSAGES: Final = 1_000_000
"""More messages than these take more memory than their chunk, and seconds to look through."""
MAX_CHANNELS: Final = 5_000
"""The largest robots have some hundred topics; every list and search goes through all there are."""
MAX_NAMES_CHARS: Final = 1 << 20
"""Names of all topics and types of one file, which are held for as long as the bag lies there."""
MAX_DEFINITION_BYTES: Final = 1 << 20
"""A larger one is not used, so no more of it is held than what shows that it is larger."""
MAX_CHUNK_DECLARATIONS: Final = 20_000
"""Schemas and channels in one chunk; a writer declares each once."""
MESSAGE_BYTES: Final = 64
"""What a message takes besides itself while its file is looked through."""
MAX_CHUNKS: Final = 150_000
"""Each is kept in mind for as long as its file is asked about."""
MAX_TIMES_PACKED: Final = 100
"""Nothing that a robot records shrinks to less than this part of itself, but for what is small."""
_ALWAYS_ALLOWED: Final = 32 << 20


def most_unpacked(packed: int) -> int:
    """How many bytes so many compressed bytes may unpack to; more is made to do harm."""
    return _ALWAYS_ALLOWED + MAX_TIMES_PACKED * packed


def too_large(what: str, max_bytes: int) -> str:
    """The reason why something is not read."""
    return (
        f"{what} is larger than the {max_bytes >> 20} MiB allowed; where that is right, raise"
        " reader.max_chunk_mb"
    )
