"""What happened in a time, and what changed before and after a moment."""

from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import pytest

from ros2_memory.analysis.facts import FLAG, MOST
from ros2_memory.core.regions import Circle, Place, Rectangle
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.view import TimeRange
from ros2_memory.insights.recap import recap
from ros2_memory.results import Recap
from tests.support.bags import (
    McapLayout,
    Msg,
    battery,
    boolean,
    command,
    detections,
    diagnostics,
    goals,
    log_entry,
    make,
    odom,
    write_mcap,
    write_splits,
)
from tests.support.memories import asked, each_way, memory_of

S = 10**9
BEGIN = 1_784_000_000 * S


def over(memory: Memory, begin: float, end: float) -> Recap:
    """Of so many seconds after BEGIN."""
    return recap(memory, Call(), TimeRange(start_s=BEGIN / S + begin, end_s=BEGIN / S + end))


def test_booleans_that_are_too_many_to_follow_are_counted(tmp_path: Path) -> None:
    type_name = "px4_msgs/msg/ManyFlags"
    body = make(type_name, **{f"flag_{nth:03}": False for nth in range(600)})
    write_splits(tmp_path, [Msg("/many", type_name, BEGIN + n * S, body) for n in (1, 2)])
    memory = memory_of(tmp_path)
    [note] = [note for note in over(memory, 0, 10).notes if "/many" in note]
    more = 600 - MOST[FLAG]
    assert note == (
        f"/many has too many booleans or things in one message: {more} more are not followed"
    )


def test_one_pose_that_noise_throws_off_cuts_nothing_off_a_stop(tmp_path: Path) -> None:
    draw = Random(1)
    thrown = {5 * 50 + 25, 13 * 50 - 25}
    messages: list[Msg] = []
    for tick in range(18 * 50):
        x = 0.5 * (min(tick / 50, 5) + max(tick / 50 - 13, 0)) + draw.gauss(0, 0.005)
        y = 0.024 if tick in thrown else draw.gauss(0, 0.005)
        messages.append(odom(BEGIN + tick * S // 50, x, y))
    write_splits(tmp_path, messages)
    [stop] = [each for each in over(memory_of(tmp_path), 0, 20).events if each.kind == "stop"]
    assert stop.end is not None
    assert (stop.start - BEGIN) / S == pytest.approx(5, abs=0.1)
    assert (stop.end - BEGIN) / S == pytest.approx(13, abs=0.1)


PLACES = (
    Place("room", "map", Rectangle(-1, 5, -1, 4)),
    Place("corner", "map", Circle(0.0, 3.0, 0.5)),
    Place("elsewhere", "map", Rectangle(50, 51, 50, 51)),
)


def in_places(memory: Memory, frame_id: str = "map") -> Memory:
    places = tuple(replace(each, frame_id=frame_id) for each in PLACES)
    return replace(memory, limits=replace(memory.limits, places=places))


def test_only_what_happened_in_a_place_is_reported(tmp_path: Path) -> None:
    """Drives 1 m/s through the room and out of it, stands at 20 s and at 50 s, bumps twice."""
    messages = []
    for step in range(700):
        seconds = step / 10
        stood = min(max(seconds - 20, 0), 10) + min(max(seconds - 50, 0), 10)
        messages.append(odom(BEGIN + step * S // 10, seconds - stood - 16, 0.0))
        if step % 10 == 0:
            bump = int(seconds) in {18, 45}
            messages.append(boolean(BEGIN + step * S // 10, bump, topic="/bumper"))
            label = "cup" if 17 <= seconds < 30 else "plant"
            messages.append(detections(BEGIN + step * S // 10, [label]))
        if step in {180, 450, 460}:
            messages.append(log_entry(BEGIN + step * S // 10, 40, "base", "stuck"))
    write_splits(tmp_path, messages)
    memory = in_places(memory_of(tmp_path), "odom")
    span = TimeRange(start_s=BEGIN / S, end_s=BEGIN / S + 70)
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
    refused = asked(memory, "recap", around=BEGIN / S + 20, where="room")
    assert refused["error"] == "invalid_arguments"
    robot = asked(memory, "recap", around=BEGIN / S + 20)["robot"]
    assert (robot["frame_id"], robot["in"]) == ("odom", "room")


def test_what_was_not_recorded_is_part_of_no_duration_and_of_no_mean(tmp_path: Path) -> None:
    """A robot that drives at 0.5 m/s, recorded for 20 s, an hour later, and another hour later."""
    for run in range(3):
        begin = BEGIN + run * 3600 * S
        body = [odom(begin + n * S // 10, n * 0.05, 0.0, 0.0) for n in range(200)]
        body += [boolean(begin + n * S, n < 5, "/bumper") for n in range(20)]
        write_mcap(tmp_path / f"run{run}" / f"run{run}_0.mcap", body)
    memory, window = memory_of(tmp_path), {"start": BEGIN / S, "end": BEGIN / S + 7220}
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
    return [odom(at(t), 0.4 * min(t, stops), 0.0, 0.0) for t in times]


def before(memory: Memory, around: float, **given: float) -> dict[str, Any]:
    reply: dict[str, Any] = asked(memory, "recap", around=BEGIN / S + around, **given)
    return reply


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


@pytest.fixture(scope="module")
def bag_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bags")
    write_splits(folder, ALL)
    return folder


@each_way
def test_what_changed_is_listed_the_nearest_first(bag_dir: Path, recalls: bool) -> None:
    reply = before(memory_of(bag_dir, recalls=recalls), 43.0)
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
    write_splits(tmp_path, [*trembling, boolean(at(59), True)])
    reply = before(memory_of(tmp_path), 60.0, seconds_before=60)
    below = [each for each in reply["before"] if "fell below" in each["text"]]
    assert [each["text"] for each in below] == ["/battery_state fell below 20%"]


def test_the_first_changes_after_a_moment_are_told_apart(tmp_path: Path) -> None:
    late = [log_entry(at(40 + t), 30, name, "late") for t, name in ((0.4, "a"), (5.2, "f"))]
    late += [log_entry(at(41 + 0.7 * nth), 30, name, "late") for nth, name in enumerate("bcde")]
    write_splits(tmp_path, [*driving(60, 40), *late])
    memory = memory_of(tmp_path)
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
    later = [odom(at(600 + t), 24.0, 0.0) for t in range(60)]
    later += [command(at(600 + t), 0.4 if t < 40 else 0.0) for t in range(30, 60)]
    later += [goals(at(601), {1: 2})] * listed_again
    write_splits(tmp_path, later, name="second", layout=layout)
    reply = before(memory_of(tmp_path), 642.0)
    went_on = [("/cmd_vel went to zero while a goal was active", 2.0)]
    assert told(reply) == (went_on if listed_again else [])
    assert reply["state"] == {"/docked": True} | ({"/drive goal": "active"} if listed_again else {})


def test_what_a_latched_topic_said_is_the_state_also_hours_later_not_a_goal(tmp_path: Path) -> None:
    said = [boolean(at(t), value, "/docked") for t, value in ((0, True), (7200, False))]
    said.append(goals(at(0), {1: 2}))
    beats = [odom(at(t), 0.0, 0.0) for t in range(0, 7300, 10)]
    layout = McapLayout(latched=frozenset({"/docked", "/drive/_action/status"}))
    write_splits(tmp_path, [*said, *beats], 1000, layout=layout)
    memory = memory_of(tmp_path)
    assert before(memory, 5000.0)["state"] == {"/docked": True}
    assert told(before(memory, 7203.0)) == [("/docked became false", 3.0)]
