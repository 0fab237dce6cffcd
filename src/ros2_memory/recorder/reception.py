"""Measures how topics arrive, plans their QoS, and decides when that needs a new recording.

`ros2 bag record` never changes a subscription. So a deeper queue, or a weaker QoS for a publisher
that came later, takes a rotation. What the splits show is measured beside the recorder's loop.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import yaml

from ros2_memory.bag_dir.layout import has_own_name
from ros2_memory.bag_dir.state_files import Loss, append_losses
from ros2_memory.core.directories import is_folder
from ros2_memory.core.errors import EpisodicError, RecorderError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.text import counted, listed
from ros2_memory.core.timebase import NS_PER_S, Ns, Span
from ros2_memory.recorder.measure import (
    Arrivals,
    LossCounter,
    TopicFlow,
    measure_split,
)
from ros2_memory.retention.delete import size_of

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.recorder.background import Background
    from ros2_memory.storage.base import BagReader

DEFAULT_DEPTH: Final = 10
"""The depth with which rosbag2 subscribes by itself."""
HEADROOM: Final = 2
"""Queues are made so many times as deep as measured, where memory allows."""


class QueuePlan(NamedTuple):
    """The depth of each queue. `cut_short` hold less than `HOLD_S`, for want of memory."""

    depths: Mapping[str, int]
    cut_short: frozenset[str] = frozenset()

    def depth(self, topic: str) -> int:
        """Returns the depth of a topic's queue; without a plan it is rosbag2's own."""
        return self.depths.get(topic, DEFAULT_DEPTH)


def plan_queues(flows: Mapping[str, TopicFlow], queue_bytes: int) -> QueuePlan:
    """Returns depths that hold `HOLD_S` of each topic and together take at most `queue_bytes`.

    Where that is not enough, no topic takes more than an equal share of what the smaller ones
    leave. At least one message of each is held, however large.
    """
    sizes = {topic: flow.message_bytes for topic, flow in flows.items()}
    for factor in (HEADROOM, 1):
        depths = {topic: max(DEFAULT_DEPTH, factor * flow.burst) for topic, flow in flows.items()}
        if sum(depth * sizes[topic] for topic, depth in depths.items()) <= queue_bytes:
            return QueuePlan(depths)
    # One message of each, and shares of what is then left.
    wanted = {topic: max(1, flow.burst) for topic, flow in flows.items()}
    left, depths = max(0, queue_bytes - sum(sizes.values())), {}
    for nth, topic in enumerate(sorted(wanted, key=lambda name: wanted[name] * sizes[name])):
        more = min(wanted[topic] - 1, left // (len(wanted) - nth) // sizes[topic])
        depths[topic] = 1 + more
        left -= more * sizes[topic]
    short = frozenset(topic for topic, depth in depths.items() if depth < flows[topic].burst)
    return QueuePlan(depths, short)


_Profile: TypeAlias = dict[str, str | int]


def _profile(depth: int | None, *, reliable: bool = False, latched: bool = False) -> _Profile:
    """Returns a QoS profile; with None in place of a depth all messages are kept."""
    return {
        **({"history": "keep_all"} if depth is None else {"history": "keep_last", "depth": depth}),
        "reliability": "reliable" if reliable else "best_effort",
        "durability": "transient_local" if latched else "volatile",
    }


ALL_MESSAGES: Final = _profile(None, reliable=True, latched=True)
"""Asks for all messages, also for earlier ones."""
DEEPEN_EVERY_S: Final = 60.0
"""At most so often a recording is rotated for deeper queues: a robot's nodes start one by one."""
ASK_AGAIN_S: Final = 300.0
"""So long no recording is rotated for a topic of which one refused the weakest QoS, too."""
ASKED_FOR: Final = 8
"""So many recordings ask for what fits the publisher that was last refused, or best effort. What
splits name are the publishers that were discovered in time, often not all: they do not show that it
has gone."""
_UNNOTICED_NS: Final[Ns] = 5 * NS_PER_S
"""So long a publisher may have sent before rosbag2 says that it was refused."""
_PLANS_KEPT: Final = 8
_LOOKED_AT: Final = 3
_MOST_UNWRITTEN: Final = 1000
_TASK: Final = "reception"

_log = get_logger(__name__)


class Rotation(NamedTuple):
    """Why a new recording is needed: a log event, a sentence, and the topics it is for."""

    event: str
    sentence: str
    topics: frozenset[str]
    is_fault: bool = False


@dataclass(slots=True)
class _Recording:
    plan: QueuePlan
    refused: set[str] = field(default_factory=set)
    """Topics with a publisher that this recording's subscription does not fit."""
    asked_anew: frozenset[str] = frozenset()
    """Topics that it asked for with what fits every publisher."""
    span: Span = (0, 0)
    """First and last log time of what it has."""


class _Anew(NamedTuple):
    """How a topic with a publisher that offers less is asked for, and by how many recordings.

    Without `best_effort` only its durability did not fit.
    """

    best_effort: bool
    recordings: int = ASKED_FOR


@dataclass(eq=False, repr=False)
class Reception:
    """How the topics of one bag directory arrive, across its recordings.

    Args:
        queue_bytes: what the queues of all topics together may take.
        bag_dir: where losses are written.
        volatile: topics that are not asked for their earlier messages once a split has shown them.

    Attributes:
        may_write: whether losses are written; those that are not wait.
    """

    reader: BagReader
    queue_bytes: int
    _: KW_ONLY
    bag_dir: Path
    latched: Collection[str] = ()
    volatile: Collection[str] = ()
    background: Background

    def __post_init__(self) -> None:
        """Sets what is known at the beginning."""
        self._losses = LossCounter()
        self._unwritten: deque[Loss] = deque(maxlen=_MOST_UNWRITTEN)
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
            topics = {*self._flows, *anew, *self.latched}
            profiles = {topic: self._profile_of(topic, plan) for topic in topics}
            self._recordings[recording] = _Recording(plan, asked_anew=frozenset(anew))
            self._losses.begin(recording)
            for name in [*self._recordings][:-_PLANS_KEPT]:
                del self._recordings[name]
            self._asked_anew = {
                topic: asked._replace(recordings=asked.recordings - 1)
                for topic, asked in anew.items()
                if asked.recordings > 1
            }
        chosen = {topic: profile for topic, profile in profiles.items() if profile is not None}
        return yaml.safe_dump(chosen, sort_keys=True)

    def _profile_of(self, topic: str, plan: QueuePlan) -> _Profile | None:
        """Returns the QoS with which a topic is asked for; None where rosbag2 chooses it.

        One with a publisher that was refused, or is best effort, is asked for with what fits every
        publisher: rosbag2 itself asks for more where it has not discovered all of them, and a split
        names only those that it had. Who subscribes with best effort is sent no earlier messages,
        so it is volatile as well. Of a topic that counts as latched, and may have many publishers,
        all messages are asked for, unless its publishers are known to be volatile.
        """
        flow, asked = self._flows.get(topic), self._asked_anew.get(topic)
        counts_as_latched, depth = topic in self.latched, plan.depth(topic)
        if asked is not None and counts_as_latched and not asked.best_effort:
            # As volatile it would lose what was published before: rosbag2 decides by the publishers
            # that it finds.
            return None
        if flow is None:
            return {**ALL_MESSAGES} if asked is None else _profile(depth)
        reliable, latched, publishers = flow.offered
        is_skipped = topic in self._skipped and publishers == 1
        latched &= asked is None and topic not in self.volatile and not is_skipped
        return _profile(
            None if latched and counts_as_latched else depth,
            reliable=reliable and not (asked is not None and asked.best_effort),
            latched=latched,
        )

    def skip_latched(self, topics: Collection[str]) -> None:
        """Sets the topics whose latched message the next recordings are not to ask for.

        Of several publishers only one may have such a message: all are asked for theirs.
        """
        with self._lock:
            self._skipped = frozenset(topics)

    def recall(self, paths: Sequence[Path]) -> None:
        """Measures the ends of closed splits of an earlier run at once, in order. Raises nothing.

        No holes: what an earlier run recorded was counted by that.
        """
        for path in paths:
            self._measure("", path)

    def learn(self, recording: str, path: Path) -> None:
        """Measures a closed split of a recording, later."""
        self.background.add(_TASK, lambda: self._measure(recording, path))

    def flush(self) -> None:
        """Counts what no further split can fill; called when nothing is recorded any more."""
        self.background.add(_TASK, lambda: self._report_losses(self._losses.flush))

    def lost(self, recording: str, topic: str, count: int) -> None:
        """Notes that rosbag2 itself lost messages of a topic, up to a recording's last split."""

        def reported() -> list[Loss]:
            state = self._recordings.get(recording)
            start, stop = (0, 0) if state is None else state.span
            return self._losses.add_reported(topic, start, stop, count)

        self.background.add(_TASK, lambda: self._report_losses(reported))

    def lost_in_last_hour(self, now: Ns) -> dict[str, int]:
        """Returns how many messages of each topic are known to be missing of the last hour."""
        with self._lock:
            return self._losses.in_last_hour(now)

    def arrivals(self, idle: Ns) -> tuple[frozenset[str], Mapping[str, float]]:
        """Returns the topics that have stopped, and the rates of all, see `Arrivals`."""
        with self._lock:
            return self._arrivals.silent_topics(idle), self._arrivals.rates_hz(idle)

    def _report_losses(self, take: Callable[[], list[Loss]]) -> None:
        with self._lock:
            losses = take()
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
        self._unwritten += losses
        if self.may_write and self._unwritten:
            try:
                append_losses(self.bag_dir, self._unwritten)
            except OSError as error:
                reason = error.strerror or error
                raise RecorderError(f"losses cannot be written: {reason}") from error
            self._unwritten.clear()

    def refused(self, recording: str, topic: str, *, best_effort: bool | None = True) -> None:
        """Notes that a publisher does not fit how a recording subscribed to the topic.

        The next recordings ask for what fits every publisher; without `best_effort` for what fits a
        volatile one, or, of a topic that counts as latched, adapt to the publishers they find. With
        None it is of another type, which no QoS fits. What that publisher sent is missing from each
        split of this recording, until it ends.
        """
        with self._lock:
            state = self._recordings.get(recording)
            if state is not None:
                state.refused.add(topic)
            if best_effort is not None:
                before = self._asked_anew.get(topic)
                best_effort |= before is not None and before.best_effort
                self._asked_anew[topic] = _Anew(best_effort)

    def rotation_due(self, recording: str, now_s: float) -> Rotation | None:
        """Returns why a recording should be rotated now; None where it need not be."""
        with self._lock:
            state = self._recordings.get(recording)
            if state is None:
                return None
            refused = frozenset(
                topic
                for topic in state.refused & self._asked_anew.keys()
                if topic not in state.asked_anew
                or now_s - self._asked_s.get(topic, -ASK_AGAIN_S) >= ASK_AGAIN_S
            )
            if refused:
                sentence = (
                    f"a publisher offers weaker QoS than requested on {listed(sorted(refused))}: a "
                    "new recording subscribes again; messages sent by it meanwhile are not recorded"
                )
                return Rotation("asking_again", sentence, refused, is_fault=True)
            if self._deepened_s is not None and now_s - self._deepened_s < DEEPEN_EVERY_S:
                return None
            active, planned = state.plan, self._plan_queues()
            shallow = frozenset(
                topic
                for topic, flow in self._planned_for().items()
                if active.depth(topic) < min(flow.burst, planned.depth(topic))
            )
            if not shallow:
                return None
            sentence = "a new recording starts, to subscribe with deeper queues: "
            return Rotation("queues_deepened", sentence + listed(sorted(shallow)), shallow)

    def rotation_begun(self, rotation: Rotation, now_s: float) -> None:
        """Records why a rotation was started."""
        with self._lock:
            if rotation.is_fault:
                self._asked_s |= dict.fromkeys(rotation.topics, now_s)
            else:
                self._deepened_s = now_s

    def _planned_for(self) -> Mapping[str, TopicFlow]:
        """Returns the topics with a queue of a planned depth."""
        return {
            topic: flow
            for topic, flow in self._flows.items()
            if not (topic in self.latched and flow.offered.latched)
        }

    def _plan_queues(self) -> QueuePlan:
        return plan_queues(self._planned_for(), self.queue_bytes)

    def _measure(self, recording: str, path: Path) -> None:
        try:
            split = measure_split(self.reader, path, end_only=not recording)
            summary = self.reader.summarize(path)
        except (EpisodicError, OSError) as error:
            # The file is reported where it matters; its successor shows the same topics.
            _log.debug("split_not_measured", file=str(path), reason=str(error))
            with self._lock:
                self._losses.forget()
            return
        with self._lock:
            before = self._plan_queues().cut_short
            state = self._recordings.get(recording)
            for topic, flow in split.flows.items():
                # A recording that refused a publisher does not state what that one offers.
                if state is None or topic not in state.refused:
                    self._flows[topic] = self._flows.get(topic, flow).joined(flow)
                    if not flow.offered.reliable:
                        self._asked_anew[topic] = _Anew(best_effort=True)
            short = self._plan_queues().cut_short - before
            self._losses.forget(split.arrivals.keys() - split.progress.keys())
            if recording:
                self._arrivals.add_split(split)
            if state is not None and split.arrivals:
                # Of a large split only the end is measured.
                start, (first, last) = summary.start, state.span
                since = max(first or start, min(last or start, start) - _UNNOTICED_NS)
                self._unwritten += (
                    Loss(topic, since, split.end + 1, 0, "refused")
                    for topic in sorted(state.refused)
                )
                state.span = first or start, split.end
        if recording:
            self._report_losses(lambda: self._losses.add_split(recording, split.progress))
        for topic in sorted(short):
            _log.warning(
                "queue_cut_short",
                topic=topic,
                reason=f"{topic}: its queue holds less than 2 s of its messages; raise "
                "recording.queue_mb, or record less",
            )


def newest_splits(bag_dir: Path) -> list[Path]:
    """Returns the newest splits in a bag directory, by the names of its recordings, in order.

    More than one: the last of a run may have been recorded when the robot's nodes had ended.
    """
    newest: list[Path] = []
    with suppress(OSError):
        folders = sorted(folder for folder in bag_dir.iterdir() if has_own_name(folder.name))
        for folder in [*filter(is_folder, folders)][-_LOOKED_AT:]:
            splits = sorted(folder.glob("*.mcap"), key=lambda split: split.lstat().st_mtime_ns)
            newest += filter(size_of, splits)
    return newest[-_LOOKED_AT:]
