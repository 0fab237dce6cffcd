"""This project's side: the memory as the server builds it, asked through its queries."""

from __future__ import annotations

import asyncio
import json
from dataclasses import replace
from typing import TYPE_CHECKING, cast

from ros2_memory import queries
from ros2_memory.bootstrap import build_memory, build_server
from ros2_memory.config import load_settings
from ros2_memory.core.logging_setup import configure_logging
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import unix_from_ns
from ros2_memory.history.context import Call
from ros2_memory.history.view import AtTime, TimeRange

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from mcp.types import TextContent

    from benchmarks.bags import Split
    from ros2_memory.config import Settings
    from ros2_memory.core.model import JsonValue
    from ros2_memory.history.context import Memory


def settings_for(bag_dir: Path) -> Settings:
    """The shipped configuration over a folder of bags; logs below an error are dropped.

    It is that of a robot that records, so the catalogue lies beside the bags.
    """
    configure_logging("error", "json")
    return load_settings(overrides(bag_dir), env={})


def overrides(bag_dir: Path) -> list[str]:
    """What of the configuration is not as shipped."""
    return [f"recording.bag_dir='{bag_dir}'", "logging.level=error"]


def memory(settings: Settings) -> Memory:
    """A memory that does not know the folder yet."""
    return build_memory(settings)


def counts(memory: Memory) -> list[tuple[str, int]]:
    """Messages by topic, having indexed the folder."""
    snapshot = memory.index.refresh()
    return [
        (topic, sum(each.messages for each in snapshot.timeline.totals(topic).values()))
        for topic in snapshot.timeline.topics()
    ]


def forgetful(memory: Memory, settings: Settings, known: Split, topic: str) -> Memory:
    """The memory with a reader that has read nothing of any bag.

    Its decoders are compiled, as those of plain rosbags are: one record is decoded, without
    reading it.
    """
    record = next(iter(memory.reader.records(known.path, [topic], TimeWindow.everything())), None)
    reader = build_memory(settings).reader
    if record is not None:
        reader.decode(record)
    return replace(memory, reader=reader)


def position_at(memory: Memory, topic: str, at_s: float) -> tuple[int, float, float]:
    """Log time and place of the newest pose at or before a moment."""
    found = queries.position(memory, Call(), AtTime(at_s=at_s), topic=topic)
    return found.time, found.pose.position[0], found.pose.position[1]


def samples(
    memory: Memory, topic: str, start: int, stop: int, at_most: int
) -> list[tuple[int, float, float]]:
    """Evenly spaced poses of a window, the first and the last among them."""
    found = queries.topic_range(memory, Call(), topic, _span(start, stop), max_samples=at_most)
    return [(each.time, *_place(each.value)) for each in found.samples]


def path_length(memory: Memory, topic: str, start: int, stop: int) -> float:
    """Metres driven in a window."""
    return queries.trajectory_summary(
        memory, Call(), _span(start, stop), topic=topic
    ).trajectory.totals.distance_m


def last_match(memory: Memory, topic: str, condition: str, value: JsonValue) -> int | None:
    """Log time of the newest message that meets a condition."""
    found = queries.find_last_match(memory, Call(), topic, condition, value).found
    return None if found is None else found.sample.time


def positions_by_tool(
    memory: Memory, settings: Settings, moments: Sequence[float]
) -> list[tuple[float, float]]:
    """Places at some moments, each by one call of the tool: arguments in, JSON text out."""
    server = build_server(settings, memory)

    async def ask() -> list[tuple[float, float]]:
        places = []
        for at_s in moments:
            result = await server.call_tool("get_position_at", {"timestamp": at_s})
            place = json.loads(cast("TextContent", result.content[0]).text)
            places.append((float(place["x"]), float(place["y"])))
        return places

    return asyncio.run(ask())


def _span(start: int, stop: int) -> TimeRange:
    return TimeRange(start_s=unix_from_ns(start), end_s=unix_from_ns(stop))


def _place(value: JsonValue) -> tuple[float, float]:
    place = value.get("position") if isinstance(value, dict) else None
    if not isinstance(place, dict):
        raise TypeError(f"a sample has no position: {value!r}")
    x, y = place.get("x"), place.get("y")
    if not isinstance(x, int | float) or not isinstance(y, int | float):
        raise TypeError(f"a position is not two numbers: {place!r}")
    return float(x), float(y)
