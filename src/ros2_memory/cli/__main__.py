"""`python -m ros2_memory.cli`, and `ros2-memory`."""

import gc
import os
import sys
from contextlib import suppress

from ros2_memory.cli.app import main


def run() -> int:
    """Runs `main` in a process of its own, and returns the exit code.

    Most of what a command allocates are modules and classes, which live as long as the process.
    Looking for garbage among them takes a quarter of the processor time of a short command (0.71 s
    instead of 0.99 s for `info`), so it is looked for seldom, and at the exit not at all: the
    system takes back the memory.
    """
    gc.set_threshold(100_000)
    # Or pydantic reads the metadata of every installed package in search of plugins.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    try:
        return _run_until_written()
    finally:
        # DuckDB's binding would print a page about leaks.
        if "duckdb" not in sys.modules:
            gc.freeze()


def _run_until_written() -> int:
    """Runs `main`, and writes what it printed; returns the exit code.

    Python would exit with 120 where stdout or stderr is on a full disk, or a pipe that is closed.
    """
    code, failure = 0, None
    try:
        code = main()
    except OSError as error:  # of a page of help, or of the line that says what is wrong
        failure = error
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError as error:
            failure = error
            # Or Python would write once more when it exits.
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    if code or failure is None:
        return code
    # Imported here, so that `--help` does not wait for the configuration.
    from ros2_memory.cli.options import EXIT_CANNOT_RUN, EXIT_NEGATIVE  # noqa: PLC0415

    if isinstance(failure, BrokenPipeError):
        return EXIT_NEGATIVE
    with suppress(OSError):
        print(f"ros2-memory: {failure.strerror}", file=sys.stderr)
    return EXIT_CANNOT_RUN


if __name__ == "__main__":
    sys.exit(run())
