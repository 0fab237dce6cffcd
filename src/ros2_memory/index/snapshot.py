"""The bag directory as it is known at one moment.

A file that cannot be read shows nothing of its times; the files around it do:

    not before   the end of the split before it in its recording, else the time in the name of a
                 recording of this program
    not after    the start of the split after it, else the last time that the file was written to

Between two splits nothing more is known. Where only one side is known, the file is taken to hold a
day at most: so an old file that nobody removes, or one that was copied here later, does not affect
answers about other days. Where neither side is known, or the file's own date cannot be true, its
time is unknown.

That a file holds a day at most is an estimate, good enough for a note beside an answer. Where the
answer is that there is nothing, the file counts wherever it can contain a message.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain, pairwise
from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.silences import (
    LONGEST_OFF_NS,
    SHORTEST_NS,
    Pacing,
    Silence,
    joined_pacings,
    length_in,
    prolonged_silence,
    robot_on_times,
    shortest_silence,
    silences,
    usual_periods,
)
from ros2_memory.bag_dir.layout import is_carried, named_start
from ros2_memory.core.model import BagFile, SetAside, TimeWindow
from ros2_memory.core.pauses import SHORTEST_PAUSE_NS
from ros2_memory.core.spans import Spans, united, without
from ros2_memory.core.timebase import FUTURE_NS, MAX_NS, MIN_NS, Ns, Span
from ros2_memory.index.clock_faults import (
    FIRST_BAGS_NS,
    ClockFault,
    Dating,
    check_dates,
    dated_segments,
    max_plausible,
)
from ros2_memory.index.holes import Pause, Rhythm, pause_between
from ros2_memory.index.split_order import Neighbours, is_recording, neighbours, split_of, steps_of
from ros2_memory.index.timeline import MAX_FILE_NS, Timeline

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.index.segment import Segment, TopicTotals


_MAX_PLACED: Final = 500


@dataclass(frozen=True)
class Snapshot:
    """The bag directory at one moment. Immutable, so threads share it freely.

    Attributes:
        timeline: the bags that answer queries, in time order, and what they hold.
        active: files that are still being written, or held back, with the reason, by path; those
            that answer as far as they are complete are among `bags` too.
        damaged: files and directories that cannot be read at all, likewise.
        unread: files of a kind that another adapter reads, and symbolic links, likewise.
        empty: closed bags without a message, by path.
        silent_topics: topics that some bag declares and none has a message of.
        scanned_at: when the directory was scanned.
        problem: why the bag directory itself could not be read.
        metadata_folders: folders with a metadata.yaml.
        copies: bags that are byte for byte the same as others in their folder, which answer.
        older: up to which log time (inclusive) there are older bags, which are not in it: those of
            a lake are shown some days at a time. None where all are.
    """

    timeline: Timeline = field(default_factory=Timeline, repr=False, compare=False)
    active: tuple[SetAside, ...] = ()
    damaged: tuple[SetAside, ...] = ()
    unread: tuple[SetAside, ...] = ()
    empty: tuple[Path, ...] = ()
    silent_topics: frozenset[str] = frozenset()
    scanned_at: Ns = 0
    problem: str | None = None
    metadata_folders: tuple[str, ...] = ()
    copies: tuple[BagFile, ...] = ()
    older: Ns | None = None

    @property
    def bags(self) -> Sequence[BagFile]:
        """What answers queries: bags that are closed, or left open by a crash, and not empty.

        In the order (start, end, path). The bag of carried latched messages is not among them, but
        is found wherever a topic is asked for.
        """
        return self.timeline.recorded

    @property
    def earliest(self) -> Ns | None:
        """Log time of the first message in any correctly dated bag; None without one."""
        return self._dating_by_times.earliest

    @property
    def latest(self) -> Ns | None:
        """Log time of the last message (inclusive) in such a bag; None without one."""
        return self._dating_by_times.latest

    @cached_property
    def _dating_by_times(self) -> Dating:
        return check_dates(self.timeline, (), self.scanned_at)

    @property
    def misdated(self) -> Sequence[ClockFault]:
        """The bags that `earliest` and `latest` leave out, since their dates cannot be true."""
        return [fault for fault in self._dating_by_times.faults if fault.misleads]

    @cached_property
    def dating(self) -> Dating:
        """What the dates and the order of all bags show about the clocks that dated them."""
        recorded = self.timeline.recorded_segments
        within = chain.from_iterable(segment.set_back for segment in recorded)
        between = steps_of(self.timeline)
        return check_dates(self.timeline, [*between, *within], self.scanned_at)

    @cached_property
    def _dated_segments(self) -> Sequence[Segment]:
        """The bags that a correct clock dated, without that of carried messages, in order."""
        return dated_segments(self.timeline, self.dating.faults)

    @property
    def whole_segments(self) -> Iterator[Segment]:
        """The bags that a correct clock dated, and that have every message that was recorded."""
        return filter(None, (segment.unthinned for segment in self._dated_segments))

    @cached_property
    def _periods(self) -> dict[str, Ns]:
        """The usual period of each topic; not of logs, whose lines come when something happens."""
        by_topic: dict[str, list[Pacing]] = {}
        for segment in self.whole_segments:
            for topic, pacing in segment.pacings.items():
                by_topic.setdefault(topic, []).append(pacing)
        is_log = self.timeline.is_log
        return usual_periods(
            {topic: joined_pacings(parts) for topic, parts in by_topic.items() if not is_log(topic)}
        )

    @cached_property
    def _runs(self) -> dict[str, Spans]:
        """By topic, when bags hold it; see `silences`."""
        by_topic: dict[str, list[Span]] = {}
        for segment in self.whole_segments:
            for topic, runs in segment.runs.items():
                by_topic.setdefault(topic, []).extend(runs)
        return {topic: united(runs, SHORTEST_NS) for topic, runs in by_topic.items()}

    @cached_property
    def silences(self) -> tuple[Silence, ...]:
        """Where topics with a usual rate were silent, in order of time; see `analysis.silences`."""
        together = frozenset(
            chain.from_iterable(segment.together for segment in self._dated_segments)
        )
        return tuple(silences(self._periods, self._runs, together, self.gaps))

    def prolonged(self, silence: Silence) -> Silence:
        """Returns a silence that deleted bags showed, as it went on in later ones."""
        if not silence.goes_on:
            return silence
        return prolonged_silence(
            silence, self._robot_on, self._runs.get(silence.topic, ()), self.gaps
        )

    @cached_property
    def _robot_on(self) -> Sequence[Span]:
        """When the robot was on, by all topics that have a usual rate."""
        return robot_on_times([self._runs[topic] for topic in self._periods])

    def shortest_silence(self, topic: str) -> Ns:
        """Returns how long a topic must have no message to count as silent."""
        return shortest_silence(self._periods.get(topic, 0))

    def longest_silence(self, topic: str) -> Ns:
        """Returns for how long others were recorded, at most, between two messages of a topic."""
        pauses = () if self.timeline.is_log(topic) else pairwise(self._runs.get(topic, ()))
        return max(
            (stop - start - length_in(self.gaps, start, stop) for (_, start), (stop, _) in pauses),
            default=0,
        )

    def totals(self, topic: str) -> list[TopicTotals]:
        """Returns what correctly dated bags hold of a topic, in parts."""
        return [
            totals
            for segment in self._dated_segments
            for totals in segment.totals.get(topic, {}).values()
        ]

    @cached_property
    def newest_stretch(self) -> Ns | None:
        """First log time after the newest gap of more than `LONGEST_OFF_NS`; None without a bag."""
        begin = reach = None
        for segment in self._dated_segments:
            bags, (first, *_) = segment.bags, segment.first
            spans = [(first, segment.latest)]
            if segment.latest - first > LONGEST_OFF_NS:
                spans = [*zip(bags.starts.tolist(), bags.ends.tolist(), strict=True)]
            for start, end in spans:
                if reach is None or start - reach > LONGEST_OFF_NS:
                    begin = start
                reach = end if reach is None else max(reach, end)
        return begin

    @cached_property
    def gaps(self) -> Sequence[Span]:
        """Where nothing was recorded: from the last message before to the first after, in order.

        Between bags or within one; see `index.holes`. Carried messages and bags that a wrong clock
        dated do not count. A step forward of the clock looks alike: see `View.gaps`.
        """
        # Each bag of several that hold the same has it.
        return sorted({pause.span for pause in self._rhythm.gaps(self.pauses)})

    @cached_property
    def breaks(self) -> Sequence[Span]:
        """Those gaps after which another run of a recorder began."""
        pauses = [*self._rhythm.gaps(self.pauses)]
        within_runs = {pause.span for pause in pauses if pause.ran_on}
        return [gap for gap in self.gaps if gap not in within_runs]

    @cached_property
    def shortest_gap(self) -> Ns:
        """How long a pause between two recordings may be without being one of `gaps`."""
        return self._rhythm.shortest_gap

    @cached_property
    def suspects(self) -> Sequence[Pause]:
        """Where the clock may have been set forward, as a recorder ran on, in order of time."""
        return self._rhythm.suspects(self.pauses)

    @cached_property
    def _rhythm(self) -> Rhythm:
        return Rhythm(self._periods)

    @cached_property
    def pauses(self) -> Sequence[Pause]:
        """Where no dated bag has a message for a while, in order of time."""
        pauses: list[Pause] = []
        newest: BagFile | None = None
        for segment in self._dated_segments:
            if newest is not None:
                # Bags of other parts may last into this one.
                reach = newest.end
                if segment.bags[0].start - reach > SHORTEST_PAUSE_NS:
                    pauses.append(pause_between(newest, segment.bags[0]))
                pauses += (
                    pause._replace(start=max(pause.start, reach))
                    for pause in segment.pauses
                    if pause.end - reach > SHORTEST_PAUSE_NS
                )
            else:
                pauses += segment.pauses
            for pause in segment.pauses_within:
                pauses += self._shared_parts(pause)
            if newest is None or segment.latest > newest.end:
                newest = segment.newest
        return sorted(pauses, key=lambda pause: pause.span)

    def _shared_parts(self, pause: Pause) -> Iterator[Pause]:
        """Yields the parts of a bag's pause in which no other bag has a message either."""
        inside = TimeWindow(pause.start + 1, pause.end)
        others = united(
            span
            for bag in self.timeline.overlapping(inside)
            if bag not in pause.bags and not is_carried(bag.file)
            if bag.file not in self.dating.misdated
            for span in without([(bag.start, bag.end)], bag.summary.schema.pauses)
        )
        parts = [
            (start, end)
            for start, end in without([pause.span], others)
            if end - start > SHORTEST_PAUSE_NS
        ]
        for start, end in parts:
            # With another recording in the middle of it, the clock was set more likely than not.
            yield pause._replace(start=start, end=end, ran_on=pause.ran_on and len(parts) == 1)

    @cached_property
    def unread_spans(self) -> Mapping[SetAside, TimeWindow | None]:
        """When messages of the files that do not answer may have been recorded; None: unknown.

        Of very many files that cannot be read only the last ones are looked at.
        """
        closed = (*self.damaged, *self.unread)
        return {
            **{aside: self._unread_span(aside, growing=True) for aside in self.active},
            **dict.fromkeys(closed),
            **{aside: self._unread_span(aside, growing=False) for aside in closed[-_MAX_PLACED:]},
        }

    def _unread_span(self, aside: SetAside, *, growing: bool) -> TimeWindow | None:
        if aside.until is not None:
            return _after(aside.until)
        near = self._neighbours(aside)
        recording = aside.path.parent.name
        return unreadable_span(recording, near, aside.written, self.scanned_at, growing=growing)

    @cached_property
    def unread_bounds(self) -> Mapping[SetAside, TimeWindow | None]:
        """Bounds outside of which the files that do not answer contain no message.

        Wider than `unread_spans`, which estimate how much a file holds. None: anywhere.
        """
        return self.bounds_of((*self.damaged, *self.unread, *self.active))

    def bounds_of(self, files: Sequence[SetAside]) -> Mapping[SetAside, TimeWindow | None]:
        """Returns `unread_bounds` of any files, even if they do not exist any more."""
        return {
            **dict.fromkeys(files),
            **{file: self._bounds(file) for file in files[-_MAX_PLACED:]},
        }

    def _bounds(self, aside: SetAside) -> TimeWindow | None:
        if aside.until is not None:
            return _after(aside.until)
        name = split_of(str(aside.path))
        # Files that `ros2 bag record` did not number may lie in any order.
        is_split = name is not None and is_recording(name.series)
        near = self._neighbours(aside) if is_split else Neighbours()
        return unreadable_bounds(aside.path.parent.name, near, aside.written, self.scanned_at)

    def _neighbours(self, aside: SetAside) -> Neighbours:
        folder = str(aside.path.parent)
        segments = (segment for segment in self.timeline.segments if folder in segment.bags.folders)
        return neighbours(str(aside.path), segments)


def _after(until: Ns) -> TimeWindow:
    """Returns the times behind what was read of a file that goes on."""
    return TimeWindow(min(until + 1, MAX_NS), MAX_NS)


def unreadable_span(
    recording: str, near: Neighbours, written: Ns | None, now: Ns, *, growing: bool = False
) -> TimeWindow | None:
    """Returns the log times between which all messages of a file lie; None where unknown.

    Args:
        recording: the name of the file's folder.
        near: the splits around it.
        written: the file's mtime; None where unknown.
        now: the present.
        growing: whether the file is still being written.
    """
    start = named_start(recording) if near.before is None else near.before
    if near.after is not None:
        if start is None or (near.before is None and start > near.after):
            start = max(near.after - MAX_FILE_NS, MIN_NS)
        low, high = sorted((start, near.after))
        return TimeWindow(low, min(high + 1, MAX_NS))
    if growing:
        return TimeWindow(max(now - MAX_FILE_NS, MIN_NS) if start is None else start, MAX_NS)
    end = _last_written(written, now)
    if start is None:
        return None if end is None else TimeWindow(end - MAX_FILE_NS, end)
    longest = min(start + MAX_FILE_NS, MAX_NS)
    # A file last written before its start was recorded by another clock than its file system's.
    return TimeWindow(start, longest if end is None or end <= start else min(end, longest))


def unreadable_bounds(
    recording: str, near: Neighbours, written: Ns | None, now: Ns
) -> TimeWindow | None:
    """Returns the log times outside of which a closed file has no message; None: anywhere.

    As `unreadable_span`, without the estimate of how much a file holds. Splits between which the
    clock was set back bound nothing.
    """
    start = named_start(recording) if near.before is None else near.before
    end = _last_written(written, now) if near.after is None else min(near.after + 1, MAX_NS)
    if start is None and end is None:
        return None
    if start is not None and end is not None and end <= start:
        return None
    return TimeWindow(MIN_NS if start is None else start, MAX_NS if end is None else end)


def _last_written(written: Ns | None, now: Ns) -> Ns | None:
    """Returns the latest log time that a file can have, by its mtime; None where that cannot be."""
    if written is None or not FIRST_BAGS_NS <= written <= max_plausible(now):
        return None
    return min(written + FUTURE_NS, MAX_NS)
