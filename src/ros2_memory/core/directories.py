"""Directories in which others may put anything: links to somewhere else, or a thousand levels.

Nothing here follows a symbolic link below the directory that it is given, and nothing recurses: a
tree may be deeper than the stack, or than the number of files that a process may hold open.
"""

from __future__ import annotations

import errno
import fcntl
import os
import stat
import struct
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

LINK_NOT_FOLLOWED: Final = "it lies behind a symbolic link, which is not followed"

_LISTABLE: Final = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC
# A path may lead through directories that must not be listed, such as /home.
_PASSABLE: Final = os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC
_GETVERSION: Final = 0x80087601  # _IOR('v', 1, long), linux/fs.h
_GENERATION: Final = struct.Struct("=I4x")  # the first 4 bytes of that long, on every architecture
_MOST_KNOWN: Final = 1 << 14


class Identity(NamedTuple):
    """Shows whether a directory is the very one that was seen before, and not another of its name.

    An inode number alone does not: ext4 gives a directory that was deleted and restored its number
    again. Its generation (FS_IOC_GETVERSION) does: ext4, XFS, Btrfs and F2FS choose a new one for
    each inode. It is None on other file systems, where the number has to do. Clocks play no part.
    """

    inode: int
    generation: int | None = None

    def matches(self, listed: Identity) -> bool:
        """Returns whether this is the directory that was listed under an identity."""
        return self.inode == listed.inode and listed.generation in {None, self.generation}


def identity_of(directory: Path | str) -> Identity | None:
    """Returns the identity of a directory; None if there is none of that name, or a link.

    Raises:
        OSError: the directory cannot be opened.
    """
    try:
        if stat.S_ISLNK(os.lstat(directory).st_mode):
            return None
        descriptor = os.open(directory, _LISTABLE | os.O_NOFOLLOW)
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


def mode_of(path: Path) -> int:
    """Returns `st_mode` of a path, of a symbolic link its own; 0 where there is nothing.

    Not by `Path.exists`, which takes what the disk does not tell for missing since Python 3.14.

    Raises:
        OSError: the disk does not tell.
    """
    try:
        return path.lstat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return 0


def is_folder(path: Path) -> bool:
    """Returns whether it is a directory, and not a link to one.

    Raises:
        OSError: the disk does not tell.
    """
    return stat.S_ISDIR(mode_of(path))


def walk(
    root: Path, on_error: Callable[[OSError], object] = lambda _: None
) -> Iterator[tuple[str, list[os.DirEntry[str]]]]:
    """Yields a directory and each below it, with their entries; skips what cannot be listed.

    The root may be a link; none below it is followed.
    """
    waiting = [os.fspath(root)]
    while waiting:
        path = waiting.pop()
        try:
            with os.scandir(path) as listing:
                entries = list(listing)
            waiting.extend(entry.path for entry in entries if entry.is_dir(follow_symlinks=False))
        except OSError as error:
            on_error(error)
        else:
            yield path, entries


def files_below(root: Path, suffix: str) -> Iterator[Path]:
    """Yields the files below a directory with a suffix, links to files included, in no order."""
    for path, entries in walk(root):
        for entry in entries:
            if entry.name.endswith(suffix) and entry.is_file():
                yield Path(path, entry.name)


def remove(root: Path) -> None:
    """Deletes a directory and all below it, as far as possible."""
    folders = []
    for path, entries in walk(root):
        folders.append(path)
        for entry in entries:
            if not entry.is_dir(follow_symlinks=False):
                with suppress(OSError):
                    Path(entry.path).unlink()
    for path in reversed(folders):
        with suppress(OSError):
            Path(path).rmdir()


@contextmanager
def opened(root: Path, path: Path) -> Iterator[int]:
    """Yields a descriptor of the root or a directory below it, opened without following a link.

    Raises:
        OSError: it cannot be opened; `LINK_NOT_FOLLOWED` where it lies behind a link.
    """
    parts = path.relative_to(root).parts
    descriptor = os.open(root, _PASSABLE if parts else _LISTABLE)
    try:
        for nth, name in enumerate(parts, start=1):
            flags = (_LISTABLE if nth == len(parts) else _PASSABLE) | os.O_NOFOLLOW
            try:
                inner = os.open(name, flags, dir_fd=descriptor)
            except NotADirectoryError as error:
                raise _link_error(error, name, descriptor, path) from error
            os.close(descriptor)
            descriptor = inner
        yield descriptor
    finally:
        os.close(descriptor)


def make(root: Path, path: Path) -> None:
    """Makes a directory below the root, and its parents, but not the root, a disk of its own maybe.

    Raises:
        OSError: it cannot be made, or would lie behind a link.
    """
    parts = path.relative_to(root).parts
    for depth in range(1, len(parts) + 1):
        folder = root.joinpath(*parts[:depth])
        folder.mkdir(exist_ok=True)
        if folder.is_symlink():
            reason = f"{folder.name} is a symbolic link, which is not followed"
            raise OSError(errno.ELOOP, reason, str(path))


def link_in(path: Path) -> Path | None:
    """Returns the first symbolic link in a path, itself included; None without one."""
    whole = path.absolute()
    return next((part for part in (*reversed(whole.parents), whole) if part.is_symlink()), None)


def _link_error(error: OSError, name: str, directory: int, path: Path) -> OSError:
    """Returns `LINK_NOT_FOLLOWED` if the name is a link, else the error."""
    try:
        mode = os.stat(name, dir_fd=directory, follow_symlinks=False).st_mode
    except OSError:
        return error
    return OSError(errno.ELOOP, LINK_NOT_FOLLOWED, str(path)) if stat.S_ISLNK(mode) else error
