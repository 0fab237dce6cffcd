"""A small fleet: for each robot a minute in two splits, seeded by its name, and what it saw."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

from ros2_memory.core.errors import EpisodicError
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.fleet.robots import Fleet, Robot
from ros2_memory.fleet.tools import fleet_tools
from ros2_memory.history.context import Call, Memory, QuerySettings
from ros2_memory.tools.build import build_tools
from ros2_memory.tools.declaration import Tool
from ros2_memory.tools.replies import Replies
from tests.support.bags import (
    McapLayout,
    Msg,
    boolean,
    detections,
    odom,
    set_mtime,
    tf_of,
    write_mcap,
)
from tests.support.clocks import FixedClock
from tests.support.memories import memory_of

START_S = 1_795_161_600
NOW = (START_S + 600) * NS_PER_S
LENGTH_S = 60
LABELS = ("mug", "scissors", "table")
SEEN = "/vision/scene/scene_objects"
MOST_CHARS = 10**6

_AT: dict[str, object] = {"timestamp": START_S + 205, "tolerance_s": 200}
_AGO: dict[str, object] = {"seconds_ago": 10}
_SPAN: dict[str, object] = {"start": START_S, "end": START_S + 300}
_FRAMES: dict[str, object] = {"parent": "map", "child": "base_link"}
MUG: dict[str, object] = {
    "topic": "/vision/*",
    "condition_type": "contains",
    "value": "mug",
}
CALLS: dict[str, dict[str, object]] = {
    "get_topic_at_time": {"topic": "/is_docked", **_AT},
    "get_topic_seconds_ago": {"topic": "/is_docked", **_AGO},
    "get_topic_in_range": {"topic": "/is_docked", **_SPAN},
    "get_topic_in_last": {"topic": "/is_docked", "seconds": 600},
    "get_position_at": _AT,
    "get_position_seconds_ago": _AGO,
    "get_velocity_at": _AT,
    "get_velocity_seconds_ago": _AGO,
    "get_transform_at": {**_FRAMES, "timestamp": START_S + 205},
    "get_transform_seconds_ago": {**_FRAMES, **_AGO},
    "find_last_match": MUG,
    "find_matches": MUG,
    "get_value_when": {
        "value_topic": "/odom",
        "condition_topic": "/vision/*",
        "condition_type": "contains",
        "value": "mug",
    },
    "trajectory_summary": _SPAN,
    "recent_trajectory_summary": {"seconds": 600},
    "recap": _SPAN,
    "compare": {**_SPAN, "start": START_S + 30, "with_start": START_S, "with_end": START_S + 30},
    "visits": {"where": {"x": 1, "y": 2, "radius_m": 2}},
}
"""Arguments with which a tool answers about some seeded robot; others need none."""
TOOLS = [tool.name for tool in build_tools(QuerySettings())]


@dataclass(frozen=True)
class SeededRobot:
    """What a robot's bags hold: when its data begins, and when it saw what (Unix s)."""

    name: str
    start_s: int
    seen: tuple[tuple[int, str], ...]

    @property
    def end_s(self) -> int:
        """The last second that has data."""
        return self.start_s + LENGTH_S - 1


def seeded(name: str, *, shift_s: int = 0) -> SeededRobot:
    """The robot of a name: it sees something every seventh second, and what depends on the name."""
    chance = Random(name)
    start = START_S + 10 * chance.randrange(20) + shift_s
    seen = [(start + at, chance.choice(LABELS)) for at in range(1, LENGTH_S, 7)]
    return SeededRobot(name, start, tuple(seen))


def write_robot(robot: SeededRobot, bag_dir: Path) -> Path:
    """Writes its bags, dated as their recorder would have left them."""
    first = robot.start_s * NS_PER_S
    messages: list[Msg] = [tf_of(first, "map", "odom", (1.0, 2.0, 0.0), topic="/tf_static")]
    seen = dict(robot.seen)
    for second in range(LENGTH_S):
        at = first + second * NS_PER_S
        x = math.sin(second / 10) * 3
        messages.append(odom(at, x, 0.1 * second, 0.0, vx=0.3))
        messages.append(tf_of(at, "odom", "base_link", (x, 0.1 * second, 0.0), 0.0))
        if second % 20 == 0:
            messages.append(boolean(at, second == 20, topic="/is_docked"))
        if robot.start_s + second in seen:
            label = seen[robot.start_s + second]
            # What is seen stands still, 2 m apart, in the map.
            place = (4.0 + 2 * LABELS.index(label) - x, 3.0 - 0.1 * second, 0.0)
            messages.append(detections(at, [label], topic=SEEN, at=place))
    half = first + LENGTH_S // 2 * NS_PER_S
    for number, (begin, end) in enumerate(((first, half), (half, half * 2))):
        path = bag_dir / "rec" / f"rec_{number}.mcap"
        part = [each for each in messages if begin <= each.log_time < end]
        write_mcap(path, part, McapLayout(latched=frozenset({"/tf_static"})))
        set_mtime(path, min(end, first + LENGTH_S * NS_PER_S))
    return bag_dir


def fleet_memory(bag_dir: Path, limits: QuerySettings | None = None) -> Memory:
    """A robot's memory, asked at `NOW`."""
    return memory_of(bag_dir, clock=FixedClock(NOW), limits=limits, setting="fleet.robots")


def fleet_over(
    folder: Path,
    names: tuple[str, ...],
    *,
    shared_map: bool = False,
    limits: QuerySettings | None = None,
) -> Fleet:
    """The fleet of `folder/<name>`, asked at `NOW`."""
    robots = [Robot(name, fleet_memory(folder / name, limits)) for name in names]
    return Fleet(robots, FixedClock(NOW), shared_map=shared_map)


def tools_of(fleet: Fleet, at_once: int = 4, max_chars: int = MOST_CHARS) -> dict[str, Tool]:
    """The tools of a fleet by name."""
    tools = build_tools(QuerySettings(), writing=True)
    return {tool.name: tool for tool in fleet_tools(tools, fleet, max_chars, at_once)}


def reply(fleet: Fleet, tool: str, given: Mapping[str, object], call: Call | None = None) -> Any:
    """The JSON of a fleet's reply, be it an error; robots are asked one after another.

    So what the first answer decides what the others need not.
    """
    return reply_of(tools_of(fleet, at_once=1)[tool], given, call)


def reply_of(tool: Tool, given: Mapping[str, object], call: Call | None = None) -> Any:
    """The JSON of a tool of a fleet, be it an error."""
    replies = Replies(Path("nowhere"), MOST_CHARS)
    of_no_robot = memory_of(Path("/nowhere"))
    try:
        answer = replies.answer(tool.question({**given})(of_no_robot, call or Call()))
    except EpisodicError as error:
        answer = replies.error(error)
    return json.loads(answer.text)
