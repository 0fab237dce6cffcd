"""The tools of a deployment: those of the specification, and those beyond it."""

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

    `additions`: also those beyond the specification; `writing`: also those of them that write.
    """
    defaults = {
        "pose_topic": settings.pose_topic,
        "tolerance": f"{settings.time_tolerance_s:g}",
        "map_frame": settings.map_frame or "no map",
    }
    added = extra_tools.DECLARATIONS if additions else ()
    return tuple(
        tool
        for declaration in (*spec_tools.DECLARATIONS, *added)
        if writing or not declaration.writes
        for tool in declaration.tools(defaults, plain_times=not additions)
    )


def readable_tools(settings: QuerySettings) -> tuple[Tool, ...]:
    """Returns what is read as a resource, and is not a tool."""
    return tuple(
        tool
        for declaration in extra_tools.READABLE
        for tool in declaration.tools({"pose_topic": settings.pose_topic})
    )
