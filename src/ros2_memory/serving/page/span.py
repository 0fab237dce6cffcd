"""The first look of the page: where the robot drove in a span, what it saw, and what happened.

Gathered from the queries behind the tools, and bounded however long the span is. A live page asks
only for what is new since its last look.
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
from ros2_memory.core.regions import Circle, Place, Polygon
from ros2_memory.core.reply import (
    INSIDE,
    PAIRS,
    PLAIN,
    TENTHS_OF_S,
    JsonObject,
    Scope,
    degrees,
    digits,
    keys,
    moment,
    objects,
    render,
    rounded,
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
from ros2_memory.history.view import TimeRange, View
from ros2_memory.insights.recap import recap
from ros2_memory.insights.saved_moments import list_moments
from ros2_memory.insights.status import memory_status
from ros2_memory.queries import data_time_range
from ros2_memory.serving.page.drawn_path import RobotPath, robot_path, why_no_path
from ros2_memory.serving.page.topics import Signal, signal_in
from ros2_memory.things.find import find_things

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from ros2_memory.analysis.motion.robot_track import RobotTrack
    from ros2_memory.columns.fill import Progress
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.index.snapshot import Snapshot
    from ros2_memory.results import DataTimeRange
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
"""Parts that are of the whole span; `whole_ms` is their processor time, so that a live page knows
how often it may ask for them."""
_NEWEST_BAGS: Final = 3
_NEWEST_NS: Final[Ns] = 600 * NS_PER_S


def _unix_s(at: Ns) -> float:
    """Returns Unix seconds to the millisecond: a pixel of the page is more."""
    return round(unix_from_ns(at), 3)


_TIME: Final = unit(_unix_s)
_XY: Final = vector("xy", 2)
EVENT: Final = keys(
    "kind",
    _TIME("t", "start"),
    "text",
    _TIME("end").if_known,
    PLAIN("goes_on").if_any,
    _XY.spread("point").if_known,
    INSIDE("places"),
)
SUMMARY: Final = keys(digits(1)("distance_m"), TENTHS_OF_S("stood_s"))
"""Of a recap: what a stretch of time has, too."""
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


class Shown(NamedTuple):
    """Keys of an answer, and the reasons if they are incomplete."""

    keys: JsonObject
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class SpanRequest:
    """What a page asks for.

    Attributes:
        start_s: Unix seconds of the begin of the span; with `end_s`, else the last `last_s`.
        last_s: seconds before the newest data.
        since_s: only what is newer is returned of the path and the signals, and of the bag that it
            is in; without `things` also of the events.
        version: of the answer that the page has; nothing is looked up where it is current.
        things: whether things, events and totals of the whole span are looked up.
        status: whether the state of the memory is; without it only how far it reaches.
        patient: whether the answer may take long; else what takes long is left out.
        first: whether nothing is shown yet, so that the answer must not take long as a whole.
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
        """Returns the span over a memory that begins and ends so; at least a second long.

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
    """Returns what the page shows of a span.

    `progress`: how far the store of columns is filled; `questions`: the latest ones, if
    these are kept.

    Raises:
        InvalidArgumentsError: the span is invalid, or a signal is not recorded.
        QueryTimeoutError: the call's time is over.
    """
    filling = None if progress is None else progress()
    # Of a robot that is on up to a time past the newest bag, so that the folder is scanned.
    snapshot = memory.index.snapshot(memory.clock.now() if memory.limits.now == "wall" else None)
    version = _version(snapshot, filling, 0 if questions is None else questions.count)
    now = moment(memory.now(memory.clock.now(), snapshot.latest))
    if version == request.version:
        return {"version": version, "unchanged": True, "now": now}
    earliest, latest = snapshot.dating.earliest, snapshot.dating.latest
    shown: JsonObject = {
        "version": version,
        "now": now,
        "latest": moment(latest),
        "filling": _filling_shown(filling),
    }
    if questions is not None and questions.is_on:
        shown["questions"] = [*questions.newest(MOST_QUESTIONS)]
    if request.status:
        shown["range"] = _range_shown(memory, call, snapshot)
        shown["status"] = render(memory_status(memory, call), memory.index.bag_dir)
    if earliest is None or latest is None:
        return shown
    window = request.window(earliest, latest)
    fresh = _fresh(snapshot, window, request.since_s)
    # Rounded away from the span, so that one that is asked again holds all that it did.
    end_s = -((AT_OR_BEFORE_SLACK_NS + 1 - window.stop) // NS_PER_MS) / 1000
    shown |= {"start": _start_s(window), "end": end_s, "since": _start_s(fresh)}
    parts: dict[str, Callable[[Call], Shown]] = {
        "path": lambda call: _path(memory, call, fresh, latest),
        "events": lambda call: _events(memory, call, window if request.things else fresh),
        "things": lambda call: _things(memory, call, window),
        "moments": lambda call: _moments(memory, call),
    }
    if not request.things:
        del parts["things"]
    all_parts = _united_parts(parts, call, request)
    shown |= all_parts.keys
    if request.signals:
        shown["signals"] = [
            signal_in(memory, call, signal, fresh, window) for signal in request.signals
        ]
    shown["notes"] = [*all_parts.notes]
    return shown


def _filling_shown(filling: Progress | None) -> JsonObject | None:
    """Returns how far the store of columns is filled; None where that is as good as full."""
    # So it is without the newest of many bags, as while recording.
    if filling is None or filling.waiting <= min(_NEWEST_BAGS, filling.closed // 10):
        return None
    return {"closed": filling.closed, "waiting": filling.waiting}


def _range_shown(memory: Memory, call: Call, snapshot: Snapshot) -> JsonObject:
    """Returns the recorded range with its longest gaps, and the days that were thinned, if any."""
    ranged = data_time_range(memory, call)
    shown: JsonObject = {**render(ranged, memory.index.bag_dir), "gaps": _gaps(ranged)}
    if thinned := snapshot.timeline.thinned_times:
        shown["thinned"] = [[_unix_s(start), _unix_s(stop)] for start, stop in thinned]
    return shown


def _united_parts(
    parts: Mapping[str, Callable[[Call], Shown]], call: Call, request: SpanRequest
) -> Shown:
    """Returns all parts as one, or why one is not known; and how long those of the span took."""
    shown: JsonObject = {}
    notes: list[str] = []
    budget_s, whole_s = _PART_S if request.patient else _QUICK_S, 0.0
    whole = call.deadline.within(budget_s)
    for name, part in parts.items():
        begun = time.thread_time()
        if request.first:
            budget_s = max(whole.left_s(), 0.0) / 2
        try:
            known = part(call.within(budget_s))
        except QueryTimeoutError as error:
            known = Shown({}, (f"the {name} are not known yet: {error}",))
        shown |= known.keys
        notes += known.notes
        whole_s += time.thread_time() - begun if name in _OF_WHOLE else 0.0
    if request.things:
        shown["whole_ms"] = round(whole_s * 1000)
    return Shown(shown, tuple(dict.fromkeys(notes)))


def _fresh(snapshot: Snapshot, window: TimeWindow, since_s: float | None) -> TimeWindow:
    """Returns the part of a window that is newer than a time, from the begin of a bag.

    What is stored answers for whole bags.
    """
    if since_s is None:
        return window
    since = min(max(ns_from_unix(since_s), window.start), window.stop - 1)
    bags = snapshot.timeline.overlapping(TimeWindow(since, since + 1))
    begins = min((bag.start for bag in bags), default=since)
    return TimeWindow(max(begins, window.start), window.stop)


def _version(snapshot: Snapshot, filling: Progress | None, questions: int) -> str:
    """Returns another text whenever there is more to be shown."""
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
    """Returns the begin to the millisecond: asked from there, a span holds all that it did."""
    return (window.start + START_SLACK_NS) // NS_PER_MS / 1000


def _gaps(ranged: DataTimeRange) -> list[JsonValue]:
    """Returns the longest gaps in order, as pairs of times."""
    longest = sorted(ranged.gaps, key=lambda gap: gap.start - gap.end)[:MOST_GAPS]
    return [
        [_unix_s(gap.start), _unix_s(gap.end)] for gap in sorted(longest, key=lambda gap: gap.start)
    ]


def _path(memory: Memory, call: Call, window: TimeWindow, latest: Ns) -> Shown:
    """Returns the path, and where the robot was last; else why there is none."""
    view = View(memory, call, window.stop)
    path = newest = robot_path(view, window)
    if path is None:
        why = why_no_path(view)
        return Shown({"path": None, "robot": None, "no_path": why}, (why,))
    if window.stop <= latest or not len(path.track.times):
        newest = robot_path(view, TimeWindow.before(latest, _NEWEST_NS))
    named: list[JsonValue] = [
        _place_outline(place) for place in memory.limits.places if place.frame_id == path.frame
    ]
    robot = None if newest is None else _newest_pose(newest.track)
    notes = [*view.notes.sentences()]
    if not path.is_whole:
        notes.append("the path is not complete yet: older bags are still being read")
    return Shown({"path": _drawn(path), "robot": robot, "places": named}, tuple(notes))


def path_in(memory: Memory, call: Call, window: TimeWindow) -> JsonObject | None:
    """Returns the path in a window; None where no topic with poses is recorded.

    Raises:
        QueryTimeoutError: it is not known within the time of a quick answer.
    """
    path = robot_path(View(memory, call.within(_QUICK_S), window.stop), window)
    return None if path is None else _drawn(path)


def _drawn(path: RobotPath) -> JsonObject:
    """Returns a path by `MOST_POINTS` points at most."""
    track = path.track
    kept, tolerance_m = np.arange(len(track.times)), _FINE_M
    while len(kept) > MOST_POINTS:
        line = path.line.some(kept)
        few = line.simplified(tolerance_m, len(kept))
        is_too_coarse = len(few) < MOST_POINTS // 2 and tolerance_m > _FINE_M
        if is_too_coarse or tolerance_m > _COARSE_M:
            few = line.simplified(0.0, MOST_POINTS)  # as near as these allow: ten times slower
        kept, tolerance_m = kept[few], 2 * tolerance_m
    return {
        "frame": path.frame,
        "t": np.round(track.times[kept] / NS_PER_S, 3).tolist(),
        "x": np.round(track.x[kept], 2).tolist(),
        "y": np.round(track.y[kept], 2).tolist(),
        "yaw": [degrees(heading) for heading in track.heading[kept].tolist()],
        "begins": _begins(track, kept),
        "continues": bool(len(kept)) and not bool(track.begins[0]),
        "whole": path.is_whole,
    }


def _begins(track: RobotTrack, kept: NDArray[np.intp]) -> list[JsonValue]:
    """Returns the numbers of the kept points before which the robot was not seen for a while."""
    if not len(kept):
        return []
    pieces = np.cumsum(track.begins)[kept]
    return [0, *(np.flatnonzero(np.diff(pieces)) + 1).tolist()]


def _newest_pose(track: RobotTrack) -> JsonObject | None:
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
    match place.region:
        case Circle(x, y, radius_m):
            return {"name": place.name, "circle": [x, y, radius_m]}
        case Polygon(corners=given):
            corners = [*given]
        case region:
            min_x, max_x, min_y, max_y = region.bounds
            corners = [(min_x, min_y), (max_x, min_y), (max_x, max_y), (min_x, max_y)]
    return {"name": place.name, "corners": [[x, y] for x, y in corners]}


def _events(memory: Memory, call: Call, window: TimeWindow) -> Shown:
    summary = recap(
        memory, call, TimeRange.over(window), most_events=MOST_EVENTS, with_changes=False
    )
    shown = {**SUMMARY.render(summary, Scope()), **_ALL_EVENTS.render(summary, Scope())}
    return Shown({**shown, "events_since": _start_s(window)}, summary.notes)


def _moments(memory: Memory, call: Call) -> Shown:
    try:
        stored = list_moments(memory, call).moments
    except EpisodicError as error:
        return Shown({"moments": []}, (str(error),))
    return Shown({"moments": [_MOMENT.render(saved, Scope()) for saved in stored]})


def _things(memory: Memory, call: Call, window: TimeWindow) -> Shown:
    """Returns the things that were seen in a window."""
    try:
        answer = find_things(
            memory,
            call,
            start_s=unix_from_ns(window.start),
            end_s=unix_from_ns(window.stop - 1),
            limit=MOST_THINGS,
        )
    except (NoDataError, InvalidArgumentsError) as error:
        return Shown({"things": []}, (str(error),))
    things: list[JsonValue] = [_THING.render(thing, Scope()) for thing in answer.things]
    return Shown({"things": things, "things_total": answer.total}, answer.notes)
