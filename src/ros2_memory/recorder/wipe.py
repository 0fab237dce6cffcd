"""Deletes what is not history: recordings without a byte, and all bags where that is asked for.

`recording.clear_on_startup` is for simulation and tests, so moments go too. Only files that are
known by name are deleted; a directory goes when that leaves it empty. Links are not followed, and
another file system that is mounted below is left alone.
"""

from __future__ import annotations

import os
import pwd
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ros2_memory.errors import RecorderError
from ros2_memory.recorder.layout import (
    HANDOVER_FILE,
    METADATA_FILE,
    MOMENT_FILE,
    MOMENTS_FOLDER,
    OWN_FILES,
    RECORDING_FILES,
)
from ros2_memory.recorder.scan import bag_kind

if TYPE_CHECKING:
    from collections.abc import Iterator

_SQLITE_COMPANIONS: Final = (".db3-wal", ".db3-shm", ".db3-journal")


@dataclass(slots=True)
class Wiped:
    """What was deleted, and a sentence for each thing that could not be."""

    files: int = 0
    bytes: int = 0
    faults: list[str] = field(default_factory=list)


def clear_bags(bag_dir: Path) -> Wiped:
    """Deletes every bag below the directory.

    Raises:
        RecorderError: the directory is `/`, a home directory or above one: a mistake, surely.
    """
    refuse_homes(bag_dir)
    root = bag_dir.resolve()
    wiped = Wiped()
    try:
        with _opened(root) as opened:
            _clear(root, opened, os.fstat(opened).st_dev, wiped, root)
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
        with os.scandir(recording) as listing:
            entries = list(listing)
        if not all(_is_nothing(entry) for entry in entries):
            return False
        for entry in entries:
            Path(entry.path).unlink()
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


def _clear(path: Path, opened: int, device: int, wiped: Wiped, root: Path) -> bool:
    """Deletes the bags below an open directory; whether there were any in it, or moments.

    Names are looked up in the open directory: whatever takes the place of its path meanwhile is
    not touched. A directory below goes too if nothing else is in it.
    """
    with os.scandir(opened) as listing:
        entries = list(listing)
    moments = root / MOMENTS_FOLDER
    had_bags = moments in {path, path.parent} or any(_is_bag(entry) for entry in entries)
    beside = _beside_bags(path, root, had_bags=had_bags)
    for entry in entries:
        below = path / entry.name
        try:
            if _is_directory(entry, device):
                with _opened(entry.name, opened) as inner:
                    emptied = _clear(below, inner, device, wiped, root)
                if emptied:
                    with suppress(OSError):
                        os.rmdir(entry.name, dir_fd=opened)
            elif _is_bag(entry) or (entry.name in beside and entry.is_file(follow_symlinks=False)):
                size = entry.stat(follow_symlinks=False).st_size
                os.unlink(entry.name, dir_fd=opened)
                wiped.files += 1
                wiped.bytes += size
        except FileNotFoundError:
            continue
        except OSError as error:
            wiped.faults.append(f"{below} cannot be deleted: {error.strerror}")
    return had_bags


@contextmanager
def _opened(path: Path | str, within: int | None = None) -> Iterator[int]:
    """A descriptor of a directory that stands there itself and not through a link."""
    flags = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC | os.O_NOFOLLOW
    descriptor = os.open(path, flags, dir_fd=within)
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


def _beside_bags(path: Path, root: Path, *, had_bags: bool) -> frozenset[str]:
    """The files of a directory that go with its bags."""
    names = RECORDING_FILES if had_bags else frozenset()
    if path == root:
        return names | OWN_FILES
    return names | {MOMENT_FILE} if path.parent == root / MOMENTS_FOLDER else names
