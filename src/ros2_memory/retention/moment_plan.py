"""Which bags a moment needs, whether it waits for more, and whether its share has room. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.layout import is_carried
from ros2_memory.core.model import BagState, TimeWindow
from ros2_memory.core.timebase import MAX_NS, NS_PER_S
from ros2_memory.retention.policy import GB

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Ns

REPAIRED_WITHIN_NS: Final[Ns] = 600 * NS_PER_S
"""A bag that a crash left open is waited for so long: once it is repaired it is another file."""
LONGEST_WAIT_NS: Final[Ns] = 2 * 3600 * NS_PER_S
"""No split stays open for longer, unless somebody else's recorder writes it, or clocks differ."""


class Needed(NamedTuple):
    """The bags of a moment that can be kept now, in order of time; `waits`: there may be more."""

    bags: tuple[BagFile, ...]
    waits: bool


class Weight(NamedTuple):
    """One file: its inode, and its bytes."""

    inode: int
    size: int


def window_of(start: Ns, end: Ns) -> TimeWindow:
    """The window of a moment, both ends included."""
    return TimeWindow(start, min(end + 1, MAX_NS))


def needed(
    window: TimeWindow,
    asked: Ns,
    bags: Iterable[BagFile],
    open_files: Iterable[TimeWindow | None],
    now: Ns,
) -> Needed:
    """What a moment needs of the bags.

    Args:
        window: when the moment was.
        asked: when it was asked for.
        bags: those that answer.
        open_files: when what is still being written may have been recorded; None: unknown.
        now: the present moment.
    """
    waits = now < window.stop or any(each is None or _meet(each, window) for each in open_files)
    ready = []
    for bag in bags:
        if not window.overlaps(bag.start, bag.end) or is_carried(bag.path):
            continue
        unfinished = bag.state is BagState.INCOMPLETE and bag.file.endswith(".mcap")
        if unfinished and now - asked < REPAIRED_WITHIN_NS:
            waits = True
        else:
            ready.append(bag)
    return Needed(tuple(ready), waits and abs(now - asked) < LONGEST_WAIT_NS)


def admitted(
    files: Sequence[Weight], held: Mapping[int, int], share: int, expected: int = 0
) -> tuple[Weight, ...] | None:
    """The files that are not held yet, if all of them may be.

    Args:
        files: what a moment needs.
        held: what moments hold, by inode, in bytes.
        share: how many bytes they may hold.
        expected: bytes of what is still being written.
    """
    new = {each.inode: each for each in files if each.inode not in held}
    weight = sum(each.size for each in new.values())
    return tuple(new.values()) if sum(held.values()) + weight + expected <= share else None


def fitting(files: Iterable[Weight], held: Mapping[int, int], share: int) -> set[int]:
    """By inode the files, the first ones rather, that moments may hold; those held among them."""
    total, taken = sum(held.values()), set(held)
    for each in files:
        if each.inode not in taken and total + each.size <= share:
            taken.add(each.inode)
            total += each.size
    return taken


def no_room(held: Mapping[int, int], more: int, share: int) -> str:
    """Why a moment of so many bytes more is refused."""
    return (
        f"moments may take {share / GB:.3g} GB, {sum(held.values()) / GB:.3g} GB of that are "
        f"used, and this one takes {more / GB:.3g} GB more; delete folders in moments/ of the bag "
        "directory, raise retention.max_moments_gb, or ask for fewer seconds"
    )


def _meet(one: TimeWindow, other: TimeWindow) -> bool:
    return one.start < other.stop and other.start < one.stop
