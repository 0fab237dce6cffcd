"""Runs a bounded number of queries at once, fairly among clients.

A client with many queries delays its own, not those of others: the next free thread goes to the
client with the fewest running queries, and among equals to the one that has waited longest since
its last. Queries of one client run in the order of their arrival.
"""

from __future__ import annotations

import asyncio
import contextvars
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeVar

from ros2_memory.core.errors import BusyError

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable

T = TypeVar("T")

STOPPING: Final = "the server is stopping; ask again when it runs again"
_NO_THREAD: Final = "the machine starts no more threads for the server; ask again later"
_HANGING: Final = (
    "every thread is still busy with a question whose time is over, as when a disk hangs: is it "
    "reachable?"
)
_HANGING_WAIT_S: Final = 2.0
"""Waited for a turn where all threads were left behind: a query that only is late ends sooner."""
MOST_WAITING: Final = 256
"""Queries that may wait in one queue. Each holds its arguments in memory."""


@dataclass(eq=False)
class _Turn:
    """The turn of a waiting query; `comes` is done when the query may begin, or is refused."""

    client: Hashable
    comes: asyncio.Future[None]


class FairQueue:
    """Runs at most `threads` queries at once, each in a thread. At most `MOST_WAITING` wait.

    All methods must be called on the event loop's thread. A query counts as running until its
    thread is done, also where nobody waits for the answer any more: a thread cannot be stopped.
    """

    def __init__(self, name: str, threads: int) -> None:
        self._threads = ThreadPoolExecutor(threads, thread_name_prefix=name)
        self._at_once = threads
        self._stopped = False
        self._waiting: list[_Turn] = []
        self._running: Counter[Hashable] = Counter()
        self._left_behind: set[object] = set()
        """The running queries for whose answers nobody waits any more."""

    @property
    def waiting(self) -> int:
        """Returns how many queries wait for a thread."""
        return len(self._waiting)

    @property
    def running(self) -> int:
        """Returns how many queries run."""
        return self._running.total()

    def stop(self) -> None:
        """Accepts no more queries, and ends the threads when they are done."""
        self._stopped = True
        self._threads.shutdown(wait=False)

    async def run(self, client: Hashable, query: Callable[[], T]) -> T:
        """Waits for the client's turn, runs the query in a thread, and returns its result.

        If the caller is cancelled, its query leaves the queue; a running query goes on.

        Raises:
            BusyError: too many queries wait already, all threads hang, or the queue was stopped.
        """
        is_hanging = len(self._left_behind) == self._at_once
        try:
            async with asyncio.timeout(_HANGING_WAIT_S if is_hanging else None):
                await self._wait_for_turn(client)
        except TimeoutError:
            raise BusyError(_HANGING) from None
        loop = asyncio.get_running_loop()
        try:
            running = self._threads.submit(contextvars.copy_context().run, query)
        except RuntimeError as error:
            self._release(client)
            raise BusyError(STOPPING if self._stopped else _NO_THREAD) from error

        def release() -> None:
            self._left_behind.discard(running)
            self._release(client)

        def release_soon(_: object) -> None:
            with suppress(RuntimeError):  # the loop has ended, and with it the queue
                loop.call_soon_threadsafe(release)

        running.add_done_callback(release_soon)
        try:
            return await asyncio.wrap_future(running)
        except asyncio.CancelledError:
            if not running.done():
                self._left_behind.add(running)
            raise

    async def _wait_for_turn(self, client: Hashable) -> None:
        """Waits for a free thread, and takes it."""
        if self.running < self._at_once and not self._waiting:
            self._running[client] += 1
            return
        if self.waiting >= MOST_WAITING:
            self._make_room(client)
        turn = _Turn(client, asyncio.get_running_loop().create_future())
        self._waiting.append(turn)
        try:
            await turn.comes
        except asyncio.CancelledError:
            if turn in self._waiting:
                self._waiting.remove(turn)
            elif not turn.comes.cancelled() and turn.comes.exception() is None:
                self._release(client)
            raise

    def _make_room(self, client: Hashable) -> None:
        """Refuses the newest waiting query of the client with most of them.

        Raises:
            BusyError: this client would have most itself.
        """
        waiting = Counter(turn.client for turn in self._waiting)
        [(most, count)] = waiting.most_common(1)
        refusal = BusyError(
            f"{MOST_WAITING} questions wait already; ask again when some are answered, and "
            "fewer at once"
        )
        if count <= waiting[client] + 1:
            raise refusal
        last = next(turn for turn in reversed(self._waiting) if turn.client == most)
        self._waiting.remove(last)
        last.comes.set_exception(refusal)

    def _release(self, client: Hashable) -> None:
        """Frees a thread, and begins the next query."""
        self._running[client] -= 1
        if not self._running[client]:
            del self._running[client]
        while self.running < self._at_once and self._waiting:
            turn = min(self._waiting, key=lambda turn: self._running[turn.client])
            self._waiting.remove(turn)
            # The client's other turns go behind those of others; a sort keeps the order of equals.
            self._waiting.sort(key=lambda other: other.client == turn.client)
            if not turn.comes.done():
                self._running[turn.client] += 1
                turn.comes.set_result(None)
