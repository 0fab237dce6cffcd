"""A reader that keeps to one directory.

The index follows no link inside the bag directory. But some seconds lie between its look and a
question, in which a directory can be moved away and a link to elsewhere put in its place. The last
part of a path is held by the open itself (`O_NOFOLLOW`); this looks at those before it.
"""

from __future__ import annotations

import os
import stat
from itertools import chain
from typing import TYPE_CHECKING, Final

from ros2_memory.errors import BagError, BagVanishedError
from ros2_memory.storage.base import BagReader

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.model import BagSummary, TimeWindow
    from ros2_memory.storage.base import Channel, Closing, Layout, Record
    from ros2_memory.timebase import Ns

_LINK: Final = "it lies behind a symbolic link, which is not followed"


class ConfinedReader(BagReader):
    """Reads through another reader, and only what lies below `root`, through no link inside it.

    The root itself may be a link, or lie behind one.
    """

    def __init__(self, reader: BagReader, root: Path) -> None:
        self._reader = reader
        self._root = f"{str(root).rstrip(os.sep)}{os.sep}"

    def reads(self, path: Path) -> bool:
        """As the reader beneath."""
        return self._reader.reads(path)

    def closing(self, path: Path) -> Closing:
        """As the reader beneath."""
        self._require_inside(path)
        return self._reader.closing(path)

    def summarize(self, path: Path) -> BagSummary:
        """As the reader beneath."""
        self._require_inside(path)
        return self._reader.summarize(path)

    def records(
        self,
        path: Path,
        topics: Collection[str],
        window: TimeWindow,
        *,
        newest_first: bool = False,
    ) -> Iterator[Record]:
        """As the reader beneath."""

        def found() -> Iterator[Iterator[Record]]:
            self._require_inside(path)
            yield self._reader.records(path, topics, window, newest_first=newest_first)

        # Not a generator, which would end where some messages are lost.
        return chain.from_iterable(found())

    def newest(self, path: Path, topic: str, window: TimeWindow) -> Record | None:
        """As the reader beneath."""
        self._require_inside(path)
        return self._reader.newest(path, topic, window)

    def log_times(self, path: Path, topic: str, window: TimeWindow) -> Sequence[Ns]:
        """As the reader beneath."""
        self._require_inside(path)
        return self._reader.log_times(path, topic, window)

    def channels(self, path: Path) -> Sequence[Channel]:
        """As the reader beneath."""
        self._require_inside(path)
        return self._reader.channels(path)

    def undecodable(self, channel: Channel) -> str | None:
        """As the reader beneath."""
        return self._reader.undecodable(channel)

    def decode(self, record: Record) -> object:
        """As the reader beneath."""
        return self._reader.decode(record)

    def layout(self, record: Record) -> Layout | None:
        """As the reader beneath."""
        return self._reader.layout(record)

    def _require_inside(self, path: Path) -> None:
        """Refuses what is not below the root, or only through a link.

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
