"""The arguments `where`, a named place, a circle or a rectangle, and `while`, conditions elsewhere.

Of several places any counts: a thing, or the robot, is there where it is in one of them. Both bound
a search besides its window.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain
from operator import itemgetter
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.conditions import as_float
from ros2_memory.analysis.intervals import SILENCE_NS, pieces_of
from ros2_memory.core.errors import InvalidArgumentsError, QueryTimeoutError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.regions import AnyOf, Circle, Place, Rectangle, Region
from ros2_memory.core.spans import Spans, lies_inside, united, without
from ros2_memory.core.text import abbreviate, caseless
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns, Span
from ros2_memory.history.coverage import unknown_times
from ros2_memory.history.driven_path import resolve_path_topic
from ros2_memory.history.held_values import breaks_of, deletions, holds_on
from ros2_memory.history.reverse_search import ReverseSearch, compared_frames, condition_of
from ros2_memory.history.robots import note_robots, note_robots_on
from ros2_memory.history.scan import scan
from ros2_memory.places.pose_frames import (
    WHEREABOUTS,
    MapPlacement,
    known_track,
    map_placement,
    placed_times,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    # Not at runtime: pydantic, which `WhileCondition` is an argument of, takes no recursive type.
    from ros2_memory.core.model import JsonValue
    from ros2_memory.core.reply import JsonObject
    from ros2_memory.history.context import QuerySettings
    from ros2_memory.history.view import View
    from ros2_memory.places.robot_tracks import KnownTrack

PLACES_SETTING: Final = "data.places_file (for a fleet: fleet.places)"
"""Where places are named, for sentences."""
_EXPECTED: Final = (
    "give the name of a place, "
    '{"x": 1.0, "y": 2.0, "radius_m": 0.5}, or {"x": [0, 5], "y": [5, 9]} (m); '
    'several as "kitchen, hall", or by name: {"kitchen": {"x": [0, 5], "y": [5, 9]}, "hall": ...}'
)
_OF_REGION: Final = frozenset({"x", "y", "radius_m"})
_MOST_PLACES: Final = 30
_UNNAMED: Final = "where"
"""What a region without a name is called in tables."""


@dataclass(frozen=True, slots=True)
class Where:
    """A region, and the frame that it is in.

    Attributes:
        frame_id: None for the frame that places are in by default.
        name: of a named place, or of several; None for any other region.
        several: these, each with a name, where the region is that of several places.
    """

    region: Region
    frame_id: str | None = None
    name: str | None = None
    several: tuple[Where, ...] = ()

    def contains(self, frame_id: str, x: float, y: float) -> bool:
        """Whether a point (m) of a frame lies in the region."""
        return self.frame_id in {None, frame_id} and self.region.contains(x, y)

    @property
    def each(self) -> tuple[Where, ...]:
        """The places that it is made of: itself, where it is one."""
        return self.several or (self,)

    @property
    def title(self) -> str:
        """What a row about it is called."""
        return self.name or _UNNAMED

    def places(self, frame_id: str) -> tuple[Place, ...]:
        """Returns each of its places by name; `frame_id` is the frame of those that name none."""
        frame = self.frame_id or frame_id
        return tuple(Place(part.title, part.frame_id or frame, part.region) for part in self.each)

    @property
    def shown(self) -> JsonValue:
        """The argument as a reply repeats it: a place's name, or the bounds."""
        match self.region:
            case _ if self.name is not None:
                return self.name
            case Circle(x, y, radius_m):
                return {"x": x, "y": y, "radius_m": radius_m}
            case region:
                min_x, max_x, min_y, max_y = region.bounds
                return {"x": [min_x, max_x], "y": [min_y, max_y]}


def parse_where(
    limits: QuerySettings,
    value: JsonValue,
    default_radius_m: float | None = None,
    what: str = "where",
) -> Where:
    """Returns what a value of the argument `where` means.

    Args:
        limits: have the named places.
        value: as the client gave it: a place, or several.
        default_radius_m: of a circle without a radius; None where it must have one.
        what: the name of the argument.

    Raises:
        InvalidArgumentsError: it is no region, or no place has that name.
    """
    several = _places_by_name(limits, value)
    if several is None:
        return _parse_place(limits, value, default_radius_m, what)
    if len(several) > _MOST_PLACES:
        raise InvalidArgumentsError(
            f"{what} has {len(several)} places, more than {_MOST_PLACES}: ask about some of them"
        )
    by_name = (
        (name, _parse_place(limits, place_value, default_radius_m, f"{what}: {abbreviate(name)}"))
        for name, place_value in several.items()
    )
    # Two spellings of one name are one place.
    places = tuple(
        dict.fromkeys(
            replace(place, name=name) if place.name is None else place for name, place in by_name
        )
    )
    if len(places) == 1:
        return places[0]
    region = AnyOf(tuple(part.region for part in places))
    names = ", ".join(part.title for part in places)
    return Where(region, _frame_of(places), names, places)


def _places_by_name(limits: QuerySettings, value: JsonValue) -> JsonObject | None:
    """Returns places by name; None of a value that is to be one place."""
    if isinstance(value, str):
        names = [name.strip() for name in value.split(",")]
        if len(names) == 1 or _place_named(limits, value) is not None:
            return None
        return {name: name for name in names if name} or None
    if isinstance(value, list) and value and all(isinstance(name, str) for name in value):
        return {str(name): name for name in value}
    if not isinstance(value, dict):
        return None
    is_one = any(not isinstance(value.get(name, {}), dict) for name in _OF_REGION)
    are_places = any(isinstance(place_value, str | dict) for place_value in value.values())
    return value if are_places and not is_one else None


def _frame_of(several: Sequence[Where]) -> str | None:
    """Returns the frame that several places share; coordinates are in that of the named ones.

    Raises:
        InvalidArgumentsError: they are in several frames.
    """
    name_by_frame = {part.frame_id: part.title for part in several if part.frame_id is not None}
    if len(name_by_frame) > 1:
        listed = ", ".join(f"{name} is in {frame}" for frame, name in name_by_frame.items())
        raise InvalidArgumentsError(f"where: {listed}: ask about places of one frame")
    return next(iter(name_by_frame), None)


def _parse_place(
    limits: QuerySettings, value: JsonValue, default_radius_m: float | None, what: str
) -> Where:
    if isinstance(value, str):
        if (place := _place_named(limits, value)) is not None:
            return Where(place.region, place.frame_id, place.name)
        names = ", ".join(sorted(named.name for named in limits.places))
        none = f"none are named in {places_setting(limits)}; {_EXPECTED}"
        listed = f"there are: {names}" if names else none
        raise InvalidArgumentsError(f"{what}: no place is named {abbreviate(value)}; {listed}")
    if not isinstance(value, dict):
        raise InvalidArgumentsError(f"{what} was {abbreviate(value)}; {_EXPECTED}")
    unknown = value.keys() - _OF_REGION
    if unknown:
        raise InvalidArgumentsError(f"{what} has no {abbreviate(min(unknown))}; {_EXPECTED}")
    x, y = value.get("x"), value.get("y")
    if isinstance(x, list) or isinstance(y, list):
        if "radius_m" in value:
            raise InvalidArgumentsError(f"{what} has a radius_m and a range; {_EXPECTED}")
        return Where(Rectangle(*_parse_range(f"{what}: x", x), *_parse_range(f"{what}: y", y)))
    radius = value.get("radius_m", default_radius_m)
    numbers = [*map(as_float, (x, y, radius))]
    if not all(map(math.isfinite, numbers)) or numbers[-1] <= 0:
        raise InvalidArgumentsError(f"{what} was {abbreviate(value)}; {_EXPECTED}")
    return Where(Circle(*numbers))


def places_asked(
    limits: QuerySettings, where: Where | None, frames: Iterable[str]
) -> tuple[Place, ...]:
    """Returns the named places, and those that a question names in any of some frames."""
    asked = [] if where is None or where.name is None else [where.places(frame) for frame in frames]
    return tuple(dict.fromkeys(chain(limits.places, *asked)))


def places_setting(limits: QuerySettings) -> str:
    """Returns where places are named, with the file that was read."""
    return f"{PLACES_SETTING}, here {limits.places_file}" if limits.places_file else PLACES_SETTING


def _place_named(limits: QuerySettings, name: str) -> Place | None:
    def folded(words: str) -> str:
        return caseless(" ".join(words.split()))

    same = (named for named in limits.places if folded(named.name) == folded(name))
    return next(same, None)


def _parse_range(axis: str, value: JsonValue) -> tuple[float, float]:
    bounds = [*map(as_float, value)] if isinstance(value, list) else []
    match bounds:
        case [low, high] if low < high and all(map(math.isfinite, bounds)):
            return low, high
    raise InvalidArgumentsError(
        f"{axis} was {abbreviate(value)}, which is not a range [from, to]; {_EXPECTED}"
    )


def note_other_frame(
    view: View, where: Where, placement: MapPlacement, window: TimeWindow, ask: str
) -> None:
    """Notes that coordinates without a frame, where nothing is in the map, are those of poses.

    As replies of get_position_* give them. `ask` says how to ask for what is there.
    """
    pose_frame = placement.pose_frame
    if where.frame_id is not None or pose_frame == placement.frame_id:
        return
    with suppress(QueryTimeoutError):
        if known_track(view, pose_frame, window).inside(where.region, window):
            view.notes.add(
                f"x and y were taken in {placement.frame_id}; the robot was at those in "
                f"{pose_frame}, the frame of get_position_*: {ask}"
            )


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
        since: back to when the robot's place is known, where the time was over before; else None.

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
        self._view = view
        self.window = window
        self.unknown: Spans = []
        self.since: Ns | None = None
        self._inside: Spans | None = None
        if where is not None:
            place = parse_where(view.limits, where)
            joined = known_track_for(view, place, window)
            self.since = joined.since
            inside = joined.inside(place.region, window)
            self._inside = united((stay.start, stay.stop + 1) for stay in inside)
            mixed = note_robots(view, resolve_path_topic(view), window)
            known = placed_times(joined.track, mixed)
            self.unknown = unknown_times(view, window, known, WHEREABOUTS, mixed=mixed)
        self._states = [_ConditionStates(view, condition) for condition in during]
        for state, condition in zip(self._states, during, strict=True):
            state.search.require_met(window.stop)
            state.search.note_untested(window)
            mixed = note_robots_on(view, state.search.topics, window)
            known = without(state.known_in(window), mixed)
            said = f"what {condition.topic} said"
            unknown = unknown_times(view, window, known, said, mixed=mixed)
            self.unknown = united([*self.unknown, *unknown])

    @property
    def compared_frames(self) -> tuple[str, ...]:
        """The notes on the frames in which the other conditions compared positions, if any did."""
        searches = [state.search for state in self._states]
        notes = (compared_frames(self._view, each.topics, each.condition) for each in searches)
        return tuple(dict.fromkeys(chain(*notes)))

    @property
    def is_bounded(self) -> bool:
        """Whether messages in the window may not count."""
        return self._inside is not None or bool(self._states)

    def narrowed(self) -> Iterator[TimeWindow]:
        """Returns the parts of the window in which matches may count, newest first."""
        if self._inside is None:
            return iter([self.window])
        spans = (TimeWindow(*span) for span in reversed(self._inside))
        return (part for part in map(self.window.intersect, spans) if not part.empty)

    def holds_at(self, time: Ns) -> bool:
        """Returns whether a match at a moment counts."""
        if self._inside is not None and not lies_inside(self._inside, time):
            return False
        return all(state.holds_at(time) for state in self._states)

    def holds_until(self, time: Ns, end: Ns) -> Ns:
        """Returns until when matches count from a moment at which they do, at most until `end`."""
        if self._inside is not None:
            nth = bisect_right(self._inside, time, key=itemgetter(1))
            end = min(end, self._inside[nth][1] - 1)
        for state in self._states:
            end = state.holds_until(time, end)
        return end

    def parts_of(self, first: Ns, last: Ns) -> Spans:
        """Returns the parts of a time (inclusive, as they are) in which matches count, in order."""
        inside = [(first, last + 1)] if self._inside is None else self._inside
        begin = bisect_right(inside, first, key=itemgetter(1))
        end = bisect_right(inside, last, key=itemgetter(0))
        parts = [(max(first, start), min(last, stop - 1)) for start, stop in inside[begin:end]]
        for state in self._states:
            parts = [part for span in parts for part in state.parts_of(*span)]
        return parts


def known_track_for(view: View, where: Where, window: TimeWindow) -> KnownTrack:
    """Returns the robot's track in the frame of a region: the map, unless it names another.

    Notes say where it is not all known, and where it is in the region in another frame alone.

    Raises:
        InvalidArgumentsError: no pose is in the region's frame, and none can be placed there.
        NoDataError: no pose is recorded.
        QueryTimeoutError: the call's time runs out before any result.
    """
    topic = resolve_path_topic(view)
    placement = map_placement(view, topic, where.frame_id)
    joined = known_track(view, where.frame_id or placement.frame_id, window)
    if not joined.inside(where.region, window):
        ask = f'ask it with frame_id "{placement.frame_id}"'
        note_other_frame(view, where, placement, window, ask)
    return joined


class _ConditionStates:
    """Whether the newest message of a topic met a condition; moments are asked newest first.

    Messages are read bag by bag: those around the moment, and the newest one before.
    """

    def __init__(self, view: View, during: WhileCondition) -> None:
        self._view = view
        topic, kind, value = during.topic, during.condition_type, during.value
        condition = condition_of(view, topic, kind, value, field=during.field, min_score=0.0)
        self.search = ReverseSearch(view, topic, condition)
        self._holds_on = holds_on(view, self.search.topics)
        found = breaks_of if self._holds_on else deletions
        moments = chain.from_iterable(found(view, topic) for topic in self.search.topics)
        self._breaks = sorted(moments)
        self._known = TimeWindow(0, 0)
        self._times: list[Ns] = []
        self._values: list[bool] = []

    def known_in(self, window: TimeWindow) -> Spans:
        """Returns when it is known what the topics said: without silences, unless that holds on."""
        topics, timeline = self.search.topics, self._view.timeline
        if self._holds_on:
            spans = (span for topic in topics for span in timeline.recordings(topic).values())
            known = [(min((first for first, _ in spans), default=MAX_NS), MAX_NS)]
            return without(known, self._after_breaks(window))
        return heard_times(self._view, topics, window.widened(SILENCE_NS))

    def _after_breaks(self, window: TimeWindow) -> Spans:
        """Returns from each break to the next message, as far as they reach into a window."""
        spans: Spans = []
        reached = MIN_NS
        for at in self._breaks[max(bisect_right(self._breaks, window.start) - 1, 0) :]:
            if reached <= at < window.stop:
                after = TimeWindow(at + 1, window.stop)
                message = self._view.stream.first(self.search.topics, after)
                reached = MAX_NS if message is None else message.time
                spans.append((at, reached))
        return spans

    def holds_at(self, time: Ns) -> bool:
        """Returns whether the newest message then met the condition; False without one."""
        if not self._known.contains(time):
            self._read_around(time)
        number = bisect_right(self._times, time)
        if not number:
            return False
        last = self._times[number - 1]
        return (
            self._values[number - 1]
            and (self._holds_on or time - last <= SILENCE_NS)
            and self._broken_from(last) >= time
        )

    def holds_until(self, time: Ns, end: Ns) -> Ns:
        """Returns until when the condition is known to be met from a moment on; at most `end`."""
        while time < end and self.holds_at(time):
            number = bisect_right(self._times, time)
            last, following = self._times[number - 1], self._next_after(time, end)
            if not self._holds_on and min(following, end) - last > SILENCE_NS:
                return max(time, last)
            if (broken := self._broken_from(last)) < min(following, end):
                return max(time, broken)
            time = following
        return min(time, end)

    def _broken_from(self, last: Ns) -> Ns:
        """Returns from when on what a message said is not known to hold; `MAX_NS`: it may hold."""
        nth = bisect_left(self._breaks, last)
        return self._breaks[nth] if nth < len(self._breaks) else MAX_NS

    def parts_of(self, first: Ns, last: Ns) -> Iterator[Span]:
        """Yields the parts of a time (inclusive) in which the condition is met, in order."""
        time = first
        while time <= last:
            until = time
            if self.holds_at(time):
                until = self.holds_until(time, last)
                yield time, until
            time = MAX_NS if until == last else self._next_after(until, last)

    def _next_after(self, time: Ns, end: Ns) -> Ns:
        """Returns the log time of the first message after a moment that was read around.

        `MAX_NS` where none comes until `end`.
        """
        number = bisect_right(self._times, time)
        if number < len(self._times):
            return self._times[number]
        window = TimeWindow(self._known.stop, end + 1)
        message = self._view.stream.first(self.search.topics, window)
        return MAX_NS if message is None else message.time

    def _read_around(self, time: Ns) -> None:
        """Reads the messages of the bags that may hold the newest one at a moment."""
        topics = self.search.topics
        spans = self._view.stream.overlapping_bags(topics, TimeWindow(time, time + 1))
        start = min((span.first for span in spans), default=time)
        stop = max((span.last + 1 for span in spans), default=time + 1)
        stop = max(stop, time + 1)
        messages = [*self._view.stream.messages(topics, TimeWindow(start, stop))]
        if not messages or messages[0].time > start:
            before = self._view.stream.first(topics, TimeWindow(MIN_NS, start), newest_first=True)
            messages = messages if before is None else [before, *messages]
        self._times, self._values = [], []
        for message in messages:
            met = self.search.matches(message)
            if met is not None:
                self._times.append(message.time)
                self._values.append(met)
        self._known = TimeWindow(start, stop)


def heard_times(view: View, topics: Iterable[str], window: TimeWindow) -> Spans:
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
            scanned = scan(view, topic, window, columns=False, within=united(within))
            spans += [pieces_of(rows.times, rows.times) for rows in scanned]
    starts, stops = (np.concatenate(bounds) for bounds in zip(*spans, strict=True))
    starts, stops = pieces_of(starts, stops)
    return list(zip(starts.tolist(), (stops + 1).tolist(), strict=True))
