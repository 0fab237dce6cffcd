"""What could not be read, or was not recorded, is part of every answer, said once and truly.

A window in which nothing was recorded has no answer: "never" and "none" would be false. What was
excluded was recorded, an interruption explains what it cost and no more, a wrong clock spoils no
answer, and time 0 is a moment like any other.
"""

import json
import os
import random
import re
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import Writer

from ros2_memory import queries
from ros2_memory.bag_dir.state_files import (
    EVERY_TOPIC,
    SCREENED,
    Excluded,
    Loss,
    ScreenState,
    append_losses,
)
from ros2_memory.core.errors import InvalidArgumentsError, NoDataReason
from ros2_memory.core.model import BagFile, SetAside, TimeWindow
from ros2_memory.history.context import Call, Memory, QuerySettings
from ros2_memory.history.coverage import note_unread
from ros2_memory.history.view import TimeRange, View
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.index.timeline import Timeline
from tests.support import bags
from tests.support.bags import (
    McapLayout,
    Msg,
    along_x,
    boolean,
    detections,
    in_order,
    log_entry,
    odom,
    set_mtime,
    text,
    tf,
    tf_of,
    transform,
    write_db3,
    write_mcap,
)
from tests.support.clocks import FixedClock, SettableClock
from tests.support.heartbeats import beat
from tests.support.listed_bags import odom_bag
from tests.support.mcap_surgery import chunks_of, raw_mcap, spoil_chunk
from tests.support.memories import (
    Remember,
    asked,
    clause,
    memory_of,
    remembered,
    replied,
    with_store,
)
from tests.unit.history.test_any_cut import questions

S = 10**9

T0_S = 1_784_023_200
T0 = T0_S * S
HOUR = 3600 * S
LOST = "could not be read, so messages may be missing: rec/rec_1.mcap"


def messages(start_s: int) -> list[Msg]:
    """Of ten seconds."""
    made: list[Msg] = []
    for second in range(start_s, start_s + 10):
        at = T0 + second * S
        made += [
            odom(at, second * 0.1),
            tf_of(at, "odom", "base_link", (second * 0.1, 0.0, 0.0)),
            boolean(at, second % 7 == 0),
        ]
    return [*made, detections(T0 + start_s * S, ["cup"])]


def write_splits(bag_dir: Path, count: int) -> list[Path]:
    paths = []
    for number in range(count):
        path = bag_dir / "rec" / f"rec_{number}.mcap"
        paths.append(write_mcap(path, messages(number * 10), McapLayout(chunk_size=2000)))
        set_mtime(path, T0 + number * 10 * S + 10 * S)
    return paths


def tear(path: Path, at: int = T0) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b"this was a bag once, and is none any more")
    set_mtime(path, at)


def at(second: float) -> float:
    return T0_S + second


Question = tuple[str, dict[str, Any]]
FULL = {"start": at(0), "end": at(29)}
NEAR: dict[str, Any] = {"topic": "/odom", "condition_type": "near_position"}
FAR: dict[str, Any] = {**NEAR, "value": {"x": 500, "y": 0}}
SCISSORS = {"condition_type": "contains", "value": "scissors"}
SEEN = clause("/vision/*", "contains", "cup")
BASE = {"parent": "odom", "child": "base_link"}

TOUCHING: list[Question] = [
    ("get_topic_at_time", {"topic": "/odom", "timestamp": at(15), "tolerance_s": 30}),
    ("get_topic_at_time", {"topic": "/nowhere", "timestamp": at(5)}),
    ("get_topic_in_range", {"topic": "/odom", "start": at(12), "end": at(15)}),
    ("get_topic_in_range", {"topic": "/bumper", **FULL, "changes": True}),
    ("get_topic_in_range", {"topic": "/bumper", **FULL, "by": "value"}),
    ("get_position_at", {"timestamp": at(15)}),
    ("get_velocity_at", {"timestamp": at(15)}),
    ("get_transform_at", {**BASE, "timestamp": at(12)}),
    ("get_transform_at", {"parent": "odom", "child": "nobody", "timestamp": at(15)}),
    ("list_frames", {}),
    ("trajectory_summary", FULL),
    ("trajectory_summary", {**FULL, "by": "hour"}),
    ("find_last_match", {**NEAR, "value": {"x": 0.3, "y": 0}}),
    ("find_last_match", FAR),
    ("find_last_match", {"topic": "/vision/*", **SCISSORS, "before": at(19)}),
    (
        "get_value_when",
        {"value_topic": "/odom", "condition_topic": "/vision/scene/scene_objects", **SCISSORS},
    ),
    ("find_things", {}),
    ("find_things", {"label": "dog"}),
    ("find_matches", SEEN),
    ("find_matches", {**SEEN, "by": "day"}),
    ("find_matches", {**SEEN, "by": "label"}),
    ("visits", {"x": 500, "y": 0}),
    ("visits", {"x": 0.5, "y": 0, "by": "day", **FULL}),
    ("recap", FULL),
    ("recap", {"around": at(25)}),
    ("compare", {"start": at(12), "end": at(29), "with_start": at(0), "with_end": at(9)}),
]

APART: list[Question] = [
    ("get_topic_at_time", {"topic": "/odom", "timestamp": at(5)}),
    ("get_topic_in_range", {"topic": "/odom", "start": at(0), "end": at(9)}),
    ("get_position_at", {"timestamp": at(25)}),
    ("get_transform_at", {**BASE, "timestamp": at(5)}),
    ("trajectory_summary", {"start": at(21), "end": at(29)}),
    ("find_things", {"end": at(9)}),
    ("find_things", {"label": "dog", "start": at(21)}),
    ("compare", {"start": at(21), "end": at(29), "with_start": at(0), "with_end": at(8)}),
    ("find_last_match", {**NEAR, "value": {"x": 2.5, "y": 0}}),
    ("find_last_match", {**FAR, "before": at(8)}),
]


@pytest.fixture(scope="module", params=[False, True], ids=["plain", "catalogue"])
def torn(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Memory:
    """Of three splits the second is torn."""
    folder = tmp_path_factory.mktemp("torn")
    tear(write_splits(folder, 3)[1], T0 + 20 * S)
    return memory_of(folder, clock=FixedClock(T0 + HOUR), recalls=request.param)


@pytest.mark.parametrize(("tool", "given"), TOUCHING)
def test_every_tool_says_that_a_split_of_its_window_could_not_be_read(
    tool: str, given: dict[str, Any], torn: Memory
) -> None:
    assert LOST in str(asked(torn, tool, **given)["notes"])


@pytest.mark.parametrize(("tool", "given"), APART)
def test_no_tool_speaks_of_a_split_that_its_window_does_not_touch(
    tool: str, given: dict[str, Any], torn: Memory
) -> None:
    reply = asked(torn, tool, **given)
    assert reply is None or "error" not in reply
    assert "could not be read" not in str(reply)


def test_the_split_being_written_is_reported_where_it_may_hold_newer_and_no_future_is(
    tmp_path: Path,
) -> None:
    write_splits(tmp_path, 2)
    active = write_mcap(tmp_path / "rec" / "rec_2.mcap", messages(20), McapLayout(finish=False))
    set_mtime(active, T0 + 29 * S)
    memory = memory_of(tmp_path, clock=FixedClock(T0 + 30 * S))
    written = f"the split being written is left out: nothing after {at(19):.6f}"
    newest = asked(memory, "find_last_match", **SEEN)
    assert (newest["timestamp"], newest["notes"]) == (at(10), [written])
    older = asked(memory, "find_last_match", **SEEN, before=at(15))
    assert "notes" not in older
    lately = asked(memory, "get_topic_in_last", topic="/odom", seconds=25)
    assert lately["notes"] == [written]
    now = asked(memory, "get_position_seconds_ago", seconds_ago=1)
    assert (now["reason"], now["notes"]) == ("not_closed_yet", [written])
    # A time in the future is not waited for.
    soon = asked(memory, "get_position_at", timestamp=at(80))
    assert soon["reason"] == "not_closed_yet"
    future = asked(memory, "get_position_at", timestamp=at(3630))
    assert future["reason"] == "outside_range"
    assert f"the time asked is 3600 s in the future: it is {at(30):.6f} now" in future["detail"]
    assert "tolerance_s" not in future["detail"]
    window = {"topic": "/odom", "end": at(9000)}
    begun = asked(memory, "get_topic_in_range", **window, start=at(25))
    assert begun["reason"] == "not_closed_yet"
    later = asked(memory, "get_topic_in_range", **window, start=at(8000))
    assert later["reason"] == "outside_range"
    assert "in the future" in later["detail"]


def test_a_bag_that_a_crash_left_open_is_reported_with_what_is_lost_of_it(tmp_path: Path) -> None:
    paths = write_splits(tmp_path, 3)
    paths[2].write_bytes(paths[2].read_bytes()[:6000])
    set_mtime(paths[2], T0 + 32 * S)
    memory = memory_of(tmp_path, clock=FixedClock(T0 + HOUR))
    window = {"topic": "/odom", "start": at(1), "end": at(31)}
    told = asked(memory, "get_topic_in_range", **window)["notes"][0]
    assert told == f"messages after {at(21):.6f} may be missing, as a crash left 1 bag open"
    [named] = asked(memory, "data_time_range")["incomplete"]
    assert named["file"] == "rec/rec_2.mcap"
    assert named["reason"].startswith("the file ends early: the last ")
    assert "notes" not in asked(memory, "get_topic_in_range", **window | {"end": at(19)})
    assert "notes" not in asked(memory, "get_position_at", timestamp=at(19))
    rows = queries.list_recorded_topics(memory, Call())
    assert [row.notes for row in rows if row.topic == "/odom"] == [(told,)]


def test_a_clock_that_was_set_back_in_an_unfinished_bag_is_no_reason_why_messages_are_missing(
    tmp_path: Path,
) -> None:
    ticks = [*range(30), *range(10, 40)]
    path = write_mcap(
        tmp_path / "rec" / "rec_0.mcap",
        [boolean(T0 + n * S, True) for n in ticks],
        McapLayout(chunk_size=300, finish=False),
    )
    set_mtime(path, T0 + 45 * S)
    memory = memory_of(tmp_path, clock=FixedClock(T0 + HOUR))
    window = {"topic": "/bumper", "start": at(0), "end": at(44)}
    notes = asked(memory, "get_topic_in_range", **window)["notes"]
    missing = [note for note in notes if "missing" in note]
    assert missing == [f"messages after {at(34):.6f} may be missing, as a crash left 1 bag open"]
    assert any("twice, as the clock was set back meanwhile" in note for note in notes)


def write_protobuf(path: Path, topics: int) -> None:
    path.parent.mkdir(parents=True)
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="", library="test")
        schema = writer.register_schema("keelson.Envelope", "protobuf", b"")
        for number in range(topics):
            channel = writer.register_channel(f"/keelson/{number:03}", "protobuf", schema)
            writer.add_message(channel, T0 + number * S, b"\x08\x01", T0 + number * S)
        writer.finish()


def test_many_topics_that_are_not_read_hide_no_damaged_file(
    tmp_path: Path, remember: Remember
) -> None:
    write_protobuf(tmp_path / "keelson" / "keelson_0.mcap", 6)
    seen = [detections(T0 + n * S, ["cup"]) for n in range(40)]
    for name in ("a/run", "b/run", "c", "d", "e"):
        path = tmp_path / name / f"{name[2:] or name}_0.mcap"
        spoil_chunk(write_mcap(path, seen, McapLayout(chunk_size=2000)), 1)
    tear(tmp_path / "f" / "f_0.mcap")
    never = clause("/*", "contains", "never seen")
    memory = remember()
    notes = asked(memory, "find_last_match", **never)["notes"]
    damaged, unread, undecoded = sorted(notes)
    assert undecoded.startswith(
        "messages of 6 topics could not be decoded: its message encoding 'protobuf'"
    )
    assert "/keelson/000 (keelson.Envelope), /keelson/001 (keelson.Envelope)" in undecoded
    assert "and 3 more" in undecoded
    assert damaged.startswith("5 bags could not be read whole: a/run/run_0.mcap (")
    assert ", b/run/run_0.mcap (" in damaged
    assert "and 2 more" in damaged
    assert unread.startswith("could not be read, so messages may be missing: f/f_0.mcap")


def test_of_several_files_that_are_not_read_the_newest_is_named(tmp_path: Path) -> None:
    """Not the last by name: rec_10 comes before rec_9 there."""
    for nth in range(12):
        path = tmp_path / "rec" / f"rec_{nth}.mcap"
        if nth in {9, 10}:
            tear(path)
        else:
            write_mcap(path, along_x(T0 + nth * 10 * S, 9))
    never = {"topic": "/odom", "condition_type": "contains", "value": "never seen"}
    notes = asked(memory_of(tmp_path), "find_last_match", **never)["notes"]
    [said] = [note for note in notes if note.startswith("could not be read")]
    assert "rec/rec_10.mcap" in said
    assert "and 1 more" in said


@pytest.mark.parametrize("topics", [1, 3])
def test_where_nothing_can_be_decoded_damaged_files_are_named_beside_it(
    tmp_path: Path, topics: int
) -> None:
    write_protobuf(tmp_path / "keelson" / "keelson_0.mcap", topics)
    tear(tmp_path / "f" / "f_0.mcap")
    memory = memory_of(tmp_path)
    found = {"condition_type": "contains", "value": "x"}
    every, first = "/keelson/*", "/keelson/000"
    window = {"topic": first, "start": T0_S, "end": T0_S + 9}
    for tool, given_ in (
        ("find_last_match", {"topic": every, **found}),
        ("find_matches", {"topic": every, **found}),
        ("get_value_when", {"condition_topic": every, "value_topic": first, **found}),
        ("get_topic_in_range", window),
        ("trajectory_summary", window),
    ):
        reply = asked(memory, tool, **given_)
        assert reply["reason"] == "undecodable"
        assert "(keelson.Envelope) are recorded but cannot be decoded" in reply["detail"]
        assert "messages may be missing: f/f_0.mcap" in str(reply["notes"])
        of_all = "messages of 3 topics could not be decoded" in str(reply["notes"])
        assert of_all == (given_ is not window and topics == 3)


def test_what_cannot_be_decoded_is_judged_by_bags_that_are_there(
    tmp_path: Path, remember: Remember
) -> None:
    """The first bag has the definition, the second one has not, and is then deleted."""
    for n, layout in enumerate([McapLayout(), McapLayout(definitions=False)]):
        seen = detections(T0 + n * 100 * S, ["cup"])
        write_mcap(tmp_path / f"run{n}" / f"run{n}_0.mcap", [seen], layout)
    memory = remember()
    assert asked(memory, "data_time_range")["undecodable"] == []
    (tmp_path / "run1" / "run1_0.mcap").unlink()
    assert asked(memory, "data_time_range")["undecodable"] == []


@pytest.mark.parametrize(("fields", "is_lost"), [(b"later", True), (b"\x00", False)])
def test_messages_of_a_type_that_the_recorder_did_not_find_are_said_to_be_undecodable(
    tmp_path: Path, remember: Remember, fields: bytes, is_lost: bool
) -> None:
    """As the feedback of actions, whose definition rosbag2 does not find; or it has no fields."""
    payload = b"\x00\x01\x00\x00" + fields

    def fill(writer: Writer) -> None:
        schema = writer.register_schema("a_msgs/action/Go_FeedbackMessage", "ros2msg", b"")
        channel = writer.register_channel("/go/_action/feedback", "cdr", schema)
        for at in range(20):
            writer.add_message(channel, T0 + at * S, payload, T0 + at * S)

    raw_mcap(tmp_path / "run" / "run_0.mcap", fill, profile="ros2")
    memory = remember()
    rows = asked(memory, "data_time_range")["undecodable"]
    assert [row["topic"] for row in rows] == (["/go/_action/feedback"] if is_lost else [])
    assert ("cannot be decoded" in asked(memory, "memory_status")["doubts"]) == is_lost


@pytest.mark.parametrize("damaged", [[4, 5, 6], [*range(1, 19)], [0, 19]])
def test_a_message_that_cannot_be_decoded_ends_no_sighting_and_is_none(
    tmp_path: Path, remember: Remember, damaged: list[int]
) -> None:
    cut_off = b"\x00\x01\x00\x00\xff\xff\xff\x7f"
    kind = "ros2_vision_interfaces/msg/VisionDetectionArray"
    messages = [
        Msg("/vision/scene/scene_objects", kind, T0 + n * S, cut_off)
        if n in damaged
        else detections(T0 + n * S, ["cup"] if n < 20 else ["table"])
        for n in range(30)
    ]
    bags.write_splits(tmp_path, messages)
    memory = remember()
    reply = asked(memory, "find_matches", **SEEN)
    seen = [n for n in range(20) if n not in damaged]
    [sighting] = reply["sightings"]
    assert (sighting["first_seen"], sighting["last_seen"]) == (T0_S + seen[0], T0_S + seen[-1])
    assert (sighting["count"], reply["total"]) == (len(seen), 1)
    assert "could not be decoded" in str(reply["notes"])


def test_an_index_that_no_message_needs_is_no_doubt_of_an_answer(tmp_path: Path) -> None:
    for name in "abc":
        messages = [boolean(T0 + n * S, n % 2 == 0) for n in range(6)]
        path = write_db3(tmp_path / name / f"{name}_0.db3", messages)
        with closing(sqlite3.connect(path)) as base:
            base.execute("PRAGMA writable_schema = 1")
            base.execute(
                "UPDATE sqlite_master SET sql = replace(sql, 'ASC', 'DESC') WHERE type = 'index'"
            )
            base.commit()
    window = {"start": T0_S, "end": T0_S + 9}
    bumps = {"condition_type": "equals", "value": True}
    for tool, given_ in (
        ("get_topic_at_time", {"topic": "/bumper", "timestamp": T0_S + 5}),
        ("get_topic_in_range", {"topic": "/bumper", **window}),
        ("find_last_match", {"topic": "/bumper", **bumps}),
        ("find_matches", {"topic": "/bumper", **bumps}),
        ("recap", window),
    ):
        memory = memory_of(tmp_path, storage="rosbag2")
        assert "damaged" not in str(asked(memory, tool, **given_)), tool
    never = {"condition_type": "contains", "value": "x"}
    assert asked(memory, "find_last_match", topic="/bumper", **never) is None
    [named] = asked(memory, "data_time_range")["notes"]
    assert named.startswith("c/c_0.db3, b/b_0.db3, a/a_0.db3: its index by time")


DAY = 24 * 3600 * S


def test_a_time_of_a_wrong_clock_is_recorded_as_any_other(tmp_path: Path) -> None:
    for name, start_s in (("unset", 1000 - T0_S), ("set", 0)):
        write_mcap(tmp_path / name / f"{name}_0.mcap", messages(start_s))
    memory = memory_of(tmp_path, clock=FixedClock(T0 + HOUR))
    unset = {"start": 1000, "end": 1009}
    compared = asked(memory, "compare", **unset, with_start=T0_S, with_end=T0_S + 9)
    assert compared["recorded_s"] == {"this": 9.0, "with": 9.0}
    assert "recorded only" not in str(asked(memory, "recap", **unset))


def test_a_gap_in_which_a_robot_may_have_driven_with_a_wrong_clock_says_so(tmp_path: Path) -> None:
    """Of the second day: what its file was made on, two hours after the rightly dated drive."""
    day = 86_400
    for nth in range(3):
        poses = along_x((T0_S + nth * day) * S, 60)
        write_mcap(tmp_path / f"day{nth}" / f"day{nth}_0.mcap", poses)
    boot = tmp_path / "boot" / "boot_0.mcap"
    write_mcap(boot, along_x(20 * S, 60))
    os.utime(boot, (T0_S + day + 7_200,) * 2)
    memory = memory_of(tmp_path)

    def is_noted(tool: str, begin: float, end: float, **arguments: object) -> bool:
        told = asked(memory, tool, start=T0_S + begin, end=T0_S + end, **arguments)
        note = "dated by a wrong clock, and may be of this time: boot/boot_0.mcap"
        return note in str(told.get("notes"))

    for tool in ("trajectory_summary", "recap"):
        assert is_noted(tool, day, 2 * day - 10)
        assert not is_noted(tool, day + 5, day + 50)
        assert not is_noted(tool, day + 7_300, 3 * day)
    assert is_noted("trajectory_summary", 0, 3 * day, by="day")
    assert is_noted("trajectory_summary", day + 3_600, day + 3_700)


def test_what_a_topic_reports_that_was_not_recorded_in_a_time_is_unknown_then_not_zero(
    tmp_path: Path, remember: Remember
) -> None:
    """Diagnostics and the lidar's topic were taken into the list after ten minutes."""
    made = along_x(T0, 1200)
    made += [boolean(T0 + n * S, True, "/heartbeat") for n in range(1200)]
    made += [bags.diagnostics(T0 + n * S, motor=(2, "hot")) for n in range(600, 1200)]
    heard = [n for n in range(600, 1200) if not 700 < n < 900]
    made += [boolean(T0 + n * S, True, "/lidar") for n in heard]
    made += [log_entry(T0 + 100 * S, 20, "nav", "fine"), log_entry(T0 + 900 * S, 40, "nav", "lost")]
    bags.write_splits(tmp_path, made, 60)
    window = {"start": T0_S + 600, "end": T0_S + 1199}
    memory = remember()
    reply = asked(memory, "compare", **window, with_start=T0_S, with_end=T0_S + 599)
    assert reply["errors"] == {
        "motor: hot": {"this": 600.0, "with": None},
        "nav: lost": {"this": 1.0, "with": 0.0},
    }
    assert reply["silent_s"] == {"/lidar": {"this": 200.0, "with": None}}


NO_MEMORY: Final = memory_of(Path("/nowhere"))


def test_a_search_before_the_first_message_of_its_topics_says_that_nothing_was_searched(
    tmp_path: Path, remember: Remember
) -> None:
    """The robot is recorded for a minute, its bumper from 30 s on: it says something twice."""
    made = along_x(T0, 60)
    made += [boolean(T0 + n * S, n == 50) for n in (30, 50)]
    bags.write_splits(tmp_path, made)
    memory = remember()
    hit = clause("/bump*", "equals", True)
    unsearched = f"no message of /bumper is here before {T0_S + 30}.000000: nothing was searched"
    assert asked(memory, "find_matches", **hit, end=T0_S + 20)["notes"] == [unsearched]
    assert asked(memory, "find_last_match", **hit, before=T0_S + 20)["notes"] == [unsearched]
    assert "notes" not in asked(memory, "find_matches", **hit, start=T0_S + 35, end=T0_S + 40)
    assert asked(memory, "find_last_match", **hit, before=T0_S + 40) is None


def listed(number: int, notes: tuple[str, ...] = ()) -> BagFile:
    start, end = T0 + number * 10 * S, T0 + number * 10 * S + 9 * S
    return odom_bag(f"/b/rec/rec_{number}.mcap", start, end, written=end, notes=notes)


def sentences(snapshot: Snapshot, start: int, stop: int, *, nothing: bool = False) -> list[str]:
    view = View(replace(NO_MEMORY, fixed=snapshot), Call())
    note_unread(view, TimeWindow(T0 + start * S, T0 + stop * S), nothing=nothing, gaps=False)
    return [*view.notes.sentences()]


def test_beside_an_answer_that_there_is_nothing_each_file_is_named_that_may_hold_it() -> None:
    active = SetAside(Path("/b/copied/copied_0.db3"), "still being written")
    snapshot = Snapshot(Timeline.of([listed(0)]), active=(active,), scanned_at=T0 + 72 * HOUR)
    assert sentences(snapshot, 0, 9) == []
    named = ["still being written and not included: copied/copied_0.db3"]
    assert sentences(snapshot, 0, 9, nothing=True) == named


@given(
    lost=st.sets(st.integers(0, 40), max_size=30),
    reason=st.text(min_size=1, max_size=3000),
    window=st.tuples(st.integers(-100, 500), st.integers(-100, 500)),
    nothing=st.booleans(),
)
def test_what_is_reported_stays_short_however_much_was_lost(
    lost: set[int], reason: str, window: tuple[int, int], nothing: bool
) -> None:
    asides = tuple(SetAside(Path(f"/b/rec/rec_{n}.mcap"), reason, T0) for n in sorted(lost))
    timeline = Timeline.of(tuple(listed(n, (reason,)) for n in range(41) if n not in lost))
    snapshot = Snapshot(timeline, damaged=asides, scanned_at=T0 + 24 * HOUR)
    told = sentences(snapshot, *sorted(window), nothing=nothing)
    assert len(told) <= 5
    assert sum(map(len, told)) < 2000


def test_a_reply_names_the_damage_of_its_window_alone(tmp_path: Path) -> None:
    """A file with damage on both sides of a window is whole there."""
    made: list[Msg] = []
    for at in range(T0, T0 + 60 * S, S // 5):
        moved = tf_of(at, "map", "odom", (1.0, 0.0, 0.0))
        made += [odom(at, (at - T0) / S / 20), moved, detections(at, ["cup"])]
    path = write_mcap(tmp_path / "rec" / "rec_0.mcap", made, McapLayout(chunk_size=8000))
    for at in (T0 + 10 * S, T0 + 50 * S):
        chunks = enumerate(chunks_of(path))
        spoil_chunk(path, next(nth for nth, chunk in chunks if chunk.message_end_time >= at))
    above = clause("/odom", "above", 1.7, field="position.x")
    plain = memory_of(tmp_path)
    stored = with_store(plain, tmp_path)
    for memory, tool, asks in (
        (plain, "visits", {"x": 0.0, "y": 0.0, "radius_m": 9.0}),
        (stored, "find_things", {}),
        (plain, "recap", {}),
        (stored, "compare", {"with_start": T0_S + 28, "with_end": T0_S + 40}),
        (stored, "trajectory_summary", {"frame_id": "map"}),
        (stored, "find_matches", above),
        (plain, "get_topic_in_range", {"topic": "/odom"}),
    ):
        for start, is_named in ((0, True), (28, False), (45, True)):
            window = {"start": T0_S + start, "end": T0_S + start + 12}
            reply = asked(memory, tool, **asks, **window)
            assert "error" not in reply, tool
            assert ("could not be read whole" in str(reply)) == is_named, tool


def test_a_frame_that_is_reported_within_an_hour_is_not_unknown_but_silent(
    tmp_path: Path, remember: Remember
) -> None:
    """`map` is known for ten seconds, `odom` for a minute, and again three hours later."""
    for name, start, stop, pair in (
        ("run/run_0", 0, 11, ("map", "odom")),
        ("run/run_1", 0, 60, ("odom", "base_link")),
        ("late/late_0", 10_850, 10_851, ("odom", "base_link")),
    ):
        ticks = range(T0 + start * S, T0 + stop * S, S // 2)
        moved = [tf(at, transform(at, *pair, (0.0, 0.0, 0.0))) for at in ticks]
        write_mcap(tmp_path / f"{name}.mcap", moved)
    memory = remember()
    for parent, child, later, reason in (
        ("map", "nobody", 50, NoDataReason.FRAME_UNKNOWN),
        ("/map", "base_link", 50, NoDataReason.GAP),
        ("map", "base_link", 3 * 3600 + 50, NoDataReason.FRAME_UNKNOWN),
    ):
        asks = {"parent": parent, "child": child, "timestamp": T0_S + later}
        assert asked(memory, "get_transform_at", **asks)["reason"] == reason, asks


@pytest.mark.parametrize("older_s", [12.631, 59.891])
def test_the_tolerance_that_is_advised_finds_the_message(tmp_path: Path, older_s: float) -> None:
    messages = [boolean(T0, True), text(T0 + round(older_s * S), "late")]
    ask = partial(asked, remembered(tmp_path, messages), "get_topic_at_time", topic="/bumper")
    detail = ask(timestamp=T0_S + older_s)["detail"]
    advised = re.search(r"tolerance_s of at least ([\d.]+)", detail)
    assert advised
    assert ask(timestamp=T0_S + older_s, tolerance_s=float(advised[1]))["timestamp"] == T0_S


TRUE = {"condition_type": "equals", "value": True}
BUMPED = {"topic": "/bumper", **TRUE}
WINDOWED: dict[str, dict[str, Any]] = {
    "find_matches": BUMPED,
    "find_things": {},
    "visits": {"x": 1, "y": 0},
    "trajectory_summary": {},
    "get_topic_in_range": {"topic": "/odom"},
}
BEFORE: dict[str, dict[str, Any]] = {
    "find_last_match": BUMPED,
    "get_value_when": {"value_topic": "/odom", "condition_topic": "/bumper", **TRUE},
}


@pytest.fixture(scope="module", params=[False, True], ids=["plain", "catalogue"])
def memory(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Memory:
    """Recorded are the seconds 0 to 39 and 140 to 149."""
    folder = tmp_path_factory.mktemp("gap")
    for name, driven in (("a", range(40)), ("b", range(140, 150))):
        messages = [odom(T0 + at * S, 0.1 * at) for at in driven]
        begin = T0 + driven[0] * S
        messages += [boolean(begin, True), detections(begin, ["cup"])]
        messages.append(log_entry(begin, 40, "motor", "too hot"))
        write_mcap(folder / name / f"{name}_0.mcap", messages)
    return memory_of(folder, clock=FixedClock(T0 + 200 * S), recalls=request.param)


@pytest.mark.parametrize(
    ("window", "reason"),
    [((-50, -20), "outside_range"), ((70, 90), "gap"), ((160, 190), "outside_range")],
)
@pytest.mark.parametrize("tool", WINDOWED)
def test_a_window_without_recording_is_not_answered_as_never(
    memory: Memory, tool: str, window: tuple[int, int], reason: str
) -> None:
    start, end = (T0_S + each for each in window)
    told = asked(memory, tool, **WINDOWED[tool], start=start, end=end)
    assert told["reason"] == reason
    assert "the memory covers" in told["detail"]


def test_a_short_time_is_said_in_seconds_without_an_exponent(tmp_path: Path) -> None:
    memory = remembered(tmp_path, [text(T0, "on"), text(T0 + 20_000, "off"), text(T0 + S, "on")])
    asks = {"topic": "/chatter", "timestamp": T0_S + 0.00002, "tolerance_s": 0.000001}
    assert asked(memory, "get_topic_at_time", **asks)["value"] == {"value": "off"}
    told = asked(memory, "get_topic_at_time", **asks | {"timestamp": T0_S + 0.00001})["detail"]
    assert "the nearest older one is 0.00001 s before it" in told


def test_seconds_and_bounds_of_a_window_are_not_given_both(memory: Memory) -> None:
    span = TimeRange(start_s=T0_S, end_s=T0_S + 9.0, last_s=5.0)
    ask = partial(queries.trajectory_summary, memory, Call())
    for given_ in (span, TimeRange(last_s=0.0), TimeRange(last_s=-5.0), TimeRange(end_s=1.0)):
        with pytest.raises(InvalidArgumentsError):
            ask(given_)
    with pytest.raises(InvalidArgumentsError, match="give it, or start and end"):
        ask(span)


def test_a_moment_in_a_gap_is_not_between_messages_of_a_slow_topic(tmp_path: Path) -> None:
    """Of the topic, which has a message a minute, none is missing; of the robot, 89 s are."""
    for name, driven in (("a", range(301)), ("b", range(390, 700))):
        messages = [odom(T0 + at * S, 0.1 * at) for at in driven]
        messages += [text(T0 + at * S, "ok", "/slow") for at in driven if at % 60 == 0 or at == 391]
        write_mcap(tmp_path / name / f"{name}_0.mcap", in_order(messages))
    memory = memory_of(tmp_path)
    for at, reason in ((350, "gap"), (270, "between_messages"), (395, "between_messages")):
        told = asked(memory, "get_topic_at_time", topic="/slow", timestamp=T0_S + at)
        assert told["reason"] == reason


@pytest.mark.parametrize("tool", BEFORE)
def test_never_before_the_memory_began_is_no_data(memory: Memory, tool: str) -> None:
    told = asked(memory, tool, **BEFORE[tool], before=T0_S - 1)
    assert told["reason"] == "outside_range"
    found = asked(memory, tool, **BEFORE[tool], before=T0_S + 90)
    assert found["timestamp"] == T0_S
    never = BEFORE[tool] | {"value": False}
    assert asked(memory, tool, **never) is None


@pytest.mark.parametrize("tool", WINDOWED)
def test_a_window_that_is_recorded_in_part_says_how_much(memory: Memory, tool: str) -> None:
    told = asked(memory, tool, **WINDOWED[tool], start=T0_S, end=T0_S + 149)
    assert "recorded only 48 of 149 s" in told["notes"]
    whole = asked(memory, tool, **WINDOWED[tool], start=T0_S, end=T0_S + 39)
    assert "recorded" not in str(whole.get("notes"))
    almost = asked(memory, tool, **WINDOWED[tool], start=T0_S, end=T0_S + 39.01)
    assert "recorded only" not in str(almost.get("notes"))


@pytest.mark.parametrize(
    ("listed", "waits"),
    [
        (("/tf", "/scan"), False),
        (("/*", "not /odom"), False),
        (("/tf", "/od*"), True),
        ((), True),
    ],
)
def test_a_topic_that_the_recorder_no_longer_records_is_not_waited_for(
    tmp_path: Path, listed: tuple[str, ...], waits: bool
) -> None:
    write_mcap(tmp_path / "rec" / "rec_0.mcap", messages(0))
    active = write_mcap(tmp_path / "rec" / "rec_1.mcap", messages(20), McapLayout(finish=False))
    set_mtime(active, T0 + 29 * S)
    beat(tmp_path, T0 + 30 * S, listed=listed, recordings=("rec",))
    memory = memory_of(tmp_path, clock=FixedClock(T0 + 30 * S))
    for reply in (
        asked(memory, "get_position_seconds_ago", seconds_ago=1),
        asked(memory, "get_topic_in_last", topic="/odom", seconds=2),
    ):
        assert reply["reason"] == "not_closed_yet"
        assert ("or again in" in reply["detail"]) is waits
        assert ("the recorder no longer records /odom" in reply["detail"]) is not waits


BEGIN = 1_784_000_000
MODE = "/privacy_mode"
DIED = "because ros2 bag record died"
UNCLEAN = "because the recorder ended without a shutdown"


@pytest.fixture
def apart(tmp_path: Path) -> Path:
    """Two recordings, with 80 s between them; a mode holds from the begin of each."""
    layout = McapLayout(latched=frozenset({MODE}))
    for name, start, stop in (("a", 0, 21), ("b", 100, 120)):
        messages = [odom((BEGIN + second) * S, 1.0, 2.0) for second in range(start, stop)]
        messages.append(boolean((BEGIN + start) * S, False, MODE))
        write_mcap(tmp_path / name / f"{name}_0.mcap", messages, layout)
    return tmp_path


def interrupted(apart: Path, start: int, stop: int, by: Any = "died") -> None:
    append_losses(apart, [Loss(EVERY_TOPIC, (BEGIN + start) * S, (BEGIN + stop) * S, 0, by)])


def exclude(apart: Path, start: int, stop: int) -> None:
    excluded = Excluded((BEGIN + start) * S + 1, (BEGIN + stop) * S)
    SCREENED.write(apart, ScreenState(excluded=[excluded]))


def ask(apart: Path, tool: str, **given: object) -> Any:
    return asked(memory_of(apart), tool, **given)


def causes(apart: Path) -> list[str]:
    found = ask(apart, "trajectory_summary", start=BEGIN + 10, end=BEGIN + 110)["notes"]
    told = [note for note in found if note.startswith("nothing ")]
    return [note.replace(str(BEGIN // 1000), "") for note in told]


def test_a_cause_is_said_of_the_interruption_and_not_of_the_whole_gap(apart: Path) -> None:
    interrupted(apart, 22, 30)
    assert causes(apart) == [
        f"nothing was recorded from 020.000000 to 040.000000 (20 s), {DIED}",
        "nothing was recorded from 040.000000 to 100.000000 (60 s)",
    ]
    doubts = ask(apart, "memory_status")["doubts"]
    assert "(20 s), because ros2 bag record died" in doubts
    assert "60 s" not in doubts


def test_a_gap_in_which_recorders_died_again_and_again_is_one(apart: Path) -> None:
    for second in (22, 40, 57, 75):
        interrupted(apart, second, second + 1)
    assert causes(apart) == [
        f"nothing was recorded from 020.000000 to 086.000000 (66 s), {DIED}",
        "nothing was recorded from 086.000000 to 100.000000 (14 s)",
    ]


def test_a_restart_across_which_the_clock_was_set_is_the_cause_of_no_gap_between_its_dates(
    apart: Path,
) -> None:
    interrupted(apart, -90 * 86400, 150, "unclean")
    assert causes(apart) == ["nothing was recorded from 020.000000 to 100.000000 (80 s)"]
    assert "nothing was recorded" not in str(ask(apart, "memory_status").get("doubts"))


def test_several_gaps_are_one_sentence_that_names_the_longest(tmp_path: Path) -> None:
    for number, second in enumerate((0, 40, 60, 200)):
        write_mcap(tmp_path / f"run{number}" / f"run{number}_0.mcap", messages(second))
    window = {"start": at(0), "end": at(209)}
    driven = asked(memory_of(tmp_path), "trajectory_summary", **window)
    assert "recorded only 36 of 209 s" in driven["notes"]
    longest = f"from {at(69):.6f} to {at(200):.6f} (131 s)"
    assert f"nothing was recorded 3 times, the longest {longest}" in driven["notes"]
    gaps = asked(memory_of(tmp_path), "data_time_range", **window)["gaps"]
    assert [gap["duration_s"] for gap in gaps] == [31.0, 11.0, 131.0]


@pytest.mark.parametrize(
    ("start", "end", "is_told"),
    [(99.99, 110, False), (0, 20.01, False), (95, 110, True), (99.5, 103, True)],
)
def test_a_gap_that_only_touches_a_window_is_no_gap_of_it(
    apart: Path, start: float, end: float, is_told: bool
) -> None:
    window = {"start": BEGIN + start, "end": BEGIN + end}
    driven, recap = ask(apart, "trajectory_summary", **window), ask(apart, "recap", **window)
    assert ("nothing was recorded" in str(driven.get("notes"))) is is_told
    assert ("nothing was recorded" in str(recap["events"])) is is_told


def test_what_was_excluded_was_recorded(apart: Path) -> None:
    exclude(apart, 20, 100)
    interrupted(apart, 98, 102, "unclean")
    assert causes(apart) == []
    exclude(apart, 20, 90)
    assert f"nothing was recorded from 090.000000 to 100.000000 (10 s), {UNCLEAN}" in causes(apart)


@pytest.mark.parametrize("stop", [90, 100])
def test_what_was_excluded_is_no_gap_and_no_event_and_has_no_value_not_even_an_older_one(
    apart: Path, stop: int
) -> None:
    exclude(apart, 20, stop)
    for tool in ("data_time_range", "memory_status"):
        gaps = [(gap["start"] - BEGIN, gap["end"] - BEGIN) for gap in ask(apart, tool)["gaps"]]
        assert gaps == [(90, 100)] * (stop == 90)
    recap = ask(apart, "recap", start=BEGIN, end=BEGIN + 120)
    told = [event["text"] for event in recap["events"]]
    assert [each for each in told if "recorded" in each or "silent" in each] == [
        "nothing was recorded"
    ] * (stop == 90)
    assert "excluded by the rules" in str(recap["notes"])
    at = {"timestamp": BEGIN + 60}
    for tool, given_ in (
        ("get_position_at", at),
        ("get_topic_in_range", {"topic": "/odom", "start": BEGIN + 40, "end": BEGIN + 60}),
        ("get_topic_at_time", {"topic": MODE, **at}),
    ):
        reply = ask(apart, tool, **given_)
        assert reply["reason"] == "deleted"
        assert "excluded by the rules" in str(reply["notes"])


def test_what_may_be_in_a_file_that_cannot_be_read_is_not_said_to_be_unrecorded(
    apart: Path,
) -> None:
    interrupted(apart, 22, 30)
    (apart / "a" / "a_1.mcap").write_bytes(b"no bag at all" * 100)
    assert causes(apart) == [
        f"nothing was recorded from 022.000000 to 030.000000 (8 s), {DIED}",
        "nothing could be read from 030.000000 to 100.000000 (70 s)",
    ]


SEARCHES: list[dict[str, Any]] = [
    TRUE,
    {"condition_type": "contains", "value": "never recorded"},
    {"condition_type": "near_position", "value": {"x": 0.0, "y": 0.0}},
]


def zero_questions(topics: Sequence[str]) -> Iterator[Question]:
    yield from questions(random.Random(7), topics, [0, 1000, S, 5 * S, 9 * S], most=60)
    for timestamp in (-5.0, 0.0, 1e-6):
        for more in ({}, {"tolerance_s": 1e12}):
            yield "get_topic_at_time", {"topic": "/odom", "timestamp": timestamp, **more}
    for ago in (0.0, 1e12):
        yield "get_topic_seconds_ago", {"topic": "/odom", "seconds_ago": ago}
    for start, end in ((-1e300, 1e-6), (-5.0, -1.0), (0.0, 0.0)):
        window = {"start": start, "end": end}
        yield "trajectory_summary", window
        yield "recap", window
        for condition in SEARCHES:
            yield "find_matches", {"topic": "/*", **condition, **window}
    for seconds in (1e-6, 1e300):
        yield "recap", {"last_s": seconds}
        yield "find_matches", {"topic": "/*", **TRUE, "seconds": seconds}
    for condition in SEARCHES:
        yield "find_last_match", {"topic": "/*", **condition, "before": -1.0}


@pytest.mark.parametrize(("recalls", "now"), [(False, "wall"), (True, "latest")])
def test_no_reply_about_a_memory_from_time_zero_holds_a_bound_of_the_clock(
    tmp_path: Path, recalls: bool, now: Literal["wall", "latest"]
) -> None:
    """Asks much, and finds neither a refusal nor the least or greatest 64-bit time."""
    for split in (0, 5):
        messages = along_x(split * S, 5, mps=0.1)
        messages += [boolean(split * S, True), detections(split * S, ["cup"])]
        write_mcap(tmp_path / "rec" / f"rec_{split}.mcap", messages)
    clock, limits = SettableClock(9 * S), QuerySettings(now=now)
    memory = memory_of(tmp_path, clock=clock, limits=limits, recalls=recalls)
    for name, given_ in zero_questions(memory.index.snapshot().timeline.topics()):
        reply = replied(memory, name, given_)
        told = f"{name}({given_}): {reply.text[:2000]}"
        assert "92233720" not in reply.text, told
        numbers: list[str] = []
        json.loads(reply.text, parse_float=numbers.append, parse_int=numbers.append)
        if reply.is_error:
            assert "carries no" in reply.text or "no position" in reply.text, told
        assert all(abs(each) < 9e9 or each == 1e300 for each in map(float, numbers)), told
