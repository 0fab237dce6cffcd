"""What is kept between calls: a cache bounded in bytes, and one object for equal ones."""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable

T = TypeVar("T")

_MAX_SHARED = 10_000
_MAX_SHARED_BYTES = 16 << 20


class ByteLru(Generic[T]):
    """Keeps what was used last, up to `capacity` bytes. Safe to use from several threads.

    What alone is larger than the capacity is not kept.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._held: OrderedDict[Hashable, tuple[T, int]] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    def get(self, key: Hashable) -> T | None:
        """What is kept under the key, or None."""
        with self._lock:
            entry = self._held.get(key)
            if entry is None:
                return None
            self._held.move_to_end(key)
            return entry[0]

    def put(self, key: Hashable, value: T, size: int) -> None:
        """Keeps `value`, which takes about `size` bytes, and lets go of the least recently used."""
        with self._lock:
            replaced = self._held.pop(key, None)
            if replaced is not None:
                self._bytes -= replaced[1]
            if size > self._capacity:
                return
            self._held[key] = (value, size)
            self._bytes += size
            while self._bytes > self._capacity:
                _, (_, dropped) = self._held.popitem(last=False)
                self._bytes -= dropped

    @property
    def bytes_held(self) -> int:
        """The sum of the sizes of what is kept."""
        with self._lock:
            return self._bytes


class Shared(Generic[T]):
    """One object for all that are equal: bags of one robot declare the same channels.

    Args:
        size_of: about how many bytes a value takes.
    """

    def __init__(self, size_of: Callable[[T], int]) -> None:
        self._size_of = size_of
        self._known: dict[T, T] = {}
        self._bytes = 0

    def of(self, value: T) -> T:
        """The first object met that equals `value`."""
        known = self._known.get(value)
        if known is not None:
            return known
        if len(self._known) >= _MAX_SHARED or self._bytes > _MAX_SHARED_BYTES:
            self._known.clear()
            self._bytes = 0
        self._bytes += self._size_of(value)
        return self._known.setdefault(value, value)
