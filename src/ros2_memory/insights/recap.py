"""A recap of a window, from the data alone: a few sentences, each with its time.

The robot stood, things came into view and left it, booleans toggled, errors were reported, and
nothing was recorded. Where there are more events than a planner wants to read, the least important
are left out, and counted.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from dataclasses import replace
from heapq import nsmallest
from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.facts import FLAG, has_events
from ros2_memory.analysis.intervals import IntervalTable, united
from ros2_memory.analysis.motion.standstills import SHORTEST_NS, Standstill
from ros2_memory.analysis.topic_events import Change, Report, TopicEvents, joined_events
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.text import Quoted, counted, listed, repeating
from ros2_memory.core.timebase import Ns, unix_from_ns
from ros2_memory.history.clock_steps import clock_steps
from ros2_memory.history.coverage import (
    deleted_between,
    note_edges,
    note_unread,
    note_unrecorded,
    recording_gaps,
)
from ros2_memory.history.driven_path import length_notes
from ros2_memory.history.no_data import seconds
from ros2_memory.history.view import TimeRange, View, open_span
from ros2_memory.insights.changes_before import (
    SLACK_NS,
    ChangesBefore,
    before,
    changes_in,
    is_routine,
)
from ros2_memory.insights.drive import Drive, drive_in
from ros2_memory.insights.goals import FAILURES, GoalRun, goals_in
from ros2_memory.insights.silences import grouped, silences_in, unrecorded_times
from ros2_memory.insights.topic_events import events_in, note_limits, toggled
from ros2_memory.messages.levels import FOXGLOVE_LOGS
from ros2_memory.places.driven_inside import totals_inside
from ros2_memory.places.pose_frames import RobotPlaces, robot_places
from ros2_memory.places.where import parse_where, times_in_region
from ros2_memory.results import Before, Event, PastChange, Recap

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from ros2_memory.analysis.clock_steps import Elapsed
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.places.robot_tracks import Inside

MOST_EVENTS: Final = 25

_MOST_CHANGES: Final = 3
"""Changes that are listed before an event, the nearest."""
_MOST_CHARS: Final = 1_200
"""Characters of changes before all events of a recap: a recap with `around` has them all."""
_CHANGE_CHARS: Final = 30
"""What the reply adds to a change's text."""

_PLURALS: Final = {
    "gap": "gaps",
    "clock step": "clock steps",
    "silence": "silences",
    "error": "errors",
    "failed goal": "failed goals",
    "stop": "stops",
    "flip": "on/off changes",
    "drop": "speed drops",
    "goal": "goals",
    "thing": "sightings",
}
"""The kinds of events, the most important first, and the words for several of each."""
_KINDS: Final = tuple(_PLURALS)
_OF_ROBOT: Final = frozenset({"error", "stop", "flip", "drop"})
"""The kinds of which matters in which place the robot was."""


def recap_or_before(
    memory: Memory,
    call: Call,
    span: TimeRange,
    *,
    where: JsonValue = None,
    frame_id: str | None = None,
    min_score: float | None = None,
) -> Recap | Before:
    """Returns what happened in a window, or what changed before a moment; see both.

    Raises:
        InvalidArgumentsError: the window and the moment are given in more than one form, or the
            moment with `where`.
    """
    is_bounded = span.start_s is not None or span.end_s is not None
    if is_bounded + (span.last_s is not None) + (span.around_s is not None) > 1:
        raise InvalidArgumentsError("last_s, around, or start and end: give one of the three")
    if span.around_s is None:
        return recap(memory, call, span, where=where, frame_id=frame_id, min_score=min_score)
    if where is not None:
        raise InvalidArgumentsError("where cannot be combined with around")
    return before(memory, call, span.around_s, span.before_s, frame_id)


def recap(
    memory: Memory,
    call: Call,
    span: TimeRange,
    *,
    where: JsonValue = None,
    frame_id: str | None = None,
    min_score: float | None = None,
    most_events: int = MOST_EVENTS,
    with_changes: bool = True,
) -> Recap:
    """Returns what happened in a window; with `where` only while the robot was in that region.

    Places are in the map where transforms lead there at their time, or in `frame_id`. Things in
    view count where their best score is `min_score` or more, or where they have none. Of more than
    `most_events` the most important are returned, `with_changes` with what changed before them.

    Raises:
        InvalidArgumentsError: the bounds are missing, reversed, not finite or of no length, `where`
            is no region, or no position is given in `frame_id`.
        NoDataError: nothing is recorded.
        QueryTimeoutError: the call's time is over.
    """
    region = None if where is None else parse_where(memory.limits, where)
    view, window = open_span(memory, call, span)
    note_unrecorded(view, window)
    start, end = window.asked()
    places = robot_places(view, window, frame_id)
    drive = drive_in(view, window)
    elapsed = drive.elapsed
    there = None if region is None else _There(times_in_region(view, region, window), elapsed)
    found = found_events(view, window)
    least = memory.limits.min_score if min_score is None else min_score
    reported, things, throughout = _topic_events(
        view, window, found, there, min_score=least, most=most_events
    )
    stops = drive.stops(end - start)
    if there is not None:
        stops = tuple(each for each in stops if there.overlaps(each[0].start, each[0].end))
    longest = nsmallest(most_events, stops, key=lambda each: each[0].start - each[0].end)
    events = [*_stops(longest, places), *reported, *_of_recording(view, window, drive)]
    events += [_goal(each, start, elapsed) for each in goals_in(view, window, found)]
    if there is not None:
        events = [each for each in events if there.has(each)]
    note_unread(view, window)
    note_edges(view, window)
    _note_foxglove_logs(view, window)
    counts = Counter(each.kind for each in events)
    counts |= Counter(thing=things, stop=len(stops))
    shown = _most_important(view, events, counts, most_events)
    if with_changes:
        shown = _with_changes(changes_in(view, window, found), shown)
    shown = [
        replace(each, skipped=elapsed.skipped_between(each.start, each.end or each.start))
        for each in shown
    ]
    if places is not None:
        shown = [
            replace(each, places=places.names_at(_when(each, places)))
            if each.kind in _OF_ROBOT
            else each
            for each in shown
        ]
    stood = drive.stood(end - start)
    if stood is None and drive.known is not None:
        view.notes.add(
            "the positions are too noisy, or too few, to detect standstills: stood_s is null"
        )
    answer = Recap(
        start=start,
        end=end,
        now=memory.now(memory.clock.now(), view.snapshot.latest, view.call),
        distance_m=None,
        max_speed=None,
        stood=stood,
        shortest_stop=SHORTEST_NS,
        frame_id=None if drive.path is None or places is None else places.frame_id,
        events=tuple(shown),
        throughout=tuple(sorted(throughout)),
        counts=tuple((_PLURALS[kind], counts[kind]) for kind in _KINDS if counts[kind]),
        skipped=elapsed.skipped_between(start, end),
    )
    if there is None or region is None:
        answer = _with_way(view, answer, drive)
    else:
        answer = replace(_with_way_there(answer, drive, there), where=region.shown)
    view.notes.retract_outside(window)
    return replace(answer, notes=view.notes.sentences())


def _note_foxglove_logs(view: View, window: TimeWindow) -> None:
    """Notes the logs whose errors are no events: those that ROS writes alone are read for them."""
    timeline = view.timeline
    for topic in timeline.topics():
        types = timeline.types_of(topic)
        if FOXGLOVE_LOGS.isdisjoint(types):
            continue
        here = FOXGLOVE_LOGS & {
            held.type
            for each in timeline.extents(topic, window)
            for held in each.bag.summary.of(topic)
        }
        if here:
            # Where the topic has two types, its levels have no names; no log of ROS has a 4.
            asks = '"above", field "level", value "WARN"'
            asks = asks if len(types) == 1 else '"equals", field "level", value 4'
            view.notes.add(
                f"errors in {topic} are not among the events, since it is of {min(here)}: "
                f"find_matches with condition_type {asks} lists them"
            )


class _There:
    """The times at which the robot was in a region, in order."""

    def __init__(self, spans: Sequence[Inside], elapsed: Elapsed) -> None:
        self.spans = spans
        self._elapsed = elapsed

    def overlaps(self, start: Ns, end: Ns | None = None) -> bool:
        """Returns whether some of a time, or a moment, is among them."""
        last = start if end is None else end
        return any(each.start <= last and start <= each.stop for each in self.spans)

    def has(self, event: Event) -> bool:
        """Returns whether an event happened then; how long a boolean held is of no matter."""
        if event.kind == "gap":
            return False
        return self.overlaps(event.start, None if event.kind == "flip" else event.end)

    def covers(self, start: Ns, end: Ns) -> bool:
        """Returns whether a time is in one of them as a whole, or in none at all."""
        inside = any(each.start <= start and end <= each.stop for each in self.spans)
        return inside or not self.overlaps(start, end)

    def length_of(self, standstills: Iterable[tuple[Standstill, bool]]) -> Ns:
        """Returns how long the robot stood in them."""
        return sum(
            self._elapsed.between(max(stood.start, each.start), min(stood.end, each.stop))
            for stood, _ in standstills
            for each in self.spans
            if stood.start < each.stop and each.start < stood.end
        )


def _with_way(view: View, answer: Recap, drive: Drive) -> Recap:
    view.notes.add(*() if drive.trajectory is None else length_notes(drive.trajectory))
    known = drive.known
    if known is None:
        return answer
    return replace(
        answer,
        distance_m=known.totals.distance_m,
        max_speed=known.max_speed,
        path_sum_m=known.totals.path_sum_m if known.is_noisy else None,
        gap_m=known.totals.gap_m if known.totals.gaps else None,
    )


def _with_way_there(answer: Recap, drive: Drive, there: _There) -> Recap:
    """Returns a recap with the path in a region, and how often and how long the robot was there."""
    way = drive.path
    driven = None if way is None or not way.poses else totals_inside(way.line, there.spans)
    return replace(
        answer,
        distance_m=None if driven is None else driven.distance_m,
        max_speed=None if driven is None else driven.max_speed,
        stood=None if answer.stood is None else there.length_of(drive.standstills),
        visits=len(there.spans),
        inside=drive.elapsed.among((each.start, each.stop) for each in there.spans),
    )


def _when(event: Event, places: RobotPlaces) -> Ns:
    """Returns at which log time (ns) to place an event."""
    stood = event.kind == "stop" and event.end is not None
    return places.within(event.start, event.end or 0) if stood else event.start


def found_events(
    view: View, window: TimeWindow, can_have: Callable[[str], bool] = has_events
) -> dict[str, TopicEvents | None]:
    """Returns the events of each topic whose type can have them; None where it has no message."""
    timeline = view.timeline
    return {
        topic: events_in(view, topic, window)
        for topic in timeline.topics()
        if any(map(can_have, timeline.types_of(topic)))
    }


def _topic_events(
    view: View,
    window: TimeWindow,
    found_of: Mapping[str, TopicEvents | None],
    there: _There | None,
    *,
    min_score: float,
    most: int,
) -> tuple[list[Event], int, set[str]]:
    """Returns events that messages report, the number of things seen, and those seen throughout.

    Of things that came or went, only the `most` that were seen longest are among the events.
    """
    start, end = window.asked()
    newest = view.snapshot.latest
    known_to = window.stop if newest is None else min(window.stop, newest)
    events: list[Event] = []
    visible: list[IntervalTable] = []
    throughout: set[str] = set()
    last_seen: dict[str, Ns] = {}
    below = 0
    for topic, found in found_of.items():
        if found is None:
            continue
        seen = found.visible.scoring(min_score) if min_score else found.visible
        below += found.visible.size - seen.size
        _, toggles = found.of_kind(FLAG)
        if toggles:
            ends = [begin for begin, _ in unrecorded_times(view, topic, TimeWindow(start, end))]
            events += _flips(topic, toggles, ends)
        events += map(_error, _errors(view, topic, found, there))
        visible.append(seen)
        throughout.update(seen.throughout(start, end))
        for label in seen.at_end(found.last, known_to):
            last_seen[label] = max(found.last, last_seen.get(label, found.last))
        note_limits(view, topic, found)
    if below:
        sights = counted(below, "sighting", "sightings")
        view.notes.add(f"{sights} left out: no score in it reaches min_score {min_score:g}")
    things = united(visible)
    if there is None:
        things = things.without(throughout)
    else:
        throughout = set()
        things = things.during([(each.start, each.stop) for each in there.spans])
    events += [
        Event(
            "thing",
            each.first,
            each.last,
            repeating(f"{each.label} in view", [each.label]),
            goes_on=each.last == last_seen.get(each.label),
            score=each.best,
        )
        for each in things.longest(most)
    ]
    return events, things.size, throughout


def _of_recording(view: View, window: TimeWindow, drive: Drive) -> Iterator[Event]:
    """Yields losses of speed, and when nothing was recorded, clocks were set or topics silent."""
    for time, before_mps, after_mps in drive.drops:
        text = f"slowed down suddenly from {before_mps:.2f} to {after_mps:.2f} m/s"
        yield Event("drop", time, None, text)
    for begin, until in recording_gaps(view, TimeWindow(*window.asked())):
        yield Event("gap", begin, until, _why_nothing(view, begin, until))
    for at, by in clock_steps(view, window):
        how = f"forward by {seconds(by)}" if by > 0 else f"back by {seconds(-by)} or more"
        yield Event("clock step", at, None, f"the clock was set {how}")
    for group in grouped(silences_in(view, window)):
        topics, first = listed([each.topic for each in group]), group[0]
        text = f"{topics} {'was' if len(group) == 1 else 'were'} silent"
        yield Event("silence", first.start, first.end, text, goes_on=first.goes_on)


def _why_nothing(view: View, begin: Ns, until: Ns) -> str:
    spans = deleted_between(view, TimeWindow(begin, until))
    deleted = unix_from_ns(sum(stop - start for start, stop in spans))
    if not deleted:
        return "nothing was recorded"
    whole = unix_from_ns(until - begin)
    return f"nothing is here: {deleted:.1f} of {whole:.1f} s were deleted"


def _stops(stops: Iterable[tuple[Standstill, bool]], places: RobotPlaces | None) -> Iterator[Event]:
    for (start, end, box), goes_on in stops:
        (x, y, _), frame = box.centre, ""
        point: tuple[float, float] | None = (x, y)
        if places is not None and places.frame_id != places.pose_frame:
            point = places.at(places.within(start, end))
            x, y = point or (x, y)
            frame = "" if point else f" in {places.pose_frame}"
        # z: a rounded -0.00 reads as 0.00.
        text = f"stood at x {x:z.2f}, y {y:z.2f}{frame}"
        yield Event("stop", start, end, text, goes_on, point=point)


def _errors(view: View, topic: str, found: TopicEvents, there: _There | None) -> tuple[Report, ...]:
    """Returns the errors of a window; in a region only their reports there count."""
    if there is None or all(there.covers(each.first, each.last) for each in found.errors):
        return found.errors
    parts = [events_in(view, topic, TimeWindow(each.start, each.stop + 1)) for each in there.spans]
    inside = joined_events([part for part in parts if part is not None])
    return () if inside is None else inside.errors


def _goal(goal: GoalRun, start: Ns, elapsed: Elapsed) -> Event:
    """Returns a goal from when it was accepted; one from before the window, from when it ended."""
    kind = "failed goal" if goal.outcome in FAILURES else "goal"
    if goal.accepted is None:
        state = "last heard of" if goal.is_lost else goal.outcome or "active"
        at = goal.last if goal.is_lost or goal.ended is not None else start
        goes_on = goal.ended is None and not goal.is_lost
        return Event(
            kind, at, None, f"{goal.action} goal {state}, accepted before", goes_on=goes_on
        )
    if goal.is_lost:
        after = f"after {seconds(elapsed.between(goal.accepted, goal.last))}"
        text = f"{goal.action} goal last heard of {after}, and listed no more by its server"
        return Event(kind, goal.accepted, goal.last, text)
    if goal.ended is None:
        return Event(kind, goal.accepted, None, f"{goal.action} goal accepted", goes_on=True)
    after = f"after {seconds(elapsed.between(goal.accepted, goal.ended))}"
    return Event(kind, goal.accepted, goal.ended, f"{goal.action} goal {goal.outcome} {after}")


def _flips(topic: str, toggles: Sequence[Change], ends: Sequence[Ns]) -> Iterator[Event]:
    """Yields each toggle with how long its value held: until the next, or beyond the window.

    Or as long as it was recorded: `ends` are the times at which the topic ceased to be, in order.
    """
    until: dict[str, Ns] = {}
    for toggle in reversed(toggles):
        text = toggled(topic, toggle)
        end = until.get(toggle.name)
        ceased = bisect_left(ends, toggle.time)
        if ceased < len(ends) and (end is None or ends[ceased] < end):
            end = ends[ceased]
        yield Event("flip", toggle.time, end, text, goes_on=end is None)
        until[toggle.name] = toggle.time


def _error(error: Report) -> Event:
    again = f" ({error.reports} times)" if error.reports > 1 else ""
    end = error.last if error.reports > 1 else None
    return Event("error", error.first, end, Quoted(f"error: {error.text}{again}"))


def _with_changes(changes: ChangesBefore, events: Sequence[Event]) -> list[Event]:
    """Returns the events, and with each stop, speed drop and toggle what changed before."""
    found: dict[Event, tuple[PastChange, ...]] = {}
    for each in events:
        if each.kind in {"stop", "drop"}:
            found[each] = changes.before(each.start, slack=SLACK_NS)
        elif each.kind == "flip":
            found[each] = changes.before(each.start, without=each.text.rpartition(" ")[0])
    shown = dict.fromkeys(found, 0)
    left = _MOST_CHARS
    # What a goal that was meant begins or ends with matters least.
    routine = {each: all(map(is_routine, found[each])) for each in found}
    ranks = [(is_last, nth) for is_last in (False, True) for nth in range(_MOST_CHANGES)]
    for is_last, nth in ranks:
        for each, past in found.items():
            if routine[each] is is_last and len(past) > nth == shown[each]:
                size = len(past[nth].text) + _CHANGE_CHARS
                if size <= left:
                    left -= size
                    shown[each] += 1
    return [
        replace(each, before=found[each][: shown[each]]) if each in found else each
        for each in events
    ]


def _most_important(
    view: View, events: Sequence[Event], counts: Counter[str], most: int
) -> list[Event]:
    """Returns at most `most`, in order of time: of a kind those that lasted longest.

    `counts` has how many there are of each kind, also of those that are not among `events`.
    """
    ranked = sorted(
        events,
        key=lambda each: (
            _KINDS.index(each.kind),
            0 if each.end is None else each.start - each.end,
        ),
    )
    shown = ranked[:most]
    left_out = counts - Counter(each.kind for each in shown)
    if left_out:
        named = ", ".join(
            counted(left_out[kind], kind if kind != "thing" else "sight of a thing", _PLURALS[kind])
            for kind in _KINDS
            if left_out[kind]
        )
        view.notes.add(f"left out, because there are too many: {named}; ask for a shorter time")
    return sorted(shown, key=lambda each: (each.start, _KINDS.index(each.kind)))
