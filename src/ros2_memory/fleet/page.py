"""The page of rows that several robots fill: which times still have a place on it."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Final

from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S, Ns

if TYPE_CHECKING:
    from collections.abc import Iterable

_SHOWN_NS: Final[Ns] = NS_PER_S // 1000
"""Rows are put in order by times as replies show them, in milliseconds."""


class Page:
    """The `limit` rows that come first, of the rows of robots that answered so far. Thread-safe.

    The newest rows come first, or the oldest.
    """

    def __init__(self, limit: int | None, *, oldest_first: bool) -> None:
        self._limit = limit
        self._oldest_first = oldest_first
        self._lock = threading.Lock()
        self._times: list[Ns] = []

    def add(self, times: Iterable[Ns]) -> None:
        """Adds the times of a robot's rows."""
        with self._lock:
            self._times = sorted((*self._times, *times), reverse=not self._oldest_first)
            del self._times[self._limit :]

    def window(self) -> TimeWindow | None:
        """Returns where a row's time must lie for a place on the page; None while there is room."""
        with self._lock:
            if self._limit is None or len(self._times) < max(self._limit, 1):
                return None
            last = self._times[-1]
        if self._oldest_first:
            return TimeWindow(MIN_NS, last + _SHOWN_NS)
        return TimeWindow(last - _SHOWN_NS, MAX_NS)
