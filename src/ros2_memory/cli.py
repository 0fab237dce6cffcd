"""`ros2-memory`: the program for people."""

from __future__ import annotations

import argparse
import signal
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ros2_memory.bootstrap import build_filler, build_memory
from ros2_memory.config import load_settings
from ros2_memory.demo.run import DemoOptions, run_demo
from ros2_memory.errors import ConfigError, EpisodicError
from ros2_memory.indexing import Bar, die_with, fill, orphaned, step_back
from ros2_memory.logs import configure_logging
from ros2_memory.recovery import recover

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from types import FrameType

_NOT_REPAIRED: Final = 1
_CANNOT_START: Final = 2
_INTERRUPTED: Final = 130


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line (`sys.argv` unless given) and returns the exit code.

    0: done and right; 1: an answer was wrong, or a bag could not be repaired; 2: it could not run,
    and stderr says why; 130: interrupted before it was done.
    """
    arguments = _parser().parse_args(argv)
    run = {"demo": _demo, "index": _index, "recover": _recover}[arguments.command]
    try:
        with _ended_like_ctrl_c(signal.SIGTERM, signal.SIGHUP):
            return run(arguments)
    except KeyboardInterrupt:
        return _INTERRUPTED
    except (EpisodicError, OSError) as error:
        print(f"ros2-memory {arguments.command}: {error}", file=sys.stderr)
        return _CANNOT_START


def _demo(arguments: argparse.Namespace) -> int:
    options = DemoOptions(
        once=arguments.once,
        port=arguments.port,
        bag_dir=arguments.bag_dir,
        duration_s=arguments.duration,
        verbose=arguments.verbose,
    )
    return run_demo(options, _say)


def _recover(arguments: argparse.Namespace) -> int:
    outcome = recover(arguments.path, _say, force=arguments.force)
    return _NOT_REPAIRED if outcome.failed else 0


def _index(arguments: argparse.Namespace) -> int:
    settings = load_settings(arguments.overrides)
    server: int | None = arguments.for_server
    serving = server is not None
    if server is not None and not die_with(server):
        return _CANNOT_START
    configure_logging(settings.logging.level if serving else "warning", settings.logging.format)
    memory = build_memory(settings)
    filler = build_filler(settings, memory)
    if serving:
        step_back()
    elif filler.in_memory:
        raise ConfigError(
            "no catalogue can be written, neither beside the bags nor in the cache folder: "
            "give XDG_CACHE_HOME a folder that can be"
        )
    fill(filler, None if serving else Bar(), orphaned() if serving else lambda: False)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="ros2-memory", description="A robot's episodic memory: tools for people."
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    demo = commands.add_parser(
        "demo",
        help="a simulated robot, its bags, the query server and a client that asks it questions",
        description="Runs the query server on the bags of a simulated robot, asks it questions, "
        "and holds every answer against what the robot did. Needs no ROS and no configuration.",
    )
    demo.add_argument(
        "--once",
        action="store_true",
        help="leave after the answers; the exit code is 1 if one was wrong",
    )
    demo.add_argument(
        "--port", type=int, default=9203, help="on 127.0.0.1; 0: any that is free (%(default)s)"
    )
    demo.add_argument(
        "--bag-dir",
        type=Path,
        metavar="DIR",
        help="a new or empty folder, kept (a temporary one, removed at the end)",
    )
    demo.add_argument(
        "--duration",
        type=float,
        default=120.0,
        metavar="S",
        help="seconds of history that exist when the questions are asked (%(default)s)",
    )
    demo.add_argument("--verbose", action="store_true", help="show the server's log on stderr")
    indexing = commands.add_parser(
        "index",
        help="look into every bag once, so that questions about a week take milliseconds",
        description="Fills the catalogue of the bags at once, with the settings of the server. The "
        "server does the same by itself, in the background; no answer depends on it.",
    )
    indexing.add_argument(
        "overrides", nargs="*", metavar="key=value", help="settings, as for ros2-memory-server"
    )
    indexing.add_argument("--for-server", type=int, metavar="PID", help=argparse.SUPPRESS)
    recovering = commands.add_parser(
        "recover",
        help="repair MCAP files that a crash, a full disk or a pulled plug left unfinished",
        description="Rewrites each unfinished MCAP file from all that can be read of it, in place: "
        "the original stays until the whole one has been read back and is on the disk. Files of 0 "
        "bytes are removed. The exit code is 1 if a file could not be repaired.",
    )
    recovering.add_argument(
        "path", type=Path, metavar="PATH", help="an MCAP file, or a directory of recordings"
    )
    recovering.add_argument(
        "--force",
        action="store_true",
        help="also files that changed in the last half minute; nothing must be writing them",
    )
    return parser


@contextmanager
def _ended_like_ctrl_c(*signals: signal.Signals) -> Iterator[None]:
    """Within the block each of these signals is a KeyboardInterrupt, so that all is closed."""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in signals}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _say(line: str) -> None:
    print(line, flush=True)


if __name__ == "__main__":
    sys.exit(main())
