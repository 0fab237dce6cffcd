from __future__ import annotations

import asyncio
import threading
from typing import TYPE_CHECKING

import pytest

from ros2_memory.serving.fair_queue import FairQueue

if TYPE_CHECKING:
    from collections.abc import Callable

BOUND_S = 20


class Gates:
    """Questions that end when the test lets them, and the order in which they began."""

    def __init__(self) -> None:
        self.begun: list[str] = []
        self._gates: dict[str, threading.Event] = {}

    def ask(self, name: str) -> Callable[[], str]:
        gate = self._gates.setdefault(name, threading.Event())

        def answer() -> str:
            self.begun.append(name)
            assert gate.wait(BOUND_S)
            return name

        return answer

    def release(self, *names: str) -> None:
        for name in names or tuple(self._gates):
            self._gates[name].set()


async def until(what: Callable[[], bool]) -> None:
    """Lets everything else go on until it is so."""
    async with asyncio.timeout(BOUND_S):
        while not what():
            await asyncio.sleep(0.001)


def started(queue: FairQueue, gates: Gates, client: str, count: int) -> list[asyncio.Task[str]]:
    return [asyncio.create_task(queue.run(client, gates.ask(f"{client}{n}"))) for n in range(count)]


async def test_the_next_place_goes_to_whoever_has_the_fewest() -> None:
    queue, gates = FairQueue("test", 3), Gates()
    tasks = [*started(queue, gates, "a", 4), *started(queue, gates, "b", 3)]
    await until(lambda: len(gates.begun) == 3)
    gates.release("a0")  # a has two left running, b has none
    await until(lambda: len(gates.begun) == 4)
    gates.release("a1")  # one each: a waits for longer
    await until(lambda: len(gates.begun) == 5)
    assert gates.begun == ["a0", "a1", "a2", "b0", "a3"]
    gates.release()
    await asyncio.gather(*tasks)


async def test_a_question_whose_caller_leaves_gives_its_place_in_the_queue_back() -> None:
    queue, gates = FairQueue("test", 1), Gates()
    tasks = started(queue, gates, "a", 3)
    await until(lambda: queue.waiting == 2)
    tasks[1].cancel()
    await until(lambda: queue.waiting == 1)
    gates.release()
    assert await tasks[2] == "a2"
    assert gates.begun == ["a0", "a2"]


@pytest.mark.parametrize("has_turn", [True, False])
async def test_a_turn_that_comes_as_its_caller_leaves_goes_to_the_next(has_turn: bool) -> None:
    queue, gates = FairQueue("test", 1), Gates()
    first, leaving, last = started(queue, gates, "a", 3)
    await until(lambda: queue.waiting == 2)
    gates.release("a0")
    queue._threads.submit(int).result(BOUND_S)  # so the first is done, which the loop learns next
    if has_turn:
        asyncio.get_running_loop().call_soon(leaving.cancel)
    else:
        leaving.cancel()
    gates.release()
    assert [await first, await last] == ["a0", "a2"]
    assert leaving.cancelled()
    assert gates.begun == ["a0", "a2"]
    await until(lambda: (queue.running, queue.waiting) == (0, 0))


async def test_a_thread_that_is_left_behind_keeps_its_place_until_it_is_done() -> None:
    queue, gates = FairQueue("test", 1), Gates()
    stuck, following = started(queue, gates, "a", 2)
    await until(lambda: gates.begun == ["a0"])
    stuck.cancel()
    await until(stuck.done)
    assert (queue.running, queue.waiting) == (1, 1)
    gates.release()
    assert await following == "a1"
    await until(lambda: queue.running == 0)
