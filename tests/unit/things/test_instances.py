"""The estimator against a simulated home, whose state alone is the truth."""

from __future__ import annotations

import math
from functools import cache
from statistics import median
from typing import TYPE_CHECKING

import pytest

from ros2_memory.analysis.sights import SLICE_NS, Sights, Spot
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.things.instances import Estimate, Instance, estimate
from ros2_memory.things.labels import Labels
from tests.support.sights import (
    Message,
    PlacedDetection,
    sights_of_messages,
    whole,
)
from tests.unit.things.simulated_things import (
    BAG_S,
    BEGIN_S,
    OUT,
    Simulation,
    Thing,
    simulate,
    visible,
)

if TYPE_CHECKING:
    from collections.abc import Iterator


pytestmark = pytest.mark.xdist_group("instances")
"""The homes are made once, for all tests of this file."""

LABELS = Labels({"mug": ["coffee mug"]})
SEEDS = (1, 2, 3)
ENOUGH = 3
"""Detections that make a thing; of fewer nothing is claimed."""
HERE = (0.0, 0.0, 0.0)
SLICE_S = SLICE_NS / NS_PER_S


@cache
def home(seed: int) -> tuple[Simulation, Estimate]:
    simulation = simulate(seed, hours=1.8, moves=10)
    return simulation, estimate(whole(simulation.bags), LABELS)


def found(result: Estimate, key: str) -> list[Instance]:
    return [each for each in result.instances if each.key == key]


def true_things(simulation: Simulation) -> Iterator[tuple[str, list[Thing]]]:
    labels = dict.fromkeys(LABELS.key(each.label) for each in simulation.things)
    for key in labels:
        yield key, [each for each in simulation.things if LABELS.key(each.label) == key]


def seconds(moment: int) -> float:
    return moment / 1e9 - BEGIN_S


def test_nearly_every_label_has_exactly_its_number_of_instances() -> None:
    right = wrong = 0
    for seed in SEEDS:
        simulation, result = home(seed)
        for key, things in true_things(simulation):
            seen = [each for each in things if len(each.detected) >= ENOUGH]
            same = len(found(result, key)) == len(seen)
            right, wrong = right + same, wrong + (not same)
        assert {each.key for each in result.instances} <= {
            key for key, _ in true_things(simulation)
        }
    assert right / (right + wrong) >= 0.95


def test_places_are_within_a_third_of_a_metre() -> None:
    off = []
    for seed in SEEDS:
        simulation, result = home(seed)
        for key, things in true_things(simulation):
            for thing in things:
                last = thing.detected[-1]
                place = thing.place_at(last)
                assert place is not None
                off.append(
                    min(
                        math.dist((stay.x / 1000, stay.y / 1000), place)
                        for each in found(result, key)
                        for stay in each.stays
                    )
                )
    assert median(off) < 0.3
    assert sorted(off)[int(0.95 * len(off))] < 0.3


def test_identities_are_hardly_ever_switched() -> None:
    switched = sightings = 0
    for seed in SEEDS:
        simulation, result = home(seed)
        spots = result.sights.spots
        for key, things in true_things(simulation):
            by_bag: dict[int, list[tuple[int, int]]] = {}
            for number, each in enumerate(found(result, key)):
                for stay in each.stays:
                    for row in stay.spots.tolist():
                        by_bag.setdefault(int(spots[row, Spot.SLICE]), []).append((row, number))
            for thing in things:
                before = None
                for bag in sorted({int(each // SLICE_S) for each in thing.detected}):
                    place = thing.place_at((bag + 0.5) * SLICE_S)
                    if place is None:
                        continue
                    near = [
                        (int(spots[row, Spot.N]), number)
                        for row, number in by_bag.get(bag, [])
                        if math.dist((spots[row, Spot.X] / 1e3, spots[row, Spot.Y] / 1e3), place)
                        < 0.6
                    ]
                    if near:
                        now = max(near)[1]
                        sightings += before is not None
                        switched += before not in {None, now}
                        before = now
    assert sightings > 4_000
    assert switched / sightings < 0.02


def test_moves_are_dated_to_the_split_of_the_first_new_sighting() -> None:
    dated = late = 0
    for seed in SEEDS:
        simulation, result = home(seed)
        for key, things in true_things(simulation):
            for thing in things:
                ends = [when for when, _, _ in thing.moves[1:]] + [simulation.stop_s]
                for (when, before, after), end in zip(thing.moves, ends, strict=False):
                    again = [each for each in thing.detected if when <= each < end]
                    known = [each for each in thing.detected if thing.place_at(each) == before]
                    apart = OUT not in (before, after) and math.dist(before, after) >= 1.0
                    if len(again) < 5 or len(known) < 5 or not apart:
                        continue
                    starts = [
                        seconds(stay.first)
                        for each in found(result, key)
                        for stay in each.stays[1:]
                        if math.dist((stay.x / 1e3, stay.y / 1e3), after) < 0.6
                    ]
                    near = any(abs(each - again[0]) <= BAG_S for each in starts)
                    dated, late = dated + near, late + (not near)
    assert dated > 10
    assert late == 0


def test_a_thing_is_missed_only_where_the_robot_looked_and_it_was_gone() -> None:
    missed = 0
    for seed in SEEDS:
        simulation, result = home(seed)
        for key, things in true_things(simulation):
            for each in found(result, key):
                if each.missed_by is None:
                    continue
                missed += 1
                stay = each.stays[-1]
                place, by = (stay.x / 1000, stay.y / 1000), seconds(each.missed_by)
                assert any(
                    visible(pose, place)
                    for time, pose in simulation.looks
                    if seconds(stay.last) < time <= by
                )
                there = [thing.place_at(by) for thing in things]
                assert all(at is None or math.dist(at, place) > 0.6 for at in there)
    assert missed > 0


def bag_of(
    *messages: tuple[tuple[float, float, float], list[PlacedDetection]], start: int = 0
) -> Sights:
    return sights_of_messages(
        [
            Message("/detections", (start + nth) * 10**9, robot, things)
            for nth, (robot, things) in enumerate(messages)
        ]
    )


def seen_at(
    x: float, y: float, label: str = "mug", score: float | None = None
) -> list[PlacedDetection]:
    return [PlacedDetection(label, (x, y, 0.7), score)]


def test_a_thing_is_missed_once_chance_alone_is_below_one_in_a_hundred() -> None:
    there = [bag_of(*[(HERE, seen_at(2, 0))] * 10)]
    twice = bag_of(*[(HERE, [])] * 2, start=100)
    often = bag_of(*[(HERE, [])] * 8, start=110)
    [mug] = estimate(whole([*there, twice]), LABELS).instances
    assert mug.missed_by is None
    assert mug.looks == 2
    [mug] = estimate(whole([*there, twice, often]), LABELS).instances
    assert mug.missed_by == 117 * 10**9
    assert mug.chance < 0.01


def test_a_thing_seen_once_in_ten_messages_is_missed_later_than_one_that_is_always_seen() -> None:
    rarely = [
        bag_of(*[(HERE, seen_at(2, 0) if each % 5 == 0 else []) for each in range(20)], start=t)
        for t in (0, 20, 40)
    ]
    empty = bag_of(*[(HERE, [])] * 12, start=100)
    [mug] = estimate(whole([*rarely, empty]), LABELS).instances
    assert mug.missed_by is None
    assert 0.01 < mug.chance < 0.2


def test_a_name_that_is_rarely_given_to_a_thing_is_its_other_name() -> None:
    messages = [(HERE, seen_at(2, 0, "cup" if nth % 10 == 0 else "mug")) for nth in range(100)]
    [mug] = estimate(whole([bag_of(*messages)]), LABELS).instances
    assert mug.key == "mug"
    assert mug.stays[0].also == {"cup": 10}
