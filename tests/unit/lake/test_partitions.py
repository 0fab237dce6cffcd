"""Which days of a robot are looked at, and read, together."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date, timedelta

from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.lake.partitions import NO_DAYS, Days, LakeFile

FIRST = date(2024, 2, 27)
SIZES = st.lists(st.tuples(st.integers(0, 40), st.integers(1, 50)), min_size=1, max_size=12)


def days_of(sizes: Sequence[tuple[int, int]]) -> Days:
    """Days with gaps between them and files of so many rows."""
    found, day = {}, FIRST
    for gap, size in sizes:
        day += timedelta(days=gap + 1)
        found[day] = (LakeFile(f"file:///{day}", size),)
    return Days(found)


def rows(days: Days, first: date, last: date) -> int:
    return sum(each.rows for each in days.files(first, last))


@given(SIZES, st.integers(1, 60), st.integers(1, 40), st.integers(0, 500))
def test_the_newest_days_are_as_many_as_fit_and_at_least_those_asked_for(
    sizes: list[tuple[int, int]], most: int, fewest: int, after: int
) -> None:
    days, until = days_of(sizes), FIRST + timedelta(days=after)
    known = [each for each in days.known if each <= until]
    found = days.newest(until, most, fewest)
    if found is None:
        assert not known
        return
    first, last = found
    assert last == known[-1]
    assert rows(days, first, last) <= most or first > last - timedelta(days=fewest)
    if older := [each for each in known if each < first]:
        assert rows(days, older[-1], last) > most
        assert older[-1] <= last - timedelta(days=fewest)


def test_a_robot_without_rows_has_no_days() -> None:
    assert NO_DAYS.newest(date.max, 1, 1) is None
    assert NO_DAYS.files(date.min, date.max) == []
