"""Which columns a message definition has, and how its payloads are gone through.

CDR (OMG CDR 1.x, as ROS 2 writes it): behind a header of 4 bytes each primitive is aligned to its
own size, strings and sequences to the 4 bytes of their length; messages are their fields. Fields of
fixed size that follow each other lie at fixed offsets once their first one is aligned; they make
one `Run`, which is read by a single array operation.
"""

from __future__ import annotations

import keyword
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import islice
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.columns.table import MAX_NUMBERS, MAX_RANGED_BYTES
from ros2_memory.core.text import dotted
from ros2_memory.storage.base import SEQUENCE, Definition, Field

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

MAX_COLUMNS: Final = 5_000
"""Of one type, with those of its sequences."""
_MOST_ELEMENTS: Final = 2**32 - 1
"""Of a sequence in CDR; no message holds a longer array either."""

_DTYPES: Final = {
    "bool": "u1",
    "byte": "u1",
    "char": "u1",
    "int8": "i1",
    "uint8": "u1",
    "int16": "<i2",
    "uint16": "<u2",
    "int32": "<i4",
    "uint32": "<u4",
    "int64": "<i8",
    "uint64": "<u8",
    "float32": "<f4",
    "float64": "<f8",
}
_LENGTH_BYTES: Final = 4
_TIMES: Final = frozenset({"builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"})
_TIME_FIELDS: Final = (Field("sec", "int32"), Field("nanosec", "uint32"))
_FILLER: Final = "structure_needs_at_least_one_member"


class UnplannedError(Exception):
    """A definition whose messages cannot be columns; the text is the reason."""


class Number(NamedTuple):
    """A number or boolean. `attribute` is its path in a decoded message; `nth` of a fixed array."""

    path: str
    attribute: str
    dtype: np.dtype[np.generic[object]]
    is_bool: bool
    nth: int | None = None


class Time(NamedTuple):
    """A time or duration."""

    path: str
    attribute: str


class Array(NamedTuple):
    """A fixed array that is no column."""

    path: str
    attribute: str
    length: int
    is_bool: bool
    is_ranged: bool


class Run(NamedTuple):
    """Fields of fixed size that lie together.

    Attributes:
        align: to what the first one is aligned; 1 where it lies where the position is.
        size: bytes of the run.
        dtype: where those that are read lie in it, by their number in `fields`.
        fields: those that become columns.
    """

    align: int
    size: int
    dtype: np.dtype[np.void]
    fields: tuple[Number | Time | Array, ...]


class Text(NamedTuple):
    """A string. `align` and `skip` lead to its length, as for all that follows."""

    align: int
    skip: int
    path: str
    attribute: str


class NumberSequence(NamedTuple):
    """A sequence of numbers, each of `size` bytes."""

    align: int
    skip: int
    path: str
    attribute: str
    dtype: np.dtype[np.generic[object]]
    is_bool: bool
    size: int


class Sequence(NamedTuple):
    """A sequence, or an array of fixed `length`. `plan` reads one element."""

    align: int
    skip: int
    path: str
    attribute: str
    length: int
    plan: Plan


Step: TypeAlias = Run | Text | NumberSequence | Sequence


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """How messages of a type are gone through.

    Attributes:
        steps: in the order of the payload.
        align: the alignment of the first field.
        least: the fewest bytes that such a message takes.
        unit: the alignment that its layout depends on.
        ends: if its size is fixed, where it ends when it begins 0, 1, .. `unit` - 1 bytes behind a
            multiple of `unit`; else empty.
        left_out: see `Table.left_out`.
        has_objects: whether it has strings or sequences of messages.
    """

    steps: tuple[Step, ...]
    align: int
    least: int
    unit: int
    ends: tuple[int, ...]
    left_out: dict[str, str]
    has_objects: bool


@lru_cache(512)
def plan_of(definition: Definition) -> Plan:
    """Returns the plan of a type; the same for the same object.

    Raises:
        UnplannedError: it has more columns than `MAX_COLUMNS`, a type that has none, or an array
            that no message holds.
    """
    planner = _Planner(iter(range(MAX_COLUMNS)))
    planner.add_message(definition, "", "")
    return planner.finished()


@dataclass(slots=True)
class _Planner:
    """Follows the position through one message: known to be `rest` behind a multiple of `unit`."""

    budget: Iterator[int]
    steps: list[Step] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)
    unit: int = 8
    rest: int = 0
    # The run that is being made.
    align: int = 1
    size: int = 0
    read: list[tuple[Number | Time | Array, str, int]] = field(default_factory=list)
    # Alignment and size of all fields, while their sizes are fixed.
    layout: list[tuple[int, int]] | None = field(default_factory=list)
    first: int = 0
    least: int = 0

    def finished(self) -> Plan:
        """Returns the plan of the fields that were added."""
        self._flush()
        layout = self.layout or ()
        unit = max((align for align, _ in layout), default=1)
        ends = () if self.layout is None else tuple(self._end(start) for start in range(unit))
        has_objects = any(isinstance(step, Text | Sequence) for step in self.steps)
        steps, left_out = tuple(self.steps), self.left_out
        return Plan(steps, self.first or 1, self.least, unit, ends, left_out, has_objects)

    def _end(self, at: int) -> int:
        for align, size in self.layout or ():
            at += -at % align + size
        return at

    def add_message(self, definition: Definition, path: str, attribute: str) -> None:
        """Adds the fields of a message at a path."""
        if not definition.fields:
            self._pass(1, 1)
        for entry in definition.fields:
            name = f"{entry.name}_" if keyword.iskeyword(entry.name) else entry.name
            self.add_field(entry, dotted(path, entry.name), dotted(attribute, name))

    def add_field(self, entry: Field, path: str, attribute: str) -> None:
        """Adds one field at its path."""
        kind, length = entry.kind, entry.length
        if length is not None and length > _MOST_ELEMENTS:
            raise UnplannedError(f"{path} is an array of {length} elements, more than a bag holds")
        self._take(1)
        if entry.name == _FILLER:
            self._pass(1, 1)
        elif length is None and isinstance(kind, Definition):
            if is_time(kind):
                self._fixed(Time(path, attribute), "<i4, <u4", 4, 8)
            else:
                self.add_message(kind, path, attribute)
        elif length is None and kind == "string":
            align, skip = self._variable()
            self.steps.append(Text(align, skip, path, attribute))
            self._behind(1, 5)
        elif length is None:
            dtype = _dtype(kind)
            number = Number(path, attribute, dtype, kind == "bool")
            self._fixed(number, dtype.str, dtype.itemsize, dtype.itemsize)
        elif isinstance(kind, Definition) or kind == "string":
            self._elements(kind, length, path, attribute)
        elif length == SEQUENCE:
            self._numbers(kind, path, attribute)
        else:
            self._array(kind, length, path, attribute)

    def _take(self, columns: int) -> None:
        if len([*islice(self.budget, columns)]) < columns:
            raise UnplannedError(f"it has more than {MAX_COLUMNS} fields")

    def _numbers(self, kind: str, path: str, attribute: str) -> None:
        dtype = _dtype(kind)
        align, skip = self._variable()
        self.steps.append(
            NumberSequence(align, skip, path, attribute, dtype, kind == "bool", dtype.itemsize)
        )
        self._behind(min(4, dtype.itemsize), 4)

    def _array(self, kind: str, length: int, path: str, attribute: str) -> None:
        dtype = _dtype(kind)
        size = dtype.itemsize
        if length <= MAX_NUMBERS:
            self._take(length)
            for nth in range(length):
                at = f"{path}.{nth}"
                number = Number(at, attribute, dtype, kind == "bool", nth)
                self._fixed(number, dtype.str, size, size)
            return
        is_ranged = length * size <= MAX_RANGED_BYTES
        array = Array(path, attribute, length, kind == "bool", is_ranged)
        self.left_out[path] = f"an array of {length} numbers"
        if is_ranged:
            self._fixed(array, f"({length},){dtype.str}", size, length * size)
            return
        self._fixed(array, "", size, length * size)
        self._flush()  # so that a run does not copy what is not read

    def _elements(self, kind: str | Definition, length: int, path: str, attribute: str) -> None:
        first = first_align(kind)
        planner = _Planner(self.budget, unit=first)
        if isinstance(kind, Definition) and not is_time(kind):
            planner.add_message(kind, "", "")
        else:
            planner.add_field(Field("", kind), "", "")
        inner = planner.finished()
        self._flush()
        align, skip = self._variable() if length == SEQUENCE else (1, 0)
        self.steps.append(Sequence(align, skip, path, attribute, length, inner))
        self.left_out |= {f"{path}.{below}": why for below, why in inner.left_out.items()}
        if length == SEQUENCE:
            self._behind(1, _LENGTH_BYTES)
            return
        self.first = self.first or first
        self.least += length * inner.least
        self.layout, self.unit, self.rest = None, 1, 0

    def _fixed(self, read: Number | Time | Array, dtype: str, align: int, size: int) -> None:
        """Adds a field of fixed size to the run."""
        self._pass(align, size)
        self.read.append((read, dtype, self.size - size))

    def _pass(self, align: int, size: int) -> None:
        if align > self.unit:
            self._flush()
            self.align, self.unit, self.rest = align, align, 0
        before = -self.rest % align
        self.size += before + size
        self.rest = (self.rest + before + size) % self.unit
        self.first = self.first or align
        self.least += size
        if self.layout is not None:
            self.layout.append((align, size))

    def _flush(self) -> None:
        """Ends the run."""
        if self.size:
            shown = [(str(nth), kind, at) for nth, (_, kind, at) in enumerate(self.read) if kind]
            names, formats, offsets = zip(*shown, strict=True) if shown else ((), (), ())
            dtype = np.dtype({"names": names, "formats": formats, "offsets": offsets})
            fields = tuple(read for read, _, _ in self.read)
            self.steps.append(Run(self.align, self.size, dtype, fields))
        self.align, self.size, self.read = 1, 0, []

    def _variable(self) -> tuple[int, int]:
        """Ends the run before a length; returns how to get to it: alignment and bytes to skip."""
        self._flush()
        self.first = self.first or _LENGTH_BYTES
        return (_LENGTH_BYTES, 0) if self.unit < _LENGTH_BYTES else (1, -self.rest % _LENGTH_BYTES)

    def _behind(self, unit: int, least: int) -> None:
        """Goes on behind something of variable size, where `unit` is what is known."""
        self.unit, self.rest, self.layout = unit, 0, None
        self.least += least


def is_time(kind: Definition) -> bool:
    """Returns whether a message is a time or a duration."""
    return kind.type in _TIMES and kind.fields == _TIME_FIELDS


def first_align(kind: str | Definition) -> int:
    """Returns the alignment of a value, which is that of its first field."""
    while isinstance(kind, Definition):
        if not kind.fields:
            return 1
        entry = kind.fields[0]
        kind = "string" if entry.length == SEQUENCE else entry.kind
    return _LENGTH_BYTES if kind == "string" else _dtype(kind).itemsize


def fields_at(definition: Definition | None, path: Iterable[str]) -> list[Field]:
    """Returns the fields along a path, each inside the one before, as far as there are such."""
    fields: list[Field] = []
    kind: str | Definition | None = definition
    for name in path:
        inside = kind.fields if isinstance(kind, Definition) else ()
        member = next((entry for entry in inside if entry.name == name), None)
        if member is None:
            break
        fields.append(member)
        kind = member.kind
    return fields


def _dtype(kind: str | Definition) -> np.dtype[np.generic[object]]:
    if not isinstance(kind, str) or kind not in _DTYPES:
        raise UnplannedError(f"it has fields of type {kind}")
    return np.dtype(_DTYPES[kind])
