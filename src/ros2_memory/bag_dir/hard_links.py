"""Where the bag of a saved moment was recorded.

A saved moment has a bag, by a hard link, under its path in the bag directory, so one path gives the
other:

    rec_A/rec_A_7.mcap
    moments/20261120T043012Z-charging/rec_A/rec_A_7.mcap
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ros2_memory.bag_dir.layout import MOMENTS_FOLDER

if TYPE_CHECKING:
    from pathlib import Path


class HardLinks:
    """The links in saved moments of one bag directory. Paths are strings, as scans have them."""

    def __init__(self, bag_dir: Path) -> None:
        self._root = f"{str(bag_dir).rstrip('/')}/"
        self._moments = f"{self._root}{MOMENTS_FOLDER}/"

    def is_saved(self, path: str) -> bool:
        """Returns whether a path lies in the folder of the saved moments."""
        return path.startswith(self._moments)

    def recorded_as(self, path: str) -> str:
        """Returns where the bag of a saved moment was recorded; any other path as it is."""
        _, slash, name = path[len(self._moments) :].partition("/")
        return f"{self._root}{name}" if slash and self.is_saved(path) else path
