"""Deletes bags that exceed the limits, after their latched messages were carried forward.

A query works on a snapshot of the bags that is some seconds old. So a bag with latched messages is
deleted only when those have been carried for that long: until then a query may look for them in the
bag. Meanwhile the next oldest bag is deleted instead; if there is none, the limits come first.
"""

from __future__ import annotations

import time
from collections import defaultdict
from dataclasses import KW_ONLY, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol

from ros2_memory.bag_dir.layout import other_form
from ros2_memory.bag_dir.metadata_yaml import bare_name
from ros2_memory.bag_dir.state_files import Deleted, append_deleted, deleted_of, unshipped
from ros2_memory.core.errors import EpisodicError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.retention.delete import remove_bag, remove_emptied
from ros2_memory.retention.disk import RETRIED_S, free_bytes
from ros2_memory.retention.inventory import Inventory
from ros2_memory.retention.latched_carry import Carrier
from ros2_memory.retention.policy import (
    DeletionPlan,
    DirContents,
    RetentionLimits,
    StoredBag,
    bags_older_than,
    plan_deletions,
)
from ros2_memory.retention.recorded_time import RecordedTime

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Sequence

    from ros2_memory.bag_dir.own_recordings import OwnRecordings
    from ros2_memory.core.timebase import Ns
    from ros2_memory.index.bag_table import KnownBags
    from ros2_memory.index.snapshot import Snapshot
    from ros2_memory.retention.topic_ages import TopicCutter
    from ros2_memory.storage.base import BagReader, BagWriter

MOST_AT_ONCE: Final = 2000
"""Bags deleted in one pass, which take some tenths of a second. The next pass continues."""
_FIRST_LOST: Final = 8
"""One in so many bags is deleted first if the memory of them cannot be written."""

_log = get_logger(__name__)


@dataclass(slots=True)
class Collected:
    """What one pass did.

    Attributes:
        bags: how many bags were deleted; `bytes` is their size. `failed` could not be deleted.
        recordings: how many directories of recordings were deleted with their last bag.
        carried: how many latched messages are carried, if their bag was rewritten.
        total_bytes: what the budget counts afterwards.
        foreign_bytes: the size of bags of other programs, which no limit counts.
        state_bytes: how much of the total is no recording: `.episodic` and logs.
        saved_bytes: how much of the total saved moments take.
        held: how many bags are too old by their dates and stay, since the clock is not known to be
            right.
        cut: from how many bags topics were cut.
        needed: how many deleted bags rules may still have needed.
        unshipped: the deleted bags that had to be shipped and were in no lake, relative to the bag
            directory; without bags that are saved in moments.
        most_free: see `DeletionPlan.most_free`.
    """

    bags: int = 0
    bytes: int = 0
    recordings: int = 0
    carried: int | None = None
    failed: int = 0
    total_bytes: int = 0
    foreign_bytes: int = 0
    state_bytes: int = 0
    saved_bytes: int = 0
    held: int = 0
    cut: int = 0
    needed: int = 0
    unshipped: tuple[str, ...] = ()
    most_free: int | None = None


@dataclass(slots=True)
class _Pass:
    """The input and the state of one pass; bags are paths.

    Attributes:
        needed: the bags that rules may still need.
        needs_disk: whether the pass makes room on the disk.
        urgent: whether it does not wait until carried messages have been known for long enough.
        synchronised: whether the system clock is synchronised; None until asked, which starts a
            program.
        remaining: bags that this pass does not delete.
        waiting: the remaining bags that can be deleted some moments later.
        saved: deleted bags whose files are saved in moments.
        unshipped: deleted bags that had to be shipped, in the order of deletion.
        gave_up: whether bags were deleted though the memory of them could not be written.
    """

    known: KnownBags
    snapshot: Snapshot
    needed: frozenset[str]
    limits: RetentionLimits
    needs_disk: bool
    urgent: bool
    synchronised: bool | None = None
    waiting: set[str] = field(default_factory=set)
    result: Collected = field(default_factory=Collected)
    deleted: set[str] = field(default_factory=set)
    remaining: set[str] = field(default_factory=set)
    saved: set[str] = field(default_factory=set)
    unshipped: list[str] = field(default_factory=list)
    gave_up: bool = False


class DeletedBagMemory(Protocol):
    """The memory of deleted bags: a part of their messages, in fewer bytes.

    Attributes:
        keeps: whether anything is remembered; if not, `limit` forgets it all in time.
    """

    keeps: bool

    def keep(self, snapshot: Snapshot, paths: Collection[str]) -> None:
        """Stores the memory of bags durably, before they are deleted.

        Raises:
            EpisodicError: a bag cannot be read, or its memory not be written.
            OSError: the disk fails.
        """

    def limit(self, now: Ns | None) -> None:
        """Deletes days that are too old, or too many. Age counts from `now`; None: nothing ages.

        Raises:
            OSError: a day cannot be deleted.
        """


@dataclass(eq=False, repr=False)
class GarbageCollector:
    """Keeps one bag directory within its limits. Not thread-safe.

    Args:
        is_synchronised: returns whether the system clock is synchronised; may take some seconds.
        grace_s: how long latched messages are carried before their bag is deleted: for so long a
            query may work on an older snapshot of the bags.
        memory: the memory of deleted bags; None if nothing is, or was, remembered.
        cutter: cuts topics with a shorter life out of bags that stay; None if there are none.

    Attributes:
        recorded: how long was recorded after each recording.
        emptied: recordings that go with the next pass if no bag is left of them.
    """

    bag_dir: Path
    reader: BagReader
    writer: BagWriter
    limits: RetentionLimits
    own: OwnRecordings
    _: KW_ONLY
    is_synchronised: Callable[[], bool]
    static_topics: Collection[str]
    grace_s: float = 0.0
    measure_free: Callable[[Path], int] = free_bytes
    monotonic: Callable[[], float] = time.monotonic
    memory: DeletedBagMemory | None = None
    cutter: TopicCutter | None = None

    def __post_init__(self) -> None:
        """Starts with nothing known."""
        self.recorded = RecordedTime(self.bag_dir)
        self._carrier = Carrier(
            self.bag_dir,
            self.reader,
            self.writer,
            self.static_topics,
            self.own,
            monotonic=self.monotonic,
        )
        self._memory_fails_since: float | None = None
        self._inventory = Inventory(
            self.bag_dir, self.static_topics, self.own if self.limits.keeps_foreign else None
        )
        self._carried_since: dict[str, float] = {}
        self._reported: set[str] = set()
        self._not_deleted: set[str] = set()
        """Bags whose deletion failed after it was written down."""
        self.emptied: set[Path] = set()
        self._unwritten: list[Deleted] = []

    def apply(
        self,
        known: KnownBags,
        snapshot: Snapshot,
        needed: frozenset[str],
        free_bytes_wanted: int | None,
    ) -> Collected:
        """Deletes what is too old, then what exceeds the budget. Reports what cannot be deleted.

        Args:
            known: the bags that the index knows.
            snapshot: the bags that answer queries.
            needed: the bags that rules may still need, which no age deletes.
            free_bytes_wanted: how much of the disk must be free; None if that does not count.

        Raises:
            OSError: the free space cannot be measured, or the list of the recorder's own recordings
                cannot be read.
        """
        limits, needs_disk = self.limits, False
        if free_bytes_wanted is not None:
            limits, needs_disk = replace(limits, min_free_bytes=free_bytes_wanted), True
        run = _Pass(known, snapshot, needed, limits, needs_disk, urgent=needs_disk)
        contents, plan = self._delete_beyond_limits(run)
        self._remove_emptied(run)
        self._limit_memory(contents, snapshot)
        if self.cutter is not None and not needs_disk and plan.fits:
            try:
                run.result.cut = self.cutter.cut(contents, limits, snapshot)
            except OSError as error:
                _log.error("topics_not_cut", reason=error.strerror or str(error))
        return replace(
            run.result,
            total_bytes=plan.total_bytes,
            foreign_bytes=contents.foreign_bytes,
            state_bytes=contents.state_bytes,
            saved_bytes=sum(contents.saved.values()),
            needed=len(needed & run.deleted),
            unshipped=tuple(
                self.own.name_of(path) for path in run.unshipped if path not in run.saved
            ),
            most_free=plan.most_free,
        )

    def _delete_beyond_limits(self, run: _Pass) -> tuple[DirContents, DeletionPlan]:
        """Deletes bags until the limits are kept; returns what is left, and the last plan."""
        keeps = self.memory is not None and self.memory.keeps
        while True:
            contents = self._contents(run)
            # Whole hours, so that the memory of an hour is written once.
            plan = plan_deletions(contents, run.limits, whole_hours=keeps)
            going = plan.to_delete[: MOST_AT_ONCE - len(run.deleted)]
            if going:
                for bag in going:
                    if any(file.inode in contents.saved for file in bag.files):
                        run.saved.add(bag.path)
                self._carry(going, run)
                left = [bag for bag in going if bag.path not in run.remaining]
                self._delete_bags(self._bags_with_memory(left, contents, run), run)
                run.unshipped += sorted(contents.unshipped & run.deleted)
            elif plan.fits or not run.waiting:
                return contents, plan
            else:
                run.urgent = True
                run.remaining -= run.waiting
                run.waiting.clear()

    def _limit_memory(self, contents: DirContents, snapshot: Snapshot) -> None:
        if self.memory is None:
            return
        # As bags do, days age by the newest that is recorded, and by a clock that is right.
        newest = snapshot.latest if contents.synchronised else None
        try:
            self.memory.limit(None if newest is None else min(newest, snapshot.scanned_at))
        except (EpisodicError, OSError) as error:
            _log.error("memory_not_limited", reason=str(error))

    def _contents(self, run: _Pass) -> DirContents:
        """Returns the bags with all that the plan needs; counts those that the clock holds."""
        contents = self._inventory.contents(run.known, deleted=run.deleted, remaining=run.remaining)
        recordings = {bag.recording for bag in contents.bags}
        missing = frozenset[str]()
        if run.limits.require_shipped:
            missing = unshipped(self.bag_dir, ((bag.path, bag.size) for bag in contents.bags))
        contents = replace(
            contents,
            free_bytes=self.measure_free(self.bag_dir) if run.needs_disk else None,
            recorded_since=self.recorded.since(recordings),
            doubtful=self.recorded.doubtful(recordings),
            places={name: place for place, name in enumerate(self.own.in_order())},
            needed=run.needed,
            unshipped=missing,
        )
        aged = bags_older_than(contents, run.limits, run.limits.max_age_ns)
        is_clock_decisive = aged.if_synchronised != aged.if_unsynchronised
        wants_clock = is_clock_decisive or self.recorded.asks_for_clock() or self.cutter is not None
        if wants_clock and run.synchronised is None:
            run.synchronised = self.is_synchronised()
            if run.synchronised:
                self.recorded.confirm_clock()
        synchronised = bool(run.synchronised)
        held = aged.if_synchronised - aged.by_clock(synchronised=synchronised)
        run.result.held = len(held)
        return replace(contents, synchronised=synchronised)

    def _carry(self, to_delete: Sequence[StoredBag], run: _Pass) -> None:
        """Carries latched messages on. A bag remains if that failed, or was done just now."""
        paths = run.deleted.union(bag.path for bag in to_delete)
        files = {bag.file for bag in self._carrier.with_latched(run.snapshot, paths)}
        latched = [bag for bag in to_delete if bag.path in files]
        try:
            carried = self._carrier.carry(run.snapshot, paths, run.saved)
        except (EpisodicError, OSError) as error:
            # Bags without latched messages can still be deleted, and may free enough space.
            for bag in latched:
                self._keep_failed(bag, f"its latched messages cannot be carried on: {error}", run)
            return
        if carried is not None:
            run.result.carried = carried
        now = self.monotonic()
        for bag in latched:
            # Queries may still look for latched messages there, though they are carried.
            since = self._carried_since.setdefault(bag.path, now)
            if not run.urgent and now - since < self.grace_s:
                run.remaining.add(bag.path)
                run.waiting.add(bag.path)

    def _bags_with_memory(
        self, going: list[StoredBag], contents: DirContents, run: _Pass
    ) -> list[StoredBag]:
        """Writes the memory of bags; returns the bags that may be deleted now."""
        if self.memory is None or not self.memory.keeps:
            return going
        try:
            # A moment has all messages of its bags.
            self.memory.keep(run.snapshot, {bag.path for bag in going} - run.saved)
        except (EpisodicError, OSError) as error:
            return self._bags_that_must_go(going, contents, run, str(error))
        self._memory_fails_since = None
        return going

    def _bags_that_must_go(
        self, going: list[StoredBag], contents: DirContents, run: _Pass, reason: str
    ) -> list[StoredBag]:
        """Returns the bags to delete though their memory cannot be written; the others remain.

        For a day, only the limits delete such bags, not their age. No bag goes only since others of
        its hour do. The first time in a pass few are returned: without them the disk may have room
        for what stays of the others.
        """
        now = self.monotonic()
        if self._memory_fails_since is None:
            self._memory_fails_since = now
        if now - self._memory_fails_since < RETRIED_S:
            # No age deletes what is needed.
            contents = replace(contents, needed=frozenset(bag.path for bag in contents.bags))
        must_go = {bag.path for bag in plan_deletions(contents, run.limits).to_delete}
        waiting = {bag.path for bag in going} - must_go
        run.remaining |= waiting
        lost = [bag for bag in going if bag.path in must_go]
        if not run.gave_up:
            run.gave_up = True
            lost = lost[: 1 + len(lost) // _FIRST_LOST]
        _log.error("memory_not_kept", reason=reason, waiting=len(waiting), lost=len(lost))
        return lost

    def _delete_bags(self, going: Sequence[StoredBag], run: _Pass) -> None:
        """Writes down what is deleted, and deletes it. A full disk does not stop deletion."""
        splits: defaultdict[str, list[tuple[str, Ns, Ns]]] = defaultdict(list)
        for bag in going:
            if bag.path not in self._not_deleted:
                splits[bag.recording].append((bare_name(bag.path), bag.start, bag.end))
        self._unwritten += [deleted_of(name, named) for name, named in splits.items()]
        self._append_unwritten()
        for bag in going:
            self._delete_bag(bag, run)
        # Where the disk was full, there is room now.
        error = self._append_unwritten()
        if error is not None:
            _log.warning("deletions_not_written", reason=error.strerror or str(error))
            self._unwritten = self._unwritten[-MOST_AT_ONCE:]

    def _append_unwritten(self) -> OSError | None:
        """Writes down the deletions that are not; returns the error if that fails."""
        try:
            if self._unwritten:
                append_deleted(self.bag_dir, self._unwritten)
        except OSError as error:
            return error
        self._unwritten.clear()
        return None

    def _delete_bag(self, bag: StoredBag, run: _Pass) -> None:
        size = 0
        # Most bags have one form only.
        for path, file in zip((bag.path, other_form(bag.path)), bag.files, strict=False):
            try:
                freed = remove_bag(self.bag_dir, Path(path), file.inode)
            except FileNotFoundError:
                continue
            except OSError as error:
                self._not_deleted.add(bag.path)
                self._keep_failed(bag, str(error), run)
                return
            if path not in run.saved:
                size += freed
        self._not_deleted.discard(bag.path)
        self._reported.discard(bag.path)
        self._carried_since.pop(bag.path, None)
        run.deleted.add(bag.path)
        run.result.bags += 1
        run.result.bytes += size

    def _remove_emptied(self, run: _Pass) -> None:
        """Deletes the directories of recordings without a bag that are not being written."""
        self.emptied |= {Path(path).parent for path in run.deleted}
        for recording in self.emptied - {self.bag_dir / name for name in run.known.named}:
            try:
                remove_emptied(self.bag_dir, recording)
            except OSError as error:
                self._report(str(recording), str(error))
            else:
                self.emptied.discard(recording)
                run.result.recordings += not recording.exists()

    def _keep_failed(self, bag: StoredBag, reason: str, run: _Pass) -> None:
        run.remaining.add(bag.path)
        run.result.failed += 1
        self._report(bag.path, reason)

    def _report(self, path: str, reason: str) -> None:
        """Reports a fault once, until the bag is deleted."""
        if path not in self._reported:
            self._reported.add(path)
            _log.error("not_deleted", path=path, reason=reason)
