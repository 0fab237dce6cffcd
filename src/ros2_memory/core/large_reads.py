"""Lets one question at a time hold much of a bag: some kilobytes of it decompress to gigabytes."""

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
"""Up to so much of a bag any thread holds at once; who needs more waits for its turn."""
_LOOKED_S: Final = 0.1
"""How often one that waits looks whether its time is over."""


class _Block:
    """A block of one thread, which may have the turn."""

    def __init__(self, check: Callable[[], None], waited: Callable[[Ns], None]) -> None:
        self.check = check
        self.waited = waited
        self.has_turn = False


class LargeReads:
    """The turn to hold more than `LARGE_BYTES` of bags, of all threads that share it. Thread-safe.

    A thread takes it when it first needs it, and has it until its block ends: so what it holds
    always lets it go on, and whoever waits holds little. Outside of blocks nothing waits, as in
    programs that do one thing at a time.

    No thread may wait for it with a lock that is taken by one that has it.
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
        """Within the block this thread may have to wait, and in the end its turn is over.

        Args:
            check: raises where the time of who waits is over.
            waited: is called with how long it waited.
        """
        before = self._block_of_thread
        if before is not None:
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
        """Within the block this thread never waits: for what is done under a lock."""
        before, self._own.block = self._block_of_thread, None
        try:
            yield
        finally:
            self._own.block = before

    def acquire(self) -> None:
        """Waits until this thread may hold more than `LARGE_BYTES`. Raises what `check` does."""
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
        """Ends the turn of this thread, which holds nothing large at the moment, if it has it."""
        block = self._block_of_thread
        if block is not None:
            self._end(block)

    @property
    def _block_of_thread(self) -> _Block | None:
        return getattr(self._own, "block", None)

    def _end(self, block: _Block) -> None:
        if not block.has_turn:
            return
        # Before another one's turn, which adds to what is not given back.
        return_free_memory()
        with self._changed:
            block.has_turn = False
            self._queue.popleft()
            self._changed.notify_all()
