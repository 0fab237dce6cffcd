from __future__ import annotations

from functools import partial

from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.storage.mcap.merge import Rows, SortedRun, merged

Item = tuple[int, int]
"""Log time and place in the file."""


def fetch(place: int, time: int) -> Item:
    return (time, place)


def runs_of(
    chunks: list[list[int]], opened: list[int], *, newest_first: bool
) -> list[SortedRun[Item]]:
    """A run for each chunk of log times; `opened` takes note of those that are read."""

    def rows(rank: int, items: list[Item]) -> Rows[Item]:
        opened.append(rank)
        ordered = sorted(items, reverse=newest_first)
        return Rows([time for time, _ in ordered], [place for _, place in ordered], fetch)

    runs = []
    place = 0
    for rank, times in enumerate(chunks):
        items = [(time, place + offset) for offset, time in enumerate(times)]
        place += len(times)
        runs.append(SortedRun(min(times), max(times), rank, partial(rows, rank, items)))
    return runs


_chunks = st.lists(st.lists(st.integers(0, 8), min_size=1, max_size=6), max_size=6)


@given(_chunks)
def test_newest_first_is_exactly_the_reverse(chunks: list[list[int]]) -> None:
    forwards = list(merged(runs_of(chunks, [], newest_first=False), newest_first=False))
    backwards = list(merged(runs_of(chunks, [], newest_first=True), newest_first=True))
    assert backwards == forwards[::-1]


def test_a_run_is_read_only_when_it_can_hold_the_next_message() -> None:
    opened: list[int] = []
    chunks = [[1, 2, 3], [3, 4], [9, 10]]
    items = merged(runs_of(chunks, opened, newest_first=False), newest_first=False)
    assert [next(items) for _ in range(2)] == [(1, 0), (2, 1)]
    assert opened == [0]
    assert next(items) == (3, 2)
    assert opened == [0, 1]
    assert [next(items) for _ in range(2)] == [(3, 3), (4, 4)]
    assert opened == [0, 1]
    assert list(items) == [(9, 5), (10, 6)]


def test_the_newest_run_is_read_first_when_the_newest_is_asked_for() -> None:
    opened: list[int] = []
    chunks = [[1, 2, 3], [4, 5], [9, 10]]
    items = merged(runs_of(chunks, opened, newest_first=True), newest_first=True)
    assert next(items) == (10, 6)
    assert opened == [2]
