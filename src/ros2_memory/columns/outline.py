"""What is known of the columns of a part besides their zones, without unpacking them again.

Of numbers how many there are, their sum, and when the least and the greatest was; of texts that are
too many to be listed (JSON, lines of a log) which rows of letters are in which row. It is made
while filling, and is there also where a column was dropped.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple, cast

import numpy as np

from ros2_memory.columns.fragments import FragmentKind
from ros2_memory.columns.table import IN_PART, Numbers, Table, Texts, letters_of, words_of
from ros2_memory.core.arrays import Flags, Ints, numbered
from ros2_memory.core.text import caseless

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from ros2_memory.core.timebase import Span
    from ros2_memory.storage.base import IntArray

    Floats = NDArray[np.float64]

_BYTES: Final = 500
"""About how much memory an entry takes."""
_MOST_LETTERS: Final = 1_024
"""Different rows of letters in the texts of a part; of more nothing is known."""


class Totals(NamedTuple):
    """The finite numbers of a column.

    Attributes:
        size: how many.
        total: their sum.
        least: log times between which the first of the least ones is, inclusive; equal if known.
        greatest: of the greatest ones likewise.
    """

    size: int
    total: float
    least: Span
    greatest: Span


class Letters(NamedTuple):
    """Which casefolded rows of letters are in the texts of a column.

    Attributes:
        words: the rows of letters, and of what is not ASCII between them.
        has: for each of them, packed bits: which texts have it.
        size: how many texts there are.
    """

    words: tuple[str, ...]
    has: NDArray[np.uint8]
    size: int

    @classmethod
    def of(cls, texts: Texts) -> Letters | None:
        """Returns the letters of texts; None where they are too many."""
        spellings, nth = numbered(frozenset(words_of(caseless(text))) for text in texts.words)
        words = sorted(frozenset().union(*spellings))
        if len(words) > _MOST_LETTERS:
            return None
        has_word = [[word in spelling for spelling in spellings] for word in words]
        rows = np.array(has_word, np.bool_).reshape(len(words), len(spellings))[:, nth[texts.codes]]
        return cls(tuple(words), np.packbits(rows, axis=1), len(texts))

    def may_have(self, text: str) -> Flags:
        """Returns in which texts a casefolded text may be; surely, if it is one row of letters."""
        bits = np.full(self.has.shape[1], 0xFF, np.uint8)
        for letters in letters_of(text):
            containing = [nth for nth, word in enumerate(self.words) if letters in word]
            bits &= np.bitwise_or.reduce(self.has[containing], axis=0)
        return np.unpackbits(bits, count=self.size).view(np.bool_)


class Outline(NamedTuple):
    """What is known of the columns of a part; of some of them nothing is.

    Attributes:
        paths: of columns of numbers.
        sizes: how many finite numbers each has.
        sums: what they add up to.
        times: when the ends of each were, as of `Totals` (N x 4).
        letters: of columns of texts, by their paths.
    """

    paths: Sequence[str]
    sizes: IntArray
    sums: Floats
    times: Ints
    letters: Mapping[str, Letters]

    @classmethod
    def of(cls, totals: Mapping[str, Totals], letters: Mapping[str, Letters]) -> Outline:
        """Returns the outline of columns, by their paths."""
        sizes, sums, least, greatest = zip(*totals.values(), strict=True) if totals else ((),) * 4
        ends = np.array([*zip(least, greatest, strict=True)], np.int64).reshape(-1, 4)
        return cls([*totals], np.array(sizes, np.int64), np.array(sums, float), ends, letters)

    def totals(self, path: str) -> Totals | None:
        """Returns what is known of a column of numbers; None: nothing."""
        if path not in self.paths:
            return None
        nth = self.paths.index(path)
        first, second, third, fourth = self.times[nth].tolist()
        size, total = int(self.sizes[nth]), float(self.sums[nth])
        return Totals(size, total, (first, second), (third, fourth))

    @property
    def memory_bytes(self) -> int:
        """About how much memory it takes."""
        texts = sum(
            letters.has.nbytes + 100 * len(letters.words) for letters in self.letters.values()
        )
        return texts + _BYTES + 120 * len(self.paths)


def outline_of(table: Table, times: IntArray) -> Outline:
    """Returns the outline of a part, all of whose columns are stored, and its log times."""
    totals: dict[str, Totals] = {}
    letters: dict[str, Letters] = {}
    for path in table.columns:
        zone = table.zone(path)
        if zone is None:
            continue
        if (zone.words or "").startswith(IN_PART):
            texts = table.columns[path]
            if isinstance(texts, Texts) and (in_texts := Letters.of(texts)) is not None:
                letters[path] = in_texts
        elif np.isfinite([zone.low, zone.high]).all():
            column = table.columns[path]
            if not isinstance(column, Texts) and column.dtype.kind in "iuf":
                totals[path] = _totals_of(column, table.error(path), times)
    return Outline.of(totals, letters)


def _totals_of(column: Numbers, error: float, times: IntArray) -> Totals:
    is_finite = np.isfinite(column)
    if not is_finite.all():
        column, times = column[is_finite], times[is_finite]
    numbers = cast("Floats", column if error == 0.0 else column.astype(np.float64, copy=False))
    with np.errstate(over="ignore", invalid="ignore"):  # not finite where no float holds it
        total = float(numbers.sum(dtype=np.float64))
    if error == 0.0:
        least, greatest = int(times[numbers.argmin()]), int(times[numbers.argmax()])
        return Totals(len(numbers), total, (least, least), (greatest, greatest))
    may_be_least = times[numbers - error <= (numbers + error).min()]
    may_be_greatest = times[numbers + error >= (numbers - error).max()]
    spans = [(int(ends[0]), int(ends[-1])) for ends in (may_be_least, may_be_greatest)]
    return Totals(len(numbers), total, *spans)


OUTLINE: Final[FragmentKind[Outline]] = FragmentKind("outline", (Outline, Letters))
