"""Which paths are hard links of one bag: where it was recorded, and the moments that save it.

A saved moment has a bag under its path in the bag directory, so one path gives the others:

    rec_A/rec_A_7.mcap
    moments/20261120T043012Z-charging/rec_A/rec_A_7.mcap
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ros2_memory.bag_dir.layout import MOMENTS_FOLDER

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable
    from pathlib import Path


class HardLinks:
    """The known links in saved moments of one bag directory. Paths are strings, as scans have them.

    Attributes:
        known: the links that were added.
    """

    def __init__(self, bag_dir: Path) -> None:
        self._root = f"{str(bag_dir).rstrip('/')}/"
        self._moments = f"{self._root}{MOMENTS_FOLDER}/"
        self._links: dict[str, set[str]] = {}
        self.known: set[str] = set()

    def is_saved(self, path: str) -> bool:
        """Returns whether a path lies in the folder of the saved moments."""
        return path.startswith(self._moments)

    def saved_among(self, paths: Iterable[str]) -> list[str]:
        """Returns the paths that `is_saved` is true of; for 60,000 at once."""
        moments = self._moments
        return [path for path in paths if path.startswith(moments)]

    def recorded_as(self, path: str) -> str:
        """Returns where the bag of a saved moment was recorded; any other path as it is."""
        if not self.is_saved(path):
            return path
        _, slash, name = path[len(self._moments) :].partition("/")
        return f"{self._root}{name}" if slash else path

    def add(self, path: str) -> None:
        """Adds a file that was found, if it lies in a saved moment."""
        if self.is_saved(path):
            self.known.add(path)
            self._links.setdefault(self.recorded_as(path), set()).add(path)

    def discard(self, path: str) -> None:
        """Removes a file that has gone."""
        if path in self.known:
            self.known.discard(path)
            recorded = self.recorded_as(path)
            self._links[recorded].discard(path)
            if not self._links[recorded]:
                del self._links[recorded]

    def of(self, path: str) -> Collection[str]:
        """Returns the links in moments of a bag, given by any of its paths."""
        return self._links.get(self.recorded_as(path), ()) if self._links else ()

    def before(self, path: str) -> list[str]:
        """Returns the paths preferred to this link: where the bag was recorded, then by name."""
        if path not in self.known:
            return []
        others = sorted(name for name in self.of(path) if name < path)
        return [self.recorded_as(path), *others]
