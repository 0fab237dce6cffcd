"""What numbers a topic held in each bin of a window: how many messages, least, greatest, mean."""

from __future__ import annotations

import math
from bisect import bisect_right
from functools import partial
from itertools import groupby
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.timebase import MAX_NS, MIN_NS
from ros2_memory.counts.bins import MOST_CELLS, BinnedWindow
from ros2_memory.counts.column_numbers import GREATEST, LEAST, PieceNumbers
from ros2_memory.counts.field_numbers import FieldReader
from ros2_memory.history.bag_fold import shares_of
from ros2_memory.history.counting import Counted, count_messages
from ros2_memory.history.no_data import no_data_between, resolve_topic
from ros2_memory.history.robots import note_robots
from ros2_memory.history.view import open_span

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from typing import TypeAlias

    from numpy.typing import NDArray

    from ros2_memory.core.errors import UndecodableError
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
    numbers = _numbers(view, name, binned, names) if names else None
    counts, first, last = _counted(view, name, binned)
    if not counts.any():
        raise no_data_between(view, (name,), asked)
    member = binned.bins.member
    binned.add("count", "count", (counts @ member).tolist(), int(counts.sum()))
    held = [counts.astype(bool) & each for each in member.T]
    binned.add("first", "time", [_extreme(first[each], min) for each in held], first.min())
    binned.add("last", "time", [_extreme(last[each], max) for each in held], last.max())
    for field, cells in zip(names, numbers or (), strict=True):
        _add_columns(binned, field, cells)
    note_robots(view, name, binned.counted)
    return binned.answer()


def _extreme(times: Times, which: Callable[[Iterable[Ns]], Ns]) -> Ns | None:
    return which(times.tolist()) if len(times) else None


def _counted(view: View, topic: str, binned: BinnedWindow) -> tuple[Times, Times, Times]:
    """Returns for each piece how many messages it holds, and when the first and the last came."""
    edges = binned.bins.edges[1:-1]
    size = len(binned.bins.member)
    counts, first, last = [0] * size, [MAX_NS] * size, [MIN_NS] * size
    of_columns = view.memory.columns is not None
    count = count_messages if of_columns else _counted_by_shares
    for counted in count(view, topic, binned.counted, edges):
        counts[counted.piece] += counted.messages
        first[counted.piece] = min(first[counted.piece], counted.first)
        last[counted.piece] = max(last[counted.piece], counted.last)
    return np.array(counts, np.int64), np.array(first, np.int64), np.array(last, np.int64)


def _counted_by_shares(
    view: View, topic: str, window: TimeWindow, edges: Times
) -> Iterator[Counted]:
    """Does as `count_messages` where there are no columns: in a lake."""
    for share in shares_of(view, topic, window):
        view.bags.check_deadline()
        yield from _held(view, topic, share, window, edges.tolist())


def _held(
    view: View, topic: str, share: Share, window: TimeWindow, edges: Sequence[Ns]
) -> Sequence[Counted]:
    """Returns the messages of a share between edges; remembered where a window covers the share."""
    digests = view.bags.digests_of(share.segment)
    inner = tuple(edge for edge in edges if share.first < edge <= share.last)
    begin = bisect_right(edges, share.first)
    if digests is None or not share.is_covered_by(window):
        return _counted_in(view, topic, share, window, edges)
    # A list of none or one: what cannot be read now is counted again.
    known: list[Sequence[Counted]] = digests.derived(f"counts {topic} {inner} {share.key}", list)
    if not known:
        with view.notes.isolated():
            found = _counted_in(view, topic, share, window, inner)
            if view.notes.complete:
                known.append(found)
    else:
        found = [*known[0]]
    return [counted._replace(piece=begin + counted.piece) for counted in found]


def _counted_in(
    view: View, topic: str, share: Share, window: TimeWindow, edges: Sequence[Ns]
) -> list[Counted]:
    """Counts the messages of a share between edges.

    Messages are read where recordings overlap; the times of messages where a bag lies on both
    sides of an edge.
    """
    found: dict[int, Counted] = {}

    def add(piece: int, count: int, first: Ns, last: Ns) -> None:
        known = found.get(piece, Counted(piece, 0, first, last))
        found[piece] = Counted(
            piece, known.messages + count, min(known.first, first), max(known.last, last)
        )

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


def _numbers(
    view: View, topic: str, binned: BinnedWindow, fields: Sequence[str]
) -> list[Sequence[_Cell | None]]:
    """Returns for each field the numbers in each bin, and in all of them together."""
    if view.memory.columns is None:
        return _numbers_by_shares(view, topic, binned, fields)
    found = PieceNumbers(view, topic, fields, binned.bins.edges[1:-1])
    found.collect(binned.counted)
    binned.count_since(found.since)
    _note_failures(view, found.failures)
    pieces = [np.flatnonzero(member).tolist() for member in binned.bins.member.T]
    pieces.append([*range(len(binned.bins.member))])
    return [[_cell(found, field, some) for some in pieces] for field in range(len(fields))]


def _cell(found: PieceNumbers, field: int, pieces: Sequence[int]) -> _Cell | None:
    """Returns the numbers of a field in some pieces; None if there are none."""
    parts = [part for piece in pieces for part in found.parts(field, piece)]
    least = found.extreme(field, pieces, LEAST)
    greatest = found.extreme(field, pieces, GREATEST)
    if least is None or greatest is None:
        return None
    mean = _mean(math.fsum(part.total for part in parts), sum(part.size for part in parts))
    return _Cell(mean, (least[0] + 0.0, least[1]), (greatest[0] + 0.0, greatest[1]))


def _mean(total: float, count: int) -> float:
    # Plus 0.0: no reply says -0.0.
    return float(f"{total / count:.{_MEAN_DIGITS}g}") + 0.0


def _note_failures(view: View, failures: Sequence[UndecodableError]) -> None:
    if failures:
        view.notes.complete = False
        reason = failures[0].reason
        view.notes.add(f"messages left out, since they cannot be decoded: {reason}")


def _numbers_by_shares(
    view: View, topic: str, binned: BinnedWindow, fields: Sequence[str]
) -> list[Sequence[_Cell | None]]:
    """Does as `_numbers` where there are no columns: in a lake."""
    reader = FieldReader(view, topic, fields)
    folded = reader.over(binned.counted, binned.bins.edges[1:-1].tolist())
    binned.count_since(folded.since)
    _note_failures(view, reader.failures)
    firsts = [at for part in folded.parts for at in part.first]
    among = binned.bins.among(firsts)
    rows = [np.flatnonzero(each) for each in (*among.T, np.ones(len(firsts), np.bool_))]
    extremes = _Extremes(reader, folded.parts)
    return [[extremes.cell(at, some.tolist()) for some in rows] for at in range(len(fields))]


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
        mean = _mean(total, count)
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
