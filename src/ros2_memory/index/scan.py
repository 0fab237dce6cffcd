"""Walking the bag directory: which bag files lie there, and which may have changed.

A directory is listed again only when its mtime says that names came or went. That says nothing of
what was written *into* a file, so the caller names the files that it wants looked at every time.
"""

from __future__ import annotations

import errno
import os
import stat
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.layout import (
    BAG_KINDS,
    HANDOVER_FILE,
    METADATA_FILE,
    MOMENTS_FOLDER,
    bag_kind,
)
from ros2_memory.core.model import SetAside
from ros2_memory.core.timebase import NS_PER_S, Ns

if TYPE_CHECKING:
    from collections.abc import Iterable

YOUNG_NS: Final[Ns] = 2 * NS_PER_S
"""Two changes within one tick of the file system share an mtime: a younger one proves nothing."""

LOST_AND_FOUND: Final = "lost+found"
"""Stands in the root of a file system, where only the system's administrator may look into it."""

_OTHER_DISK = (
    "the bag directory lies on another disk than before, and no bag lies there: the disk of the "
    "bags has been unmounted; they are found again when it is mounted"
)
_LINK = "a symbolic link, which is not followed: move or mount the bags into the bag directory"


def settled(mtime_ns: Ns, now: Ns) -> bool:
    """Whether a later change would have to show another mtime. One far in the future is settled."""
    return abs(now - mtime_ns) >= YOUNG_NS


class Stamp(NamedTuple):
    """How a file looked from outside.

    `sidecar_ns` is the mtime of the `handover.json` beside it, 0 without one: that file says which
    messages of this one count.
    """

    size: int
    mtime_ns: Ns
    ctime_ns: Ns
    inode: int
    sidecar_ns: Ns = 0

    @classmethod
    def of(cls, stat: os.stat_result, sidecar_ns: Ns = 0) -> Stamp:
        """The stamp in a stat result."""
        return cls(stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino, sidecar_ns)

    def shows(self, before: Stamp) -> bool:
        """Whether all but the ctime, which permissions change too, is as it was before."""
        return (self.size, self.mtime_ns, self.inode, self.sidecar_ns) == (
            before.size,
            before.mtime_ns,
            before.inode,
            before.sidecar_ns,
        )


@dataclass(frozen=True, slots=True)
class Walked:
    """What one walk found. A file's path is the text that `os.scandir` gives: it is met so often.

    `looked_at` has every bag file of the directories that were listed, and the watched ones; `gone`
    the ones that are known no more. `damaged` are directories that cannot be listed and bag names
    that are no files, `links` the symbolic links, neither in any order. With a `problem` the bag
    directory itself is not there, and everything in it is gone; or it cannot be listed at the
    moment, and everything in it counts as it did. `described` are the folders with a metadata.yaml.
    """

    looked_at: dict[str, Stamp]
    gone: set[str]
    damaged: list[SetAside]
    links: list[SetAside]
    problem: str | None = None
    described: list[str] = field(default_factory=list)


@dataclass(slots=True)
class _Folder:
    mtime_ns: Ns
    trusted: bool
    device: int = 0
    folders: list[str] = field(default_factory=list)
    files: list[str] = field(default_factory=list)
    inodes: list[int] = field(default_factory=list)
    linked: set[int] = field(default_factory=set)
    links: list[Path] = field(default_factory=list)
    odd: list[SetAside] = field(default_factory=list)
    sidecar_ns: Ns = 0
    described: bool = False


class Tree:
    """The directories under one root, as the last walk saw them.

    The root itself may be a symbolic link; inside it none is followed. Folders whose name begins
    with a dot are left out, and so is `lost+found`. Of the hard links of one file the first name
    alone is found, but for those in moments, which `KeptNames` weighs. Not for several threads at
    once.
    """

    def __init__(self, root: Path) -> None:
        self._root = str(root)
        self._folders: dict[str, _Folder] = {}
        self._device: int | None = None  # of the disk that bags were last found on
        self._moments = f"{self._root.rstrip('/')}/{MOMENTS_FOLDER}"
        self._second: set[str] = set()

    def walk(self, now: Ns, watched: Iterable[str]) -> Walked:
        """Looks for what is new, changed or gone since the last walk, and at the `watched` files.

        `now` tells which mtimes are too young to be trusted. Raises nothing: a directory that
        cannot be listed is part of the result, and what was known to lie in it counts as there.
        """
        before, self._folders = self._folders, {}
        walked = Walked({}, set(), [], [])
        fault = self._descend(before, now, walked)
        if fault is not None and not _is_gone(fault) and before:
            self._folders = before
            return Walked({}, set(), [], [], _problem(fault))
        problem = self._other_disk() if fault is None else _problem(fault)
        if problem is not None:
            self._folders = {}
            walked = Walked({}, set(), [], [], problem)
        for path, folder in before.items():
            after = self._folders.get(path)
            if after is not folder:
                walked.gone.update(set(folder.files).difference(after.files if after else ()))
        for file in watched:
            self._look(file, walked)
        self._leave_out_second_names(before, walked)
        return walked

    def _leave_out_second_names(self, before: dict[str, _Folder], walked: Walked) -> None:
        """Has each file found under one name: the others are gone, until the first one is."""
        if all(self._folders.get(path) is folder for path, folder in before.items()) and len(
            before
        ) == len(self._folders):
            second = self._second
        else:
            second = self._second_names()
        for path in second:
            walked.looked_at.pop(path, None)
        walked.gone.update(second - self._second)
        for path in self._second - second - walked.gone:
            self._look(path, walked)
        self._second = second

    def _second_names(self) -> set[str]:
        """All but the first name of each file that has several outside of moments."""
        folders = [
            folder
            for path, folder in self._folders.items()
            if path != self._moments and not path.startswith(f"{self._moments}/")
        ]
        linked = {(folder.device, inode) for folder in folders for inode in folder.linked}
        if not linked:
            return set()
        names: dict[tuple[int, int], list[str]] = {}
        for folder in folders:
            for path, inode in zip(folder.files, folder.inodes, strict=True):
                if (folder.device, inode) in linked:
                    names.setdefault((folder.device, inode), []).append(path)
        return {path for each in names.values() for path in sorted(each, key=_outermost)[1:]}

    def distrust(self, path: str) -> None:
        """Has the folder of a file listed again in the next walk, whatever its mtime says."""
        folder = self._folders.get(_folder_of(path))
        if folder is not None:
            folder.trusted = False

    def _other_disk(self) -> str | None:
        """What to say where the root lies on another disk than bags were found on, and has none.

        That is how a mount point looks below the disk that was mounted there.
        """
        device = self._folders[self._root].device
        if any(folder.files for folder in self._folders.values()):
            self._device = device
        return None if self._device in {None, device} else _OTHER_DISK

    def _descend(self, before: dict[str, _Folder], now: Ns, walked: Walked) -> OSError | None:
        """Visits every folder; gives what is wrong where the root cannot be listed."""
        waiting = [self._root]
        while waiting:
            path = waiting.pop()
            try:
                is_root = path == self._root
                folder = _visit(path, before.get(path), now, walked.looked_at, is_root=is_root)
            except OSError as error:
                if path == self._root:
                    return error
                # A folder that went since its parent was listed changes that parent's mtime.
                if _is_gone(error):
                    continue
                reason = f"the directory cannot be listed: {error.strerror or error}"
                walked.damaged.append(SetAside(Path(path), reason))
                if path not in before:
                    continue
                # What was there is not gone because the disk fails.
                folder = replace(before[path], trusted=False)
            self._folders[path] = folder
            waiting.extend(folder.folders)
            if folder.described:
                walked.described.append(path)
            walked.damaged.extend(folder.odd)
            walked.links.extend(
                SetAside(link, _LINK)
                for link in folder.links
                if bag_kind(link.name) or _is_folder(link)
            )
        return None

    def _look(self, path: str, walked: Walked) -> None:
        if path in walked.looked_at or path in walked.gone:
            return
        folder = self._folders.get(_folder_of(path))
        try:
            walked.looked_at[path] = Stamp.of(os.lstat(path), folder.sidecar_ns if folder else 0)
        except OSError as error:
            # Its folder looks as before, and may soon look the same with the file back in it.
            if _is_gone(error):
                walked.gone.add(path)
            self.distrust(path)


def _visit(
    path: str, known: _Folder | None, now: Ns, looked_at: dict[str, Stamp], *, is_root: bool
) -> _Folder:
    """The folder as it is known where nothing came or went; otherwise as it is listed.

    Its mtime is taken first: what changes during the listing is then found by the next walk. Only
    the root may be a link: one that took a folder's place since that was found is none.
    """
    status = os.stat(path, follow_symlinks=is_root)  # noqa: PTH116 - a Path costs more
    if not stat.S_ISDIR(status.st_mode):
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), path)
    mtime_ns, device = status.st_mtime_ns, status.st_dev
    if known is not None and known.trusted and (known.mtime_ns, known.device) == (mtime_ns, device):
        return known
    folder = _Folder(mtime_ns, trusted=settled(mtime_ns, now), device=device)
    with os.scandir(path) as entries:
        for entry in entries:
            _enter(folder, entry, looked_at)
    if folder.sidecar_ns:
        for file in folder.files:
            if file in looked_at:
                looked_at[file] = Stamp(*looked_at[file][:4], folder.sidecar_ns)
    return folder


def _enter(folder: _Folder, entry: os.DirEntry[str], looked_at: dict[str, Stamp]) -> None:
    hidden = entry.name.startswith(".")
    # Nearly all that is listed, so it is asked for first.
    if not hidden and entry.name.endswith(BAG_KINDS) and entry.is_file(follow_symlinks=False):
        _enter_file(folder, entry, looked_at)
    elif entry.is_symlink():
        if not hidden:
            folder.links.append(Path(entry.path))
    elif entry.is_dir(follow_symlinks=False):
        if not hidden and entry.name != LOST_AND_FOUND:
            folder.folders.append(entry.path)
    elif entry.name == HANDOVER_FILE:
        _enter_sidecar(folder, entry)
    elif entry.name == METADATA_FILE:
        folder.described = True
    elif bag_kind(entry.name):
        if entry.is_file(follow_symlinks=False):
            _enter_file(folder, entry, looked_at)
        else:
            folder.odd.append(SetAside(Path(entry.path), "not a regular file"))


def _enter_file(folder: _Folder, entry: os.DirEntry[str], looked_at: dict[str, Stamp]) -> None:
    try:
        status = entry.stat(follow_symlinks=False)
    except FileNotFoundError:
        return
    except OSError as error:
        reason = f"cannot be looked at: {error.strerror or error}"
        folder.odd.append(SetAside(Path(entry.path), reason))
        folder.trusted = False
        # One that is known is not gone because of it.
        folder.files.append(entry.path)
        folder.inodes.append(0)
        return
    looked_at[entry.path] = Stamp.of(status)
    folder.files.append(entry.path)
    folder.inodes.append(status.st_ino)
    if status.st_nlink > 1:
        folder.linked.add(status.st_ino)


def _enter_sidecar(folder: _Folder, entry: os.DirEntry[str]) -> None:
    try:
        folder.sidecar_ns = entry.stat(follow_symlinks=False).st_mtime_ns
    except OSError:
        folder.trusted = False


def _outermost(path: str) -> tuple[int, str]:
    """What orders the names of one file: the one nearest to the root first."""
    return path.count("/"), path


def _is_gone(error: OSError) -> bool:
    """Whether there is nothing of that name; otherwise it may be there, and cannot be looked at."""
    return error.errno in {errno.ENOENT, errno.ENOTDIR}


def _folder_of(path: str) -> str:
    return path.rpartition("/")[0] or "/"


def _is_folder(link: Path) -> bool:
    """Whether a link leads to a directory; where that cannot be told it is better named."""
    try:
        return link.is_dir()
    except OSError:
        return True


def _problem(error: OSError) -> str:
    """What to tell the operator of a bag directory that cannot be listed."""
    if isinstance(error, FileNotFoundError):
        return "the bag directory does not exist; it is looked for again with every scan"
    if isinstance(error, NotADirectoryError):
        return "the bag directory is a file, not a directory: correct recording.bag_dir"
    return f"the bag directory cannot be read: {error.strerror or error}"
