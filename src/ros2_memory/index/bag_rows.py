"""Bags as columns: a week has 60,000 of them, and a question looks at few.

A row takes some 200 bytes. A `BagFile` takes four times as much, so it is made on request.
"""

from __future__ import annotations

from bisect import bisect_right
from itertools import accumulate, chain
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.core.arrays import numbered
from ros2_memory.core.bag_summary import BagSummary, SummarySchema
from ros2_memory.core.model import BagFile, BagState, folder_path
from ros2_memory.index.split_order import split_names_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from ros2_memory.core.arrays import Flags, Ints, Which

    Rows: TypeAlias = "Which | list[int]"

_ALL: Final = slice(None)
_STATES: Final = tuple(BagState)
_Places: TypeAlias = "NDArray[np.uint16]"


class Summaries(NamedTuple):
    """The summaries that share a schema and a size.

    Attributes:
        schema: how to decode them.
        rows: the rows of their bags.
        data: the encoded summaries, one after the other.
    """

    schema: SummarySchema
    rows: _Places
    data: bytes


class BagRows:
    """Some hundred bags, at least one, in the given order.

    Args:
        bags: the bags.
        stored: the `ColumnStore.state` deletion at which they were loaded, and their row numbers in
            the store; see `take_store_rows`.

    Attributes:
        names: the paths of the bags.
        folders: the folders that the bags lie in, each once.
        folder_of: by row, the index into `folders`.
        summaries: what the bags hold.
    """

    def __init__(self, bags: Iterable[BagFile], stored: tuple[int, Ints] | None = None) -> None:
        files, sizes, mtimes, states, summaries, starts, ends, sidecars = zip(*bags, strict=True)
        self.names = split_names_of(files)
        folders = (stem.series.rpartition("/")[0] for stem in self.names.stems)
        self.folders, folder_of = numbered(folders)
        self.folder_of: _Places = folder_of.astype(np.uint16)[self.names.positions]
        kinds, kind_of = numbered((id(known.schema), len(known.data)) for known in summaries)
        self._kind_of: _Places = kind_of.astype(np.uint16)
        self._place_of = np.empty_like(self._kind_of)
        self.summaries: list[Summaries] = []
        for kind in range(len(kinds)):
            rows = np.flatnonzero(self._kind_of == kind)
            self._place_of[rows] = np.arange(rows.size)
            data = b"".join([summaries[row].data for row in rows.tolist()])
            alike = Summaries(summaries[int(rows[0])].schema, rows.astype(np.uint16), data)
            self.summaries.append(alike)
        numbers = sizes, mtimes, sidecars, starts, ends, [*map(_STATES.index, states)]
        self._numbers: Ints = np.array(numbers, np.int64)
        self._stored = stored

    def take_store_rows(self, deletion: int) -> Ints | None:
        """Returns the row numbers in the store, and drops them.

        None if they were taken before, or if the store has deleted rows since they were loaded.
        """
        stored, self._stored = self._stored, None
        if stored is None:
            return None
        loaded_at, store_rows = stored
        return store_rows if loaded_at == deletion else None

    def select(self, rows: Flags) -> BagRows | None:
        """Returns the bags of the marked rows; None if no row is marked."""
        if rows.all():
            return self
        if not rows.any():
            return None
        stored = self._stored
        if stored is not None:
            loaded_at, store_rows = stored
            stored = loaded_at, store_rows[rows]
        return BagRows(self.at(rows), stored)

    @property
    def sizes(self) -> Ints:
        """Size of each file in bytes."""
        return np.asarray(self._numbers[0])

    @property
    def contents(self) -> Ints:
        """A row for each bag: the numbers of its `Stamp.content`."""
        return self._numbers[:3].T

    @property
    def stamps(self) -> Ints:
        """A row for each bag: `contents`, and the log times of its first and last message."""
        return self._numbers[:5].T

    @property
    def starts(self) -> Ints:
        """Log time of the first message in each bag."""
        return np.asarray(self._numbers[3])

    @property
    def ends(self) -> Ints:
        """Log time of the last message in each bag."""
        return np.asarray(self._numbers[4])

    def in_state(self, state: BagState) -> Flags:
        """Returns which bags are in a state."""
        return np.asarray(self._numbers[5] == _STATES.index(state))

    def with_schema(self, is_wanted: Callable[[SummarySchema], object]) -> Flags:
        """Returns which bags have a summary whose schema is wanted."""
        are_wanted = np.array([bool(is_wanted(alike.schema)) for alike in self.summaries])
        return np.asarray(are_wanted[self._kind_of])

    def files(self, rows: Rows = _ALL) -> list[str]:
        """Returns the paths of the bags in some rows."""
        stems, positions, numbers = self.names
        return [
            f"{series}{zeros}{number}{suffix}" if number >= 0 else f"{series}{suffix}"
            for (series, zeros, suffix), number in zip(
                map(stems.__getitem__, positions[rows].tolist()),
                numbers[rows].tolist(),
                strict=True,
            )
        ]

    def __len__(self) -> int:
        return len(self._kind_of)

    def __iter__(self) -> Iterator[BagFile]:
        return self.at(_ALL)

    def __getitem__(self, row: int) -> BagFile:
        return next(self.at([row]))

    def at(self, rows: Rows) -> Iterator[BagFile]:
        """Yields the bags in some rows."""
        for file, kind, place, (size, mtime, sidecar, start, end, state) in zip(
            self.files(rows),
            self._kind_of[rows].tolist(),
            self._place_of[rows].tolist(),
            self._numbers.T[rows].tolist(),
            strict=True,
        ):
            schema, members, data = self.summaries[kind]
            length = len(data) // members.size
            summary = BagSummary(schema, data[place * length : (place + 1) * length])
            yield BagFile(file, size, mtime, _STATES[state], summary, start, end, sidecar)


class Bags:
    """The bags of several `BagRows`, one after the other."""

    def __init__(self, parts: Iterable[BagRows]) -> None:
        self._parts = [*parts]
        self._edges = [*accumulate(map(len, self._parts), initial=0)]

    def __len__(self) -> int:
        return self._edges[-1]

    def __iter__(self) -> Iterator[BagFile]:
        return chain.from_iterable(self._parts)

    def __reversed__(self) -> Iterator[BagFile]:
        return chain.from_iterable(reversed([*part]) for part in reversed(self._parts))

    def __getitem__(self, nth: int) -> BagFile:
        part, row = self._locate(nth)
        return part[row]

    def recording(self, nth: int) -> Path:
        """Returns the recording of a bag, without making its `BagFile`."""
        part, row = self._locate(nth)
        return folder_path(part.folders[part.folder_of[row]] or "/")

    def _locate(self, nth: int) -> tuple[BagRows, int]:
        """Returns the part that has the `nth` bag, and its row there."""
        part = bisect_right(self._edges, nth) - 1
        return self._parts[part], nth - self._edges[part]
