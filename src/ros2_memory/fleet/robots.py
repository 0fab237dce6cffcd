"""The robots of a fleet, each with a memory of its own, and one question to many of them."""

from __future__ import annotations

import contextvars
import threading
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from operator import itemgetter
from typing import TYPE_CHECKING, Final, NamedTuple, TypeVar

from ros2_memory.core.errors import (
    BusyError,
    EpisodicError,
    InvalidArgumentsError,
    LakeError,
    NoDataError,
    NotInLakeError,
    QueryTimeoutError,
    RefusedError,
)
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.text import abbreviate, listed
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Clock, Ns, utc_day
from ros2_memory.history.context import Call, Memory, Stages

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

    from ros2_memory.lake.engine import Lake

T = TypeVar("T")

_MOST_NAMED: Final = 50
AT_ONCE: Final = 4
"""Robots that are asked at once: most of it is Python, which runs one thread at a time."""
_OF_ONE: Final = 0.4
"""The part of the time of a call that one robot of several may take."""
_OF_ALL: Final = 0.9
"""The part that all robots, or a single one, may take; the rest is for merging the answers."""
_GRACE: Final = 0.05
"""The part by which a robot may exceed its limit before it counts as stuck."""

log = get_logger(__name__)


class LakeReport(NamedTuple):
    """What a reply has to report if its answer is from a lake.

    Attributes:
        latest: the log time of the robot's newest message in the lake; None if there is none.
        older: the last log time (inclusive) of older days that were not looked at; None if the
            answer is from all days.
        is_alone: whether the lake alone could answer: the robot has no bags of its own here.
        takes_time: whether an argument of the question can have older days looked at.
    """

    latest: Ns | None
    older: Ns | None = None
    is_alone: bool = True
    takes_time: bool = True

    def since(self, begin: Ns) -> LakeReport:
        """Returns the report for an answer that needs nothing before a log time."""
        is_whole = self.older is None or begin > self.older
        return self._replace(older=None) if is_whole else self

    @property
    def notes(self) -> list[str]:
        """The note on days that were not looked at, if there are any."""
        if self.older is None:
            return []
        do = ": an end (or before, or a time) there has them looked at" if self.takes_time else ""
        return [f"the lake has days before {utc_day(self.older + 1)}, which were not looked at{do}"]


@dataclass(frozen=True, slots=True, eq=False)
class Robot:
    """One robot of a fleet.

    Attributes:
        name: its name in replies and arguments; never a path.
        memory: the memory over its bags and, if there is a lake, the bags that were shipped.
        own: the memory over its bags alone; None if it has no bag directory, or there is no lake.
        in_lake: whether `memory` is over a lake, too.
    """

    name: str
    memory: Memory
    own: Memory | None = None
    in_lake: bool = False

    def ask(
        self,
        ask: Callable[[Memory, Call], T],
        call: Call,
        since: Callable[[Ns], Ns | None] = lambda _: MIN_NS,
    ) -> tuple[T, LakeReport | None]:
        """Returns what `ask` finds in the memory, and a report if the answer is from a lake.

        If the lake cannot be read, the robot's own bags answer, provided that they reach back to
        the time that the question is about; `since` returns it, given now. They also answer if the
        lake has only the times of the messages.

        Raises:
            EpisodicError: there is no answer.
        """
        if not self.in_lake:
            return ask(self.memory, call), None
        call.older = MAX_NS
        try:
            return ask(self.memory, call), self._lake_report(call)
        except NoDataError as error:
            detail = "; ".join((error.detail, *self._lake_report(call).notes))
            raise NoDataError(error.reason, detail, error.notes) from error
        except (RefusedError, LakeError) as failure:
            return self._ask_own(ask, call, since, failure), None

    def _ask_own(
        self,
        ask: Callable[[Memory, Call], T],
        call: Call,
        since: Callable[[Ns], Ns | None],
        failure: EpisodicError,
    ) -> T:
        """Returns what `ask` finds in the robot's own bags, where the lake has no answer.

        Raises:
            EpisodicError: `failure`, if these bags do not answer either.
        """
        lacks_payloads = isinstance(failure, NotInLakeError)
        if self.own is None or not (lacks_payloads or _reaches_back(self.own, since)):
            raise failure
        try:
            return ask(self.own, call)
        except NoDataError as error:
            if lacks_payloads:
                raise failure from None
            notes = (*error.notes, f"the lake has no answer either: {failure}")
            raise NoDataError(error.reason, error.detail, notes) from failure

    def _lake_report(self, call: Call) -> LakeReport:
        own = None if self.own is None else self.own.index.published
        is_alone = own is None or own.problem is not None or not own.bags
        return LakeReport(self.latest, None if call.older == MAX_NS else call.older, is_alone)

    @property
    def latest(self) -> Ns | None:
        """The log time of its newest data as of the last scan, if there is one."""
        published = self.memory.index.published
        return None if published is None else published.latest


def _reaches_back(own: Memory, since: Callable[[Ns], Ns | None]) -> bool:
    """Returns whether a robot's own bags begin before the time that a question is about."""
    snapshot = own.index.snapshot()
    begin = since(own.now(snapshot.latest))
    return begin is None or (snapshot.earliest is not None and begin >= snapshot.earliest)


class Fleet:
    """The robots that one server answers for.

    Args:
        robots: the configured robots, with unique names.
        clock: the wall clock, read once for a question to several robots.
        shared_map: whether coordinates mean the same place for all robots.
        join: returns the robots in the lake whose names are not given; None if there is no lake.
            It looks into the lake, unless it did so a moment ago.
        tables: the lake; None if there is none.

    Attributes:
        robots: all robots by name, the configured ones and those in the lake.
    """

    def __init__(
        self,
        robots: Iterable[Robot],
        clock: Clock,
        *,
        shared_map: bool = False,
        join: Callable[[Collection[str]], Iterable[Robot]] | None = None,
        tables: Lake | None = None,
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
            InvalidArgumentsError: there is no such robot, or the call may not ask about it; the
                sentence is the same.
            EpisodicError: the lake, which may have the robot, cannot be read.
        """
        name = name.strip() if isinstance(name, str) else name
        if isinstance(name, str) and name not in self.robots and call.robots is None:
            self.add_shipped()
        allowed = self.allowed(call)
        for robot in allowed:
            if robot.name == name:
                return robot
        clause = robots_clause(allowed)
        raise InvalidArgumentsError(f"there is no robot {abbreviate(name)}; {clause}")

    def chosen(self, named: object, call: Call) -> list[Robot]:
        """Returns the named robot, several ("a, b"), or all allowed ones if `named` is None.

        Raises:
            EpisodicError: see `named`.
        """
        if named is None:
            return self.allowed(call)
        names = named.split(",") if isinstance(named, str) else [named]
        return [*dict.fromkeys([self.named(name, call) for name in names])]

    def newest(self, named: object, call: Call) -> Memory | None:
        """Returns the memory with the newest data of the `chosen` robots; None if none answers.

        Raises:
            EpisodicError: see `named`.
        """

        def read_latest(memory: Memory, _: Call) -> tuple[Ns, Memory]:
            return memory.snapshot().dating.latest or MIN_NS, memory

        answers = FanOut().ask(
            self.chosen(named, call), lambda robot, own: robot.ask(read_latest, own)[0], call
        )
        dated = [answer for answer in answers.values() if isinstance(answer, tuple)]
        _, memory = max(dated, key=itemgetter(0), default=(MIN_NS, None))
        return memory


def robots_clause(robots: Iterable[Robot]) -> str:
    """Returns a clause that lists robots, such as "there are a, b"."""
    names = [robot.name for robot in robots]
    if not names:
        return "there is none"
    return f"there {'is' if len(names) == 1 else 'are'} {listed(names, at_most=_MOST_NAMED)}"


class FanOut:
    """Asks robots in threads, a few at a time, each with a time limit. Thread-safe.

    A robot that exceeded its limit is not asked again until the threads of all questions that it
    did not answer in time are done. So a hanging disk blocks the threads of the questions that were
    asked within the first one's limit, however many follow.
    """

    def __init__(self, at_once: int = AT_ONCE) -> None:
        self._at_once = at_once
        self._late: dict[str, set[object]] = {}
        """For each robot, the answers that did not come in time, until they do."""

    def ask(
        self, robots: Sequence[Robot], work: Callable[[Robot, Call], T], call: Call
    ) -> Mapping[str, T | EpisodicError]:
        """Returns what `work` returned for each robot, or the error, in the order of the robots.

        It takes at most `_OF_ALL` plus `_GRACE` of the time that is left of the call.
        """
        left_s, is_of_several = call.deadline.left_s(), len(robots) > 1
        until = call.deadline.within(left_s * _OF_ALL)
        most_s = left_s * (_OF_ONE if is_of_several else _OF_ALL)
        context = contextvars.copy_context()

        def ask_one(robot: Robot) -> tuple[T | EpisodicError, Call]:
            """Returns the answer of a robot, or the error, and the call that it was asked in."""
            own = replace(
                call.within(min(most_s, until.left_s())),
                stages=Stages(),
                used_active=False,
                used_thinned=False,
            )
            late = self._late.setdefault(robot.name, set())
            if late:
                why = "still busy with an earlier question that it did not finish in time"
                return BusyError(f"{why}: is its disk reachable?"), own
            if own.deadline.expired():
                do = "ask about fewer robots, or a shorter time"
                return QueryTimeoutError(f"not asked: the time of the call was up; {do}"), own
            answer = _start(context.copy(), robot, partial(work, robot, own))
            own_s = own.deadline.budget_s
            try:
                return answer.result(min(own_s + left_s * _GRACE, threading.TIMEOUT_MAX)), own
            except TimeoutError:
                late.add(answer)
                answer.add_done_callback(late.discard)
                do = "ask about it alone, or about" if is_of_several else "ask about"
                return QueryTimeoutError(f"no answer in {own_s:.3g} s; {do} a shorter window"), own

        with ThreadPoolExecutor(self._at_once) as threads:
            answers = [*threads.map(ask_one, robots)]
        for _, own in answers:
            for stage, spent in [*own.stages.spent.items()]:
                call.stages.add(stage, spent)
            call.used_active |= own.used_active
            call.used_thinned |= own.used_thinned
        return {robot.name: answer for robot, (answer, _) in zip(robots, answers, strict=True)}


def _start(
    context: contextvars.Context, robot: Robot, ask: Callable[[], T]
) -> Future[T | EpisodicError]:
    """Asks a robot in a thread of its own; returns the future answer."""
    answer: Future[T | EpisodicError] = Future()

    def run() -> None:
        try:
            answer.set_result(ask())
        except EpisodicError as error:
            answer.set_result(error.detached())
        except Exception:
            log.exception("robot_failed", robot=robot.name)
            fault = "failed through a fault in this server; its log has the cause"
            answer.set_result(EpisodicError(fault))

    # A daemon: one that hangs must not keep the program from ending.
    name = f"robot-{robot.name}"
    threading.Thread(target=partial(context.run, run), name=name, daemon=True).start()
    return answer
