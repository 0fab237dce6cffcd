"""Notes on what could not be read: one for each reason, and no reply cut into pieces."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import Writer

from ros2_memory.core.text import Reason
from tests.support.bags import McapLayout, Msg, boolean, detections, write_db3, write_mcap
from tests.support.mcap_surgery import spoil_chunk
from tests.support.memories import asked, each_way, memory_of

if TYPE_CHECKING:
    from pathlib import Path

S = 10**9
T0_S = 1_784_000_000
T0 = T0_S * S
OBJECTS = "/vision/scene/scene_objects"
CUP = {"topic": OBJECTS, "condition_type": "contains", "value": "cup"}


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


@each_way
def test_many_topics_that_are_not_read_hide_no_damaged_file(tmp_path: Path, recalls: bool) -> None:
    write_protobuf(tmp_path / "keelson" / "keelson_0.mcap", 60)
    seen = [detections(T0 + n * S, ["cup"]) for n in range(40)]
    for name in ("a", "b", "c", "d", "e"):
        spoil_chunk(
            write_mcap(tmp_path / name / f"{name}_0.mcap", seen, McapLayout(chunk_size=2000)), 1
        )
    (tmp_path / "f").mkdir()
    (tmp_path / "f" / "f_0.mcap").write_bytes(b"this was a bag once, and is none any more")
    reply = asked(
        memory_of(tmp_path, recalls=recalls),
        tmp_path,
        "find_last_match",
        topic="/*",
        condition_type="contains",
        value="never seen",
    )
    notes = "\n".join(reply["notes"])
    assert len(reply["notes"]) == 3
    assert "messages of 60 topics could not be decoded: its message encoding 'protobuf'" in notes
    assert "/keelson/000 (keelson.Envelope), /keelson/001 (keelson.Envelope)" in notes
    assert "and 57 more" in notes
    assert "5 bags could not be read whole: a/a_0.mcap (" in notes
    assert "and 2 more" in notes
    assert "1 bag file could not be read and may hold more: f/f_0.mcap" in notes


@pytest.mark.parametrize(
    ("tool", "given"),
    [
        ("find_last_match", {"topic": "/keelson/*", "condition_type": "contains", "value": "x"}),
        ("find_matches", {"topic": "/keelson/*", "condition_type": "contains", "value": "x"}),
        (
            "get_value_when",
            {
                "condition_topic": "/keelson/*",
                "value_topic": "/keelson/000",
                "condition_type": "contains",
                "value": "x",
            },
        ),
        ("get_topic_in_range", {"topic": "/keelson/000", "start": T0_S, "end": T0_S + 9}),
        ("trajectory_summary", {"topic": "/keelson/000", "start": T0_S, "end": T0_S + 9}),
    ],
)
@pytest.mark.parametrize("topics", [1, 3])
def test_where_nothing_can_be_decoded_damaged_files_are_named_beside_it(
    tmp_path: Path, tool: str, given: dict[str, object], topics: int
) -> None:
    write_protobuf(tmp_path / "keelson" / "keelson_0.mcap", topics)
    (tmp_path / "f").mkdir()
    (tmp_path / "f" / "f_0.mcap").write_bytes(b"this was a bag once, and is none any more")
    memory = memory_of(tmp_path)
    reply = asked(memory, tmp_path, tool, **given)
    assert (reply["error"], reply["reason"]) == ("no_data", "undecodable")
    assert "(keelson.Envelope) are recorded but cannot be decoded" in reply["detail"]
    assert any("may hold more: f/f_0.mcap" in note for note in reply["notes"])
    of_all = "messages of 3 topics could not be decoded"
    is_search = "condition_type" in given
    assert any(of_all in note for note in reply["notes"]) == (is_search and topics == 3)


@each_way
@pytest.mark.parametrize("damaged", [[4, 5, 6], [*range(1, 19)], [0, 19], [9, 10]])
def test_a_message_that_cannot_be_decoded_ends_no_sighting_and_is_none(
    tmp_path: Path, recalls: bool, damaged: list[int]
) -> None:
    torn = b"\x00\x01\x00\x00\xff\xff\xff\x7f"
    kind = "ros2_vision_interfaces/msg/VisionDetectionArray"
    messages = [
        Msg(OBJECTS, kind, T0 + n * S, torn)
        if n in damaged
        else detections(T0 + n * S, ["cup"] if n < 20 else ["table"])
        for n in range(30)
    ]
    for split in range(3):
        path = tmp_path / "rec" / f"rec_{split}.mcap"
        write_mcap(path, messages[10 * split : 10 * split + 10])
    memory = memory_of(tmp_path, recalls=recalls)
    reply = asked(memory, tmp_path, "find_matches", **CUP)
    seen = [n for n in range(20) if n not in damaged]
    [sighting] = reply["sightings"]
    assert (sighting["first_seen"], sighting["last_seen"]) == (T0_S + seen[0], T0_S + seen[-1])
    assert (sighting["count"], reply["total"]) == (len(seen), 1)
    assert any("could not be decoded" in note for note in reply["notes"])


def test_a_slow_detector_is_not_silent_while_its_messages_cannot_be_decoded(tmp_path: Path) -> None:
    torn = Msg(
        OBJECTS,
        "ros2_vision_interfaces/msg/VisionDetectionArray",
        T0 + 8 * S,
        b"\x00\x01\x00\x00\xff\xff\xff\x7f",
    )
    seen = [detections(T0 + at * S, ["cup"]) for at in (0, 16, 40)]
    write_mcap(tmp_path / "rec" / "rec_0.mcap", [seen[0], torn, *seen[1:]])
    memory = memory_of(tmp_path)
    sightings = asked(memory, tmp_path, "find_matches", **CUP)["sightings"]
    spans = [(each["first_seen"] - T0_S, each["last_seen"] - T0_S) for each in sightings]
    assert spans == [(40, 40), (0, 16)]


@pytest.mark.parametrize("bags", [3])
@pytest.mark.parametrize(
    ("tool", "given"),
    [
        ("get_topic_at_time", {"topic": "/bumper", "timestamp": T0_S + 5}),
        ("get_topic_in_range", {"topic": "/bumper", "start": T0_S, "end": T0_S + 9}),
        ("find_last_match", {"topic": "/bumper", "condition_type": "equals", "value": True}),
        ("find_matches", {"topic": "/bumper", "condition_type": "equals", "value": True}),
        ("recap", {"start": T0_S, "end": T0_S + 9}),
    ],
)
def test_what_is_wrong_with_a_bag_is_reported_once(
    tmp_path: Path, tool: str, given: dict[str, object], bags: int
) -> None:
    for name in "abc"[:bags]:
        messages = [boolean(T0 + n * S, n % 2 == 0) for n in range(6)]
        path = write_db3(tmp_path / name / f"{name}_0.db3", messages)
        with closing(sqlite3.connect(path)) as base:
            base.execute("PRAGMA writable_schema = 1")
            base.execute(
                "UPDATE sqlite_master SET sql = replace(sql, 'ASC', 'DESC') WHERE type = 'index'"
            )
            base.commit()
    memory = memory_of(tmp_path, storage="rosbag2")
    notes = asked(memory, tmp_path, tool, **given)["notes"]
    damaged = [note for note in notes if "index by time is damaged" in note]
    assert len(damaged) == 1
    assert "a/a_0.db3" in damaged[0]


@given(st.dictionaries(st.text(min_size=1), st.text(max_size=3), min_size=1))
def test_one_sentence_counts_all_things_and_names_a_few(things: dict[str, str]) -> None:
    reason = Reason("is torn", "bag", of="of ", many="are torn")
    told = reason.sentence(things)
    if len(things) == 1:
        [(name, detail)] = things.items()
        assert told == f"of {name} is torn" + (f": {detail}" if detail else "")
    else:
        assert told.startswith(f"of {len(things)} bags are torn: ")
        assert len(told) < 700
