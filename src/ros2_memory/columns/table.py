"""The messages of a topic as columns.

What a type's columns are follows from its definition alone, so that tables of any bags of one
topic, type and definition can be joined:

- a number or a boolean: a column of its own type. A string: `Texts`. A time or duration
  (builtin_interfaces): one int64 column of ns;
- a nested message: the columns of its fields, by dot-path (`pose.pose.position.x`);
- a fixed array of at most `MAX_NUMBERS` numbers: a column for each (`bbox.0` .. `bbox.3`);
- a longer fixed array: `<path>.length` and, up to `MAX_RANGED_BYTES`, `<path>.least` and
  `<path>.greatest`;
- a sequence of numbers: `<path>.length`, `<path>.least`, `<path>.greatest`, and `Elements` with the
  column "" that hold the numbers of those rows that have at most `MAX_NUMBERS`, or, decoded for a
  question, `MOST_DECODED_NUMBERS`; of rows that have more there are no elements (`left_out` then
  names the path);
- a sequence or an array of messages: `Elements` with the columns of the message; of strings, times
  and durations: `Elements` with the column "".

`length` is uint32. `least` and `greatest` are float64, over finite values: NaN where there is none,
and where a sequence takes more than `MAX_RANGED_BYTES`.
"""

from __future__ import annotations

import math
import re
from collections import ChainMap
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias, TypeVar, cast

import numpy as np

from ros2_memory.core.arrays import (
    entries_of_codes,
    joined_codes,
    numbered,
    range_numbers,
    renumbered,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from ros2_memory.storage.base import Channel, Definition, IntArray, Mask

T = TypeVar("T")

Numbers: TypeAlias = "np.ndarray[tuple[int, ...], np.dtype[np.generic[object]]]"

MAX_NUMBERS: Final = 9
"""Longer arrays of numbers (covariances of poses, scans, images) are no columns."""
MOST_DECODED_NUMBERS: Final = 64
"""Sequences of numbers (of a robot's joints) up to this length have elements where a bag is decoded
for a question."""
IN_PART: Final = "LETTERS"
"""Begins the words of a zone that has the runs of letters in its texts, not the whole texts.

No casefolded text begins like this, in capitals."""
_SPACES: Final = bytes(code if code > 127 or chr(code).isalpha() else 32 for code in range(256))
"""For `bytes.translate`, which is faster than that of `str`."""
_LETTERS: Final = re.compile(r"[^\W\d_]+")
UNHASHED: Final = -1
"""In place of the hash of a payload that was not hashed."""
MAX_RANGED_BYTES: Final = 4096
"""Of longer arrays the least and the greatest number are not looked for."""


class Zone(NamedTuple):
    """What is known of a column without reading its values; `Zones` compares it with numbers.

    Attributes:
        least: the least number, exact; None for texts and if all are NaN. Infinities count; False
            is 0.
        greatest: the greatest number.
        nulls: how many numbers are NaN.
        words: the distinct texts, casefolded and joined by newlines; or, if these are too many or
            too long, `IN_PART` and the runs of letters in them. None for numbers, and if there are
            too many runs: then any text may be there.
    """

    least: float | None = None
    greatest: float | None = None
    nulls: int = 0
    words: str | None = None

    @property
    def low(self) -> float:
        """The least value; infinity where there is none."""
        return math.inf if self.least is None else self.least

    @property
    def high(self) -> float:
        """The greatest value; minus infinity where there is none."""
        return -math.inf if self.greatest is None else self.greatest


def letters_of(text: str) -> list[str]:
    """Returns the longest runs of letters in a text."""
    # The expression takes four times as long.
    return words_of(text) if text.isascii() else _LETTERS.findall(text)


def words_of(text: str) -> list[str]:
    """Returns the runs of letters in a text; each character beyond ASCII counts as a letter."""
    spaced = text.encode("utf-8", "surrogatepass").translate(_SPACES)
    return spaced.decode("utf-8", "surrogatepass").split()


def may_be_in(words: str, text: str) -> bool:
    """Returns whether a column may have a value that contains a casefolded text.

    Args:
        words: those of the column's zone.
        text: what is looked for.
    """
    if not words.startswith(IN_PART):
        return text in words
    return all(letters in words for letters in letters_of(text))


def as_float(number: float) -> float:
    """Returns the float nearest to a number; infinity if it is too large for one."""
    try:
        return float(number)
    except OverflowError:
        return math.copysign(math.inf, 1 if number > 0 else -1)


@dataclass(frozen=True, slots=True, eq=False)
class Texts:
    """A column of strings: `words[code]` for each row.

    Attributes:
        codes: uint32.
        words: each once, in the order of their first rows.
    """

    codes: np.ndarray[tuple[int], np.dtype[np.uint32]]
    words: tuple[str, ...]

    @classmethod
    def of(cls, values: Sequence[str]) -> Texts:
        """Returns the column with some strings."""
        words, codes = numbered(values)
        return cls(codes.astype(np.uint32), words)

    def __len__(self) -> int:
        """Returns the number of rows."""
        return self.codes.size

    def values(self) -> list[str]:
        """Returns the string of each row."""
        words = self.words
        return [words[code] for code in self.codes.tolist()]

    def are(self, wanted: Callable[[str], object]) -> Mask:
        """Returns which rows have a word that is wanted; each word is asked about once."""
        return np.array([bool(wanted(word)) for word in self.words], np.bool_)[self.codes]

    def at(self, positions: IntArray | Mask) -> Texts:
        """Returns some rows, with all words."""
        return Texts(self.codes[positions], self.words)

    def __getitem__(self, positions: IntArray) -> Texts:
        """Returns some rows, without the words that none of them has."""
        codes = self.codes[positions]
        if len(self.words) <= 1:
            return Texts(codes, self.words if codes.size else ())
        used, new_codes = renumbered(codes, len(self.words))
        return Texts(new_codes.astype(np.uint32), tuple(self.words[code] for code in used.tolist()))


def joined_texts(parts: Sequence[Texts]) -> Texts:
    """Returns columns of texts one after the other."""
    codes, words = joined_codes((part.codes, part.words) for part in parts)
    return Texts(codes.astype(np.uint32), words)


Column: TypeAlias = "Numbers | Texts"


@dataclass(frozen=True, slots=True, eq=False)
class Elements:
    """The elements that a sequence has in all rows of a table, or in all elements around it.

    Attributes:
        owners: the row of each element, ascending; elements of one row are in the message's order.
        columns: by the dot-path inside the element; "" if an element is no message.
        elements: the sequences inside the element, by their dot-path.
    """

    owners: IntArray
    columns: Mapping[str, Column]
    elements: Mapping[str, Elements] = field(default_factory=dict)

    def __len__(self) -> int:
        """Returns the number of elements in all rows."""
        return self.owners.size

    def rows(self, positions: IntArray) -> Elements:
        """Returns the elements of some rows, which become the rows 0, 1, 2 and so on."""
        counts, taken = entries_of_codes(self.owners, positions)
        return Elements(
            range_numbers(counts),
            {path: column[taken] for path, column in self.columns.items()},
            {path: inner.rows(taken) for path, inner in self.elements.items()},
        )


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Messages of one topic and type, from one bag or several.

    They are ordered by log time, those of one log time by bag and place.

    Attributes:
        channel: the first channel of this topic, type and definition.
        log_times: of each message (ns).
        publish_times: of each message (ns); in a table without columns they may be the log times.
        places: the place of each message in its file.
        columns: by the dot-path of the field.
        elements: by the dot-path of the sequence.
        left_out: why a field has no column, or not in all rows, by its dot-path; "" stands for the
            whole message, of which only the times are known.
        payload_hashes: CRC-32 of each payload, or `UNHASHED`; None if no hash was asked for.
        define: returns the `definition`.
        bags: the number of each row's bag among those that were decoded together; None: all 0.
    """

    channel: Channel
    log_times: IntArray
    publish_times: IntArray
    places: IntArray
    columns: Mapping[str, Column] = field(default_factory=dict)
    elements: Mapping[str, Elements] = field(default_factory=dict)
    left_out: Mapping[str, str] = field(default_factory=dict)
    payload_hashes: IntArray | None = None
    define: Callable[[], Definition | None] = lambda: None
    bags: IntArray | None = None

    def __len__(self) -> int:
        """Returns the number of messages."""
        return self.log_times.size

    @property
    def definition(self) -> Definition | None:
        """The fields of the type; None where they are not known."""
        return self.define()

    @property
    def bag_numbers(self) -> IntArray:
        """The number of each row's bag; see `bags`."""
        return np.zeros(len(self), np.int64) if self.bags is None else self.bags

    def error(self, path: str) -> float:
        """Returns the greatest absolute error of a column's values; decoded ones are exact.

        Args:
            path: the column; of elements `<sequence>.<column>`.
        """
        del path
        return 0.0

    def zone(self, path: str) -> Zone | None:
        """Returns the zone of a column; a decoded one has none."""
        del path
        return None

    def remember(self, what: str, make: Callable[[], T], size_of: Callable[[T], int]) -> T:
        """Returns what `make` returns; a stored part remembers it.

        Args:
            what: the key under which the result is remembered.
            make: makes it of all rows.
            size_of: returns about how much memory it takes.
        """
        del what, size_of
        return make()

    def rows(self, positions: IntArray) -> Table:
        """Returns some rows, in the order given."""
        hashes, bags = self.payload_hashes, self.bags
        return replace(
            self,
            log_times=self.log_times[positions],
            publish_times=self.publish_times[positions],
            places=self.places[positions],
            columns={path: column[positions] for path, column in self.columns.items()},
            elements={path: inner.rows(positions) for path, inner in self.elements.items()},
            payload_hashes=None if hashes is None else hashes[positions],
            bags=None if bags is None else bags[positions],
        )

    def without_columns(self, reason: str) -> Table:
        """Returns the rows with their times alone.

        Args:
            reason: why they have no columns.
        """
        return replace(self, columns={}, elements={}, left_out={"": reason})

    @property
    def memory_bytes(self) -> int:
        """About how much memory it takes."""
        return 32 * len(self) + _bytes(self.columns, self.elements)


def order_of(log_times: IntArray, bags: IntArray, places: IntArray) -> IntArray | None:
    """Returns the positions by log time, then bag, then place; None if they are in order."""
    if (log_times[1:] > log_times[:-1]).all():
        return None
    order = np.lexsort((places, bags, log_times))
    return None if (order[1:] > order[:-1]).all() else order


def join_tables(tables: Sequence[Table]) -> Table:
    """Returns the rows of tables as one table.

    Args:
        tables: at least one; of one topic, type and definition, all with columns or all without.
    """
    first = tables[0]
    if len(tables) == 1:
        return first
    is_hashed = any(table.payload_hashes is not None for table in tables)
    whole = Table(
        first.channel,
        np.concatenate([table.log_times for table in tables]),
        np.concatenate([table.publish_times for table in tables]),
        np.concatenate([table.places for table in tables]),
        *_joined_levels(tables),
        dict(ChainMap(*(dict(table.left_out) for table in tables))),
        np.concatenate([*map(_hashes, tables)]) if is_hashed else None,
        first.define,
        np.concatenate([table.bag_numbers for table in tables]),
    )
    order = order_of(whole.log_times, whole.bag_numbers, whole.places)
    return whole if order is None else whole.rows(order)


def _hashes(table: Table) -> IntArray:
    hashes = table.payload_hashes
    return np.full(len(table), UNHASHED) if hashes is None else hashes


def joined_column(parts: Sequence[Column]) -> Column:
    """Returns columns, all of texts or all of numbers, one after the other."""
    texts = [part for part in parts if isinstance(part, Texts)]
    return joined_texts(texts) if texts else np.concatenate(cast("Sequence[Numbers]", parts))


def _joined_levels(
    parts: Sequence[Table] | Sequence[Elements],
) -> tuple[dict[str, Column], dict[str, Elements]]:
    """Returns the columns and the sequences of some tables or elements, joined.

    Args:
        parts: at least one; of one topic, type and definition.
    """
    columns: dict[str, Column] = {}
    for path in parts[0].columns:
        columns[path] = joined_column([part.columns[path] for part in parts])
    first_rows = np.cumsum([0, *map(len, parts)])[:-1].tolist()
    elements: dict[str, Elements] = {}
    for path in parts[0].elements:
        inner = [part.elements[path] for part in parts]
        owners = [part.owners + row for part, row in zip(inner, first_rows, strict=True)]
        elements[path] = Elements(np.concatenate(owners), *_joined_levels(inner))
    return columns, elements


def column_bytes(column: Column) -> int:
    """Returns about how many bytes of memory a column takes."""
    if isinstance(column, Texts):
        return column_bytes(column.codes) + sum(map(len, column.words)) + 60 * len(column.words)
    return column.nbytes if all(column.strides) else column.itemsize


def _bytes(columns: Mapping[str, Column], elements: Mapping[str, Elements]) -> int:
    size = sum(map(column_bytes, columns.values()))
    for inner in elements.values():
        size += inner.owners.nbytes + _bytes(inner.columns, inner.elements)
    return size
