"""A topic over a window, group of bags by group: by what is kept of whole ones, else by messages.

What is kept of a bag is the same whether the catalogue has it or it is made here from the bag, so
an answer put together from portions does not depend on what the catalogue knows.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, TypeVar

from ros2_memory.core.model import BagState

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from ros2_memory.catalogue.lookup import SegmentDigests
    from ros2_memory.core.model import TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.bag_groups import Group
    from ros2_memory.history.view import View

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class DigestKind(Generic[T]):
    """What is kept of a topic in a bag.

    Attributes:
        name: tells it from the others.
        ask: what the catalogue has of a topic in some entries of one run of bags, by entry.
        packed: one as text.
        unpacked: back; a ValueError where it is none.
    """

    name: str
    ask: Callable[[SegmentDigests, str, Sequence[int]], Mapping[int, T]]
    packed: Callable[[T], str]
    unpacked: Callable[[str], T]


def is_whole(group: Group, window: TimeWindow) -> bool:
    """Whether all messages of the group's bags lie in the window, and no crash cut a bag short."""
    return all(
        window.covers(held.first, held.last) and held.bag.state is BagState.CLOSED
        for held in group.holdings
    )


class StoredPart(Generic[T]):
    """What the catalogue keeps of one topic in a window; of one run of bags at a time."""

    def __init__(self, view: View, topic: str, kind: DigestKind[T], window: TimeWindow) -> None:
        self._view = view
        self._topic = topic
        self._kind = kind
        self._window = window
        self._question = f"{kind.name} {topic}"
        self._notes: SegmentDigests | None = None
        self._known: Mapping[int, T] = {}

    def of(self, group: Group) -> tuple[T, tuple[Ns, Ns]] | None:
        """What is kept of a group, and the times of its first and last message; None: nothing."""
        if group.may_be_relatched:
            return None
        if len(group.holdings) > 1:
            return self._remembered(group)
        [held] = group.holdings
        number = None if self._notes is None else self._notes.numbers.get(held.bag.file)
        if number is None:  # not of the run that the bag before it was of
            entry = self._view.entry(held.bag)
            if entry is None:
                return None
            self._view.check_deadline()
            self._notes, number = entry
            run = self._view.snapshot.run_of(held.bag)
            numbers = self._notes.numbers
            inside = [each.bag.file for each in run.extents(self._topic, self._window)]
            among = [numbers[file] for file in dict.fromkeys(inside) if file in numbers]
            self._known = self._kind.ask(self._notes, self._topic, among)
        if number not in self._known:
            return None
        return self._known[number], (held.first, held.last)

    def keep(self, group: Group, kept: T, span: tuple[Ns, Ns]) -> None:
        """Keeps what bags that hold copies of each other come to, for the next time."""
        recall, numbers = self._view.memory.recall, self._numbers(group)
        if recall is None or numbers is None or len(numbers) < 2 or not self._view.complete:
            return
        if group.may_be_relatched:
            return
        recall.remember(self._question, numbers, json.dumps([self._kind.packed(kept), *span]))

    def _remembered(self, group: Group) -> tuple[T, tuple[Ns, Ns]] | None:
        recall, numbers = self._view.memory.recall, self._numbers(group)
        if recall is None or numbers is None:
            return None
        return recall.remembered(self._question, numbers, self._parsed)

    def _parsed(self, answer: str) -> tuple[T, tuple[Ns, Ns]]:
        packed, first, last = json.loads(answer)
        return self._kind.unpacked(packed), (int(first), int(last))

    def _numbers(self, group: Group) -> list[int] | None:
        """The entries of the group's bags; None where one has none."""
        entries = [self._view.entry(held.bag) for held in group.holdings]
        numbers = [entry[1] for entry in entries if entry is not None]
        return numbers if len(numbers) == len(entries) else None
