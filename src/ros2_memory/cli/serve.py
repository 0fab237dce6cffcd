"""`ros2-memory serve`: the query server, under the name of the package, as `uvx` looks for it."""

import os
import sys

from ros2_memory.cli.options import BagDir, Overrides
from ros2_memory.config_sources import quoted


def serve(overrides: Overrides = None, bag_dir: BagDir = None) -> None:
    """Answer questions over MCP, like ros2-memory-server.

    Over stdio, or over HTTP with server.transport=sse. Stop it with Ctrl-C, or close stdin.
    """
    chosen = [] if bag_dir is None else [f"recording.bag_dir={quoted(str(bag_dir.absolute()))}"]
    program = [sys.executable, "-m", "ros2_memory.server", *(overrides or ()), *chosen]
    # In place of this process, whose signals and garbage collection are those of a short command.
    os.execv(sys.executable, program)  # noqa: S606 - there is nothing for a shell to do
