"""The adapter `mcap`: single `.mcap` files."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING

from ros2_memory.core.large_reads import LargeReads
from ros2_memory.storage.errors import MAX_CHUNK_MB, reading
from ros2_memory.storage.file_reader import FileReader, OpenedBag
from ros2_memory.storage.mcap.bag_file import McapBags

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from ros2_memory.storage.base import Closing


class McapReader(FileReader):
    """Reads `.mcap` files, with or without metadata.yaml beside them.

    Args:
        custom_msg_paths: folders of `.msg` files for types that a bag holds no definition of.
        cache_mb: memory that indexes and decompressed chunks may take between calls, in MiB.
        max_chunk_mb: decompressed size up to which a chunk or a message is read, in MiB.
        large: the turn to hold much of a bag.

    Raises:
        ConfigError: one of the paths cannot be used.
    """

    def __init__(
        self,
        custom_msg_paths: Sequence[Path | str] = (),
        cache_mb: int = 64,
        max_chunk_mb: int = MAX_CHUNK_MB,
        large: LargeReads | None = None,
    ) -> None:
        large = large or LargeReads()
        super().__init__(custom_msg_paths, large)
        self._bags = McapBags(cache_mb, max_chunk_mb, large)

    def reads(self, path: Path) -> bool:
        """Returns whether the name ends with `.mcap`."""
        return path.suffix == ".mcap"

    def closing(self, path: Path) -> Closing:
        """Returns whether the closing magic is there."""
        with reading(path):
            return self._bags.closing(path)

    def _open(self, path: Path) -> AbstractContextManager[OpenedBag]:
        return nullcontext(OpenedBag(self._bags, path, ""))
