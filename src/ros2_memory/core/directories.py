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
    """Tells a directory from another one that later has its name.

    An inode number alone does not: ext4 gives a directory that was deleted and restored its number
    again. Its generation (FS_IOC_GETVERSION) does: ext4, XFS, Btrfs and F2FS choose a new one for
    each inode. It is None on other file systems, where the number has to do. Clocks play no part.
    """

    inode: int
    generation: int | None = None

    def matches(self, listed: Identity) -> bool:
        """Returns whether this is the directory that was listed with an identity."""
        return self.inode == listed.inode and listed.generation in {None, self.generation}


def identity_of(directory: Path | str) -> Identity | None:
    """Returns the identity of a directory; None if it is a link, or missing.

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
        return _identity_at(descriptor)
    finally:
        os.close(descriptor)


def known_identity(directory: str) -> Identity | None:
    """Returns `identity_of` a directory from a cache; None if the directory cannot be opened.

    The directory is opened again after its entries or its attributes changed.
    """
    try:
        status = os.stat(directory, follow_symlinks=False)  # noqa: PTH116 - called for many
        return _identity_as_of(directory, status.st_ino, status.st_ctime_ns)
    except OSError:
        return None


@lru_cache(maxsize=_MOST_KNOWN)
def _identity_as_of(directory: str, _inode: int, _ctime_ns: int) -> Identity | None:
    return identity_of(directory)


def _identity_at(descriptor: int) -> Identity:
    """Returns the identity of an open directory."""
    inode = os.fstat(descriptor).st_ino
    try:
        (generation,) = _GENERATION.unpack(fcntl.ioctl(descriptor, _GETVERSION, bytes(8)))
    except OSError:  # such as tmpfs
        return Identity(inode)
    return Identity(inode, int(generation))


def mode_of(path: Path) -> int:
    """Returns `st_mode` of a path without following a link; 0 if nothing is there.

    `Path.exists` would not do: since Python 3.14 it takes a disk that fails for a missing file.

    Raises:
        OSError: the disk fails.
    """
    try:
        return path.lstat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return 0


def is_folder(path: Path) -> bool:
    """Returns whether a path is a directory, and not a link to one.

    Raises:
        OSError: the disk fails.
    """
    return stat.S_ISDIR(mode_of(path))


def walk(
    root: Path, on_error: Callable[[OSError], object] = lambda _: None
) -> Iterator[tuple[str, list[os.DirEntry[str]]]]:
    """Yields a directory and every directory below it, each with its entries.

    `on_error` is called for a directory that cannot be listed. The root may be a link; no link
    below it is followed.
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
    """Yields the files below a directory whose names end so, also links to files, in no order."""
    for path, entries in walk(root):
        for entry in entries:
            if entry.name.endswith(suffix) and entry.is_file():
                yield Path(path, entry.name)


def remove(root: Path) -> None:
    """Deletes a directory and everything below it, as far as possible."""
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
    """Opens the root or a directory below it without following a link; yields the descriptor.

    Raises:
        OSError: the directory cannot be opened; `LINK_NOT_FOLLOWED` if it lies behind a link.
    """
    parts = path.relative_to(root).parts
    descriptor = os.open(root, _PASSABLE if parts else _LISTABLE)
    try:
        for depth, name in enumerate(parts, start=1):
            flags = (_LISTABLE if depth == len(parts) else _PASSABLE) | os.O_NOFOLLOW
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
    """Makes a directory below the root, and its parents; not the root, which may be a mount point.

    Raises:
        OSError: a directory cannot be made, or would lie behind a link.
    """
    folder = root
    for name in path.relative_to(root).parts:
        folder /= name
        folder.mkdir(exist_ok=True)
        if folder.is_symlink():
            reason = f"{folder.name} is a symbolic link, which is not followed"
            raise OSError(errno.ELOOP, reason, str(path))


def link_in(path: Path) -> Path | None:
    """Returns the first symbolic link on the way to a path, or the path if it is one; else None."""
    whole = path.absolute()
    return next((part for part in (*reversed(whole.parents), whole) if part.is_symlink()), None)


def _link_error(error: OSError, name: str, directory: int, path: Path) -> OSError:
    """Returns an error that says `LINK_NOT_FOLLOWED` if the name is a link; else `error`."""
    try:
        mode = os.stat(name, dir_fd=directory, follow_symlinks=False).st_mode
    except OSError:
        return error
    return OSError(errno.ELOOP, LINK_NOT_FOLLOWED, str(path)) if stat.S_ISLNK(mode) else error
