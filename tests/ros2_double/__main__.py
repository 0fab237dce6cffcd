"""`ros2 bag record ...` and nothing else of `ros2`."""

from __future__ import annotations

import os
import sys
from importlib import import_module

from tests.ros2_double.arguments import Options, RefusedError, options
from tests.ros2_double.signals import Signals


def main(argv: list[str]) -> int:
    """Runs the command; the exit code is the real recorder's."""
    signals = Signals()
    if argv[:2] != ["bag", "record"]:
        return _refusal("this `ros2` is a test double: it knows `ros2 bag record` alone")
    try:
        _record(options(argv[2:]), signals)
    except RefusedError as error:
        return _refusal(str(error))
    return 0


def _record(wanted: Options, signals: Signals) -> None:
    recorder = import_module("tests.ros2_double.recorder")  # slow: the help needs none of it
    try:
        recorder.record(wanted, signals)
    except OSError as error:
        sys.stderr.write(f"terminate called after throwing an exception\n  what():  {error}\n")
        sys.stderr.flush()
        os.abort()


def _refusal(text: str) -> int:
    sys.stderr.write(f"[ERROR] [ros2bag]: {text}\n")
    return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
