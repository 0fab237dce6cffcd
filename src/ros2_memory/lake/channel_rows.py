"""The channels of one bag as rows: what declares each, and its messages.

These are the robot's own bytes. So whatever is asked of them is asked as of the bag, by a later
version, too; columns are made of them where they are asked for.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from ros2_memory.columns.decode import BULKY_TYPES
from ros2_memory.lake.packed_messages import packed_messages

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from ros2_memory.lake.tables import Row
    from ros2_memory.storage.base import Channel, Record

MOST_OF_MESSAGE: Final = 512
"""Packed bytes of each message on average; of a channel with more the lake has the times alone."""
LEAST_OF_CHANNEL: Final = 16 << 10
"""A channel may take this, however few its messages are: a description, a map of a room."""
_MOST_BYTES: Final = 64 << 20
"""Payloads of a bag that are in memory at once; beyond it the largest channel goes first."""


@dataclass(slots=True, eq=False)
class _Messages:
    """The messages of a channel. `payloads`: None where they are not shipped; `size`: of these.

    `is_whole`: they are shipped whatever they take.
    """

    channel: Channel
    is_whole: bool
    payloads: list[bytes] | None
    log_times: list[int] = field(default_factory=list)
    publish_times: list[int] = field(default_factory=list)
    size: int = 0


class ChannelRows:
    """Takes the messages of a bag in order of their log times, and returns its rows.

    Images, clouds, scans and the like have times alone.

    Args:
        whole: topics whose payloads are shipped whatever they take.
    """

    def __init__(self, whole: Collection[str] = ()) -> None:
        self._whole = whole
        # By identity, since hashing a channel hashes its definition.
        self._of: dict[int, _Messages] = {}
        self._size = 0

    def add(self, record: Record) -> None:
        """Takes the next message."""
        channel = record.channel
        found = self._of.get(id(channel))
        if found is None:
            is_whole = channel.topic in self._whole
            payloads: list[bytes] | None = (
                [] if is_whole or channel.type not in BULKY_TYPES else None
            )
            found = self._of[id(channel)] = _Messages(channel, is_whole, payloads)
        found.log_times.append(record.log_time)
        found.publish_times.append(record.publish_time)
        if found.payloads is not None:
            found.payloads.append(record.payload)
            found.size += len(record.payload)
            self._size += len(record.payload)
            if self._size > _MOST_BYTES:
                self._drop_largest()

    def rows(self) -> Iterator[Row]:
        """Yields the rows, by topic."""
        found = sorted(self._of.values(), key=lambda each: (each.channel.topic, each.channel.type))
        for number, each in enumerate(found):
            channel, schema, count = each.channel, each.channel.schema, len(each.log_times)
            packed = packed_messages(each.log_times, each.publish_times, each.payloads)
            most = max(MOST_OF_MESSAGE * count, LEAST_OF_CHANNEL)
            if each.payloads is not None and len(packed) > most and not each.is_whole:
                each.payloads = None
                packed = packed_messages(each.log_times, each.publish_times, None)
            yield {
                "topic": channel.topic,
                "channel": number,
                "type": schema.name,
                "encoding": channel.encoding,
                "latched": channel.latched,
                "schema_encoding": schema.encoding,
                "schema": schema.text,
                "metadata": json.dumps(channel.metadata),
                "messages": count,
                "first_ns": each.log_times[0],
                "last_ns": each.log_times[-1],
                "has_payloads": each.payloads is not None,
                "packed": packed,
            }

    def _drop_largest(self) -> None:
        some = [each for each in self._of.values() if not each.is_whole]
        largest = max(some, key=lambda each: each.size, default=None)
        if largest is not None:
            largest.payloads = None
            self._size -= largest.size
            largest.size = 0
