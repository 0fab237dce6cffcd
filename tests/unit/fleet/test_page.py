"""Which times still have a place on the page that robots fill."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.fleet.page import Page

ROBOTS = st.lists(st.lists(st.integers(0, 20).map(lambda s: s * NS_PER_S), max_size=5), max_size=6)


@given(ROBOTS, st.integers(1, 4), st.booleans())
def test_what_is_left_out_is_on_no_page(
    robots: list[list[int]], limit: int, oldest_first: bool
) -> None:
    page = Page(limit, oldest_first=oldest_first)
    kept: list[int] = []
    for times in robots:
        window = page.window()
        wanted = [each for each in times if window is None or window.contains(each)]
        kept += wanted
        page.add(wanted)
    every = sorted((each for times in robots for each in times), reverse=not oldest_first)
    assert sorted(kept, reverse=not oldest_first)[:limit] == every[:limit]


def test_a_full_page_leaves_out_what_comes_later_and_one_without_an_end_nothing() -> None:
    page = Page(2, oldest_first=False)
    page.add([5 * NS_PER_S])
    assert page.window() is None
    page.add([3 * NS_PER_S, 4 * NS_PER_S])
    window = page.window()
    assert window is not None
    assert not window.contains(3 * NS_PER_S)
    assert window.contains(4 * NS_PER_S)
    endless = Page(None, oldest_first=False)
    endless.add([1, 2, 3])
    assert endless.window() is None
