"""What a question is asked of, and what one call carries with it."""

from __future__ import annotations

import time
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from ros2_memory.bag_dir.carried_origin import origin_of
from ros2_memory.bag_dir.layout import CARRY_FOLDER, is_carried
from ros2_memory.core.text import match_topics
from ros2_memory.core.timebase import Deadline, ms_from_ns
from ros2_memory.index.pace import is_rare

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from ros2_memory.bag_dir.heartbeat import Heartbeat
    from ros2_memory.catalogue.lookup import DigestCache
    from ros2_memory.core.timebase import Clock, Ns
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.index.snapshot import Snapshot
    from ros2_memory.recorder.index_manager import IndexManager
    from ros2_memory.retention.foreign import Foreign
    from ros2_memory.retention.policy import RetentionLimits
    from ros2_memory.storage.base import BagReader

ClockOfTransforms = Literal["auto", "stamp", "log"]
NowOfMemory = Literal["wall", "latest"]


@dataclass(frozen=True, slots=True)
class QuerySettings:
    """The knobs of the configuration that questions need.

    `kept` is how much the recorder keeps; None where nothing is recorded, and nothing deleted.
    """

    position_tolerance_m: float = 0.5
    time_tolerance_s: float = 0.1
    pose_topic: str = "/odom"
    map_frame: str | None = "map"
    tf_topics: tuple[str, ...] = ("/tf",)
    tf_static_topics: tuple[str, ...] = ("/tf_static",)
    now: NowOfMemory = "wall"
    tf_clock: ClockOfTransforms = "auto"
    max_plausible_speed_mps: float = 10.0
    split_duration_s: float = 10.0
    include_active: bool = False
    kept: RetentionLimits | None = None
    latched_topics: tuple[str, ...] = ()
    never_latched_topics: tuple[str, ...] = ()

    @property
    def latching(self) -> Latching:
        """Which topics are latched."""
        return Latching(self.tf_static_topics, self.latched_topics, self.never_latched_topics)


@dataclass(frozen=True, slots=True)
class Memory:
    """The robot's past, as far as it lies in bags: closed ones, unless the index includes others.

    Every answer is the same with `recall` and without.
    """

    index: IndexManager
    reader: BagReader
    extractor: SchemaExtractor
    clock: Clock
    limits: QuerySettings
    recall: DigestCache | None = None

    def foreign(self, snapshot: Snapshot) -> Foreign | None:
        """The bags that retention neither deletes nor counts, since the recorder did not make them.

        None where nothing is deleted, or all bags are, or no recorder has listed its own yet.
        """
        kept = self.limits.kept
        return self.index.foreign(snapshot) if kept is not None and kept.keeps_foreign else None

    def heartbeat(self) -> Heartbeat | None:
        """What the recorder of these bags last said; None where none was heard of.

        None of bags of another day, too, which nobody records (`recorder=none`, `data.now=latest`):
        a heartbeat that was copied with them says nothing of today.
        """
        if self.limits.kept is None and self.limits.now == "latest":
            return None
        return self.index.heartbeat()


class Stages:
    """How long one call spent where: `index`, `read`, `extract`."""

    __slots__ = ("_spent",)

    def __init__(self) -> None:
        self._spent: dict[str, Ns] = {}

    def add(self, stage: str, spent: Ns) -> None:
        """Adds nanoseconds to a stage."""
        self._spent[stage] = self._spent.get(stage, 0) + spent

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Adds what the block takes."""
        begin = time.perf_counter_ns()
        try:
            yield
        finally:
            self.add(stage, time.perf_counter_ns() - begin)

    def as_ms(self) -> dict[str, float]:
        """Milliseconds by stage, for the log event of the call."""
        return {stage: round(ms_from_ns(spent), 3) for stage, spent in self._spent.items()}


@dataclass(slots=True)
class Call:
    """One call: when it must be over, and where its time went.

    Attributes:
        used_active: whether the answer is partly from a bag that is still being written.
    """

    deadline: Deadline = field(default_factory=Deadline.never)
    stages: Stages = field(default_factory=Stages)
    used_active: bool = False


@dataclass(frozen=True, slots=True)
class Latching:
    """Judges topics.

    Attributes:
        static_topics: those of static transforms.
        include: names or globs of topics that are latched whatever their publishers offer.
        exclude: names or globs of topics that are not; it wins.
    """

    static_topics: tuple[str, ...] = ()
    include: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()

    def may_hold(self, snapshot: Snapshot, topic: str) -> bool:
        """Whether some message of a topic may be latched."""
        said = self._configured(topic)
        return snapshot.is_held(topic) if said is None else said

    def holds(self, snapshot: Snapshot, found: StoredMessage) -> bool:
        """Whether a message is latched, by the pace of its topic in its own recording."""
        channel = found.record.channel
        said = self._configured(channel.topic)
        if said is not None or not snapshot.is_held(channel.topic):
            return bool(said)
        if is_carried(found.bag.path):
            origin = origin_of(channel)
            return origin is None or not origin.often
        return is_rare(snapshot.pace(channel.topic, found.bag.recording))

    def is_latched(self, snapshot: Snapshot, topic: str) -> bool:
        """Whether a topic is latched, by its pace in the newest recording that holds it."""
        said = self._configured(topic)
        if said is not None or not snapshot.is_held(topic):
            return bool(said)
        newest = _newest(snapshot, topic)
        return newest is not None and is_rare(snapshot.pace(topic, newest))

    def _configured(self, topic: str) -> bool | None:
        """What the configuration says of a topic; None where it says nothing."""
        if any(match_topics((topic,), glob) for glob in self.exclude):
            return False
        if topic in self.static_topics or any(
            match_topics((topic,), glob) for glob in self.include
        ):
            return True
        return None


def _newest(snapshot: Snapshot, topic: str) -> Path | None:
    """The recording with the newest message of a topic; that of carried ones where no other is."""
    spans = {
        recording: last
        for recording, (_, last) in snapshot.recordings(topic).items()
        if recording.name != CARRY_FOLDER
    } or {recording: last for recording, (_, last) in snapshot.recordings(topic).items()}
    return max(spans, key=lambda each: (spans[each], str(each)), default=None)
