"""From what the channels of a file hold to its summary."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from ros2_memory.model import BagSummary, TopicSummary

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ros2_memory.storage.base import Channel
    from ros2_memory.timebase import Ns


class Held(NamedTuple):
    """The messages of one channel: how many (at least one), the earliest and the latest."""

    channel: Channel
    messages: int
    first: Ns
    last: Ns


def bag_summary(
    held: Iterable[Held],
    declared: Iterable[Channel],
    *,
    complete: bool = True,
    notes: tuple[str, ...] = (),
) -> BagSummary:
    """The summary of a file: channels of one topic and type count as one."""
    found: dict[tuple[str, str], TopicSummary] = {}
    for channel, count, first, last in held:
        key = (channel.topic, channel.type)
        other = found.get(key)
        if other is None:
            found[key] = TopicSummary(*key, channel.encoding, count, first, last, channel.latched)
        else:
            found[key] = replace(
                other,
                count=other.count + count,
                first=min(other.first, first),
                last=max(other.last, last),
                latched=other.latched or channel.latched,
            )
    silent = {channel.topic for channel in declared} - {topic for topic, _ in found}
    topics = tuple(found[key] for key in sorted(found))
    return BagSummary(topics, tuple(sorted(silent)), complete, notes)
