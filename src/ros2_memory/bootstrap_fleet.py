"""The composition root of many robots: a memory for each, the lake, and the bags as shipped."""

from __future__ import annotations

import atexit
import os
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, cast

import yaml

from ros2_memory.bootstrap import (
    SharedParts,
    build_backfill,
    build_columns,
    build_memory,
    instantiated,
    query_settings_of,
    reading_of,
    require_extra,
    shared_parts,
)
from ros2_memory.config import DuckdbNode, NullRecorderNode, Settings, is_robot_name
from ros2_memory.core.errors import ConfigError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.memo import Memo
from ros2_memory.core.timebase import WallClock

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from ros2_memory.fleet.robots import Fleet, Robot
    from ros2_memory.history.context import Memory
    from ros2_memory.lake.engine import Lake
    from ros2_memory.lake.shipper import RobotBags
    from ros2_memory.lake.warehouse import LakeLocation


# ruff: noqa: PLC0415 - the lake is an extra, and a server of one robot loads nothing of a fleet

log = get_logger(__name__)

ROBOTS_SETTING: Final = "fleet.robots"
"""The setting that names the bags of robots."""
_JOINED_AGAIN_S: Final = 5.0
"""Least time between two looks into the lake for an unknown robot that is asked for."""


def lake_location(settings: Settings) -> LakeLocation:
    """Returns where the lake is.

    Raises:
        ConfigError: no warehouse is given, its secrets cannot be read, or the extra is missing.
    """
    require_extra("a lake", "lake", "pyarrow", "pyiceberg")
    # Arrow's own allocator keeps freed memory; the system's returns it. Arrow reads this once, when
    # it is imported, which nothing has done yet.
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
    from ros2_memory.lake.warehouse import LakeLocation, location_of

    lake = settings.lake
    if lake.warehouse is None:
        raise ConfigError(
            "lake.warehouse: must name where the lake is, such as lake.warehouse=/srv/lake or "
            "lake.warehouse=s3://bucket/lake"
        )
    try:
        warehouse, state_dir = location_of(lake.warehouse, lake.state_dir)
    except ValueError as error:
        raise ConfigError(f"lake.warehouse: {error}") from error
    secrets = {} if lake.secrets_file is None else _secrets_of(lake.secrets_file)
    return LakeLocation(
        warehouse, state_dir, lake.catalog, lake.uri, dict(lake.properties), secrets
    )


def _secrets_of(path: Path) -> dict[str, str]:
    """Returns the names and texts in a file of secrets; no error shows any of them.

    Raises:
        ConfigError: it cannot be read, or has anything else.
    """
    try:
        given: object = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"lake.secrets_file: {path}: {error.strerror}") from None
    except (ValueError, yaml.YAMLError, RecursionError):
        given = None
    if not isinstance(given, dict) or not all(
        isinstance(text, str) for text in (*given, *given.values())
    ):
        raise ConfigError(
            f'lake.secrets_file: {path} must have lines like s3.access-key-id: "...", names and '
            "texts alone"
        )
    return given


def open_lake(settings: Settings, node: DuckdbNode) -> Lake:
    """Opens the lake of the settings with its engine, until this process ends.

    Raises:
        ConfigError: its place or an extra is missing.
        LakeError: it cannot be opened.
    """
    location = lake_location(settings)
    require_extra("lake: duckdb", "lake", "duckdb")
    closing = ExitStack()
    atexit.register(closing.close)
    catalog = closing.enter_context(location.opened())
    return cast("Lake", instantiated(node, catalog=catalog, translated=location.translated))


def build_fleet(settings: Settings) -> Fleet | None:
    """Returns the robots of `fleet.robots`, and those of the lake; None without `fleet.robots`.

    Their bags are only read. All robots share the reader and its caches.

    Raises:
        ConfigError: other settings are not those of a fleet, or a robot's places are refused.
        LakeError: there is to be a lake, and it cannot be opened.
    """
    if not settings.fleet.robots:
        return None
    from ros2_memory.fleet.robots import Fleet

    _require_only_reading(settings)
    shared = shared_parts(settings)
    engine = settings.lake.engine
    lake = None if engine is None else open_lake(settings, engine)
    robots = [_build_robot(settings, name, shared, lake) for name in settings.fleet.robots]
    join = None if lake is None else partial(_robots_of, lake, settings, shared)
    shared_map = settings.fleet.shared_map
    fleet = Fleet(robots, WallClock(), shared_map=shared_map, join=join, tables=lake)
    fleet.add_shipped()
    if lake is not None and not lake.days("bags"):
        log.warning(
            "lake_empty",
            warehouse=settings.lake.warehouse,
            reason="the lake has no bag: only the robots' own bags answer. Check lake.warehouse, "
            "unless ros2-memory ship has yet to write there",
        )
    return fleet


def _robots_of(
    lake: Lake, settings: Settings, shared: SharedParts, known: Collection[str]
) -> Iterator[Robot]:
    """Yields the robots of a lake that are not known yet."""
    lake.refresh(_JOINED_AGAIN_S)
    for name in lake.days("bags"):
        if name not in known and is_robot_name(name):
            yield _build_robot(settings, name, shared, lake)


def _build_robot(settings: Settings, name: str, shared: SharedParts, lake: Lake | None) -> Robot:
    """Returns a robot with bags in its own directory, in a lake, or both.

    Raises:
        ConfigError: the file of its places is refused.
    """
    from ros2_memory.fleet.joined import JoinedIndex
    from ros2_memory.fleet.robots import Robot

    own = robot_settings(settings, name)
    limits = query_settings_of(own)
    if not settings.fleet.shared_map and own.data.places_file == settings.data.places_file:
        # The robot has a map of its own, and `data.places_file` is about another one.
        limits = replace(limits, places=(), places_file="")
    hidden = hidden_topics(settings, name)
    memory = build_memory(own, shared, setting=ROBOTS_SETTING, hidden=hidden)
    memory = replace(memory, limits=limits)
    if lake is None:
        return Robot(name, memory)
    shipped = _shipped(memory, lake, own, name, shared)
    if name not in settings.fleet.robots:
        return Robot(name, shipped, in_lake=True)
    both = replace(shipped, index=JoinedIndex(shipped.index, memory.index, own.recording.bag_dir))
    return Robot(name, both, memory, in_lake=True)


def _shipped(memory: Memory, lake: Lake, own: Settings, name: str, shared: SharedParts) -> Memory:
    """Returns the memory of a robot's bags in a lake; its columns are in a store of their own."""
    from ros2_memory.columns.scanner import Scanner
    from ros2_memory.lake.memory import LakeIndex, LakeReader

    index = LakeIndex(lake, name, memory.bag_dir, memory.clock)
    reader = LakeReader(index, memory.reader, shared.large)
    store = build_columns(own, shared.reader, (f"{own.lake.warehouse} {name}",))
    reading = reading_of(own, shared.extractor.schemas)
    scanner = Scanner(store, index.bag_dir, reading, shared.large, shared.caches)
    return replace(memory, index=index, reader=reader, scanner=scanner, memo=Memo())


def robot_settings(settings: Settings, name: str) -> Settings:
    """Returns the settings of one robot of a fleet, as if a server had it alone.

    For a robot that only a lake knows, the bag directory is a path that cannot exist.
    """
    fleet, data = settings.fleet, settings.data
    bag_dir = fleet.robots.get(name, Path(os.devnull) / name)
    if fleet.places is not None:
        places_file = Path(fleet.places.replace("*", name))
        if os.path.isfile(places_file):
            data = replace(data, places_file=places_file)
    data = replace(data, pose_topic=fleet.pose_topics.get(name, data.pose_topic))
    return replace(
        settings,
        recording=replace(settings.recording, bag_dir=bag_dir),
        data=data,
        fleet=replace(fleet, robots={}, tokens={}),
    )


def hidden_topics(settings: Settings, name: str) -> tuple[str, ...]:
    """Returns the prefixes of topics of other robots in the same bags: `/NAME/`."""
    robots = settings.fleet.robots
    return tuple(
        f"/{other}/"
        for other, bag_dir in robots.items()
        if other != name and bag_dir == robots.get(name)
    )


def build_robots(settings: Settings, shared: SharedParts) -> list[RobotBags]:
    """Returns the robots of `fleet.robots` as they are shipped, all with `shared`.

    Raises:
        ConfigError: there are none, or their settings are refused.
    """
    # The extra is there: whoever ships has asked for `lake_location`.
    from ros2_memory.lake.shipper import RobotBags

    if not settings.fleet.robots:
        raise ConfigError(
            "fleet.robots: must name the robots whose bags are shipped: choose "
            "MEMORY_DEPLOYMENT=lake, and give fleet.robots={r1: /data/r1/bags, ...} or /data/*/bags"
        )

    robots: list[RobotBags] = []
    for name in settings.fleet.robots:
        own = robot_settings(settings, name)
        hidden = hidden_topics(settings, name)
        memory = build_memory(own, shared, setting=ROBOTS_SETTING, hidden=hidden)
        filling = build_backfill(own, memory).filling
        reading = reading_of(own, shared.extractor.schemas)
        robots.append(
            RobotBags(name, memory, shared.reader, reading, settings.lake.messages, filling)
        )
    return robots


def _require_only_reading(settings: Settings) -> None:
    """Refuses settings that make no sense for the bags of several robots.

    Raises:
        ConfigError: there is such a setting.
    """
    if not isinstance(settings.recorder, NullRecorderNode):
        raise ConfigError(
            "fleet.robots: a server of several robots records nothing; choose "
            "MEMORY_DEPLOYMENT=fleet, or recorder=none"
        )
    if settings.server.write_tools:
        raise ConfigError(
            "server.write_tools: true is not allowed with fleet.robots: nothing is written into "
            "the bags of a fleet"
        )
    if settings.data.recording is not None:
        raise ConfigError(
            f"data.recording: {settings.data.recording!r} is not allowed with fleet.robots, of "
            "which each has recordings of its own"
        )
