"""The arguments `where` (named places, a circle or a rectangle) and `while` (other topics).

Both bound a search besides its window. With several places, being in any of them counts. `while`
takes the times in which the newest messages of other topics meet conditions.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from itertools import chain, islice, starmap
from operator import itemgetter
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.conditions import as_float
from ros2_memory.analysis.facts import BATTERY, DIAGNOSTICS, GOALS
from ros2_memory.analysis.goals import while_active
from ros2_memory.analysis.intervals import SILENCE_NS, pieces_of
from ros2_memory.core.arrays import rows_of, stable_order, stacked
from ros2_memory.core.errors import InvalidArgumentsError, QueryTimeoutError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.regions import AnyOf, Circle, Place, Rectangle, Region, Storey, contains
from ros2_memory.core.spans import Spans, lies_inside, overlaps_any, spans_of, united, without
from ros2_memory.core.text import MAX_NAMED, abbreviate, caseless, listed
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_DAY, NS_PER_HOUR, Ns, Span
from ros2_memory.history.condition_hints import compared_frames
from ros2_memory.history.conditions import Sought, condition_of, types_matching
from ros2_memory.history.coverage import recording_gaps, span_text, unknown_times
from ros2_memory.history.driven_path import resolve_path_topic
from ros2_memory.history.lasting import Lasting, held_times
from ros2_memory.history.reverse_search import MET, UNKNOWN, ReverseSearch, Tested
from ros2_memory.history.robots import note_robots, note_robots_on
from ros2_memory.history.scan import scan
from ros2_memory.places.pose_frames import (
    WHEREABOUTS,
    MapPlacement,
    known_track,
    map_placement,
    placed_times,
)
from ros2_memory.places.robot_tracks import TrackReader
from ros2_memory.places.stays import stays_within

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Sequence

    from ros2_memory.core.model import JsonValue, Vector3
    from ros2_memory.core.reply import JsonObject
    from ros2_memory.history.context import QuerySettings
    from ros2_memory.history.view import View
    from ros2_memory.places.stays import KnownTrack

PLACES_SETTING: Final = "data.places_file (for a fleet: fleet.places)"
"""Where places are named, for sentences."""
_EXPECTED: Final = (
    "give the name of a place, "
    '{"x": 1.0, "y": 2.0, "radius_m": 0.5}, or {"x": [0, 5], "y": [5, 9]} (m), of one storey with '
    '"z": [2, 4], or [2, null]; '
    'several as "kitchen, hall", or by name: {"kitchen": {"x": [0, 5], "y": [5, 9]}, "hall": ...}'
)
_REGION_KEYS: Final = frozenset({"x", "y", "z", "radius_m"})
_MOST_PLACES: Final = 30
_NODE_NS: Final = NS_PER_HOUR
"""For so long at most a node of diagnostics has said something, if others have since."""
_MOST_TRIED: Final = 200
"""Messages that are read to find one that says whether a condition is met."""
_NONE_TESTED: Final = Tested(
    np.empty(0, np.int64), np.empty(0, np.uint8), np.empty(0, np.int64), np.empty(0, np.int64)
)
_UNNAMED: Final = "where"
"""What tables call a region without a name."""


@dataclass(frozen=True, slots=True)
class Where:
    """A region, and the frame that it is in.

    Attributes:
        region: one place, or several.
        frame_id: its frame; None for the frame that places are in by default.
        name: the name of the place, or of several; None for a region of coordinates alone.
        several: the places, each with a name; empty for one place.
    """

    region: Region
    frame_id: str | None = None
    name: str | None = None
    several: tuple[Where, ...] = ()

    def contains(self, frame_id: str, point: Vector3) -> bool:
        """Returns whether a point (m) in a frame lies in the region."""
        return self.frame_id in {None, frame_id} and contains(self.region, *point)

    @property
    def each(self) -> tuple[Where, ...]:
        """Its places, one by one."""
        return self.several or (self,)

    @property
    def title(self) -> str:
        """The name of a row about it."""
        return self.name or _UNNAMED

    def places(self, frame_id: str) -> tuple[Place, ...]:
        """Returns its named places; `frame_id` is the frame of places that name none."""
        frame = self.frame_id or frame_id
        return tuple(Place(part.title, part.frame_id or frame, part.region) for part in self.each)

    @property
    def shown(self) -> JsonValue:
        """The argument as a reply repeats it: the name of the place, or its bounds (m)."""
        region = self.region
        if self.name is not None:
            return self.name
        heights: JsonObject = {}
        if isinstance(region, Storey):
            heights["z"] = [region.low, region.high]
            region = region.plan
        if isinstance(region, Circle):
            return {"x": region.x, "y": region.y, **heights, "radius_m": region.radius_m}
        min_x, max_x, min_y, max_y = region.bounds
        return {"x": [min_x, max_x], "y": [min_y, max_y], **heights}


def parse_where(
    settings: QuerySettings,
    value: JsonValue,
    default_radius_m: float | None = None,
    what: str = "where",
) -> Where:
    """Returns the region that a value of the argument `where` describes.

    Args:
        settings: those of queries, which have the named places.
        value: the argument: one place, or several.
        default_radius_m: the radius of a circle that gives none; None if it must give one.
        what: the name of the argument, for errors.

    Raises:
        InvalidArgumentsError: the value is no region, or no place has that name.
    """
    several = _places_by_name(settings, value)
    if several is None:
        return _parse_place(settings, value, default_radius_m, what)
    if len(several) > _MOST_PLACES:
        raise InvalidArgumentsError(
            f"{what} has {len(several)} places, more than {_MOST_PLACES}: ask about some of them"
        )
    with_coordinates = {_spelling(name) for name in several if isinstance(several[name], dict)}
    places: list[Where] = []
    for name, place_value in several.items():
        place = _parse_place(settings, place_value, default_radius_m, f"{what}: {abbreviate(name)}")
        # Coordinates may have been given the name of a place that the settings have.
        if place.name is None or _spelling(place.name) in with_coordinates:
            place = replace(place, name=name)
        # Two spellings of one name are one place.
        if place not in places:
            places.append(place)
    if len(places) == 1:
        return places[0]
    region = AnyOf(tuple(part.region for part in places))
    names = ", ".join(part.title for part in places)
    return Where(region, _shared_frame(places, what), names, tuple(places))


def has_coordinates(value: object) -> bool:
    """Returns whether a value of the argument `where` gives more than names of places."""
    return isinstance(value, dict) and not all(isinstance(part, str) for part in value.values())


def _places_by_name(settings: QuerySettings, value: JsonValue) -> JsonObject | None:
    """Returns the values of several places by name; None if the value describes one place."""
    if isinstance(value, str):
        names = [name.strip() for name in value.split(",")]
        if len(names) == 1 or _place_named(settings, value) is not None:
            return None
        return {name: name for name in names if name} or None
    if isinstance(value, list) and value and all(isinstance(name, str) for name in value):
        return {str(name): name for name in value}
    if not isinstance(value, dict):
        return None
    # A place may be named "x": then it has an object as its value.
    is_one = any(not isinstance(value.get(key, {}), dict) for key in _REGION_KEYS)
    are_places = any(isinstance(place_value, str | dict) for place_value in value.values())
    return value if are_places and not is_one else None


def _shared_frame(several: Sequence[Where], what: str) -> str | None:
    """Returns the one frame that places name; coordinates without a frame are in it, too.

    Raises:
        InvalidArgumentsError: places name different frames.
    """
    name_by_frame = {part.frame_id: part.title for part in several if part.frame_id is not None}
    if len(name_by_frame) > 1:
        listed = ", ".join(f"{name} is in {frame}" for frame, name in name_by_frame.items())
        raise InvalidArgumentsError(f"{what}: {listed}: ask about places of one frame")
    return next(iter(name_by_frame), None)


def _parse_place(
    settings: QuerySettings, value: JsonValue, default_radius_m: float | None, what: str
) -> Where:
    if isinstance(value, str):
        if (place := _place_named(settings, value)) is not None:
            return Where(place.region, place.frame_id, place.name)
        names = ", ".join(sorted(named.name for named in settings.places))
        none = f"none are named in {places_setting(settings)}; {_EXPECTED}"
        listed = f"there are: {names}" if names else none
        raise InvalidArgumentsError(f"{what}: no place is named {abbreviate(value)}; {listed}")
    region = _region_of(value, default_radius_m)
    if region is None:
        raise InvalidArgumentsError(f"{what} was {abbreviate(value)}; {_EXPECTED}")
    return Where(region)


def _region_of(value: JsonValue, default_radius_m: float | None) -> Region | None:
    """Returns the region that an object describes, with its heights; None if it describes none."""
    if not isinstance(value, dict) or value.keys() - _REGION_KEYS:
        return None
    plan, heights = _plan_of(value, default_radius_m), value.get("z")
    if plan is None or heights is None:
        return plan
    match heights:
        case [bottom, top]:
            low = -math.inf if bottom is None else as_float(bottom)
            high = math.inf if top is None else as_float(top)
            return Storey(plan, low, high) if low < high else None
    return None


def _plan_of(value: JsonObject, default_radius_m: float | None) -> Circle | Rectangle | None:
    """Returns the rectangle or circle that an object describes; None if it describes none."""
    match value:
        case {"x": [_, _] as x_range, "y": [_, _] as y_range} if "radius_m" not in value:
            min_x, max_x, min_y, max_y = bounds = [as_float(end) for end in (*x_range, *y_range)]
            is_region = min_x < max_x and min_y < max_y and all(map(math.isfinite, bounds))
            return Rectangle(min_x, max_x, min_y, max_y) if is_region else None
    radius = value.get("radius_m", default_radius_m)
    numbers = [as_float(number) for number in (value.get("x"), value.get("y"), radius)]
    is_region = all(map(math.isfinite, numbers)) and numbers[2] > 0
    return Circle(*numbers) if is_region else None


def places_asked(
    settings: QuerySettings, where: Where | None, frames: Iterable[str]
) -> tuple[Place, ...]:
    """Returns the named places of the settings, and the places that a question names.

    A place of the question without a frame is taken once in each of `frames`.
    """
    asked = [] if where is None or where.name is None else [where.places(frame) for frame in frames]
    return tuple(dict.fromkeys(chain(settings.places, *asked)))


def places_setting(settings: QuerySettings) -> str:
    """Returns the name of the setting for places, and the path of the file that was read."""
    file = settings.places_file
    return f"{PLACES_SETTING}, here {file}" if file else PLACES_SETTING


def _place_named(settings: QuerySettings, name: str) -> Place | None:
    spelling = _spelling(name)
    return next((place for place in settings.places if _spelling(place.name) == spelling), None)


def _spelling(name: str) -> str:
    """Returns a name as names are compared: without case, and with single spaces."""
    return caseless(" ".join(name.split()))


def note_other_frame(
    view: View, where: Where, placement: MapPlacement, window: TimeWindow, advice: str
) -> None:
    """Notes that the robot was in the region if its coordinates are taken in the poses' frame.

    Planners copy coordinates from replies of get_position_*, which may be in that frame, not in the
    map. Does nothing if the region names a frame. `advice` says how to ask in the poses' frame.
    """
    pose_frame = placement.pose_frame
    if where.frame_id is not None or pose_frame == placement.frame_id:
        return
    with suppress(QueryTimeoutError):
        if TrackReader(view, pose_frame).track_in(window).inside(where.region, window):
            view.notes.add(
                f"x and y were taken in {placement.frame_id}; the robot was at those in "
                f"{pose_frame}, the frame of get_position_*: {advice}"
            )


class Scope:
    """The times in which matches count: the robot is in a place, and all conditions hold.

    Attributes:
        window: the window that is searched.
        unknown: the recorded spans of it in which it is not known whether matches count.
        since: log time before which the robot's place is not known because time ran out; else None.

    Raises:
        InvalidArgumentsError: `where` is no place, or nothing can meet one of the conditions.
        NoDataError: a topic of the conditions is not recorded, or no pose is.
    """

    def __init__(
        self,
        view: View,
        window: TimeWindow,
        where: JsonValue = None,
        during: Sequence[Sought] = (),
    ) -> None:
        self._view = view
        self.window = window
        self.unknown: Spans = []
        self.since: Ns | None = None
        self._inside: Spans | None = None
        if where is not None:
            self._limit_to_place(parse_where(view.limits, where))
        self._states = [_ConditionStates(view, condition) for condition in during]
        for state, condition in zip(self._states, during, strict=True):
            state.search.require_met(window.stop)
            state.search.note_untested(window)
            mixed = note_robots_on(view, state.search.topics, window)
            known = without(state.known_in(window), mixed)
            said = f"what {condition.topic} said"
            unknown = unknown_times(view, window, known, said, mixed=mixed)
            self.unknown = united([*self.unknown, *unknown])

    def _limit_to_place(self, place: Where) -> None:
        view, window = self._view, self.window
        known_track = _track_for(view, place, window)
        self.since = known_track.since
        inside = known_track.inside(place.region, window)
        self._inside = united((stay.start, stay.stop + 1) for stay in inside)
        mixed = note_robots(view, resolve_path_topic(view), window, places=True)
        known = placed_times(known_track.track, mixed)
        self.unknown = unknown_times(view, window, known, WHEREABOUTS, mixed=mixed)

    def widened(self, by: Ns) -> Scope:
        """Returns the scope of a window that is longer at either end.

        What is added there is in the place if that end of this window is.
        """
        wider, old = copy(self), self.window
        wider.window = new = old.widened(by)
        if self._inside is not None:
            wider._inside = [
                (new.start if start <= old.start else start, new.stop if stop >= old.stop else stop)
                for start, stop in self._inside
            ]
        return wider

    def settled(self) -> Scope:
        """Returns a scope that tests its conditions now, and not for each question again."""
        settled = copy(self)
        if self._states:
            # A wrong clock makes a window long: between days with poses nothing is asked.
            bounds = self._view.bounds(resolve_path_topic(self._view), self.window)
            days = spans_of(*pieces_of(*bounds, NS_PER_DAY))
            parts = chain.from_iterable(starmap(self.parts_of, days))
            settled._inside, settled._states = [(first, last + 1) for first, last in parts], []
        return settled

    @property
    def compared_frames(self) -> tuple[str, ...]:
        """Notes on the frames in which the conditions compared positions."""
        searches = (state.search for state in self._states)
        notes = (
            compared_frames(self._view, search.topics, search.condition, self.window)
            for search in searches
        )
        return tuple(dict.fromkeys(chain(*notes)))

    @property
    def is_bounded(self) -> bool:
        """Whether there is a place or a condition."""
        return self._inside is not None or bool(self._states)

    def narrowed(self) -> Iterator[TimeWindow]:
        """Yields the parts of the window in which the robot was in the place, newest first.

        Conditions do not narrow them. Without a place this is the whole window.
        """
        if self._inside is None:
            yield self.window
            return
        for start, stop in reversed(self._inside):
            part = self.window.intersect(TimeWindow(start, stop))
            if not part.empty:
                yield part

    def holds_at(self, time: Ns) -> bool:
        """Returns whether a match at a log time counts."""
        if self._inside is not None and not lies_inside(self._inside, time):
            return False
        return all(state.holds_at(time) for state in self._states)

    def holds_until(self, time: Ns, end: Ns) -> Ns:
        """Returns until when (at most `end`) matches count, from a time at which they count."""
        if self._inside is not None:
            nth = bisect_right(self._inside, time, key=itemgetter(1))
            end = min(end, self._inside[nth][1] - 1)
        for state in self._states:
            end = state.holds_until(time, end)
        return end

    def parts_of(self, first: Ns, last: Ns) -> Spans:
        """Returns the parts of a time in which matches count, in order; all ends are inclusive."""
        inside = [(first, last + 1)] if self._inside is None else self._inside
        begin = bisect_right(inside, first, key=itemgetter(1))
        end = bisect_right(inside, last, key=itemgetter(0))
        parts = [(max(first, start), min(last, stop - 1)) for start, stop in inside[begin:end]]
        for state in self._states:
            parts = list(chain.from_iterable(state.parts_of(*part) for part in parts))
        return parts


def counted_stays(view: View, where: Where | None, scope: Scope, path: Span) -> list[Spans]:
    """Returns the parts of each of the robot's stays in a place that lie in a scope, in order.

    They lie on its path, from the first to the last log time. Without a place all of it is one
    stay, but for gaps of the recording that end a stay in a place, too. Stays without such a part
    are left out; all ends are inclusive.

    Raises:
        InvalidArgumentsError, NoDataError, QueryTimeoutError: as `known_track_for` does.
    """
    first, last = path
    window, driven = scope.window, TimeWindow(first, last + 1)
    if where is None:
        gaps = [gap for gap in recording_gaps(view, window) if gap[1] - gap[0] > SILENCE_NS]
        recorded = without([(driven.start, driven.stop)], united(gaps))
        spans = [(start, stop - 1) for start, stop in recorded]
    else:
        track = known_track_for(view, where, window).track
        spans = [stay.span for stay in stays_within(track, where.region, driven)]
    parts_of_stays = (scope.parts_of(*span) for span in spans)
    return [parts for parts in parts_of_stays if parts]


def known_track_for(view: View, where: Where, window: TimeWindow) -> KnownTrack:
    """Returns the robot's track in the frame of a region: its own, or else the map.

    Notes say how far back the track is known, when it is not, and whether the robot was in the
    region if that is taken in the poses' frame.

    Raises:
        InvalidArgumentsError: poses are not in the region's frame, and cannot be placed there.
        NoDataError: no pose is recorded.
        QueryTimeoutError: the call's time runs out before any result.
    """
    known = _track_for(view, where, window)
    note_unplaced(view, known, window)
    return known


def note_unplaced(view: View, known: KnownTrack, window: TimeWindow) -> None:
    """Notes when in a window it is not known where the robot was."""
    unknown = unknown_times(view, window, placed_times(known.track, []), WHEREABOUTS, mixed=[])
    if unknown and known.reaches(window):
        named = [span_text(*span) for span in unknown[-MAX_NAMED:]]
        view.notes.add(f"{WHEREABOUTS} is not known from {listed(named, len(unknown))}")


def _track_for(view: View, where: Where, window: TimeWindow) -> KnownTrack:
    topic = resolve_path_topic(view)
    placement = map_placement(view, topic, where.frame_id)
    known = known_track(view, where.frame_id or placement.frame_id, window)
    if not known.inside(where.region, window):
        advice = f'ask it with frame_id "{placement.pose_frame}"'
        note_other_frame(view, where, placement, window, advice)
    return known


class _ConditionStates:
    """When the newest message of some topics met a condition; of diagnostics, that of any node.

    Messages are tested bag by bag, those around the time that is asked about, by their columns. So
    it is quick to ask about times from the newest to the oldest. Of one long time they are tested
    hour by hour.
    """

    def __init__(self, view: View, during: Sought) -> None:
        self._view = view
        topic, condition = during.topic, condition_of(view, during)
        types = types_matching(view, topic)
        if types == {GOALS}:
            condition = while_active(topic, condition)
        self.search = ReverseSearch(view, topic, condition)
        self._lasting = Lasting(view, self.search.topics)
        self._look_back = _NODE_NS if types & {DIAGNOSTICS, BATTERY} else 0
        # The window that was read, and when in it the condition was met.
        self._read, self._met = TimeWindow(0, 0), Spans()

    def known_in(self, window: TimeWindow) -> Spans:
        """Returns when it is known what the topics said."""
        return known_times(self._view, self.search.topics, window)

    def holds_at(self, time: Ns) -> bool:
        """Returns whether the newest message at a log time met the condition.

        False if there is none, or if what it said may no longer hold.
        """
        start, _ = self._span_from(time, time)
        return start <= time

    def holds_until(self, time: Ns, end: Ns) -> Ns:
        """Returns until when (at most `end`) it holds, from a log time on at which it does."""
        stop = time + 1
        while stop <= end:
            start, later_stop = self._span_from(stop, end)
            if start > stop:
                break
            stop = later_stop
        return min(stop - 1, end)

    def parts_of(self, first: Ns, last: Ns) -> Iterator[Span]:
        """Yields the parts of a time in which the condition holds, in order; ends are inclusive."""
        time = first
        while time <= last:
            start, stop = self._span_from(time, last)
            if start < stop and start <= last:
                until = self.holds_until(max(start, time), last)
                yield max(start, time), until
                stop = until + 1
            time = stop

    def _span_from(self, time: Ns, until: Ns) -> Span:
        """Returns the first known span in which the condition holds at a log time (ns) or later.

        Messages are read up to `until`, for an hour at most. Without such a span among them it is
        empty, at the end of the window that was read.
        """
        if not self._read.contains(time):
            self._read_around(time, until)
        nth = bisect_right(self._met, time, key=itemgetter(1))
        return self._met[nth] if nth < len(self._met) else (self._read.stop, self._read.stop)

    def _read_around(self, time: Ns, until: Ns) -> None:
        topics = self.search.topics
        wanted = TimeWindow(time, max(time + 1, min(until + 1, time + NS_PER_HOUR)))
        spans = self._view.stream.overlapping_bags(topics, wanted)
        start = min([time, *(span.first for span in spans)])
        stop = max([wanted.stop, *(span.last + 1 for span in spans)])
        tested = self._tested(TimeWindow(start - self._look_back, stop))
        if not tested.times.size or tested.times[0] > start:
            before = self._newest_before(start)
            # There is no message between the two: earlier times need no further search.
            start = MIN_NS if before is None else int(before.times[0]) + 1
            tested = tested if before is None else stacked([before, tested])
        self._read = TimeWindow(start, stop)
        self._met = self._spans_of(tested) if tested.times.size else []

    def _newest_before(self, start: Ns) -> Tested | None:
        """Returns the newest message before a log time that says whether the condition is met."""
        earlier = TimeWindow(MIN_NS, start)
        messages = self._view.stream.messages(self.search.topics, earlier, newest_first=True)
        for stored in islice(messages, _MOST_TRIED):
            if (is_met := self.search.matches(stored)) is not None:
                columns = (np.array([number]) for number in (stored.time, is_met, 0, 0))
                return Tested(*columns)
        return None

    def _tested(self, window: TimeWindow) -> Tested:
        """Returns the messages in a window, in order, that say whether the condition is met."""
        # Of messages with one log time those of the last topic are the newest.
        parts = [_NONE_TESTED]
        for nth, topic in enumerate(self.search.topics):
            for block in self.search.blocks(topic, window):
                tested = block.tested()
                parts.append(replace(tested, sources=tested.sources + (nth << 32)))
        tested = stacked(parts)
        order = np.lexsort((tested.sources, tested.times))
        return rows_of(tested, order[tested.met[order] != UNKNOWN])

    def _spans_of(self, tested: Tested) -> Spans:
        """Returns when in what was read the condition was met, by messages in order, one at least.

        What a message says holds until the next one of its node, but for `_NODE_NS` at most if
        other nodes go on.
        """
        times, stop = tested.times, self._read.stop
        by_node = stable_order(tested.nodes)
        is_same = np.diff(tested.nodes[by_node]) == 0
        of_node = np.full(len(times), MAX_NS)
        of_node[by_node[:-1][is_same]] = times[by_node[1:][is_same]]
        soon = TimeWindow(stop, max(stop, int(times[-1]) + SILENCE_NS + 1))
        later = self._view.stream.overlapping_bags(self.search.topics, soon)
        next_time = min((max(span.first, stop) for span in later), default=MAX_NS)
        following = np.append(times[1:], next_time)
        ended = self._lasting.ends(np.append(times, next_time))
        pairs = spans_of(times[ended], following[ended])
        ends = np.array([*(self._lasting.until(*pair)[0] for pair in pairs), MAX_NS - 1])
        stops = np.minimum(of_node, np.maximum(times + _NODE_NS, following)).clip(max=stop)
        stops = np.minimum(stops, ends[np.searchsorted(ends, times)] + 1)
        is_met = (tested.met == MET) & (stops > times)
        return spans_of(*pieces_of(times[is_met], stops[is_met], 0))


def known_times(view: View, topics: Sequence[str], window: TimeWindow) -> Spans:
    """Returns when in a window it is known what topics said.

    What latched and rare topics said lasts through silences; what others said does not.
    """
    around = window.widened(SILENCE_NS)
    is_frequent = overlaps_any(Lasting(view, topics).frequent, around.start, around.stop)
    heard = heard_times(view, topics, around) if is_frequent else []
    return united([*held_times(view, topics, window), *heard])


def heard_times(view: View, topics: Collection[str], window: TimeWindow) -> Spans:
    """Returns when topics had messages, without pauses of more than `SILENCE_NS`.

    Only bags that hold a topic for longer are scanned. In others there is no such silence.
    """
    starts, stops = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for topic in topics:
        firsts, lasts = view.bounds(topic, window)
        is_long = lasts - firsts > SILENCE_NS
        starts.append(firsts[~is_long])
        stops.append(lasts[~is_long])
        if is_long.any():
            long = spans_of(firsts[is_long], lasts[is_long] + 1)
            for rows in scan(view, topic, window, columns=False, within=united(long)):
                piece_starts, piece_stops = pieces_of(rows.times, rows.times)
                starts.append(piece_starts)
                stops.append(piece_stops)
    heard_from, heard_to = pieces_of(np.concatenate(starts), np.concatenate(stops))
    return spans_of(heard_from, heard_to + 1)
