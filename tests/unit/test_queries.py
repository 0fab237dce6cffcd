"""Questions whose honest answer takes care."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from ros2_memory import queries, results
from ros2_memory.core.errors import (
    InvalidArgumentsError,
    NoDataError,
    NoDataReason,
)
from ros2_memory.history.context import Call
from ros2_memory.history.view import AtTime, TimeRange
from tests.support.bags import (
    Msg,
    boolean,
    command,
    detections,
    odom,
    tf,
    transform,
    write_mcap,
)
from tests.support.memories import asked, memory_of

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.core.model import JsonValue

T0 = 1_700_000_000 * 10**9
S = 10**9


def span(start: float, end: float) -> TimeRange:
    return TimeRange(start_s=T0 / 1e9 + start, end_s=T0 / 1e9 + end)


@pytest.mark.parametrize(
    ("topic", "kind", "value", "field"),
    [
        ("/bumper", "equals", True, "data.nothing"),
        ("/odom", "near_position", {"x": 1, "y": 0}, "pose.pose.nothing"),
        ("/bumper", "near_position", {"x": 1, "y": 0}, None),
    ],
)
def test_what_no_value_can_meet_is_refused_and_not_answered_with_never(
    tmp_path: Path, topic: str, kind: str, value: JsonValue, field: str | None
) -> None:
    write_mcap(tmp_path / "a" / "a_0.mcap", [boolean(T0, True), odom(T0, 1.0, 0.0)])
    with pytest.raises(InvalidArgumentsError, match=topic):
        queries.find_last_match(memory_of(tmp_path), Call(), topic, kind, value, field=field)


def test_nothing_seen_in_the_newest_message_does_not_make_a_field_unknown(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a" / "a_0.mcap", [detections(T0, [])])
    answer = queries.find_last_match(
        memory_of(tmp_path),
        Call(),
        "/vision/scene/scene_objects",
        "equals",
        "cup",
        field="detections.label",
    )
    assert (answer.found, answer.notes) == (None, ())


def test_a_pose_that_cannot_be_decoded_is_left_out_of_the_path_and_counted(tmp_path: Path) -> None:
    poses = [odom(T0 + n * S, n, 0.0) for n in range(10)]
    poses[5] = Msg("/odom", poses[5].type, T0 + 5 * S, b"\x00\x01\x00\x00")
    write_mcap(tmp_path / "a" / "a_0.mcap", poses)
    answer = queries.trajectory_summary(memory_of(tmp_path), Call(), span(0, 10))
    assert (answer.trajectory.poses, answer.trajectory.totals.distance_m) == (9, 9.0)
    assert any("cannot be decoded: 1 " in note for note in answer.notes)


def test_a_path_of_which_nothing_can_be_decoded_has_no_answer(tmp_path: Path) -> None:
    broken = Msg("/odom", odom(T0, 0, 0).type, T0, b"\x00\x01\x00\x00")
    write_mcap(tmp_path / "a" / "a_0.mcap", [broken])
    with pytest.raises(NoDataError) as caught:
        queries.trajectory_summary(memory_of(tmp_path), Call(), span(0, 10))
    assert caught.value.reason is NoDataReason.UNDECODABLE


def test_a_field_that_one_type_of_a_topic_has_is_shown_of_its_messages(tmp_path: Path) -> None:
    poses = [odom(T0 + n * S, n, 0.0) for n in range(3)]
    write_mcap(tmp_path / "a" / "a_0.mcap", poses)
    write_mcap(tmp_path / "b" / "b_0.mcap", [command(T0 + 9 * S, 0.5, topic="/odom")])
    window = {"topic": "/odom", "start": T0 / 1e9, "end": T0 / 1e9 + 9}
    memory = memory_of(tmp_path)
    told = asked(memory, tmp_path, "get_topic_in_range", **window, fields=["position.x"])
    assert [x for _, x in told["rows"]] == [0, 1, 2]
    assert any("1 samples left out: geometry_msgs/msg/Twist has no" in n for n in told["notes"])
    told = asked(memory, tmp_path, "get_topic_in_range", **window, fields=["nothing"])
    assert told["error"] == "invalid_arguments"


def test_a_window_that_reaches_past_the_memory_at_either_end_says_so(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a" / "a_0.mcap", [odom(T0 + n * S, n, 0.0) for n in range(3)])
    memory = memory_of(tmp_path)
    inside = queries.topic_range(memory, Call(), "/odom", span(0, 2))
    assert inside.notes == ()
    wider = queries.topic_range(memory, Call(), "/odom", span(-5, 900))
    assert [note.partition(" at ")[0] for note in wider.notes] == [
        f"recorded only 2 of 905 s between {T0 // S - 5}.000000 and {T0 // S + 900}.000000",
        "the memory begins",
        "the memory ends",
    ]


@pytest.mark.parametrize(
    ("at", "reason"),
    [
        (-3.0, "outside_range"),
        (-60.0, "outside_range"),
        (23.0, "gap"),
        (50.0, "gap"),
        (109.0, "outside_range"),
    ],
)
def test_why_there_is_no_transform_is_reported_of_the_whole_memory(
    tmp_path: Path, at: float, reason: str
) -> None:
    for name, begin in (("a", 0), ("b", 80)):
        write_mcap(
            tmp_path / name / f"{name}_0.mcap",
            [
                tf(
                    T0 + n * S // 10,
                    transform(T0 + n * S // 10, "odom", "base_link", (n, 0.0, 0.0)),
                )
                for n in range(begin * 10, begin * 10 + 200)
            ],
        )
    with pytest.raises(NoDataError) as caught:
        queries.transform(
            memory_of(tmp_path), Call(), "odom", "base_link", AtTime(at_s=T0 / 1e9 + at)
        )
    assert caught.value.reason == reason
    assert "tolerance_s" not in caught.value.detail


def test_without_a_bag_directory_it_is_not_reported_that_nothing_was_recorded(
    tmp_path: Path,
) -> None:
    memory = memory_of(tmp_path / "away")
    with pytest.raises(NoDataError, match=r"the bag directory does not exist.*check \.\.\./away"):
        queries.list_recorded_topics(memory, Call())
    assert queries.list_recorded_topics(memory_of(tmp_path), Call()) == ()


def test_a_path_is_drawn_with_as_many_waypoints_as_are_asked_for(tmp_path: Path) -> None:
    zigzag = [odom(T0 + at * S, float(at), float(at % 2)) for at in range(20)]
    write_mcap(tmp_path / "a" / "a_0.mcap", zigzag)
    memory = memory_of(tmp_path)

    def drawn(at_most: int) -> results.TrajectorySummary:
        return queries.trajectory_summary(memory, Call(), span(0, 20), max_waypoints=at_most)

    whole = drawn(50)
    assert len(whole.trajectory.waypoints) == 20
    few = drawn(5)
    assert len(few.trajectory.waypoints) <= 5
    assert few.trajectory.waypoint_error_m > 0.5
    none = drawn(0)
    assert none.trajectory.waypoints == ()
    assert none.trajectory.totals == whole.trajectory.totals
    assert [each.time for each in drawn(1).trajectory.waypoints] == [T0 + 19 * S]
    reply = asked(memory, tmp_path, "trajectory_summary", start=T0 / S, end=T0 / S + 20,
                  max_waypoints=0)  # fmt: skip
    assert reply["waypoints"] == []
    assert not any("waypoint" in each for each in reply.get("notes", []))
