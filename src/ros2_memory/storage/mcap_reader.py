"""The adapter `mcap`: single `.mcap` files."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from ros2_memory.storage.base import BagReader
from ros2_memory.storage.decoding import Decoding
from ros2_memory.storage.errors import MAX_CHUNK_MB, raise_if_lost, reading
from ros2_memory.storage.mcap.bag_file import McapBags

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.core.model import BagSummary, TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.storage.base import CdrLayout, Channel, Closing, Record
    from ros2_memory.storage.errors import LostError


class McapReader(BagReader):
    """Reads `.mcap` files, with or without metadata.yaml beside them.

    Args:
        custom_msg_paths: folders of `.msg` files for types that a bag holds no definition of.
        cache_mb: what indexes and decompressed chunks may take of memory between calls.
        max_chunk_mb: what one chunk or one message may hold, decompressed; a larger one is not
            read.

    Raises:
        ConfigError: one of the paths cannot be used.
    """

    def __init__(
        self,
        custom_msg_paths: Sequence[Path | str] = (),
        cache_mb: int = 64,
        max_chunk_mb: int = MAX_CHUNK_MB,
    ) -> None:
        self._decoding = Decoding(custom_msg_paths)
        self._bags = McapBags(cache_mb, max_chunk_mb)

    def reads(self, path: Path) -> bool:
        """Whether its name ends on `.mcap`."""
        return path.suffix == ".mcap"

    def closing(self, path: Path) -> Closing:
        """Whether the closing magic is there."""
        with reading(path):
            return self._bags.closing(path)

    def summarize(self, path: Path) -> BagSummary:
        """Topics with exact counts and exact first and last log times."""
        with reading(path):
            return self._bags.summarize(path)

    def records(
        self,
        path: Path,
        topics: Collection[str],
        window: TimeWindow,
        *,
        newest_first: bool = False,
    ) -> Iterator[Record]:
        """The undecoded messages of `topics` inside the window, by log time."""

        def found() -> Iterator[Record | LostError]:
            with reading(path):
                yield from self._bags.records(path, topics, window, newest_first=newest_first)

        return map(partial(raise_if_lost, path), found())

    def newest(self, path: Path, topic: str, window: TimeWindow) -> Record | None:
        """The latest message of the topic inside the window."""
        with reading(path):
            return self._bags.newest(path, topic, window)

    def log_times(self, path: Path, topic: str, window: TimeWindow) -> Sequence[Ns]:
        """The log times of the topic inside the window, from the message indexes."""
        with reading(path):
            return self._bags.log_times(path, topic, window)

    def channels(self, path: Path) -> Sequence[Channel]:
        """Every channel that is declared in the file."""
        with reading(path):
            return self._bags.channels(path)

    def profile(self, path: Path) -> str:
        """The profile in the header of the file."""
        with reading(path):
            return self._bags.profile(path)

    def undecodable(self, channel: Channel) -> str | None:
        """Why no message of this channel can be decoded, or None."""
        return self._decoding.undecodable(channel)

    def decode(self, record: Record) -> object:
        """The message of a record."""
        return self._decoding.decode(record)

    def layout(self, record: Record) -> CdrLayout | None:
        """Where the numbers of a record lie, or None."""
        return self._decoding.layout(record)
