"""A reader that finds a kept bag under its other name when the one that is known has gone.

Between its look and a question some seconds pass, in which retention may delete where a bag was
recorded. What a moment keeps of it is the same file.
"""

from __future__ import annotations

import os
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from ros2_memory.recorder.keepsake import moments_of
from ros2_memory.recorder.kept_names import KeptNames
from ros2_memory.storage.base import BagReader

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from ros2_memory.model import BagSummary, TimeWindow
    from ros2_memory.storage.base import Channel, Closing, Layout, Record
    from ros2_memory.timebase import Ns


class StandInReader(BagReader):
    """Reads through another reader. The index is told how things are: only messages are found."""

    def __init__(self, reader: BagReader, root: Path) -> None:
        self._reader = reader
        self._root = root
        self._names = KeptNames(root)

    def reads(self, path: Path) -> bool:
        """As the reader beneath."""
        return self._reader.reads(path)

    def closing(self, path: Path) -> Closing:
        """As the reader beneath."""
        return self._reader.closing(path)

    def summarize(self, path: Path) -> BagSummary:
        """As the reader beneath."""
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
            there = self._there(path)
            yield self._reader.records(there, topics, window, newest_first=newest_first)

        # Not a generator, which would end where some messages are lost.
        return chain.from_iterable(found())

    def newest(self, path: Path, topic: str, window: TimeWindow) -> Record | None:
        """As the reader beneath."""
        return self._reader.newest(self._there(path), topic, window)

    def log_times(self, path: Path, topic: str, window: TimeWindow) -> Sequence[Ns]:
        """As the reader beneath."""
        return self._reader.log_times(self._there(path), topic, window)

    def channels(self, path: Path) -> Sequence[Channel]:
        """As the reader beneath."""
        return self._reader.channels(self._there(path))

    def undecodable(self, channel: Channel) -> str | None:
        """As the reader beneath."""
        return self._reader.undecodable(channel)

    def decode(self, record: Record) -> object:
        """As the reader beneath."""
        return self._reader.decode(record)

    def layout(self, record: Record) -> Layout | None:
        """As the reader beneath."""
        return self._reader.layout(record)

    def _there(self, path: Path) -> Path:
        """The path, or another name of the bag where there is nothing of that one."""
        if os.path.lexists(path):
            return path
        recorded = Path(self._names.recorded_as(str(path)))
        name = os.path.relpath(recorded, self._root)
        names = [recorded]
        with suppress(OSError):
            names += (folder / name for folder in sorted(moments_of(self._root).iterdir()))
        return next((each for each in names if os.path.lexists(each)), path)
