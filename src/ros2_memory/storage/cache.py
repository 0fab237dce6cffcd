"""Caches of the readers: one that is bounded in bytes, and one object for equal channels."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import islice
from typing import TYPE_CHECKING, Final, Generic, NamedTuple, TypeVar

if TYPE_CHECKING:
    from collections.abc import Hashable, Mapping

    from ros2_memory.storage.base import Channel

T = TypeVar("T")

_SPARED: Final = 3
"""For each value that is dropped, so many older ones stay."""
_ENTRY_BYTES: Final = 200
"""What an entry takes besides its value: its key, and its place among the others."""
_SHARED_BYTES: Final = 32 << 10
"""The size up to which a channel is shared; a longer one belongs to its file alone."""


class ByteLru(Generic[T]):
    """A cache of up to `capacity` bytes, which drops what was not used lately. Thread-safe.

    A value that is larger than the capacity is not cached. For each value that it drops, a few
    older ones stay. A question that reads slightly more than fits, and is asked again, then finds
    most of it; LRU would drop each value just before it is read again.
    """

    def __init__(self, capacity: int) -> None:
        self._store: _SharedStore[T] = _SharedStore(capacity)
        self._space = object()  # not the cache: the store would keep itself alive

    def namespace(self) -> ByteLru[T]:
        """Returns a cache with keys of its own, within the capacity of this one."""
        cache = ByteLru[T](0)
        cache._store = self._store
        return cache

    def get(self, key: Hashable) -> T | None:
        """Returns the value of the key, or None."""
        with self._store.lock:
            entry = self._store.entries.get((self._space, key))
            if entry is None:
                return None
            self._store.entries.move_to_end((self._space, key))
            return entry.value

    def put(self, key: Hashable, value: T, size: int) -> None:
        """Caches `value`, which takes about `size` bytes, and drops others."""
        store, entries = self._store, self._store.entries
        new = _Entry(value, size + _ENTRY_BYTES)
        with store.lock:
            replaced = entries.pop((self._space, key), None)
            if replaced is not None:
                store.bytes -= replaced.bytes
            if new.bytes > store.capacity:
                return
            while store.bytes + new.bytes > store.capacity:
                for spared in [*islice(entries, min(_SPARED, len(entries) - 1))]:
                    entries.move_to_end(spared)
                _, dropped = entries.popitem(last=False)
                store.bytes -= dropped.bytes
            entries[self._space, key] = new
            store.bytes += new.bytes


class _Entry(NamedTuple, Generic[T]):
    """A cached value, and the bytes that it takes."""

    value: T
    bytes: int


@dataclass(slots=True)
class _SharedStore(Generic[T]):
    """The entries of caches that share a capacity, by space and key; the last used comes last."""

    capacity: int
    entries: OrderedDict[tuple[object, Hashable], _Entry[T]] = field(default_factory=OrderedDict)
    bytes: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)


def shared(channel: Channel) -> Channel:
    """Returns one object for equal channels: bags of one robot declare the same.

    A channel with long texts is returned as it is, so that shared ones take 16 MiB at most.
    """
    return _first_equal(channel) if channel.memory_bytes <= _SHARED_BYTES else channel


def unshared_bytes(channels: Mapping[int, Channel]) -> int:
    """Returns about how much memory channels take that no other file shares."""
    sizes = [channel.memory_bytes for channel in channels.values()]
    return 300 * len(sizes) + sum([size for size in sizes if size > _SHARED_BYTES])


@lru_cache(512)
def _first_equal(channel: Channel) -> Channel:
    return channel
