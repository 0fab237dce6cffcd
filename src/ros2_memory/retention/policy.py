"""Which bags are deleted: those too old, then the oldest beyond the budget. Pure decisions.

Age deletes only by a clock that is known to be right. Where the system clock is synchronised that
is the one of the dates; else it is the monotonic clock: a bag is too old when more than
`max_age_ns` has been recorded after it. What the dates alone call too old is held.

By dates, age counts from the newest recorded data, not from the wall clock: a robot that was
switched off does not erase itself when it wakes. Clocks step, so not every date is believed:

- A bag dated in the future, before there was ROS 2, or longer than any recording is not dated: it
  ages no others, and is itself as old as its file.
- A pause longer than `max_age_ns`, and than a day, is a robot that was off or a clock that was
  set, which nothing can tell apart. It parts two eras, and no bag ages those of another era.

The budget takes them all, oldest first: a dated bag of the present era by its newest message, any
other by the time of its file. A file dated after all that may be kept, counted from now, tells no
time, and goes first: else it would stay for good. One dated before there was ROS 2, while the clock
stands there now, is being recorded now, and goes last. The newest bag stays, whatever the limits
say.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S, Ns
from ros2_memory.index.clock_faults import FIRST_BAGS_NS, FUTURE_NS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

GB: Final = 10**9
"""Bytes of a gigabyte, as configuration keys that end in `_gb` count them."""
SHORTEST_PAUSE_NS: Final[Ns] = 24 * 3600 * NS_PER_S
"""A shorter pause never parts two eras, however little history is kept."""


@dataclass(frozen=True, slots=True)
class RetentionLimits:
    """How much is kept: bytes in all, age of the oldest, and what must stay free on the disk.

    `keeps_foreign`: bags that the recorder did not make are no part of it, and never deleted.
    """

    max_total_bytes: int
    max_age_ns: Ns
    min_free_bytes: int = 0
    keeps_foreign: bool = True


class StoredFile(NamedTuple):
    """One file of a bag. Files that share an inode (device and number) take their space once.

    `size` is what the budget counts, `disk` what deleting it frees.
    """

    inode: tuple[int, int]
    size: int
    disk: int


class Span(NamedTuple):
    """The log times of the first and the last message (inclusive)."""

    start: Ns
    end: Ns


class StoredBag(NamedTuple):
    """A bag that may be deleted (a tuple: a week is 60,000 of them, weighed every few seconds).

    `span` leaves latched topics out, since each recording receives those again; None where the bag
    holds nothing else. `written` is when its file was last written to; `recording` is the
    directory that it lies in.
    """

    path: str
    recording: str
    span: Span | None
    written: Ns
    files: tuple[StoredFile, ...]


@dataclass(frozen=True, slots=True)
class RetentionStock:
    """All that lies in the bag directory because of this program.

    `sidecars` says, for each recording that goes with its last bag, how many bytes go with it.
    `other_bytes` is what nothing here may delete: open bags, and what is not worth deleting.
    `kept` are the files of moments, which nothing here deletes; bags may be other names of them.
    `foreign_bytes` is what bags of other programs take that are kept; no limit counts them.
    `free_bytes` is what the disk has left; None where that is not to count. `recorded_since` is by
    recording how long was recorded after it, by the monotonic clock (none where it is missing), and
    `synchronised` whether the system clock is.
    """

    bags: Sequence[StoredBag]
    now: Ns
    sidecars: Mapping[str, int] = field(default_factory=dict)
    other_bytes: int = 0
    free_bytes: int | None = None
    kept: Sequence[StoredFile] = ()
    recorded_since: Mapping[str, Ns] = field(default_factory=dict)
    synchronised: bool = False
    foreign_bytes: int = 0


class Ages(NamedTuple):
    """The bags that are too old by their dates, and by the time that was recorded after them."""

    by_dates: frozenset[str]
    by_recording: frozenset[str]

    def too_old(self, *, synchronised: bool) -> frozenset[str]:
        """Those that age deletes."""
        return self.by_dates if synchronised else self.by_recording

    def held(self, *, synchronised: bool) -> frozenset[str]:
        """Those that would go if the clock were known to be right."""
        return self.by_dates - self.too_old(synchronised=synchronised)


class DeletionPlan(NamedTuple):
    """What the limits say of a stock.

    `doomed` are the bags to delete, oldest first. `total_bytes` is what the budget counted, each
    file once; `fits` says whether the limits are kept when those bags are gone.
    """

    doomed: tuple[StoredBag, ...]
    total_bytes: int
    fits: bool


def expired(stock: RetentionStock, limits: RetentionLimits) -> tuple[StoredBag, ...]:
    """The bags to delete, oldest first: all that are too old, and no more than the budget needs."""
    return plan_deletions(stock, limits).doomed


def ages(stock: RetentionStock, limits: RetentionLimits) -> Ages:
    """The bags that are too old by either clock."""
    return _ages(stock, _eras(stock, limits), limits.max_age_ns)


def plan_deletions(stock: RetentionStock, limits: RetentionLimits) -> DeletionPlan:
    """The bags to delete, and what came of weighing them."""
    plan = _Plan(stock)
    total = plan.total
    eras = _eras(stock, limits)
    aged = _ages(stock, eras, limits.max_age_ns).too_old(synchronised=stock.synchronised)
    if not aged and plan.fits(limits):
        return DeletionPlan((), total, fits=True)
    order = _oldest_first(stock, limits, eras[-1] if eras else [], shared=plan.shared)
    # What shares a file with the bag that stays would free nothing.
    kept = _inodes(_newest(order, eras))
    doomed: set[str] = set()
    for bag in order:
        if bag.path in aged and kept.isdisjoint(_inodes(bag)):
            doomed.add(bag.path)
            plan.delete(bag)
    for bag in order:
        if plan.fits(limits):
            break
        if bag.path not in aged and kept.isdisjoint(_inodes(bag)) and plan.frees(bag):
            doomed.add(bag.path)
            plan.delete(bag)
    return DeletionPlan(
        tuple(bag for bag in order if bag.path in doomed), total, fits=plan.fits(limits)
    )


class _Plan:
    """What is left when some bags are deleted."""

    def __init__(self, stock: RetentionStock) -> None:
        files = [each for bag in stock.bags for each in bag.files]
        sizes = {each.inode: each.size for each in files}
        self.shared = len(sizes) < len(files)
        # What a moment keeps stays when every other name of it goes.
        self._kept = {each.inode for each in stock.kept}
        sizes.update((each.inode, each.size) for each in stock.kept)
        self._links = Counter(each.inode for each in files) if self.shared else Counter()
        self._bags_in = Counter(bag.recording for bag in stock.bags)
        self._sidecars = stock.sidecars
        self.total = stock.other_bytes + sum(sizes.values()) + sum(stock.sidecars.values())
        self._free = stock.free_bytes

    def delete(self, bag: StoredBag) -> None:
        """Leaves one bag out."""
        for each in bag.files:
            self._links[each.inode] -= 1
            if self._links[each.inode] <= 0 and each.inode not in self._kept:
                self._release(each.size, each.disk)
        self._bags_in[bag.recording] -= 1
        if not self._bags_in[bag.recording]:
            size = self._sidecars.get(bag.recording, 0)
            self._release(size, size)

    def frees(self, bag: StoredBag) -> bool:
        """Whether any of a bag's files could go for good."""
        return not self._kept or any(each.inode not in self._kept for each in bag.files)

    def fits(self, limits: RetentionLimits) -> bool:
        """Whether what is left is within the budget, and leaves enough of the disk."""
        enough = self._free is None or self._free >= limits.min_free_bytes
        return enough and self.total <= limits.max_total_bytes

    def _release(self, size: int, disk: int) -> None:
        self.total -= size
        if self._free is not None:
            self._free += disk


_Era: TypeAlias = "list[tuple[Span, StoredBag]]"


def _eras(stock: RetentionStock, limits: RetentionLimits) -> list[_Era]:
    """The dated bags, parted where a pause is too long; the last era is the present one."""
    longest = max(limits.max_age_ns, SHORTEST_PAUSE_NS)
    latest = stock.now + FUTURE_NS
    dated = [
        (bag.span, bag)
        for bag in stock.bags
        if bag.span is not None
        and bag.span.start >= FIRST_BAGS_NS
        and bag.span.end <= latest
        and bag.span.end - bag.span.start <= longest
    ]
    if not dated:
        return []
    reach, end = min(span.start for span, _ in dated), max(span.end for span, _ in dated)
    if end - reach <= longest:
        return [dated]
    dated.sort()
    eras: list[_Era] = [[]]
    for each in dated:
        span, _ = each
        if span.start - reach > longest:
            eras.append([])
        eras[-1].append(each)
        reach = max(reach, span.end)
    return eras


def _ages(stock: RetentionStock, eras: Sequence[_Era], max_age_ns: Ns) -> Ages:
    old = {name for name, since in stock.recorded_since.items() if since > max_age_ns}
    by_recording = (bag.path for bag in stock.bags if bag.recording in old) if old else ()
    by_dates = _aged(stock.bags, eras, max_age_ns)
    return Ages(frozenset(by_dates), frozenset(by_recording))


def _aged(bags: Sequence[StoredBag], eras: Sequence[_Era], max_age_ns: Ns) -> set[str]:
    """The bags that are too old for the newest of their era, if all dates are right.

    One that is not dated is of the present era if it was written in it, else of none.
    """
    aged: set[str] = set()
    dated = {bag.path for era in eras for _, bag in era}
    for era in eras:
        oldest = max(span.end for span, _ in era) - max_age_ns
        aged.update(bag.path for span, bag in era if span.end < oldest)
        if era is eras[-1]:
            begun = min(span.start for span, _ in era)
            undated = (bag for bag in bags if bag.path not in dated)
            aged.update(bag.path for bag in undated if begun <= bag.written < oldest)
    return aged


def _oldest_first(
    stock: RetentionStock, limits: RetentionLimits, present: _Era, *, shared: bool
) -> list[StoredBag]:
    """All bags, oldest first.

    One that shares a file is as old as the newest that does: deleting it frees nothing before.
    """
    moments = {bag.path: _written(bag, stock.now, limits) for bag in stock.bags}
    moments.update((bag.path, (span.end, span.end)) for span, bag in present)
    if shared:
        newest: dict[tuple[int, int], tuple[Ns, Ns]] = {}
        for bag in stock.bags:
            moment = moments[bag.path]
            for each in bag.files:
                newest[each.inode] = max(moment, newest.get(each.inode, moment))
        moments = {bag.path: max(newest[each.inode] for each in bag.files) for bag in stock.bags}
    return sorted(stock.bags, key=lambda bag: (moments[bag.path], bag.path))


def _written(bag: StoredBag, now: Ns, limits: RetentionLimits) -> tuple[Ns, Ns]:
    """What orders a bag by its file; the second number orders those of which the first is made up.

    While the clock is behind by less than history is kept, the dates of files still order them.
    """
    if now < FIRST_BAGS_NS:
        return (MAX_NS if bag.written < FIRST_BAGS_NS else bag.written), bag.written
    longest = max(limits.max_age_ns, SHORTEST_PAUSE_NS)
    return (MIN_NS if bag.written > now + longest else bag.written), bag.written


def _newest(order: Sequence[StoredBag], eras: Sequence[_Era]) -> StoredBag | None:
    """The bag that stays: the newest dated one, else the last written that holds anything."""
    if eras:
        return max(eras[-1], key=lambda each: (each[0].end, each[1].path))[1]
    holding = [bag for bag in order if bag.span is not None] or order
    return holding[-1] if holding else None


def _inodes(bag: StoredBag | None) -> set[tuple[int, int]]:
    return set() if bag is None else {each.inode for each in bag.files}
