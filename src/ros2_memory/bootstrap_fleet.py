"""The composition root of a fleet: a memory for each robot, from settings derived for it."""
# ruff: noqa: PLC0415 - a server of one robot loads nothing of this

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ros2_memory.bootstrap import build_memory, places_of, query_settings_of, shared_parts
from ros2_memory.config import NullRecorderNode
from ros2_memory.core.errors import ConfigError
from ros2_memory.core.timebase import WallClock

if TYPE_CHECKING:
    from ros2_memory.bootstrap import SharedParts
    from ros2_memory.config import Settings
    from ros2_memory.fleet.robots import Fleet
    from ros2_memory.history.context import Memory

ROBOTS_SETTING: Final = "fleet.robots"
"""The setting that names the bags of robots."""
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
    if settings.lake.engine != "none":
        from ros2_memory.bootstrap_lake import open_lake

        lake = open_lake(settings)
    robots = []
    for name, bag_dir in fleet.robots.items():
        own = robot_settings(settings, name)
        has_places = fleet.shared_map or own.data.places_file != settings.data.places_file
        if has_places:
            # Here, so that a file that is refused keeps the server from starting.
            places_of(own)
        build = partial(_memory_of, own, shared, has_places=has_places)
        source = None
        if lake is not None:
            from ros2_memory.lake.memory.robot import LakeRobot

            limits = query_settings_of(own)
            source = LakeRobot(
                lake,
                name,
                WallClock(),
                limits if has_places else replace(limits, places=()),
                shared.extractor,
                refresh_s=LAKE_REFRESH_S,
            )
        is_mounted = lake is None or bag_dir.is_dir()
        robots.append(Robot(name, bag_dir, build, lake=source, is_mounted=is_mounted))
    return Fleet(robots, WallClock(), shared_map=fleet.shared_map)


def robot_settings(settings: Settings, name: str) -> Settings:
    """Returns the settings of one robot of a fleet, as if a server had it alone."""
    fleet, data = settings.fleet, settings.data
    if fleet.places is not None:
        own = Path(fleet.places.replace("*", name))
        data = replace(data, places_file=own) if own.is_file() else data
    return replace(
        settings,
        recording=replace(settings.recording, bag_dir=fleet.robots[name]),
        data=data,
        fleet=replace(fleet, robots={}, tokens={}),
    )


def _memory_of(own: Settings, shared: SharedParts, *, has_places: bool) -> Memory:
    memory = build_memory(own, shared, setting=ROBOTS_SETTING)
    if has_places:
        return memory
    # `data.places_file` is about some other map.
    return replace(memory, limits=replace(memory.limits, places=()))


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
