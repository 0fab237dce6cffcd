"""What follows from the rows of some parts: made once, remembered, and stored beside the parts.

A fragment is of a slice of the clock, and of the parts that have rows in it or beside it. What a
part says does not change, though columns of it may be dropped later; so a fragment does not change
either, and goes with the first of its parts.
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
from itertools import pairwise
from typing import TYPE_CHECKING, Final, Generic, NamedTuple, Protocol, TypeAlias, TypeVar, cast

import numpy as np

from ros2_memory.columns.pack import compressed, decompressed, pack, unpack
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
"""Fragments that wait to be stored; of more the oldest are made again."""

_MOST: Final = (1 << 63) - 1
_KEY_BYTES: Final = 400
"""About how much memory it takes to remember a fragment, besides its own."""
_FEW: Final = 256
"""Shorter arrays are stored as they are: to unpack one takes longer than to read it."""
_TUPLE, _BYTES, _ARRAY, _ROWS, _COLUMN = -1, -2, -3, -4, -5
_NUMBERS: Final = {int: "<i8", float: "<f8"}
_PLAIN: Final = frozenset({int, float, bool, type(None)})

log = get_logger(__name__)


class Sized(Protocol):
    """What is remembered."""

    @property
    def memory_bytes(self) -> int:
        """About how much memory it takes."""


T = TypeVar("T", bound=Sized)


class FragmentKind(NamedTuple, Generic[T]):
    """A kind of fragments: what tells it apart from others in the file, and what it consists of.

    Attributes:
        name: of the kind.
        classes: dataclasses and named tuples that it has in it, besides arrays, tuples, mappings,
            and values of JSON. Their order is what the file knows them by.
        join: returns fewer fragments that say the same as those of a stretch of the clock, in
            order. Without it these stay as they are.
    """

    name: str
    classes: tuple[type, ...]
    join: Callable[[Sequence[T]], Sequence[T]] = lambda fragments: fragments


def to_bytes(fragment: object, classes: Sequence[type]) -> bytes:
    """Returns a fragment as it is stored: a line of JSON, and the bytes of arrays one by one.

    Each list in it begins with what it is: the number of a class, or a number below 0. Values that
    are alike are there column by column: to make each of its own takes longer.
    """
    numbers = {cls: number for number, cls in enumerate(classes)}
    data: list[bytes] = []
    head = json.dumps(_plain(fragment, numbers, data))
    return compressed(b"".join((head.encode(), b"\n", *data)))


# A function within a function that calls itself would keep all of this until garbage is looked for.
def _plain(value: object, numbers: Mapping[type, int], data: list[bytes]) -> object:
    if isinstance(value, bytes):
        data.append(value)
        return [_BYTES, len(value)]
    if isinstance(value, np.ndarray):
        codec, least, packed = _packed(value)
        data.append(packed)
        return [_ARRAY, len(packed), codec, least, value.dtype.str, *value.shape]
    if isinstance(value, dict):
        return {key: _plain(entry, numbers, data) for key, entry in value.items()}
    number = numbers.get(type(value))
    if number is not None:
        return [number, *(_plain(part, numbers, data) for part in _parts(value))]
    return _plain_rows(value, numbers, data) if isinstance(value, tuple | list) else value


def _plain_rows(
    values: Sequence[object], numbers: Mapping[type, int], data: list[bytes]
) -> list[object]:
    """Returns several values: column by column, with the places of None, where others are alike."""
    there = [value for value in values if value is not None]
    none = [_TUPLE, *(nth for nth, value in enumerate(values) if value is None)]
    kinds = {*map(type, there)}
    kind = kinds.pop() if len(kinds) == 1 < len(there) else object
    if kind in _NUMBERS and (kind is float or max(map(abs, cast("list[int]", there))) <= _MOST):
        numbers_there = np.array(there, _NUMBERS[kind]).tobytes()
        data.append(numbers_there)
        return [_COLUMN, len(numbers_there), none[1:], _NUMBERS[kind]]
    if kind is np.ndarray:
        arrays = cast("list[Array]", there)
        if len({(array.dtype, array.shape[1:]) for array in arrays}) == 1:
            sizes = [_TUPLE, *map(len, arrays)]
            return [_ROWS, none, sizes, _plain(np.concatenate(arrays), numbers, data)]
    elif kind is tuple or kind in numbers:
        rows = [*map(_parts, there)]
        if rows[0] and len({*map(len, rows)}) == 1:
            columns = (_plain_rows(column, numbers, data) for column in zip(*rows, strict=True))
            return [_ROWS, none, numbers.get(kind, _TUPLE), *columns]
    return [_TUPLE, *(_plain(value, numbers, data) for value in values)]


def _parts(value: object) -> Sequence[object]:
    if is_dataclass(value):
        return [getattr(value, field.name) for field in fields(value)]
    return cast("Sequence[object]", value)


def from_bytes(data: bytes, classes: Sequence[type]) -> object:
    """Returns the fragment that was stored so.

    Raises:
        ValueError, TypeError, LookupError, struct.error: the bytes are none.
    """
    head, tail = decompressed(data).split(b"\n", 1)
    return _restored(json.loads(head), classes, BytesIO(tail))


def _restored(value: object, classes: Sequence[type], tail: BytesIO) -> object:
    if isinstance(value, dict):
        return {sys.intern(key): _restored(entry, classes, tail) for key, entry in value.items()}
    if not isinstance(value, list):
        # Names of columns and labels are in thousands of fragments.
        return sys.intern(value) if isinstance(value, str) else value
    number, *rest = value
    if number in {_BYTES, _ARRAY, _COLUMN}:
        size, *array = rest
        packed = tail.read(size)
        if number == _COLUMN:
            none, dtype = array
            return _with_none(np.frombuffer(packed, dtype).tolist(), none)
        return packed if number == _BYTES else _unpacked(packed, *array)
    parts = rest
    # Most are numbers: to call for each would take half of the time.
    if not _PLAIN.issuperset(map(type, rest)):
        parts = [part if type(part) in _PLAIN else _restored(part, classes, tail) for part in rest]
    if number == _ROWS:
        none, kind, *columns = cast("list[Sequence[object]]", parts)
        return _rows(cast("Sequence[int]", none), kind, columns, classes)
    return tuple(parts) if number == _TUPLE else classes[number](*parts)


def _rows(
    none: Sequence[int], kind: object, columns: Sequence[Sequence[object]], classes: Sequence[type]
) -> tuple[object, ...]:
    """Returns the values that `_plain_rows` was given; of arrays `kind` is their lengths."""
    rows: list[object]
    if isinstance(kind, tuple):
        ends = np.cumsum([0, *kind]).tolist()
        rows = [columns[0][start:stop] for start, stop in pairwise(ends)]
    elif kind == _TUPLE:
        rows = [*zip(*columns, strict=True)]
    else:
        rows = [*map(classes[cast("int", kind)], *columns)]
    return _with_none(rows, none)


def _with_none(values: list[object], places: Sequence[int]) -> tuple[object, ...]:
    for nth in places:
        values.insert(nth, None)
    return tuple(values)


def _packed(array: Array) -> tuple[str, float | None, bytes]:
    """Returns the codec of an array, its least value, and its bytes. Nothing of it changes."""
    if array.size >= _FEW:
        flat = array.reshape(-1, order="F")
        for step in (METRES, EXACT):
            column = pack(flat, step)
            unpacked = unpack(column.codec, column.count, column.zone.least, column.data)
            if cast("Array", unpacked).tobytes() == flat.tobytes():
                return column.codec, column.zone.least, column.data
    return "", None, array.tobytes()


def _unpacked(data: bytes, codec: str, least: float | None, dtype: str, *shape: int) -> Array:
    if not codec:
        return np.frombuffer(data, dtype).reshape(shape)
    flat = cast("Array", unpack(codec, math.prod(shape), least, data))
    return np.ascontiguousarray(flat.reshape(shape, order="F"))


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
        store: where they are stored; None where they are remembered alone.
        kind: see there.
        settings: what all of them depend on, as a text.
        remembered: those of all kinds that were asked for last.
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

        If it is stored, those that begin so long (ns) before it are remembered with it: they are
        asked for next.
        """
        # By name: each kind has one type.
        fragment = cast("T | None", self._remembered.get((self._kind.name, key)))
        if fragment is None and self._store is not None:
            for other, data in self._store.fragments(self._name, key, also_before):
                if self._remembered.get((self._kind.name, other)) is not None:
                    continue
                loaded = self._loaded(data)
                if loaded is not None:
                    self._remember(other, loaded)
                    fragment = loaded if other == key else fragment
        return fragment

    def put(self, key: FragmentKey, fragment: T) -> None:
        """Remembers a fragment, which waits to be stored."""
        self._remember(key, fragment)
        if self._store is not None:
            with self._lock:
                self._waiting.append((key, fragment))

    def write(self) -> None:
        """Stores what was made since; not what follows from parts that are deleted meanwhile."""
        with self._lock:
            waiting = [*self._waiting]
            self._waiting.clear()
        if self._store is not None and waiting:
            classes = self._kind.classes
            packed = [(key, to_bytes(fragment, classes)) for key, fragment in waiting]
            self._store.put_fragments(self._name, packed)

    def _remember(self, key: FragmentKey, fragment: T) -> None:
        self._remembered.put((self._kind.name, key), fragment, fragment.memory_bytes + _KEY_BYTES)

    def _loaded(self, data: bytes) -> T | None:
        try:
            return cast("T", from_bytes(data, self._kind.classes))
        except (ValueError, TypeError, LookupError, struct.error) as error:
            log.warning("fragment_damaged", kind=self._kind.name, reason=str(error))
            return None
