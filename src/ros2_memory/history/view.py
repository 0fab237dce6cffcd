"""One call's view of the history, opened for the times that its question names.

A view is a snapshot of the index, its bags, and these as one stream. Times of a question are floats
of seconds. "Ago" counts from the wall clock or, for replayed and simulated bags (`data.now:
latest`), from the newest recorded moment. A call reads the clock once (`tools/declaration.py`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.examples import with_elements
from ros2_memory.analysis.intervals import THINNED_NS
from ros2_memory.core.arrays import concatenated
from ros2_memory.core.errors import InvalidArgumentsError, NoDataError, NoDataReason
from ros2_memory.core.memo import Key, Memo
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.timebase import (
    AT_OR_BEFORE_SLACK_NS,
    MAX_NS,
    MIN_NS,
    START_SLACK_NS,
    Ns,
    Span,
    ns_from_unix,
    unix_from_ns,
)
from ros2_memory.history.bag_access import BagAccess
from ros2_memory.history.clock_steps import elapsed_in, skipped_in
from ros2_memory.history.context import READING_S
from ros2_memory.history.coverage import unix_text
from ros2_memory.history.merged_stream import MergedStream
from ros2_memory.history.no_data import (
    only_pose_topic,
    require_bags,
    topics_of_robot,
    unmapped_topics_with,
)
from ros2_memory.history.scan import blocks, open_scan
from ros2_memory.history.sessions import Sessions
from ros2_memory.index.segment import TopicTotals

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.analysis.clock_steps import Elapsed
    from ros2_memory.columns.scan import Scan
    from ros2_memory.core.spans import Spans
    from ros2_memory.history.bag_access import StoredMessage
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.storage.base import IntArray


_CENSUSES: Final[Key[dict[str, dict[str, TopicTotals]]]] = Key()
"""Of a timeline: by topic, its census."""


class View:
    """What one call sees of a memory; it stays the same while the call lasts.

    What reads messages by it raises `QueryTimeoutError` when the call's time is over.

    Args:
        memory: the memory.
        call: the call.
        reach: the latest log time that the question is about. The bag directory is scanned again if
            the index does not reach it.

    Attributes:
        reach: the latest log time that the question is about.
        limits: the settings of the memory.
        extractor: reads its decoded messages.
        bag_dir: where its bags are.
        bags: each bag by itself.
        stream: all bags as one stream.
        snapshot: the index.
        timeline: the bags in the order of time.
        followed: the topic of poses that the question names; places are of these then.
        notes: what the reply reports besides its answer.
        memo: what was found out by this view.
    """

    def __init__(self, memory: Memory, call: Call, reach: Ns | None = None) -> None:
        self.memory = memory
        self.call = call
        self.reach = reach
        self.bags = BagAccess(memory, call, reach)
        self.stream = MergedStream(self.bags)
        self.snapshot = self.bags.snapshot
        self.timeline = self.snapshot.timeline
        self.limits, self.extractor = memory.limits, memory.extractor
        self.bag_dir = memory.bag_dir
        self.followed: str | None = None
        self.notes = self.bags.notes
        self.memo = Memo()

    @cached_property
    def sessions(self) -> Sessions:
        """Which recordings are of one robot in one run, and their transforms."""
        return Sessions(self)

    @cached_property
    def moving_topics(self) -> tuple[str, ...]:
        """The recorded topics of transforms that move (`data.tf_topics`)."""
        return tuple(topic for topic in self.limits.tf_topics if topic in self.timeline.types)

    @cached_property
    def static_topics(self) -> tuple[str, ...]:
        """The recorded topics of static transforms (`data.tf_static_topics`)."""
        return tuple(
            topic for topic in self.limits.tf_static_topics if topic in self.timeline.types
        )

    @cached_property
    def pose_topic(self) -> str:
        """The topic that places the robot: `only_pose_topic`, or `data.pose_topic`.

        The latter need not be recorded.
        """
        return only_pose_topic(self) or self.limits.pose_topic

    @cached_property
    def has_poses(self) -> bool:
        """Whether a topic has the robot's poses; if not, transforms may place it."""
        # The configured topic first: it is cheap to know, and mostly enough.
        for type_name in self.timeline.types_of(self.limits.pose_topic):
            kinds = self.extractor.kinds_of(type_name)
            if "position" in kinds or not self.extractor.is_mapped(type_name):
                return True
        return bool(topics_of_robot(self, "position") or unmapped_topics_with(self))

    def brief(self) -> View:
        """Returns another view, with notes of its own, that has `READING_S` seconds."""
        return View(self.memory, self.call.within(READING_S), self.reach)

    def value(self, stored: StoredMessage) -> JsonValue:
        """Returns a message as JSON; None if it cannot be decoded."""
        message = self.bags.decode(stored)
        return None if message is None else self.extractor.exact(message, stored.type)

    def example(self, stored: StoredMessage) -> JsonValue:
        """Returns a message's whole value with an example in each empty list of messages.

        So it has all fields that its type can have. None if it cannot be decoded.
        """
        value = self.value(stored)
        definition = self.bags.memory.reader.definition(stored.record.channel)
        paths = self.extractor.plan(stored.type).fields
        return value if definition is None else with_elements(value, definition, paths)

    def bounds(self, topic: str, window: TimeWindow) -> tuple[IntArray, IntArray]:
        """Returns the first and last log times of a topic in each bag of a window, or near it."""
        in_segments = (segment.column(topic) for segment in self.timeline.segments_in(window))
        columns = [column for column in in_segments if column is not None]
        firsts = concatenated(column.firsts for column in columns)
        return firsts, concatenated(column.lasts for column in columns)

    def gaps(
        self, window: TimeWindow, *, around: bool = False, steps: bool = False
    ) -> Sequence[Span]:
        """Returns the gaps that overlap a window, without steps of the clock unless `steps`.

        With `around`, only a gap that has the whole window inside.
        """
        first, last = window.asked()
        starts_before, ends_after = (window.start, window.stop - 1) if around else (last, first)
        pauses = {
            pause.span
            for pause in self.snapshot.pauses
            if pause.start < starts_before and ends_after < pause.end
        }
        # Most windows have no pause: then the gaps, which follow from all bags, are not needed.
        gaps = [gap for gap in self.snapshot.gaps if gap in pauses] if pauses else []
        if steps or not gaps:
            return gaps
        skipped = {start for start, _ in self.skipped_in(TimeWindow(gaps[0][0], gaps[-1][1]))}
        return [(start, end) for start, end in gaps if start not in skipped]

    def elapsed_in(self, window: TimeWindow) -> Elapsed:
        """Returns how much time passed between moments of a window, with a note on each step."""
        return elapsed_in(self, window)

    def skipped_in(self, window: TimeWindow) -> Spans:
        """Returns the times in and around a window that steps of the clock skipped, in order."""
        return skipped_in(self, window)

    def census(self, topic: str) -> dict[str, TopicTotals]:
        """Returns by type the totals of a topic, each message counted once.

        They follow from the summaries of bags; messages are read only where recordings overlap.
        Remembered until a bag comes or goes, if everything could be read.
        """
        remembered = self.timeline.memo.of(_CENSUSES, dict)
        if topic in remembered:
            return remembered[topic]
        with self.bags.watched() as reading:
            census = self._read_census(topic)
        if reading.is_final:
            remembered[topic] = census
        return census

    def _read_census(self, topic: str) -> dict[str, TopicTotals]:
        census = self.timeline.totals(topic)
        opened = open_scan(self, topic, TimeWindow.everything(), columns=False)
        for copies in opened.copies():
            type_name = copies.table.channel.type
            first, last, messages = census[type_name]
            _, last_copy = copies.span
            if last_copy >= last:
                last = self._last_counted(opened, type_name)
            census[type_name] = TopicTotals(first, last, messages - len(copies))
        return {type_name: totals for type_name, totals in census.items() if totals.messages}

    def _last_counted(self, opened: Scan, type_name: str) -> Ns:
        """Returns the log time of the newest message of a type that is no copy."""
        for block in blocks(opened.rows(newest_first=True), newest_first=True):
            for rows in block:
                self.bags.track_thinned(rows.first, rows.last)
            spans = [rows.span for rows in block if rows.table.channel.type == type_name]
            if spans:
                return max(last for _, last in spans)
        return MIN_NS


@dataclass(frozen=True, slots=True)
class AtTime:
    """The moment, or the moments, that a question is about. Exactly one of the first three is set.

    Attributes:
        at_s: Unix seconds.
        ago_s: seconds before now.
        each: several moments; `insights.at_each` asks about one after the other.
        rest_s: a message still counts if it is at most so much later than `at_s`: the time was
            given with fewer digits. Nothing is interpolated there.
    """

    at_s: float | None = None
    ago_s: float | None = None
    each: tuple[AtTime, ...] = ()
    rest_s: float = 0.0

    @property
    def end_s(self) -> float:
        """The last Unix seconds at which a message counts."""
        return (self.at_s or 0.0) + self.rest_s


@dataclass(frozen=True, slots=True)
class TimeRange:
    """An inclusive window: from `start_s` to `end_s` (Unix seconds), or the last `last_s` seconds.

    For a recap, it may also be the `before_s` seconds before `around_s`.
    """

    start_s: float | None = None
    end_s: float | None = None
    last_s: float | None = None
    around_s: float | None = None
    before_s: float = 10.0

    @classmethod
    def over(cls, window: TimeWindow) -> TimeRange:
        """Returns the range of a window, at least 1 ms long: a recap needs some length."""
        start_s = unix_from_ns(window.start)
        return cls(start_s, max(unix_from_ns(window.stop - 1), start_s + 0.001))


ANY_TIME: Final = TimeRange()


def days_back(view: View) -> Iterator[View]:
    """Yields a view, then views of the days before it, as long as there is time to read them.

    An index of years shows some days at a time, and reports which it has not shown.
    """
    reading = view.call.partial_after(READING_S)
    reach = MAX_NS if view.reach is None else view.reach
    while True:
        yield view
        older = view.snapshot.older
        if older is None or older >= reach or reading.expired() or view.call.deadline.expired():
            return
        reach = older
        view = View(view.memory, view.call, reach)


def open_moment(memory: Memory, call: Call, moment: AtTime) -> tuple[View, Ns, Ns | None]:
    """Returns the view for a moment, the moment, and now if the moment was relative to it.

    Raises:
        InvalidArgumentsError: the seconds are not finite, or negative where they count back.
        NoDataError: nothing is recorded, or no recorded time can lie so far back.
    """
    if moment.at_s is not None:
        at = ns_argument("timestamp", moment.at_s)
        view, now = open_view(memory, call, at + ns_from_unix(moment.rest_s)), None
    else:
        ago = ns_argument("seconds_ago", moment.ago_s or 0.0)
        if ago < 0:
            raise InvalidArgumentsError("seconds_ago must be 0 or more: it counts back from now")
        reach = None if memory.limits.now == "latest" else memory.clock.now() - ago
        view = open_view(memory, call, reach)
        now = memory.now(view.snapshot.latest, call)
        at = MIN_NS if ago == MAX_NS else now - ago
    if at > MIN_NS:
        call.asked = (TimeWindow.around(at, THINNED_NS),)
        return view, at, now
    earliest = view.snapshot.earliest
    begins = "" if earliest is None else f"; the memory begins at {unix_text(earliest)}"
    raise NoDataError(
        NoDataReason.OUTSIDE_RANGE, f"no recorded time is that far back (before 1678){begins}"
    )


def open_span(memory: Memory, call: Call, span: TimeRange) -> tuple[View, TimeWindow]:
    """Returns the view for a window, and the window.

    Raises:
        InvalidArgumentsError: the bounds are missing, reversed, not finite or of no length, or both
            kinds of bounds are given.
        NoDataError: nothing is recorded.
    """
    if span.last_s is None and (span.start_s is None or span.end_s is None):
        raise InvalidArgumentsError("start and end must both be given, as Unix seconds")
    window = search_window(span, memory.clock.now())
    counts_back = span.last_s is not None and memory.limits.now == "latest"
    view = open_view(memory, call, None if counts_back else window.stop)
    if counts_back:
        window = search_window(span, memory.now(view.snapshot.latest, call))
    window = clamped(view, window)
    call.asked = (window,)
    return view, window


def search_window(span: TimeRange, now: Ns) -> TimeWindow:
    """Returns the window to search; an end that is not given is open (`MIN_NS`, `MAX_NS`).

    Raises:
        InvalidArgumentsError: as for `open_span`.
    """
    if span.last_s is None:
        return TimeWindow.from_unix(span.start_s, span.end_s)
    if span.start_s is not None or span.end_s is not None:
        raise InvalidArgumentsError("seconds counts from now: give it, or start and end")
    length = ns_argument("seconds", span.last_s)
    if length <= 0:
        raise InvalidArgumentsError("seconds must be more than 0: the length of the window")
    start = now - length - START_SLACK_NS
    return TimeWindow(max(start, MIN_NS), min(now + AT_OR_BEFORE_SLACK_NS + 1, MAX_NS))


def clamped(view: View, window: TimeWindow) -> TimeWindow:
    """Returns the window without the time before both the epoch and the memory."""
    earliest = view.snapshot.earliest
    floor = min(0, 0 if earliest is None else earliest) - START_SLACK_NS
    return TimeWindow(max(window.start, floor), max(window.stop, floor + 1))


def ns_argument(name: str, value_s: float) -> Ns:
    """Returns an argument in seconds as nanoseconds.

    Raises:
        InvalidArgumentsError: it is not finite. `name` is the name of the argument.
    """
    try:
        return ns_from_unix(value_s)
    except ValueError as error:
        raise InvalidArgumentsError(f"{name}: {error}") from error


def open_view(memory: Memory, call: Call, reach: Ns | None) -> View:
    """Returns a view of a memory.

    Raises:
        NoDataError: the memory holds nothing.
    """
    view = View(memory, call, reach)
    require_bags(view)
    return view


def open_search(memory: Memory, call: Call, span: TimeRange) -> tuple[View, Ns, TimeWindow]:
    """Returns the view for a search, now, and the window to search.

    Raises:
        InvalidArgumentsError: the bounds make no window.
        NoDataError: the memory holds nothing.
    """
    wall = memory.clock.now()
    view = open_view(memory, call, min(search_window(span, wall).stop, wall))
    now = memory.now(view.snapshot.latest, call)
    return view, now, search_window(span, now)
