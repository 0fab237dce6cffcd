"""Builds the MCP server: `bootstrap`, and what speaks the protocol.

Apart from it, so that a program that asks in process does without the libraries of a server.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ros2_memory import package_version
from ros2_memory.bootstrap import build_dispatcher
from ros2_memory.core.telemetry import SILENT
from ros2_memory.serving.mcp_server import EpisodicServer
from ros2_memory.tools.instructions import instructions

if TYPE_CHECKING:
    from ros2_memory.config import Settings
    from ros2_memory.core.telemetry import Telemetry
    from ros2_memory.history.context import Memory


def build_server(
    settings: Settings, memory: Memory, telemetry: Telemetry = SILENT
) -> EpisodicServer:
    """The MCP server that answers from a memory."""
    served = settings.server
    dispatcher = build_dispatcher(settings, memory, telemetry)
    return EpisodicServer(
        dispatcher,
        dispatcher.tools,
        name=served.name,
        version=package_version(),
        instructions=instructions(memory.limits, additions=served.tools == "all"),
    )
