from __future__ import annotations

from typing import TYPE_CHECKING

from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.model import BagFile, BagState, TimeWindow
from ros2_memory.core.timebase import MAX_NS
from ros2_memory.retention.moment_plan import (
    LONGEST_WAIT_NS,
    REPAIRED_WITHIN_NS,
    Weight,
    admitted,
    fitting,
    needed,
    no_room,
    window_of,
)
from tests.support.memories import LAST_WRITTEN

if TYPE_CHECKING:
    from ros2_memory.core.model import BagSummary

S = 10**9
T0 = LAST_WRITTEN
WEIGHTS = st.lists(st.builds(Weight, st.integers(0, 8), st.integers(0, 50)), max_size=12).map(
    # A file has one size.
    lambda each: [Weight(inode, 7 * inode) for inode, _ in each]
)


def bag(start: int, end: int, state: BagState = BagState.CLOSED, name: str = "r/r.mcap") -> BagFile:
    """A bag from `start` to `end` seconds."""
    unread: BagSummary = None  # type: ignore[assignment]
    return BagFile(f"/bags/{name}", 1, T0, state, unread, T0 + start * S, T0 + end * S)


def window(start: int, end: int) -> TimeWindow:
    return window_of(T0 + start * S, T0 + end * S)


class TestWhatIsNeeded:
    def test_the_bags_that_have_a_moment_of_it_both_ends_included(self) -> None:
        bags = [bag(0, 9), bag(10, 19), bag(20, 29), bag(30, 39), bag(41, 50)]
        found = needed(window(19, 40), T0 + 60 * S, bags, [], T0 + 60 * S)
        assert found.bags == (bags[1], bags[2], bags[3])
        assert not found.waits

    def test_it_waits_for_its_own_end_and_for_open_files_that_may_hold_some_of_it(self) -> None:
        def waits(now: int, *open_files: TimeWindow | None) -> bool:
            return needed(window(0, 30), T0 + 30 * S, [], open_files, T0 + now * S).waits

        assert waits(30)
        assert not waits(31)
        assert waits(31, window(30, 40))
        assert waits(31, None)
        assert not waits(31, window(31, 40))

    def test_it_does_not_wait_for_ever(self) -> None:
        asked = T0 + 30 * S
        found = needed(window(0, 30), asked, [], [None], asked + LONGEST_WAIT_NS)
        assert not found.waits
        assert not needed(window(0, 30), asked, [], [None], asked - LONGEST_WAIT_NS).waits

    def test_a_bag_that_a_crash_left_open_is_waited_for_as_long_as_repair_may_take(self) -> None:
        left = [bag(0, 9, BagState.INCOMPLETE)]
        young = needed(window(0, 5), T0, left, [], T0 + 60 * S)
        assert (young.bags, young.waits) == ((), True)
        old = needed(window(0, 5), T0, left, [], T0 + REPAIRED_WITHIN_NS)
        assert (old.bags, old.waits) == (tuple(left), False)
        other = [bag(0, 9, BagState.INCOMPLETE, "r/r.db3")]
        assert needed(window(0, 5), T0, other, [], T0 + 60 * S).bags == tuple(other)

    def test_the_bag_of_carried_messages_is_none(self) -> None:
        carried = bag(0, 9, name="latched/carried.mcap")
        assert needed(window(0, 5), T0, [carried], [], T0 + 60 * S).bags == ()

    def test_a_window_ends_with_time_itself(self) -> None:
        assert window_of(0, MAX_NS).stop == MAX_NS


class TestTheShare:
    def test_a_file_that_is_held_already_takes_nothing_more(self) -> None:
        held = {1: 60}
        assert admitted([Weight(1, 60), Weight(2, 40)], held, 100) == (Weight(2, 40),)
        assert admitted([Weight(1, 60), Weight(2, 41)], held, 100) is None
        assert admitted([Weight(2, 40), Weight(2, 40)], held, 100) == (Weight(2, 40),)

    def test_what_is_still_being_written_is_expected(self) -> None:
        assert admitted([Weight(2, 40)], {}, 100, expected=60) is not None
        assert admitted([Weight(2, 40)], {}, 100, expected=61) is None

    @given(WEIGHTS, WEIGHTS, st.integers(0, 150))
    def test_what_is_admitted_or_fits_never_passes_it(
        self, files: list[Weight], before: list[Weight], share: int
    ) -> None:
        held: dict[int, int] = {}
        for each in before:
            if admitted([each], held, share) is not None:
                held[each.inode] = each.size
        sizes = {each.inode: each.size for each in (*files, *before)}
        assert sum(held.values()) <= share
        if admitted(files, held, share) is not None:
            assert sum(sizes[each] for each in {*held, *(each.inode for each in files)}) <= share
        taken = fitting(files, held, share)
        assert taken >= held.keys()
        assert sum(sizes[each] for each in taken) <= share

    @given(WEIGHTS, st.integers(0, 150))
    def test_all_that_is_admitted_fits(self, files: list[Weight], share: int) -> None:
        if admitted(files, {}, share) is not None:
            assert fitting(files, {}, share) == {each.inode for each in files}

    def test_a_refusal_says_what_is_used_and_what_to_do(self) -> None:
        said = no_room({1: 900_000_000}, 200_000_000, 10**9)
        assert "may take 1 GB, 0.9 GB of that are used, and this one takes 0.2 GB more" in said
        assert "retention.max_moments_gb" in said
