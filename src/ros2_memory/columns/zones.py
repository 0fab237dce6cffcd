"""The zones of a column over many parts, as arrays: one comparison rules out a week of them."""

from __future__ import annotations

import math
import sys
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.columns.table import Zone, as_float, may_be_in
from ros2_memory.core.arrays import places_among

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from ros2_memory.columns.stored import Topic
    from ros2_memory.core.arrays import Flags
    from ros2_memory.storage.base import IntArray

    Floats = NDArray[np.float64]

_EXACT_BELOW: Final = 2.0**53
_ANY: Final = -1
"""The code of a zone whose words are not known."""


class Zones(NamedTuple):
    """The zones of one column in several parts.

    Attributes:
        parts: the numbers of the parts, ascending.
        low: a bound that no value of the part is below; infinity if it has none.
        high: a bound that no value of the part is above; minus infinity if it has none.
        codes: the place in `words` of the part's words; -1 if any text may be there.
        words: the distinct `Zone.words` of the parts.
    """

    parts: IntArray
    low: Floats
    high: Floats
    codes: IntArray
    words: tuple[str, ...] = ()

    @classmethod
    def of(cls, parts: Sequence[int], zones: Sequence[Zone]) -> Zones:
        """Returns the zones of parts, whose numbers ascend."""
        code_of: dict[str, int] = {}
        codes = [
            _ANY if zone.words is None else code_of.setdefault(zone.words, len(code_of))
            for zone in zones
        ]
        return cls(
            np.array(parts, np.int64),
            _bounds([zone.low for zone in zones], -math.inf),
            _bounds([zone.high for zone in zones], math.inf),
            np.array(codes, np.int64),
            tuple(code_of),
        )

    def among(self, parts: IntArray) -> Zones:
        """Returns the zones of some parts, in their order; unknown ones may have any value."""
        places, is_known = places_among(parts, self.parts)
        at = np.where(is_known, places, -1)
        return Zones(
            parts,
            np.append(self.low, -math.inf)[at],
            np.append(self.high, math.inf)[at],
            np.append(self.codes, _ANY)[at],
            self.words,
        )

    def joined(self, newer: Zones) -> Zones:
        """Returns these zones and those of newer parts."""
        code_of = {words: code for code, words in enumerate(self.words)}
        newer_codes = [code_of.setdefault(words, len(code_of)) for words in newer.words]
        recoded = np.array([*newer_codes, _ANY], np.int64)  # at the end, so for code -1: -1
        return Zones(
            np.concatenate((self.parts, newer.parts)),
            np.concatenate((self.low, newer.low)),
            np.concatenate((self.high, newer.high)),
            np.concatenate((self.codes, recoded[newer.codes])),
            tuple(code_of),
        )

    def divided(self, by: int) -> Zones:
        """Returns the zones of the values divided by a positive number."""
        return self._replace(low=self.low / by, high=self.high / by)

    def spans(self, number: float) -> Flags:
        """Returns which parts may have a number as a value."""
        at = as_float(number)
        return (self.low <= at) & (at <= self.high)

    def reaches(self, limit: float, *, above: bool) -> Flags:
        """Returns which parts may have a value above a limit, or else below it."""
        # An integer that no float reaches is below infinity all the same.
        at = min(max(as_float(limit), -sys.float_info.max), sys.float_info.max)
        return self.high > at if above else self.low < at

    def may_be_near(self, place: float, distance: float) -> Flags:
        """Returns which parts may have a value within a distance of a place."""
        return (self.low - place <= distance) & (place - self.high <= distance)

    def may_have(self, text: str) -> Flags:
        """Returns which parts may have a value that contains a casefolded text."""
        return self._where(lambda words: may_be_in(words, text))

    @property
    def may_be_json(self) -> Flags:
        """Which parts may have a text that is a JSON array or object."""
        return self._where(lambda words: may_be_in(words, "[") or may_be_in(words, "{"))

    @property
    def memory_bytes(self) -> int:
        """About how much memory it takes."""
        return 32 * self.parts.size + sum(60 + len(words) for words in self.words)

    def _where(self, may_have: Callable[[str], bool]) -> Flags:
        """Returns which parts have words of which `may_have` is true, or unknown words."""
        flags = np.ones(len(self.words) + 1, np.bool_)
        for code in np.unique(self.codes[self.codes != _ANY]).tolist():
            flags[code] = may_have(self.words[code])
        return flags[self.codes]


class PartZones(NamedTuple):
    """Some parts of one topic, of which only zones are read.

    Attributes:
        topic: the topic.
        numbers: of the parts.
        zones: returns the zones of a column by its path.
    """

    topic: Topic
    numbers: IntArray
    zones: Callable[[str], Zones]

    def zone(self, path: str) -> Zones:
        """Returns the zones of a column; of elements its path is `<sequence>.<column>`."""
        return self.zones(path.rstrip("."))


def _bounds(values: Sequence[float], away: float) -> Floats:
    """Returns bounds as floats; those that are rounded are moved one float farther away."""
    bounds = np.array([float(value) for value in values], np.float64)
    is_rounded = (np.abs(bounds) >= _EXACT_BELOW) & np.isfinite(bounds)
    with np.errstate(over="ignore"):  # beyond the greatest float lies infinity
        return np.where(is_rounded, np.nextafter(bounds, away), bounds)
