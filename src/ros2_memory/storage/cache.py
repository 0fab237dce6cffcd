"""Caches of the readers: one that is bounded in bytes, and one object for equal channels."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import islice
from typing import TYPE_CHECKING, Final, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import Hashable, Mapping

    from ros2_memory.storage.base import Channel

T = TypeVar("T")

_SPARED: Final = 3
"""Values that stay, though they are older, for each that goes."""
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
        self._all: _Values[T] = _Values(capacity)

    def namespace(self) -> ByteLru[T]:
        """Returns a cache with keys of its own, within the capacity of this one."""
        cache = ByteLru[T](0)
        cache._all = self._all
        return cache

    def get(self, key: Hashable) -> T | None:
        """Returns the value of the key, or None."""
        with self._all.lock:
            entry = self._all.values.get((self, key))
            if entry is None:
                return None
            self._all.values.move_to_end((self, key))
            return entry[0]

    def put(self, key: Hashable, value: T, size: int) -> None:
        """Caches `value`, which takes about `size` bytes, and drops others."""
        entries = self._all
        size += _ENTRY_BYTES
        with entries.lock:
            _, replaced = entries.values.pop((self, key), (None, 0))
            entries.bytes -= replaced
            if size > entries.capacity:
                return
            while entries.bytes + size > entries.capacity:
                for oldest in [*islice(entries.values, min(_SPARED, len(entries.values) - 1))]:
                    entries.values.move_to_end(oldest)
                _, (_, dropped) = entries.values.popitem(last=False)
                entries.bytes -= dropped
            entries.values[(self, key)] = (value, size)
            entries.bytes += size


@dataclass(slots=True)
class _Values(Generic[T]):
    """The values of caches that share a capacity, by cache and key; last the one used last."""

    capacity: int
    values: OrderedDict[tuple[ByteLru[T], Hashable], tuple[T, int]] = field(
        default_factory=OrderedDict
    )
    bytes: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)


def shared(channel: Channel) -> Channel:
    """Returns the first channel met that equals this one: bags of one robot declare the same.

    A channel with long texts is returned as it is, so that no more than 16 MiB are held.
    """
    return _first_met(channel) if channel.memory_bytes <= _SHARED_BYTES else channel


def unshared_bytes(channels: Mapping[int, Channel]) -> int:
    """Returns about how much memory channels take that no other file shares."""
    sizes = [channel.memory_bytes for channel in channels.values()]
    return 300 * len(sizes) + sum([size for size in sizes if size > _SHARED_BYTES])


@lru_cache(512)
def _first_met(channel: Channel) -> Channel:
    return channel
