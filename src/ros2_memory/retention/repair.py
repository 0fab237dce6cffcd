"""Rewrites bags in place: those that a crash left open, and those of which messages go.

A file of 0 bytes is removed: nothing had reached the disk. A truncated file is rewritten beside
itself from all that can be read of it, read back, compared and flushed. Only then does it take the
name of the original, which is left as it is in every other case.
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
from ros2_memory.retention.delete import beside
from ros2_memory.storage.base import BagReader, BagWriter, Closing, Rewritten

if TYPE_CHECKING:
    from collections import Counter
    from collections.abc import Callable, Collection, Iterator

    from ros2_memory.core.timebase import Ns

Identity = tuple[int, int]
_CONTENT: Final = ("st_ino", "st_size", "st_mtime_ns")


class Repaired(NamedTuple):
    """The result of repairing one file.

    `was_bytes` and `is_bytes` are its sizes before and after. `rewritten` describes what was
    recovered; it is None for an empty file, which was removed.
    """

    was_bytes: int
    is_bytes: int = 0
    rewritten: Rewritten | None = None


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
            BagVanishedError: it does not exist.
            BagError: it cannot be opened, or is no MCAP file.
        """
        is_closed = self.reader.closing(path) is Closing.CLOSED
        if is_closed:
            # A file that is no bag at all counts as closed; this raises for it.
            self.reader.channels(path)
        return is_closed

    def repair(self, path: Path) -> Repaired | None:
        """Repairs one file; returns None if its writer had finished it.

        Raises:
            BagVanishedError: it does not exist.
            BagError: it cannot be repaired, and is unchanged.
        """
        try:
            with opened_folder(self.root, path.absolute()) as here:
                return self._rewrite_if_open(here, path)
        except BagError as error:
            # With the name of the file in place of that of the open directory.
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
            here.unlink()
            flush(here.parent)
            return Repaired(0)
        if self.reader.closing(path) is Closing.CLOSED:
            return None
        with beside(here) as new:
            result = self.writer.rewrite(here, new)
            _give_attributes(new, before, before.st_mtime_ns)
            after = here.lstat()
            if any(getattr(after, key) != getattr(before, key) for key in _CONTENT):
                raise BagError(str(here), "it was written to while it was being repaired")
            new.replace(here)
        flush(here.parent)
        return Repaired(before.st_size, here.stat().st_size, result)


@contextmanager
def opened_folder(root: Path, path: Path) -> Iterator[Path]:
    """Yields the path of a file in its open folder, even if another takes that one's name.

    Raises:
        OSError: the folder cannot be opened, or lies behind a link below the root.
    """
    with directories.opened(root, path.parent) as folder:
        yield Path(f"/proc/self/fd/{folder}", path.name)


def _give_attributes(new: Path, before: os.stat_result, mtime_ns: Ns) -> None:
    """Gives a file the mode and, where that is allowed, the owner of another; and its times."""
    new.chmod(stat.S_IMODE(before.st_mode))
    with suppress(OSError):
        os.chown(new, before.st_uid, before.st_gid)
    os.utime(new, ns=(before.st_atime_ns, mtime_ns))


@contextmanager
def rewritten(
    bag_dir: Path,
    path: Path,
    before: os.stat_result,
    writer: BagWriter,
    *,
    takes: Callable[[str, Ns, Ns], bool],
    expected: Counter[str],
) -> Iterator[Path]:
    """Yields the new file, beside the old one; it takes the name of the old one after the block.

    Args:
        bag_dir: the bag directory, behind no link in which the file must lie.
        path: the old file.
        before: its status; the file must still be the same at the end.
        writer: rewrites it.
        takes: whether a message goes, by topic, log time and publish time.
        expected: how many messages go, by topic.

    Raises:
        EpisodicError: it cannot be rewritten, or another program rewrites it; nothing is changed.
        OSError: likewise, or it is another file now; or the folder of the new one cannot be
            flushed.
    """
    with opened_folder(bag_dir, path) as here, here.open("rb") as old:
        try:
            fcntl.flock(old, fcntl.LOCK_EX | fcntl.LOCK_NB)  # `forget` runs beside the recorder
        except BlockingIOError as error:
            raise BagError(str(path), "another program rewrites it; try again") from error
        with beside(here) as new:
            if writer.cut(here, new, takes) != expected:
                raise BagError(str(path), "its contents changed meanwhile")
            # A nanosecond later: nobody may take the new file for the old one.
            _give_attributes(new, before, before.st_mtime_ns + 1)
            yield new
            replace_file(new, here, (before.st_dev, before.st_ino))


def replace_file(new: Path, path: Path, inode: Identity) -> None:
    """Gives a file the name of another, which must still be the one that was read.

    Raises:
        OSError: it is not, or has gone; or it has the name, but the folder cannot be flushed.
    """
    status = path.lstat()
    if (status.st_dev, status.st_ino) != inode:
        raise OSError(f"{path.name} is not the file that was read")
    new.replace(path)
    flush(path.parent)


def metadata_corrected(
    bag_dir: Path, recordings: Collection[Path], reader: BagReader
) -> Iterator[str]:
    """Has each recording's metadata.yaml describe the bags that are left; yields a line for each.

    Where a recorder is still to write it, that counts what has gone, too.
    """
    for recording in sorted(recordings):
        folder = os.path.relpath(recording, bag_dir)
        name = f"{folder}/{METADATA_FILE}"
        if not (recording / METADATA_FILE).exists():
            if folder in read_heartbeat(bag_dir).recordings:
                yield f"{name} will count what was deleted, too: the recorder writes it at the end"
            continue
        try:
            with directories.opened(bag_dir, recording):
                if correct(recording, reader):
                    yield f"{name} describes what is left"
        except (BagError, OSError, ValueError) as error:
            yield (
                f"{name} still describes what was deleted ({error}); rosbag2 opens the folder "
                f"after `ros2 bag reindex {recording}`"
            )


def open_files() -> frozenset[tuple[int, int]]:
    """Returns device and inode of every open file that /proc shows."""
    inodes: set[tuple[int, int]] = set()
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
    return (error.strerror or str(error)) if isinstance(error, OSError) else str(error)
