"""What happened in a time, what became of goals, what changed before and after a moment."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.analysis.facts import FLAG, MOST
from ros2_memory.core.model import JsonValue
from ros2_memory.core.regions import Place, Rectangle
from ros2_memory.history.context import Call, Memory, QuerySettings
from ros2_memory.history.view import TimeRange
from ros2_memory.insights.recap import MOST_EVENTS, recap
from ros2_memory.results import Recap
from tests.support.bags import (
    McapLayout,
    Msg,
    along_x,
    battery,
    boolean,
    command,
    detections,
    diagnostics,
    goals,
    in_order,
    log_entry,
    make,
    odom,
    tf_of,
    write_mcap,
    write_splits,
)
from tests.support.clocks import in_zone
from tests.support.examples import examples
from tests.support.memories import Remember, asked, clause, memory_of, remembered
from tests.support.tables import table

S = 10**9
T0 = 1_784_000_000
BEGIN = T0 * S


def over(memory: Memory, begin: float, end: float) -> Recap:
    """Of so many seconds after BEGIN."""
    return recap(memory, Call(), TimeRange(start_s=T0 + begin, end_s=T0 + end))


def test_booleans_that_are_too_many_to_follow_are_counted(tmp_path: Path) -> None:
    type_name = "px4_msgs/msg/ManyFlags"
    body = make(type_name, **{f"flag_{nth:03}": False for nth in range(600)})
    many = [Msg("/many", type_name, BEGIN + n * S, body) for n in (1, 2)]
    more = 600 - MOST[FLAG]
    assert (
        f"/many has too many booleans or things in one message: {more} more are not followed"
    ) in over(remembered(tmp_path, many), 0, 10).notes


@pytest.mark.parametrize("unit", [1.0, 100.0], ids=["fractions", "percent"])
def test_a_battery_that_runs_low_is_one_line(remember: Remember, unit: float) -> None:
    """From 25 to 3 % in 220 s, charged to 40 % at 300 s, at 8 % from 400 s on."""
    charges = [*range(250, 30, -1), *([30] * 80), *([400] * 100), *([80] * 50)]
    told = [battery(BEGIN + at * S, of * unit / 1000) for at, of in enumerate(charges)]
    memory = remember(told)

    def events(first: int, last: int) -> list[tuple[str, float, float, bool]]:
        return [
            (event.text, since(event.start), since(event.end or 0), event.goes_on)
            for event in over(memory, first, last).events
        ]

    fell, again = "/battery_state fell below 5%", "/battery_state fell below 10%"
    assert events(0, 449) == [(fell, 151, 300, False), (again, 400, 449, True)]
    assert events(0, 160) == [(again, 151, 160, True)]
    assert events(240, 250) == [("/battery_state was below 5%", 240, 250, True)]
    assert events(0, 140) == events(310, 390) == []
    assert ("low batteries", 2) in over(memory, 0, 449).counts


def test_two_batteries_on_one_topic_run_low_one_by_one(remember: Remember) -> None:
    told = []
    for second in range(100):
        at, charge = BEGIN + second * S, 0.1605 - second / 1000
        told += [
            battery(at, charge, location="left"),
            battery(at + 1000, 0.8),
            battery(at + 2000, 0.7, location="in the trailer"),
        ]
    memory = remember(told)
    low = [(event.text, since(event.start)) for event in over(memory, 0, 100).events]
    assert low == [("/battery_state (left) fell below 10%", 61)]
    span = {"start": BEGIN // S, "end": BEGIN // S + 100}
    below = {"topic": "/battery_state", "condition_type": "below", "value": 0.1, **span}
    found = asked(memory, "find_matches", **below, field="percentage")
    assert [row["count"] for row in found["sightings"]] == [39]
    assert asked(memory, "find_matches", **below, field="percentage", by="day")["all"][2] == 1
    changes = asked(memory, "recap", around=BEGIN // S + 65)["before"]
    assert [each["text"] for each in changes] == ["/battery_state (left) fell below 10%"]


def test_a_boolean_that_is_true_in_its_first_message_says_how_long_it_was(
    remember: Remember,
) -> None:
    poses = [odom(at(t), 0.4 * t) for t in range(60)]
    flips = [(20, True), (21.2, False), (30, True), (31, False)]
    cliff = [boolean(at(t), is_near, "/cliff") for t, is_near in flips]
    # What is true as the recording begins may have been so for long.
    docked = [boolean(at(t), t < 40, "/docked") for t in range(1, 60)]
    memory = remember(in_order([*poses, *cliff, *docked]), split_s=10)

    def flipped(begin: float, stop: float) -> list[str]:
        events = asked(memory, "recap", start=T0 + begin, end=T0 + stop)["events"]
        return [each["text"] for each in events if "became" in each["text"]]

    assert flipped(0, 60) == [
        "/cliff became false, true since its first message 1.2 s before",
        "/cliff became true",
        "/cliff became false",
        "/docked became false",
    ]
    assert flipped(20.5, 29) == ["/cliff became false"]
    assert flipped(29, 39) == ["/cliff became true", "/cliff became false"]


def test_an_error_that_comes_again_long_after_is_another_event(remember: Remember) -> None:
    """It is reported once a minute twice, in two rooms."""
    often = [log_entry(at(t), 40, "brush", "stalled") for t in (5, 65, 605, 2400, 2460)]
    poses = [odom(at(t), 0.0 if t < 1200 else 5.0) for t in range(0, 2500, 5)]
    memory = remember(in_order([*often, *poses]), split_s=600)
    reply = asked(memory, "recap", start=T0, end=T0 + 2500)
    errors = [each for each in reply["events"] if each["text"].startswith("error")]
    assert [(each["text"], each["duration_s"]) for each in errors] == [
        ("error: brush: stalled (3 times)", 600.0),
        ("error: brush: stalled (2 times)", 60.0),
    ]
    assert [each["timestamp"] - T0 for each in errors] == [5.0, 2400.0]
    assert reply["counts"]["errors"] == 2


def test_a_battery_without_a_known_charge_is_not_low(tmp_path: Path) -> None:
    told = [battery(BEGIN + at * S, 0.0) for at in range(60)]
    assert over(remembered(tmp_path, told), 0, 59).events == ()


@pytest.mark.parametrize("recordings", [1, 2])
def test_a_boolean_toggles_not_at_each_message_of_a_time_that_is_recorded_twice(
    tmp_path: Path, remember: Remember, recordings: int
) -> None:
    """It toggles every 50 s; after 300 s the clock is set back by 60, perhaps by a restart."""
    for split in range(20):
        messages = []
        for second in range(30 * split, 30 * split + 30):
            at = BEGIN + (second - 60 * (second >= 300)) * S
            messages += [odom(at, 0.2 * second), boolean(at + 1, (second // 50) % 2 == 0)]
        number = split * recordings // 20
        write_mcap(tmp_path / f"rec{number}" / f"rec{number}_{split}.mcap", messages)
    memory = remember()
    told = asked(memory, "recap", start=BEGIN / S, end=BEGIN / S + 600)
    flips = [event for event in told["events"] if "became" in event["text"]]
    since = [round(flip["timestamp"] - BEGIN / S) for flip in flips]
    assert since == [50, 100, 150, 200, 340, 390, 440, 490]
    assert flips[3]["duration_s"] == pytest.approx(40, abs=1.1)
    assert any("set back" in note and "no on/off changes" in note for note in told["notes"])


def test_one_pose_that_noise_throws_off_cuts_nothing_off_a_stop(tmp_path: Path) -> None:
    draw = Random(1)
    thrown = {5 * 50 + 25, 13 * 50 - 25}
    messages: list[Msg] = []
    for tick in range(18 * 50):
        x = 0.5 * (min(tick / 50, 5) + max(tick / 50 - 13, 0)) + draw.gauss(0, 0.005)
        y = 0.024 if tick in thrown else draw.gauss(0, 0.005)
        messages.append(odom(BEGIN + tick * S // 50, x, y))
    events = over(remembered(tmp_path, messages), 0, 20).events
    [stop] = [(since(each.start), each.end and since(each.end)) for each in events]
    assert stop == pytest.approx((5, 13), abs=0.1)


def test_only_what_happened_in_a_place_is_reported(tmp_path: Path) -> None:
    """Drives 1 m/s through the room and out of it, stands at 20 s and at 50 s, bumps twice."""
    messages = []
    for step in range(700):
        seconds = step / 10
        stood = min(max(seconds - 20, 0), 10) + min(max(seconds - 50, 0), 10)
        messages.append(odom(BEGIN + step * S // 10, seconds - stood - 16))
        if step % 10 == 0:
            bump = int(seconds) in {18, 45}
            messages.append(boolean(BEGIN + step * S // 10, bump, topic="/bumper"))
            label = "cup" if 17 <= seconds < 30 else "plant"
            messages.append(detections(BEGIN + step * S // 10, [label]))
        if step in {180, 450, 460}:
            messages.append(log_entry(BEGIN + step * S // 10, 40, "base", "stuck"))
    room, other = Rectangle(-1, 5, -1, 4), Rectangle(50, 51, 50, 51)
    places = Place("room", "odom", room), Place("elsewhere", "odom", other)
    memory = remembered(tmp_path, messages, limits=QuerySettings(places=places))
    span = TimeRange(start_s=T0, end_s=T0 + 70)
    there = recap(memory, Call(), span, where="room")
    # In the room from x = -1 at 15 s to x = 5 at 31 s.
    assert (there.where, there.visits) == ("room", 1)
    assert there.inside / S == pytest.approx(16, abs=0.2)
    assert there.distance_m == pytest.approx(6, abs=0.1)
    assert (there.stood or 0) / S == pytest.approx(10, abs=0.2)
    assert [(each.kind, each.text.partition(",")[0], each.places) for each in there.events] == [
        ("thing", "plant in view", ()),
        ("thing", "cup in view", ()),
        ("error", "error: base: stuck", ("room",)),
        ("flip", "/bumper became true", ("room",)),
        ("flip", "/bumper became false", ("room",)),
        ("stop", "stood at x 4.00", ("room",)),
        ("thing", "plant in view", ()),
    ]
    never = recap(memory, Call(), span, where="elsewhere")
    assert (never.visits, never.events, never.distance_m, never.stood) == (0, (), 0, 0)
    refused = asked(memory, "recap", around=T0 + 20, where="room")
    assert refused["error"] == "invalid_arguments"
    robot = asked(memory, "recap", around=T0 + 20)["robot"]
    assert (robot["frame_id"], robot["in"]) == ("odom", "room")


def test_booleans_of_one_message_that_become_the_same_are_one_event(tmp_path: Path) -> None:
    def lands(second: int, *, landed: bool) -> Msg:
        type_name = "px4_msgs/msg/VehicleLandDetected"
        flags = dict.fromkeys(("ground_contact", "maybe_landed", "landed"), landed)
        body = make(type_name, timestamp=second, in_air=not landed, **flags)
        return Msg("/landed", type_name, BEGIN + second * S, body)

    messages = [lands(second, landed=not 20 <= second < 40) for second in range(60)]
    messages += [boolean(BEGIN + second * S, second >= 18, "/armed") for second in range(60)]
    messages += along_x(BEGIN, 60)
    memory = remembered(tmp_path, messages)
    events = asked(memory, "recap", start=T0, end=T0 + 60)["events"]
    flips = [event for event in events if "became" in event["text"]]
    on_ground = "/landed ground_contact, maybe_landed, landed became"
    before = [{"text": "/armed became true", "s_before": 2.0}]
    assert [(flip["timestamp"] - T0, flip["text"]) for flip in flips] == [
        (18, "/armed became true"),
        (20, f"{on_ground} false"),
        (20, "/landed in_air became true"),
        (40, f"{on_ground} true"),
        (40, "/landed in_air became false"),
    ]
    assert [flip.get("duration_s") for flip in flips] == [None, 20.0, 20.0, None, None]
    assert [flip.get("before") for flip in flips] == [None, before, before, None, None]
    around = asked(memory, "recap", around=T0 + 21)
    assert [change["text"] for change in around["before"]] == [
        f"{on_ground} false",
        "/landed in_air became true",
        "/armed became true",
    ]


@pytest.mark.parametrize("more", [1, 2])
def test_one_event_too_many_is_listed_and_two_are_counted(tmp_path: Path, more: int) -> None:
    toggles = MOST_EVENTS + more
    door = [boolean(BEGIN + at * S, at % 2 == 1, topic="/door") for at in range(toggles + 1)]
    told = over(remembered(tmp_path, door), 0, toggles)
    assert dict(told.counts) == {"on/off changes": toggles}
    is_noted = "left out, because there are too many" in str(told.notes)
    assert (len(told.events), is_noted) == ((toggles, False) if more == 1 else (MOST_EVENTS, True))


def test_of_many_stops_and_toggles_the_rare_are_listed_first(tmp_path: Path) -> None:
    """Stands for 5 s 34 times; a door opens and closes 40 times, an emergency stop is set once."""
    messages = []
    for tick in range(34 * 8 * 5):
        cycle, within_s = divmod(tick / 5, 8)
        at = BEGIN + tick * S // 5
        messages.append(odom(at, 1.5 * cycle + 0.5 * max(within_s - 5, 0)))
        if tick % 5 == 0:
            second = tick // 5
            messages.append(boolean(at, second // 3 % 2 == 1, topic="/door"))
            messages.append(boolean(at, 100 <= second < 110, topic="/emergency_stop"))
    told = over(remembered(tmp_path, messages), 0, 34 * 8)
    texts = [event.text for event in told.events]
    assert [text for text in texts if not text.startswith("stood at")] == [
        "/emergency_stop became true",
        "/emergency_stop became false",
    ]
    assert len(texts) == MOST_EVENTS
    assert dict(told.counts) == {"stops": 34, "on/off changes": 2 + 34 * 8 // 3}
    [left_out] = [note for note in told.notes if note.startswith("left out, because")]
    assert f"{34 - (MOST_EVENTS - 2)} stops, {34 * 8 // 3} on/off changes" in left_out


def test_of_a_lid_that_is_mostly_closed_the_openings_are_listed_first(tmp_path: Path) -> None:
    lid = [boolean(BEGIN + at * S, at % 9 in {4, 5}, topic="/lid") for at in range(9 * MOST_EVENTS)]
    told = over(remembered(tmp_path, lid), 0, 9 * MOST_EVENTS)
    assert [event.text for event in told.events] == ["/lid became true"] * MOST_EVENTS
    assert dict(told.counts) == {"on/off changes": 2 * MOST_EVENTS}


@pytest.mark.parametrize(("sights", "is_one"), [(MOST_EVENTS - 1, False), (MOST_EVENTS, True)])
def test_many_sights_are_one_event_of_each_thing_in_all_its_spellings(
    tmp_path: Path, sights: int, *, is_one: bool
) -> None:
    """A clock is seen for 4 s of every 10, now and then as "Clock"; a ghost in one message."""
    seen = [
        detections(BEGIN + at * S, ["Clock" if at % 10 == 2 else "clock"] * (at % 10 < 5))
        for at in range(10 * sights)
    ]
    seen.append(detections(BEGIN + 17 * S + S // 2, ["ghost"]))
    reply = asked(remembered(tmp_path, in_order(seen)), "recap", start=T0, end=T0 + 10 * sights)
    texts = [event["text"] for event in reply["events"]]
    assert reply["counts"] == {"sightings": sights + 1}
    if is_one:
        assert texts == [f"clock in view ({sights} times, {4 * sights} s in all)", "ghost in view"]
        event, _ = reply["events"]
        assert (event["timestamp"], event["duration_s"]) == (T0, 10 * sights - 6)
    else:
        assert sorted(texts) == ["clock in view"] * sights + ["ghost in view"]


def test_things_that_are_passed_by_are_events_however_many_they_are(tmp_path: Path) -> None:
    """A robot drives along 30 shelves, and a slow detector has each of them in two messages."""
    seen = [detections(BEGIN + at * S, [f"shelf {at // 2}"]) for at in range(60)]
    reply = asked(remembered(tmp_path, seen), "recap", start=T0, end=T0 + 60)
    assert [event["text"] for event in reply["events"]][:2] == [
        "shelf 0 in view",
        "shelf 1 in view",
    ]
    assert len(reply["events"]) == 25


@pytest.mark.parametrize("camera", [False, True])
@pytest.mark.parametrize(("hours", "visits"), [(60, 2), (10, MOST_EVENTS + 1)])
def test_the_visits_that_a_detector_says_in_one_message_each_are_listed(
    tmp_path: Path, hours: int, visits: int, *, camera: bool
) -> None:
    """A detector at the door has a message of each visitor, and no others; a camera has a clock."""
    length = 3600 * hours
    said = [odom(BEGIN + at * S, 0.0) for at in range(0, length, 300)]
    said += [detections(BEGIN + nth * length // visits * S, ["person"]) for nth in range(visits)]
    clock = [detections(BEGIN + (900 + at) * S, ["clock"], topic="/camera") for at in range(9)]
    said += clock if camera else []
    events = over(remembered(tmp_path, in_order(said)), 0, length).events
    persons = f"person in view ({visits} times, 0 s in all)"
    assert [event.text for event in events] == [persons, *["clock in view"] * camera]


@pytest.mark.parametrize(("hours", "is_listed"), [(60, True), (40, False)])
def test_a_thing_that_was_seen_once_in_days_is_listed_beside_what_happens_all_the_time(
    tmp_path: Path, hours: int, is_listed: bool
) -> None:
    """Each hour a door toggles, and cups or mugs are seen; after 20 hours a deer, and a ghost."""

    def seen(hour: int, second: int, *labels: str) -> Msg:
        return detections(BEGIN + (3600 * hour + second) * S, labels)

    told = [odom(BEGIN + 60 * minute * S, 0.0) for minute in range(60 * hours)]
    told += [boolean(BEGIN + 3600 * hour * S + 1, hour % 2 == 1, "/door") for hour in range(hours)]
    for hour in range(hours):
        label = "Cup" if hour == 5 else "cup"
        told += [seen(hour, second, label, "chair") for second in range(100, 140, 2)]
    told += [seen(20, second, "deer") for second in range(2000, 2010, 2)]
    told += [seen(20, 2500, "ghost")]
    told_of = over(remembered(tmp_path, in_order(told), split_s=3600), 0, 3600 * hours)
    texts = [event.text for event in told_of.events]
    assert [text for text in texts if "view" in text and "cup" not in text.lower()] == (
        ["deer in view"] * is_listed
    )
    assert (len(texts), "Cup in view" in texts) == (MOST_EVENTS, False)


def test_a_path_that_begins_or_ends_within_a_window_says_when_there_are_no_poses(
    tmp_path: Path,
) -> None:
    """Poses are recorded from 60 to 120 s."""
    poses = [odom(BEGIN + t * S, 0.1 * t) for t in range(60, 121)]
    beats = [boolean(BEGIN + t * S, True) for t in range(181)]
    memory = remembered(tmp_path, [*poses, *beats])
    spans = [f"{T0 + first}.000000 to {T0 + first + 60}.000000 (60 s)" for first in (0, 120)]
    note = f"/odom has no poses from {', '.join(spans)}: the path is without that time"
    assert note in asked(memory, "recap", start=T0, end=T0 + 180)["notes"]
    late, early = (
        f"/odom has no poses from {span}: the path is without that time" for span in spans
    )
    halves = {"start": T0, "end": T0 + 90, "with_start": T0 + 90, "with_end": T0 + 180}
    assert {late, early} <= {*asked(memory, "compare", **halves)["notes"]}
    whole = asked(memory, "recap", start=T0 + 65, end=T0 + 125)
    assert "no poses" not in str(whole)


@pytest.mark.parametrize("tool", ["recap", "trajectory_summary"])
def test_for_how_long_nobody_knows_whether_the_robot_was_in_a_place_is_said(
    tmp_path: Path, tool: str
) -> None:
    """Poses have no numbers for 40 s."""
    poses = [odom(BEGIN + t * S, math.nan if 10 < t < 50 else t) for t in range(90)]
    memory, room = remembered(tmp_path, poses), {"x": [-1, 5], "y": [-1, 1]}
    unknown = "where the robot was is not known"
    note = f"{unknown} from {T0 + 10}.000001 to {T0 + 50}.000000 (40 s)"
    assert "notes" not in asked(memory, "recap", start=T0, end=T0 + 9, where=room)
    assert note in asked(memory, tool, start=T0, end=T0 + 89, where=room)["notes"]
    two = {"with_start": T0, "with_end": T0 + 9}
    assert note in asked(memory, "compare", start=T0 + 9, end=T0 + 89, where=room, **two)["notes"]
    there = asked(memory, "recap", start=T0 + 25, end=T0 + 35, where=room)
    assert there["visits"] == 0
    assert f"{unknown} at any time of the window" in there["notes"]


def test_what_was_not_recorded_is_part_of_no_duration_and_of_no_mean(tmp_path: Path) -> None:
    """A robot that drives at 0.5 m/s, recorded for 20 s, an hour later, and another hour later."""
    for run in range(3):
        begin = BEGIN + run * 3600 * S
        body = along_x(begin, 20, mps=0.5, hz=10)
        body += [boolean(begin + n * S, n < 5, "/bumper") for n in range(20)]
        write_mcap(tmp_path / f"run{run}" / f"run{run}_0.mcap", body)
    memory, window = memory_of(tmp_path), {"start": T0, "end": T0 + 7220}
    answer = asked(memory, "recap", **window)
    flips = [each for each in answer["events"] if each["text"].startswith("/bumper")]
    assert [each["text"] for each in flips] == [
        f"/bumper became {now}" for now in ("false", "true", "false", "true", "false")
    ]
    assert [each.get("duration_s") for each in flips] == [
        pytest.approx(length, abs=1.0) if length else None for length in (15, 5, 15, 5, None)
    ]
    assert answer["stood_s"] == 0
    path = asked(memory, "trajectory_summary", **window)
    assert path["avg_speed"] == pytest.approx(0.5, abs=0.01)
    assert path["avg_speed"] <= path["max_speed"]
    assert path["duration_s"] == pytest.approx(7219.9)
    assert path["recorded_s"] == pytest.approx(59.7, abs=0.1)


def at(seconds: float) -> int:
    return BEGIN + round(seconds * S)


def driving(until: int, stops: float) -> list[Msg]:
    """Drives 0.4 m/s up to a time, and then stands."""
    times = [nth / 10 for nth in range(until * 10)]
    return [odom(at(t), 0.4 * min(t, stops)) for t in times]


def before(memory: Memory, around: float, **given: float) -> Any:
    return asked(memory, "recap", around=T0 + around, **given)


def told(reply: dict[str, Any]) -> list[tuple[str, float]]:
    return [(each["text"], each["s_before"]) for each in reply["before"]]


ALL = [
    *driving(60, 43),
    *(command(at(t / 10), 0.4 if t < 430 else 0.0) for t in range(600)),
    *(boolean(at(t), 42.6 <= t < 43.4) for t in range(60)),
    boolean(at(42.6), True),
    *(diagnostics(at(t), motor=(1, "hot") if t > 38 else (0, "ok")) for t in range(0, 60, 3)),
    goals(at(5), {1: 2}),
    *(battery(at(t), 0.25 - t * 0.00125) for t in range(60)),
    log_entry(at(41.5), 30, "motor", "81 C"),
    log_entry(at(42.0), 20, "motor", "nothing of interest"),
]


def test_what_changed_is_listed_the_nearest_first(remember: Remember) -> None:
    reply = before(remember(ALL, split_s=10), 43.0)
    assert told(reply) == [
        ("/cmd_vel went to zero while a goal was active", 0.0),
        ("/bumper became true", 0.4),
        ("warning of motor: 81 C", 1.5),
        ("/battery_state fell below 20%", 2.0),
        ("status of motor became warning: hot", 4.0),
    ]
    assert reply["state"] == {
        "/bumper": True,
        "/drive goal": "active",
        "status of motor": "warning",
        "/battery_state": "20%",
    }
    assert reply["robot"]["frame_id"] == "odom"
    assert "notes" not in reply


def test_a_charge_that_trembles_about_a_limit_falls_below_it_once(tmp_path: Path) -> None:
    trembling = [battery(at(t), 0.209 - t * 0.0002 + 0.008 * (-1) ** t) for t in range(60)]
    memory = remembered(tmp_path, [*trembling, boolean(at(59), True)])
    reply = before(memory, 60.0, seconds_before=60)
    assert str(reply["before"]).count("/battery_state fell below 20%") == 1


@pytest.mark.parametrize(
    ("charge", "states"),
    [
        (lambda t: max(6 - t * 0.1, 0.8), {20: "4%", 55: "1%"}),
        (lambda t: 84.0 if t < 30 else 0.83, {55: "83%"}),
    ],
    ids=["the last percent is no full one", "a fraction after an update is no percent"],
)
def test_the_state_of_a_battery_is_its_charge_in_percent(
    remember: Remember, charge: Callable[[int], float], states: dict[int, str]
) -> None:
    charges = [battery(at(t), charge(t)) for t in range(60)]
    memory = remember([*charges, boolean(at(59), True)])
    assert {t: before(memory, t)["state"]["/battery_state"] for t in states} == states


def test_the_first_changes_after_a_moment_are_told_apart(tmp_path: Path) -> None:
    late = [log_entry(at(40 + t), 30, name, "late") for t, name in ((0.4, "a"), (5.2, "f"))]
    late += [log_entry(at(41 + 0.7 * nth), 30, name, "late") for nth, name in enumerate("bcde")]
    memory = remembered(tmp_path, [*driving(60, 40), *late])
    reply = before(memory, 40.0)
    assert told(reply) == [("warning of a: late", 0.0)]
    assert [(each["text"], each["s_after"]) for each in reply["after"]] == [
        ("warning of b: late", 1.0),
        ("warning of c: late", 1.7),
        ("warning of d: late", 2.4),
    ]
    assert before(memory, 50.0)["after"] == []


@pytest.mark.parametrize("listed_again", [False, True])
def test_of_another_run_only_what_a_latched_topic_said_goes_on(
    tmp_path: Path, listed_again: bool
) -> None:
    layout = McapLayout(latched=frozenset({"/docked", "/drive/_action/status"}))
    said = [boolean(at(50), True, "/docked"), boolean(at(50), True), goals(at(50), {1: 2})]
    write_splits(tmp_path, [*driving(60, 60), *said], name="first", layout=layout)
    later = [odom(at(600 + t), 24.0) for t in range(60)]
    later += [command(at(600 + t), 0.4 if t < 40 else 0.0) for t in range(30, 60)]
    later += [goals(at(601), {1: 2})] * listed_again
    write_splits(tmp_path, later, name="second", layout=layout)
    reply = before(memory_of(tmp_path), 642.0)
    went_on = [("/cmd_vel went to zero while a goal was active", 2.0)]
    assert told(reply) == (went_on if listed_again else [])
    assert reply["state"] == {"/docked": True} | ({"/drive goal": "active"} if listed_again else {})


def test_what_the_first_message_after_a_restart_says_is_no_change(
    tmp_path: Path, remember: Remember
) -> None:
    """It may have been so for long: the robot was off for nine minutes."""
    for name, begin, is_worse in (("first", 0, False), ("second", 600, True)):
        level, charge, vx = (2, 0.09, 0.0) if is_worse else (0, 0.5, 0.4)
        body = along_x(at(begin), 30, hz=10)
        for t in range(begin + 1, begin + 30):
            body += [battery(at(t), charge), diagnostics(at(t), lidar=(level, ""))]
            body += [boolean(at(t), is_worse), command(at(t), vx), goals(at(t), {1: 2})]
        body.append(battery(at(begin + 8.5), 0.04))
        write_splits(tmp_path, body, name=name)
    memory = remember()
    assert told(before(memory, 609.0)) == [("/battery_state fell below 5%", 0.5)]
    for start in (0, 600):
        events = asked(memory, "recap", start=T0 + start, end=T0 + 629)["events"]
        *_, stop = (event for event in events if event["text"].startswith("stood at"))
        assert (stop["timestamp"], stop.get("before")) == (T0 + 600, None)


def test_a_stop_is_where_the_robot_was_once_it_was_localised_in_it(tmp_path: Path) -> None:
    """As after a restart, before the initial pose is known."""
    stood = along_x(BEGIN, 60)
    placed = [tf_of(at(nth), "map", "odom", (7, 2, 0)) for nth in range(40, 60)]
    reply = asked(
        remembered(tmp_path, in_order([*stood, *placed])), "recap", start=at(0) / S, end=at(59) / S
    )
    assert [event["text"] for event in reply["events"]] == ["stood at x 7.00, y 2.00"]


@pytest.mark.parametrize(
    ("listed", "moments", "state"),
    [
        (
            {10: {1: 4, 2: 4}, 30: {1: 4, 2: 4, 3: 2}, 141: {1: 4, 2: 4, 3: 6}},
            (142, 200),
            "aborted",
        ),
        ({10: {1: 4}, 40: {1: 4, 2: 2}}, (45, 200), "active"),
        ({10: {2: 4}, 40: {2: 4, 1: 2}}, (45, 200), "active"),
    ],
    ids=["all ended", "the later runs", "the earlier runs"],
)
def test_the_state_of_an_action_is_that_of_the_goal_that_runs_or_ended_last(
    tmp_path: Path, listed: dict[int, dict[int, int]], moments: tuple[int, ...], state: str
) -> None:
    """A server lists its goals as it accepted them, for minutes after they ended."""
    statuses = [goals(at(second), each) for second, each in listed.items()]
    memory = remembered(tmp_path, [*along_x(BEGIN, 250), *statuses])
    for moment in moments:
        assert before(memory, moment)["state"]["/drive goal"] == state


def test_what_a_latched_topic_said_is_the_state_also_hours_later_not_a_goal(tmp_path: Path) -> None:
    said = [boolean(at(t), value, "/docked") for t, value in ((0, True), (7200, False))]
    said.append(goals(at(0), {1: 2}))
    beats = [odom(at(t)) for t in range(0, 7300, 10)]
    layout = McapLayout(latched=frozenset({"/docked", "/drive/_action/status"}))
    write_splits(tmp_path, [*said, *beats], 1000, layout=layout)
    memory = memory_of(tmp_path)
    assert before(memory, 5000.0)["state"] == {"/docked": True}
    assert told(before(memory, 7203.0)) == [("/docked became false", 3.0)]


def test_what_a_latched_topic_said_as_the_recorder_began_did_not_change_then(
    tmp_path: Path, remember: Remember
) -> None:
    """The recorder receives the newest value, however old it is."""
    layout = McapLayout(latched=frozenset({"/docked"}))
    for start, said in ((0, {0.5: True}), (600, {600.5: False, 630: True})):
        body = along_x(at(start), 60)
        body += [boolean(at(t), value, "/docked") for t, value in said.items()]
        write_splits(tmp_path, body, 1000, f"rec{start}", layout)
    memory = remember()
    for start in (0, 600):
        events = asked(memory, "recap", start=T0 + start, end=T0 + 659)["events"]
        [docked] = [event for event in events if "/docked" in event["text"]]
        assert (docked["timestamp"], docked["text"]) == (T0 + 630, "/docked became true")
        *_, stop = (event for event in events if event["text"].startswith("stood at"))
        assert "before" not in stop
    reply = before(memory, 605.0)
    assert (told(reply), reply["state"]) == ([], {"/docked": False})


TOPIC = "/drive/_action/status"


def told_goals(
    bag_dir: Path, messages: list[Msg], begin: float, end: float, cut: int = 99, *, recalls: bool
) -> list[tuple[str, str, float, float | None, bool]]:
    """Kind, text, first and last second of each goal, and whether it goes on."""
    for number, at in enumerate(range(0, len(messages), cut)):
        write_mcap(bag_dir / "rec" / f"rec_{number}.mcap", messages[at : at + cut])
    events = over(memory_of(bag_dir, recalls=recalls), begin, end).events
    goals = [each for each in events if "goal" in each.kind]
    return [
        (each.kind, each.text, since(each.start), each.end and since(each.end), each.goes_on)
        for each in goals
    ]


def since(at: int) -> float:
    return (at - BEGIN) / S


def history(*statuses: tuple[int, Mapping[int, int]]) -> list[Msg]:
    return [goals(BEGIN + at * S, listed) for at, listed in statuses]


DAY = history(
    (10, {1: 1}),
    (11, {1: 2}),
    (20, {1: 4}),
    (30, {1: 4, 2: 2}),
    (42, {1: 4, 2: 6}),
    (50, {2: 6, 3: 2}),
    (55, {2: 6, 3: 3}),
    (56, {2: 6, 3: 5}),
    (60, {3: 5, 4: 2}),
)


def test_what_ended_before_a_window_is_not_told_and_what_began_before_is(tmp_path: Path) -> None:
    assert told_goals(tmp_path, DAY, 35, 52, recalls=False) == [
        ("failed goal", "/drive goal aborted, accepted before", 42, None, False),
        ("goal", "/drive goal accepted", 50, None, True),
    ]


TORN = Msg(TOPIC, DAY[0].type, BEGIN + 20 * S, b"\x00\x01\x00\x00\xff\xff\xff\x7f")


@pytest.mark.parametrize(
    ("before", "pause", "is_told"),
    [
        ([], range(0), False),
        (history((20, {1: 4})), range(0), True),
        (history((20, {1: 4})), range(24, 39), False),
        ([*history((20, {1: 4})), TORN], range(0), False),
    ],
)
def test_what_a_window_first_lists_as_ended_just_did_if_the_message_before_it_is_known(
    tmp_path: Path, before: list[Msg], pause: range, is_told: bool
) -> None:
    beats = [odom(BEGIN + at * S + 1) for at in range(60) if at not in pause]
    messages = [*beats, *before, *history((42, {1: 4, 2: 6}))]
    found = told_goals(tmp_path, in_order(messages), 35, 52, 5, recalls=False)
    assert [text for _, text, *_ in found] == ["/drive goal aborted after 0 s"] * is_told
    window = {"start": T0 + 35, "end": T0 + 52}
    searched = found_in(memory_of(tmp_path), "equals", "failed", **window)
    assert [(goal, last) for goal, _, _, last in searched] == [(2, 42)] * is_told


def found_in(
    memory: Memory, condition: str, value: JsonValue, **more: object
) -> list[tuple[int, str, float, float]]:
    """The goals that a search finds: number, status, first and last second."""
    asks = clause(TOPIC, condition, value, limit=50)
    found = asked(memory, "find_matches", **asks, **more)["sightings"]
    return [
        (
            int(each["value"]["goal"], 16),
            each["value"]["status"],
            *(each[key] - T0 for key in ("first_seen", "last_seen")),
        )
        for each in found
    ]


@in_zone("UTC")
def test_a_goal_is_active_from_its_acceptance_to_its_end_in_windows_without_a_status(
    tmp_path: Path,
) -> None:
    """Active from 10 to 40 s (34:00), another from 60 s on, which a restart at 99 s cuts short."""
    messages = along_x(BEGIN, 100, mps=0.1)
    messages += history((10, {1: 2}), (40, {1: 4}), (60, {1: 4, 2: 2}))
    write_splits(tmp_path, messages, layout=McapLayout(latched=frozenset({TOPIC})))
    write_splits(tmp_path, along_x(BEGIN + 900 * S, 50), name="next")
    memory = memory_of(tmp_path)

    def held(word: str, begin: int, end: int) -> object:
        given = clause(TOPIC, "equals", word)
        window = {"start": T0 + begin, "end": T0 + end}
        rows = asked(memory, "find_matches", **given, **window)["sightings"]
        by_hour = asked(memory, "find_matches", **given, **window, by="hour")
        whole = table(by_hour)["all"]
        shown = [(row["duration_s"], row["began_earlier"], row["robot"]["x"]) for row in rows]
        return shown, whole["count"], whole["seconds"], str(whole["first"])[-5:]

    assert held("executing", 20, 30) == ([(10, True, 2.0)], 0, 10, "None")
    assert held("succeeded", 20, 50) == ([(20, True, 4.0)], 1, 20, "34:00")
    assert held("succeeded", 45, 55) == ([], 0, 0, "None")
    assert held("executing", 900, 940) == ([], 0, 0, "None")


def test_what_feedback_says_holds_while_there_is_feedback(tmp_path: Path) -> None:
    """Of two goals, a minute apart; a bumper that is as quiet in between stays pressed."""
    said = {at: at >= 5 for at in range(8)} | {at: at >= 65 for at in range(60, 68)}
    messages = along_x(BEGIN, 100)
    for topic in ("/grip/_action/feedback", "/bumper"):
        messages += [boolean(BEGIN + at * S, value, topic=topic) for at, value in said.items()]
    messages = in_order(messages)
    flips = [
        each for each in over(remembered(tmp_path, messages), 0, 99).events if each.kind == "flip"
    ]
    lasted = [
        (each.text, (each.start - BEGIN) // S, each.end and (each.end - BEGIN) // S)
        for each in flips
    ]
    assert [row for row in lasted if "feedback" in row[0]] == [
        ("/grip/_action/feedback became true", 5, 7),
        ("/grip/_action/feedback became false", 60, 65),
        ("/grip/_action/feedback became true", 65, 67),
    ]
    assert [row[1:] for row in lasted if "bumper" in row[0]] == [(5, 60), (60, 65), (65, None)]


def test_while_a_goal_was_executing_is_asked_by_that_word(tmp_path: Path) -> None:
    """Executing from 10 to 20 s and from 30 to 35 s; the first one stays listed as succeeded."""
    messages = [*history((5, {1: 1}), (10, {1: 2}), (20, {1: 4}), (30, {1: 4, 2: 2}), (35, {2: 6}))]
    messages += [boolean(BEGIN + at * S, True, topic="/bump") for at in (7, 15, 25, 32, 38)]
    memory = remembered(tmp_path, in_order(messages))

    def bumps(kind: str, word: str | int, **more: object) -> Any:
        during = clause(TOPIC, kind, word) | more
        question = {"topic": "/bump", "condition_type": "equals", "value": True, "while": during}
        reply = asked(memory, "find_matches", **question, oldest_first=True)
        if "error" in reply:
            return reply["detail"]
        return [row["first_seen"] - T0 for row in reply["sightings"]]

    assert bumps("equals", "executing") == bumps("contains", "exec") == [15, 32]
    assert bumps("contains_word", "accepted") == [7]
    assert bumps("equals", 2, field="status_list.status") == [15, 32]
    for word in ("aborted", "failed", "cancel"):
        assert "find_matches says when each one ended" in bumps("contains", word)
    assert "the status of a goal is unknown, accepted, executing" in bumps("contains", "driving")


def test_a_search_for_messages_that_list_goals_says_that_they_list_those_that_ended(
    tmp_path: Path,
) -> None:
    memory = remembered(tmp_path, history((10, {1: 2}), (20, {1: 6}), (30, {1: 6, 2: 2})))
    number = {"condition_type": "equals", "field": "status_list.status", "value": 6}
    word = {"condition_type": "contains", "value": "aborted"}
    last = asked(memory, "find_last_match", topic=TOPIC, **number)
    assert last["timestamp"] - T0 == 30
    never = asked(memory, "find_last_match", topic=TOPIC, **word)
    assert never["timestamp"] is None
    both = {"value_topic": TOPIC, "condition_topic": TOPIC}
    by_number, by_word = (
        asked(memory, "get_value_when", **both, **each) for each in (number, word)
    )
    for reply in (last, never, by_number, by_word):
        [note] = reply["notes"]
        assert 'find_matches, such as contains "aborted", finds each goal' in note
    assert [(goal, last) for goal, _, _, last in found_in(memory, "contains", "aborted")] == [
        (1, 20)
    ]


def test_a_goal_has_the_fields_and_statuses_that_there_are(tmp_path: Path) -> None:
    memory = remembered(tmp_path, DAY)
    aborted = clause(TOPIC, "equals", "aborted")
    status = "status_list.1.status"
    goal = asked(memory, "find_matches", **aborted, fields=[status])["sightings"][0]["value"]
    assert (goal["goal"][-1], goal["status"], goal[status]) == ("2", "aborted", 6)
    refused = asked(memory, "find_matches", **aborted, fields=["nope"])
    assert (refused["error"], "nope" in refused["detail"]) == ("invalid_arguments", True)
    refused = asked(memory, "find_matches", **{**aborted, "value": "lost"})
    assert "aborted (0 to 6), or failed" in refused["detail"]


@settings(max_examples=examples(15))
@given(
    st.lists(
        st.tuples(st.integers(1, 9), st.integers(1, 9), st.integers(4, 6)), min_size=1, max_size=4
    ),
    st.integers(1, 5),
    st.booleans(),
)
def test_however_the_history_is_cut_the_same_is_told(
    runs: list[tuple[int, int, int]], cut: int, recalls: bool
) -> None:
    at, expected, statuses = 5, [], dict[int, int]()
    messages: list[tuple[int, Mapping[int, int]]] = [(1, {})]
    words = {4: "succeeded", 5: "canceled", 6: "aborted"}
    for goal, (pause, length, end) in enumerate(runs):
        at += pause
        begun, at = at, at + length
        statuses = {**statuses, goal: 2}
        messages.append((begun, statuses))
        statuses = {**statuses, goal: end}
        messages.append((at, statuses))
        expected.append((f"/drive goal {words[end]} after {length} s", begun, at))
    with TemporaryDirectory() as folder:
        found = told_goals(Path(folder), history(*messages), 0, 200, cut, recalls=recalls)
        searched = found_in(memory_of(Path(folder), recalls=recalls), "above", 3, field="status")
    assert [(text, begin, end) for _, text, begin, end, _ in found] == expected
    assert [
        (f"/drive goal {status} after {end - begin:g} s", begin, end)
        for _, status, begin, end in reversed(searched)
    ] == expected


def test_a_stop_does_not_go_on_while_poses_are_silent(tmp_path: Path) -> None:
    stood = [odom(BEGIN + at * S // 2, 1.0, 2.0) for at in range(40)]
    write_splits(tmp_path, [*stood, *(boolean(BEGIN + at * S, False) for at in range(60))], 20)
    for end, goes_on in ((15, True), (40, False), (60, False)):
        events = over(memory_of(tmp_path), 0, end).events
        assert [each.goes_on for each in events if each.kind == "stop"] == [goes_on]


@pytest.mark.parametrize("is_lost", [False, True])
def test_a_greatest_speed_that_a_gap_exceeds_has_a_note(
    tmp_path: Path, remember: Remember, is_lost: bool
) -> None:
    """It stands, and while it is not localised for a minute it gets 6 m farther."""
    stood = [odom(at(t / 5), 0.0) for t in range(150)]
    lost = [odom(at(30 + t / 5), math.nan) for t in range(300) if is_lost]
    later = [odom(at(90 + t / 5), 6.0) for t in range(50)]
    memory = remember([*stood, *lost, *later])
    note = "max_speed is of the time with poses alone: across gaps it was 0.10 m/s or more"
    for tool in ("trajectory_summary", "recap"):
        whole = asked(memory, tool, start=T0, end=T0 + 100)
        assert whole["max_speed"] == 0.0
        assert whole["gap_m"] == pytest.approx(6.0)
        assert note in whole["notes"]
        assert "max_speed" not in str(asked(memory, tool, start=T0, end=T0 + 29).get("notes"))
    driven = [odom(at(t / 5), t / 10) for t in range(150)]
    faster = remembered(
        tmp_path / "faster", [*driven, *(odom(at(90 + t / 5), 21.0) for t in range(50))]
    )
    assert "across gaps" not in str(asked(faster, "recap", start=T0, end=T0 + 100)["notes"])


def test_a_comparison_says_which_of_the_two_paths_has_a_gap(tmp_path: Path) -> None:
    legs = along_x(BEGIN, 30, mps=0.2, hz=10)
    legs += [odom(BEGIN + 60 * S + n * S // 10, 10.0 + n / 50) for n in range(300)]
    memory = remembered(tmp_path, legs)
    whole, part = (T0, T0 + 90), (T0, T0 + 20)
    gap = "1 gap without a pose, 4.02 m across in straight lines (gap_m): left out of distance_m"
    for this, other, of in (
        (whole, part, "from start to end: "),
        (part, whole, "from with_start to with_end: "),
        (whole, (T0, T0 + 85), ""),
    ):
        windows = dict(zip(("start", "end", "with_start", "with_end"), this + other, strict=True))
        notes = asked(memory, "compare", **windows)["notes"]
        assert [note for note in notes if "without a pose" in note] == [of + gap]


@pytest.mark.parametrize("map_frame", ["odom", "map"])
def test_how_far_it_is_across_a_gap_is_unknown_where_odometry_began_anew(
    tmp_path: Path, map_frame: str
) -> None:
    """It drives 6 m; the next recording begins at 2 m, of another origin if not in the map."""
    begin = 1_700_000_000 * S
    legs = [along_x(begin, 30, mps=0.2, hz=10)]
    legs.append([odom(begin + (60 + n) * S, 2.0) for n in range(30)])
    for number, leg in enumerate(legs):
        write_splits(tmp_path / "several", leg, 1000.0, f"run{number}")
    write_splits(tmp_path / "one", [*legs[0], *legs[1]], 1000.0, "run")
    window = {"start": begin / S, "end": begin / S + 100}
    for folder, is_known in (("several", map_frame == "odom"), ("one", True)):
        memory = memory_of(tmp_path / folder, limits=QuerySettings(map_frame=map_frame))
        for tool in ("recap", "trajectory_summary"):
            reply = asked(memory, tool, **window)
            assert reply["distance_m"] == pytest.approx(5.98, abs=0.05)
            assert reply.get("gap_m") == (pytest.approx(3.98, abs=0.01) if is_known else None)
            (note,) = [note for note in reply["notes"] if "1 gap without a pose" in note]
            assert ("across in straight lines" in note) == is_known
