"""Bags in time order, and what follows from their summaries.

A week is 60,000 bags, and one more closes every ten seconds. So the bags lie in runs: what is
worked out for a run serves every later timeline that still has it, and only the run that a change
falls into is worked out again.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from functools import cached_property
from itertools import accumulate, chain
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from ros2_memory.model import BagFile, TopicSummary
from ros2_memory.recorder.layout import is_carried

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.model import TimeWindow
    from ros2_memory.timebase import Ns

Held: TypeAlias = tuple[BagFile, TopicSummary]
"""A bag, and what it holds of one topic under one type."""

Span: TypeAlias = "tuple[Ns, Ns]"
"""Log times of a first and a last message, both inclusive."""

RUN_LIMIT: Final = 256
"""Bags in a run at most: few enough to work out in a millisecond, and 240 runs make a week."""


def in_time(bag: BagFile) -> tuple[Ns, Ns, Path]:
    """What orders bags: the times inside them, never their names; the path only breaks ties."""
    return bag.start, bag.end, bag.path


class Stated(NamedTuple):
    """What summaries say of one topic under one type."""

    first: Ns
    last: Ns
    messages: int

    def with_more(self, other: Stated) -> Stated:
        """Both together."""
        return Stated(
            min(self.first, other.first), max(self.last, other.last), self.messages + other.messages
        )


class Run:
    """Some consecutive bags of a timeline; never without any."""

    def __init__(self, bags: Sequence[BagFile]) -> None:
        self.bags = tuple(bags)
        self.first = in_time(self.bags[0])
        self._extents: dict[str, tuple[list[Ns], list[Ns]]] = {}

    @cached_property
    def latest(self) -> Ns:
        """Log time of the last message in any of the bags."""
        return max(bag.end for bag in self.bags)

    @cached_property
    def recorded(self) -> tuple[BagFile, ...]:
        """The bags without that of carried messages."""
        return tuple(bag for bag in self.bags if not is_carried(bag.path))

    @cached_property
    def held(self) -> dict[str, tuple[Held, ...]]:
        """By topic, the bags that hold messages of it, one entry for each type, in bag order."""
        held: dict[str, list[Held]] = {}
        for bag in self.bags:
            for topic in bag.summary.topics:
                held.setdefault(topic.topic, []).append((bag, topic))
        return {topic: tuple(entries) for topic, entries in held.items()}

    @cached_property
    def stated(self) -> dict[str, dict[str, Stated]]:
        """By topic and type, what the summaries of the bags say."""
        stated: dict[str, dict[str, Stated]] = {}
        for topic, entries in self.held.items():
            by_type = stated.setdefault(topic, {})
            for _, each in entries:
                here = Stated(each.first, each.last, each.count)
                known = by_type.get(each.type)
                by_type[each.type] = here if known is None else known.with_more(here)
        return stated

    @cached_property
    def recordings(self) -> dict[str, dict[Path, Span]]:
        """By topic and recording, the log times of the first and last message."""
        recordings: dict[str, dict[Path, Span]] = {}
        folders = [bag.recording for bag in self.bags]
        for bag, folder in zip(self.bags, folders, strict=True):
            for each in bag.summary.topics:
                spans = recordings.setdefault(each.topic, {})
                spans[folder] = _wider(spans.get(folder), (each.first, each.last))
        return recordings

    def between(self, topic: str, window: TimeWindow) -> Iterator[Held]:
        """The entries of the topic in `held` that may hold a message in the window."""
        if topic not in self._extents:
            held = [each for _, each in self.held[topic]]
            self._extents[topic] = ([each.first for each in held], [each.last for each in held])
        firsts, lasts = self._extents[topic]
        start, stop = window.start, window.stop
        return (
            entry
            for entry, first, last in zip(self.held[topic], firsts, lasts, strict=True)
            if first < stop and last >= start
        )

    @cached_property
    def spans(self) -> dict[str, Span]:
        """By topic, the log times of its first and last message (inclusive)."""
        return {
            topic: (min(held.first for _, held in entries), max(held.last for _, held in entries))
            for topic, entries in self.held.items()
        }

    @cached_property
    def types(self) -> dict[str, frozenset[str]]:
        """By topic, the types that its messages have."""
        return {
            topic: frozenset(held.type for _, held in entries)
            for topic, entries in self.held.items()
        }

    @cached_property
    def latched(self) -> frozenset[str]:
        """The topics that some publisher offered as transient local."""
        return frozenset(
            topic
            for topic, entries in self.held.items()
            if any(held.latched for _, held in entries)
        )

    @cached_property
    def silent(self) -> frozenset[str]:
        """The topics that some bag declares without a message."""
        return frozenset(chain.from_iterable(bag.summary.silent for bag in self.bags))


class Timeline:
    """Bags sorted by (start, end, path), immutable; `changed` gives the next one."""

    def __init__(self, runs: Sequence[Run] = ()) -> None:
        self._runs = tuple(runs)
        self._held: dict[str, tuple[Held, ...]] = {}
        self._recordings: dict[str, dict[Path, Span]] = {}

    @property
    def runs(self) -> tuple[Run, ...]:
        """The bags, some at a time, in order; a run stays the same while its bags do."""
        return self._runs

    @classmethod
    def of(cls, bags: Iterable[BagFile]) -> Timeline:
        """A timeline of these bags, given in any order."""
        return cls(_runs_of(sorted(bags, key=in_time)))

    def changed(self, removed: Iterable[BagFile], added: Iterable[BagFile]) -> Timeline:
        """This timeline without some of its bags and with some others.

        Raises:
            ValueError: a removed bag is not in it.
        """
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
        runs: list[Run] = []
        for at, run in enumerate(self._runs):
            if at in touched:
                runs.extend(_runs_of(sorted(touched[at], key=in_time)))
            else:
                runs.append(run)
        return Timeline(runs)

    @cached_property
    def _firsts(self) -> list[tuple[Ns, Ns, Path]]:
        return [run.first for run in self._runs]

    @cached_property
    def _reaches(self) -> list[Ns]:
        """For each run the latest log time in it and all before it: ascending."""
        return list(accumulate((run.latest for run in self._runs), max))

    def _runs_in(self, window: TimeWindow) -> Sequence[Run]:
        """The runs that may hold something of a window, in order."""
        begin = bisect_left(self._reaches, window.start)
        end = bisect_left(self._firsts, window.stop, key=lambda first: first[0])
        return self._runs[begin:end]

    def run_of(self, bag: BagFile) -> Run:
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
            spans: dict[Path, Span] = {}
            for run in self._runs:
                for folder, span in run.recordings.get(topic, {}).items():
                    spans[folder] = _wider(spans.get(folder), span)
            self._recordings[topic] = spans
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
    def earliest(self) -> Ns | None:
        """Log time of the first message that was recorded and is kept; None without bags."""
        return self.recorded[0].start if self._runs else None

    @cached_property
    def latest(self) -> Ns | None:
        """Log time of the last message (inclusive); None without bags."""
        return max((run.latest for run in self._runs), default=None)

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

    def holding(self, topic: str, window: TimeWindow | None = None) -> tuple[Held, ...]:
        """The bags that hold messages of the topic (in the window), in order.

        A bag in which the topic has two types appears once for each.
        """
        if window is not None:
            return self._holding_in(topic, window)
        if topic not in self.types:
            return ()
        if topic not in self._held:
            self._held[topic] = tuple(
                chain.from_iterable(run.held.get(topic, ()) for run in self._runs)
            )
        return self._held[topic]

    def _holding_in(self, topic: str, window: TimeWindow) -> tuple[Held, ...]:
        if window.empty:
            return ()
        return tuple(
            entry
            for run in self._runs_in(window)
            if topic in run.spans and window.overlaps(*run.spans[topic])
            for entry in run.between(topic, window)
        )


def _runs_of(bags: Sequence[BagFile]) -> list[Run]:
    """Sorted bags cut into runs, the first ones full."""
    return [Run(bags[at : at + RUN_LIMIT]) for at in range(0, len(bags), RUN_LIMIT)]


def _wider(known: Span | None, span: Span) -> Span:
    return span if known is None else (min(known[0], span[0]), max(known[1], span[1]))
