"""A reader that keeps to one directory.

The index follows no link inside the bag directory. But some seconds lie between its look and a
question, in which a directory can be moved away and a link to elsewhere put in its place. The last
part of a path is held by the open itself (`O_NOFOLLOW`); this looks at those before it.
"""

from __future__ import annotations

import os
import stat
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.layered import LayeredReader
from ros2_memory.core.errors import BagError, BagVanishedError

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.storage.base import BagReader

_LINK: Final = "it lies behind a symbolic link, which is not followed"


class ConfinedReader(LayeredReader):
    """Reads through another reader, and only what lies below `root`, through no link inside it.

    The root itself may be a link, or lie behind one.
    """

    def __init__(self, reader: BagReader, root: Path) -> None:
        super().__init__(reader)
        self._root = f"{str(root).rstrip(os.sep)}{os.sep}"

    def _looked_at(self, path: Path) -> Path:
        """The path, which must lie below the root, and not behind a link there.

        Raises:
            BagVanishedError: a directory on the way is not there.
            BagError: it is not inside.
        """
        text = str(path)
        folders = text[len(self._root) :].split("/")[:-1]
        if not text.startswith(self._root) or os.pardir in folders:
            raise BagError(text, "it does not lie in the bag directory")
        way = self._root
        for folder in folders:
            way = f"{way}{folder}"
            try:
                mode = os.lstat(way).st_mode
            except OSError as error:
                raise BagVanishedError(text, "the file is not there any more") from error
            if stat.S_ISLNK(mode):
                raise BagError(text, _LINK)
            way += os.sep
        return path

    _read_from = _looked_at
