"""One question to many robots, a few at a time: each has its time limit, and none waits for one."""

from __future__ import annotations

import contextvars
import threading
import time
from collections import deque
from dataclasses import replace
from queue import Empty, SimpleQueue
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
        self._stuck: dict[str, threading.Thread] = {}

    def ask(
        self, robots: Sequence[Robot], work: Callable[[Robot, Call], T], call: Call
    ) -> Mapping[str, T | EpisodicError]:
        """Returns, by robot and in their order, what `work` returned, or the error why not.

        Every robot is in it. Takes 0.95 of the time that is left of the call, at most.
        """
        left_s = call.deadline.left_s()
        limit_s = left_s * (_OF_ONE if len(robots) > 1 else _OF_ALL)
        end_s = time.monotonic() + left_s * _OF_ALL
        waiting = deque(robots)
        running: dict[str, tuple[threading.Thread, Call, float]] = {}
        done: dict[str, T | EpisodicError] = {}
        answers: SimpleQueue[tuple[str, T | EpisodicError]] = SimpleQueue()
        while waiting or running:
            while waiting and len(running) < self._at_once:
                robot = waiting.popleft()
                now_s = time.monotonic()
                refused = self._refused(robot, call, is_over=now_s >= end_s)
                if refused is not None:
                    done[robot.name] = refused
                    continue
                own_s = min(limit_s, end_s - now_s)
                deadline = call.deadline.within(own_s)
                own = replace(
                    call,
                    deadline=deadline,
                    stages=Stages(),
                    used_active=False,
                    used_thinned=False,
                )
                thread = _started(robot, work, own, answers)
                running[robot.name] = thread, own, now_s + own_s + left_s * _GRACE
            if running:
                first_s = min(until_s for *_, until_s in running.values())
                try:
                    # Without a deadline there is nothing to wake up for but an answer.
                    wait_s = max(first_s - time.monotonic(), 0)
                    name, answer = answers.get(
                        timeout=wait_s if wait_s < threading.TIMEOUT_MAX else None
                    )
                except Empty:
                    pass
                else:
                    # Where it was given up meanwhile, its answer comes too late.
                    if name in running:
                        _, own, _ = running.pop(name)
                        _add_costs(own, call)
                        done[name] = answer
            now_s = time.monotonic()
            for name, (thread, own, until_s) in [*running.items()]:
                if now_s >= until_s and answers.empty():
                    del running[name]
                    _add_costs(own, call)
                    self._stuck[name] = thread
                    done[name] = _too_slow(limit_s, alone=len(robots) == 1)
        return {robot.name: done[robot.name] for robot in robots}

    def _refused(self, robot: Robot, call: Call, *, is_over: bool) -> EpisodicError | None:
        """Returns why a robot is not asked: it is stuck, or no time is left."""
        stuck = self._stuck.get(robot.name)
        if stuck is not None and stuck.is_alive():
            return BusyError(
                "still busy with an earlier question that it did not finish in time: is its disk "
                "reachable?"
            )
        if is_over or call.deadline.expired():
            return QueryTimeoutError(
                "not asked: the time of the call was up; ask about fewer robots, or a shorter time"
            )
        self._stuck.pop(robot.name, None)
        return None


def _started(
    robot: Robot,
    work: Callable[[Robot, Call], T],
    call: Call,
    answers: SimpleQueue[tuple[str, T | EpisodicError]],
) -> threading.Thread:
    """Returns the thread that asks a robot; its answer goes into the queue."""

    def run() -> None:
        answer: T | EpisodicError
        try:
            answer = work(robot, call)
        except EpisodicError as error:
            answer = error
        except Exception:
            log.exception("robot_failed", robot=robot.name)
            answer = EpisodicError("failed through a fault in this server; its log has the cause")
        answers.put((robot.name, answer))

    # A daemon: one that hangs must not keep the program from ending.
    thread = threading.Thread(
        target=contextvars.copy_context().run,
        args=(run,),
        name=f"robot-{robot.name}",
        daemon=True,
    )
    thread.start()
    return thread


def _add_costs(own: Call, call: Call) -> None:
    """Adds what a robot's answer took to what the whole call did."""
    for stage, spent in [*own.stages.spent.items()]:
        call.stages.add(stage, spent)
    call.used_active |= own.used_active
    call.used_thinned |= own.used_thinned


def _too_slow(limit_s: float, *, alone: bool) -> QueryTimeoutError:
    do = "ask about" if alone else "ask about it alone, or about"
    return QueryTimeoutError(f"no answer in {limit_s:.3g} s; {do} a shorter window")
