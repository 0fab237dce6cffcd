"""Compares tables with decoded messages, leaf by leaf, without the plan they were made by."""

import dataclasses
import keyword
import math
from collections.abc import Callable, Container, Iterator, Sequence

import numpy as np

from ros2_memory.columns.table import MAX_NUMBERS, MAX_RANGED_BYTES, Elements, Table, Texts

FILLER = "structure_needs_at_least_one_member"
TIMES = {"builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"}


class Comparison:
    """What differs of what was compared. All columns must have been met.

    `error` returns by how much the numbers of a column may differ, by its path from the table.
    """

    def __init__(self, error: Callable[[str], float] = lambda _: 0.0) -> None:
        self._error = error
        self.wrong: list[str] = []

    def table(self, table: Table, messages: Sequence[object]) -> None:
        """Compares the rows of a table with messages in their order."""
        self._rows(table, messages, table.channel.topic)

    def _rows(
        self, rows: Table | Elements, values: Sequence[object], where: str, around: str = ""
    ) -> None:
        """Compares the columns of a table or of elements with a message for each row."""
        columns: dict[str, list[object]] = {
            path: list(column.values() if isinstance(column, Texts) else column.tolist())
            for path, column in rows.columns.items()
        }
        lengths = {len(rows), *map(len, columns.values())}
        if lengths != {len(values)}:
            self.wrong.append(f"{where}: {lengths} rows for {len(values)} messages")
            return
        met: set[str] = set()
        lists: dict[str, list[tuple[int, list[object]]]] = {path: [] for path in rows.elements}
        for row, value in enumerate(values):
            for path, leaf in leaves(value):
                for own, expected in _of_array(path, leaf, columns, rows.elements):
                    if isinstance(expected, list):
                        lists.setdefault(own, []).append((row, expected))
                        continue
                    met.add(own)
                    found = columns[own][row] if own in columns else "no column"
                    allowed = self._error(f"{around}{own}") if own in columns else 0.0
                    self._leaf(f"{where} {own}[{row}]", found, expected, allowed)
        if values:
            self.wrong += [f"{where} {path}: extra" for path in columns.keys() - met]
        for path, found_lists in lists.items():
            inner = rows.elements.get(path)
            self._elements(inner, found_lists, f"{where} {path}", f"{around}{path}.")

    def _leaf(self, where: str, found: object, expected: object, allowed: float) -> None:
        if not same(found, expected) and not _is_near(found, expected, allowed):
            self.wrong.append(f"{where}: {found!r} for {expected!r}")

    def _elements(
        self,
        elements: Elements | None,
        lists: list[tuple[int, list[object]]],
        where: str,
        around: str,
    ) -> None:
        """Compares elements with the list of each row."""
        owners = [row for row, entries in lists for _ in entries]
        if elements is None or owners != elements.owners.tolist():
            self.wrong.append(f"{where}: elements are missing, or belong to other rows")
            return
        self._rows(elements, [entry for _, entries in lists for entry in entries], where, around)


def _is_near(found: object, expected: object, allowed: float) -> bool:
    if not isinstance(found, float) or not isinstance(expected, float):
        return False
    return abs(found - expected) <= allowed


def leaves(value: object, path: str = "") -> Iterator[tuple[str, object]]:
    """The leaves of a decoded message by dot-path; times as ns, sequences of messages as lists."""
    kind = getattr(value, "__msgtype__", "")
    if kind in TIMES:
        yield path, value.sec * 10**9 + value.nanosec  # type: ignore[attr-defined]
    elif dataclasses.is_dataclass(value):
        for entry in dataclasses.fields(value):
            if entry.name == FILLER or str(entry.type).startswith("ClassVar"):
                continue
            name = entry.name.removesuffix("_")
            name = name if keyword.iskeyword(name) else entry.name
            yield from leaves(getattr(value, entry.name), f"{path}.{name}" if path else name)
    else:
        yield path, value


def _of_array(
    path: str, leaf: object, columns: dict[str, list[object]], elements: Container[str]
) -> Iterator[tuple[str, object]]:
    """What stands for a leaf: itself, or for an array its length, bounds and short content."""
    if not isinstance(leaf, np.ndarray):
        yield path, leaf
        return
    numbers = leaf.tolist()
    is_sequence = path in elements
    if f"{path}.0" in columns and not is_sequence:
        for nth, number in enumerate(numbers):
            yield f"{path}.{nth}", number
        return
    yield f"{path}.length", len(numbers)
    ranged = leaf.nbytes <= MAX_RANGED_BYTES
    finite = [float(each) for each in numbers if math.isfinite(each)] if ranged else []
    if is_sequence or ranged:
        yield f"{path}.least", min(finite, default=math.nan)
        yield f"{path}.greatest", max(finite, default=math.nan)
    if is_sequence:
        yield path, numbers if len(numbers) <= MAX_NUMBERS else []


def same(found: object, expected: object) -> bool:
    """Whether two values are equal, NaN with NaN, and of one kind."""
    if isinstance(found, bool) != isinstance(expected, bool | np.bool_):
        return False
    if isinstance(found, float) and math.isnan(found):
        return isinstance(expected, float) and math.isnan(expected)
    return bool(found == expected)
