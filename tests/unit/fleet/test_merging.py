"""Merging: what several robots answered, as one reply."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.errors import EpisodicError
from ros2_memory.fleet.tools import Page, RobotReply, merged

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

NAMES = st.lists(
    st.sampled_from([f"r{number}" for number in range(8)]), unique=True, min_size=1, max_size=6
)


def reply_of(tool: str, replies: Sequence[RobotReply], **how: Any) -> dict[str, Any]:
    failures: Mapping[str, EpisodicError] = how.pop("failures", {})
    page = Page(how.pop("limit", None), oldest_first=False)
    found = merged(tool, replies, failures, page, 10**6)
    assert json.loads(json.dumps(found)) == found
    return found


@st.composite
def sighting_replies(draw: st.DrawFn) -> list[RobotReply]:
    """Replies of `find_matches`, each newest first."""
    replies = []
    for name in draw(NAMES):
        times = sorted(draw(st.lists(st.integers(0, 30), max_size=6)), reverse=True)
        rows = [{"topic": "/seen", "last_seen": float(at), "of": name} for at in times]
        total = len(rows) + draw(st.integers(0, 2))
        value: dict[str, Any] = {
            "sightings": rows,
            "total": total,
            "searched_from": float(draw(st.integers(-9, 0))),
            "searched_to": float(draw(st.integers(31, 40))),
        }
        if total > len(rows):
            value["more"] = True
        replies.append(RobotReply(name, value, latest=draw(st.none() | st.integers(0, 50))))
    return replies


@given(sighting_replies(), st.integers(1, 12))
def test_rows_are_the_newest_of_all_robots_each_with_its_name(
    replies: list[RobotReply], limit: int
) -> None:
    found = reply_of("find_matches", replies, limit=limit)
    values: list[Any] = [reply.value for reply in replies]
    every = [row for value in values for row in value["sightings"]]
    rows = found["sightings"]
    assert [row["last_seen"] for row in rows] == sorted(
        (row["last_seen"] for row in every), reverse=True
    )[:limit]
    assert all(row["robot_name"] == row["of"] for row in rows)
    assert found["total"] == sum(value["total"] for value in values)
    assert found["searched_from"] == min(value["searched_from"] for value in values)
    assert found["searched_to"] == max(value["searched_to"] for value in values)
    assert {name: row["total"] for name, row in found["by_robot"].items()} == {
        reply.name: value["total"] for reply, value in zip(replies, values, strict=True)
    }
    hides = len(every) > limit or any(value.get("more") for value in values)
    assert found.get("more", False) is hides


def test_a_total_that_one_robot_did_not_count_is_not_that_of_the_others() -> None:
    found = reply_of(
        "find_matches",
        [
            RobotReply("red", {"sightings": [], "total": 7}, latest=100),
            RobotReply("blue", {"sightings": [], "at_least": 5}, latest=100),
        ],
    )
    assert found["at_least"] == 12
    assert "total" not in found


def test_a_stay_that_goes_on_is_the_newest() -> None:
    replies = [
        RobotReply(name, {"visits": [{"arrived": arrived, "departed": departed}], "total": 1})
        for name, arrived, departed in (("r1", 8.0, 9.0), ("r2", 1.0, None))
    ]
    found = reply_of("visits", replies)["visits"]
    assert [row["robot_name"] for row in found] == ["r2", "r1"]
