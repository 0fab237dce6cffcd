"""Notes on what could not be read: one for each reason, and no reply cut into pieces."""

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import Writer

from ros2_memory.core.model import BagFile, SetAside, TimeWindow
from ros2_memory.core.text import Reason
from ros2_memory.history.context import Memory
from ros2_memory.history.coverage import unread_spans
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.index.timeline import Timeline
from tests.support.bags import McapLayout, Msg, boolean, detections, odom, write_db3, write_mcap
from tests.support.listed_bags import odom_bag
from tests.support.mcap_surgery import chunks_of, spoil_chunk
from tests.support.memories import asked, each_way, memory_of
from tests.support.moving_map import BEGIN, write_moving_map

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


def write_torn(bag_dir: Path) -> None:
    (bag_dir / "f").mkdir()
    (bag_dir / "f" / "f_0.mcap").write_bytes(b"this was a bag once, and is none any more")


@each_way
def test_many_topics_that_are_not_read_hide_no_damaged_file(tmp_path: Path, recalls: bool) -> None:
    write_protobuf(tmp_path / "keelson" / "keelson_0.mcap", 6)
    seen = [detections(T0 + n * S, ["cup"]) for n in range(40)]
    for name in "abcde":
        path = write_mcap(tmp_path / name / f"{name}_0.mcap", seen, McapLayout(chunk_size=2000))
        spoil_chunk(path, 1)
    write_torn(tmp_path)
    never = {"topic": "/*", "condition_type": "contains", "value": "never seen"}
    memory = memory_of(tmp_path, recalls=recalls)
    notes = asked(memory, tmp_path, "find_last_match", **never)["notes"]
    unread, damaged, undecoded = sorted(notes)
    assert undecoded.startswith(
        "messages of 6 topics could not be decoded: its message encoding 'protobuf'"
    )
    assert "/keelson/000 (keelson.Envelope), /keelson/001 (keelson.Envelope)" in undecoded
    assert "and 3 more" in undecoded
    assert damaged.startswith("5 bags could not be read whole: a/a_0.mcap (")
    assert "and 2 more" in damaged
    assert unread.startswith("1 bag file could not be read and may hold more: f/f_0.mcap")


@pytest.mark.parametrize("topics", [1, 3])
def test_where_nothing_can_be_decoded_damaged_files_are_named_beside_it(
    tmp_path: Path, topics: int
) -> None:
    write_protobuf(tmp_path / "keelson" / "keelson_0.mcap", topics)
    write_torn(tmp_path)
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
        reply = asked(memory, tmp_path, tool, **given_)
        assert (reply["error"], reply["reason"]) == ("no_data", "undecodable")
        assert "(keelson.Envelope) are recorded but cannot be decoded" in reply["detail"]
        assert any("may hold more: f/f_0.mcap" in note for note in reply["notes"])
        of_all = any("messages of 3 topics could not be decoded" in n for n in reply["notes"])
        assert of_all == (given_ is not window and topics == 3)


@each_way
@pytest.mark.parametrize("damaged", [[4, 5, 6], [*range(1, 19)], [0, 19]])
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


def test_what_is_wrong_with_a_bag_is_reported_once(tmp_path: Path) -> None:
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
        notes = asked(memory, tmp_path, tool, **given_)["notes"]
        [damaged] = [note for note in notes if "index by time is damaged" in note]
        assert "a/a_0.db3" in damaged


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


DAY = 24 * 3600 * S


def split(number: int, notes: tuple[str, ...] = ()) -> BagFile:
    start, end = T0 + number * 10 * S, T0 + number * 10 * S + 9 * S
    return odom_bag(f"/b/rec/rec_{number}.mcap", start, end, written=end, notes=notes)


def torn(number: int, written: int | None = T0 + DAY, folder: str = "rec") -> SetAside:
    return SetAside(Path(f"/b/{folder}/{folder}_{number}.mcap"), "torn", written)


def sentences(snapshot: Snapshot, start: float, stop: float, *, nothing: bool = False) -> list[str]:
    window = TimeWindow(T0 + round(start * S), T0 + round(stop * S))
    odd = snapshot.timeline.faulty(window)
    return list(unread_spans(snapshot, window, nothing=nothing, absent=(), odd=odd))


def test_a_file_of_which_the_time_is_unknown_is_reported_where_nothing_was_found() -> None:
    snapshot = Snapshot(
        Timeline.of((split(0),)), damaged=(torn(7, None, "alone"),), scanned_at=T0 + DAY
    )
    assert sentences(snapshot, 0, 9) == []
    assert sentences(snapshot, 0, 9, nothing=True) == [
        "1 bag file could not be read and may hold more: alone/alone_7.mcap (torn)"
    ]


def test_beside_an_answer_that_there_is_nothing_each_file_is_named_that_may_hold_it() -> None:
    active = SetAside(Path("/b/copied/copied_0.db3"), "still being written")
    timeline = Timeline.of((split(0), split(1)))
    snapshot = Snapshot(timeline, active=(active,), scanned_at=T0 + 3 * DAY)
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
    bags = tuple(split(n, notes=(reason,)) for n in range(41) if n not in lost)
    snapshot = Snapshot(Timeline.of(bags), damaged=asides, scanned_at=T0 + DAY)
    told = sentences(snapshot, *sorted(window), nothing=nothing)
    assert len(told) <= 5
    assert sum(map(len, told)) < 2000


_BEGIN_S = BEGIN // S


@pytest.fixture(scope="module")
def damaged(tmp_path_factory: pytest.TempPathFactory) -> Memory:
    """Two minutes in splits of 10 s; chunks of the second and the last but three are damaged."""
    folder = tmp_path_factory.mktemp("damaged")
    write_moving_map(folder, 3)
    for number in (1, 8):
        (split,) = folder.rglob(f"*_{number}.mcap")
        data = bytearray(split.read_bytes())
        for at in range(len(data) // 3, len(data) // 3 + 60):
            data[at] ^= 0xFF
        split.write_bytes(data)
    return memory_of(folder)


@each_way
@pytest.mark.parametrize(
    ("tool", "given"), [("visits", {"x": 0.0, "y": 0.0, "radius_m": 9.0}), ("recap", {})]
)
def test_a_file_with_damage_on_both_sides_of_the_window_is_whole_there(
    tmp_path: Path, tool: str, given: dict[str, object], *, recalls: bool
) -> None:
    messages = [odom(T0 + n * S // 5, n * 0.01, 0.0) for n in range(300)]
    path = write_mcap(tmp_path / "rec" / "rec_0.mcap", messages, McapLayout(chunk_size=8000))
    for at in (T0 + 10 * S, T0 + 50 * S):
        chunks = enumerate(chunks_of(path))
        spoil_chunk(path, next(nth for nth, chunk in chunks if chunk.message_end_time >= at))
    memory = memory_of(tmp_path, recalls=recalls)
    for start, is_named in ((0, True), (28, False), (45, True)):
        window = {"start": T0_S + start, "end": T0_S + start + 12}
        notes = asked(memory, tmp_path, tool, **given, **window).get("notes", [])
        assert any("could not be read whole" in note for note in notes) == is_named


@pytest.mark.parametrize(
    ("tool", "given"),
    [
        ("visits", {"x": 4.0, "y": 0.0, "radius_m": 1.0}),
        ("find_things", {}),
        ("recap", {}),
        ("compare", {"with_start": _BEGIN_S + 40, "with_end": _BEGIN_S + 50}),
        ("trajectory_summary", {"frame_id": "map"}),
        (
            "find_matches",
            {"topic": "/odom", "field": "position.x", "condition_type": "above", "value": 1.0},
        ),
        ("get_topic_in_range", {"topic": "/odom"}),
    ],
)
def test_a_reply_names_the_damage_of_its_window_alone(
    damaged: Memory, tool: str, given: dict[str, object]
) -> None:
    def told(end: int) -> list[str]:
        window = {"start": _BEGIN_S + 50, "end": _BEGIN_S + end}
        reply = asked(damaged, damaged.index.bag_dir, tool, **given, **window)
        assert "error" not in reply
        return [note for note in reply.get("notes", ()) if "damaged" in note]

    assert told(70) == []
    if tool not in {"visits", "trajectory_summary"}:  # of the stored path nothing is lost
        (note,) = told(100)
        assert "rec_8.mcap" in note
        assert "rec_1.mcap" not in note
