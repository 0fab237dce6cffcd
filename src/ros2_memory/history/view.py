"""One call's sight of the memory as a history: the newest message, some of many, how many."""

from __future__ import annotations

import json
from dataclasses import astuple, dataclass
from typing import TYPE_CHECKING

from ros2_memory.core.model import TimeWindow
from ros2_memory.history.bag_access import short_name
from ros2_memory.history.bag_groups import groups_of
from ros2_memory.history.duplicates import deduplicate_forward
from ros2_memory.history.merged_stream import MergedStream
from ros2_memory.messages.downsample import evenly

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.bag_groups import Group
    from ros2_memory.history.duplicates import BagSpan, StoredMessage

__all__ = ["Census", "View", "short_name"]


@dataclass(frozen=True, slots=True)
class Census:
    """Log times of the earliest and latest message (inclusive), and how many there are."""

    first: Ns
    last: Ns
    count: int


class View(MergedStream):
    """One call's consistent sight of the memory: a snapshot, a deadline, and notes on the way."""

    def newest(self, topic: str, window: TimeWindow) -> StoredMessage | None:
        """The latest message of the topic in the window."""
        return self.last_of(topic, window)

    def oldest(self, topic: str, window: TimeWindow) -> StoredMessage | None:
        """The earliest message of the topic in the window."""
        return next(self.stream([topic], window), None)

    def pick(self, topic: str, window: TimeWindow, at_most: int) -> tuple[int, list[StoredMessage]]:
        """How many messages the window holds, and `at_most` of them, evenly spaced.

        The first and the last are always among them. Reads payloads of the chosen ones only,
        except where recordings overlap or latched messages may have been received again.
        """
        groups = self.groups(topic, window)
        sizes = [group.count() for group in groups]
        total = sum(sizes)
        chosen: list[StoredMessage] = []
        begin, position = 0, 0
        indices = evenly(total, at_most)
        for group, size in zip(groups, sizes, strict=True):
            local = []
            while position < len(indices) and indices[position] < begin + size:
                local.append(indices[position] - begin)
                position += 1
            chosen.extend(group.fetch(local))
            begin += size
        return total, chosen

    def groups(self, topic: str, window: TimeWindow) -> list[Group]:
        """The bags that hold messages of the topic in the window, in groups, in order."""
        return groups_of(self, topic, window)

    def census(self, topic: str) -> dict[str, Census]:
        """What is recorded of a topic under each of its types, each message counted once."""
        everything = TimeWindow.everything()
        if self.may_be_relatched([topic]):
            return _counted(self.stream([topic], everything))
        counted = {
            type_name: Census(*stated) for type_name, stated in self.snapshot.stated(topic).items()
        }
        for span in self.spans_of_copies(topic, everything):
            for type_name, (standing, once) in self._in_contest(topic, TimeWindow(*span)).items():
                known = counted[type_name]
                last = once.last if standing.last == known.last else known.last
                count = known.count - standing.count + once.count
                counted[type_name] = Census(known.first, last, count)
        return counted

    def _in_contest(self, topic: str, window: TimeWindow) -> dict[str, tuple[Census, Census]]:
        """By type, what stands in bags that contest a span, and what of it counts."""
        involved = self.holdings([topic], window)
        entries = [self.entry(held.bag) for held in involved]
        numbers = [number for _, number in filter(None, entries)]
        recall = self.memory.recall
        if recall is None or len(numbers) < len(involved):
            return self._count_contest(topic, window, involved)
        question = json.dumps(["contest", topic, window.start, window.stop])
        remembered = recall.remembered(question, numbers, _contest)
        if remembered is not None:
            return remembered
        counted = self._count_contest(topic, window, involved)
        if self.complete:
            answer = {
                type_name: [astuple(standing), astuple(once)]
                for type_name, (standing, once) in counted.items()
            }
            recall.remember(question, numbers, json.dumps(answer))
        return counted

    def _count_contest(
        self, topic: str, window: TimeWindow, involved: Sequence[BagSpan]
    ) -> dict[str, tuple[Census, Census]]:
        standing = _counted(self.merged(involved, [topic], window, newest_first=False))
        merged = self.merged(involved, [topic], window, newest_first=False)
        once = _counted(deduplicate_forward(merged, [(window.start, window.stop)]))
        return {type_name: (standing[type_name], once[type_name]) for type_name in once}


def _contest(answer: str) -> dict[str, tuple[Census, Census]]:
    return {
        type_name: (Census(*standing), Census(*once))
        for type_name, (standing, once) in json.loads(answer).items()
    }


def _counted(found: Iterable[StoredMessage]) -> dict[str, Census]:
    """A census by message type of an ascending stream."""
    counted: dict[str, Census] = {}
    for each in found:
        known = counted.get(each.record.channel.type)
        first, count = (known.first, known.count) if known else (each.time, 0)
        counted[each.record.channel.type] = Census(first, each.time, count + 1)
    return counted
