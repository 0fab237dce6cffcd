from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory import results
from ros2_memory.analysis.motion.odometry import Leg, MotionTotals, NearbyMotion, TimedPosition
from ros2_memory.analysis.motion.path_length import End
from ros2_memory.analysis.motion.trajectory import Trajectory, Waypoint
from ros2_memory.core.errors import (
    BagVanishedError,
    ConfigError,
    EpisodicError,
    InvalidArgumentsError,
    NoDataError,
    NoDataReason,
    QueryTimeoutError,
    UndecodableError,
)
from ros2_memory.core.model import Sample, SetAside
from ros2_memory.core.timebase import NS_PER_S, unix_rounded_up
from ros2_memory.results import Answer
from ros2_memory.tools.replies import Replies

if TYPE_CHECKING:
    pass

BAGS = Path("bags")
T0 = 1_784_023_200 * NS_PER_S
REPLIES = Replies(BAGS, 24_000)


def said(answer: Answer, replies: Replies = REPLIES) -> Any:
    reply = replies.answer(answer)
    assert not reply.is_error
    return json.loads(reply.text)


def driven(jumps: int = 0, jumped_m: float = 0.0) -> MotionTotals:
    end, near = End(0.0, 0.0, plain=True, creep=None), NearbyMotion(0.0, 0.0)
    first = TimedPosition(T0, (0.0, 0.0, 0.0))
    last = first._replace(time=T0 + 60_000_490_000)
    length_m = 12.34567
    leg = Leg(first, last, 3000, None, length_m, length_m, end, end, False, near, near)
    return MotionTotals(leg, jumps=jumps, jumped_m=jumped_m)


def trajectory(**other: Any) -> results.TrajectorySummary:
    way: dict[str, Any] = {
        "totals": driven(),
        "avg_speed": 0.205761,
        "max_speed": 0.5,
        "max_speed_from": "twist",
        "waypoints": (
            Waypoint(T0, (0.0, 1.00004, -0.0), math.pi / 2),
            Waypoint(T0 + 1, (1.0, 2.0, 0.0), None),
        ),
        "waypoint_error_m": 0.05,
        "poses": 3000,
        "invalid": 0,
    }
    return results.TrajectorySummary("/odom", "odom", T0, T0 + 1, Trajectory(**way | other))


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (
            NoDataError(NoDataReason.GAP, "nothing", ("1 file is damaged",)),
            '{"error":"no_data","reason":"gap","detail":"nothing","notes":["1 file is damaged"]}',
        ),
        (
            UndecodableError("/x", "a/msg/B", "no definition"),
            '{"error":"no_data","reason":"undecodable","detail":"/x (a/msg/B): no definition"}',
        ),
        (QueryTimeoutError("say a"), '{"error":"timeout","detail":"say a"}'),
        (ConfigError("say a"), '{"error":"invalid_config","detail":"say a"}'),
    ],
)
def test_having_no_data_is_an_answer_with_its_reason(error: EpisodicError, text: str) -> None:
    """Other errors are errors for the protocol, too."""
    reply = REPLIES.error(error)
    assert (reply.text, reply.is_error) == (
        text,
        not isinstance(error, (NoDataError, UndecodableError)),
    )


def test_a_bag_error_names_the_file_but_no_path_of_the_machine() -> None:
    reply = Replies(Path("/data/bags"), 1000).error(
        BagVanishedError("/data/bags/r1/r1_0.mcap", "it is gone")
    )
    assert json.loads(reply.text)["detail"] == "r1/r1_0.mcap: it is gone; ask again"


ROW_KEYS = ["topic", "type", "first_ts", "last_ts", "count"]


@given(
    st.lists(
        st.tuples(st.text(min_size=1, max_size=900), st.integers(0, 2**63 - 1), st.integers(0, 9)),
        max_size=60,
    ),
    st.integers(500, 3000),
)
def test_topics_are_always_a_list_of_rows_of_five_keys_with_the_busiest_first(
    topics: list[tuple[str, int, int]], max_chars: int
) -> None:
    rows = tuple(
        results.TopicRow(name, "a/msg/B", T0 + n, T0 + n + extent, count, "why", ("odd",))
        for n, (name, count, extent) in enumerate(topics)
    )
    reply = Replies(BAGS, max_chars).answer(rows)
    listed = json.loads(reply.text)
    assert len(reply.text) <= max(max_chars, 2)
    assert all([*each] == ROW_KEYS for each in listed)
    assert sum(each["count"] for each in listed) == sum(count for _, count, _ in topics)
    if len(listed) == len(rows) and not (listed and listed[-1]["type"] == ""):
        assert [each["count"] for each in listed] == [count for _, count, _ in topics]
        return
    *shown, rest = listed
    left_out = sorted(rows, key=lambda row: -row.count)[len(shown) :]
    assert [each["count"] for each in shown] == sorted((row.count for row in rows), reverse=True)[
        : len(shown)
    ]
    assert (rest["topic"], rest["type"]) == (f"({len(left_out)} more: use pattern)", "")
    assert rest["first_ts"] == unix_rounded_up(min(row.first for row in left_out))
    assert rest["last_ts"] == unix_rounded_up(max(row.last for row in left_out))


def test_long_lists_of_files_show_the_last_ones_and_their_number() -> None:
    damaged = tuple(SetAside(BAGS / f"{n:03}.mcap", "torn") for n in range(50))
    shown = said(results.DataTimeRange(T0, T0, T0, 1, (), (), (), damaged, (), 0))
    assert [each["file"] for each in shown["damaged"]] == [f"{n:03}.mcap" for n in range(30, 50)]
    assert shown["damaged_count"] == 50
    assert shown["notes"] == ["damaged: the last 20 of 50 are listed"]


def test_a_range_with_fields_is_a_table() -> None:
    place: Any = {"x": 1.0, "y": 2.0, "z": 0.0}
    samples = (
        Sample(T0, {"position": place, "yaw": 1.25}),
        Sample(T0 + 123_456_789, {"position": None, "yaw": 0.5}),
    )
    fields = ("position", "yaw")
    shown = said(results.TopicRange("/odom", "nav_msgs/msg/Odometry", 2, samples, fields=fields))
    assert shown["fields"] == [
        "timestamp", "position.x", "position.y", "position.z", "yaw", "position",
    ]  # fmt: skip
    assert shown["rows"] == [
        [1784023200.0, 1.0, 2.0, 0.0, 1.25, None],
        [1784023200.123457, None, None, None, 0.5, None],
    ]
    assert "samples" not in shown


def test_a_trajectory_says_what_was_left_out_and_how_it_was_measured() -> None:
    notes = said(
        trajectory(
            invalid=3, totals=driven(2, 41.5), max_speed_from="positions", waypoint_error_m=0.31
        )
    )["notes"]
    assert [note.split(" ")[0] for note in notes] == ["3", "2", "max_speed", "the"]
    assert "41.50 m" in notes[1]
    assert "0.31 m" in notes[3]


def test_a_jump_is_marked_at_the_waypoint_it_led_to() -> None:
    waypoints = (Waypoint(T0, (0, 0, 0), None), Waypoint(T0 + 1, (90, 0, 0), None, jump=True))
    shown = said(trajectory(waypoints=waypoints, totals=driven(1, 90.0)))
    assert [point.get("jump") for point in shown["waypoints"]] == [None, True]
    assert shown["notes"] == [
        ("1 jump of 90.00 m in all, faster than is plausible, left out of distance and speed"),
        "of the jumps each leads to a waypoint with jump: true; that distance was not driven",
    ]
    shown = said(trajectory(waypoints=waypoints, totals=driven(9, 99.0)))
    assert shown["notes"][1].startswith("of the jumps the longest lead to a waypoint")


def test_a_mean_above_the_highest_speed_is_told() -> None:
    [note] = said(trajectory(avg_speed=0.9, max_speed=0.5))["notes"]
    assert note.startswith("avg_speed, by the positions, is above max_speed")
    assert "notes" not in said(trajectory(avg_speed=0.501, max_speed=0.5))


def test_an_error_stays_below_the_cap() -> None:
    reply = Replies(BAGS, 1000).error(InvalidArgumentsError("why " * 5000))
    assert len(reply.text) <= 1000
    assert json.loads(reply.text)["error"] == "invalid_arguments"
