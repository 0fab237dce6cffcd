"""When the messages of a file that cannot be read may have been recorded. A pure decision.

Such a file says nothing of its times; what lies around it does:

    not before   the end of the split before it in its recording, else the time in the name of a
                 recording of this program
    not after    the start of the split after it, else the last time that the file was written to

Between two splits that is all there is to know. Where only one side is known, or the other is only
known from outside, the file is taken to hold a day at most: so an old one that nobody removes, or
one that was copied here later, leaves the answers about all other days alone. Where neither side is
known, or the file's own date cannot be true, its time is unknown.

That a file holds a day at most is a guess, good enough for a note beside an answer. Where the
answer is that there is nothing, the file counts wherever it may hold a message: see `bounds`.
"""

from __future__ import annotations

import re
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S, Ns
from ros2_memory.index.clock_faults import FIRST_BAGS_NS, FUTURE_NS, last_believed

if TYPE_CHECKING:
    from ros2_memory.index.split_order import Neighbours

LONGEST_NS: Final[Ns] = 24 * 3600 * NS_PER_S
"""What a file of which one end is known is taken to hold at most."""

_OWN_NAME: Final = re.compile(r"rec_(\d{8}T\d{6})Z(?:_\d+)?")


def begun(recording: str) -> Ns | None:
    """When a recording of this program began, by its name; None for any other."""
    named = _OWN_NAME.fullmatch(recording)
    if named is None:
        return None
    try:
        moment = datetime.strptime(named[1], "%Y%m%dT%H%M%S").replace(tzinfo=UTC)
    except ValueError:
        return None
    return int(moment.timestamp()) * NS_PER_S


def unreadable_span(
    recording: str, near: Neighbours, written: Ns | None, now: Ns, *, growing: bool = False
) -> TimeWindow | None:
    """The log times between which all messages of a file lie; None where that is unknown.

    Args:
        recording: the name of the file's folder.
        near: the splits around it.
        written: the file's mtime; None where it is not known.
        now: the present.
        growing: whether the file is still being written.
    """
    start = begun(recording) if near.before is None else near.before
    if near.after is not None:
        if start is None or (near.before is None and start > near.after):
            start = max(near.after - LONGEST_NS, MIN_NS)
        low, high = sorted((start, near.after))
        return TimeWindow(low, min(high + 1, MAX_NS))
    if growing:
        return TimeWindow(max(now - LONGEST_NS, MIN_NS) if start is None else start, MAX_NS)
    end = _last_written(written, now)
    if start is None:
        return None if end is None else TimeWindow(end - LONGEST_NS, end)
    longest = min(start + LONGEST_NS, MAX_NS)
    # A file that was last written before it began was recorded by another clock than it lies under.
    return TimeWindow(start, longest if end is None or end <= start else min(end, longest))


def bounds(recording: str, near: Neighbours, written: Ns | None, now: Ns) -> TimeWindow | None:
    """The log times outside of which a closed file can hold no message; None where it may anywhere.

    As `unreadable_span`, without the guess how much a file holds. Splits around it of which the
    clock was set back in between bound nothing.
    """
    start = begun(recording) if near.before is None else near.before
    end = _last_written(written, now) if near.after is None else min(near.after + 1, MAX_NS)
    if start is not None and end is not None and end <= start:
        return None
    if start is None and end is None:
        return None
    return TimeWindow(MIN_NS if start is None else start, MAX_NS if end is None else end)


def _last_written(written: Ns | None, now: Ns) -> Ns | None:
    """The end of what a file may hold by its mtime; None where that cannot be true."""
    if written is None or not FIRST_BAGS_NS <= written <= last_believed(now):
        return None
    return min(written + FUTURE_NS, MAX_NS)
