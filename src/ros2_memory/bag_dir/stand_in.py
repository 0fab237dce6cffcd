"""A reader that finds a kept bag under its other name when the one that is known has gone.

Between its look and a question some seconds pass, in which retention may delete where a bag was
recorded. What a moment keeps of it is the same file.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from ros2_memory.bag_dir.hard_links import HardLinks
from ros2_memory.bag_dir.layered import LayeredReader
from ros2_memory.bag_dir.moment_file import moments_of

if TYPE_CHECKING:
    from ros2_memory.storage.base import BagReader


class StandInReader(LayeredReader):
    """Reads through another reader. The index is told how things are: only messages are found."""

    def __init__(self, reader: BagReader, root: Path) -> None:
        super().__init__(reader)
        self._root = root
        self._names = HardLinks(root)

    def _read_from(self, path: Path) -> Path:
        """The path, or another name of the bag where there is nothing of that one."""
        if os.path.lexists(path):
            return path
        recorded = Path(self._names.recorded_as(str(path)))
        name = os.path.relpath(recorded, self._root)
        names = [recorded]
        with suppress(OSError):
            names += (folder / name for folder in sorted(moments_of(self._root).iterdir()))
        return next((each for each in names if os.path.lexists(each)), path)
