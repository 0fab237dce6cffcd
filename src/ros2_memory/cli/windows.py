"""The time window of a command: `--start`, `--end`, or `--last`."""

from datetime import datetime
from typing import Annotated

import typer

from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MAX_NS, MIN_NS, unix_from_ns
from ros2_memory.history.context import Memory
from ros2_memory.index.snapshot import Snapshot

Start = Annotated[
    str | None,
    typer.Option(metavar="TIME", help="From here on: Unix seconds, or ISO 8601 (local time)."),
]
End = Annotated[str | None, typer.Option(metavar="TIME", help="Up to here, inclusive; likewise.")]
Last = Annotated[
    float | None, typer.Option(metavar="S", help="The last seconds, instead of a start and an end.")
]


def window_of(
    memory: Memory, snapshot: Snapshot, start: str | None, end: str | None, last: float | None
) -> TimeWindow:
    """The window that was asked for; a side that was not given is open.

    Raises:
        InvalidArgumentsError: it is none.
    """
    if last is None:
        first = unix_from_ns(MIN_NS) if start is None else unix_of(start)
        return TimeWindow.from_unix(first, unix_from_ns(MAX_NS) if end is None else unix_of(end))
    if start is not None or end is not None:
        raise InvalidArgumentsError("give --last, or --start and --end, not both")
    if not last > 0:
        raise InvalidArgumentsError(f"--last is {last:g}; it must be more than 0 seconds")
    latest = snapshot.dating.latest
    wall = memory.limits.now == "wall" or latest is None
    now = unix_from_ns(memory.clock.now() if wall or latest is None else latest)
    return TimeWindow.from_unix(now - last, now)


def unix_of(text: str) -> float:
    """Unix seconds of a time as people write it.

    Raises:
        InvalidArgumentsError: it is none.
    """
    try:
        return float(text)
    except ValueError:
        pass
    try:
        return datetime.fromisoformat(text).astimezone().timestamp()
    except (ValueError, OverflowError, OSError):
        raise InvalidArgumentsError(
            f"{text!r} is no time; write Unix seconds (1795163910.5) or ISO 8601 "
            "(2026-11-20T08:30:00)"
        ) from None
