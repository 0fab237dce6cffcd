"""Deletes what is not history: recordings without a byte, and all bags where that is asked for.

`recording.clear_on_startup` is for simulation and tests, so moments go too. Bags of other programs
stay, unless retention deletes those as well (`retention.foreign`). Only files that are known by
name are deleted; a directory goes when that leaves it empty. Links are not followed, and another
file system that is mounted below is left alone.
"""

from __future__ import annotations

import errno
import os
import pwd
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.directory_identity import identity_at
from ros2_memory.bag_dir.layout import (
    HANDOVER_FILE,
    METADATA_FILE,
    MOMENT_FILE,
    MOMENTS_FOLDER,
    OWN_FILES,
    RECORDING_FILES,
    bag_kind,
    is_kept_apart,
)
from ros2_memory.core.errors import RecorderError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ros2_memory.bag_dir.own_recordings import OwnRecordings

MOST_FAULTS: Final = 100

_SQLITE_COMPANIONS: Final = (".db3-wal", ".db3-shm", ".db3-journal")


@dataclass(slots=True)
class Wiped:
    """What was deleted, and a sentence for each of the first things that could not be.

    `more` is how many could not be besides.
    """

    files: int = 0
    bytes: int = 0
    faults: list[str] = field(default_factory=list)
    more: int = 0


def clear_bags(bag_dir: Path, own: OwnRecordings | None = None) -> Wiped:
    """Deletes the bags below the directory: every one, or the recorder's `own` and moments.

    Raises:
        RecorderError: the directory is `/`, a home directory or above one: a mistake, surely.
    """
    refuse_homes(bag_dir)
    root = bag_dir.resolve()
    wiped = Wiped()
    try:
        if own is not None:
            own.names()
        _Clearing(root, wiped, own).run()
    except FileNotFoundError:
        pass
    except OSError as error:
        wiped.faults.append(f"{root} cannot be listed: {error.strerror}")
    return wiped


def refuse_homes(bag_dir: Path) -> None:
    """Says whether bags may be deleted below a directory, before anything is written there.

    Raises:
        RecorderError: the directory is `/`, a home directory or above one.
    """
    root = bag_dir.resolve()
    homes = {Path(entry.pw_dir) for entry in pwd.getpwall() if entry.pw_dir.startswith("/")}
    with suppress(RuntimeError):
        homes.add(Path.home())
    for home in (Path("/"), *sorted(homes)):
        if home.resolve().is_relative_to(root):
            raise RecorderError(
                f"recording.clear_on_startup refuses to delete bags below {root}, which holds "
                f"{home}; let recording.bag_dir be a directory of its own"
            )


def remove_if_empty(recording: Path) -> bool:
    """Deletes the directory of a recording that ended without a byte; whether it did.

    A recorder that dies as soon as it starts would leave one with every attempt.
    """
    try:
        with _opened(recording) as opened:
            with os.scandir(opened) as listing:
                entries = list(listing)
            if not all(_is_nothing(entry) for entry in entries):
                return False
            for entry in entries:
                os.unlink(entry.name, dir_fd=opened)
        recording.rmdir()
    except OSError:
        return False
    return True


def _is_nothing(entry: os.DirEntry[str]) -> bool:
    if not entry.is_file(follow_symlinks=False):
        return False
    empty = entry.stat(follow_symlinks=False).st_size == 0
    return entry.name == HANDOVER_FILE or (
        empty and (_is_bag(entry) or entry.name == METADATA_FILE)
    )


@dataclass(slots=True)
class _Folder:
    """A directory that is being cleared, and the ones in it that still are to be."""

    name: str
    inode: tuple[int, int]
    had_bags: bool
    waiting: list[str]


class _Clearing:
    """Deletes the bags below one directory, however deep they lie.

    One directory is open at a time, and names are looked up in it: whatever takes the place of its
    path meanwhile is not touched. The way up is `..`, if that is the directory it was come from.
    """

    def __init__(self, root: Path, wiped: Wiped, own: OwnRecordings | None = None) -> None:
        self._root = root
        self._own = own
        self._wiped = wiped
        self._open = -1
        self._way: list[_Folder] = []

    def run(self) -> None:
        """Clears it.

        Raises:
            OSError: the directory itself cannot be listed.
        """
        self._open = _open(self._root)
        try:
            self._device = os.fstat(self._open).st_dev
            self._enter("")
            while self._way:
                waiting = self._way[-1].waiting
                if waiting:
                    self._descend(waiting.pop())
                else:
                    self._leave()
        finally:
            os.close(self._open)

    def _descend(self, name: str) -> None:
        """Goes down into a directory, where it can, and clears what lies in it."""
        above = self._open
        try:
            self._open = _open(name, above)
        except FileNotFoundError:
            return
        except OSError as error:
            self._fault(name, error)
            return
        try:
            self._enter(name)
        except OSError as error:
            os.close(self._open)
            self._open = above
            self._fault(name, error)
        else:
            os.close(above)

    def _enter(self, name: str) -> None:
        """Deletes the bags in the open directory, and what goes with them."""
        with os.scandir(self._open) as listing:
            entries = list(listing)
        status = os.fstat(self._open)
        level = len(self._way)
        moments = level in {1, 2} and (name if level == 1 else self._way[1].name) == MOMENTS_FOLDER
        had_bags = moments or any(_is_bag(entry) for entry in entries)
        ours = self._is_ours(name)
        names = RECORDING_FILES if had_bags and ours else frozenset()
        if level == 0:
            names |= OWN_FILES
        elif level == 2 and moments:
            names |= {MOMENT_FILE}
        folder = _Folder(name, (status.st_dev, status.st_ino), had_bags, [])
        self._way.append(folder)
        for entry in entries:
            try:
                if _is_directory(entry, self._device):
                    folder.waiting.append(entry.name)
                elif (ours and _is_bag(entry)) or (
                    entry.name in names and entry.is_file(follow_symlinks=False)
                ):
                    size = entry.stat(follow_symlinks=False).st_size
                    os.unlink(entry.name, dir_fd=self._open)
                    self._wiped.files += 1
                    self._wiped.bytes += size
            except FileNotFoundError:
                continue
            except OSError as error:
                self._fault(entry.name, error)

    def _is_ours(self, name: str) -> bool:
        """Whether the bags in the open directory may go."""
        if self._own is None:
            return True
        path = "/".join([*(each.name for each in self._way if each.name), name])
        return is_kept_apart(path) or self._own.lists(path, identity_at(self._open))

    def _leave(self) -> None:
        """Goes up again, and deletes the directory where it had bags and nothing is left in it."""
        left = self._way.pop()
        if not self._way:
            return
        above = _open("..", self._open)
        os.close(self._open)
        self._open = above
        status = os.fstat(above)
        if (status.st_dev, status.st_ino) != self._way[-1].inode:
            moved = OSError(errno.EBUSY, "it was moved away while it was cleared")
            self._fault(left.name, moved)
            self._way.clear()
        elif left.had_bags:
            with suppress(OSError):
                os.rmdir(left.name, dir_fd=above)

    def _fault(self, name: str, error: OSError) -> None:
        path = self._root.joinpath(*(each.name for each in self._way if each.name), name)
        if len(self._wiped.faults) < MOST_FAULTS:
            self._wiped.faults.append(f"{path} cannot be deleted: {error.strerror}")
        else:
            self._wiped.more += 1


def _open(path: Path | str, within: int | None = None) -> int:
    """A descriptor of a directory that stands there itself and not through a link."""
    flags = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC | os.O_NOFOLLOW
    return os.open(path, flags, dir_fd=within)


@contextmanager
def _opened(path: Path) -> Iterator[int]:
    descriptor = _open(path)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def _is_directory(entry: os.DirEntry[str], device: int) -> bool:
    if entry.name.startswith(".") or not entry.is_dir(follow_symlinks=False):
        return False
    return entry.stat(follow_symlinks=False).st_dev == device


def _is_bag(entry: os.DirEntry[str]) -> bool:
    named = bag_kind(entry.name) or entry.name.endswith(_SQLITE_COMPANIONS)
    return bool(named) and entry.is_file(follow_symlinks=False)
