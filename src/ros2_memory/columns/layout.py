"""The columns of a topic's tables: the same from bag to bag, so that they are written down once."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple, NotRequired, TypedDict, cast

from ros2_memory.columns.steps import EXACT, Step, step_of
from ros2_memory.columns.table import Column, Elements, Table, Texts

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from ros2_memory.storage.base import Definition


class _Described(TypedDict):
    """A layout as JSON."""

    columns: dict[str, str]
    sequences: NotRequired[dict[str, _Described]]
    left_out: NotRequired[dict[str, str]]


class Kind(NamedTuple):
    """What a column is: `text` or numpy's name of its dtype, and how exactly it is stored."""

    dtype: str
    step: Step = EXACT


_OWNERS: Final = Kind("int64")


@dataclass(frozen=True, slots=True)
class Layout:
    """The columns of the tables of one topic, type and definition.

    Attributes:
        columns: by the path of the field.
        sequences: by the path of the sequence, as `Elements` has them.
        left_out: what is no column, and why.
        slots: all columns in the order in which they are packed, by their path from the table
            (`detections.label`), and the owners of elements, by that of the sequence and `#`.
    """

    columns: Mapping[str, Kind]
    sequences: Mapping[str, Layout] = field(default_factory=dict)
    left_out: Mapping[str, str] = field(default_factory=dict)
    slots: Mapping[str, Kind] = field(init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        slots = dict(self.columns)
        for path, inner in self.sequences.items():
            slots[f"{path}#"] = _OWNERS
            for name, kind in inner.slots.items():
                slots[f"{path}.{name}".rstrip(".")] = kind
        object.__setattr__(self, "slots", slots)

    @classmethod
    def of(cls, table: Table, definition: Definition | None) -> Layout:
        """Returns that of a table; the definition names the steps."""
        return cls._of(table, definition, "", table.left_out)

    @classmethod
    def _of(
        cls,
        rows: Table | Elements,
        definition: Definition | None,
        around: str,
        left_out: Mapping[str, str],
    ) -> Layout:
        columns = {
            name: _kind(column, f"{around}{name}".rstrip("."), definition)
            for name, column in rows.columns.items()
        }
        sequences = {
            name: cls._of(inner, definition, f"{around}{name}.", {})
            for name, inner in rows.elements.items()
        }
        return cls(columns, sequences, left_out)

    def fits(self, table: Table) -> bool:
        """Whether the table has these columns, and no others, and leaves the same out."""
        return self.left_out == table.left_out and self._fits(table)

    def _fits(self, rows: Table | Elements) -> bool:
        return (
            self.columns.keys() == rows.columns.keys()
            and self.sequences.keys() == rows.elements.keys()
            and all(inner._fits(rows.elements[path]) for path, inner in self.sequences.items())
        )

    def columns_of(self, table: Table) -> list[Column]:
        """Returns the columns of a table and the owners of its elements, in the order of `slots`.

        Raises:
            ValueError: the table has other columns.
        """
        if not self.fits(table):
            raise ValueError(f"a table of {table.channel.topic} has other columns than its layout")
        return [*self._columns_in(table)]

    def _columns_in(self, rows: Table | Elements) -> Iterator[Column]:
        for path in self.columns:
            yield rows.columns[path]
        for path, inner in self.sequences.items():
            elements = rows.elements[path]
            yield elements.owners
            yield from inner._columns_in(elements)

    def to_json(self) -> str:
        """Returns it as a person can read it; equal layouts give equal texts."""
        return json.dumps(self._described(), ensure_ascii=False)

    def _described(self) -> dict[str, object]:
        found: dict[str, object] = {
            "columns": {
                path: kind.dtype if kind.step == EXACT else f"{kind.dtype} {kind.step}"
                for path, kind in self.columns.items()
            }
        }
        if self.sequences:
            found["sequences"] = {
                path: inner._described() for path, inner in self.sequences.items()
            }
        if self.left_out:
            found["left_out"] = dict(self.left_out)
        return found

    @classmethod
    def from_json(cls, text: str) -> Layout:
        """Returns the layout that was written so.

        Raises:
            ValueError: it is not one.
        """
        try:
            return cls._read(cast("_Described", json.loads(text)))
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"this is not the layout of a table: {text[:80]!r}") from error

    @classmethod
    def _read(cls, described: _Described) -> Layout:
        columns: dict[str, Kind] = {}
        for path, words in described["columns"].items():
            dtype, _, step = words.partition(" ")
            columns[path] = Kind(dtype, Step.parse(step) if step else EXACT)
        sequences = {
            path: cls._read(inner) for path, inner in described.get("sequences", {}).items()
        }
        return cls(columns, sequences, described.get("left_out", {}))


def _kind(column: Column, path: str, definition: Definition | None) -> Kind:
    if isinstance(column, Texts):
        return Kind("text")
    name = column.dtype.name
    return Kind(name, step_of(path, definition) if column.dtype.kind == "f" else EXACT)
