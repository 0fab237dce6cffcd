"""Where the programs begin: Ctrl-C while one imports its modules ends it without a traceback."""

import signal
from collections.abc import Callable
from importlib import import_module
from typing import cast


def memory() -> int:
    """Runs `ros2-memory`, and returns the exit code."""
    return _load("ros2_memory.cli.__main__", "run")()


def recorder() -> int:
    """Runs `ros2-memory-recorder`, and returns the exit code."""
    return _load("ros2_memory.recorder.__main__", "main")()


def server() -> int:
    """Runs `ros2-memory-server`, and returns the exit code."""
    return _load("ros2_memory.server", "main")()


def _load(module: str, name: str) -> Callable[[], int]:
    """Imports the main function of a program; Ctrl-C meanwhile ends the process by its signal."""
    # In background jobs of a shell the signal is ignored, and stays so.
    is_ours = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if is_ours:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    main = cast("Callable[[], int]", getattr(import_module(module), name))
    if is_ours:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    return main
