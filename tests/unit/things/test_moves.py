"""Things that were moved a little, and things that were not: over bags, and as sightings."""

from __future__ import annotations

import math
from random import Random
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.analysis.sights import Ints, Look, fixes_of
from ros2_memory.columns.sights import joined, packed
from ros2_memory.things.places import Sightings, poorly_localised, stays_in
from tests.support.bags import Msg, header, make, point, quaternion, write_splits
from tests.support.examples import examples
from tests.support.memories import asked, memory_of
from tests.support.sights import Message, sights_of_messages
from tests.unit.things.test_find import BEGIN, NAMED, S, scene

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

DAY: Final = 86_400
DAYS: Final = 6
LABELS: Final = ("mug", "book", "lamp", "bag", "vase", "radio", "plant", "clock")
SIDES: Final = ((0.0, 0.0, 0.0), (6.0, 0.0, math.pi))
LAST_DAY: Final = BEGIN + (DAYS - 1) * DAY


class Home:
    """Eight things that are seen twice a day, from one side or the other, with 5 cm of noise.

    Args:
        moved: by how much (m) each is moved before the last day, at least and at most.
        bias: how far (m) the detector places a thing behind itself.
        sides: by day and visit, the side that the robot looks from; at random without.
    """

    def __init__(
        self, seed: int, moved: tuple[float, float] = (0, 0), bias: float = 0, sides: str = ""
    ) -> None:
        self._draw = Random(seed)
        self._bias = bias
        self.before = {label: (3.0 + (n % 2) * 0.8, n - 4.0) for n, label in enumerate(LABELS)}
        self.after = {label: self._moved(place, moved) for label, place in self.before.items()}
        self.messages: list[Msg] = []
        for visit in range(2 * DAYS):
            side = int(sides[visit // 2]) if sides else self._draw.randrange(2)
            at = visit // 2 * DAY + visit % 2 * 3600
            places = self.after if at >= (DAYS - 1) * DAY else self.before
            for second in range(8):
                seen = [(label, *self._seen(SIDES[side], place)) for label, place in places.items()]
                self.messages += scene(at + second, SIDES[side], seen)

    def _moved(self, place: tuple[float, float], moved: tuple[float, float]) -> tuple[float, float]:
        away, angle = self._draw.uniform(*moved), self._draw.uniform(0, 2 * math.pi)
        return place[0] + away * math.cos(angle), place[1] + away * math.sin(angle)

    def _seen(
        self, robot: tuple[float, float, float], place: tuple[float, float]
    ) -> tuple[float, float]:
        angle = math.atan2(place[1] - robot[1], place[0] - robot[0])
        noise = self._draw.gauss(0, 0.05), self._draw.gauss(0, 0.05)
        return (
            place[0] + self._bias * math.cos(angle) + noise[0],
            place[1] + self._bias * math.sin(angle) + noise[1],
        )


def found(bag_dir: Path, home: Home) -> dict[str, Any]:
    write_splits(bag_dir, home.messages)
    reply = ask(bag_dir, "find_things")
    assert reply["labels"] == dict.fromkeys(sorted(LABELS), 1)
    return {each["label"]: each for each in reply["things"]}


def ask(bag_dir: Path, tool: str, **given: object) -> Any:
    return asked(memory_of(bag_dir, limits=NAMED), bag_dir, tool, **given)


def compare(bag_dir: Path) -> Any:
    earlier = {"with_start": BEGIN, "with_end": LAST_DAY - 1}
    return ask(bag_dir, "compare", start=LAST_DAY, end=LAST_DAY + DAY, **earlier)


@pytest.mark.parametrize(("seed", "bias"), [(1, 0.0), (2, 0.1)])
def test_a_thing_that_was_moved_a_little_is_where_it_was_seen_last(
    tmp_path: Path, seed: int, bias: float
) -> None:
    home = Home(seed, (0.2, 0.6), bias)
    for label, thing in found(tmp_path, home).items():
        place = thing["place"]
        assert math.dist((place["x"], place["y"]), home.after[label]) < 0.05 + bias
        assert thing["moved_times"] == 1
        assert [each["to"] < LAST_DAY for each in thing["moved"]] == [True, False]
        assert thing["count"] == 2 * 8 * DAYS
        assert "in_view" in thing["still_there"]
    reply = compare(tmp_path)
    assert sorted(each["label"] for each in reply["things"]["moved"]) == sorted(LABELS)
    for each in reply["things"]["moved"]:
        assert (
            math.dist((each["is"]["x"], each["is"]["y"]), home.after[each["label"]]) < 0.05 + bias
        )
        was = each["was"]["x"], each["was"]["y"]
        assert math.dist(was, home.before[each["label"]]) < 0.05 + bias
    assert reply["things_unchanged"] == 0


# -- sightings, in many worlds -------------------------------------------------------------------


def sightings(
    draw: np.random.Generator,
    places: Sequence[tuple[float, float]],
    *,
    visit_mm: float = 0.0,
    bias_mm: float = 0.0,
    sides: int = 2,
) -> Sightings:
    """A thing at a place (mm) by visit, two a day, each of two bags with ten looks."""
    xy, dev, side, first = [], [], [], []
    for nth, place in enumerate(places):
        angle = draw.integers(sides) * 2 * math.pi / sides
        view = np.array([math.cos(angle), math.sin(angle)])
        off = np.array(place) + bias_mm * view + draw.normal(0, visit_mm, 2)
        for bag in range(2):
            looks = off + draw.normal(0, 50, (10, 2))
            xy.append(looks.mean(axis=0))
            dev.append(math.sqrt(((looks - xy[-1]) ** 2).sum(axis=1).mean()))
            side.append(view)
            first.append((nth * DAY // 2 + bag * 10) * S)
    begin = np.array(first)
    n = np.full(len(begin), 10)
    return Sightings(np.array(xy), n, np.array(dev), np.array(side), begin, begin + 9 * S)


def stays_of(things: list[Sightings]) -> list[Ints]:
    together = Sightings(*map(np.concatenate, zip(*things, strict=True)))
    return stays_in(together, np.repeat(np.arange(len(things)), [len(one.n) for one in things]))


NOISE: Final = [
    {},
    {"visit_mm": 30.0},
    {"bias_mm": 100.0},
    {"bias_mm": 100.0, "visit_mm": 20.0, "sides": 8},
]


@pytest.mark.parametrize("noise", NOISE)
def test_nearly_all_small_moves_are_found_and_none_is_made_up(noise: dict[str, Any]) -> None:
    right = 0
    for seed in range(40):
        draw = np.random.default_rng(seed)
        still = [sightings(draw, [(0.0, 0.0)] * 12, **noise) for _ in LABELS]
        assert not any(stay.any() for stay in stays_of(still))
        moved = []
        for _ in LABELS:
            away, angle = draw.uniform(200, 600), draw.uniform(0, 2 * math.pi)
            new = (away * math.cos(angle), away * math.sin(angle))
            moved.append(sightings(draw, [(0.0, 0.0)] * 10 + [new] * 2, **noise))
        truth = [0] * 20 + [1] * 4
        right += sum(stay.tolist() == truth for stay in stays_of(moved))
    assert right >= 0.99 * 40 * len(LABELS)


def test_one_far_look_moves_nothing() -> None:
    draw = np.random.default_rng(1)
    seen = sightings(draw, [(0.0, 0.0)] * 6 + [(500.0, 0.0)])
    looks = seen.n.copy()
    looks[-2:] = 1
    [stay] = stays_of([seen._replace(n=looks)])
    assert not stay.any()


@settings(max_examples=examples(40), deadline=None)
@given(
    seed=st.integers(0, 2**32),
    turn=st.floats(0, 2 * math.pi),
    off=st.tuples(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4)),
)
def test_stays_do_not_depend_on_where_the_map_begins(
    seed: int, turn: float, off: tuple[float, float]
) -> None:
    draw = np.random.default_rng(seed)
    moved = [(0.0, 0.0)] * 6 + [(draw.uniform(0, 600), 0.0)] * 4
    seen = sightings(draw, moved, bias_mm=50.0, sides=5)
    turned = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
    other = seen._replace(xy=seen.xy @ turned + np.array(off), side=seen.side @ turned)
    assert stays_of([seen])[0].tolist() == stays_of([other])[0].tolist()


# -- while localisation was poor -----------------------------------------------------------------


def amcl(at_s: float, sigma_m: float) -> Msg:
    """What a localiser says of the robot: with this standard deviation along x and y."""
    at = BEGIN * S + round(at_s * S)
    covariance = np.zeros(36)
    covariance[[0, 7]] = sigma_m**2
    pose = make("geometry_msgs/msg/Pose", position=point(0, 0), orientation=quaternion(0))
    spread = make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance)
    type_name = "geometry_msgs/msg/PoseWithCovarianceStamped"
    return Msg("/amcl_pose", type_name, at, make(type_name, header=header(at, "map"), pose=spread))


def seen_off(start: int, stop: int, off: float) -> list[Msg]:
    """What is seen of a mug and a book by a robot that takes itself to be farther left (m)."""
    return [
        message
        for at in range(start, stop)
        for message in scene(
            at, (1.0, off, 0.0), [("mug", 3.0, 0.5 + off), ("book", 3.0, -1.0 + off)], map_off=off
        )
    ]


def test_what_is_seen_before_the_map_jumps_moves_nothing(tmp_path: Path) -> None:
    """The map slips by 0.5 m, unnoticed for four seconds, across the end of a split or not."""
    for start in (34, 38):
        folder = tmp_path / str(start)
        slipped = [*seen_off(0, start, 0.0), *seen_off(start, start + 4, 0.5)]
        write_splits(folder, [*slipped, *seen_off(start + 4, start + 6, 0.0)])
        reply = ask(folder, "find_things")
        assert {each["place"]["y"] for each in reply["things"]} == {0.5, -1.0}
        assert not any("moved" in each for each in reply["things"])


@pytest.mark.parametrize(("sigma_m", "is_poor"), [(0.1, False), (1.0, True)])
def test_what_is_seen_with_a_large_covariance_moves_nothing(
    tmp_path: Path, sigma_m: float, is_poor: bool
) -> None:
    good, later = seen_off(0, 30, 0.0), seen_off(90, 120, 0.4)
    write_splits(tmp_path, [amcl(0, 0.1), *good, amcl(89.9, sigma_m), *later])
    reply = ask(tmp_path, "find_things")
    for thing in reply["things"]:
        assert ("moved" in thing) == (not is_poor)
        assert (thing["place"]["y"] in {0.5, -1.0}) == is_poor
        assert (thing["last_seen"], thing["count"]) == (BEGIN + 119, 60)
    poor = [note for note in reply.get("notes", []) if "localisation was poor" in note]
    assert [note.endswith(": book, mug") for note in poor] == [True] * is_poor
    windows = {"with_start": BEGIN, "with_end": BEGIN + 30}
    reply = ask(tmp_path, "compare", start=BEGIN + 90, end=BEGIN + 119, **windows)
    assert reply["things_unchanged"] == 2 * is_poor
    assert ("moved" in reply["things"]) == (not is_poor)
    assert any("localisation was poor" in note for note in reply.get("notes", [])) == is_poor


def test_fixes_of_two_robots_in_turn_are_no_jumps_of_the_map() -> None:
    poses = np.zeros((30, 3))
    times = (BEGIN + np.arange(30)) * S
    seen = [Message("/detections", time, (0, 0, 0), []) for time in times.tolist()]
    fixes = [fixes_of(times + off * S // 2, poses + off, NOT_SAID) for off in (0, 1)]
    bags = [packed(part) for part in (sights_of_messages(seen), *fixes)]
    for sessions, is_poor in (([0, 0, 0], True), ([0, 0, 1], False)):
        sights = joined(bags, [0] * len(bags), sessions)
        assert poorly_localised(sights)[1].any() == is_poor


NOT_SAID: Final = np.full(30, math.nan)


def test_a_slice_in_which_localisation_was_poor_is_poor_as_a_whole() -> None:
    """A look from beside would miss what is left out of what another has seen."""
    begin = BEGIN // 10 * 10  # of a slice of ten seconds
    places = {0: (0, 0, 0), 4: (3, 0, 0), 8: (0, 3, 0), 12: (3, 3, 0)}
    seen = [Message("/detections", (begin + at) * S, place, []) for at, place in places.items()]
    said = fixes_of(np.array([begin - 1, begin + 1]) * S, np.zeros((2, 3)), np.array([2.0, 0.05]))
    sights = joined([packed(sights_of_messages(seen)), packed(said)], [0, 0], [0, 0])
    _, looks = poorly_localised(sights)
    slices = sights.looks[:, Look.SLICE]
    assert len(looks) == 4
    assert looks.tolist() == (slices == slices.min()).tolist()


def test_a_thing_that_was_only_seen_while_localisation_was_poor_is_listed(tmp_path: Path) -> None:
    write_splits(tmp_path, [amcl(0, 2.0), *seen_off(0, 30, 0.0)])
    reply = ask(tmp_path, "find_things", label="mug")
    [mug] = reply["things"]
    assert (mug["place"]["y"], mug["count"]) == (0.5, 30)
    [note] = reply["notes"]
    assert note.startswith("localisation was poor")
    assert note.endswith(": mug")


def test_what_is_far_off_while_localisation_is_poor_is_no_second_thing(tmp_path: Path) -> None:
    far = seen_off(90, 120, 3.0)
    write_splits(tmp_path, [amcl(0, 0.1), *seen_off(0, 30, 0.0), amcl(89.9, 2.0), *far])
    reply = ask(tmp_path, "find_things", label="mug")
    [mug] = reply["things"]
    assert (mug["place"]["y"], mug["last_seen"]) == (0.5, BEGIN + 29)
    assert mug["still_there"] == {"not_looked_at_since": BEGIN + 29}
    assert any(note.startswith("localisation was poor") for note in reply["notes"])


@pytest.mark.parametrize(
    ("bias", "sides"), [(0.0, ""), (0.1, ""), (0.1, "000001"), (0.1, "000011"), (0.1, "010101")]
)
def test_a_world_without_moves_has_none(tmp_path: Path, bias: float, sides: str) -> None:
    things = found(tmp_path, Home(4, bias=bias, sides=sides))
    assert not any("moved" in thing for thing in things.values())
    reply = compare(tmp_path)
    assert (reply["things"], reply["things_unchanged"]) == ({}, len(LABELS))
