"""What numbers a topic held in each bin of a window: how many messages, least, greatest, mean."""

from __future__ import annotations

import math
from bisect import bisect_right
from functools import partial
from itertools import groupby
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.timebase import MAX_NS, MIN_NS
from ros2_memory.counts.bins import MOST_CELLS, BinnedWindow
from ros2_memory.counts.field_numbers import FieldReader
from ros2_memory.history.bag_fold import shares_of
from ros2_memory.history.no_data import no_data_between, resolve_topic
from ros2_memory.history.view import open_span

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from typing import TypeAlias

    from numpy.typing import NDArray

    from ros2_memory.core.model import TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.counts.bins import By
    from ros2_memory.counts.field_numbers import FieldNumbers, Numbers, NumberTable
    from ros2_memory.history.bag_fold import Share
    from ros2_memory.history.bag_groups import Group
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.history.view import TimeRange, View
    from ros2_memory.results import BinColumn, Bins

    Times: TypeAlias = NDArray[np.int64]

_MEAN_DIGITS: Final = 12
"""What rounding of sums cannot change, however a window is cut into bags."""


def count_range(
    memory: Memory,
    call: Call,
    topic: str,
    span: TimeRange,
    by: By,
    *,
    fields: Sequence[str] = (),
) -> Bins:
    """Returns how many messages of a topic each bin holds, and the numbers of fields in them.

    Raises:
        InvalidArgumentsError: there are too many bins, or too many fields for them.
        NoDataError: there is no message in the window.
        QueryTimeoutError: the call's time is over.
    """
    view, asked = open_span(memory, call, span)
    name = resolve_topic(view, topic)
    binned = BinnedWindow(view, asked, by, (name,))
    names = tuple(dict.fromkeys(fields))
    size = len(binned.bins.names)
    if len(names) * size > MOST_CELLS:
        raise InvalidArgumentsError(
            f"{len(names)} fields by {by} in {size} bins are too many for one reply: "
            "name fewer fields, or ask about a shorter window"
        )
    counts, first, last = _counted(view, name, binned)
    if not counts.any():
        raise no_data_between(view, (name,), asked)
    member = binned.bins.member
    binned.add("count", "count", (counts @ member).tolist(), int(counts.sum()))
    held = [counts.astype(bool) & each for each in member.T]
    binned.add("first", "time", [_extreme(first[each], min) for each in held], first.min())
    binned.add("last", "time", [_extreme(last[each], max) for each in held], last.max())
    if names:
        _add_numbers(view, name, binned, names)
    return binned.answer()


def _extreme(times: Times, which: Callable[[Iterable[Ns]], Ns]) -> Ns | None:
    return which(times.tolist()) if len(times) else None


def _counted(view: View, topic: str, binned: BinnedWindow) -> tuple[Times, Times, Times]:
    """Returns for each piece how many messages it holds, and when the first and the last came."""
    edges = binned.bins.edges[1:-1].tolist()
    size = len(binned.bins.member)
    counts, first, last = [0] * size, [MAX_NS] * size, [MIN_NS] * size
    for share in shares_of(view, topic, binned.asked):
        view.bags.check_deadline()
        for held in _held(view, topic, share, binned.asked, edges):
            piece = bisect_right(edges, held.first)
            counts[piece] += held.messages
            first[piece] = min(first[piece], held.first)
            last[piece] = max(last[piece], held.last)
    return np.array(counts, np.int64), np.array(first, np.int64), np.array(last, np.int64)


class _Held(NamedTuple):
    """How many messages were recorded between two times, both of messages."""

    messages: int
    first: Ns
    last: Ns


def _held(
    view: View, topic: str, share: Share, window: TimeWindow, edges: Sequence[Ns]
) -> Sequence[_Held]:
    """Returns the messages of a share between edges; remembered where a window covers the share."""
    digests = view.bags.digests_of(share.segment)
    inner = tuple(edge for edge in edges if share.first < edge <= share.last)
    if digests is None or not share.is_covered_by(window):
        return _counted_in(view, topic, share, window, inner)
    # A list of none or one: what cannot be read now is counted again.
    known: list[Sequence[_Held]] = digests.derived(f"counts {topic} {inner} {share.key}", list)
    if known:
        return known[0]
    with view.notes.isolated():
        found = _counted_in(view, topic, share, window, inner)
        if view.notes.complete:
            known.append(found)
    return found


def _counted_in(
    view: View, topic: str, share: Share, window: TimeWindow, edges: Sequence[Ns]
) -> list[_Held]:
    """Counts the messages of a share between edges.

    Messages are read where recordings overlap; the times of messages where a bag lies on both
    sides of an edge.
    """
    found: dict[int, _Held] = {}

    def add(piece: int, count: int, first: Ns, last: Ns) -> None:
        known = found.get(piece, _Held(0, first, last))
        found[piece] = _Held(known.messages + count, min(known.first, first), max(known.last, last))

    def is_uncut(group: Group) -> bool:
        begin, end = (bisect_right(edges, at) for at in (group.first, group.last))
        return group.is_inside and begin == end

    for whole in share.groups(view, topic, window):
        for group in [whole] if is_uncut(whole) else view.apart(topic, whole):
            if is_uncut(group):
                piece = bisect_right(edges, group.first)
                add(piece, view.count_in(topic, group), group.first, group.last)
                continue
            for piece, times in groupby(group.times(), key=partial(bisect_right, edges)):
                here = [*times]
                add(piece, len(here), here[0], here[-1])
    return [*found.values()]


def _add_numbers(view: View, topic: str, binned: BinnedWindow, fields: Sequence[str]) -> None:
    reader = FieldReader(view, topic, fields)
    folded = reader.over(binned.asked, binned.bins.edges[1:-1].tolist())
    binned.note_since(folded.since)
    if reader.failures:
        view.notes.complete = False
        reason = reader.failures[0].reason
        view.notes.add(f"messages left out, since they cannot be decoded: {reason}")
    firsts = [at for part in folded.parts for at in part.first]
    among = binned.bins.among(firsts)
    rows = [np.flatnonzero(each) for each in (*among.T, np.ones(len(firsts), np.bool_))]
    extremes = _Extremes(reader, folded.parts)
    for at, field in enumerate(fields):
        _add_columns(binned, field, [extremes.cell(at, each.tolist()) for each in rows])


class _Cell:
    """The numbers of one field in one bin: the mean, and least and greatest with their times."""

    def __init__(self, mean: float, least: tuple[float, Ns], most: tuple[float, Ns]) -> None:
        self.mean, self.least, self.most = mean, least, most


class _Extremes:
    """Finds the least and the greatest number of many short times, and reads only what it must."""

    def __init__(self, reader: FieldReader, parts: Sequence[NumberTable]) -> None:
        self._reader = reader
        self._first = [at for part in parts for at in part.first]
        self._last = [at for part in parts for at in part.last]
        self._numbers = [each for part in parts for each in part.numbers]
        self._read: dict[int, Numbers | None] = {}

    def cell(self, field: int, rows: Sequence[int]) -> _Cell | None:
        """Returns the numbers of a field in some of the times; None if there are none."""
        some = [row for row in rows if self._numbers[row][field].size]
        count = sum(self._numbers[row][field].size for row in some)
        if not count:
            return None
        total = math.fsum(self._numbers[row][field].total for row in some)
        least = self._furthest(field, some, 1)
        most = self._furthest(field, some, -1)
        # Plus 0.0: digests do not know -0.0.
        mean = float(f"{total / count:.{_MEAN_DIGITS}g}")
        return _Cell(mean, (least[0] + 0.0, least[1]), (0.0 - most[0], most[1]))

    def _furthest(self, field: int, rows: Sequence[int], sign: int) -> tuple[float, Ns]:
        """Returns the least number times `sign`, and when it was first."""
        bounds = sorted(
            (_end(self._numbers[row][field], sign)[0], self._first[row], row) for row in rows
        )
        best = (math.inf, 0)
        for bound, first, row in bounds:
            if (bound, first) > best:
                break
            number, at = _end(self._exact(field, row, sign), sign)
            if at is not None:
                best = min(best, (number, at))
        return best

    def _exact(self, field: int, row: int, sign: int) -> FieldNumbers:
        """Returns the numbers of a time, read where the catalogue has bounds alone."""
        known = self._numbers[row][field]
        if _end(known, sign)[1] is not None:
            return known
        if row not in self._read:
            self._read[row] = self._reader.between(self._first[row], self._last[row])
        read = self._read[row]
        return known if read is None else read[field]


def _end(numbers: FieldNumbers, sign: int) -> tuple[float, Ns | None]:
    if sign > 0:
        return numbers.low, numbers.low_at
    return -numbers.high, numbers.high_at


def _add_columns(binned: BinnedWindow, field: str, cells: Sequence[_Cell | None]) -> None:
    """Adds the columns of a field; the last cell is that of all bins together."""
    if cells[-1] is None:
        binned.view.notes.add(f"{field} holds no number in the window")
        return
    columns: tuple[tuple[str, BinColumn, Callable[[_Cell], float]], ...] = (
        ("min", "number", lambda cell: cell.least[0]),
        ("min_at", "time", lambda cell: cell.least[1]),
        ("max", "number", lambda cell: cell.most[0]),
        ("max_at", "time", lambda cell: cell.most[1]),
        ("mean", "number", lambda cell: cell.mean),
    )
    for name, kind, of in columns:
        *each, whole = [None if cell is None else of(cell) for cell in cells]
        binned.add(f"{field}.{name}", kind, each, whole)
