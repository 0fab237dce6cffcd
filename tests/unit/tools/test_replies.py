import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory import results
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
from ros2_memory.core.model import Sample
from ros2_memory.core.timebase import NS_PER_S, unix_rounded_up
from ros2_memory.tools.replies import Replies

BAGS = Path("bags")
T0 = 1_784_023_200 * NS_PER_S
REPLIES = Replies(BAGS, 24_000)


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


def test_a_range_with_fields_is_a_table() -> None:
    place: Any = {"x": 1.0, "y": 2.0, "z": 0.0}
    samples = (
        Sample(T0, {"position": place, "yaw": 1.25}),
        Sample(T0 + 123_456_789, {"position": None, "yaw": 0.5}),
    )
    fields = ("position", "yaw")
    found = results.TopicRange("/odom", "nav_msgs/msg/Odometry", 2, samples, fields=fields)
    shown = json.loads(REPLIES.answer(found).text)
    assert shown["fields"] == [
        "timestamp", "position.x", "position.y", "position.z", "yaw", "position",
    ]  # fmt: skip
    assert shown["rows"] == [
        [1784023200.0, 1.0, 2.0, 0.0, 1.25, None],
        [1784023200.123457, None, None, None, 0.5, None],
    ]
    assert "samples" not in shown


def test_an_error_stays_below_the_cap() -> None:
    reply = Replies(BAGS, 1000).error(InvalidArgumentsError("why " * 5000))
    assert len(reply.text) <= 1000
    assert json.loads(reply.text)["error"] == "invalid_arguments"
