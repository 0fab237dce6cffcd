"""One closed bag read once: what it holds of each topic, short enough to be kept of every bag.

A digest answers a question about the bag, or rules the bag out, without opening it. What it
cannot say for sure it leaves open: then the bag is read. Pure: reads through the port, keeps
nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from ros2_memory.conditions import leaves, positions
from ros2_memory.errors import UndecodableError
from ros2_memory.evidence import (
    MOST_NUMBERS,
    MOST_WORD_CHARS,
    MOST_WORDS,
    OPEN,
    Box,
    Evidence,
    joined_words,
    rounded,
    words_of,
)
from ros2_memory.model import TimeWindow
from ros2_memory.trajectory import PoseCollector

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.model import BagSummary, JsonValue, StampedTransform
    from ros2_memory.motion import PoseDigest
    from ros2_memory.storage.base import BagReader, Record
    from ros2_memory.timebase import Ns

DIGEST_VERSION: Final = 1
"""Of what is found in a bag and how; another one has every bag digested again."""
MOST_KEPT: Final = 64
"""Messages that are kept whole of a topic that has few: latched ones, and transforms."""
MOST_KEPT_BYTES: Final = 1 << 20

MOST_TEXTS: Final = 2_000
"""Distinct texts of one topic that are looked at before its words count as too many."""
MOST_EDGES: Final = 1_000

_LARGEST: Final = 1e300


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
    """What one bag holds of one topic, under whatever types.

    Attributes:
        topic: its name.
        evidence: what rules conditions out.
        poses: what its poses amount to; None where some message carries none.
        edges: its frame edges; None where some message could not be decoded, or they are too many.
        kept: all its messages in order, where they are few; else None.
        undecodable: by type, why none of its messages can be decoded; for most nothing.
    """

    topic: str
    evidence: Evidence
    poses: PoseDigest | None
    edges: EdgeDigest | None
    kept: tuple[Record, ...] | None
    undecodable: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class Digest:
    """What one closed bag holds."""

    summary: BagSummary
    topics: tuple[TopicDigest, ...]


class Digester:
    """Makes digests, the same from the same bag.

    Args:
        reader: gives the messages that count.
        extractor: gives the values that conditions are tested on.
        max_plausible_speed_mps: what makes a jump of a step of the robot.
    """

    def __init__(
        self, reader: BagReader, extractor: SchemaExtractor, max_plausible_speed_mps: float
    ) -> None:
        self._reader = reader
        self._extractor = extractor
        self._max_plausible_speed_mps = max_plausible_speed_mps

    def digest(self, path: Path) -> Digest:
        """What the bag holds.

        Raises:
            BagVanishedError: the file is not there any more.
            BagError: some of it cannot be read.
        """
        summary = self._reader.summarize(path)
        topics = {each.topic: False for each in summary.topics}
        for each in summary.topics:
            topics[each.topic] |= each.latched
        collectors = {
            topic: _Collector(topic, self._reader, self._extractor, limit, latched=latched)
            for limit in (self._max_plausible_speed_mps,)
            for topic, latched in topics.items()
        }
        for record in self._reader.records(path, tuple(topics), TimeWindow.everything()):
            collectors[record.channel.topic].add(record)
        reasons = self._reasons(path)
        return Digest(
            summary,
            tuple(each.digest(reasons.get(topic, {})) for topic, each in collectors.items()),
        )

    def _reasons(self, path: Path) -> dict[str, dict[str, str]]:
        """By topic and type, why messages cannot be decoded."""
        reasons: dict[str, dict[str, str]] = {}
        for channel in self._reader.channels(path):
            reason = self._reader.undecodable(channel)
            if reason:
                reasons.setdefault(channel.topic, {})[channel.type] = reason
        return reasons


class _Collector:
    """Takes the messages of one topic, in order."""

    def __init__(
        self,
        topic: str,
        reader: BagReader,
        extractor: SchemaExtractor,
        max_plausible_speed_mps: float,
        *,
        latched: bool,
    ) -> None:
        self._topic = topic
        self._reader = reader
        self._extractor = extractor
        self._latched = latched
        self._evidence = EvidenceCollector()
        self._poses: PoseCollector | None = PoseCollector(max_plausible_speed_mps)
        self._edges: _Edges | None = _Edges()
        self._kept: list[Record] | None = []
        self._kept_bytes = 0

    def add(self, record: Record) -> None:
        self._keep(record)
        type_name = record.channel.type
        try:
            message = self._reader.decode(record)
        except UndecodableError:
            self._evidence.give_up()
            self._poses = self._edges = None
            return
        self._evidence.add(self._extractor.exact(message, type_name))
        if self._poses is not None:
            pose = self._extractor.pose(message, type_name)
            if pose is None:
                self._poses = None
            else:
                twist = self._extractor.twist(message, type_name)
                speed = None if twist is None else math.hypot(*twist.linear)
                self._poses.add(record.log_time, pose, speed)
        if self._edges is not None and not self._edges.add(
            self._extractor.transforms(message, record.log_time, static=False)
        ):
            self._edges = None

    def digest(self, undecodable: dict[str, str]) -> TopicDigest:
        edges = None if self._edges is None else self._edges.digest()
        few = self._kept is not None and (self._latched or bool(edges and edges.pairs))
        return TopicDigest(
            topic=self._topic,
            evidence=self._evidence.evidence(),
            poses=None if self._poses is None else self._poses.digest(),
            edges=edges,
            kept=tuple(self._kept) if self._kept is not None and few else None,
            undecodable=tuple(undecodable.items()),
        )

    def _keep(self, record: Record) -> None:
        if self._kept is None:
            return
        self._kept_bytes += len(record.payload)
        if len(self._kept) == MOST_KEPT or self._kept_bytes > MOST_KEPT_BYTES:
            self._kept = None
        else:
            self._kept.append(record)


class _Edges:
    """Takes the transforms of one topic, message by message."""

    def __init__(self) -> None:
        self._pairs: set[tuple[str, str]] = set()
        self._first: list[Ns] | None = None
        self._last: list[Ns] = []

    def add(self, transforms: tuple[StampedTransform, ...]) -> bool:
        """Takes one message's; False where they are too many to keep."""
        self._pairs.update((each.parent, each.child) for each in transforms)
        self._last = [each.stamp for each in transforms]
        if self._first is None:
            self._first = self._last
        return len(self._pairs) <= MOST_EDGES

    def digest(self) -> EdgeDigest:
        stamps = [*(self._first or ()), *self._last]
        return EdgeDigest(
            tuple(sorted(self._pairs)), min(stamps, default=None), max(stamps, default=None)
        )


class EvidenceCollector:
    """Takes extracted values, and says what can have stood in them."""

    def __init__(self) -> None:
        self._open = False
        self._strings: set[str] = set()
        self._words: set[str] | None = set()
        self._chars = 0
        self._booleans: set[bool] = set()
        self._low = math.inf
        self._high = -math.inf
        self._numbers: set[int | float] | None = set()
        self._box: Box | None = None

    def give_up(self) -> None:
        """A message whose value is not known: nothing can be ruled out any more."""
        self._open = True

    def add(self, value: JsonValue) -> None:
        """Takes the exact value of one message."""
        if self._open:
            return
        numbers: list[int | float] = []
        for leaf in leaves(value):
            if isinstance(leaf, str):
                self._add_text(leaf)
            elif isinstance(leaf, bool):
                self._booleans.add(leaf)
            elif isinstance(leaf, int) or (isinstance(leaf, float) and not math.isnan(leaf)):
                numbers.append(leaf)
        if numbers:
            self._add_numbers(numbers)
            for x, y, z in positions(value):
                self._add_place(x, y, z)

    def evidence(self) -> Evidence:
        """What the values so far can have held."""
        if self._open:
            return OPEN
        return Evidence(
            words=None if self._words is None else joined_words(self._words),
            texts=bool(self._strings),
            booleans=tuple(sorted(self._booleans)),
            low=self._low,
            high=self._high,
            numbers=None if self._numbers is None else tuple(self._numbers),
            box=self._box,
        )

    def _add_text(self, text: str) -> None:
        if text in self._strings or (self._words is None and self._strings):
            return
        self._strings.add(text)
        if self._words is None:
            return
        fresh = set(words_of(text.casefold())) - self._words
        self._chars += sum(len(word) + 1 for word in fresh)
        many = len(self._strings) > MOST_TEXTS or len(self._words) + len(fresh) > MOST_WORDS
        if many or self._chars > MOST_WORD_CHARS:
            self._words = None
        else:
            self._words |= fresh

    def _add_numbers(self, numbers: list[int | float]) -> None:
        low, high = min(numbers), max(numbers)
        if low < self._low:
            self._low = rounded(low, up=False)
        if high > self._high:
            self._high = rounded(high, up=True)
        if self._numbers is not None:
            self._numbers.update(numbers[: MOST_NUMBERS + 1])
            # JSON may hold whole numbers of any length.
            huge = max(abs(low), abs(high)) > _LARGEST
            if huge or len(numbers) > MOST_NUMBERS or len(self._numbers) > MOST_NUMBERS:
                self._numbers = None

    def _add_place(self, x: float, y: float, z: float) -> None:
        if not (math.isfinite(x) and math.isfinite(y)):
            return
        low_z, high_z = (z, z) if math.isfinite(z) else (math.inf, -math.inf)
        here = Box(x, x, y, y, low_z, high_z)
        self._box = here if self._box is None else self._box.united(here)
