"""`ros2-memory ship`: ships the closed bags of many robots into a lake, for as long as it runs."""

import math
import time
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, Final, NoReturn

from ros2_memory.bootstrap import SharedParts, shared_parts
from ros2_memory.bootstrap_fleet import build_robots, lake_location
from ros2_memory.cli.options import BOUNDED, AsJson, Overrides, Times, Verbose, load_for
from ros2_memory.cli.output import print_json, print_line, print_notes
from ros2_memory.config import Settings
from ros2_memory.core.errors import ConfigError, InvalidArgumentsError, LakeError
from ros2_memory.core.logging_setup import configure_logging, get_logger
from ros2_memory.core.malloc import share_one_arena
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.sd_notify import READY, WATCHDOG, notify
from ros2_memory.core.text import abbreviate, counted, listed
from ros2_memory.core.timebase import Ns, WallClock, ns_from_unix

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from ros2_memory.lake.shipper import RobotBags, Shipper
    from ros2_memory.lake.warehouse import LakeLocation

_STEP_S: Final = 5.0
"""How long it waits at a time: the service manager hears from it in between."""
_RETRY_S: Final = 60.0
_UPKEEP_S: Final = 3600.0
"""How often days are put together, and old files deleted."""

log = get_logger(__name__)


def ship(
    overrides: Overrides = None,
    *,
    once: Annotated[bool, "Ship what is there, and end."] = False,
    forget: Annotated[
        str | None, "ROBOT", "Forget a time of a robot, from --start to --end or --last, and end."
    ] = None,
    times: Times,
    as_json: AsJson = False,
    verbose: Verbose = False,
) -> bool:
    """Ship the closed bags of many robots into a lake of Apache Iceberg tables.

    Reads the bags of fleet.robots, writes below lake.warehouse, and goes on until it is stopped.
    It can be killed and started again at any time: each bag comes into the lake once. Needs
    ros2-memory[lake].
    """
    settings, _ = load_for(None, overrides)
    window = _window_of(forget, times)
    share_one_arena()
    location, shared = lake_location(settings), shared_parts(settings)
    robots = build_robots(settings, shared)
    # The extra is there: `lake_location` has checked that.
    from ros2_memory.lake.warehouse import writing_alone  # noqa: PLC0415

    shown = settings.logging.level if verbose or not (once or forget) else "warning"
    configure_logging(shown, settings.logging.format)
    with writing_alone(location.state_dir):
        shipping = _Shipping(settings, location, robots)
        if forget is None and not once:
            shipping.go_on(partial(_new_robots, overrides, shared))
        location.claim()
        if forget is not None and window is not None:
            return _forget(location, forget, window, robots, as_json=as_json)
        with shipping.shipper() as shipper:
            done = shipper.run()
            shipper.keep_up(shipping.grace)
    rows, bags = counted(done.rows, "row"), counted(done.bags, "bag")
    waiting = f"; {counted(done.waiting, 'bag waits', 'bags wait')}" if done.waiting else ""
    keys = ("bags", "rows", "forgotten", "waiting", "problems")
    if as_json:
        print_json({key: getattr(done, key) for key in keys})
    else:
        print_line(f"shipped {bags} ({rows}){waiting}")
        if done.forgotten:
            print_line(f"forgotten as on the robot: {counted(done.forgotten, 'bag')}")
        print_notes(done.problems)
    if done.forgotten:
        _note_versions(location)
    return bool(done.waiting or done.problems)


def _window_of(robot: str | None, times: Times) -> TimeWindow | None:
    """Returns the time to forget, if any.

    Raises:
        InvalidArgumentsError: a part of it is missing, or is no time.
    """
    if robot is None and times == Times():
        return None
    if robot is None or not times.are_bounded:
        raise InvalidArgumentsError(f"give --forget ROBOT and a time to forget: {BOUNDED}")
    return times.window_at(time.time())


def _forget(
    location: "LakeLocation",
    robot: str,
    window: TimeWindow,
    robots: "Sequence[RobotBags]",
    *,
    as_json: bool,
) -> bool:
    """Forgets a time of a robot in the lake, and prints what is gone.

    Raises:
        InvalidArgumentsError: neither the lake nor the settings know the robot; nothing is done.
        LakeError: the lake cannot be read or written; the next start finishes it.
    """
    from ros2_memory.lake.upkeep import Tombstone, append_tombstone, forget_in_lake  # noqa: PLC0415

    tombstone = Tombstone(robot, window.start, window.stop)
    with location.writable() as lake:
        names = {*lake.days("bags"), *(configured.name for configured in robots)}
        if robot not in names:
            raise InvalidArgumentsError(
                f"there is no robot {abbreviate(robot)} in the lake or in fleet.robots; there are: "
                f"{listed(sorted(names))}"
            )
        of_robot = (configured for configured in robots if configured.name == robot)
        stored = [why for configured in of_robot for why in configured.forget([window])]
        append_tombstone(location.state_dir, tombstone, done=False)
        gone = forget_in_lake(lake, tombstone)
    kept_by = [*gone.kept_by]
    if as_json:
        print_json({"bags": gone.bags, "files": gone.files, "kept_by": kept_by})
    else:
        bags = counted(gone.bags, "bag")
        print_line(f"{bags} of {robot} forgotten; {counted(gone.files, 'file')} deleted")
        print_notes([f"a branch or tag keeps an older version: {name}" for name in kept_by])
    print_notes(stored)
    _note_versions(location)
    return bool(kept_by or stored)


def _note_versions(location: "LakeLocation") -> None:
    """Prints, after something was forgotten, what a bucket may still have of it."""
    if not location.warehouse.startswith("file:"):
        print_notes(["where the bucket keeps versions of deleted objects, those are not erased"])


def _wait(seconds: float) -> None:
    """Waits, and notifies the service manager meanwhile."""
    until_s = time.monotonic() + seconds
    while (left_s := until_s - time.monotonic()) > 0:
        notify(WATCHDOG)
        time.sleep(min(left_s, _STEP_S))


@dataclass
class _Shipping:
    """What ships the bags of robots.

    `committed_s` is when it last began a commit, by the monotonic clock.
    """

    settings: Settings
    location: "LakeLocation"
    robots: "Sequence[RobotBags]"
    committed_s: float = -math.inf

    @property
    def grace(self) -> Ns:
        """How long files that no table names stay."""
        return ns_from_unix(self.settings.lake.grace_h * 3600)

    @contextmanager
    def shipper(self) -> "Iterator[Shipper]":
        """Yields what ships, after what was forgotten is gone."""
        from ros2_memory.lake.shipper import Shipper  # noqa: PLC0415
        from ros2_memory.lake.upkeep import forget_in_lake, read_tombstones  # noqa: PLC0415

        with self.location.writable() as lake:
            tombstones = read_tombstones(self.location.state_dir)
            for tombstone in tombstones:
                if not tombstone.done:
                    forget_in_lake(lake, tombstone)
            yield Shipper(
                lake,
                self.robots,
                WallClock(),
                tombstones={*tombstones},
                before_commit=self._before_commit,
                alive=partial(notify, WATCHDOG),
            )

    def _before_commit(self, is_full: bool) -> None:
        """Waits until enough time has passed since the last commit, but with no full batch.

        More than a batch may come in that time: to wait with each would never keep up.
        """
        if not is_full:
            _wait(self.committed_s + self.settings.lake.commit_interval_s - time.monotonic())
        self.committed_s = time.monotonic()
        self.location.claim()

    def go_on(self, new_robots: "Callable[[Sequence[RobotBags]], Sequence[RobotBags]]") -> NoReturn:
        """Ships until the process is stopped; a lake that fails is tried again.

        `new_robots` returns those that are in the settings now, besides the ones that it is given.
        """
        notify(READY)
        log.info("shipping", robots=len(self.robots), warehouse=self.location.warehouse)
        reported: list[str] = []
        kept_up_s = -math.inf
        while True:
            try:
                self.location.claim()
                with self.shipper() as shipper:
                    new: Sequence[RobotBags] = ()
                    while not new:
                        problems = shipper.run().problems
                        is_due = time.monotonic() - kept_up_s >= _UPKEEP_S
                        if is_due:
                            self.location.claim()
                            shipper.keep_up(self.grace)
                            kept_up_s = time.monotonic()
                        for problem in problems:
                            if problem not in reported:
                                log.warning("not_shipped", reason=problem)
                        reported = problems
                        if is_due:
                            new = new_robots(self.robots)
                        if not new:
                            _wait(self.settings.reader.index_refresh_s)
                    self.robots = [*self.robots, *new]
            except LakeError as error:
                log.warning("lake_failed", reason=str(error))
                _wait(_RETRY_S)


def _new_robots(
    overrides: Overrides, shared: "SharedParts", robots: "Sequence[RobotBags]"
) -> "Sequence[RobotBags]":
    """Returns the robots of the settings that were not there before: a pattern may match more."""
    try:
        settings, _ = load_for(None, overrides)
        names = {robot.name for robot in robots}
        new = {name: bags for name, bags in settings.fleet.robots.items() if name not in names}
        if not new:
            return []
        built = build_robots(replace(settings, fleet=replace(settings.fleet, robots=new)), shared)
    except ConfigError as error:
        log.warning("not_shipped", reason=f"robots that are new are not looked for: {error}")
        return []
    log.info("shipping", robots=len(robots) + len(built), warehouse=settings.lake.warehouse)
    return built
