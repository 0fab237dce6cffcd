"""Deletes what the limits do not allow to keep, after what must outlive it was carried on.

Whoever asks a question holds what was known of the bags some seconds ago. So a bag with latched
messages is deleted only when those have been carried for that long: until then somebody may look
for them where they stood. Meanwhile the next oldest goes in its place; where there is none, the
limits come first.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import structlog

from ros2_memory.bag_dir.layout import other_form
from ros2_memory.core.errors import EpisodicError
from ros2_memory.retention.delete import Inode, remove_bag, remove_emptied
from ros2_memory.retention.inventory import Inventory
from ros2_memory.retention.policy import ages, plan_deletions
from ros2_memory.retention.recorded_time import relative_recording

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Sequence

    from ros2_memory.bag_dir.own_recordings import OwnRecordings
    from ros2_memory.index.bag_table import KnownBags
    from ros2_memory.index.snapshot import Snapshot
    from ros2_memory.retention.latched_carry import Carrier
    from ros2_memory.retention.policy import RetentionLimits, RetentionStock, StoredBag
    from ros2_memory.retention.recorded_time import RecordedTime

MOST_AT_ONCE: Final = 2000
"""Bags deleted in one pass: some tenths of a second. The next pass goes on."""

_log: structlog.typing.FilteringBoundLogger = structlog.get_logger(__name__)


@dataclass(slots=True)
class Collected:
    """What one pass did.

    `total_bytes` is what the budget counts afterwards, and `fits` whether the limits are kept.
    `foreign_bytes` is what bags take that the recorder did not make and no limit counts. `carried`
    is how many latched messages are carried, where their bag was written anew; `failed` is how many
    bags could not be deleted. `held` is how many are too old by their dates and stay, since the
    clock is not known to be right.
    """

    bags: int = 0
    bytes: int = 0
    recordings: int = 0
    carried: int | None = None
    failed: int = 0
    total_bytes: int = 0
    foreign_bytes: int = 0
    fits: bool = True
    held: int = 0


@dataclass(slots=True)
class _Pass:
    """One pass under way: bags that were deleted (`kept` of them in moments), and those that stay.

    Of these some are `waiting`: they could be deleted, and should be some moments later. When it is
    `urgent` nothing is waited for. `synchronised`: whether the system clock is; None until asked.
    """

    urgent: bool
    synchronised: bool | None = None
    waiting: set[str] = field(default_factory=set)
    done: Collected = field(default_factory=Collected)
    gone: set[str] = field(default_factory=set)
    staying: set[str] = field(default_factory=set)
    kept: set[Path] = field(default_factory=set)

    def hurry(self) -> None:
        """Waits no more."""
        self.urgent = True
        self.staying -= self.waiting
        self.waiting.clear()


class GarbageCollector:
    """Keeps one bag directory within its limits. Not for several threads at once.

    Args:
        bag_dir: the bag directory.
        limits: how much is kept.
        carrier: carries latched messages on.
        own: the recordings that the recorder made.
        recorded: how long was recorded after each recording.
        is_synchronised: whether the system clock is synchronised; may take some seconds.
        static_topics: topics that are latched whatever their publishers say.
        grace_s: how long latched messages are carried before the bag goes that they stood in.
        monotonic: a clock that never steps, in seconds.
    """

    def __init__(
        self,
        bag_dir: Path,
        limits: RetentionLimits,
        carrier: Carrier,
        own: OwnRecordings,
        *,
        recorded: RecordedTime,
        is_synchronised: Callable[[], bool],
        static_topics: Collection[str] = (),
        grace_s: float = 0.0,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._bag_dir = bag_dir
        self._limits = limits
        self._carrier = carrier
        self._recorded = recorded
        self._is_synchronised = is_synchronised
        self._inventory = Inventory(bag_dir, static_topics, own if limits.keeps_foreign else None)
        self._grace_s = grace_s
        self._monotonic = monotonic
        self._carried_since: dict[str, float] = {}
        self._told: set[str] = set()
        self._untidy: set[Path] = set()

    def apply(
        self,
        known: KnownBags,
        snapshot: Snapshot,
        *,
        free_bytes: Callable[[], int] | None = None,
        min_free_bytes: int | None = None,
    ) -> Collected:
        """Deletes what is too old, and then what is too much. What cannot be deleted is reported.

        Args:
            known: what the index knows of files.
            snapshot: what it publishes of them.
            free_bytes: measures what the disk has left; where None, that does not count.
            min_free_bytes: what must be free, where that is not as the limits have it.

        Raises:
            OSError: what is free cannot be measured, or it cannot be read which recordings are the
                recorder's own.
        """
        limits = self._limits
        if min_free_bytes is not None:
            limits = replace(limits, min_free_bytes=min_free_bytes)
        under_way = _Pass(urgent=free_bytes is not None)
        while True:
            stock = self._inventory.stock(known, gone=under_way.gone, staying=under_way.staying)
            if free_bytes is not None:
                stock = replace(stock, free_bytes=free_bytes())
            stock = self._with_clocks(stock, limits, under_way)
            found = plan_deletions(stock, limits)
            under_way.done.foreign_bytes = stock.foreign_bytes
            under_way.done.total_bytes, under_way.done.fits = found.total_bytes, found.fits
            doomed = found.doomed[: MOST_AT_ONCE - len(under_way.gone)]
            if doomed:
                kept = {file.inode for file in stock.kept}
                self._dispose(doomed, kept, snapshot, under_way)
            elif found.fits or not under_way.waiting:
                break
            else:
                under_way.hurry()
        self._tidy(known, under_way)
        return under_way.done

    def _with_clocks(
        self, stock: RetentionStock, limits: RetentionLimits, under_way: _Pass
    ) -> RetentionStock:
        """The stock, and what the clocks say of it."""
        names = {
            bag.recording: relative_recording(bag.recording, self._bag_dir) for bag in stock.bags
        }
        since = self._recorded.since(names.values())
        stock = replace(stock, recorded_since={path: since[name] for path, name in names.items()})
        old = ages(stock, limits)
        # A program has to be started to know, so only where it matters.
        if old.by_dates != old.by_recording and under_way.synchronised is None:
            under_way.synchronised = self._is_synchronised()
        synchronised = bool(under_way.synchronised)
        under_way.done.held = len(old.held(synchronised=synchronised))
        return replace(stock, synchronised=synchronised)

    def _dispose(
        self,
        doomed: Sequence[StoredBag],
        kept: Collection[tuple[int, int]],
        snapshot: Snapshot,
        under_way: _Pass,
    ) -> None:
        leaving = {Path(bag.path) for bag in doomed} | {Path(path) for path in under_way.gone}
        latched = {str(bag.path) for bag in self._carrier.concerned(snapshot, leaving)}
        try:
            under_way.kept |= {
                Path(bag.path) for bag in doomed if any(each.inode in kept for each in bag.files)
            }
            carried = self._carrier.carry(snapshot, leaving, under_way.kept)
        except (EpisodicError, OSError) as error:
            # The others may go all the same, and make the room that was missing.
            reason = f"its latched messages cannot be carried on: {error}"
            for each in doomed:
                if each.path in latched:
                    self._stays(each.path, reason, under_way)
        else:
            under_way.done.carried = under_way.done.carried if carried is None else carried
        for each in doomed:
            if each.path in latched and self._is_asked_for(each.path, under_way):
                under_way.staying.add(each.path)
                under_way.waiting.add(each.path)
            if each.path not in under_way.staying:
                self._delete(each, under_way)

    def _is_asked_for(self, path: str, under_way: _Pass) -> bool:
        """Whether latched messages are still looked for in a bag, though they are carried."""
        now = self._monotonic()
        since = self._carried_since.setdefault(path, now)
        return not under_way.urgent and now - since < self._grace_s

    def _delete(self, bag: StoredBag, under_way: _Pass) -> None:
        size = 0
        for path, file in zip((bag.path, other_form(bag.path)), bag.files, strict=False):
            try:
                freed = remove_bag(self._bag_dir, Path(path), Inode(*file.inode))
                size += 0 if Path(path) in under_way.kept else freed
            except FileNotFoundError:
                continue
            except OSError as error:
                self._stays(bag.path, str(error), under_way)
                return
        self._told.discard(bag.path)
        self._carried_since.pop(bag.path, None)
        under_way.gone.add(bag.path)
        under_way.done.bags += 1
        under_way.done.bytes += size

    def _tidy(self, known: KnownBags, under_way: _Pass) -> None:
        """Deletes what is left of recordings without a bag, unless one is being written."""
        named = {self._bag_dir / name for name in known.named}
        self._untidy |= {Path(path).parent for path in under_way.gone}
        for recording in self._untidy - named:
            try:
                remove_emptied(self._bag_dir, recording)
            except OSError as error:
                self._tell(str(recording), str(error))
            else:
                self._untidy.discard(recording)
                under_way.done.recordings += not recording.exists()

    def _stays(self, path: str, reason: str, under_way: _Pass) -> None:
        under_way.staying.add(path)
        under_way.done.failed += 1
        self._tell(path, reason)

    def _tell(self, path: str, reason: str) -> None:
        """Reports a fault; silent while it stands."""
        if path not in self._told:
            self._told.add(path)
            _log.error("not_deleted", path=path, reason=reason)
