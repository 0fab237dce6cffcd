"""The bag directory as it is known at one moment."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from typing import TYPE_CHECKING, Final

from ros2_memory.core.model import BagState, TimeWindow
from ros2_memory.core.timebase import MAX_NS
from ros2_memory.index.clock_faults import DatedBags, check_dates
from ros2_memory.index.segment import is_log
from ros2_memory.index.split_order import (
    Neighbours,
    StepBack,
    is_recording,
    neighbours,
    split_of,
    steps_of,
)
from ros2_memory.index.timeline import Timeline
from ros2_memory.index.unreadable_span import MAX_FILE_NS, unreadable_bounds, unreadable_span

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.core.model import BagFile, SetAside
    from ros2_memory.core.timebase import Ns
    from ros2_memory.index.clock_faults import ClockFault, Dating
    from ros2_memory.index.segment import (
        Pace,
        Segment,
        Span,
        TopicExtent,
        TopicInBag,
        TopicTotals,
    )

_MAX_PLACED: Final = 500


@dataclass(frozen=True)
class Snapshot:
    """The bag directory at one moment. Immutable, so threads share it freely.

    Attributes:
        bags: what answers queries: bags that are closed, or left open by a crash, and not empty, in
            the order (start, end, path). The bag of carried latched messages is not among them, but
            is found wherever a topic is asked for.
        active: files that are still being written, with the reason, by path; those that answer as
            far as they are complete are among `bags` too.
        damaged: files and directories that cannot be read at all, likewise.
        unread: files of a kind that another adapter reads, and symbolic links, likewise.
        empty: number of closed bags without a message.
        silent_topics: topics that some bag declares and none has a message of.
        scanned_at: when the directory was scanned.
        problem: why the bag directory itself could not be read.
        metadata_folders: folders with a metadata.yaml.
        timeline: the bags in time order; made from `bags` where None.
    """

    bags: tuple[BagFile, ...] = ()
    active: tuple[SetAside, ...] = ()
    damaged: tuple[SetAside, ...] = ()
    unread: tuple[SetAside, ...] = ()
    empty: int = 0
    silent_topics: frozenset[str] = frozenset()
    scanned_at: Ns = 0
    problem: str | None = None
    metadata_folders: tuple[str, ...] = ()
    timeline: Timeline | None = field(default=None, repr=False, compare=False)

    @cached_property
    def _timeline(self) -> Timeline:
        return Timeline.of(self.bags) if self.timeline is None else self.timeline

    @property
    def earliest(self) -> Ns | None:
        """Log time of the first message in any correctly dated bag; None without one."""
        return self._dates.earliest

    @property
    def latest(self) -> Ns | None:
        """Log time of the last message (inclusive) in such a bag; None without one."""
        return self._dates.latest

    @cached_property
    def _dates(self) -> Dating:
        return self._check_dates(())

    @property
    def misdated(self) -> Sequence[ClockFault]:
        """The bags that `earliest` and `latest` leave out, since their dates cannot be true."""
        return [fault for fault in self._dates.faults if fault.misleads]

    @cached_property
    def dating(self) -> Dating:
        """What the dates and the order of all bags show about the clocks that dated them."""
        segments = self.segments
        between = steps_of([each.split_ranges for each in segments], self._bags_of)
        within = chain.from_iterable(segment.set_back for segment in segments)
        steps = [StepBack(bag, bag, bag.summary.schema.set_back) for bag in within]
        return self._check_dates([*between, *steps])

    def _check_dates(self, steps: Sequence[StepBack]) -> Dating:
        """Checks the dates of the bags; that of carried messages shows nothing about clocks."""
        dated = [
            DatedBags(
                each.recorded,
                each.latest
                if each.recorded is each.bags
                else max(bag.end for bag in each.recorded),
            )
            for each in self.segments
            if each.recorded
        ] or [DatedBags(each.bags, each.latest) for each in self.segments]
        return check_dates(
            dated,
            steps,
            self.scanned_at,
            lambda first, last: self.overlapping(TimeWindow(first, min(last + 1, MAX_NS))),
        )

    @cached_property
    def unread_spans(self) -> Mapping[SetAside, TimeWindow | None]:
        """When messages of the files that do not answer may have been recorded; None: unknown.

        Of very many files that cannot be read only the last ones are looked at.
        """
        closed = (*self.damaged, *self.unread)
        return {
            **{each: self._unread_span(each, growing=True) for each in self.active},
            **dict.fromkeys(closed),
            **{each: self._unread_span(each, growing=False) for each in closed[-_MAX_PLACED:]},
        }

    def _unread_span(self, aside: SetAside, *, growing: bool) -> TimeWindow | None:
        if aside.until is not None:
            return TimeWindow(min(aside.until + 1, MAX_NS), MAX_NS)
        near = self._neighbours(aside)
        recording = aside.path.parent.name
        return unreadable_span(recording, near, aside.written, self.scanned_at, growing=growing)

    @cached_property
    def unread_bounds(self) -> Mapping[SetAside, TimeWindow | None]:
        """Bounds outside of which the closed files that do not answer contain no message.

        Wider than `unread_spans`, which estimate how much a file holds. None: anywhere.
        """
        return self.bounds_of((*self.damaged, *self.unread))

    def bounds_of(self, files: Sequence[SetAside]) -> Mapping[SetAside, TimeWindow | None]:
        """Returns `unread_bounds` of any closed files, even if they do not exist any more."""
        return {
            **dict.fromkeys(files),
            **{each: self._bounds(each) for each in files[-_MAX_PLACED:]},
        }

    def _bounds(self, aside: SetAside) -> TimeWindow | None:
        split = split_of(str(aside.path))
        # Files that `ros2 bag record` did not number may lie in any order.
        is_split = split is not None and is_recording(split[0])
        near = self._neighbours(aside) if is_split else Neighbours()
        return unreadable_bounds(aside.path.parent.name, near, aside.written, self.scanned_at)

    def _neighbours(self, aside: SetAside) -> Neighbours:
        folder = str(aside.path.parent)
        numbers = [nth for nth, each in enumerate(self.segments) if folder in each.folders]
        ranges = [self.segments[nth].split_ranges for nth in numbers]
        return neighbours(
            str(aside.path), ranges, lambda at: self._bags_of([numbers[each] for each in at])
        )

    def _bags_of(self, segments: Sequence[int]) -> Iterator[BagFile]:
        return chain.from_iterable(self.segments[nth].bags for nth in segments)

    def topics(self) -> tuple[str, ...]:
        """Returns the topics of which some bag holds a message, sorted."""
        return tuple(self._timeline.types)

    def with_topic(self, topic: str, window: TimeWindow | None = None) -> tuple[TopicInBag, ...]:
        """Returns every bag that holds messages of the topic, in order, once for each type.

        With a window, only those that can contain some in it, by the topic's first and last time in
        each bag.
        """
        return self._timeline.with_topic(topic, window)

    def extents(self, topic: str, window: TimeWindow) -> Iterator[TopicExtent]:
        """Returns what `with_topic` returns, but only the first and last times; that is faster."""
        return self._timeline.extents(topic, window)

    def overlapping(self, window: TimeWindow) -> tuple[BagFile, ...]:
        """Returns the bags whose span overlaps the window, in order."""
        return self._timeline.overlapping(window)

    def faulty(self, window: TimeWindow) -> list[BagFile]:
        """Returns the bags whose faults may bear on the window, in order.

        Those of a bag that a crash left open reach to the last time that its file was written to,
        if that was within a day.
        """
        return [
            bag
            for segment in self._faulty_segments
            if segment.bags[0].start < window.stop
            for bag in segment.faulty
            if window.overlaps(bag.start, _lost_until(bag))
        ]

    @cached_property
    def _faulty_segments(self) -> list[Segment]:
        return [segment for segment in self.segments if segment.faulty]

    def types_of(self, topic: str) -> tuple[str, ...]:
        """Returns the message types of the topic, sorted; empty where it has no message."""
        return self._timeline.types.get(topic, ())

    def is_transient_local(self, topic: str) -> bool:
        """Returns whether some publisher offered the topic as transient local.

        Then a subscriber may receive its last messages again, long after they were published.
        """
        return topic in self._timeline.transient_local

    def is_transient_state(self, topic: str) -> bool:
        """Returns whether the topic is transient local, and no log as `/rosout` is everywhere."""
        return self.is_transient_local(topic) and not self.is_log(topic)

    def is_log(self, topic: str) -> bool:
        """Returns whether the topic is a log, whose lines come when something happens."""
        return all(map(is_log, self.types_of(topic)))

    def pace(self, topic: str, recording: Path) -> Pace:
        """Returns how often a recording has messages of a topic; it must hold some."""
        return self._timeline.pace(topic, recording)

    @property
    def disk_use(self) -> tuple[int, int]:
        """The bytes of the bags, and how many of them a crash left open."""
        return self._timeline.disk_use

    @property
    def segments(self) -> Sequence[Segment]:
        """The bags in order, some at a time."""
        return self._timeline.segments

    def segment_of(self, bag: BagFile) -> Segment:
        """Returns the segment of a bag."""
        return self._timeline.segment_of(bag)

    def totals(self, topic: str) -> Mapping[str, TopicTotals]:
        """Returns by type what summaries state of a topic; copies count in each bag with one."""
        return self._timeline.totals(topic)

    def recordings(self, topic: str) -> Mapping[Path, Span]:
        """Returns the recordings that hold the topic, with its first and last log time in each."""
        return self._timeline.recordings(topic)

    def first_with(self, topic: str, type_name: str) -> BagFile:
        """Returns the first bag that holds the topic under a type; there must be one."""
        segment = next(each for each in self.segments if type_name in each.types.get(topic, ()))
        return next(bag for bag, held in segment.with_topic(topic) if held.type == type_name)


def _lost_until(bag: BagFile) -> Ns:
    """Returns until when (inclusive) a bag may have recorded what cannot be read of it."""
    is_cut = bag.state is BagState.INCOMPLETE and bag.end < bag.mtime_ns <= bag.end + MAX_FILE_NS
    return bag.mtime_ns if is_cut else bag.end
