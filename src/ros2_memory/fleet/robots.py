"""The robots of a fleet, each with a memory of its own, and one question to many of them."""

from __future__ import annotations

import contextvars
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol, TypeVar

from ros2_memory.core.errors import (
    BusyError,
    EpisodicError,
    InvalidArgumentsError,
    LakeError,
    NoDataError,
    NoDataReason,
    NotInLakeError,
    QueryTimeoutError,
    RefusedError,
)
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.model import Selected, TimeWindow
from ros2_memory.core.text import abbreviate, listed
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S, Clock, Ns
from ros2_memory.history.context import Call, Memory, Stages

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.core.timebase import Deadline

T = TypeVar("T")

_MOST_NAMED: Final = 50
AT_ONCE: Final = 4
"""Robots that are asked at once: most of it is Python, which runs one thread at a time."""
_OF_ONE: Final = 0.4
"""The part of the time of a call that one robot of several may take."""
_OF_ALL: Final = 0.9
"""The part that all may take together, or one alone; the rest is for merging the answers."""
_UNKNOWN: Final = (NoDataReason.TOPIC_NOT_RECORDED, NoDataReason.EMPTY_MEMORY)
_GRACE: Final = 0.05
"""How much later than its limit a robot counts as stuck: a disk that hangs heeds no limit."""

log = get_logger(__name__)


@dataclass(frozen=True, slots=True)
class StoppedClock(Clock):
    """The time at which a question was asked, so that it is one question to all robots."""

    at: Ns

    def now(self) -> Ns:
        """Returns that time."""
        return self.at


class FromLake(NamedTuple):
    """What a reply has to report of an answer from a lake.

    Attributes:
        latest: the log time of the newest message that was shipped; None if there is none.
        older: up to which log time (inclusive) there is more, which was not looked at; None if not.
    """

    latest: Ns | None
    older: Ns | None = None

    def since(self, begin: Ns) -> FromLake:
        """Returns the report for an answer that needs nothing before a log time."""
        is_whole = self.older is None or begin > self.older
        return self._replace(older=None) if is_whole else self

    @property
    def notes(self) -> list[str]:
        """The note on days that the answer would need, if any."""
        if self.older is None:
            return []
        since = datetime.fromtimestamp((self.older + 1) // NS_PER_S, tz=UTC).date()
        do = "an end (or before, or a time) there has them looked at"
        return [f"the lake has days before {since}, which were not looked at: {do}"]


@dataclass(frozen=True, slots=True, eq=False)
class Robot:
    """One robot of a fleet.

    Attributes:
        name: as replies and arguments have it; never a path.
        bag_dir: the bag directory, which need not exist.
        memory: over its own bags; that of the lake where only the lake has some.
        lake: its memory over what was shipped to a lake.
        is_mounted: returns whether there are bags besides those of the lake; it may hang.
    """

    name: str
    bag_dir: Path
    memory: Memory
    lake: Memory | None = None
    is_mounted: Callable[[], bool] = lambda: True

    def asked(
        self,
        ask: Callable[[Memory, Call], T],
        call: Call,
        since: Callable[[Ns], Ns | None] = lambda _: MIN_NS,
    ) -> tuple[T, FromLake | None]:
        """Returns what `ask` finds in a memory, and what to report with it if that is a lake's.

        The lake answers where it has more of the time `since` (of now) than the robot's own bags,
        and these do otherwise, or where it is None; where one has no answer, the other does.

        Raises:
            NoDataError: none of the two has an answer; it is that of the first one that knows the
                topic.
            NotInLakeError: it needs messages that the lake does not have, nor the robot.
        """
        lake = self.lake
        if lake is None:
            return ask(self.memory, call), None

        def answer(*, of_lake: bool) -> tuple[T, FromLake | None]:
            return _ask_lake(lake, ask, call) if of_lake else (ask(self.memory, call), None)

        is_mounted = self.is_mounted()
        own = self.memory.index.snapshot() if is_mounted else None
        if own is None or not (own.bags or own.problem is not None):
            # A folder that is there says best why nothing is, where nothing was shipped either.
            return answer(of_lake=not is_mounted or lake.index.snapshot().latest is not None)
        is_lakes = _lacks(self.memory, lake, since)
        try:
            return answer(of_lake=is_lakes)
        except (NoDataError, NotInLakeError) as error:
            try:
                return answer(of_lake=not is_lakes)
            except NoDataError as other:
                if isinstance(error, NoDataError) and error.reason in _UNKNOWN:
                    raise (error if other.reason in _UNKNOWN else other) from None
                raise error from None
            except (RefusedError, LakeError, QueryTimeoutError) as failure:
                if is_lakes or not isinstance(error, NoDataError):
                    raise
                notes = (*error.notes, f"the lake has no answer either: {failure}")
                raise NoDataError(error.reason, error.detail, notes) from failure

    def latest_known(self) -> Ns:
        """Returns the log time of its newest data as of the last scan; the least before the first.

        Nothing is scanned for it.
        """
        published = [memory.index.published for memory in (self.memory, self.lake) if memory]
        known = [snapshot.latest for snapshot in published if snapshot is not None]
        return next(filter(None, known), MIN_NS)


def _lacks(own: Memory, lake: Memory, since: Callable[[Ns], Ns | None]) -> bool:
    """Returns whether a lake has more of a time than a robot's own bags have.

    What is newer than the lake does not count. Retention may delete any bag, or parts of it.

    Raises:
        EpisodicError: the lake cannot be read, and these bags do not reach back so far.
    """
    on_robot = own.index.snapshot()
    begin = since(own.now(own.clock.now(), on_robot.latest))
    if begin is None:
        return False
    try:
        in_lake = lake.index.snapshot()
    except (RefusedError, LakeError):
        if on_robot.earliest is None or begin < on_robot.earliest:
            raise
        return False
    if in_lake.older is not None and begin <= in_lake.older:
        return True
    window = TimeWindow(begin, MIN_NS if in_lake.latest is None else in_lake.latest + 1)
    # By their beginnings: bags that were never shipped do not stand for those that are gone.
    sizes = dict(sorted((bag.start, bag.size) for bag in on_robot.timeline.overlapping(window)))
    return any(bag.size > sizes.get(bag.start, 0) for bag in in_lake.timeline.overlapping(window))


def _ask_lake(lake: Memory, ask: Callable[[Memory, Call], T], call: Call) -> tuple[T, FromLake]:
    """Returns what `ask` finds in a lake, with what to report; raises what it raises."""
    call.older = MAX_NS

    def report() -> FromLake:
        published = lake.index.published
        latest = None if published is None else published.latest
        return FromLake(latest, None if call.older == MAX_NS else call.older)

    try:
        return ask(lake, call), report()
    except NoDataError as error:
        detail = "; ".join((error.detail, *report().notes))
        raise NoDataError(error.reason, detail, error.notes) from error


class LakeTables(Protocol):
    """The tables of a lake, over which a statement is answered; see `lake.engine.Lake`."""

    def columns(self) -> Mapping[str, Collection[str]]:
        """Returns the columns of each table."""

    def shipped_until(self, robots: Collection[str] | None) -> Mapping[str, Ns]:
        """Returns the log time of the newest message that is there, of each robot, or of some."""

    def query(
        self,
        sql: str,
        robots: Collection[str] | None,
        *,
        most_rows: int | None,
        most_chars: int | None,
        deadline: Deadline | None,
    ) -> Selected:
        """Returns the rows of a SELECT."""


class Fleet:
    """The robots that one server answers for.

    Args:
        robots: no two have one name.
        clock: the wall clock, read once for a question to several.
        shared_map: whether coordinates mean the same place for all of them.
        join: returns the robots that a lake has besides those of some names, where there is one.
            It looks there, unless it did so a moment ago.
        tables: those of the lake, where there is one.

    Attributes:
        robots: all of them, by their names.
    """

    def __init__(
        self,
        robots: Iterable[Robot],
        clock: Clock,
        *,
        shared_map: bool = False,
        join: Callable[[Collection[str]], Iterable[Robot]] | None = None,
        tables: LakeTables | None = None,
    ) -> None:
        self.robots: Mapping[str, Robot] = {robot.name: robot for robot in robots}
        self.clock, self.shared_map, self.join = clock, shared_map, join
        self.tables = tables
        self._lock = threading.Lock()

    def add_shipped(self) -> Sequence[Robot]:
        """Adds the robots that were shipped to the lake for the first time since; returns them.

        Raises:
            EpisodicError: the lake cannot be read.
        """
        if self.join is None:
            return ()
        with self._lock:
            joining = [*self.join(self.robots)]
            # A new dict: other threads iterate over the old one.
            self.robots = {**self.robots, **{robot.name: robot for robot in joining}}
        return joining

    def allowed(self, call: Call) -> list[Robot]:
        """Returns the robots that a call may ask about, in the order of the configuration."""
        robots = call.robots
        return [robot for name, robot in self.robots.items() if robots is None or name in robots]

    def named(self, name: object, call: Call) -> Robot:
        """Returns the robot with a name.

        Raises:
            InvalidArgumentsError: there is none, or the call may not ask about it, which the
                sentence does not tell apart.
            EpisodicError: the lake, which may have it, cannot be read.
        """
        name = name.strip() if isinstance(name, str) else name
        if isinstance(name, str) and name not in self.robots and call.robots is None:
            self.add_shipped()
        allowed = self.allowed(call)
        for robot in allowed:
            if robot.name == name:
                return robot
        raise InvalidArgumentsError(f"there is no robot {abbreviate(name)}; {there_are(allowed)}")

    def chosen(self, named: object, call: Call) -> list[Robot]:
        """Returns the robot of a name, several (a, b), or where it is None all that are allowed.

        Raises as `named`.
        """
        if named is None:
            return self.allowed(call)
        names = named.split(",") if isinstance(named, str) else [named]
        return [*dict.fromkeys([self.named(name, call) for name in names])]


def there_are(robots: Iterable[Robot]) -> str:
    """Returns a clause that names the robots that there are."""
    names = [robot.name for robot in robots]
    if not names:
        return "there is none"
    return f"there {'is' if len(names) == 1 else 'are'} {listed(names, at_most=_MOST_NAMED)}"


class FanOut:
    """Asks robots in threads, a few at a time: each has its time limit, and none waits for one.

    A robot that is stuck is not asked again until it is done.

    So a hanging disk blocks one thread, however many questions follow. Thread-safe.
    """

    def __init__(self, at_once: int = AT_ONCE) -> None:
        self._at_once = at_once
        self._is_done: dict[str, Callable[[], bool]] = {}

    def ask(
        self, robots: Sequence[Robot], work: Callable[[Robot, Call], T], call: Call
    ) -> Mapping[str, T | EpisodicError]:
        """Returns, by robot and in their order, what `work` returned, or the error why not.

        Every robot is in it. Takes 0.95 of the time that is left of the call, at most.
        """
        left_s, begun_s = call.deadline.left_s(), time.monotonic()
        limit_s = left_s * (_OF_ONE if len(robots) > 1 else _OF_ALL)
        context = contextvars.copy_context()

        def ask_one(robot: Robot) -> tuple[T | EpisodicError, Call]:
            own_s = min(limit_s, begun_s + left_s * _OF_ALL - time.monotonic())
            own = replace(call.within(own_s), stages=Stages())
            own.used_active = own.used_thinned = False
            if refused := self._refused(robot, call, own_s):
                return refused, own
            answer = _start_asking(robot, work, own, context.copy())
            try:
                return answer.result(min(own_s + left_s * _GRACE, threading.TIMEOUT_MAX)), own
            except TimeoutError:
                self._is_done[robot.name] = answer.done
                do = "ask about it alone, or about" if len(robots) > 1 else "ask about"
                return QueryTimeoutError(f"no answer in {own_s:.3g} s; {do} a shorter window"), own

        with ThreadPoolExecutor(self._at_once) as threads:
            answers = [*threads.map(ask_one, robots)]
        for _, own in answers:
            for stage, spent in [*own.stages.spent.items()]:
                call.stages.add(stage, spent)
            call.used_active |= own.used_active
            call.used_thinned |= own.used_thinned
        return {robot.name: answer for robot, (answer, _) in zip(robots, answers, strict=True)}

    def _refused(self, robot: Robot, call: Call, own_s: float) -> EpisodicError | None:
        """Returns why a robot is not asked: it is stuck, or no time is left."""
        if robot.name in self._is_done and not self._is_done[robot.name]():
            late = "still busy with an earlier question that it did not finish in time"
            return BusyError(f"{late}: is its disk reachable?")
        if own_s <= 0 or call.deadline.expired():
            do = "ask about fewer robots, or a shorter time"
            return QueryTimeoutError(f"not asked: the time of the call was up; {do}")
        self._is_done.pop(robot.name, None)
        return None


def _start_asking(
    robot: Robot, work: Callable[[Robot, Call], T], call: Call, context: contextvars.Context
) -> Future[T | EpisodicError]:
    """Returns what a robot will answer, in a thread of its own."""
    answer: Future[T | EpisodicError] = Future()

    def run() -> None:
        try:
            answer.set_result(work(robot, call))
        except EpisodicError as error:
            answer.set_result(error)
        except Exception:
            log.exception("robot_failed", robot=robot.name)
            fault = "failed through a fault in this server; its log has the cause"
            answer.set_result(EpisodicError(fault))

    # A daemon: one that hangs must not keep the program from ending.
    threading.Thread(
        target=context.run, args=(run,), name=f"robot-{robot.name}", daemon=True
    ).start()
    return answer
