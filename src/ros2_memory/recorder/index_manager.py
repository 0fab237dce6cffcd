"""Keeps the index of the bag directory: which bags answer queries, and what was set aside.

A scan reads what changed (see `index.bag_table`) and swaps in a new `Snapshot`: a query that has
one works on a consistent index for as long as it needs. No thread is started: a query, or a caller
of `refresh`, runs the scan itself.
"""

from __future__ import annotations

import gc
import threading
import time
from contextlib import contextmanager, nullcontext
from copy import copy
from dataclasses import replace
from functools import partial
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
"""A file unchanged for so many splits is not being written, unless a heartbeat names it."""

_log = get_logger(__name__)


class IndexManager:
    """Keeps the snapshot of one bag directory. Thread-safe.

    Args:
        refresh_s: how old a snapshot may become before a query has it renewed.
        known: gives closed files which were read earlier, in order of time. A first scan does not
            read them again if they are unchanged.
        include_active: whether the readable part of a file that is being written answers, too. Not
            for programs that delete, repair or save bags, which work on finished files.
        trusts_mtime: whether a young file without an end is being written; else it may be a copy,
            and its content decides.
        only: the name of the one recording that counts (see `index.scan.Tree`); None: all.
        setting: the one that names the bag directory, for sentences.
        large: the turn to hold much of a bag, for which no scan waits.

    Attributes:
        published: the result of the last scan, however old; None before the first has ended.
    """

    def __init__(
        self,
        bag_dir: Path,
        reader: BagReader,
        clock: Clock,
        *,
        refresh_s: float,
        split_duration_s: float,
        known: Callable[[], Iterable[BagRows]] = list,
        include_active: bool = False,
        trusts_mtime: bool = True,
        only: str | None = None,
        setting: str = BAG_DIR_SETTING,
        large: LargeReads | None = None,
    ) -> None:
        self._large = large or LargeReads()
        self._trusts_mtime = trusts_mtime
        self.bag_dir = bag_dir
        self._include_active = include_active
        self._clock = clock
        self._refresh: Ns = ns_from_unix(refresh_s)
        self._three_splits: Ns = ns_from_unix(SPLITS_OF_PATIENCE * split_duration_s)
        self._lock = threading.Lock()
        self.published: Snapshot | None = None
        self._new_table = partial(
            BagTable,
            bag_dir,
            reader,
            known=known,
            setting=setting,
            only=() if only is None else (only,),
        )
        self._table = self._new_table()

    def snapshot(self, reach: Ns | None = None) -> Snapshot:
        """Returns the current snapshot, after a new scan if it is out of date.

        It is when it is older than `refresh_s`, or when `reach`, the latest log time that the query
        is about, lies past the end of the newest bag. Callers that come while a scan runs wait for
        it and share its result.
        """
        current = self.published
        if (
            current is not None
            and 0 <= self._clock.now() - current.scanned_at < self._refresh
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
        """Yields the result of a scan; within the block no other one enters, or scans.

        `patrolling`: whether directories that did not change are looked at again.
        """
        with self._lock:
            yield self._scan(patrolling=patrolling)

    def alone(self, recording: str) -> IndexManager:
        """Returns the index of one recording of these; it reads no bag that this one has read."""
        alone = copy(self)
        alone._lock, alone.published = threading.Lock(), None
        only = *self._new_table.keywords["only"], recording
        alone._new_table = partial(
            self._new_table,
            known=lambda: [part.bags for part in self.snapshot().timeline.recorded_segments],
            only=only,
        )
        alone._table = alone._new_table()
        return alone

    def known_bags(self, named: Collection[str], snapshot: Snapshot) -> KnownBags:
        """Returns what retention considers, within `undisturbed`, which gave the snapshot.

        `named` are recordings that are being written.
        """
        return self._table.known(named, snapshot.scanned_at)

    def joined_with(self, recording: Path) -> tuple[str, ...]:
        """Returns the recordings that a handover names as those before and after one."""
        handover = read_handover(recording).handover
        return tuple(filter(None, (handover.previous, handover.next)))

    def heartbeat(self) -> Heartbeat | None:
        """Returns the recorder's last heartbeat, live or not; None if it cannot be read."""
        return read_heartbeat(self.bag_dir).heartbeat

    # The methods below run under the lock.

    def _scan(self, *, patrolling: bool = True) -> Snapshot:
        begun, before = time.perf_counter_ns(), self.published
        context = self._context()
        # Who has the turn may wait for this scan.
        with self._large.exempt(), _gc_paused() if before is None else nullcontext():
            try:
                change = self._table.update(context, patrolling=patrolling)
            except BaseException:
                # A new table: the interrupted one will not be shown again what changed.
                self._table = self._new_table()
                raise
            if before is not None and not change.is_new:
                self.published = replace(before, scanned_at=context.now)
                return self.published
            self.published = self._table.snapshot(context.now)
        self._report(before, self.published, change, begun)
        return self.published

    def _context(self) -> ScanContext:
        now, heartbeat = self._clock.now(), self.heartbeat()
        open_recordings = None
        if heartbeat is not None and heartbeat.is_live(now):
            open_recordings = frozenset(heartbeat.recordings)
        return ScanContext(
            self.bag_dir,
            now,
            self._three_splits,
            open_recordings,
            self._include_active,
            self._trusts_mtime,
        )

    def _report(
        self, before: Snapshot | None, after: Snapshot, change: TableChange, begun: Ns
    ) -> None:
        removed, added, _ = change
        reported_before = set() if before is None else set(before.damaged)
        for aside in after.damaged:
            if aside not in reported_before:
                _log.warning("bag_damaged", path=str(aside.path), reason=aside.reason)
        # A file that grows and answers is read again with every query: not worth a line each time.
        grew = removed and all(bag.state is BagState.ACTIVE for bag in (*removed, *added))
        changed = before is None or _logged_figures(before) != _logged_figures(after)
        if after.problem is not None and (before is None or before.problem != after.problem):
            _log.warning(
                "bag_directory_not_read", reason=after.problem, bag_dir=str(self.bag_dir.absolute())
            )
        (_log.info if changed and not grew else _log.debug)(
            "index_scanned",
            bag_dir=str(self.bag_dir),
            bags=len(after.bags),
            added=len(added),
            removed=len(removed),
            active=len(after.active),
            damaged=len(after.damaged),
            unread=len(after.unread),
            empty=len(after.empty),
            problem=after.problem,
            duration_ms=ms_since(begun),
        )


def _logged_figures(snapshot: Snapshot) -> tuple[object, ...]:
    """Returns what a line about a scan shows, but for what came and went."""
    return (
        snapshot.timeline.recorded_segments,
        *(map(len, (snapshot.active, snapshot.damaged, snapshot.unread, snapshot.empty))),
        snapshot.problem,
    )


@contextmanager
def _gc_paused() -> Iterator[None]:
    """Pauses Python's garbage collector, and exempts from it what the block made.

    The objects that the first scan makes of a week's files stay alive, and examining all of them
    again and again takes longer than making them.
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
