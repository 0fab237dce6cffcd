"""Fills the store: decodes every closed bag that is not in it, and makes parts of what is."""

from __future__ import annotations

import os
import time
from collections import defaultdict
from dataclasses import dataclass
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.layout import ERASING_FILE, HANDOVER_FILE
from ros2_memory.columns.coverage import shared_times
from ros2_memory.columns.decode import decoded
from ros2_memory.columns.store import LONG_NS, PART_NS, BagKey
from ros2_memory.core.errors import BagError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.model import BagState
from ros2_memory.core.timebase import NS_PER_S, Ns, ms_from_ns
from ros2_memory.index.scan import settled
from ros2_memory.index.segment import in_time

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from ros2_memory.columns.scan import Scanner
    from ros2_memory.columns.store import ColumnStore
    from ros2_memory.columns.table import Table
    from ros2_memory.core.model import BagFile, TimeWindow
    from ros2_memory.core.timebase import Clock
    from ros2_memory.index.timeline import Timeline
    from ros2_memory.storage.base import BagReader, Channel

log = get_logger(__name__)

RETRY_NS: Final[Ns] = 600 * NS_PER_S
"""After this long a bag that could not be stored is tried again: the disk may have failed."""
LEAST_BYTES_PER_S: Final = 200
"""What the columns of a second may take however small the bags are."""
_MOST_REFUSED: Final = 10_000


@dataclass(frozen=True, slots=True)
class StoreLimits:
    """How much the store may take.

    Attributes:
        max_share: of the bytes of the bags; or `LEAST_BYTES_PER_S`, whichever is more.
        max_bytes: in all; None: no limit. Bags that are older than those that fit are not stored.
    """

    max_share: float = 0.15
    max_bytes: int | None = None


class Filling:
    """Fills the store of one bag directory. For one thread.

    Args:
        scanner: of the store.
        reader: reads the bags.
        bag_dir: the bag directory.
        clock: says now.
        limits: how much the store may take.
    """

    def __init__(
        self,
        scanner: Scanner,
        reader: BagReader,
        bag_dir: Path,
        clock: Clock,
        limits: StoreLimits,
    ) -> None:
        if scanner.store is None:
            raise ValueError("a scanner without a store has nothing to fill")
        self.store: ColumnStore = scanner.store
        self._scanner = scanner
        self._reader = reader
        self._bag_dir = bag_dir
        self._clock = clock
        self._limits = limits
        self._refused: dict[BagKey, Ns] = {}
        self._shared: tuple[Timeline, list[TimeWindow]] | None = None

    def waiting(self, timeline: Timeline) -> list[BagFile]:
        """Returns the bags to be stored, the newest first.

        Those among them that are stored already lie beside another recording by now, and copies of
        their messages cannot be recognised.
        """
        coverage = self._scanner.coverage(timeline)
        if coverage is None:
            return []
        found = [bag for bag in coverage.missing if bag.state is BagState.CLOSED]
        found += [bag for bag in coverage.unhashed() if self._is_shared(bag, timeline)]
        found = [bag for bag in found if not self._is_refused(self._key(bag))]
        if self._is_full():
            oldest = self.store.oldest()
            found = [bag for bag in found if oldest is not None and bag.end >= oldest]
        return sorted(found, key=in_time, reverse=True)

    def fill(self, bag: BagFile, timeline: Timeline) -> bool:
        """Stores one bag; returns False if it must wait, has changed meanwhile, or is refused."""
        if not self._may_be_stored(bag):
            return False
        begun = time.perf_counter_ns()
        try:
            stored = self._store(bag, hashed=self._is_shared(bag, timeline))
        except BagError as error:
            self._refuse(bag, error.reason)
            return False
        except Exception as error:
            log.exception("bag_not_stored", path=str(bag.path))
            self._refuse(bag, type(error).__name__)
            return False
        if stored:
            spent = ms_from_ns(time.perf_counter_ns() - begun)
            log.debug("bag_stored", path=str(bag.path), duration_ms=round(spent, 3))
        return stored

    def merge(self, timeline: Timeline) -> int:
        """Makes parts of bags whose ten minutes are over and all stored; returns of how many."""
        coverage = self._scanner.coverage(timeline)
        if coverage is None:
            return 0
        done = 0
        waiting = {self._slot(bag) for bag in self.waiting(timeline)}
        slots: dict[tuple[str, Ns, bool], list[tuple[int, BagFile]]] = defaultdict(list)
        hashed = self.store.hashed()
        for number in sorted(self.store.splits()):
            bag = coverage.bag(number)
            if bag is not None and (slot := self._slot(bag)) not in waiting:
                slots[(*slot, number in hashed)].append((number, bag))
        for (_, begin, _), bags in slots.items():
            if self._is_over(begin, timeline):
                size = sum(bag.size for _, bag in bags)
                length = sum(bag.end - bag.start for _, bag in bags) // NS_PER_S
                budget = max(
                    round(self._limits.max_share * size), LEAST_BYTES_PER_S * (length + len(bags))
                )
                if self.store.merge([number for number, _ in bags], budget):
                    done += len(bags)
        return done

    def prune(self, timeline: Timeline) -> None:
        """Deletes the bags whose files are gone, or that only another preset reads."""
        present = {self._key(bag).path for bag in timeline.bags}
        gone = [
            path
            for path in self.store.bags()
            if path not in present and not (self._bag_dir / path).exists()
        ]
        if gone:
            self.store.delete(gone)

    def _store(self, bag: BagFile, *, hashed: bool) -> bool:
        is_hashed = partial(_is_hashed, everything=hashed)
        groups = decoded(self._reader, bag.path, hashed=is_hashed)
        first = next(groups, [])
        second = next(groups, None)
        key, is_current = self._key(bag), partial(self._may_be_stored, bag)
        if second is None and bag.end - bag.start <= LONG_NS:
            tables = _sound(bag, first)
            return self.store.put(key, bag, tables, hashed=hashed, is_current=is_current)
        begin = [first] if second is None else [first, second]
        every = (_sound(bag, tables) for tables in chain(begin, groups))
        return self.store.put_long(key, bag, every, hashed=hashed, is_current=is_current)

    def _may_be_stored(self, bag: BagFile) -> bool:
        """Returns whether a bag is as the index found it, for a while now, and none of it goes."""
        try:
            stat = os.lstat(bag.path)
        except OSError:
            return False
        sidecar_ns = _mtime_ns(bag.path.with_name(HANDOVER_FILE))
        now = self._clock.now()
        return (
            (stat.st_size, stat.st_mtime_ns, sidecar_ns) == (bag.size, bag.mtime_ns, bag.sidecar_ns)
            and settled(stat.st_mtime_ns, now)
            and settled(sidecar_ns, now)
            and not (self._bag_dir / ERASING_FILE).exists()
        )

    def _is_shared(self, bag: BagFile, timeline: Timeline) -> bool:
        """Returns whether messages of a bag may lie in another recording, too."""
        if self._shared is None or self._shared[0] is not timeline:
            self._shared = timeline, shared_times(timeline)
        return any(span.overlaps(bag.start, bag.end) for span in self._shared[1])

    def _is_over(self, begin: Ns, timeline: Timeline) -> bool:
        """Returns whether no bag that belongs to ten minutes is to be expected."""
        newest = max(segment.latest for segment in timeline.segments[-1:])
        return max(newest, self._clock.now()) >= begin + PART_NS

    def _slot(self, bag: BagFile) -> tuple[str, Ns]:
        return bag.file.rpartition("/")[0], bag.start // PART_NS * PART_NS

    def _is_full(self) -> bool:
        most = self._limits.max_bytes
        return most is not None and self.store.used_bytes() > most

    def _refuse(self, bag: BagFile, reason: str) -> None:
        log.warning("bag_not_stored", path=str(bag.path), reason=reason)
        if len(self._refused) >= _MOST_REFUSED:
            self._refused.clear()
        self._refused[self._key(bag)] = self._clock.now()

    def _is_refused(self, key: BagKey) -> bool:
        since = self._refused.get(key)
        return since is not None and abs(self._clock.now() - since) < RETRY_NS

    def _key(self, bag: BagFile) -> BagKey:
        return BagKey.of(bag, self._bag_dir)


def _is_hashed(channel: Channel, *, everything: bool) -> bool:
    """Returns whether payloads of a channel are hashed: a latched message may come again later."""
    return everything or channel.latched


def _sound(bag: BagFile, tables: Sequence[Table]) -> Sequence[Table]:
    """Returns the tables.

    Raises:
        BagError: a message cannot be decoded. The bag is read for each question then, which says
            so.
    """
    for table in tables:
        if table.undecodable:
            reason = f"{table.channel.topic}: {table.undecodable_reason}"
            raise BagError(str(bag.path), reason)
    return tables


def _mtime_ns(path: Path) -> Ns:
    try:
        return os.lstat(path).st_mtime_ns
    except OSError:
        return 0
