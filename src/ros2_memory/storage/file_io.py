"""Opens files on disk for bounded reads at any offset, and identifies their content."""

from __future__ import annotations

import errno
import os
import stat
from contextlib import suppress
from typing import TYPE_CHECKING, Final, NamedTuple, Self

from ros2_memory.storage.errors import UnreadableError

if TYPE_CHECKING:
    from pathlib import Path

EMPTY_FILE: Final = "empty file: nothing had reached the disk"
_AT_ONCE_BYTES: Final = 1 << 20
"""A file up to this size can be read at once: one of a minute has some two hundred pieces."""
LINK: Final = "a symbolic link, which is not followed"


def open_regular(path: Path) -> int:
    """Returns a descriptor of a regular file; a symbolic link is not followed.

    Raises:
        OSError: it cannot be opened.
        UnreadableError: it is not a regular file.
    """
    try:
        # O_NONBLOCK: opening a pipe would wait for a writer.
        flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOFOLLOW
        descriptor = os.open(path, flags)
    except OSError as error:
        if error.errno == errno.ELOOP and path.is_symlink():
            raise UnreadableError(LINK) from None
        raise
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise UnreadableError("not a regular file")
    return descriptor


class FileKey(NamedTuple):
    """Identifies the content of a file: each write into it changes its ctime."""

    path: str
    size: int
    mtime_ns: int
    inode: int
    ctime_ns: int


class OpenFile:
    """A file that is open for reads at any offset; a context manager.

    It stays readable after the file is deleted, until it is closed. Safe to use from several
    threads at once.

    Args:
        path: the file.
        at_once: whether most of the file will be read, so that a small file is read at once.

    Raises:
        OSError: it cannot be opened.
        UnreadableError: it is not a regular file.
    """

    def __init__(self, path: Path, *, at_once: bool = False) -> None:
        self._descriptor = open_regular(path)
        status = os.fstat(self._descriptor)
        self.size = status.st_size
        self.key = FileKey(
            str(path), status.st_size, status.st_mtime_ns, status.st_ino, status.st_ctime_ns
        )
        self._whole = b""
        if at_once and self.size <= _AT_ONCE_BYTES:
            with suppress(OSError):  # `read` raises it for the part that is asked for
                self._whole = os.pread(self._descriptor, self.size, 0)

    def __enter__(self) -> Self:
        """Returns the open file."""
        return self

    def __exit__(self, *_: object) -> None:
        """Closes it."""
        os.close(self._descriptor)

    def read(self, offset: int, length: int) -> bytes:
        """Returns exactly `length` bytes from `offset`.

        Raises:
            UnreadableError: the file has fewer; this is checked before anything is allocated.
        """
        if offset < 0 or length < 0 or offset + length > self.size:
            raise UnreadableError("damaged: it refers to bytes past its end")
        if len(self._whole) == self.size:
            return self._whole[offset : offset + length]
        pieces: list[bytes] = []
        missing = length
        while missing:
            piece = os.pread(self._descriptor, missing, offset)
            if not piece:
                raise UnreadableError("it became shorter while it was being read")
            pieces.append(piece)
            offset += len(piece)
            missing -= len(piece)
        return b"".join(pieces)
