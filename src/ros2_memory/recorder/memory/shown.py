"""What bags show besides their messages: silences, pauses, steps of the clock, crashes.

The days that stand for them have too few messages to show it; `memory/thinned.json` states it.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.clock_steps import SHORTEST_STEP_NS, STAMPS_BESIDE_NS
from ros2_memory.bag_dir.layout import utc_day
from ros2_memory.bag_dir.state_files import Thinned
from ros2_memory.core.model import BagState
from ros2_memory.index.clock_faults import FaultyClock

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Ns
    from ros2_memory.index.snapshot import Snapshot

    IntArray = NDArray[np.int64]

_MOST_PAUSES: Final = 32
"""Of a day; the messages beside each stay."""


def shown_by(known: Thinned, snapshot: Snapshot, bags: Sequence[BagFile]) -> Thinned:
    """Returns what is known, and what some bags of a snapshot show; at least one bag."""

    def is_in(at: Ns) -> bool:
        return any(bag.start <= at <= bag.end for bag in bags)

    silences = {each[:2]: each for each in known.silences}
    silences |= {each[:2]: (*each,) for each in snapshot.silences if is_in(each.start)}
    steps = [
        (fault.bag.start, fault.by)
        for fault in snapshot.dating.faults
        if fault.kind is FaultyClock.SET_BACK and fault.by >= SHORTEST_STEP_NS
    ]
    pauses = [(pause.start, pause.end) for pause in snapshot.suspects]
    left_open = [bag.end for bag in bags if bag.state is BagState.INCOMPLETE]
    since = bags[0].start if known.since is None else known.since
    if since > snapshot.scanned_at:  # by a clock that was ahead
        since = min(since, bags[0].start)
    return Thinned(
        since,
        tuple(sorted(silences.values(), key=lambda each: each[1])),
        (*_few_a_day([*known.pauses, *(pause for pause in pauses if is_in(pause[0]))]),),
        tuple(sorted({*known.set_back, *(step for step in steps if is_in(step[0]))})),
        tuple(sorted({*known.left_open, *left_open})),
    )


def _few_a_day(pauses: Iterable[tuple[Ns, Ns]]) -> Iterator[tuple[Ns, Ns]]:
    """Yields pauses in order of time, each once: the first `_MOST_PAUSES` of a day."""
    counts = Counter[str]()
    for pause in sorted(dict.fromkeys(pauses)):
        day = utc_day(pause[0])
        counts[day] += 1
        if counts[day] <= _MOST_PAUSES:
            yield pause


def beside(pauses: Iterable[tuple[Ns, Ns]], times: IntArray) -> IntArray:
    """Returns those of some log times (ns) that lie so near a pause that they show a step."""
    near = np.zeros(times.size, bool)
    for start, end in pauses:
        near |= (times >= start - STAMPS_BESIDE_NS) & (times <= end + STAMPS_BESIDE_NS)
    return times[near]
