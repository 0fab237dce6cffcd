"""When a label was at a place: which looks are evidence."""

from dataclasses import replace
from typing import Any, Final

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis.sights import CELL_MM, Hit, Look
from ros2_memory.columns.sights import JoinedSights
from ros2_memory.core.arrays import Columns
from ros2_memory.core.timebase import MAX_NS
from ros2_memory.things.instances import count_misses
from ros2_memory.things.presence import (
    Cells,
    Evidence,
    evidence_at,
    stays_at,
)
from tests.unit.things.test_instances import whole

_looks = st.lists(
    st.tuples(st.integers(0, 1), st.integers(0, 2), st.integers(1, 16), st.integers(-6, 3)),
    min_size=1,
    max_size=60,
)
"""Steps to the next bag, the cell, messages, and how often these have the label."""


_unplaced = st.dictionaries(st.integers(0, 100), st.integers(1, 3), max_size=3)
UNPLACED: Final[Any] = {"unplaced": [whole([]).unplaced[:]], "label": np.zeros(2, np.int64)}
_ANYWHERE = np.array([[1e9, -180.0, 180.0]])


@given(_looks, _unplaced)
def test_looks_that_can_tell_nothing_are_left_out_and_change_nothing(
    given_looks: list[tuple[int, int, int, int]], unplaced: dict[int, int]
) -> None:
    """From where the robot mostly stands, all looks of a week are at what it once saw there."""
    cells, hits = _seen(given_looks, unplaced)
    place = np.array([[3000.0, 100.0]])
    found = evidence_at(cells, _ANYWHERE, place, hits, np.zeros(len(hits), np.int64), **UNPLACED)

    whole = _with_every_look(cells, found, hits)
    left_out = np.setdiff1d(whole.looks, found.looks)
    seen_in = {bag for bag, *_ in hits.tolist()}
    assert not seen_in & {*cells.slice[left_out].tolist()}
    assert not {*cells.cell[found.looks[found.fair]]} & {*cells.cell[left_out]}
    assert [*stays_at(cells, found)] == [*stays_at(cells, whole)]
    for _, stay in stays_at(cells, found):
        for after in (0, int(cells.last[len(cells.last) // 2])):
            by = stay, after, (after + 1, MAX_NS)
            assert count_misses(cells.looks, found.at_place(0), *by) == count_misses(
                cells.looks, whole.at_place(0), *by
            )


@pytest.mark.parametrize(("every", "sees"), [(50, False), (2, True)])
def test_a_cell_sees_a_place_if_some_hits_come_close_to_each_other(every: int, sees: bool) -> None:
    """From a dock, a detector of 1 Hz has false detections at a place now and then."""
    cells, hits = _seen([(1, 0, 10, int(nth % every == 0)) for nth in range(500)], {})
    place = np.zeros(len(hits), np.int64)
    found = evidence_at(cells, _ANYWHERE, np.array([[3000.0, 100.0]]), hits, place, **UNPLACED)
    assert found.fair.all() == found.sees.all() == sees
    assert len(found.looks) == (500 if sees else len(hits))


def _seen(
    given_looks: list[tuple[int, int, int, int]], unplaced: dict[int, int]
) -> tuple[Cells, np.ndarray]:
    """Returns looks, and rows of `Hit` with the bag for the spot."""
    bag = 0
    looks: list[tuple[int, ...]] = []
    rows: list[tuple[int, int, int]] = []
    for step, place, n, seen in given_looks:
        bag += step
        time = len(looks) * 1000
        looks.append((bag, 0, place * CELL_MM + 100, 100, 0, 0, n, time, time + 900, 0))
        if seen > 0:  # few looks see it
            rows.append((bag, len(looks) - 1, seen))
    rows += [(each, -1, n) for each, n in unplaced.items() if each <= bag]
    cells = Cells(_sights(looks, bag + 1), np.zeros(len(looks), np.bool_))
    return cells, np.array(rows, np.int64).reshape(-1, len(Hit))


def _with_every_look(cells: Cells, found: Evidence, rows: np.ndarray) -> Evidence:
    """Returns evidence with all looks from the cells that saw the place."""
    seen_in = rows[rows[:, Hit.LOOK] >= 0, Hit.LOOK]
    known = np.unique(cells.cell[seen_in])
    looks = np.flatnonzero(np.isin(cells.cell, known))
    at = np.searchsorted(looks, found.looks)
    hits = np.zeros(len(looks), np.int64)
    sees, fair = (np.zeros(len(looks), np.bool_) for _ in range(2))
    hits[at], sees[at], fair[at] = found.hits, found.sees, found.fair
    np.add.at(of := np.zeros(len(cells.n), np.int64), seen_in, rows[rows[:, 1] >= 0, Hit.N])
    assert (hits == np.minimum(of, cells.n)[looks]).all()
    cell = np.searchsorted(known, cells.cell[looks])
    return Evidence(looks, cell, cells.n[looks], hits, found.blind, found.times, sees, fair)


def _sights(looks: list[tuple[int, ...]], bags: int) -> JoinedSights:
    rows = Columns(np.array(looks, np.int64).reshape(-1, len(Look)).T)
    return replace(whole([]), topics=("/detections",), looks=rows, epochs=np.zeros(bags, np.int64))
