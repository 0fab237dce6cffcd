"""What one bag holds, topic by topic, stored so that 60,000 bags fit into a small memory.

Nearly all bags of a robot hold the same topics, and differ only in counts and times. So a summary
has a `SummarySchema`, which many bags share, and its numbers as bytes; a `TopicSummary` is unpacked
on demand.
"""

from __future__ import annotations

import json
import struct
import sys
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias, TypeVar, cast

import numpy as np

from ros2_memory.core.timebase import NS_PER_S, Ns, Span

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Sequence

    from ros2_memory.core.arrays import Ints
    from ros2_memory.core.pauses import Absences, Pauses


T = TypeVar("T")

SetBack: TypeAlias = "tuple[Ns, Ns] | None"
"""The step back of log times, and the first log time after it; None without such a step."""
OUT_OF_ORDER_NS: Final[Ns] = NS_PER_S
"""Messages are written out of order by less than this, also across two splits."""

_NUMBERS: Final = struct.Struct("<qqq")
"""Count, first and last log time of a topic."""

_COUNT_BYTES: Final = 3
_TIME_BYTES: Final = 5
"""Of a packed count, and of a packed time since the bag's start: up to 18 min after it."""
_TOPIC_BYTES: Final = _COUNT_BYTES + 2 * _TIME_BYTES
_BASE: Final = struct.Struct("<q")

_CACHED_SCHEMAS: Final = 1024


@dataclass(frozen=True, slots=True)
class TopicSummary:
    """The messages of one topic and type in one bag; at least one.

    Attributes:
        first: the least log time.
        last: the greatest log time (inclusive).
        latched: whether some publisher offered the topic as transient local.
    """

    topic: str
    type: str
    encoding: str
    count: int
    first: Ns
    last: Ns
    latched: bool = False


class TopicHeader(NamedTuple):
    """The part of a `TopicSummary` that does not differ from bag to bag."""

    topic: str
    type: str
    encoding: str
    latched: bool


@dataclass(frozen=True)
class SummarySchema:
    """A summary without its numbers.

    Attributes:
        topics: one for each topic and type.
        silent: the topics that are declared without a message.
        complete: False if the file ends early and only its readable part is counted.
        notes: sentences on what is wrong with the file.
        set_back: the greatest step back of log times of a topic, in the order of writing, if it is
            a second or more.
        pauses: times without a message of any topic, if some topic usually has messages.
        absences: long times without a message of one topic, each with the messages before it.
    """

    topics: tuple[TopicHeader, ...] = ()
    silent: tuple[str, ...] = ()
    complete: bool = True
    notes: tuple[str, ...] = ()
    set_back: SetBack = None
    pauses: Pauses = ()
    absences: Absences = ()

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        # Once: bags are looked up by their content, and some recordings have thousands of topics.
        return hash(tuple(getattr(self, column.name) for column in fields(self)))

    @cached_property
    def remarks(self) -> tuple[str, ...]:
        """The notes, and a sentence on a clock that was set back."""
        if self.clock_set_back is None:
            return self.notes
        by, _ = self.clock_set_back
        return (*self.notes, set_back_while_written(by))

    @cached_property
    def faults(self) -> tuple[str, ...]:
        """The notes but for an early end."""
        return tuple(note for note in self.notes if not note.startswith(ENDS_EARLY))

    @cached_property
    def is_damaged(self) -> bool:
        """Whether the file is known as damaged: then its times may be, too."""
        return any(_DAMAGED in note for note in self.notes)

    @cached_property
    def clock_set_back(self) -> SetBack:
        """`set_back`, if it shows that a clock was set back: not in a damaged file."""
        return None if self.is_damaged else self.set_back

    @cached_property
    def positions(self) -> dict[str, tuple[int, ...]]:
        """The positions of each topic among `topics`; see `positions_of`."""
        return positions_of(self.topics)

    def to_json(self) -> str:
        """Returns the schema as JSON; equal schemas give equal texts."""
        return json.dumps([getattr(self, column.name) for column in fields(self)])

    @staticmethod
    def from_json(text: str) -> SummarySchema:
        """Returns the schema of a text that `to_json` returned.

        Raises:
            ValueError, TypeError: the text is not valid.
        """
        topics, *others = _with_tuples(json.loads(text))
        headers = tuple(TopicHeader(*header) for header in topics)
        return shared_schema(SummarySchema(headers, *others))


def _with_tuples(value: T) -> T:
    """Returns a value of JSON with tuples in place of lists."""
    return cast("T", tuple(map(_with_tuples, value))) if isinstance(value, list) else value


_DAMAGED: Final = "damaged"
"""A word in each note on bytes that no recorder wrote so."""
WRONG_STATISTICS: Final = "its own statistics are wrong"
READ_WITHOUT_INDEXES: Final = "its messages were read without its indexes"
MESSAGES_MISSING: Final = "messages may be missing"
NONE_LOST: Final = "none is lost"
ENDS_EARLY: Final = "the file ends early"
DOUBTS: Final = (
    WRONG_STATISTICS,
    "its summary section ",
    "its message indexes ",
    "its chunk indexes ",
)
"""Beginnings of notes on files that contradict themselves; these are read from end to end."""


def numbers_of(
    schema: SummarySchema, joined: bytes, summaries: int, positions: Sequence[int]
) -> Ints:
    """Unpacks the numbers of some topics from the joined `data` of several summaries.

    All summaries have this schema, and data of the same size.

    Returns:
        Count, first and last log time, in the shape (positions, summaries, 3).
    """
    size = len(joined) // summaries
    if size == len(schema.topics) * _NUMBERS.size:
        numbers = np.frombuffer(joined, "<i8").reshape(summaries, -1, 3)
        return numbers[:, positions].swapaxes(0, 1)
    base = np.ndarray((summaries,), "<i8", joined, 0, (size,))
    # Read as eight bytes each: a count (3 bytes) with a first time (5 bytes), and, five bytes
    # later, the end of that first time (3 bytes) with a last time (5 bytes).
    shape, strides = (2, len(schema.topics), summaries), (_TIME_BYTES, _TOPIC_BYTES, size)
    pairs = np.ndarray(shape, "<i8", joined, _BASE.size, strides)[:, [*positions]]
    unpacked: Ints = np.empty((3, len(positions), summaries), np.int64)
    unpacked[0] = pairs[0] & ((1 << 8 * _COUNT_BYTES) - 1)
    unpacked[1:] = base + (pairs.view("<u8") >> 8 * _COUNT_BYTES).view("<i8")
    return unpacked.transpose(1, 2, 0)


def set_back_while_written(by: Ns) -> str:
    """Returns a sentence on a clock that was set back by at least `by` within one bag."""
    return f"the clock was set back by {by / NS_PER_S:.0f} s or more while it was being written"


@lru_cache(maxsize=_CACHED_SCHEMAS)
def shared_schema(schema: SummarySchema) -> SummarySchema:
    """Returns the one object for all equal schemas, with one object for all equal topics."""
    topics, silent = _shared_headers(schema.topics), tuple(map(sys.intern, schema.silent))
    return replace(schema, topics=topics, silent=silent)


# Apart: bags with pauses or remarks have schemas of their own, and the same topics.
@lru_cache(maxsize=_CACHED_SCHEMAS)
def _shared_headers(topics: tuple[TopicHeader, ...]) -> tuple[TopicHeader, ...]:
    intern = sys.intern
    return tuple(
        TopicHeader(intern(topic), intern(type_name), intern(encoding), latched)
        for topic, type_name, encoding, latched in topics
    )


@lru_cache(maxsize=_CACHED_SCHEMAS)
def positions_of(topics: tuple[TopicHeader, ...]) -> dict[str, tuple[int, ...]]:
    """Returns the positions of each topic: one for each of its types."""
    positions: dict[str, tuple[int, ...]] = {}
    for position, header in enumerate(topics):
        positions[header.topic] = (*positions.get(header.topic, ()), position)
    return positions


@dataclass(frozen=True, slots=True)
class BagSummary:
    """What one bag file holds. Summaries of equal content are equal.

    Attributes:
        schema: the summary without its numbers.
        data: the numbers, packed into about half of their bytes if they fit.
    """

    schema: SummarySchema
    data: bytes

    @classmethod
    def packed(cls, topics: Sequence[TopicSummary], besides: SummarySchema) -> BagSummary:
        """Returns a summary of topics, one for each topic and type, with numbers of 64 bits.

        `besides` has all else; its own topics do not count.
        """
        headers = (
            TopicHeader(topic.topic, topic.type, topic.encoding, topic.latched) for topic in topics
        )
        return cls(shared_schema(replace(besides, topics=tuple(headers))), _packed(topics))

    def _numbers_at(self, position: int) -> tuple[int, Ns, Ns]:
        """Returns count, first and last of the topic at a position, without unpacking others."""
        packed = self.data
        if len(packed) == len(self.schema.topics) * _NUMBERS.size:
            count, first, last = _NUMBERS.unpack_from(packed, position * _NUMBERS.size)
            return count, first, last
        at = _BASE.size + position * _TOPIC_BYTES
        begin, end = at + _COUNT_BYTES, at + _COUNT_BYTES + _TIME_BYTES
        (base,) = _BASE.unpack_from(packed)
        count = int.from_bytes(packed[at:begin], "little")
        first = base + int.from_bytes(packed[begin:end], "little")
        last = base + int.from_bytes(packed[end : end + _TIME_BYTES], "little")
        return count, first, last

    def with_topics(self, topics: Sequence[TopicSummary]) -> BagSummary:
        """Returns the summary with other topics; absences of their messages are unknown."""
        return BagSummary.packed(topics, replace(self.schema, absences=()))

    def with_notes(self, notes: tuple[str, ...], *, is_whole: bool = True) -> BagSummary:
        """Returns the summary with other notes; not complete unless the file is whole, too."""
        complete = self.complete and is_whole
        return replace(
            self, schema=shared_schema(replace(self.schema, notes=notes, complete=complete))
        )

    @property
    def topics(self) -> tuple[TopicSummary, ...]:
        """Each topic under each of its types; unpacked at each access."""
        return tuple(map(self.at, range(len(self.schema.topics))))

    def at(self, position: int) -> TopicSummary:
        """Returns the topic at a position of the schema."""
        topic, type_name, encoding, latched = self.schema.topics[position]
        return TopicSummary(topic, type_name, encoding, *self._numbers_at(position), latched)

    def of(self, topic: str) -> tuple[TopicSummary, ...]:
        """Returns one topic under each of its types."""
        return tuple(self.at(position) for position in self.schema.positions.get(topic, ()))

    def span_of(self, topics: Collection[str]) -> Span:
        """Returns the first and last log time of some topics, of which the bag has at least one."""
        positions = self.schema.positions
        numbers = [
            self._numbers_at(position) for topic in topics for position in positions.get(topic, ())
        ]
        return min(first for _, first, _ in numbers), max(last for _, _, last in numbers)

    @property
    def complete(self) -> bool:
        """Whether the file was readable to its end."""
        return self.schema.complete

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on what is wrong with the file."""
        return self.schema.notes

    @property
    def remarks(self) -> tuple[str, ...]:
        """The notes, and a sentence on a clock that was set back."""
        return self.schema.remarks

    @property
    def count(self) -> int:
        """The number of messages on all topics."""
        return sum(count for count, _, _ in self._numbers())

    @property
    def empty(self) -> bool:
        """Whether the bag holds no message: such a bag has no start and no end."""
        return not self.schema.topics

    @property
    def start(self) -> Ns:
        """Log time of the earliest message. Only for a bag that is not empty."""
        return min(first for _, first, _ in self._numbers())

    @property
    def end(self) -> Ns:
        """Log time of the latest message (inclusive). Only for a bag that is not empty."""
        return max(last for _, _, last in self._numbers())

    def _numbers(self) -> Iterable[tuple[int, Ns, Ns]]:
        return map(self._numbers_at, range(len(self.schema.topics)))


def _packed(topics: Sequence[TopicSummary]) -> bytes:
    """Packs count, first and last of each topic: relative to the bag's start if that fits.

    Relative numbers take 13 bytes a topic, others 24.
    """
    if not topics:
        return b""
    base = min(topic.first for topic in topics)
    parts = [_BASE.pack(base)]
    try:
        for topic in topics:
            parts.append(topic.count.to_bytes(_COUNT_BYTES, "little"))
            parts.append((topic.first - base).to_bytes(_TIME_BYTES, "little"))
            parts.append((topic.last - base).to_bytes(_TIME_BYTES, "little"))
    except OverflowError:
        numbers = [(topic.count, topic.first, topic.last) for topic in topics]
        return np.array(numbers, "<i8").tobytes()
    return b"".join(parts)
