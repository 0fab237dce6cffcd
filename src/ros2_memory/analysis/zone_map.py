"""What the messages of one topic can have said: enough to rule out that a condition held.

Evidence never rules out what was there. Where it would have grown too large, or a message could
not be decoded, it is open, and rules out nothing.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from numpy.typing import NDArray

MOST_WORDS: Final = 400
"""Distinct words that are kept of one topic in one bag; a topic of logs or UUIDs passes it."""
MOST_WORD_CHARS: Final = 4_000
MOST_NUMBERS: Final = 16
"""Distinct numbers that are kept besides their span."""

WORD_END: Final = "\n"

_WORD: Final = re.compile(r"\w+")


class Box(NamedTuple):
    """The smallest box (m) around places; its `z` bounds are those of the places that have one.

    Where none has a `z`, `min_z` is above `max_z`.
    """

    min_x: float
    max_x: float
    min_y: float
    max_y: float
    min_z: float
    max_z: float

    def meets(self, x: float, y: float, z: float | None, reach: float) -> bool:
        """Whether some point of the box may lie within `reach` (m) of a place, in the plane or not.

        Says yes a little too often: the slack is more than any rounding of a distance.
        """
        within = _near(self.min_x, self.max_x, x, reach) and _near(self.min_y, self.max_y, y, reach)
        return within and (z is None or _near(self.min_z, self.max_z, z, reach))

    def united(self, other: Box) -> Box:
        """The box around both."""
        return Box(
            min(self.min_x, other.min_x),
            max(self.max_x, other.max_x),
            min(self.min_y, other.min_y),
            max(self.max_y, other.max_y),
            min(self.min_z, other.min_z),
            max(self.max_z, other.max_z),
        )


@dataclass(frozen=True, slots=True)
class ZoneMap:
    """What can have stood in the extracted values of some messages.

    Attributes:
        words: the distinct words of all texts, casefolded, each ended by `WORD_END`; None where
            they are too many. A word is a longest run of letters, digits and underscores.
        texts: whether there was any text at all, be it without a word.
        booleans: the distinct booleans, in no order.
        low: the least number, rounded down to a float; above `high` where there is none.
        high: the greatest number, rounded up; NaN is no number.
        numbers: the distinct numbers; None where they are too many.
        box: around the places that `near_position` looks at; None without any.
        open: nothing can be ruled out.
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
        """Whether some text may contain this casefolded one."""
        if self.open:
            return True
        if not self.texts or self.words is None:
            return self.texts
        # A longest run in the needle is part of a longest run in any text that contains it.
        return all(word in self.words for word in words_of(folded))

    def can_contain_boolean(self, value: bool) -> bool:
        """Whether this boolean may stand somewhere."""
        return self.open or value in self.booleans

    def can_contain_number(self, value: float) -> bool:
        """Whether a number equal to this one may stand somewhere."""
        if self.open:
            return True
        if not (rounded(value, up=True) >= self.low and rounded(value, up=False) <= self.high):
            return False
        return self.numbers is None or value in self.numbers

    def can_contain_number_near(self, value: float, reach: float) -> bool:
        """Whether a number within `reach` of this one may stand somewhere."""
        return self.open or _near(self.low, self.high, value, reach)

    def can_contain_place(self, x: float, y: float, z: float | None, reach: float) -> bool:
        """Whether a place within `reach` (m) of this one may stand where it is looked for."""
        return self.open or (self.box is not None and self.box.meets(x, y, z, reach))


class Boxes:
    """The boxes of many pieces of evidence, to be asked of one place all at once."""

    def __init__(self, evidence: Mapping[int, ZoneMap]) -> None:
        self._numbers = list(evidence)
        boxes = [_EVERYWHERE if each.open else each.box or _NOWHERE for each in evidence.values()]
        self._bounds: NDArray[np.float64] = np.array(boxes, dtype=np.float64).reshape(-1, 6).T

    def meeting(self, x: float, y: float, z: float | None, reach: float) -> set[int]:
        """The numbers of the evidence that may hold a place within `reach` (m) of this one."""
        within = np.ones(len(self._numbers), dtype=np.bool_)
        for axis, value in enumerate((x, y) if z is None else (x, y, z)):
            slack = _slack(value, reach)
            within &= self._bounds[2 * axis] <= value + reach + slack
            within &= self._bounds[2 * axis + 1] >= value - reach - slack
        return {self._numbers[at] for at in np.flatnonzero(within)}


_EVERYWHERE: Final = Box(-math.inf, math.inf, -math.inf, math.inf, -math.inf, math.inf)
_NOWHERE: Final = Box(math.inf, -math.inf, math.inf, -math.inf, math.inf, -math.inf)

UNBOUNDED: Final = ZoneMap(words=None, texts=True, numbers=None, open=True)
"""Of messages of which nothing is known."""


def words_of(folded: str) -> list[str]:
    """The words of a casefolded text."""
    return _WORD.findall(folded)


def united(evidence: Iterable[ZoneMap]) -> ZoneMap:
    """What can have stood in any of several, without the distinct numbers."""
    words: set[str] | None = set()
    texts, booleans, low, high = False, set[bool](), math.inf, -math.inf
    box: Box | None = None
    for each in evidence:
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
    """Words as `ZoneMap` keeps them."""
    return "".join(f"{word}{WORD_END}" for word in sorted(words) if word)


def rounded(number: float, *, up: bool) -> float:
    """The number (an int of any size, too) as a float that is not below it, or not above it."""
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
    """More than any rounding of a distance."""
    return 1e-9 * (1 + abs(value) + reach)
