"""Which days of a robot are looked at, and read, together."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date, timedelta

from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.lake.memory import newest
from ros2_memory.lake.warehouse import Days, LakeFile

FIRST = date(2024, 2, 27)
SIZES = st.lists(st.tuples(st.integers(0, 40), st.integers(1, 50)), max_size=12)


def days_of(sizes: Sequence[tuple[int, int]]) -> Days:
    """Days with gaps between them and files of so many rows."""
    found, day = {}, FIRST
    for gap, size in sizes:
        day += timedelta(days=gap + 1)
        found[day] = (LakeFile(f"file:///{day}", size),)
    return found


@given(SIZES, st.integers(1, 60), st.integers(1, 40), st.integers(0, 500))
def test_the_newest_days_are_as_many_as_fit_and_at_least_those_asked_for(
    sizes: list[tuple[int, int]], most: int, fewest: int, after: int
) -> None:
    days, until = days_of(sizes), FIRST + timedelta(days=after)
    known = [day for day in days if day <= until]
    found, before = newest(days, until, most, fewest)
    assert [*found] == [day for day in known if before is None or day > before]
    if not found:
        assert not known
        return
    assert max(found) == known[-1]
    always = known[-1] - timedelta(days=fewest)
    rows = sum(file.rows for files in found.values() for file in files)
    assert rows <= most or min(found) > always
    if before is not None:
        assert rows + days[before][0].rows > most
        assert before <= always
