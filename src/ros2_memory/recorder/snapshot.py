"""What is known of the bag directory at one moment, and its bags in time order.

A week is 60,000 bags, and one more closes every ten seconds. So the bags lie in runs: what is
worked out for a run serves every later timeline that still has it, and only the run that a change
falls into is worked out again.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from typing import TYPE_CHECKING, Final, TypeAlias

from ros2_memory.model import BagFile, TopicSummary

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from ros2_memory.model import SetAside, TimeWindow
    from ros2_memory.timebase import Ns

Held: TypeAlias = tuple[BagFile, TopicSummary]
"""A bag, and what it holds of one topic under one type."""

RUN_LIMIT: Final = 256
"""Bags in a run at most: few enough to work out in a millisecond, and 240 runs make a week."""


def in_time(bag: BagFile) -> tuple[Ns, Ns, Path]:
    """What orders bags: the times inside them, never their names; the path only breaks ties."""
    return bag.start, bag.end, bag.path


class Run:
    """Some consecutive bags of a timeline; never without any."""

    def __init__(self, bags: Sequence[BagFile]) -> None:
        self.bags = tuple(bags)
        self.first = in_time(self.bags[0])

    @cached_property
    def latest(self) -> Ns:
        """Log time of the last message in any of the bags."""
        return max(bag.end for bag in self.bags)

    @cached_property
    def held(self) -> dict[str, tuple[Held, ...]]:
        """By topic, the bags that hold messages of it, one entry for each type, in bag order."""
        held: dict[str, list[Held]] = {}
        for bag in self.bags:
            for topic in bag.summary.topics:
                held.setdefault(topic.topic, []).append((bag, topic))
        return {topic: tuple(entries) for topic, entries in held.items()}

    @cached_property
    def spans(self) -> dict[str, tuple[Ns, Ns]]:
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
        firsts = [run.first for run in self._runs]
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
    def bags(self) -> tuple[BagFile, ...]:
        """All bags, in order."""
        return tuple(chain.from_iterable(run.bags for run in self._runs))

    @property
    def earliest(self) -> Ns | None:
        """Log time of the first message; None without bags."""
        return self._runs[0].bags[0].start if self._runs else None

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
        started = bisect_left([run.first[0] for run in self._runs], window.stop)
        return tuple(
            bag
            for run in self._runs[:started]
            if run.latest >= window.start
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
            (bag, held)
            for run in self._runs
            if topic in run.spans and window.overlaps(*run.spans[topic])
            for bag, held in run.held[topic]
            if window.overlaps(held.first, held.last)
        )


@dataclass(frozen=True)
class Snapshot:
    """The bag directory at one moment. Never changes, so threads share it freely.

    `bags` answer questions: closed, or left incomplete by a crash, and never empty; sorted by
    (start, end, path). Set aside, each with its reason and sorted by path: `active` files are still
    being written; `damaged` ones cannot be read at all (among them directories that cannot be
    listed); `unread` ones are of a kind that another storage reads, or symbolic links, which are
    not followed. `empty` counts closed bags without a message. `silent_topics` are declared in some
    bag and heard in none. `problem` says why the bag directory itself could not be read.
    """

    bags: tuple[BagFile, ...] = ()
    active: tuple[SetAside, ...] = ()
    damaged: tuple[SetAside, ...] = ()
    unread: tuple[SetAside, ...] = ()
    empty: int = 0
    silent_topics: frozenset[str] = frozenset()
    scanned_at: Ns = 0
    problem: str | None = None
    timeline: Timeline | None = field(default=None, repr=False, compare=False)

    @cached_property
    def _timeline(self) -> Timeline:
        return Timeline.of(self.bags) if self.timeline is None else self.timeline

    @property
    def earliest(self) -> Ns | None:
        """Log time of the first message in any bag; None without bags."""
        return self._timeline.earliest

    @property
    def latest(self) -> Ns | None:
        """Log time of the last message in any bag (inclusive); None without bags."""
        return self._timeline.latest

    def topics(self) -> tuple[str, ...]:
        """The topics of which some bag holds a message, sorted."""
        return tuple(self._timeline.types)

    def holding(self, topic: str, window: TimeWindow | None = None) -> tuple[Held, ...]:
        """Every bag that holds messages of the topic, in bag order, one entry for each type.

        With a window, only those that may hold some in it: by the topic's own first and last time
        in each bag.
        """
        return self._timeline.holding(topic, window)

    def overlapping(self, window: TimeWindow) -> tuple[BagFile, ...]:
        """The bags whose span has a moment in the window, in bag order."""
        return self._timeline.overlapping(window)

    def types_of(self, topic: str) -> tuple[str, ...]:
        """The message types under which the topic was heard, sorted; empty where it was not."""
        return self._timeline.types.get(topic, ())

    def is_latched(self, topic: str) -> bool:
        """Whether some publisher offered the topic as transient local."""
        return topic in self._timeline.latched


def _runs_of(bags: Sequence[BagFile]) -> list[Run]:
    """Sorted bags cut into runs, the first ones full."""
    return [Run(bags[at : at + RUN_LIMIT]) for at in range(0, len(bags), RUN_LIMIT)]
