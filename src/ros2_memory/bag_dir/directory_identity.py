"""Whether a directory is the very one that was seen before, and not another of its name.

An inode number alone does not prove that: ext4 gives a directory that was deleted and restored its
number again. Its generation (FS_IOC_GETVERSION) does: ext4, XFS, Btrfs and F2FS choose one anew for
each inode. On other file systems the number has to do. Clocks play no part.
"""

from __future__ import annotations

import fcntl
import os
import stat
import struct
from functools import lru_cache
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from pathlib import Path

_GETVERSION: Final = 0x80087601  # _IOR('v', 1, long), linux/fs.h
_MOST_KNOWN: Final = 1 << 14
_GENERATION: Final = struct.Struct("=I4x")  # the first 4 bytes of that long, on every architecture


class Identity(NamedTuple):
    """An inode and its generation; `generation` is None where the file system has none."""

    inode: int
    generation: int | None = None

    def matches(self, listed: Identity) -> bool:
        """Returns whether this is the directory that was listed under an identity."""
        return self.inode == listed.inode and listed.generation in {None, self.generation}


def identity_of(directory: Path | str) -> Identity | None:
    """Returns the identity of a directory; None where there is none of that name, or a link.

    Raises:
        OSError: the directory cannot be opened.
    """
    flags = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC | os.O_NOFOLLOW
    try:
        if stat.S_ISLNK(os.lstat(directory).st_mode):
            return None
        descriptor = os.open(directory, flags)
    except (FileNotFoundError, NotADirectoryError):
        return None
    try:
        return identity_at(descriptor)
    finally:
        os.close(descriptor)


def known_identity(directory: str) -> Identity | None:
    """Returns the identity of a directory as `identity_of` does; None if it cannot be opened.

    It is opened again only after its entries or its attributes changed.
    """
    try:
        status = os.stat(directory, follow_symlinks=False)  # noqa: PTH116 - called for many
        return _identity_as_of(directory, status.st_ino, status.st_ctime_ns)
    except OSError:
        return None


@lru_cache(maxsize=_MOST_KNOWN)
def _identity_as_of(directory: str, _inode: int, _ctime_ns: int) -> Identity | None:
    return identity_of(directory)


def identity_at(descriptor: int) -> Identity:
    """Returns the identity of an open directory."""
    inode = os.fstat(descriptor).st_ino
    try:
        (generation,) = _GENERATION.unpack(fcntl.ioctl(descriptor, _GETVERSION, bytes(8)))
    except OSError:  # such as tmpfs
        return Identity(inode)
    return Identity(inode, int(generation))
