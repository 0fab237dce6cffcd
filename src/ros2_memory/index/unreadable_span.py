"""When the messages of a file that cannot be read may have been recorded. Pure decisions.

Such a file shows nothing of its times; the files around it do:

    not before   the end of the split before it in its recording, else the time in the name of a
                 recording of this program
    not after    the start of the split after it, else the last time that the file was written to

Between two splits nothing more is known. Where only one side is known, the file is taken to hold a
day at most: so an old file that nobody removes, or one that was copied here later, does not affect
answers about other days. Where neither side is known, or the file's own date cannot be true, its
time is unknown.

That a file holds a day at most is an estimate, good enough for a note beside an answer. Where the
answer is that there is nothing, the file counts wherever it can contain a message: `bounds`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.layout import named_start
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import FUTURE_NS, MAX_NS, MIN_NS, NS_PER_S, Ns
from ros2_memory.index.clock_faults import FIRST_BAGS_NS, max_plausible

if TYPE_CHECKING:
    from ros2_memory.index.split_order import Neighbours

MAX_FILE_NS: Final[Ns] = 24 * 3600 * NS_PER_S
"""The longest span that a file is taken to hold when one end of it is known."""


def unreadable_span(
    recording: str, near: Neighbours, written: Ns | None, now: Ns, *, growing: bool = False
) -> TimeWindow | None:
    """Returns the log times between which all messages of a file lie; None where unknown.

    Args:
        recording: the name of the file's folder.
        near: the splits around it.
        written: the file's mtime; None where unknown.
        now: the present.
        growing: whether the file is still being written.
    """
    start = named_start(recording) if near.before is None else near.before
    if near.after is not None:
        if start is None or (near.before is None and start > near.after):
            start = max(near.after - MAX_FILE_NS, MIN_NS)
        low, high = sorted((start, near.after))
        return TimeWindow(low, min(high + 1, MAX_NS))
    if growing:
        return TimeWindow(max(now - MAX_FILE_NS, MIN_NS) if start is None else start, MAX_NS)
    end = _last_written(written, now)
    if start is None:
        return None if end is None else TimeWindow(end - MAX_FILE_NS, end)
    longest = min(start + MAX_FILE_NS, MAX_NS)
    # A file last written before its start was recorded by another clock than its file system's.
    return TimeWindow(start, longest if end is None or end <= start else min(end, longest))


def unreadable_bounds(
    recording: str, near: Neighbours, written: Ns | None, now: Ns
) -> TimeWindow | None:
    """Returns the log times outside of which a closed file has no message; None: anywhere.

    As `unreadable_span`, without the estimate of how much a file holds. Splits between which the
    clock was set back bound nothing.
    """
    start = named_start(recording) if near.before is None else near.before
    end = _last_written(written, now) if near.after is None else min(near.after + 1, MAX_NS)
    if start is None and end is None:
        return None
    if start is not None and end is not None and end <= start:
        return None
    return TimeWindow(MIN_NS if start is None else start, MAX_NS if end is None else end)


def _last_written(written: Ns | None, now: Ns) -> Ns | None:
    """Returns the latest log time that a file can have, by its mtime; None where that cannot be."""
    if written is None or not FIRST_BAGS_NS <= written <= max_plausible(now):
        return None
    return min(written + FUTURE_NS, MAX_NS)
