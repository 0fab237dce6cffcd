"""Lets one thread at a time hold much of a bag: some kilobytes of it decompress to gigabytes."""

from __future__ import annotations

import threading
import time
from collections import deque
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

from ros2_memory.core.malloc import return_free_memory

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from ros2_memory.core.timebase import Ns

LARGE_BYTES: Final = 4 << 20
"""Bytes of bags that any thread may hold; one that needs more waits for its turn."""
_LOOKED_S: Final = 0.1
"""How often a thread that waits calls `check`."""


class _Block:
    """The block of `during` that a thread is in, and whether it has the turn."""

    def __init__(self, check: Callable[[], None], waited: Callable[[Ns], None]) -> None:
        self.check = check
        self.waited = waited
        self.has_turn = False


class LargeReads:
    """The turn to hold more than `LARGE_BYTES` of bags: one thread has it at a time. Thread-safe.

    A thread takes the turn when it first needs it, and keeps it until its block of `during` ends:
    so a thread that holds much can always go on, and one that waits holds little. Outside of a
    block nothing waits, as in programs that do one thing at a time.

    No thread may wait for the turn while it has a lock that the thread with the turn may take.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._queue: deque[_Block] = deque()
        self._own = threading.local()

    @contextmanager
    def during(
        self,
        check: Callable[[], None] = lambda: None,
        waited: Callable[[Ns], None] = lambda _: None,
    ) -> Iterator[None]:
        """Lets this thread wait for the turn within the block, and ends its turn after it.

        Args:
            check: is called while it waits; raises if its time is over.
            waited: is called with the time that it waited.
        """
        if self._block_of_thread is not None:
            yield
            return
        block = self._own.block = _Block(check, waited)
        try:
            yield
        finally:
            self._own.block = None
            self._end(block)

    @contextmanager
    def exempt(self) -> Iterator[None]:
        """Lets this thread never wait within the block, which holds a lock."""
        before, self._own.block = self._block_of_thread, None
        try:
            yield
        finally:
            self._own.block = before

    def acquire(self) -> None:
        """Waits until this thread has the turn. Raises what `check` raises."""
        block = self._block_of_thread
        if block is None or block.has_turn:
            return
        begun = time.perf_counter_ns()
        with self._changed:
            has_to_wait = bool(self._queue)
            self._queue.append(block)
            try:
                while self._queue[0] is not block:
                    block.check()
                    self._changed.wait(_LOOKED_S)
            except BaseException:
                self._queue.remove(block)
                raise
            block.has_turn = True
        if has_to_wait:
            block.waited(time.perf_counter_ns() - begun)

    def release(self) -> None:
        """Ends the turn of this thread before its block ends: it holds nothing large now."""
        block = self._block_of_thread
        if block is not None:
            self._end(block)

    @property
    def _block_of_thread(self) -> _Block | None:
        return getattr(self._own, "block", None)

    def _end(self, block: _Block) -> None:
        if not block.has_turn:
            return
        # First of all: the next thread adds to the memory that is not returned.
        return_free_memory()
        with self._changed:
            block.has_turn = False
            self._queue.popleft()
            self._changed.notify_all()
