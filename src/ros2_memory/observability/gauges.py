"""What a monitor is told of the memory: figures from the last scan, without another one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ros2_memory.core.timebase import unix_from_ns

if TYPE_CHECKING:
    from ros2_memory.bag_dir.heartbeat import Heartbeat, RecorderState
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.context import Memory
    from ros2_memory.index.snapshot import Snapshot


@dataclass(frozen=True, slots=True)
class IndexMeasures:
    """What the last scan found.

    Attributes:
        bags: that answer questions.
        active: files that are still being written.
        damaged: files that cannot be read at all.
        unread: files of a kind that another storage reads.
        kept_bytes: size of the bags that answer.
        newest_age_s: since the newest message; None without one. Negative where it is dated in the
            future.
        age_s: since that scan.
    """

    bags: int
    active: int
    damaged: int
    unread: int
    kept_bytes: int
    newest_age_s: float | None
    age_s: float


@dataclass(frozen=True, slots=True)
class RecorderMeasures:
    """What the recorder says of itself, and what can be told from it.

    Attributes:
        live: whether it is likely to be there still.
        since: Unix seconds; when the state began.
        heartbeat_age_s: since it last said something.
        written_bytes: since that recorder started.
        silent_topics: subscribed to, and never heard.
        restarts: how often another process was found to be the recorder, since this one asks.
    """

    state: RecorderState
    live: bool
    since: float
    heartbeat_age_s: float
    written_bytes: int
    silent_topics: int
    restarts: int


@dataclass(frozen=True, slots=True)
class Measures:
    """All figures of one moment; None for what is not known, or is not there.

    `budget_bytes` is what the recorder of this deployment may keep.
    """

    index: IndexMeasures | None
    recorder: RecorderMeasures | None
    budget_bytes: int | None


class Measuring:
    """Takes the figures of a memory; of one thread at a time."""

    def __init__(self, memory: Memory) -> None:
        self._memory = memory
        self._pid: int | None = None
        self._restarts = 0

    def __call__(self) -> Measures:
        """The figures of this moment. Reads the heartbeat, and no bag."""
        memory = self._memory
        now, snapshot = memory.clock.now(), memory.index.published
        heartbeat, kept = memory.heartbeat(), memory.limits.kept
        return Measures(
            None if snapshot is None else _of_index(snapshot, now),
            None if heartbeat is None else self._of_recorder(heartbeat, now),
            None if kept is None else kept.max_total_bytes,
        )

    def _of_recorder(self, heartbeat: Heartbeat, now: Ns) -> RecorderMeasures:
        if self._pid is not None and self._pid != heartbeat.pid:
            self._restarts += 1
        self._pid = heartbeat.pid
        return RecorderMeasures(
            heartbeat.state,
            heartbeat.is_live(now),
            unix_from_ns(heartbeat.since),
            unix_from_ns(now - heartbeat.updated),
            heartbeat.bytes_written,
            len(heartbeat.silent),
            self._restarts,
        )


def _of_index(snapshot: Snapshot, now: Ns) -> IndexMeasures:
    latest = snapshot.dating.latest
    return IndexMeasures(
        len(snapshot.bags),
        len(snapshot.active),
        len(snapshot.damaged),
        len(snapshot.unread),
        sum(bag.size for bag in snapshot.bags),
        None if latest is None else unix_from_ns(now - latest),
        unix_from_ns(now - snapshot.scanned_at),
    )
