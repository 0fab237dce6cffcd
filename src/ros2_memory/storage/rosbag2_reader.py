"""The adapter `rosbag2`: the files of a rosbag2 recording, of either storage plugin."""

from __future__ import annotations

from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING

from ros2_memory.core.large_reads import LargeReads
from ros2_memory.storage.errors import MAX_CHUNK_MB, UnreadableError, reading
from ros2_memory.storage.file_io import OpenFile
from ros2_memory.storage.file_reader import FileReader, OpenedBag
from ros2_memory.storage.mcap.bag_file import McapBags
from ros2_memory.storage.sqlite_bag import (
    SqliteBags,
    closing_of_db3,
    copy_with_journal,
    journals_beside,
)
from ros2_memory.storage.temp_files import Scratch
from ros2_memory.storage.zstd_bag import closing_of_zstd, unpack

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from ros2_memory.storage.base import Closing

_SUFFIXES = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")


class Rosbag2Reader(FileReader):
    """Reads `.mcap` and `.db3` files, also compressed as a whole (`.zstd`).

    Args:
        custom_msg_paths: folders of `.msg` files for types that a bag holds no definition of.
        cache_mb: memory that indexes and decompressed chunks may take between calls, in MiB.
        unpack_max_mb: disk space that decompressed files may take in the folder for temporary
            files, in MiB.
        max_chunk_mb: decompressed size up to which a chunk or a message is read, in MiB.
        large: the turn to hold much of a bag.

    Raises:
        ConfigError: one of the paths cannot be used.
    """

    def __init__(
        self,
        custom_msg_paths: Sequence[Path | str] = (),
        cache_mb: int = 64,
        unpack_max_mb: int = 1024,
        max_chunk_mb: int = MAX_CHUNK_MB,
        large: LargeReads | None = None,
    ) -> None:
        large = large or LargeReads()
        super().__init__(custom_msg_paths, large)
        self._mcap = McapBags(cache_mb, max_chunk_mb, large)
        self._sqlite = SqliteBags(max_chunk_mb, large)
        self._scratch = Scratch(unpack_max_mb << 20)

    def reads(self, path: Path) -> bool:
        """Returns whether the name ends with one of the four suffixes."""
        return path.name.endswith(_SUFFIXES) and path.name not in _SUFFIXES

    def closing(self, path: Path) -> Closing:
        """Checks closing magic for MCAP, journals beside a `.db3`, whole frames for `.zstd`."""
        with reading(path):
            if path.suffix == ".zstd":
                return closing_of_zstd(path)
            return closing_of_db3(path) if path.suffix == ".db3" else self._mcap.closing(path)

    @contextmanager
    def _open(self, path: Path) -> Iterator[OpenedBag]:
        """Opens the file itself, or a temporary copy, decompressed or with its journal applied."""
        plain = path.with_suffix("") if path.suffix == ".zstd" else path
        bags = self._sqlite if plain.suffix == ".db3" else self._mcap
        sources = [path]
        if path.suffix == ".zstd":
            fill = partial(unpack, path)
        elif plain.suffix == ".db3" and journals_beside(path):
            sources += journals_beside(path)
            fill = partial(copy_with_journal, path)
        elif self.reads(path):
            yield OpenedBag(bags, path, "")
            return
        else:
            raise UnreadableError(f"not of a kind that is read ({', '.join(_SUFFIXES)})")
        keys = []
        for source in sources:
            with OpenFile(source) as file:
                keys.append(file.key)
        with self._scratch.use(tuple(keys), fill) as (copy, note):
            yield OpenedBag(bags, copy, note)
