"""What could not be read is part of every answer, and a wrong clock spoils none."""

import os
from pathlib import Path
from typing import Any

import pytest

from ros2_memory import queries
from ros2_memory.history.context import Call, Memory
from tests.support.bags import (
    McapLayout,
    Msg,
    boolean,
    detections,
    odom,
    text,
    tf,
    transform,
    write_mcap,
)
from tests.support.clocks import FixedClock
from tests.support.mcap_surgery import spoil_chunk
from tests.support.memories import asked, memory_of, with_store

S = 10**9
T0_S = 1_784_023_200
T0 = T0_S * S
HOUR = 3600 * S
LOST = "1 bag file could not be read and may hold more: rec/rec_1.mcap"


def messages(start_s: int, seconds: int = 10) -> list[Msg]:
    made: list[Msg] = []
    for second in range(start_s, start_s + seconds):
        at = T0 + second * S
        made += [
            odom(at, second * 0.1, 0.0),
            tf(at, transform(at, "odom", "base_link", (second * 0.1, 0.0, 0.0))),
            boolean(at, second % 7 == 0),
        ]
    return [*made, detections(T0 + start_s * S, ["cup"])]


def write_splits(bag_dir: Path, count: int, folder: str = "rec") -> list[Path]:
    paths = []
    for number in range(count):
        path = bag_dir / folder / f"{folder}_{number}.mcap"
        paths.append(write_mcap(path, messages(number * 10), McapLayout(chunk_size=2000)))
        os.utime(path, ns=(T0 + number * 10 * S + 10 * S,) * 2)
    return paths


def tear(path: Path) -> None:
    was = path.stat().st_mtime_ns
    path.write_bytes(b"this was a bag once, and is none any more")
    os.utime(path, ns=(was, was))


def notes_of(reply: Any) -> list[str]:
    return list(reply.get("notes", ())) if isinstance(reply, dict) else []


def at(second: float) -> float:
    return T0_S + second


FULL: dict[str, Any] = {"start": at(0), "end": at(29)}
NEAR: dict[str, Any] = {"topic": "/odom", "condition_type": "near_position"}
FAR: dict[str, Any] = {**NEAR, "value": {"x": 500, "y": 0}}
SCISSORS: dict[str, Any] = {"condition_type": "contains", "value": "scissors"}
SEEN = {"topic": "/vision/*", "condition_type": "contains", "value": "cup"}
BASE = {"parent": "odom", "child": "base_link"}
TOUCHING: list[tuple[str, dict[str, Any]]] = [
    ("get_topic_at_time", {"topic": "/odom", "timestamp": at(15), "tolerance_s": 30}),
    ("get_topic_at_time", {"topic": "/nowhere", "timestamp": at(5)}),
    ("get_topic_in_range", {"topic": "/odom", "start": at(5), "end": at(25)}),
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
APART: list[tuple[str, dict[str, Any]]] = [
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
    tear(write_splits(folder, 3)[1])
    return memory_of(folder, clock=FixedClock(T0 + HOUR), recalls=request.param)


@pytest.mark.parametrize(("tool", "given"), TOUCHING)
def test_every_tool_says_that_a_split_of_its_window_could_not_be_read(
    tool: str, given: dict[str, Any], torn: Memory
) -> None:
    told = notes_of(asked(torn, torn.index.bag_dir, tool, **given))
    assert any(note.startswith(LOST) for note in told), told


@pytest.mark.parametrize(("tool", "given"), APART)
def test_no_tool_speaks_of_a_split_that_its_window_does_not_touch(
    tool: str, given: dict[str, Any], torn: Memory
) -> None:
    reply = asked(torn, torn.index.bag_dir, tool, **given)
    assert reply is None or "error" not in reply
    assert not any("could not be read" in note for note in notes_of(reply))


def test_the_split_being_written_is_reported_where_it_may_hold_newer_and_no_future_is(
    tmp_path: Path,
) -> None:
    write_splits(tmp_path, 2)
    active = write_mcap(tmp_path / "rec" / "rec_2.mcap", messages(20), McapLayout(finish=False))
    os.utime(active, ns=(T0 + 29 * S,) * 2)
    memory = memory_of(tmp_path, clock=FixedClock(T0 + 30 * S))
    written = f"the split being written is left out: nothing after {at(19):.6f}"
    newest = asked(memory, tmp_path, "find_last_match", **SEEN)
    assert (newest["timestamp"], newest["notes"]) == (at(10), [written])
    older = asked(memory, tmp_path, "find_last_match", **SEEN, before=at(15))
    assert "notes" not in older
    lately = asked(memory, tmp_path, "get_topic_in_last", topic="/odom", seconds=25)
    assert lately["notes"] == [written]
    now = asked(memory, tmp_path, "get_position_seconds_ago", seconds_ago=1)
    assert (now["reason"], now["notes"]) == ("not_closed_yet", [written])
    # A time in the future is not waited for.
    soon = asked(memory, tmp_path, "get_position_at", timestamp=at(80))
    assert soon["reason"] == "not_closed_yet"
    future = asked(memory, tmp_path, "get_position_at", timestamp=at(3630))
    assert future["reason"] == "outside_range"
    assert f"the time asked is 3600 s in the future: it is {at(30):.6f} now" in future["detail"]
    assert "tolerance_s" not in future["detail"]
    window = {"topic": "/odom", "end": at(9000)}
    begun = asked(memory, tmp_path, "get_topic_in_range", **window, start=at(25))
    assert begun["reason"] == "not_closed_yet"
    later = asked(memory, tmp_path, "get_topic_in_range", **window, start=at(8000))
    assert later["reason"] == "outside_range"
    assert "in the future" in later["detail"]


def test_a_bag_that_a_crash_left_open_is_reported_with_what_is_lost_of_it(tmp_path: Path) -> None:
    paths = write_splits(tmp_path, 3)
    paths[2].write_bytes(paths[2].read_bytes()[:6000])
    os.utime(paths[2], ns=(T0 + 32 * S,) * 2)
    memory = memory_of(tmp_path, clock=FixedClock(T0 + HOUR))
    [told] = asked(memory, tmp_path, "get_topic_in_range", topic="/odom", start=at(1), end=at(31))[
        "notes"
    ][:1]
    assert told.startswith("1 unfinished bag; its readable part is used: rec/rec_2.mcap (")
    [named] = asked(memory, tmp_path, "data_time_range")["incomplete"]
    assert named["file"] == "rec/rec_2.mcap"
    rows = queries.list_recorded_topics(memory, Call())
    assert [row.notes for row in rows if row.topic == "/odom"] == [(told,)]


@pytest.mark.parametrize("last", [9, 30], ids=["other topics go on", "the topic goes on"])
def test_a_chunk_that_is_lost_is_not_reported_in_windows_behind_it_whatever_is_stored(
    last: int, tmp_path: Path
) -> None:
    poses = [odom(T0 + n * S, n / 10, 0.0) for n in range(last)]
    others = [text(T0 + n * S, "cup") for n in range(31)]
    damaged = write_mcap(tmp_path / "a" / "a_0.mcap", [*poses, *others], McapLayout(chunk_size=400))
    spoil_chunk(damaged, 0)
    # The other recording may have copies of what the damaged one has.
    copies = [text(T0 + 5 * S, "mug"), *(odom(T0 + n * S, 0.1, 0.0) for n in range(28, 40))]
    write_mcap(tmp_path / "b" / "b_0.mcap", copies)
    plain = memory_of(tmp_path)
    stored = with_store(plain, tmp_path)
    for start, is_lost in ((29, False), (5, False), (0, True)):
        asking = {"topic": "/odom", "fields": ["position.x"], "by": "day", "end": at(50)}
        replies = [
            asked(memory, tmp_path, "get_topic_in_range", start=at(start), **asking)
            for memory in (stored, plain)
        ]
        assert replies[0] == replies[1]
        assert any("could not be read whole" in note for note in notes_of(replies[1])) is is_lost
