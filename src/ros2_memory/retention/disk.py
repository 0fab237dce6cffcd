"""Whether the bag directory still lies on the disk on which recording began, and reads that fail.

When a disk is unmounted under a running recorder, the path of the bag directory names a directory
of the disk below it, mostly the system disk, which recordings would fill.
"""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING, Final

from ros2_memory.core.errors import BagUnreachableError

if TYPE_CHECKING:
    from collections.abc import Callable, Collection
    from pathlib import Path

RETRIED_S: Final = 86_400.0
"""How long an operation that the disk refuses is tried again; then the data counts as lost."""
_READ_BETWEEN_S: Final = 3600.0
"""A file is tried every minute. One that has not failed for so long was read in between."""


def free_bytes(directory: Path) -> int:
    """Returns the bytes that the file system of a directory has left for this user.

    Raises:
        OSError: it cannot be measured.
    """
    return shutil.disk_usage(directory).free


def device_of(directory: Path) -> int:
    """Returns the device of a directory, or of its nearest parent that exists.

    Raises:
        OSError: the directory cannot be looked at.
    """
    for existing in (directory, *directory.parents):
        try:
            return existing.stat().st_dev
        except FileNotFoundError:
            continue
    raise FileNotFoundError(f"{directory} has no existing parent")


class HomeDisk:
    """The disk that a bag directory lay on when recording began.

    Attributes:
        away: the last answer of `is_away`.
    """

    def __init__(self, bag_dir: Path, device: Callable[[Path], int]) -> None:
        self._bag_dir = bag_dir
        self._device_of = device
        self._device: int | None = None
        self._recordings: frozenset[str] = frozenset()
        self.away = False

    def remember(self) -> None:
        """Remembers the disk that the bag directory lies on now.

        Raises:
            OSError: it cannot be looked at.
        """
        self._device = self._device_of(self._bag_dir)
        self.away = False

    def is_away(self, recordings: Collection[str]) -> bool:
        """Whether the bag directory lies on another disk now; the last answer if that is unknown.

        A disk may come back under another device number, so a disk with a recording of this run
        counts as the same.

        Args:
            recordings: the recordings that are being written and exist.
        """
        if recordings and not self.away:
            self._recordings = frozenset(recordings)
        try:
            device = self._device_of(self._bag_dir)
            if device != self._device and any(
                (self._bag_dir / name).is_dir() for name in self._recordings
            ):
                self._device = device
        except OSError:
            return self.away
        self.away = device != self._device
        return self.away


class FailingFiles:
    """Remembers since when the disk fails to read files, to give up the ones that are bad."""

    def __init__(self, monotonic: Callable[[], float]) -> None:
        self._monotonic = monotonic
        self._failed: dict[Path, tuple[float, float]] = {}

    def may_recover(self, path: Path, error: Exception) -> bool:
        """Returns whether to try a file again, whose reading has just raised `error`.

        That is so while the disk has failed to read it for less than `RETRIED_S`.
        """
        if not isinstance(error, BagUnreachableError):
            return False
        now = self._monotonic()
        long_ago = now - _READ_BETWEEN_S
        # In order of their last failure: files that were read since, or are gone, are forgotten.
        while self._failed and next(iter(self._failed.values()))[1] < long_ago:
            del self._failed[next(iter(self._failed))]
        first, _ = self._failed.pop(path, (now, now))
        self._failed[path] = first, now
        return now - first < RETRIED_S
