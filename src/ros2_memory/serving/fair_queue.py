"""Places for questions of one kind, given out in turn among those who ask.

A client that asks much waits for its own questions, not others for them: the next place goes to
whoever has the fewest, and among equals to whoever had none for longest. Of one client, what came
first is asked first.
"""

from __future__ import annotations

import asyncio
import contextvars
from collections import Counter, deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final, TypeVar

from ros2_memory.core.errors import BusyError

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable

T = TypeVar("T")

MOST_WAITING: Final = 256
"""Questions that wait for one kind of place. Each holds its arguments, so they are counted."""


@dataclass(frozen=True, slots=True, eq=False)
class _Waiting:
    """One question that waits: the future is done when it may begin, or is refused."""

    turn: asyncio.Future[None]


class FairQueue:
    """At most `places` questions at once, each in a thread; the others wait, at most so many.

    All methods belong to the event loop's thread. A place is taken until the thread is done with
    it, also where nobody waits for the answer any more: what cannot be stopped is at least counted.
    """

    def __init__(self, name: str, places: int, most_waiting: int = MOST_WAITING) -> None:
        self._threads = ThreadPoolExecutor(places, thread_name_prefix=name)
        self._free = places
        self._most_waiting = most_waiting
        self._waiting: dict[Hashable, deque[_Waiting]] = {}
        self._running: Counter[Hashable] = Counter()

    @property
    def waiting(self) -> int:
        """How many questions wait for a place."""
        return sum(len(each) for each in self._waiting.values())

    @property
    def running(self) -> int:
        """How many places are taken."""
        return self._running.total()

    def stop(self) -> None:
        """Takes no more questions, and lets the threads go when they are done."""
        self._threads.shutdown(wait=False)

    async def run(self, client: Hashable, ask: Callable[[], T]) -> T:
        """What `ask` gives, when its turn has come.

        Where the caller is cancelled its question leaves the queue, or is left behind in its
        thread, which keeps the place until it is done.

        Raises:
            BusyError: too many wait already, or the lane was stopped.
        """
        await self._turn(client)
        loop = asyncio.get_running_loop()
        try:
            context = contextvars.copy_context()
            running = self._threads.submit(context.run, ask)
        except RuntimeError as error:
            self._leave(client)
            raise BusyError(
                "the server takes no questions, because it is stopping or out of threads; "
                "ask again later"
            ) from error
        running.add_done_callback(lambda _: _soon(loop, partial(self._leave, client)))
        return await asyncio.wrap_future(running)

    async def _turn(self, client: Hashable) -> None:
        """Waits for a place, and takes it."""
        if self._free and not self._waiting:
            self._take(client)
            return
        if self.waiting >= self._most_waiting:
            self._make_room(client)
        waiting = _Waiting(asyncio.get_running_loop().create_future())
        self._waiting.setdefault(client, deque()).append(waiting)
        try:
            await waiting.turn
        except asyncio.CancelledError:
            if waiting.turn.done() and not waiting.turn.cancelled():
                if waiting.turn.exception() is None:
                    self._leave(client)
            else:
                self._forget(client, waiting)
            raise

    def _make_room(self, client: Hashable) -> None:
        """Refuses the newest question of whoever has most of them waiting.

        Raises:
            BusyError: that is the one who asks.
        """
        most = max(self._waiting, key=lambda each: len(self._waiting[each]))
        refusal = BusyError(
            f"{self._most_waiting} questions wait already; ask again when some are answered, and "
            "fewer at once"
        )
        own = len(self._waiting.get(client, ()))
        if len(self._waiting[most]) <= own + 1:
            raise refusal
        last = self._waiting[most][-1]
        self._forget(most, last)
        last.turn.set_exception(refusal)

    def _forget(self, client: Hashable, waiting: _Waiting) -> None:
        """Takes it out of the queue, where it may not be any more: its turn may just have come."""
        left = self._waiting.get(client, deque())
        if waiting in left:
            left.remove(waiting)
            if not left:
                del self._waiting[client]

    def _take(self, client: Hashable) -> None:
        self._free -= 1
        self._running[client] += 1

    def _leave(self, client: Hashable) -> None:
        """Gives a place back, and to the next."""
        self._free += 1
        self._running[client] -= 1
        if not self._running[client]:
            del self._running[client]
        while self._free and self._waiting:
            following = min(self._waiting, key=self._running.__getitem__)
            waiting = self._waiting[following].popleft()
            left = self._waiting.pop(following)
            if left:  # behind the others: a dictionary keeps its order
                self._waiting[following] = left
            if not waiting.turn.done():
                self._take(following)
                waiting.turn.set_result(None)


def _soon(loop: asyncio.AbstractEventLoop, leave: Callable[[], None]) -> None:
    with suppress(RuntimeError):  # the loop has ended, and with it the queue
        loop.call_soon_threadsafe(leave)
