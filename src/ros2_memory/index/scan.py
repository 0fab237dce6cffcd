"""Scanning the bag directory: which bag files are there, and which may have changed.

A directory is listed again only if its mtime shows that names came or went. The mtime does not show
writes *into* a file, so the caller names files to be looked up in every scan.
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
"""How many closed files each patrolling scan checks, in turn: an overwrite changes no directory."""

YOUNG_NS: Final[Ns] = 2 * NS_PER_S
"""Two changes within one tick of the file system share an mtime: a young mtime proves nothing."""

BAG_DIR_SETTING: Final = "recording.bag_dir (MEMORY_BAG_DIR)"
"""The setting that names the bag directory, unless another one does."""

_OTHER_DISK = (
    "the bag directory is on another disk than before, and contains no bags: the disk of the bags "
    "has been unmounted; mount it again, and the bags are found again"
)
_AWAY = "its disk has been unmounted; mount it again, and its bags are found again"
_LINK = "a symbolic link, which is not followed: move or mount the bags into the bag directory"


def settled(mtime_ns: Ns, now: Ns) -> bool:
    """Returns whether a later change would change the mtime; an mtime in the future is settled."""
    return abs(now - mtime_ns) >= YOUNG_NS


class Stamp(NamedTuple):
    """The stat result of a file.

    `sidecar_ns` is the mtime of the `handover.json` beside it, 0 without one. That file decides
    which messages of a bag count.
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
        """Size, mtime and mtime of the sidecar: if these are the same, so is the content."""
        return self.size, self.mtime_ns, self.sidecar_ns


def sidecar_ns_of(status: os.stat_result) -> Ns:
    """Returns the `sidecar_ns` for the stat result of a `handover.json`; a link does not count."""
    return 0 if stat.S_ISLNK(status.st_mode) else limited(status.st_mtime_ns)


UNSEEN: Final = Stamp(-1, 0, 0, 0)
"""The stamp of a file that no scan has seen."""
_ROW: Final = np.dtype([("size", "i8"), ("mtime", "i8"), ("ctime", "i8"), ("inode", "u8")])
"""A stamp without `sidecar_ns`, which all files of a directory share."""


@dataclass(frozen=True, slots=True)
class ScanResult:
    """What one scan found. Paths are strings, as `os.scandir` gives them: there are many.

    Attributes:
        stamps: by path, the bag files that are new, have changed, are watched, or may change
            without a trace.
        gone: paths of files that went since the last scan.
        damaged: directories that cannot be listed, and bag names that are no files; in no order.
        links: symbolic links; in no order.
        problem: what is wrong with the bag directory itself. If it does not exist, all its files
            are gone. If it cannot be listed at the moment, all its files count as before.
        metadata_folders: folders with a metadata.yaml.
    """

    stamps: dict[str, Stamp] = field(default_factory=dict)
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
    """A directory as it was last listed.

    Attributes:
        path: its path.
        mtime_ns: its mtime before it was listed.
        trusted: whether an equal mtime means that it need not be listed again.
        device: the device that it is on.
        folders: paths of the directories in it.
        names: names of the bags in it, separated by slashes.
        rows: the stamps of these bags, in this order.
        linked: inodes of bags with several hard links.
        newer: by path, stamps of bags that were looked up since.
        links: symbolic links in it.
        odd: names of bags that are no files, or cannot be read.
        sidecar_ns: as in `Stamp`.
        has_metadata: whether it has a metadata.yaml.
        is_away: whether its disk has been unmounted: its bags are not gone, but cannot be read.
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
    is_away: bool = False

    def stamps(self, among: Iterable[str] | None = None) -> dict[str, Stamp]:
        """Returns the stamps of all bags, by path; or of some: there may be a week of others."""
        names, rows = self.names.split("/") if self.names else [], self.rows
        if among is not None:
            wanted = {path.rpartition("/")[2] for path in among}
            chosen = [row for row, name in enumerate(names) if name in wanted]
            names, rows = [names[row] for row in chosen], rows[chosen]
        root, sidecar = self.path.rstrip("/"), self.sidecar_ns
        stamps = {
            f"{root}/{name}": Stamp(size, mtime, ctime, inode, sidecar)
            for name, (size, mtime, ctime, inode) in zip(names, rows.tolist(), strict=True)
        }
        return stamps | self.newer

    def set_bags(self, stamps: dict[str, Stamp]) -> None:
        """Sets the bags that the directory has."""
        self.names = "/".join([path.rpartition("/")[2] for path in stamps])
        self.rows = np.array([stamp[:-1] for stamp in stamps.values()], _ROW)

    def read_sidecar(self) -> None:
        """Looks up the `handover.json` in the directory."""
        try:
            status = os.lstat(f"{self.path}/{HANDOVER_FILE}")
        except FileNotFoundError:
            return
        except OSError:
            self.trusted = False
            return
        self.sidecar_ns = sidecar_ns_of(status)

    def add_entry(
        self, entry: os.DirEntry[str], stamps: dict[str, Stamp], before: Mapping[str, Stamp]
    ) -> None:
        """Adds an entry of the directory; the stamp of a bag goes into `stamps`.

        A bag that cannot be looked up keeps its stamp from `before`.
        """
        kind = bag_kind(entry.name)
        # Nearly all entries are bags: they are checked first.
        if kind and entry.is_file(follow_symlinks=False):
            self._add_bag(entry, stamps, before)
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

    def _add_bag(
        self, entry: os.DirEntry[str], stamps: dict[str, Stamp], before: Mapping[str, Stamp]
    ) -> None:
        try:
            status = entry.stat(follow_symlinks=False)
        except FileNotFoundError:
            return
        except OSError as error:
            reason = f"cannot be read: {error.strerror or error}"
            self.odd.append(SetAside(Path(entry.path), reason))
            # A known file is not gone because it cannot be looked up.
            self.trusted = False
            stamps[entry.path] = before.get(entry.path, UNSEEN)
        else:
            stamps[entry.path] = Stamp.of(status, self.sidecar_ns)
            if status.st_nlink > 1:
                self.linked.add(status.st_ino)


class Tree:
    """The directories under one root, as the last scan saw them. Not thread-safe.

    The root itself may be a symbolic link; inside it none is followed. Folders whose name begins
    with a dot are left out, and so is `lost+found`. A file with several hard links is found once:
    at the path nearest to the root, and in a saved moment only if it has no other path.

    Args:
        root: the directory.
        only: paths below it; see `paths_named`. Files that one of them does not match are left out.
        setting: the setting that names the root, for error messages.

    Attributes:
        saved: by path, all files in saved moments, including second links.
    """

    def __init__(
        self, root: Path, only: Sequence[str] = (), *, setting: str = BAG_DIR_SETTING
    ) -> None:
        self._root = str(root)
        self._setting = setting
        self._only = only
        paths = [f"{self._root.rstrip('/')}/{name.strip('/')}" for name in only]
        self._only_paths = [(path, paths_named(path)) for path in paths]
        self._folders: dict[str, _Folder] = {}
        self._device: int | None = None  # of the disk that bags were last found on
        self._moments = f"{self._root.rstrip('/')}/{MOMENTS_FOLDER}/"
        self._second_links: set[str] = set()
        self._unpatrolled: list[str] = []
        self._patrol: list[str] = []
        self.saved: dict[str, Stamp] = {}

    def scan(self, now: Ns, watched: Iterable[str], *, patrolling: bool = False) -> ScanResult:
        """Returns what is new, changed or gone since the last scan, and the `watched` files.

        `now` decides which mtimes are too young to be trusted. `patrolling` also looks up some
        files of unchanged directories. Raises nothing: a directory that cannot be listed is part of
        the result, and its known files count as being there.
        """
        before, self._folders = self._folders, {}
        result = ScanResult()
        fault = self._visit_all(before, now, result)
        if fault is not None and not _is_gone(fault) and before:
            self._folders = before
            return ScanResult(problem=self._describe_fault(fault))
        problem = self._find_problem() if fault is None else self._describe_fault(fault)
        if problem is not None:
            self._folders = {}
            result = ScanResult(problem=problem)
        for path, folder in before.items():
            after = self._folders.get(path)
            if after is not folder:
                there = {} if after is None else after.stamps()
                result.gone.update(folder.stamps().keys() - there)
        self._look_up(watched, result)
        if patrolling:
            self._look_up(self._next_patrol(), result, settled_at=now)
        for file in result.gone & self.saved.keys():
            del self.saved[file]
        for file, stamp in result.stamps.items():
            if file.startswith(self._moments):
                self.saved[file] = stamp
        self._leave_out_second_links(before, result)
        return result

    def _leave_out_second_links(self, before: dict[str, _Folder], result: ScanResult) -> None:
        """Reports second links of files as gone, and a link as new once it is the first one."""
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
        # A file may have got its second link after its own folder was listed.
        linked = {inode for folder in self._folders.values() for inode in folder.linked}
        links: dict[tuple[int, int], list[str]] = {}
        for folder in self._folders.values() if linked else ():
            if linked.isdisjoint(folder.rows["inode"].tolist()):
                continue
            for path, stamp in folder.stamps().items():
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
            for path, stamp in folder.stamps().items():
                if path not in self._second_links:
                    yield path, stamp

    def stamp(self, path: str) -> Stamp:
        """Returns the stamp of a file that a scan returned."""
        return self._folder_with(path).stamps([path]).get(path, UNSEEN)

    def is_away(self, path: str) -> bool:
        """Returns whether the disk of a file has been unmounted."""
        return self._folder_with(path).is_away

    def lose(self, path: str) -> None:
        """Makes the next scan report a file as new if it is there."""
        folder = self._folder_with(path)
        folder.newer[path] = UNSEEN
        folder.trusted = False

    def _folder_with(self, path: str) -> _Folder:
        """Returns the folder of a file, as it was last listed; an empty one if it never was."""
        folder = _folder_of(path)
        return self._folders.get(folder) or _Folder(folder, 0, trusted=False)

    def _next_patrol(self) -> list[str]:
        """Returns the next files to check, in turn."""
        if not self._patrol:
            self._unpatrolled = self._unpatrolled or [*self._folders]
            while self._unpatrolled and len(self._patrol) < PATROL:
                folder = self._folders.get(self._unpatrolled.pop())
                self._patrol += () if folder is None else folder.stamps()
        following = self._patrol[-PATROL:]
        del self._patrol[-PATROL:]
        return following

    def _find_problem(self) -> str | None:
        """Returns what is wrong if no bag was found: the disk was unmounted, or `only` is wrong."""
        device = self._folders[self._root].device
        folders = self._folders.values()
        if any(folder.names for folder in folders):
            self._device = device
        elif self._device not in {None, device}:
            return _OTHER_DISK
        elif self._only and not any(folder.odd for folder in folders):
            return f"no bag is named {self._only[-1]} (data.recording)"
        return None

    def _describe_fault(self, error: OSError) -> str:
        """Returns a sentence on a bag directory that cannot be listed, without absolute paths."""
        root = Path(self._root)
        name = f".../{root.name}" if root.is_absolute() else self._root
        if isinstance(error, FileNotFoundError):
            return f"the bag directory does not exist (yet): check {name}, from {self._setting}"
        if isinstance(error, NotADirectoryError):
            return f"the bag directory is a file, not a directory: correct {self._setting}"
        return f"the bag directory cannot be read: {error.strerror or error}"

    def _visit_all(self, before: dict[str, _Folder], now: Ns, result: ScanResult) -> OSError | None:
        """Visits every folder; returns the error if the root cannot be listed."""
        waiting = [self._root]
        while waiting:
            path = waiting.pop()
            try:
                folder = self._visit(path, before.get(path), now, result)
            except OSError as error:
                if path == self._root:
                    return error
                # Its parent has a new mtime then, and is listed by the next scan.
                if _is_gone(error):
                    continue
                reason = f"the directory cannot be listed: {error.strerror or error}"
                result.damaged.append(SetAside(Path(path), reason))
                if path not in before:
                    continue
                # A failing disk hides its files: they are not gone.
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
        self._keep_unmounted(before, result)
        return None

    def _keep_unmounted(self, before: dict[str, _Folder], result: ScanResult) -> None:
        """Keeps the folders on disks that have been unmounted below the root, with their bags."""
        for path, folder in before.items():
            above, after = before.get(_folder_of(path)), self._folders.get(path)
            if above is None or above.device == folder.device:
                continue  # no disk was mounted there
            if after is not None and after.device == folder.device:
                continue  # it still is
            below = [other for other in before if other == path or other.startswith(f"{path}/")]
            has_bags = any(before[other].names for other in below)
            if has_bags and not (after and (after.names or after.folders)):
                result.damaged.append(SetAside(Path(path), _AWAY))
                for other in below:
                    self._folders[other] = replace(before[other], trusted=False, is_away=True)
                result.metadata_folders.extend(
                    other for other in below if before[other].has_metadata
                )

    def _visit(self, path: str, known: _Folder | None, now: Ns, result: ScanResult) -> _Folder:
        """Returns the known folder if nothing came or went, else lists it anew.

        The mtime is read first: so the next scan finds what changes during the listing. Only the
        root may be a link: any other has just replaced a folder.
        """
        status = os.stat(path, follow_symlinks=path == self._root)  # noqa: PTH116 - a Path costs more
        if not stat.S_ISDIR(status.st_mode):
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), path)
        mtime_ns, device = status.st_mtime_ns, status.st_dev
        if known and known.trusted and (known.mtime_ns, known.device) == (mtime_ns, device):
            return known
        folder = _Folder(path, mtime_ns, trusted=settled(mtime_ns, now), device=device)
        folder.read_sidecar()
        before, stamps = {} if known is None else known.stamps(), dict[str, Stamp]()
        with os.scandir(path) as entries:
            for entry in entries:
                if self._may_lead_to_bags(entry.path):
                    folder.add_entry(entry, stamps, before)
        folder.set_bags(stamps)
        for file, stamp in stamps.items():
            known_stamp = before.get(file, UNSEEN)
            is_looked_up = stamp is not known_stamp
            if is_looked_up and (stamp != known_stamp or not settled(stamp.mtime_ns, now)):
                result.stamps[file] = stamp
        return folder

    def _may_lead_to_bags(self, path: str) -> bool:
        """Returns whether each path of `only` matches a path, or lies below it."""
        return all(
            pattern.fullmatch(path) or only.startswith(f"{path}/")
            for only, pattern in self._only_paths
        )

    def _look_up(
        self, paths: Iterable[str], result: ScanResult, settled_at: Ns | None = None
    ) -> None:
        """Adds the current stamps of files; with `settled_at`, only if they may have changed."""
        unseen = set(paths) - result.stamps.keys() - result.gone
        for _, files in groupby(sorted(unseen, key=_folder_of), _folder_of):
            in_folder = [*files]
            folder = self._folder_with(in_folder[0])
            if folder.is_away:
                continue
            before = folder.stamps(in_folder)
            for path in in_folder:
                try:
                    stamp = Stamp.of(os.lstat(path), folder.sidecar_ns)
                except OSError as error:
                    folder.trusted = False
                    if _is_gone(error):
                        result.gone.add(path)
                        # The mtime of its folder may be the same, and the file may soon be back.
                        self.lose(path)
                    continue
                is_new = stamp != before.get(path)
                if settled_at is None or is_new or not settled(stamp.mtime_ns, settled_at):
                    result.stamps[path] = stamp
                if is_new:
                    folder.newer[path] = stamp


def _is_gone(error: OSError) -> bool:
    """Returns whether an error proves that a path does not exist."""
    return error.errno in {errno.ENOENT, errno.ENOTDIR}


def _folder_of(path: str) -> str:
    return path.rpartition("/")[0] or "/"


def _is_folder(link: Path) -> bool:
    """Returns whether a link leads to a directory; True if that cannot be looked up."""
    try:
        return link.is_dir()
    except OSError:
        return True
