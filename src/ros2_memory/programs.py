"""Where the programs begin: Ctrl-C while one imports its modules ends it without a traceback.

Each finds stdin, stdout and stderr open, also where its caller has closed them.
"""

import os
import signal
import sys
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
    _open_closed_streams()
    # Where the caller ignores it the system reaps children, and their exit codes are lost.
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    # In background jobs of a shell the signal is ignored, and stays so.
    is_ours = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if is_ours:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    main = cast("Callable[[], int]", getattr(import_module(module), name))
    if is_ours:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    return main


def _open_closed_streams() -> None:
    """Opens /dev/null as stdin, stdout and stderr where these are closed, as by `2>&-`.

    Python has None in their place, and the next file that is opened would get their number.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.open(os.devnull, os.O_RDWR), mode))  # noqa: PTH123, SIM115
