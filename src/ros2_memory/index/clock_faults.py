"""Bags that a wrong clock dated, found by comparing them with the bags around. Pure decisions.

A robot without a battery-backed clock starts in 1970 and is corrected once it has a network; clocks
are also ahead, and are set back while a recording runs. Bags keep their times, and are found by
them; but the span of the memory, and its newest moment, are computed without the wrong ones:

    before 2017          the clock was not set; simulated where no bag has another date
    after now            the clock was ahead; this machine's own is behind where all bags are so
    set back by a day    of the two sides the one with fewer bags around it; of equals the earlier

A clock that is set back by less is listed and leaves the span as it is. Where this machine's own
clock is before 2017 no date counts as being in the future.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import takewhile
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.core.bag_summary import OUT_OF_ORDER_NS, set_back_while_written
from ros2_memory.core.memo import Key
from ros2_memory.core.model import BagFile, TimeWindow
from ros2_memory.core.timebase import FUTURE_NS, MAX_NS, NS_PER_S, Ns, unix_from_ns
from ros2_memory.index.segment import in_time

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

    from ros2_memory.index.segment import Segment
    from ros2_memory.index.split_order import StepBack
    from ros2_memory.index.timeline import Timeline

FIRST_BAGS_NS: Final[Ns] = 1_483_228_800 * NS_PER_S
"""2017-01-01, before the first release of ROS 2. Clocks without a battery start in 1970."""
FAR_BACK_NS: Final[Ns] = 24 * 3600 * NS_PER_S
"""Where a clock is set back by this much, the dates before or after that are wrong."""

_DATED: Final[Key[dict[frozenset[str], Sequence[Segment]]]] = Key()
"""Of a timeline: the segments without some bags, by their files."""


class FaultyClock(StrEnum):
    """What is wrong with the dates of a bag."""

    UNSET = "unset"
    AHEAD = "ahead"
    SET_BACK = "set back"
    STRAY = "stray"


class ClockFault(NamedTuple):
    """A bag that a wrong clock dated.

    `by` is how far its last message lies after the present, or how far the clock was set back after
    the bag `before` was begun (None: at least this far, while this bag was being written).
    `misleads`: it is left out of the span of the memory.
    """

    bag: BagFile
    kind: FaultyClock
    by: Ns = 0
    before: BagFile | None = None
    misleads: bool = True

    @property
    def at(self) -> Ns:
        """The first log time after the clock was set back; of other faults that of the bag."""
        set_back = self.bag.summary.schema.clock_set_back if self.before is None else None
        return self.bag.start if set_back is None else set_back[1]

    @property
    def reason(self) -> str:
        """What is wrong, as a sentence, and what follows from it."""
        left_out = "; left out of earliest and latest" if self.misleads else ""
        return f"{self.description}{left_out}"

    @property
    def description(self) -> str:
        """What is wrong, as a sentence."""
        match self.kind:
            case FaultyClock.UNSET if self.bag.mtime_ns >= FIRST_BAGS_NS:
                return (
                    f"its messages are dated from {_seconds(self.bag.start)} on, its file "
                    f"{_seconds(self.bag.mtime_ns)}: the clock was not set, or was simulated"
                )
            case FaultyClock.UNSET:
                return f"dated from {_seconds(self.bag.start)} on: the clock was not set"
            case FaultyClock.AHEAD:
                return (
                    f"dated up to {_seconds(self.bag.end)}, {_length(self.by)} after now: "
                    "the clock was ahead"
                )
            case FaultyClock.SET_BACK if self.before is not None:
                name = self.before.path.name
                return f"the clock was set back by {_length(self.by)} after {name} was begun"
            case FaultyClock.SET_BACK:
                return set_back_while_written(self.by)
            case FaultyClock.STRAY:
                return (
                    f"dated {_seconds(self.bag.start)}, a day or more from the rest of its "
                    "recording, between which the clock was set back"
                )


@dataclass(frozen=True, slots=True)
class Dating:
    """What the dates of all bags show.

    `earliest` and `latest` are the log times of the first and last message (inclusive) of correctly
    dated bags; None without bags. `note` is a sentence on a clock that contradicts all of them.
    """

    earliest: Ns | None = None
    latest: Ns | None = None
    faults: tuple[ClockFault, ...] = ()
    note: str | None = None

    @property
    def misdated(self) -> frozenset[str]:
        """The paths of the bags that are left out of the span."""
        return frozenset(fault.bag.file for fault in self.faults if fault.misleads)

    @property
    def ahead_from(self) -> Ns:
        """The log time from which on bags are dated after now; MAX_NS if none is."""
        ahead = (fault for fault in self.faults if fault.kind is FaultyClock.AHEAD)
        begins = (max(fault.bag.start, fault.bag.end - fault.by) for fault in ahead)
        return min(begins, default=MAX_NS)


def max_plausible(now: Ns) -> Ns:
    """Returns the latest plausible date of a message."""
    return MAX_NS if now < FIRST_BAGS_NS else min(now + FUTURE_NS, MAX_NS)


def check_dates(
    timeline: Timeline,
    steps: Sequence[StepBack],
    now: Ns,
) -> Dating:
    """Returns what the dates of all bags show.

    Args:
        timeline: the bags; that of carried messages shows nothing about clocks.
        steps: where a clock was set back while a recording ran.
        now: the present by this machine's clock.
    """
    segments = timeline.recorded_segments
    limit = max_plausible(now)
    ahead = [
        ClockFault(bag, FaultyClock.AHEAD, bag.end - now)
        for segment in segments
        if segment.latest > limit
        for bag in segment.bags.at(segment.bags.ends > limit)
    ]
    unset = [
        ClockFault(bag, FaultyClock.UNSET)
        for segment in takewhile(lambda segment: segment.first[0] < FIRST_BAGS_NS, segments)
        for bag in segment.bags.at(
            (segment.bags.starts < FIRST_BAGS_NS) & (segment.bags.ends <= limit)
        )
    ]
    bags = sum(len(segment.bags) for segment in segments)
    note: str | None = None
    if len(ahead) == bags and bags:
        ahead = [fault._replace(misleads=False) for fault in ahead]
        note = "every bag is dated after now: the clock of this machine is behind, or theirs ahead"
    elif len(ahead) + len(unset) == bags:
        unset = []  # a simulated clock, or a robot that has none
    faults = [*unset, *ahead]
    faults += _step_faults(steps, {fault.bag.file for fault in faults}, timeline)
    dating = Dating(faults=tuple(faults), note=note)
    if len(dating.misdated) == bags:
        dating = replace(dating, faults=tuple(fault._replace(misleads=False) for fault in faults))
    dated = dated_segments(timeline, dating.faults)
    return replace(
        dating,
        earliest=dated[0].first[0] if dated else None,
        latest=max((segment.latest for segment in dated), default=None),
    )


def _step_faults(
    steps: Iterable[StepBack],
    faulty: Collection[str],
    timeline: Timeline,
) -> Iterator[ClockFault]:
    """Yields the faults of clocks that were set back, if no other fault explains the step."""
    steps = [
        step for step in steps if step.before.file not in faulty and step.after.file not in faulty
    ]
    faults = [
        ClockFault(
            step.after,
            FaultyClock.SET_BACK,
            step.by,
            None if step.before is step.after else step.before,
            misleads=False,
        )
        for step in steps
    ]
    within = {fault.bag.file: fault for fault in faults if fault.before is None}
    strays: set[str] = set()
    for step, fault in zip(steps, faults, strict=True):
        if not _is_shown_within(fault, within):
            yield fault
        if fault.before is None or step.by < FAR_BACK_NS:
            continue
        half = FAR_BACK_NS // 2
        sides = [
            timeline.overlapping(TimeWindow.around(at, half))
            for at in (step.after.start, step.before.end)
        ]
        # Of equals the earlier one is wrong: a clock that loses its time falls back.
        for bag in min(sides, key=len):
            if bag.file not in strays and bag.file not in faulty:
                strays.add(bag.file)
                yield ClockFault(bag, FaultyClock.STRAY)


def _is_shown_within(fault: ClockFault, within: Mapping[str, ClockFault]) -> bool:
    """Returns whether a step between two bags is the one within one of them.

    A bag in which the clock was set back begins before the one before it ends, and ends after the
    next one begins, too.

    Args:
        fault: a step.
        within: the steps within bags, by their files.
    """
    if fault.before is None:
        return False
    into, out_of = within.get(fault.bag.file), within.get(fault.before.file)
    return (into is not None and fault.before.end <= into.at + into.by + OUT_OF_ORDER_NS) or (
        out_of is not None and fault.bag.start >= out_of.at - OUT_OF_ORDER_NS
    )


def dated_segments(timeline: Timeline, faults: Sequence[ClockFault]) -> Sequence[Segment]:
    """Returns the recorded segments without the bags that mislead, in order; remembers them."""
    misdated = [fault.bag for fault in faults if fault.misleads]
    files = frozenset(bag.file for bag in misdated)
    known = timeline.memo.of(_DATED, dict)
    if files not in known:
        known[files] = _segments_without(timeline.recorded_segments, misdated, files)
    return known[files]


def _segments_without(
    segments: Sequence[Segment], misdated: Sequence[BagFile], files: Collection[str]
) -> Sequence[Segment]:
    firsts = [segment.first for segment in segments]
    # Of the others, what they remember serves the next snapshot.
    touched = {bisect_right(firsts, in_time(bag)) - 1 for bag in misdated}
    dated = (
        segment.without(file in files for file in segment.bags.files())
        if nth in touched
        else segment
        for nth, segment in enumerate(segments)
    )
    return [*filter(None, dated)]


def _seconds(at: Ns) -> str:
    return f"{unix_from_ns(at):.0f}"


def _length(duration: Ns) -> str:
    return f"{unix_from_ns(duration):.0f} s"
