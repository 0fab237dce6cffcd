"""Deletes recordings without a byte, and all bags where that is asked for.

`recording.clear_on_startup` is for simulation and tests, so moments go too. Bags of other programs
stay, unless retention deletes those as well (`retention.foreign`). Only files that are known by
name are deleted, and a directory when that leaves it empty. Links are not followed, and another
file system that is mounted below is left alone.
"""

from __future__ import annotations

import os
import pwd
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.layout import (
    HANDOVER_FILE,
    METADATA_FILE,
    MOMENT_FILE,
    MOMENTS_FOLDER,
    OWN_FILES,
    RECORDING_FILES,
    bag_kind,
)
from ros2_memory.core import directories
from ros2_memory.core.directories import identity_at
from ros2_memory.core.errors import RecorderError
from ros2_memory.retention.delete import is_journal

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ros2_memory.bag_dir.own_recordings import OwnRecordings

MOST_FAULTS: Final = 100


@dataclass(slots=True)
class Cleared:
    """What was deleted, and a sentence for each of the first things that could not be.

    `more` counts the others that could not be.
    """

    files: int = 0
    bytes: int = 0
    faults: list[str] = field(default_factory=list)
    more: int = 0

    def add_fault(self, sentence: str) -> None:
        """Adds a sentence, or only counts it once there are `MOST_FAULTS`."""
        if len(self.faults) < MOST_FAULTS:
            self.faults.append(sentence)
        else:
            self.more += 1


def clear_bags(bag_dir: Path, own: OwnRecordings | None = None) -> Cleared:
    """Deletes the bags below the directory: all of them, or the recorder's `own` and moments.

    Raises:
        RecorderError: the directory is `/`, a home directory or above one.
    """
    refuse_homes(bag_dir)
    root = bag_dir.resolve()
    cleared = Cleared()
    try:
        if own is not None:
            own.names()
        device = root.stat().st_dev
        os.listdir(root)  # noqa: PTH208 - only whether it can be
    except FileNotFoundError:
        return cleared
    except OSError as error:
        cleared.add_fault(f"{root} cannot be listed: {error.strerror}")
        return cleared
    # Names, not paths: a path may be longer than the system takes (PATH_MAX), and `opened` finds
    # each directory again from the root, so that few files are open however deep it lies.
    waiting: list[tuple[str, ...]] = [()]
    emptied: list[Path] = []
    while waiting:
        parts = waiting.pop()
        path = root.joinpath(*parts)
        try:
            with directories.opened(root, path) as folder:
                if os.fstat(folder).st_dev != device:
                    continue
                had_bags, below = _clear_folder(folder, parts, path, own, cleared)
            if had_bags and parts:
                emptied.append(path)
            waiting.extend((*parts, name) for name in below)
        except FileNotFoundError:
            continue
        except OSError as error:
            cleared.add_fault(f"{path} cannot be deleted: {error.strerror}")
    _remove_emptied(root, reversed(emptied), cleared)
    return cleared


def refuse_homes(bag_dir: Path) -> None:
    """Checks that bags may be deleted below a directory, before anything is written there.

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
                f"recording.clear_on_startup refuses to delete bags below {root}, which contains "
                f"{home}; give recording.bag_dir a directory of its own"
            )


def remove_if_empty(recording: Path) -> bool:
    """Deletes the directory of a recording that ended without a byte; returns whether it did.

    A recorder that dies as soon as it starts would leave one with every attempt.
    """
    try:
        with directories.opened(recording.parent, recording) as folder:
            with os.scandir(folder) as listing:
                entries = list(listing)
            if not all(_is_worthless(entry) for entry in entries):
                return False
            for entry in entries:
                os.unlink(entry.name, dir_fd=folder)
        recording.rmdir()
    except OSError:
        return False
    return True


def _clear_folder(
    folder: int, parts: tuple[str, ...], path: Path, own: OwnRecordings | None, cleared: Cleared
) -> tuple[bool, list[str]]:
    """Deletes the bags in an open directory, which has this path and these names below the root.

    Returns whether it may go when it is empty, and the directories in it that are not hidden.
    """
    with os.scandir(folder) as listing:
        entries = list(listing)
    in_moments = parts[:1] == (MOMENTS_FOLDER,) and len(parts) <= 2
    bags = [entry for entry in entries if _is_bag(entry)]
    going = bags
    if own is not None:
        holds = own.judge("/".join(parts), identity_at(folder))
        going = [entry for entry in bags if holds(_bag_name(entry.name))]
    names = RECORDING_FILES if bags and going == bags else frozenset()
    if not parts:
        names |= OWN_FILES
    beside = [each for each in entries if each.name in names]
    for entry in going + [each for each in beside if each.is_file(follow_symlinks=False)]:
        _delete(folder, path, entry, cleared)
    below = [
        entry.name
        for entry in entries
        if not entry.name.startswith(".") and entry.is_dir(follow_symlinks=False)
    ]
    return in_moments or bool(bags), below


def _remove_emptied(root: Path, emptied: Iterable[Path], cleared: Cleared) -> None:
    """Deletes directories that are empty, the deepest first."""
    for path in emptied:
        if path.parent == root / MOMENTS_FOLDER:
            _clear_moment(root, path, cleared)
        with suppress(OSError), directories.opened(root, path.parent) as above:
            os.rmdir(path.name, dir_fd=above)


def _clear_moment(root: Path, path: Path, cleared: Cleared) -> None:
    """Deletes the file of a saved moment of which no bag is left."""
    with suppress(OSError), directories.opened(root, path) as folder:
        with os.scandir(folder) as listing:
            entries = {entry.name: entry for entry in listing}
        is_left = any(_is_bag(each) or each.is_dir() for each in entries.values())
        if MOMENT_FILE in entries and not is_left:
            _delete(folder, path, entries[MOMENT_FILE], cleared)


def _delete(folder: int, path: Path, entry: os.DirEntry[str], cleared: Cleared) -> None:
    """Deletes a file in an open directory, which has this path."""
    try:
        size = entry.stat(follow_symlinks=False).st_size
        os.unlink(entry.name, dir_fd=folder)
    except FileNotFoundError:
        return
    except OSError as error:
        cleared.add_fault(f"{path / entry.name} cannot be deleted: {error.strerror}")
    else:
        cleared.files += 1
        cleared.bytes += size


def _bag_name(name: str) -> str:
    """Returns the name of a bag; of a journal, that of its bag."""
    return name.rpartition("-")[0] if is_journal(name) else name


def _is_worthless(entry: os.DirEntry[str]) -> bool:
    """Whether a file of a recording means nothing where that has no bag with content."""
    if entry.name == HANDOVER_FILE:
        return entry.is_file(follow_symlinks=False)
    empty = entry.is_file(follow_symlinks=False) and not entry.stat(follow_symlinks=False).st_size
    return empty and (_is_bag(entry) or entry.name == METADATA_FILE)


def _is_bag(entry: os.DirEntry[str]) -> bool:
    named = bag_kind(entry.name) is not None or is_journal(entry.name)
    return named and entry.is_file(follow_symlinks=False)
