"""What pictures show: asked as the tools ask it, as plain numbers. Times are Unix seconds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import datetime
from itertools import islice, pairwise
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.analysis.motion.trajectory import Waypoint
from ros2_memory.cli.output import format_duration
from ros2_memory.core.errors import InvalidArgumentsError, NoDataError, NoDataReason
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import united, without
from ros2_memory.core.text import listed
from ros2_memory.core.timebase import Ns, ns_from_unix, unix_from_ns
from ros2_memory.history.context import Call
from ros2_memory.history.coverage import recording_gaps
from ros2_memory.history.driven_path import Body, body_by_transforms, robot_body
from ros2_memory.history.no_data import (
    GIVE_TOPIC,
    require_bags,
    topics_that_show_poses,
    topics_with,
)
from ros2_memory.history.transforms import transform_at
from ros2_memory.history.view import TimeRange, View
from ros2_memory.insights.recap import recap
from ros2_memory.places.local_map import east_north, fixes_in, local_frame
from ros2_memory.places.pose_frames import placed_waypoints
from ros2_memory.queries import trajectory_summary

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.core.model import JsonValue
    from ros2_memory.core.regions import Place
    from ros2_memory.history.context import Memory
    from ros2_memory.results import Event, Recap, TrajectorySummary

_MOST_WAYPOINTS: Final = 4000
"""Of a path; one of no more poses is drawn through each of them."""
_MOST_SAMPLES: Final = 20_000
"""Messages of a signal that are drawn, evenly spaced: some for each column of a wide picture."""
_MOST_SIGNALS: Final = 6
MOST_TOPICS: Final = 30
_PERIODS: Final = 5
"""A signal has a gap, and its line is broken, after so many of its usual periods, and a second."""
_COLORS: Final = {
    "recorded": "#3b82a0",
    "gap": "#dc2626",
    "clock step": "#111827",
    "silence": "#f97316",
    "error": "#dc2626",
    "failed goal": "#be123c",
    "stop": "#f59e0b",
    "flip": "#0891b2",
    "drop": "#db2777",
    "goal": "#059669",
    "thing": "#7c3aed",
}
_ROWS: Final = {
    "gap": "gaps",
    "clock step": "clock steps",
    "silence": "silences",
    "stop": "stood",
    "goal": "goals",
    "failed goal": "failed goals",
    "error": "errors",
    "drop": "speed drops",
    "flip": "on/off",
    "thing": "things in view",
}
"""The kinds of events in a recap, and the name of each one's row, the first one on top."""
_TOPIC: Final = "#94a3b8"


_MOST_MOMENTS: Final = 300
"""Transforms that are looked up: each takes some milliseconds."""


class TimelineRow(NamedTuple):
    """A row of a timeline: stretches from one time to another; equal ones are a moment."""

    name: str
    stretches: Sequence[tuple[float, float]]
    color: str


class Signal(NamedTuple):
    """The values of a field, NaN where it has none."""

    name: str
    times: Sequence[float]
    values: Sequence[float]


class Stop(NamedTuple):
    """A place where the robot stood, and for how long (s)."""

    x: float
    y: float
    length: float


@dataclass(frozen=True, slots=True)
class DrawnPath:
    """A driven path in a frame: where (m) and when, and which points the robot jumped to."""

    frame: str
    times: tuple[float, ...]
    xs: tuple[float, ...]
    ys: tuple[float, ...]
    jumps: tuple[bool, ...]

    def at(self, time: float) -> tuple[float, float]:
        """Returns where the robot was, between two points on the line between them."""
        return (
            float(np.interp(time, self.times, self.xs)),
            float(np.interp(time, self.times, self.ys)),
        )


FoundPath: TypeAlias = tuple[DrawnPath, str, "Sequence[str]"]
"""A path, a line on it, and notes."""


@dataclass(frozen=True, slots=True)
class Scene:
    """What all pictures are asked for: a memory, a window in it, and its bounds in Unix seconds."""

    memory: Memory
    view: View
    window: TimeWindow

    @property
    def span(self) -> tuple[float, float]:
        """The bounds (inclusive) of the window."""
        return unix_from_ns(self.window.start), unix_from_ns(self.window.stop - 1)

    @property
    def range(self) -> TimeRange:
        """The window as queries take it."""
        return TimeRange.over(self.window)

    @property
    def title(self) -> str:
        """The bounds of the window, for people: `2026-11-21 08:00:00 - 18:30:00 CET`."""
        start, end = (datetime.fromtimestamp(each).astimezone() for each in self.span)
        until = f"{end:%H:%M:%S}" if end.date() == start.date() else f"{end:%Y-%m-%d %H:%M:%S}"
        return f"{start:%Y-%m-%d %H:%M:%S} - {until} {end:%Z}"


def opened(memory: Memory, window: TimeWindow) -> Scene:
    """Returns what is asked for, as far as the memory spans it.

    Raises:
        NoDataError: nothing is recorded, or nothing of that time.
    """
    view = View(memory, Call())
    require_bags(view)
    earliest, latest = view.snapshot.dating.earliest, view.snapshot.dating.latest
    if earliest is None or latest is None:
        earliest, latest = view.snapshot.bags[0].start, view.snapshot.bags[-1].end
    within = window.intersect(TimeWindow(earliest, latest + 1))
    if within.empty:
        raise NoDataError(
            NoDataReason.OUTSIDE_RANGE,
            "nothing was recorded in this time: `ros2-memory info` shows what is recorded",
        )
    return Scene(memory, view, within)


def recap_in(asked: Scene) -> Recap | None:
    """Returns what happened; None where the window has no length."""
    try:
        return recap(asked.memory, Call(), asked.range)
    except InvalidArgumentsError:
        return None


def path_in(
    asked: Scene, topic: str | None, frame: str | None
) -> tuple[DrawnPath, str, Sequence[str]]:
    """Returns the path, a line on it, and notes; in the map where transforms lead there.

    Without a topic of poses, by transforms or by a satellite receiver.

    Raises:
        InvalidArgumentsError: the topic has no poses, or nothing places them in the frame.
        NoDataError: there is none in this time.
    """
    by_transforms = topic is None and body_by_transforms(asked.view) is not None
    if topic is not None or by_transforms:
        other = _path_without_poses(asked.view, asked.window, topic, frame)
        if other is not None:
            return other
    map_frame = asked.memory.limits.map_frame
    for each in (frame,) if frame is not None else (map_frame, None):
        try:
            found = trajectory_summary(
                asked.memory,
                Call(),
                asked.range,
                topic=topic,
                frame_id=each,
                max_waypoints=_MOST_WAYPOINTS,
            )
            break
        except NoDataError as error:
            is_unknown = topic is None and error.reason is NoDataReason.TOPIC_NOT_RECORDED
            if is_unknown and (other := _path_without_poses(asked.view, asked.window, None, frame)):
                return other
            detail = error.detail.replace(GIVE_TOPIC, "give --topic").replace(
                "; give topic", "; give --topic"
            )
            raise NoDataError(error.reason, detail, error.notes) from error
        except InvalidArgumentsError:
            if each is None or each == frame:
                raise
    points = _every_pose(asked, found) or found.trajectory.waypoints
    if not points:
        raise NoDataError(NoDataReason.OUTSIDE_RANGE, f"no pose of {found.topic} has a place")
    totals = found.trajectory.totals
    path = DrawnPath(
        found.frame_id,
        tuple(unix_from_ns(each.time) for each in points),
        tuple(each.position[0] for each in points),
        tuple(each.position[1] for each in points),
        tuple(each.jump for each in points),
    )
    line = (
        f"{totals.distance_m:.1f} m in {format_duration(unix_from_ns(found.end - found.start))}, "
        f"at most {found.trajectory.max_speed:.2f} m/s; by {found.topic}"
    )
    return path, line, found.notes


def _path_without_poses(
    view: View, window: TimeWindow, topic: str | None, frame: str | None
) -> FoundPath | None:
    """Returns the path by transforms or by fixes, if that is what the topic has, or all there is.

    `topic`: None where the topic of poses is not recorded.

    Raises:
        NoDataError: there is nothing of it in this time, or it leads to no frame.
    """
    fixes = [each.partition(" ")[0] for each in topics_with(view, "geodetic")]
    body = robot_body(view)
    if topic is not None:
        if topic in fixes:
            return _by_fixes(view, window, topic)
        if body is None or topic not in view.memory.limits.tf_topics:
            return None
        return _by_transforms(view, window, body, frame)
    if topics_with(view, "position") or topics_that_show_poses(view):
        return None
    if body is not None:
        return _by_transforms(view, window, body, frame)
    return _by_fixes(view, window, fixes[0]) if fixes else None


def _by_transforms(
    view: View, window: TimeWindow, found_body: Body, frame: str | None
) -> FoundPath:
    """Returns the path of the robot's body in the map, or in the root of its frames."""
    parent, body, others = found_body
    parent = parent if frame is None else frame
    found: list[tuple[Ns, float, float]] = []
    failure: NoDataError | None = None
    for at in np.linspace(window.start, window.stop - 1, _MOST_MOMENTS).astype(np.int64).tolist():
        try:
            explains = failure is None
            x, y, _ = transform_at(view, parent, body, at, explains=explains).transform.translation
        except NoDataError as error:
            failure = failure or error
            continue
        found.append((at, x, y))
    if not found:
        raise failure or NoDataError(NoDataReason.OUTSIDE_RANGE, "no transform in this time")
    path = _drawn(parent, found)
    notes = [*view.notes.sentences()]
    if others:
        notes.append(f"other frames that move: {', '.join(others[:5])}; get_transform_at has them")
    by = f"{body} in {parent} by transforms, at {len(found)} times"
    return path, f"{_line(path)}; {by}", notes


def _by_fixes(view: View, window: TimeWindow, topic: str) -> FoundPath:
    """Returns the path of a satellite receiver, in metres east and north of its first fix."""
    total, fixes = fixes_in(view, topic, window)
    if not fixes:
        raise NoDataError(NoDataReason.OUTSIDE_RANGE, f"no message of {topic} has a position")
    first = fixes[0][1]
    path = _drawn(
        local_frame(first),
        [(at, *east_north(first, fix)) for at, fix in fixes],
    )
    return (
        path,
        f"{_line(path)}; by {len(fixes)} of {total} fixes of {topic}",
        view.notes.sentences(),
    )


def _drawn(frame: str, points: Sequence[tuple[Ns, float, float]]) -> DrawnPath:
    times, xs, ys = zip(*points, strict=True)
    return DrawnPath(frame, tuple(map(unix_from_ns, times)), xs, ys, (False,) * len(points))


def _line(path: DrawnPath) -> str:
    points = [*zip(path.xs, path.ys, strict=True)]
    driven = sum(math.dist(one, other) for one, other in pairwise(points))
    return f"{driven:.1f} m in {format_duration(path.times[-1] - path.times[0])}"


def _every_pose(asked: Scene, found: TrajectorySummary) -> Sequence[Waypoint]:
    """Returns a waypoint for each pose, where these are few; else none.

    Waypoints of the trajectory leave out what is within some centimetres of a line, so that a curve
    would be drawn with corners.
    """
    view, extractor = asked.view, asked.memory.extractor
    stored = view.stream.messages([found.topic], asked.window)
    messages = [*islice(stored, _MOST_WAYPOINTS + 1)]
    if len(messages) > _MOST_WAYPOINTS or found.skipped:
        return ()
    jumps = {each.time for each in found.trajectory.waypoints if each.jump}
    frames, waypoints = set[str](), list[Waypoint]()
    for each in messages:
        message = view.bags.decode(each)
        pose = None if message is None else extractor.pose(message, each.record.channel.type)
        if pose is not None and all(map(math.isfinite, pose.position)):
            frames.add(pose.frame_id)
            waypoints.append(Waypoint(each.time, pose.position, 0.0, jump=each.time in jumps))
    if len(frames) != 1:
        return ()
    [own] = frames
    if own == found.frame_id:
        return waypoints
    return placed_waypoints(view, found.topic, waypoints, own, found.frame_id)


def places_in(memory: Memory, frame: str) -> list[Place]:
    """Returns the named places of a frame."""
    return [each for each in memory.limits.places if each.frame_id == frame]


def stops_along(found: Recap | None, path: DrawnPath) -> list[Stop]:
    """Returns where the robot stood, by the path at that time."""
    stops: list[Stop] = []
    for each in () if found is None else found.events:
        if each.kind == "stop" and each.end is not None:
            x, y = path.at(unix_from_ns((each.start + each.end) // 2))
            stops.append(Stop(x, y, unix_from_ns(each.end - each.start)))
    return stops


def signals_of(
    asked: Scene, topic: str, fields: Sequence[str]
) -> tuple[int, list[Signal], list[str]]:
    """Returns how many messages there are, numeric fields of them, and notes.

    Raises:
        InvalidArgumentsError: there is no such field, or it holds no number.
        NoDataError: there is no message in this time, or none can be decoded.
    """
    view, extractor = asked.view, asked.memory.extractor
    total, picked = view.pick(topic, asked.window, _MOST_SAMPLES)
    messages = [*picked]
    decoded = [(each, view.bags.decode(each)) for each in messages]
    readable = [(each, message) for each, message in decoded if message is not None]
    if not readable:
        what = "can be decoded" if messages else "is in this time"
        raise NoDataError(NoDataReason.OUTSIDE_RANGE, f"no message of {topic} {what}")
    first, message = readable[0]
    type_name = first.record.channel.type
    extractor.shown(message, type_name, fields)  # refuses fields that there are not
    notes = [*view.notes.sentences()]
    if not fields:
        varying = _varying([extractor.exact(each, type_name) for _, each in readable])
        fields = varying[:_MOST_SIGNALS]
        if len(varying) > len(fields):
            notes.append(f"not drawn: {listed(varying[_MOST_SIGNALS:])}; name them with --field")
    if total > len(messages):
        notes.append(f"{len(messages)} of {total} messages are drawn, evenly spaced")
    signals: list[Signal] = []
    for name in fields:
        points = [
            (each.time, _number(extractor.exact_at(message, each.record.channel.type, name)))
            for each, message in readable
        ]
        if all(math.isnan(value) for _, value in points):
            raise InvalidArgumentsError(f"{name} of {topic} holds no number")
        broken = [*_with_breaks(points)]
        times, values = zip(*broken, strict=True)
        signals.append(Signal(name, [unix_from_ns(each) for each in times], values))
    if not signals:
        raise InvalidArgumentsError(f"{topic} ({type_name}) has no numeric field")
    return total, signals, notes


def _varying(values: Sequence[JsonValue]) -> list[str]:
    """Returns the numeric fields that change; all of the first value where none does."""
    first = dict(_numbers(values[0]))
    changing = {
        name
        for value in values
        for name, number in _numbers(value)
        if name in first and number != first[name] and not math.isnan(number)
    }
    known = [name for name, number in first.items() if not math.isnan(number)]
    return [name for name in first if name in changing] or known


def _numbers(value: JsonValue, name: str = "") -> Iterator[tuple[str, float]]:
    """Yields the numeric fields of a value, with dot-paths."""
    if isinstance(value, dict):
        for key, each in value.items():
            yield from _numbers(each, f"{name}.{key}" if name else key)
    elif isinstance(value, bool | int | float):
        yield name, float(value)


def _number(value: JsonValue) -> float:
    return float(value) if isinstance(value, bool | int | float) else math.nan


def _with_breaks(points: Sequence[tuple[Ns, float]]) -> Iterator[tuple[Ns, float]]:
    """Yields points, and NaN where there was none for much longer than usual."""
    steps = sorted(after - before for (before, _), (after, _) in pairwise(points))
    usual = steps[len(steps) // 2] if steps else 0
    longest = max(_PERIODS * usual, ns_from_unix(1.0))
    before: Ns | None = None
    for at, value in points:
        if before is not None and at - before > longest:
            yield before + 1, math.nan
        yield at, value
        before = at


def event_rows(asked: Scene, found: Recap | None) -> list[TimelineRow]:
    """Returns a row of what was recorded, and one for each kind of event that occurs."""
    span = asked.window.start, asked.window.stop - 1
    recorded = without([span], [*recording_gaps(asked.view, asked.window)])
    rows = [TimelineRow("recorded", [*map(_unix, recorded)], _COLORS["recorded"])]
    events: dict[str, list[Event]] = {}
    for each in () if found is None else found.events:
        events.setdefault(each.kind, []).append(each)
    for kind, name in _ROWS.items():
        if kind in events:
            stretches = [_unix((each.start, _until(each))) for each in events[kind]]
            rows.append(TimelineRow(name, stretches, _COLORS[kind]))
    return rows


def _unix(span: tuple[Ns, Ns]) -> tuple[float, float]:
    return unix_from_ns(span[0]), unix_from_ns(span[1])


def _until(event: Event) -> Ns:
    """Returns when an event was over; what a flip led to is not a part of it."""
    return event.start if event.end is None or event.kind == "flip" else event.end


def topic_rows(asked: Scene) -> Iterator[TimelineRow]:
    """Yields when each topic was recorded, of the topics with the most messages, by name."""
    timeline = asked.view.snapshot.timeline
    messages = {
        topic: sum(each.messages for each in timeline.totals(topic).values())
        for topic in timeline.topics()
    }
    busiest = sorted(messages, key=lambda topic: -messages[topic])[:MOST_TOPICS]
    joined = ns_from_unix(2 * asked.memory.limits.split_duration_s)
    for topic in sorted(busiest):
        extents = ((first, last) for _, first, last in timeline.extents(topic, asked.window))
        yield TimelineRow(topic, [*map(_unix, united(extents, joined))], _TOPIC)


def totals_line(found: Recap | None) -> str:
    """Returns distance, speed and time of standing in a line, as far as they are known."""
    parts: list[str] = []
    if found is not None and found.distance_m is not None and found.max_speed is not None:
        parts = [f"{found.distance_m:.1f} m driven", f"at most {found.max_speed:.2f} m/s"]
    if found is not None and found.stood is not None:
        parts.append(f"stood {format_duration(unix_from_ns(found.stood))}")
    if found is not None:
        parts += [f"{count} {name}" for name, count in found.counts]
    return ", ".join(parts)


def event_lines(found: Recap | None) -> Iterator[str]:
    """Yields each event in a line, with the time of day, and how long it took."""
    if found is None or not found.events:
        yield "no events"
        return
    for each in found.events:
        at = datetime.fromtimestamp(unix_from_ns(each.start)).astimezone()
        length = unix_from_ns(_until(each) - each.start)
        took = f" ({format_duration(length)})" if length >= 1 else ""
        where = f", in {each.places[0]}" if each.places else ""
        yield f"{at:%H:%M:%S}  {each.text}{where}{took}"
