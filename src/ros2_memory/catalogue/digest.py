"""Digests one closed bag: reads it once, and returns what is stored of each of its topics.

Pure: reads through the port, stores nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from ros2_memory.core.errors import BagError
from ros2_memory.core.model import TimeWindow

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.core.bag_summary import BagSummary
    from ros2_memory.storage.base import BagReader

DIGEST_VERSION: Final = 25
"""Version of what is stored of a bag and how; another one has every bag digested again."""
_ALWAYS_READ_BYTES: Final = 64 << 20
_MESSAGE_BYTES: Final = 200
"""Counted for each message besides its payload, since reading it takes time too."""
_MAX_EXPANSION: Final = 100
"""A bag whose messages decompress to more times its size is not digested."""


@dataclass(frozen=True, slots=True)
class TopicDigest:
    """What one bag holds of one topic, of all its types together.

    Attributes:
        topic: its name.
        undecodable: by type, why none of its messages can be decoded; mostly empty.
        relatched: whether one of its messages may repeat a message of another recording.
    """

    topic: str
    undecodable: tuple[tuple[str, str], ...] = ()
    relatched: bool = False


@dataclass(frozen=True, slots=True)
class Digest:
    """What is stored of one closed bag."""

    summary: BagSummary
    topics: tuple[TopicDigest, ...]


class Digester:
    """Builds digests; equal ones for the same bag.

    Args:
        reader: gives the messages that count.
    """

    def __init__(self, reader: BagReader) -> None:
        self._reader = reader

    def digest(self, path: Path) -> Digest:
        """Reads a bag and returns its digest.

        Raises:
            BagVanishedError: the file is gone.
            BagError: some of it cannot be read, or it decompresses to more than it can be worth.
        """
        summary = self._reader.summarize(path)
        topics = dict.fromkeys(each.topic for each in summary.topics)
        latched = {each.topic for each in summary.topics if each.latched}
        relatched: set[str] = set()
        left = _ALWAYS_READ_BYTES + _MAX_EXPANSION * _size(path)
        for record in self._reader.records(path, tuple(topics), TimeWindow.everything()):
            left -= len(record.payload) + _MESSAGE_BYTES
            if left < 0:
                raise BagError(str(path), "its messages unpack to more than they can be worth")
            topic = record.channel.topic
            if topic in latched and record.may_be_relatched:
                relatched.add(topic)
        reasons = self._reasons(path)
        digests = (
            TopicDigest(topic, tuple(reasons.get(topic, {}).items()), topic in relatched)
            for topic in topics
        )
        return Digest(summary, tuple(digests))

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
