"""Repairs bags that a crash left open: each keeps its name and is whole afterwards.

A file of 0 bytes is removed: nothing had reached the disk. A truncated file is rewritten beside
itself from all that can be read of it, read back, compared and flushed. Only then does it take the
name of the original, which is left as it is in every other case.
"""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ros2_memory.bag_dir.durable_write import flush
from ros2_memory.bag_dir.metadata_yaml import correct
from ros2_memory.core import directories
from ros2_memory.core.errors import BagError, BagVanishedError
from ros2_memory.retention.rewriting import beside, give_attributes
from ros2_memory.storage.base import BagReader, BagWriter, Closing, Rewritten

if TYPE_CHECKING:
    from collections.abc import Callable


@dataclass(frozen=True, slots=True)
class Repaired:
    """The result of repairing one file.

    `was_bytes` and `is_bytes` are its sizes before and after. `rewritten` describes what was
    recovered; it is None for an empty file, which was removed.
    """

    was_bytes: int
    is_bytes: int = 0
    rewritten: Rewritten | None = None


class Repairer:
    """Repairs MCAP files in place. The caller must know that nothing writes them any more.

    Files must lie below `root`, and no symbolic link below it is followed.
    """

    def __init__(self, reader: BagReader, writer: BagWriter, root: Path = Path("/")) -> None:
        self._reader = reader
        self._writer = writer
        self._root = root

    def is_whole(self, path: Path) -> bool:
        """Whether the writer of a file finished it, so that there is nothing to repair.

        Raises:
            BagVanishedError: it does not exist.
            BagError: it cannot be opened, or is no MCAP file.
        """
        whole = self._reader.closing(path) is Closing.CLOSED
        if whole:
            # A file that is no bag at all counts as closed; this raises for it.
            self._reader.channels(path)
        return whole

    def repair(self, path: Path, progress: Callable[[int], None] | None = None) -> Repaired | None:
        """Repairs one file; returns None if its writer had finished it.

        `progress` is called with the number of bytes read so far.

        Raises:
            BagVanishedError: it does not exist.
            BagError: it cannot be repaired, and is unchanged.
        """
        try:
            with directories.opened(self._root, path.parent.absolute()) as folder:
                # The open directory itself, even if something else takes its name meanwhile.
                here = Path(f"/proc/self/fd/{folder}", path.name)
                return self._repair(here, path, progress)
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
        with directories.opened(self._root, recording.absolute()):
            return correct(recording, self._reader)

    def _repair(
        self, here: Path, path: Path, progress: Callable[[int], None] | None
    ) -> Repaired | None:
        before = _status(here)
        if not before.st_size:
            here.unlink()
            flush(here.parent)
            return Repaired(0)
        if self._reader.closing(path) is Closing.CLOSED:
            return None
        return self._rewrite(here, before, progress)

    def _rewrite(
        self, path: Path, before: os.stat_result, progress: Callable[[int], None] | None
    ) -> Repaired:
        with beside(path) as new:
            rewritten = self._writer.rewrite(path, new, progress)
            give_attributes(new, before, before.st_mtime_ns)
            _require_same(path, before)
            new.replace(path)
        flush(path.parent)
        return Repaired(before.st_size, path.stat().st_size, rewritten)


def open_files() -> frozenset[tuple[int, int]]:
    """Returns device and inode of every open file that /proc shows."""
    found: set[tuple[int, int]] = set()
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError), os.scandir(process / "fd") as descriptors:
            for each in descriptors:
                with suppress(OSError):
                    status = each.stat()
                    found.add((status.st_dev, status.st_ino))
    return frozenset(found)


def _status(path: Path) -> os.stat_result:
    """Returns the status of a regular file.

    Raises:
        BagError: it is something else.
        OSError: its status cannot be read.
    """
    status = path.lstat()
    if not stat.S_ISREG(status.st_mode):
        raise BagError(str(path), "not a regular file")
    return status


def _require_same(path: Path, before: os.stat_result) -> None:
    after = _status(path)
    for each in ("st_ino", "st_size", "st_mtime_ns"):
        if getattr(after, each) != getattr(before, each):
            raise BagError(str(path), "it was written to while it was being repaired")
