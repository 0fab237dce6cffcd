"""A recap of a window, from the data alone: a few sentences, each with its time.

The robot stood, things came into view and left it, booleans toggled, errors were reported, and
nothing was recorded. If there are more events than a planner wants to read, the least important are
left out, and counted.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter, defaultdict
from dataclasses import replace
from heapq import nsmallest
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.analysis.facts import CHARGE, FLAG, LOW_CHARGES, battery_of, charge_of, has_events
from ros2_memory.analysis.goals import FAILURES
from ros2_memory.analysis.intervals import (
    SILENCE_NS,
    IntervalTable,
    VisibleInterval,
    united_tables,
)
from ros2_memory.analysis.motion.trajectory import length_notes
from ros2_memory.analysis.silences import length_in
from ros2_memory.analysis.topic_events import Change, KnownState, Report, TopicEvents, joined_events
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.spans import overlaps_any
from ros2_memory.core.spans import united as united_spans
from ros2_memory.core.text import Quoted, counted, listed, repeating
from ros2_memory.core.timebase import MAX_NS, NS_PER_HOUR, Ns, unix_from_ns
from ros2_memory.history.clock_steps import clock_steps
from ros2_memory.history.coverage import (
    deleted_between,
    is_missed,
    note_edges,
    note_unread,
    note_unrecorded,
    recording_gaps,
    seconds,
    shown_span,
    unexcluded,
)
from ros2_memory.history.lasting import breaks_of, deletions, is_latched
from ros2_memory.history.robots import parallel_or_twice
from ros2_memory.history.view import TimeRange, View, open_span
from ros2_memory.insights.changes_before import (
    SLACK_NS,
    ChangesBefore,
    changes_in,
    firsts_of_runs,
    is_first_of_run,
    recap_before,
)
from ros2_memory.insights.drive import Drive, drive_in
from ros2_memory.insights.silences import group_silences, silences_in, unrecorded_times
from ros2_memory.insights.topic_events import (
    GoalRun,
    events_in,
    flags_before,
    goals_in,
    note_foxglove_logs,
    note_limits,
    toggle_sentence,
    toggled_together,
)
from ros2_memory.places.driven_inside import totals_inside
from ros2_memory.places.pose_frames import RobotPlaces, robot_places
from ros2_memory.places.where import heard_times, known_track_for, parse_where
from ros2_memory.results import Before, Event, PastChange, Recap
from ros2_memory.things.labels import Labels

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence

    from ros2_memory.analysis.clock_steps import Elapsed
    from ros2_memory.analysis.motion.standstills import Standstill
    from ros2_memory.core.spans import Spans
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.places.stays import Stay

MOST_EVENTS: Final = 25

_MOST_CHANGES: Final = 3
"""The nearest changes before an event that a recap lists."""
_MOST_CHARS: Final = 1_200
"""Characters of all changes in a recap. With `around` it has all of them."""
_LOW_CHARGE: Final = 0.1
"""The fraction of a full battery below which a recap reports it, one of `LOW_CHARGES`."""
_CHANGE_CHARS: Final = 30
"""Characters that the reply adds to a change's text."""

_PLURALS: Final = {
    "gap": "gaps",
    "clock step": "clock steps",
    "silence": "silences",
    "error": "errors",
    "failed goal": "failed goals",
    "low battery": "low batteries",
    "stop": "stops",
    "flip": "on/off changes",
    "drop": "speed drops",
    "goal": "goals",
    "thing": "sightings",
}
"""The kinds of events, the most important first, and the words for several of each."""
_MOST_RARE: Final = 3
"""So many things that were seen once in a long record are listed."""
_LONG_RECORD_NS: Final = 48 * NS_PER_HOUR
_KINDS: Final = tuple(_PLURALS)
_OF_ROBOT: Final = frozenset({"error", "stop", "flip", "drop"})
"""The kinds of events that name the place where the robot was."""
_OF_ANY_DAY: Final = _KINDS.index("stop")
"""The kinds from this one on happen on any day."""


def recap_or_before(
    memory: Memory,
    call: Call,
    span: TimeRange,
    *,
    where: JsonValue = None,
    frame_id: str | None = None,
    min_score: float | None = None,
) -> Recap | Before:
    """Returns what happened in a window, or what changed before a moment.

    See `recap` and `recap_before`.

    Raises:
        InvalidArgumentsError: the window and the moment are given in more than one form, or the
            moment with `where`.
    """
    is_bounded = span.start_s is not None or span.end_s is not None
    forms = [is_bounded, span.last_s is not None, span.around_s is not None]
    if forms.count(True) > 1:
        raise InvalidArgumentsError("last_s, around, or start and end: give one of the three")
    if span.around_s is None:
        return recap(memory, call, span, where=where, frame_id=frame_id, min_score=min_score)
    if where is not None:
        raise InvalidArgumentsError("where cannot be combined with around")
    return recap_before(memory, call, span.around_s, span.before_s, frame_id)


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
    with_sights: bool = True,
    each_sight: bool = False,
) -> Recap:
    """Returns what happened in a window; with `where` only while the robot was in that region.

    Places are in the map if transforms lead there at their time, or in `frame_id`. Things in view
    count with a best score of `min_score` or more, or without scores. If there are more than
    `most_events`, the most important ones are returned. With `with_changes` they have what changed
    before them. Without `with_sights` things in view are no events, but counted all the same. Where
    there are many sights, each label has one event, unless `each_sight` is to be drawn.

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
    region_stays = None
    if region is not None:
        stays = known_track_for(view, region, window).inside(region.region, window)
        region_stays = _RegionStays(stays, drive.elapsed)
    topics = events_by_topic(view, window)
    happened = _what_happened(
        view,
        window,
        topics,
        region_stays,
        drive=drive,
        places=places,
        min_score=memory.limits.min_score if min_score is None else min_score,
        most=most_events,
        each_sight=each_sight,
    )
    note_unread(view, window)
    note_edges(view, window)
    note_foxglove_logs(view, window)
    shown = _shown_events(view, happened, drive, places, most=most_events, with_sights=with_sights)
    if with_changes:
        shown = _with_changes(changes_in(view, window, topics), shown)
    counts = happened.counts
    answer = Recap(
        start=start,
        end=end,
        now=memory.now(view.snapshot.latest, view.call),
        distance_m=None,
        max_speed=None,
        stood=_standing_time(view, drive),
        frame_id=None if drive.path is None or places is None else places.frame_id,
        events=tuple(shown),
        throughout=tuple(sorted(happened.throughout)),
        counts=tuple((name, counts[kind]) for kind, name in _PLURALS.items() if counts[kind]),
        longest_sights=tuple(happened.longest_sights),
        skipped=drive.elapsed.skipped_between(start, end),
    )
    if region_stays is None or region is None:
        answer = _with_path(view, answer, drive)
    else:
        answer = replace(_with_path_in_region(answer, drive, region_stays), where=region.shown)
    view.notes.retract_outside(window)
    return replace(answer, notes=view.notes.sentences())


class _Happened(NamedTuple):
    """What happened in a window.

    Attributes:
        events: the events, but for short stops and sightings of which there are more than enough.
        rare: those among them that happened once in a long record.
        counts: by kind, how many there were.
        throughout: the labels that were in view all the time.
        longest_sights: the longest sight of each other label, in order of time.
    """

    events: Sequence[Event]
    rare: Collection[Event]
    counts: Counter[str]
    throughout: Collection[str]
    longest_sights: Sequence[Event]


def _what_happened(
    view: View,
    window: TimeWindow,
    topics: Mapping[str, TopicEvents],
    region_stays: _RegionStays | None,
    *,
    drive: Drive,
    places: RobotPlaces | None,
    min_score: float,
    most: int,
    each_sight: bool,
) -> _Happened:
    """Returns what happened in a window, with at most `most` stops and sightings."""
    start, _ = window.asked()
    things = _things_in_view(
        view,
        window,
        topics,
        region_stays,
        min_score=min_score,
        most=most,
        each_sight=each_sight,
    )
    stops = drive.stops
    if region_stays is not None:
        stops = [stop for stop in stops if region_stays.overlaps(*stop.span)]
    goals = goals_in(view, window, topics)
    events = [
        *_stop_events(nsmallest(most, stops, key=lambda stop: -stop.length), places),
        *_reported_events(view, window, topics, region_stays),
        *things.events,
        *_recording_events(view, window, drive),
        *(_goal_event(goal, start, drive.elapsed) for goal in goals),
    ]
    if region_stays is not None:
        events = [event for event in events if region_stays.contains(event)]
    counts = Counter(event.kind for event in events)
    counts["thing"], counts["stop"] = things.total, len(stops)
    return _Happened(events, things.rare, counts, things.throughout, things.longest_of_each)


def _shown_events(
    view: View,
    happened: _Happened,
    drive: Drive,
    places: RobotPlaces | None,
    *,
    most: int,
    with_sights: bool,
) -> list[Event]:
    """Returns the most important events, in order of time, with the places where the robot was."""
    counts = happened.counts
    kinds = [kind for kind in counts if with_sights or kind != "thing"]
    events = [event for event in happened.events if event.kind in kinds]
    counted_kinds = Counter({kind: counts[kind] for kind in kinds})
    shown = _most_important(view, events, counted_kinds, most, happened.rare)
    return [
        replace(
            event,
            places=_place_names(event, places),
            skipped=drive.elapsed.skipped_between(event.start, event.end or event.start),
        )
        for event in shown
    ]


def _standing_time(view: View, drive: Drive) -> Ns | None:
    """Returns how long the robot stood (ns); if that is unknown, a note says so."""
    stood = drive.stood
    if stood is None and drive.valid_trajectory is not None:
        view.notes.add(
            "positions are too noisy, too few or missing for too long to detect standstills: "
            "stood_s is null"
        )
    return stood


class _RegionStays:
    """The stays of robots in a region.

    Attributes:
        times: the times of all stays together (half-open), in order.
    """

    def __init__(self, stays: Sequence[Stay], elapsed: Elapsed) -> None:
        self.stays = stays
        self.times = united_spans((stay.start, stay.stop + 1) for stay in stays)
        self._elapsed = elapsed

    def overlaps(self, start: Ns, end: Ns | None = None) -> bool:
        """Returns whether a stay overlaps a time (inclusive), or a moment."""
        last = start if end is None else end
        return overlaps_any(self.times, start, last)

    def contains(self, event: Event) -> bool:
        """Returns whether an event happened during a stay. A boolean toggles at one moment."""
        end = None if event.kind == "flip" else event.end
        return event.kind != "gap" and self.overlaps(event.start, end)

    def is_cut_by(self, start: Ns, end: Ns) -> bool:
        """Returns whether one part of a time (inclusive) is in the stays, and another is not."""
        is_inside = any(stay.start <= start and end <= stay.stop for stay in self.stays)
        return not is_inside and self.overlaps(start, end)

    def standing_time(self, stops: Iterable[Standstill]) -> Ns:
        """Returns how long (ns) the robot stood during the stays."""
        spans: Spans = []
        for stop in stops:
            start, end = stop.span
            spans += [
                (max(start, stay.start), min(end, stay.stop))
                for stay in self.stays
                if start < stay.stop and stay.start < end
            ]
        return self._elapsed.among(spans)


def _with_path(view: View, answer: Recap, drive: Drive) -> Recap:
    """Returns a recap with the length and the greatest speed of the path."""
    if drive.trajectory is not None:
        view.notes.add(*length_notes(drive.trajectory))
    trajectory = drive.valid_trajectory
    if trajectory is None:
        return answer
    return replace(
        answer,
        distance_m=trajectory.totals.distance_m,
        max_speed=trajectory.max_speed,
        path_sum_m=trajectory.totals.path_sum_m if trajectory.is_noisy else None,
        gap_m=trajectory.gap_m,
    )


def _with_path_in_region(answer: Recap, drive: Drive, region_stays: _RegionStays) -> Recap:
    """Returns a recap with the path in a region, and how often and how long the robot was there."""
    path, driven, stays = drive.path, None, region_stays.stays
    if path is not None and path.poses:
        driven = totals_inside(path.line, [stay.span for stay in stays])
    return replace(
        answer,
        distance_m=None if driven is None else driven.distance_m,
        max_speed=None if driven is None else driven.max_speed,
        stood=None if answer.stood is None else region_stays.standing_time(drive.standstills),
        visits=len(stays),
        inside=drive.elapsed.among(stay.span for stay in stays),
    )


def _place_names(event: Event, places: RobotPlaces | None) -> tuple[str, ...]:
    """Returns the names of the places where the robot was at an event, if its kind names them."""
    if places is None or event.kind not in _OF_ROBOT:
        return ()
    at = event.start
    if event.kind == "stop" and event.end is not None:
        at = places.standstill_time(event.start, event.end)
    return places.names_at(at)


def events_by_topic(
    view: View, window: TimeWindow, can_have: Callable[[str], bool] = has_events
) -> dict[str, TopicEvents]:
    """Returns the events of each topic that can have them, by its types."""
    timeline = view.timeline
    return {
        topic: events_in(view, topic, window)
        for topic in timeline.topics()
        if any(map(can_have, timeline.types_of(topic)))
    }


def _reported_events(
    view: View,
    window: TimeWindow,
    events_of_topics: Mapping[str, TopicEvents],
    region_stays: _RegionStays | None,
) -> list[Event]:
    """Returns the toggles and errors that messages report. Notes say how many are left out."""
    events: list[Event] = []
    for topic, topic_events in events_of_topics.items():
        toggles = _toggles(view, topic, topic_events)
        if toggles:
            mixed = _mixed_times(view, topic, window)
            toggles = [one for one in toggles if not any(at.contains(one.time) for at in mixed)]
            # What is received as the recorder begins became so before.
            is_held = is_latched(view, topic)
            firsts = firsts_of_runs(view, topic, window) if is_held else frozenset()
            begun = _true_since_first_message(view, topic, topic_events)
            ends = sorted([*_ends_of_holding(view, topic, window), *(at.start for at in mixed)])
            flips = _flip_events(topic, toggles, ends, begun)
            events += (flip for flip in flips if flip.start not in firsts)
        errors = _errors_in_region(view, topic, topic_events, region_stays)
        events += [_error_event(error) for error in errors]
        events += _low_charge_events(view, topic, topic_events)
        note_limits(view, topic, topic_events)
    return events


def _mixed_times(view: View, topic: str, window: TimeWindow) -> list[TimeWindow]:
    """Returns when messages of two times, or robots, alternate on a topic; a note names each.

    The next message after that may say something else, which is no change, either.
    """
    mixed = []
    for pair in parallel_or_twice(view, topic, window):
        how = pair.describe_by_clock(topic)
        view.notes.add(f"{how}: no on/off changes of {topic} are listed there")
        mixed.append(replace(pair.span, stop=min(pair.span.stop, MAX_NS - SILENCE_NS) + SILENCE_NS))
    return mixed


def _ends_of_holding(view: View, topic: str, window: TimeWindow) -> list[Ns]:
    """Returns the moments, in order, after which a boolean of a topic is not known to hold."""
    if is_latched(view, topic):
        return breaks_of(view, topic)  # it holds through gaps
    if view.timeline.is_on_events(topic):  # there are no messages between goals
        return [stop - 1 for _, stop in heard_times(view, [topic], window)]
    unrecorded = unrecorded_times(view, topic, TimeWindow(*window.asked()))
    return [begin for begin, _ in unrecorded]


def _toggles(view: View, topic: str, events: TopicEvents) -> list[Change]:
    """Returns when booleans of a topic toggled, also from before a window to its first message."""
    flags, toggles = events.of_kind(FLAG)
    before = flags_before(view, topic, events.first) if flags else {}
    first = [
        Change(FLAG, flag.name, flag.at, flag.first)
        for flag in flags
        if flag.name in before and before[flag.name] != bool(flag.first)
    ]
    return [*first, *toggles]


def _true_since_first_message(view: View, topic: str, events: TopicEvents) -> dict[str, Ns]:
    """Returns since when booleans are true of which the first message of a recording says so.

    Empty if that is as the recording begins: they may have been true for long.
    """
    flags, _ = events.of_kind(FLAG)
    begun = {flag.name: flag.at for flag in flags if flag.first and flag.at == events.first}
    if not begun or not is_first_of_run(view, topic, events.first) or deletions(view, topic):
        return {}
    return begun


class _ThingsInView(NamedTuple):
    """Things that came into view or left it.

    Attributes:
        events: the things that were seen.
        rare: those among them that were seen once in a long record.
        total: how many there are.
        throughout: the labels that were seen throughout the window.
        longest_of_each: the longest sight of each other label, in order of time.
    """

    events: list[Event]
    rare: list[Event]
    total: int
    throughout: set[str]
    longest_of_each: list[Event]


def _things_in_view(
    view: View,
    window: TimeWindow,
    events_of_topics: Mapping[str, TopicEvents],
    region_stays: _RegionStays | None,
    *,
    min_score: float,
    most: int,
    each_sight: bool,
) -> _ThingsInView:
    """Returns the things that were seen, with events of at most `most`, and of as many labels.

    Of more sights than that, or in a long record, each label has one event, unless `each_sight`. In
    a region nothing counts as seen throughout. A note says how many scores are too low.
    """
    start, end = window.asked()
    newest = view.snapshot.latest
    known_to = window.stop if newest is None else min(window.stop, newest)
    tables: list[IntervalTable] = []
    throughout: set[str] = set()
    last_seen: dict[str, Ns] = {}
    below = 0
    every = united_tables([events.visible for events in events_of_topics.values()])
    label_of = Labels(view.limits.labels).one_spelling(every.messages())
    for topic_events in events_of_topics.values():
        visible = topic_events.visible.relabelled(label_of)
        below += visible.size
        visible = visible.scoring(min_score) if min_score else visible
        below -= visible.size
        tables.append(visible)
        throughout.update(visible.throughout(start, end))
        for label in visible.at_end(topic_events.last, known_to):
            last_seen[label] = max(topic_events.last, last_seen.get(label, topic_events.last))
    if below:
        view.notes.add(
            f"{counted(below, 'sighting')} left out: no score in it reaches min_score {min_score:g}"
        )
    things = united_tables(tables)
    if region_stays is None:
        things = things.without(throughout)
    else:
        throughout = set()
        things = things.during([stay.span for stay in region_stays.stays])
    longest_of_each = things.longest_of_each().most_lasting(most).intervals()
    is_long = region_stays is None and _recorded_for(view, window) >= _LONG_RECORD_NS
    of_labels = things.of_each_label()
    if each_sight or not (is_long or things.size > most):
        events = [_sight_event(last_seen, interval) for interval in things.longest(most)]
    else:
        events = [_sight_event(last_seen, *of_label) for of_label in of_labels]
    brief = {
        one.label for one, _, length in of_labels if length and one.last - one.first <= NS_PER_HOUR
    }
    once = [event for event in events if is_long and event.label in brief]
    return _ThingsInView(
        events,
        nsmallest(_MOST_RARE, once, key=lambda event: -event.length),
        things.size,
        throughout,
        [_sight_event(last_seen, interval) for interval in longest_of_each],
    )


def _recorded_for(view: View, window: TimeWindow) -> Ns:
    """Returns for how long (ns) something was recorded in a window."""
    first, last = shown_span(view.snapshot, window)
    return last - first - length_in([*recording_gaps(view, window)], first, last)


def _sight_event(
    last_seen: Mapping[str, Ns], interval: VisibleInterval, times: int = 1, length: Ns = 0
) -> Event:
    """Returns a sight of a thing, or several as one event, which last so long (ns) in all.

    It goes on if the label was last seen (ns) at its end.
    """
    label = interval.label
    often = f" ({times} times, {seconds(length)} in all)" if times > 1 else ""
    return Event(
        "thing",
        interval.first,
        interval.last,
        repeating(f"{label} in view{often}", [label]),
        times=times,
        goes_on=interval.last == last_seen.get(label),
        score=interval.best,
        label=label,
    )


def _recording_events(view: View, window: TimeWindow, drive: Drive) -> Iterator[Event]:
    """Yields sudden losses of speed, gaps in the recording, steps of the clock, and silences."""
    for time, before_mps, after_mps in drive.drops:
        text = f"slowed down suddenly from {before_mps:.2f} to {after_mps:.2f} m/s"
        yield Event("drop", time, None, text)
    for begin, until in unexcluded(view, recording_gaps(view, TimeWindow(*window.asked()))):
        if is_missed(view.snapshot, window, begin, until):
            yield Event("gap", begin, until, _gap_sentence(view, begin, until))
    for at, by in clock_steps(view, window):
        how = f"forward by {seconds(by)}" if by > 0 else f"back by {seconds(-by)} or more"
        if window.contains(at):
            yield Event("clock step", at, None, f"the clock was set {how}")
    for group in group_silences(silences_in(view, window)):
        topics, first = listed([silence.topic for silence in group]), group[0]
        text = f"{topics} {'was' if len(group) == 1 else 'were'} silent"
        yield Event("silence", first.start, first.end, text, goes_on=first.goes_on)


def _gap_sentence(view: View, begin: Ns, until: Ns) -> str:
    near = deleted_between(view, TimeWindow(begin, until))
    deleted = unix_from_ns(length_in(near, begin, until))
    if not deleted:
        return "nothing was recorded"
    whole = unix_from_ns(until - begin)
    return f"nothing is here: {deleted:.1f} of {whole:.1f} s were deleted"


def _stop_events(stops: Iterable[Standstill], places: RobotPlaces | None) -> Iterator[Event]:
    """Yields stops with the point where the robot stood, in the frame of places if it is known."""
    for start, end, box, goes_on in stops:
        x, y, _ = box.centre
        point: tuple[float, float] | None = (x, y)
        frame = ""
        if places is not None and places.frame_id != places.placement.pose_frame:
            point = places.at(places.standstill_time(start, end))
            if point is None:
                frame = f" in {places.placement.pose_frame}"
            else:
                x, y = point
        # z: a rounded -0.00 reads as 0.00.
        text = f"stood at x {x:z.2f}, y {y:z.2f}{frame}"
        yield Event("stop", start, end, text, goes_on, point=point)


def _errors_in_region(
    view: View, topic: str, events: TopicEvents, region_stays: _RegionStays | None
) -> tuple[Report, ...]:
    """Returns the errors of a window. If a stay in the region cuts one, the stays are read alone.

    So only reports in the region count for it.
    """
    if region_stays is None or not any(
        region_stays.is_cut_by(error.first, error.last) for error in events.errors
    ):
        return events.errors
    parts = [events_in(view, topic, TimeWindow(*time)) for time in region_stays.times]
    return joined_events(parts).errors


def _goal_event(goal: GoalRun, start: Ns, elapsed: Elapsed) -> Event:
    """Returns a goal as an event, from its acceptance on.

    A goal from before the window is an event at the moment when it ended; an active one at `start`.
    """
    kind, name = "failed goal" if goal.outcome in FAILURES else "goal", f"{goal.action} goal"
    is_over = goal.is_lost or goal.ended is not None
    if goal.accepted is None:
        state = "last heard of" if goal.is_lost else goal.outcome or "active"
        at = goal.last if is_over else start
        return Event(kind, at, None, f"{name} {state}, accepted before", goes_on=not is_over)
    if not is_over:
        return Event(kind, goal.accepted, None, f"{name} accepted", goes_on=True)
    after = f"after {seconds(elapsed.between(goal.accepted, goal.last))}"
    text = f"{name} {goal.outcome} {after}"
    if goal.is_lost:
        text = f"{name} last heard of {after}, and listed no more by its server"
    return Event(kind, goal.accepted, goal.last, text)


def _flip_events(
    topic: str, toggles: Sequence[Change], ends: Sequence[Ns], begun: Mapping[str, Ns]
) -> Iterator[Event]:
    """Yields toggles with how long their values are known to hold.

    That is until the next toggle, or until one of `ends` (ns, in order); else beyond the window.
    `begun` has since when (ns) booleans were true before their first toggle, if that is known.
    Booleans of a message that become the same, for as long, are one event.
    """
    next_toggle: dict[str, Ns] = {}
    toggles_by_end: defaultdict[Ns | None, list[Change]] = defaultdict(list)
    for toggle in reversed(toggles):
        end = next_toggle.get(toggle.name)
        nth = bisect_left(ends, toggle.time)
        if nth < len(ends) and (end is None or ends[nth] < end):
            end = ends[nth]
        toggles_by_end[end].append(toggle)
        next_toggle[toggle.name] = toggle.time
    for end, ending_then in toggles_by_end.items():
        for together in toggled_together(reversed(ending_then)):
            text = toggle_sentence(topic, *together)
            at = together[0].time
            # The last toggle that was met going back is the first one.
            firsts = [flip.name for flip in together if next_toggle[flip.name] == at]
            since = [begun[name] for name in firsts if name in begun]
            if len(since) == len(together):
                text += f", true since its first message {seconds(at - since[0])} before"
            yield Event("flip", at, end, text, goes_on=end is None, topic=topic)


def _low_charge_events(view: View, topic: str, events: TopicEvents) -> Iterator[Event]:
    """Yields each time in which a battery was below `_LOW_CHARGE`, with how low it became."""
    charges, changes = events.of_kind(CHARGE)
    for charge in charges:
        own = [change for change in changes if change.name == charge.name]
        yield from _low_times(view, topic, charge, own, events.last)


def _low_times(
    view: View, topic: str, charge: KnownState, changes: Sequence[Change], last: Ns
) -> Iterator[Event]:
    """Yields the events of one battery, whose topic has messages until `last`.

    A driver that does not know the charge may always say 0.
    """
    levels = [(charge.at, charge.first), *((change.time, change.value) for change in changes)]
    since, lowest = None, 0
    for time, level in [*levels, (MAX_NS, 0)]:
        if level > LOW_CHARGES.index(_LOW_CHARGE):
            since, lowest = time if since is None else since, max(level, lowest)
        elif since is not None:
            goes_on, is_begun = time == MAX_NS, since != charge.at
            if goes_on and not is_begun and _says_zero(view, topic, since):
                return
            verb = "fell" if is_begun else "was"
            who, low = battery_of(topic, charge.name), LOW_CHARGES[lowest - 1]
            text = repeating(f"{who} {verb} below {low:.0%}", [charge.name])
            yield Event("low battery", since, min(time, last), text, goes_on=goes_on)
            since, lowest = None, 0


def _says_zero(view: View, topic: str, at: Ns) -> bool:
    message = view.stream.last(topic, at + 1)
    return message is not None and not charge_of(view.value(message))


def _error_event(error: Report) -> Event:
    again = f" ({error.reports} times)" if error.reports > 1 else ""
    end = error.last if error.reports > 1 else None
    return Event("error", error.first, end, Quoted(f"error: {error.text}{again}"))


def _with_changes(changes: ChangesBefore, events: Sequence[Event]) -> list[Event]:
    """Returns the events with what changed before each stop, speed drop and toggle."""
    past: dict[Event, tuple[PastChange, ...]] = {}
    for event in events:
        if event.kind == "flip":
            own, topic = _boolean_of(event), event.topic
            past[event] = changes.before(event.start, without=own, beside=topic)
        elif event.kind in {"stop", "drop"}:
            past[event] = changes.before(event.start, slack=SLACK_NS)
    # The nearest changes of all events come first, then the second nearest, and so on. An event
    # whose nearer change has no room shows no farther one.
    shown: defaultdict[Event, list[PastChange]] = defaultdict(list)
    chars_left = _MOST_CHARS
    for nth in range(_MOST_CHANGES):
        for event, of_event in past.items():
            has_next = len(of_event) > nth == len(shown[event])
            size = len(of_event[nth].text) + _CHANGE_CHARS if has_next else 0
            if has_next and size <= chars_left:
                chars_left -= size
                shown[event].append(of_event[nth])
    return [replace(event, before=tuple(shown[event])) for event in events]


def _boolean_of(event: Event) -> str:
    """Returns the sentence on a toggled boolean without its value; empty for another event."""
    name, became, _ = event.text.partition(" became ")
    return f"{name}{became.rstrip()}" if event.kind == "flip" else ""


def _most_important(
    view: View, events: Sequence[Event], counts: Counter[str], most: int, rare: Collection[Event]
) -> list[Event]:
    """Returns at most `most` events, in order of time: the most important, the longest of a kind.

    What happens on any day comes last, the rare before the frequent: two changes of an emergency
    stop, then the stops, then a door that opens all the time. Of a boolean the value comes first
    that held for less time in all. `counts` has how many there are of each kind; there may be more
    than `events`. The `rare` ones displace only what happened more often than there may be of them.
    A note says how many are left out; one alone is not.
    """
    alike = counts + Counter(map(_boolean_of, events))
    held = Counter[str]()
    for event in events:
        held[event.text] += event.length if event.kind == "flip" else 0

    def rank(event: Event) -> tuple[int, int, int, Ns, Ns]:
        kind, often = _KINDS.index(event.kind), alike[_boolean_of(event) or event.kind]
        often = min(often, _MOST_RARE) if event in rare else often
        return min(kind, _OF_ANY_DAY), often, kind, held[event.text], -event.length

    if counts.total() == len(events) == most + 1:
        most += 1
    shown = sorted(events, key=rank)[:most]
    left_out = counts - sum((Counter({event.kind: event.times}) for event in shown), Counter())
    if left_out:
        named = [
            counted(left_out[kind], "sight of a thing" if kind == "thing" else kind, several)
            for kind, several in _PLURALS.items()
            if left_out[kind]
        ]
        view.notes.add(
            f"left out, because there are too many: {', '.join(named)}; ask for a shorter time"
        )
    return sorted(shown, key=lambda event: (event.start, _KINDS.index(event.kind)))
