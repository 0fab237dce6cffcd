"""The digest of one topic in one closed bag, and how it is built from the topic's messages."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import repeat
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.analysis.bulk_decode import BulkDecoder
from ros2_memory.core.errors import UndecodableError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ros2_memory.analysis.payload_templates import Bytes, PayloadTemplate, Templates
    from ros2_memory.core.model import StampedTransform
    from ros2_memory.core.timebase import Ns
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.storage.base import BagReader, Record

MAX_STORED: Final = 64
"""Messages of a topic of few messages, latched ones or transforms, that are stored whole."""
MAX_STORED_BYTES: Final = 1 << 20
_MAX_EDGES: Final = 1_000
_BATCH_BYTES: Final = 1 << 20
_FEWEST: Final = 8
"""Messages below which decoding them one by one costs no more than using a known template."""


@dataclass(frozen=True, slots=True)
class EdgeDigest:
    """The parent and child pairs of a topic of transforms, sorted.

    `first_stamp` and `last_stamp` are the least and greatest header stamp in its first and its
    last message; None where these hold no transform.
    """

    pairs: tuple[tuple[str, str], ...]
    first_stamp: Ns | None
    last_stamp: Ns | None


@dataclass(frozen=True, slots=True)
class TopicDigest:
    """What one bag holds of one topic, of all its types together.

    Attributes:
        topic: its name.
        edges: its frame edges; None where some message could not be decoded, or they are too many.
        kept: all its messages in order, where they are few; else None.
        relatched: whether one of its messages may repeat a message of another recording.
        undecodable: by type, why none of its messages can be decoded; mostly empty.
    """

    topic: str
    edges: EdgeDigest | None
    kept: tuple[Record, ...] | None
    undecodable: tuple[tuple[str, str], ...] = ()
    relatched: bool = False


class _Sample(NamedTuple):
    """What one message contributes to the digest.

    `pairs` are the frames of its valid transforms where it was decoded alone, None if not
    requested.
    """

    pairs: frozenset[tuple[str, str]] | None = frozenset()


class TopicCollector:
    """Builds the digest of one topic from its messages in log-time order.

    Args:
        topic: its name.
        reader: decodes the messages.
        extractor: gives the values that conditions are tested on.
        templates: of the same reader and extractor.
        latched: whether its messages are stored whole where they are few.
    """

    def __init__(
        self,
        topic: str,
        reader: BagReader,
        extractor: SchemaExtractor,
        templates: Templates,
        *,
        latched: bool,
    ) -> None:
        self._topic = topic
        self._reader = reader
        self._extractor = extractor
        self._templates = templates
        self._latched = latched
        self._relatched = False
        self._pairs: set[tuple[str, str]] | None = set()
        self._ends: tuple[Record, Record] | None = None
        self._kept: list[Record] | None = []
        self._kept_bytes = 0
        self._decoder = BulkDecoder(self._decode, self._template, self._apply, fewest=_FEWEST)
        self._batch: list[Record] = []
        self._batch_bytes = 0

    def add(self, record: Record) -> None:
        """Takes the next message."""
        if self._kept is not None:
            self._keep(self._kept, record)
        if self._latched and not self._relatched:
            self._relatched = record.may_be_relatched
        self._batch.append(record)
        self._batch_bytes += len(record.payload)
        if self._batch_bytes > _BATCH_BYTES:
            self._decode_batch()

    def digest(self, undecodable: dict[str, str]) -> TopicDigest:
        """Returns the digest; `undecodable` says, by type, why its messages cannot be decoded."""
        self._decode_batch()
        # Its functions are methods of this one: the cycle would keep all messages in memory.
        del self._decoder
        few = self._kept is not None and (self._latched or bool(self._pairs))
        return TopicDigest(
            topic=self._topic,
            edges=self._edges(),
            kept=tuple(self._kept) if self._kept is not None and few else None,
            undecodable=tuple(undecodable.items()),
            relatched=self._relatched,
        )

    def _keep(self, kept: list[Record], record: Record) -> None:
        self._kept_bytes += len(record.payload)
        if len(kept) == MAX_STORED or self._kept_bytes > MAX_STORED_BYTES:
            self._kept = None
        else:
            kept.append(record)

    def _edges(self) -> EdgeDigest | None:
        if self._pairs is None:
            return None
        ends = self._ends if self._pairs else None
        stamps = [
            each.stamp
            for end in ends or ()
            for each in self._transforms(self._reader.decode(end), end)
        ]
        return EdgeDigest(
            tuple(sorted(self._pairs)), min(stamps, default=None), max(stamps, default=None)
        )

    def _transforms(self, message: object, record: Record) -> tuple[StampedTransform, ...]:
        return self._extractor.transforms(message, record.log_time, static=False)

    def _decode_batch(self) -> None:
        """Decodes the waiting messages."""
        batch, self._batch, self._batch_bytes = self._batch, [], 0
        if batch:
            self._ends = (batch[0] if self._ends is None else self._ends[0], batch[-1])
        if any(isinstance(sample, UndecodableError) for sample in self._decoder.decode(batch)):
            self._pairs = None

    def _decode(self, record: Record) -> _Sample:
        """Decodes one message; its edges count at once, since their order does not."""
        message = self._reader.decode(record)
        pairs = None
        if self._pairs is not None:
            pairs = self._add_transforms(self._transforms(message, record))
        return _Sample(pairs)

    def _add_transforms(self, transforms: Sequence[StampedTransform]) -> frozenset[tuple[str, str]]:
        """Takes the valid transforms of a message, and returns their frames."""
        pairs = frozenset([(each.parent, each.child) for each in transforms])
        if self._pairs is not None and pairs:
            self._pairs |= pairs
            if len(self._pairs) > _MAX_EDGES:
                self._pairs = None
        return pairs

    def _template(self, record: Record, sample: _Sample) -> PayloadTemplate | None:
        template = self._templates.of(record)
        # A transform that is invalid in this message may be valid in others of the template.
        return template if template is not None and template.pairs == sample.pairs else None

    def _apply(
        self, _: PayloadTemplate, __: _Sample, ___: Sequence[Record], rows: Bytes
    ) -> Iterable[_Sample]:
        return repeat(_Sample(), len(rows))
