"""How long a state lasts that one message states, and no other message repeats."""

from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

from ros2_memory.history.context import Memory
from tests.support.bags import (
    McapLayout,
    along_x,
    battery,
    boolean,
    in_order,
    odom,
    text,
    write_mcap,
    write_splits,
)
from tests.support.clocks import FixedClock
from tests.support.memories import Remember, asked, clause, each_way, memory_of, remembered
from tests.support.tables import table

S = 10**9
T0 = 1_790_000_000 * S
DOCKED, BUMPER = "/docked", "/bumper"
TOGGLES = ((0, False), (100, True), (400, False), (700, True))


@pytest.fixture(scope="module")
def bag_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """1000 s of a robot that says latched when it docks, and every 4 s whether it bumped."""
    folder = tmp_path_factory.mktemp("bags")
    messages = [odom(T0 + at * S, 0.0, 0.0) for at in range(0, 1001, 2)]
    messages += [boolean(T0 + at * S, value, DOCKED) for at, value in TOGGLES]
    messages += [boolean(T0 + at * S, at >= 700, BUMPER) for at in range(0, 1001, 4)]
    write_splits(folder, messages, 600, layout=McapLayout(latched=frozenset({DOCKED})))
    return folder


@patch("ros2_memory.analysis.topic_events.MAX_EVENTS", 25)
def test_of_more_changes_than_memory_holds_the_first_are_counted_and_a_note_says_so(
    remember: Remember,
) -> None:
    """It toggles each second for 100 s; no question may know of more than 25 changes."""
    counted = matches(
        remember([boolean(T0 + at * S, at % 2 == 1, BUMPER) for at in range(100)], split_s=10),
        BUMPER,
        0,
        99,
        by="day",
    )
    whole = table(counted)["all"]
    assert (whole["count"], whole["seconds"], whole["last_unix"]) == (13, 12, T0 / S + 25)
    assert f"{BUMPER} changes too often to count all: {99 - 25} more" in counted["notes"]


def matches(memory: Memory, topic: str, first: float, last: float, **more: object) -> Any:
    given = {"topic": topic, "condition_type": "equals", "value": True, **more}
    return asked(memory, "find_matches", start=T0 / S + first, end=T0 / S + last, **given)


@each_way
def test_a_state_lasts_until_a_message_says_otherwise_or_to_the_end_of_the_window(
    bag_dir: Path, recalls: bool
) -> None:
    memory = memory_of(bag_dir, recalls=recalls)
    for topic, first, last, held, began in (
        (DOCKED, 0, 1000, 600, 2),
        (DOCKED, 0, 900, 500, 2),
        (DOCKED, 50, 350, 250, 1),
        (DOCKED, 300, 900, 300, 1),
        (DOCKED, 750, 950, 200, 0),
        (DOCKED, 450, 650, 0, 0),
        (BUMPER, 0, 902, 202, 1),
        (BUMPER, 0, 703, 3, 1),
    ):
        whole = table(matches(memory, topic, first, last, by="day"))["all"]
        assert (whole["seconds"], whole["count"]) == (held, began), (topic, first, last)


def test_what_a_latched_topic_states_is_found_while_a_scope_holds(
    tmp_path: Path, remember: Remember
) -> None:
    """auto from 0 to 45 s and from 70 s on; bumped from 20 to 30, from 40 to 50 and from 80 s.

    What follows while it is still met begins nothing: `auto 3` at 85 s.
    """
    bumps = [at for at in range(0, 101, 2) if 20 <= at < 30 or 40 <= at < 50 or at >= 80]
    messages = [boolean(T0 + at * S, at in bumps, BUMPER) for at in range(0, 101, 2)]
    said = ((0, "auto"), (45, "manual"), (70, "auto 2"), (85, "auto 3"))
    messages += [text(T0 + at * S, words, "/mode") for at, words in said]
    messages += along_x(T0, 101, mps=0.1)
    write_splits(tmp_path, messages, 600, layout=McapLayout(latched=frozenset({"/mode"})))
    memory = remember()
    bumped = clause(BUMPER, "equals", True)
    auto = {"topic": "/mode", "condition_type": "contains", "value": "auto", "while": bumped}
    found = asked(memory, "find_matches", **auto)
    rows = [(row["first_seen"] - T0 / S, row["duration_s"]) for row in found["sightings"]]
    assert rows == [(80, 20), (40, 5), (20, 10)]
    texts = [row["matched"] for row in found["sightings"]]
    assert texts == [["auto 3"], ["auto"], ["auto"]]
    assert [row.get("count") for row in found["sightings"]] == [1, None, None]
    assert [row["robot"]["x"] for row in found["sightings"]] == [8.0, 4.0, 2.0]
    assert (found["total"], "notes" in found) == (3, False)
    counted = asked(memory, "find_matches", **auto, by="day")
    whole = table(counted)["all"]
    assert (whole["seconds"], whole["count"]) == (35, 3)
    later = asked(memory, "find_matches", **auto, by="day", start=T0 / S + 25)
    assert table(later)["all"]["seconds"] == 30
    place = {"x": [1.0, 3.0], "y": [-1, 1]}
    inside = asked(memory, "find_matches", **{**auto, "while": [bumped]}, where=place)
    assert [row["first_seen"] for row in inside["sightings"]] == [T0 / S + 20]


def test_by_counts_a_boolean_that_is_said_when_it_changes_from_its_first_message_on(
    remember: Remember,
) -> None:
    """Nothing is recorded from 100 to 110 s, so when it began to be true at 115 s is not known."""
    changes = (0, False), (60, True), (65, False), (90, True), (91, False), (95, True), (96, False)
    messages = [boolean(T0 + at * S, value, BUMPER) for at, value in (*changes, (115, True))]
    messages += [odom(T0 + at * S, 0.0, 0.0) for at in range(120) if not 100 <= at < 110]
    memory = remember(messages, split_s=10)
    for first, began in ((0, 3), (50, 3), (61, 2), (92, 1), (98, 0)):
        counted = matches(memory, BUMPER, first, 120, by="hour")
        assert table(counted)["all"]["count"] == began, first


def test_a_boolean_that_is_said_when_it_changes_holds_from_before_the_window_and_to_its_end(
    tmp_path: Path, remember: Remember
) -> None:
    """True from 50 s on and from 800 s on; after the pause from 2499 s on it is not known."""
    said = ((10, False), (50, True), (600, False), (800, True))
    for number, recorded in enumerate((range(2500), range(2600, 3001))):
        messages = [boolean(T0 + at * S, value, DOCKED) for at, value in said if at in recorded]
        messages += [odom(T0 + at * S, 0.0, 0.0) for at in recorded]
        write_mcap(tmp_path / "rec" / f"rec_{number}.mcap", messages)
    memory = remember()
    windows = (0, 3000, 2249, 2), (100, 900, 600, 1), (100, 500, 400, 0), (700, 3000, 1699, 1)
    for first, last, held, began in windows:
        whole = table(matches(memory, DOCKED, first, last, by="day"))["all"]
        assert (whole["seconds"], whole["count"]) == (held, began), first


@pytest.mark.parametrize(("split_s", "recalls"), [(10, False), (30, True), (600, True)])
def test_a_boolean_does_not_hold_through_a_silence_of_its_topic(
    tmp_path: Path, split_s: int, recalls: bool
) -> None:
    """Once a second, but not from 30, 80, 140 and 161 s on: false, true, true, true, then false."""
    times = [*range(30), *range(45, 80), *range(100, 140), 160, 161, *range(175, 300)]
    bumped = [45 <= at < 130 or 160 <= at < 162 for at in times]
    messages = [boolean(T0 + at * S, *said) for at, *said in zip(times, bumped, strict=True)]
    messages += along_x(T0, 300)
    memory = remembered(tmp_path, messages, split_s=split_s, recalls=recalls)

    def whole(first: int, last: int, by: str = "hour") -> list[float]:
        answer = table(matches(memory, BUMPER, first, last, by=by))["all"]
        return [answer["count"], answer["seconds"]]

    rows = matches(memory, BUMPER, 0, 300)["sightings"]
    assert [row["duration_s"] for row in rows] == [1, 30, 34]
    assert whole(0, 300) == [2, 65]
    assert whole(0, 300, "value")[1] == 65
    assert whole(50, 110) == [0, 29 + 10]
    assert whole(79, 95) == whole(85, 95) == [0, 0]


def test_a_boolean_of_a_rare_topic_holds_to_the_ends_of_the_window_but_not_after_a_gap(
    tmp_path: Path, remember: Remember
) -> None:
    """As of a dock; nothing is recorded from 7999 to 8500 s, or on."""
    changes = ((100, False), (4000, True), (5000, False), (6000, True))
    messages = [boolean(T0 + at * S, value, BUMPER) for at, value in changes]
    found = matches(remember([*messages, *along_x(T0, 8000)], split_s=2000), BUMPER, 0, 10_000)[
        "sightings"
    ]
    assert [row["duration_s"] for row in found] == [1999, 1000]
    write_splits(tmp_path, along_x(T0 + 8500 * S, 1501), 2000)
    memory = remember()
    matched = partial(matches, memory, BUMPER)
    found = matched(0, 10_000)["sightings"]
    assert [row["duration_s"] for row in found] == [1999, 1000]
    said = partial(asked, memory, "get_topic_in_range", topic=BUMPER)
    span = {"start": T0 // S, "end": T0 // S + 10_000}
    lengths = [change["seconds"] for change in said(changes=True, **span)["changes"]]
    assert lengths[1::2] == [1000, 1999]
    assert table(said(by="value", **span))["true"]["seconds"] == 1000 + 1999
    for first, last, began, held in (
        (0, 10_000, 2, 1000 + 1999),
        (4500, 4800, 0, 300),
        (3000, 4500, 1, 500),
        (4500, 7000, 1, 500 + 1000),
        (7500, 10_000, 0, 499),
        (8500, 9500, 0, 0),
    ):
        whole = table(matched(first, last, by="hour"))["all"]
        assert (whole["count"], whole["seconds"]) == (began, held), first


TRUE = 1_784_030_400
UNSET = 86_400
AHEAD = 2_082_758_400


def test_no_value_holds_from_one_clock_to_the_next(tmp_path: Path) -> None:
    """The robot was idle at the end of 1970, and at the beginning of today."""
    for name, begin, count in (("unset", UNSET, 2), ("today", TRUE, 6), ("ahead", AHEAD, 1)):
        said = [text((begin + n) * S, "idle" if n < 3 else "busy") for n in range(count)]
        write_mcap(tmp_path / name / f"{name}_0.mcap", said)
    memory = memory_of(tmp_path, clock=FixedClock((TRUE + 600) * S))
    of_topic = partial(asked, memory, "get_topic_in_range", topic="/chatter", by="value")
    rows = table(of_topic(start=0, end=AHEAD + 10))
    assert {value: row["count"] for value, row in rows.items()} == {"idle": 1, "busy": 1, "all": 2}
    assert (rows["idle"]["first_unix"], rows["busy"]["last_unix"]) == (TRUE, TRUE + 5)
    of_1970 = table(of_topic(start=UNSET - 5, end=UNSET + 60))
    assert of_1970["all"]["last_unix"] == UNSET + 1


def test_what_a_rare_topic_said_counts_as_said_until_its_next_message(
    tmp_path: Path, remember: Remember
) -> None:
    """In two runs a mission says what it does when that changes, first after 10 s."""
    for begin in (0, 2000):
        said = ((10, "CHARGING"), (400, "SCOUTING"), (700, "CHARGING"))
        states = [text(T0 + (begin + at) * S, word, "/mission") for at, word in said]
        messages = [odom(T0 + (begin + at) * S, 0.0) for at in range(0, 1001, 2)]
        write_splits(tmp_path, [*states, *messages], 100, f"run{begin}")
    given = clause("/mission", "equals", "CHARGING", by="day")
    memory = remember()
    whole = table(asked(memory, "find_matches", **given))["all"]
    assert (whole["count"], whole["seconds"]) == (4, 2 * 690)
    assert whole["topic_s"] == pytest.approx(2 * 990, abs=1)
    del given["by"]
    episodes = asked(memory, "find_matches", **given)["episodes"]
    assert [row["seconds"] for row in episodes] == [300, 390, 300, 390]


def test_a_rare_measurement_that_falls_silent_is_not_known_any_more(remember: Remember) -> None:
    levels = [battery(T0 + at * S, 0.5) for at in range(0, 401, 5)]
    memory = remember(in_order([*levels, *along_x(T0, 1001)]))
    given = {"topic": "/battery_state", "field": "percentage", "condition_type": "above"}
    reply = asked(memory, "find_matches", value=0, by="day", **given)
    assert table(reply)["all"]["topic_s"] == pytest.approx(400, abs=1)


def test_a_while_on_a_rare_measurement_ends_where_that_falls_silent(
    tmp_path: Path, remember: Remember
) -> None:
    levels = [battery(T0 + at * S, 0.5) for at in range(0, 401, 5)]
    moving = along_x(T0, 1001)
    other = [boolean(T0 + at * S, True) for at in range(1001)]
    write_splits(tmp_path, [*levels, *moving, *other], 100)
    charged = {"topic": "/battery_state", "field": "percentage", "condition_type": "above"}
    memory = remember()
    scope = {"while": {**charged, "value": 0.2}}
    counted = matches(memory, BUMPER, 0, 1000, by="day", **scope)
    whole = table(counted)["all"]
    assert (whole["seconds"], whole["unknown_s"]) == (400, 600)
