"""`ros2-memory plot`: pictures of what is recorded, by the same queries as the tools.

Times are Unix seconds.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import datetime
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import Annotated, Final, NamedTuple

import numpy as np
import typer
from numpy.typing import NDArray

from ros2_memory.cli.app import epilog
from ros2_memory.cli.options import AsJson, Bags, Times, as_command, day_of
from ros2_memory.cli.output import (
    format_duration,
    leaves,
    print_json,
    print_line,
    print_notes,
    spinner,
)
from ros2_memory.core.errors import ConfigError, InvalidArgumentsError, NoDataError, NoDataReason
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.regions import Place
from ros2_memory.core.spans import united, without
from ros2_memory.core.text import counted, listed
from ros2_memory.core.timebase import NS_PER_S, Ns, ns_from_unix, unix_from_ns
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.counting import pick
from ros2_memory.history.coverage import recording_gaps
from ros2_memory.history.driven_path import robot_body
from ros2_memory.history.no_data import (
    GIVE_TOPIC,
    require_bags,
    resolve_topic,
    topics_that_show_poses,
    topics_with,
)
from ros2_memory.history.view import TimeRange, View
from ros2_memory.insights.recap import recap
from ros2_memory.places.local_map import east_north, fixes_in, local_frame
from ros2_memory.places.robot_tracks import RobotTracks
from ros2_memory.queries import trajectory_summary
from ros2_memory.results import Event, Recap

FORMATS: Final = (".svg", ".png", ".pdf")
_MOST_WAYPOINTS: Final = 4000
"""Of a path; one of no more poses is drawn through each of them."""
_MOST_SAMPLES: Final = 20_000
"""Messages of a signal that are drawn, evenly spaced: some for each column of a wide picture."""
_MOST_SIGNALS: Final = 6
_MOST_TOPICS: Final = 30
_PERIODS: Final = 5
"""A signal has a gap, and its line is broken, after so many of its usual periods, and a second."""
_RECORDED: Final = "#3b82a0"
_TOPIC: Final = "#94a3b8"
_ROWS: Final = {
    "gap": ("gaps", "#dc2626"),
    "clock step": ("clock steps", "#111827"),
    "silence": ("silences", "#f97316"),
    "stop": ("stood", "#f59e0b"),
    "goal": ("goals", "#059669"),
    "failed goal": ("failed goals", "#be123c"),
    "error": ("errors", "#dc2626"),
    "drop": ("speed drops", "#db2777"),
    "flip": ("on/off", "#0891b2"),
    "thing": ("things in view", "#7c3aed"),
}
"""The kinds of events in a recap: the name and the colour of each one's row, in their order."""

plot = typer.Typer(
    help="Draw the driven path, a signal, what was recorded when, or a day.",
    no_args_is_help=True,
    rich_markup_mode=None,
)

Out = Annotated[
    Path,
    "--out",
    "-o",
    "FILE",
    "Write the picture here: .svg, .png or .pdf; overwrites the file.",
]


class TimelineRow(NamedTuple):
    """A row of a timeline: stretches from one time to another; equal ones are a moment."""

    name: str
    stretches: Sequence[tuple[float, float]]
    color: str


class Signal(NamedTuple):
    """The values of a field, NaN where it has none."""

    name: str
    times: NDArray[np.float64]
    values: NDArray[np.float64]


class DrawnPath(NamedTuple):
    """A path in a frame: where (m) and when, which points the robot jumped to; a line on it."""

    frame: str
    times: NDArray[np.float64]
    xs: NDArray[np.float64]
    ys: NDArray[np.float64]
    jumps: NDArray[np.bool_]
    line: str
    notes: Sequence[str]

    def stops(self, found: Recap) -> list[tuple[float, float, float]]:
        """Returns where the robot stood (x, y in m), by the path at that time; and how long (s)."""
        stops = [
            (event.start, event.end)
            for event in found.events
            if event.kind == "stop" and event.end is not None
        ]
        middles = [unix_from_ns((start + end) // 2) for start, end in stops]
        xs, ys = (np.interp(middles, self.times, axis).tolist() for axis in (self.xs, self.ys))
        return [*zip(xs, ys, [unix_from_ns(end - start) for start, end in stops], strict=True)]


class Asked(NamedTuple):
    """What all pictures are asked for: a memory, and a window in it."""

    memory: Memory
    view: View
    window: TimeWindow

    @property
    def span(self) -> tuple[float, float]:
        """The bounds (inclusive) of the window."""
        return _unix((self.window.start, self.window.stop - 1))

    @property
    def title(self) -> str:
        """The bounds of the window, for people: `2026-11-21 08:00:00 - 18:30:00 CET`."""
        start, end = (datetime.fromtimestamp(at).astimezone() for at in self.span)
        until = f"{end:%H:%M:%S}" if end.date() == start.date() else f"{end:%Y-%m-%d %H:%M:%S}"
        return f"{start:%Y-%m-%d %H:%M:%S} - {until} {end:%Z}"

    def recap(self) -> Recap:
        """Returns what happened."""
        return recap(self.memory, Call(), TimeRange.over(self.window))

    def places(self, frame: str) -> list[Place]:
        """Returns the named places of a frame."""
        return [place for place in self.memory.limits.places if place.frame_id == frame]


@plot.command("path", epilog=epilog("plot"))
@as_command("plot path")
def plot_path(
    *,
    out: Out,
    times: Times,
    topic: Annotated[
        str | None,
        "TOPIC",
        "The topic of the poses (default: data.pose_topic).",
    ] = None,
    frame: Annotated[
        str | None,
        "FRAME",
        "The frame to draw in (default: data.map_frame, or the frame of the poses).",
    ] = None,
    as_json: AsJson = False,
    bags: Bags,
) -> None:
    """Draw the driven path in 2D, coloured by time, with named places and standstills."""
    asked = _asked(out, bags, times)
    from ros2_memory.cli import drawing  # noqa: PLC0415 - an extra that few install

    with spinner("looking for the path"):
        path = path_in(asked, topic, frame)
        stops = path.stops(asked.recap())
    with drawing.picture(out, f"Path, {asked.title}", path.line, (8.5, 7.0)) as figure:
        drawing.draw_path(figure.add_subplot(), path, asked.places(path.frame), stops)
    _finish(out, path.notes, as_json=as_json)


@plot.command("signal", epilog=epilog("plot"))
@as_command("plot signal")
def plot_signal(
    topic: Annotated[
        str, typer.Argument(metavar="TOPIC", help="The name of the topic, such as /battery.")
    ],
    *,
    out: Out,
    field: Annotated[
        list[str] | None,
        "PATH",
        "A numeric field; repeatable (default: all that change).",
    ] = None,
    times: Times,
    as_json: AsJson = False,
    bags: Bags,
) -> None:
    """Draw numeric fields of a topic over time, one row for each field."""
    topic, bags = bags.with_topic(topic, "plot signal")
    asked = _asked(out, bags, times)
    from ros2_memory.cli import drawing  # noqa: PLC0415 - an extra that few install

    name = resolve_topic(asked.view, topic)
    with spinner(f"reading {name}"):
        total, signals, notes = signals_of(asked, name, field or ())
    title, size = f"{name}, {asked.title}", (10.0, 1.2 + 1.9 * len(signals))
    with drawing.picture(out, title, counted(total, "message"), size) as figure:
        drawing.draw_signals(figure, signals, asked.span)
    _finish(out, notes, as_json=as_json)


@plot.command("timeline", epilog=epilog("plot"))
@as_command("plot timeline")
def plot_timeline(*, out: Out, times: Times, as_json: AsJson = False, bags: Bags) -> None:
    """Draw what was recorded when: gaps, silences and events, and one row for each topic."""
    asked = _asked(out, bags, times)
    from ros2_memory.cli import drawing  # noqa: PLC0415 - an extra that few install

    with spinner("looking what was recorded when"):
        found = asked.recap()
        rows = [*event_rows(asked, found), *topic_rows(asked)]
    left_out = len(asked.view.timeline.topics()) - _MOST_TOPICS
    subtitle = f"without the {counted(left_out, 'rarest topic')}" if left_out > 0 else ""
    size = (11.0, 1.3 + 0.27 * len(rows))
    with drawing.picture(out, f"Recorded, {asked.title}", subtitle, size) as figure:
        drawing.draw_rows(figure.add_subplot(), rows, asked.span)
    _finish(out, found.notes, as_json=as_json)


@plot.command("recap", epilog=epilog("plot"))
@as_command("plot recap")
def plot_recap(
    *,
    out: Out,
    day: Annotated[
        str | None,
        "TIME",
        "today, yesterday or a date, 2026-11-20 (default: the newest day).",
    ] = None,
    times: Times,
    as_json: AsJson = False,
    bags: Bags,
) -> None:
    """Draw a day in one picture: where the robot drove, what happened, what was recorded."""
    if day is not None and times != Times():
        raise InvalidArgumentsError("give --day, or --start, --end and --last, not both")
    asked = _asked(out, bags, times if times != Times() else day)
    from ros2_memory.cli import drawing  # noqa: PLC0415 - an extra that few install

    with spinner("recalling the day"):
        found = asked.recap()
        rows = event_rows(asked, found)
        path: DrawnPath | str
        try:
            path = path_in(asked, None, None)
        except (InvalidArgumentsError, NoDataError) as error:
            path = f"the path is unknown: {error}"
    with drawing.picture(out, f"Recap, {asked.title}", _totals(found), (12.0, 8.0)) as figure:
        plane = drawing.draw_recap(figure, rows, asked.span, _event_lines(found))
        if isinstance(path, str):
            drawing.write_instead(plane, path)
        else:
            drawing.draw_path(plane, path, asked.places(path.frame), path.stops(found))
            plane.set_adjustable("datalim")  # it fills its part of the picture
    _finish(out, found.notes, as_json=as_json)


def _asked(out: Path, bags: Bags, when: Times | str | None) -> Asked:
    """Returns what is asked for, in a window or on a day; checks that it can be drawn.

    Raises:
        ConfigError: the optional dependency is missing.
        InvalidArgumentsError: the name has a suffix of no picture.
    """
    if find_spec("matplotlib") is None:
        raise ConfigError(
            "pictures need the optional part of this package (no matplotlib): pip install '.[plot]'"
        )
    if out.suffix.lower() not in FORMATS:
        kinds = ", ".join(FORMATS)
        raise InvalidArgumentsError(f"--out {out} is not a picture: its name must end in {kinds}")
    memory = bags.memory()
    return opened(memory, when.window(memory) if isinstance(when, Times) else day_of(memory, when))


def _finish(out: Path, notes: Sequence[str], *, as_json: bool) -> None:
    if as_json:
        print_json({"path": str(out), "notes": [*notes]})
    else:
        print_line(str(out))
        print_notes(notes)


def opened(memory: Memory, window: TimeWindow) -> Asked:
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
    return Asked(memory, view, within)


def path_in(asked: Asked, topic: str | None, frame: str | None) -> DrawnPath:
    """Returns the path; in the map where transforms lead there.

    Without a topic of poses and transforms, that of a satellite receiver.

    Raises:
        InvalidArgumentsError: the topic has no poses, or nothing places them in the frame.
        NoDataError: there is none in this time.
    """
    view = asked.view
    receivers = [named.partition(" ")[0] for named in topics_with(view, "geodetic")]
    if topic is None and not (
        topics_with(view, "position") or topics_that_show_poses(view) or robot_body(view)
    ):
        topic = next(iter(receivers), None)
    if topic in receivers:
        return _path_by_fixes(asked, topic)
    for wanted in (frame,) if frame is not None else (asked.memory.limits.map_frame, None):
        try:
            found = trajectory_summary(
                asked.memory,
                Call(),
                TimeRange.over(asked.window),
                topic=topic,
                frame_id=wanted,
                max_waypoints=_MOST_WAYPOINTS,
            )
            break
        except NoDataError as error:
            detail = error.detail.replace(GIVE_TOPIC, "give --topic").replace(
                "; give topic", "; give --topic"
            )
            raise NoDataError(error.reason, detail, error.notes) from error
        except InvalidArgumentsError:
            if wanted is None or wanted == frame:
                raise
    fastest = found.trajectory.max_speed
    line = (
        f"{found.trajectory.totals.distance_m:.1f} m in "
        f"{format_duration(unix_from_ns(found.end - found.start))}"
        f"{'' if fastest is None else f', at most {fastest:.2f} m/s'}; by {found.topic}"
    )
    vertices = found.trajectory.waypoints
    times = np.array([vertex.time for vertex in vertices])
    xs, ys = (np.array([vertex.position[axis] for vertex in vertices]) for axis in (0, 1))
    jumps = times[[vertex.jump for vertex in vertices]]
    if found.trajectory.poses <= _MOST_WAYPOINTS and not found.skipped:
        # Waypoints leave out what is within 5 cm of a line: a curve would have corners.
        limits = replace(asked.memory.limits, pose_topic=found.topic)
        view = View(replace(asked.memory, limits=limits), Call())
        poses = RobotTracks(view, found.frame_id).poses(asked.window)
        placed = np.isfinite(poses.x) & np.isfinite(poses.y)
        times, xs, ys = poses.times[placed], poses.x[placed], poses.y[placed]
    if not len(times):
        raise NoDataError(NoDataReason.OUTSIDE_RANGE, f"no pose of {found.topic} has a place")
    jumped = np.isin(times, jumps)
    return DrawnPath(found.frame_id, times / NS_PER_S, xs, ys, jumped, line, found.notes)


def _path_by_fixes(asked: Asked, topic: str) -> DrawnPath:
    """Returns the path of a satellite receiver, in metres east and north of its first fix."""
    total, fixes = fixes_in(asked.view, topic, asked.window)
    if not fixes:
        raise NoDataError(NoDataReason.OUTSIDE_RANGE, f"no message of {topic} has a position")
    first = fixes[0][1]
    times = np.array([at for at, _ in fixes]) / NS_PER_S
    xs, ys = np.array([east_north(first, fix) for _, fix in fixes]).T
    driven, lasted = np.hypot(np.diff(xs), np.diff(ys)).sum(), format_duration(np.ptp(times))
    line = f"{driven:.1f} m in {lasted}; by {len(fixes)} of {total} fixes of {topic}"
    jumps = np.zeros(len(fixes), bool)
    return DrawnPath(local_frame(first), times, xs, ys, jumps, line, asked.view.notes.sentences())


def signals_of(
    asked: Asked, topic: str, fields: Sequence[str]
) -> tuple[int, list[Signal], list[str]]:
    """Returns how many messages there are, numeric fields of them, and notes.

    Raises:
        InvalidArgumentsError: there is no such field, or it holds no number.
        NoDataError: there is no message in this time, or none can be decoded.
    """
    view, extractor = asked.view, asked.memory.extractor
    total, picked = pick(view, topic, asked.window, _MOST_SAMPLES)
    messages = [(stored, view.bags.decode(stored)) for stored in picked]
    readable = [(stored, message) for stored, message in messages if message is not None]
    if not readable:
        what = "can be decoded" if messages else "is in this time"
        raise NoDataError(NoDataReason.OUTSIDE_RANGE, f"no message of {topic} {what}")
    first, message = readable[0]
    type_name = first.record.channel.type
    extractor.shown(message, type_name, fields)  # refuses fields that there are not
    notes = [*view.notes.sentences()]
    if not fields:
        varying = _varying([extractor.exact(message, type_name) for _, message in readable])
        fields = varying[:_MOST_SIGNALS]
        if len(varying) > len(fields):
            notes.append(f"not drawn: {listed(varying[_MOST_SIGNALS:])}; name them with --field")
    if not fields:
        raise InvalidArgumentsError(f"{topic} ({type_name}) has no numeric field")
    if total > len(messages):
        notes.append(f"{len(messages)} of {total} messages are drawn, evenly spaced")
    times = np.array([stored.time for stored, _ in readable])
    signals: list[Signal] = []
    for name in fields:
        found = [extractor.exact_at(message, stored.type, name) for stored, message in readable]
        values = [float(one) if isinstance(one, bool | int | float) else math.nan for one in found]
        if all(map(math.isnan, values)):
            raise InvalidArgumentsError(f"{name} of {topic} holds no number")
        signals.append(Signal(name, *_with_breaks(times, values)))
    return total, signals, notes


def _varying(values: Sequence[JsonValue]) -> list[str]:
    """Returns the numeric fields that change; all of the first value where none does."""
    first: dict[str, float] = {}
    changing: set[str] = set()
    for name, number in chain.from_iterable(map(_numbers, values)):
        if not math.isnan(number) and first.setdefault(name, number) != number:
            changing.add(name)
    return [name for name in first if name in changing] or [*first]


def _numbers(value: JsonValue) -> Iterator[tuple[str, float]]:
    """Yields the numeric fields of a value, with dot-paths."""
    for name, inner in leaves(value):
        if isinstance(inner, bool | int | float):
            yield name, float(inner)


def _with_breaks(
    times: NDArray[np.int64], values: Sequence[float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns points in seconds, and NaN where there was none for much longer than usual."""
    steps = np.diff(times)
    usual = np.sort(steps)[len(steps) // 2] if len(steps) else 0
    broken = np.flatnonzero(steps > max(_PERIODS * usual, NS_PER_S)) + 1
    shown = np.insert(times, broken, times[broken - 1] + 1) / NS_PER_S
    return shown, np.insert(np.array(values), broken, math.nan)


def event_rows(asked: Asked, found: Recap) -> list[TimelineRow]:
    """Returns a row of what was recorded, and one for each kind of event that occurs."""
    span = asked.window.start, asked.window.stop - 1
    recorded = without([span], [*recording_gaps(asked.view, asked.window)])
    rows = [TimelineRow("recorded", [*map(_unix, recorded)], _RECORDED)]
    for kind, (name, color) in _ROWS.items():
        stretches = [
            _unix((event.start, _until(event))) for event in found.events if event.kind == kind
        ]
        if stretches:
            rows.append(TimelineRow(name, stretches, color))
    return rows


def _unix(span: tuple[Ns, Ns]) -> tuple[float, float]:
    return unix_from_ns(span[0]), unix_from_ns(span[1])


def _until(event: Event) -> Ns:
    """Returns when an event was over; what a flip led to is not a part of it."""
    return event.start if event.end is None or event.kind == "flip" else event.end


def topic_rows(asked: Asked) -> Iterator[TimelineRow]:
    """Yields when each topic was recorded, of the topics with the most messages, by name."""
    timeline = asked.view.timeline
    messages = {
        topic: sum(totals.messages for totals in timeline.totals(topic).values())
        for topic in timeline.topics()
    }
    joined = ns_from_unix(2 * asked.memory.limits.split_duration_s)
    for topic in sorted(sorted(messages, key=lambda topic: -messages[topic])[:_MOST_TOPICS]):
        extents = ((first, last) for _, first, last in timeline.extents(topic, asked.window))
        yield TimelineRow(topic, [*map(_unix, united(extents, joined))], _TOPIC)


def _totals(found: Recap) -> str:
    """Returns distance, speed and time of standing in a line, as far as they are known."""
    parts: list[str] = []
    if found.distance_m is not None and found.max_speed is not None:
        parts = [f"{found.distance_m:.1f} m driven", f"at most {found.max_speed:.2f} m/s"]
    if found.stood is not None:
        parts.append(f"stood {format_duration(unix_from_ns(found.stood))}")
    return ", ".join([*parts, *(f"{count} {name}" for name, count in found.counts)])


def _event_lines(found: Recap) -> Iterator[str]:
    """Yields each event in a line, with the time of day, and how long it took."""
    if not found.events:
        yield "no events"
    for event in found.events:
        at = datetime.fromtimestamp(unix_from_ns(event.start)).astimezone()
        length = unix_from_ns(_until(event) - event.start)
        took = f" ({format_duration(length)})" if length >= 1 else ""
        where = f", in {event.places[0]}" if event.places else ""
        yield f"{at:%H:%M:%S}  {event.text}{where}{took}"
