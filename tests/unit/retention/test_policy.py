import zlib
from collections.abc import Callable, Iterable
from dataclasses import replace

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from ros2_memory.core.timebase import MAX_NS, MIN_NS
from ros2_memory.retention.policy import (
    DeletionPlan,
    DirContents,
    RetentionLimits,
    StoredBag,
    StoredFile,
    plan_deletions,
)

S = 10**9
HOUR = 3600 * S
DAY = 24 * HOUR
NOW = 1_790_000_000 * S
PLENTY = 10**15
LIMITS = RetentionLimits(max_total_bytes=PLENTY, max_age_ns=168 * HOUR)


def bag(
    name: str,
    end: int | None,
    *,
    size: int = 10,
    written: int | None = None,
    recording: str = "rec",
    length: int = 10 * S,
    inode: int | None = None,
) -> StoredBag:
    """A bag whose last message is at `end`; without messages where that is None."""
    span = (MAX_NS, MIN_NS) if end is None else (end - length, end)
    at = written if written is not None else end or NOW
    number = zlib.crc32(name.encode()) if inode is None else inode
    return StoredBag(f"{recording}/{name}", recording, *span, at, 1, number, size)


def sizes(files: Iterable[StoredFile]) -> dict[tuple[int, int], int]:
    return {file.inode: file.size for file in files}


def bytes_of(bags: Iterable[StoredBag], *others: StoredFile) -> int:
    """What the files of bags take, and others, each once."""
    return sum(sizes((*others, *(file for bag in bags for file in bag.files))).values())


def contents(*bags: StoredBag, now: int = NOW) -> DirContents:
    return DirContents(bags, now, synchronised=True)


def expired(contents: DirContents, limits: RetentionLimits) -> tuple[StoredBag, ...]:
    return plan_deletions(contents, limits).to_delete


def by_hours(contents: DirContents, limits: RetentionLimits) -> DeletionPlan:
    return plan_deletions(contents, limits, whole_hours=True)


def names(bags: Iterable[StoredBag]) -> list[str]:
    return [each.path.rpartition("/")[2] for each in bags]


def hourly(hours: int, *, until: int = NOW) -> list[StoredBag]:
    """One bag every hour, h0 the newest."""
    return [bag(f"h{ago}", until - ago * HOUR) for ago in range(hours)]


def test_whole_hours_go_to_make_room_but_for_what_is_needed_and_the_newest_hour() -> None:
    minutes = [bag(f"m{ago}", NOW - ago * 60 * S) for ago in range(200)]
    held = replace(contents(*minutes), needed=frozenset({"rec/m170", "rec/m199"}))
    going = set(names(by_hours(held, budget(1900)).to_delete))
    assert set(names(expired(held, budget(1900)))) <= going
    assert "m170" not in going
    first = min(int(name[1:]) for name in going)
    left = {each.path for each in minutes} - {f"rec/{name}" for name in going}
    assert left >= {f"rec/m{ago}" for ago in range(first)}
    # Of the hour that the plan ends in all go that may.
    hours = {each.end // HOUR for each in minutes if each.path.rpartition("/")[2] in going}
    rest = [each for each in minutes if each.end // HOUR in hours and each.path in left]
    assert {each.path for each in rest} <= held.needed


def test_a_future_date_has_no_newest_hour() -> None:
    ahead = bag("ahead", NOW + 900 * DAY)
    minutes = [bag(f"m{ago}", NOW - ago * 60 * S) for ago in range(30)]
    held = contents(*minutes, ahead)
    assert "m0" not in names(by_hours(held, budget(200)).to_delete)


def test_a_robot_that_was_off_for_two_weeks_does_not_erase_itself_when_it_wakes() -> None:
    before, after = hourly(100, until=NOW - 14 * DAY), bag("new", NOW)
    assert expired(contents(*before, after), LIMITS) == ()


def anew(clock: int, runs: int, now: int = NOW) -> DirContents:
    """Runs of four minutes, by a clock that begins at a time with each of them."""
    bags = [
        bag(f"r{run}_{n}", clock + n * 60 * S, recording=f"r{run}")
        for run in range(runs)
        for n in range(4)
    ]
    return replace(contents(*bags, now=now), places={f"r{run}": run for run in range(runs)})


@pytest.mark.parametrize("clock", [2 * HOUR, NOW - 400 * DAY, NOW + 3 * DAY])
@pytest.mark.parametrize("deletes", [expired, lambda *given: by_hours(*given).to_delete])
def test_what_was_recorded_first_goes_first_whatever_its_clock_said(
    clock: int, deletes: Callable[[DirContents, RetentionLimits], tuple[StoredBag, ...]]
) -> None:
    for now in (NOW, clock + 240 * S):
        held = anew(clock, 3, now)
        assert names(deletes(held, budget(80))) == ["r0_0", "r0_1", "r0_2", "r0_3"]
        all_but_one = names(deletes(held, budget(0)))
        assert all_but_one == [f"r{n // 4}_{n % 4}" for n in range(11)]


def set_back(begun: int, hours: int, *wrong: int) -> DirContents:
    """A recording by a clock an hour ahead, and one that goes on for hours by the right clock.

    By `wrong` hours of these, its clock was a year behind.
    """
    ahead = bag("r0_0.mcap", begun + HOUR, recording="r0")
    later = [
        bag(f"r1_{n}.mcap", begun + (n + 1) * HOUR // 2 - 365 * DAY * (n in wrong), recording="r1")
        for n in range(2 * hours)
    ]
    held = contents(ahead, *later, now=begun + hours * HOUR)
    return replace(held, places={"r0": 0, "r1": 1})


def test_what_was_recorded_just_after_a_clock_was_set_back_ages_with_what_follows_it() -> None:
    hours = 30 * 24
    old = 2 * (hours - 168) - 1
    expected = ["r0_0.mcap", *(f"r1_{n}.mcap" for n in range(old))]
    assert names(expired(set_back(NOW, hours), LIMITS)) == expected


def test_what_a_clock_that_fell_behind_dates_is_as_young_as_what_follows_it() -> None:
    hours = 30 * 24
    behind = range(2 * hours - 300, 2 * hours - 290)
    going = names(expired(set_back(NOW, hours, *behind), LIMITS))
    assert not {f"r1_{n}.mcap" for n in behind}.intersection(going)


def test_bags_without_a_date_go_by_the_time_of_their_file() -> None:
    bags = [
        bag("b", 3 * HOUR, written=NOW - 5 * HOUR),
        bag("c", NOW - 4 * HOUR),
        bag("a", NOW + 9000 * DAY, written=NOW - 6 * HOUR),
        bag("d", NOW - 300 * DAY, written=NOW - 3 * HOUR),
        bag("e", None, written=NOW - 2 * HOUR),
        bag("new", NOW),
    ]
    limits = replace(LIMITS, max_total_bytes=0)
    assert names(expired(contents(*bags), limits)) == ["a", "b", "c", "d", "e"]


def test_files_dated_a_little_ahead_of_a_clock_that_is_behind_keep_their_order() -> None:
    last_hours = hourly(5, until=NOW + 10 * HOUR)
    assert names(expired(contents(*last_hours), budget(30))) == ["h4", "h3"]


def budget(size: int) -> RetentionLimits:
    return RetentionLimits(max_total_bytes=size, max_age_ns=10**6 * DAY)


moments = st.one_of(
    st.integers(0, 400).map(lambda ago: NOW - ago * HOUR),
    st.integers(0, 400).map(lambda ago: NOW - 300 * DAY - ago * HOUR),
    st.integers(0, 400).map(lambda hour: hour * HOUR),
    st.integers(1, 400).map(lambda later: NOW + later * DAY),
)


@st.composite
def stocks(draw: st.DrawFn) -> DirContents:
    """Bags by good and bad clocks, in several recordings, and some with several names."""
    bags: dict[str, StoredBag] = {}
    for number in range(draw(st.integers(0, 12))):
        inode = draw(st.none() | st.integers(0, 2))
        made = bag(
            f"b{number}",
            draw(st.none() | moments),
            # Names of one file have its size.
            size=draw(st.integers(1, 50)) if inode is None else 20,
            inode=inode,
            written=draw(moments),
            recording=draw(st.sampled_from("ABC")),
            length=draw(st.sampled_from([S, 10 * S, 300 * DAY])),
        )
        bags[made.path] = made
    return DirContents(
        tuple(draw(st.permutations(list(bags.values())))),
        draw(st.sampled_from([NOW, 5 * HOUR, NOW + 900 * DAY])),
        other_bytes=draw(st.integers(0, 50)),
        free_bytes=draw(st.none() | st.integers(0, 300)),
        recorded_since=draw(
            st.dictionaries(st.sampled_from("ABC"), st.integers(0, 200).map(lambda h: h * HOUR))
        ),
        synchronised=draw(st.booleans()),
    )


all_limits = st.builds(
    RetentionLimits,
    st.integers(0, 400),
    st.sampled_from([HOUR, 100 * HOUR, 168 * HOUR, 10**6 * DAY]),
    st.integers(0, 600),
)


def without(held: DirContents, deleted: Iterable[StoredBag]) -> DirContents:
    """What lies there after these bags are deleted."""
    gone = {each.path for each in deleted}
    bags = [each for each in held.bags if each.path not in gone]
    free = held.free_bytes
    if free is not None:
        free += bytes_of(held.bags) - bytes_of(bags)
    return replace(held, bags=bags, free_bytes=free)


def fits(held: DirContents, limits: RetentionLimits) -> bool:
    enough = held.free_bytes is None or held.free_bytes >= limits.min_free_bytes
    return enough and plan_deletions(held, limits).total_bytes <= limits.max_total_bytes


@given(stocks(), all_limits)
def test_the_limits_are_held_by_no_more_than_is_needed_and_something_is_left(
    held: DirContents, limits: RetentionLimits
) -> None:
    """In whatever order bags are known; what cannot be reached costs none."""
    plan, going = plan_deletions(held, limits), expired(held, limits)
    left = without(held, going)
    assert plan.total_bytes == held.other_bytes + bytes_of(held.bags)
    assert fits(left, limits) == plan.fits
    assert plan.fits or len({each.files for each in left.bags}) <= 1 or plan.most_free is not None
    if plan.most_free is not None:
        assert held.free_bytes is not None
        assert plan.most_free < limits.min_free_bytes
        assert going == expired(held, replace(limits, min_free_bytes=0))
    assert bool(left.bags) == bool(held.bags)
    dates = [any(each.has_dates for each in some.bags) for some in (left, held)]
    assert dates[0] == dates[1]
    aged = expired(held, replace(limits, max_total_bytes=PLENTY, min_free_bytes=0))
    if deleted := [each for each in going if each not in aged]:
        spared = [each for each in deleted if each.files != deleted[-1].files]
        assert not fits(without(held, [*aged, *spared]), limits)
    assert expired(replace(held, bags=held.bags[::-1]), limits) == going
    assert expired(left, limits) == ()


@given(stocks(), all_limits, st.sets(st.integers(0, 20)))
def test_what_is_not_shipped_waits_for_the_budget_alone_which_is_held_all_the_same(
    held: DirContents, limits: RetentionLimits, numbers: set[int]
) -> None:
    unshipped = frozenset(each.path for n, each in enumerate(held.bags) if n in numbers)
    waiting = replace(held, unshipped=unshipped)
    by_age = expired(waiting, replace(limits, max_total_bytes=PLENTY, min_free_bytes=0))
    assert unshipped.isdisjoint(each.path for each in by_age)
    assert set(by_age) <= set(expired(held, limits))
    assert plan_deletions(waiting, limits).fits == plan_deletions(held, limits).fits
    lost = [each for each in expired(waiting, limits) if each not in by_age]
    if lost:
        spared = [each for each in lost if each.files != lost[-1].files]
        assert not fits(without(waiting, [*by_age, *spared]), limits)


@given(
    st.lists(st.integers(0, 180), min_size=1, max_size=12),
    st.integers(1, 40),
    st.sets(st.integers(0, 12)),
)
@example([0, 45, 68], 10, set())  # of the older hour only one is too old, and would be enough
def test_in_whole_hours_the_limits_are_kept_as_well(
    minutes_ago: list[int], too_many: int, numbers: set[int]
) -> None:
    bags = [bag(f"b{n}", NOW - ago * 60 * S) for n, ago in enumerate(minutes_ago)]
    needed = frozenset(each.path for n, each in enumerate(bags) if n in numbers)
    held = replace(contents(*bags), needed=needed)
    limits = RetentionLimits(10 * len(bags) - too_many, HOUR)
    plan = by_hours(held, limits)
    assert fits(without(held, plan.to_delete), limits) == plan.fits


@given(stocks(), all_limits, st.integers(0, 400))
def test_a_larger_budget_deletes_nothing_that_a_smaller_one_keeps(
    held: DirContents, limits: RetentionLimits, more: int
) -> None:
    larger = replace(limits, max_total_bytes=limits.max_total_bytes + more)
    assert set(expired(held, larger)) <= set(expired(held, limits))


@given(stocks(), st.lists(moments, min_size=1, max_size=5))
def test_bags_of_bad_clocks_change_nothing_in_the_age_of_others(
    held: DirContents, ends: list[int]
) -> None:
    odd = [
        bag(f"odd{number}", end, written=end, recording="ODD")
        for number, end in enumerate(ends)
        if end < 400 * HOUR + 1 or end > NOW
    ]
    held = replace(held, now=NOW)
    more = replace(held, bags=(*held.bags, *odd))
    # One that is longer than any recording counts as undated, too.
    dated = (each for each in held.bags if each.end - each.start <= LIMITS.max_age_ns)
    if any(NOW - 400 * HOUR <= each.end <= NOW for each in dated):
        assert set(expired(more, LIMITS)) == set(expired(held, LIMITS))


# `kept` are files of moments, which other names of may be deleted.


@given(
    st.lists(
        st.tuples(st.integers(0, 200), st.integers(0, 6)),
        min_size=1,
        unique_by=lambda drawn: drawn[1],
    ),
    st.sets(st.integers(0, 8)),
    st.integers(0, 120),
)
def test_what_is_said_of_the_budget_is_what_the_disk_would_show(
    drawn: list[tuple[int, int]], kept: set[int], most: int
) -> None:
    bags = [
        bag(f"b{n}", NOW - hours * HOUR, size=10 + inode, inode=inode)
        for n, (hours, inode) in enumerate(drawn)
    ]
    limits = replace(LIMITS, max_total_bytes=most)
    files = [StoredFile((1, inode), 10 + inode) for inode in kept]
    found = plan_deletions(replace(contents(*bags), saved=sizes(files)), limits)
    left = [each for each in bags if each not in found.to_delete]
    assert found.total_bytes == bytes_of(bags, *files)
    assert found.fits == (bytes_of(left, *files) <= most)
