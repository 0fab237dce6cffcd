"""What one bag holds, topic by topic, kept so that 60,000 bags fit into a small memory.

Nearly all bags of a robot hold the same topics and differ in counts and times alone. So a summary
is a `SummarySchema`, which many share, and its numbers as bytes; a `TopicSummary` is made when it
is asked for.
"""

from __future__ import annotations

import struct
import sys
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Final, NamedTuple, Self

from ros2_memory.core.timebase import NS_PER_S, Ns

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

OUT_OF_ORDER_NS: Final[Ns] = NS_PER_S
"""Messages are written out of order by less than this, also across two splits."""

_NUMBERS: Final = struct.Struct("<qqq")
"""Count, first and last log time of a topic."""

_SHAPES_AT_HAND: Final = 1024


@dataclass(frozen=True, slots=True)
class TopicSummary:
    """What one bag holds of one topic under one type; only where it holds at least one message.

    `first` and `last` are the exact log times of its earliest and latest message (inclusive).
    `latched`: some publisher offered it as transient local.
    """

    topic: str
    type: str
    encoding: str
    count: int
    first: Ns
    last: Ns
    latched: bool = False


class TopicHeader(NamedTuple):
    """What of a `TopicSummary` does not differ from bag to bag."""

    topic: str
    type: str
    encoding: str
    latched: bool


@dataclass(frozen=True)
class SummarySchema:
    """All of a summary but its numbers; see `BagSummary` for what the fields say."""

    topics: tuple[TopicHeader, ...]
    silent: tuple[str, ...] = ()
    complete: bool = True
    notes: tuple[str, ...] = ()
    set_back: Ns = 0

    @cached_property
    def remarks(self) -> tuple[str, ...]:
        """The notes, and a sentence on a clock that was set back."""
        return (*self.notes, set_back_while_written(self.set_back)) if self.set_back else self.notes

    @cached_property
    def places(self) -> dict[str, tuple[int, ...]]:
        """By topic, where it stands among `topics`: once for each of its types."""
        places: dict[str, tuple[int, ...]] = {}
        for place, heading in enumerate(self.topics):
            places[heading.topic] = (*places.get(heading.topic, ()), place)
        return places

    @cached_property
    def layout(self) -> struct.Struct:
        """How the numbers of a bag lie in their bytes."""
        return struct.Struct(f"<{3 * len(self.topics)}q")


WRONG_STATISTICS: Final = "its own statistics are wrong"
READ_WITHOUT_INDEXES: Final = "its messages were read without its indexes"
MESSAGES_MISSING: Final = "messages may be missing"
DOUBTS: Final = (
    WRONG_STATISTICS,
    "its summary section ",
    "its message indexes ",
    "its chunk indexes ",
)
"""How notes begin on what a file says of itself, in spite of which it was read from end to end."""


def set_back_while_written(by: Ns) -> str:
    """The sentence on a bag in the writing of which the clock was set back by so much, or more."""
    return f"the clock was set back by {by / NS_PER_S:.0f} s or more while it was being written"


@lru_cache(maxsize=_SHAPES_AT_HAND)
def shared_schema(
    topics: tuple[TopicHeader, ...],
    silent: tuple[str, ...],
    complete: bool,
    notes: tuple[str, ...],
    set_back: Ns = 0,
) -> SummarySchema:
    """One shape for all bags that have it, with one copy of each name."""
    intern = sys.intern
    headings = tuple(
        TopicHeader(intern(each.topic), intern(each.type), intern(each.encoding), each.latched)
        for each in topics
    )
    return SummarySchema(
        headings, tuple(intern(name) for name in silent), complete, notes, set_back
    )


class BagSummary:
    """What one bag file holds. Not to be changed; equal to any other that says the same.

    Args:
        topics: one for each topic and type; their numbers fit into 64 bits.
        silent: the topics that are declared without a message.
        complete: False where the file ends early and only what was readable is counted.
        notes: sentences on what is odd.
        set_back: by how much the log times of a topic go back in the order of writing, at most; 0
            where they do so by less than a second.

    Attributes:
        shape: the summary without its numbers.
        numbers: count, first and last of each topic, in the order of the shape.
    """

    __slots__ = ("numbers", "shape")

    shape: SummarySchema
    numbers: bytes

    def __init__(
        self,
        topics: Sequence[TopicSummary],
        silent: tuple[str, ...] = (),
        complete: bool = True,
        notes: tuple[str, ...] = (),
        set_back: Ns = 0,
    ) -> None:
        headings = (
            TopicHeader(each.topic, each.type, each.encoding, each.latched) for each in topics
        )
        self.shape = shared_schema(tuple(headings), silent, complete, notes, set_back)
        numbers = (part for each in topics for part in (each.count, each.first, each.last))
        self.numbers = self.shape.layout.pack(*numbers)

    @classmethod
    def packed(cls, shape: SummarySchema, numbers: bytes) -> Self:
        """The summary of these numbers, which must be as many as the shape has."""
        made = cls.__new__(cls)
        made.shape = shape
        made.numbers = numbers
        return made

    def replaced(
        self,
        *,
        topics: Sequence[TopicSummary] | None = None,
        complete: bool | None = None,
        notes: tuple[str, ...] | None = None,
    ) -> BagSummary:
        """This summary with some of it said otherwise."""
        return BagSummary(
            self.topics if topics is None else topics,
            self.silent,
            self.complete if complete is None else complete,
            self.notes if notes is None else notes,
            self.shape.set_back,
        )

    @property
    def topics(self) -> tuple[TopicSummary, ...]:
        """Each topic under each of its types, made anew."""
        return tuple(self.at(place) for place in range(len(self.shape.topics)))

    def at(self, place: int) -> TopicSummary:
        """The topic at a place of the shape."""
        topic, type_name, encoding, latched = self.shape.topics[place]
        count, first, last = _NUMBERS.unpack_from(self.numbers, place * _NUMBERS.size)
        return TopicSummary(topic, type_name, encoding, count, first, last, latched)

    def of(self, topic: str) -> tuple[TopicSummary, ...]:
        """One topic under each of its types."""
        return tuple(self.at(place) for place in self.shape.places.get(topic, ()))

    def span_of(self, topics: Collection[str]) -> tuple[Ns, Ns]:
        """Log times of the first and last message of these topics; it must hold one of them."""
        known, numbers = self.shape.places, self._unpacked()
        places = [place for topic in topics for place in known.get(topic, ())]
        return (
            min(numbers[3 * place + 1] for place in places),
            max(numbers[3 * place + 2] for place in places),
        )

    @property
    def silent(self) -> tuple[str, ...]:
        """The topics that are declared without a message."""
        return self.shape.silent

    @property
    def complete(self) -> bool:
        """Whether the file was readable to its end."""
        return self.shape.complete

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on what is odd."""
        return self.shape.notes

    @property
    def remarks(self) -> tuple[str, ...]:
        """The notes, and a sentence on a clock that was set back."""
        return self.shape.remarks

    @property
    def count(self) -> int:
        """Messages on all topics."""
        return sum(self._unpacked()[0::3])

    @property
    def empty(self) -> bool:
        """Whether the bag holds no message: such a bag has no start and no end."""
        return not self.shape.topics

    @property
    def start(self) -> Ns:
        """Log time of the earliest message. Only for a bag that is not empty."""
        return min(self._unpacked()[1::3])

    @property
    def end(self) -> Ns:
        """Log time of the latest message (inclusive). Only for a bag that is not empty."""
        return max(self._unpacked()[2::3])

    def _unpacked(self) -> tuple[int, ...]:
        return self.shape.layout.unpack(self.numbers)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, BagSummary):
            return NotImplemented
        return self.numbers == other.numbers and self.shape == other.shape

    def __hash__(self) -> int:
        return hash((self.shape, self.numbers))

    def __repr__(self) -> str:
        return (
            f"BagSummary(topics={self.topics!r}, silent={self.silent!r},"
            f" complete={self.complete!r}, notes={self.notes!r}, set_back={self.shape.set_back})"
        )
