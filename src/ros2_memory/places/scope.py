"""Bounds of a search besides its window: the robot's place, and conditions on other topics."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np

from ros2_memory.analysis.intervals import SILENCE_NS, pieces_of
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import united, without
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns
from ros2_memory.history.coverage import unknown_times
from ros2_memory.history.driven_path import resolve_path_topic
from ros2_memory.history.held_values import holds_on
from ros2_memory.history.reverse_search import ReverseSearch, compared_frames, condition_of
from ros2_memory.history.robots import note_robots, note_robots_on
from ros2_memory.history.scan import scan
from ros2_memory.places.pose_frames import map_placement
from ros2_memory.places.region_visits import WHEREABOUTS, placed_times, track_in
from ros2_memory.places.robot_tracks import robot_inside
from ros2_memory.places.where import note_other_frame, parse_where

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from ros2_memory.analysis.motion.robot_track import RobotTrack
    from ros2_memory.core.model import JsonValue
    from ros2_memory.core.spans import Spans
    from ros2_memory.history.view import View
    from ros2_memory.places.robot_tracks import Inside
    from ros2_memory.places.where import Where


@dataclass(frozen=True, slots=True)
class WhileCondition:
    """A condition on another topic, which its newest message must meet."""

    topic: str
    condition_type: str
    value: JsonValue
    field: str | None = None


class Scope:
    """The times in which matches count: in a place, and while all of some conditions hold.

    Attributes:
        window: that is searched.
        unknown: the recorded times of it in which it is not known whether matches count.

    Raises:
        InvalidArgumentsError: `where` is no place, or nothing can meet one of the other conditions.
        NoDataError: one of the other topics is not recorded, or no pose is.
    """

    def __init__(
        self,
        view: View,
        window: TimeWindow,
        where: JsonValue = None,
        during: Sequence[WhileCondition] = (),
    ) -> None:
        self.window = window
        self.unknown: Spans = []
        self._inside: list[tuple[Ns, Ns]] | None = None
        if where is not None:
            track, inside = _in_region(view, parse_where(view.limits, where), window)
            self._inside = [(each.start, each.stop) for each in inside]
            known = placed_times(track, note_robots(view, resolve_path_topic(view), window))
            self.unknown = unknown_times(view, window, known, WHEREABOUTS)
        self._states = [_States(view, each) for each in during]
        for state, each in zip(self._states, during, strict=True):
            known = state.known_in(window)
            unknown = unknown_times(view, window, known, f"what {each.topic} said")
            self.unknown = united([*self.unknown, *unknown])

    @property
    def compared_frames(self) -> tuple[str, ...]:
        """The notes on the frames in which the other conditions compared positions, if any did."""
        return tuple(dict.fromkeys(chain(*(state.compared_frames for state in self._states))))

    @property
    def is_bounded(self) -> bool:
        """Whether messages in the window may not count."""
        return self._inside is not None or bool(self._states)

    def narrowed(self) -> Iterator[TimeWindow]:
        """Yields the parts of the window in which matches may count, newest first."""
        if self._inside is None:
            yield self.window
            return
        for start, stop in reversed(self._inside):
            part = self.window.intersect(TimeWindow(start, stop + 1))
            if not part.empty:
                yield part

    def holds_at(self, time: Ns) -> bool:
        """Returns whether a match at a moment counts."""
        if self._inside is not None:
            number = bisect_right(self._inside, time, key=lambda each: each[0])
            if not number or time > self._inside[number - 1][1]:
                return False
        return all(state.holds_at(time) for state in self._states)


def times_in_region(view: View, where: Where, window: TimeWindow) -> Sequence[Inside]:
    """Returns when the robot was in a region, in order: one in the map, unless it names a frame.

    Raises:
        InvalidArgumentsError: no pose is in the region's frame, and none can be placed there.
        NoDataError: no pose is recorded.
        QueryTimeoutError: the call's time runs out before any result.
    """
    return _in_region(view, where, window)[1]


def _in_region(view: View, where: Where, window: TimeWindow) -> tuple[RobotTrack, Sequence[Inside]]:
    """Returns the robot's track, and when it was in a region."""
    topic = resolve_path_topic(view)
    placement = map_placement(view, topic, where.frame_id)
    track = track_in(view, where.frame_id or placement.frame_id, window)
    found = robot_inside(track, where.region, window)
    if not found:
        ask = f'ask it with frame_id "{placement.frame_id}"'
        note_other_frame(view, where, placement, window, ask)
    return track, found


class _States:
    """Whether the newest message of a topic met a condition; moments are asked newest first.

    Messages are read bag by bag: those around the moment, and the newest one before.
    """

    def __init__(self, view: View, during: WhileCondition) -> None:
        self._view = view
        self._condition = condition_of(
            view,
            during.topic,
            during.condition_type,
            during.value,
            field=during.field,
            min_score=0.0,
        )
        self._search = ReverseSearch(view, during.topic, self._condition)
        self._holds_on = holds_on(view, self._search.topics)
        self._known = TimeWindow(0, 0)
        self._times: list[Ns] = []
        self._values: list[bool] = []

    @property
    def compared_frames(self) -> tuple[str, ...]:
        """The note on the frames in which the condition compared positions, if it did."""
        return compared_frames(self._view, self._search.topics, self._condition)

    def known_in(self, window: TimeWindow) -> Spans:
        """Returns when the topics said something: without silences, unless that holds on."""
        topics, timeline = self._search.topics, self._view.timeline
        if self._holds_on:
            begins = [span[0] for topic in topics for span in timeline.recordings(topic).values()]
            known = [(min(begins, default=MAX_NS), MAX_NS)]
        else:
            known = _heard(self._view, topics, window.widened(SILENCE_NS))
        return without(known, note_robots_on(self._view, topics, window))

    def holds_at(self, time: Ns) -> bool:
        """Returns whether the newest message then met the condition; False without one."""
        if not self._known.contains(time):
            self._read_around(time)
        number = bisect_right(self._times, time)
        if not number:
            return False
        since = time - self._times[number - 1]
        return self._values[number - 1] and (self._holds_on or since <= SILENCE_NS)

    def _read_around(self, time: Ns) -> None:
        """Reads the messages of the bags that may hold the newest one at a moment."""
        topics = self._search.topics
        spans = self._view.stream.overlapping_bags(topics, TimeWindow(time, time + 1))
        start = min((span.first for span in spans), default=time)
        stop = max((span.last + 1 for span in spans), default=time + 1)
        stop = max(stop, time + 1)
        found = [*self._view.stream.messages(topics, TimeWindow(start, stop))]
        if not found or found[0].time > start:
            before = self._view.stream.first(topics, TimeWindow(MIN_NS, start), newest_first=True)
            found = found if before is None else [before, *found]
        self._times, self._values = [], []
        for each in found:
            met = self._search.matches(each)
            if met is not None:
                self._times.append(each.time)
                self._values.append(met)
        self._known = TimeWindow(start, stop)


def _heard(view: View, topics: Iterable[str], window: TimeWindow) -> Spans:
    """Returns when topics had messages, without silences of more than `SILENCE_NS`.

    Of a bag that holds a topic for no longer, its first and its last message say enough.
    """
    spans = [(np.empty(0, np.int64), np.empty(0, np.int64))]
    for topic in topics:
        firsts, lasts = view.bounds(topic, window)
        is_long = lasts - firsts > SILENCE_NS
        spans.append((firsts[~is_long], lasts[~is_long]))
        within = zip(firsts[is_long].tolist(), (lasts[is_long] + 1).tolist(), strict=True)
        if is_long.any():
            every = scan(view, topic, window, columns=False, within=united(within))
            spans += [pieces_of(rows.times, rows.times) for rows in every]
    starts, stops = (np.concatenate(some) for some in zip(*spans, strict=True))
    order = np.argsort(starts, kind="stable")
    starts, stops = pieces_of(starts[order], stops[order])
    return list(zip(starts.tolist(), (stops + 1).tolist(), strict=True))
