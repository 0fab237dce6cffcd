"""`ros2-memory ship`: ships the closed bags of many robots into a lake, for as long as it runs."""

import json
import math
import sys
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Final, NoReturn

import typer

from ros2_memory.bootstrap_lake import build_robots, lake_location
from ros2_memory.cli.options import (
    EXIT_NEGATIVE,
    AsJson,
    Overrides,
    Verbose,
    load_for,
    print_line,
)
from ros2_memory.config import Settings
from ros2_memory.core.errors import LakeError
from ros2_memory.core.logging_setup import configure_logging, get_logger
from ros2_memory.core.sd_notify import READY, WATCHDOG, notify
from ros2_memory.core.text import counted
from ros2_memory.core.timebase import WallClock

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.lake.shipper import RobotBags, Shipper
    from ros2_memory.lake.warehouse import LakeLocation

_STEP_S: Final = 5.0
"""How long it waits at a time: the service manager hears from it in between."""
_RETRY_S: Final = 60.0

log = get_logger(__name__)


def ship(
    overrides: Overrides = None,
    once: Annotated[bool, typer.Option("--once", help="Ship what is there, and end.")] = False,
    as_json: AsJson = False,
    verbose: Verbose = False,
) -> None:
    """Ship the closed bags of many robots into a lake of Apache Iceberg tables.

    Reads the bags of fleet.robots, writes below lake.warehouse, and goes on until it is stopped.
    It can be killed and started again at any time: each bag comes into the lake once. Needs
    ros2-memory[lake].
    """
    settings = load_for(None, overrides)
    location, robots = lake_location(settings), build_robots(settings)
    # The extra is there: `lake_location` has checked that.
    from ros2_memory.lake.lease import writing_alone  # noqa: PLC0415

    shown = settings.logging.level if verbose or not once else "warning"
    configure_logging(shown, settings.logging.format)
    pace = _Pace(settings.lake.commit_interval_s)
    with writing_alone(location.state_dir):
        if not once:
            _ship_on(settings, location, robots, pace)
        with _shipper(settings, location, robots, pace) as shipper:
            done = shipper.run()
    if as_json:
        print_line(
            json.dumps(
                {
                    "bags": done.bags,
                    "rows": done.rows,
                    "waiting": done.waiting,
                    "problems": done.problems,
                }
            )
        )
    else:
        rows = counted(done.rows, "row")
        waiting = f"; {counted(done.waiting, 'bag waits', 'bags wait')}" if done.waiting else ""
        print_line(f"shipped {counted(done.bags, 'bag')} ({rows}){waiting}")
        for problem in done.problems:
            print(f"note: {problem}", file=sys.stderr)
    if done.waiting or done.problems:
        raise typer.Exit(EXIT_NEGATIVE)


class _Pace:
    """Waits before a commit until enough time has passed since the one before."""

    def __init__(self, interval_s: float) -> None:
        self._interval_s = interval_s
        self._last_s = -math.inf

    def __call__(self) -> None:
        _wait(self._last_s + self._interval_s - time.monotonic())
        self._last_s = time.monotonic()


def _wait(seconds: float) -> None:
    """Waits, and notifies the service manager meanwhile."""
    until_s = time.monotonic() + seconds
    while (left_s := until_s - time.monotonic()) > 0:
        notify(WATCHDOG)
        time.sleep(min(left_s, _STEP_S))


@contextmanager
def _shipper(
    settings: Settings, location: "LakeLocation", robots: "Sequence[RobotBags]", pace: _Pace
) -> "Iterator[Shipper]":
    from ros2_memory.lake.shipper import Shipper  # noqa: PLC0415 - as in `ship`
    from ros2_memory.lake.tables import TABLES  # noqa: PLC0415

    with location.opened() as catalog:
        yield Shipper(
            location,
            location.tables(catalog, TABLES),
            robots,
            WallClock(),
            messages=settings.lake.messages,
            pause=pace,
            alive=lambda: notify(WATCHDOG),
        )


def _ship_on(
    settings: Settings, location: "LakeLocation", robots: "Sequence[RobotBags]", pace: _Pace
) -> NoReturn:
    """Ships until the process is stopped; a lake that fails is tried again."""
    notify(READY)
    log.info("shipping", robots=len(robots), warehouse=location.warehouse)
    known: list[str] = []
    while True:
        try:
            with _shipper(settings, location, robots, pace) as shipper:
                while True:
                    problems = shipper.run().problems
                    for problem in problems:
                        if problem not in known:
                            log.warning("not_shipped", reason=problem)
                    known = problems
                    _wait(settings.reader.index_refresh_s)
        except LakeError as error:
            log.warning("lake_failed", reason=str(error))
            _wait(_RETRY_S)
