"""Which part of the recordings can be searched now, and in which order. Pure.

Splits close one after the other, and two recordings overlap while one takes over. A message counts
for a rule once nothing earlier can come: so a recording is searched up to the end of what is closed
in those that are being written, less the time by which messages are written out of order. Where
clocks differ by more than recordings can overlap, they do not wait for each other.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.layout import named_start
from ros2_memory.core.bag_summary import OUT_OF_ORDER_NS
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S, Ns

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence

    from ros2_memory.core.model import BagFile

LEAST_NEAR_NS: Final[Ns] = 60 * NS_PER_S
"""Recordings that take over from each other overlap by less."""
_SPLITS_NEAR: Final = 3


class SearchPart(NamedTuple):
    """A part of one recording that can be searched: its closed bags that touch a window."""

    recording: str
    window: TimeWindow
    bags: tuple[BagFile, ...]


class SearchChain(NamedTuple):
    """Parts of recordings that took over from each other, in order.

    `goes_on`: the first of them goes on from what was searched before, without a gap.
    """

    parts: tuple[SearchPart, ...]
    goes_on: bool


def chains_to_search(
    closed: Mapping[str, Sequence[BagFile]],
    live: Collection[str],
    searched: Mapping[str, Ns],
    previous: Callable[[str], str | None],
    split_ns: Ns,
) -> list[SearchChain]:
    """Returns what can be searched of recordings.

    Args:
        closed: their closed bags, by recording, in the order in which the recordings began.
        live: those that are being written.
        searched: until when each was searched.
        previous: gives the recording that one took over from; None where it took over from none.
        split_ns: how long one bag is.
    """
    ends = {name: max((bag.end for bag in bags), default=MIN_NS) for name, bags in closed.items()}
    written = {name: ends[name] if closed.get(name) else None for name in live}
    limits = horizons(ends, written, split_ns)
    chains: list[SearchChain] = []
    last: str | None = None
    for name, bags in closed.items():
        start = searched.get(name, MIN_NS)
        window = TimeWindow(start, max(start, min(limits[name], ends[name] + 1)))
        touched = tuple(each for each in bags if window.overlaps(each.start, each.end))
        if window.empty or not touched:
            continue
        part = SearchPart(name, window, touched)
        from_before = name in searched
        other = None if from_before else previous(name)
        if last is not None and (from_before or other == last):
            chains[-1] = SearchChain((*chains[-1].parts, part), chains[-1].goes_on)
        else:
            chains.append(SearchChain((part,), from_before or other in searched))
        last = name
    return chains


def horizons(ends: Mapping[str, Ns], live: Mapping[str, Ns | None], split_ns: Ns) -> dict[str, Ns]:
    """Returns until when nothing can come any more that affects recordings; MAX_NS for all times.

    Args:
        ends: where what is closed of each recording ends.
        live: the same of those that are being written; None where nothing of one is closed.
        split_ns: how long one bag is.
    """
    begun = {name: named_start(name) if end is None else end for name, end in live.items()}
    known = {name: end - OUT_OF_ORDER_NS for name, end in begun.items() if end is not None}
    near = max(LEAST_NEAR_NS, _SPLITS_NEAR * split_ns)
    return {
        name: min(
            (until for other, until in known.items() if other == name or abs(until - end) <= near),
            default=MAX_NS,
        )
        for name, end in ends.items()
    }
