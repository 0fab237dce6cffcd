"""Keeps what is known of the bag directory: which bags answer, and what was set aside.

A scan looks at what changed (see `survey`), and swaps a whole new `Snapshot` in: a query that holds
one sees one consistent index for as long as it likes. No thread is started: whoever asks a
question, or calls `refresh` now and then, scans. Nothing is written or deleted, unless it was built
to dispose of bags, as the recorder's daemon alone does.
"""

from __future__ import annotations

import gc
import threading
import time
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import structlog

from ros2_memory.bag_dir.heartbeat import read_heartbeat
from ros2_memory.core.model import BagState
from ros2_memory.core.timebase import ms_from_ns, ns_from_unix
from ros2_memory.index.bag_table import BagTable
from ros2_memory.index.file_state import ScanContext
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.retention.collect import Collected
from ros2_memory.retention.foreign import ForeignBags

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

    from structlog.typing import FilteringBoundLogger

    from ros2_memory.bag_dir.heartbeat import Heartbeat
    from ros2_memory.core.timebase import Clock, Ns
    from ros2_memory.index.bag_table import TableChange
    from ros2_memory.index.file_state import KnownFile
    from ros2_memory.retention.collect import GarbageCollector
    from ros2_memory.retention.foreign import Foreign
    from ros2_memory.storage.base import BagReader

__all__ = ["IndexManager", "Snapshot"]

SPLITS_OF_PATIENCE: Final = 3
"""A file that lay still for so many splits is not being written, unless a heartbeat says so."""


class IndexManager:
    """Keeps the snapshot of one bag directory. Safe for several threads at once.

    `refresh_s` is how old a snapshot may become before a question has it renewed;
    `split_duration_s` is how long the recorder writes one file. `disposal` deletes bags by its
    limits when it is told to; without it nothing here deletes anything. `known` tells, by path, of
    closed files that were read earlier: a scan that begins anew does not read them again while they
    look as they did. `include_active`: what is whole of a file that is being written answers, too;
    not where bags are disposed of, repaired or kept, which is for those that are finished.
    `trusts_mtime`: a file without an end that is young is being written; else it may be a copy, and
    what is in it decides.

    Attributes:
        bag_dir: the bag directory.
        published: what the last scan gave, however old; None before the first has ended.
    """

    def __init__(
        self,
        bag_dir: Path,
        reader: BagReader,
        clock: Clock,
        *,
        refresh_s: float,
        split_duration_s: float,
        disposal: GarbageCollector | None = None,
        known: Callable[[], Mapping[str, KnownFile]] | None = None,
        include_active: bool = False,
        trusts_mtime: bool = True,
    ) -> None:
        self._trusts_mtime = trusts_mtime
        self.bag_dir = bag_dir
        self._known = known
        self._include_active = include_active
        self._disposal = disposal
        self._reader = reader
        self._clock = clock
        self._refresh: Ns = ns_from_unix(refresh_s)
        self._three_splits: Ns = ns_from_unix(SPLITS_OF_PATIENCE * split_duration_s)
        self._log: FilteringBoundLogger = structlog.get_logger()
        self._lock = threading.Lock()
        self._foreign = ForeignBags(bag_dir)
        self.published: Snapshot | None = None
        self._survey = self._new_survey()

    def snapshot(self, reach: Ns | None = None) -> Snapshot:
        """The current snapshot, scanned anew where it may not do.

        That is: it is older than `refresh_s`, or `reach`, the latest log time that the question is
        about, lies past the end of the newest bag. Callers that come while a scan runs wait for it
        and share its result.
        """
        current = self.published
        if current is not None and not self._is_stale(current, reach):
            return current
        with self._lock:
            if self.published is not None and self.published is not current:
                return self.published
            # A question waits for what changes by itself, the newest bags; `refresh` patrols.
            return self._scan(patrolling=False)

    def refresh(self) -> Snapshot:
        """Scans now, and gives the result."""
        with self._lock:
            return self._scan()

    @contextmanager
    def undisturbed(self) -> Iterator[Snapshot]:
        """The result of a scan, and nothing is deleted while it is looked at."""
        with self._lock:
            yield self._scan(patrolling=False)

    def apply_retention(
        self, *, free_bytes: Callable[[], int] | None = None, min_free_bytes: int | None = None
    ) -> Collected:
        """Scans, and deletes what the limits do not allow to keep; nothing without a `disposal`.

        `free_bytes` measures what the disk has left, where that is to count; `min_free_bytes` is
        what it must have, where that is not as the limits say.
        """
        if self._disposal is None:
            return Collected()
        with self._lock:
            snapshot = self._scan()
            heartbeat = self.heartbeat()
            named = () if heartbeat is None else heartbeat.recordings
            done = self._disposal.apply(
                self._survey.known(named, snapshot.scanned_at),
                snapshot,
                free_bytes=free_bytes,
                min_free_bytes=min_free_bytes,
            )
            if done.bags:
                self._scan()
            return done

    def foreign(self, snapshot: Snapshot) -> Foreign | None:
        """What bags take that the recorder of this directory did not make; None where not known."""
        heartbeat = self.heartbeat()
        return self._foreign.measured(snapshot, () if heartbeat is None else heartbeat.recordings)

    def heartbeat(self) -> Heartbeat | None:
        """What the recorder last wrote of itself, live or not; None where that cannot be read."""
        return read_heartbeat(self.bag_dir).heartbeat

    def _is_stale(self, snapshot: Snapshot, reach: Ns | None) -> bool:
        if not 0 <= self._clock.now() - snapshot.scanned_at < self._refresh:
            return True
        return reach is not None and (snapshot.latest is None or reach > snapshot.latest)

    # What follows runs under the lock.

    def _new_survey(self) -> BagTable:
        # Disposal weighs more than bags.
        keep_all_notes = self._disposal is not None
        return BagTable(
            self.bag_dir, self._reader, known=self._known, keep_all_notes=keep_all_notes
        )

    def _scan(self, *, patrolling: bool = True) -> Snapshot:
        if self.published is not None:
            return self._look_through(patrolling=patrolling)
        with _collector_resting():
            return self._look_through(patrolling=patrolling)

    def _look_through(self, *, patrolling: bool = True) -> Snapshot:
        begun = time.perf_counter_ns()
        scene = self._scene()
        try:
            change = self._survey.update(scene, patrolling=patrolling)
        except BaseException:
            # The walk does not show a second time what it has shown once.
            self._survey = self._new_survey()
            raise
        before = self.published
        if before is not None and not change.is_new:
            self.published = replace(before, scanned_at=scene.now)
            return self.published
        self.published = self._survey.snapshot(scene.now)
        self._report(before, self.published, change, begun)
        return self.published

    def _scene(self) -> ScanContext:
        now = self._clock.now()
        heartbeat = self.heartbeat()
        live = heartbeat is not None and heartbeat.is_live(now)
        named = frozenset(heartbeat.recordings) if heartbeat is not None and live else None
        return ScanContext(
            self.bag_dir,
            now,
            self._three_splits,
            named,
            self._include_active,
            self._trusts_mtime,
        )

    def _report(
        self, before: Snapshot | None, after: Snapshot, change: TableChange, begun: Ns
    ) -> None:
        removed, added, _ = change
        known = set() if before is None else set(before.damaged)
        for each in after.damaged:
            if each not in known:
                self._log.warning("bag_damaged", path=str(each.path), reason=each.reason)
        # One that grows and answers does so with every question.
        grew = removed and all(bag.state is BagState.ACTIVE for bag in (*removed, *added))
        (self._log.debug if grew else self._log.info)(
            "index_scanned",
            bag_dir=str(self.bag_dir),
            bags=len(after.bags),
            added=len(added),
            removed=len(removed),
            active=len(after.active),
            damaged=len(after.damaged),
            unread=len(after.unread),
            empty=after.empty,
            problem=after.problem,
            duration_ms=round(ms_from_ns(time.perf_counter_ns() - begun), 3),
        )


@contextmanager
def _collector_resting() -> Iterator[None]:
    """Within the block no garbage is looked for, and afterwards not among what it made.

    What the first scan makes of a week's files stays, and looking through all of it again and
    again takes longer than making it.
    """
    if not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        # From the youngest generation into the oldest, which is seldom looked through.
        gc.freeze()
        gc.unfreeze()
        gc.enable()
