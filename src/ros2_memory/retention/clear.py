"""Deletes recordings without a byte, and all bags if `recording.clear_on_startup` is set.

That setting is for simulation and tests, so moments go too. Bags of other programs stay, unless
retention deletes those as well (`retention.foreign`). Only files with known names are deleted, and
a directory that becomes empty. State files that refer to log times go with the last recording.
Links are not followed, and bags of another file system that is mounted below are left alone.
"""

from __future__ import annotations

import os
import pwd
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.json_files import state_path
from ros2_memory.bag_dir.layout import (
    HANDOVER_FILE,
    LOST_AND_FOUND,
    METADATA_FILE,
    MOMENT_FILE,
    MOMENTS_FOLDER,
    OWN_FILES,
    TIMED_FILES,
    bag_kind,
    has_own_name,
)
from ros2_memory.core import directories
from ros2_memory.core.directories import known_identity
from ros2_memory.core.errors import RecorderError
from ros2_memory.retention.delete import is_journal, remove_bag, remove_emptied

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.bag_dir.own_recordings import OwnRecordings

MOST_FAULTS: Final = 100


@dataclass(slots=True)
class Cleared:
    """How many bags were deleted, their bytes, and a sentence for each that could not be deleted.

    Beyond `MOST_FAULTS` sentences, `more` counts the faults.
    """

    files: int = 0
    bytes: int = 0
    faults: list[str] = field(default_factory=list)
    more: int = 0

    def delete(self, root: Path, bag: Path, device: int) -> None:
        """Deletes a bag below the root, unless it lies on another device."""
        try:
            status = bag.lstat()
            if status.st_dev == device:
                self.bytes += remove_bag(root, bag, (device, status.st_ino))
                self.files += 1
        except OSError as error:
            self.add_fault(bag, error)

    def add_fault(self, path: Path | str, error: OSError) -> None:
        """Adds a file that cannot be deleted; one that has gone is no fault."""
        if isinstance(error, FileNotFoundError):
            return
        if len(self.faults) < MOST_FAULTS:
            self.faults.append(f"{path} cannot be deleted: {error.strerror or error}")
        else:
            self.more += 1


def clear_bags(bag_dir: Path, own: OwnRecordings | None = None) -> Cleared:
    """Deletes the bags below the directory: all of them, or the recorder's `own` and moments.

    Raises:
        RecorderError: the directory is `/`, a home directory or above one.
    """
    refuse_homes(bag_dir)
    root, cleared = bag_dir.resolve(), Cleared()
    try:
        if own is not None:
            own.names()  # without this list every bag would count as foreign
        device = root.stat().st_dev
    except OSError as error:
        cleared.add_fault(root, error)
        return cleared
    had_bags: dict[Path, bool] = {}
    for folder, bags in _bags_by_folder(root, own, cleared):
        for bag in bags:
            cleared.delete(root, bag, device)
        had_bags[folder] = bool(bags)
    for folder in reversed(had_bags):  # the deepest first
        with suppress(OSError):
            _remove_emptied(root, folder, had_bags=had_bags[folder])
    is_left = any(has_own_name(folder.name) and folder.exists() for folder in had_bags)
    # The files of times also say which splits of a recording that is left are not screened yet.
    timed_files = frozenset() if cleared.faults or is_left else TIMED_FILES
    for name in OWN_FILES | timed_files:
        with suppress(OSError):
            state_path(root, name).unlink()
    return cleared


def _bags_by_folder(
    root: Path, own: OwnRecordings | None, cleared: Cleared
) -> Iterator[tuple[Path, Sequence[Path]]]:
    """Yields each folder with its bags that may be deleted; a folder before those in it."""
    begin = len(str(root)) + 1

    def add_fault(error: OSError) -> None:
        if not _is_left_alone(error.filename[begin:]):
            cleared.add_fault(error.filename, error)

    for path, entries in directories.walk(root, add_fault):
        if _is_left_alone(path[begin:]):
            continue
        is_own = own.judge(path[begin:], known_identity(path)) if own else lambda _: True
        yield (
            Path(path),
            [
                Path(path, entry.name)
                for entry in entries
                if bag_kind(entry.name)
                and entry.is_file(follow_symlinks=False)
                and is_own(entry.name)
            ],
        )


def _is_left_alone(name: str) -> bool:
    """Whether a path below the bag directory is hidden, or in `lost+found`."""
    return "/." in f"/{name}" or f"{name}/".startswith(f"{LOST_AND_FOUND}/")


def _remove_emptied(root: Path, folder: Path, *, had_bags: bool) -> None:
    """Deletes a folder that had bags or belongs to a moment, if nothing else is left in it."""
    moments = root / MOMENTS_FOLDER
    if folder.parent == moments:
        with directories.opened(root, folder) as moment:
            if os.listdir(moment) == [MOMENT_FILE]:  # noqa: PTH208 - a descriptor has no path
                os.unlink(MOMENT_FILE, dir_fd=moment)
    if had_bags or moments in (folder, folder.parent):
        remove_emptied(root, folder)


def refuse_homes(bag_dir: Path) -> None:
    """Checks that bags may be deleted below a directory.

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


def _is_worthless(entry: os.DirEntry[str]) -> bool:
    """Whether a file is of no use in a recording whose bags are all empty."""
    name = entry.name
    if not entry.is_file(follow_symlinks=False):
        return False
    if name == HANDOVER_FILE:
        return True
    is_known = name == METADATA_FILE or is_journal(name) or bag_kind(name) is not None
    return is_known and not entry.stat(follow_symlinks=False).st_size
