"""What follows from the rows of some parts: made once, remembered, and stored beside the parts.

A fragment is of a slice of the clock, and of the parts that have rows in it or beside it. Parts do
not change, so a fragment does not either, and goes with the first of its parts.
"""

from __future__ import annotations

import json
import threading
from collections import deque
from typing import TYPE_CHECKING, Final, Generic, NamedTuple, Protocol, TypeAlias, TypeVar, cast

import numpy as np

from ros2_memory.columns.pack import compressed, decompressed
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.timebase import NS_PER_S, Ns
from ros2_memory.storage.cache import ByteLru

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from ros2_memory.columns.store import ColumnStore
    from ros2_memory.storage.base import IntArray

    Array: TypeAlias = NDArray[np.generic[object]]
    Floats: TypeAlias = np.ndarray[tuple[int], np.dtype[np.float64]]
    Vectors: TypeAlias = np.ndarray[tuple[int, int], np.dtype[np.float64]]

DAY_NS: Final[Ns] = 86_400 * NS_PER_S
"""Fragments are read from the store a day of the clock at a time."""
_MOST_WAITING: Final = 1_024
"""Fragments that wait to be stored; of more the oldest are made again."""

log = get_logger(__name__)


class Sized(Protocol):
    """What is remembered."""

    @property
    def memory_bytes(self) -> int:
        """About how much memory it takes."""


T = TypeVar("T", bound=Sized)


class Fragment(NamedTuple):
    """A fragment as it is stored: JSON in one line, and arrays by their names."""

    head: str
    arrays: Mapping[str, Array]

    def floats(self, name: str) -> Floats:
        """Returns an array of numbers; raises `LookupError` without it, as the others do."""
        return cast("Floats", self.arrays[name])

    def vectors(self, name: str) -> Vectors:
        """Returns an array of rows of numbers."""
        return cast("Vectors", self.arrays[name])

    def integers(self, name: str) -> IntArray:
        """Returns an array of integers."""
        return cast("IntArray", self.arrays[name])

    def marks(self, name: str) -> NDArray[np.bool_]:
        """Returns an array of booleans."""
        return cast("NDArray[np.bool_]", self.arrays[name])

    def to_bytes(self) -> bytes:
        """Returns it as bytes: the head, a line of JSON on what the arrays are, and these."""
        kinds = [[name, array.dtype.str, *array.shape] for name, array in self.arrays.items()]
        lines = f"{self.head}\n{json.dumps(kinds)}\n"
        values = (np.ascontiguousarray(array).tobytes() for array in self.arrays.values())
        return compressed(b"".join((lines.encode(), *values)))

    @classmethod
    def from_bytes(cls, data: bytes) -> Fragment:
        """Returns the fragment that was stored so.

        Raises:
            ValueError: the bytes are no fragment.
        """
        head, kinds, values = decompressed(data).split(b"\n", 2)
        arrays: dict[str, Array] = {}
        at = 0
        for name, kind, *shape in json.loads(kinds):
            count = int(np.prod(shape, dtype=np.int64))
            array = np.frombuffer(values, np.dtype(kind), count, at)
            arrays[name] = array.reshape(shape)
            at += array.nbytes
        return cls(head.decode(), arrays)


class Kind(NamedTuple, Generic[T]):
    """A kind of fragments: what tells it apart from others in the file, and how it is stored."""

    name: str
    store: Callable[[T], Fragment]
    load: Callable[[Fragment], T]


class FragmentKey(NamedTuple):
    """Identifies a fragment of a kind.

    Attributes:
        start: log time (ns) where its slice begins.
        settings: what else it depends on, as a text.
        parts: the numbers of the parts.
    """

    start: Ns
    settings: str
    parts: tuple[int, ...]


class Fragments(Generic[T]):
    """The fragments of one kind. Thread-safe.

    Args:
        store: where they are stored; None where they are remembered alone.
        kind: see there.
        settings: what all of them depend on, as a text.
        most_bytes: of those that are remembered.
    """

    def __init__(
        self, store: ColumnStore | None, kind: Kind[T], settings: str, most_bytes: int
    ) -> None:
        self._store = store
        self._kind = kind
        self._settings = settings
        self._made: ByteLru[T] = ByteLru(most_bytes)
        self._stored: ByteLru[bytes] = ByteLru(most_bytes)
        self._read: dict[tuple[int, str, Ns], int] = {}
        self._waiting: deque[tuple[FragmentKey, T]] = deque(maxlen=_MOST_WAITING)
        self._lock = threading.Lock()

    def get(self, key: FragmentKey) -> T | None:
        """Returns a fragment; None if it was not made yet."""
        found = self._made.get(key)
        if found is None and self._store is not None:
            data = self._stored.get(key) or self._read_day(self._store, key)
            if data is not None:
                found = self._loaded(data)
        if found is not None:
            self._made.put(key, found, found.memory_bytes)
        return found

    def put(self, key: FragmentKey, made: T) -> None:
        """Remembers a fragment, which waits to be stored."""
        self._made.put(key, made, made.memory_bytes)
        if self._store is not None:
            with self._lock:
                self._waiting.append((key, made))

    def write(self) -> None:
        """Stores what was made since; not what follows from parts that are deleted meanwhile."""
        with self._lock:
            waiting = [*self._waiting]
            self._waiting.clear()
        if self._store is not None and waiting:
            made = [(key, self._kind.store(made).to_bytes()) for key, made in waiting]
            self._store.put_fragments(self._name(), made)

    def _name(self) -> str:
        return f"{self._kind.name} {self._settings}"

    def _read_day(self, store: ColumnStore, key: FragmentKey) -> bytes | None:
        """Reads the fragments of a day that were stored since it was read last."""
        day = key.start // DAY_NS
        read = (store.offset, key.settings, day)
        newest = self._read.get(read, 0)
        data = None
        for number, found, packed in store.fragments(
            self._name(), key.settings, (day * DAY_NS, day * DAY_NS + DAY_NS), newest
        ):
            newest = max(newest, number)
            self._stored.put(found, packed, len(packed))
            if found == key:
                data = packed
        self._read[read] = newest
        return data

    def _loaded(self, data: bytes) -> T | None:
        try:
            return self._kind.load(Fragment.from_bytes(data))
        except (ValueError, TypeError, LookupError) as error:
            log.warning("fragment_damaged", kind=self._kind.name, reason=str(error))
            return None
