"""Collects, message by message, the evidence of what one topic can have said.

Pure: it is given values, or rows of the payloads of a mould, and reads nothing itself.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.conditions import leaves, positions
from ros2_memory.analysis.zone_map import (
    MOST_NUMBERS,
    MOST_WORD_CHARS,
    MOST_WORDS,
    UNBOUNDED,
    Box,
    ZoneMap,
    joined_words,
    rounded,
    words_of,
)

if TYPE_CHECKING:
    from ros2_memory.analysis.bulk_decode import Bytes, PayloadTemplate
    from ros2_memory.core.model import JsonValue

MOST_TEXTS: Final = 2_000
"""Distinct texts of one topic that are looked at before its words count as too many."""
_MOST_TEXT_CHARS: Final = 1 << 20
"""The words of a longer text alone would take more memory than it."""
_LARGEST: Final = 1e300


class ZoneMapBuilder:
    """Takes extracted values, and says what can have stood in them."""

    def __init__(self) -> None:
        self._open = False
        self._strings: set[str] = set()
        self._words: set[str] | None = set()
        self._chars = 0
        self._booleans: set[bool] = set()
        self._low = math.inf
        self._high = -math.inf
        self._numbers: set[int | float] | None = set()
        self._box: Box | None = None

    def give_up(self) -> None:
        """A message whose value is not known: nothing can be ruled out any more."""
        self._open = True

    def add(self, value: JsonValue) -> None:
        """Takes the exact value of one message."""
        if self._open:
            return
        numbers: list[int | float] = []
        for leaf in leaves(value):
            if isinstance(leaf, str):
                self._add_text(leaf)
            elif isinstance(leaf, bool):
                self._booleans.add(leaf)
            elif isinstance(leaf, int) or (isinstance(leaf, float) and not math.isnan(leaf)):
                numbers.append(leaf)
        if numbers:
            self._add_numbers(numbers)
            for x, y, z in positions(value):
                self._add_place(x, y, z)

    def add_rows(self, mould: PayloadTemplate, rows: Bytes) -> None:
        """Takes many messages of a mould of which one was added as a value."""
        if self._open:
            return
        for offset in mould.numbers:
            column = mould.column(rows, offset)
            numbers = column[~np.isnan(column)]
            if numbers.size:
                self._add_numbers(np.unique(numbers).tolist())
        for offset in mould.times:
            self._add_numbers(mould.seconds(rows, offset))
        if mould.angles:
            self._add_numbers([-180.0, 180.0])
            self._numbers = None
        for place in mould.points:
            points = np.array(mould.coordinates(rows, place), dtype=np.float64)
            here = points[np.isfinite(points[:, 0]) & np.isfinite(points[:, 1])]
            if here.size:
                self._add_places(here)

    def zone_map(self) -> ZoneMap:
        """What the values so far can have held."""
        if self._open:
            return UNBOUNDED
        return ZoneMap(
            words=None if self._words is None else joined_words(self._words),
            texts=bool(self._strings),
            booleans=tuple(sorted(self._booleans)),
            low=self._low,
            high=self._high,
            numbers=None if self._numbers is None else tuple(self._numbers),
            box=self._box,
        )

    def _add_text(self, text: str) -> None:
        if text in self._strings or (self._words is None and self._strings):
            return
        self._strings.add(text)
        if self._words is None or len(text) > _MOST_TEXT_CHARS:
            self._words = None
            return
        fresh = set(words_of(text.casefold())) - self._words
        self._chars += sum(len(word) + 1 for word in fresh)
        many = len(self._strings) > MOST_TEXTS or len(self._words) + len(fresh) > MOST_WORDS
        if many or self._chars > MOST_WORD_CHARS:
            self._words = None
        else:
            self._words |= fresh

    def _add_numbers(self, numbers: list[int | float]) -> None:
        low, high = min(numbers), max(numbers)
        if low < self._low:
            self._low = rounded(low, up=False)
        if high > self._high:
            self._high = rounded(high, up=True)
        if self._numbers is not None:
            self._numbers.update(numbers[: MOST_NUMBERS + 1])
            # JSON may hold whole numbers of any length.
            huge = max(abs(low), abs(high)) > _LARGEST
            if huge or len(numbers) > MOST_NUMBERS or len(self._numbers) > MOST_NUMBERS:
                self._numbers = None

    def _add_places(self, points: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> None:
        heights = points[np.isfinite(points[:, 2]), 2]
        low_z, high_z = (heights.min(), heights.max()) if heights.size else (math.inf, -math.inf)
        (min_x, min_y, _), (max_x, max_y, _) = points.min(axis=0), points.max(axis=0)
        bounds = (min_x, max_x, min_y, max_y, low_z, high_z)
        box = Box(*(float(bound) for bound in bounds))
        self._box = box if self._box is None else self._box.united(box)

    def _add_place(self, x: float, y: float, z: float) -> None:
        if not (math.isfinite(x) and math.isfinite(y)):
            return
        low_z, high_z = (z, z) if math.isfinite(z) else (math.inf, -math.inf)
        here = Box(x, x, y, y, low_z, high_z)
        self._box = here if self._box is None else self._box.united(here)
