"""Readers of MCAP bags that note what they are asked, or fail."""

from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from ros2_memory.core.bag_summary import BagSummary
from ros2_memory.core.model import TimeWindow
from ros2_memory.storage.base import Channel, Record
from ros2_memory.storage.mcap_reader import McapReader


class NotingReader(McapReader):
    """Notes which bags were asked for what, in order.

    Attributes:
        asked: a bag and the topics of messages; none for a summary or its channels.
        windows: the window of each search for messages.
        read: the topic of each message that was read.
    """

    def __init__(self) -> None:
        super().__init__()
        self.asked: list[tuple[Path, tuple[str, ...]]] = []
        self.windows: list[TimeWindow] = []
        self.read: list[str] = []

    @property
    def names(self) -> list[str]:
        """The files of these bags."""
        return [path.name for path, _ in self.asked]

    def summarize(self, path: Path) -> BagSummary:
        self.asked.append((path, ()))
        return super().summarize(path)

    def channels(self, path: Path) -> Sequence[Channel]:
        self.asked.append((path, ()))
        return super().channels(path)

    def records(
        self,
        path: Path,
        topics: Collection[str],
        window: TimeWindow,
        *,
        newest_first: bool = False,
    ) -> Iterator[Record]:
        self.asked.append((path, tuple(topics)))
        self.windows.append(window)
        for record in super().records(path, topics, window, newest_first=newest_first):
            self.read.append(record.channel.topic)
            yield record


def fail_reading(
    monkeypatch: pytest.MonkeyPatch, way: str, error_of: Callable[[Path], Exception | None]
) -> None:
    """Has one way of reading (`records`, `batches`) fail for the bags that have an error."""
    read = getattr(McapReader, way)

    def failing(self: McapReader, path: Path, *given: Any, **how: Any) -> Any:
        if error := error_of(path):
            raise error
        return read(self, path, *given, **how)

    monkeypatch.setattr(McapReader, way, failing)
