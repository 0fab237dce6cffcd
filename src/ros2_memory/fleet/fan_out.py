"""One question to many robots, a few at a time: each has its time limit, and none waits for one."""

from __future__ import annotations

import contextvars
import threading
import time
from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING, Final, Generic, TypeVar

from ros2_memory.core.errors import BusyError, EpisodicError, QueryTimeoutError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.history.context import Stages

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from ros2_memory.fleet.robots import Robot
    from ros2_memory.history.context import Call

T = TypeVar("T")

AT_ONCE: Final = 4
"""Robots that are asked at once: most of it is Python, which runs one thread at a time."""
_OF_ONE: Final = 0.4
"""The part of the time of a call that one robot of several may take."""
_OF_ALL: Final = 0.9
"""The part that all may take together, or one alone; the rest is for merging the answers."""
_GRACE: Final = 0.05
"""How much later than its limit a robot counts as stuck: a disk that hangs heeds no limit."""

log = get_logger(__name__)


class FanOut:
    """Asks robots in threads. A robot that is stuck is not asked again until it is done.

    So a hanging disk blocks one thread, however many questions follow. Thread-safe.
    """

    def __init__(self, at_once: int = AT_ONCE) -> None:
        self._at_once = at_once
        self._stuck: dict[str, threading.Thread] = {}

    def ask(
        self, robots: Sequence[Robot], work: Callable[[Robot, Call], T], call: Call
    ) -> Mapping[str, T | EpisodicError]:
        """Returns, by robot and in their order, what `work` returned, or the error why not.

        Every robot is in it. Takes 0.95 of the time that is left of the call, at most.
        """
        return _Round(self._at_once, self._stuck, robots, work, call).results()


class _Round(Generic[T]):
    """One question to some robots."""

    def __init__(
        self,
        at_once: int,
        stuck: dict[str, threading.Thread],
        robots: Sequence[Robot],
        work: Callable[[Robot, Call], T],
        call: Call,
    ) -> None:
        self._at_once = at_once
        self._stuck = stuck
        self._robots = robots
        self._work = work
        self._call = call
        left_s = call.deadline.left_s()
        self._limit_s = left_s * (_OF_ONE if len(robots) > 1 else _OF_ALL)
        self._grace_s = left_s * _GRACE
        self._end_s = time.monotonic() + left_s * _OF_ALL
        self._changed = threading.Condition()
        self._done: dict[str, T | EpisodicError] = {}
        self._calls: list[Call] = []

    def results(self) -> Mapping[str, T | EpisodicError]:
        waiting = deque(self._robots)
        running: dict[str, tuple[threading.Thread, float]] = {}
        with self._changed:
            while waiting or running:
                while waiting and len(running) < self._at_once:
                    self._begin(waiting.popleft(), running)
                now_s = time.monotonic()
                for name, (thread, until_s) in [*running.items()]:
                    if name in self._done:
                        del running[name]
                    elif now_s >= until_s:
                        del running[name]
                        self._stuck[name] = thread
                        self._done[name] = self._too_slow()
                if running and not (waiting and len(running) < self._at_once):
                    first_s = min(until_s for _, until_s in running.values())
                    # Without a deadline there is nothing to wake up for but an answer.
                    wait_s = first_s - now_s
                    self._changed.wait(wait_s if wait_s < threading.TIMEOUT_MAX else None)
            for each in self._calls:
                for stage, spent in [*each.stages.spent.items()]:
                    self._call.stages.add(stage, spent)
                self._call.used_active |= each.used_active
            return {each.name: self._done[each.name] for each in self._robots}

    def _begin(self, robot: Robot, running: dict[str, tuple[threading.Thread, float]]) -> None:
        """Has a robot asked in a thread of its own, unless it is stuck or no time is left."""
        stuck = self._stuck.get(robot.name)
        now_s = time.monotonic()
        if stuck is not None and stuck.is_alive():
            self._done[robot.name] = BusyError(
                "still busy with an earlier question that it did not finish in time: is its disk "
                "reachable?"
            )
            return
        if now_s >= self._end_s or self._call.deadline.expired():
            self._done[robot.name] = QueryTimeoutError(
                "not asked: the time of the call was up; ask about fewer robots, or a shorter time"
            )
            return
        self._stuck.pop(robot.name, None)
        limit_s = min(self._limit_s, self._end_s - now_s)
        call = replace(
            self._call,
            deadline=self._call.deadline.within(limit_s),
            stages=Stages(),
            used_active=False,
        )
        self._calls.append(call)
        # A daemon: one that hangs must not keep the program from ending.
        thread = threading.Thread(
            target=contextvars.copy_context().run,
            args=(self._run, robot, call),
            name=f"robot-{robot.name}",
            daemon=True,
        )
        thread.start()
        running[robot.name] = thread, now_s + limit_s + self._grace_s

    def _run(self, robot: Robot, call: Call) -> None:
        done: T | EpisodicError
        try:
            done = self._work(robot, call)
        except EpisodicError as error:
            done = error
        except Exception:
            log.exception("robot_failed", robot=robot.name)
            done = EpisodicError("failed through a fault in this server; its log has the cause")
        with self._changed:
            # Where it was given up meanwhile, its answer comes too late.
            self._done.setdefault(robot.name, done)
            self._changed.notify()

    def _too_slow(self) -> QueryTimeoutError:
        do = "ask about it alone, or about" if len(self._robots) > 1 else "ask about"
        return QueryTimeoutError(f"no answer in {self._limit_s:.3g} s; {do} a shorter window")
