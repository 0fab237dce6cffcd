"""What one closed bag holds of one topic, and how it is collected from the topic's messages."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.analysis.bulk_decode import template_for
from ros2_memory.analysis.odometry import is_place
from ros2_memory.analysis.standstills import StandstillCollector
from ros2_memory.analysis.topic_events import MOST_TOLD, TopicEventsBuilder, state_of
from ros2_memory.analysis.trajectory import PoseCollector
from ros2_memory.analysis.zone_map_builder import ZoneMapBuilder
from ros2_memory.core.errors import UndecodableError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.analysis.bulk_decode import PayloadTemplate
    from ros2_memory.analysis.odometry import PoseDigest
    from ros2_memory.analysis.standstills import StandstillDigest
    from ros2_memory.analysis.topic_events import State, TopicEvents
    from ros2_memory.analysis.zone_map import ZoneMap
    from ros2_memory.core.model import Pose, StampedTransform
    from ros2_memory.core.timebase import Ns
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.storage.base import BagReader, Record

MOST_KEPT: Final = 64
"""Messages that are kept whole of a topic that has few: latched ones, and transforms."""
MOST_KEPT_BYTES: Final = 1 << 20
MOST_EDGES: Final = 1_000

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
        standstills: where they stand still; None where `poses` is None or has no valid one.
        story: what its messages say; None where there is none.
        edges: its frame edges; None where some message could not be decoded, or they are too many.
        kept: all its messages in order, where they are few; else None.
        undecodable: by type, why none of its messages can be decoded; for most nothing.
    """

    topic: str
    evidence: ZoneMap
    poses: PoseDigest | None
    standstills: StandstillDigest | None
    story: TopicEvents | None
    edges: EdgeDigest | None
    kept: tuple[Record, ...] | None
    undecodable: tuple[tuple[str, str], ...] = ()


class _Seen(NamedTuple):
    """What one message that could be decoded says of the robot's motion, and else."""

    pose: Pose | None
    speed_mps: float | None
    state: State


class TopicCollector:
    """Takes the messages of one topic, in order, and says what they amount to.

    Args:
        topic: its name.
        reader: decodes the messages.
        extractor: gives the values that conditions are tested on.
        max_plausible_speed_mps: what makes a jump of a step of the robot.
        latched: whether its messages are kept whole where they are few.
        count: about how many messages will come.
    """

    def __init__(
        self,
        topic: str,
        reader: BagReader,
        extractor: SchemaExtractor,
        max_plausible_speed_mps: float,
        *,
        latched: bool,
        count: int,
    ) -> None:
        self._topic = topic
        self._reader = reader
        self._extractor = extractor
        self._latched = latched
        self._evidence = ZoneMapBuilder()
        self._poses: PoseCollector | None = PoseCollector(max_plausible_speed_mps)
        self._standstills = StandstillCollector()
        self._story = TopicEventsBuilder()
        self._pairs: set[tuple[str, str]] | None = set()
        self._ends: tuple[Record, Record] | None = None
        self._kept: list[Record] | None = []
        self._kept_bytes = 0
        self._moulds: list[tuple[PayloadTemplate, Record, State]] = []
        self._more_moulds = _MOST_MOULDS if count > _FEW else 0
        self._waiting: list[Record] = []
        self._waiting_bytes = 0

    def add(self, record: Record) -> None:
        """Takes the next message."""
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
        """What the messages so far amount to; `undecodable`: by type, why none can be decoded."""
        self._flush()
        few = self._kept is not None and (self._latched or bool(self._pairs))
        return TopicDigest(
            topic=self._topic,
            evidence=self._evidence.evidence(),
            poses=None if self._poses is None else self._poses.digest(),
            standstills=None if self._poses is None else self._standstills.digest(),
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
                self._standstills.add(record.log_time, seen.pose.position)

    def _flush(self) -> None:
        """Takes the waiting messages: those of one mould together, the others one by one."""
        records, self._waiting, self._waiting_bytes = self._waiting, [], 0
        seen: list[_Seen | None] = [None] * len(records)
        rest = deque(range(len(records)))
        for mould, first, state in self._moulds:
            rest = self._cast(mould, (first, state), records, rest, seen)
        while rest:
            at = rest.popleft()
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

    def _new_mould(self, record: Record) -> PayloadTemplate | None:
        """The mould of a message that could be decoded; one failure is the last try."""
        if not self._more_moulds:
            return None
        self._more_moulds -= 1
        mould = template_for(self._reader, self._extractor, record)
        if mould is None or mould.pairs != {
            (each.parent, each.child) for each in self._transforms(record)
        }:
            # Where a transform of this one is not valid, it may be in others.
            self._more_moulds = 0
            return None
        return mould

    def _cast(
        self,
        mould: PayloadTemplate,
        model: tuple[Record, State],
        records: Sequence[Record],
        rest: deque[int],
        seen: list[_Seen | None],
    ) -> deque[int]:
        """Takes those of `rest` that are of the mould of `model`; gives the others."""
        first, state = model
        chosen, rows = mould.matching(first, records, rest)
        if not chosen:
            return rest
        self._evidence.add_rows(mould, rows)
        speeds = [None if v is None else math.hypot(*v) for v in mould.velocities(rows)]
        for at, pose, speed in zip(chosen, mould.poses(rows), speeds, strict=True):
            seen[at] = _Seen(pose, speed, state)
        taken = set(chosen)
        return deque(at for at in rest if at not in taken)
