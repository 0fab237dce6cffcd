"""Measures how topics arrive, plans their QoS, and decides when that needs a new recording.

`ros2 bag record` never changes a subscription. So a deeper queue, or a weaker QoS or another type
for a publisher that came later, takes a rotation. Splits are measured in the background.
"""

from __future__ import annotations

import threading
from collections import Counter
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import yaml

from ros2_memory.bag_dir.state_files import Loss, append_losses
from ros2_memory.core.directories import is_folder
from ros2_memory.core.errors import EpisodicError, RecorderError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.model import MCAP
from ros2_memory.core.text import counted, listed
from ros2_memory.core.timebase import NS_PER_S, Ns, Span
from ros2_memory.recorder.measure import (
    Arrivals,
    LossCounter,
    SplitMeasure,
    TopicFlow,
    measure_split,
)
from ros2_memory.retention.delete import size_of

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.bag_dir.own_recordings import OwnRecordings
    from ros2_memory.recorder.background import Background
    from ros2_memory.storage.base import BagReader

DEFAULT_DEPTH: Final = 10
"""The depth with which rosbag2 subscribes by itself."""
HEADROOM: Final = 2
"""Queues are made so many times as deep as measured, if memory allows."""


class QueuePlan(NamedTuple):
    """The depth of each topic's queue.

    `cut_short` names the topics whose queue holds less than `HOLD_S`, for want of memory.
    """

    depths: Mapping[str, int]
    cut_short: frozenset[str] = frozenset()

    def depth(self, topic: str) -> int:
        """Returns the depth of a topic's queue; rosbag2's own if it is not planned."""
        return self.depths.get(topic, DEFAULT_DEPTH)


def plan_queues(flows: Mapping[str, TopicFlow], queue_bytes: int) -> QueuePlan:
    """Returns depths that hold `HOLD_S` of each topic and together take at most `queue_bytes`.

    If that is not enough, each topic gets an equal share of what smaller ones leave, and at least
    one message, however large.
    """
    sizes = {topic: flow.message_bytes for topic, flow in flows.items()}
    for factor in (HEADROOM, 1):
        depths = {topic: max(DEFAULT_DEPTH, factor * flow.burst) for topic, flow in flows.items()}
        if sum(depth * sizes[topic] for topic, depth in depths.items()) <= queue_bytes:
            return QueuePlan(depths)
    left, depths = max(0, queue_bytes - sum(sizes.values())), {}
    by_size = sorted(flows, key=lambda topic: flows[topic].burst * sizes[topic])
    for nth, topic in enumerate(by_size):
        share = left // (len(by_size) - nth)
        more = min(flows[topic].burst - 1, share // sizes[topic])
        depths[topic] = 1 + more
        left -= more * sizes[topic]
    short = frozenset(topic for topic, depth in depths.items() if depth < flows[topic].burst)
    return QueuePlan(depths, short)


_Profile: TypeAlias = dict[str, str | int]


def _profile(depth: int | None, *, reliable: bool = False, latched: bool = False) -> _Profile:
    """Returns a QoS profile for rosbag2; the depth None keeps all messages."""
    profile: _Profile = {"history": "keep_all"}
    if depth is not None:
        profile = {"history": "keep_last", "depth": depth}
    profile["reliability"] = "reliable" if reliable else "best_effort"
    profile["durability"] = "transient_local" if latched else "volatile"
    return profile


ALL_MESSAGES: Final = _profile(None, reliable=True, latched=True)
"""The QoS that receives all messages, earlier ones as well."""
DEEPEN_EVERY_S: Final = 60.0
"""The least time between two rotations for deeper queues: a robot's nodes start one by one."""
ASK_AGAIN_S: Final = 300.0
"""The least time between two rotations for a topic: publishers may refuse the weakest QoS, too."""
ASKED_FOR: Final = 8
"""So many recordings ask a topic for what fits the publisher that was refused last. A split does
not show that this publisher has gone: it names only publishers that were discovered in time."""
_UNNOTICED_NS: Final[Ns] = 5 * NS_PER_S
"""So long a publisher may have sent before rosbag2 reports that it was refused."""
_RECORDINGS_KEPT: Final = 8
_NEWEST_SPLITS: Final = 3
"""So many splits are measured at the start: the last one may have been recorded when the robot's
nodes had ended."""
_MOST_UNWRITTEN: Final = 1000
_TASK: Final = "reception"

_log = get_logger(__name__)


class Rotation(NamedTuple):
    """Why a new recording is needed: a log event, a sentence, and its topics."""

    event: str
    sentence: str
    topics: frozenset[str]
    is_fault: bool = False


@dataclass(slots=True)
class _Recording:
    """A recording that was started.

    Attributes:
        refused: topics with a publisher that the subscription does not fit.
        of_types: topics with a publisher of another type during the newest split.
        asked_anew: topics whose subscription fits every publisher.
        span: the first and the last log time (ns); None before the first split.
        newest: the same of its newest split, and of the seconds before that.
    """

    plan: QueuePlan
    asked_anew: frozenset[str]
    refused: set[str] = field(default_factory=set)
    of_types: Collection[str] = ()
    span: Span | None = None
    newest: Span | None = None


class _Anew(NamedTuple):
    """How a topic with a weak publisher is asked for, and by how many more recordings.

    Without `best_effort` only the durability did not fit.
    """

    best_effort: bool
    recordings: int = ASKED_FOR


@dataclass(eq=False, repr=False)
class Reception:
    """How the topics of one bag directory arrive, across its recordings.

    Args:
        queue_bytes: the bytes that the queues of all topics may take together.
        bag_dir: the directory whose `lost.jsonl` gets the losses.
        latched: topics whose messages are all recorded, earlier ones as well.
        volatile: topics that, once measured, are not asked for earlier messages.

    Attributes:
        may_write: whether losses are written now; if not, they wait.
    """

    reader: BagReader
    queue_bytes: int
    _: KW_ONLY
    bag_dir: Path
    latched: Collection[str] = ()
    volatile: Collection[str] = ()
    background: Background

    def __post_init__(self) -> None:
        self._losses = LossCounter()
        self._unwritten: list[Loss] = []
        self._arrivals = Arrivals()
        self._lock = threading.Lock()
        self.may_write = True
        self._flows: dict[str, TopicFlow] = {}
        self._asked_anew: dict[str, _Anew] = {}
        self._skipped = frozenset[str]()
        self._recordings: dict[str, _Recording] = {}
        self._deepened_s: float | None = None
        self._asked_s: dict[str, float] = {}

    @property
    def cut_short(self) -> frozenset[str]:
        """The topics whose queues hold less than two seconds, for want of memory."""
        with self._lock:
            return self._plan_queues().cut_short

    def overrides(self, recording: str) -> str:
        """Returns the QoS overrides (YAML) for a recording that is about to start."""
        with self._lock:
            plan, anew = self._plan_queues(), self._asked_anew
            chosen: dict[str, _Profile] = {}
            for topic in {*self._flows, *anew, *self.latched}:
                profile = self._profile_of(topic, plan)
                if profile is not None:
                    chosen[topic] = profile
            self._recordings[recording] = _Recording(plan, frozenset(anew))
            self._losses.begin(recording)
            for name in [*self._recordings][:-_RECORDINGS_KEPT]:
                del self._recordings[name]
            self._asked_anew = {
                topic: asked._replace(recordings=asked.recordings - 1)
                for topic, asked in anew.items()
                if asked.recordings > 1
            }
        return yaml.safe_dump(chosen, sort_keys=True)

    def _profile_of(self, topic: str, plan: QueuePlan) -> _Profile | None:
        """Returns the QoS of the subscription to a topic; None lets rosbag2 choose.

        A topic with a best-effort or a refused publisher gets a QoS that fits every publisher:
        rosbag2 asks for more if it has not discovered all of them, and a split names only those
        that were discovered. A best-effort subscriber is sent no earlier messages, so it is
        volatile as well. All messages of a topic in `latched`, which may have many publishers, are
        asked for, unless its publishers are known to be volatile.
        """
        flow, asked = self._flows.get(topic), self._asked_anew.get(topic)
        counts_as_latched, depth = topic in self.latched, plan.depth(topic)
        if asked is not None and counts_as_latched and not asked.best_effort:
            # A volatile subscriber would lose earlier messages: rosbag2 decides by the publishers.
            return None
        if flow is None:
            return {**ALL_MESSAGES} if asked is None else _profile(depth)
        reliable, latched, publishers = flow.offered
        if asked is not None:
            return _profile(depth, reliable=reliable and not asked.best_effort)
        # One of several publishers may have a message that is not excluded: all are asked.
        is_skipped = topic in self._skipped and publishers == 1
        latched = latched and topic not in self.volatile and not is_skipped
        keeps_all = latched and counts_as_latched
        return _profile(None if keeps_all else depth, reliable=reliable, latched=latched)

    def skip_latched(self, topics: Collection[str]) -> None:
        """Sets the topics whose latched message the next recordings do not ask for."""
        with self._lock:
            self._skipped = frozenset(topics)

    def recall(self, paths: Sequence[Path]) -> None:
        """Measures the ends of closed splits of an earlier run, now and in order. Raises nothing.

        Their holes do not count again.
        """
        for path in paths:
            self._measure("", path)

    def learn(self, recording: str, path: Path, of_types: Collection[str] = ()) -> None:
        """Measures a closed split of a recording in the background.

        `of_types`: topics of which some publisher was not received meanwhile, for its type.
        """
        self.background.add(_TASK, lambda: self._measure(recording, path, of_types))

    def flush(self) -> None:
        """Counts the losses that only a further split could disprove: recording has ended."""
        self.background.add(_TASK, self._flush)

    def note_lost(self, recording: str, topic: str, count: int, lived: Span) -> None:
        """Notes that rosbag2 reports lost messages of a topic, since it last did so for a split.

        `lived`: when the recording ran (wall time), for one of which no split shows it.
        """
        self.background.add(_TASK, lambda: self._add_reported(recording, topic, count, lived))

    def _flush(self) -> None:
        with self._lock:
            losses = self._losses.flush()
        self._report_losses(losses)

    def _add_reported(self, recording: str, topic: str, count: int, lived: Span) -> None:
        with self._lock:
            state = self._recordings.get(recording)
            newest = None if state is None else state.newest
            start, stop = sorted(newest or lived)  # the clock may have been set back
            losses = self._losses.add_reported(topic, start, stop, count)
        self._report_losses(losses)

    def lost_in_last_hour(self, now: Ns) -> dict[str, int]:
        """Returns how many messages of each topic are known to be missing in the last hour."""
        with self._lock:
            return self._losses.in_last_hour(now)

    def arrivals(self, idle: Ns) -> tuple[frozenset[str], Mapping[str, float]]:
        """Returns the silent topics, and the rate of each topic (Hz), see `Arrivals`.

        `idle`: how long nothing at all has come (ns).
        """
        with self._lock:
            return self._arrivals.silent_topics(idle), self._arrivals.rates_hz(idle)

    def _report_losses(self, losses: Sequence[Loss]) -> None:
        """Logs losses, and writes them with those that are not written yet.

        Raises:
            RecorderError: they cannot be written; the next call tries again.
        """
        by_topic = Counter[str]()
        for loss in losses:
            by_topic[loss.topic] += loss.lost
        for topic, lost in by_topic.items():
            _log.warning(
                "messages_missing",
                topic=topic,
                lost=lost,
                reason=f"{topic}: {counted(lost, 'message')} missing, by its counter, its stamps "
                "or rosbag2's count: lost on the way to the disk, or never published",
            )
        if dropped := len(self._unwritten[:-_MOST_UNWRITTEN]):
            del self._unwritten[:dropped]
            unnamed = "lost.jsonl cannot be written: answers will not name the oldest losses"
            _log.warning("losses_dropped", losses=dropped, reason=unnamed)
        self._unwritten += losses
        if self.may_write and self._unwritten:
            try:
                append_losses(self.bag_dir, self._unwritten)
            except OSError as error:
                reason = error.strerror or error
                raise RecorderError(f"losses cannot be written: {reason}") from error
            self._unwritten.clear()

    def note_refused(self, recording: str, topic: str, *, best_effort: bool = True) -> None:
        """Notes that a publisher's QoS does not fit how a recording subscribed to the topic.

        The next recordings ask for what fits every publisher. Without `best_effort` they ask for
        what fits a volatile publisher; a topic in `latched` adapts to the publishers that it finds.
        """
        with self._lock:
            before = self._asked_anew.get(topic)
            was_best_effort = before is not None and before.best_effort
            self._asked_anew[topic] = _Anew(best_effort or was_best_effort)
            state = self._recordings.get(recording)
            if state is not None:
                state.refused.add(topic)

    def rotation_due(
        self, recording: str, now_s: float, subscribed: Collection[str] = ()
    ) -> Rotation | None:
        """Returns why a recording should be rotated now; None if there is no reason.

        `subscribed` are the topics that the recording has subscribed to.
        """
        with self._lock:
            state = self._recordings.get(recording)
            if state is None:
                return None
            weak = state.refused & self._asked_anew.keys()
            # The publisher of the type that was subscribed to has gone.
            gone = {*state.of_types}.intersection(subscribed, self._arrivals.silent_topics(0))
            refused = [
                topic
                for topic in sorted(weak.union(gone))
                if topic in weak - state.asked_anew
                or now_s - self._asked_s.get(topic, -ASK_AGAIN_S) >= ASK_AGAIN_S
            ]
            if refused:
                sentence = (
                    f"the QoS or type of a publisher of {listed(refused)} does not fit: a new "
                    "recording subscribes again; messages sent by it meanwhile are not recorded"
                )
                return Rotation("asking_again", sentence, frozenset(refused), is_fault=True)
            if self._deepened_s is not None and now_s - self._deepened_s < DEEPEN_EVERY_S:
                return None
            planned = self._plan_queues()
            shallow = [
                topic
                for topic, flow in sorted(self._flows_with_depth().items())
                if state.plan.depth(topic) < min(flow.burst, planned.depth(topic))
            ]
            if not shallow:
                return None
            sentence = "a new recording starts, to subscribe with deeper queues: "
            return Rotation("queues_deepened", sentence + listed(shallow), frozenset(shallow))

    def note_rotation(self, rotation: Rotation, now_s: float) -> None:
        """Notes that a rotation began: the same reason waits before the next one."""
        with self._lock:
            if rotation.is_fault:
                self._asked_s |= dict.fromkeys(rotation.topics, now_s)
            else:
                self._deepened_s = now_s

    def _flows_with_depth(self) -> dict[str, TopicFlow]:
        """Returns the topics whose queue has a depth: all but those that keep all messages."""
        return {
            topic: flow
            for topic, flow in self._flows.items()
            if not (topic in self.latched and flow.offered.latched)
        }

    def _plan_queues(self) -> QueuePlan:
        return plan_queues(self._flows_with_depth(), self.queue_bytes)

    def _measure(self, recording: str, path: Path, of_types: Collection[str] = ()) -> None:
        """Measures a split; without a recording it is of an earlier run."""
        try:
            split = measure_split(self.reader, path, end_only=not recording)
        except (EpisodicError, OSError) as error:
            # The file is reported where it matters; the next split shows the same topics.
            _log.debug("split_not_measured", file=str(path), reason=str(error))
            with self._lock:
                self._losses.forget()
            return
        losses: list[Loss] = []
        with self._lock:
            before = self._plan_queues().cut_short
            state = self._recordings.get(recording)
            refused = {*of_types}
            if state is not None:
                state.of_types = of_types
                refused |= state.refused
            self._add_flows(split, refused)
            short = self._plan_queues().cut_short - before
            self._losses.forget(split.arrivals.keys() - split.progress.keys())
            if state is not None and split.arrivals:
                self._note_split(state, refused, split.start, split.end)
            if recording:
                self._arrivals.add_split(split)
                losses = self._losses.add_split(recording, split.progress)
        if recording:
            self._report_losses(losses)
        for topic in sorted(short):
            _log.warning(
                "queue_cut_short",
                topic=topic,
                reason=f"{topic}: its queue holds less than 2 s of its messages; raise "
                "recording.queue_mb, or record less",
            )

    def _add_flows(self, split: SplitMeasure, refused: Collection[str]) -> None:
        for topic, flow in split.flows.items():
            # A recording that refused a publisher does not state that publisher's QoS.
            if topic not in refused:
                self._flows[topic] = self._flows.get(topic, flow).joined(flow)
                if not flow.offered.reliable:
                    self._asked_anew[topic] = _Anew(best_effort=True)

    def _note_split(
        self, recording: _Recording, refused: Collection[str], start: Ns, end: Ns
    ) -> None:
        """Notes the time of a split, which is lost to each topic with a refused publisher."""
        since = first = start
        if recording.span is not None:
            # rosbag2 reports what is lost late: it may have been before the split.
            first, last = recording.span
            first = min(first, start)  # the clock was set back
            since = max(first, min(last, start) - _UNNOTICED_NS)
        for topic in sorted(refused):
            self._unwritten.append(Loss(topic, since, end + 1, 0, "refused"))
        recording.span, recording.newest = (first, end), (since, end)


def newest_splits(bag_dir: Path, own: OwnRecordings) -> list[Path]:
    """Returns the newest splits of a recorder's own recordings, in the order in which these began.

    Their names have dates, which a wrong clock may have made.
    """
    newest: list[Path] = []
    with suppress(OSError):
        folders = [bag_dir / name for name in own.in_order()]
        for folder in [*filter(is_folder, folders)][-_NEWEST_SPLITS:]:
            splits = sorted(folder.glob(f"*{MCAP}"), key=lambda split: split.lstat().st_mtime_ns)
            newest += filter(size_of, splits)
    return newest[-_NEWEST_SPLITS:]
