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
    from collections.abc import Iterator, Sequence

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
    settings = load_for(None, overrides)
    window = _window_to_forget(forget, times)
    share_one_arena()
    location, shared = lake_location(settings), shared_parts(settings)
    robots = build_robots(settings, shared)
    # The extra is there: `lake_location` has checked that.
    from ros2_memory.lake.warehouse import writing_alone  # noqa: PLC0415

    goes_on = not once and forget is None
    level = settings.logging.level if verbose or goes_on else "warning"
    configure_logging(level, settings.logging.format)
    with writing_alone(location.state_dir):
        service = _ShippingService(overrides, shared, settings, location, robots, goes_on)
        if goes_on:
            service.run()
        location.claim()
        if forget is not None and window is not None:
            return service.forget(forget, window, as_json=as_json)
        with service.open_shipper() as shipper:
            done = shipper.run()
            shipper.keep_up(service.grace)
    if as_json:
        keys = ("bags", "rows", "forgotten", "waiting", "problems")
        print_json({key: getattr(done, key) for key in keys})
    else:
        rows, bags = counted(done.rows, "row"), counted(done.bags, "bag")
        waiting = f"; {counted(done.waiting, 'bag waits', 'bags wait')}" if done.waiting else ""
        print_line(f"shipped {bags} ({rows}){waiting}")
        if done.forgotten:
            print_line(f"forgotten as on the robot: {counted(done.forgotten, 'bag')}")
        print_notes(done.problems)
    if done.forgotten:
        service.note_versions()
    return bool(done.waiting or done.problems)


def _window_to_forget(robot: str | None, times: Times) -> TimeWindow | None:
    """Returns the window to forget; None without --forget.

    Raises:
        InvalidArgumentsError: a robot or an end of the window is missing, or is no time.
    """
    if robot is None and times == Times():
        return None
    if robot is None or not times.are_bounded:
        raise InvalidArgumentsError(f"give --forget ROBOT and a time to forget: {BOUNDED}")
    return times.window_at(time.time())


def _wait(seconds: float) -> None:
    """Waits, and notifies the service manager meanwhile."""
    until_s = time.monotonic() + seconds
    while (left_s := until_s - time.monotonic()) > 0:
        notify(WATCHDOG)
        time.sleep(min(left_s, _STEP_S))


@dataclass
class _ShippingService:
    """Ships the bags of robots into a lake.

    Attributes:
        goes_on: whether it ships until it is stopped, and waits for more bags before a commit.
        committed_s: when it last began a commit, by the monotonic clock.
        kept_up_s: when it last tidied the lake, by the monotonic clock.
        reported: the problems of the last pass, which were logged.
    """

    overrides: Overrides
    shared: SharedParts
    settings: Settings
    location: "LakeLocation"
    robots: "Sequence[RobotBags]"
    goes_on: bool
    committed_s: float = -math.inf
    kept_up_s: float = -math.inf
    reported: "Sequence[str]" = ()

    @property
    def grace(self) -> Ns:
        """How long files stay that no table names."""
        return ns_from_unix(self.settings.lake.grace_h * 3600)

    @contextmanager
    def open_shipper(self) -> "Iterator[Shipper]":
        """Opens the lake, finishes what was begun to be forgotten, and yields a shipper."""
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
        """Waits until `lake.commit_interval_s` has passed since the last commit.

        Not before the commit of a full batch: more than a batch may come in that time. Nor in a
        single pass, for which no more bags come.
        """
        if self.goes_on and not is_full:
            _wait(self.committed_s + self.settings.lake.commit_interval_s - time.monotonic())
        self.committed_s = time.monotonic()
        self.location.claim()

    def forget(self, robot: str, window: TimeWindow, *, as_json: bool) -> bool:
        """Forgets a window of a robot in the lake, and prints what is gone.

        Returns whether something of it stays.

        Raises:
            InvalidArgumentsError: neither the lake nor the settings know the robot; nothing is
                done.
            LakeError: the lake cannot be read or written; the next start finishes it.
        """
        from ros2_memory.lake.upkeep import Tombstone, forget_in_lake  # noqa: PLC0415

        tombstone = Tombstone(robot, window.start, window.stop)
        with self.location.writable() as lake:
            names = {*lake.days("bags"), *(configured.name for configured in self.robots)}
            if robot not in names:
                raise InvalidArgumentsError(
                    f"there is no robot {abbreviate(robot)} in the lake or in fleet.robots; "
                    f"there are: {listed(sorted(names))}"
                )
            failures: list[str] = []
            for configured in self.robots:
                if configured.name == robot:
                    failures += configured.forget([window])
            gone = forget_in_lake(lake, tombstone)
        kept_by = [*gone.kept_by]
        if as_json:
            print_json({"bags": gone.bags, "files": gone.files, "kept_by": kept_by})
        else:
            bags = counted(gone.bags, "bag")
            print_line(f"{bags} of {robot} forgotten; {counted(gone.files, 'file')} deleted")
            print_notes([f"a branch or tag keeps an older version: {name}" for name in kept_by])
        print_notes(failures)
        self.note_versions()
        return bool(kept_by or failures)

    def note_versions(self) -> None:
        """Notes that a bucket may keep versions of objects that were deleted."""
        if not self.location.warehouse.startswith("file:"):
            print_notes(
                ["where the bucket keeps versions of deleted objects, those are not erased"]
            )

    def run(self) -> NoReturn:
        """Ships until the process is stopped; a lake that fails is tried again."""
        notify(READY)
        log.info("shipping", robots=len(self.robots), warehouse=self.location.warehouse)
        while True:
            try:
                self.location.claim()
                with self.open_shipper() as shipper:
                    new = self._ship_until_new(shipper)
                    self.robots = [*self.robots, *new]
            except LakeError as error:
                log.warning("lake_failed", reason=str(error))
                _wait(_RETRY_S)

    def _ship_until_new(self, shipper: "Shipper") -> "Sequence[RobotBags]":
        """Ships, and once an hour tidies the lake, until there are new robots; returns these."""
        while True:
            problems = shipper.run().problems
            is_due = time.monotonic() - self.kept_up_s >= _UPKEEP_S
            if is_due:
                self.location.claim()
                shipper.keep_up(self.grace)
                self.kept_up_s = time.monotonic()
            for problem in problems:
                if problem not in self.reported:
                    log.warning("not_shipped", reason=problem)
            self.reported = problems
            if is_due and (new := self._new_robots()):
                return new
            _wait(self.settings.reader.index_refresh_s)

    def _new_robots(self) -> "Sequence[RobotBags]":
        """Loads the settings again, and returns the robots that are not shipped yet.

        `fleet.robots` may be a pattern, which matches more folders than before.
        """
        try:
            settings = load_for(None, self.overrides)
            fleet, names = settings.fleet, {robot.name for robot in self.robots}
            new = {name: bags for name, bags in fleet.robots.items() if name not in names}
            if not new:
                return []
            built = build_robots(replace(settings, fleet=replace(fleet, robots=new)), self.shared)
        except ConfigError as error:
            log.warning("not_shipped", reason=f"robots that are new are not looked for: {error}")
            return []
        total = len(self.robots) + len(built)
        log.info("shipping", robots=total, warehouse=settings.lake.warehouse)
        return built
