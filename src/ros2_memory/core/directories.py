"""Directories in which others may put anything: links to elsewhere, or a thousand levels.

Nothing here follows a symbolic link below the directory that it is given, and nothing recurses:
a tree may be deeper than a program's stack, and than the files that it may hold open.
"""

from __future__ import annotations

import errno
import os
import stat
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator

LINK_NOT_FOLLOWED: Final = "it lies behind a symbolic link, which is not followed"

_HERE: Final = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC
# Passing through a directory takes no right to list it, such as /home may not give.
_THROUGH: Final = os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC


def walk(root: Path) -> Iterator[tuple[str, list[os.DirEntry[str]]]]:
    """A directory and each below it, with their entries; what cannot be listed is left out.

    The root may be a link; none below it is followed.
    """
    waiting = [os.fspath(root)]
    while waiting:
        path = waiting.pop()
        with suppress(OSError):
            with os.scandir(path) as listing:
                entries = list(listing)
            waiting.extend(each.path for each in entries if each.is_dir(follow_symlinks=False))
            yield path, entries


def files_below(root: Path, suffix: str) -> Iterator[Path]:
    """Every file below a directory whose name ends so, also a link to one, in no order."""
    for path, entries in walk(root):
        for each in entries:
            if each.name.endswith(suffix) and each.is_file():
                yield Path(path, each.name)


def remove(root: Path) -> None:
    """Deletes a directory and all below it, as far as that can be deleted."""
    folders = []
    for path, entries in walk(root):
        folders.append(path)
        for each in entries:
            if not each.is_dir(follow_symlinks=False):
                with suppress(OSError):
                    Path(each.path).unlink()
    for path in reversed(folders):
        with suppress(OSError):
            Path(path).rmdir()


@contextmanager
def opened(root: Path, path: Path) -> Iterator[int]:
    """A descriptor of a directory that is the root or below it, found without following a link.

    Raises:
        OSError: it cannot be opened; `LINK_NOT_FOLLOWED` where it lies behind a link.
    """
    parts = path.relative_to(root).parts
    descriptor = os.open(root, _THROUGH if parts else _HERE)
    try:
        for nth, name in enumerate(parts, start=1):
            flags = (_HERE if nth == len(parts) else _THROUGH) | os.O_NOFOLLOW
            try:
                inner = os.open(name, flags, dir_fd=descriptor)
            except NotADirectoryError as error:
                raise _told(error, name, descriptor, path) from error
            os.close(descriptor)
            descriptor = inner
        yield descriptor
    finally:
        os.close(descriptor)


def make(root: Path, path: Path) -> None:
    """Makes a directory below the root, and those between.

    Raises:
        OSError: it cannot be made; `LINK_NOT_FOLLOWED` where it would lie behind a link.
    """
    parts = path.relative_to(root).parts
    for depth in range(1, len(parts) + 1):
        folder = root.joinpath(*parts[:depth])
        folder.mkdir(exist_ok=True)
        if folder.is_symlink():
            raise OSError(errno.ELOOP, LINK_NOT_FOLLOWED, str(path))


def link_in(path: Path) -> Path | None:
    """The first symbolic link in a path, itself included; None without one."""
    whole = path.absolute()
    return next((each for each in (*reversed(whole.parents), whole) if each.is_symlink()), None)


def _told(error: OSError, name: str, directory: int, path: Path) -> OSError:
    try:
        mode = os.stat(name, dir_fd=directory, follow_symlinks=False).st_mode
    except OSError:
        return error
    return OSError(errno.ELOOP, LINK_NOT_FOLLOWED, str(path)) if stat.S_ISLNK(mode) else error
