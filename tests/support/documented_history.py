"""The fixed history that the documentation uses, and the parts of pages that are made of code.

a drive of one minute, from 08:00:00 UTC on 20 November 2026, in six splits of 10 s:
  0 to 20 s   along x at 0.5 m/s, to (10, 0)
  20 to 40 s  there, with scissors in view
  40 to 60 s  along y at 0.5 m/s, to (10, 10)
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import anyio

from ros2_memory.bag_dir.heartbeat import HEARTBEAT_FILE
from ros2_memory.bag_dir.layout import MOMENT_FILE
from ros2_memory.bag_dir.moment_file import SavedMoment, SaveRequest, write_saved_moment
from ros2_memory.bootstrap import build_server, query_settings_of
from ros2_memory.config import load_settings
from ros2_memory.core.timebase import NS_PER_S
from tests.support.bags import (
    McapLayout,
    Msg,
    detections,
    odom,
    set_mtime,
    text,
    tf,
    tf_of,
    transform,
    write_mcap,
)
from tests.support.clocks import SettableClock
from tests.support.heartbeats import beat
from tests.support.housekeepers import recorder_at_work
from tests.support.memories import clause, memory_of

START_S = 1_795_161_600
RECORDING = "rec_20261120T080000Z"
NOW = (START_S + 64) * NS_PER_S
LATCHED = frozenset({"/tf_static"})
CALLS: dict[str, dict[str, object]] = {
    "list_recorded_topics": {"pattern": "/vision/*"},
    "data_time_range": {},
    "get_topic_at_time": {"topic": "/vision/scene/scene_objects", "timestamp": START_S + 30.0},
    "get_topic_seconds_ago": {
        "topic": "/vision/scene/scene_objects",
        "seconds_ago": 20,
        "tolerance_s": 2,
    },
    "get_topic_in_range": {
        "topic": "/odom",
        "start": START_S,
        "end": START_S + 20,
        "max_samples": 2,
        "fields": ["position.x"],
    },
    "get_topic_in_last": {"topic": "/vision/scene/scene_objects", "seconds": 30, "max_samples": 2},
    "get_position_at": {"timestamp": START_S + 10},
    "get_position_seconds_ago": {"seconds_ago": 10},
    "get_velocity_at": {"timestamp": START_S + 10},
    "get_velocity_seconds_ago": {"seconds_ago": 10},
    "get_transform_at": {"parent": "map", "child": "camera", "timestamp": START_S + 10},
    "get_transform_seconds_ago": {"parent": "map", "child": "camera", "seconds_ago": 10},
    "list_frames": {},
    "find_last_match": clause("/vision/*/scene_objects", "contains", "scissors"),
    "get_value_when": {
        "value_topic": "/odom",
        "condition_topic": "/vision/scene/scene_objects",
        "condition_type": "contains",
        "value": "scissors",
        "fields": ["pose.pose.position"],
    },
    "trajectory_summary": {"start": START_S, "end": START_S + 60},
    "recent_trajectory_summary": {"seconds": 30},
    "find_matches": clause("/vision/scene/scene_objects", "contains", "scissors", seconds=64),
    "find_things": {"label": "scissors"},
    "compare": {
        "start": START_S + 30,
        "end": START_S + 60,
        "with_start": START_S,
        "with_end": START_S + 30,
    },
    "recap": {"last_s": 30},
    "visits": {"x": 11, "y": 2, "radius_m": 1},
    "memory_status": {},
    "remember_moment": {"label": "scissors found", "seconds_before": 30},
}
"""A call of every tool."""
MISTAKES: dict[str, tuple[str, dict[str, object]]] = {
    "unknown": ("get_topic_at_time", {"topic": "/odm", "timestamp": START_S + 30}),
}
"""Calls without an answer, by what is wrong with them."""


def messages() -> Iterator[Msg]:
    """All that the robot published, in order."""
    yield tf(
        START_S * NS_PER_S,
        transform(START_S * NS_PER_S, "map", "odom", (1.0, 2.0, 0.0)),
        transform(START_S * NS_PER_S, "base_link", "camera", (0.25, 0.0, 1.0)),
        topic="/tf_static",
    )
    for tenth in range(600):
        at = START_S * NS_PER_S + tenth * NS_PER_S // 10
        along = min(tenth, 200) / 20
        across = max(tenth - 400, 0) / 20
        yaw = math.pi / 2 if tenth >= 400 else 0.0
        yield odom(at, along, across, yaw, vx=0.0 if 200 <= tenth < 400 else 0.5)
        yield tf_of(at, "odom", "base_link", (along, across, 0.0), yaw)
        if tenth % 20 == 0:
            seen = "cup, scissors" if 220 <= tenth < 390 else "table"
            yield text(at, seen, "/vision/scene/scene_objects")
        if 220 <= tenth < 390 and tenth % 20 == 0:
            yield detections(at, ["scissors"], topic="/vision/find_object/detections_meta")


def write_history(bag_dir: Path) -> Path:
    """Writes the six bags, dated as their recorder would have left them."""
    every = list(messages())
    for split in range(6):
        first = (START_S + 10 * split) * NS_PER_S
        path = bag_dir / RECORDING / f"{RECORDING}_{split}.mcap"
        part = [each for each in every if first <= each.log_time < first + 10 * NS_PER_S]
        write_mcap(path, part, McapLayout(latched=LATCHED))
        set_mtime(path, first + 10 * NS_PER_S)
    return bag_dir


def replies(bag_dir: Path) -> dict[str, str]:
    """The replies to `CALLS` and `MISTAKES`, asked `NOW`; the moment is kept before the status."""
    clock = SettableClock(NOW)
    settings = load_settings([f"recording.bag_dir={bag_dir}"], env={"MEMORY_DEPLOYMENT": "robot"})
    memory = memory_of(bag_dir, clock=clock, limits=query_settings_of(settings))
    server = build_server(settings, memory)
    told = {}
    heartbeat(bag_dir, NOW)
    with recorder_at_work(bag_dir, clock):
        for name in sorted(CALLS, key=lambda name: name == "memory_status"):
            told[name] = anyio.run(server.dispatcher.answer, name, CALLS[name]).text
        for name, (tool, given) in MISTAKES.items():
            told[name] = anyio.run(server.dispatcher.answer, tool, given).text
    server.dispatcher.stop()
    return told


def shown_files(bag_dir: Path) -> dict[str, str]:
    """The recorder's own files of that history, by name."""
    heartbeat(bag_dir, NOW)
    start = (START_S + 34) * NS_PER_S
    request = SaveRequest("5f0c" * 8, "scissors found", start, NOW, NOW)
    write_saved_moment(bag_dir, SavedMoment(request, pending=False))
    names = (HEARTBEAT_FILE, MOMENT_FILE)
    return {name: (bag_dir / name).read_text() for name in names}


def heartbeat(bag_dir: Path, now: int, **more: Any) -> None:
    """Writes what the recorder says at some time of that history."""
    beat(
        bag_dir,
        now,
        pid=4711,
        recordings=(RECORDING,),
        since=START_S * NS_PER_S,
        bytes_written=1_000_000,
        subscribed=("/odom", "/tf", "/tf_static"),
        **more,
    )
