"""One closed bag read once: what it holds of each topic, short enough to be kept of every bag.

A digest answers a question about the bag, or rules the bag out, without opening it. What it
cannot say for sure it leaves open: then the bag is read. Pure: reads through the port, keeps
nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.conditions import leaves, positions
from ros2_memory.errors import BagError, UndecodableError
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
from ros2_memory.model import Pose, TimeWindow
from ros2_memory.motion import is_place
from ros2_memory.mould import mould_of
from ros2_memory.rests import RestCollector
from ros2_memory.stories import MOST_TOLD, StoryBuilder, state_of
from ros2_memory.trajectory import PoseCollector

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.model import BagSummary, JsonValue, StampedTransform
    from ros2_memory.motion import PoseDigest
    from ros2_memory.mould import Bytes, Mould
    from ros2_memory.rests import RestDigest
    from ros2_memory.storage.base import BagReader, Record
    from ros2_memory.stories import State, Story
    from ros2_memory.timebase import Ns

DIGEST_VERSION: Final = 2
"""Of what is found in a bag and how; another one has every bag digested again."""
MOST_KEPT: Final = 64
"""Messages that are kept whole of a topic that has few: latched ones, and transforms."""
MOST_KEPT_BYTES: Final = 1 << 20

MOST_TEXTS: Final = 2_000
"""Distinct texts of one topic that are looked at before its words count as too many."""
MOST_EDGES: Final = 1_000
_MOST_TEXT_CHARS: Final = 1 << 20
"""The words of a longer text alone would take more memory than it."""
_ALWAYS_READ_BYTES: Final = 64 << 20
_MESSAGE_BYTES: Final = 200
"""What a message is counted as besides its payload: looking at it takes time too."""
_MOST_TIMES_PACKED: Final = 100
"""A bag whose messages unpack to more times its size is left to be read when it is asked for."""

_LARGEST: Final = 1e300
_FEW: Final = 24
"""So many messages are decoded one by one: looking for their mould costs as much."""
_MOST_MOULDS: Final = 8
_WORTH_IT: Final = 8
"""A mould of fewer messages than these costs more than it saves."""
_MOST_WAITING_BYTES: Final = 1 << 20


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
        rests: where they stand still; None where `poses` is None or has no valid one.
        story: what its messages say; None where there is none.
        edges: its frame edges; None where some message could not be decoded, or they are too many.
        kept: all its messages in order, where they are few; else None.
        undecodable: by type, why none of its messages can be decoded; for most nothing.
    """

    topic: str
    evidence: Evidence
    poses: PoseDigest | None
    rests: RestDigest | None
    story: Story | None
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
        latched: dict[str, bool] = {}
        counts: dict[str, int] = {}
        for each in summary.topics:
            latched[each.topic] = latched.get(each.topic, False) or each.latched
            counts[each.topic] = counts.get(each.topic, 0) + each.count
        collectors = {
            topic: _Collector(
                topic,
                self._reader,
                self._extractor,
                self._max_plausible_speed_mps,
                latched=latched[topic],
                many=count > _FEW,
            )
            for topic, count in counts.items()
        }
        left = _ALWAYS_READ_BYTES + _MOST_TIMES_PACKED * _size(path)
        for record in self._reader.records(path, tuple(counts), TimeWindow.everything()):
            left -= len(record.payload) + _MESSAGE_BYTES
            if left < 0:
                raise BagError(str(path), "its messages unpack to more than they can be worth")
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


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


class _Seen(NamedTuple):
    """What one message that could be decoded says of the robot's motion, and else."""

    pose: Pose | None
    speed_mps: float | None
    state: State


class _Collector:
    """Takes the messages of one topic, in order.

    `many`: it is worth looking for moulds.
    """

    def __init__(
        self,
        topic: str,
        reader: BagReader,
        extractor: SchemaExtractor,
        max_plausible_speed_mps: float,
        *,
        latched: bool,
        many: bool,
    ) -> None:
        self._topic = topic
        self._reader = reader
        self._extractor = extractor
        self._latched = latched
        self._evidence = EvidenceCollector()
        self._poses: PoseCollector | None = PoseCollector(max_plausible_speed_mps)
        self._rests = RestCollector()
        self._story = StoryBuilder()
        self._pairs: set[tuple[str, str]] | None = set()
        self._ends: tuple[Record, Record] | None = None
        self._kept: list[Record] | None = []
        self._kept_bytes = 0
        self._moulds: list[tuple[Mould, Record, State]] = []
        self._more_moulds = _MOST_MOULDS if many else 0
        self._waiting: list[Record] = []
        self._waiting_bytes = 0

    def add(self, record: Record) -> None:
        self._keep(record)
        self._ends = (record if self._ends is None else self._ends[0], record)
        if not self._moulds and not self._more_moulds:
            self._take(record, self._decoded(record))
            return
        self._waiting.append(record)
        self._waiting_bytes += len(record.payload)
        if self._waiting_bytes > _MOST_WAITING_BYTES:
            self._flush()

    def digest(self, undecodable: dict[str, str]) -> TopicDigest:
        self._flush()
        few = self._kept is not None and (self._latched or bool(self._pairs))
        return TopicDigest(
            topic=self._topic,
            evidence=self._evidence.evidence(),
            poses=None if self._poses is None else self._poses.digest(),
            rests=None if self._poses is None else self._rests.digest(),
            story=self._story.story(MOST_TOLD),
            edges=self._edges(),
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

    def _edges(self) -> EdgeDigest | None:
        if self._pairs is None:
            return None
        ends = self._ends if self._pairs else None
        stamps = [each.stamp for end in ends or () for each in self._transforms(end)]
        return EdgeDigest(
            tuple(sorted(self._pairs)), min(stamps, default=None), max(stamps, default=None)
        )

    def _transforms(self, record: Record) -> tuple[StampedTransform, ...]:
        message = self._reader.decode(record)
        return self._extractor.transforms(message, record.log_time, static=False)

    def _decoded(self, record: Record) -> _Seen | None:
        """Takes a message but for its pose, which it gives; None where it cannot be decoded."""
        type_name = record.channel.type
        try:
            message = self._reader.decode(record)
        except UndecodableError:
            self._evidence.give_up()
            self._pairs = None
            return None
        value = self._extractor.exact(message, type_name)
        self._evidence.add(value)
        if self._pairs is not None:
            edges = self._extractor.transforms(message, record.log_time, static=False)
            self._pairs.update((each.parent, each.child) for each in edges)
            if len(self._pairs) > MOST_EDGES:
                self._pairs = None
        twist = self._extractor.twist(message, type_name)
        speed = None if twist is None else math.hypot(*twist.linear)
        pose = self._extractor.pose(message, type_name)
        return _Seen(pose, speed, state_of(value, type_name))

    def _take(self, record: Record, seen: _Seen | None) -> None:
        """Takes the pose of the next message, and what it says."""
        if seen is None:
            self._story.miss()
        else:
            self._story.add(record.log_time, seen.state)
        if seen is None or seen.pose is None:
            self._poses = None
        elif self._poses is not None:
            self._poses.add(record.log_time, seen.pose, seen.speed_mps)
            if is_place(seen.pose.position):
                self._rests.add(record.log_time, seen.pose.position)

    def _flush(self) -> None:
        """Takes the waiting messages: those of one mould together, the others one by one."""
        records, self._waiting, self._waiting_bytes = self._waiting, [], 0
        seen: list[_Seen | None] = [None] * len(records)
        rest: Sequence[int] = range(len(records))
        for mould, first, state in self._moulds:
            rest = self._cast(mould, (first, state), records, rest, seen)
        while rest:
            at, rest = rest[0], rest[1:]
            seen[at] = one = self._decoded(records[at])
            made = self._new_mould(records[at]) if one is not None else None
            if made is not None and one is not None:
                before = len(rest)
                rest = self._cast(made, (records[at], one.state), records, rest, seen)
                if before - len(rest) >= _WORTH_IT:
                    self._moulds.append((made, records[at], one.state))
                else:
                    self._more_moulds = 0
        for record, each in zip(records, seen, strict=True):
            self._take(record, each)

    def _new_mould(self, record: Record) -> Mould | None:
        """The mould of a message that could be decoded; one failure is the last try."""
        if not self._more_moulds:
            return None
        self._more_moulds -= 1
        mould = mould_of(self._reader, self._extractor, record)
        if mould is None or mould.pairs != {
            (each.parent, each.child) for each in self._transforms(record)
        }:
            # Where a transform of this one is not valid, it may be in others.
            self._more_moulds = 0
            return None
        return mould

    def _cast(
        self,
        mould: Mould,
        model: tuple[Record, State],
        records: Sequence[Record],
        rest: Sequence[int],
        seen: list[_Seen | None],
    ) -> Sequence[int]:
        """Takes those of `rest` that are of the mould of `model`; gives the others."""
        first, state = model
        chosen, rows = mould.those_like(first, records, rest)
        if not chosen:
            return rest
        self._evidence.add_rows(mould, rows)
        speeds = [None if v is None else math.hypot(*v) for v in mould.velocities(rows)]
        for at, pose, speed in zip(chosen, mould.poses(rows), speeds, strict=True):
            seen[at] = _Seen(pose, speed, state)
        taken = set(chosen)
        return [at for at in rest if at not in taken]


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

    def add_rows(self, mould: Mould, rows: Bytes) -> None:
        """Takes many messages of a mould of which one was added as a value."""
        if self._open:
            return
        for offset in mould.numbers:
            column = mould.column(rows, offset)
            numbers = column[~np.isnan(column)]
            if numbers.size:
                self._add_numbers(np.unique(numbers).tolist())
        for offset in mould.times:
            self._add_numbers(mould.seconds(rows, offset))
        if mould.angles:
            self._add_numbers([-180.0, 180.0])
            self._numbers = None
        for place in mould.places:
            points = np.array(mould.points(rows, place), dtype=np.float64)
            here = points[np.isfinite(points[:, 0]) & np.isfinite(points[:, 1])]
            if here.size:
                self._add_places(here)

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
        if self._words is None or len(text) > _MOST_TEXT_CHARS:
            self._words = None
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

    def _add_places(self, points: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> None:
        heights = points[np.isfinite(points[:, 2]), 2]
        low_z, high_z = (heights.min(), heights.max()) if heights.size else (math.inf, -math.inf)
        (min_x, min_y, _), (max_x, max_y, _) = points.min(axis=0), points.max(axis=0)
        bounds = (min_x, max_x, min_y, max_y, low_z, high_z)
        box = Box(*(float(bound) for bound in bounds))
        self._box = box if self._box is None else self._box.united(box)

    def _add_place(self, x: float, y: float, z: float) -> None:
        if not (math.isfinite(x) and math.isfinite(y)):
            return
        low_z, high_z = (z, z) if math.isfinite(z) else (math.inf, -math.inf)
        here = Box(x, x, y, y, low_z, high_z)
        self._box = here if self._box is None else self._box.united(here)
