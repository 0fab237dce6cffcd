"""One call's view of the history: a snapshot of the index, its bags, and these as one stream."""

from __future__ import annotations

import json
from bisect import bisect_left
from dataclasses import astuple, dataclass
from typing import TYPE_CHECKING

from ros2_memory.core.model import TimeWindow
from ros2_memory.history.bag_access import BagAccess
from ros2_memory.history.bag_groups import groups_of
from ros2_memory.history.duplicates import deduplicate_forward
from ros2_memory.history.merged_stream import MergedStream
from ros2_memory.messages.downsample import evenly

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.history.duplicates import BagSpan, StoredMessage
    from ros2_memory.history.sessions import Sessions


@dataclass(frozen=True, slots=True)
class Census:
    """Log times of the earliest and latest message (inclusive), and how many there are."""

    first: Ns
    last: Ns
    count: int


class View:
    """What one call sees of a memory; it stays the same while the call lasts.

    `reach` is the latest log time that the question is about: where the index does not reach as
    far, it is scanned anew.

    Attributes:
        bags: each bag by itself.
        stream: all bags as one stream.
        sessions: which recordings belong together, once that is asked (see `transforms`).
    """

    def __init__(self, memory: Memory, call: Call, reach: Ns | None = None) -> None:
        self.memory = memory
        self.call = call
        self.bags = BagAccess(memory, call, reach)
        self.stream = MergedStream(self.bags)
        self.snapshot = self.bags.snapshot
        self.notes = self.bags.notes
        self.sessions: Sessions | None = None

    def pick(self, topic: str, window: TimeWindow, at_most: int) -> tuple[int, list[StoredMessage]]:
        """Returns how many messages the window holds, and `at_most` of them, evenly spaced.

        The first and the last are always among them. Reads payloads of the chosen ones only,
        except where recordings overlap or latched messages may have been received again.
        """
        groups = groups_of(self.stream, topic, window)
        sizes = [group.count() for group in groups]
        indices = evenly(sum(sizes), at_most)
        chosen: list[StoredMessage] = []
        begin = 0
        for group, size in zip(groups, sizes, strict=True):
            inside = indices[bisect_left(indices, begin) : bisect_left(indices, begin + size)]
            chosen.extend(group.fetch([index - begin for index in inside]))
            begin += size
        return sum(sizes), chosen

    def census(self, topic: str) -> dict[str, Census]:
        """Returns what is recorded of a topic under each of its types, each message counted once.

        From the summaries of bags; messages are read only where recordings overlap.
        """
        everything = TimeWindow.everything()
        if self.stream.may_be_relatched([topic]):
            return _counted(self.stream.messages([topic], everything))
        counted = {
            type_name: Census(*stated)
            for type_name, stated in self.snapshot.timeline.totals(topic).items()
        }
        for span in self.stream.duplicate_spans(topic, everything):
            for type_name, (stored, once) in self._overlap_census(topic, TimeWindow(*span)).items():
                known = counted[type_name]
                last = once.last if stored.last == known.last else known.last
                count = known.count - stored.count + once.count
                counted[type_name] = Census(known.first, last, count)
        return counted

    def _overlap_census(self, topic: str, window: TimeWindow) -> dict[str, tuple[Census, Census]]:
        """Returns, by type, the messages stored in overlapping bags, and those that count."""
        bags = self.stream.overlapping_bags([topic], window)
        entries = [self.bags.entry(each.bag) for each in bags]
        numbers = [number for _, number in filter(None, entries)]
        cache = self.memory.recall
        if cache is None or len(numbers) < len(bags):
            return self._count_overlap(topic, window, bags)
        question = json.dumps(["contest", topic, window.start, window.stop])
        known = cache.cached_answer(question, numbers, _decode_overlap)
        if known is not None:
            return known
        counted = self._count_overlap(topic, window, bags)
        if self.notes.complete:
            answer = {
                type_name: [astuple(stored), astuple(once)]
                for type_name, (stored, once) in counted.items()
            }
            cache.catalogue.cache_answer(question, numbers, json.dumps(answer))
        return counted

    def _count_overlap(
        self, topic: str, window: TimeWindow, bags: Sequence[BagSpan]
    ) -> dict[str, tuple[Census, Census]]:
        stored = _counted(self.stream.merged(bags, [topic], window, newest_first=False))
        merged = self.stream.merged(bags, [topic], window, newest_first=False)
        once = _counted(deduplicate_forward(merged, [(window.start, window.stop)]))
        return {type_name: (stored[type_name], once[type_name]) for type_name in once}


def _decode_overlap(answer: str) -> dict[str, tuple[Census, Census]]:
    return {
        type_name: (Census(*stored), Census(*once))
        for type_name, (stored, once) in json.loads(answer).items()
    }


def _counted(messages: Iterable[StoredMessage]) -> dict[str, Census]:
    """Returns a census by message type of an ascending stream."""
    counted: dict[str, Census] = {}
    for each in messages:
        type_name = each.record.channel.type
        known = counted.get(type_name, Census(each.time, each.time, 0))
        counted[type_name] = Census(known.first, each.time, known.count + 1)
    return counted
