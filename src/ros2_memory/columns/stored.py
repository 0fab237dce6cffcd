"""The layout of a topic's tables, and tables that unpack columns when they are first used.

A topic has the same columns from bag to bag, so their layout is stored once.

The zones of a column over many parts are arrays: one comparison rules out a week of them.

The outline of a part says what its zones do not, without a column being unpacked: how many numbers
a column has, their sum, and the times of the least and the greatest one; and which runs of letters
are in which text, if a column has too many texts for its zone (JSON, lines of a log). It is made
while the store is filled, and remains when columns are dropped.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Final, NamedTuple, TypeVar, cast

import numpy as np

from ros2_memory.columns.fragments import FragmentKind
from ros2_memory.columns.table import (
    IN_PART,
    Column,
    Elements,
    Numbers,
    Table,
    Texts,
    Zone,
    as_float,
    letters_of,
    may_be_in,
    words_of,
)
from ros2_memory.core.arrays import Flags, numbered, places_among
from ros2_memory.core.text import caseless

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ros2_memory.columns.pack import Packed
    from ros2_memory.core.timebase import Span
    from ros2_memory.storage.base import Channel, Definition, IntArray
    from ros2_memory.storage.cache import ByteLru

    Floats = NDArray[np.float64]


_BYTES: Final = 500
"""About how much memory an entry takes."""
_TOTALS_BYTES: Final = 600
"""About how much memory the totals of a column take."""
_MOST_LETTERS: Final = 1_024
"""Distinct runs of letters in the texts of a part; if there are more, the outline has none."""
_EXACT_BELOW: Final = 2.0**53
_ANY: Final = -1
"""The code of a zone whose words are not known."""
V = TypeVar("V")


@dataclass(frozen=True)
class Layout:
    """The columns of the tables of one topic, type and definition.

    Attributes:
        paths: of all columns, from the table, in the order in which they are packed: the columns of
            the messages; then for each sequence the owners of its elements, whose path ends with
            `#`, and their columns (`detections.label`).
        left_out: why fields have no column; see `Table.left_out`.
    """

    paths: tuple[str, ...]
    left_out: Mapping[str, str]

    @classmethod
    def of(cls, table: Table) -> Layout:
        """Returns the layout of a table."""
        return cls(tuple(path for path, _ in columns_in(table)), table.left_out)

    @cached_property
    def levels(self) -> dict[str, LevelPaths]:
        """The columns of the messages (""), and of the elements of each sequence by its path."""
        levels = {"": LevelPaths({}, {})}
        sequence = ""
        for path in self.paths:
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

    def to_json(self) -> str:
        """Returns the layout as readable JSON; that of equal layouts is equal."""
        described = {"columns": self.paths, "left_out": dict(self.left_out)}
        return json.dumps(described, ensure_ascii=False)

    @classmethod
    def from_json(cls, text: str) -> Layout:
        """Returns the layout that `to_json` wrote.

        Raises:
            ValueError, LookupError, TypeError: the text is no layout.
        """
        described = json.loads(text)
        return cls(tuple(described["columns"]), described["left_out"])


class LevelPaths(NamedTuple):
    """The paths in `Layout.paths` of the fields of messages, or of elements of a sequence.

    Attributes:
        columns: by the names of the columns.
        sequences: by the names of the sequences.
    """

    columns: dict[str, str]
    sequences: dict[str, str]


def columns_in(rows: Table | Elements, around: str = "") -> Iterator[tuple[str, Column]]:
    """Yields all columns of a table with their paths, in the order of `Layout.paths`."""
    for name, column in rows.columns.items():
        yield f"{around}{name}".rstrip("."), column
    for name, inner in rows.elements.items():
        yield f"{around}{name}#", inner.owners
        yield from columns_in(inner, f"{around}{name}.")


class LazyMapping(Mapping[str, V]):
    """A mapping whose values are made when they are first used, and kept."""

    def __init__(self, names: Collection[str], make: Callable[[str], V]) -> None:
        self._names = names
        self._make = make
        self._values: dict[str, V] = {}

    def __getitem__(self, name: str) -> V:
        value = self._values.get(name)
        if value is None:
            if name not in self._names:
                raise KeyError(name)
            value = self._values[name] = self._make(name)
        return value

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


@dataclass(frozen=True, slots=True, eq=False)
class StoredTable(Table):
    """The table of a part, whose columns are unpacked when they are first used, by any thread.

    Attributes:
        packed: returns how the column at a path of `Layout.paths` is packed, without its data; None
            if there is no such column.
        outline: returns the outline of the part; None if it was not made.
        memory: remembers what is made of the part.
        number: of the part.
    """

    packed: Callable[[str], Packed | None] = field(kw_only=True)
    outline: Callable[[], Outline | None] = field(kw_only=True, default=lambda: None)
    memory: ByteLru[object] = field(kw_only=True)
    number: int = field(kw_only=True, default=0)

    def error(self, path: str) -> float:
        """Returns the greatest absolute error of a column; 0.0 if it is exact.

        Args:
            path: the column; of elements `<sequence>.<column>`.

        Raises:
            KeyError: there is no such column.
        """
        packed = self.packed(path.rstrip("."))
        if packed is None:
            raise KeyError(path)
        return packed.error

    def zone(self, path: str) -> Zone | None:
        """Returns the zone of a column, as `error`; None if there is no such column."""
        packed = self.packed(path.rstrip("."))
        return None if packed is None else packed.zone

    def remember(self, what: str, make: Callable[[], V], size_of: Callable[[V], int]) -> V:
        """Returns what `make` returns, once for the part; see `Table.remember`."""
        key = (self.number, f"={what}")
        cached = self.memory.get(key)
        if cached is not None:
            return cast("V", cached)  # by name: each has one type
        value = make()
        self.memory.put(key, value, size_of(value))
        return value


@dataclass(frozen=True, eq=False)
class Topic:
    """A stored topic.

    Attributes:
        channel: its channel.
        layout: its columns.
        define: returns the definition of a channel; called late, since parsing takes some 10 ms.
    """

    channel: Channel
    layout: Layout
    define: Callable[[Channel], Definition | None] = lambda _: None

    @cached_property
    def definition(self) -> Definition | None:
        """The fields of the messages; None where they are not known."""
        return self.define(self.channel)

    @property
    def left_out(self) -> Mapping[str, str]:
        """Which fields have no column; see `Table.left_out`."""
        return self.layout.left_out


def lazy_columns(
    layout: Layout, column: Callable[[str], Column], dropped: Collection[str], sequence: str = ""
) -> tuple[Mapping[str, Column], Mapping[str, Elements]]:
    """Returns the columns and sequences of a table, each made when it is first used, and kept.

    Args:
        layout: of the table.
        column: returns the column at a path of `Layout.paths`.
        dropped: the paths of the columns that were dropped.
        sequence: the path of the sequence whose elements have the columns; "" for the messages.
    """
    columns, sequences = layout.levels[sequence]

    def elements(name: str) -> Elements:
        path = sequences[name]
        owners = np.asarray(column(f"{path}#"), np.int64)
        return Elements(owners, *lazy_columns(layout, column, dropped, path))

    # Owners that differ may be dropped: then the list is missing. Equal ones take no bytes.
    kept = {name: path for name, path in columns.items() if path not in dropped}
    lists = {name: path for name, path in sequences.items() if f"{path}#" not in dropped}
    return LazyMapping(kept, lambda name: column(kept[name])), LazyMapping(lists, elements)


# What is known of columns without unpacking them


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


class Totals(NamedTuple):
    """The finite numbers of a column.

    Attributes:
        size: how many there are.
        total: their sum.
        least: the log times (ns, inclusive) between which the first least number lies; both are
            the same if its time is known.
        greatest: the log times between which the first greatest number lies.
    """

    size: int
    total: float
    least: Span
    greatest: Span


class Letters(NamedTuple):
    """Which runs of letters are in which texts of a column.

    Attributes:
        words: the runs, casefolded; what is not ASCII counts as a letter.
        has: for each run, as packed bits, whether a text has it.
        size: how many texts there are.
    """

    words: tuple[str, ...]
    has: NDArray[np.uint8]
    size: int

    @classmethod
    def of(cls, texts: Texts) -> Letters | None:
        """Returns the letters of texts; None if they have too many runs."""
        # Many texts differ in their numbers alone, and have the same words.
        word_sets, set_of = numbered(frozenset(words_of(caseless(text))) for text in texts.words)
        words = sorted(frozenset().union(*word_sets))
        if len(words) > _MOST_LETTERS:
            return None
        row_of = {word: row for row, word in enumerate(words)}
        is_in_set = np.zeros((len(words), len(word_sets)), np.bool_)
        for nth, word_set in enumerate(word_sets):
            is_in_set[[row_of[word] for word in word_set], nth] = True
        is_in_text = is_in_set[:, set_of[texts.codes]]
        return cls(tuple(words), np.packbits(is_in_text, axis=1), len(texts))

    def may_have(self, text: str) -> Flags:
        """Returns which texts may contain a casefolded text; surely if it is one run of letters."""
        bits = np.full(self.has.shape[1], 0xFF, np.uint8)
        for letters in letters_of(text):
            containing = [nth for nth, word in enumerate(self.words) if letters in word]
            bits &= np.bitwise_or.reduce(self.has[containing], axis=0)
        return np.unpackbits(bits, count=self.size).view(np.bool_)


class Outline(NamedTuple):
    """What is known of some columns of a part.

    Attributes:
        totals: of columns of numbers, by their paths.
        letters: of columns of texts, by their paths.
    """

    totals: Mapping[str, Totals]
    letters: Mapping[str, Letters]

    @property
    def memory_bytes(self) -> int:
        """About how much memory it takes."""
        size = _BYTES + _TOTALS_BYTES * len(self.totals)
        for letters in self.letters.values():
            size += letters.has.nbytes + 100 * len(letters.words)
        return size


def outline_of(table: Table, times: IntArray) -> Outline:
    """Returns the outline of a part of which no column was dropped.

    Args:
        table: of the part.
        times: its log times (ns).
    """
    totals: dict[str, Totals] = {}
    letters: dict[str, Letters] = {}
    for path in table.columns:
        zone = table.zone(path)
        if zone is None:
            continue
        if (zone.words or "").startswith(IN_PART):
            texts = table.columns[path]
            in_texts = Letters.of(texts) if isinstance(texts, Texts) else None
            if in_texts is not None:
                letters[path] = in_texts
        elif np.isfinite([zone.low, zone.high]).all():
            column = table.columns[path]
            if not isinstance(column, Texts) and column.dtype.kind in "iuf":
                totals[path] = _totals_of(column, table.error(path), times)
    return Outline(totals, letters)


def _totals_of(column: Numbers, error: float, times: IntArray) -> Totals:
    is_finite = np.isfinite(column)
    if not is_finite.all():
        column, times = column[is_finite], times[is_finite]
    numbers = cast("Floats", column if error == 0.0 else column.astype(np.float64, copy=False))
    with np.errstate(over="ignore", invalid="ignore"):  # the sum may be too large for a float
        total = float(numbers.sum(dtype=np.float64))
    if error == 0.0:
        least, greatest = int(times[numbers.argmin()]), int(times[numbers.argmax()])
        return Totals(len(numbers), total, (least, least), (greatest, greatest))
    may_be_least = times[numbers - error <= (numbers + error).min()]
    may_be_greatest = times[numbers + error >= (numbers - error).max()]
    spans = [(int(ends[0]), int(ends[-1])) for ends in (may_be_least, may_be_greatest)]
    return Totals(len(numbers), total, *spans)


OUTLINE: Final[FragmentKind[Outline]] = FragmentKind("outline", (Outline, Totals, Letters))
