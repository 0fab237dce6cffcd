"""One question to many robots, a few at a time: each has its time limit, and none waits for one."""

from __future__ import annotations

import contextvars
import threading
import time
from collections import deque
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import replace
from typing import TYPE_CHECKING, Final, TypeVar

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
        self._is_done: dict[str, Callable[[], bool]] = {}

    def ask(
        self, robots: Sequence[Robot], work: Callable[[Robot, Call], T], call: Call
    ) -> Mapping[str, T | EpisodicError]:
        """Returns, by robot and in their order, what `work` returned, or the error why not.

        Every robot is in it. Takes 0.95 of the time that is left of the call, at most.
        """
        left_s, begun_s = call.deadline.left_s(), time.monotonic()
        limit_s = left_s * (_OF_ONE if len(robots) > 1 else _OF_ALL)
        waiting = deque(robots)
        running: dict[str, tuple[Future[T | EpisodicError], Call, float]] = {}
        done: dict[str, T | EpisodicError] = {}
        while waiting or running:
            now_s = time.monotonic()
            while waiting and len(running) < self._at_once:
                robot = waiting.popleft()
                own_s = min(limit_s, begun_s + left_s * _OF_ALL - now_s)
                refused = self._refused(robot, call, own_s)
                if refused is not None:
                    done[robot.name] = refused
                    continue
                own = replace(
                    call,
                    deadline=call.deadline.within(own_s),
                    stages=Stages(),
                    used_active=False,
                    used_thinned=False,
                )
                until_s = now_s + own_s + left_s * _GRACE
                running[robot.name] = _asked(robot, work, own), own, until_s
            # Without a deadline there is nothing to wake up for but an answer.
            first_s = min((until_s for *_, until_s in running.values()), default=now_s)
            futures = [future for future, *_ in running.values()]
            wait(futures, min(max(first_s - now_s, 0), threading.TIMEOUT_MAX), FIRST_COMPLETED)
            for name, (future, own, until_s) in [*running.items()]:
                if future.done():
                    done[name] = future.result()
                elif time.monotonic() >= until_s:
                    self._is_done[name] = future.done
                    do = "ask about it alone, or about" if len(robots) > 1 else "ask about"
                    text = f"no answer in {limit_s:.3g} s; {do} a shorter window"
                    done[name] = QueryTimeoutError(text)
                else:
                    continue
                del running[name]
                _add_costs(own, call)
        return {robot.name: done[robot.name] for robot in robots}

    def _refused(self, robot: Robot, call: Call, own_s: float) -> EpisodicError | None:
        """Returns why a robot is not asked: it is stuck, or no time is left."""
        if robot.name in self._is_done and not self._is_done[robot.name]():
            return BusyError(
                "still busy with an earlier question that it did not finish in time: is its disk "
                "reachable?"
            )
        if own_s <= 0 or call.deadline.expired():
            return QueryTimeoutError(
                "not asked: the time of the call was up; ask about fewer robots, or a shorter time"
            )
        self._is_done.pop(robot.name, None)
        return None


def _add_costs(own: Call, call: Call) -> None:
    """Adds what a robot's answer took to what the whole call did."""
    for stage, spent in [*own.stages.spent.items()]:
        call.stages.add(stage, spent)
    call.used_active |= own.used_active
    call.used_thinned |= own.used_thinned


def _asked(robot: Robot, work: Callable[[Robot, Call], T], call: Call) -> Future[T | EpisodicError]:
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
        target=contextvars.copy_context().run,
        args=(run,),
        name=f"robot-{robot.name}",
        daemon=True,
    ).start()
    return answer
