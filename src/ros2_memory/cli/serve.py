"""`ros2-memory serve`: the query server, under the name of the package, as `uvx` looks for it."""

import os
import sys
from typing import Annotated

from ros2_memory.cli.options import BagDir, Words, settings_to_look
from ros2_memory.config_sources import quoted


def serve(
    words: Words = None,
    *,
    bag_dir: BagDir = None,
    no_open: Annotated[bool, "Open no browser; print the page's address only."] = False,
) -> None:
    """Answer questions over MCP, like ros2-memory-server.

    With a PATH over HTTP, and the page of the memory opens in the browser. Otherwise over stdio, or
    over HTTP with server.transport=sse. Stop it with Ctrl-C, or close stdin.
    """
    folder, settings = settings_to_look(bag_dir, words)
    options: list[str] = []
    if folder is not None:
        settings.append(f"recording.bag_dir={quoted(str(folder.absolute()))}")
        if bag_dir is None:  # a PATH
            options = ["--page", "print" if no_open else "open"]
            if "MCP_TRANSPORT" not in os.environ:
                settings.insert(0, "server.transport=sse")
    program = [sys.executable, "-P", "-m", "ros2_memory.server", *options, *settings]
    # In place of this process, whose signals and garbage collection are those of a short command.
    os.execv(sys.executable, program)  # noqa: S606 - there is nothing for a shell to do
