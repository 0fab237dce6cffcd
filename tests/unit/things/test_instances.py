"""When a thing is missed, and which name it has, by its sights alone."""

import math
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
import pytest

from ros2_memory.analysis.sights import DetectorMessages, Sights, sights_of
from ros2_memory.columns.sights import JoinedSights, join_sights, pack_sights
from ros2_memory.columns.table import Texts
from ros2_memory.core.model import Vector3
from ros2_memory.things.estimation import estimate
from ros2_memory.things.labels import Labels, moves_by_itself

LABELS = Labels({"mug": ["coffee mug"]})
HERE = (0.0, 0.0, 0.0)


class PlacedDetection(NamedTuple):
    """A detection in the frame of the sights (m)."""

    label: str
    place: Vector3 | None


Seen: TypeAlias = "tuple[tuple[float, float, float], list[PlacedDetection]]"
"""From where (x, y, yaw) a detector published, and what it had."""


def bag_of(*messages: Seen, start: int = 0) -> Sights:
    """The sights of a message each second."""
    nowhere = (math.nan, math.nan, math.nan)
    robots = [(x, y, 0.0, yaw, 0.0) for (x, y, yaw), _ in messages]
    every = [(row, one) for row, (_, things) in enumerate(messages) for one in things]
    labels = Texts.of([one.label for _, one in every])
    seen = DetectorMessages(
        np.arange(start, start + len(messages)) * 10**9,
        np.array(robots, np.float64).reshape(-1, 5),
        np.array([row for row, _ in every], np.int64),
        labels.codes.astype(np.int64),
        labels.words,
        np.array([one.place or nowhere for _, one in every], np.float64).reshape(-1, 3),
        np.full(len(every), math.nan),
    )
    return sights_of("/detections", seen)


def whole(parts: Sequence[Sights]) -> JoinedSights:
    """The sights of all parts, which are in one coordinate system."""
    zeros = [0] * len(parts)
    return join_sights([pack_sights(part) for part in parts], zeros, zeros)


def seen_at(x: float, y: float) -> list[PlacedDetection]:
    return [PlacedDetection("mug", (x, y, 0.7))]


@pytest.mark.parametrize("away_m", [0.62, 0.88, 0.92, 0.96])
def test_a_thing_that_was_moved_by_less_than_a_metre_after_long_is_where_it_was_seen_last(
    away_m: float,
) -> None:
    """However little that is of all its detections, it is no noise around its old place."""
    there = [(HERE, seen_at(2, 0))] * 1200
    [mug] = estimate(whole([bag_of(*there, *[(HERE, seen_at(2, away_m))] * 60)]), LABELS).instances
    assert mug.stays[-1].y == pytest.approx(away_m * 1000)
    assert (len(mug.stays), mug.missed_by) == (2, None)


def test_a_second_thing_that_comes_close_beside_one_after_long_stands_with_it() -> None:
    """In each slice both are seen, and none goes to and fro between the two places."""
    alone = [(HERE, seen_at(2, 0))] * 2400
    both = [(HERE, [*seen_at(2, 0), *seen_at(2, 0.5)])] * 150
    found = estimate(whole([bag_of(*alone, *both)]), LABELS)
    [mugs] = found.instances
    [stay] = mugs.stays
    assert (stay.count, found.side_by_side(stay.spots)) == (2700, 2)


def test_what_a_thing_was_called_wrongly_is_known_after_it_came_back_to_a_place() -> None:
    first, other, back = (2.0, 0.0, 0.7), (-6.0, 8.0, 0.7), (1.0, 9.0, 0.7)
    before, away, beside = (0.0, 9.0, 0.0), (0.0, 0.0, 3.14), (-6.0, 6.0, 1.57)
    called = ["bowl" if nth % 8 == 3 else "mug" for nth in range(120)]
    seen = [(HERE, [PlacedDetection(label, first)]) for label in called]
    elsewhere = [(beside, [PlacedDetection("mug", other)])] * 120
    gone = [(before, [PlacedDetection("mug", back)])] * 120 + [(before, [])] * 120
    nothing: list[Seen] = [(away, [])] * 30
    bag = bag_of(*gone, *seen, *nothing, *elsewhere, *nothing, *seen)
    [mug] = estimate(whole([bag]), LABELS).instances
    assert len(mug.stays) == 4
    assert sum((stay.misread_as for stay in mug.stays), Counter()) == {"bowl": 27}


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
    ("key", "moves"), [("dog", True), ("small dog", True), ("hot dog", False), ("dog bed", False)]
)
def test_people_and_pets_move_by_themselves_and_food_does_not(key: str, *, moves: bool) -> None:
    assert moves_by_itself(key) == moves
