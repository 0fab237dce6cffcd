"""Deletes bags and the files that belong to them, and never anything else.

Every name is looked up below the bag directory without following a link, and a bag file is deleted
only while it is the very file that was judged. A recording's directory is deleted when it is empty.
"""

from __future__ import annotations

import errno
import os
import re
import stat
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.layout import RECORDING_FILES, bag_kind
from ros2_memory.core import directories
from ros2_memory.core.model import SQLITE

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

REPAIR_SUFFIX: Final = ".repair"
_LEFTOVER: Final = re.compile(
    r"\.(?P<target>.+)\.tmp|\.(?P<bag>.+)" + re.escape(REPAIR_SUFFIX), re.DOTALL
)
_JOURNALS: Final = ("-wal", "-shm", "-journal")
_JOURNAL: Final = re.compile(rf".+\.db3({'|'.join(_JOURNALS)})", re.IGNORECASE | re.DOTALL)


def repair_name(name: str) -> str:
    """Returns the name of a bag file while it is being repaired, which the index ignores."""
    return f".{name}{REPAIR_SUFFIX}"


@contextmanager
def new_file_beside(path: Path) -> Iterator[Path]:
    """Yields a path beside a bag for its new content. No file has that path after the block.

    Raises:
        OSError: the file that an interrupted block left there cannot be deleted.
    """
    new = path.with_name(repair_name(path.name))
    new.unlink(missing_ok=True)
    try:
        yield new
    finally:
        with suppress(OSError):
            new.unlink(missing_ok=True)


def is_journal(name: str) -> bool:
    """Whether a file is one that SQLite writes beside a bag."""
    return _JOURNAL.fullmatch(name) is not None


def remove_bag(root: Path, path: Path, inode: tuple[int, int]) -> int:
    """Deletes one bag file below the root, and a sqlite bag's journals; returns its size in bytes.

    `inode` are the device and inode number that the file must have.

    Raises:
        FileNotFoundError: it is not there any more.
        OSError: it cannot be deleted, or is not the file that was looked at.
    """
    with directories.opened(root, path.parent) as directory:
        status = os.stat(path.name, dir_fd=directory, follow_symlinks=False)
        if not stat.S_ISREG(status.st_mode) or (status.st_dev, status.st_ino) != inode:
            reason = "it is not the file that was looked at"
            raise OSError(errno.ESTALE, reason, str(path))
        os.unlink(path.name, dir_fd=directory)
        if path.suffix.lower() == SQLITE:
            for suffix in _JOURNALS:
                with suppress(FileNotFoundError, IsADirectoryError):
                    os.unlink(path.name + suffix, dir_fd=directory)
        return status.st_size


def remove_emptied(root: Path, recording: Path) -> None:
    """Deletes the directory of a recording that has no bag any more.

    An unknown file stays, and then the directory does, too.

    Raises:
        OSError: a file or the directory cannot be deleted.
    """
    if recording == root:
        return
    with suppress(FileNotFoundError):
        with directories.opened(root, recording) as directory:
            with os.scandir(directory) as listing:
                entries = list(listing)
            if any(bag_kind(entry.name) for entry in entries):
                return
            sidecars = [entry.name for entry in entries if _is_sidecar(entry)]
            for name in sidecars:
                os.unlink(name, dir_fd=directory)
            if len(entries) > len(sidecars):
                return
        with directories.opened(root, recording.parent) as above:
            os.rmdir(recording.name, dir_fd=above)


def sidecar_bytes(recording: Path) -> int:
    """Returns the bytes of the files that are deleted with a recording's last bag."""
    size = 0
    with suppress(OSError), os.scandir(recording) as entries:
        for entry in entries:
            if _is_sidecar(entry):
                size += entry.stat(follow_symlinks=False).st_size
    return size


def _is_sidecar(entry: os.DirEntry[str]) -> bool:
    """Whether an entry of a recording is a file that has no meaning without its bags.

    Those are the recorder's sidecars, and unfinished files that a crash left.
    """
    leftover = _LEFTOVER.fullmatch(entry.name)
    if leftover is None:
        is_known = entry.name in RECORDING_FILES or is_journal(entry.name)
    else:
        is_sidecar = leftover["target"] in RECORDING_FILES
        is_known = is_sidecar or bag_kind(leftover["bag"] or "") is not None
    return is_known and entry.is_file(follow_symlinks=False)


def size_of(path: Path) -> int:
    """Returns the size of a regular file in bytes, or 0 if it is none or cannot be looked at."""
    with suppress(OSError):
        status = path.lstat()
        return status.st_size if stat.S_ISREG(status.st_mode) else 0
    return 0
