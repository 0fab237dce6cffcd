"""In which rows of a table, and elements of its lists, the extracted value has a field."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ros2_memory.columns.values import Leaf, Level, UnknownShapeError, Values

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ros2_memory.storage.base import IntArray, Mask


class TruthValues(NamedTuple):
    """Of some rows or elements: which surely have a field, and which may have it."""

    surely: Mask
    perhaps: Mask

    @classmethod
    def known(cls, stands: Mask) -> TruthValues:
        """Returns that these have it and no others."""
        return cls(stands, stands)

    @property
    def unsure(self) -> Mask:
        """Which may have it or not."""
        return self.perhaps & ~self.surely

    @property
    def is_settled(self) -> bool:
        """Whether it is known everywhere."""
        return not self.unsure.any()

    @property
    def is_none(self) -> bool:
        """Whether none has it."""
        return not self.perhaps.any()


def nowhere(size: int) -> TruthValues:
    """Returns that so many rows or elements do not have a value."""
    return TruthValues(np.zeros(size, np.bool_), np.zeros(size, np.bool_))


def unknown(size: int) -> TruthValues:
    """Returns that nothing is known of so many rows or elements."""
    return TruthValues(np.zeros(size, np.bool_), np.ones(size, np.bool_))


class Limit(NamedTuple):
    """Which rows or elements of a level have a field in the extracted value.

    Attributes:
        level: the level that it is about.
        find: returns which of some rows or elements of the level have it; may raise
            `UnknownShapeError`.
    """

    level: Level
    find: Callable[[Values, IntArray], TruthValues]

    def kept(self, values: Values, positions: IntArray) -> TruthValues:
        """Returns which of some rows or elements of the level have it."""
        try:
            return self.find(values, positions)
        except UnknownShapeError:
            return unknown(len(positions))


def at_place(level: Level, place: int) -> Limit:
    """Returns the limit to the element at this place of each list; negative from the end."""

    def find(values: Values, positions: IntArray) -> TruthValues:
        return TruthValues.known(values.places(level, positions, from_end=place < 0) == place)

    return Limit(level, find)


def at_name(level: Level, names: Leaf, name: str, nth: int | None = None) -> Limit:
    """Returns the limit to the element that has this name in the list of names beside it.

    Of an array of fixed length, whose elements are columns of their own: to rows where it is `nth`.
    """

    def find(values: Values, positions: IntArray) -> TruthValues:
        texts, owners = values.texts(names), values.elements(names.level).owners
        has_name = np.array([word == name for word in texts.words], np.bool_)[texts.codes]
        found = np.flatnonzero(has_name)[::-1]  # the first of a row is written last
        places = np.full(values.rows, -1)
        places[owners[found]] = values.places(names.level, found, from_end=False)
        if nth is not None:
            return TruthValues.known(places[positions] == nth)
        at = values.places(level, positions, from_end=False)
        return TruthValues.known(at == places[values.elements(level).owners[positions]])

    return Limit(level, find)


def where_longer(level: Level, sequence: str, count: int, *, is_longer: bool) -> Limit:
    """Returns the limit to sequences of more numbers than this, or else of no more."""

    def find(values: Values, positions: IntArray) -> TruthValues:
        lengths = values.numeric(level, f"{sequence}.length")
        if lengths is None:
            return unknown(len(positions))
        return TruthValues.known((lengths[positions] > count) == is_longer)

    return Limit(level, find)


def placed(
    values: Values, level: Level, positions: IntArray, limits: Sequence[Limit], *, surely: bool
) -> tuple[IntArray, IntArray]:
    """Returns which of some rows or elements have a field, and the row of each.

    Args:
        values: of the table.
        level: of the rows or elements.
        positions: their positions.
        limits: on which have it.
        surely: whether those that may have it or not are left out.
    """
    current, kept, owners = level, positions, positions
    while True:
        for limit in limits:
            if limit.level == current and len(kept):
                mask = limit.kept(values, owners)[0 if surely else 1]
                kept, owners = kept[mask], owners[mask]
        if current.parent is None:
            return kept, owners
        owners, current = values.elements(current).owners[owners], current.parent
