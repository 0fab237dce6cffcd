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

    def add_fault(self, path: Path, error: OSError, verb: str = "deleted") -> None:
        """Adds a sentence, or only counts it once there are `MOST_FAULTS`."""
        if len(self.faults) < MOST_FAULTS:
            self.faults.append(f"{path} cannot be {verb}: {error.strerror}")
        else:
            self.more += 1

    def delete(self, path: Path, folder: int) -> None:
        """Deletes a file; `folder` is its open directory."""
        try:
            size = os.stat(path.name, dir_fd=folder, follow_symlinks=False).st_size
            os.unlink(path.name, dir_fd=folder)
        except FileNotFoundError:
            return
        except OSError as error:
            self.add_fault(path, error)
        else:
            self.files += 1
            self.bytes += size


def clear_bags(bag_dir: Path, own: OwnRecordings | None = None) -> Cleared:
    """Deletes the bags below the directory: all of them, or the recorder's `own` and moments.

    Raises:
        RecorderError: the directory is `/`, a home directory or above one.
    """
    refuse_homes(bag_dir)
    root, cleared = bag_dir.resolve(), Cleared()
    try:
        if own is not None:
            own.names()
        device = root.stat().st_dev
        os.listdir(root)  # noqa: PTH208 - only whether it can be
    except FileNotFoundError:
        return cleared
    except OSError as error:
        cleared.add_fault(root, error, "listed")
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
        except FileNotFoundError:
            continue
        except OSError as error:
            cleared.add_fault(path, error)
            continue
        if parts and (had_bags or (parts[0] == MOMENTS_FOLDER and len(parts) <= 2)):
            emptied.append(path)
        waiting.extend((*parts, name) for name in below)
    _remove_emptied(root, emptied, cleared)
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

    Returns whether there were any, and the directories in it that are not hidden.
    """
    bags, files, below = _names_in(folder)
    going = bags
    if own is not None:
        holds = own.judge("/".join(parts), identity_at(folder))
        # A journal goes with its bag.
        going = {
            name for name in bags if holds(name.rpartition("-")[0] if is_journal(name) else name)
        }
    beside = RECORDING_FILES if bags and going == bags else frozenset()
    for name in going | files & (beside if parts else beside | OWN_FILES):
        cleared.delete(path / name, folder)
    return bool(bags), [name for name in below if not name.startswith(".")]


def _remove_emptied(root: Path, emptied: list[Path], cleared: Cleared) -> None:
    """Deletes directories that are empty, but for the file of a moment of which no bag is left."""
    # The deepest first.
    for path in reversed(emptied):
        with suppress(OSError), directories.opened(root, path.parent) as above:
            if path.parent == root / MOMENTS_FOLDER:
                with directories.opened(root, path) as folder:
                    bags, files, below = _names_in(folder)
                    if MOMENT_FILE in files and not bags and not below:
                        cleared.delete(path / MOMENT_FILE, folder)
            os.rmdir(path.name, dir_fd=above)


def _names_in(folder: int) -> tuple[set[str], set[str], list[str]]:
    """Returns the names of bags and their journals, of files, and of directories in a directory."""
    with os.scandir(folder) as listing:
        entries = [*listing]
    files = {entry.name for entry in entries if entry.is_file(follow_symlinks=False)}
    below = [entry.name for entry in entries if entry.is_dir(follow_symlinks=False)]
    return {name for name in files if bag_kind(name) or is_journal(name)}, files, below


def _is_worthless(entry: os.DirEntry[str]) -> bool:
    """Whether a file of a recording means nothing where that has no bag with content."""
    if not entry.is_file(follow_symlinks=False):
        return False
    is_known = bag_kind(entry.name) or is_journal(entry.name) or entry.name == METADATA_FILE
    is_empty = not entry.stat(follow_symlinks=False).st_size
    return entry.name == HANDOVER_FILE or bool(is_known and is_empty)
