"""What a planner reads where it searched: a match, `null`, or what could not be searched."""

from __future__ import annotations

import json
import os
from functools import partial
from itertools import count
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from mcap.opcode import Opcode

from ros2_memory import queries
from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.core.timebase import Deadline
from ros2_memory.history.context import Call, Memory, QuerySettings
from tests.support.bags import (
    McapLayout,
    Msg,
    boolean,
    detections,
    make,
    octets,
    stamp,
    write_db3,
    write_mcap,
)
from tests.support.clocks import SettableClock
from tests.support.log_lines import with_checks
from tests.support.mcap_surgery import change_index, chunks_of, edit_summary, spoil_chunk
from tests.support.memories import asked, each_way, memory_of, with_store

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from ros2_memory.core.model import JsonValue

S = 10**9
T0_S = 1_784_000_000
T0 = T0_S * S


def log(ns: int, level: int, msg: str) -> Msg:
    body = make(
        "rcl_interfaces/msg/Log",
        stamp=stamp(ns),
        level=level,
        name="driver",
        msg=msg,
        file="driver.cpp",
        function="spin",
        line=20,
    )
    return Msg("/rosout", "rcl_interfaces/msg/Log", ns, body)


def numbers(ns: int, *held: int) -> Msg:
    layout = make("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
    body = make("std_msgs/msg/Int32MultiArray", layout=layout, data=np.array(held, dtype=np.int32))
    return Msg("/numbers", "std_msgs/msg/Int32MultiArray", ns, body)


def recalling(bag_dir: Path, recalls: bool, **more: Any) -> Memory:
    """A memory of the bags, which has stored their columns where it recalls them."""
    return memory_of(bag_dir, **more, recalls=recalls)


def last(bag_dir: Path, recalls: bool, topic: str, kind: str, value: JsonValue, **more: Any) -> Any:
    given = {"topic": topic, "condition_type": kind, "value": value, **more}
    return asked(recalling(bag_dir, recalls), bag_dir, "find_last_match", **given)


@pytest.fixture
def bag_dir(tmp_path: Path) -> Path:
    first = [
        log(T0, 20, "started"),
        boolean(T0 + S, True),
        numbers(T0 + 2 * S, 3, 20),
        detections(T0 + 3 * S, ["cup"]),
    ]
    second = [
        log(T0 + 10 * S, 30, "retry in 20 s"),
        boolean(T0 + 11 * S, False),
        numbers(T0 + 12 * S, 4),
        detections(T0 + 13 * S, []),
    ]
    third = [log(T0 + 20 * S, 20, "done"), boolean(T0 + 21 * S, False), numbers(T0 + 22 * S, 5)]
    for nth, messages in enumerate([first, second, third]):
        write_mcap(tmp_path / "rec" / f"rec_{nth}.mcap", messages)
    return tmp_path


@each_way
@pytest.mark.parametrize(
    ("topic", "kind", "value", "field", "at_s"),
    [
        ("/rosout", "contains", "20", None, 10),
        ("/rosout", "contains", 20, None, 10),
        ("/rosout", "contains", "20", "msg", 10),
        ("/rosout", "contains", "20", "level", 20),
        ("/rosout", "contains", 20, "level", 20),
        ("/rosout", "contains", "2", "level", None),
        ("/rosout", "equals", 20, None, 20),
        ("/vision/scene/scene_objects", "contains", "100", None, None),
        ("/vision/scene/scene_objects", "contains", 100, "detections.bbox", 3),
        ("/vision/scene/scene_objects", "contains", "10", "detections.bbox", 3),
        ("/vision/scene/scene_objects", "contains", "1", "detections.bbox", None),
        ("/vision/scene/scene_objects", "equals", "100", None, 3),
        ("/numbers", "contains", 3, "data", 2),
        ("/numbers", "contains", "20", "data", 2),
        ("/numbers", "contains", 7, "data", None),
        ("/bumper", "equals", 1, None, 1),
        ("/bumper", "equals", "1", None, 1),
        ("/bumper", "equals", 0, None, 21),
        ("/bumper", "equals", True, None, 1),
        ("/bumper", "equals", 2, None, None),
        ("/bumper", "contains", "true", None, 1),
        ("/bumper", "contains", True, None, 1),
        ("/bumper", "contains", 1, "value", 1),
    ],
)
def test_a_number_is_found_as_a_whole_value_and_a_text_by_its_part(
    bag_dir: Path,
    recalls: bool,
    topic: str,
    kind: str,
    value: JsonValue,
    field: str | None,
    at_s: int | None,
) -> None:
    reply = last(bag_dir, recalls, topic, kind, value, field=field)
    assert reply == (None if at_s is None else reply)
    assert at_s is None or reply["timestamp"] == T0_S + at_s


@each_way
@pytest.mark.parametrize("value", [5, "5"])
def test_never_is_not_the_answer_where_only_a_named_field_could_hold_the_number(
    bag_dir: Path, recalls: bool, value: JsonValue
) -> None:
    reply = last(bag_dir, recalls, "/numbers", "contains", value)
    assert reply["error"] == "invalid_arguments"
    assert "name that in field, or ask with equals" in reply["detail"]


def never(memory: Memory, bag_dir: Path, tool: str) -> Any:
    topic = {
        "find_last_match": {"topic": "/vision/*"},
        "get_value_when": {"condition_topic": "/vision/*", "value_topic": "/bumper"},
    }[tool]
    condition = {"condition_type": "contains", "value": "scissors"}
    return asked(memory, bag_dir, tool, **topic, **condition)


each_search = pytest.mark.parametrize("tool", ["find_last_match", "get_value_when"])


@each_way
@pytest.mark.parametrize(
    "wanted",
    [
        {"condition_type": "above", "value": 100, "field": "data"},
        {"condition_type": "equals", "value": 200, "field": "data.3"},
        {"condition_type": "contains", "value": 200, "field": "data"},
        {"condition_type": "equals", "value": 200},
    ],
)
def test_that_a_long_array_was_not_searched_is_said_whatever_the_newest_is(
    tmp_path: Path, wanted: dict[str, object], *, recalls: bool
) -> None:
    for nth in range(3):
        held = [octets(T0 + (10 * nth + at) * S, [7] * 4) for at in range(3)]
        if nth == 1:
            held.append(octets(T0 + 15 * S, [200] * 60))
        write_mcap(tmp_path / "rec" / f"rec_{nth}.mcap", [*held, boolean(T0 + nth * 10 * S, True)])
    memory = memory_of(tmp_path, recalls=recalls)
    note = f"/octets: where data is long it is only summarised, last at {T0_S + 15}.000000"
    given = {"topic": "/octets", **wanted}
    never = asked(memory, tmp_path, "find_last_match", **given)
    assert never["timestamp"] is None
    assert any(said.startswith(note) for said in never["notes"])
    none = asked(memory, tmp_path, "find_matches", **given)
    assert (none["total"], none["notes"]) == (0, never["notes"])
    bumped = {"topic": "/bumper", "condition_type": "equals", "value": True, "while": given}
    assert any(
        said.startswith(note) for said in asked(memory, tmp_path, "find_matches", **bumped)["notes"]
    )
    window = {"topic": "/octets", "fields": ["data"], "start": T0_S, "end": T0_S + 30}
    for by in ({}, {"by": "hour"}):
        numbers = asked(memory, tmp_path, "get_topic_in_range", **window, **by)
        assert any(said.startswith(note) for said in numbers["notes"])
    # After that all was searched.
    later = asked(memory, tmp_path, "find_matches", **given, start=T0_S + 16)
    assert (later["total"], "notes" in later) == (0, False)
    newest = asked(
        memory, tmp_path, "find_last_match", **given | {"condition_type": "equals", "value": 7}
    )
    assert "notes" not in newest


@each_search
@each_way
@pytest.mark.parametrize("include_active", [False, True])
def test_a_robot_that_records_is_answered_null_where_every_closed_bag_was_searched(
    bag_dir: Path, tool: str, recalls: bool, include_active: bool
) -> None:
    active = bag_dir / "rec" / "rec_3.mcap"
    fresh = [detections(T0 + (30 + n) * S, ["cup"]) for n in range(5)]
    write_mcap(active, fresh, McapLayout(finish=False))
    os.utime(active, ns=(T0 + 34 * S,) * 2)
    memory = memory_of(
        bag_dir,
        clock=SettableClock(T0 + 35 * S),
        limits=QuerySettings(include_active=include_active),
        include_active=include_active,
    )
    assert memory.index.snapshot().active
    memory = with_store(memory, bag_dir) if recalls else memory
    assert never(memory, bag_dir, tool) is None


@each_search
@each_way
@pytest.mark.parametrize("fault", ["torn", "cut", "spoilt", "undecodable"])
def test_a_search_that_could_not_read_a_closed_bag_says_which(
    bag_dir: Path, tool: str, recalls: bool, fault: str
) -> None:
    path = bag_dir / "rec" / "rec_1.mcap"
    if fault == "torn":
        path.write_bytes(b"this was a bag once, and is none any more")
    elif fault == "cut":
        path.write_bytes(path.read_bytes()[:-200])
    elif fault == "spoilt":
        spoil_chunk(path, 0)
    else:
        body = b"\x00\x01\x00\x00\xff\xff\xff\x7f"
        kind = "ros2_vision_interfaces/msg/VisionDetectionArray"
        write_mcap(path, [Msg("/vision/scene/scene_objects", kind, T0 + 10 * S, body)])
    os.utime(path, ns=(T0 + 20 * S,) * 2)
    reply = never(recalling(bag_dir, recalls), bag_dir, tool)
    assert [*reply] == ["timestamp", "value", "notes"]
    assert (reply["timestamp"], reply["value"]) == (None, None)
    shown = "could not be decoded" if fault == "undecodable" else "rec/rec_1.mcap"
    assert any(shown in note for note in reply["notes"])


HOUR = 3600 * S


@each_search
@each_way
@pytest.mark.parametrize("name", ["o_0.mcap", "o_0.db3", "notes.mcap"])
@pytest.mark.parametrize("before_h", [None, 36])
def test_a_copy_that_cannot_be_read_may_hold_what_is_older_than_the_copy(
    tmp_path: Path, tool: str, recalls: bool, name: str, before_h: int | None
) -> None:
    write_mcap(tmp_path / "a" / "a_0.mcap", [boolean(T0 - 72 * HOUR + n * S, True) for n in (0, 1)])
    copied = tmp_path / "o" / name
    copied.parent.mkdir()
    if name.endswith(".db3"):
        write_db3(copied, [boolean(T0 - 48 * HOUR, False)])
    else:
        write_mcap(copied, [boolean(T0 - 48 * HOUR, False)])
        copied.write_bytes(b"X" + copied.read_bytes()[1:])
    for path in tmp_path.rglob("*.*"):
        os.utime(path, ns=(T0 - HOUR,) * 2)
    memory = recalling(tmp_path, recalls, clock=SettableClock(T0))
    given: dict[str, Any] = {"condition_type": "equals", "value": False}
    if before_h is not None:
        given["before"] = T0_S - before_h * 3600
    if tool == "find_last_match":
        given["topic"] = "/bumper"
    else:
        given["condition_topic"] = given["value_topic"] = "/bumper"
    reply = asked(memory, tmp_path, tool, **given)
    assert (reply["timestamp"], reply["value"]) == (None, None)
    assert any(f"may hold more: o/{name}" in note for note in reply["notes"])


@each_way
def test_a_split_that_cannot_be_read_bears_on_nothing_before_the_split_before_it(
    bag_dir: Path, recalls: bool
) -> None:
    (bag_dir / "rec" / "rec_2.mcap").write_bytes(b"this was a bag once, and is none any more")
    never_before = last(bag_dir, recalls, "/rosout", "contains", "never", before=T0_S + 9)
    assert never_before is None
    assert last(bag_dir, recalls, "/rosout", "contains", "never", before=T0_S + 14)["notes"]


def list_splits(recording: Path, count: int) -> None:
    names = "".join(f"  - {recording.name}_{n}.mcap\n" for n in range(count))
    (recording / "metadata.yaml").write_text(
        f"rosbag2_bagfile_information:\n  version: 5\n  relative_file_paths:\n{names}"
    )


@each_search
@each_way
@pytest.mark.parametrize("gone", [0, 1, 2])
def test_never_is_not_the_answer_beside_a_split_that_is_listed_and_not_there(
    bag_dir: Path, tool: str, recalls: bool, gone: int
) -> None:
    list_splits(bag_dir / "rec", 3)
    assert never(recalling(bag_dir, recalls), bag_dir, tool) is None
    (bag_dir / "rec" / f"rec_{gone}.mcap").unlink()
    reply = never(recalling(bag_dir, recalls), bag_dir, tool)
    lacking = (
        f"1 bag file could not be read and may hold more: rec/rec_{gone}.mcap "
        "(metadata.yaml lists it, but it is missing)"
    )
    assert reply == {"timestamp": None, "value": None, "notes": [lacking]}


@each_way
def test_a_split_that_is_not_there_is_named_only_where_it_may_bear_on_the_answer(
    bag_dir: Path, recalls: bool
) -> None:
    list_splits(bag_dir / "rec", 3)
    (bag_dir / "rec" / "rec_1.mcap").unlink()
    assert last(bag_dir, recalls, "/rosout", "contains", "never", before=T0_S + 2) is None
    assert "notes" not in last(bag_dir, recalls, "/rosout", "contains", "done")
    found = last(bag_dir, recalls, "/rosout", "contains", "started")
    assert any("rec/rec_1.mcap" in note for note in found["notes"])
    memory = memory_of(bag_dir)
    given = {"topic": "/rosout", "condition_type": "contains", "value": "started"}
    sightings = asked(memory, bag_dir, "find_matches", **given)
    assert any("rec/rec_1.mcap" in note for note in sightings["notes"])
    early = asked(memory, bag_dir, "find_matches", **given, end=T0_S + 2)
    assert "notes" not in early


@each_way
def test_the_oldest_splits_that_our_retention_deleted_are_no_reason_to_doubt_never(
    bag_dir: Path, recalls: bool
) -> None:
    list_splits(bag_dir / "rec", 3)
    (bag_dir / "rec" / "rec_0.mcap").unlink()
    own = bag_dir / ".episodic" / "recordings.jsonl"
    own.parent.mkdir()
    inode = (bag_dir / "rec").stat().st_ino
    mine = json.dumps({"recording": "rec", "inode": inode})
    own.write_text(with_checks(mine))
    assert last(bag_dir, recalls, "/rosout", "contains", "never") is None
    (bag_dir / "rec" / "rec_1.mcap").rename(bag_dir / "rec" / "rec_0.mcap")
    assert last(bag_dir, recalls, "/rosout", "contains", "never")["notes"]


def lie_in_a_message_index(path: Path) -> None:
    chunk = chunks_of(path)[0]
    change_index(path, chunk, 0, chunk.message_start_time + 1)


def lie_in_the_chunk_indexes(path: Path) -> None:
    def later(body: bytearray) -> None:
        body[0:8] = (int.from_bytes(body[0:8], "little") + 5).to_bytes(8, "little")

    edit_summary(path, Opcode.CHUNK_INDEX, later)


@each_search
@each_way
@pytest.mark.parametrize("lie", [lie_in_a_message_index, lie_in_the_chunk_indexes])
def test_a_bag_that_was_read_in_spite_of_its_lies_was_read(
    bag_dir: Path, tool: str, recalls: bool, lie: Callable[[Path], None]
) -> None:
    lie(bag_dir / "rec" / "rec_1.mcap")
    assert never(recalling(bag_dir, recalls), bag_dir, tool) is None


def test_a_search_that_got_somewhere_says_how_far_the_catalogue_is(bag_dir: Path) -> None:
    memory = with_store(memory_of(bag_dir), bag_dir, part=0.0)
    call = Call(Deadline.after(6.0, partial(next, map(float, count()))))
    with pytest.raises(QueryTimeoutError) as late:
        queries.find_last_match(memory, call, "/*", "contains", "never")
    assert late.value.searched_back_to is not None
    assert "has 0 of 3 bags so far: wait for it, or to continue from there" in str(late.value)
