"""Builds the tools of a deployment: those of the specification, and those beyond it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ros2_memory.tools import extra_tools, spec_tools

if TYPE_CHECKING:
    from ros2_memory.history.context import QuerySettings
    from ros2_memory.tools.declaration import Tool


def build_tools(
    settings: QuerySettings, *, additions: bool = True, writing: bool = False
) -> tuple[Tool, ...]:
    """Returns the tools, in order. Their descriptions name this deployment's defaults.

    Args:
        settings: the defaults.
        additions: whether the tools beyond the specification are there.
        writing: whether tools that write are there.
    """
    defaults = {
        "pose_topic": settings.pose_topic,
        "tolerance": f"{settings.time_tolerance_s:g}",
        "map_frame": settings.map_frame or "no map",
    }
    added = extra_tools.DECLARATIONS if additions else ()
    tools: list[Tool] = []
    for declaration in (*spec_tools.DECLARATIONS, *added):
        if writing or not declaration.writes:
            tools += declaration.tools(defaults, plain_times=not additions)
    return tuple(tools)


def readable_tools() -> tuple[Tool, ...]:
    """Returns the tools whose replies are read as resources alone."""
    tools: list[Tool] = []
    for declaration in extra_tools.READABLE:
        tools += declaration.tools({})
    return tuple(tools)
