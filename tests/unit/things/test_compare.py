"""What differs between two times, over bags of a robot whose map moves under its odometry."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import pytest

from tests.support.bags import Msg, log_entry, write_splits
from tests.support.memories import asked, memory_of, replied
from tests.unit.things.test_find import (
    AWAY,
    BEGIN,
    HERE,
    NAMED,
    looked,
    scene,
)

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


S = 10**9
MUG = ("mug", 3.0, 0.5)
BOOK = ("book", 3.5, -1.0)
FAR_MUG = ("mug", -2.0, 0.5)
EARLIER = {"with_start": BEGIN, "with_end": BEGIN + 29}
LATER = {"start": BEGIN + 60, "end": BEGIN + 89}


def compared(bag_dir: Path, messages: Sequence[Msg], **given: object) -> Any:
    write_splits(bag_dir, messages)
    return ask(bag_dir, **{**EARLIER, **LATER, **given})


def ask(bag_dir: Path, **given: object) -> Any:
    return asked(memory_of(bag_dir, limits=NAMED), bag_dir, "compare", **given)


def labels(reply: Any) -> dict[str, list[str]]:
    return {
        kind: [each["label"] for each in listed]
        for kind, listed in reply["things"].items()
        if isinstance(listed, list)
    }


def moved_mug() -> list[Msg]:
    return [
        *looked(0, 20, HERE, MUG, BOOK),
        *looked(20, 30, AWAY),
        *looked(60, 70, HERE, BOOK),
        *looked(70, 90, AWAY, FAR_MUG),
    ]


def test_a_thing_that_moved_is_listed_with_both_places(tmp_path: Path) -> None:
    reply = compared(tmp_path, moved_mug())
    [mug] = reply["things"]["moved"]
    assert mug == {
        "label": "mug",
        "was": {"x": 3.0, "y": 0.5, "in": "kitchen", "last_seen": BEGIN + 19},
        "is": {"x": -2.0, "y": 0.5, "first_seen": BEGIN + 70},
    }
    assert labels(reply) == {"moved": ["mug"]}
    assert reply["things_unchanged"] == 1
    assert reply["duration_s"] == {"this": 29.0, "with": 29.0}


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


def test_nothing_differs_between_equal_times(tmp_path: Path) -> None:
    reply = compared(tmp_path, looked(0, 90, HERE, MUG))
    assert reply["things"] == {}
    assert reply["things_unchanged"] == 1
    assert not reply.keys() & {"way", "minutes", "errors", "silent_s"}


def test_a_thing_appeared_only_where_its_place_was_looked_at_before(tmp_path: Path) -> None:
    fresh = looked(60, 90, HERE, MUG, BOOK)
    known = compared(tmp_path / "looked", [*looked(0, 30, HERE, BOOK), *fresh])
    assert labels(known) == {"appeared": ["mug"]}
    assert known["things"]["appeared"][0]["is"]["first_seen"] == BEGIN + 60
    unknown = compared(tmp_path / "away", [*looked(0, 30, AWAY), *fresh])
    assert labels(unknown) == {"not_looked_at": ["book", "mug"]}


def test_a_thing_is_missed_only_where_the_robot_looked_again(tmp_path: Path) -> None:
    seen = looked(0, 30, HERE, MUG)
    missed = compared(tmp_path / "missed", [*seen, *looked(60, 90, HERE)])
    [mug] = missed["things"]["not_seen_where_expected"]
    assert (mug["was"]["x"], mug["was"]["last_seen"]) == (3.0, BEGIN + 29)
    assert mug["missed_by"] == BEGIN + 69
    assert mug["looks"] == 30
    away = compared(tmp_path / "away", [*seen, *looked(60, 90, AWAY)])
    assert labels(away) == {"not_looked_at": ["mug"]}
    # What is missed after the later window is no difference between the two.
    after = [*seen, *looked(60, 90, AWAY), *looked(100, 130, HERE)]
    assert labels(compared(tmp_path / "after", after)) == {"not_looked_at": ["mug"]}


def test_a_thing_that_was_brought_back_in_between_is_not_missed(tmp_path: Path) -> None:
    seen = [*looked(0, 30, HERE, MUG), *looked(30, 45, HERE)]
    back = [*seen, *looked(45, 60, HERE, MUG), *looked(60, 90, AWAY)]
    assert labels(compared(tmp_path / "away", back)) == {"not_looked_at": ["mug"]}
    gone = [*seen, *looked(45, 60, HERE, MUG), *looked(60, 90, HERE)]
    [mug] = compared(tmp_path / "gone", gone)["things"]["not_seen_where_expected"]
    assert (mug["was"]["last_seen"], mug["missed_by"]) == (BEGIN + 29, BEGIN + 69)


def test_a_thing_that_was_brought_back_appeared(tmp_path: Path) -> None:
    there, gone = looked(0, 30, HERE, MUG, BOOK), looked(30, 60, HERE, BOOK)
    messages = [*there, *gone, *looked(60, 90, HERE, MUG, BOOK)]
    window = {"with_start": BEGIN + 30, "with_end": BEGIN + 59}
    reply = compared(tmp_path / "back", messages, **window)
    assert labels(reply) == {"appeared": ["mug"]}
    assert reply["things_unchanged"] == 1
    # It was there before, but whether in the earlier window is not known.
    away = [*there, *looked(30, 60, AWAY), *looked(60, 90, HERE, MUG, BOOK)]
    unknown = compared(tmp_path / "away", away, **window)
    assert labels(unknown) == {"not_looked_at": ["book", "mug"]}


def test_a_thing_that_was_moved_to_and_fro_is_unchanged(tmp_path: Path) -> None:
    visits = [*(0.5,) * 4, *(0.1,) * 4, *(0.48,) * 4]
    messages = [
        each
        for nth, y in enumerate(visits)
        for each in looked(nth * 120, nth * 120 + 30, HERE, ("mug", 3.0, y), BOOK)
    ]
    first = {"with_start": BEGIN, "with_end": BEGIN + 470}
    last = {"start": BEGIN + 960, "end": BEGIN + 1430}
    assert labels(compared(tmp_path, messages, **first, **last)) == {}
    moved = ask(tmp_path, **first, start=BEGIN + 480, end=BEGIN + 950)
    assert labels(moved) == {"moved": ["mug"]}


def test_where_keeps_the_things_that_were_in_a_region_in_either_window(tmp_path: Path) -> None:
    reply = compared(tmp_path, moved_mug(), where="kitchen")
    assert labels(reply) == {"moved": ["mug"]}
    not_only = "way, errors and silent_s are not only of that place"
    assert not_only in reply["notes"]
    assert not_only not in str(ask(tmp_path, **EARLIER, **LATER))
    there = ask(tmp_path, **EARLIER, **LATER, where={"x": -2.0, "y": 0.5, "radius_m": 0.5})
    assert labels(there) == {"moved": ["mug"]}
    assert there["things_unchanged"] == 0
    elsewhere = ask(tmp_path, **EARLIER, **LATER, where={"x": 9.0, "y": 9.0, "radius_m": 0.5})
    assert elsewhere["things"] == {}


def test_places_are_those_of_the_two_windows(tmp_path: Path) -> None:
    """The mug is in the kitchen, in between elsewhere, and then not looked at."""
    messages = [
        *looked(0, 20, HERE, MUG),
        *looked(30, 40, HERE),
        *looked(40, 55, AWAY, FAR_MUG),
        *looked(60, 90, (9.0, 9.0, 0.0)),
    ]
    reply = compared(tmp_path / "gone", messages, where="kitchen")
    [mug] = reply["things"]["not_seen_where_expected"]
    assert mug["was"] == {"x": 3.0, "y": 0.5, "in": "kitchen", "last_seen": BEGIN + 19}
    back = compared(
        tmp_path / "back", messages, where="kitchen", start=BEGIN, end=BEGIN + 25,
        with_start=BEGIN + 60, with_end=BEGIN + 89,
    )  # fmt: skip
    assert back["things"] == reply["things"]
    # What came in between, from a place that it had before both windows, is new there.
    fresh = [
        *looked(0, 20, AWAY, FAR_MUG),
        *looked(20, 30, AWAY),
        *looked(30, 50, HERE, BOOK),
        *looked(60, 90, HERE, BOOK, MUG),
    ]
    window = {"with_start": BEGIN + 30, "with_end": BEGIN + 50}
    reply = compared(tmp_path / "fresh", fresh, where="kitchen", **window)
    [mug] = reply["things"]["appeared"]
    assert mug == {
        "label": "mug",
        "is": {"x": 3.0, "y": 0.5, "in": "kitchen", "first_seen": BEGIN + 60},
    }


def test_way_minutes_and_errors_are_listed_where_they_differ(tmp_path: Path) -> None:
    drive = [
        message for at in range(60, 90) for message in scene(at, (1.0 + (at - 60) * 0.5, 0, 0), [])
    ]
    fault = log_entry((BEGIN + 70) * S, 40, "drive", "motor is hot")
    reply = compared(tmp_path, [*looked(0, 30, HERE), *drive, fault])
    way = reply["way"]
    assert way["distance_m"]["with"] == 0.0
    assert way["distance_m"]["this"] == pytest.approx(14.5, abs=0.2)
    assert way["stood_s"]["with"] == pytest.approx(29.0, abs=0.1)
    # The kitchen ends at x 6: it is left after 10 s.
    assert reply["minutes"]["kitchen"]["with"] == pytest.approx(29 / 60, abs=0.1)
    assert reply["minutes"]["kitchen"]["this"] == pytest.approx(10 / 60, abs=0.1)
    [(text, reports)] = reply["errors"].items()
    assert "motor is hot" in text
    assert reports == {"this": 1, "with": 0}


def test_minutes_are_null_where_no_pose_says_where_the_robot_was(tmp_path: Path) -> None:
    fault = log_entry((BEGIN + 70) * S, 40, "drive", "motor is hot")
    reply = compared(tmp_path, [*looked(0, 30, HERE), fault])
    assert reply["minutes"] == {"kitchen": {"this": None, "with": 0.48}}
    assert reply["way"]["stood_s"]["this"] is None


def drive(start: int, *corners: tuple[float, float]) -> list[Msg]:
    """Drives through corners (m) at 0.5 m/s, looking along x, two poses a second."""
    messages: list[Msg] = []
    at_s = float(start)
    for (x, y), (to_x, to_y) in pairwise(corners):
        steps = max(1, round(math.dist((x, y), (to_x, to_y)) / 0.25))
        for nth in range(steps):
            share = nth / steps
            pose = (x + share * (to_x - x), y + share * (to_y - y), 0.0)
            messages += scene(at_s, pose, [])
            at_s += 0.5
    return messages


STRAIGHT = ((0.0, 0.0), (8.0, 0.0))
DETOUR = ((0.0, 0.0), (3.0, 0.0), (3.0, 1.5), (5.0, 1.5), (5.0, 0.0), (8.0, 0.0))


def test_two_runs_of_a_route_differ_by_where_they_are_farthest_apart(tmp_path: Path) -> None:
    reply = compared(tmp_path, [*drive(0, *STRAIGHT), *drive(60, *DETOUR)])
    far = reply["farthest_apart"]
    assert far.keys() == {"this", "with"}
    assert far["this"]["y"] == pytest.approx(1.5, abs=0.1)
    assert far["this"]["away_m"] == pytest.approx(1.5, abs=0.1)
    assert far["this"]["in"] == "kitchen"
    assert BEGIN + 60 + 8 <= far["this"]["t"] <= BEGIN + 60 + 14
    assert far["with"]["x"] == pytest.approx(4.0, abs=0.2)
    assert far["with"]["away_m"] == pytest.approx(1.0, abs=0.1)
    assert reply["frame_id"] == "map"
    beyond = ask(tmp_path, **EARLIER, **LATER, where={"x": [6, 9], "y": [-1, 1]})
    assert "farthest_apart" not in beyond


def test_two_equal_runs_do_not_differ_in_space(tmp_path: Path) -> None:
    reply = compared(tmp_path, [*drive(0, *DETOUR), *drive(60, *DETOUR)])
    assert not reply.keys() & {"farthest_apart", "stood_at", "way"}


def test_standstills_are_compared_by_place_and_length(tmp_path: Path) -> None:
    """Ten seconds at the door and fifteen at the end, against half a minute at the end."""
    end = (4.0, 1.0, 0.0)
    messages = [
        *looked(0, 29, end),
        *looked(60, 75, (1.0, 1.0, 0.0)),
        *looked(75, 90, end),
    ]
    reply = compared(tmp_path, messages)
    door, at_end = sorted(reply["stood_at"], key=lambda each: each["x"])
    assert (door["x"], door["y"], door["in"]) == (1.0, 1.0, "kitchen")
    assert (door["this"], door["with"]) == (14, 0)
    assert door["this_since"] == BEGIN + 60
    assert "with_since" not in door
    assert (at_end["x"], at_end["this"], at_end["with"]) == (4.0, 14, 28)
    assert "stood_s" not in reply["way"]  # as much in all, but elsewhere
    near = ask(tmp_path, **EARLIER, **LATER, where={"x": 1.0, "y": 1.0, "radius_m": 1.0})
    assert [each["x"] for each in near["stood_at"]] == [1.0]


def test_odometry_that_began_anew_has_no_places_to_compare(tmp_path: Path) -> None:
    stood = looked(0, 30, HERE, BOOK, in_map=False)
    later = looked(60, 90, (3.0, 0.0, 0.0), BOOK, in_map=False)
    write_splits(tmp_path / "two", stood, name="first")
    write_splits(tmp_path / "two", later, name="second")
    reply = ask(tmp_path / "two", **EARLIER, **LATER)
    assert not reply.keys() & {"stood_at", "farthest_apart"}
    assert any("changes with every start" in note for note in reply["notes"])
    assert any("from one run of odometry to another" in note for note in reply["notes"])
    # It was seen in both windows, so that one was not "not looked at".
    [book] = reply["things"]["not_comparable"]
    assert labels(reply) == {"not_comparable": ["book"]}
    assert (book["was"]["last_seen"], book["is"]["first_seen"]) == (BEGIN + 29, BEGIN + 60)
    write_splits(tmp_path / "one", [*stood, *later])
    reply = ask(tmp_path / "one", **EARLIER, **LATER)
    assert len(reply["stood_at"]) == 2
    assert reply["frame_id"] == "odom"
    assert not any("from one run" in note for note in reply.get("notes", ()))


def test_of_odometry_that_began_anew_only_what_one_window_saw_was_not_looked_at(
    tmp_path: Path,
) -> None:
    person = ("person", 3.0, 0.5)
    first = looked(0, 30, HERE, BOOK, ("book", 3.5, 1.5), person, in_map=False)
    write_splits(tmp_path, first, name="first")
    write_splits(tmp_path, looked(60, 90, HERE, BOOK, MUG, person, in_map=False), name="second")
    reply = ask(tmp_path, **EARLIER, **LATER)
    assert labels(reply) == {
        "not_comparable": ["book"],
        "not_looked_at": ["mug", "book"],
        "movers": ["person"],
    }
    [mover] = reply["things"]["movers"]
    assert mover.keys() == {"label", "was", "is"}


def test_what_moves_by_itself_is_told_where_it_was_last(tmp_path: Path) -> None:
    someone, elsewhere = ("person", 3.0, 0.5), ("person", 4.0, -1.2)
    first = looked(0, 30, HERE, someone)
    here = compared(tmp_path / "here", [*first, *looked(60, 90, HERE, someone)])
    assert here["things"] == {}
    moved = compared(tmp_path / "moved", [*first, *looked(60, 90, HERE, elsewhere)])
    assert moved["things"]["movers"] == [
        {
            "label": "person",
            "was": {
                "times": 30,
                "at_once": 1,
                "x": 3.0,
                "y": 0.5,
                "in": "kitchen",
                "last_seen": BEGIN + 29,
            },
            "is": {
                "times": 30,
                "at_once": 1,
                "x": 4.0,
                "y": -1.2,
                "in": "kitchen",
                "last_seen": BEGIN + 89,
            },
        }
    ]
    two = compared(tmp_path / "two", [*first, *looked(60, 90, HERE, someone, elsewhere)])
    assert two["things"]["movers"][0]["is"]["at_once"] == 2
    alone = compared(tmp_path / "alone", [*first, *looked(60, 90, HERE)])
    [person] = alone["things"]["movers"]
    assert person.keys() == {"label", "was"}
    away = ask(tmp_path / "alone", **EARLIER, **LATER, where={"x": 9.0, "y": 9.0, "radius_m": 1.0})
    assert away["things"] == {}


def test_a_window_that_is_none_is_refused_by_its_name(tmp_path: Path) -> None:
    reply = compared(tmp_path, looked(0, 10, HERE), with_start=BEGIN + 9, with_end=BEGIN)
    assert reply["error"] == "invalid_arguments"
    assert "with_start" in reply["detail"]


def test_times_that_begin_together_have_no_things_to_compare(tmp_path: Path) -> None:
    reply = compared(tmp_path, moved_mug(), start=BEGIN, end=BEGIN + 89)
    assert reply["things"] == {}
    assert "things are not compared: the two times begin together" in reply["notes"]


def test_what_a_window_has_after_one_that_lies_in_it_is_not_compared_and_it_says_so(
    tmp_path: Path,
) -> None:
    messages = [*looked(0, 60, HERE, MUG), *looked(60, 90, HERE, MUG, BOOK)]
    within = {"start": BEGIN + 20, "end": BEGIN + 50, "with_start": BEGIN, "with_end": BEGIN + 89}
    [note] = [each for each in compared(tmp_path, messages, **within)["notes"] if "things" in each]
    assert note.startswith(f"things are not compared after {BEGIN + 50}")
    until_its_end = ask(tmp_path, **{**within, "end": BEGIN + 89})
    assert labels(until_its_end) == {"appeared": ["book"]}
    assert not any("things" in each for each in until_its_end["notes"])


def test_long_lists_are_cut_to_6_kb_with_their_totals(tmp_path: Path) -> None:
    many, gone, new = (
        [(f"{name}{nth:02}", 2.5 + nth % 6, 1.2 * (nth // 6) + y) for nth in range(24)]
        for name, y in (("thing", -2.0), ("lost", 3.0), ("new", -7.0))
    )
    shifted = [(label, x - 12.0, y) for label, x, y in many]
    messages = [
        *looked(0, 30, HERE, *many, *gone),
        *looked(60, 75, HERE, *new),
        *looked(75, 90, AWAY, *shifted),
    ]
    messages += [
        log_entry((BEGIN + 61 + nth) * S, 40, "drive", f"{nth} {'broken ' * 40}")
        for nth in range(20)
    ]
    write_splits(tmp_path, messages)
    memory = memory_of(tmp_path, limits=NAMED)
    text = replied(memory, tmp_path, "compare", {**EARLIER, **LATER}).text
    reply = ask(tmp_path, **EARLIER, **LATER)
    assert 3_000 < len(text) <= 6_000
    things = reply["things"]
    # At the edge of what the detector sees, what is not seen is not known.
    for kind, shown in (("moved", 10), ("appeared", 5), ("not_seen_where_expected", 5)):
        assert len(things[kind]) == shown
        assert 20 < things[f"{kind}_total"] <= 24
    assert reply["errors_total"] == 20


def test_a_thing_that_was_detected_without_a_place_is_not_missed(tmp_path: Path) -> None:
    lost = ("mug", math.nan, math.nan)
    reply = compared(tmp_path, [*looked(0, 20, HERE, MUG), *looked(60, 90, HERE, lost)])
    assert labels(reply) == {"not_looked_at": ["mug"]}
    [note] = reply["notes"]
    assert "could not be placed: mug (30 times" in note
