from pathlib import Path
from typing import Any

import pytest

from ros2_memory.history.context import Memory
from tests.support.bags import (
    McapLayout,
    Msg,
    battery,
    boolean,
    command,
    diagnostics,
    goals,
    log_entry,
    odom,
    write_splits,
)
from tests.support.memories import asked, each_way, memory_of

S = 10**9
BEGIN = 1_784_000_000 * S


def at(seconds: float) -> int:
    return BEGIN + round(seconds * S)


def driving(until: int, stops: float) -> list[Msg]:
    """Drives 0.4 m/s up to a time, and then stands."""
    times = [nth / 10 for nth in range(until * 10)]
    return [odom(at(t), 0.4 * min(t, stops), 0.0, 0.0) for t in times]


def before(memory: Memory, around: float, **given: float) -> dict[str, Any]:
    folder, moment = memory.index.bag_dir, BEGIN / S + around
    reply: dict[str, Any] = asked(memory, folder, "recap", around=moment, **given)
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


def test_how_far_back_can_be_asked_and_a_stop_knows_what_changed_before_the_window(
    bag_dir: Path,
) -> None:
    memory = memory_of(bag_dir)
    assert told(before(memory, 43.0, seconds_before=1)) == [
        ("/cmd_vel went to zero while a goal was active", 0.0),
        ("/bumper became true", 0.4),
    ]
    assert before(memory, 43.0, seconds_before=61)["error"] == "invalid_arguments"
    reply = asked(memory, bag_dir, "recap", start=BEGIN / S + 44, end=BEGIN / S + 58)
    [stop] = [each for each in reply["events"] if each["text"].startswith("stood")]
    assert "/bumper became true" in [each["text"] for each in stop["before"]]


def test_a_charge_that_trembles_about_a_limit_falls_below_it_once(tmp_path: Path) -> None:
    trembling = [battery(at(t), 0.209 - t * 0.0002 + 0.008 * (-1) ** t) for t in range(60)]
    write_splits(tmp_path, [*trembling, boolean(at(59), True)])
    reply = before(memory_of(tmp_path), 60.0, seconds_before=60)
    below = [each for each in reply["before"] if "fell below" in each["text"]]
    assert [each["text"] for each in below] == ["/battery_state fell below 20%"]


def test_levels_without_a_name_are_numbers_and_long_texts_end_with_an_ellipsis(
    tmp_path: Path,
) -> None:
    text = "the current is above what is allowed " * 3
    levels = [diagnostics(at(t), motor=(7, text) if t > 38 else (0, "ok")) for t in range(60)]
    write_splits(tmp_path, [*driving(60, 43), *levels])
    reply = before(memory_of(tmp_path), 43.0)
    [(sentence, _)] = told(reply)
    assert sentence.startswith("status of motor became level 7: the current is above")
    assert sentence.endswith("…")
    assert len(sentence) == 100
    assert reply["state"] == {"status of motor": "level 7"}


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
