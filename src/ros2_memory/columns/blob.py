"""All tables of a bag in one blob: every value exactly as it was decoded.

A bag lies here until its ten minutes are over, so this is made to be written and read quickly. The
columns of a topic are the same from bag to bag, so a blob holds none of their names: a `Layout`
does, which its caller keeps under a number. What the blob is, once decompressed (numbers are
little-endian and lie in planes, the lowest byte of each first, as they then compress best)::

    1       format (`pack.FORMAT`)
    4       t, the number of tables
    5 t     number of the topic, as the caller has it (4), and whether payloads are hashed (1)
    4 n     how many values each column has: of each table in turn the log times, publish times and
            hashes if payloads are hashed, and then the columns in the order of `Layout.slots`
    ...     the values, those of one kind together (`KINDS`); of texts the codes
    4 m     how many words each column of texts has
    4 w     length of each word in characters
    ...     the words in UTF-8, surrogates pass
"""

from __future__ import annotations

import struct
from functools import cache
from typing import TYPE_CHECKING, Final, NamedTuple, cast

import numpy as np

from ros2_memory.columns.layout import KINDS, TEXT
from ros2_memory.columns.pack import FORMAT, compressed, decompressed
from ros2_memory.columns.stored import lazy_columns
from ros2_memory.columns.table import Column, Numbers, Table, Texts

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from ros2_memory.columns.layout import Layout
    from ros2_memory.columns.stored import Topic
    from ros2_memory.storage.base import IntArray

_BEGIN: Final = struct.Struct("<BI")
_HEAD: Final = np.dtype([("topic", "<u4"), ("hashed", "?")])
_INT64: Final = KINDS.index("int64")
_HASHED: Final = 3
"""Log times, publish times and hashes; without hashes log times alone."""


class Entry(NamedTuple):
    """A table to be packed: the number that its topic and layout have at the caller's."""

    topic: int
    layout: Layout
    table: Table


def pack_tables(entries: Sequence[Entry]) -> bytes:
    """Returns the tables as one compressed blob.

    Publish times are packed where there are hashes, with which they tell copies of a message.
    Elsewhere they come back as log times.

    Raises:
        ValueError: a table has other columns than its layout.
    """
    heads = np.array(
        [(entry.topic, entry.table.payload_hashes is not None) for entry in entries], _HEAD
    )
    counts: list[int] = []
    values: list[list[Numbers]] = [[] for _ in KINDS]
    words: list[tuple[str, ...]] = []
    for _, layout, table in entries:
        times = [table.log_times]
        if table.payload_hashes is not None:
            times += [table.publish_times, table.payload_hashes]
        columns = layout.columns_of(table)
        counts += map(len, (*times, *columns))
        values[_INT64] += times
        for kind, column in zip(layout.kinds.tolist(), columns, strict=True):
            if isinstance(column, Texts):
                words.append(column.words)
                values[kind].append(column.codes)
            else:
                values[kind].append(column)
    planes = [_planes(np.concatenate(some)) for some in values if some]
    return compressed(
        b"".join(
            (
                _BEGIN.pack(FORMAT, len(heads)),
                heads.tobytes(),
                _planes(np.array(counts, "<u4")),
                *planes,
                *_packed_words(words),
            )
        )
    )


def topics_in(blob: bytes) -> list[int]:
    """Returns the numbers of the topics of the tables in a blob.

    Raises:
        ValueError: the blob is damaged, or of another format.
    """
    heads, _ = _heads(decompressed(blob))
    return cast("list[int]", heads["topic"].tolist())


def unpack_tables(blob: bytes, topics: Mapping[int, Topic]) -> Iterator[tuple[int, Table]]:
    """Yields the tables of a blob, each with its number, in the order in which they were packed.

    Args:
        blob: what `pack_tables` returned.
        topics: the topics of the tables, by the number under which they were packed.

    Raises:
        ValueError: the blob is damaged, of another format, or not of these layouts.
    """
    data = decompressed(blob)
    heads, at = _heads(data)
    found = [topics[number] for number in heads["topic"].tolist()]
    times = np.where(heads["hashed"], _HASHED, 1)
    kinds = np.concatenate(
        [
            np.empty(0, np.int64),
            *(
                each
                for topic, count in zip(found, times.tolist(), strict=True)
                for each in (np.full(count, _INT64), topic.layout.kinds)
            ),
        ]
    )
    values = _Values(data, at, kinds)
    first = 0
    for number, topic, count in zip(heads["topic"].tolist(), found, times.tolist(), strict=True):
        yield number, _table(values, first, topic, count)
        first += count + len(topic.layout.slots)


def _heads(data: bytes) -> tuple[np.ndarray[tuple[int], np.dtype[np.void]], int]:
    """Returns the topics of the tables, and where the counts begin."""
    form, tables = _BEGIN.unpack_from(data)
    if form != FORMAT:
        raise ValueError(f"the blob of columns is of format {form}, this program reads {FORMAT}")
    heads = np.frombuffer(data, _HEAD, tables, _BEGIN.size)
    return heads, _BEGIN.size + heads.nbytes


class _Values:
    """The columns of a blob, by their numbers.

    Args:
        data: the blob, decompressed.
        at: where the counts begin.
        kinds: of each column.
    """

    def __init__(self, data: bytes, at: int, kinds: IntArray) -> None:
        self._data = data
        self._kinds = kinds
        self._counts = _from_planes(data, at, len(kinds), "<u4").astype(np.int64)
        self._starts = np.zeros_like(self._counts)
        self._texts = np.cumsum(kinds == TEXT) - 1
        self._places: dict[int, tuple[int, int]] = {}
        at += 4 * len(kinds)
        for kind in range(len(KINDS)):
            those = kinds == kind
            stops = np.cumsum(self._counts[those])
            self._starts[those] = stops - self._counts[those]
            length = int(stops[-1]) if stops.size else 0
            self._places[kind] = at, length
            at += length * _dtype(kind).itemsize
        self._words_at = at
        self._all = cache(self._of_kind)
        self._words = cache(self._unpacked_words)

    def column(self, nth: int) -> Column:
        """Returns a column."""
        kind, start = int(self._kinds[nth]), int(self._starts[nth])
        values = self._all(kind)[start : start + int(self._counts[nth])]
        if kind != TEXT:
            return values
        return Texts(values.astype(np.uint32, copy=False), self._words()[int(self._texts[nth])])

    def _of_kind(self, kind: int) -> Numbers:
        at, count = self._places[kind]
        return _from_planes(self._data, at, count, _dtype(kind))

    def _unpacked_words(self) -> list[tuple[str, ...]]:
        counts = _from_planes(self._data, self._words_at, int((self._kinds == TEXT).sum()), "<u4")
        stops = np.cumsum(counts, dtype=np.int64).tolist()
        at = self._words_at + counts.nbytes
        lengths = _from_planes(self._data, at, stops[-1] if stops else 0, "<u4")
        ends = np.cumsum(lengths, dtype=np.int64).tolist()
        text = self._data[at + lengths.nbytes :].decode("utf-8", "surrogatepass")
        words = [text[start:stop] for start, stop in zip([0, *ends], ends, strict=False)]
        return [tuple(words[start:stop]) for start, stop in zip([0, *stops], stops, strict=False)]


def _table(values: _Values, first: int, topic: Topic, count: int) -> Table:
    """The table whose columns begin with number `first`, after `count` for its times."""
    slots = topic.layout.slots
    times = [cast("IntArray", values.column(first + nth)) for nth in range(count)]
    columns, elements = lazy_columns(
        topic.layout, lambda path: values.column(first + count + slots[path].nth)
    )
    return Table(
        topic.channel,
        times[0],
        times[1] if count == _HASHED else times[0],
        np.arange(len(times[0])),
        columns,
        elements,
        topic.layout.left_out,
        times[2] if count == _HASHED else None,
        definition=topic.definition,
    )


def _packed_words(texts: Sequence[tuple[str, ...]]) -> Iterator[bytes]:
    words = [word for some in texts for word in some]
    yield _planes(np.array([len(some) for some in texts], "<u4"))
    yield _planes(np.array([len(word) for word in words], "<u4"))
    yield "".join(words).encode("utf-8", "surrogatepass")


def _dtype(kind: int) -> np.dtype[np.generic[object]]:
    return np.dtype("uint32" if kind == TEXT else KINDS[kind])


def _planes(numbers: Numbers) -> bytes:
    return numbers.view(np.uint8).reshape(-1, numbers.itemsize).T.tobytes()


def _from_planes(
    data: bytes, at: int, count: int, dtype: str | np.dtype[np.generic[object]]
) -> Numbers:
    whole = np.dtype(dtype)
    planes = np.frombuffer(data, np.uint8, count * whole.itemsize, at)
    return np.ascontiguousarray(planes.reshape(whole.itemsize, count).T).view(whole).ravel()
