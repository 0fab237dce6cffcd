"""The composition root of a fleet: a memory for each robot, from settings derived for it."""
# ruff: noqa: PLC0415 - a server of one robot loads nothing of this

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ros2_memory.bootstrap import (
    build_columns_of_lake,
    build_memory,
    query_settings_of,
    reading_of,
    shared_parts,
)
from ros2_memory.config import NullRecorderNode, is_robot_name
from ros2_memory.core.errors import ConfigError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.timebase import WallClock

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from ros2_memory.bootstrap import SharedParts
    from ros2_memory.config import Settings
    from ros2_memory.fleet.robots import Fleet, Robot
    from ros2_memory.history.context import Memory, QuerySettings
    from ros2_memory.lake.files import Lake
    from ros2_memory.lake.memory.robot import LakeRobot

log = get_logger(__name__)

ROBOTS_SETTING: Final = "fleet.robots"
"""The setting that names the bags of robots."""
_JOINED_AGAIN_S: Final = 5.0
"""Least time between two looks into the lake for a robot that is asked for and not known."""
LAKE_REFRESH_S: Final = 60.0
"""How old what is known of a lake may be: at most one commit of a table is made in this time."""


def build_fleet(settings: Settings) -> Fleet | None:
    """Returns the robots of `fleet.robots`, whose bags are only read; None if there are none.

    A robot's memory is built when it is first asked; what reads and decodes bags is shared.

    Raises:
        ConfigError: other settings are not those of a fleet, or a robot's places are refused.
        LakeError: there is to be a lake, and it cannot be opened.
    """
    fleet = settings.fleet
    if not fleet.robots:
        return None
    from ros2_memory.fleet.robots import Fleet, Robot

    _require_only_reading(settings)
    shared = shared_parts(settings)
    lake = None
    if settings.lake.engine is not None:
        from ros2_memory.bootstrap_lake import open_lake

        lake = open_lake(settings, settings.lake.engine)
    robots = []
    for name, bag_dir in fleet.robots.items():
        own = robot_settings(settings, name)
        # Here, so that a file of places that is refused keeps the server from starting.
        limits = _limits_of(settings, own)
        build = partial(_memory_of, own, shared, limits)
        source = None if lake is None else _source_of(lake, name, own, shared, limits)
        is_mounted = lake is None or bag_dir.is_dir()
        robots.append(Robot(name, bag_dir, build, lake=source, is_mounted=is_mounted))
    join = None if lake is None else partial(_only_in, lake, settings, shared)
    found = Fleet(robots, WallClock(), shared_map=fleet.shared_map, join=join)
    found.joined()
    if lake is not None and not lake.robots():
        log.warning(
            "lake_empty",
            warehouse=settings.lake.warehouse,
            reason="the lake has no bag: only the robots' own bags answer. Check lake.warehouse, "
            "unless ros2-memory ship has yet to write there",
        )
    return found


def _only_in(
    lake: Lake, settings: Settings, shared: SharedParts, known: Collection[str]
) -> Iterator[Robot]:
    """Yields the robots of a lake besides the known ones."""
    from ros2_memory.fleet.robots import Robot

    lake.refresh(_JOINED_AGAIN_S)
    for name in lake.robots():
        if name in known or not is_robot_name(name):
            continue
        own = robot_settings(settings, name)
        source = _source_of(lake, name, own, shared, _limits_of(settings, own))
        yield Robot(name, Path(name), partial(_lake_of, source), lake=source, is_mounted=False)


def _limits_of(settings: Settings, own: Settings) -> QuerySettings:
    """Returns the settings of queries to a robot; with named places only if they are of its map.

    Raises:
        ConfigError: their file is refused.
    """
    limits = query_settings_of(own)
    if settings.fleet.shared_map or own.data.places_file != settings.data.places_file:
        return limits
    # `data.places_file` is about some other map.
    return replace(limits, places=(), places_file="")


def _source_of(
    lake: Lake, name: str, own: Settings, shared: SharedParts, limits: QuerySettings
) -> LakeRobot:
    """Returns what a lake has of a robot."""
    from ros2_memory.lake.memory.robot import LakeRobot

    return LakeRobot(
        lake,
        name,
        WallClock(),
        limits,
        extractor=shared.extractor,
        decoder=shared.reader,
        large=shared.large,
        store=build_columns_of_lake(own, name, shared.reader),
        settings=reading_of(own, shared.schemas),
        refresh_s=LAKE_REFRESH_S,
    )


def _lake_of(source: LakeRobot) -> Memory:
    return source.memory


def robot_settings(settings: Settings, name: str) -> Settings:
    """Returns the settings of one robot of a fleet, as if a server had it alone.

    Of a robot that only a lake knows they name no bag directory of its own.
    """
    fleet, data = settings.fleet, settings.data
    bag_dir = fleet.robots.get(name, settings.recording.bag_dir)
    if fleet.places is not None:
        own = Path(fleet.places.replace("*", name))
        data = replace(data, places_file=own) if own.is_file() else data
    return replace(
        settings,
        recording=replace(settings.recording, bag_dir=bag_dir),
        data=data,
        fleet=replace(fleet, robots={}, tokens={}),
    )


def _memory_of(own: Settings, shared: SharedParts, limits: QuerySettings) -> Memory:
    return replace(build_memory(own, shared, setting=ROBOTS_SETTING), limits=limits)


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
