"""Decides which bags are deleted: those too old, then the oldest beyond the budget. Pure.

Age deletes only by a clock that is known to be right. If the system clock is synchronised, dates
count; else the monotonic clock does: a bag is too old when more than `max_age_ns` has been recorded
after it. A bag that only its dates make too old is held. Where the clock was not known to be right
when a bag was recorded, its dates never make it old: the monotonic clock alone does.

Age deletes no bag that rules may still need, nor, if bags must be shipped, one that is in no lake.
The budget and the disk do, the oldest first as ever.

By dates, age counts from the newest recorded data, not from the wall clock: a robot that was
switched off does not erase itself when it wakes. Clocks step, so not every date is believed:

- A bag dated in the future, before there was ROS 2, or longer than any recording counts as
  undated: it makes no other bag old, and is itself as old as its file.
- A pause longer than both `max_age_ns` and a day is a robot that was off or a clock that was set,
  and nothing distinguishes the two. It separates two periods; a bag ages only against its own.
- Where no bag is believed, as in simulated time, all are dated by their files.
- Nothing is older than what was recorded before it: a bag that is dated before the newest of an
  earlier recording, whose dates are not in doubt, has a wrong date, and counts as recorded with
  the next that has a right one, in its own recording or a later one.
  In the same way, no more was recorded after a recording than after one that was listed before it.

The budget deletes the oldest first. The recorder's recordings are in the order in which they were
listed as they began, whatever their dates. Bags that were adopted lie between them by dates: a
dated bag of the present period by its newest message, any other by the time of its file. A file
dated further ahead of now than history is kept goes first, since its time means nothing and it
would otherwise stay for good. A file dated before there was ROS 2, while the clock is there as
well, goes last. The newest bag always stays.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import accumulate
from operator import attrgetter
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from ros2_memory.bag_dir.layout import split_number
from ros2_memory.core.timebase import FUTURE_NS, MAX_NS, MIN_NS, NS_PER_DAY, NS_PER_HOUR, Ns
from ros2_memory.index.clock_faults import FIRST_BAGS_NS

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

SMALL_BUDGET_GB: Final = 0.1
"""The files beside the bags may take a large part of a smaller budget."""
GB: Final = 10**9
"""Bytes of a gigabyte, as configuration keys that end in `_gb` count them."""
SHORTEST_PAUSE_NS: Final[Ns] = NS_PER_DAY
"""A shorter pause never parts two periods, however little history is kept."""


def small_budget(max_total_gb: float) -> str:
    """Returns the warning about a budget below `SMALL_BUDGET_GB`."""
    return (
        f"retention.max_total_gb={max_total_gb:g} is less than {SMALL_BUDGET_GB:g}: what is stored "
        "beside the bags counts, too, and may take a large part of it"
    )


@dataclass(frozen=True, slots=True)
class RetentionLimits:
    """The limits of retention: total bytes, maximum age, and minimum free disk space.

    `keeps_foreign`: bags that the recorder did not make are never deleted, and do not count.
    `require_shipped`: age deletes no bag before it is in a lake.
    """

    max_total_bytes: int
    max_age_ns: Ns
    min_free_bytes: int = 0
    keeps_foreign: bool = True
    require_shipped: bool = False

    @property
    def longest_pause_ns(self) -> Ns:
        """A longer pause parts two periods, and no recording is longer."""
        return max(self.max_age_ns, SHORTEST_PAUSE_NS)


class StoredFile(NamedTuple):
    """One file of a bag, by its inode (device and number); `size` is what the budget counts."""

    inode: tuple[int, int]
    size: int


class StoredBag(NamedTuple):
    """A bag that may be deleted. One flat tuple, since a week has 60,000, judged every few seconds.

    `start` and `end` are the log times of its first and last message (inclusive). They leave
    latched topics out, since each recording receives those again: a bag that contains nothing else
    ends before it starts. `written` is when its file was last modified; `recording` is the
    directory that it lies in, relative to the bag directory. `device` to `size` are its file, see
    `StoredFile`; `second` is its other form, if that lies there as well.
    """

    path: str
    recording: str
    start: Ns
    end: Ns
    written: Ns
    device: int
    inode: int
    size: int
    second: StoredFile | None = None

    @property
    def has_dates(self) -> bool:
        """Whether it has messages by which it can be dated."""
        return self.start <= self.end

    @property
    def date(self) -> Ns:
        """The log time of the last message that dates it, else when its file was written."""
        return self.end if self.has_dates else self.written

    @property
    def hour(self) -> int:
        """The hour of its date, counted from the epoch."""
        return self.date // NS_PER_HOUR

    def dated(self, at: Ns) -> StoredBag:
        """Returns it with another date."""
        return self._replace(start=at, end=at) if self.has_dates else self._replace(written=at)

    @property
    def files(self) -> tuple[StoredFile, ...]:
        """All forms of it."""
        first = StoredFile((self.device, self.inode), self.size)
        return (first,) if self.second is None else (first, self.second)


@dataclass(frozen=True, slots=True)
class DirContents:
    """Everything that this program wrote to the bag directory.

    Attributes:
        bags: the bags that may be deleted.
        other_bytes: the bytes of all else that counts: open bags, and files beside bags.
        free_bytes: free disk space; None if that does not count.
        saved: the sizes of the files of moments, by inode (device and number), which are never
            deleted; bags may be other names of them.
        recorded_since: how long was recorded after each recording, by the monotonic clock; a
            recording that is missing counts as new.
        doubtful: the recordings whose dates are not known to be right.
        foreign_bytes: the size of bags of other programs, which no limit counts.
        state_bytes: how much of `other_bytes` is no recording: `.episodic` and logs.
        places: the place of each recording in the list of the recorder's own; a missing recording
            was adopted, and its order is unknown.
        needed: bags that rules may still need; no age deletes them.
        unshipped: bags that must be shipped, and are in no lake; no age deletes them.
    """

    bags: Sequence[StoredBag]
    now: Ns
    other_bytes: int = 0
    free_bytes: int | None = None
    saved: Mapping[tuple[int, int], int] = field(default_factory=dict)
    recorded_since: Mapping[str, Ns] = field(default_factory=dict)
    doubtful: frozenset[str] = frozenset()
    synchronised: bool = False
    foreign_bytes: int = 0
    state_bytes: int = 0
    places: Mapping[str, int] = field(default_factory=dict)
    needed: frozenset[str] = frozenset()
    unshipped: frozenset[str] = frozenset()


class DeletionPlan(NamedTuple):
    """The deletions that the limits require.

    `to_delete` has the oldest bag first. `total_bytes` is what the budget counted, each file once.
    `fits`: whether the limits are kept once those bags are deleted. `most_free` is set where even
    deleting all bags would not free enough of the disk: the bytes that would be free then. No bag
    is deleted for the disk in that case.
    """

    to_delete: tuple[StoredBag, ...]
    total_bytes: int
    fits: bool
    most_free: int | None = None


class AgedBags(NamedTuple):
    """The paths of the bags that are too old, if the system clock is synchronised and if not."""

    if_synchronised: frozenset[str]
    if_unsynchronised: frozenset[str]

    def by_clock(self, *, synchronised: bool) -> frozenset[str]:
        """Returns the bags that are too old by the clock as it is."""
        return self.if_synchronised if synchronised else self.if_unsynchronised


def bags_older_than(contents: DirContents, limits: RetentionLimits, max_age_ns: Ns) -> AgedBags:
    """Returns the bags older than `max_age_ns`; `limits` say which pauses and dates are wrong."""
    contents = _with_consistent_dates(contents, limits)
    return _aged_bags(contents, _periods(contents, limits), max_age_ns)


def plan_deletions(
    contents: DirContents, limits: RetentionLimits, *, whole_hours: bool = False
) -> DeletionPlan:
    """Plans which bags to delete: all that are too old, then no more than the limits need.

    Where deleting all bags would not free enough of the disk, none is deleted for the disk: that
    would cost all history, and recording would still have to pause.

    With `whole_hours`, age waits until all bags of an hour are too old, and to make room the rest
    of an hour goes, too, but for the hour of the newest bag. Bags that no age deletes neither go
    with an hour nor keep it. Where the clock is set back, another hour begins.
    """
    dated = _with_consistent_dates(contents, limits)
    periods = _periods(dated, limits)
    by_age = _aged_bags(dated, periods, limits.max_age_ns)
    aged = by_age.by_clock(synchronised=contents.synchronised)
    left = _Remaining(contents)
    total = left.total
    if not aged and left.fits(limits):
        return DeletionPlan((), total, fits=True)
    order = _oldest_first(contents, dated, limits, periods[-1] if periods else [])
    newest = _newest_path(order, contents, periods)
    hours = _split_by_hour(order) if whole_hours else []
    needed = contents.needed | contents.unshipped
    order = [bag for bag in order if bag.path != newest]
    if whole_hours:
        goes_or_is_ageless = aged | needed | {newest}
        aged &= set[str]().union(*(hour for hour in hours if hour <= goes_or_is_ageless))
    left.delete_until_fits(order, aged, limits)
    most_free = None
    if left.free is not None and left.free < limits.min_free_bytes:
        most_free = left.free
        left = _Remaining(replace(contents, free_bytes=None))
        left.delete_until_fits(order, aged, limits)
    going, for_room = left.deleted, left.deleted - aged
    for hour in hours:
        if newest not in hour and not hour.isdisjoint(for_room):
            going |= hour - needed
    return DeletionPlan(
        tuple(bag for bag in order if bag.path in going),
        total,
        fits=most_free is None and left.fits(limits),
        most_free=most_free,
    )


def _newest_path(
    order: Sequence[StoredBag], contents: DirContents, periods: Sequence[_Period]
) -> str:
    """Returns the path of the bag that always stays, or "" if there is none.

    It is the last one with messages: of the recorder's own, else of the present period, else by
    `order`. If no bag has messages, it is the last of `order`.
    """
    with_messages = [bag for bag in order if bag.has_dates]
    own = [bag for bag in with_messages if bag.recording in contents.places]
    if own:
        return own[-1].path
    if periods:
        return max(periods[-1], key=attrgetter("end", "path")).path
    candidates = with_messages or order
    return candidates[-1].path if candidates else ""


def _split_by_hour(order: Sequence[StoredBag]) -> list[set[str]]:
    """Returns the paths of bags by hour; another begins where the clock was set back, too."""
    hours: list[set[str]] = []
    before: StoredBag | None = None
    for bag in order:
        if before is None or bag.hour != before.hour or bag.date < before.date:
            hours.append(set())
        hours[-1].add(bag.path)
        before = bag
    return hours


class _Remaining:
    """Counts the bytes that are left and free while bags are deleted.

    Attributes:
        total: the bytes that the budget counts.
        free: the free bytes of the disk; None if they do not count.
        deleted: the paths of the deleted bags.
    """

    def __init__(self, contents: DirContents) -> None:
        # A file counts once, and stays while it has another name, as in a moment.
        self._saved = contents.saved
        files = [file for bag in contents.bags for file in bag.files]
        self._names = Counter([*contents.saved, *(file.inode for file in files)])
        self.total = contents.other_bytes + sum({**dict(files), **contents.saved}.values())
        self.free = contents.free_bytes
        self.deleted: set[str] = set()

    def delete_until_fits(
        self, order: Sequence[StoredBag], aged: Collection[str], limits: RetentionLimits
    ) -> None:
        """Deletes the bags that are too old, then others in `order` until the limits are kept."""
        for bag in order:
            if bag.path in aged:
                self._delete(bag)
        for bag in order:
            if self.fits(limits):
                break
            is_saved = self._saved.keys() >= {file.inode for file in bag.files}
            if bag.path not in self.deleted and not is_saved:
                self._delete(bag)

    def fits(self, limits: RetentionLimits) -> bool:
        """Whether what is left is within the budget, and leaves enough of the disk."""
        enough = self.free is None or self.free >= limits.min_free_bytes
        return enough and self.total <= limits.max_total_bytes

    def _delete(self, bag: StoredBag) -> None:
        self._names.subtract(file.inode for file in bag.files)
        freed = sum(file.size for file in bag.files if not self._names[file.inode])
        self.total -= freed
        if self.free is not None:
            self.free += freed
        self.deleted.add(bag.path)


def _with_consistent_dates(contents: DirContents, limits: RetentionLimits) -> DirContents:
    """Returns the contents with dates and ages that agree with the order of the recordings.

    If no bag has a credible date, each one gets that of its file first. Then a bag dated before the
    newest message of an earlier recording that is not in doubt gets another date, see
    `_replacement_dates`.
    """
    credible = _credibly_dated(contents, limits)
    if not credible:
        contents = replace(contents, bags=[bag.dated(bag.written) for bag in contents.bags])
        credible = _credibly_dated(contents, limits)
    if not contents.places:
        return contents
    names = sorted(contents.places, key=contents.places.__getitem__)
    sure = contents.places.keys() - contents.doubtful
    newest: dict[str, Ns] = {}
    for bag in credible:
        if bag.recording in sure:
            newest[bag.recording] = max(bag.end, newest.get(bag.recording, MIN_NS))
    newest_in_order = [newest.get(name, MIN_NS) for name in names]
    earliest = dict(zip(names, accumulate([MIN_NS, *newest_in_order], max), strict=False))
    replacements = _replacement_dates(contents, credible, earliest)
    bags = [
        bag.dated(replacements[bag.path]) if bag.path in replacements else bag
        for bag in contents.bags
    ]
    return replace(
        contents, bags=bags, recorded_since=_never_rising(contents.recorded_since, names)
    )


def _replacement_dates(
    contents: DirContents, credible: Sequence[StoredBag], earliest: Mapping[str, Ns]
) -> dict[str, Ns]:
    """Returns the dates of the wrongly dated bags, by path.

    Each is the date of the next recorded bag that is not dated before `earliest`; if there is none,
    the newest date of all.
    """
    wrong = [bag for bag in contents.bags if bag.date < earliest.get(bag.recording, MIN_NS)]
    if not wrong:
        return {}
    wrong_paths = {bag.path for bag in wrong}
    believed = [bag for bag in credible if bag.recording in contents.places]
    right = [bag for bag in believed if bag.path not in wrong_paths]
    dates: dict[str, Ns] = {}
    date = max(bag.end for bag in believed)
    recorded = sorted((*wrong, *right), key=partial(_recorded_order, places=contents.places))
    for bag in reversed(recorded):
        if bag.path in wrong_paths:
            dates[bag.path] = date
        else:
            date = bag.end
    return dates


def _recorded_order(bag: StoredBag, places: Mapping[str, int]) -> tuple[int, int, Ns]:
    """Returns the sort key of a bag by when it was recorded: dates say least."""
    number = split_number(bag.recording, bag.path.rpartition("/")[2])
    return places[bag.recording], MAX_NS if number is None else number, bag.date


def _never_rising(recorded_since: Mapping[str, Ns], names: Sequence[str]) -> dict[str, Ns]:
    """Returns how long was recorded after each recording: never more than after an earlier one."""
    known = [name for name in names if name in recorded_since]
    least = accumulate((recorded_since[name] for name in known), min)
    return {**recorded_since, **dict(zip(known, least, strict=True))}


_Period: TypeAlias = "list[StoredBag]"


def _periods(contents: DirContents, limits: RetentionLimits) -> list[_Period]:
    """Splits the dated bags where a pause is too long; the last period is the present one."""
    periods: list[_Period] = []
    reach = MIN_NS
    for bag in sorted(_credibly_dated(contents, limits), key=attrgetter("start")):
        if not periods or bag.start - reach > limits.longest_pause_ns:
            periods.append([])
        periods[-1].append(bag)
        reach = max(reach, bag.end)
    return periods


def _credibly_dated(contents: DirContents, limits: RetentionLimits) -> list[StoredBag]:
    """Returns the bags whose dates are believed."""
    longest, latest = limits.longest_pause_ns, contents.now + FUTURE_NS
    return [
        bag
        for bag in contents.bags
        if FIRST_BAGS_NS <= bag.start <= bag.end <= latest and bag.end - bag.start <= longest
    ]


def _aged_bags(contents: DirContents, periods: Sequence[_Period], max_age_ns: Ns) -> AgedBags:
    """Returns the bags that are too old. Doubtful dates never make a bag old, recorded time does.

    Without a synchronised clock recorded time alone decides.
    """
    old_recordings = {name for name, since in contents.recorded_since.items() if since > max_age_ns}
    by_dates = _aged_by_dates(contents, periods, max_age_ns)
    stays = contents.needed | contents.unshipped
    by_recorded_time = frozenset(
        bag.path
        for bag in contents.bags
        if bag.recording in old_recordings and bag.path not in stays
    )
    doubtful = {bag.path for bag in contents.bags if bag.recording in contents.doubtful}
    if_synchronised = (by_recorded_time & doubtful) | (by_dates - doubtful - stays)
    return AgedBags(if_synchronised, by_recorded_time)


def _aged_by_dates(contents: DirContents, periods: Sequence[_Period], max_age_ns: Ns) -> set[str]:
    """Returns the bags that end more than `max_age_ns` before the newest of their period.

    Dates in the future, of a clock that was ahead for a while, make no other bag older.
    An undated bag belongs to the present period if it was written in it, else to none.
    """
    aged: set[str] = set()
    for period in periods:
        cutoff = min(max(bag.end for bag in period), contents.now) - max_age_ns
        aged.update(bag.path for bag in period if bag.end < cutoff)
        if period is periods[-1]:
            begun = min(bag.start for bag in period)
            undated = _outside_periods(contents.bags, *periods)
            aged.update(bag.path for bag in undated if begun <= bag.written < cutoff)
    return aged


def _oldest_first(
    contents: DirContents, dated: DirContents, limits: RetentionLimits, present: _Period
) -> list[StoredBag]:
    """Returns all bags with their own dates, oldest first; `dated` has them with consistent ones.

    Adopted bags take their places by date. The recorder's bags fill the places between in the order
    of their recordings.
    """
    places = contents.places
    undated = _outside_periods(dated.bags, present)
    keys = {bag.path: _file_time_key(bag, contents.now, limits) for bag in undated}
    by_date = sorted(
        dated.bags, key=lambda bag: (*keys.get(bag.path, (bag.end, bag.end)), bag.path)
    )
    recorded = sorted(
        (bag for bag in contents.bags if bag.recording in places),
        key=lambda bag: (places[bag.recording], bag.date, bag.path),
    )
    next_recorded = iter(recorded)
    by_path = {bag.path: bag for bag in contents.bags}
    return [
        next(next_recorded) if bag.recording in places else by_path[bag.path] for bag in by_date
    ]


def _outside_periods(bags: Sequence[StoredBag], *periods: _Period) -> Sequence[StoredBag]:
    """Returns the bags that are in none of the periods."""
    there = {bag.path for period in periods for bag in period}
    return [bag for bag in bags if bag.path not in there]


def _file_time_key(bag: StoredBag, now: Ns, limits: RetentionLimits) -> tuple[Ns, Ns]:
    """Returns the sort key of a bag by the time of its file.

    The first number may be made up; then the second orders the bags. While the clock is behind by
    less than history is kept, the times of files still order them.
    """
    if now < FIRST_BAGS_NS:
        return (MAX_NS if bag.written < FIRST_BAGS_NS else bag.written), bag.written
    is_ahead = bag.written > now + limits.longest_pause_ns
    return (MIN_NS if is_ahead else bag.written), bag.written
