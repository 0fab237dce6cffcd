"""A reader that reads through another one: what stands between says only what it adds."""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING

from ros2_memory.storage.base import BagReader

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.core.model import BagSummary, TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.storage.base import CdrLayout, Channel, Closing, Record


class LayeredReader(BagReader):
    """Answers every question as the reader beneath does.

    A subclass says where that one is to look (`_looked_at`, `_read_from`), or answers a question
    itself. It may choose which messages are read, but not what they say: the innermost reader is
    asked for that directly, as it is asked of every message.
    """

    def __init__(self, reader: BagReader) -> None:
        self._reader = reader
        self._decoder: BagReader = reader._decoder if isinstance(reader, LayeredReader) else reader

    def _looked_at(self, path: Path) -> Path:
        """The file whose state and summary are given for this path; may refuse with a BagError."""
        return path

    def _read_from(self, path: Path) -> Path:
        """The file whose messages are given for this path; may refuse with a BagError."""
        return path

    def reads(self, path: Path) -> bool:
        """As the reader beneath."""
        return self._reader.reads(path)

    def closing(self, path: Path) -> Closing:
        """As the reader beneath."""
        return self._reader.closing(self._looked_at(path))

    def summarize(self, path: Path) -> BagSummary:
        """As the reader beneath."""
        return self._reader.summarize(self._looked_at(path))

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
            there = self._read_from(path)
            yield self._reader.records(there, topics, window, newest_first=newest_first)

        # Not a generator, which would end where some messages are lost.
        return chain.from_iterable(found())

    def newest(self, path: Path, topic: str, window: TimeWindow) -> Record | None:
        """As the reader beneath."""
        return self._reader.newest(self._read_from(path), topic, window)

    def log_times(self, path: Path, topic: str, window: TimeWindow) -> Sequence[Ns]:
        """As the reader beneath."""
        return self._reader.log_times(self._read_from(path), topic, window)

    def channels(self, path: Path) -> Sequence[Channel]:
        """As the reader beneath."""
        return self._reader.channels(self._read_from(path))

    def profile(self, path: Path) -> str:
        """As the reader beneath."""
        return self._reader.profile(self._read_from(path))

    def undecodable(self, channel: Channel) -> str | None:
        """As the innermost reader."""
        return self._decoder.undecodable(channel)

    def decode(self, record: Record) -> object:
        """As the innermost reader."""
        return self._decoder.decode(record)

    def layout(self, record: Record) -> CdrLayout | None:
        """As the innermost reader."""
        return self._decoder.layout(record)
