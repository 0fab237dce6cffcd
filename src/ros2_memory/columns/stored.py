"""Tables whose columns are unpacked when they are first asked for, and that know what was lost."""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Protocol, TypeVar, cast

import numpy as np

from ros2_memory.columns.table import Column, Elements, Table, Zone

if TYPE_CHECKING:
    from ros2_memory.columns.layout import Layout
    from ros2_memory.columns.outline import Outline
    from ros2_memory.columns.pack import Packed
    from ros2_memory.storage.base import Channel, Definition

V = TypeVar("V")


class Remembered(Protocol):
    """What is remembered, as long as there is room for it."""

    def get(self, key: Hashable) -> object | None:
        """Returns what is remembered under a key."""

    def put(self, key: Hashable, value: object, size: int) -> None:
        """Remembers a value of about so many bytes."""


class Lazily(Mapping[str, V]):
    """A mapping whose values are made when they are first asked for, and kept."""

    def __init__(self, names: Collection[str], make: Callable[[str], V]) -> None:
        self._names = names
        self._make = make
        self._made: dict[str, V] = {}

    def __getitem__(self, name: str) -> V:
        value = self._made.get(name)
        if value is None:
            if name not in self._names:
                raise KeyError(name)
            value = self._made[name] = self._make(name)
        return value

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


@dataclass(frozen=True, slots=True, eq=False)
class StoredTable(Table):
    """A table whose columns are unpacked when they are first asked for, by any thread.

    Attributes:
        packed: returns what is known of a column, by its path as in `Layout.slots`, without its
            data; None where there is no such one.
        outline: returns what else is known of them; None where it was not made.
        memory: has what was made of it, under its number; None where nothing is remembered.
        number: of the part.
    """

    packed: Callable[[str], Packed | None] = field(kw_only=True)
    outline: Callable[[], Outline | None] = field(kw_only=True, default=lambda: None)
    memory: Remembered | None = field(kw_only=True, default=None)
    number: int = field(kw_only=True, default=0)

    def error(self, path: str) -> float:
        """Returns the greatest absolute error of a column; 0.0: it is exact.

        Args:
            path: the column; of elements `<sequence>.<column>`.

        Raises:
            KeyError: there is no such column.
        """
        packed = self.packed(path.rstrip("."))
        if packed is None:
            raise KeyError(path)
        return packed.error

    def zone(self, path: str) -> Zone | None:
        """Returns what is known of a column without unpacking it; None where there is no such one.

        `path` is as in `error`.
        """
        packed = self.packed(path.rstrip("."))
        return None if packed is None else packed.zone

    def remember(self, what: str, make: Callable[[], V], size_of: Callable[[V], int]) -> V:
        """Returns what `make` makes of all rows, once for the part; see `Table.remember`."""
        if self.memory is None:
            return make()
        key = (self.number, f"={what}")
        cached = self.memory.get(key)
        if cached is not None:
            return cast("V", cached)  # by name: each has one type
        value = make()
        self.memory.put(key, value, size_of(value))
        return value


@dataclass(frozen=True, eq=False)
class Topic:
    """A topic with its columns, and its definition.

    `define` finds the definition, when it is first asked for: to parse one takes some 10 ms.
    """

    channel: Channel
    layout: Layout
    define: Callable[[Channel], Definition | None] = lambda _: None

    @cached_property
    def definition(self) -> Definition | None:
        """The fields of the messages; None where they are not known."""
        return self.define(self.channel)


def lazy_columns(
    layout: Layout, column: Callable[[str], Column], dropped: Collection[str], sequence: str = ""
) -> tuple[Mapping[str, Column], Mapping[str, Elements]]:
    """Returns the columns and sequences of a table, each made when it is needed, and kept.

    Args:
        layout: of the table.
        column: returns the column, or the owners, at a path of `Layout.slots`.
        dropped: the paths of those that there are not.
        sequence: the path of that whose elements they are of; "" for those of the messages.
    """
    columns, sequences = layout.levels[sequence]

    def elements(name: str) -> Elements:
        path = sequences[name]
        owners = np.asarray(column(f"{path}#"), np.int64)
        return Elements(owners, *lazy_columns(layout, column, dropped, path))

    kept: Collection[str] = columns
    lists: Collection[str] = sequences
    if dropped:
        # Owners that are all equal take no bytes: they stay where the columns beside them go.
        kept = [name for name, path in columns.items() if path not in dropped]
        lists = [name for name, path in sequences.items() if f"{path}#" not in dropped]
    return Lazily(kept, lambda name: column(columns[name])), Lazily(lists, elements)
