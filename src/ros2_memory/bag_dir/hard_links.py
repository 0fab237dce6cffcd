"""Which paths are names of one bag: where it was recorded, and the moments that keep it.

A moment has a bag under the name that it has in the bag directory, so one name tells the others:

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
    """The names in moments that are known below one root. Paths are texts, as a scan has them."""

    def __init__(self, root: Path) -> None:
        self._root = f"{str(root).rstrip('/')}/"
        self._moments = f"{self._root}{MOMENTS_FOLDER}/"
        self._kept: dict[str, set[str]] = {}
        self.known: set[str] = set()
        """Those in moments."""

    def is_kept(self, path: str) -> bool:
        """Whether a path lies in the folder of the moments."""
        return path.startswith(self._moments)

    def kept_among(self, paths: Iterable[str]) -> list[str]:
        """As `is_kept`, of 60,000 at once."""
        moments = self._moments
        return [path for path in paths if path.startswith(moments)]

    def recorded_as(self, path: str) -> str:
        """Where the bag of a moment was recorded; any other path is its own."""
        if not self.is_kept(path):
            return path
        _, slash, name = path[len(self._moments) :].partition("/")
        return f"{self._root}{name}" if slash else path

    def enter(self, path: str) -> None:
        """A file was found; only those in moments are noted."""
        if self.is_kept(path):
            self.known.add(path)
            self._kept.setdefault(self.recorded_as(path), set()).add(path)

    def leave(self, path: str) -> None:
        """A file has gone."""
        if path in self.known:
            self.known.discard(path)
            recorded = self.recorded_as(path)
            self._kept[recorded].discard(path)
            if not self._kept[recorded]:
                del self._kept[recorded]

    def of(self, path: str) -> Collection[str]:
        """The names in moments that a bag has, whichever of its names is given."""
        return self._kept.get(self.recorded_as(path), ()) if self._kept else ()

    def before(self, path: str) -> list[str]:
        """The other names that answer rather than this one: where it was recorded, then by name."""
        if path not in self.known:
            return []
        others = sorted(name for name in self.of(path) if name < path)
        return [self.recorded_as(path), *others]
