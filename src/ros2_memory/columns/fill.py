"""Fills the store: decodes closed bags that are not stored, and joins the bags of an hour."""

from __future__ import annotations

import os
import time
from collections import defaultdict
from dataclasses import dataclass
from functools import partial
from itertools import chain, islice
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.bag_dir.handover_file import sure_handover
from ros2_memory.bag_dir.layout import ERASING_FILE, HANDOVER_FILE, OWN_FOLDER
from ros2_memory.columns.decode import Group, undecoded
from ros2_memory.columns.store import LONG_NS, BagKey, relative
from ros2_memory.columns.writing import PART_NS, Level, ReadBag
from ros2_memory.core.errors import BagError
from ros2_memory.core.large_reads import LargeReads
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.model import BagFile, BagState, TimeWindow
from ros2_memory.core.spans import united
from ros2_memory.core.timebase import NS_PER_S, Clock, Ns, Span, ms_from_ns
from ros2_memory.index.scan import Stamp, settled, sidecar_ns_of
from ros2_memory.index.segment import in_time

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.columns.coverage import Coverage
    from ros2_memory.columns.scanner import Scanner
    from ros2_memory.columns.table import Table
    from ros2_memory.index.timeline import Timeline
    from ros2_memory.storage.base import BagReader

log = get_logger(__name__)

RETRY_NS: Final[Ns] = 600 * NS_PER_S
"""After this long a bag that could not be stored is tried again: the disk may have failed."""
IN_MEMORY_BYTES: Final = 64 << 20
"""What the store may take where no file can be written."""
_MOST_HELD: Final = 64 << 20
"""Bytes of columns after which bags are written, though more bags of their hour wait."""
_TRIMMED_TO: Final = 0.9
"""A store above its limit is trimmed to this share of it."""
_MOST_REFUSED: Final = 10_000


@dataclass(frozen=True, slots=True)
class StoreLimits:
    """How large the store may be.

    Attributes:
        max_share: its share of the bytes of the bags.
        max_bytes: its bytes, if the file is not beside the bags. The oldest bags go first.
        least_bytes_per_s: how many bytes a second of bags may take, however small they are.
    """

    max_share: float = 0.15
    max_bytes: int = 2 * 10**9
    least_bytes_per_s: int = 200


@dataclass(frozen=True, slots=True)
class Progress:
    """How many bags are stored.

    Attributes:
        closed: closed bags.
        stored: closed bags that are stored.
        waiting: bags that will be stored.
        refused: bags that could not be stored; each question about them reads them.
    """

    closed: int
    stored: int = 0
    waiting: int = 0
    refused: int = 0

    @property
    def percent(self) -> int:
        """How many of a hundred closed bags are stored, rounded down."""
        return 100 * self.stored // max(self.closed, 1)


class Batch(NamedTuple):
    """Bags of one recording that are stored in the same parts.

    Attributes:
        bags: the bags of a slot that do not have parts of the level yet. The slot is over.
        level: of the parts; with `Level.BAG` it is a single bag, whose slots may go on.
    """

    bags: Sequence[BagFile]
    level: Level


class Filling:
    """Fills the store of one bag directory. One thread may use it; any may call `progress`.

    Args:
        scanner: of the store.
        reader: reads the bags.
        bag_dir: the bag directory.
        clock: says now.
        limits: how large the store may be.
        large: the turn to hold much of a bag in memory, which is passed on after each group.
    """

    def __init__(
        self,
        scanner: Scanner,
        reader: BagReader,
        bag_dir: Path,
        clock: Clock,
        limits: StoreLimits,
        *,
        large: LargeReads | None = None,
    ) -> None:
        self._large = large or LargeReads()
        if scanner.covering is None:
            raise ValueError("a scanner without a store has nothing to fill")
        self._covering = scanner.covering
        self.store = scanner.covering.store
        self._scanner = scanner
        self._reader = reader
        self._bag_dir = bag_dir
        self._clock = clock
        self._limits = limits
        self._refused: dict[BagKey, Ns] = {}
        self._trimmed: dict[BagKey, Ns] = {}
        self._shared: tuple[Timeline, frozenset[str]] | None = None
        self._merged: list[Span] = []
        self._whole_parts: list[tuple[Sequence[int], list[BagFile]]] = []

    def waiting(self, timeline: Timeline) -> list[BagFile]:
        """Returns the bags to be stored, the newest first.

        They include stored bags that have no hashes, and beside which another recording lies now.
        """
        coverage = self._covering.of(timeline)
        bags = [*coverage.to_store]
        bags += [bag for bag in coverage.unhashed() if self._is_shared(bag, timeline)]
        bags = [bag for bag in bags if not self._is_refused(self._key(bag))]
        return self._fitting(sorted(bags, key=in_time, reverse=True))

    def progress(self, timeline: Timeline) -> Progress:
        """Returns how much is stored. Any thread may ask."""
        missing = self._covering.of(timeline).missing
        return Progress(
            timeline.closed,
            timeline.closed - sum(bag.state is BagState.CLOSED for bag in missing),
            len(self.waiting(timeline)),
            sum(map(self._is_refused, [*self._refused])),
        )

    def batches(self, timeline: Timeline) -> list[Batch]:
        """Returns the bags to be stored, as batches, the newest first.

        A bag is stored alone until its ten minutes are over, then together with the bags of these,
        and together with the bags of its hour once that is over.
        """
        coverage = self._covering.of(timeline)
        waiting = self.waiting(timeline)
        stored_alone = {*self._below(Level.TEN_MINUTES, coverage)}
        of_ten_minutes = stored_alone.union(waiting)
        recent, hours = list[Batch](), list[Batch]()
        for of_hour in _by_slot([*waiting, *self._below(Level.HOUR, coverage)], Level.HOUR):
            if self._is_over(of_hour[0], Level.HOUR, timeline):
                hours.append(Batch(of_hour, Level.HOUR))
                continue
            bags = [bag for bag in of_hour if bag in of_ten_minutes]
            for of_slot in _by_slot(bags, Level.TEN_MINUTES):
                if self._is_over(of_slot[0], Level.TEN_MINUTES, timeline):
                    recent.append(Batch(of_slot, Level.TEN_MINUTES))
                else:
                    new = [bag for bag in of_slot if bag not in stored_alone]
                    recent += [Batch([bag], Level.BAG) for bag in new]
        return [*recent, *hours]

    def _below(self, level: Level, coverage: Coverage) -> list[BagFile]:
        """Returns the stored bags that have parts below a level, and may be stored again."""
        stored = map(coverage.bag, self.store.below(level))
        return [bag for bag in stored if bag and not self._is_refused(self._key(bag))]

    def fill(self, batch: Batch, timeline: Timeline) -> int:
        """Stores the bags of a batch; returns how many.

        The others must wait, have changed, or are refused.
        """
        pending: list[ReadBag] = []
        group, stored = Group(self._reader), 0
        try:
            for bag in sorted(batch.bags, key=in_time):
                stored += self._add(bag, pending, group, hashed=self._is_shared(bag, timeline))
                self._large.release()
                if group.memory_bytes > _MOST_HELD:
                    stored += self._put(pending, group, batch.level, timeline)
                    pending, group = [], Group(self._reader)
            return stored + self._put(pending, group, batch.level, timeline)
        except Exception as error:
            log.exception("bag_not_stored", path=str(batch.bags[0].path), bags=len(batch.bags))
            if len(batch.bags) > 1:  # the fault may lie in one of them
                return self._fill_alone(batch.bags, batch.level, timeline)
            self._refuse(batch.bags[0], type(error).__name__)
            return stored

    def whole_since(self) -> list[TimeWindow]:
        """Returns the times of the whole parts written since the last call, the newest first.

        Fragments must be made of these parts before `thin` is called, which drops columns.
        """
        merged, self._merged = united(self._merged), []
        return [TimeWindow(*span) for span in reversed(merged)]

    def thin(self) -> None:
        """Drops columns of the whole parts written since the last call, beyond their share.

        A robot that drives has more to store than one that stands, so they may also take what other
        bags left of their share.
        """
        groups, self._whole_parts = self._whole_parts, []
        shares = [(parts, self._share(bags)) for parts, bags in groups]
        self.store.thin(shares, self._limits.max_share)

    def count_gone(self, timeline: Timeline) -> tuple[int, int]:
        """Returns how many stored bags are gone or have changed, and how many there are."""
        coverage, stored = self._covering.of(timeline), self.store.numbers().size
        return stored - coverage.stored, stored

    def prune(self, timeline: Timeline) -> None:
        """Deletes the bags whose files are gone.

        If no bag is left nothing is deleted: the disk is more likely missing than empty.
        """
        files = chain.from_iterable(segment.bags.files() for segment in timeline.segments)
        present = {relative(file, str(self._bag_dir)) for file in files}
        if not present:
            return
        absent = [path for path in self.store.paths() if path not in present]
        gone = [path for path in absent if not (self._bag_dir / path).exists()]
        if gone:
            self.store.delete(gone)
        self.store.release_pages()

    def trim(self) -> None:
        """Deletes the oldest bags if the store is larger than it may be."""
        most = self._most_bytes()
        if most is None or self.store.used_bytes() <= most:
            return
        while self.store.used_bytes() > _TRIMMED_TO * most:
            oldest = self.store.oldest()
            if oldest is None:
                break
            # The bags of an hour together: a part is deleted with the last of its bags.
            hour = Level.HOUR.length
            keys = self.store.beginning_before((oldest // hour + 1) * hour)
            if not self.store.delete([key.path for key in keys]):
                break
            recent = {key: at for key, at in self._trimmed.items() if self._is_refused(key)}
            self._trimmed = {**recent, **dict.fromkeys(keys, self._clock.now())}
            log.info("oldest_columns_deleted", bags=len(keys))
        self.store.release_pages()

    def _renew(self, bag: BagFile) -> bool:
        """Keeps a stored bag if a new `handover.json` beside it changes nothing in it.

        Each rotation writes the file of a recording again, though it concerns one or two of many
        bags. If all messages of a bag count now, and it was stored with as many, nothing changed.

        Returns:
            Whether it is kept.
        """
        if not bag.sidecar_ns or not self._reader.is_file(bag.path):
            return False
        if sure_handover(bag.recording).handover.rule(bag.path.name):
            return False
        return self.store.renew(self._key(bag), bag)

    def _add(self, bag: BagFile, pending: list[ReadBag], group: Group, *, hashed: bool) -> bool:
        """Adds a bag to `pending` and its messages to `group`; or stores it, if it is a long one.

        Returns:
            Whether the bag is stored.
        """
        if not self._may_be_stored(bag):
            return False
        try:
            if self._renew(bag):
                return True
            is_current = partial(self._may_be_stored, bag)
            to_store = ReadBag(self._key(bag), bag, hashed, is_current, len(pending))
            # A latched message may come again later, in another recording.
            groups = undecoded(
                self._reader,
                bag.path,
                hashed=lambda channel: hashed or channel.latched,
                number=to_store.number,
            )
            first_groups = [*islice(groups, 2)]
            if len(first_groups) > 1 or bag.end - bag.start > LONG_NS:
                return self._put_long(to_store, self._tables_of_groups(first_groups, groups))
        except BagError as error:
            self._scanner.met_damage(bag, error)
            self._refuse(bag, error.reason)
            return False
        pending.append(to_store)
        for of_bag in first_groups:
            group.take(of_bag)
        return False

    def _fill_alone(self, bags: Sequence[BagFile], level: Level, timeline: Timeline) -> int:
        return sum(self.fill(Batch([bag], level), timeline) for bag in bags)

    def _put(
        self, pending: Sequence[ReadBag], group: Group, level: Level, timeline: Timeline
    ) -> int:
        """Stores bags in common parts, or each alone if the database refuses them.

        Returns:
            How many are stored.
        """
        bags = [to_store.bag for to_store in pending]
        if not bags:
            return 0
        begun, refusals = time.perf_counter_ns(), self.store.refusals
        written = self.store.put(pending, group.tables(), level)
        if self.store.refusals > refusals:
            if len(bags) > 1:
                return self._fill_alone(bags, level, timeline)
            self._refuse(bags[0], self.store.refused_for or "")
        if written.parts and level > Level.BAG:
            _, begin = _slot(bags[0], level)
            self._merged.append((begin, begin + level.length))
            self._whole_parts.append((written.parts, bags))
        if written.bags:
            spent = ms_from_ns(time.perf_counter_ns() - begun)
            log.debug(
                "bags_stored",
                bags=written.bags,
                slot_s=level.length // NS_PER_S,
                duration_ms=round(spent, 3),
            )
        return written.bags

    def _put_long(self, to_store: ReadBag, groups: Iterator[list[Table]]) -> bool:
        """Stores a bag as parts of an hour each, group by group; returns whether it did."""
        bag = to_store.bag
        refusals = self.store.refusals
        stored, taken = self.store.merged_bytes()
        left = round(self._limits.max_share * stored) - taken
        budget = self._share([bag]) + max(left, 0)
        is_stored = self.store.put_long(to_store, groups, budget=budget)
        if not is_stored and self.store.refusals > refusals:
            self._refuse(bag, self.store.refused_for or "")
        return is_stored

    def _tables_of_groups(
        self, first_groups: list[Group], groups: Iterator[Group]
    ) -> Iterator[list[Table]]:
        """Yields the tables of a long bag, and notes the hours in which they have rows.

        Before the next tables are decoded, the previous ones are freed and the turn released.

        Args:
            first_groups: those that were taken from `groups` already.
            groups: the groups of the bag.
        """
        while True:
            group = first_groups.pop(0) if first_groups else next(groups, None)
            if group is None:
                return
            tables = group.tables()
            for table in tables:
                # Hour by hour, since decades may lie between two messages.
                hours = np.unique(table.log_times // PART_NS).tolist()
                self._merged += [(hour * PART_NS, (hour + 1) * PART_NS) for hour in hours]
            yield tables
            tables.clear()  # the caller still has the list
            if not first_groups:
                self._large.release()

    def _share(self, bags: Sequence[BagFile]) -> int:
        """Returns how many bytes the columns of some bags may take.

        By their length at most as many as the bags have: years may lie between two messages.
        """
        size = sum(bag.size for bag in bags)
        length = sum(bag.end - bag.start for bag in bags) // NS_PER_S + len(bags)
        by_length = min(self._limits.least_bytes_per_s * length, size)
        return max(round(self._limits.max_share * size), by_length)

    def _may_be_stored(self, bag: BagFile) -> bool:
        return not self._reader.is_file(bag.path) or is_settled(
            bag, self._bag_dir, self._clock.now()
        )

    def _is_shared(self, bag: BagFile, timeline: Timeline) -> bool:
        """Returns whether messages of a bag may lie in another recording, too."""
        shared_in, files = self._shared or (None, frozenset[str]())
        if shared_in is not timeline:
            spans = [TimeWindow(*span) for span in timeline.shared_times]
            files = frozenset(bag.file for span in spans for bag in timeline.overlapping(span))
            self._shared = timeline, files
        return bag.file in files

    def _is_over(self, bag: BagFile, level: Level, timeline: Timeline) -> bool:
        """Returns whether the slot of a bag is over, so that no other bag will begin in it."""
        now = self._clock.now()
        if bag.start > now:  # this clock is behind: else a newest bag that is ahead shows nothing
            now = timeline.segments[-1].latest
        return now >= _slot(bag, level)[1] + level.length

    def _fitting(self, bags: Sequence[BagFile]) -> list[BagFile]:
        """Returns which bags may be stored.

        A bag that is newer than the oldest stored one may replace that. An older bag must fit
        beside what is stored, even if it takes twice its share: else it would be deleted and stored
        again for ever.

        Args:
            bags: the newest first.
        """
        most = self._most_bytes()
        if most is None or not bags:
            return [*bags]
        most = round(_TRIMMED_TO * most)
        oldest, used = self.store.oldest(), self.store.used_bytes()
        fitting: list[BagFile] = []
        for bag in bags:
            size = 2 * self._share([bag])
            if oldest is not None and bag.start >= oldest:
                if size <= most:
                    fitting.append(bag)
            elif used + size <= most:
                fitting.append(bag)
                used += size
        return fitting

    def _most_bytes(self) -> int | None:
        """Returns how large the store may be; None beside the bags, where retention limits it."""
        path = self.store.path
        if path is None:
            return min(IN_MEMORY_BYTES, self._limits.max_bytes)
        # Bags in a home folder have the cache folder below them.
        is_beside = path.parent == self._bag_dir / OWN_FOLDER
        return None if is_beside else self._limits.max_bytes

    def _refuse(self, bag: BagFile, reason: str) -> None:
        log.warning("bag_not_stored", path=str(bag.path), reason=reason)
        if len(self._refused) >= _MOST_REFUSED:
            self._refused.clear()
        self._refused[self._key(bag)] = self._clock.now()

    def _is_refused(self, key: BagKey) -> bool:
        since = self._refused.get(key, self._trimmed.get(key))
        return since is not None and abs(self._clock.now() - since) < RETRY_NS

    def _key(self, bag: BagFile) -> BagKey:
        return BagKey.of(bag, self._bag_dir)


def _slot(bag: BagFile, level: Level) -> tuple[str, Ns]:
    """Returns the recording of a bag, and the log time (ns) at which its slot begins."""
    return bag.file.rpartition("/")[0], bag.start // level.length * level.length


def _by_slot(bags: Iterable[BagFile], level: Level) -> list[list[BagFile]]:
    """Returns distinct bags, grouped by their slots."""
    slots: dict[tuple[str, Ns], list[BagFile]] = defaultdict(list)
    for bag in dict.fromkeys(bags):
        slots[_slot(bag, level)].append(bag)
    return [*slots.values()]


def is_settled(bag: BagFile, bag_dir: Path, now: Ns) -> bool:
    """Returns whether a bag is as the index found it, has not changed lately, and is not erased."""
    try:
        stamp = Stamp.of(os.lstat(bag.path), _sidecar_ns(bag.path.with_name(HANDOVER_FILE)))
        return (
            stamp.content == (bag.size, bag.mtime_ns, bag.sidecar_ns)
            and settled(stamp.mtime_ns, now)
            and settled(stamp.sidecar_ns, now)
            and not (bag_dir / ERASING_FILE).exists()
        )
    except OSError:
        return False


def _sidecar_ns(path: Path) -> Ns:
    try:
        return sidecar_ns_of(os.lstat(path))
    except OSError:
        return 0
