"""What is known of the bag directory at one moment."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Final

from ros2_memory.index import bearings
from ros2_memory.index.segment import is_log
from ros2_memory.index.timeline import RUN_LIMIT, Timeline

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.core.model import BagFile, SetAside, TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.index.clock_faults import ClockFault, Dating
    from ros2_memory.index.pace import Pace
    from ros2_memory.index.segment import Extent, HeldMessages, Segment, Span, Stated

__all__ = ["RUN_LIMIT", "Snapshot", "Timeline"]

_PLACED: Final = 500


@dataclass(frozen=True)
class Snapshot:
    """The bag directory at one moment. Never changes, so threads share it freely.

    `bags` answer questions: closed, or left incomplete by a crash, and never empty; sorted by
    (start, end, path). The one of latched messages that outlive their own bags is not among them,
    but found wherever a topic is asked for. Set aside, each with its reason and sorted by path:
    `active` files are still being written (those that answer as far as they are whole are among
    `bags` too); `damaged` ones cannot be read at all (among them directories that cannot be
    listed); `unread` ones are of a kind that another storage reads, or symbolic links, which are
    not followed. `empty` counts closed bags without a message. `silent_topics` are declared in some
    bag and heard in none. `described` are the folders with a metadata.yaml.
    `problem` says why the bag directory itself could not be read.
    """

    bags: tuple[BagFile, ...] = ()
    active: tuple[SetAside, ...] = ()
    damaged: tuple[SetAside, ...] = ()
    unread: tuple[SetAside, ...] = ()
    empty: int = 0
    silent_topics: frozenset[str] = frozenset()
    scanned_at: Ns = 0
    problem: str | None = None
    described: tuple[str, ...] = ()
    timeline: Timeline | None = field(default=None, repr=False, compare=False)

    @cached_property
    def _timeline(self) -> Timeline:
        return Timeline.of(self.bags) if self.timeline is None else self.timeline

    @property
    def earliest(self) -> Ns | None:
        """Log time of the first message in any bag that its date does not refute; None without."""
        return self._dates.earliest

    @property
    def latest(self) -> Ns | None:
        """Log time of the last message (inclusive) in such a bag; None without one."""
        return self._dates.latest

    @cached_property
    def _dates(self) -> Dating:
        return bearings.dating(self._timeline, self.scanned_at, with_steps=False)

    @property
    def misdated(self) -> Sequence[ClockFault]:
        """The bags that `earliest` and `latest` leave out, since their dates cannot be true."""
        return [fault for fault in self._dates.faults if fault.misleads]

    @cached_property
    def dating(self) -> Dating:
        """What the dates and the order of all bags tell of the clocks that dated them."""
        return bearings.dating(self._timeline, self.scanned_at, with_steps=True)

    @cached_property
    def places(self) -> Mapping[SetAside, TimeWindow | None]:
        """Of the files set aside, when messages may have been recorded that do not answer.

        None: unknown. Of very many files that cannot be read only the last ones are placed.
        """
        timeline, now = self._timeline, self.scanned_at
        asides = [(aside, True) for aside in self.active]
        asides += [(aside, False) for aside in (*self.damaged, *self.unread)]
        return {
            aside: bearings.place(timeline, aside, now, growing=growing)
            if growing or number >= len(asides) - _PLACED
            else None
            for number, (aside, growing) in enumerate(asides)
        }

    @cached_property
    def bounds(self) -> Mapping[SetAside, TimeWindow | None]:
        """Of the closed files that do not answer, outside of which times they hold no message.

        Wider than `places`, which guess how much a file holds. None: they may hold any.
        """
        return self.bounds_of((*self.damaged, *self.unread))

    def bounds_of(self, files: Sequence[SetAside]) -> Mapping[SetAside, TimeWindow | None]:
        """As `bounds`, of any closed files, be they not there any more."""
        placed = files[-_PLACED:]
        known = {each: bearings.bounds(self._timeline, each, self.scanned_at) for each in placed}
        return {**dict.fromkeys(files), **known}

    def topics(self) -> tuple[str, ...]:
        """The topics of which some bag holds a message, sorted."""
        return tuple(self._timeline.types)

    def holding(self, topic: str, window: TimeWindow | None = None) -> tuple[HeldMessages, ...]:
        """Every bag that holds messages of the topic, in bag order, one entry for each type.

        With a window, only those that may hold some in it: by the topic's own first and last time
        in each bag.
        """
        return self._timeline.holding(topic, window)

    def extents(self, topic: str, window: TimeWindow) -> Iterator[Extent]:
        """As `holding`, but of the summaries only the times of the first and last message."""
        return self._timeline.extents(topic, window)

    def overlapping(self, window: TimeWindow) -> tuple[BagFile, ...]:
        """The bags whose span has a moment in the window, in bag order."""
        return self._timeline.overlapping(window)

    def odd(self, window: TimeWindow) -> list[BagFile]:
        """The bags of which something is amiss and may bear on the window, in bag order.

        That of a bag which a crash left open reaches on to the last time its file was written to,
        if that was within a day.
        """
        return [
            bag
            for run in self._odd_runs
            if run.bags[0].start < window.stop
            for bag in run.odd
            if window.overlaps(bag.start, bearings.lost_until(bag))
        ]

    @cached_property
    def _odd_runs(self) -> list[Segment]:
        return [run for run in self.runs if run.odd]

    def types_of(self, topic: str) -> tuple[str, ...]:
        """The message types under which the topic was heard, sorted; empty where it was not."""
        return self._timeline.types.get(topic, ())

    def is_transient_local(self, topic: str) -> bool:
        """Whether some publisher offered the topic as transient local.

        Then a subscriber may receive its last messages again, long after they were published.
        """
        return topic in self._timeline.latched

    def is_held(self, topic: str) -> bool:
        """Whether that may have been for its last message to hold: it is no log.

        Which topics are latched `latching` says.
        """
        return topic in self._timeline.held

    def is_log(self, topic: str) -> bool:
        """Whether the topic is a log, whose lines come when something happens."""
        return all(map(is_log, self.types_of(topic)))

    def pace(self, topic: str, recording: Path) -> Pace:
        """How often a recording has messages of a topic; it must hold some."""
        return self._timeline.pace(topic, recording)

    @property
    def taken(self) -> tuple[int, int]:
        """The bytes that the bags take on disk, and how many of them a crash left open."""
        return self._timeline.taken

    @property
    def runs(self) -> Sequence[Segment]:
        """The bags, some at a time, in order; what is worked out for a run holds while it stays."""
        return self._timeline.runs

    def run_of(self, bag: BagFile) -> Segment:
        """The run in which a bag lies."""
        return self._timeline.run_of(bag)

    def stated(self, topic: str) -> Mapping[str, Stated]:
        """By type, what the summaries say of a topic; copies count in each bag that has one."""
        return self._timeline.stated(topic)

    def recordings(self, topic: str) -> Mapping[Path, Span]:
        """The recordings that hold the topic, each with the times of its first and last message."""
        return self._timeline.recordings(topic)

    def first_with(self, topic: str, type_name: str) -> BagFile:
        """The first bag, in bag order, that holds the topic under a type; there must be one."""
        run = next(run for run in self.runs if type_name in run.types.get(topic, ()))
        return next(bag for bag, held in run.holding(topic) if held.type == type_name)
