"""What the bags of a timeline tell of clocks, and of the files between them that cannot be read."""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING

from ros2_memory.core.model import BagState, TimeWindow
from ros2_memory.core.timebase import MAX_NS
from ros2_memory.index import unreadable_span
from ros2_memory.index.clock_faults import Part, dating_of
from ros2_memory.index.split_order import (
    Neighbours,
    StepBack,
    is_recording,
    neighbours,
    place_of,
    steps_of,
)
from ros2_memory.index.unreadable_span import LONGEST_NS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.core.model import BagFile, SetAside
    from ros2_memory.core.timebase import Ns
    from ros2_memory.index.clock_faults import Dating
    from ros2_memory.index.segment import Segment
    from ros2_memory.index.timeline import Timeline


def dating(timeline: Timeline, now: Ns, *, with_steps: bool) -> Dating:
    """What the dates of the bags come to; the bag of carried messages dates nothing.

    `with_steps` looks at the order of the splits too, which takes a moment where bags are many.
    """

    def around(first: Ns, last: Ns) -> Sequence[BagFile]:
        return timeline.overlapping(TimeWindow(first, min(last + 1, MAX_NS)))

    steps = _steps(timeline.runs) if with_steps else []
    return dating_of(_parts(timeline.runs), steps, now, around)


def place(timeline: Timeline, aside: SetAside, now: Ns, *, growing: bool) -> TimeWindow | None:
    """When the messages of a file that do not answer may have been recorded; None: unknown."""
    if aside.until is not None:
        return TimeWindow(min(aside.until + 1, MAX_NS), MAX_NS)
    near = _near(timeline, aside)
    return unreadable_span.unreadable_span(
        aside.path.parent.name, near, aside.written, now, growing=growing
    )


def bounds(timeline: Timeline, aside: SetAside, now: Ns) -> TimeWindow | None:
    """The times outside of which a closed file that does not answer has no message; None: unknown.

    Files that are counted, but not as `ros2 bag record` counts splits, may lie in any order.
    """
    split = place_of(str(aside.path))
    is_split = split is not None and is_recording(split[0])
    near = _near(timeline, aside) if is_split else Neighbours()
    return unreadable_span.bounds(aside.path.parent.name, near, aside.written, now)


def _near(timeline: Timeline, aside: SetAside) -> Neighbours:
    folder = str(aside.path.parent)
    runs = [run for run in timeline.runs if folder in run.folders]
    courses = [run.courses for run in runs]
    return neighbours(str(aside.path), courses, lambda at: _bags(runs, at))


def lost_until(bag: BagFile) -> Ns:
    """Until when (inclusive) a bag may have recorded what cannot be read of it."""
    written = bag.mtime_ns
    behind = bag.state is BagState.INCOMPLETE and bag.end < written <= bag.end + LONGEST_NS
    return written if behind else bag.end


def _parts(runs: Sequence[Segment]) -> list[Part]:
    parts = [
        Part(
            run.recorded,
            run.latest if run.recorded is run.bags else max(bag.end for bag in run.recorded),
        )
        for run in runs
        if run.recorded
    ]
    return parts or [Part(run.bags, run.latest) for run in runs]


def _steps(runs: Sequence[Segment]) -> list[StepBack]:
    between = steps_of([run.courses for run in runs], lambda at: _bags(runs, at))
    within = (bag for run in runs for bag in run.set_back)
    return [*between, *(StepBack(bag, bag, bag.summary.shape.set_back) for bag in within)]


def _bags(runs: Sequence[Segment], at: Sequence[int]) -> chain[BagFile]:
    return chain.from_iterable(runs[number].bags for number in at)
