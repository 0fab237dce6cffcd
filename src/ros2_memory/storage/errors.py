"""Translates foreign exceptions into the error tree, and bounds what a file may make a reader do.

Reading bytes that anybody may have written raises whatever the libraries and the interpreter make
of them: struct.error, ZstdError, sqlite3.Error, lz4's RuntimeError, MemoryError, UnicodeDecodeError
and more. The modules below the adapters let all of them pass, and raise `UnreadableError` for what
they find wrong themselves; `reading` adds the name of the file.

No size that a file states is allocated before it was compared with the limits here and with the
bytes that are really there.
"""

from __future__ import annotations

import errno
import sqlite3
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, NamedTuple, TypeVar

from ros2_memory.core.errors import (
    BagError,
    BagUnreachableError,
    BagVanishedError,
    EpisodicError,
    sqlite_code,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from ros2_memory.core.timebase import Ns

T = TypeVar("T")

# Not ESTALE and ENODEV: a server or a disk that is gone may come back with all its files.
_GONE = {errno.ENOENT, errno.ENOTDIR}
_DISK_ERRORS = {
    sqlite3.SQLITE_IOERR,
    sqlite3.SQLITE_CANTOPEN,
    sqlite3.SQLITE_NOMEM,
    sqlite3.SQLITE_FULL,
    sqlite3.SQLITE_PERM,
}


class UnreadableError(Exception):
    """Bytes of a bag that cannot be read; the text is the reason, without the file's name."""


class UnreachableError(UnreadableError):
    """An `UnreadableError` whose cause is not the file, and may pass."""


class Lost(NamedTuple):
    """Stands for messages that cannot be read, while those around them may be.

    Attributes:
        reason: why they cannot be read.
        first: a log time; no lost message is earlier.
        last: a log time; no lost message is later.
        error: what the reader of the file raises in their place. A `BagContradictionError` says
            that the messages are read without the file's indexes, and that none is lost.
    """

    reason: str
    first: Ns
    last: Ns
    error: type[BagError] = BagError


def raise_if_lost(path: Path, item: T | Lost) -> T:
    """Returns the item, unless it stands for lost messages of `path`.

    Raises:
        BagError: it does.
    """
    if isinstance(item, Lost):
        raise item.error(str(path), item.reason, (item.first, item.last))
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
        is_transient = isinstance(error, (OSError, MemoryError, UnreachableError))
        if is_transient or sqlite_code(error) in _DISK_ERRORS:
            raise BagUnreachableError(str(path), reason_of(error)) from error
        raise BagError(str(path), reason_of(error)) from error


@contextmanager
def as_unreadable() -> Iterator[None]:
    """Raises every exception that damaged bytes cause as an `UnreadableError`.

    For parts of a file whose neighbours may be whole. OSError, MemoryError and EpisodicError (the
    time of a call is over) pass: whole bytes raise them, too.
    """
    try:
        yield
    except (UnreadableError, EpisodicError, OSError, MemoryError):
        raise
    except Exception as error:
        raise UnreadableError(reason_of(error)) from error


def reason_of(error: Exception) -> str:
    """Returns one line on why the bytes cannot be read."""
    if isinstance(error, UnreadableError):
        return str(error)
    if isinstance(error, OSError):
        return f"it cannot be opened or read: {error.strerror or error}"
    if isinstance(error, MemoryError):
        return "there is not enough memory to read it"
    if sqlite_code(error) in _DISK_ERRORS:
        return f"it cannot be opened or read: {error}"
    words = " ".join(str(error).split())[:160]
    return f"damaged: {words} ({type(error).__name__})" if words else type(error).__name__


MAX_CHUNK_MB: Final = 64
"""The decompressed size of one chunk or one message, unless the configuration sets another."""
MAX_SECTION_BYTES: Final = 64 << 20
"""The size of one record or of a summary section, which is read into memory as a whole."""
MAX_CHUNK_MESSAGES: Final = 1_000_000
"""More take more memory than their chunk, and seconds to index."""
MAX_TOPICS: Final = 5_000
"""The largest robots have some hundred topics; every list and search goes through all of them."""
MANY_TOPICS: Final = f"it may be whole, but has more than the {MAX_TOPICS} topics that are read"
MAX_CHANNELS: Final = 1 << 16
"""The numbers that MCAP has for channels: a topic may have one for each time it was subscribed."""
MAX_NAMES_CHARS: Final = 1 << 20
"""Names of all topics and types of one file, which stay in memory as long as the bag exists."""
MAX_TEXTS_BYTES: Final = 32 << 20
"""All texts of one table of a `.db3`: names, definitions, the QoS that publishers offer."""
MAX_DEFINITION_BYTES: Final = 1 << 20
"""A longer definition is not used; one byte more of it is kept, so that this shows."""
MAX_CHUNK_DECLARATIONS: Final = 20_000
"""Schemas and channels in one chunk; a writer declares each once."""
MESSAGE_BYTES: Final = 64
"""Memory that a message takes besides its payload while its file is scanned."""
MAX_CHUNKS: Final = 150_000
"""Each takes memory as long as queries read its file."""
MAX_COMPRESSION_RATIO: Final = 100
"""Nothing large that a robot records compresses better than this."""
_ALWAYS_ALLOWED: Final = 32 << 20


class SizeLimit(NamedTuple):
    """How large a chunk or a message may be, decompressed.

    Attributes:
        max_bytes: a larger one is not read.
        take_turn: is called before more than `LARGE_BYTES` are in memory.
    """

    max_bytes: int
    take_turn: Callable[[], None] = lambda: None

    def require(self, what: str, size: int) -> None:
        """Checks that something is not larger.

        Raises:
            UnreadableError: it is.
        """
        if size > self.max_bytes:
            raise UnreadableError(self.refusal(what))

    def refusal(self, what: str) -> str:
        """Returns the sentence on something that is larger."""
        return (
            f"{what} is larger than the {self.max_bytes >> 20} MiB allowed; if that is right,"
            " raise reader.max_chunk_mb"
        )


def max_decompressed_bytes(compressed: int) -> int:
    """Returns how many bytes these compressed bytes may decompress to at most."""
    return _ALWAYS_ALLOWED + MAX_COMPRESSION_RATIO * compressed
