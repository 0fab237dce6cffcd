"""An undecoded message with its bag."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple
from zlib import crc32

if TYPE_CHECKING:
    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Ns
    from ros2_memory.storage.base import Record


class StoredMessage(NamedTuple):
    """An undecoded message and the bag that it is in."""

    bag: BagFile
    record: Record

    @property
    def time(self) -> Ns:
        """Log time."""
        return self.record.log_time

    @property
    def topic(self) -> str:
        """Name of the topic."""
        return self.record.channel.topic

    @property
    def type(self) -> str:
        """Name of the message type."""
        return self.record.channel.type

    @property
    def identity(self) -> tuple[Ns, int]:
        """Publish time and CRC-32 of the payload: copies of a message of a topic share these."""
        return self.record.publish_time, crc32(self.record.payload)
