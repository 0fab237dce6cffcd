"""Some consecutive bags of a timeline, and what follows from their summaries.

It is worked out once, when it is first asked for, and serves for as long as the bags stay together.
"""

from __future__ import annotations

from functools import cached_property, lru_cache, reduce
from itertools import chain
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from ros2_memory.bag_dir.layout import CARRY_FILE, is_carried
from ros2_memory.core.model import BagState
from ros2_memory.index.columns import all_alike, column_of, rows_in
from ros2_memory.index.split_order import split_ranges_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from ros2_memory.core.bag_summary import SummarySchema
    from ros2_memory.core.model import BagFile, TimeWindow, TopicSummary
    from ros2_memory.core.timebase import Ns
    from ros2_memory.index.columns import Alike, Column
    from ros2_memory.index.split_order import Series, SplitRange

_RUNS_AT_HAND: Final = 64
"""Two days of splits."""

HeldMessages: TypeAlias = "tuple[BagFile, TopicSummary]"
"""A bag, and what it holds of one topic under one type."""


class Extent(NamedTuple):
    """A bag, and the log times (inclusive) of the first and last message that it holds of a topic.

    A bag in which the topic has two types has two extents.
    """

    bag: BagFile
    first: Ns
    last: Ns


Span: TypeAlias = "tuple[Ns, Ns]"
"""Log times of a first and a last message, both inclusive."""


def in_time(bag: BagFile) -> tuple[Ns, Ns, str]:
    """What orders bags: the times inside them, never their names; the file only breaks ties."""
    return bag.start, bag.end, bag.file


class Stated(NamedTuple):
    """What summaries say of one topic under one type."""

    first: Ns
    last: Ns
    messages: int

    def with_more(self, other: Stated) -> Stated:
        """Both together."""
        return Stated(
            min(self.first, other.first), max(self.last, other.last), self.messages + other.messages
        )


class Tally(NamedTuple):
    """How many bags, and how many messages they hold."""

    bags: int
    messages: int


class Segment:
    """Some consecutive bags of a timeline; never without any."""

    def __init__(self, bags: Sequence[BagFile]) -> None:
        self.bags = tuple(bags)
        self.first = in_time(self.bags[0])

    @cached_property
    def latest(self) -> Ns:
        """Log time of the last message in any of the bags."""
        return max([bag.end for bag in self.bags])

    @cached_property
    def recorded(self) -> tuple[BagFile, ...]:
        """The bags without that of carried messages."""
        if any(bag.file.endswith(CARRY_FILE) for bag in self.bags):
            return tuple(bag for bag in self.bags if not is_carried(bag.path))
        return self.bags

    @cached_property
    def taken(self) -> tuple[int, int]:
        """As `taken_by`, of those."""
        return taken_by(self.recorded)

    @cached_property
    def taken_in(self) -> dict[str, int]:
        """The bytes that those take on disk, by the folder in which they lie."""
        taken: dict[str, int] = {}
        for bag in self.recorded:
            folder = bag.file[: bag.file.rfind("/")]
            taken[folder] = taken.get(folder, 0) + bag.size
        return taken

    @cached_property
    def folders(self) -> frozenset[str]:
        """The folders in which the bags lie."""
        return frozenset([bag.file[: bag.file.rfind("/")] for bag in self.bags])

    @cached_property
    def tallies(self) -> dict[str, Tally]:
        """How many bags of the run lie in each folder, and how many messages those hold."""
        found: dict[str, Tally] = {}
        for bag in self.bags:
            folder = bag.file[: bag.file.rfind("/")]
            bags, messages = found.get(folder, (0, 0))
            found[folder] = Tally(bags + 1, messages + bag.summary.count)
        return found

    @cached_property
    def courses(self) -> dict[Series, SplitRange]:
        """How far each recording's splits reach among the bags, by their count."""
        return split_ranges_of(self.bags)

    @cached_property
    def odd(self) -> tuple[BagFile, ...]:
        """The bags of which not all could be read, or that contradict themselves."""
        return tuple(
            bag
            for bag in self.bags
            if bag.summary.shape.remarks or bag.state is BagState.INCOMPLETE
        )

    @cached_property
    def set_back(self) -> tuple[BagFile, ...]:
        """The bags in which times go back."""
        return tuple(bag for bag in self.recorded if bag.summary.shape.set_back)

    @cached_property
    def _shapes(self) -> tuple[SummarySchema, ...]:
        """The shapes of the bags. Most runs have one."""
        return tuple({id(bag.summary.shape): bag.summary.shape for bag in self.bags}.values())

    @cached_property
    def stated(self) -> dict[str, dict[str, Stated]]:
        """By topic and type, what the summaries of the bags say."""
        stated: dict[str, dict[str, Stated]] = {}
        for shape, _, numbers in _at_hand(self).alike:
            rows = zip(
                shape.topics,
                numbers[:, :, 1].min(axis=0).tolist(),
                numbers[:, :, 2].max(axis=0).tolist(),
                numbers[:, :, 0].sum(axis=0).tolist(),
                strict=True,
            )
            for (topic, type_name, *_), first, last, messages in rows:
                by_type = stated.setdefault(topic, {})
                here = Stated(first, last, messages)
                known = by_type.get(type_name)
                by_type[type_name] = here if known is None else known.with_more(here)
        return stated

    def recordings(self, topic: str) -> dict[Path, Span]:
        """The recordings that hold the topic, each with the times of its first and last message."""
        column = self._column(topic)
        if column is None:
            return {}
        folders = [self.bags[at].recording for at in column.at.tolist()]
        if folders.count(folders[0]) == len(folders):
            return {folders[0]: self.spans[topic]}
        spans: dict[Path, Span] = {}
        rows = zip(folders, column.firsts.tolist(), column.lasts.tolist(), strict=True)
        for folder, first, last in rows:
            spans[folder] = wider(spans.get(folder), (first, last))
        return spans

    def holding(self, topic: str, window: TimeWindow | None = None) -> Iterator[HeldMessages]:
        """The bags that hold messages of the topic, one entry for each type, in bag order.

        With a window, those that may hold some in it.
        """
        column = self._column(topic)
        if column is None:
            return
        rows = rows_in(column, window)
        for at, place in zip(column.at[rows].tolist(), column.places[rows].tolist(), strict=True):
            bag = self.bags[at]
            yield bag, bag.summary.at(place)

    def extents(self, topic: str, window: TimeWindow | None = None) -> Iterator[Extent]:
        """As `holding`, but of the summaries only the times of the first and last message."""
        column = self._column(topic)
        if column is None:
            return
        rows = rows_in(column, window)
        columns = (column.at, column.firsts, column.lasts)
        for at, first, last in zip(*(each[rows].tolist() for each in columns), strict=True):
            yield Extent(self.bags[at], first, last)

    def bags_with(self, topic: str) -> tuple[BagFile, ...]:
        """The bags that hold messages of the topic, in order; `bags` itself where all do."""
        if all(topic in shape.places for shape in self._shapes):
            return self.bags
        column = self._column(topic)
        places = [] if column is None else column.at.tolist()
        return tuple(self.bags[at] for at in dict.fromkeys(places))

    def _column(self, topic: str) -> Column | None:
        """What is held of a topic; None where nothing is."""
        numbers = _at_hand(self)
        if topic not in numbers.columns:
            numbers.columns[topic] = column_of(numbers.alike, topic)
        return numbers.columns[topic]

    @cached_property
    def spans(self) -> dict[str, Span]:
        """By topic, the log times of its first and last message (inclusive)."""
        return {
            topic: (
                min(each.first for each in by_type.values()),
                max(each.last for each in by_type.values()),
            )
            for topic, by_type in self.stated.items()
        }

    @cached_property
    def types(self) -> dict[str, frozenset[str]]:
        """By topic, the types that its messages have."""
        types: dict[str, set[str]] = {}
        for shape in self._shapes:
            for heading in shape.topics:
                types.setdefault(heading.topic, set()).add(heading.type)
        return {topic: frozenset(names) for topic, names in types.items()}

    @cached_property
    def latched(self) -> frozenset[str]:
        """The topics that some publisher offered as transient local."""
        return frozenset(
            heading.topic for shape in self._shapes for heading in shape.topics if heading.latched
        )

    @cached_property
    def held(self) -> frozenset[str]:
        """Those of them that are no logs: `/rosout` is transient local everywhere."""
        return frozenset(
            heading.topic
            for shape in self._shapes
            for heading in shape.topics
            if heading.latched and not is_log(heading.type)
        )

    def stated_in(self, topic: str, recording: Path) -> Stated | None:
        """What the summaries of a recording's bags say of a topic, under all of its types."""
        folder = str(recording)
        if folder not in self.folders or topic not in self.stated:
            return None
        if len(self.folders) == 1:
            said = [*self.stated[topic].values()]
        else:
            said = [
                Stated(held.first, held.last, held.count)
                for bag, held in self.holding(topic)
                if bag.recording == recording
            ]
        return reduce(Stated.with_more, said) if said else None

    def extent_of(self, recording: Path) -> Span | None:
        """The times (inclusive) between which a recording has bags among these."""
        folder = str(recording)
        if folder not in self.folders:
            return None
        if len(self.folders) == 1:
            return self.bags[0].start, self.latest
        own = [bag for bag in self.bags if bag.recording == recording]
        return own[0].start, max(bag.end for bag in own)

    @cached_property
    def silent(self) -> frozenset[str]:
        """The topics that some bag declares without a message."""
        return frozenset(chain.from_iterable(shape.silent for shape in self._shapes))


def is_log(type_name: str) -> bool:
    """Whether messages of a type are lines of a log."""
    return type_name in {"rcl_interfaces/msg/Log", "rcl_interfaces/Log"}


def taken_by(bags: Sequence[BagFile]) -> tuple[int, int]:
    """The bytes that bags take on disk, and how many of them a crash left open."""
    left_open = [bag.state is BagState.INCOMPLETE for bag in bags]
    return sum([bag.size for bag in bags]), sum(left_open)


def wider(known: Span | None, span: Span) -> Span:
    """The span of both, where one is known."""
    return span if known is None else (min(known[0], span[0]), max(known[1], span[1]))


class _Numbers:
    """The numbers of a run's bags, and what of them was asked for."""

    def __init__(self, alike: tuple[Alike, ...]) -> None:
        self.alike = alike
        self.columns: dict[str, Column | None] = {}


@lru_cache(maxsize=_RUNS_AT_HAND)
def _at_hand(run: Segment) -> _Numbers:
    """The numbers of a run: a copy of what its summaries say, so of a week few are held."""
    return _Numbers(all_alike(run.bags))
