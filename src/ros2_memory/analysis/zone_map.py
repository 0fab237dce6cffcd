"""Zone maps: a bound on what can be in the messages of one topic, to rule conditions out.

Databases call this data skipping: minima, maxima and distinct values of a block decide whether it
has to be read. A zone map never rules out what is there. Where it would grow too large, or a
message could not be decoded, it is open, and rules out nothing.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from numpy.typing import NDArray

MAX_WORDS: Final = 400
"""Distinct words that are stored of one topic in one bag; logs and UUIDs exceed it."""
MAX_WORD_CHARS: Final = 4_000
MAX_NUMBERS: Final = 16
"""Distinct numbers that are stored besides their range."""

WORD_END: Final = "\n"

_WORD: Final = re.compile(r"\w+")


class Box(NamedTuple):
    """The smallest box (m) around points; its `z` bounds are those of the points that have one.

    Where none has a `z`, `min_z` is above `max_z`.
    """

    min_x: float
    max_x: float
    min_y: float
    max_y: float
    min_z: float
    max_z: float

    def meets(self, x: float, y: float, z: float | None, reach: float) -> bool:
        """Returns whether some point of the box may be within `reach` (m) of a position.

        Errs on the side of yes: the slack is more than any rounding of a distance.
        """
        within = _near(self.min_x, self.max_x, x, reach) and _near(self.min_y, self.max_y, y, reach)
        return within and (z is None or _near(self.min_z, self.max_z, z, reach))

    def united(self, other: Box) -> Box:
        """Returns the box around both."""
        # Bounds alternate: the least and the greatest of each axis.
        low, high = map(min, self[::2], other[::2]), map(max, self[1::2], other[1::2])
        return Box(*chain.from_iterable(zip(low, high, strict=True)))


@dataclass(frozen=True, slots=True)
class ZoneMap:
    """What can be in the extracted values of some messages.

    Attributes:
        words: the distinct words of all strings, casefolded, each ended by `WORD_END`; None where
            they are too many. A word is a longest run of letters, digits and underscores.
        texts: whether there was any string at all, even without a word.
        booleans: the distinct booleans, in no order.
        low: the least number, rounded down to a float; above `high` if there is none.
        high: the greatest number, rounded up; NaN is no number.
        numbers: the distinct numbers; None where they are too many.
        box: around the positions that `near_position` tests; None without any.
        open: whether nothing can be ruled out.
    """

    words: str | None = ""
    texts: bool = False
    booleans: tuple[bool, ...] = ()
    low: float = math.inf
    high: float = -math.inf
    numbers: tuple[int | float, ...] | None = ()
    box: Box | None = None
    open: bool = False

    def can_contain_text(self, folded: str) -> bool:
        """Returns whether some string may contain this casefolded one."""
        if self.open:
            return True
        if not self.texts or self.words is None:
            return self.texts
        # A longest run in the needle is part of a longest run in any text that contains it.
        return all(word in self.words for word in words_of(folded))

    def can_contain_boolean(self, value: bool) -> bool:
        """Returns whether this boolean may be somewhere."""
        return self.open or value in self.booleans

    def can_contain_number(self, value: float) -> bool:
        """Returns whether a number equal to this one may be somewhere."""
        if self.open:
            return True
        if not (rounded(value, up=True) >= self.low and rounded(value, up=False) <= self.high):
            return False
        return self.numbers is None or value in self.numbers

    def can_contain_number_near(self, value: float, reach: float) -> bool:
        """Returns whether a number within `reach` of this one may be somewhere."""
        return self.open or _near(self.low, self.high, value, reach)

    def can_contain_place(self, x: float, y: float, z: float | None, reach: float) -> bool:
        """Returns whether a position within `reach` (m) of this one may be there."""
        return self.open or (self.box is not None and self.box.meets(x, y, z, reach))


class Boxes:
    """The boxes of many zone maps as one array, to compare a position with all of them at once.

    A zone map without a position has none; that of one which is open is `EVERYWHERE`.
    """

    def __init__(self, by_number: Mapping[int, Box | None]) -> None:
        self._numbers = list(by_number)
        boxes = [each or _NOWHERE for each in by_number.values()]
        self._bounds: NDArray[np.float64] = np.array(boxes, dtype=np.float64).reshape(-1, 6).T

    def meeting(self, x: float, y: float, z: float | None, reach: float) -> set[int]:
        """Returns the numbers of the zone maps that may have a point within `reach` (m) of this."""
        within = np.ones(len(self._numbers), dtype=np.bool_)
        for axis, value in enumerate((x, y) if z is None else (x, y, z)):
            slack = _slack(value, reach)
            within &= self._bounds[2 * axis] <= value + reach + slack
            within &= self._bounds[2 * axis + 1] >= value - reach - slack
        return {self._numbers[at] for at in np.flatnonzero(within)}


EVERYWHERE: Final = Box(-math.inf, math.inf, -math.inf, math.inf, -math.inf, math.inf)
_NOWHERE: Final = Box(math.inf, -math.inf, math.inf, -math.inf, math.inf, -math.inf)

UNBOUNDED: Final = ZoneMap(words=None, texts=True, numbers=None, open=True)
"""The zone map of messages of which nothing is known."""


def words_of(folded: str) -> list[str]:
    """Returns the words of a casefolded string."""
    return _WORD.findall(folded)


def united(zone_maps: Iterable[ZoneMap]) -> ZoneMap:
    """Returns the zone map of several together, without the distinct numbers."""
    words: set[str] | None = set()
    texts, booleans, low, high = False, set[bool](), math.inf, -math.inf
    box: Box | None = None
    for each in zone_maps:
        if each.open:
            return UNBOUNDED
        if words is not None and each.words is not None:
            words.update(each.words.split(WORD_END))
        else:
            words = None
        texts = texts or each.texts
        booleans.update(each.booleans)
        low, high = min(low, each.low), max(high, each.high)
        if each.box is not None:
            box = each.box if box is None else box.united(each.box)
    joined = None if words is None else joined_words(words)
    return ZoneMap(joined, texts, tuple(sorted(booleans)), low, high, None, box)


def joined_words(words: Iterable[str]) -> str:
    """Returns words in the form in which `ZoneMap` stores them."""
    return "".join(f"{word}{WORD_END}" for word in sorted(words) if word)


def rounded(number: float, *, up: bool) -> float:
    """Returns a float that is not below the number, or not above it; an int may be of any size."""
    try:
        near = float(number)
    except OverflowError:
        near = math.inf if number > 0 else -math.inf
    if near == number or math.isnan(near):
        return near
    if up:
        return near if near > number else math.nextafter(near, math.inf)
    return near if near < number else math.nextafter(near, -math.inf)


def _near(low: float, high: float, value: float, reach: float) -> bool:
    slack = _slack(value, reach)
    return low <= value + reach + slack and high >= value - reach - slack


def _slack(value: float, reach: float) -> float:
    """Returns more than any rounding of a distance."""
    return 1e-9 * (1 + abs(value) + reach)
