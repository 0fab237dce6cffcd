"""A short run of a robot, and questions about it that go through the whole house."""

import json
import math
from functools import cache
from pathlib import Path
from typing import Any

from mcp import Client
from mcp.types import TextContent

from ros2_memory.core.timebase import NS_PER_S
from tests.support.bags import Msg, boolean, detections, mcap_content, odom, tf, transform
from tests.support.memories import clause

T0_S = 1_784_023_200
T0 = T0_S * NS_PER_S
LENGTH_S = 12

ANSWERED: list[tuple[str, dict[str, Any], str]] = [
    ("list_recorded_topics", {}, "topic"),
    ("data_time_range", {}, "earliest"),
    ("get_topic_at_time", {"topic": "/odom", "timestamp": T0_S + 5}, "value"),
    ("get_topic_seconds_ago", {"topic": "/odom", "seconds_ago": 5}, "age_s"),
    ("get_topic_in_range", {"topic": "/odom", "start": T0_S, "end": T0_S + 9}, "samples"),
    ("get_topic_in_last", {"topic": "/odom", "seconds": 5, "fields": "position"}, "rows"),
    ("get_position_at", {"timestamp": T0_S + 3}, "yaw_deg"),
    ("get_position_seconds_ago", {"seconds_ago": 1}, "age_s"),
    ("get_velocity_at", {"timestamp": T0_S + 3}, "linear"),
    ("get_velocity_seconds_ago", {"seconds_ago": 1, "topic": "/odom"}, "angular"),
    ("get_transform_at", {"parent": "odom", "child": "laser", "timestamp": T0_S + 3}, "rotation"),
    ("get_transform_seconds_ago", {"parent": "laser", "child": "odom", "seconds_ago": 1}, "clock"),
    ("list_frames", {}, "transforms"),
    (
        "find_last_match",
        clause("/vision/*/scene_objects", "contains", "scissors"),
        "timestamp",
    ),
    (
        "find_last_match",
        clause("/odom", "near_position", '{"x": 0, "y": 0}'),
        "value",
    ),
    (
        "get_value_when",
        {
            "value_topic": "/odom",
            "condition_topic": "/bumper",
            "condition_type": "equals",
            "value": True,
        },
        "matched",
    ),
    ("trajectory_summary", {"start": T0_S, "end": T0_S + LENGTH_S}, "waypoints"),
    ("recent_trajectory_summary", {"seconds": 5}, "distance_m"),
    (
        "find_matches",
        clause("/vision/*/scene_objects", "contains", "cup"),
        "sightings",
    ),
    ("find_things", {"label": "cup"}, "things"),
    (
        "compare",
        {"start": T0_S + 10, "end": T0_S + LENGTH_S, "with_start": T0_S, "with_end": T0_S + 10},
        "things",
    ),
    ("recap", {"start": T0_S, "end": T0_S + LENGTH_S}, "events"),
    ("recap", {"last_s": 5}, "stood_s"),
    ("visits", {"x": 0.0, "y": 0.0}, "visits"),
    ("memory_status", {}, "doubts"),
]
REFUSED: list[tuple[str, dict[str, Any], str, bool]] = [
    ("get_position_at", {"timestamp": 5}, "no_data", False),
    ("get_topic_at_time", {"topic": "/nope", "timestamp": T0_S}, "no_data", False),
    ("get_transform_at", {"parent": "map", "child": "laser", "timestamp": T0_S}, "no_data", False),
    ("get_position_at", {"timestamp": "yesterday"}, "invalid_arguments", True),
    ("get_position_at", {"timestamp": T0_S, "when": 1}, "invalid_arguments", True),
    ("get_position_at", {}, "invalid_arguments", True),
    ("get_topic_in_range", {"topic": "/odom", "start": 9, "end": 1}, "invalid_arguments", True),
    (
        "find_last_match",
        clause("/odom", "near_position", "here"),
        "invalid_arguments",
        True,
    ),
    ("no_such_tool", {}, "invalid_arguments", True),
]
CALLS: list[tuple[str, dict[str, Any]]] = [
    *((name, given) for name, given, _ in ANSWERED),
    *((name, given) for name, given, _, _ in REFUSED),
]
"""Every tool, and every kind of refusal."""


def write_run(bag_dir: Path) -> None:
    """Twelve seconds of a robot: odometry, transforms, one sighting, one bump."""
    (bag_dir / "run").mkdir(parents=True, exist_ok=True)
    (bag_dir / "run" / "run_0.mcap").write_bytes(_run())


@cache
def _run() -> bytes:
    messages: list[Msg] = []
    for n in range(LENGTH_S * 50):
        at = T0 + n * NS_PER_S // 50
        messages.append(odom(at, math.sin(n / 50), n / 100, 0.3, vx=0.5, wz=0.1))
        moved = transform(at, "odom", "base_link", (n / 100, 0.0, 0.0), 0.1)
        messages.append(tf(at, moved))
    fixed = transform(T0, "base_link", "laser", (0.2, 0.0, 0.1))
    messages.append(tf(T0, fixed, topic="/tf_static"))
    messages.append(detections(T0 + 5 * NS_PER_S, ["scissors", "cup"]))
    messages.append(boolean(T0 + 6 * NS_PER_S, data=True))
    return mcap_content(messages)


async def ask(client: Client, name: str, given: dict[str, Any]) -> tuple[Any, bool]:
    result = await client.call_tool(name, given)
    [block] = result.content
    assert isinstance(block, TextContent)
    assert result.structured_content is None
    return json.loads(block.text), bool(result.is_error)


async def ask_everything(client: Client, *, of_several_robots: bool = False) -> None:
    """Every tool and every kind of error that a sound server has.

    Over the recordings `of_several_robots` at one time there is no path.
    """
    tools = (await client.list_tools()).tools
    assert {tool.name for tool in tools} == {name for name, _, _ in ANSWERED}
    for name, given, key in ANSWERED:
        reply, is_error = await ask(client, name, given)
        if of_several_robots and name == "trajectory_summary":
            assert reply["reason"] == "mixed", reply
            continue
        assert key in (reply[0] if isinstance(reply, list) else reply), (name, reply)
        assert not is_error
    for name, given, code, expected in REFUSED:
        reply, is_error = await ask(client, name, given)
        assert reply["error"] == code, (name, reply)
        assert reply["detail"]
        assert is_error == expected
