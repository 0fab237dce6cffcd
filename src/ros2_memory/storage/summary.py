"""From what the channels of a file hold to its summary."""

from __future__ import annotations

from dataclasses import replace
from operator import itemgetter
from typing import TYPE_CHECKING, NamedTuple

from ros2_memory.core.bag_summary import BagSummary, TopicHeader, shared_schema

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ros2_memory.core.timebase import Ns
    from ros2_memory.storage.base import Channel


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
    set_back: Ns = 0,
) -> BagSummary:
    """The summary of a file: channels of one topic and type count as one."""
    found: dict[tuple[str, str], Held] = {}
    for each in held:
        key = (each.channel.topic, each.channel.type)
        other = found.get(key)
        found[key] = each if other is None else _together(other, each)
    silent = {channel.topic for channel in declared} - {topic for topic, _ in found}
    headings: list[TopicHeader] = []
    numbers: list[int] = []
    # Past the objects of single topics: an index makes one summary after the other.
    for (topic, type_name), (channel, *stated) in sorted(found.items(), key=itemgetter(0)):
        headings.append(TopicHeader(topic, type_name, channel.encoding, channel.latched))
        numbers += stated
    shape = shared_schema(tuple(headings), tuple(sorted(silent)), complete, notes, set_back)
    return BagSummary.packed(shape, shape.layout.pack(*numbers))


def _together(one: Held, other: Held) -> Held:
    """Two channels of one topic and type."""
    channel = one.channel
    if other.channel.latched and not channel.latched:
        channel = replace(channel, latched=True)
    first, last = min(one.first, other.first), max(one.last, other.last)
    return Held(channel, one.messages + other.messages, first, last)
