"""Small files that are replaced at once and survive a power cut, and closed bags that do.

A file is on the disk when it was flushed itself, and its name when its directory was.
"""

from __future__ import annotations

import errno
import os
import stat
from contextlib import suppress
from typing import TYPE_CHECKING, BinaryIO, Final

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

MAX_SMALL_FILE: Final = 1 << 20

# Never through a symbolic link: what is written or read lies in the bag directory itself.
_ANEW: Final = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC | os.O_NOFOLLOW
_AT_THE_END: Final = (
    os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOFOLLOW
)
_AS_IT_IS: Final = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOFOLLOW


def write_durably(target: Path, text: str) -> None:
    """Replaces the file at once: a reader sees what was there, or all of the new text.

    Raises:
        OSError: it cannot be written; what was there stands.
    """
    write_all_durably({target: text})


def write_all_durably(texts: Mapping[Path, str]) -> None:
    """Replaces the files one after the other, each at once, and none before all texts are on disk.

    So a full disk leaves all of them as they are; a power cut may come between two of them.

    Raises:
        OSError: a text cannot be written, and `filename` says which.
    """
    waiting = {target: target.with_name(f".{target.name}.tmp") for target in texts}
    try:
        for target, beside in waiting.items():
            with os.fdopen(os.open(beside, _ANEW, 0o666), "w", encoding="utf-8") as stream:
                stream.write(texts[target])
                stream.flush()
                os.fsync(stream.fileno())
        for target, beside in waiting.items():
            beside.replace(target)
            flush(target.parent)
    except OSError:
        for beside in waiting.values():
            with suppress(OSError):
                beside.unlink(missing_ok=True)
        raise


def append_durably(target: Path, text: str) -> None:
    """Adds text to a regular file, which is made where there is none; on the disk on return.

    Raises:
        OSError: it cannot be written; a part of the text may have been.
    """
    descriptor = os.open(target, _AT_THE_END, 0o666)
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise OSError(errno.EINVAL, "it is not a regular file", str(target))
        data = memoryview(text.encode())
        while data:
            data = data[os.write(descriptor, data) :]
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
    if not status.st_size:
        flush(target.parent)


def own_folder(folder: Path) -> None:
    """Makes a folder of this program where there is none, and none above it.

    Raises:
        OSError: it cannot be made, or a symbolic link stands there, which is not followed.
    """
    folder.mkdir(exist_ok=True)
    if folder.is_symlink():
        reason = f"{folder.name} is a symbolic link, which is not followed"
        raise OSError(errno.ELOOP, reason, str(folder))


def open_plain(path: Path | str, dir_fd: int | None = None) -> BinaryIO:
    """Opens a regular file for reading. Never waits, as opening a FIFO would; follows no link.

    Raises:
        OSError: it cannot be opened.
        ValueError: it is no regular file.
    """
    descriptor = os.open(path, _AS_IT_IS, dir_fd=dir_fd)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise ValueError("it is not a regular file")
    return os.fdopen(descriptor, "rb")


def read_small_file(path: Path | str) -> str:
    """The text of a small regular file. Never waits, as opening a FIFO would.

    Raises:
        OSError: it cannot be read.
        ValueError: it is no regular file, no text, or larger than `MAX_SMALL_FILE`.
    """
    with open_plain(path) as stream:
        data = stream.read(MAX_SMALL_FILE + 1)
    if len(data) > MAX_SMALL_FILE:
        raise ValueError(f"it is larger than {MAX_SMALL_FILE} bytes")
    return data.decode("utf-8")


def flush(path: Path) -> None:
    """Waits until a file's content, or a directory's names, are on the disk.

    Raises:
        OSError: they are not.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def flush_bags(directory: Path, names: Iterable[str]) -> list[str]:
    """Flushes closed splits and then the directory that names them.

    Returns a sentence for each that could not be flushed; one that has been deleted is none.
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
