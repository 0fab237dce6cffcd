"""Bags in time order, and what follows from their summaries.

A week is 60,000 bags, and one more closes every ten seconds. So the bags lie in runs: what is
worked out for a run serves every later timeline that still has it, and only the run that a change
falls into is worked out again.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from functools import cached_property, reduce
from itertools import accumulate, chain
from typing import TYPE_CHECKING, Final

from ros2_memory.index.pace import Pace
from ros2_memory.index.segment import Segment, Stated, in_time, taken_by, wider

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.core.model import BagFile, TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.index.segment import Extent, HeldMessages, Span

RUN_LIMIT: Final = 256
"""Bags in a run at most: few enough to work out in a millisecond, and 240 runs make a week."""


class Timeline:
    """Bags sorted by (start, end, path), immutable; `changed` gives the next one."""

    def __init__(self, runs: Sequence[Segment] = ()) -> None:
        self._runs = tuple(runs)
        self._recordings: dict[str, dict[Path, Span]] = {}
        self._before_last: dict[str, dict[Path, Span]] = {}  # of all runs but the last

    @property
    def runs(self) -> tuple[Segment, ...]:
        """The bags, some at a time, in order; a run stays the same while its bags do."""
        return self._runs

    @classmethod
    def of(cls, bags: Iterable[BagFile]) -> Timeline:
        """A timeline of these bags, given in any order."""
        return cls(_runs_of(sorted(bags, key=in_time)))

    def changed(self, removed: Iterable[BagFile], added: Iterable[BagFile]) -> Timeline:
        """This timeline without some of its bags and with some others; itself where none are.

        Raises:
            ValueError: a removed bag is not in it.
        """
        removed, added = tuple(removed), tuple(added)
        if not removed and not added:
            return self
        if not self._runs:
            return Timeline.of(added)
        firsts = self._firsts
        touched: dict[int, list[BagFile]] = {}

        def run_for(bag: BagFile) -> list[BagFile]:
            at = max(bisect_right(firsts, in_time(bag)) - 1, 0)
            return touched.setdefault(at, list(self._runs[at].bags))

        for bag in removed:
            run_for(bag).remove(bag)
        for bag in added:
            run_for(bag).append(bag)
        runs: list[Segment] = []
        for at, run in enumerate(self._runs):
            if at in touched:
                runs.extend(_runs_of(sorted(touched[at], key=in_time)))
            else:
                runs.append(run)
        changed = Timeline(runs)
        if touched.keys() == {len(runs) - 1}:
            # Mostly it is the end that changes, often while a file there grows.
            changed._before_last = self._before_last
        return changed

    @cached_property
    def _firsts(self) -> list[tuple[Ns, Ns, str]]:
        return [run.first for run in self._runs]

    @cached_property
    def _reaches(self) -> list[Ns]:
        """For each run the latest log time in it and all before it: ascending."""
        return list(accumulate((run.latest for run in self._runs), max))

    def _runs_in(self, window: TimeWindow) -> Sequence[Segment]:
        """The runs that may hold something of a window, in order."""
        begin = bisect_left(self._reaches, window.start)
        end = bisect_left(self._firsts, window.stop, key=lambda first: first[0])
        return self._runs[begin:end]

    def run_of(self, bag: BagFile) -> Segment:
        """The run in which a bag of this timeline lies."""
        return self._runs[max(bisect_right(self._firsts, in_time(bag)) - 1, 0)]

    def stated(self, topic: str) -> dict[str, Stated]:
        """By type, what the summaries of all bags say of a topic."""
        stated: dict[str, Stated] = {}
        for run in self._runs:
            for type_name, here in run.stated.get(topic, {}).items():
                known = stated.get(type_name)
                stated[type_name] = here if known is None else known.with_more(here)
        return stated

    def recordings(self, topic: str) -> dict[Path, Span]:
        """The recordings that hold the topic, each with the times of its first and last message."""
        if topic not in self._recordings:
            if topic not in self._before_last:
                self._before_last[topic] = _recordings(self._runs[:-1], topic, {})
            known = self._before_last[topic]
            self._recordings[topic] = _recordings(self._runs[-1:], topic, known)
        return self._recordings[topic]

    @cached_property
    def bags(self) -> tuple[BagFile, ...]:
        """All bags, in order."""
        return tuple(chain.from_iterable(run.bags for run in self._runs))

    @cached_property
    def recorded(self) -> tuple[BagFile, ...]:
        """The bags that tell when there was a recording, in order.

        The bag of carried messages does not: it holds what is left of bags that were deleted. It
        tells of itself where there is no other.
        """
        return tuple(chain.from_iterable(run.recorded for run in self._runs)) or self.bags

    @property
    def taken(self) -> tuple[int, int]:
        """The bytes that the recorded bags take, and how many of them a crash left open."""
        parts = [run.taken for run in self._runs if run.recorded] or [taken_by(self.bags)]
        return sum(size for size, _ in parts), sum(left_open for _, left_open in parts)

    @cached_property
    def types(self) -> dict[str, tuple[str, ...]]:
        """By topic (sorted), the types under which it was heard (sorted)."""
        types: dict[str, set[str]] = {}
        for run in self._runs:
            for topic, names in run.types.items():
                types.setdefault(topic, set()).update(names)
        return {topic: tuple(sorted(types[topic])) for topic in sorted(types)}

    @cached_property
    def latched(self) -> frozenset[str]:
        """The topics that some publisher offered as transient local."""
        return frozenset(chain.from_iterable(run.latched for run in self._runs))

    @cached_property
    def held(self) -> frozenset[str]:
        """Those of them that are no logs."""
        return frozenset(chain.from_iterable(run.held for run in self._runs))

    def pace(self, topic: str, recording: Path) -> Pace:
        """How often a recording has messages of a topic; it must hold some."""
        stated, extents = [], []
        for run in self._runs:
            extent = run.extent_of(recording)
            if extent is not None:
                extents.append(extent)
                stated.append(run.stated_in(topic, recording))
        return Pace(reduce(Stated.with_more, filter(None, stated)), *reduce(wider, extents))

    @cached_property
    def silent(self) -> frozenset[str]:
        """The topics that some bag declares without a message (another may hold some)."""
        return frozenset(chain.from_iterable(run.silent for run in self._runs))

    def overlapping(self, window: TimeWindow) -> tuple[BagFile, ...]:
        """The bags whose span has a moment in the window, in order."""
        if window.empty:
            return ()
        return tuple(
            bag
            for run in self._runs_in(window)
            for bag in run.bags
            if window.overlaps(bag.start, bag.end)
        )

    def holding(self, topic: str, window: TimeWindow | None = None) -> tuple[HeldMessages, ...]:
        """The bags that hold messages of the topic (in the window), in order.

        A bag in which the topic has two types appears once for each.
        """
        return tuple(
            chain.from_iterable(run.holding(topic, window) for run in self._of(topic, window))
        )

    def extents(self, topic: str, window: TimeWindow) -> Iterator[Extent]:
        """As `holding`, but of the summaries only the times of the first and last message."""
        return chain.from_iterable(run.extents(topic, window) for run in self._of(topic, window))

    def _of(self, topic: str, window: TimeWindow | None) -> Iterator[Segment]:
        """The runs that may hold messages of the topic (in the window), in order."""
        if window is not None and window.empty:
            return
        for run in self._runs if window is None else self._runs_in(window):
            span = run.spans.get(topic)
            if span is not None and (window is None or window.overlaps(*span)):
                yield run


def _runs_of(bags: Sequence[BagFile]) -> list[Segment]:
    """Sorted bags cut into runs, the first ones full."""
    return [Segment(bags[at : at + RUN_LIMIT]) for at in range(0, len(bags), RUN_LIMIT)]


def _recordings(
    runs: Iterable[Segment], topic: str, known: Mapping[Path, Span]
) -> dict[Path, Span]:
    """The recordings that hold the topic in some runs, besides those that are known."""
    spans = dict(known)
    for run in runs:
        for folder, span in run.recordings(topic).items():
            spans[folder] = wider(spans.get(folder), span)
    return spans
