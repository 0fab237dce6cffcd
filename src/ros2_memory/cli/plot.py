"""`ros2-memory plot`: pictures of what is recorded, by the same queries as the tools.

Times are Unix seconds. No window is opened, and nothing is written but the picture and what
matplotlib keeps in its own folders, its list of fonts.
"""

import logging
import math
import textwrap
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple, TypeAlias

import numpy as np
import typer
from numpy.typing import NDArray

from ros2_memory.bootstrap import require_extra
from ros2_memory.cli.app import epilog
from ros2_memory.cli.cat import extracted
from ros2_memory.cli.options import AsJson, Bags, Times, as_command, day_of
from ros2_memory.cli.output import (
    format_duration,
    leaves,
    made_whole,
    print_json,
    print_line,
    print_notes,
    spinner,
)
from ros2_memory.config_sources import quoted
from ros2_memory.core.errors import InvalidArgumentsError, NoDataError, NoDataReason
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.regions import Circle, Polygon
from ros2_memory.core.spans import united, without
from ros2_memory.core.text import counted, listed, shortened
from ros2_memory.core.timebase import NS_PER_S, Ns, ns_from_unix, unix_from_ns
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.coverage import recording_gaps
from ros2_memory.history.driven_path import resolve_path_topic
from ros2_memory.history.no_data import (
    no_data_between,
    require_bags,
    resolve_topic,
    topics_with,
)
from ros2_memory.history.scan import pick
from ros2_memory.history.view import TimeRange, View
from ros2_memory.insights.recap import recap
from ros2_memory.places.pose_frames import robot_places
from ros2_memory.results import Event, Recap
from ros2_memory.serving.page.drawn_path import Box, line_in_box

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

FORMATS: Final = (".svg", ".png", ".pdf")
_PIXEL_M: Final = 0.001
"""As exactly the path is drawn."""
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
_STYLE: Final = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "figure.titlesize": 11,
    "font.size": 9,
    "grid.color": "#e5e7eb",
    "svg.hashsalt": "ros2-memory",
    "text.parse_math": False,  # or a dollar sign in a name would begin a formula
}
_GREY: Final = "#9ca3af"
_DAY_S: Final = 86_400
_LEAST_SHARE: Final = 0.002
"""Of the width of a timeline: what is shorter is drawn as long."""
_LONGEST_NAME: Final = 34

Seconds: TypeAlias = tuple[float, float]
Floats: TypeAlias = NDArray[np.float64]
Row: TypeAlias = tuple[str, Sequence[Seconds], str]
"""A row of a timeline: its name, stretches (equal ones are a moment), and its colour."""

plot = typer.Typer(
    help="Draw the driven path, a signal, what was recorded when, or a day.",
    no_args_is_help=True,
    rich_markup_mode=None,
)

Out = Annotated[
    Path, "--out", "-o", "FILE", "Write the picture here: .svg, .png or .pdf; overwrites the file."
]


class DrawnPath(NamedTuple):
    """A path in a frame: when, and where (m); which points no line leads to."""

    frame: str
    times: Floats
    xs: Floats
    ys: Floats
    begins: NDArray[np.bool_]


class Asked(NamedTuple):
    """What all pictures are asked for: a window in a memory."""

    view: View
    window: TimeWindow

    @property
    def span(self) -> Seconds:
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
        return recap(self.view.memory, Call(), TimeRange.over(self.window))


@plot.command("path", epilog=epilog("plot"))
@as_command("plot path")
def plot_path(
    *,
    out: Out,
    times: Times,
    topic: Annotated[
        str | None, "TOPIC", "The topic of the poses (default: data.pose_topic)."
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
    chosen = {"data.pose_topic": topic, "data.map_frame": frame}
    given = [f"{key}={quoted(value)}" for key, value in chosen.items() if value is not None]
    asked = _checked_request(out, bags, times, *given)
    with spinner("looking for the path"):
        path, happened = path_in(asked, topic), asked.recap()
    if frame not in (None, path.frame):
        raise InvalidArgumentsError(f"--frame {frame}: no transform leads there from {path.frame}")
    with _picture(out, f"Path, {asked.title}", _totals(happened), (8.5, 7.0)) as figure:
        _draw_path(figure.add_subplot(), asked, path, happened)
    _finish(out, happened.notes, as_json=as_json)


@plot.command("signal", epilog=epilog("plot"))
@as_command("plot signal")
def plot_signal(
    topic: Annotated[
        str, typer.Argument(metavar="TOPIC", help="The name of the topic, such as /battery.")
    ],
    *,
    out: Out,
    field: Annotated[
        list[str] | None, "PATH", "A numeric field; repeatable (default: all that change)."
    ] = None,
    times: Times,
    as_json: AsJson = False,
    bags: Bags,
) -> None:
    """Draw numeric fields of a topic over time, one row for each field."""
    asked = _checked_request(out, bags, times)
    name = resolve_topic(asked.view, topic)
    with spinner(f"reading {name}"):
        total, signals, notes = signals_of(asked, name, field or ())
    title, size = f"{name}, {asked.title}", (10.0, 1.2 + 1.9 * len(signals))
    with _picture(out, title, counted(total, "message"), size) as figure:
        rows = figure.subplots(len(signals), 1, sharex=True, squeeze=False)[:, 0]
        for nth, (field_name, (at, values)) in enumerate(signals.items()):
            marker = "." if len(at) < 60 else ""
            rows[nth].plot(at / _DAY_S, values, color=f"C{nth}", linewidth=1.1, marker=marker)
            rows[nth].set_title(field_name)
            rows[nth].ticklabel_format(axis="y", useOffset=False)
        _label_times(rows[-1].xaxis, *asked.span)
    _finish(out, notes, as_json=as_json)


@plot.command("timeline", epilog=epilog("plot"))
@as_command("plot timeline")
def plot_timeline(*, out: Out, times: Times, as_json: AsJson = False, bags: Bags) -> None:
    """Draw what was recorded when: gaps, silences and events, and one row for each topic."""
    asked = _checked_request(out, bags, times)
    with spinner("looking what was recorded when"):
        happened = asked.recap()
        rows = [*event_rows(asked, happened), *topic_rows(asked)]
    left_out = len(asked.view.timeline.topics()) - _MOST_TOPICS
    subtitle = f"without the {counted(left_out, 'rarest topic')}" if left_out > 0 else ""
    size = (11.0, 1.3 + 0.27 * len(rows))
    with _picture(out, f"Recorded, {asked.title}", subtitle, size) as figure:
        _draw_rows(figure.add_subplot(), rows, asked.span)
    _finish(out, happened.notes, as_json=as_json)


@plot.command("recap", epilog=epilog("plot"))
@as_command("plot recap")
def plot_recap(
    *,
    out: Out,
    day: Annotated[
        str | None, "TIME", "today, yesterday or a date, 2026-11-20 (default: the newest day)."
    ] = None,
    times: Times,
    as_json: AsJson = False,
    bags: Bags,
) -> None:
    """Draw a day in one picture: where the robot drove, what happened, what was recorded."""
    if day is not None and times != Times():
        raise InvalidArgumentsError("give --day, or --start, --end and --last, not both")
    asked = _checked_request(out, bags, times if times != Times() else day)
    with spinner("recalling the day"):
        happened = asked.recap()
        rows = event_rows(asked, happened)
        path, why = None, ""
        try:
            path = path_in(asked)
        except (InvalidArgumentsError, NoDataError) as error:
            why = f"the path is unknown: {error}"
    with _picture(out, f"Recap, {asked.title}", _totals(happened), (12.0, 8.0)) as figure:
        height = 0.35 + 0.3 * len(rows)
        grid = figure.add_gridspec(
            2, 2, height_ratios=[max(7.0 - height, 3.0), height], width_ratios=[1.25, 1.0]
        )
        plane = figure.add_subplot(grid[0, 0])
        if path is None:
            _write_lines(plane, [why])
        else:
            _draw_path(plane, asked, path, happened)
        _write_lines(figure.add_subplot(grid[0, 1]), _event_lines(happened))
        _draw_rows(figure.add_subplot(grid[1, :]), rows, asked.span)
    _finish(out, happened.notes, as_json=as_json)


@contextmanager
def _picture(out: Path, title: str, subtitle: str, size: Seconds) -> Iterator["Figure"]:
    """Yields a figure, and writes what the block has drawn in the format that the suffix names.

    `subtitle` has the details of the whole, and `size` is its width and height in inches.

    Raises:
        OSError: it cannot be written.
    """
    # It warns of fonts, of its own limits, and where it finds no place for its list of fonts.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    from matplotlib import rc_context  # noqa: PLC0415 - an extra that few install
    from matplotlib.figure import Figure  # noqa: PLC0415

    with rc_context(_STYLE), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # on letters that no font here has
        figure = Figure(figsize=size, layout="constrained")
        figure.suptitle(f"{title}\n{subtitle}".rstrip(), x=0.01, ha="left")
        yield figure
        metadata = {"Date": None} if out.suffix.lower() == ".svg" else None
        with made_whole(out) as temporary:
            figure.savefig(temporary, format=out.suffix[1:].lower(), dpi=130, metadata=metadata)


def _draw_path(axes: "Axes", asked: Asked, path: DrawnPath, happened: Recap) -> None:
    """Draws a path, coloured by time, with named places and standstills of the same frame."""
    from matplotlib import patches  # noqa: PLC0415 - as above
    from matplotlib.collections import LineCollection  # noqa: PLC0415

    for place in asked.view.limits.places:
        if place.frame_id == path.frame:
            left, right, low, high = place.region.bounds
            outline: patches.Patch = patches.Rectangle((left, low), right - left, high - low)
            if isinstance(place.region, Polygon):
                outline = patches.Polygon(place.region.corners)
            elif isinstance(place.region, Circle):
                outline = patches.Circle((place.region.x, place.region.y), place.region.radius_m)
            outline.set(facecolor="#f3f4f6", edgecolor=_GREY)
            axes.add_patch(outline)
            middle = ((left + right) / 2, (low + high) / 2)
            axes.annotate(place.name, middle, ha="center", va="center", color="#6b7280", fontsize=8)
    points = np.column_stack([path.xs, path.ys])
    pieces, are_lines = np.stack([points[:-1], points[1:]], axis=1), ~path.begins[1:]
    days = path.times[:-1][are_lines] / _DAY_S
    lines = LineCollection([*pieces[are_lines]], array=days, cmap="viridis", linewidths=2.0)
    axes.add_collection(lines)
    axes.scatter(*points[0], s=60, marker="o", color="#16a34a", zorder=3, label="start")
    axes.scatter(*points[-1], s=60, marker="s", color="#dc2626", zorder=3, label="end")
    stops = [(stop.start, stop.end) for stop in happened.events if stop.kind == "stop" and stop.end]
    if stops:
        starts, ends = np.array(stops).T / NS_PER_S
        xs, ys = (np.interp((starts + ends) / 2, path.times, axis) for axis in (path.xs, path.ys))
        sizes = 30 + np.minimum(ends - starts, 3600) / 12
        axes.scatter(xs, ys, s=sizes, color="#f59e0b", alpha=0.55, linewidths=0, label="stood")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(f"x (m, {path.frame})")
    axes.set_ylabel("y (m)")
    axes.legend(loc="best", framealpha=0.85, fontsize=8)
    if path.times[-1] > path.times[0] and axes.figure is not None:
        bar = axes.figure.colorbar(lines, ax=axes, shrink=0.8, pad=0.02, label="time of day")
        _label_times(bar.ax.yaxis, path.times[0], path.times[-1])


def _draw_rows(axes: "Axes", rows: Sequence[Row], span: Seconds) -> None:
    """Draws the rows of a timeline, the first one on top."""
    start, end = span
    least = max((end - start) * _LEAST_SHARE, 1e-6)
    for at, (_, stretches, color) in enumerate(reversed(rows)):
        bars = [(first / _DAY_S, max(last - first, least) / _DAY_S) for first, last in stretches]
        axes.broken_barh(bars, (at - 0.34, 0.68), facecolors=color, linewidth=0)
    names = [shortened(name, _LONGEST_NAME) for name, *_ in reversed(rows)]
    axes.set_yticks(range(len(rows)), names)
    axes.set_xlim(start / _DAY_S, (end + least) / _DAY_S)
    axes.grid(visible=False, axis="y")
    _label_times(axes.xaxis, start, end + least)


def _write_lines(axes: "Axes", lines: Iterable[str]) -> None:
    """Writes lines of text in place of a drawing."""
    axes.set_axis_off()
    wrapped = (textwrap.fill(line, 62, subsequent_indent=" " * 12) for line in lines)
    axes.text(0, 1, "\n".join(wrapped), ha="left", va="top", fontsize=8.5, linespacing=1.5)


def _label_times(axis: "Axis", start: float, end: float) -> None:
    """Labels an axis of time in this machine's zone, as it is in the middle."""
    from matplotlib.dates import AutoDateLocator, DateFormatter  # noqa: PLC0415 - as above

    zone = datetime.fromtimestamp((start + end) / 2).astimezone().tzinfo
    axis.set_major_locator(AutoDateLocator(tz=zone, maxticks=8))
    form = "%H:%M:%S" if end - start < _DAY_S else "%d %b %H:%M"
    axis.set_major_formatter(DateFormatter(form, tz=zone))


def _checked_request(out: Path, bags: Bags, when: Times | str | None, *settings: str) -> Asked:
    """Returns what is asked for, in a window or on a day; checks that it can be drawn.

    Raises:
        ConfigError: the optional dependency is missing.
        InvalidArgumentsError: the name has a suffix of no picture.
    """
    require_extra("plot", "plot", "matplotlib")
    if out.suffix.lower() not in FORMATS:
        kinds = ", ".join(FORMATS)
        raise InvalidArgumentsError(f"--out {out} is not a picture: its name must end in {kinds}")
    memory = bags.memory(*settings)
    return asked_in(
        memory, when.window(memory) if isinstance(when, Times) else day_of(memory, when)
    )


def _finish(out: Path, notes: Sequence[str], *, as_json: bool) -> None:
    if as_json:
        print_json({"path": str(out), "notes": [*notes]})
    else:
        print_line(str(out))
        print_notes(notes)


def asked_in(memory: Memory, window: TimeWindow) -> Asked:
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
    return Asked(view, within)


def path_in(asked: Asked, topic: str | None = None) -> DrawnPath:
    """Returns the path by a topic or `data.pose_topic`; in the map where transforms lead there.

    Without a topic of poses and transforms, that of a satellite receiver.

    Raises:
        NoDataError: there is none in this time, or no such topic.
    """
    view, memory = asked.view, asked.view.memory
    if topic is not None:
        resolve_topic(view, topic)  # another one that has poses is not what was asked for
    elif (
        (receivers := topics_with(view, "geodetic"))
        and not topics_with(view, "position")
        and robot_places(view, asked.window) is None
    ):
        receiver, _, _ = receivers[0].partition(" ")
        memory = replace(memory, limits=replace(memory.limits, pose_topic=receiver))
    everywhere = Box(-math.inf, -math.inf, math.inf, math.inf, _PIXEL_M)
    try:
        path, line, _ = line_in_box(memory, Call(), asked.window, everywhere)
    except NoDataError as error:
        has_others = "data.pose_topic" in error.detail
        hint = ", or give --topic" if has_others else "; list_recorded_topics lists all"
        raise NoDataError(error.reason, f"{error.detail}{hint}") from error
    if not len(line.times):
        view = View(memory, Call())
        of = resolve_path_topic(view, degrees=True)
        if any(view.timeline.extents(of, asked.window)):
            raise NoDataError(NoDataReason.OUTSIDE_RANGE, f"no pose of {of} has a place")
        raise no_data_between(view, (of,), asked.window)
    return DrawnPath(path.frame, line.times / NS_PER_S, line.x, line.y, line.begins)


def signals_of(
    asked: Asked, topic: str, fields: Sequence[str]
) -> tuple[int, dict[str, tuple[Floats, Floats]], list[str]]:
    """Returns how many messages there are, times and values of numeric fields, and notes.

    A value is NaN where there is none.

    Raises:
        InvalidArgumentsError: there is no such field, or it holds no number.
        NoDataError: there is no message in this time, or none can be decoded.
    """
    view = asked.view
    total, picked = pick(view, topic, asked.window, _MOST_SAMPLES)
    rows = [
        (time, dict(leaves(value))) for time, value in extracted(view, picked, fields, exact=True)
    ]
    if not rows:
        what = "can be decoded" if total else "is in this time"
        raise NoDataError(NoDataReason.OUTSIDE_RANGE, f"no message of {topic} {what}")
    names = fields or [*dict.fromkeys(name for _, row in rows for name in row)]
    columns = {name: np.array([_number(row.get(name)) for _, row in rows]) for name in names}
    known = {name: values[~np.isnan(values)] for name, values in columns.items()}
    lacking = [name for name, values in known.items() if not len(values)]
    if lacking and (fields or len(lacking) == len(names)):
        raise InvalidArgumentsError(f"{lacking[0] or topic} of {topic} holds no number")
    notes = [*view.notes.sentences()]
    if not fields:
        numeric = [name for name in names if len(known[name])]
        varying = [name for name in numeric if np.ptp(known[name])] or numeric
        names = varying[:_MOST_SIGNALS]
        if left_out := varying[_MOST_SIGNALS:]:
            notes.append(f"not drawn: {listed(left_out)}; name them with --field")
    if total > len(rows):
        notes.append(f"{len(rows)} of {total} messages are drawn, evenly spaced")
    times = np.array([time for time, _ in rows])
    return total, {name: _with_breaks(times, columns[name]) for name in names}, notes


def _number(value: JsonValue) -> float:
    """Returns a number, or NaN where it is none."""
    return float(value) if isinstance(value, bool | int | float) else math.nan


def _with_breaks(times: NDArray[np.int64], values: Floats) -> tuple[Floats, Floats]:
    """Returns points in seconds, and NaN where there was none for much longer than usual."""
    steps = np.diff(times)
    usual = np.sort(steps)[len(steps) // 2] if len(steps) else 0
    broken = np.flatnonzero(steps > max(_PERIODS * usual, NS_PER_S)) + 1
    shown = np.insert(times, broken, times[broken - 1] + 1) / NS_PER_S
    return shown, np.insert(values, broken, math.nan)


def event_rows(asked: Asked, happened: Recap) -> list[Row]:
    """Returns a row of what was recorded, and one for each kind of event that occurs."""
    span = asked.window.start, asked.window.stop - 1
    recorded = without([span], [*recording_gaps(asked.view, asked.window)])
    rows: list[Row] = [("recorded", [*map(_unix, recorded)], _RECORDED)]
    for kind, (name, color) in _ROWS.items():
        if events := [event for event in happened.events if event.kind == kind]:
            rows.append((name, [_unix((event.start, _until(event))) for event in events], color))
    return rows


def _unix(span: tuple[Ns, Ns]) -> Seconds:
    return unix_from_ns(span[0]), unix_from_ns(span[1])


def _lasted(start: Ns, end: Ns) -> str:
    return format_duration(unix_from_ns(end - start))


def _until(event: Event) -> Ns:
    """Returns when an event was over; what a flip led to is not a part of it."""
    return event.start if event.end is None or event.kind == "flip" else event.end


def topic_rows(asked: Asked) -> Iterator[Row]:
    """Yields when each topic was recorded, of the topics with the most messages, by name."""
    timeline = asked.view.timeline
    messages = {
        topic: sum(totals.messages for totals in timeline.totals(topic).values())
        for topic in timeline.topics()
    }
    joined = ns_from_unix(2 * asked.view.limits.split_duration_s)
    for topic in sorted(sorted(messages, key=lambda topic: -messages[topic])[:_MOST_TOPICS]):
        extents = ((first, last) for _, first, last in timeline.extents(topic, asked.window))
        yield topic, [*map(_unix, united(extents, joined))], _TOPIC


def _totals(happened: Recap) -> str:
    """Returns distance, speed and time of standing in a line, as far as they are known."""
    parts = [f"{count} {name}" for name, count in happened.counts]
    if happened.stood is not None:
        parts.insert(0, f"stood {_lasted(0, happened.stood)}")
    if happened.distance_m is not None and happened.max_speed is not None:
        driven = f"{happened.distance_m:.1f} m driven"
        parts.insert(0, f"{driven}, at most {happened.max_speed:.2f} m/s")
    return ", ".join(parts)


def _event_lines(happened: Recap) -> Iterator[str]:
    """Yields each event in a line, with the time of day, and how long it took."""
    if not happened.events:
        yield "no events"
    for event in happened.events:
        at = datetime.fromtimestamp(unix_from_ns(event.start)).astimezone()
        until = _until(event)
        took = f" ({_lasted(event.start, until)})" if until - event.start >= NS_PER_S else ""
        where = f", in {event.places[0]}" if event.places else ""
        yield f"{at:%H:%M:%S}  {event.text}{where}{took}"
