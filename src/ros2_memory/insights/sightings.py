"""Matches in a row as sightings: when each began and ended, and where the robot and the thing were.

A sighting is message after message of one topic that meets a condition. It is over with a message
of that topic that does not, and where the topic is silent for longer than `SILENCE_NS`: a detector
may speak only of what it sees. A message that cannot be decoded is neither a match nor an end.
"""

from __future__ import annotations

import math
from collections import OrderedDict, deque
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.conditions import NearPosition, parse_condition
from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.core.errors import (
    InvalidArgumentsError,
    NoDataError,
    QueryTimeoutError,
    UndecodableError,
)
from ros2_memory.core.geometry import rotate
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import (
    AT_OR_BEFORE_SLACK_NS,
    MAX_NS,
    MIN_NS,
    START_SLACK_NS,
    Ns,
)
from ros2_memory.history.coverage import note_unread, unix_text
from ros2_memory.history.no_data import require_bags
from ros2_memory.history.reverse_search import ReverseSearch
from ros2_memory.history.time_arguments import TimeRange, clamped, ns_argument
from ros2_memory.history.transforms import own_holdings, transform_at
from ros2_memory.history.view import View
from ros2_memory.messages.detections import detections_of
from ros2_memory.results import Sighting, Sightings, Spot

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.analysis.conditions import Condition
    from ros2_memory.core.model import JsonValue, Pose
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.history.reverse_search import SearchWindow
    from ros2_memory.messages.detections import Detection

NEWEST_POSE_NS: Final[Ns] = SILENCE_NS
"""An older pose does not tell where the robot was."""


@dataclass(slots=True)
class _Run:
    """Matches in a row, the newest first.

    Attributes:
        newest: the last match.
        first: log time of the first match so far.
        reach: log time of the first message so far, be it one that cannot be decoded.
        begun: it is known what is before them.
    """

    newest: StoredMessage
    first: Ns
    reach: Ns
    messages: int = 1
    begun: bool = False


def find_matches(
    memory: Memory,
    call: Call,
    topic: str,
    condition_type: str,
    value: JsonValue,
    *,
    field: str | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
    last_s: float | None = None,
    limit: int = 5,
    oldest_first: bool = False,
) -> Sightings:
    """The newest `limit` sightings on a topic, or on all topics of a glob, newest first.

    `start_s` and `end_s` (Unix seconds, inclusive), or `last_s` (before now), bound what is
    searched. With `oldest_first` all of it is gone through, and the oldest sightings are told.

    Raises:
        InvalidArgumentsError: nothing can meet the condition, or the bounds make no window.
        NoDataError: the memory holds nothing, or no such topic.
        QueryTimeoutError: the call's time is over before anything was found.
    """
    condition = parse_condition(condition_type, value, memory.limits.position_tolerance_m, field)
    span = TimeRange(start_s, end_s, last_s)
    wall = memory.clock.now()
    view = View(memory, call, min(_window(span, wall).stop, wall))
    require_bags(view)
    earliest, latest = view.snapshot.earliest, view.snapshot.latest
    now = memory.now(wall, latest)
    window = clamped(view, _window(span, now))
    runs = _Runs(limit, oldest_first=oldest_first)
    _gather(view, topic, condition, window, runs)
    searched = TimeWindow(runs.told[-1].first, window.stop) if runs.cut and runs.told else window
    view.notes.retract_before(searched.start)
    pose_topic = memory.limits.pose_topic
    found = tuple(_told(view, condition, run, pose_topic) for run in runs.told)
    note_unread(view, searched, nothing=not found, search=True)
    start = window.start if earliest is None else max(window.start, earliest)
    end = window.stop if latest is None else min(window.stop, latest)
    if end < start:  # all of it lies before or behind the memory
        start, end = window.asked()
    return Sightings(
        found,
        more=runs.cut or runs.count > len(found),
        total=None if runs.cut else runs.count,
        start=start,
        end=end,
        now=now,
        notes=view.notes.sentences(),
    )


def _window(span: TimeRange, now: Ns) -> TimeWindow:
    """The window searched, with the slack of floats of seconds.

    Raises:
        InvalidArgumentsError: the end lies before the start, or a bound is not finite, or both
            kinds of bounds are given.
    """
    start_s, end_s = span.start_s, span.end_s
    if span.last_s is not None:
        if start_s is not None or end_s is not None:
            raise InvalidArgumentsError("seconds counts from now: give it, or start and end")
        stop = min(now + AT_OR_BEFORE_SLACK_NS + 1, MAX_NS)
        return TimeWindow(max(now - ns_argument("seconds", span.last_s), MIN_NS), stop)
    start = MIN_NS if start_s is None else ns_argument("start", start_s) - START_SLACK_NS
    end = MAX_NS - 1 if end_s is None else ns_argument("end", end_s) + AT_OR_BEFORE_SLACK_NS
    if end < start:
        raise InvalidArgumentsError(f"end ({end_s}) lies before start ({start_s})")
    return TimeWindow(max(start, MIN_NS), min(end + 1, MAX_NS))


def _gather(
    view: View, pattern: str, condition: Condition, window: TimeWindow, runs: _Runs
) -> None:
    """Adds the matches in a window, newest first, until there are enough.

    Raises:
        InvalidArgumentsError: no value of the topics can meet the condition.
        NoDataError: there is no such topic, or none of its messages can be decoded.
        QueryTimeoutError: the call's time is over before the first match was found.
    """
    search = ReverseSearch(view, pattern, condition)
    candidates = search.candidates(window.stop)
    before = window.stop
    try:
        for part, topics in _parts(view, search.topics, candidates.windows(), window):
            runs.end_silent(part.stop)
            _pass_over(view, runs, TimeWindow(part.stop, max(before, part.stop)))
            # There may be thousands of topics: read are those that can begin a row or end one.
            bearing = sorted({*topics, *runs.under_way()})
            for found in view.stream.messages(bearing, part, newest_first=True):
                before = found.time
                runs.end_silent(found.time)
                matches = search.matches(found)
                if matches:
                    runs.add(found)
                elif matches is None:
                    runs.pass_by(found)
                else:
                    runs.end(found.record.channel.topic)
                if runs.enough:
                    _leave(search, runs)
                    return
            before = part.start
    except QueryTimeoutError:
        if not runs.count:
            raise
        runs.cut = True
        view.notes.complete = False
        view.notes.add(
            f"the search ran out of time at {unix_text(before)}: to go on, ask with end there"
        )
        return
    for topic in runs.under_way():
        runs.end(topic)
    if runs.enough:
        # As where one message more is read, which the catalogue rules out.
        _leave(search, runs)
    else:
        search.close(candidates, window, found=bool(runs.count))


def _pass_over(view: View, runs: _Runs, gap: TimeWindow) -> None:
    """Ends the rows of the topics that have a message in a time without a match."""
    for topic in runs.under_way():
        if _any_between(view, topic, gap):
            runs.end(topic)


def _leave(search: ReverseSearch, runs: _Runs) -> None:
    """Ends a search that need not have looked further."""
    runs.cut = True
    search.note_undecodable(runs.told[-1].first)


class _Runs:
    """Matches that come newest first, in rows by topic; told are the newest or the oldest ones.

    Attributes:
        count: how many rows there are so far.
        cut: the search was left before all was gone through, or might have been.
    """

    def __init__(self, limit: int, *, oldest_first: bool) -> None:
        self._limit = limit
        self._oldest_first = oldest_first
        self._kept: deque[_Run] = deque(maxlen=limit if oldest_first else None)
        self._open: OrderedDict[str, _Run] = OrderedDict()  # the one longest without a match first
        self.count = 0
        self.cut = False

    def add(self, found: StoredMessage) -> None:
        """Takes the next older match; rows that ended in silence before it have been ended."""
        topic = found.record.channel.topic
        run = self._open.get(topic)
        if run is None:
            self._open[topic] = run = _Run(found, found.time, found.time)
            self._kept.append(run)
            self.count += 1
        else:
            run.first = run.reach = found.time
            run.messages += 1
            self._open.move_to_end(topic)

    def pass_by(self, found: StoredMessage) -> None:
        """Takes a message that cannot be decoded: it is no match, and ends no row."""
        topic = found.record.channel.topic
        run = self._open.get(topic)
        if run is not None:
            run.reach = found.time
            self._open.move_to_end(topic)

    def end_silent(self, until: Ns) -> None:
        """Ends the rows in which no message from before a moment can be."""
        while self._open:
            run = next(iter(self._open.values()))
            if run.reach - until <= SILENCE_NS:
                return
            self.end(run.newest.record.channel.topic)

    def end(self, topic: str) -> None:
        """What comes next of the topic belongs to another row."""
        run = self._open.pop(topic, None)
        if run is not None:
            run.begun = True

    def under_way(self) -> tuple[str, ...]:
        """The topics whose row may go on."""
        return tuple(self._open)

    @property
    def told(self) -> list[_Run]:
        """As many as are asked for, in their order."""
        if self._oldest_first:
            return [*reversed(self._kept)]
        return [*islice(self._kept, self._limit)]

    @property
    def enough(self) -> bool:
        """Whether nothing that comes can change the newest ones, and those are told."""
        return (
            not self._oldest_first
            and self.count > self._limit
            and all(run.begun for run in self.told)
        )


def _parts(
    view: View, topics: Sequence[str], stretches: Iterator[SearchWindow], window: TimeWindow
) -> Iterator[tuple[TimeWindow, Sequence[str]]]:
    """The parts of a window in which topics may have matches, and these, newest first."""
    if view.stream.may_be_relatched(topics):
        # What ends a row may be a copy of a message in a bag that is ruled out.
        yield window, topics
        return
    for stretch in stretches:
        if stretch.window.stop <= window.start:
            return
        part = stretch.window.intersect(window)
        if not part.empty:
            yield part, stretch.topics


def _any_between(view: View, topic: str, gap: TimeWindow) -> bool:
    """Whether the topic has a message in a time that holds no match."""
    if gap.empty:
        return False
    held = view.stream.overlapping_bags([topic], gap)
    if len({each.bag.recording for each in held}) == 1 and any(
        gap.contains(each.first) or gap.contains(each.last) for each in held
    ):
        return True
    return bool(held) and view.stream.first([topic], gap) is not None


def _told(view: View, condition: Condition, run: _Run, pose_topic: str) -> Sighting:
    """A row with where the robot was at its newest message, and where the thing was."""
    robot = _robot(view, pose_topic, run.newest)
    return Sighting(
        topic=run.newest.record.channel.topic,
        first=run.first,
        last=run.newest.time,
        messages=run.messages,
        begun=run.begun,
        robot=robot,
        thing=_spot(view, condition, run.newest, robot),
    )


def _robot(view: View, topic: str, seen: StoredMessage) -> Pose | None:
    """Where the robot was: its newest pose at or before then that can be read.

    Where the sighting's own session has poses, it is one of these.
    """
    window = TimeWindow(max(seen.time - NEWEST_POSE_NS, MIN_NS), seen.time + 1)
    own = own_holdings(view, topic, window, seen.bag.recording)
    found = view.stream.newest(topic, window)
    if own is not None and (found is None or found.bag not in {held.bag for held in own}):
        found = view.stream.first([topic], window, newest_first=True, among=own)
    if found is None:
        return None
    try:
        message = view.memory.reader.decode(found.record)
    except UndecodableError:
        return None
    pose = view.memory.extractor.pose(message, found.record.channel.type)
    return pose if pose is not None and all(map(math.isfinite, pose.position)) else None


def _spot(
    view: View, condition: Condition, found: StoredMessage, robot: Pose | None
) -> Spot | None:
    """Where the thing that matched was; in the map, the robot's frame, or its message's own."""
    message = view.memory.reader.decode(found.record)
    value = view.memory.extractor.exact(message, found.record.channel.type)
    frame = view.memory.extractor.frame(message)
    thing = _matching(detections_of(value, frame), condition)
    if thing is None or thing.place is None:
        return None
    frames = (view.memory.limits.map_frame, "" if robot is None else robot.frame_id)
    for target in filter(None, frames):
        if target == thing.frame_id:
            return Spot(thing.label, thing.place, target)
        try:
            found_transform = transform_at(
                view, target, thing.frame_id, found.time, found.bag.recording
            )
        except NoDataError:
            continue
        pose = found_transform.transform
        x, y, z = rotate(pose.rotation, thing.place)
        dx, dy, dz = pose.translation
        return Spot(thing.label, (x + dx, y + dy, z + dz), target)
    return Spot(thing.label, thing.place, thing.frame_id)


def _matching(things: Sequence[Detection], condition: Condition) -> Detection | None:
    """The thing that a condition is about: by name or place, or the only one; placed ones first."""
    test = condition.test
    if isinstance(test, NearPosition):
        about = [each for each in things if each.place is not None and test.is_near(*each.place)]
    else:
        about = [each for each in things if test.matches(each.label)]
    if not about and len(things) == 1:
        about = list(things)
    return max(about, key=lambda thing: thing.place is not None, default=None)
