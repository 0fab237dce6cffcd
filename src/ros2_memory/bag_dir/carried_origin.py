"""Where a carried latched message came from, as metadata of its channel."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from ros2_memory.storage.base import Channel, Record

_RECORDINGS: Final = "ros2_memory_recordings"
_OFTEN: Final = "ros2_memory_often"


@dataclass(frozen=True, slots=True)
class Origin:
    """Where a carried message came from.

    Attributes:
        recordings: folders, relative to the bag directory, of the recordings that received it: the
            first one, and those that still had bags when their own copy was deleted.
        often: whether the first one had messages of the topic often, so that it is not latched.
    """

    recordings: tuple[str, ...]
    often: bool


def with_origin(record: Record, origin: Origin) -> Record:
    """Returns the message with its origin in place of any that its channel names."""
    channel = record.channel
    rest = tuple(each for each in channel.metadata if each[0] not in {_RECORDINGS, _OFTEN})
    new = ((_RECORDINGS, json.dumps(origin.recordings)), (_OFTEN, json.dumps(origin.often)))
    return record._replace(channel=replace(channel, metadata=(*rest, *new)))


def origin_of(channel: Channel) -> Origin | None:
    """Returns the origin of a carried message; None where its channel names none."""
    metadata = dict(channel.metadata)
    try:
        recordings = json.loads(metadata.get(_RECORDINGS, "null"))
    except ValueError:
        return None
    if not isinstance(recordings, list) or not recordings:
        return None
    return Origin(tuple(map(str, recordings)), metadata.get(_OFTEN) == "true")
