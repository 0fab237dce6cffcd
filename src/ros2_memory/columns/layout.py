"""The columns of a topic's tables: the same from bag to bag, so that they are written down once."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

from ros2_memory.columns.steps import EXACT, Step, step_of
from ros2_memory.columns.table import Column, Elements, Table, Texts

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from ros2_memory.storage.base import Definition


class ColumnKind(NamedTuple):
    """What a column is: `text` or numpy's name of its dtype, and how exactly it is stored."""

    dtype: str
    step: Step = EXACT


@dataclass(frozen=True)
class Layout:
    """The columns of the tables of one topic, type and definition.

    Attributes:
        slots: all columns in the order in which they are packed, by their path from the table:
            those of the messages, then of each sequence the owners of its elements, by its path and
            `#`, and the columns of these (`detections.label`).
        left_out: what is no column, and why.
    """

    slots: Mapping[str, ColumnKind]
    left_out: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, table: Table, definition: Definition | None) -> Layout:
        """Returns that of a table; the definition names the steps."""
        kinds = {path: _kind_of(column, path, definition) for path, column in columns_in(table)}
        return cls(kinds, table.left_out)

    @cached_property
    def levels(self) -> dict[str, LevelPaths]:
        """The columns of the messages (""), and of the elements of each sequence by its path."""
        levels = {"": LevelPaths({}, {})}
        sequence = ""
        for path in self.slots:
            if path.endswith("#"):
                sequence = path[:-1]
                parent = max(
                    (outer for outer in levels if sequence.startswith(f"{outer}.")), default=""
                )
                levels[parent].sequences[sequence.removeprefix(f"{parent}.")] = sequence
                levels[sequence] = LevelPaths({}, {})
            else:
                name = path.removeprefix(sequence).removeprefix(".") if sequence else path
                levels[sequence].columns[name] = path
        return levels

    def fits(self, table: Table) -> bool:
        """Whether the table has these columns, and no others, and leaves the same out."""
        paths = [path for path, _ in columns_in(table)]
        return self.left_out == table.left_out and paths == [*self.slots]

    def to_json(self) -> str:
        """Returns it as a person can read it; equal layouts give equal texts."""
        columns = {
            path: kind.dtype if kind.step == EXACT else f"{kind.dtype} {kind.step}"
            for path, kind in self.slots.items()
        }
        described = {"columns": columns, "left_out": dict(self.left_out)}
        return json.dumps(described, ensure_ascii=False)

    @classmethod
    def from_json(cls, text: str) -> Layout:
        """Returns the layout that was written so.

        Raises:
            ValueError, LookupError, TypeError: it is not one.
        """
        described = json.loads(text)
        slots = {}
        for path, words in dict(described["columns"]).items():
            dtype, _, step = str(words).partition(" ")
            slots[path] = ColumnKind(dtype, Step.parse(step) if step else EXACT)
        return cls(slots, described["left_out"])


class LevelPaths(NamedTuple):
    """The columns of messages or elements, and the sequences in them: by their names, the paths."""

    columns: dict[str, str]
    sequences: dict[str, str]


def columns_in(rows: Table | Elements, around: str = "") -> Iterator[tuple[str, Column]]:
    """Yields all columns of a table with their paths, in the order of `Layout.slots`."""
    for name, column in rows.columns.items():
        yield f"{around}{name}".rstrip("."), column
    for name, inner in rows.elements.items():
        yield f"{around}{name}#", inner.owners
        yield from columns_in(inner, f"{around}{name}.")


def _kind_of(column: Column, path: str, definition: Definition | None) -> ColumnKind:
    if isinstance(column, Texts):
        return ColumnKind("text")
    name = column.dtype.name
    return ColumnKind(name, step_of(path, definition) if column.dtype.kind == "f" else EXACT)
