"""Every reader over every kind of file that it reads, for tests that hold for all of them."""

import sqlite3
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import zstandard
from mcap.writer import CompressionType, IndexType

from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.core.errors import BagError
from ros2_memory.storage.base import BagReader
from ros2_memory.storage.mcap_reader import McapReader
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
from tests.support.bags import McapLayout, Msg, write_db3, write_mcap

T = TypeVar("T")
NO_CHUNK_INDEX = IndexType.ATTACHMENT | IndexType.MESSAGE | IndexType.METADATA
NO_MESSAGE_INDEX = IndexType.ATTACHMENT | IndexType.CHUNK | IndexType.METADATA

LAYOUTS = {
    "default": McapLayout(),
    "small chunks": McapLayout(chunk_size=200),
    "zstd": McapLayout(chunk_size=200, compression=CompressionType.ZSTD),
    "lz4": McapLayout(chunk_size=200, compression=CompressionType.LZ4),
    "unchunked": McapLayout(chunk_size=None),
    "no summary offsets": McapLayout(chunk_size=200, use_summary_offsets=False),
    "no chunk index": McapLayout(chunk_size=200, index_types=NO_CHUNK_INDEX),
    "no message index": McapLayout(chunk_size=200, index_types=NO_MESSAGE_INDEX),
    "no repeated channels": McapLayout(chunk_size=200, repeat_channels=False),
    "no statistics": McapLayout(chunk_size=200, use_statistics=False),
    "no summary": McapLayout(
        chunk_size=200,
        index_types=IndexType.NONE,
        repeat_channels=False,
        use_statistics=False,
        use_summary_offsets=False,
    ),
    "other profile": McapLayout(profile="px4"),
}


@dataclass(frozen=True)
class Shelf:
    """A reader, and how a bag comes to lie before it."""

    name: str
    make_reader: Callable[[], BagReader]
    write: Callable[[Path, Iterable[Msg], Collection[tuple[str, str]]], Path]
    suffix: str = ".mcap"
    keeps_publish_time: bool = True

    def __str__(self) -> str:
        return self.name

    def stocked(
        self,
        folder: Path,
        messages: Iterable[Msg] = (),
        *,
        declared: Collection[tuple[str, str]] = (),
    ) -> tuple[BagReader, Path]:
        """A reader, and one bag that it reads."""
        return self.make_reader(), self.write(folder / f"bag{self.suffix}", messages, declared)


def read_through(items: Iterator[T]) -> tuple[list[T], list[BagError]]:
    """What an iterator yields, and what it raises meanwhile."""
    found: list[T] = []
    errors: list[BagError] = []
    while True:
        try:
            found.extend(items)
        except BagError as error:
            errors.append(error)
        else:
            return found, errors


def _mcap(
    layout: McapLayout, path: Path, messages: Iterable[Msg], declared: Collection[tuple[str, str]]
) -> Path:
    return write_mcap(path, messages, layout, declared=declared)


def _db3(path: Path, messages: Iterable[Msg], declared: Collection[tuple[str, str]]) -> Path:
    write_db3(path, messages)
    with closing(sqlite3.connect(path)) as base:
        for topic, type_name in declared:
            base.execute(
                "INSERT INTO topics(name,type,serialization_format,offered_qos_profiles,"
                "type_description_hash) VALUES (?,?,'cdr','','')",
                (topic, type_name),
            )
        base.commit()
    return path


def _compressed(
    write: Callable[[Path, Iterable[Msg], Collection[tuple[str, str]]], Path],
    path: Path,
    messages: Iterable[Msg],
    declared: Collection[tuple[str, str]],
) -> Path:
    plain = write(path.with_suffix(""), messages, declared)
    path.write_bytes(zstandard.compress(plain.read_bytes()))
    plain.unlink()
    return path


MCAP = [
    Shelf(f"mcap: {name}", McapReader, partial(_mcap, layout)) for name, layout in LAYOUTS.items()
]
ROSBAG2 = [
    Shelf("rosbag2: mcap", Rosbag2Reader, partial(_mcap, McapLayout())),
    Shelf("rosbag2: db3", Rosbag2Reader, _db3, ".db3", keeps_publish_time=False),
    Shelf(
        "rosbag2: mcap.zstd",
        Rosbag2Reader,
        partial(_compressed, partial(_mcap, McapLayout())),
        ".mcap.zstd",
    ),
    Shelf(
        "rosbag2: db3.zstd",
        Rosbag2Reader,
        partial(_compressed, _db3),
        ".db3.zstd",
        keeps_publish_time=False,
    ),
]
COUNTING = [
    Shelf(
        "counting: mcap",
        lambda: BagDirReader(McapReader()),
        partial(_mcap, McapLayout(chunk_size=200)),
    )
]
FILES = MCAP + ROSBAG2 + COUNTING
