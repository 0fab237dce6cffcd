"""Transforms: the same however they are cut or stored, and whose hold at which time."""

from collections.abc import Collection
from dataclasses import replace
from itertools import count, groupby
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import Mock

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.analysis.frames import static_at
from ros2_memory.bag_dir.handover_file import Handover, write_handover
from ros2_memory.bag_dir.layout import OWN_FOLDER
from ros2_memory.columns.scanner import Scanner
from ros2_memory.columns.store import FILE, ColumnStore
from ros2_memory.core.timebase import AT_OR_BEFORE_SLACK_NS, Deadline
from ros2_memory.history import sessions
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.scan import scan
from ros2_memory.history.view import View
from ros2_memory.places.visits import visits
from ros2_memory.queries import frames
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import Msg, boolean, in_order, odom, tf, tf_of, transform, write_splits
from tests.support.examples import examples
from tests.support.memories import Remember, asked, memory_of, with_store

S = 10**9
T0 = 1_784_000_000 * S


def fixed(at: int, parent: str, child: str, x: float) -> Msg:
    return tf_of(at, parent, child, (x, 0.0, 0.0), topic="/tf_static")


def ticks(begin: int, seconds: int) -> range:
    return range(begin, begin + seconds * S + 1, S // 5)


def moving(begin: int, seconds: int, parent: str, child: str, x: float, mps: float) -> list[Msg]:
    places = [(at, x + mps * (at - begin) / S) for at in ticks(begin, seconds)]
    return [tf_of(at, parent, child, (x, 0.0, 0.0)) for at, x in places]


def drive(begin: int, seconds: int, mps: float = 0.5) -> list[Msg]:
    """Odometry along x from 0."""
    return [odom(at, mps * (at - begin) / S) for at in ticks(begin, seconds)]


def record(folder: Path, messages: list[Msg], split_s: int = 10) -> None:
    write_splits(folder.parent, messages, split_s, folder.name)


def arrivals(memory: Memory, x: float) -> list[float]:
    """Arrivals in whole seconds after T0, newest first."""
    found = visits(memory, Call(), x, 0.0, radius_m=0.3)
    assert found.frame_id == "map"
    return [round(((each.arrived or 0) - T0) / S, 1) for each in found.visits]


@pytest.mark.parametrize(("nav2_days", "recalls"), [(-3, False), (3, True), (0, True)])
def test_a_place_in_the_map_is_one_by_the_transforms_of_the_own_recording(
    tmp_path: Path, nav2_days: int, recalls: bool
) -> None:
    """The boat slips in its odometry, so that it stands at 5 m of its map throughout.

    The other robot's map is 100 m off its odometry for ever: it drives from 100 m to 108.
    """
    apart = nav2_days * 86_400 * S
    first = drive(T0 + apart + 1, 20, 0.4)  # else the first messages of both are one
    record(tmp_path / "nav2", [fixed(T0 + apart, "map", "odom", 100.0), *first])
    record(tmp_path / "boat", [*moving(T0, 20, "map", "odom", 5.0, -0.5), *drive(T0, 20)])
    memory = memory_of(tmp_path, recalls=recalls)
    assert arrivals(memory, 5.0) == [0.0]
    assert arrivals(memory, 103.0) == [round(apart / S + 6.8, 1)]
    assert arrivals(memory, 3.0) == []
    assert len(arrivals(memory, 105.0)) == 1


def looked_up(memory: Memory, at: int, parent: str = "map", child: str = "odom") -> Any:
    asks = {"parent": parent, "child": child, "timestamp": at / S}
    return asked(memory, "get_transform_at", **asks)


def x_of(memory: Memory, at: int, parent: str = "map", child: str = "odom") -> Any:
    """Where a frame is along x, or why that is not known."""
    found = looked_up(memory, at, parent, child)
    return found.get("reason") or found["translation"]["x"]


def test_a_note_says_how_far_stamps_of_transforms_are_from_log_times(tmp_path: Path) -> None:
    """A robot that drives is elsewhere by get_position_at of the same time."""
    for name, late in (("one clock", 0), ("two", 16 * S // 10)):
        driven = moving(T0, 20, "map", "odom", 0.0, 0.5)
        late_ones = [replace(message, log_time=message.log_time + late) for message in driven]
        record(tmp_path / name / "rec", late_ones)
        found = looked_up(memory_of(tmp_path / name), T0 + 10 * S)
        assert found["translation"]["x"] == 5.0
        assert ("1.6 s before log times" in str(found.get("notes"))) == bool(late)


def test_a_note_names_the_recording_that_answers_and_none_that_is_not_there(tmp_path: Path) -> None:
    first, second = "rec_20260714T000000Z", "rec_20260714T000001Z"
    for name, x in ((first, 100.0), (second, 500.0)):
        record(tmp_path / name, [fixed(T0, "map", "odom", x), *drive(T0, 20)])
    memory = memory_of(tmp_path)
    found = looked_up(memory, T0 + 4 * S)
    named = {100.0: first, 500.0: second}[found["translation"]["x"]]
    [note] = [note for note in found["notes"] if "2 sessions" in note]
    assert note.endswith(f"this is that of {named}")


def test_a_call_that_needs_many_recordings_looks_up_all_at_once_whatever_an_earlier_one_did(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for nth in range(9):
        begin = T0 + nth * 1000 * S
        mounted = fixed(begin, "base_link", "laser", 0.1 + nth)
        record(tmp_path / f"rec{nth:02}", [mounted, *drive(begin, 5)])
    memory = memory_of(tmp_path, recalls=True)
    looked_up = Mock(wraps=scan)
    monkeypatch.setattr(sessions, "scan", looked_up)
    for wanted in (range(4), range(4, 9)):
        looked_up.reset_mock()
        view = View(memory, Call())
        recordings = sorted(view.timeline.recordings("/tf_static"))
        for nth in wanted:
            [static] = view.sessions.static(view.sessions.session_of(recordings[nth]))
            assert static.transform.translation[0] == 0.1 + nth
        assert looked_up.call_count == 4


@pytest.mark.parametrize("gap", [S // 5, 5 * S, 15 * S])
@pytest.mark.parametrize("again", [False, True])
def test_after_a_restart_a_transform_is_that_of_the_recording_that_goes_on(
    tmp_path: Path, *, again: bool, gap: int
) -> None:
    """Whatever it is called, however soon it began, and if it received the old transform again."""
    end = T0 + 18 * S
    begin = end + gap
    first = [fixed(T0 + S, "map", "odom", 1.0), *drive(T0, 18)]
    late = fixed(begin + S // 20, "map", "odom", 1.0)
    second = [
        *drive(begin, 30),
        *([replace(late, publish_time=T0 + S)] if again else []),
        fixed(begin + S, "map", "odom", 2.0),
        fixed(begin + 2 * S, "map", "odom", 3.0),
    ]
    before = 1.0 if again else 2.0  # a session's first holds before it was received, too
    expected = {end: 1.0, begin: before, begin + S: 2.0, begin + 2 * S: 3.0, begin + 9 * S: 3.0}
    for recalls, (one, other) in ((False, "ab"), (True, "ba")):
        folder = tmp_path / one
        record(folder / one, first)
        record(folder / other, second)
        memory = memory_of(folder, recalls=recalls)
        for at, x in expected.items():
            found = looked_up(memory, at)
            assert found["translation"]["x"] == x
            assert "sessions" not in str(found)
        if gap < 10 * S:
            assert x_of(memory, begin - S // 10) == 1.0


def test_recordings_joined_by_a_handover_share_their_transforms(
    tmp_path: Path, remember: Remember
) -> None:
    """A publisher that has gone is not heard by the recording that took over."""
    first, second = tmp_path / "rec_20260714T000000Z", tmp_path / "rec_20260714T010000Z"
    record(first, [fixed(T0, "map", "odom", 7.0), *drive(T0, 20)])
    record(second, [fixed(T0 + 21 * S, "base_link", "laser", 1.0), *drive(T0 + 21 * S, 20)])
    memory = remember()
    assert x_of(memory, T0 + 33 * S) == "frame_unknown"
    write_handover(first, Handover(next=second.name))
    write_handover(second, Handover(previous=first.name))
    memory = remember()
    assert x_of(memory, T0 + 33 * S) == 7.0
    assert arrivals(memory, 12.0) == [pytest.approx(30.6, abs=0.3), pytest.approx(9.6, abs=0.3)]


def test_two_recorders_of_one_robot_complete_each_other(tmp_path: Path, remember: Remember) -> None:
    """One records what moves, one what is static, one neither."""
    record(tmp_path / "fixed", [fixed(T0, "map", "odom", 7.0)])
    record(tmp_path / "moving", moving(T0, 20, "odom", "base_link", 0.0, 0.5))
    record(tmp_path / "sensors", drive(T0, 20))
    memory = remember()
    joined = looked_up(memory, T0 + 4 * S, "map", "base_link")
    assert joined["translation"]["x"] == pytest.approx(9.0)
    assert "fixed and moving are combined" in str(joined["notes"])
    assert "notes" not in looked_up(memory, T0 + 4 * S, "odom", "base_link")
    assert arrivals(memory, 9.0) == [pytest.approx(3.4, abs=0.21)]
    note = visits(memory, Call(), 9.0, 0.0).notes[0]
    assert note.startswith("sensors is placed by transforms of another recording")
    assert note.endswith("those of fixed and moving")


@pytest.mark.parametrize(
    ("apart_s", "recalls"), [(30, False), (30, True), (3600, True), (-86_400, False)]
)
def test_a_loan_is_never_silent_and_a_recording_of_another_time_lends_nothing(
    tmp_path: Path, apart_s: int, recalls: bool
) -> None:
    """Whether `nav2` is the same robot cannot be known; a day apart it is another."""
    base = moving(T0, 60, "odom", "base_link", 0.0, 0.5)
    record(tmp_path / "nav2", [fixed(T0, "map", "odom", 100.0), *base])
    record(tmp_path / "boat", drive(T0 + apart_s * S, 60))
    memory = memory_of(tmp_path, recalls=recalls)
    answer = visits(memory, Call(), 105.0, 0.0)
    notes = [note for note in answer.notes if "boat" in note and "those of nav2" in note]
    lends = apart_s == 30
    assert (answer.total, len(notes)) == (lends, lends)
    assert visits(memory, Call(), 5.0, 0.0).frame_id == ("map" if lends else "odom")


@pytest.mark.parametrize("has_tf", [False, True])
def test_a_robot_beside_it_that_has_poses_of_its_own_lends_nothing(
    tmp_path: Path, has_tf: bool
) -> None:
    """A boat without a map was nowhere in that of the other robot, and a note says so."""
    record(tmp_path / "nav2", [fixed(T0, "map", "odom", 100.0), *drive(T0, 20, 0.0)])
    base = moving(T0, 20, "odom", "base_link", 0.0, 0.5) if has_tf else []
    record(tmp_path / "boat", [*base, *drive(T0, 20)])
    memory = memory_of(tmp_path)
    answer = visits(memory, Call(), 105.0, 0.0)
    assert (answer.frame_id, answer.total) == ("map", 0)
    assert visits(memory, Call(), 100.0, 0.0).total == 1
    if has_tf:
        assert x_of(memory, T0 + 4 * S, "map", "base_link") == "frame_unknown"
    else:
        assert "boat has no transforms" in str(answer.notes)


def test_a_value_is_of_the_recording_of_the_match(tmp_path: Path) -> None:
    """Two robots of one time on the same topics: r1 drives 20 m, r2 stands at 50 m and bumps."""
    times = ticks(T0, 20)
    record(tmp_path / "r1", [*drive(T0, 20, 1.0), *(boolean(at + 1, False) for at in times)])
    standing = [odom(at + S // 10, 50.0) for at in times]
    record(tmp_path / "r2", [*standing, *(boolean(at + 2, at == times[50]) for at in times)])
    bumped = {"condition_topic": "/bumper", "condition_type": "equals", "value": True}
    memory = memory_of(tmp_path)
    reply = asked(memory, "get_value_when", value_topic="/odom", **bumped)
    assert reply["value"]["position"]["x"] == 50
    assert reply["value_timestamp"] == T0 / S + 9.9
    assert [note for note in reply["notes"] if "/bumper" in note and note.endswith(": r1, r2")]
    assert "the match is of" not in str(reply["notes"])


def test_frames_are_those_of_the_newest_bags_where_there_is_no_time_for_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number, child in enumerate(["gone", "old", "new"]):
        record(tmp_path / f"r{number}", moving(T0 + number * 60 * S, 20, "odom", child, 0.0, 0.0))

    def children(looks: int) -> tuple[list[str], bool]:
        deadline = Deadline.after(looks, count().__next__)
        monkeypatch.setattr(Call, "partial_after", lambda *_: deadline)
        found = frames(memory_of(tmp_path), Call())
        return [edge.child for edge in found.edges], "older bags" in str(found.notes)

    answers = [children(looks) for looks in range(12)]
    named = [",".join(names) for names, _ in answers]
    assert [names for names, _ in groupby(named)] == ["new", "new,old", "gone,new,old"]
    assert all(is_partial for names, is_partial in answers if "gone" not in names)
    assert answers[-1] == (["gone", "new", "old"], False)


def test_which_frames_there_are_is_stored_though_columns_of_transforms_are_not(
    tmp_path: Path,
) -> None:
    read: list[str] = []

    class Noting(McapReader):
        def batches(self, path: Path, topics: Collection[str], *args: Any, **given: Any) -> Any:
            read.extend(topics)
            return super().batches(path, topics, *args, **given)

    driven = [*moving(T0, 60, "map", "odom", 1.0, 0.0), *moving(T0, 60, "odom", "base_link", 0, 1)]
    record(tmp_path / "rec", in_order([*driven, fixed(T0, "base_link", "camera", 0.1)]))
    memory = memory_of(tmp_path, reader=Noting())
    with_store(memory, tmp_path, share=0.0)
    assert "/tf" in read
    read.clear()
    store = ColumnStore([tmp_path / OWN_FOLDER / FILE], memory.reader.definition)
    another = replace(memory, scanner=Scanner(store, tmp_path))  # of another process
    found = asked(another, "list_frames")["frames"]
    assert found == ["base_link", "camera", "map", "odom"]
    assert not read


def test_of_a_frame_that_is_seen_now_and_then_the_nearest_time_is_named(
    tmp_path: Path, remember: Remember
) -> None:
    """As a marker, whose transform is published while a camera sees it."""
    messages = moving(T0, 600, "odom", "base_link", 0.0, 0.1)
    for begin in (100, 400):
        messages += moving(T0 + begin * S, 20, "odom", "tag", 5.0, 0.0)
    record(tmp_path / "one", in_order(messages))
    memory = remember()
    for second, away, nearest in ((200, "80 s earlier", 120.0), (350, "50 s later", 400.1)):
        refused = looked_up(memory, T0 + second * S, "base_link", "tag")
        assert refused["reason"] == "gap"
        said, _, moment = refused["detail"].rpartition(": ask about ")
        assert said.endswith(f"the two were connected {away}")
        assert float(moment) == pytest.approx(T0 / S + nearest, abs=0.1)
        found = asked(memory, "get_transform_at", parent="odom", child="tag", timestamp=moment)
        assert found["translation"]["x"] == 5.0


def test_a_frame_that_two_nodes_place_in_two_parents_is_named(tmp_path: Path) -> None:
    """As by odometry and by a localiser, which should place the frame of odometry instead."""
    messages = moving(T0, 20, "odom", "base_link", 0.0, 0.1)
    for at in range(T0, T0 + 20 * S, S // 2):
        messages.append(tf_of(at + 1000, "map", "base_link", (1.0, 0.0, 0.0)))
    record(tmp_path / "one", in_order(messages))
    memory = memory_of(tmp_path)
    for child in ("odom", "base_link"):
        refused = looked_up(memory, T0 + 10 * S + S // 5, "map", child)
        assert refused["reason"] == "frames_not_connected"
        said = "because 'base_link' has the parents 'map', 'odom' around then, as where two nodes "
        assert said in refused["detail"]


def test_a_frame_without_a_name_or_a_rotation_is_none(tmp_path: Path, remember: Remember) -> None:
    """Nor advised for another time; tf2 refuses a quaternion that nobody filled in, too."""
    unfilled: Any = transform(T0, "base_link", "laser", (1.0, 0.0, 0.0))
    unfilled.transform.rotation.w = 0.0
    static = tf(T0, unfilled, topic="/tf_static")
    nameless = moving(T0, 20, "", "arm", 0.0, 0.0)
    placed = moving(T0, 20, "odom", "base_link", 0.0, 0.0)
    record(tmp_path / "one", [static, *nameless, *placed])
    memory = remember()
    listed = asked(memory, "list_frames")
    assert listed["frames"] == ["base_link", "odom"]
    assert [note for note in listed["notes"] if "no name" in note and note.endswith("1")]
    for second, parent, child in ((5, "base_link", "laser"), (300, "", "arm")):
        refused = looked_up(memory, T0 + second * S, parent, child)
        assert "ask about" not in refused["detail"]


@settings(max_examples=examples(30))
@given(
    received=st.lists(
        st.tuples(st.sampled_from(["arm", "/arm", "eye"]), st.integers(0, 2)),
        min_size=1,
        max_size=12,
    ),
    at=st.integers(-1, 13),
)
def test_a_static_transform_is_the_newest_of_its_child_however_often_it_was_repeated(
    received: list[tuple[str, int]], at: int
) -> None:
    with TemporaryDirectory() as name:
        folder = Path(name)
        for nth, (child, x) in enumerate(received):
            record(folder / "rec", [fixed(T0 + nth * S, "base_link", child, x)], split_s=1)
        view = View(memory_of(folder), Call())
        [[session]] = view.sessions.recorded_at(T0) or []
        found = static_at(view.sessions.static(session), T0 + at * S - AT_OR_BEFORE_SLACK_NS)
    expected: dict[str, float] = {}
    for second, (child, x) in enumerate(received):
        name = child.lstrip("/")
        if second <= at or name not in expected:
            expected[name] = x
    assert {each.child.lstrip("/"): each.transform.translation[0] for each in found} == expected
