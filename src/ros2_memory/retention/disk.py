"""The disk of the bag directory: is it still the one on which recording began, and what fails?

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
"""So long it is tried again what the disk refuses; after that it counts as lost."""
_READ_BETWEEN_S: Final = 3600.0
"""What is tried every minute and has not failed for so long was read, and fails anew."""


def free_bytes(directory: Path) -> int:
    """Returns the bytes that the file system of a directory has left for this user.

    Raises:
        OSError: it cannot be measured.
    """
    return shutil.disk_usage(directory).free


def device_of(directory: Path) -> int:
    """Returns the device that a directory lies on, or would lie on if it were made.

    Raises:
        OSError: it cannot be looked at.
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
        """Whether another disk lies there now; the answer from before if that cannot be read.

        A disk may come back under another device number, so one with a recording of this run is
        taken for the same.

        Args:
            recordings: those that are being written and exist.
        """
        if recordings and not self.away:
            self._recordings = frozenset(recordings)
        try:
            device = self._device_of(self._bag_dir)
            is_other = device != self._device
            if is_other and any((self._bag_dir / name).is_dir() for name in self._recordings):
                self._device = device
        except OSError:
            return self.away
        self.away = device != self._device
        return self.away


class FailingFiles:
    """Since when the disk fails to read files, so that those bad for good are given up."""

    def __init__(self, monotonic: Callable[[], float]) -> None:
        self._monotonic = monotonic
        self._failed: dict[Path, tuple[float, float]] = {}

    def may_recover(self, path: Path, error: Exception) -> bool:
        """Returns whether the disk fails to read a file, and has done so for less than `RETRIED_S`.

        `error` is what reading the file raised now.
        """
        if not isinstance(error, BagUnreachableError):
            return False
        now = self._monotonic()
        first, last = self._failed.get(path, (now, now))
        if now - last > _READ_BETWEEN_S:
            first = now
        self._failed[path] = first, now
        return now - first < RETRIED_S
