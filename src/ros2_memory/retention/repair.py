"""Rewrites bags in place: to close what a crash left open, and to take messages out.

A file of 0 bytes is deleted: nothing had reached the disk. A truncated file is rewritten beside
itself from all that can be read of it, read back, compared and flushed. Only then does the new file
take the name of the old one. In every other case the old file is unchanged.
"""

from __future__ import annotations

import fcntl
import os
import stat
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.durable_write import flush
from ros2_memory.bag_dir.heartbeat import read_heartbeat
from ros2_memory.bag_dir.layout import METADATA_FILE
from ros2_memory.bag_dir.metadata_yaml import correct
from ros2_memory.core import directories
from ros2_memory.core.errors import BagError, BagVanishedError
from ros2_memory.retention.delete import new_file_beside

if TYPE_CHECKING:
    from collections import Counter
    from collections.abc import Callable, Collection, Iterator

    from ros2_memory.core.timebase import Ns
    from ros2_memory.storage.base import BagReader, BagWriter, Rewritten

Identity = tuple[int, int]
"""A file by its device and inode number."""
_CONTENT: Final = ("st_dev", "st_ino", "st_size", "st_mtime_ns")


class Repaired(NamedTuple):
    """The result of repairing one file.

    `was_bytes` and `is_bytes` are its sizes before and after. `rewritten` describes what was
    recovered; it is None for an empty file, which was removed. `notes` are sentences on what was
    lost, or may be undone.
    """

    was_bytes: int
    is_bytes: int = 0
    rewritten: Rewritten | None = None
    notes: tuple[str, ...] = ()


class UnflushedError(OSError):
    """A file was replaced or deleted, and a power cut may undo that."""


@dataclass(eq=False, repr=False)
class Repairer:
    """Repairs MCAP files in place. The caller must know that nothing writes them any more.

    Files must lie below `root`, and no symbolic link below it is followed.
    """

    reader: BagReader
    writer: BagWriter
    root: Path = Path("/")

    def is_whole(self, path: Path) -> bool:
        """Whether the writer of a file finished it, so that there is nothing to repair.

        Raises:
            BagVanishedError: the file does not exist.
            BagError: the file cannot be opened, or is no MCAP file.
        """
        is_closed = self.reader.is_finished(path)
        if is_closed:
            # A file that is no bag at all counts as closed; this raises for it.
            self.reader.channels(path)
        return is_closed

    def repair(self, path: Path) -> Repaired | None:
        """Repairs one file; returns None if its writer had finished it.

        Raises:
            BagVanishedError: the file does not exist.
            BagError: the file cannot be repaired, and is unchanged.
        """
        try:
            with open_folder(self.root, path.absolute()) as here:
                return self._rewrite_if_open(here, path)
        except BagError as error:
            # The error has the path below the open directory in /proc.
            raise type(error)(str(path), error.reason) from error
        except FileNotFoundError as error:
            raise BagVanishedError(str(path), "the file is not there any more") from error
        except OSError as error:
            raise BagError(
                str(path), f"it cannot be repaired: {error.strerror or error}"
            ) from error

    def correct_metadata(self, recording: Path) -> bool:
        """Rewrites metadata.yaml from the files' contents; returns whether it had to be."""
        with directories.opened(self.root, recording.absolute()):
            return correct(recording, self.reader)

    def _rewrite_if_open(self, here: Path, path: Path) -> Repaired | None:
        before = here.lstat()
        if not stat.S_ISREG(before.st_mode):
            raise BagError(str(here), "not a regular file")
        if not before.st_size:
            return Repaired(0, notes=_unflushed(lambda: delete_file(here)))
        if self.reader.is_finished(path):
            return None
        with new_file_beside(here) as new:
            result = self.writer.rewrite(here, new)
            _give_attributes(new, before, before.st_mtime_ns)
            size = new.stat().st_size
            notes = result.notes + _unflushed(lambda: replace_file(new, here, before))
        return Repaired(before.st_size, size, result, notes)


def _unflushed(change: Callable[[], None]) -> tuple[str, ...]:
    """Changes a file; returns a note if a power cut may undo that."""
    try:
        change()
    except UnflushedError as error:
        return (str(error),)
    return ()


@contextmanager
def open_folder(root: Path, path: Path) -> Iterator[Path]:
    """Yields the path of a file in its open folder, which stays valid if the folder is renamed.

    Raises:
        OSError: the folder cannot be opened, or lies behind a link below the root.
    """
    with directories.opened(root, path.parent) as folder:
        yield Path(f"/proc/self/fd/{folder}", path.name)


def _give_attributes(new: Path, before: os.stat_result, mtime_ns: Ns) -> None:
    """Gives a file the mode and access time of another, `mtime_ns`, and if permitted its owner."""
    new.chmod(stat.S_IMODE(before.st_mode))
    with suppress(OSError):
        os.chown(new, before.st_uid, before.st_gid)
    os.utime(new, ns=(before.st_atime_ns, mtime_ns))


@contextmanager
def rewrite_without(
    bag_dir: Path,
    path: Path,
    before: os.stat_result,
    writer: BagWriter,
    *,
    takes: Callable[[str, Ns, Ns], bool],
    expected: Counter[str],
) -> Iterator[Path]:
    """Rewrites a bag without some messages; yields the new file beside the old one.

    After the block, the new file takes the name of the old one.

    Args:
        bag_dir: the bag directory; no folder between it and the file may be a link.
        path: the old file.
        before: the status of the old file, which must not change meanwhile.
        writer: rewrites the file.
        takes: whether a message goes, by topic, log time and publish time.
        expected: how many messages go, by topic.

    Raises:
        EpisodicError: the file cannot be rewritten, or another program rewrites it; it is
            unchanged.
        UnflushedError: it was rewritten, and a power cut may undo that.
        OSError: the file cannot be rewritten, or is another one now.
    """
    with open_folder(bag_dir, path) as here, here.open("rb") as old:
        try:
            fcntl.flock(old, fcntl.LOCK_EX | fcntl.LOCK_NB)  # `forget` runs beside the recorder
        except BlockingIOError as error:
            raise BagError(str(path), "another program rewrites it; try again") from error
        with new_file_beside(here) as new:
            if writer.cut(here, new, takes) != expected:
                raise BagError(str(path), "its contents changed meanwhile")
            # A nanosecond later: nobody may take the new file for the old one.
            _give_attributes(new, before, before.st_mtime_ns + 1)
            yield new
            replace_file(new, here, before)


def replace_file(new: Path, path: Path, before: os.stat_result) -> None:
    """Renames a new file to `path`, where the file must still be as it was `before`.

    Raises:
        UnflushedError: it was renamed, and a power cut may undo that.
        OSError: another file lies there, or none, or it was written to.
    """
    after = path.lstat()
    if any(getattr(after, key) != getattr(before, key) for key in _CONTENT):
        raise OSError(f"{path.name} was written to meanwhile, or is another file")
    new.replace(path)
    _flush_change(path)


def delete_file(path: Path) -> None:
    """Deletes a file.

    Raises:
        UnflushedError: it was deleted, and a power cut may undo that.
        OSError: it cannot be deleted.
    """
    path.unlink()
    _flush_change(path)


def _flush_change(path: Path) -> None:
    try:
        flush(path.parent)
    except OSError as error:
        reason = error.strerror or error
        raise UnflushedError(
            f"{path.name} was changed, and a power cut may undo that: {reason}"
        ) from error


def correct_metadata_files(
    bag_dir: Path, recordings: Collection[Path], reader: BagReader
) -> list[str]:
    """Corrects each recording's metadata.yaml to the bags that are left; returns notes on it."""
    notes: list[str] = []
    for recording in sorted(recordings):
        folder = os.path.relpath(recording, bag_dir)
        name = f"{folder}/{METADATA_FILE}"
        if not (recording / METADATA_FILE).exists():
            if folder in read_heartbeat(bag_dir).recordings:
                notes.append(
                    f"{name} will count what was deleted, too: the recorder writes it at the end"
                )
            continue
        try:
            with directories.opened(bag_dir, recording):
                if correct(recording, reader):
                    notes.append(f"{name} describes what is left")
        except (BagError, OSError, ValueError) as error:
            notes.append(
                f"{name} still describes what was deleted ({error}); rosbag2 opens the folder "
                f"after `ros2 bag reindex {recording}`"
            )
    return notes


def open_files() -> frozenset[Identity]:
    """Returns device and inode of every open file that /proc shows."""
    inodes: set[Identity] = set()
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError), os.scandir(process / "fd") as descriptors:
            for descriptor in descriptors:
                with suppress(OSError):
                    status = descriptor.stat()
                    inodes.add((status.st_dev, status.st_ino))
    return frozenset(inodes)


def reason_of(error: Exception) -> str:
    """Returns the reason of an error, without its path."""
    if isinstance(error, BagError):
        return error.reason
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return str(error)
