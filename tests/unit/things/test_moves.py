"""Things that were moved a little, and things that were not: over bags, and as sightings."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

from ros2_memory.core.arrays import Ints
from ros2_memory.things.places import Sightings, stays_in
from tests.support.bags import Msg, header, make, point, quaternion, write_splits
from tests.support.memories import asked, memory_of
from tests.unit.things.test_find import BEGIN, NAMED, S, scene

DAY: Final = 86_400
DAYS: Final = 6
LABELS: Final = ("mug", "book", "lamp", "bag", "vase", "radio", "plant", "clock")
LAST_DAY: Final = BEGIN + (DAYS - 1) * DAY


def ask(bag_dir: Path, tool: str, **given: object) -> Any:
    return asked(memory_of(bag_dir, limits=NAMED), bag_dir, tool, **given)


def compare(bag_dir: Path) -> Any:
    earlier = {"with_start": BEGIN, "with_end": LAST_DAY - 1}
    return ask(bag_dir, "compare", start=LAST_DAY, end=LAST_DAY + DAY, **earlier)


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
    for seed in range(20):
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
    assert right >= 0.99 * 20 * len(LABELS)


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
            at + 0.5,
            (1.0, off, 0.0),
            [("mug", 3.0, 0.5 + off), ("book", 3.0, -1.0 + off)],
            map_off=off,
        )
    ]


@pytest.mark.parametrize(
    ("sigma_m", "stop", "is_poor"),
    [(0.1, 120, False), *((1.0, stop, True) for stop in (108, 111, 116, 120))],
)
def test_what_is_seen_with_a_large_covariance_moves_nothing(
    tmp_path: Path, sigma_m: float, stop: int, is_poor: bool
) -> None:
    """Also what is seen behind the last fix of the sights."""
    good, later = seen_off(0, 30, 0.0), seen_off(90, stop, 0.4)
    write_splits(tmp_path, [amcl(0, 0.1), *good, amcl(89.9, sigma_m), *later])
    reply = ask(tmp_path, "find_things")
    for thing in reply["things"]:
        assert ("moved" in thing) == (not is_poor)
        assert (thing["place"]["y"] in {0.5, -1.0}) == is_poor
        assert (thing["last_seen"], thing["count"]) == (BEGIN + stop - 0.5, stop - 60)
    poor = [note for note in reply.get("notes", []) if "localisation was poor" in note]
    assert [note.endswith(": book, mug") for note in poor] == [True] * is_poor
    windows = {"with_start": BEGIN, "with_end": BEGIN + 30}
    reply = ask(tmp_path, "compare", start=BEGIN + 90, end=BEGIN + stop, **windows)
    assert reply["things_unchanged"] == 2 * is_poor
    assert ("moved" in reply["things"]) == (not is_poor)
    assert any("localisation was poor" in note for note in reply.get("notes", [])) == is_poor


def test_a_thing_that_was_only_seen_while_localisation_was_poor_is_listed(tmp_path: Path) -> None:
    write_splits(tmp_path, [amcl(0, 2.0), *seen_off(0, 30, 0.0)])
    reply = ask(tmp_path, "find_things", label="mug")
    [mug] = reply["things"]
    assert (mug["place"]["y"], mug["count"]) == (0.5, 30)
    [note] = reply["notes"]
    assert note.startswith("localisation was poor")
    assert note.endswith(": mug")
