"""Builds the zone map of one topic, message by message or by rows of payloads of a template."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.conditions import POSITION_KEYS, own_positions
from ros2_memory.analysis.zone_map import (
    MAX_NUMBERS,
    MAX_WORD_CHARS,
    MAX_WORDS,
    UNBOUNDED,
    Box,
    ZoneMap,
    joined_words,
    rounded,
    words_of,
)
from ros2_memory.core.timebase import unix_from_ns

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.analysis.payload_templates import Bytes, PayloadTemplate
    from ros2_memory.core.model import JsonValue

MAX_TEXTS: Final = 2_000
"""Distinct strings of one topic that are examined before its words count as too many."""
_MAX_TEXT_CHARS: Final = 1 << 20
"""The words of a longer text alone would take more memory than it."""
_LARGEST: Final = 1e300


class ZoneMapBuilder:
    """Takes extracted values, and bounds what can be in them."""

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
        """Takes a message whose value is not known: nothing can be ruled out any more."""
        self._open = True

    def add(self, value: JsonValue) -> Sequence[str]:
        """Takes the exact value of one message; returns its texts, unless nothing is ruled out."""
        if self._open:
            return ()
        texts: list[str] = []
        booleans: list[bool] = []
        numbers: list[int | float] = []
        places: list[JsonValue] = []
        _sort(value, texts, booleans, numbers, places)
        for text in texts:
            self._add_text(text)
        self._booleans.update(booleans)
        if numbers:
            self._add_numbers(numbers)
            own = list(own_positions(value))
            for x, y, z in own or (each for place in places for each in own_positions(place)):
                if math.isfinite(x) and math.isfinite(y):
                    low_z, high_z = (z, z) if math.isfinite(z) else (math.inf, -math.inf)
                    self._add_box(Box(x, x, y, y, low_z, high_z))
        return texts

    def add_rows(self, template: PayloadTemplate, rows: Bytes) -> None:
        """Takes many messages of a template, the first of which was added as a value."""
        if self._open:
            return
        # Times first: these are many, and of numbers that are too many only the ends are taken.
        for _, offsets in template.times:
            for offset in offsets:
                times = template.nanoseconds(rows, offset)
                ends = [int(times.min()), int(times.max())]
                few = self._numbers is not None and len(times) <= MAX_NUMBERS
                self._add_numbers([*map(unix_from_ns, times.tolist() if few else ends)])
                if not few:
                    self._numbers = None
        for offset in template.numbers:
            column = template.column(rows, offset)
            numbers = column[~np.isnan(column)]
            if numbers.size and self._numbers is None:
                self._add_numbers([float(numbers.min()), float(numbers.max())])
            elif numbers.size:
                self._add_numbers(np.unique(numbers).tolist())
        if template.angles:
            self._add_numbers([-180.0, 180.0])
            self._numbers = None
        for point in template.points:
            self._add_points(np.array(template.coordinates(rows, point), dtype=np.float64))

    def zone_map(self) -> ZoneMap:
        """Returns the zone map of the values so far."""
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
        if self._words is None or len(text) > _MAX_TEXT_CHARS:
            self._words = None
            return
        fresh = set(words_of(text.casefold())) - self._words
        self._chars += sum(len(word) + 1 for word in fresh)
        many = len(self._strings) > MAX_TEXTS or len(self._words) + len(fresh) > MAX_WORDS
        if many or self._chars > MAX_WORD_CHARS:
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
            self._numbers.update(numbers[: MAX_NUMBERS + 1])
            # JSON may hold whole numbers of any length.
            huge = max(abs(low), abs(high)) > _LARGEST
            if huge or len(numbers) > MAX_NUMBERS or len(self._numbers) > MAX_NUMBERS:
                self._numbers = None

    def _add_points(self, points: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> None:
        points = points[np.isfinite(points[:, :2]).all(axis=1)]
        if not points.size:
            return
        heights = points[np.isfinite(points[:, 2]), 2]
        low_z, high_z = (heights.min(), heights.max()) if heights.size else (math.inf, -math.inf)
        (min_x, min_y, _), (max_x, max_y, _) = points.min(axis=0), points.max(axis=0)
        bounds = (min_x, max_x, min_y, max_y, low_z, high_z)
        self._add_box(Box(*(float(bound) for bound in bounds)))

    def _add_box(self, box: Box) -> None:
        self._box = box if self._box is None else self._box.united(box)


def _sort(
    value: JsonValue,
    texts: list[str],
    booleans: list[bool],
    numbers: list[int | float],
    places: list[JsonValue],
) -> None:
    """Sorts what is in a value by kind, without NaN; places are what may hold a position."""
    waiting: list[JsonValue] = [value]
    while waiting:
        node = waiting.pop()
        if isinstance(node, dict):
            waiting.extend(node.values())
            places.extend(node[key] for key in POSITION_KEYS if key in node)
        elif isinstance(node, str):
            texts.append(node)
        elif isinstance(node, bool):
            booleans.append(node)
        elif isinstance(node, list):
            waiting.extend(node)
        # NaN is equal to nothing; `isnan` takes no whole number that is beyond a float.
        elif node is not None and node == node:  # noqa: PLR0124 - false for NaN
            numbers.append(node)
