"""Scanning the bag directory: which bag files are there, and which may have changed.

A directory is listed again only when its mtime shows that names came or went. That does not show
what was written *into* a file, so the caller names files to be looked up in every scan.
"""

from __future__ import annotations

import errno
import os
import stat
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.bag_dir.layout import (
    HANDOVER_FILE,
    LOST_AND_FOUND,
    METADATA_FILE,
    MOMENTS_FOLDER,
    bag_kind,
)
from ros2_memory.core.model import SetAside
from ros2_memory.core.timebase import NS_PER_S, Ns, limited
from ros2_memory.index.recordings import paths_named

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray


PATROL: Final = 256
"""Closed files checked in each scan, in turn: one overwritten in place changes no directory."""

YOUNG_NS: Final[Ns] = 2 * NS_PER_S
"""Two changes within one tick of the file system share an mtime: a young one proves nothing."""

BAG_DIR_SETTING: Final = "recording.bag_dir (MEMORY_BAG_DIR)"
"""The setting that names the bag directory, unless another one does."""

_OTHER_DISK = (
    "the bag directory is on another disk than before, and contains no bags: the disk of the bags "
    "has been unmounted; mount it again, and the bags are found again"
)
_LINK = "a symbolic link, which is not followed: move or mount the bags into the bag directory"


def settled(mtime_ns: Ns, now: Ns) -> bool:
    """Returns whether a later change would show in the mtime; also of one far in the future."""
    return abs(now - mtime_ns) >= YOUNG_NS


class Stamp(NamedTuple):
    """The stat result of a file.

    `sidecar_ns` is the mtime of the `handover.json` beside it, 0 without one: that decides which
    messages of the file count.
    """

    size: int
    mtime_ns: Ns
    ctime_ns: Ns
    inode: int
    sidecar_ns: Ns = 0

    @classmethod
    def of(cls, status: os.stat_result, sidecar_ns: Ns = 0) -> Stamp:
        """Returns the stamp of a stat result."""
        times = limited(status.st_mtime_ns), limited(status.st_ctime_ns)
        return cls(status.st_size, *times, status.st_ino, sidecar_ns)

    @property
    def content(self) -> tuple[int, Ns, Ns]:
        """What changes when other messages count: size, mtime and mtime of the sidecar."""
        return self.size, self.mtime_ns, self.sidecar_ns


def sidecar_ns_of(status: os.stat_result) -> Ns:
    """Returns the `sidecar_ns` of stamps beside a `handover.json`; a link is as good as none."""
    return 0 if stat.S_ISLNK(status.st_mode) else limited(status.st_mtime_ns)


_UNSEEN: Final = Stamp(-1, 0, 0, 0)
_ROW: Final = np.dtype([("size", "i8"), ("mtime", "i8"), ("ctime", "i8"), ("inode", "u8")])
"""The stamp of a file in a directory, whose sidecar is that of all."""


@dataclass(frozen=True, slots=True)
class ScanResult:
    """What one scan found. Paths are strings, as `os.scandir` gives them: there are so many.

    Attributes:
        stamps: the bag files that are new, have changed, or may change without a trace; and the
            watched ones.
        before: how those were when they were last looked at, and those that are gone.
        gone: the files that are not known any more.
        damaged: directories that cannot be listed, and bag names that are no files; in no order.
        links: symbolic links; in no order.
        problem: what is wrong with the bag directory itself. Either it does not exist, and all its
            files are gone; or it cannot be listed at the moment, and all its files count as before.
        metadata_folders: folders with a metadata.yaml.
    """

    stamps: dict[str, Stamp] = field(default_factory=dict)
    before: dict[str, Stamp] = field(default_factory=dict)
    gone: set[str] = field(default_factory=set)
    damaged: list[SetAside] = field(default_factory=list)
    links: list[SetAside] = field(default_factory=list)
    problem: str | None = None
    metadata_folders: list[str] = field(default_factory=list)

    def is_like(self, before: ScanResult | None) -> bool:
        """Returns whether an earlier scan found the same, apart from bag files."""
        return before is not None and self._apart_from_bags() == before._apart_from_bags()

    def _apart_from_bags(self) -> tuple[object, ...]:
        return self.problem, set(self.damaged), set(self.links), set(self.metadata_folders)


@dataclass(slots=True)
class _Folder:
    """A directory as it was last listed: of its bags, the names and their stamps, one by one.

    Attributes:
        linked: inodes of files with several hard links.
        newer: stamps of bags that were looked at since, by path.
    """

    path: str
    mtime_ns: Ns
    trusted: bool
    device: int = 0
    folders: list[str] = field(default_factory=list)
    names: str = ""
    rows: NDArray[np.void] = field(default_factory=lambda: np.empty(0, _ROW))
    linked: set[int] = field(default_factory=set)
    newer: dict[str, Stamp] = field(default_factory=dict)
    links: list[Path] = field(default_factory=list)
    odd: list[SetAside] = field(default_factory=list)
    sidecar_ns: Ns = 0
    has_metadata: bool = False

    @property
    def stamps(self) -> dict[str, Stamp]:
        """Of all bags, by path."""
        names = self.names.split("/") if self.names else []
        return self._with_stamps(names, self.rows)

    def stamps_of(self, paths: Iterable[str]) -> dict[str, Stamp]:
        """Of those of some bags that it has, by path: a folder may have a week of others."""
        wanted, names = {path.rpartition("/")[2] for path in paths}, self.names.split("/")
        rows = [row for row, name in enumerate(names) if name in wanted]
        return self._with_stamps([names[row] for row in rows], self.rows[rows])

    def _with_stamps(self, names: Sequence[str], rows: NDArray[np.void]) -> dict[str, Stamp]:
        root, sidecar = self.path.rstrip("/"), self.sidecar_ns
        found = {
            f"{root}/{name}": Stamp(size, mtime, ctime, inode, sidecar)
            for name, (size, mtime, ctime, inode) in zip(names, rows.tolist(), strict=True)
        }
        return found | self.newer

    def keep(self, stamps: dict[str, Stamp]) -> None:
        """Has the directory hold these bags."""
        self.names = "/".join([path.rpartition("/")[2] for path in stamps])
        self.rows = np.array([stamp[:-1] for stamp in stamps.values()], _ROW)

    def find_sidecar(self) -> None:
        """Looks up the `handover.json` in the directory."""
        try:
            status = os.lstat(f"{self.path}/{HANDOVER_FILE}")
        except FileNotFoundError:
            return
        except OSError:
            self.trusted = False
            return
        self.sidecar_ns = sidecar_ns_of(status)

    def enter(
        self, entry: os.DirEntry[str], stamps: dict[str, Stamp], before: Mapping[str, Stamp]
    ) -> None:
        """Adds what the directory has under a name: of a bag, its stamp to `stamps`.

        Of one that cannot be looked at that is the one from `before`.
        """
        kind = bag_kind(entry.name)
        # Nearly all entries are bags: they are checked first.
        if kind and entry.is_file(follow_symlinks=False):
            self._enter_bag(entry, stamps, before)
        elif entry.is_symlink():
            if not entry.name.startswith("."):
                self.links.append(Path(entry.path))
        elif entry.is_dir(follow_symlinks=False):
            if not entry.name.startswith(".") and entry.name != LOST_AND_FOUND:
                self.folders.append(entry.path)
        elif entry.name == METADATA_FILE:
            self.has_metadata = True
        elif kind:
            self.odd.append(SetAside(Path(entry.path), "not a regular file"))

    def _enter_bag(
        self, entry: os.DirEntry[str], stamps: dict[str, Stamp], before: Mapping[str, Stamp]
    ) -> None:
        try:
            status = entry.stat(follow_symlinks=False)
        except FileNotFoundError:
            return
        except OSError as error:
            reason = f"cannot be read: {error.strerror or error}"
            self.odd.append(SetAside(Path(entry.path), reason))
            # A known file is not gone because of that.
            self.trusted = False
            stamps[entry.path] = before.get(entry.path, _UNSEEN)
        else:
            stamps[entry.path] = Stamp.of(status, self.sidecar_ns)
            if status.st_nlink > 1:
                self.linked.add(status.st_ino)


class Tree:
    """The directories under one root, as the last scan saw them. Not for several threads at once.

    The root itself may be a symbolic link; inside it none is followed. Folders whose name begins
    with a dot are left out, and so is `lost+found`. Of the hard links of one file one is found:
    that nearest to the root, one in a saved moment only where there is no other.

    Args:
        root: the directory.
        only: a path below it, of a folder, a bag, or the bags of one series (`run` for `run_0.mcap`
            and its like): nothing else is found then. Of several, what all of them name.
        setting: the one that names the root, for sentences.

    Attributes:
        saved: all files in saved moments, also those that are found elsewhere.
    """

    def __init__(
        self, root: Path, only: Sequence[str] = (), *, setting: str = BAG_DIR_SETTING
    ) -> None:
        self._root = str(root)
        self._setting = setting
        self._only = only
        paths = (f"{self._root.rstrip('/')}/{name.strip('/')}" for name in only)
        self._named = [(path, paths_named(path).fullmatch) for path in paths]
        self._folders: dict[str, _Folder] = {}
        self._device: int | None = None  # of the disk that bags were last found on
        self._moments = f"{self._root.rstrip('/')}/{MOMENTS_FOLDER}/"
        self._second_links: set[str] = set()
        self._unpatrolled: list[str] = []
        self._patrol: list[str] = []
        self.saved: dict[str, Stamp] = {}

    def scan(self, now: Ns, watched: Iterable[str], *, patrolling: bool = False) -> ScanResult:
        """Returns what is new, changed or gone since the last scan, and the `watched` files.

        `now` decides which mtimes are too young to be trusted; `patrolling` also looks at some
        files of directories that did not change. Raises nothing: a directory that cannot be listed
        is part of the result, and its known files count as being there.
        """
        before, self._folders = self._folders, {}
        result = ScanResult()
        fault = self._descend(before, now, result)
        if fault is not None and not _is_gone(fault) and before:
            self._folders = before
            return ScanResult(problem=self._problem(fault))
        problem = self._unmounted() if fault is None else self._problem(fault)
        folders = self._folders.values()
        if (
            problem is None
            and self._only
            and not any(folder.names or folder.odd for folder in folders)
        ):
            problem = f"no bag is named {self._only[-1]} (data.recording)"
        if problem is not None:
            self._folders = {}
            result = ScanResult(problem=problem)
        for path, folder in before.items():
            after = self._folders.get(path)
            if after is not folder:
                there = {} if after is None else after.stamps
                gone = {file: stamp for file, stamp in folder.stamps.items() if file not in there}
                result.before.update(gone)
                result.gone.update(gone)
        self._look_up(watched, result)
        if patrolling:
            self._look_up(self._next_patrol(), result, settled_at=now)
        for file in result.gone & self.saved.keys():
            del self.saved[file]
        moments = self._moments
        self.saved.update(
            (file, stamp) for file, stamp in result.stamps.items() if file.startswith(moments)
        )
        self._leave_out_second_links(before, result)
        return result

    def _leave_out_second_links(self, before: dict[str, _Folder], result: ScanResult) -> None:
        """Keeps one hard link of each file: the others are gone, until the first one is."""
        is_same = len(before) == len(self._folders) and all(
            self._folders.get(path) is folder for path, folder in before.items()
        )
        second = self._second_links if is_same else self._find_second_links()
        for path in second:
            result.stamps.pop(path, None)
        result.gone.update(second - self._second_links)
        self._look_up(self._second_links - second - result.gone, result)
        self._second_links = second

    def _find_second_links(self) -> set[str]:
        """Returns all but the first link of each file that has several."""
        # A folder that was listed before a file got its second link does not show that.
        linked = {inode for folder in self._folders.values() for inode in folder.linked}
        links: dict[tuple[int, int], list[str]] = {}
        for folder in self._folders.values() if linked else ():
            if linked.isdisjoint(folder.rows["inode"].tolist()):
                continue
            for path, stamp in folder.stamps.items():
                if stamp.inode in linked:
                    links.setdefault((folder.device, stamp.inode), []).append(path)
        second: set[str] = set()
        for paths in links.values():
            paths.sort(key=lambda path: (path.startswith(self._moments), path.count("/"), path))
            second.update(paths[1:])
        return second

    @property
    def stamps(self) -> Iterator[tuple[str, Stamp]]:
        """The path and the stamp of each file that a scan returned, but for second links."""
        for folder in self._folders.values():
            for path, stamp in folder.stamps.items():
                if path not in self._second_links:
                    yield path, stamp

    def stamp(self, path: str) -> Stamp:
        """Returns the stamp of a file that a scan returned."""
        folder = self._folders.get(_folder_of(path))
        return _UNSEEN if folder is None else folder.stamps_of([path]).get(path, _UNSEEN)

    def lose(self, path: str) -> None:
        """Has the next scan return a file if it is there, whatever the mtime of its folder."""
        folder = self._folders.get(_folder_of(path))
        if folder is not None:
            folder.newer[path] = _UNSEEN
            folder.trusted = False

    def _next_patrol(self) -> list[str]:
        """Returns the next known files, in turn."""
        if not self._patrol:
            self._unpatrolled = self._unpatrolled or [*self._folders]
            while self._unpatrolled and len(self._patrol) < PATROL:
                folder = self._folders.get(self._unpatrolled.pop())
                self._patrol += () if folder is None else folder.stamps
        following = self._patrol[-PATROL:]
        del self._patrol[-PATROL:]
        return following

    def _unmounted(self) -> str | None:
        """Returns what is wrong where the root is on another disk than bags were, and has none.

        A mount point looks like this when its disk has been unmounted.
        """
        device = self._folders[self._root].device
        if any(folder.names for folder in self._folders.values()):
            self._device = device
        return None if self._device in {None, device} else _OTHER_DISK

    def _problem(self, error: OSError) -> str:
        """Returns a sentence on a bag directory that cannot be listed; an absolute path is cut."""
        root = Path(self._root)
        named = f".../{root.name}" if root.is_absolute() else self._root
        if isinstance(error, FileNotFoundError):
            return f"the bag directory does not exist (yet): check {named}, from {self._setting}"
        if isinstance(error, NotADirectoryError):
            return f"the bag directory is a file, not a directory: correct {self._setting}"
        return f"the bag directory cannot be read: {error.strerror or error}"

    def _descend(self, before: dict[str, _Folder], now: Ns, result: ScanResult) -> OSError | None:
        """Visits every folder; returns the error where the root cannot be listed."""
        waiting = [self._root]
        while waiting:
            path = waiting.pop()
            try:
                folder = self._visit(path, before.get(path), now, result)
            except OSError as error:
                if path == self._root:
                    return error
                # A folder that went since its parent was listed changes that parent's mtime.
                if _is_gone(error):
                    continue
                reason = f"the directory cannot be listed: {error.strerror or error}"
                result.damaged.append(SetAside(Path(path), reason))
                if path not in before:
                    continue
                # A disk that fails hides its files; it has not lost them.
                folder = replace(before[path], trusted=False)
            self._folders[path] = folder
            waiting.extend(folder.folders)
            if folder.has_metadata:
                result.metadata_folders.append(path)
            result.damaged.extend(folder.odd)
            result.links.extend(
                SetAside(link, _LINK)
                for link in folder.links
                if bag_kind(link.name) or _is_folder(link)
            )
        return None

    def _visit(self, path: str, known: _Folder | None, now: Ns, result: ScanResult) -> _Folder:
        """Returns the folder as it is known if nothing came or went, else as it is listed now.

        Its mtime is read first: what changes during the listing is then found by the next scan.
        Only the root may be a link: anything else that is one has just replaced a folder.
        """
        status = os.stat(path, follow_symlinks=path == self._root)  # noqa: PTH116 - a Path costs more
        if not stat.S_ISDIR(status.st_mode):
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), path)
        mtime_ns, device = status.st_mtime_ns, status.st_dev
        if known and known.trusted and (known.mtime_ns, known.device) == (mtime_ns, device):
            return known
        folder = _Folder(path, mtime_ns, trusted=settled(mtime_ns, now), device=device)
        folder.find_sidecar()
        before, stamps = {} if known is None else known.stamps, dict[str, Stamp]()
        with os.scandir(path) as entries:
            for entry in entries:
                if not self._named or all(
                    is_inside(entry.path) or path.startswith(f"{entry.path}/")
                    for path, is_inside in self._named
                ):
                    folder.enter(entry, stamps, before)
        folder.keep(stamps)
        for file, stamp in stamps.items():
            known_stamp = before.get(file, _UNSEEN)
            is_looked_at = stamp is not known_stamp
            if is_looked_at and (stamp != known_stamp or not settled(stamp.mtime_ns, now)):
                result.stamps[file], result.before[file] = stamp, known_stamp
        return folder

    def _look_up(
        self, paths: Iterable[str], result: ScanResult, settled_at: Ns | None = None
    ) -> None:
        """Adds files as they are now; with `settled_at` those alone that may have changed."""
        for folder_path, files in groupby(sorted(paths, key=_folder_of), _folder_of):
            folder, in_folder = self._folders.get(folder_path), [*files]
            stamps = {} if folder is None else folder.stamps_of(in_folder)
            for path in in_folder:
                if path not in result.stamps and path not in result.gone:
                    before = stamps.get(path, _UNSEEN)
                    self._look_at(path, folder, before, result, settled_at)

    def _look_at(
        self,
        path: str,
        folder: _Folder | None,
        before: Stamp,
        result: ScanResult,
        settled_at: Ns | None,
    ) -> None:
        try:
            stamp = Stamp.of(os.lstat(path), folder.sidecar_ns if folder else 0)
        except OSError as error:
            # Its folder looks unchanged, and may soon look the same with the file back in it.
            if _is_gone(error):
                result.gone.add(path)
                result.before[path] = before
                self.lose(path)
            elif folder is not None:
                folder.trusted = False
            return
        if settled_at is None or stamp != before or not settled(stamp.mtime_ns, settled_at):
            result.stamps[path], result.before[path] = stamp, before
            if folder is not None and stamp != before:
                folder.newer[path] = stamp


def _is_gone(error: OSError) -> bool:
    """Returns whether a path does not exist; after other errors it may."""
    return error.errno in {errno.ENOENT, errno.ENOTDIR}


def _folder_of(path: str) -> str:
    return path.rpartition("/")[0] or "/"


def _is_folder(link: Path) -> bool:
    """Returns whether a link leads to a directory; also where that is unknown."""
    try:
        return link.is_dir()
    except OSError:
        return True
