"""What differs between two times, over bags of a robot whose map moves under its odometry."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tests.support.bags import Msg, write_splits
from tests.support.memories import asked, memory_of
from tests.unit.things.test_find import (
    AWAY,
    BEGIN,
    HERE,
    NAMED,
    looked,
)

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
    away = ask(tmp_path / "alone", **EARLIER, **LATER, where={"x": 9.0, "y": 9.0, "radius_m": 1.0})
    assert away["things"] == {}


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
