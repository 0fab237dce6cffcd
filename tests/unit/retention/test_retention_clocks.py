"""Age against clocks that step: what the pure plan deletes, over whole lives of a robot."""

import tempfile
from dataclasses import dataclass, field
from pathlib import Path

from hypothesis import example, given, settings
from hypothesis import strategies as st

from ros2_memory.bag_dir.layout import RECORDED_FILE
from ros2_memory.core.timebase import FUTURE_NS, MAX_NS, MIN_NS
from ros2_memory.index.clock_faults import FIRST_BAGS_NS
from ros2_memory.retention.policy import (
    SHORTEST_PAUSE_NS,
    DirContents,
    RetentionLimits,
    StoredBag,
    plan_deletions,
)
from ros2_memory.retention.recorded_time import RecordedTime

S = 10**9
MINUTE = 60 * S
HOUR = 3600 * S
DAY = 24 * HOUR
T0 = 1_790_000_000 * S
PLENTY = 10**15
AGE = 20 * MINUTE
"""Histories of minutes are as good as weeks, and short enough to try many of them."""


def expired(contents: DirContents, limits: RetentionLimits) -> tuple[StoredBag, ...]:
    return plan_deletions(contents, limits).to_delete


def bag(recording: str, inode: int, start: int, end: int) -> StoredBag:
    return StoredBag(f"{recording}/b", recording, start, end, end, 1, inode, 10)


def too_old_by_dates(bags: list[StoredBag], now: int, max_age: int) -> set[str]:
    """What is older than the limit by its dates, worked out bag by bag.

    Counted from the newest data that follows without a pause longer than the limit, and than a day.
    """
    longest = max(max_age, SHORTEST_PAUSE_NS)
    dated = [
        (bag.start, bag.end, bag)
        for bag in bags
        if bag.has_dates
        and bag.start >= FIRST_BAGS_NS
        and bag.end <= now + FUTURE_NS
        and bag.end - bag.start <= longest
    ]
    newest: dict[str, int] = {}
    for _, end, bag in dated:
        reach = end
        while True:
            further = max(stop for start, stop, _ in dated if start <= reach + longest)
            if further <= reach:
                break
            reach = further
        newest[bag.path] = min(reach, now)
    old = {bag.path for _, end, bag in dated if end < newest[bag.path] - max_age}
    if dated:
        last = max(newest.values())
        begun = min(start for start, _, bag in dated if newest[bag.path] == last)
        undated = [bag for bag in bags if bag.path not in newest]
        old |= {bag.path for bag in undated if begun <= bag.written < last - max_age}
    return old


@dataclass
class Life:
    """A robot that records a minute at a time, whose clock shows what it likes.

    `lead` is how far its clock is ahead of the true time. `lived_s` is the recorded time, and
    `ended_s` how much of it lay before the end of each bag; `true_ends` is when that was.
    """

    root: Path
    wall: int = T0
    lead: int = 0
    monotonic_s: float = 0.0
    lived_s: float = 0.0
    bytes_written: int = 0
    bags: list[StoredBag] = field(default_factory=list)
    ended_s: dict[str, float] = field(default_factory=dict)
    true_ends: dict[str, int] = field(default_factory=dict)
    right: set[str] = field(default_factory=set)
    recordings: int = 0

    def __post_init__(self) -> None:
        self.recorded = RecordedTime(self.root)

    @property
    def true_now(self) -> int:
        return self.wall - self.lead

    def boot(self) -> None:
        """Without a word: what was not saved is forgotten."""
        self.recorded = RecordedTime(self.root)
        self.monotonic_s, self.bytes_written = 3.0, 0

    def record(self, minutes: int, step: int = 0, *, has_server: bool = True) -> None:
        """So many recordings of a minute; the clock steps in the middle of the last.

        `has_server`: a time server says so where the clock is right.
        """
        for nth in range(minutes):
            self.recordings += 1
            name = f"rec_{self.recordings}"
            (self.root / name).mkdir()
            start = self.wall
            self.note(name, has_server=has_server)
            is_right, stepped = not self.lead, step if nth == minutes - 1 else 0
            self.lead += stepped
            self.wall += MINUTE + stepped
            self.monotonic_s += 60.0
            self.lived_s += 60.0
            self.bytes_written += 10
            self.note(name, has_server=has_server)
            first, last = sorted((start, self.wall))
            made = bag(name, self.recordings, first, last)._replace(written=self.wall)
            self.bags.append(made)
            self.ended_s[made.path] = self.lived_s
            self.true_ends[made.path] = self.true_now
            if has_server and is_right and not stepped:
                self.right.add(made.path)

    def note(self, recording: str, *, has_server: bool) -> None:
        if has_server and not self.lead:
            self.recorded.confirm_clock()
        self.recorded.note([recording], self.bytes_written, self.monotonic_s, self.wall)

    def contents(self, *, synchronised: bool) -> DirContents:
        names = {bag.recording for bag in self.bags}
        return DirContents(
            tuple(self.bags),
            self.wall,
            recorded_since=self.recorded.since(names),
            doubtful=self.recorded.doubtful(names),
            synchronised=synchronised,
            places={bag.recording: place for place, bag in enumerate(self.bags)},
        )

    def recorded_after(self, bag: StoredBag) -> int:
        return round((self.lived_s - self.ended_s[bag.path]) * S)

    def delete(self, deleted: tuple[StoredBag, ...]) -> None:
        for bag in deleted:
            self.bags.remove(bag)
            (self.root / bag.recording).rmdir()


steps = st.sampled_from([MINUTE, 15 * MINUTE, 25 * MINUTE, HOUR, 20 * HOUR, 3 * DAY, 150 * DAY])
events = st.one_of(
    st.tuples(st.just("record"), st.integers(1, 12), st.just(0)),
    st.tuples(st.just("record"), st.integers(1, 3), steps),
    st.tuples(st.just("record"), st.integers(1, 3), steps.map(lambda step: -step)),
    st.tuples(st.just("off"), st.integers(1, 40), st.sampled_from([5 * MINUTE, DAY])),
    st.tuples(st.just("no clock"), st.just(0), st.just(0)),
    st.tuples(st.just("set"), st.just(0), st.just(0)),
)


@given(
    st.lists(st.tuples(events, st.booleans()), min_size=1, max_size=14),
    st.none() | st.integers(0, 30),
)
@example(  # a clock that was ahead dates the newest bag a minute after now
    [
        (("record", 1, 25 * MINUTE), False),
        (("no clock", 0, 0), False),
        (("record", 3, 0), False),
        (("set", 0, 0), False),
        (("record", 5, 0), True),
        (("record", 12, 0), False),
        (("record", 3, -25 * MINUTE), False),
        (("record", 1, 25 * MINUTE), True),
    ],
    None,
)
@example(  # a recording by a clock that was ahead does not make later ones younger
    [
        (("record", 1, 15 * MINUTE), True),
        (("set", 0, 0), True),
        (("record", 1, 0), True),
        (("off", 5, 5 * MINUTE), True),
        (("record", 1, 0), True),
    ],
    None,
)
@settings(deadline=None)
def test_over_any_life_age_deletes_by_a_right_clock_alone_and_the_budget_holds(
    drawn: list[tuple[tuple[str, int, int], bool]], budget: int | None
) -> None:
    size = PLENTY if budget is None else 10 * budget
    limits = RetentionLimits(size, AGE)
    with tempfile.TemporaryDirectory() as folder:
        life = Life(Path(folder))
        for (event, amount, step), has_server in drawn:
            if event == "record":
                life.record(amount, step, has_server=has_server)
            elif event == "off":
                life.wall += amount * step
                life.boot()
            elif event == "no clock":
                life.lead -= life.wall - 30 * S
                life.wall = 30 * S
                life.boot()
            else:
                life.wall -= life.lead
                life.lead = 0
            synchronised = has_server and not life.lead
            held = life.contents(synchronised=synchronised)
            aged = set(expired(held, RetentionLimits(PLENTY, AGE)))
            assert all(life.true_now - life.true_ends[bag.path] > AGE for bag in aged)
            right = life.right if synchronised else set[str]()
            by_dates = too_old_by_dates(life.bags, life.wall, AGE) & right
            assert {bag.path for bag in aged if bag.path in right} == by_dates
            doubtful = {bag for bag in life.bags if bag.path not in right}
            assert all(life.recorded_after(bag) > AGE for bag in aged & doubtful)
            # Each boot may have forgotten a minute of it.
            boots = sum(each[0][0] in {"off", "no clock"} for each in drawn)
            sure = AGE + boots * MINUTE
            old = {bag for bag in doubtful if life.recorded_after(bag) > sure}
            assert len(old - aged) <= 1, "the newest alone stays"
            life.delete(expired(held, limits))
            left = life.contents(synchronised=synchronised)
            assert plan_deletions(left, limits).total_bytes <= size or len(life.bags) == 1


@given(
    st.lists(
        st.one_of(
            st.tuples(st.just("record"), st.integers(1, 12)),
            st.tuples(st.just("off"), st.integers(1, 40)),
            st.tuples(st.just("record lost"), st.just(0)),
        ),
        min_size=1,
        max_size=14,
    )
)
@settings(deadline=None)
def test_where_the_clock_was_always_right_age_deletes_by_dates_whatever_was_restored(
    drawn: list[tuple[str, int]],
) -> None:
    limits = RetentionLimits(PLENTY, AGE)
    with tempfile.TemporaryDirectory() as folder:
        life = Life(Path(folder))
        for event, amount in drawn:
            if event == "record":
                life.record(amount)
            elif event == "off":
                life.wall += amount * 5 * MINUTE
                life.boot()
            else:
                (life.root / RECORDED_FILE).unlink(missing_ok=True)
                life.boot()
            aged = expired(life.contents(synchronised=True), limits)
            expected = too_old_by_dates(life.bags, life.wall, AGE)
            assert {bag.path for bag in aged} == expected
            life.delete(aged)


@given(
    st.lists(
        st.tuples(st.integers(1, 9), st.booleans(), st.integers(0, 60), st.booleans()),
        min_size=1,
        max_size=40,
    ),
    st.integers(1, 40),
)
def test_a_clock_that_was_behind_ages_nothing_young(
    drawn: list[tuple[int, bool, int, bool]], limit_days: int
) -> None:
    """It recorded without a pause; the dates of a clock that was behind are doubtful."""
    limits, now = RetentionLimits(PLENTY, limit_days * DAY), T0
    bags, true_ends, doubtful = list[StoredBag](), dict[str, int](), set[str]()
    for nth, (off_days, is_behind, by_days, is_empty) in enumerate(drawn):
        now += off_days * DAY
        end = now - by_days * DAY if is_behind else now
        span = (MAX_NS, MIN_NS) if is_empty and bags else (end - S, end)
        bags.append(bag(f"rec_{nth}", nth, *span)._replace(written=end))
        true_ends[bags[-1].path] = now
        if is_behind:
            doubtful.add(bags[-1].recording)
    places = {each.recording: place for place, each in enumerate(bags)}
    contents = DirContents(
        bags,
        now,
        places=places,
        synchronised=True,
        recorded_since={each.recording: now - true_ends[each.path] for each in bags},
        doubtful=frozenset(doubtful),
    )
    aged = set(expired(contents, limits))
    old = {each for each in bags if now - true_ends[each.path] > limits.max_age_ns}
    assert aged <= old
    assert len({each for each in old if each.recording in doubtful} - aged) <= 1, "the newest stays"
