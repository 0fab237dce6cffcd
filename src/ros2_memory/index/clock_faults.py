"""Bags that a wrong clock dated, found by comparing them with the bags around. Pure decisions.

A robot without a battery-backed clock starts in 1970 and is corrected once it has a network. Clocks
also run ahead, and are set back during a recording. Such bags keep their times, and are found by
them; but the span of the memory, and its newest moment, are computed without them:

    before 2017          the clock was not set; if no bag has another date, it was simulated
    after now            the clock was ahead; if all bags are, this machine's clock is behind
    set back by a day    the side of the step with fewer bags of the recording is wrong; of equals
                         the earlier one
    set ahead by 30 days during a recording: what it has from before that is wrong

A clock that was set back by less is listed and leaves the span as it is. If this machine's own
clock is before 2017, no date counts as being in the future, and a note says so.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from enum import StrEnum
from itertools import chain
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.core.bag_summary import OUT_OF_ORDER_NS, set_back_while_written
from ros2_memory.core.memo import Key
from ros2_memory.core.model import BagFile, TimeWindow
from ros2_memory.core.timebase import FUTURE_NS, MAX_NS, NS_PER_S, Ns, Span, unix_from_ns
from ros2_memory.index.holes import FAR_AHEAD_NS
from ros2_memory.index.segment import in_time
from ros2_memory.index.split_order import splits_before_set_ahead

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

    from ros2_memory.core.arrays import Flags
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
    SET_AHEAD = "set ahead"
    STRAY = "stray"


_UNDATED: Final = frozenset({FaultyClock.UNSET, FaultyClock.AHEAD, FaultyClock.SET_AHEAD})
"""Where the true dates of a bag are known by its file, or by how far the clock was set, at best."""


class ClockFault(NamedTuple):
    """A bag that a wrong clock dated.

    Attributes:
        bag: the bag.
        kind: what is wrong with the clock.
        by: `AHEAD`: how far the last message lies after the present (ns). `SET_BACK`: how far the
            clock was set back (ns), at least. `SET_AHEAD`: how far it was set (ns), at most.
        before: the bag that was begun before the clock was set back; None if `bag` itself was.
        misleads: whether the bag is left out of the span of the memory; of `SET_AHEAD` what it has
            from before that.
        until: `SET_AHEAD`: the log time of the last message before that.
    """

    bag: BagFile
    kind: FaultyClock
    by: Ns = 0
    before: BagFile | None = None
    misleads: bool = True
    until: Ns | None = None

    @property
    def leaves_out_bag(self) -> bool:
        """Whether the whole bag is left out of the span of the memory."""
        return self.misleads and self.until is None

    @property
    def span(self) -> Span:
        """The first and the last log time that the wrong clock gave."""
        return self.bag.start, self.bag.end if self.until is None else self.until

    def reaches_into(self, window: TimeWindow) -> bool:
        """Returns whether the times that the wrong clock gave overlap a window."""
        return window.overlaps(*self.span)

    def may_be_of(self, window: TimeWindow) -> bool:
        """Returns whether the bag may be of a window that its dates do not reach."""
        start, _ = window.asked()
        if self.kind not in _UNDATED or not self.misleads or self.reaches_into(window):
            return False
        if self.kind is FaultyClock.SET_AHEAD:
            return window.overlaps(*(at + self.by for at in self.span))
        return start <= self.bag.mtime_ns or self.bag.mtime_ns < FIRST_BAGS_NS

    @property
    def at(self) -> Ns:
        """The first log time after the clock was set back; for other kinds, the bag's first."""
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
            case FaultyClock.SET_BACK:
                after = f"the clock was set back by {_length(self.by)} after "
                within = set_back_while_written(self.by)
                return f"{after}{self.before.path.name} was begun" if self.before else within
            case FaultyClock.SET_AHEAD:
                when = "after" if self.until is None else "while"
                return (
                    f"dated from {_seconds(self.bag.start)} on; {when} it was written, the clock "
                    f"was set {_length(self.by)} ahead"
                )
            case FaultyClock.STRAY:
                return (
                    f"dated {_seconds(self.bag.start)}, a day or more from the rest of its "
                    "recording, between which the clock was set back"
                )


@dataclass(frozen=True, slots=True)
class Dating:
    """What the dates of all bags show.

    Attributes:
        earliest: log time of the first message in a correctly dated bag; None without bags.
        latest: log time of the last message in such a bag (inclusive).
        faults: the bags that a wrong clock dated.
        note: a sentence if this machine's clock contradicts all bags.
    """

    earliest: Ns | None = None
    latest: Ns | None = None
    faults: tuple[ClockFault, ...] = ()
    note: str | None = None

    @property
    def misdated(self) -> frozenset[str]:
        """The paths of the bags that are left out of the span."""
        return frozenset(fault.bag.file for fault in self.faults if fault.leaves_out_bag)

    @property
    def ahead_from(self) -> Ns:
        """The first log time at which a bag is dated after now; MAX_NS if none is."""
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
        timeline: the bags. The bag of carried messages shows nothing about clocks.
        steps: where a clock was set back during a recording.
        now: the present by this machine's clock.
    """
    segments = timeline.recorded_segments
    limit = max_plausible(now)
    unset: list[ClockFault] = []
    ahead: list[ClockFault] = []
    set_ahead = _set_ahead(timeline, limit)
    for segment in segments:
        bags = segment.bags
        if segment.first[0] < FIRST_BAGS_NS:
            is_unset = (bags.starts < FIRST_BAGS_NS) & (bags.ends <= limit)
            unset += [
                ClockFault(bag, FaultyClock.UNSET)
                for bag in bags.at(is_unset)
                if bag.file not in set_ahead
            ]
        if segment.latest > limit:
            late = bags.at(bags.ends > limit)
            ahead += [ClockFault(bag, FaultyClock.AHEAD, bag.end - now) for bag in late]
    total = sum(len(segment.bags) for segment in segments)
    note: str | None = None
    if len(ahead) == total and total:
        ahead = [fault._replace(misleads=False) for fault in ahead]
        note = "every bag is dated after now: the clock of this machine is behind, or theirs ahead"
    elif len(ahead) + len(unset) == total:
        unset = []  # a simulated clock, or a robot that has none
    if now < FIRST_BAGS_NS and any(segment.latest >= FIRST_BAGS_NS for segment in segments):
        note = "the clock of this machine is not set: bags are dated years after now"
    faults = [*unset, *ahead, *set_ahead.values()]
    faults += _step_faults(steps, {fault.bag.file for fault in faults}, timeline)
    if len({fault.bag.file for fault in faults if fault.leaves_out_bag}) == total:
        faults = [fault._replace(misleads=False) for fault in faults]
    dated = dated_segments(timeline, faults)
    return Dating(
        earliest=_first_dated(dated, set_ahead),
        latest=max((segment.latest for segment in dated), default=None),
        faults=tuple(faults),
        note=note,
    )


def _set_ahead(timeline: Timeline, limit: Ns) -> dict[str, ClockFault]:
    """Returns by file the bags from before the clock was set far ahead during their recording.

    `limit` is the latest plausible date.
    """
    within = [
        ClockFault(bag, FaultyClock.SET_AHEAD, end - start, until=start)
        for segment in timeline.recorded_segments
        for bag, (start, end) in segment.set_ahead
        if end >= FIRST_BAGS_NS and bag.end <= limit
    ]
    lengths = {fault.bag: fault.by for fault in within}
    whole = [
        ClockFault(bag, FaultyClock.SET_AHEAD, by)
        for bag, by in splits_before_set_ahead(timeline, lengths, FAR_AHEAD_NS).items()
        if FIRST_BAGS_NS <= bag.end + by <= limit
    ]
    return {fault.bag.file: fault for fault in (*within, *whole)}


def _first_dated(dated: Sequence[Segment], set_ahead: Mapping[str, ClockFault]) -> Ns | None:
    """Returns the first log time of correctly dated bags; None without any.

    Those in `set_ahead` count from when the clock was set.
    """
    firsts: list[Ns] = []
    for bag in chain.from_iterable(segment.bags for segment in dated):
        fault = set_ahead.get(bag.file)
        if fault is None or fault.until is None:
            firsts.append(bag.start)
            break
        firsts.append(fault.until + fault.by)
    return min(firsts, default=None)


def _step_faults(
    steps: Iterable[StepBack],
    faulty: Collection[str],
    timeline: Timeline,
) -> Iterator[ClockFault]:
    """Yields the steps back of clocks, and the bags that a step of a day shows to be misdated.

    `faulty` are the paths of bags with another fault, which explains their steps.
    """
    faults = [
        ClockFault(
            step.after,
            FaultyClock.SET_BACK,
            step.by,
            None if step.before is step.after else step.before,
            misleads=False,
        )
        for step in steps
        if step.before.file not in faulty and step.after.file not in faulty
    ]
    within_bags = {fault.bag.file: fault for fault in faults if fault.before is None}
    starts, ends = timeline.starts, timeline.ends
    are_strays = np.zeros(starts.size, np.bool_)
    for fault in faults:
        if not _is_shown_within_bag(fault, within_bags):
            yield fault
        if fault.before is None or fault.by < FAR_BACK_NS:
            continue
        first, last = fault.bag.start, fault.before.end
        after, before = (TimeWindow.around(at, FAR_BACK_NS // 2) for at in (first, last))
        of_recording = _in_folder(timeline, str(fault.bag.recording))
        bags_after, bags_before = (
            np.count_nonzero(side.overlapping(starts, ends) & of_recording)
            for side in (after, before)
        )
        # Of equals the earlier one is wrong: a clock that loses its time falls back. Its dates
        # begin, or end, at the step.
        if bags_after <= bags_before:
            wrong = TimeWindow(first, after.stop)
        else:
            wrong = TimeWindow(before.start, min(last + 1, MAX_NS))
        are_strays |= wrong.overlapping(starts, ends) & of_recording
    strays = map(timeline.bags.__getitem__, np.flatnonzero(are_strays).tolist())
    yield from (ClockFault(bag, FaultyClock.STRAY) for bag in strays if bag.file not in faulty)


def _in_folder(timeline: Timeline, folder: str) -> Flags:
    """Returns which bags of a history lie in a folder."""
    flags = [
        np.array([name == folder for name in bags.folders])[bags.folder_of]
        for bags in (segment.bags for segment in timeline.segments)
    ]
    return np.concatenate(flags)


def _is_shown_within_bag(fault: ClockFault, within_bags: Mapping[str, ClockFault]) -> bool:
    """Returns whether a step between two bags repeats the step within one of them.

    A bag in which the clock was set back begins before its predecessor ends, and ends after its
    successor begins. `within_bags` has by path the steps within bags.
    """
    if fault.before is None:
        return False
    in_after, in_before = within_bags.get(fault.bag.file), within_bags.get(fault.before.file)
    if in_after and fault.before.end <= in_after.at + in_after.by + OUT_OF_ORDER_NS:
        return True
    return in_before is not None and fault.bag.start >= in_before.at - OUT_OF_ORDER_NS


def dated_segments(timeline: Timeline, faults: Sequence[ClockFault]) -> Sequence[Segment]:
    """Returns the recorded segments without the bags that mislead; remembers them."""
    misdated = [fault.bag for fault in faults if fault.leaves_out_bag]
    files = frozenset(bag.file for bag in misdated)
    remembered = timeline.memo.of(_DATED, dict)
    if files not in remembered:
        firsts = [segment.first for segment in timeline.recorded_segments]
        touched = {bisect_right(firsts, in_time(bag)) - 1 for bag in misdated}
        dated: list[Segment] = []
        for nth, segment in enumerate(timeline.recorded_segments):
            # An untouched segment keeps what it has computed.
            rest: Segment | None = segment
            if nth in touched:
                rest = segment.without(file in files for file in segment.bags.files())
            dated += () if rest is None else (rest,)
        remembered[files] = dated
    return remembered[files]


def _seconds(at: Ns) -> str:
    return f"{unix_from_ns(at):.0f}"


def _length(duration: Ns) -> str:
    return f"{unix_from_ns(duration):.0f} s"
