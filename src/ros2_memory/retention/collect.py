"""Deletes bags that exceed the limits, after their latched messages were carried forward.

A query works on a snapshot of the bags that is some seconds old. So a bag with latched messages is
deleted only when those have been carried for that long: until then a query may look for them in the
bag. Meanwhile the next oldest bag is deleted instead; if there is none, the limits come first.
"""

from __future__ import annotations

import os
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
from ros2_memory.retention.disk import RETRIED_S
from ros2_memory.retention.inventory import Inventory
from ros2_memory.retention.policy import (
    DirContents,
    RetentionLimits,
    StoredBag,
    plan_deletions,
    too_old,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Sequence

    from ros2_memory.bag_dir.own_recordings import OwnRecordings
    from ros2_memory.core.timebase import Ns
    from ros2_memory.index.bag_table import KnownBags
    from ros2_memory.index.snapshot import Snapshot
    from ros2_memory.retention.latched_carry import Carrier
    from ros2_memory.retention.recorded_time import RecordedTime
    from ros2_memory.retention.topic_ages import TopicCutter

MOST_AT_ONCE: Final = 2000
"""Bags deleted in one pass, which take some tenths of a second. The next pass continues."""

_log = get_logger(__name__)


@dataclass(slots=True)
class Collected:
    """What one pass did.

    Attributes:
        bags: how many were deleted, of so many `bytes`; `failed` could not be.
        carried: how many latched messages are carried, if their bag was rewritten.
        total_bytes: what the budget counts afterwards.
        saved_bytes: how much of it saved moments take.
        held: how many bags are too old by their dates and stay, since the clock is not known to be
            right.
        cut: out of how many bags topics were cut.
        needed: how many of the deleted bags rules may still have needed.
        unshipped: those of the deleted bags that had to be shipped and were in no lake, relative to
            the bag directory; without those that are saved in moments.
        most_free: how much of the disk would be free if all bags were deleted that may be, where
            that was too little; then none was deleted for it.
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
    """The state of one pass; bags are paths.

    Attributes:
        urgent: whether it does not wait until carried messages have been known for long enough.
        synchronised: whether the system clock is synchronised; None until asked.
        waiting: those of the remaining bags that can be deleted some moments later.
        saved: those of the deleted bags whose files are saved in moments.
        unshipped: those that had to be shipped, in the order in which they were deleted.
        gave_up: whether some were deleted though what stays of them could not be written.
    """

    urgent: bool
    synchronised: bool | None = None
    waiting: set[str] = field(default_factory=set)
    result: Collected = field(default_factory=Collected)
    deleted: set[str] = field(default_factory=set)
    remaining: set[str] = field(default_factory=set)
    saved: set[str] = field(default_factory=set)
    unshipped: list[str] = field(default_factory=list)
    gave_up: bool = False


class Outliving(Protocol):
    """What stays of bags that are deleted."""

    def keep(self, snapshot: Snapshot, paths: Collection[str]) -> None:
        """Makes durable what stays of some bags.

        Raises:
            EpisodicError: it cannot be written.
            OSError: likewise.
        """

    def limit(self, now: Ns | None) -> None:
        """Deletes what is too old, or too much. `now` is what age counts from; None: nothing ages.

        Raises:
            OSError: it cannot be deleted.
        """


@dataclass(eq=False, repr=False)
class GarbageCollector:
    """Keeps one bag directory within its limits. Not thread-safe.

    Args:
        recorded: how long was recorded after each recording.
        grace_s: how long latched messages are carried before their bag is deleted.
        memory: what stays of deleted bags; None where nothing does.
        cutter: cuts topics with a shorter life out of bags that stay; None where none has one.

    Attributes:
        emptied: recordings that go with the next pass if no bag is left of them.
    """

    bag_dir: Path
    limits: RetentionLimits
    carrier: Carrier
    own: OwnRecordings
    _: KW_ONLY
    recorded: RecordedTime
    is_synchronised: Callable[[], bool]
    static_topics: Collection[str]
    grace_s: float
    measure_free: Callable[[Path], int]
    monotonic: Callable[[], float]
    memory: Outliving | None
    cutter: TopicCutter | None

    def __post_init__(self) -> None:
        """Sets what is known at the beginning."""
        self._memory_fails_since: float | None = None
        self._inventory = Inventory(
            self.bag_dir, self.static_topics, self.own if self.limits.keeps_foreign else None
        )
        self._carried_since: dict[str, float] = {}
        self._reported: set[str] = set()
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
            snapshot: those of them that answer.
            needed: the bags that rules may still need, which no age deletes.
            free_bytes_wanted: how much of the disk must be free; None if that does not count.

        Raises:
            OSError: the free space cannot be measured, or the list of the recorder's own recordings
                cannot be read.
        """
        limits = self.limits
        if free_bytes_wanted is not None:
            limits = replace(limits, min_free_bytes=free_bytes_wanted)
        run = _Pass(urgent=free_bytes_wanted is not None)
        while True:
            contents = self._contents(known, needed, limits, run)
            if free_bytes_wanted is not None:
                contents = replace(contents, free_bytes=self.measure_free(self.bag_dir))
            # So that what stays of an hour is written once.
            plan = plan_deletions(contents, limits, whole_hours=self.memory is not None)
            going = plan.to_delete[: MOST_AT_ONCE - len(run.deleted)]
            if going:
                run.saved |= {
                    bag.path
                    for bag in going
                    if any(file.inode in contents.saved for file in bag.files)
                }
                self._carry(going, snapshot, run)
                left = [bag for bag in going if bag.path not in run.remaining]
                self._delete_bags(self._keep_memory(left, contents, limits, snapshot, run), run)
                run.unshipped += sorted(contents.unshipped & run.deleted)
            elif plan.fits or not run.waiting:
                break
            else:
                run.urgent = True
                run.remaining -= run.waiting
                run.waiting.clear()
        self._remove_emptied(known, run)
        if self.memory is not None:
            # As bags do, days age by the newest that is recorded, and by a clock that is right.
            newest = snapshot.latest if contents.synchronised else None
            try:
                self.memory.limit(None if newest is None else min(newest, snapshot.scanned_at))
            except (EpisodicError, OSError) as error:
                _log.error("memory_not_limited", reason=str(error))
        if self.cutter is not None and free_bytes_wanted is None and plan.fits:
            left = [bag for bag in contents.bags if bag.path not in run.deleted]
            try:
                run.result.cut = self.cutter.cut(replace(contents, bags=left), limits, snapshot)
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

    def _contents(
        self, known: KnownBags, needed: frozenset[str], limits: RetentionLimits, run: _Pass
    ) -> DirContents:
        """Returns what is stored, how long was recorded after it, and where the clock was right."""
        contents = self._inventory.contents(known, deleted=run.deleted, remaining=run.remaining)
        root = f"{self.bag_dir}{os.sep}"
        names = {bag.recording: self.own.name_of(bag.recording) for bag in contents.bags}
        since = self.recorded.since(names.values())
        doubtful = self.recorded.doubtful(names.values())
        order = {name: place for place, name in enumerate(self.own.in_order())}
        bags = ((bag.path.removeprefix(root), bag.size) for bag in contents.bags)
        missing = unshipped(self.bag_dir, bags) if limits.require_shipped else ()
        contents = replace(
            contents,
            recorded_since={path: since[name] for path, name in names.items()},
            doubtful=frozenset(path for path, name in names.items() if name in doubtful),
            places={path: order[name] for path, name in names.items() if name in order},
            needed=needed,
            unshipped=frozenset(root + path for path in missing),
        )
        old = too_old(contents, limits, limits.max_age_ns)
        # Asking starts a program, so only where it matters.
        asks = self.recorded.asks_for_clock() or self.cutter is not None
        if run.synchronised is None and (old[True] != old[False] or asks):
            run.synchronised = self.is_synchronised()
            if run.synchronised:
                self.recorded.confirm_clock()
        synchronised = bool(run.synchronised)
        run.result.held = 0 if synchronised else len(old[True] - old[False])
        return replace(contents, synchronised=synchronised)

    def _carry(self, to_delete: Sequence[StoredBag], snapshot: Snapshot, run: _Pass) -> None:
        """Carries latched messages on; bags remain of which that failed, or was just done."""
        paths = {Path(path) for path in (*run.deleted, *(bag.path for bag in to_delete))}
        files = {bag.file for bag in self.carrier.with_latched(snapshot, paths)}
        latched = [bag for bag in to_delete if bag.path in files]
        try:
            carried = self.carrier.carry(snapshot, paths, {*map(Path, run.saved)})
        except (EpisodicError, OSError) as error:
            # Bags without latched messages can still be deleted, and may free enough space.
            for bag in latched:
                self._keep_failed(bag, f"its latched messages cannot be carried on: {error}", run)
            return
        run.result.carried = run.result.carried if carried is None else carried
        now = self.monotonic()
        for bag in latched:
            # Queries may still look for latched messages there, though they are carried.
            since = self._carried_since.setdefault(bag.path, now)
            if not run.urgent and now - since < self.grace_s:
                run.remaining.add(bag.path)
                run.waiting.add(bag.path)

    def _keep_memory(
        self,
        going: list[StoredBag],
        contents: DirContents,
        limits: RetentionLimits,
        snapshot: Snapshot,
        run: _Pass,
    ) -> list[StoredBag]:
        """Writes what stays of bags; returns those that go now.

        Where that fails, age waits for a day, the limits do not. Then only the bags go that must,
        and not those that would go with them, in the same hour; few at first, as that makes room to
        write what stays of the others.
        """
        if self.memory is None:
            return going
        paths = {bag.path for bag in going}
        try:
            # A moment has all messages of its bags.
            self.memory.keep(snapshot, paths - run.saved)
        except (EpisodicError, OSError) as error:
            now = self.monotonic()
            since = now if self._memory_fails_since is None else self._memory_fails_since
            self._memory_fails_since = since
            if now - since < RETRIED_S:
                everything = frozenset(bag.path for bag in contents.bags)
                contents = replace(contents, needed=everything)  # by no age
            must_go = {bag.path for bag in plan_deletions(contents, limits).to_delete}
            waiting = paths - must_go
            run.remaining |= waiting
            going = [bag for bag in going if bag.path in must_go]
            if not run.gave_up:
                run.gave_up, going = True, going[: 1 + len(going) // 8]
            _log.error("memory_not_kept", reason=str(error), waiting=len(waiting), lost=len(going))
        else:
            self._memory_fails_since = None
        return going

    def _delete_bags(self, going: Sequence[StoredBag], run: _Pass) -> None:
        self._write_down(going)
        for bag in going:
            self._delete_bag(bag, run)
        # Where the disk was full, there is room now.
        self._write_down(())

    def _write_down(self, going: Sequence[StoredBag]) -> None:
        """Writes down what is about to be deleted, or was. A full disk does not stop deletion."""
        splits: defaultdict[str, list[tuple[str, Ns, Ns]]] = defaultdict(list)
        for bag in going:
            name = self.own.name_of(bag.recording)
            splits[name].append((bare_name(bag.path), bag.start, bag.end))
        self._unwritten += [deleted_of(name, named) for name, named in splits.items()]
        if not self._unwritten:
            return
        try:
            append_deleted(self.bag_dir, self._unwritten)
        except OSError as error:
            if not going:
                _log.warning("deletions_not_written", reason=error.strerror or str(error))
                self._unwritten = self._unwritten[-MOST_AT_ONCE:]
        else:
            self._unwritten.clear()

    def _delete_bag(self, bag: StoredBag, run: _Pass) -> None:
        size = 0
        for path, file in zip((bag.path, other_form(bag.path)), bag.files, strict=False):
            try:
                freed = remove_bag(self.bag_dir, Path(path), file.inode)
                size += 0 if path in run.saved else freed
            except FileNotFoundError:
                continue
            except OSError as error:
                self._keep_failed(bag, str(error), run)
                return
        self._reported.discard(bag.path)
        self._carried_since.pop(bag.path, None)
        run.deleted.add(bag.path)
        run.result.bags += 1
        run.result.bytes += size

    def _remove_emptied(self, known: KnownBags, run: _Pass) -> None:
        """Deletes what is left of recordings without a bag, except those being written."""
        self.emptied |= {Path(path).parent for path in run.deleted}
        for recording in self.emptied - {self.bag_dir / name for name in known.named}:
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
