"""Robots that were plainly mixed into one history are named, and one robot never is."""

import re
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any
from unittest.mock import Mock, patch

import pytest

from ros2_memory.bag_dir.handover_file import Handover, write_handover
from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import Deadline
from ros2_memory.history import robots
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.view import View
from ros2_memory.insights.status import memory_status
from tests.support.bags import (
    McapLayout,
    Msg,
    along_x,
    boolean,
    in_order,
    odom,
    text,
    tf_of,
    write_db3,
    write_mcap,
)
from tests.support.clocks import SettableClock
from tests.support.mcap_surgery import spoil_chunk
from tests.support.memories import Remember, asked, clause, memory_of, noted, with_store

S = 10**9
T0_S = 1_700_000_000
T0 = T0_S * S


def drive(x: float, *, begin: int = 0, delay: int = 0) -> list[Msg]:
    """A minute of poses; with a delay as another recorder received the same messages."""
    stamps = [T0 + (begin + n) * S for n in range(61)]
    return [odom(at, x, n / 10, log_time=at + delay) for n, at in enumerate(stamps)]


def record(bag_dir: Path, name: str, messages: list[Msg]) -> None:
    write_mcap(bag_dir / name / f"{name}_0.mcap", messages)


def mounted(parent: str, at: int = T0) -> Msg:
    return tf_of(at, parent, "laser", (0.1, 0.0, 0.0), topic="/tf_static")


MIXED = re.compile("as of several robots.*blue, red")


def test_what_is_read_to_tell_robots_apart_says_nothing_of_the_answer(tmp_path: Path) -> None:
    for number, robot in enumerate(("red", "blue")):
        path = tmp_path / robot / f"{robot}_0.mcap"
        write_mcap(path, drive(10.0 * number), McapLayout(chunk_size=2000))
    spoil_chunk(path, 0)
    view = View(memory_of(tmp_path), Call())
    assert robots.recordings_apart(view, ["/odom"], TimeWindow(T0, T0 + 60 * S)) is not None
    assert view.notes.added
    assert (view.notes.complete, view.notes.sentences()) == (True, ())


def test_what_is_remembered_of_comparisons_is_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number, robot in enumerate(("red", "blue")):
        record(tmp_path, robot, drive(10.0 * number))
    memory = memory_of(tmp_path)
    monkeypatch.setattr(robots, "MOST_REMEMBERED", 4)
    for nth in range(40):
        window = {"start": T0_S + nth / 4, "end": T0_S + 20 + nth / 4}
        reply = asked(memory, "get_topic_in_range", topic="/odom", max_samples=2, **window)
        assert MIXED.search(str(reply["notes"]))
    differing = memory.snapshot().timeline.memo.of(robots._DIFFERING, dict)
    assert 0 < len(differing) <= 4


@pytest.fixture(scope="module", params=["{0}/{0}_0", "{0}", "{0}_0"])
def both(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Memory:
    """The bags of two robots that drive at once, 10 m apart: in a folder each, or in one."""
    folder = tmp_path_factory.mktemp("both")
    for number, robot in enumerate(("red", "blue")):
        name = str(request.param).format(robot)
        write_mcap(folder / f"{name}.mcap", drive(10.0 * number))
    return memory_of(folder)


@patch.object(robots, "_lacks_most", Mock(side_effect=QueryTimeoutError("late")))
def test_robots_that_there_is_no_time_to_tell_apart_are_no_single_one(both: Memory) -> None:
    reply = asked(both, "get_topic_in_range", topic="/odom", start=T0_S + 7, end=T0_S + 9)
    assert "known whether recordings differ on" in str(reply["notes"])


def driven(memory: Memory, start: int, stop: int) -> Any:
    """The path from a second to another."""
    span = {"start": T0_S + start, "end": T0_S + stop}
    return asked(memory, "trajectory_summary", **span)


def warned(memory: Memory) -> list[str]:
    return [note for note in memory_status(memory, Call()).notes if "robots are mixed" in note]


@pytest.mark.parametrize(
    ("bags", "named"),
    [
        (("red/red_0", "blue/blue_0"), "blue, red"),
        (("both/red", "both/blue"), "both/blue, both/red"),
        (("red/run/run_0", "blue/run/run_0"), "blue/run, red/run"),
    ],
)
def test_one_topic_twice_at_once_with_messages_of_its_own_is_two_robots(
    tmp_path: Path, bags: tuple[str, str], named: str
) -> None:
    for number, name in enumerate(bags):
        write_mcap(tmp_path / f"{name}.mcap", drive(10.0 * number))
    memory = memory_of(tmp_path)
    (note,) = warned(memory)
    assert f"{named} overlap in time" in note
    assert "/odom" in note
    assert named in driven(memory, 0, 60)["detail"]
    assert "robots are mixed (see notes)" in asked(memory, "memory_status")["doubts"]


def test_what_one_recorder_made_one_after_the_other_is_of_one_robot(tmp_path: Path) -> None:
    own = OwnRecordings(tmp_path)
    names = ("rec_20231114T221340Z", "rec_20231114T221330Z")
    for number, name in enumerate(names):
        record(tmp_path, name, drive(10.0 * number))
        own.begin(name)
        assert own.complete(name)
    memory = memory_of(tmp_path)
    assert warned(memory) == []
    status = asked(memory, "memory_status")
    assert status["doubts"] == "recordings overlap in time (see notes)"
    (note,) = noted(status, "as after a clock was set back")
    assert all(name in note for name in names)
    path = asked(memory, "trajectory_summary", start=0, end=2 * T0_S)
    assert path["distance_m"] == pytest.approx(6.0, abs=0.1)
    assert "as after a clock was set back" in str(path["notes"])
    visited = asked(memory, "visits", x=0.0, y=3.0, radius_m=1.0)
    assert (visited["total"], visited.get("unknown_s", 0)) == (1, 0)
    assert "as after a clock was set back" in str(visited["notes"])
    # A copy that nobody listed may be of another robot.
    for name in names:
        (tmp_path / name).rename(tmp_path / f"{name}_copy")
    assert len(warned(memory_of(tmp_path))) == 1


WINDOW = {"start": T0_S, "end": T0_S + 60}
PLACE = {"x": 0, "y": 0, "radius_m": 1}
ABOVE = {"condition_type": "above", "field": "position.x", "value": 5}
FOUND = {"topic": "/odom", **ABOVE}
DRIVEN = {"topic": "/odom", **WINDOW}


def test_answers_from_messages_of_both_robots_say_so(both: Memory) -> None:
    for tool, given in (
        ("visits", PLACE),
        ("visits", {**PLACE, "by": "day"}),
        ("find_things", {}),
        ("find_matches", FOUND),
        ("find_matches", {**FOUND, "by": "hour"}),
        ("find_last_match", FOUND),
        ("get_value_when", {"value_topic": "/odom", "condition_topic": "/odom", **ABOVE}),
        ("get_topic_in_range", DRIVEN),
        ("get_topic_in_range", {**DRIVEN, "fields": ["position.x"]}),
        ("get_topic_in_range", {**DRIVEN, "fields": ["position.x"], "by": "hour"}),
        ("get_position_at", {"timestamp": T0_S + 9}),
        ("recap", WINDOW),
    ):
        notes = asked(both, tool, **given)["notes"]
        assert any(MIXED.search(note) for note in notes), (tool, given)


def test_the_path_of_loose_bags_that_overlap_at_their_ends_is_that_of_the_first(
    tmp_path: Path,
) -> None:
    for number, robot in enumerate(("red", "blue")):
        write_mcap(tmp_path / f"{robot}.mcap", drive(10.0 * number, begin=55 * number))
    answer = driven(memory_of(tmp_path), 0, 59)
    assert "the path there is that of red" in str(answer["notes"])
    assert {point["x"] for point in answer["waypoints"]} == {0.0}


@pytest.mark.parametrize("asks", [{}, {"where": {"x": [-99, 99], "y": [-99, 99]}}])
def test_a_way_over_both_robots_is_not_known(both: Memory, asks: dict[str, object]) -> None:
    def ask(tool: str, **more: object) -> Any:
        return asked(both, tool, **WINDOW, **asks, **more)

    told, unknown = ask("recap"), "the path is unknown: recordings differ"
    assert [told.get(each) for each in ("distance_m", "max_speed", "stood_s")] == [None] * 3
    assert not [each for each in told["events"] if each["kind"] in {"stop", "drop"}]
    assert any(unknown in note for note in told["notes"])
    compared = ask("compare", with_start=T0_S, with_end=T0_S + 30)
    assert any(unknown in note for note in compared["notes"])
    assert "distance_m" not in compared.get("way", {})


def driving(begin: int, stop: int, x: float) -> list[Msg]:
    """Poses from a second to another, 0.5 m/s along x from a place."""
    return [odom(T0 + n * S, x + (n - begin) / 2) for n in range(begin, stop + 1)]


def test_the_path_of_a_day_is_known_though_the_clock_was_set_back_between_recordings(
    tmp_path: Path, remember: Remember
) -> None:
    record(tmp_path, "run_0", driving(0, 120, 0.0))
    # Where the first one ends, by a clock that is set back by 40 s.
    record(tmp_path, "run_1", driving(81, 200, 60.5))
    memory = remember()
    window = {"start": T0_S, "end": T0_S + 200}
    told = driven(memory, 0, 200)
    # Of 60 m and 59.5 m, without the 20 m of the 40 s that are twice: a gap is no way.
    assert told["distance_m"] == pytest.approx(100.0, abs=0.6)
    [note] = noted(told, "run_0 and run_1")
    assert "as after a clock was set back, or of two robots" in note
    assert note.endswith("the path there is that of run_0")
    recapped = asked(memory, "recap", **window)
    assert recapped["distance_m"] == pytest.approx(told["distance_m"], abs=0.02)
    by_hour = asked(memory, "trajectory_summary", **window, by="hour")
    [[*_, metres]] = by_hour["rows"]
    assert metres == pytest.approx(told["distance_m"], abs=0.02)
    alone = driven(memory, 130, 200)
    assert "run_0" not in str(alone.get("notes"))


def test_a_clock_that_is_set_back_while_a_recording_runs_makes_no_second_robot(
    tmp_path: Path,
) -> None:
    run = tmp_path / "run_1"
    write_mcap(run / "run_1_0.mcap", driving(0, 100, 0.0))
    write_mcap(run / "run_1_1.mcap", driving(40, 60, 50.5))
    # What follows begins before the end of the first split by the same clock.
    record(tmp_path, "run_2", driving(61, 200, 61.0))
    memory = memory_of(tmp_path)
    assert warned(memory) == []
    told = driven(memory, 95, 200)
    assert told["distance_m"] == pytest.approx(52.0, abs=0.6)
    assert "run_1 and run_2 differ on" in str(told["notes"])
    # What lies in a time that the recording had before is left out, and nothing is a jump back.
    for known in (memory, with_store(memory, tmp_path)):
        whole = driven(known, 0, 200)
        assert whole["distance_m"] == pytest.approx(99.5, abs=0.6)
        assert "run_1 has the time from" in str(whole["notes"])
        for at, is_twice in ((50, True), (150, False)):
            there = asked(known, "get_position_at", timestamp=T0_S + at)
            assert ("run_1 has the time from" in str(there.get("notes"))) is is_twice
        assert len(whole["waypoints"]) == 4


def test_what_was_so_around_a_time_that_a_recording_has_twice_has_a_note(
    tmp_path: Path, remember: Remember
) -> None:
    run = tmp_path / "run"
    states = [boolean(T0 + n * S, data=False) for n in range(100)]
    write_mcap(run / "run_0.mcap", in_order([*driving(0, 100, 0.0), *states]))
    states = [boolean(T0 + n * S, data=True) for n in range(60, 160)]
    write_mcap(run / "run_1.mcap", in_order([*driving(60, 160, 50.5), *states]))
    memory = remember()
    for at, is_twice in ((40, False), (57, True), (80, True), (105, True), (140, False)):
        notes = asked(memory, "recap", around=T0_S + at).get("notes", [])
        twice = [note for note in notes if note.startswith("run has the time from")]
        assert len(twice) == is_twice, at
        assert all("may be from before that or from after it" in note for note in twice)


def test_of_a_file_that_has_a_time_twice_no_path_is_known_and_no_pose_is_said_to_be_missing(
    remember: Remember,
) -> None:
    """As of a simulation that is reset while its clock gives the log times."""
    memory = remember([*driving(0, 100, 0.0), *driving(0, 60, 0.0)])
    window = {"start": T0_S, "end": T0_S + 90}
    for asks in ({}, {"by": "hour"}, {"where": PLACE}):
        refused = asked(memory, "trajectory_summary", **window, **asks)
        assert refused["reason"] == "mixed", asks
        assert refused["detail"].startswith("rec has the time from")
        assert "which poses belong to one path is not known" in refused["detail"]
    recapped = asked(memory, "recap", **window)
    assert recapped["distance_m"] is None
    note = "/odom has no poses in this time that count: the path is unknown"
    assert note in recapped["notes"]
    assert asked(memory, "get_topic_in_range", topic="/odom", **window)["total"] > 100


@pytest.mark.parametrize(
    "other",
    [
        [*(each for n, each in enumerate(drive(0.0, delay=3_000_000)) if n != 1), text(T0, "b")],
        drive(0.0, delay=3_000_000)[5::10],
        [text(T0 + n * S, str(n)) for n in range(60)],
    ],
    ids=["two recorders of one robot", "one that recorded a tenth", "different topics"],
)
def test_recordings_without_messages_of_their_own_on_a_topic_are_not(
    tmp_path: Path, other: list[Msg]
) -> None:
    record(tmp_path, "a", drive(0.0))
    record(tmp_path, "b", other)
    memory = memory_of(tmp_path)
    status = memory_status(memory, Call())
    assert "overlap in time" not in str(status.notes)
    for topic in ("/odom", "/chatter"):
        ranged = asked(memory, "get_topic_in_range", topic=topic, **WINDOW)
        assert "several robots" not in str(ranged.get("notes"))


def test_what_two_recorders_of_one_robot_lost_at_other_moments_makes_no_second_robot(
    tmp_path: Path,
) -> None:
    """In the second from 25 on, neither has what the other one received."""
    poses = along_x(T0, 60, mps=0.5, hz=50)
    record(tmp_path, "a", poses[:1250] + poses[1275:])
    record(tmp_path, "b", poses[:1275] + poses[1300:])
    memory = memory_of(tmp_path)
    window = {"start": T0_S + 25, "end": T0_S + 25.98}
    assert asked(memory, "recap", **window)["distance_m"] == pytest.approx(0.49, abs=0.02)
    ranged = asked(memory, "get_topic_in_range", topic="/odom", **window)
    assert (ranged["total"], ranged.get("notes")) == (50, None)
    assert warned(memory) == []


def figures(memory: Memory) -> list[float]:
    """How many messages each topic has, metres, seconds at a place, and how often a flag was on."""
    totals = [
        asked(memory, "get_topic_in_range", topic=topic, **WINDOW)["total"]
        for topic in ("/odom", "/chatter", "/tf_static")
    ]
    met = clause("/bumper", "equals", True, field="data")
    (visit,) = asked(memory, "visits", x=8, y=0, radius_m=3, **WINDOW)["visits"]
    return [
        *totals,
        asked(memory, "trajectory_summary", **WINDOW)["distance_m"],
        visit["duration_s"],
        asked(memory, "find_matches", **met, **WINDOW)["total"],
    ]


@pytest.mark.parametrize("seed", range(4))
def test_two_recorders_whose_publish_times_are_their_log_times_make_no_second_robot(
    tmp_path: Path, remember: Remember, seed: int
) -> None:
    """As Humble writes; the second began later, lacks a topic and lost some messages."""
    draw = Random(seed)
    poses = along_x(T0, 40, mps=0.5, hz=10)
    flags = [boolean(T0 + n * S // 10, n // 77 % 2 == 1) for n in range(400)]
    said = [text(T0 + n * S, "at the door") for n in (3, 9, 15, 31)]

    def received(messages: list[Msg], lost: float) -> list[Msg]:
        jittered = (
            replace(message, log_time=at, publish_time=at)
            for message in messages
            if draw.random() >= lost
            for at in [message.log_time + draw.randrange(100_000, 8_000_000)]
        )
        return in_order(jittered)

    record(tmp_path, "a", received([*poses, *flags, *said, mounted("base_link")], 0.0))
    expected = figures(memory_of(tmp_path))
    record(tmp_path, "b", received([mounted("base_link"), *poses[100:], *flags[50:]], 0.02))
    memory = remember()
    assert warned(memory) == []
    assert figures(memory) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("dated", ["a", "b", "bc"])
def test_a_recorder_that_knows_publish_times_beside_one_that_does_not_makes_no_second_robot(
    tmp_path: Path, remember: Remember, dated: str
) -> None:
    draw = Random(dated)
    flags = [boolean(T0 + n * S // 20, n // 77 % 2 == 1) for n in range(800)]
    said = [text(T0 + n * S, "at the door") for n in (3, 9, 15, 31)]
    messages = [mounted("base_link"), *along_x(T0, 40, mps=0.5, hz=10), *flags, *said]
    for name in sorted({"a", "b", *dated}):
        received = [
            replace(message, log_time=at, publish_time=message.log_time if name in dated else at)
            for message in messages
            for at in [message.log_time + draw.randrange(100_000, 8_000_000)]
        ]
        record(tmp_path, name, in_order(received))
        if name == "a":
            expected = figures(memory_of(tmp_path))
    memory = remember()
    assert warned(memory) == []
    assert figures(memory) == pytest.approx(expected, rel=1e-3)


def test_a_recorder_whose_clock_is_ahead_makes_no_second_robot(tmp_path: Path) -> None:
    """A base station receives the robot's poses and tasks, and dates them by its own clock."""
    tasks = ["dock", "drive", "drill", "scan", "drive", "drill", "dock"]
    said = [text(T0 + (5 + 8 * n) * S, task, "/task") for n, task in enumerate(tasks)]
    sent = in_order([*drive(0.0), *said])
    record(tmp_path, "rover_1", sent[:40])
    record(tmp_path, "rover_2", sent[40:])
    expected = asked(memory_of(tmp_path), "trajectory_summary", **WINDOW)["distance_m"]
    late = [
        replace(each, log_time=at, publish_time=at)
        for each in sent
        for at in [each.log_time + 1_200_000_000]
    ]
    record(tmp_path, "station", late)
    for memory in (memory_of(tmp_path), with_store(memory_of(tmp_path), tmp_path)):
        (note,) = asked(memory, "memory_status")["notes"]
        assert "two recorders have the same messages of /odom 1.2 s apart" in note
        path = asked(memory, "trajectory_summary", **WINDOW)
        assert path["distance_m"] == pytest.approx(expected, abs=0.1)
        assert str(path["notes"]).count("that of the first") == 1
        drilled = {"topic": "/task", "condition_type": "equals", "value": "drill"}
        visited = asked(memory, "visits", x=0, y=3, radius_m=9, **{"while": drilled})
        assert visited["minutes"] == pytest.approx(16 / 60, abs=0.05)
        assert visited.get("unknown_s", 0) < 8
        assert "several robots" not in str([path, visited])


def test_recorders_whose_clocks_drift_apart_are_of_one_robot(tmp_path: Path) -> None:
    """Of two hours: the clock of the station is 3 s ahead, and 0.05 s more each 1,000 s."""
    driven = along_x(T0, 7_200, mps=0.5)
    record(tmp_path, "rover", driven)
    ahead = [
        replace(each, log_time=at, publish_time=at)
        for each in driven
        for at in [each.log_time + 3 * S + (each.log_time - T0) // 20_000]
    ]
    record(tmp_path, "station", ahead)
    whole = {"start": T0 / S, "end": T0 / S + 7_200}
    path = asked(memory_of(tmp_path), "trajectory_summary", **whole)
    assert path["distance_m"] == pytest.approx(3_600, abs=5)
    assert noted(path, "two recorders have the same messages of /odom 3.2 s apart")


def test_equal_messages_of_a_recorder_count_though_one_was_received_as_it_was_published(
    tmp_path: Path,
) -> None:
    flags = [boolean(T0 + n * S // 20, data=False) for n in range(200)]
    late = [
        replace(flag, log_time=flag.log_time + 10**6, publish_time=flag.log_time) for flag in flags
    ]
    late[150] = flags[150]
    record(tmp_path, "a", late)
    record(tmp_path, "b", late[100:])
    ranged = asked(memory_of(tmp_path), "get_topic_in_range", topic="/bumper", **WINDOW)
    assert ranged["total"] == 200


def test_a_flag_that_two_robots_have_at_nearly_the_same_times_counts_for_each(
    tmp_path: Path, remember: Remember
) -> None:
    for nth, name in enumerate(("a", "b")):
        flags = [boolean(T0 + n * S // 10 + nth * 9_000_000, data=False) for n in range(400)]
        record(tmp_path, name, in_order([*drive(9.0 * nth), *flags]))
    memory = remember()
    ranged = asked(memory, "get_topic_in_range", topic="/bumper", **WINDOW)
    assert (ranged["total"], "several robots" in str(ranged["notes"])) == (800, True)


def test_what_two_robots_say_alike_at_other_moments_counts_for_each(tmp_path: Path) -> None:
    record(tmp_path, "a", [*drive(0.0), text(T0 + 20 * S, "done"), text(T0 + 40 * S, "done")])
    record(tmp_path, "b", [*drive(9.0), text(T0 + 20 * S + S // 2, "done")])
    ranged = asked(memory_of(tmp_path), "get_topic_in_range", topic="/chatter", **WINDOW)
    assert ranged["total"] == 3


@patch.object(robots, "_MAX_PAIRS", 3)
def test_two_robots_are_found_behind_however_many_handovers(tmp_path: Path) -> None:
    """However long a handover took, and whichever of the two recordings has it."""
    for number in range(5):
        name = f"a{number}"
        record(tmp_path, name, drive(0.0, begin=5 * number))
        if number % 2:
            links = Handover(previous=f"a{number - 1}", next=f"a{number + 1}")
            write_handover(tmp_path / name, links)
    for number, name in enumerate("bc"):
        record(tmp_path, name, drive(10.0 * number, begin=900))
    (note,) = warned(memory_of(tmp_path))
    assert "b, c overlap in time" in note


def test_a_robot_that_boots_in_1970_again_and_again_is_one(tmp_path: Path) -> None:
    for number in range(3):
        name = f"boot_{number}"
        poses = [odom((n + 1) * S, 5.0 * number, n / 10) for n in range(61)]
        record(tmp_path, name, poses)
    record(tmp_path, "set", drive(0.0))
    memory = memory_of(tmp_path)
    assert warned(memory) == []
    path = asked(memory, "trajectory_summary", start=0, end=70)
    assert "as after a clock was set back" in str(path["notes"])
    for tool in ("find_things", "memory_status"):
        assert "as after a clock was set back" not in str(asked(memory, tool))


def test_a_robot_whose_clock_is_set_while_it_records_is_one_in_each_boot(tmp_path: Path) -> None:
    for number in range(3):
        unset = [odom((n + 1) * S, 5.0 * number, n / 10) for n in range(40)]
        record(tmp_path, f"boot_{number}", [*unset, *drive(5.0 * number, begin=3600 * number)])
    memory = memory_of(tmp_path)
    assert warned(memory) == []
    sought = clause("/odom", "above", -1, field="position.x")
    calls: dict[str, dict[str, Any]] = {
        "find_matches": sought,
        "find_last_match": sought,
        "trajectory_summary": {"start": T0_S, "end": T0_S + 9000},
        "find_things": {},
    }
    for tool, arguments in calls.items():
        assert "differ" not in str(asked(memory, tool, **arguments))
    path = asked(memory, "trajectory_summary", start=0, end=70)
    assert "as after a clock was set back" in str(path["notes"])


def test_a_frame_with_two_parents_is_two_robots_until_a_recording_is_replaced_or_grows(
    tmp_path: Path,
) -> None:
    later = T0 + 3600 * S
    clock = SettableClock(later + 600 * S)
    record(tmp_path, "red", [mounted("base_link")])
    record(tmp_path, "blue", [mounted("torso", later)])
    memory = memory_of(tmp_path, clock=clock)
    (note,) = warned(memory)
    assert "laser is in base_link in the recording red, and in torso in blue" in note
    (tmp_path / "blue" / "blue_0.mcap").unlink()
    record(tmp_path, "blue", [mounted("base_link", later)])
    clock.at += 300 * S
    assert warned(memory) == []
    write_mcap(tmp_path / "blue" / "blue_1.mcap", [mounted("torso", later + 60 * S)])
    clock.at += 300 * S
    assert len(warned(memory)) == 1


def test_frames_that_are_known_contradict_each_other_without_time_for_others(
    tmp_path: Path,
) -> None:
    clock = SettableClock(T0 + 9 * 3600 * S)
    for hours, name, parent in ((1, "a", "base_link"), (2, "b", "base_link"), (3, "c", "torso")):
        record(tmp_path, name, [mounted(parent, T0 + hours * 3600 * S)])
    memory = memory_of(tmp_path, clock=clock)
    assert len(warned(memory)) == 1
    (tmp_path / "a" / "a_0.mcap").unlink()
    record(tmp_path, "a", [mounted("base_link", T0 + 3660 * S)])
    memory.index.refresh()
    clock.at += 300 * S
    late = Call(deadline=Deadline.after(-1.0))
    (note,) = robots.describe_mixed(memory, late)
    assert "laser is in base_link in the recording b, and in torso in c" in note


@pytest.mark.parametrize("kind", ["mcap", "db3"])
def test_what_a_file_has_twice_since_the_clock_was_set_back_is_no_part_of_a_path(
    tmp_path: Path, remember: Remember, kind: str
) -> None:
    """100 s at 0.5 m/s; after 50 s the clock is set back by 30 s."""
    poses = along_x(T0, 100, mps=0.5, hz=10)
    logged = [
        replace(pose, log_time=pose.log_time - 30 * S * (n >= 500)) for n, pose in enumerate(poses)
    ]
    if kind == "db3":
        write_db3(tmp_path / "run" / "run_0.db3", logged)
    else:
        write_mcap(tmp_path / "run" / "run_0.mcap", logged, McapLayout(chunk_size=1 << 14))
    memory = remember(storage=kind)
    (step,) = asked(memory, "data_time_range")["clock_steps"]
    assert step["at"] == pytest.approx(T0_S + 20, abs=1)
    assert step["step_s"] == pytest.approx(-29.9, abs=2)
    path = driven(memory, 0, 70)
    assert path["distance_m"] == pytest.approx(20.0, abs=1.2)
    assert path["gap_m"] == pytest.approx(30.0, abs=1.2)
    assert "run has the time from" in str(path["notes"])
    # At log time 40 it was at x = 20 m and, 30 s later, at x = 35 m.
    visits = asked(memory, "visits", x=35.0, y=0.0, radius_m=1.0)
    assert visits["unknown_s"] == pytest.approx(30, abs=2.1)
    assert "run has the time from" in str(visits["notes"])


@pytest.mark.parametrize("resting", [1, 20])
def test_two_runs_of_a_simulation_that_begin_alike_are_two_robots(
    tmp_path: Path, resting: int
) -> None:
    for speed in (1.0, 2.0):
        name, times = f"run_{speed:.0f}", range(S, 61 * S, S)
        poses = [odom(at, max(n - resting + 1, 0) * speed) for n, at in enumerate(times)]
        record(tmp_path, name, poses)
    memory = memory_of(tmp_path)
    (note,) = warned(memory)
    assert "run_1, run_2 overlap in time" in note
    told = asked(memory, "trajectory_summary", start=0, end=61)
    assert told["reason"] == "mixed"
