"""Fragments: results that are computed from some parts once, remembered, and stored beside them.

A fragment is of a slice of the clock, and of the parts that have rows in it or beside it. The rows
of a part do not change, though columns of it may be dropped later. So a fragment does not change
either; it is deleted with the first of its parts.
"""

from __future__ import annotations

import json
import math
import struct
import sys
import threading
from collections import deque
from dataclasses import fields, is_dataclass
from io import BytesIO
from typing import TYPE_CHECKING, Final, Generic, NamedTuple, Protocol, TypeAlias, TypeVar, cast

import numpy as np

from ros2_memory.columns.pack import EXACT, METRES, compress, decompress, pack, unpack
from ros2_memory.core.logging_setup import get_logger

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from numpy.typing import NDArray

    from ros2_memory.columns.store import ColumnStore
    from ros2_memory.core.timebase import Ns
    from ros2_memory.storage.cache import ByteLru

    Array: TypeAlias = NDArray[np.generic[object]]

_MOST_WAITING: Final = 1_024
"""Fragments that wait to be stored; if there are more, the oldest have to be made again."""

_KEY_BYTES: Final = 400
"""About how much memory it takes to remember a fragment, besides its own."""
_FEW: Final = 256
"""Shorter arrays are stored as they are: to unpack one takes longer than to read it."""

log = get_logger(__name__)


class Sized(Protocol):
    """A value that knows how much memory it takes."""

    @property
    def memory_bytes(self) -> int:
        """About how much memory it takes."""


T = TypeVar("T", bound=Sized)


class FragmentKind(NamedTuple, Generic[T]):
    """A kind of fragments.

    Attributes:
        name: identifies the kind in the file.
        classes: the dataclasses and named tuples in its fragments, besides arrays, tuples, mappings
            and values of JSON. The file has their places in this order.
        join: returns fewer fragments that say the same as the fragments of a stretch of the clock,
            which are given in order; as a default, the same ones.
    """

    name: str
    classes: tuple[type, ...]
    join: Callable[[Sequence[T]], Sequence[T]] = lambda fragments: fragments


def to_bytes(fragment: object, classes: Sequence[type]) -> bytes:
    """Returns a fragment as bytes: a line of JSON, then the bytes of arrays one after the other.

    In the JSON all but numbers, texts and None is an object with one key, which says what makes the
    value of the list behind it: `tuple`, `dict`, `bytes`, `array`, or the number of a class.
    """
    numbers = {cls: str(number) for number, cls in enumerate(classes)}
    data: list[bytes] = []

    def json_of(value: object) -> object:
        maker, arguments = numbers.get(type(value), "tuple"), value
        if isinstance(value, bytes):
            data.append(value)
            return {"bytes": [len(value)]}
        if isinstance(value, np.ndarray):
            codec, least, packed = _pack_array(value)
            data.append(packed)
            return {"array": [len(packed), codec, least, value.dtype.str, *value.shape]}
        if isinstance(value, dict):
            maker, arguments = "dict", value.items()
        elif is_dataclass(value):
            maker = numbers[type(value)]
            arguments = [getattr(value, attribute.name) for attribute in fields(value)]
        elif not isinstance(value, tuple | list):
            return value
        return {maker: [*map(json_of, cast("Iterable[object]", arguments))]}

    head = json.dumps(json_of(fragment))
    return compress(b"".join((head.encode(), b"\n", *data)))


def from_bytes(data: bytes, classes: Sequence[type]) -> object:
    """Returns the fragment that `to_bytes` wrote.

    Raises:
        ValueError, TypeError, LookupError, struct.error: the bytes are no fragment.
    """
    head, tail = decompress(data).split(b"\n", 1)
    read = BytesIO(tail).read  # arrays are made in the order in which they were written

    def made(value: dict[str, object]) -> object:
        [(maker, arguments)] = value.items()
        if not isinstance(arguments, list):
            raise TypeError("something is made without arguments")
        if maker == "tuple":
            return (*arguments,)
        if maker == "dict":  # names of columns are in thousands of fragments
            return {sys.intern(key): entry for key, entry in arguments}
        if maker == "bytes":
            return read(*arguments)
        if maker == "array":
            size, *how = arguments
            return _unpack_array(read(size), *how)
        return classes[int(maker)](*arguments)

    fragment = json.loads(head, object_hook=made)
    if not isinstance(fragment, (*classes,)):
        raise TypeError("it is no fragment of this kind")
    return fragment


def _pack_array(array: Array) -> tuple[str, float | None, bytes]:
    """Returns the codec of an array, its least value, and its bytes; all of them exact."""
    if array.size >= _FEW:
        flat = array.reshape(-1, order="F")
        for step in (METRES, EXACT):
            column = pack(flat, step)
            unpacked = unpack(column.codec, column.count, column.zone.least, column.data)
            if cast("Array", unpacked).tobytes() == flat.tobytes():
                return column.codec, column.zone.least, column.data
    return "", None, array.tobytes()


def _unpack_array(data: bytes, codec: str, least: float | None, dtype: str, *shape: int) -> Array:
    if not codec:
        return np.frombuffer(data, dtype).reshape(shape)
    flat = cast("Array", unpack(codec, math.prod(shape), least, data))
    return np.ascontiguousarray(flat.reshape(shape, order="F"))


class FragmentKey(NamedTuple):
    """Identifies a fragment of a kind.

    Attributes:
        start: the log time (ns) at which its slice begins.
        settings: identifies what it depends on besides the parts.
        parts: the numbers of its parts.
    """

    start: Ns
    settings: str
    parts: tuple[int, ...]


class Joined(NamedTuple, Generic[T]):
    """The joined fragments of a stretch of the clock."""

    fragments: Sequence[T]

    @property
    def memory_bytes(self) -> int:
        """About how much memory they take."""
        return 100 + sum(fragment.memory_bytes for fragment in self.fragments)


def joining(kind: FragmentKind[T]) -> FragmentKind[Joined[T]]:
    """Returns the kind of the joined fragments of a kind."""
    return FragmentKind(f"{kind.name}-joined", (*kind.classes, Joined))


class Fragments(Generic[T]):
    """The fragments of one kind. Thread-safe.

    Args:
        store: where they are stored; None to remember them only.
        kind: of the fragments.
        settings: identifies what all of them depend on.
        remembered: the fragments of all kinds that were used last.
    """

    def __init__(
        self,
        store: ColumnStore | None,
        kind: FragmentKind[T],
        settings: str,
        remembered: ByteLru[object],
    ) -> None:
        self._store = store
        self._kind = kind
        self._name = f"{kind.name} {settings}"
        self._remembered = remembered
        self._waiting: deque[tuple[FragmentKey, T]] = deque(maxlen=_MOST_WAITING)
        self._lock = threading.Lock()

    def get(self, key: FragmentKey, also_before: Ns = 0) -> T | None:
        """Returns a fragment; None if it was not made yet.

        Args:
            key: of the fragment.
            also_before: fragments that begin at most so long (ns) before it are read and remembered
                with it, since they are asked for next.
        """
        # By name: each kind has one type.
        fragment = cast("T | None", self._remembered.get((self._kind.name, key)))
        if fragment is None and self._store is not None:
            for other, data in self._store.fragments(self._name, key, also_before):
                if self._remembered.get((self._kind.name, other)) is not None:
                    continue
                restored = self._restore(data)
                if restored is not None:
                    self._remember(other, restored)
                    if other == key:
                        fragment = restored
        return fragment

    def put(self, key: FragmentKey, fragment: T) -> None:
        """Remembers a fragment until `write` stores it, and longer if there is room."""
        self._remember(key, fragment)
        if self._store is not None:
            with self._lock:
                self._waiting.append((key, fragment))

    def write(self) -> None:
        """Stores the fragments that were put since the last call, unless a part was deleted."""
        with self._lock:
            waiting = [*self._waiting]
            self._waiting.clear()
        if self._store is not None and waiting:
            classes = self._kind.classes
            packed = [(key, to_bytes(fragment, classes)) for key, fragment in waiting]
            self._store.put_fragments(self._name, packed)

    def _remember(self, key: FragmentKey, fragment: T) -> None:
        self._remembered.put((self._kind.name, key), fragment, fragment.memory_bytes + _KEY_BYTES)

    def _restore(self, data: bytes) -> T | None:
        try:
            return cast("T", from_bytes(data, self._kind.classes))
        except (ValueError, TypeError, LookupError, struct.error) as error:
            log.warning("fragment_damaged", kind=self._kind.name, reason=str(error))
            return None
