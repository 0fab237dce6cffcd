"""Keeps the index of the bag directory: the bags that answer queries, and the files set aside.

A scan reads the files that changed (see `index.bag_table`) and swaps in a new `Snapshot`. A query
works on its snapshot for as long as it needs. No thread is started: a query, or a caller of
`refresh`, runs the scan itself.
"""

from __future__ import annotations

import gc
import threading
import time
from contextlib import contextmanager, nullcontext
from copy import copy
from dataclasses import KW_ONLY, dataclass, replace
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.handover_file import read_handover
from ros2_memory.bag_dir.heartbeat import Heartbeat, read_heartbeat
from ros2_memory.core.large_reads import LargeReads
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.model import BagState
from ros2_memory.core.timebase import Clock, Ns, ms_since, ns_from_unix
from ros2_memory.index.bag_table import BagTable, KnownBags, TableChange
from ros2_memory.index.file_state import ScanContext
from ros2_memory.index.scan import BAG_DIR_SETTING

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator
    from pathlib import Path

    from ros2_memory.index.bag_rows import BagRows
    from ros2_memory.index.snapshot import Snapshot
    from ros2_memory.storage.base import BagReader

SPLITS_OF_PATIENCE: Final = 3
"""A file that did not change for so many splits is closed, unless a heartbeat names it."""

_log = get_logger(__name__)


@dataclass(eq=False, repr=False)
class IndexManager:
    """Keeps the snapshot of one bag directory. Thread-safe.

    Args:
        refresh_s: the age of a snapshot at which a query scans again.
        known: returns closed files that were read earlier, in order of time. The first scan does
            not read them again if they are unchanged.
        include_active: whether the readable part of a file that is being written answers, too.
            Programs that delete, repair or save bags work on finished files.
        trusts_mtime: whether a young file without an end counts as being written. Otherwise it may
            be a copy, and its content decides.
        only: the name of the one recording that counts (see `index.scan.Tree`); None for all.
        setting: the setting that names the bag directory, for sentences.
        large: the turn to hold much of a bag, which no scan waits for.

    Attributes:
        published: the newest snapshot, however old; None before the first scan has ended.
    """

    bag_dir: Path
    reader: BagReader
    clock: Clock
    _: KW_ONLY
    refresh_s: float
    split_duration_s: float
    known: Callable[[], Iterable[BagRows]] = list
    include_active: bool = False
    trusts_mtime: bool = True
    only: str | None = None
    setting: str = BAG_DIR_SETTING
    large: LargeReads | None = None

    def __post_init__(self) -> None:
        self._large = self.large or LargeReads()
        self._only = () if self.only is None else (self.only,)
        self._refresh: Ns = ns_from_unix(self.refresh_s)
        self._three_splits: Ns = ns_from_unix(SPLITS_OF_PATIENCE * self.split_duration_s)
        self._lock = threading.Lock()
        self.published: Snapshot | None = None
        self._table = self._new_table()

    def _new_table(self) -> BagTable:
        return BagTable(
            self.bag_dir,
            self.reader,
            known=self.known,
            setting=self.setting,
            only=self._only,
        )

    def snapshot(self, reach: Ns | None = None) -> Snapshot:
        """Returns the current snapshot, after a scan if it is out of date.

        A snapshot is out of date if it is older than `refresh_s`, or if `reach`, the latest log
        time of the query, lies after the newest bag. Callers that come while a scan runs share its
        result.
        """
        current = self.published
        if (
            current is not None
            and 0 <= self.clock.now() - current.scanned_at < self._refresh
            and (reach is None or (current.latest is not None and reach <= current.latest))
        ):
            return current
        with self._lock:
            if self.published is not None and self.published is not current:
                return self.published
            # A query waits only for the newest bags, which change by themselves; `refresh` also
            # looks at unchanged directories again.
            return self._scan(patrolling=False)

    def refresh(self) -> Snapshot:
        """Scans now, and returns the result."""
        with self._lock:
            return self._scan()

    @contextmanager
    def undisturbed(self, *, patrolling: bool = False) -> Iterator[Snapshot]:
        """Yields a new snapshot. Other callers wait until the block ends.

        `patrolling` scans directories that did not change as well.
        """
        with self._lock:
            yield self._scan(patrolling=patrolling)

    def alone(self, recording: str) -> IndexManager:
        """Returns an index of one recording, which reads no bag that this index has read."""
        alone = copy(self)
        alone._lock, alone.published = threading.Lock(), None
        alone.known = lambda: [part.bags for part in self.snapshot().timeline.recorded_segments]
        alone._only = (*self._only, recording)
        alone._table = alone._new_table()
        return alone

    def known_bags(self, named: Collection[str], snapshot: Snapshot) -> KnownBags:
        """Returns the bags that retention considers. Call it within `undisturbed`.

        Args:
            named: the recordings that are being written.
            snapshot: the snapshot that `undisturbed` yields.
        """
        return self._table.known(named, snapshot.scanned_at)

    def joined_with(self, recording: Path) -> tuple[str, ...]:
        """Returns the names of the recordings before and after one, by its `handover.json`."""
        handover = read_handover(recording).handover
        return tuple(name for name in (handover.previous, handover.next) if name)

    def heartbeat(self) -> Heartbeat | None:
        """Returns the recorder's newest heartbeat, live or not; None if it cannot be read."""
        return read_heartbeat(self.bag_dir).heartbeat

    # The methods below run under the lock.

    def _scan(self, *, patrolling: bool = True) -> Snapshot:
        begun, before = time.perf_counter_ns(), self.published
        context = self._context()
        # The holder of the turn may itself wait for this scan.
        with self._large.exempt(), _gc_paused() if before is None else nullcontext():
            try:
                change = self._table.update(context, patrolling=patrolling)
            except BaseException:
                # The interrupted table would miss the changes that it was just shown.
                self._table = self._new_table()
                raise
            if before is not None and not change.is_new:
                self.published = replace(before, scanned_at=context.now)
                return self.published
            self.published = self._table.snapshot(context.now)
        self._report(before, self.published, change, begun)
        return self.published

    def _context(self) -> ScanContext:
        now, heartbeat = self.clock.now(), self.heartbeat()
        open_recordings = None
        if heartbeat is not None and heartbeat.is_live(now):
            open_recordings = frozenset(heartbeat.recordings)
        return ScanContext(
            self.bag_dir,
            now,
            self._three_splits,
            open_recordings,
            self.include_active,
            self.trusts_mtime,
        )

    def _report(
        self, before: Snapshot | None, after: Snapshot, change: TableChange, begun: Ns
    ) -> None:
        known_damaged = set() if before is None else set(before.damaged)
        for aside in after.damaged:
            if aside not in known_damaged:
                _log.warning("bag_damaged", path=str(aside.path), reason=aside.reason)
        if after.problem is not None and (before is None or before.problem != after.problem):
            _log.warning(
                "bag_directory_not_read", reason=after.problem, bag_dir=str(self.bag_dir.absolute())
            )
        # Every query scans a file that grows and answers: not worth a line each time.
        bags = (*change.removed, *change.added)
        only_grew = change.removed and all(bag.state is BagState.ACTIVE for bag in bags)
        changed = before is None or _logged_figures(before) != _logged_figures(after)
        (_log.info if changed and not only_grew else _log.debug)(
            "index_scanned",
            bag_dir=str(self.bag_dir),
            bags=len(after.bags),
            added=len(change.added),
            removed=len(change.removed),
            active=len(after.active),
            damaged=len(after.damaged),
            unread=len(after.unread),
            empty=len(after.empty),
            problem=after.problem,
            duration_ms=ms_since(begun),
        )


def _logged_figures(snapshot: Snapshot) -> tuple[object, ...]:
    """Returns what decides whether a scan is worth a line in the log."""
    return (
        snapshot.timeline.recorded_segments,
        len(snapshot.active),
        len(snapshot.damaged),
        len(snapshot.unread),
        len(snapshot.empty),
        snapshot.problem,
    )


@contextmanager
def _gc_paused() -> Iterator[None]:
    """Pauses Python's garbage collector, and exempts the objects that the block made.

    The first scan of a week makes objects that stay alive. To examine them again and again takes
    longer than to make them.
    """
    if not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        # Moves all objects from the youngest generation into the oldest, which is rarely examined.
        gc.freeze()
        gc.unfreeze()
        gc.enable()
