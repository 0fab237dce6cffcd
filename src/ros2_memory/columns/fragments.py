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
from dataclasses import dataclass, field, fields, is_dataclass
from io import BytesIO
from itertools import pairwise
from typing import TYPE_CHECKING, Final, Generic, NamedTuple, Protocol, TypeAlias, TypeVar, cast

import numpy as np

from ros2_memory.columns.pack import compress, decompress, pack, unpack
from ros2_memory.columns.steps import EXACT, METRES
from ros2_memory.core.logging_setup import get_logger

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from ros2_memory.columns.store import ColumnStore
    from ros2_memory.core.timebase import Ns
    from ros2_memory.storage.cache import ByteLru

    Array: TypeAlias = NDArray[np.generic[object]]

_MOST_WAITING: Final = 1_024
"""Fragments that wait to be stored; if there are more, the oldest have to be made again."""

_LARGEST_INT64: Final = (1 << 63) - 1
_KEY_BYTES: Final = 400
"""About how much memory it takes to remember a fragment, besides its own."""
_FEW: Final = 256
"""Shorter arrays are stored as they are: to unpack one takes longer than to read it."""
_TUPLE, _BYTES, _ARRAY, _ROWS, _COLUMN = -1, -2, -3, -4, -5
"""What a list in the JSON of a fragment is; numbers from 0 on are those of classes."""
_NUMBERS: Final = {int: "<i8", float: "<f8"}
_PLAIN: Final = frozenset({int, float, bool, type(None)})

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

    Each list in the JSON begins with a number that says what it is. A tuple of values of one type
    is stored column by column, since that is faster to restore than value by value.
    """
    writer = _Writer({cls: number for number, cls in enumerate(classes)})
    head = json.dumps(writer.json_of(fragment))
    return compress(b"".join((head.encode(), b"\n", *writer.data)))


@dataclass(slots=True)
class _Writer:
    """Turns fragments into JSON and bytes.

    Attributes:
        numbers: the number of each class.
        data: the bytes of arrays so far.
    """

    numbers: Mapping[type, int]
    data: list[bytes] = field(default_factory=list)

    def json_of(self, value: object) -> object:
        """Returns a value as JSON; adds the bytes of its arrays."""
        if isinstance(value, bytes):
            self.data.append(value)
            return [_BYTES, len(value)]
        if isinstance(value, np.ndarray):
            codec, least, packed = _pack_array(value)
            self.data.append(packed)
            return [_ARRAY, len(packed), codec, least, value.dtype.str, *value.shape]
        if isinstance(value, dict):
            return {key: self.json_of(entry) for key, entry in value.items()}
        number = self.numbers.get(type(value))
        if number is not None:
            return [number, *map(self.json_of, _attributes(value))]
        return self._json_of_tuple(value) if isinstance(value, tuple | list) else value

    def _json_of_tuple(self, values: Sequence[object]) -> list[object]:
        """Returns several values as JSON, column by column if all but None are of one type."""
        present = [value for value in values if value is not None]
        none_at = [nth for nth, value in enumerate(values) if value is None]
        types = {*map(type, present)}
        if len(types) == 1 < len(present):
            cls = types.pop()
            columns = self._json_of_columns(cls, present, none_at)
            if columns is not None:
                return columns
        return [_TUPLE, *map(self.json_of, values)]

    def _json_of_columns(
        self, cls: type, values: Sequence[object], none_at: Sequence[int]
    ) -> list[object] | None:
        """Returns values of one type as JSON, column by column; None if they have no columns.

        Args:
            cls: the type.
            values: at least two.
            none_at: the places of None among them.
        """
        if cls in _NUMBERS:
            if cls is int and max(map(abs, cast("list[int]", values))) > _LARGEST_INT64:
                return None
            numbers = np.array(values, _NUMBERS[cls]).tobytes()
            self.data.append(numbers)
            return [_COLUMN, len(numbers), none_at, _NUMBERS[cls]]
        head = [_ROWS, [_TUPLE, *none_at]]
        if cls is np.ndarray:
            arrays = cast("list[Array]", values)
            if len({(array.dtype, array.shape[1:]) for array in arrays}) > 1:
                return None
            sizes = [_TUPLE, *map(len, arrays)]
            return [*head, sizes, self.json_of(np.concatenate(arrays))]
        has_attributes = cls is tuple or cls in self.numbers
        rows = [*map(_attributes, values)] if has_attributes else [()]
        if not rows[0] or len({*map(len, rows)}) > 1:
            return None
        columns = map(self._json_of_tuple, zip(*rows, strict=True))
        return [*head, self.numbers.get(cls, _TUPLE), *columns]


def _attributes(value: object) -> Sequence[object]:
    """Returns the attributes of a dataclass, or the entries of a tuple."""
    if is_dataclass(value):
        return [getattr(value, attribute.name) for attribute in fields(value)]
    return cast("Sequence[object]", value)


def from_bytes(data: bytes, classes: Sequence[type]) -> object:
    """Returns the fragment that `to_bytes` wrote.

    Raises:
        ValueError, TypeError, LookupError, struct.error: the bytes are no fragment.
    """
    head, tail = decompress(data).split(b"\n", 1)
    return _restore(json.loads(head), classes, BytesIO(tail))


def _restore(value: object, classes: Sequence[type], tail: BytesIO) -> object:
    """Returns the value that `_Writer.json_of` turned into JSON.

    Args:
        value: the JSON.
        classes: of the kind of fragments.
        tail: the bytes of arrays; those of this value are next.
    """
    if isinstance(value, dict):
        return {sys.intern(key): _restore(entry, classes, tail) for key, entry in value.items()}
    if not isinstance(value, list):
        # Names of columns and labels are in thousands of fragments.
        return sys.intern(value) if isinstance(value, str) else value
    number, *rest = value
    if number in {_BYTES, _ARRAY}:
        size, *array = rest
        packed = tail.read(size)
        return packed if number == _BYTES else _unpack_array(packed, *array)
    if number == _COLUMN:
        size, none_at, dtype = rest
        return _with_none(np.frombuffer(tail.read(size), dtype).tolist(), none_at)
    parts = rest
    # Most are numbers: a call for each would take half of the time.
    if not _PLAIN.issuperset(map(type, rest)):
        parts = [part if type(part) in _PLAIN else _restore(part, classes, tail) for part in rest]
    if number == _ROWS:
        none_at, kind, *columns = cast("list[Sequence[object]]", parts)
        return _with_none(_rows(kind, columns, classes), cast("Sequence[int]", none_at))
    return tuple(parts) if number == _TUPLE else classes[number](*parts)


def _rows(
    kind: object, columns: Sequence[Sequence[object]], classes: Sequence[type]
) -> list[object]:
    """Returns the values that were stored column by column.

    Args:
        kind: the number of their class, `_TUPLE`, or the lengths of arrays.
        columns: one for each attribute; all arrays, one after the other.
        classes: of the kind of fragments.
    """
    if isinstance(kind, tuple):
        edges = np.cumsum([0, *kind]).tolist()
        return [columns[0][start:stop] for start, stop in pairwise(edges)]
    if kind == _TUPLE:
        return [*zip(*columns, strict=True)]
    return [*map(classes[cast("int", kind)], *columns)]


def _with_none(values: list[object], places: Sequence[int]) -> tuple[object, ...]:
    """Returns values with None inserted at some places, which ascend."""
    for nth in places:
        values.insert(nth, None)
    return tuple(values)


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
