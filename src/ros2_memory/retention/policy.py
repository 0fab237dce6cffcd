"""Decides which bags are deleted: those too old, then the oldest beyond the budget. Pure.

Age deletes only by a clock that is known to be right. If the system clock is synchronised, dates
count; else the monotonic clock does: a bag is too old when more than `max_age_ns` has been recorded
after it. A bag that only its dates make too old is held. Where the clock was not known to be right
when a bag was recorded, its dates never make it old: the monotonic clock alone does.

Nor does age delete what rules may still need, or, where bags must be shipped, what is in no lake.
The budget and the disk do, the oldest first as ever.

By dates, age counts from the newest recorded data, not from the wall clock: a robot that was
switched off does not erase itself when it wakes. Clocks step, so not every date is believed:

- A bag dated in the future, before there was ROS 2, or longer than any recording counts as
  undated: it makes no other bag old, and is itself as old as its file.
- A pause longer than both `max_age_ns` and a day is a robot that was off or a clock that was set,
  and nothing distinguishes the two. It separates two periods; a bag ages only against its own.
- Where no bag is believed, as in simulated time, all are dated by their files.
- Nothing is older than what was recorded before it: a bag that is dated before the newest of an
  earlier recording has a wrong date, and counts as recorded with the next that has a right one.
  Likewise no more was recorded after a recording than after any that was listed before it.

The budget deletes the oldest first. The recorder's recordings are in the order in which they were
listed as they began, whatever their dates. Bags that were adopted lie between them by dates: a
dated bag of the present period by its newest message, any other by the time of its file. A file
dated further ahead of now than history is kept goes first, since its time means nothing and it
would otherwise stay for good. A file dated before there was ROS 2, while the clock is there as
well, goes last. The newest bag always stays.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from ros2_memory.core.timebase import FUTURE_NS, MAX_NS, MIN_NS, NS_PER_S, Ns
from ros2_memory.index.clock_faults import FIRST_BAGS_NS

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

SMALL_BUDGET_GB: Final = 0.1
"""Of a smaller budget, what is stored beside the bags may take a large part."""
GB: Final = 10**9
"""Bytes of a gigabyte, as configuration keys that end in `_gb` count them."""
HOUR_NS: Final[Ns] = 3600 * NS_PER_S
SHORTEST_PAUSE_NS: Final[Ns] = 24 * 3600 * NS_PER_S
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


class StoredFile(NamedTuple):
    """One file of a bag, by its inode (device and number); `size` is what the budget counts."""

    inode: tuple[int, int]
    size: int


class StoredBag(NamedTuple):
    """A bag that may be deleted. One flat tuple, since a week has 60,000, judged every few seconds.

    `start` and `end` are the log times of its first and last message (inclusive). They leave
    latched topics out, since each recording receives those again: a bag that contains nothing else
    ends before it starts. `written` is when its file was last modified; `recording` is the
    directory that it lies in. `device` to `size` are its file, see `StoredFile`; `second` is its
    other form, if that lies there as well.
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
        return self.date // HOUR_NS

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
        bags: those that may be deleted.
        other_bytes: all else that counts: open bags, and what goes with a recording's last bag.
        free_bytes: free disk space; None if that does not count.
        saved: the sizes of the files of moments, by inode (device and number), which are never
            deleted; bags may be other names of them.
        recorded_since: how long was recorded after each recording, by the monotonic clock; a
            recording that is missing counts as new.
        doubtful: the recordings whose dates are not known to be right.
        foreign_bytes: the size of bags of other programs, which no limit counts.
        state_bytes: how much of `other_bytes` is no recording: `.episodic` and logs.
        places: the place of each recording in the list of those that the recorder made; one that
            is missing was adopted, and its order is unknown.
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
    `fits`: whether the limits are kept once those bags are deleted. `most_free`: how much of the
    disk would be free if all bags were deleted that may be, where that is too little; then none is
    deleted for it.
    """

    to_delete: tuple[StoredBag, ...]
    total_bytes: int
    fits: bool
    most_free: int | None = None


def too_old(
    contents: DirContents, limits: RetentionLimits, max_age_ns: Ns
) -> dict[bool, frozenset[str]]:
    """Returns the bags older than `max_age_ns`.

    Under True are those that count as older if the clock is synchronised, under False if it is not.
    What a pause and a wrong date are is judged by `limits`.
    """
    contents = _with_consistent_dates(contents, limits)
    return _too_old(contents, _periods(contents, limits), max_age_ns)


def plan_deletions(
    contents: DirContents, limits: RetentionLimits, *, whole_hours: bool = False
) -> DeletionPlan:
    """Plans which bags to delete: all that are too old, then no more than the limits need.

    Where deleting everything that may go would not free enough of the disk, nothing is deleted for
    that: it would cost all history, and recording would still have to pause.

    With `whole_hours`, age waits until all bags of an hour are too old, and to make room the rest
    of an hour goes, too, but for the hour of the newest bag. Bags that no age deletes neither go
    with an hour nor keep it. Where the clock is set back, another hour begins.
    """
    left, dated = _Remaining(contents), _with_consistent_dates(contents, limits)
    total, periods, most_free = left.total, _periods(dated, limits), None
    aged = _too_old(dated, periods, limits.max_age_ns)[contents.synchronised]
    if not aged and left.fits(limits):
        return DeletionPlan((), total, fits=True)
    order = _oldest_first(contents, dated, limits, periods[-1] if periods else [])
    newest = _newest(order, contents, periods)
    hours = _hours(order)
    order = [bag for bag in order if bag.path != newest]
    if whole_hours:
        aged = _of_whole_hours(aged, hours, contents, newest)
    going = left.delete_until_fits(order, aged, limits)
    if left.free is not None and left.free < limits.min_free_bytes:
        most_free = left.free
        left = _Remaining(replace(contents, free_bytes=None))
        going = left.delete_until_fits(order, aged, limits)
    if whole_hours:
        going |= _rest_of_hours(going - aged, hours, contents, newest)
    return DeletionPlan(
        tuple(bag for bag in order if bag.path in going),
        total,
        fits=most_free is None and left.fits(limits),
        most_free=most_free,
    )


def _newest(order: Sequence[StoredBag], contents: DirContents, periods: Sequence[_Period]) -> str:
    """Returns the bag that stays: the last recorded, else dated, else written, with messages."""
    with_messages = [bag for bag in order if bag.has_dates]
    listed = [bag.path for bag in with_messages if bag.recording in contents.places]
    if periods and not listed:
        return max(periods[-1], key=attrgetter("end", "path")).path
    return next(reversed(listed or [bag.path for bag in with_messages or order]), "")


def _hours(order: Sequence[StoredBag]) -> list[_Period]:
    """Splits the bags in order where another hour begins, or a clock that was set back."""
    hours: list[_Period] = []
    for bag in order:
        before = hours[-1][-1] if hours else None
        if before is None or bag.hour != before.hour or bag.date < before.date:
            hours.append([])
        hours[-1].append(bag)
    return hours


def _of_whole_hours(
    aged: frozenset[str], hours: Sequence[_Period], contents: DirContents, newest: str
) -> frozenset[str]:
    """Returns the bags that are too old in hours of which all are, but for those that stay."""
    stays = aged | contents.needed | contents.unshipped | {newest}
    old = (hour for hour in hours if all(bag.path in stays for bag in hour))
    return frozenset(bag.path for hour in old for bag in hour) & aged


def _rest_of_hours(
    going: set[str], hours: Sequence[_Period], contents: DirContents, newest: str
) -> set[str]:
    """Returns the bags of the hours in which some go to make room, but for those that stay."""
    paths = ({bag.path for bag in hour} for hour in hours)
    rest = [hour for hour in paths if newest not in hour and not going.isdisjoint(hour)]
    return set().union(*rest) - contents.needed - contents.unshipped


class _Remaining:
    """Counts what is left when some bags are deleted."""

    def __init__(self, contents: DirContents) -> None:
        # A file of a moment counts once, and stays when its other name is deleted.
        self._saved = contents.saved
        bags = sum(map(self.freed_by, contents.bags))
        self.total = contents.other_bytes + sum(contents.saved.values()) + bags
        self.free = contents.free_bytes

    def freed_by(self, bag: StoredBag) -> int:
        """Returns how many bytes deleting a bag frees."""
        return sum(file.size for file in bag.files if file.inode not in self._saved)

    def delete_until_fits(
        self, order: Sequence[StoredBag], aged: Collection[str], limits: RetentionLimits
    ) -> set[str]:
        """Takes away the bags that are too old, then others in this order; returns their paths."""
        going = {bag.path for bag in order if bag.path in aged}
        for bag in order:
            if bag.path in going:
                self._delete(bag)
        for bag in order:
            if self.fits(limits):
                break
            if bag.path not in going and self.freed_by(bag):
                self._delete(bag)
                going.add(bag.path)
        return going

    def _delete(self, bag: StoredBag) -> None:
        freed = self.freed_by(bag)
        self.total -= freed
        self.free = None if self.free is None else self.free + freed

    def fits(self, limits: RetentionLimits) -> bool:
        """Whether what is left is within the budget, and leaves enough of the disk."""
        enough = self.free is None or self.free >= limits.min_free_bytes
        return enough and self.total <= limits.max_total_bytes


def _with_consistent_dates(contents: DirContents, limits: RetentionLimits) -> DirContents:
    """Returns the contents without ages that contradict the order of the recordings.

    A bag whose date does, by its messages or else by its file, gets the newest date of the next
    recording that has a right one; of the newest of all, if there is none. If no bag has a right
    one, all get those of their files first.
    """
    believed = _credibly_dated(contents, limits)
    if not believed:
        contents = replace(contents, bags=[bag.dated(bag.written) for bag in contents.bags])
        believed = _credibly_dated(contents, limits)
    if not contents.places:
        return contents
    newest: dict[str, Ns] = {}
    for bag in believed:
        newest[bag.recording] = max(bag.end, newest.get(bag.recording, MIN_NS))
    names = sorted(contents.places, key=contents.places.__getitem__)
    since, least = {**contents.recorded_since}, MAX_NS
    reached, latest = dict[str, Ns](), MIN_NS
    for name in names:
        reached[name] = latest  # by the recordings before it
        latest = max(latest, newest.get(name, MIN_NS))
        if name in since:
            least = since[name] = min(least, since[name])
    instead: dict[str, Ns] = {}
    for name in reversed(names):
        if reached[name] <= newest.get(name, MIN_NS):
            latest = newest.get(name, latest)
        instead[name] = latest
    bags = [
        bag.dated(instead[bag.recording]) if bag.date < reached.get(bag.recording, MIN_NS) else bag
        for bag in contents.bags
    ]
    return replace(contents, bags=bags, recorded_since=since)


_Period: TypeAlias = "list[StoredBag]"


def _periods(contents: DirContents, limits: RetentionLimits) -> list[_Period]:
    """Splits the dated bags where a pause is too long; the last period is the present one."""
    longest = max(limits.max_age_ns, SHORTEST_PAUSE_NS)
    periods: list[_Period] = []
    reach = MIN_NS
    for bag in sorted(_credibly_dated(contents, limits), key=attrgetter("start")):
        if not periods or bag.start - reach > longest:
            periods.append([])
        periods[-1].append(bag)
        reach = max(reach, bag.end)
    return periods


def _credibly_dated(contents: DirContents, limits: RetentionLimits) -> list[StoredBag]:
    """Returns the bags whose dates are believed."""
    longest = max(limits.max_age_ns, SHORTEST_PAUSE_NS)
    latest = contents.now + FUTURE_NS
    return [
        bag
        for bag in contents.bags
        if FIRST_BAGS_NS <= bag.start <= bag.end <= latest and bag.end - bag.start <= longest
    ]


def _too_old(
    contents: DirContents, periods: Sequence[_Period], max_age_ns: Ns
) -> dict[bool, frozenset[str]]:
    old = {name for name, since in contents.recorded_since.items() if since > max_age_ns}
    by_recording = frozenset(bag.path for bag in contents.bags if bag.recording in old)
    doubtful = {bag.path for bag in contents.bags if bag.recording in contents.doubtful}
    by_dates = frozenset(_too_old_by_dates(contents, periods, max_age_ns)) - doubtful
    stays = contents.needed | contents.unshipped
    return {True: (by_dates | by_recording & doubtful) - stays, False: by_recording - stays}


def _too_old_by_dates(
    contents: DirContents, periods: Sequence[_Period], max_age_ns: Ns
) -> set[str]:
    """Returns the bags that are too old compared with the newest of their period, by their dates.

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
    """Sorts all bags, oldest first; `dated` has them with consistent dates."""
    odd = _outside_periods(dated.bags, present)
    keys = {bag.path: _file_time_key(bag, contents.now, limits) for bag in odd}
    by_date = sorted(
        dated.bags, key=lambda bag: (*keys.get(bag.path, (bag.end, bag.end)), bag.path)
    )
    given, places = {bag.path: bag for bag in contents.bags}, contents.places
    listed = (bag for bag in contents.bags if bag.recording in places)
    recorded = iter(sorted(listed, key=lambda bag: (places[bag.recording], bag.date, bag.path)))
    return [next(recorded) if bag.recording in places else given[bag.path] for bag in by_date]


def _outside_periods(bags: Sequence[StoredBag], *periods: _Period) -> Sequence[StoredBag]:
    """Returns the bags that are in none of some periods."""
    there = {bag.path for period in periods for bag in period}
    return [bag for bag in bags if bag.path not in there]


def _file_time_key(bag: StoredBag, now: Ns, limits: RetentionLimits) -> tuple[Ns, Ns]:
    """Returns the sort key of a bag by the time of its file.

    The first number may be made up; then the second orders the bags. While the clock is behind by
    less than history is kept, the times of files still order them.
    """
    if now < FIRST_BAGS_NS:
        return (MAX_NS if bag.written < FIRST_BAGS_NS else bag.written), bag.written
    longest = max(limits.max_age_ns, SHORTEST_PAUSE_NS)
    return (MIN_NS if bag.written > now + longest else bag.written), bag.written
