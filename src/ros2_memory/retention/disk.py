"""Whether the bag directory lies on the disk that it lay on when recording began.

Where a disk is unmounted under a running recorder, the bag directory's path names a directory of
the disk below it, mostly the one that the system runs from, which recordings would fill.
"""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Collection
    from pathlib import Path


def free_bytes(directory: Path) -> int:
    """What the file system of a directory has left for this user.

    Raises:
        OSError: it cannot be measured.
    """
    return shutil.disk_usage(directory).free


def device_of(directory: Path) -> int:
    """The device that a directory lies on, or would lie on if it were made.

    Raises:
        OSError: it cannot be told.
    """
    for existing in (directory, *directory.parents):
        try:
            return existing.stat().st_dev
        except FileNotFoundError:
            continue
    raise FileNotFoundError(f"{directory} lies nowhere")


class HomeDisk:
    """The disk that a bag directory lay on at first."""

    def __init__(self, bag_dir: Path, device: Callable[[Path], int] = device_of) -> None:
        self._bag_dir = bag_dir
        self._device_of = device
        self._device: int | None = None
        self._recordings: frozenset[str] = frozenset()
        self._away = False

    def remember(self) -> None:
        """Takes the disk that the bag directory lies on for its own.

        Raises:
            OSError: it cannot be told which it is.
        """
        self._device = self._device_of(self._bag_dir)
        self._away = False

    def is_away(self, recordings: Collection[str]) -> bool:
        """Whether another disk lies there; as before where that cannot be told.

        A disk may come back under another number, so one that has a recording of this run is it.

        Args:
            recordings: those that are being written and exist.
        """
        if recordings and not self._away:
            self._recordings = frozenset(recordings)
        try:
            device = self._device_of(self._bag_dir)
            if device != self._device and self._has_recordings():
                self._device = device
        except OSError:
            return self._away
        self._away = device != self._device
        return self._away

    def _has_recordings(self) -> bool:
        return any((self._bag_dir / name).is_dir() for name in self._recordings)
