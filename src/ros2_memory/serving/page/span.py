"""The page's data: about a span, a moment, a stretch of time, and a label seen in it.

The first look is a span: where the robot drove, what it saw, and what happened. All is gathered
from the queries behind the tools, and bounded however long the span is. A live page asks only for
what is new since its last look.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.core.errors import (
    EpisodicError,
    InvalidArgumentsError,
    NoDataError,
    QueryTimeoutError,
)
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.regions import Circle, Place, Polygon, plan_of
from ros2_memory.core.reply import (
    INSIDE,
    PAIRS,
    PLAIN,
    POSE_KEYS,
    TENTHS_OF_S,
    JsonObject,
    Scope,
    an_object,
    degrees,
    digits,
    keys,
    moment,
    objects,
    render,
    rounded,
    shown,
    unit,
    vector,
)
from ros2_memory.core.timebase import (
    AT_OR_BEFORE_SLACK_NS,
    NS_PER_MS,
    NS_PER_S,
    START_SLACK_NS,
    Ns,
    ns_from_unix,
    unix_from_ns,
)
from ros2_memory.history.conditions import Sought
from ros2_memory.history.view import TimeRange, View, open_span
from ros2_memory.insights.changes_before import recap_before
from ros2_memory.insights.recap import events_by_topic, recap
from ros2_memory.insights.saved_moments import list_moments
from ros2_memory.insights.sightings import find_matches
from ros2_memory.insights.status import memory_status
from ros2_memory.queries import data_time_range
from ros2_memory.serving.page.drawn_path import RobotPath, robot_path, why_no_path
from ros2_memory.serving.page.topics import Signal, signal_in
from ros2_memory.things.find import find_things
from ros2_memory.things.labels import Labels

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from ros2_memory.analysis.motion.robot_track import RobotTrack
    from ros2_memory.columns.fill import Progress
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.index.snapshot import Snapshot
    from ros2_memory.results import DataTimeRange, Recap, Sightings
    from ros2_memory.serving.dispatch import QuestionLog

MOST_POINTS: Final = 2_000
MOST_EVENTS: Final = 300
MOST_THINGS: Final = 200
MOST_GAPS: Final = 500
LAST_S: Final = 3600.0
MOST_QUESTIONS: Final = 30

_QUICK_S: Final = 0.8
_PART_S: Final = 8.0
"""How long each part of an answer may take; of a patient one the latter, of a first one all of them
the former. The page shows what there is, and asks again for the rest."""
_FINE_M: Final = 0.01
_COARSE_M: Final = 1.0
"""How near a path of many points is drawn, until few are left: from the one to the other."""
_OF_WHOLE: Final = ("events", "things")
"""Parts about the whole span. `whole_ms` is their processor time: by it a live page decides how
often it asks for them."""
_NEWEST_BAGS: Final = 3
_NEWEST_NS: Final[Ns] = 600 * NS_PER_S

AROUND_S: Final = 1.0
"""How long before and after a moment counts as seen at it: a detector reports once a second."""
MOST_SEEN: Final = 60
MOST_SIGHTINGS: Final = 30
_CHANGES_S: Final = 10.0
"""How long before a moment a change is shown."""


def _unix_s(at: Ns) -> float:
    """Returns Unix seconds to the millisecond: a pixel of the page is more."""
    return round(unix_from_ns(at), 3)


_TIME: Final = unit(_unix_s)
_XY: Final = vector("xy", 2)
EVENT: Final = keys(
    "kind",
    _TIME("t", "start"),
    "text",
    PLAIN("label").if_any,
    _TIME("end").if_known,
    PLAIN("goes_on").if_any,
    _XY.spread("point").if_known,
    INSIDE("places"),
)
SUMMARY: Final = keys(digits(1)("distance_m"), TENTHS_OF_S("stood_s"))
"""The keys of a recap that the page shows of any stretch of time."""
_ALL_EVENTS: Final = keys(
    objects(EVENT)("events"), PLAIN("throughout"), digits(2)("max_speed"), PAIRS("counts")
)
_MOMENT: Final = keys(
    _TIME("start", "moment.request.start"),
    _TIME("end", "moment.request.end"),
    PLAIN("label", "moment.request.label"),
)
_THING: Final = keys(
    "label",
    _XY.spread("place"),
    PLAIN("frame", "frame_id"),
    _TIME("first"),
    _TIME("last"),
    PLAIN("times", "count"),
    INSIDE("inside"),
    PLAIN("moves").if_any,
    digits(2)("score", "best").if_known,
    PLAIN("state", "still_there.state").if_known,
)
_CHANGE: Final = keys("text", TENTHS_OF_S("before_s", "before"))
_ROBOT: Final = keys(
    an_object(POSE_KEYS)("robot"),
    PLAIN("frame", "robot.frame_id"),
    digits(2)("speed", "speed_mps"),
    PAIRS("state"),
)


class Part(NamedTuple):
    """A part of a reply: keys, and notes on why they are incomplete."""

    keys: JsonObject
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class SpanRequest:
    """A request to `/page/span`.

    Attributes:
        start_s: where the span begins, in Unix seconds; None for the last `last_s`.
        end_s: where the span ends, in Unix seconds.
        last_s: seconds before the newest data.
        since_s: path and signals begin with the bag of this time (Unix seconds); without `things`
            the events, too.
        version: of the reply that the page has. If it is current, nothing else is looked up.
        things: whether things, events and totals of the whole span are looked up.
        status: whether the state of the memory is looked up.
        patient: whether the parts may take long; else slow parts are left out.
        first: whether the page shows nothing yet, so that all parts together must be quick.
        signals: to be plotted.
    """

    start_s: float | None
    end_s: float | None
    last_s: float
    since_s: float | None
    version: str
    things: bool
    status: bool
    patient: bool
    first: bool
    signals: tuple[Signal, ...]

    def window(self, earliest: Ns, latest: Ns) -> TimeWindow:
        """Returns the span, at least a second long.

        Args:
            earliest: log time (ns) of the oldest message of the memory.
            latest: log time (ns) of the newest message.

        Raises:
            InvalidArgumentsError: the bounds are no numbers, or reversed.
        """
        if self.start_s is not None and self.end_s is not None:
            return TimeWindow.from_unix(self.start_s, self.end_s)
        length = max(ns_from_unix(self.last_s), NS_PER_S)
        return TimeWindow(max(latest - length, min(earliest, latest - NS_PER_S)), latest + 1)


def span_shown(
    memory: Memory,
    call: Call,
    request: SpanRequest,
    progress: Callable[[], Progress] | None = None,
    questions: QuestionLog | None = None,
) -> JsonObject:
    """Returns the reply of `/page/span`.

    Args:
        memory: the memory.
        call: bounds how long this takes.
        request: what the page asks for.
        progress: tells how far the store of columns is filled; None without a store.
        questions: the latest questions of clients; None if they are not shown.

    Raises:
        InvalidArgumentsError: the span is invalid, or a signal is not recorded.
        QueryTimeoutError: the call's time is over.
    """
    filling = None if progress is None else progress()
    # If a recorder runs, a time past the newest bag makes the index scan the folder.
    snapshot = memory.snapshot(memory.clock.now() if memory.limits.now == "wall" else None)
    version = _version(snapshot, filling, 0 if questions is None else questions.count)
    now = moment(memory.now(snapshot.latest))
    if version == request.version:
        return {"version": version, "unchanged": True, "now": now}
    earliest, latest = snapshot.dating.earliest, snapshot.dating.latest
    shown: JsonObject = {
        "version": version,
        "now": now,
        "latest": moment(latest),
        "filling": _filling_state(filling),
    }
    if questions is not None and questions.is_on:
        shown["questions"] = [*questions.newest(MOST_QUESTIONS)]
    if request.status:
        shown["range"] = _recorded_range(memory, call, snapshot)
        shown["status"] = render(memory_status(memory, call), memory.bag_dir)
    if earliest is not None and latest is not None:
        window = request.window(earliest, latest)
        fresh = _fresh_window(snapshot, window, request.since_s)
        shown |= _span_data(memory, call, request, window=window, fresh=fresh, latest=latest)
    return shown


def _span_data(
    memory: Memory,
    call: Call,
    request: SpanRequest,
    *,
    window: TimeWindow,
    fresh: TimeWindow,
    latest: Ns,
) -> JsonObject:
    """Returns the keys of the reply that depend on the span.

    Args:
        memory: the memory.
        call: bounds how long this takes.
        request: what the page asks for.
        window: the whole span.
        fresh: the part of it that the page does not have yet.
        latest: log time (ns) of the newest message.
    """
    # Rounded away from the span: asked for again by these bounds, it has the same messages.
    end_s = -((AT_OR_BEFORE_SLACK_NS + 1 - window.stop) // NS_PER_MS) / 1000
    parts: dict[str, Callable[[Call], Part]] = {
        "path": lambda call: _path(memory, call, fresh, latest),
        "events": lambda call: _events(memory, call, window if request.things else fresh),
        "things": lambda call: _things(memory, call, window),
        "moments": lambda call: _moments(memory, call),
    }
    if not request.things:
        del parts["things"]
    united = _united_parts(parts, call, request)
    data: JsonObject = {
        "start": _start_s(window),
        "end": end_s,
        "since": _start_s(fresh),
        **united.keys,
    }
    if request.signals:
        data["signals"] = [
            signal_in(memory, call, signal, fresh, window) for signal in request.signals
        ]
    data["notes"] = [*united.notes]
    return data


def _filling_state(filling: Progress | None) -> JsonObject | None:
    """Returns how far the store of columns is filled; None if it is as good as full."""
    # While recording, the newest of many bags are never stored yet.
    if filling is None or filling.waiting <= min(_NEWEST_BAGS, filling.closed // 10):
        return None
    return {"closed": filling.closed, "percent": filling.percent}


def _recorded_range(memory: Memory, call: Call, snapshot: Snapshot) -> JsonObject:
    """Returns the recorded range with its longest gaps, and the days that were thinned, if any."""
    recorded = data_time_range(memory, call)
    shown: JsonObject = {**render(recorded, memory.bag_dir), "gaps": _gaps(recorded)}
    if thinned := snapshot.timeline.thinned_times:
        shown["thinned"] = [[_unix_s(start), _unix_s(stop)] for start, stop in thinned]
    return shown


def _united_parts(
    parts: Mapping[str, Callable[[Call], Part]], call: Call, request: SpanRequest
) -> Part:
    """Returns the keys and notes of all parts; a part that takes too long is a note."""
    shown: JsonObject = {}
    notes: list[str] = []
    budget_s, whole_s = _PART_S if request.patient else _QUICK_S, 0.0
    deadline = call.deadline.within(budget_s)
    for name, make_part in parts.items():
        begun = time.thread_time()
        if request.first:
            # Half of what is left, so that the parts after this one have time, too.
            budget_s = max(deadline.left_s(), 0.0) / 2
        try:
            part = make_part(call.within(budget_s))
        except QueryTimeoutError as error:
            part = Part({}, (f"the {name} are not known yet: {error}",))
        shown |= part.keys
        notes += part.notes
        if name in _OF_WHOLE:
            whole_s += time.thread_time() - begun
    if request.things:
        shown["whole_ms"] = round(whole_s * 1000)
    return Part(shown, tuple(dict.fromkeys(notes)))


def _fresh_window(snapshot: Snapshot, window: TimeWindow, since_s: float | None) -> TimeWindow:
    """Returns the part of a window from the begin of the bag at `since_s`, in Unix seconds.

    Stored columns answer for whole bags.
    """
    if since_s is None:
        return window
    since = min(max(ns_from_unix(since_s), window.start), window.stop - 1)
    bags = snapshot.timeline.overlapping(TimeWindow(since, since + 1))
    start = min((bag.start for bag in bags), default=since)
    return TimeWindow(max(start, window.start), window.stop)


def _version(snapshot: Snapshot, filling: Progress | None, questions: int) -> str:
    """Returns a text that changes whenever there is more to be shown."""
    counts = (
        snapshot.latest or 0,
        len(snapshot.bags),
        len(snapshot.damaged),
        len(snapshot.unread),
        0 if filling is None else filling.waiting,
        questions,
    )
    return "-".join(map(str, counts))


def _start_s(window: TimeWindow) -> float:
    """Returns where a window begins, in Unix seconds rounded down to the millisecond."""
    return (window.start + START_SLACK_NS) // NS_PER_MS / 1000


def _gaps(recorded: DataTimeRange) -> list[JsonValue]:
    """Returns the `MOST_GAPS` longest gaps in order, each as start and end in Unix seconds."""
    gaps = sorted(recorded.gaps, key=lambda gap: gap.start - gap.end)[:MOST_GAPS]
    gaps.sort(key=lambda gap: gap.start)
    return [[_unix_s(gap.start), _unix_s(gap.end)] for gap in gaps]


def _path(memory: Memory, call: Call, window: TimeWindow, latest: Ns) -> Part:
    """Returns the path, and where the robot was last; else why there is none."""
    view = View(memory, call, window.stop)
    path = newest = robot_path(view, window)
    if path is None:
        why = why_no_path(view)
        return Part({"path": None, "robot": None, "no_path": why}, (why,))
    if window.stop <= latest or not len(path.track.times):
        newest = robot_path(view, TimeWindow.before(latest, _NEWEST_NS))
    places: list[JsonValue] = [
        _place_outline(place) for place in memory.limits.places if place.frame_id == path.frame
    ]
    robot = None if newest is None else _newest_pose(newest.track)
    notes = [*view.notes.sentences()]
    if not path.is_whole:
        notes.append("the path is not complete yet: older bags are still being read")
    return Part({"path": _path_points(path), "robot": robot, "places": places}, tuple(notes))


def _path_points(path: RobotPath) -> JsonObject:
    """Returns at most `MOST_POINTS` points of a path as columns, as near to the path as they can.

    `begins` are the positions of points before which the robot was not seen for a while.
    """
    track = path.track
    points, tolerance_m = np.arange(len(track.times)), _FINE_M
    while len(points) > MOST_POINTS:
        line = path.line.select(points)
        fewer = line.simplified(tolerance_m, len(points))
        is_too_coarse = len(fewer) < MOST_POINTS // 2 and tolerance_m > _FINE_M
        if is_too_coarse or tolerance_m > _COARSE_M:
            # Exactly as many as allowed, which takes ten times as long.
            fewer = line.simplified(0.0, MOST_POINTS)
        points, tolerance_m = points[fewer], 2 * tolerance_m
    pieces = np.cumsum(track.begins)[points]
    return {
        "frame": path.frame,
        "t": np.round(track.times[points] / NS_PER_S, 3).tolist(),
        "x": np.round(track.x[points], 2).tolist(),
        "y": np.round(track.y[points], 2).tolist(),
        "yaw": [degrees(heading) for heading in track.heading[points].tolist()],
        "begins": np.flatnonzero(np.diff(pieces, prepend=-1)).tolist(),
        "continues": bool(len(points)) and not bool(track.begins[0]),
        "whole": path.is_whole,
    }


def _newest_pose(track: RobotTrack) -> JsonObject | None:
    """Returns time (Unix s), x, y (m) and yaw (degrees) of the last point; None without one."""
    if not len(track.times):
        return None
    return {
        "t": _unix_s(int(track.times[-1])),
        "x": rounded(float(track.x[-1]), 3),
        "y": rounded(float(track.y[-1]), 3),
        "yaw": degrees(math.remainder(float(track.heading[-1]), math.tau)),
    }


def _place_outline(place: Place) -> JsonObject:
    """Returns a named place as a circle or as corners."""
    match plan_of(place.region):
        case Circle(x, y, radius_m):
            return {"name": place.name, "circle": [x, y, radius_m]}
        case Polygon(corners=given):
            corners = [*given]
        case region:
            min_x, max_x, min_y, max_y = region.bounds
            corners = [(min_x, min_y), (max_x, min_y), (max_x, max_y), (min_x, max_y)]
    return {"name": place.name, "corners": [[x, y] for x, y in corners]}


def _events(memory: Memory, call: Call, window: TimeWindow) -> Part:
    """Returns what happened in a window, and its totals."""
    summary = recap(
        memory,
        call,
        TimeRange.over(window),
        most_events=MOST_EVENTS,
        with_changes=False,
        each_sight=True,
    )
    shown = {**SUMMARY.render(summary), **_ALL_EVENTS.render(summary)}
    return Part({**shown, "events_since": _start_s(window)}, summary.notes)


def _moments(memory: Memory, call: Call) -> Part:
    """Returns the saved moments."""
    try:
        stored = list_moments(memory, call)
    except EpisodicError as error:
        return Part({"moments": []}, (str(error),))
    return Part({"moments": [_MOMENT.render(saved) for saved in stored.moments]}, stored.notes)


def _things(memory: Memory, call: Call, window: TimeWindow) -> Part:
    """Returns the things that were seen in a window."""
    try:
        answer = find_things(memory, call, span=TimeRange.over(window), limit=MOST_THINGS)
    except (NoDataError, InvalidArgumentsError) as error:
        return Part({"things": []}, (str(error),))
    things: list[JsonValue] = [_THING.render(thing) for thing in answer.things]
    return Part({"things": things, "things_total": answer.total}, answer.notes)


def moment_shown(memory: Memory, call: Call, at_s: float) -> JsonObject:
    """Returns where the robot was at a moment (Unix s), what it saw and what had changed.

    Raises:
        NoDataError: nothing is recorded.
        QueryTimeoutError: the call's time is over.
    """
    preceding = recap_before(memory, call, at_s, _CHANGES_S, None)
    around = recap(
        memory,
        call,
        TimeRange(at_s - AROUND_S, at_s + AROUND_S),
        most_events=MOST_SEEN,
        with_changes=False,
        with_sights=False,
    )
    changes = [*preceding.changes, *preceding.after]
    return {
        "t": at_s,
        **_ROBOT.render(preceding),
        "changes": [_CHANGE.render(change) for change in changes],
        "seen": _seen(around),
        "notes": [*dict.fromkeys([*preceding.notes, *around.notes])],
    }


def stretch_shown(memory: Memory, call: Call, start_s: float, end_s: float) -> JsonObject:
    """Returns how far the robot drove in a stretch of time, what it saw and what happened.

    Raises:
        NoDataError: nothing is recorded.
        QueryTimeoutError: the call's time is over.
    """
    summary = recap(
        memory,
        call,
        TimeRange(start_s, end_s),
        most_events=MOST_SEEN,
        with_changes=False,
        with_sights=False,
    )
    return {
        "start": start_s,
        "end": end_s,
        **SUMMARY.render(summary),
        "seen": _seen(summary),
        "events": [EVENT.render(event) for event in summary.events],
        "notes": [*summary.notes],
    }


def _seen(summary: Recap) -> list[JsonValue]:
    """Returns the labels in view, each once; first those that were in view all the time.

    Another label has its longest sight.
    """
    throughout: list[JsonValue] = [{"label": label} for label in summary.throughout]
    return throughout + [EVENT.render(sight) for sight in summary.longest_sights]


def sightings_shown(
    memory: Memory, call: Call, label: str, start_s: float, end_s: float
) -> JsonObject:
    """Returns the newest sightings of a label in all its spellings, over all detectors.

    Raises:
        NoDataError: nothing is recorded.
        QueryTimeoutError: the call's time is over.
    """
    span = TimeRange(start_s, end_s)
    view, window = open_span(memory, call, span)
    key_of = Labels(memory.limits.labels).key
    spellings = [
        (topic, spelling)
        for topic, events in events_by_topic(view, window).items()
        if events.visible.size
        for spelling in sorted({label, *events.visible.labels})
        if key_of(spelling) == key_of(label)
    ]
    answers: list[Sightings] = []
    for topic, spelling in spellings:
        # The name of a class may be its number, which coordinates may equal.
        kind = "contains_word" if spelling.isdecimal() else "equals"
        sought = Sought(topic, kind, spelling)
        answers.append(find_matches(memory, call, sought, span=span, limit=MOST_SIGHTINGS))
    found = [sighting for answer in answers for sighting in answer.sightings]
    found.sort(key=lambda sighting: sighting.last, reverse=True)
    scope = Scope(now=max((answer.now for answer in answers), default=0))
    totals = [answer.total for answer in answers if answer.total is not None]
    return {
        "label": label,
        "start": start_s,
        "end": end_s,
        "sightings": [shown(sighting, scope) for sighting in found[:MOST_SIGHTINGS]],
        "total": sum(totals) if len(totals) == len(answers) else None,
        "notes": [*dict.fromkeys(note for answer in answers for note in answer.notes)],
    }
