"""What is asked beside a mutant: of good bags, whose answers are known, and of the mutant."""

import json
from random import Random
from typing import Any

from mcp.types import TextContent

from ros2_memory.serving.mcp_server import EpisodicServer
from tests.fuzz.good import AFTER_S, BASE_S, BEFORE_S, LENGTH_S, TOPICS
from tests.support.memories import clause

Asked = tuple[str, dict[str, Any]]

OF_GOOD: tuple[Asked, ...] = (
    ("get_topic_at_time", {"topic": "/near/odom", "timestamp": BEFORE_S + 1}),
    ("get_position_at", {"topic": "/near/odom", "timestamp": AFTER_S + 1.05}),
    ("get_velocity_at", {"topic": "/near/odom", "timestamp": BEFORE_S + 2}),
    ("get_topic_in_range", {"topic": "/near/chatter", "start": BEFORE_S, "end": AFTER_S + 9}),
    ("get_topic_in_range", {"topic": "/near/odom", "start": 0, "end": 9e9, "max_samples": 20}),
    (
        "find_last_match",
        clause("/near/seen", "contains", "scissors"),
    ),
    (
        "find_last_match",
        clause("/near/*", "equals", "step 3 of a way"),
    ),
    (
        "get_value_when",
        {
            "value_topic": "/near/odom",
            "condition_topic": "/near/bumper",
            "condition_type": "equals",
            "value": True,
        },
    ),
    ("trajectory_summary", {"topic": "/near/odom", "start": BEFORE_S, "end": AFTER_S + 9}),
    (
        "get_transform_at",
        {"parent": "near_odom", "child": "near_base", "timestamp": BEFORE_S + 1.02},
    ),
)
"""Questions that only the good bags can answer."""

_LEFT_OUT = ("notes", "clock", "age_s")
"""Parts of an answer that may speak of the mutant too, or change with the time of day."""


def of_mutant(rng: Random) -> list[Asked]:
    """Every tool, with arguments that aim at the mutant, in some order."""
    topic, other = rng.choice(TOPICS), rng.choice(TOPICS)
    at = BASE_S + rng.choice((0, 1.05, LENGTH_S - 0.1, 2.5))
    span: dict[str, Any] = rng.choice(
        ({"start": BASE_S, "end": BASE_S + LENGTH_S}, {"start": 0, "end": 9e9})
    )
    condition: dict[str, Any] = rng.choice(
        (
            {"condition_type": "contains", "value": "never said"},
            {"condition_type": "contains", "value": "step 3"},
            {"condition_type": "equals", "value": True},
            {"condition_type": "near_position", "value": '{"x": 0.5, "y": 0.2}'},
        )
    )
    frames = {"parent": rng.choice(("odom", "base", "laser")), "child": "base"}
    asked: list[Asked] = [
        ("list_recorded_topics", {}),
        ("get_topic_at_time", {"topic": topic, "timestamp": at}),
        ("get_topic_seconds_ago", {"topic": topic, "seconds_ago": rng.choice((0, 5, 1e6))}),
        ("get_topic_in_range", {"topic": topic, **span}),
        ("get_topic_in_last", {"topic": topic, "seconds": rng.choice((5, 1e6, 1e9))}),
        ("get_position_at", {"timestamp": at}),
        ("get_position_seconds_ago", {"seconds_ago": 1}),
        ("get_velocity_at", {"timestamp": at}),
        ("get_velocity_seconds_ago", {"seconds_ago": 1e5}),
        ("get_transform_at", {**frames, "timestamp": at}),
        ("get_transform_seconds_ago", {**frames, "seconds_ago": 1}),
        ("list_frames", {}),
        ("find_last_match", {"topic": rng.choice((topic, "/*", "*")), **condition}),
        ("get_value_when", {"value_topic": other, "condition_topic": topic, **condition}),
        ("trajectory_summary", span),
        ("recent_trajectory_summary", {"seconds": rng.choice((10, 1e9))}),
    ]
    rng.shuffle(asked)
    return asked


async def ask(server: EpisodicServer, name: str, given: dict[str, Any]) -> Any:
    """The answer as a client parses it.

    Raises:
        ValueError: it is no strict JSON, or no text that can be sent.
    """
    result = await server.call_tool(name, given)
    [block] = result.content
    if not isinstance(block, TextContent):
        raise TypeError(f"{name} answers with {type(block).__name__}")
    block.text.encode()
    return json.loads(block.text, parse_constant=_no_number)


def _no_number(text: str) -> object:
    raise ValueError(f"{text} is not JSON")


def comparable(answer: Any) -> Any:
    """An answer without what it may say of bags that it does not come from."""
    if isinstance(answer, dict):
        kept = {key: value for key, value in answer.items() if key not in _LEFT_OUT}
        return None if kept == {"match": None} else kept
    return answer
