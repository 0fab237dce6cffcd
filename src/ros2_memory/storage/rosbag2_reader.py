"""The adapter `rosbag2`: the files of a rosbag2 recording, of either storage plugin."""

from __future__ import annotations

from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, NamedTuple, Protocol

from ros2_memory.storage.base import BagReader
from ros2_memory.storage.decoding import Decoding
from ros2_memory.storage.errors import (
    MAX_CHUNK_MB,
    LostError,
    UnreadableError,
    raise_if_lost,
    reading,
)
from ros2_memory.storage.file_io import OpenFile
from ros2_memory.storage.mcap.bag_file import McapBags
from ros2_memory.storage.sqlite_bag import (
    SqliteBags,
    closing_of_db3,
    journals_beside,
    settled_copy,
)
from ros2_memory.storage.temp_files import Scratch
from ros2_memory.storage.zstd_bag import closing_of_zstd, unpack

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.core.model import BagSummary, TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.storage.base import CdrLayout, Channel, Closing, Record

_KINDS = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")


class _Room(Protocol):
    """What the rooms of both plugins answer."""

    def summarize(self, path: Path) -> BagSummary: ...
    def channels(self, path: Path) -> Sequence[Channel]: ...
    def newest(self, path: Path, topic: str, window: TimeWindow) -> Record | None: ...
    def profile(self, path: Path) -> str: ...
    def log_times(self, path: Path, topic: str, window: TimeWindow) -> Sequence[Ns]: ...
    def records(
        self, path: Path, topics: Collection[str], window: TimeWindow, *, newest_first: bool
    ) -> Iterator[Record | LostError]: ...


class _Opened(NamedTuple):
    """A file as one of the rooms can read it; the note is empty where nothing is odd."""

    room: _Room
    path: Path
    note: str


class Rosbag2Reader(BagReader):
    """Reads `.mcap` and `.db3` files, also compressed as a whole (`.zstd`).

    Args:
        custom_msg_paths: folders of `.msg` files for types that a bag holds no definition of.
        cache_mb: what indexes and decompressed chunks may take of memory between calls.
        unpack_max_mb: what unpacked files may take of the folder for temporary files.
        max_chunk_mb: what one MCAP chunk or one message may hold, decompressed; a larger one is
            not read.

    Raises:
        ConfigError: one of the paths cannot be used.
    """

    def __init__(
        self,
        custom_msg_paths: Sequence[Path | str] = (),
        cache_mb: int = 64,
        unpack_max_mb: int = 1024,
        max_chunk_mb: int = MAX_CHUNK_MB,
    ) -> None:
        self._decoding = Decoding(custom_msg_paths)
        self._mcap = McapBags(cache_mb, max_chunk_mb)
        self._sqlite = SqliteBags(max_chunk_mb)
        self._scratch = Scratch(unpack_max_mb << 20)

    def reads(self, path: Path) -> bool:
        """Whether its name ends on one of the four kinds."""
        return path.name.endswith(_KINDS) and path.name not in _KINDS

    def closing(self, path: Path) -> Closing:
        """Closing magic for MCAP; no journal beside a `.db3`; whole frames for `.zstd`."""
        with reading(path):
            if path.suffix == ".zstd":
                return closing_of_zstd(path)
            return closing_of_db3(path) if path.suffix == ".db3" else self._mcap.closing(path)

    def summarize(self, path: Path) -> BagSummary:
        """Topics with exact counts and exact first and last log times."""
        with reading(path), self._opened(path) as opened:
            summary = opened.room.summarize(opened.path)
            if not opened.note:
                return summary
            return summary.replaced(complete=False, notes=(opened.note, *summary.notes))

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
            with reading(path), self._opened(path) as opened:
                records = opened.room.records
                yield from records(opened.path, topics, window, newest_first=newest_first)

        return map(partial(raise_if_lost, path), found())

    def newest(self, path: Path, topic: str, window: TimeWindow) -> Record | None:
        """The latest message of the topic inside the window."""
        with reading(path), self._opened(path) as opened:
            return opened.room.newest(opened.path, topic, window)

    def log_times(self, path: Path, topic: str, window: TimeWindow) -> Sequence[Ns]:
        """The log times of the topic inside the window, without payloads."""
        with reading(path), self._opened(path) as opened:
            return opened.room.log_times(opened.path, topic, window)

    def channels(self, path: Path) -> Sequence[Channel]:
        """Every channel that is declared in the file."""
        with reading(path), self._opened(path) as opened:
            return opened.room.channels(opened.path)

    def profile(self, path: Path) -> str:
        """The profile in the header of an MCAP file; `ros2` of a sqlite file."""
        with reading(path), self._opened(path) as opened:
            return opened.room.profile(opened.path)

    def undecodable(self, channel: Channel) -> str | None:
        """Why no message of this channel can be decoded, or None."""
        return self._decoding.undecodable(channel)

    def decode(self, record: Record) -> object:
        """The message of a record."""
        return self._decoding.decode(record)

    def layout(self, record: Record) -> CdrLayout | None:
        """Where the numbers of a record lie, or None."""
        return self._decoding.layout(record)

    @contextmanager
    def _opened(self, path: Path) -> Iterator[_Opened]:
        """The file, unpacked or settled into a temporary one where that is needed."""
        plain = path.with_suffix("") if path.suffix == ".zstd" else path
        room: _Room = self._sqlite if plain.suffix == ".db3" else self._mcap
        sources = [path]
        if path.suffix == ".zstd":
            fill = partial(unpack, path)
        elif plain.suffix == ".db3" and journals_beside(path):
            sources += journals_beside(path)
            fill = partial(settled_copy, path)
        elif self.reads(path):
            yield _Opened(room, path, "")
            return
        else:
            raise UnreadableError(f"not of a kind that is read ({', '.join(_KINDS)})")
        keys = []
        for source in sources:
            with OpenFile(source) as file:
                keys.append(file.key)
        with self._scratch.holding(tuple(keys), fill) as (copy, note):
            yield _Opened(room, copy, note)
