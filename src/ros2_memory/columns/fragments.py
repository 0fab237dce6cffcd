"""What follows from the rows of some parts: made once, remembered, and stored beside the parts.

A fragment is of a slice of the clock, and of the parts that have rows in it or beside it. Parts do
not change, so a fragment does not either, and goes with the first of its parts.
"""

from __future__ import annotations

import json
import math
import threading
from collections import deque
from typing import TYPE_CHECKING, Final, Generic, NamedTuple, Protocol, TypeAlias, TypeVar, cast

import numpy as np

from ros2_memory.columns.pack import compressed, decompressed
from ros2_memory.core.logging_setup import get_logger

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from ros2_memory.columns.store import ColumnStore
    from ros2_memory.core.timebase import Ns
    from ros2_memory.storage.base import IntArray
    from ros2_memory.storage.cache import ByteLru

    Array: TypeAlias = NDArray[np.generic[object]]
    Floats: TypeAlias = np.ndarray[tuple[int], np.dtype[np.float64]]
    Vectors: TypeAlias = np.ndarray[tuple[int, int], np.dtype[np.float64]]

_MOST_WAITING: Final = 1_024
"""Fragments that wait to be stored; of more the oldest are made again."""

_KEY_BYTES: Final = 400
"""About how much memory it takes to remember a fragment, besides its own."""

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
            array = np.frombuffer(values, kind, math.prod(shape), at)
            arrays[name] = array.reshape(shape)
            at += array.nbytes
        return cls(head.decode(), arrays)


class Kind(NamedTuple, Generic[T]):
    """A kind of fragments: what tells it apart from others in the file, and how it is stored.

    Attributes:
        name: of the kind.
        store: returns what is stored.
        load: returns what was stored.
        join: returns fewer fragments that say the same as those of a stretch of the clock, in
            order. Without it these stay as they are.
    """

    name: str
    store: Callable[[T], Fragment]
    load: Callable[[Fragment], T]
    join: Callable[[Sequence[T]], Sequence[T]] = lambda found: found


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


class Joined(NamedTuple, Generic[T]):
    """The fragments of a stretch of the clock, joined."""

    found: Sequence[T]

    @property
    def memory_bytes(self) -> int:
        """About how much memory they take."""
        return 100 + sum(one.memory_bytes for one in self.found)


def joining(kind: Kind[T]) -> Kind[Joined[T]]:
    """Returns how the joined fragments of a kind are stored: each array of all in one."""

    def store(joined: Joined[T]) -> Fragment:
        every = [kind.store(one) for one in joined.found]
        rows = [
            (one.head, {name: len(array) for name, array in one.arrays.items()}) for one in every
        ]
        arrays: dict[str, list[Array]] = {}
        for one in every:
            for name, array in one.arrays.items():
                arrays.setdefault(name, []).append(array)
        whole = {name: np.concatenate(several) for name, several in arrays.items()}
        return Fragment(json.dumps(rows), whole)

    def load(fragment: Fragment) -> Joined[T]:
        found: list[T] = []
        ends = dict.fromkeys(fragment.arrays, 0)
        for head, lengths in json.loads(fragment.head):
            arrays = {}
            for name, length in lengths.items():
                arrays[name] = fragment.arrays[name][ends[name] : ends[name] + length]
                ends[name] += length
            found.append(kind.load(Fragment(head, arrays)))
        return Joined(found)

    return Kind(f"{kind.name}-joined", store, load)


class Fragments(Generic[T]):
    """The fragments of one kind. Thread-safe.

    Args:
        store: where they are stored; None where they are remembered alone.
        kind: see there.
        settings: what all of them depend on, as a text.
        remembered: those of all kinds that were asked for last.
    """

    def __init__(
        self, store: ColumnStore | None, kind: Kind[T], settings: str, remembered: ByteLru[object]
    ) -> None:
        self._store = store
        self._kind = kind
        self._name = f"{kind.name} {settings}"
        self._remembered = remembered
        self._waiting: deque[tuple[FragmentKey, T]] = deque(maxlen=_MOST_WAITING)
        self._lock = threading.Lock()

    def get(self, key: FragmentKey) -> T | None:
        """Returns a fragment; None if it was not made yet."""
        # By name: each kind has one type.
        found = cast("T | None", self._remembered.get((self._kind.name, key)))
        if found is None and self._store is not None:
            data = self._store.fragment(self._name, key)
            found = None if data is None else self._loaded(data)
            if found is not None:
                self._remember(key, found)
        return found

    def put(self, key: FragmentKey, made: T) -> None:
        """Remembers a fragment, which waits to be stored."""
        self._remember(key, made)
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
            self._store.put_fragments(self._name, made)

    def _remember(self, key: FragmentKey, made: T) -> None:
        self._remembered.put((self._kind.name, key), made, made.memory_bytes + _KEY_BYTES)

    def _loaded(self, data: bytes) -> T | None:
        try:
            return self._kind.load(Fragment.from_bytes(data))
        except (ValueError, TypeError, LookupError) as error:
            log.warning("fragment_damaged", kind=self._kind.name, reason=str(error))
            return None
