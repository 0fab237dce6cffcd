"""What differs between two times, over bags of a robot whose map moves under its odometry."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

from ros2_memory.analysis.sights import Floats, Spot
from ros2_memory.core.arrays import Ints
from ros2_memory.core.timebase import ns_from_unix
from ros2_memory.things.places import stays_in
from tests.support.bags import (
    Msg,
    detected,
    header,
    make,
    odom,
    point,
    quaternion,
    tf,
    tf_of,
    transform,
    write_mcap,
    write_splits,
)
from tests.support.memories import Remember, asked, memory_of, noted
from tests.unit.things.test_find import (
    BEGIN,
    HERE,
    NAMED,
    S,
    Seen,
    looked,
    scene,
)

MUG = ("mug", 3.0, 0.5)
BOOK = ("book", 3.5, -1.0)
EARLIER = {"with_start": BEGIN, "with_end": BEGIN + 29}
LATER = {"start": BEGIN + 60, "end": BEGIN + 89}


def compared(bag_dir: Path, messages: Sequence[Msg], **given: object) -> Any:
    write_splits(bag_dir, messages)
    return ask(bag_dir, "compare", **{**EARLIER, **LATER, **given})


def ask(bag_dir: Path, tool: str, **given: object) -> Any:
    return asked(memory_of(bag_dir, limits=NAMED), tool, **given)


def labels(reply: Any) -> dict[str, list[str]]:
    return {
        kind: [each["label"] for each in listed]
        for kind, listed in reply["things"].items()
        if isinstance(listed, list)
    }


def test_things_that_stand_together_are_compared_by_their_number(tmp_path: Path) -> None:
    cups = [("cup", 3.0, nth * 0.25) for nth in range(3)]
    reply = compared(
        tmp_path / "two", [*looked(0, 30, HERE, *cups), *looked(60, 90, HERE, *cups[1:])]
    )
    [fewer] = reply["things"]["more_or_fewer"]
    assert (fewer["was"]["at_once"], fewer["is"]["at_once"]) == (3, 2)
    assert (labels(reply), reply["things_unchanged"]) == ({"more_or_fewer": ["cup"]}, 0)
    same = compared(tmp_path / "same", [*looked(0, 30, HERE, *cups), *looked(60, 90, HERE, *cups)])
    assert (same["things"], same["things_unchanged"]) == ({}, 1)


def test_alike_things_that_two_detectors_see_do_not_stand_together(tmp_path: Path) -> None:
    """Each message of both has all of them."""
    things = [("pallet", 0.9, (2.0, y, 0.5)) for y in (-2.0, 0.0, 2.0)]
    messages: list[Msg] = []
    for at_s in range(30):
        *posed, _ = scene(at_s, HERE, ())
        at = BEGIN * S + at_s * S
        messages += [*posed, *(detected(at, things, topic=topic) for topic in ("/left", "/right"))]
    write_splits(tmp_path, messages)
    found = ask(tmp_path, "find_things")
    assert found["total"] == 3
    assert not [thing for thing in found["things"] if "at_once" in thing]


def test_a_door_that_was_closed_while_another_was_opened_is_not_the_other(tmp_path: Path) -> None:
    """One of the boxes was carried to where the other was, and both may be empty."""

    def seen(left: str, right: str) -> list[Seen]:
        return [(left, 3.0, 1.5), (right, 3.0, -1.5)]

    before = [*seen("door_open", "door_closed"), ("box 7", 4.0, 1.5), ("box 8", 4.0, -1.5)]
    after = [*seen("door_closed", "door_open"), ("box 8", 4.0, 1.5), ("box 7", 4.0, -1.5)]
    reply = compared(tmp_path, [*looked(0, 30, HERE, *before), *looked(60, 90, HERE, *after)])
    assert {kind: sorted(of_kind) for kind, of_kind in labels(reply).items()} == {
        "moved": ["box 7", "box 8"],
        "appeared": ["door closed", "door open"],
        "not_seen_where_expected": ["door closed", "door open"],
    }


def test_of_two_that_stood_together_one_is_missing_where_the_other_is_now(tmp_path: Path) -> None:
    two, one = [("cup", 3.0, 0.0), ("cup", 3.0, 0.25)], ("cup", 3.0, -1.5)
    reply = compared(tmp_path, [*looked(0, 30, HERE, *two), *looked(60, 90, HERE, one)])
    [moved] = reply["things"]["moved"]
    assert (moved["was"]["at_once"], moved["is"]["at_once"]) == (2, 1)
    reply = compared(tmp_path / "one", [*looked(0, 30, HERE, two[0]), *looked(60, 90, HERE, one)])
    [moved] = reply["things"]["moved"]
    assert "at_once" not in moved["was"] | moved["is"]


def test_one_more_that_came_since_the_visit_before_stands_beside_the_other(tmp_path: Path) -> None:
    """Although it was not there in most of the times that the robot looked."""
    cup, came = ("cup", 3.0, 0.0), ("cup", 3.0, 0.25)
    visits = [message for at in range(0, 1000, 100) for message in looked(at, at + 10, HERE, cup)]
    reply = compared(
        tmp_path, [*visits, *looked(1000, 1020, HERE, cup, came)], with_end=BEGIN + 999,
        start=BEGIN + 1000, end=BEGIN + 1020,
    )  # fmt: skip
    [more] = reply["things"]["more_or_fewer"]
    assert (more["was"]["at_once"], more["is"]["at_once"]) == (1, 2)
    found = ask(tmp_path, "find_things", label="cup")
    assert (found["total"], found["things"][0]["at_once"]) == (2, 2)


def test_things_that_all_went_the_same_way_may_stand_on_a_map_that_shifted(tmp_path: Path) -> None:
    stood = [("cup", 3.0, 0.0), ("mug", 3.0, 1.0), ("book", 2.5, -1.0), ("vase", 2.0, 0.5)]
    more = [("lamp", 2.0, -0.5), ("jar", 4.0, 0.5), ("bowl", 4.0, -0.5)]
    shifted = [(label, x + 0.3, y + 0.01 * nth) for nth, (label, x, y) in enumerate(stood)]
    pushed = [(label, x + 0.3 * nth, y - 0.3) for nth, (label, x, y) in enumerate(stood)]

    def notes(name: str, was: Sequence[Seen], now: Sequence[Seen]) -> list[str]:
        reply = compared(tmp_path / name, [*looked(0, 30, HERE, *was), *looked(60, 90, HERE, *now)])
        return noted(reply, "shifted")

    [note] = notes("all", stood, shifted)
    assert note.startswith("4 of the 4 things in moved went the same way, x +0.30 m and y +0.0")
    [note] = notes("most", stood, [*shifted[:3], pushed[3]])
    assert note.startswith("3 of the 4 things")
    assert notes("three of seven", [*stood, *more], [*shifted[:3], stood[3], *more]) == []
    assert notes("each its own", stood, pushed) == []


def test_the_one_crate_that_appeared_is_listed_beside_more_grapes_than_a_reply_has(
    tmp_path: Path,
) -> None:
    grapes = [("grape", 2.0 + 0.8 * (nth % 4), 0.8 * (nth // 4)) for nth in range(12)]
    crate = ("crate", 3.0, -1.0)
    reply = compared(
        tmp_path,
        [
            *looked(0, 30, HERE, MUG),
            *looked(60, 75, HERE, MUG, *grapes, crate),
            *looked(75, 90, HERE, MUG, *grapes),
        ],
    )
    appeared = reply["things"]["appeared"]
    assert [thing["label"] for thing in appeared] == ["crate", *["grape"] * 4]
    assert reply["things"]["appeared_total"] == 13


@pytest.mark.parametrize("frame", ["utm", "earth"])
def test_a_map_that_was_laid_out_anew_between_two_days_is_said_to_be(
    tmp_path: Path, frame: str
) -> None:
    """As by robot_localization, whose map begins where the robot was switched on."""

    def day(name: str, begin: int, utm_x: float) -> None:
        at = (BEGIN + begin) * S
        anchor = tf_of(at, "map", frame, (utm_x, -5.32e6, 0.0), topic="/tf_static")
        seen = [anchor, *looked(begin, begin + 30, HERE, MUG, BOOK)]
        write_mcap(tmp_path / name / f"{name}_0.mcap", seen)

    day("monday", 0, -455_000.0)
    day("tuesday", 60, -455_012.4)
    note = f"{frame} is 12.40 m elsewhere in map than before"
    assert note in str(ask(tmp_path, "compare", **EARLIER, **LATER)["notes"])
    day("wednesday", 120, -455_012.4)
    later = {"start": BEGIN + 120, "end": BEGIN + 149}
    same = ask(tmp_path, "compare", with_start=BEGIN + 60, with_end=BEGIN + 89, **later)
    assert "elsewhere" not in str(same.get("notes"))
    for tool, at in (("find_things", {"label": "mug"}), ("visits", {"x": 0, "y": 0})):
        assert note in str(ask(tmp_path, tool, **at)["notes"])
        alone = ask(tmp_path, tool, start=BEGIN + 60, **at)
        assert "elsewhere" not in str(alone.get("notes"))


def test_odometry_that_began_anew_has_no_places_to_compare(tmp_path: Path) -> None:
    stood = looked(0, 30, HERE, BOOK, in_map=False)
    later = looked(60, 90, (3.0, 0.0, 0.0), BOOK, in_map=False)
    write_splits(tmp_path / "two", stood, name="first")
    write_splits(tmp_path / "two", later, name="second")
    reply = ask(tmp_path / "two", "compare", **EARLIER, **LATER)
    assert "stood_at" not in reply
    assert "changes with every start" in str(reply["notes"])
    assert "from one run of odometry to another" in str(reply["notes"])
    # It was seen in both windows, so that one was not "not looked at".
    [book] = reply["things"]["not_comparable"]
    assert labels(reply) == {"not_comparable": ["book"]}
    assert (book["was"]["last_seen"], book["is"]["first_seen"]) == (BEGIN + 29, BEGIN + 60)
    write_splits(tmp_path / "one", [*stood, *later])
    reply = ask(tmp_path / "one", "compare", **EARLIER, **LATER)
    assert len(reply["stood_at"]) == 2
    assert reply["frame_id"] == "odom"
    assert "from one run" not in str(reply.get("notes"))


def test_what_moves_by_itself_is_told_where_it_was_last(tmp_path: Path) -> None:
    someone, elsewhere = ("person", 3.0, 0.5), ("person", 4.0, -1.2)
    first = looked(0, 30, HERE, someone)
    here = compared(tmp_path / "here", [*first, *looked(60, 90, HERE, someone)])
    assert here["things"] == {}
    two = compared(tmp_path / "two", [*first, *looked(60, 90, HERE, someone, elsewhere)])
    [person] = two["things"]["movers"]
    assert (person["was"]["at_once"], person["is"]["at_once"]) == (1, 2)
    assert person["was"]["last_seen"] == BEGIN + 29
    alone = compared(tmp_path / "alone", [*first, *looked(60, 90, HERE)])
    [person] = alone["things"]["movers"]
    assert person.keys() == {"label", "was"}
    away = ask(
        tmp_path / "alone",
        "compare",
        **EARLIER,
        **LATER,
        where={"x": 9.0, "y": 9.0, "radius_m": 1.0},
    )
    assert away["things"] == {}


def test_what_a_window_has_after_one_that_lies_in_it_is_not_compared_and_it_says_so(
    tmp_path: Path,
) -> None:
    messages = [*looked(0, 60, HERE, MUG), *looked(60, 90, HERE, MUG, BOOK)]
    within = {"start": BEGIN + 20, "end": BEGIN + 50, "with_start": BEGIN, "with_end": BEGIN + 89}
    [note] = noted(compared(tmp_path, messages, **within), "things")
    assert note.startswith(f"things are not compared after {BEGIN + 50}")
    until_its_end = ask(tmp_path, "compare", **{**within, "end": BEGIN + 89})
    assert labels(until_its_end) == {"appeared": ["book"]}
    assert "things" not in str(until_its_end["notes"])


LABELS: Final = ("mug", "book", "lamp", "bag", "vase", "radio", "plant", "clock")


Thing = tuple[Ints, Floats]
"""Rows of `Spot`, and from which side each was seen."""


# -- sightings, in many worlds -------------------------------------------------------------------


def sightings(
    draw: np.random.Generator,
    places: Sequence[tuple[float, float]],
    *,
    visit_mm: float = 0.0,
    bias_mm: float = 0.0,
    sides: int = 2,
) -> Thing:
    """A thing at a place (mm) by visit, two a day, each of two bags with ten looks."""
    spots, side = [], []
    for nth, place in enumerate(places):
        angle = draw.integers(sides) * 2 * math.pi / sides
        view = np.array([math.cos(angle), math.sin(angle)])
        off = np.array(place) + bias_mm * view + draw.normal(0, visit_mm, 2)
        for bag in range(2):
            looks = off + draw.normal(0, 50, (10, 2))
            spot = np.zeros(len(Spot), np.int64)
            spot[[Spot.X, Spot.Y]] = xy = looks.mean(axis=0)
            spot[Spot.DEV] = math.sqrt(((looks - xy) ** 2).sum(axis=1).mean())
            spot[Spot.FIRST] = (nth * 43_200 + bag * 10) * S
            spot[Spot.LAST] = spot[Spot.FIRST] + 9 * S
            spots.append(spot)
            side.append(view)
    return np.array(spots), np.array(side)


def stays_of(things: list[Thing]) -> list[Ints]:
    spots, side = map(np.concatenate, zip(*things, strict=True))
    thing = np.repeat(np.arange(len(things)), [len(one) for one, _ in things])
    return stays_in(spots, np.full(len(spots), 10), side, thing)


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
    poor = noted(reply, "localisation was poor")
    assert [note.endswith(": book, mug") for note in poor] == [True] * is_poor
    windows = {"with_start": BEGIN, "with_end": BEGIN + 30}
    reply = ask(tmp_path, "compare", start=BEGIN + 90, end=BEGIN + stop, **windows)
    assert reply["things_unchanged"] == 2 * is_poor
    assert ("moved" in reply["things"]) == (not is_poor)
    assert ("localisation was poor" in str(reply.get("notes"))) == is_poor


def corrected(at_s: float, robot: tuple[float, float, float], turn: float) -> list[Msg]:
    """The robot, 60 m from the origin of its odometry, in a map that is turned about the robot."""
    at = BEGIN * S + round(at_s * S)
    x, y, yaw = robot
    cos, sin = math.cos(turn), math.sin(turn)
    origin = (x - 60.0 * cos, y - 60.0 * sin, 0.0)
    pose = transform(at, "odom", "base_link", (60.0, 0.0, 0.0), yaw - turn)
    return [
        odom(at, 60.0, 0.0, yaw - turn),
        tf(at, transform(at, "map", "odom", origin, turn), pose),
    ]


@pytest.mark.parametrize(("turn", "is_poor"), [(0.012, False), (0.25, True)])
def test_a_small_turn_of_the_map_far_from_the_origin_of_odometry_is_no_jump(
    tmp_path: Path, turn: float, is_poor: bool
) -> None:
    """Localisers correct the heading all the time; what counts is how far the robot moves by it."""
    seen = [("mug", 0.9, (2.0, 0.5, 0.7)), ("book", 0.9, (2.5, -1.0, 0.7))]
    moved = [(label, score, (x, y + 0.4, z)) for label, score, (x, y, z) in seen]
    messages: list[Msg] = []
    for at in [*range(30), *range(90, 120)]:
        messages += corrected(at, HERE, turn if at > 60 and at % 4 < 2 else 0.0)
        messages.append(detected(BEGIN * S + at * S, seen if at < 60 else moved))
    write_splits(tmp_path, messages)
    reply = ask(tmp_path, "find_things")
    assert ["moved" in thing for thing in reply["things"]] == [not is_poor] * 2
    assert ("localisation was poor" in str(reply.get("notes"))) == is_poor


@pytest.mark.parametrize("cut_s", [60.0, 89.75])
@pytest.mark.parametrize("sigmas_m", [(0.1, 1.0), (1.0, 0.1)])
def test_the_covariance_that_a_localiser_gave_last_counts_wherever_its_bags_are_cut(
    tmp_path: Path, remember: Remember, sigmas_m: tuple[float, float], cut_s: float
) -> None:
    """A localiser says nothing while the robot stands: its last message holds until the next."""
    given = [amcl(at, sigma_m) for at, sigma_m in zip((89.6, 89.9), sigmas_m, strict=True)]
    messages = [amcl(0, 0.1), *seen_off(0, 30, 0.0), *given, *seen_off(90, 116, 0.4)]
    cut = ns_from_unix(BEGIN + cut_s)
    before = [message for message in messages if message.log_time < cut]
    write_mcap(tmp_path / "rec" / "rec_0.mcap", before)
    write_mcap(tmp_path / "rec" / "rec_1.mcap", messages[len(before) :])
    reply = asked(remember(limits=NAMED), "find_things")
    assert ["moved" in thing for thing in reply["things"]] == [sigmas_m[-1] < 1.0] * 2
