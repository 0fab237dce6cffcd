"""Writes files that survive a power cut, and reads files that anybody may have written.

The content of a file is on the disk once the file was flushed, and its name once the directory was.
No symbolic link is followed, so all files lie in the bag directory itself.
"""

from __future__ import annotations

import errno
import fcntl
import os
import stat
import time
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, BinaryIO, Final

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from pathlib import Path

MAX_SMALL_FILE: Final = 1 << 20

# O_NONBLOCK: opening a FIFO would wait for its other end.
_COMMON: Final = os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
_REPLACE: Final = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | _COMMON
_APPEND: Final = os.O_RDWR | os.O_APPEND | _COMMON
_READ: Final = os.O_RDONLY | _COMMON
_WITHOUT_LOCKS: Final = frozenset({errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP})
"""Errors of mounts that have no locks, as NFS may be."""
_LOCK_WAIT_S: Final = 2.0
_POLL_S: Final = 0.01


def write_durably(target: Path, text: str, *, mode: int | None = None) -> None:
    """Replaces a file atomically: a reader sees the old content, or all of the new text.

    `mode` sets the file's permissions; None leaves them to the umask.

    Raises:
        OSError: the file cannot be written, and the old one remains; or it was replaced, and a
            power cut may undo that.
    """
    write_all_durably({target: text}, mode=mode)


def write_all_durably(texts: Mapping[Path, str], *, mode: int | None = None) -> None:
    """Replaces files one after the other, each atomically, once all texts are on the disk.

    So a full disk leaves all files as they are; a power cut may come between two of them.

    Raises:
        OSError: as by `write_durably`; `filename` names the file.
    """
    temporary = {target: target.with_name(f".{target.name}.tmp") for target in texts}
    try:
        for target, beside in temporary.items():
            descriptor = os.open(beside, _REPLACE, 0o666)
            with os.fdopen(descriptor, "w", encoding="utf-8") as stream:
                if mode is not None:
                    os.fchmod(descriptor, mode)
                stream.write(texts[target])
                stream.flush()
                os.fsync(descriptor)
        for target, beside in temporary.items():
            beside.replace(target)
            flush(target.parent)
    except OSError as error:
        error.filename = str(target)  # the error of a full disk has no file name
        for beside in temporary.values():
            with suppress(OSError):
                beside.unlink(missing_ok=True)
        raise


def append_durably(target: Path, text: str) -> None:
    """Appends lines to a regular file, which is made if it is missing, and flushes it.

    Raises:
        OSError: the lines cannot be written, and none is appended.
    """
    with locked(target, os.O_CREAT) as descriptor:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise OSError(errno.EINVAL, "it is not a regular file", str(target))
        if not status.st_size:
            flush(target.parent)
        append_lines(descriptor, text)


@contextmanager
def locked(path: Path, flags: int = 0) -> Iterator[int]:
    """Yields a descriptor of a file, for reading and appending. Other writers wait meanwhile.

    On a mount without locks they do not: what is appended is whole all the same.

    Raises:
        OSError: the file cannot be opened, or another writer holds the lock for long.
    """
    give_up = time.monotonic() + _LOCK_WAIT_S
    while True:
        descriptor = os.open(path, _APPEND | flags, 0o666)
        try:
            # Another writer may have replaced the file before this one locked it.
            if _lock(descriptor) and is_open_file(path, descriptor):
                yield descriptor
                return
        finally:
            os.close(descriptor)
        if time.monotonic() >= give_up:
            raise BlockingIOError(f"another program has locked {path}")
        time.sleep(_POLL_S)


def _lock(descriptor: int) -> bool:
    """Returns whether a file was locked, or lies on a mount without locks."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in _WITHOUT_LOCKS:
            raise
    return True


def append_lines(descriptor: int, text: str) -> None:
    """Appends all lines or none to an open file, and flushes it.

    A last line that a crash cut short is ended first, so that it spoils no other line. The
    descriptor must be open for reading and appending.

    Raises:
        OSError: the lines cannot be written.
    """
    size = os.fstat(descriptor).st_size
    is_cut = size and os.pread(descriptor, 1, size - 1) != b"\n"
    data = memoryview((f"\n{text}" if is_cut else text).encode())
    try:
        while data:
            data = data[os.write(descriptor, data) :]
        os.fsync(descriptor)
    except OSError:
        with suppress(OSError):
            os.ftruncate(descriptor, size)
        raise


def open_plain(path: Path | str, dir_fd: int | None = None) -> BinaryIO:
    """Opens a regular file for reading. Never waits, and follows no link.

    Raises:
        OSError: the file cannot be opened.
        ValueError: it is not a regular file.
    """
    descriptor = os.open(path, _READ, dir_fd=dir_fd)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise ValueError("it is not a regular file")
    return os.fdopen(descriptor, "rb")


def read_small_file(path: Path | str, most_bytes: int = MAX_SMALL_FILE) -> str:
    """Returns the text of a regular file of at most `most_bytes`. Never waits.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is not a regular file, not UTF-8, or too large.
    """
    with open_plain(path) as stream:
        data = stream.read(most_bytes + 1)
    if len(data) > most_bytes:
        raise ValueError(f"it is larger than {most_bytes} bytes")
    return data.decode("utf-8")


def is_open_file(path: Path, descriptor: int) -> bool:
    """Whether a path still names an open file; True if the disk does not tell."""
    try:
        return os.path.samestat(path.lstat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False
    except OSError:
        return True


def flush(path: Path) -> None:
    """Waits until the content of a file, or the names in a directory, are on the disk.

    Raises:
        OSError: the flush fails.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def flush_bags(directory: Path, names: Iterable[str]) -> list[str]:
    """Flushes closed splits, then their directory. Splits that were deleted are left out.

    Returns:
        A sentence for each file that could not be flushed.
    """
    faults: list[str] = []
    for path in [*(directory / name for name in names), directory]:
        try:
            flush(path)
        except FileNotFoundError:
            continue
        except OSError as error:
            faults.append(f"{path} may not survive a power cut: {error.strerror or error}")
    return faults
