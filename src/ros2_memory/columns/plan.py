"""Plans how the payloads of a message type are read into columns.

In CDR (OMG CDR 1.x, as ROS 2 writes it) a payload has a header of 4 bytes. Behind it each primitive
is aligned to its own size, strings and sequences to the 4 bytes of their length; a message is the
sequence of its fields. Neighbouring fields of fixed size lie at fixed offsets from the first one
once that is aligned. They make one `Run`, which is read by a single array operation.
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
FILLER: Final = "structure_needs_at_least_one_member"


class UnplannedError(Exception):
    """A definition whose messages cannot become columns; the text is the reason."""


class Number(NamedTuple):
    """A number or boolean.

    Attributes:
        path: of its column.
        attribute: its path in a decoded message, as for all that follow.
        dtype: as it lies in the payload.
        is_bool: whether it is a boolean.
        nth: its place in a fixed array, whose path `attribute` is; None for a field of its own.
    """

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
    """A fixed array that is too long for a column of each number."""

    path: str
    attribute: str
    length: int
    is_bool: bool
    is_ranged: bool


class Run(NamedTuple):
    """Fields of fixed size that lie together.

    Attributes:
        align: the alignment of the first field; 1 if the position is aligned already.
        size: bytes of the run.
        dtype: the layout of `fields` in it; they are named by their places.
        fields: the fields that become columns.
    """

    align: int
    size: int
    dtype: np.dtype[np.void]
    fields: tuple[Number | Time | Array, ...]


class Text(NamedTuple):
    """A string.

    Attributes:
        align: the alignment of its length, as for all that follow.
        skip: bytes behind the aligned position at which the length begins.
        path: of its column.
        attribute: its path in a decoded message.
    """

    align: int
    skip: int
    path: str
    attribute: str


class NumberSequence(NamedTuple):
    """A sequence of numbers, each of `size` bytes; one of at most `most` has them as elements."""

    align: int
    skip: int
    path: str
    attribute: str
    dtype: np.dtype[np.generic[object]]
    is_bool: bool
    size: int
    most: int


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
    """How messages of a type are read.

    Attributes:
        steps: in the order of the payload.
        align: the alignment of the first field.
        least: the fewest bytes that a message takes.
        size: how many bytes it takes from its first field on; None if that depends on the message,
            or on where it begins, since another field has a greater alignment than the first.
        left_out: see `Table.left_out`.
        has_objects: whether it has strings or sequences of messages.
    """

    steps: tuple[Step, ...]
    align: int
    least: int
    size: int | None
    left_out: dict[str, str]
    has_objects: bool


@lru_cache(512)
def plan_of(definition: Definition, most_numbers: int = MAX_NUMBERS) -> Plan:
    """Returns the plan of a type. Sequences of at most `most_numbers` numbers have elements.

    Raises:
        UnplannedError: it has more columns than `MAX_COLUMNS`, a field of a type that cannot become
            a column, or an array that is too long for any message.
    """
    planner = _Planner(iter(range(MAX_COLUMNS)), most_numbers, first_align(definition))
    planner.add_message(definition, "", "")
    return planner.plan()


@dataclass(slots=True)
class _Planner:
    """Follows the position through one message.

    The position is only known to lie `rest` bytes behind a multiple of `unit`.
    """

    # Columns that may still be added; planners of elements take from the same iterator.
    budget: Iterator[int]
    most_numbers: int
    # The alignment of the first field.
    first: int
    steps: list[Step] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)
    unit: int = 8
    rest: int = 0
    # The run that is being made: its alignment, its size, and its fields with dtype and offset.
    align: int = 1
    size: int = 0
    run: list[tuple[Number | Time | Array, str, int]] = field(default_factory=list)
    least: int = 0
    # Bytes from the first field on; see `Plan.size`.
    fixed: int | None = 0

    def plan(self) -> Plan:
        """Returns the plan of the fields that were added."""
        self._flush()
        has_objects = any(isinstance(step, Text | Sequence) for step in self.steps)
        steps, left_out = tuple(self.steps), self.left_out
        return Plan(steps, self.first, self.least, self.fixed, left_out, has_objects)

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
        self._spend(1)
        if entry.name == FILLER:
            self._pass(1, 1)
        elif length is None and isinstance(kind, Definition):
            if is_time(kind):
                self._fixed(Time(path, attribute), "<i4, <u4", 4, 8)
            else:
                self.add_message(kind, path, attribute)
        elif length is None and kind == "string":
            align, skip = self._begin_variable()
            self.steps.append(Text(align, skip, path, attribute))
            self._pass_variable(1, 5)
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

    def _spend(self, columns: int) -> None:
        if len([*islice(self.budget, columns)]) < columns:
            raise UnplannedError(f"it has more than {MAX_COLUMNS} fields")

    def _numbers(self, kind: str, path: str, attribute: str) -> None:
        dtype = _dtype(kind)
        align, skip = self._begin_variable()
        self.steps.append(
            NumberSequence(
                *(align, skip, path, attribute, dtype, kind == "bool", dtype.itemsize),
                self.most_numbers,
            )
        )
        self._pass_variable(min(4, dtype.itemsize), 4)

    def _array(self, kind: str, length: int, path: str, attribute: str) -> None:
        dtype = _dtype(kind)
        size = dtype.itemsize
        if length <= MAX_NUMBERS:
            self._spend(length)
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
        planner = _Planner(self.budget, self.most_numbers, first, unit=first)
        if isinstance(kind, Definition) and not is_time(kind):
            planner.add_message(kind, "", "")
        else:
            planner.add_field(Field("", kind), "", "")
        inner = planner.plan()
        self._flush()
        align, skip = self._begin_variable() if length == SEQUENCE else (1, 0)
        self.steps.append(Sequence(align, skip, path, attribute, length, inner))
        for inner_path, reason in inner.left_out.items():
            self.left_out[f"{path}.{inner_path}"] = reason
        if length == SEQUENCE:
            self._pass_variable(1, _LENGTH_BYTES)
            return
        self._pass_variable(1, length * inner.least)

    def _fixed(self, entry: Number | Time | Array, dtype: str, align: int, size: int) -> None:
        """Adds a field of fixed size to the run."""
        self._pass(align, size)
        self.run.append((entry, dtype, self.size - size))

    def _pass(self, align: int, size: int) -> None:
        """Moves the position behind a field of fixed size."""
        if align > self.unit:
            self._flush()
            self.align, self.unit, self.rest = align, align, 0
        before = -self.rest % align
        self.size += before + size
        self.rest = (self.rest + before + size) % self.unit
        self.least += size
        if self.fixed is not None:
            self.fixed = None if align > self.first else self.fixed + -self.fixed % align + size

    def _flush(self) -> None:
        """Ends the run."""
        if self.size:
            names: list[str] = []
            formats: list[str] = []
            offsets: list[int] = []
            for nth, (_, dtype, offset) in enumerate(self.run):
                if dtype:  # a long array is not read
                    names.append(str(nth))
                    formats.append(dtype)
                    offsets.append(offset)
            layout = np.dtype({"names": names, "formats": formats, "offsets": offsets})
            fields = tuple(entry for entry, _, _ in self.run)
            self.steps.append(Run(self.align, self.size, layout, fields))
        self.align, self.size, self.run = 1, 0, []

    def _begin_variable(self) -> tuple[int, int]:
        """Ends the run before a length; returns `align` and `skip` for the next run."""
        self._flush()
        return (_LENGTH_BYTES, 0) if self.unit < _LENGTH_BYTES else (1, -self.rest % _LENGTH_BYTES)

    def _pass_variable(self, unit: int, least: int) -> None:
        """Moves the position behind something of variable size.

        Args:
            unit: the position is a multiple of this.
            least: the fewest bytes that it takes.
        """
        self.unit, self.rest, self.fixed = unit, 0, None
        self.least += least


def is_time(kind: Definition) -> bool:
    """Returns whether a message is a time or a duration."""
    return kind.type in _TIMES and kind.fields == _TIME_FIELDS


def first_align(kind: str | Definition) -> int:
    """Returns the alignment of a value: of a message, that of its first field."""
    while isinstance(kind, Definition):
        if not kind.fields:
            return 1
        entry = kind.fields[0]
        kind = "string" if entry.length == SEQUENCE else entry.kind
    return _LENGTH_BYTES if kind == "string" else _dtype(kind).itemsize


def fields_at(definition: Definition | None, path: Iterable[str]) -> list[Field]:
    """Returns the fields along a path, as far as they exist; each is in the message before it."""
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
