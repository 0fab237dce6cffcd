"""Digests one closed bag: reads it once, and returns what is stored of each of its topics.

A digest answers a question about the bag, or rules the bag out, without opening it. Where it is not
certain the bag is read. Pure: reads through the port, stores nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.payload_templates import Templates
from ros2_memory.catalogue.topic_digest import TopicCollector
from ros2_memory.core.errors import BagError
from ros2_memory.core.model import TimeWindow

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.catalogue.topic_digest import TopicDigest
    from ros2_memory.core.bag_summary import BagSummary
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.storage.base import BagReader

DIGEST_VERSION: Final = 24
"""Version of what is stored of a bag and how; another one has every bag digested again."""
_ALWAYS_READ_BYTES: Final = 64 << 20
_MESSAGE_BYTES: Final = 200
"""Counted for each message besides its payload, since decoding it takes time too."""
_MAX_EXPANSION: Final = 100
"""A bag whose messages decompress to more times its size is not digested."""


@dataclass(frozen=True, slots=True)
class Digest:
    """What is stored of one closed bag."""

    summary: BagSummary
    topics: tuple[TopicDigest, ...]


class Digester:
    """Builds digests; equal ones for the same bag.

    Args:
        reader: gives the messages that count.
        extractor: gives the values that conditions are tested on.
    """

    def __init__(
        self,
        reader: BagReader,
        extractor: SchemaExtractor,
    ) -> None:
        self._reader = reader
        self._extractor = extractor
        self._templates = Templates(reader, extractor)

    def digest(self, path: Path) -> Digest:
        """Reads a bag and returns its digest.

        Raises:
            BagVanishedError: the file is gone.
            BagError: some of it cannot be read, or it decompresses to more than it can be worth.
        """
        summary = self._reader.summarize(path)
        latched: dict[str, bool] = {}
        for each in summary.topics:
            latched[each.topic] = latched.get(each.topic, False) or each.latched
        collectors = {
            topic: TopicCollector(
                topic,
                self._reader,
                self._extractor,
                self._templates,
                latched=is_latched,
            )
            for topic, is_latched in latched.items()
        }
        add = {topic: collector.add for topic, collector in collectors.items()}
        left = _ALWAYS_READ_BYTES + _MAX_EXPANSION * _size(path)
        for record in self._reader.records(path, tuple(latched), TimeWindow.everything()):
            left -= len(record.payload) + _MESSAGE_BYTES
            if left < 0:
                raise BagError(str(path), "its messages unpack to more than they can be worth")
            add[record.channel.topic](record)
        reasons = self._reasons(path)
        topics = tuple(each.digest(reasons.get(topic, {})) for topic, each in collectors.items())
        return Digest(summary, topics)

    def _reasons(self, path: Path) -> dict[str, dict[str, str]]:
        """Returns, by topic and type, why messages cannot be decoded."""
        reasons: dict[str, dict[str, str]] = {}
        for channel in self._reader.channels(path):
            reason = self._reader.undecodable(channel)
            if reason:
                reasons.setdefault(channel.topic, {})[channel.type] = reason
        return reasons


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0
