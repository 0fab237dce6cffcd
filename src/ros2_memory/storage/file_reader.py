"""What both adapters of `BagReader` share: open a file, delegate to the format, decode."""

from __future__ import annotations

from abc import abstractmethod
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.core.large_reads import LARGE_BYTES, LargeReads
from ros2_memory.storage.base import BagReader, batched
from ros2_memory.storage.decoding import Decoding
from ros2_memory.storage.errors import raise_if_lost, reading
from ros2_memory.storage.mcap.bag_file import McapBags

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence
    from contextlib import AbstractContextManager
    from pathlib import Path

    from ros2_memory.core.bag_summary import BagSummary
    from ros2_memory.core.model import TimeWindow
    from ros2_memory.storage.base import Batch, Channel, Definition, Record
    from ros2_memory.storage.errors import LostError
    from ros2_memory.storage.sqlite_bag import SqliteBags


MUCH_DECODED_BYTES: Final = 1 << 20
"""A larger message counts as large: decoded it may take thirty times as much."""


class OpenedBag(NamedTuple):
    """A bag file in a form that its format can be read from.

    Attributes:
        bags: reads files of this format.
        path: the file itself, or a temporary copy.
        note: why the file is not complete; empty where nothing is odd.
    """

    bags: McapBags | SqliteBags
    path: Path
    note: str


class FileReader(BagReader):
    """Translates every exception of a format into `EpisodicError`, and decodes.

    Args:
        custom_msg_paths: folders of `.msg` files for types that a bag holds no definition of.
        large: the turn to hold much of a bag.

    Raises:
        ConfigError: one of the paths cannot be used.
    """

    def __init__(self, custom_msg_paths: Sequence[Path | str], large: LargeReads) -> None:
        self._decoding = Decoding(custom_msg_paths)
        self._large = large

    @abstractmethod
    def _open(self, path: Path) -> AbstractContextManager[OpenedBag]:
        """Returns a context in which the file can be read."""

    def summarize(self, path: Path) -> BagSummary:
        """Returns topics with exact counts and exact first and last log times."""
        with reading(path), self._open(path) as opened:
            summary = opened.bags.summarize(opened.path)
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
        """Yields the undecoded messages of `topics` inside the window, by log time."""

        def found() -> Iterator[Record | LostError]:
            with reading(path), self._open(path) as opened:
                records = opened.bags.records
                yield from records(opened.path, topics, window, newest_first=newest_first)

        # Mapped outside of the generator: one that has raised could not go on behind lost messages.
        return map(partial(raise_if_lost, path), found())

    def batches(
        self,
        path: Path,
        topics: Collection[str],
        window: TimeWindow,
        *,
        bare: Collection[str] = (),
    ) -> Iterator[Batch]:
        """Yields the messages of `topics` inside the window, many at once."""

        def found() -> Iterator[Batch | LostError]:
            with reading(path), self._open(path) as opened:
                bags, here = opened.bags, opened.path
                if isinstance(bags, McapBags):
                    yield from bags.batches(here, topics, window, bare)
                else:
                    if here.stat().st_size > LARGE_BYTES:
                        self._large.acquire()
                    records = bags.records(here, topics, window, newest_first=False)
                    yield from batched(enumerate(records))

        return map(partial(raise_if_lost, path), found())

    def newest(self, path: Path, topic: str, window: TimeWindow) -> Record | None:
        """Returns the latest message of the topic inside the window."""
        with reading(path), self._open(path) as opened:
            return opened.bags.newest(opened.path, topic, window)

    def channels(self, path: Path) -> Sequence[Channel]:
        """Returns every channel that is declared in the file."""
        with reading(path), self._open(path) as opened:
            return opened.bags.channels(opened.path)

    def profile(self, path: Path) -> str:
        """Returns the profile in the header of an MCAP file; `ros2` for a sqlite file."""
        with reading(path), self._open(path) as opened:
            return opened.bags.profile(opened.path)

    def undecodable(self, channel: Channel) -> str | None:
        """Returns why no message of this channel can be decoded, or None."""
        return self._decoding.undecodable(channel)

    def decode(self, record: Record) -> object:
        """Decodes the message of a record."""
        if len(record.payload) > MUCH_DECODED_BYTES:
            self._large.acquire()
        return self._decoding.decode(record)

    def encode(self, channel: Channel, message: object) -> bytes:
        """Encodes a decoded message of a channel."""
        return self._decoding.encode(channel, message)

    def definition(self, channel: Channel) -> Definition | None:
        """Returns the fields of the channel's messages, or None."""
        return self._decoding.definition(channel)
