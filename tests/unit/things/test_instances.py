"""Things by their sights alone: names, when one is missed, which looks count, usual places."""

import math
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from types import FrameType
from typing import Any, Final, TypeAlias

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis.sights import CELL_MM, DetectorMessages, Hit, Look, Sights, sights_of
from ros2_memory.columns.sights import JoinedSights, join_sights, pack_sights
from ros2_memory.columns.table import Texts
from ros2_memory.core.arrays import Columns, Ints
from ros2_memory.core.model import Vector3
from ros2_memory.core.timebase import MAX_NS
from ros2_memory.things import estimation
from ros2_memory.things.estimation import estimate
from ros2_memory.things.instances import Estimate, count_misses
from ros2_memory.things.labels import Labels, moves_by_itself
from ros2_memory.things.presence import (
    Cells,
    Evidence,
    evidence_at,
    stays_at,
)
from ros2_memory.things.routine import usual_places

LABELS = Labels({"mug": ["coffee mug"]})
HERE = (0.0, 0.0, 0.0)


Detections: TypeAlias = "list[tuple[str, Vector3]]"
"""Labels, and places in the frame of the sights (m)."""
Seen: TypeAlias = "tuple[Vector3, Detections]"
"""From where (x, y, yaw) a detector published, and what it had."""


def estimated(*messages: Seen) -> Estimate:
    """What is made of a message each second."""
    every = [(row, *one) for row, (_, things) in enumerate(messages) for one in things]
    labels = Texts.of([label for _, label, _ in every])
    seen = DetectorMessages(
        np.arange(len(messages)) * 10**9,
        np.array([(x, y, 0.0, yaw, 0.0, 0.0, 0.0, 1.0) for (x, y, yaw), _ in messages]),
        np.array([row for row, *_ in every]),
        labels.codes.astype(np.int64),
        labels.words,
        np.array([place for *_, place in every]),
        np.full(len(every), math.nan),
        np.zeros(len(every), np.int64),
        ("",),
    )
    return estimate(whole([sights_of("/detections", seen)]), LABELS)


def whole(parts: Sequence[Sights]) -> JoinedSights:
    """The sights of all parts, which are in one coordinate system."""
    zeros = [0] * len(parts)
    return join_sights([pack_sights(part) for part in parts], zeros, zeros)


def seen_at(x: float, y: float) -> Detections:
    return [("mug", (x, y, 0.7))]


@pytest.mark.parametrize("away_m", [0.62, 0.88, 0.92, 0.96])
def test_a_thing_that_was_moved_by_less_than_a_metre_after_long_is_where_it_was_seen_last(
    away_m: float,
) -> None:
    """However little that is of all its detections, it is no noise around its old place."""
    there = [(HERE, seen_at(2, 0))] * 1200
    [mug] = estimated(*there, *[(HERE, seen_at(2, away_m))] * 60).instances
    assert mug.stays[-1].y == pytest.approx(away_m * 1000)
    assert (len(mug.stays), mug.missed_by) == (2, None)


def test_a_second_thing_that_comes_close_beside_one_after_long_stands_with_it() -> None:
    """In each slice both are seen, and none goes to and fro between the two places."""
    alone = [(HERE, seen_at(2, 0))] * 2400
    both = [(HERE, [*seen_at(2, 0), *seen_at(2, 0.5)])] * 150
    found = estimated(*alone, *both)
    [mugs] = found.instances
    [stay] = mugs.stays
    assert (stay.count, found.side_by_side(stay.spots)) == (2700, 2)


def test_what_a_thing_was_called_wrongly_is_known_after_it_came_back_to_a_place() -> None:
    before, away, beside = (0.0, 9.0, 0.0), (0.0, 0.0, 3.14), (-6.0, 6.0, 1.57)
    called = ["bowl" if nth % 8 == 3 else "mug" for nth in range(120)]
    seen = [(HERE, [(label, (2.0, 0.0, 0.7))]) for label in called]
    elsewhere = [(beside, seen_at(-6.0, 8.0))] * 120
    gone = [(before, seen_at(1.0, 9.0))] * 120 + [(before, [])] * 120
    nothing: list[Seen] = [(away, [])] * 30
    [mug] = estimated(*gone, *seen, *nothing, *elsewhere, *nothing, *seen).instances
    assert len(mug.stays) == 4
    assert sum((stay.misread_as for stay in mug.stays), Counter()) == {"bowl": 27}


@pytest.mark.parametrize(("height", "things"), [(0.7, 2), (4.7, 1)])
def test_what_is_in_another_state_is_the_same_thing_on_its_own_storey_alone(
    height: float, things: int
) -> None:
    def crate(label: str, y: float, z: float) -> Detections:
        return [(f"crate_{label}", (2.0, y, z))]

    full, empty, later = crate("full", 0, 0.7), crate("empty", 0, height), crate("full", 3, 0.7)
    found = estimated(*[(HERE, full)] * 300, *[(HERE, empty + later)] * 300)
    crates = [thing for thing in found.instances if thing.label == "crate full"]
    assert len(crates) == things


LEFT, RIGHT = (0.0, 0.0, 0.9), (0.0, 0.0, -0.9)


def test_of_two_things_each_is_the_one_that_was_near_where_the_map_shifted() -> None:
    """The one that is seen again first is not the one that was seen last."""

    def shifted(by: float) -> tuple[Detections, Detections]:
        return seen_at(2 + by, 1.8), seen_at(2 + by, -1.8)

    (left, right), (later_left, later_right) = shifted(0.0), shifted(0.4)
    found = estimated(
        *[(HERE, left + right)] * 300,
        *[(RIGHT, right)] * 60,
        *[(LEFT, later_left)] * 60,
        *[(HERE, later_left + later_right)] * 300,
    )
    sides = [[stay.y > 0 for stay in thing.stays] for thing in found.instances]
    assert sorted(sides) == [[False, False], [True, True]]


def test_what_came_from_far_is_the_thing_that_is_not_seen_again_near_its_old_place() -> None:
    kitchen, study, hall = (0.0, 0.0, 0.0), (20.0, 0.0, 0.0), (40.0, 0.0, 0.0)
    before = [*[(kitchen, seen_at(2, 0))] * 150, *[(study, seen_at(22, 0))] * 150]
    found = estimated(
        *before,
        *before,
        *[(hall, seen_at(42, 0))] * 300,
        *[(kitchen, [])] * 300,
        *[(study, seen_at(22.4, 0))] * 300,
    )
    places = [[round(stay.x / 10_000) for stay in thing.stays] for thing in found.instances]
    assert sorted(places) == [[0, 4], [2, 2]]


def test_four_times_as_many_things_in_a_row_take_no_sixteen_times_the_work() -> None:
    """As of the posts of a vineyard, all of which are elsewhere after the map was made anew."""

    def work_on(things: int) -> int:
        def pass_along(y: float) -> list[Seen]:
            row = [((4.0 * nth, 0.0, 0.0), seen_at(4.0 * nth + 2, y)) for nth in range(things)]
            return [seen for seen in row for _ in range(4)]

        passes = [*pass_along(1.0) * 3, *pass_along(-0.8) * 3]
        calls = 0

        def count(frame: FrameType, event: str, _: object) -> None:
            nonlocal calls
            calls += event == "call" and frame.f_code.co_filename == estimation.__file__

        sys.setprofile(count)
        try:
            found = estimated(*passes)
        finally:
            sys.setprofile(None)
        assert [len(thing.stays) for thing in found.instances] == [2] * things
        return calls

    assert work_on(160) < 6 * work_on(40)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("mug", "Mug"),
        ("mug", "mugs"),
        ("Potted_Plant", "potted plants"),
        ("cell-phone", " cell  phone "),
        ("dish", "dishes"),
        ("box", "boxes"),
        ("battery", "batteries"),
        ("person", "People"),
        ("bookshelf", "bookshelves"),
        ("potato", "potatoes"),
        ("glass", "glasses"),
        ("banana", "bananas"),
        ("photo", "photos"),
        ("cookie", "Cookies"),
        ("bus", "buses"),
        ("caf\u00e9", "cafe\u0301"),
        ("scissors", "Scissor"),
    ],
)
def test_case_spacing_and_a_plural_do_not_matter(one: str, other: str) -> None:
    assert Labels({}).key(one) == Labels({}).key(other)


@pytest.mark.parametrize(
    ("key", "moves"),
    [
        ("dog", True),
        ("small dog", True),
        ("roe deer", True),
        ("fish school", True),
        ("diver", True),
        ("hot dog", False),
        ("dog bed", False),
        ("rocking horse", False),
        ("school", False),
    ],
)
def test_people_and_animals_move_by_themselves_and_food_does_not(key: str, *, moves: bool) -> None:
    assert moves_by_itself(key) == moves


_looks = st.lists(
    st.tuples(st.integers(0, 1), st.integers(0, 2), st.integers(1, 16), st.integers(-6, 3)),
    min_size=1,
    max_size=60,
)
"""Steps to the next bag, the cell, messages, and how often these have the label."""


_unplaced = st.dictionaries(st.integers(0, 100), st.integers(1, 3), max_size=3)
UNPLACED: Final[Any] = {"unplaced": [whole([]).unplaced[:]], "label": np.zeros(2, np.int64)}
_ANYWHERE = np.array([[1e9, 0.0, -180.0, 180.0]])


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
    for stay in stays_at(cells, found):
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
        looks.append((bag, 0, place * CELL_MM + 100, 100, 0, 0, n, time, time + 900, 0, 0))
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


HOUR: Final = 3600 * 10**9
PLACES: Final = np.array([[1000, 1000], [4000, 2000], [7000, 5000], [2000, 8000]])
DAYS: Final = 30


def month(seed: int, moves: float, is_at_home: float) -> tuple[Ints, Ints]:
    """Returns when (ns) and where (mm) a thing was seen that moves at any hour, or goes home."""
    chance = np.random.default_rng(seed)
    times, seen, place = [], [], 0
    for hour in range(DAYS * 24):
        if chance.random() < moves:
            place = 0 if chance.random() < is_at_home else int(chance.integers(len(PLACES)))
        if 7 <= hour % 24 < 23 and chance.random() < 0.35:
            times.append(hour * HOUR + int(chance.integers(HOUR)))
            seen.append([*(PLACES[place] + chance.normal(0, 80, 2).astype(np.int64)), 700])
    return np.array(times), np.array(seen)


@pytest.mark.parametrize(("moves", "is_at_home"), [(0.15, 0.0), (0.01, 0.0), (1.0, 0.8)])
def test_without_a_routine_none_is_told(moves: float, is_at_home: float) -> None:
    """One of twenty may be found by chance."""
    months = [month(seed, moves, is_at_home) for seed in range(20)]
    found = [usual_places(*each, DAYS * 24 * HOUR, lambda _: 0) for each in months]
    assert sum(bool(each) for each in found) <= 1
