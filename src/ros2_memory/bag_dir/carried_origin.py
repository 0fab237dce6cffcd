"""The recordings that a carried message stood in, as the metadata of its channel says."""

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
        recordings: the folders, from the bag directory on, of the recordings that received it: the
            first of them, and those that still had bags when theirs of this message was deleted.
        often: whether the first one had messages of the topic often: then it is not latched.
    """

    recordings: tuple[str, ...]
    often: bool


def with_origin(record: Record, origin: Origin) -> Record:
    """The message with its origin in place of what its channel said of that before."""
    channel = record.channel
    rest = tuple(each for each in channel.metadata if each[0] not in {_RECORDINGS, _OFTEN})
    said = ((_RECORDINGS, json.dumps(origin.recordings)), (_OFTEN, json.dumps(origin.often)))
    return record._replace(channel=replace(channel, metadata=(*rest, *said)))


def origin_of(channel: Channel) -> Origin | None:
    """The origin of a carried message; None where its channel does not say."""
    said = dict(channel.metadata)
    try:
        recordings = json.loads(said.get(_RECORDINGS, "null"))
    except ValueError:
        return None
    if not isinstance(recordings, list) or not recordings:
        return None
    return Origin(tuple(map(str, recordings)), said.get(_OFTEN) == "true")
