"""What numbers a topic held in each bin of a window: how many messages, least, greatest, mean."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, Literal, TypeAlias

import numpy as np

from ros2_memory.core.errors import InvalidArgumentsError, UndecodableError
from ros2_memory.counts.bins import MOST_CELLS, BinnedWindow, By
from ros2_memory.counts.column_numbers import GREATEST, LEAST, SUM_SCALE, PieceNumbers
from ros2_memory.counts.values import count_values
from ros2_memory.history.counting import count_messages
from ros2_memory.history.no_data import no_data_between, resolve_topic
from ros2_memory.history.robots import note_robots
from ros2_memory.history.view import TimeRange, View, open_span

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from numpy.typing import NDArray

    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.results import BinColumn, Bins

    Times: TypeAlias = NDArray[np.int64]
    _Cell: TypeAlias = tuple[float, Ns, float, Ns, float]

_CELL: Final[tuple[tuple[str, BinColumn], ...]] = (
    ("min", "number"),
    ("min_at", "time"),
    ("max", "number"),
    ("max_at", "time"),
    ("mean", "number"),
)
"""The columns of a field."""
_MEAN_DIGITS: Final = 12
"""What rounding of sums cannot change, however a window is cut into bags."""


def count_range(
    memory: Memory,
    call: Call,
    topic: str,
    span: TimeRange,
    by: By | Literal["value"],
    *,
    fields: Sequence[str] = (),
) -> Bins:
    """Returns how many messages of a topic each bin holds, and the numbers of fields in them.

    By value how often and how long it held each (`counts.values`).

    Raises:
        InvalidArgumentsError: there are too many bins, or too many fields for them.
        NoDataError: there is no message in the window.
        QueryTimeoutError: the call's time is over.
    """
    view, asked = open_span(memory, call, span)
    name = resolve_topic(view, topic)
    if by == "value":
        return count_values(view, name, asked, fields=fields)
    binned = BinnedWindow(view, asked, by, (name,))
    names = tuple(dict.fromkeys(fields))
    size = len(binned.bins.names)
    if len(names) * size > MOST_CELLS:
        raise InvalidArgumentsError(
            f"{len(names)} fields by {by} in {size} bins are too many for one reply: "
            "name fewer fields, or ask about a shorter window"
        )
    numbers = _numbers(view, name, binned, names) if names else None
    edges = binned.bins.edges[1:-1]
    counts, first, last = count_messages(view, name, binned.counted, edges)
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


def _numbers(
    view: View, topic: str, binned: BinnedWindow, fields: Sequence[str]
) -> list[Sequence[_Cell | None]]:
    """Returns for each field the numbers in each bin, and in all of them together."""
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
    total = math.fsum(part.total for part in parts)
    mean = float(f"{total / sum(part.size for part in parts) / SUM_SCALE:.{_MEAN_DIGITS}g}")
    # The extremes are exact; what columns add up to is not. Plus 0.0: no reply says -0.0.
    mean = min(max(mean, least[0]), greatest[0]) + 0.0
    return least[0] + 0.0, least[1], greatest[0] + 0.0, greatest[1], mean


def _note_failures(view: View, failures: Sequence[UndecodableError]) -> None:
    if failures:
        view.notes.complete = False
        reason = failures[0].reason
        view.notes.add(f"messages left out, since they cannot be decoded: {reason}")


def _add_columns(binned: BinnedWindow, field: str, cells: Sequence[_Cell | None]) -> None:
    """Adds the columns of a field; the last cell is that of all bins together."""
    if cells[-1] is None:
        binned.view.notes.add(f"{field} holds no number in the window")
        return
    for nth, (name, kind) in enumerate(_CELL):
        *each, whole = [None if cell is None else cell[nth] for cell in cells]
        binned.add(f"{field}.{name}", kind, each, whole)
