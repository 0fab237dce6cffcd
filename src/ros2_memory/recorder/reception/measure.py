"""Measures how the topics of one closed split arrived: their QoS, bursts and sizes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import NS_PER_S, Ns, ns_from_unix
from ros2_memory.recorder.reception.profiles import HOLD_S, TopicFlow, offered_by_all

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from ros2_memory.storage.base import BagReader

SPLIT_BYTES: Final = 64 * 2**20
"""Of a larger split only the last seconds are measured, to spare the processor."""
TAIL_NS: Final[Ns] = 4 * NS_PER_S
_HOLD_NS: Final[Ns] = ns_from_unix(HOLD_S)
_FEWEST: Final = 5
"""Messages that show a rate, where a topic did not last for `HOLD_S`."""


def measure_flows(reader: BagReader, path: Path) -> Mapping[str, TopicFlow]:
    """Returns how each topic of a closed split arrived, of those whose offered QoS it states.

    Raises:
        BagError: the split cannot be read.
        OSError: it is not there.
    """
    offers: dict[str, list[str]] = {}
    for channel in reader.channels(path):
        texts = offers.setdefault(channel.topic, [])
        texts += [text for name, text in channel.metadata if name == "offered_qos_profiles"]
    window = TimeWindow.everything()
    if path.stat().st_size > SPLIT_BYTES:
        summary = reader.summarize(path)
        if not summary.empty:
            window = TimeWindow(summary.end - TAIL_NS, summary.end + 1)
    times: dict[str, list[Ns]] = {}
    largest: dict[str, int] = {}
    for record in reader.records(path, offers, window):
        topic = record.channel.topic
        times.setdefault(topic, []).append(record.publish_time or record.log_time)
        largest[topic] = max(largest.get(topic, 0), len(record.payload))
    flows: dict[str, TopicFlow] = {}
    for topic, published in times.items():
        offered = offered_by_all(offers[topic])
        if offered is not None:
            flows[topic] = TopicFlow(offered, burst_of(published), largest[topic])
    return flows


def burst_of(published: Sequence[Ns]) -> int:
    """Returns the most messages within `HOLD_S`.

    A topic that did not last so long is taken to go on at its rate: it may have begun just now.
    """
    ordered = sorted(published)
    most, first = 0, 0
    for last, at in enumerate(ordered):
        while at - ordered[first] >= _HOLD_NS:
            first += 1
        most = max(most, last - first + 1)
    lasted = ordered[-1] - ordered[0] if ordered else 0
    if len(ordered) >= _FEWEST and 0 < lasted < _HOLD_NS:
        return max(most, -(-(len(ordered) - 1) * _HOLD_NS // lasted))
    return most
