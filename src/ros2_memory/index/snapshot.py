"""The bag directory as it is known at one moment.

A file that cannot be read does not show its times, but the files around it do:

    not before   the end of the split before it in its recording, else the time in the name of a
                 recording of this program
    not after    the start of the split after it, else the last time that the file was written to

If only one side is known, the file is taken to hold a day at most. So an old file that nobody
removes, or one that was copied here later, does not affect answers about other days. If neither
side is known, or if the file's own date cannot be true, its time is unknown.

A day at most is an estimate, good enough for a note beside an answer. If the answer is that there
is nothing, the file counts wherever it may contain a message.
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
from ros2_memory.bag_dir.layout import named_start
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

    from ros2_memory.index.bag_rows import Bags
    from ros2_memory.index.segment import Segment, TopicTotals


_MAX_PLACED: Final = 500
"""Of more files that do not answer, only the last ones are placed in time."""


@dataclass(frozen=True)
class Snapshot:
    """The bag directory at one moment. Immutable, so threads share it freely.

    Attributes:
        timeline: the bags that answer queries, in time order, and what they hold.
        active: files that are being written or held back, sorted by path. If the complete part of
            one answers, it is among `bags` too.
        damaged: files and directories that cannot be read at all, sorted by path.
        unread: files of a kind that another adapter reads, and symbolic links, sorted by path.
        empty: closed bags without a message, sorted.
        silent_topics: topics that some bag declares and no bag has a message of.
        scanned_at: when the directory was scanned.
        problem: why the bag directory itself could not be read.
        metadata_folders: folders with a metadata.yaml.
        copies: bags that are left out as copies of others in their folder.
        older: the last log time of older bags that are left out: a lake is shown some days at a
            time. None if no bags are.
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
    def bags(self) -> Bags:
        """The bags that answer queries, sorted by (start, end, path).

        They are closed, or left open by a crash, and have messages. The bag of carried latched
        messages is not among them, but is found wherever a topic is asked for.
        """
        return self.timeline.recorded

    @property
    def earliest(self) -> Ns | None:
        """Log time of the first message in a correctly dated bag; None without bags."""
        return self._dating_by_times.earliest

    @property
    def latest(self) -> Ns | None:
        """Log time of the last message (inclusive) in a correctly dated bag; None without bags."""
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
        """The correctly dated bags, without the bag of carried messages, in order."""
        return dated_segments(self.timeline, self.dating.faults)

    @property
    def whole_segments(self) -> Iterator[Segment]:
        """The correctly dated bags that have every message that was recorded."""
        return filter(None, (segment.unthinned for segment in self._dated_segments))

    @cached_property
    def _periods(self) -> dict[str, Ns]:
        """The usual period of each topic that has one; logs and calls have none."""
        by_topic: dict[str, list[Pacing]] = {}
        for segment in self.whole_segments:
            for topic, times in segment.topic_times.items():
                by_topic.setdefault(topic, []).append(times.pacing)
        for topic in filter(self.timeline.is_on_events, [*by_topic]):
            del by_topic[topic]
        return usual_periods({topic: joined_pacings(parts) for topic, parts in by_topic.items()})

    @cached_property
    def _runs(self) -> dict[str, Spans]:
        """By topic, when bags hold it; see `silences`."""
        by_topic: dict[str, list[Span]] = {}
        for segment in self.whole_segments:
            for topic, times in segment.topic_times.items():
                by_topic.setdefault(topic, []).extend(times.runs)
        return {topic: united(runs, SHORTEST_NS) for topic, runs in by_topic.items()}

    @cached_property
    def silences(self) -> tuple[Silence, ...]:
        """Where topics with a usual rate were silent, in order of time; see `analysis.silences`."""
        together = frozenset(
            chain.from_iterable(segment.together for segment in self._dated_segments)
        )
        return tuple(silences(self._periods, self._runs, together, self.gaps))

    def prolonged(self, silence: Silence) -> Silence:
        """Returns a silence that began in deleted bags, prolonged by what later bags show."""
        if not silence.goes_on:
            return silence
        return prolonged_silence(
            silence, self._robot_on, self._runs.get(silence.topic, ()), self.gaps
        )

    @cached_property
    def _robot_on(self) -> Sequence[Span]:
        """When the robot was on, by all topics with a usual rate."""
        return robot_on_times([self._runs[topic] for topic in self._periods])

    def shortest_silence(self, topic: str) -> Ns:
        """Returns how long a topic must have no message to count as silent."""
        return shortest_silence(self._periods.get(topic, 0))

    def longest_silence(self, topic: str) -> Ns:
        """Returns the longest time (ns) without a message of a topic, gaps not counted."""
        if self.timeline.is_log(topic):
            return 0
        longest = 0
        for (_, end), (start, _) in pairwise(self._runs.get(topic, ())):
            longest = max(longest, start - end - length_in(self.gaps, end, start))
        return longest

    def totals(self, topic: str) -> list[TopicTotals]:
        """Returns the totals of a topic in correctly dated bags, for each segment and type."""
        return [
            totals
            for segment in self._dated_segments
            for totals in segment.totals.get(topic, {}).values()
        ]

    @cached_property
    def newest_stretch(self) -> Ns | None:
        """The first log time after the newest gap of more than `LONGEST_OFF_NS`.

        None without bags.
        """
        ends = [end for start, end in self.gaps if end - start > LONGEST_OFF_NS]
        return max(ends, default=self.earliest)

    @cached_property
    def gaps(self) -> Sequence[Span]:
        """Where nothing was recorded: from the last message before to the first after, in order.

        A gap lies between bags or within one; see `index.holes`. Carried messages and bags that a
        wrong clock dated do not count. A step forward of the clock looks like a gap: see
        `View.gaps`.
        """
        # Several bags of one time each show the same gap.
        return sorted({pause.span for pause in self._rhythm.gaps(self.pauses)})

    @cached_property
    def breaks(self) -> Sequence[Span]:
        """The gaps after which another run of a recorder began."""
        within_runs = {pause.span for pause in self._rhythm.gaps(self.pauses) if pause.ran_on}
        return [gap for gap in self.gaps if gap not in within_runs]

    @property
    def shortest_gap(self) -> Ns:
        """The length (ns) that a pause between two recordings must exceed to be one of `gaps`."""
        return self._rhythm.shortest_gap

    @cached_property
    def suspects(self) -> Sequence[Pause]:
        """Pauses of running recorders in which the clock may have been set forward, in order."""
        return self._rhythm.suspects(self.pauses)

    @cached_property
    def _rhythm(self) -> Rhythm:
        return Rhythm(self._periods)

    @cached_property
    def pauses(self) -> Sequence[Pause]:
        """Where no correctly dated bag has a message for a while, in order of time."""
        pauses: list[Pause] = []
        newest: BagFile | None = None
        for segment in self._dated_segments:
            between = segment.pauses
            if newest is not None:
                # A bag of an earlier segment may last into this one.
                between = (
                    pause_between(newest, segment.bags[0]),
                    *(
                        pause_between(newest, pause.bags[1]) if pause.start < newest.end else pause
                        for pause in between
                    ),
                )
            pauses += (pause for pause in between if pause.length > SHORTEST_PAUSE_NS)
            for pause in segment.pauses_within:
                pauses += self._parts_shared_by_all(pause)
            if newest is None or segment.latest > newest.end:
                newest = segment.newest
        # One that ends where a clock was set ahead begins before the memory.
        begin = MIN_NS if self.earliest is None else self.earliest
        dated = (pause for pause in pauses if pause.start >= begin)
        return sorted(dated, key=lambda pause: pause.span)

    def _parts_shared_by_all(self, pause: Pause) -> Iterator[Pause]:
        """Yields the parts of a bag's pause in which no other dated bag has a message either."""
        parts = [
            (start, end)
            for start, end in without([pause.span], self._covered)
            if end - start > SHORTEST_PAUSE_NS
        ]
        for start, end in parts:
            # Another recording in the middle of the pause makes a step of the clock likely.
            yield pause._replace(start=start, end=end, ran_on=pause.ran_on and len(parts) == 1)

    @cached_property
    def _covered(self) -> Spans:
        """When some correctly dated bag may have messages."""
        return united(chain.from_iterable(segment.covered for segment in self._dated_segments))

    @cached_property
    def unread_spans(self) -> Mapping[SetAside, TimeWindow | None]:
        """When files that do not answer were probably recorded; None if unknown.

        An estimate: see `unreadable_span`.
        """
        spans: dict[SetAside, TimeWindow | None] = {
            aside: self._unread_span(aside, growing=True) for aside in self.active
        }
        closed = (*self.damaged, *self.unread)
        spans.update(dict.fromkeys(closed))
        for aside in closed[-_MAX_PLACED:]:
            spans[aside] = self._unread_span(aside, growing=False)
        return spans

    def _unread_span(self, aside: SetAside, *, growing: bool) -> TimeWindow | None:
        if aside.until is not None:
            return _after(aside.until)
        near = self._neighbours(aside)
        recording = aside.path.parent.name
        return unreadable_span(recording, near, aside.written, self.scanned_at, growing=growing)

    @cached_property
    def unread_bounds(self) -> Mapping[SetAside, TimeWindow | None]:
        """For each file that does not answer, the bounds of its messages; None if unknown.

        Wider than `unread_spans`: nothing is estimated.
        """
        return self.bounds_of((*self.damaged, *self.unread, *self.active))

    def bounds_of(self, files: Sequence[SetAside]) -> Mapping[SetAside, TimeWindow | None]:
        """Returns `unread_bounds` of any files, even of files that do not exist any more."""
        bounds: dict[SetAside, TimeWindow | None] = dict.fromkeys(files)
        for file in files[-_MAX_PLACED:]:
            bounds[file] = self._bounds(file)
        return bounds

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
    """Returns the times after the last message that was read of a growing file."""
    return TimeWindow(min(until + 1, MAX_NS), MAX_NS)


def unreadable_span(
    recording: str, near: Neighbours, written: Ns | None, now: Ns, *, growing: bool = False
) -> TimeWindow | None:
    """Returns the log times between which a file's messages probably lie; None if unknown.

    Args:
        recording: the name of the file's folder.
        near: the splits around it.
        written: the file's mtime; None if unknown.
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
    # If the file was last written before its start, its file system has another clock.
    is_plausible = end is not None and end > start
    return TimeWindow(start, min(end, longest) if end is not None and is_plausible else longest)


def unreadable_bounds(
    recording: str, near: Neighbours, written: Ns | None, now: Ns
) -> TimeWindow | None:
    """Returns bounds (log time) of all messages in a closed file; None if unknown.

    Does not estimate how much a file holds, as `unreadable_span` does. Splits between which the
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
    """Returns the latest log time in a file by its mtime; None if the mtime is not plausible."""
    if written is None or not FIRST_BAGS_NS <= written <= max_plausible(now):
        return None
    return min(written + FUTURE_NS, MAX_NS)
