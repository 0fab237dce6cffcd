"""The zones of a column over many parts, as arrays: one comparison rules out a week of them."""

from __future__ import annotations

import math
import sys
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.columns.table import Zone, as_float, may_be_in

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from ros2_memory.columns.stored import Topic
    from ros2_memory.core.arrays import Flags
    from ros2_memory.storage.base import Channel, Definition, IntArray

    Floats = NDArray[np.float64]

_EXACT_BELOW: Final = 2.0**53
_ANY: Final = -1
"""The code of a zone whose words are not known."""


class Zones(NamedTuple):
    """The zones of one column in several parts: what `Zone` is of one.

    Attributes:
        parts: the numbers of the parts, ascending.
        low: no value of the part is less; infinity where it has none.
        high: no value is greater; minus infinity where it has none.
        codes: which of `words` are those of the part; -1: any may be there.
        words: the different ones, as `Zone.words`.
    """

    parts: IntArray
    low: Floats
    high: Floats
    codes: IntArray
    words: tuple[str, ...] = ()

    @classmethod
    def of(cls, parts: Sequence[int], zones: Sequence[Zone]) -> Zones:
        """Returns the zones of some parts, whose numbers ascend."""
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
        """Returns the zones of some parts, in their order; of one that is not known, any value."""
        if not self.parts.size:
            nothing = np.full(parts.size, math.inf)
            return Zones(parts, -nothing, nothing, np.full(parts.size, _ANY))
        at = np.minimum(np.searchsorted(self.parts, parts), self.parts.size - 1)
        is_known = self.parts[at] == parts
        return Zones(
            parts,
            np.where(is_known, self.low[at], -math.inf),
            np.where(is_known, self.high[at], math.inf),
            np.where(is_known, self.codes[at], _ANY),
            self.words,
        )

    def joined(self, newer: Zones) -> Zones:
        """Returns these and those of newer parts."""
        code_of = {words: code for code, words in enumerate(self.words)}
        newer_codes = [code_of.setdefault(words, len(code_of)) for words in newer.words]
        recoded = np.array([*newer_codes, _ANY], np.int64)  # the last stands for -1, too
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
        """Returns in which parts a number may be a value."""
        at = as_float(number)
        return (self.low <= at) & (at <= self.high)

    def reaches(self, limit: float, *, above: bool) -> Flags:
        """Returns in which parts some value may lie above a limit, or below it."""
        # An integer that no float reaches is below infinity all the same.
        at = min(max(as_float(limit), -sys.float_info.max), sys.float_info.max)
        return self.high > at if above else self.low < at

    def may_be_near(self, place: float, distance: float) -> Flags:
        """Returns in which parts some value may be within a distance of a place."""
        return (self.low - place <= distance) & (place - self.high <= distance)

    def may_have(self, text: str) -> Flags:
        """Returns in which parts a casefolded text may be part of a value."""
        return self._where(lambda words: may_be_in(words, text))

    @property
    def may_be_json(self) -> Flags:
        """In which parts a text may be a JSON array or object."""
        return self._where(lambda words: may_be_in(words, "[") or may_be_in(words, "{"))

    @property
    def memory_bytes(self) -> int:
        """About how much memory it takes."""
        return 32 * self.parts.size + sum(60 + len(words) for words in self.words)

    def _where(self, may_have: Callable[[str], bool]) -> Flags:
        """Returns in which parts words may have something; these may be few of many."""
        flags = np.ones(len(self.words) + 1, np.bool_)
        for code in np.unique(self.codes[self.codes != _ANY]).tolist():
            flags[code] = may_have(self.words[code])
        return flags[self.codes]


class PartZones(NamedTuple):
    """What is known of some parts of one topic without reading any.

    Attributes:
        topic: what they are of.
        numbers: of the parts.
        zones: returns the zones of a column, by its path.
    """

    topic: Topic
    numbers: IntArray
    zones: Callable[[str], Zones]

    @property
    def channel(self) -> Channel:
        """The topic's channel."""
        return self.topic.channel

    @property
    def definition(self) -> Definition | None:
        """The fields of its type; None where they are not known."""
        return self.topic.definition

    @property
    def left_out(self) -> Mapping[str, str]:
        """Which fields have no column, as of a table."""
        return self.topic.layout.left_out

    def zone(self, path: str) -> Zones:
        """Returns the zones of a column; of elements its path is `<sequence>.<column>`."""
        return self.zones(path.rstrip("."))


def _bounds(values: Sequence[float], away: float) -> Floats:
    """Returns bounds as floats: where these are rounded, the next one farther out."""
    bounds = np.array([float(value) for value in values], np.float64)
    is_rounded = (np.abs(bounds) >= _EXACT_BELOW) & np.isfinite(bounds)
    with np.errstate(over="ignore"):  # beyond the greatest float lies infinity
        return np.where(is_rounded, np.nextafter(bounds, away), bounds)
