"""`ros2-memory plot`: pictures of what is recorded, by the same queries as the tools.

Times are Unix seconds. No window is opened, and nothing is written but the picture and what
matplotlib keeps in its own folders, its list of fonts.
"""

import logging
import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple, TypeAlias

import numpy as np
import typer
from numpy.typing import NDArray

from ros2_memory.bootstrap import require_extra
from ros2_memory.cli.app import epilog
from ros2_memory.cli.cat import extract_values
from ros2_memory.cli.options import AsJson, Bags, Times, as_command, newest_day
from ros2_memory.cli.output import (
    atomic_file,
    leaves,
    print_json,
    print_line,
    print_notes,
    spinner,
)
from ros2_memory.core.arrays import Ints
from ros2_memory.core.errors import InvalidArgumentsError, NoDataError, NoDataReason
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.regions import Place
from ros2_memory.core.spans import united, without
from ros2_memory.core.text import counted, listed, shortened
from ros2_memory.core.timebase import NS_PER_S, Ns, Span, ns_from_unix, unix_from_ns
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.coverage import recording_gaps
from ros2_memory.history.no_data import resolve_topic
from ros2_memory.history.scan import pick
from ros2_memory.history.view import TimeRange, View, open_view
from ros2_memory.insights.recap import recap
from ros2_memory.results import Recap
from ros2_memory.serving.page.drawn_path import Box, Line, line_in_box

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure


FORMATS: Final = (".svg", ".png", ".pdf")
_EVERYWHERE: Final = Box(-math.inf, -math.inf, math.inf, math.inf, 0.001)
"""The path is drawn to the millimetre."""
_MOST_SAMPLES: Final = 20_000
"""Messages of a signal that are drawn, evenly spaced: some for each column of a wide picture."""
_MOST_SIGNALS: Final = 6
_MOST_TOPICS: Final = 30
_PERIODS: Final = 5
"""A step of a signal that is longer than so many usual ones, and than a second, is a gap."""
_FEWEST_WITHOUT_MARKERS: Final = 60
"""Of a signal with fewer samples each one is marked."""
_STYLE: Final = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.titlelocation": "left",
    "figure.titlesize": 11,
    "font.size": 9,
    "svg.hashsalt": "ros2-memory",
    "text.parse_math": False,  # or a dollar sign in a name would begin a formula
}
_DAY_S: Final = 86_400
_LEAST_SHARE: Final = 0.002
"""Of the width of a timeline: shorter stretches are drawn so long, to be seen."""
_LONGEST_NAME: Final = 34

Seconds: TypeAlias = tuple[float, float]
Floats: TypeAlias = NDArray[np.float64]
Signal: TypeAlias = tuple[Floats, Floats]
"""Times (Unix s) and values; a value is NaN where the message has none, and in gaps."""
Rows: TypeAlias = dict[str, Sequence[Seconds]]
"""The rows of a timeline by name: the first and the last time of each stretch."""

plot = typer.Typer(
    help="Draw the driven path, a signal, what was recorded when, or a day.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


class PlotWindow(NamedTuple):
    """The part of a memory that a picture shows."""

    view: View
    window: TimeWindow

    @property
    def span(self) -> Seconds:
        """The first and the last time of the window (Unix s, inclusive)."""
        return _in_seconds((self.window.start, self.window.stop - 1))

    @property
    def title(self) -> str:
        """The first and the last time of the window, as text in this machine's zone."""
        start, end = (datetime.fromtimestamp(at).astimezone() for at in self.span)
        return f"{start:%Y-%m-%d %H:%M:%S} - {end:%Y-%m-%d %H:%M:%S %Z}"

    def recap(self) -> Recap:
        """Returns the recap of the window."""
        return recap(self.view.memory, Call(), TimeRange.over(self.window))

    def path(self) -> tuple[str, Line]:
        """Returns the frame of the robot's path, and the path, which has at least one point.

        Raises:
            NoDataError: nothing places the robot in this time.
        """
        path, line, _ = line_in_box(self.view.memory, Call(), self.window, _EVERYWHERE)
        if not len(line.times):
            raise NoDataError(NoDataReason.OUTSIDE_RANGE, "the robot has no place in this time")
        return path.frame, line


@dataclass(frozen=True, kw_only=True)
class Picture(Bags, Times):
    """The options of a picture."""

    out: Annotated[
        Path,
        "--out",
        "-o",
        "FILE",
        "Write the picture here: .svg, .png or .pdf; overwrites the file.",
    ]
    as_json: AsJson = False

    def open_window(self, *, newest_day_by_default: bool = False) -> PlotWindow:
        """Opens the memory at the window of the options.

        Without one of --start, --end and --last that is the whole memory, or its newest day.

        Raises:
            ConfigError: matplotlib is not installed.
            InvalidArgumentsError: the file's name does not end as a picture's name.
            NoDataError: nothing was recorded in the window.
        """
        require_extra("plot", "plot", "matplotlib")
        if self.out.suffix.lower() not in FORMATS:
            raise InvalidArgumentsError(
                f"--out {self.out} is not a picture: its name must end in {', '.join(FORMATS)}"
            )
        memory = self.memory()
        has_times = self.start is not None or self.end is not None or self.last is not None
        if newest_day_by_default and not has_times:
            return recorded_part(memory, newest_day(memory))
        return recorded_part(memory, self.window(memory))

    @contextmanager
    def figure(self, title: str, size: Seconds, notes: Sequence[str]) -> Iterator["Figure"]:
        """Yields a figure to draw on; afterwards writes the file, and prints its name and notes.

        `size` is the width and the height of the figure in inches.

        Raises:
            OSError: the file cannot be written.
        """
        # matplotlib warns of fonts, of its own limits, and if it cannot store its list of fonts.
        logging.getLogger("matplotlib").setLevel(logging.ERROR)
        from matplotlib import rc_context  # noqa: PLC0415 - an extra that few install
        from matplotlib.figure import Figure  # noqa: PLC0415

        kind = self.out.suffix[1:].lower()
        with rc_context(_STYLE), warnings.catch_warnings(), atomic_file(self.out) as temporary:
            warnings.simplefilter("ignore")  # about letters that no font here has
            figure = Figure(figsize=size, layout="constrained")
            figure.suptitle(title, x=0.01, ha="left")
            yield figure
            metadata = {"Date": None} if kind == "svg" else None
            figure.savefig(temporary, format=kind, dpi=130, metadata=metadata)
        if self.as_json:
            print_json({"path": str(self.out), "notes": [*notes]})
        else:
            print_line(str(self.out))
            print_notes(notes)


@plot.command("path", epilog=epilog("plot"))
@as_command("plot path")
def plot_path(*, picture: Picture) -> None:
    """Draw the driven path in 2D, coloured by time, with named places and standstills.

    Another topic of poses is chosen by data.pose_topic=TOPIC, a frame by data.map_frame=FRAME.
    """
    shown = picture.open_window()
    with spinner("looking for the path"):
        frame, line = shown.path()
        summary = shown.recap()
    with picture.figure(f"Path, {shown.title}", (8.5, 7.0), summary.notes) as figure:
        _draw_path(figure.add_subplot(), shown.view.limits.places, frame, line, summary)


@plot.command("signal", epilog=epilog("plot"))
@as_command("plot signal")
def plot_signal(
    topic: Annotated[
        str, typer.Argument(metavar="TOPIC", help="The name of the topic, such as /battery.")
    ],
    *,
    field: Annotated[
        list[str] | None, "PATH", "A numeric field; repeatable (default: all that change)."
    ] = None,
    picture: Picture,
) -> None:
    """Draw numeric fields of a topic over time, one row for each field."""
    shown = picture.open_window()
    name = resolve_topic(shown.view, topic)
    with spinner(f"reading {name}"):
        signals, notes = read_signals(shown, name, field or ())
    size = (10.0, 1.2 + 1.9 * len(signals))
    with picture.figure(f"{name}, {shown.title}", size, notes) as figure:
        rows = figure.subplots(len(signals), 1, sharex=True, squeeze=False)[:, 0]
        for axes, (field_name, (times_s, values)) in zip(rows, signals.items(), strict=True):
            marker = "." if len(times_s) < _FEWEST_WITHOUT_MARKERS else ""
            axes.plot(times_s / _DAY_S, values, linewidth=1.1, marker=marker)
            axes.set_title(field_name)
        _label_times(rows[-1].xaxis, *shown.span)


@plot.command("timeline", epilog=epilog("plot"))
@as_command("plot timeline")
def plot_timeline(*, picture: Picture) -> None:
    """Draw what was recorded when: gaps, silences and events, and one row for each topic."""
    shown = picture.open_window()
    with spinner("looking what was recorded when"):
        summary = shown.recap()
        rows = event_rows(shown, summary) | topic_rows(shown)
    notes = [*summary.notes]
    if (left_out := len(shown.view.timeline.topics()) - _MOST_TOPICS) > 0:
        notes.append(f"{counted(left_out, 'topic')} with the fewest messages left out")
    size = (11.0, 1.3 + 0.27 * len(rows))
    with picture.figure(f"Recorded, {shown.title}", size, notes) as figure:
        _draw_rows(figure.add_subplot(), rows, shown.span)


@plot.command("recap", epilog=epilog("plot"))
@as_command("plot recap")
def plot_recap(*, picture: Picture) -> None:
    """Draw a day in one picture: where the robot drove, what happened, what was recorded.

    Without a time it is the newest day; --start yesterday --end yesterday is the one before today.
    """
    shown = picture.open_window(newest_day_by_default=True)
    with spinner("recalling the day"):
        summary = shown.recap()
        rows = event_rows(shown, summary)
    height = 0.35 + 0.3 * len(rows)
    with picture.figure(f"Recap, {shown.title}", (9.0, 6.0 + height), summary.notes) as figure:
        plane, timeline = figure.subplots(2, 1, height_ratios=[6.0, height])
        plane.set_axis_off()
        with suppress(InvalidArgumentsError, NoDataError):  # a day without a path is drawn, too
            frame, line = shown.path()
            _draw_path(plane, shown.view.limits.places, frame, line, summary)
            plane.set_axis_on()
        _draw_rows(timeline, rows, shown.span)


def _draw_path(
    axes: "Axes", places: Sequence[Place], frame: str, line: Line, summary: Recap
) -> None:
    """Draws a path coloured by time, with the named places and standstills of its frame."""
    from matplotlib.collections import LineCollection  # noqa: PLC0415 - as above

    for place in places:
        if place.frame_id == frame:
            left, right, low, high = place.region.bounds
            middle = (left + right) / 2, (low + high) / 2
            axes.annotate(place.name, middle, ha="center", color="#6b7280", fontsize=8)
    points, times_s = np.column_stack([line.x, line.y]), line.times / NS_PER_S
    is_drawn = ~line.begins[1:]
    pieces = np.stack([points[:-1], points[1:]], axis=1)[is_drawn]
    days = times_s[:-1][is_drawn] / _DAY_S
    lines = LineCollection([*pieces], array=days, cmap="viridis", linewidths=2.0)
    axes.add_collection(lines)
    axes.scatter(*points[0], s=60, marker="o", color="#16a34a", zorder=3, label="start")
    axes.scatter(*points[-1], s=60, marker="s", color="#dc2626", zorder=3, label="end")
    stops = [event.point for event in summary.events if event.kind == "stop" and event.point]
    if stops and summary.frame_id == frame:
        axes.scatter(*np.array(stops).T, s=60, color="#f59e0b", alpha=0.55, label="stood")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(f"x (m, {frame})")
    axes.set_ylabel("y (m)")
    axes.legend(loc="best", fontsize=8)
    if times_s[-1] > times_s[0] and axes.figure is not None:
        bar = axes.figure.colorbar(lines, ax=axes, shrink=0.8, pad=0.02, label="time of day")
        _label_times(bar.ax.yaxis, times_s[0], times_s[-1])


def _draw_rows(axes: "Axes", rows: Rows, span: Seconds) -> None:
    """Draws the rows of a timeline, the first one on top."""
    start, end = span
    shortest_s = max((end - start) * _LEAST_SHARE, 1e-6)
    for row, stretches in enumerate(rows.values()):
        bars = [
            (first / _DAY_S, max(last - first, shortest_s) / _DAY_S) for first, last in stretches
        ]
        axes.broken_barh(bars, (row - 0.34, 0.68), facecolors=f"C{row}", linewidth=0)
    axes.set_yticks(range(len(rows)), [shortened(name, _LONGEST_NAME) for name in rows])
    axes.invert_yaxis()
    axes.set_xlim(start / _DAY_S, (end + shortest_s) / _DAY_S)
    _label_times(axes.xaxis, start, end + shortest_s)


def _label_times(axis: "Axis", start: float, end: float) -> None:
    """Labels an axis of days since 1970 with local times; `start` and `end` are Unix seconds."""
    from matplotlib.dates import AutoDateLocator, DateFormatter  # noqa: PLC0415 - as above

    # One offset from UTC for the whole axis: the one in its middle.
    zone = datetime.fromtimestamp((start + end) / 2).astimezone().tzinfo
    axis.set_major_locator(AutoDateLocator(tz=zone, maxticks=8))
    form = "%H:%M:%S" if end - start < _DAY_S else "%d %b %H:%M"
    axis.set_major_formatter(DateFormatter(form, tz=zone))


def recorded_part(memory: Memory, window: TimeWindow) -> PlotWindow:
    """Returns the part of a window between the first and the last recorded message.

    Raises:
        NoDataError: nothing is recorded, or nothing in that window.
    """
    view = open_view(memory, Call(), window.stop)
    recorded = TimeWindow(view.snapshot.earliest or 0, (view.snapshot.latest or 0) + 1)
    part = window.intersect(recorded)
    if part.empty:
        raise NoDataError(NoDataReason.OUTSIDE_RANGE, "nothing was recorded in this time")
    return PlotWindow(view, part)


def read_signals(
    shown: PlotWindow, topic: str, fields: Sequence[str]
) -> tuple[dict[str, Signal], list[str]]:
    """Reads numeric fields of a topic: those that are named, else the first ones that change.

    Returns the signals by dot-path, and notes.

    Raises:
        InvalidArgumentsError: the messages have no such field, or it holds no number.
    """
    view = shown.view
    total, picked = pick(view, topic, shown.window, _MOST_SAMPLES)
    rows: list[dict[str, JsonValue]] = []
    times: list[Ns] = []
    for time, value in extract_values(view, picked, fields, exact=True):
        times.append(time)
        rows.append(dict(leaves(value)))
    notes = [*view.notes.sentences()]
    if total > len(rows):
        notes.append(f"{len(rows)} of {total} messages are drawn, evenly spaced")
    names = fields or [*dict.fromkeys(name for row in rows for name in row)]
    columns = {name: np.array([_number(row.get(name)) for row in rows]) for name in names}
    numeric = [name for name, values in columns.items() if not np.isnan(values).all()]
    if not numeric or (fields and numeric != [*fields]):
        raise InvalidArgumentsError(f"{listed([*fields]) or topic} holds no number in this time")
    drawn = numeric
    if not fields:
        varying = [name for name in numeric if np.nanmin(columns[name]) < np.nanmax(columns[name])]
        drawn = (varying or numeric)[:_MOST_SIGNALS]
        if left_out := varying[_MOST_SIGNALS:]:
            notes.append(f"not drawn: {listed(left_out)}; name them with --field")
    return {name: _broken_at_gaps(np.array(times), columns[name]) for name in drawn}, notes


def _number(value: JsonValue) -> float:
    return float(value) if isinstance(value, bool | int | float) else math.nan


def _broken_at_gaps(times: Ints, values: Floats) -> Signal:
    """Returns a signal with a NaN in each gap: there matplotlib breaks the line."""
    steps = np.diff(times)
    usual = np.sort(steps)[len(steps) // 2] if len(steps) else 0
    after_gap = np.flatnonzero(steps > max(_PERIODS * usual, NS_PER_S)) + 1
    times_s = np.insert(times, after_gap, times[after_gap - 1] + 1) / NS_PER_S
    return times_s, np.insert(values, after_gap, math.nan)


def event_rows(shown: PlotWindow, summary: Recap) -> Rows:
    """Returns a row of the times with recordings, and one for each kind of event that occurs."""
    whole = shown.window.start, shown.window.stop - 1
    recorded = without([whole], [*recording_gaps(shown.view, shown.window)])
    rows: dict[str, list[Seconds]] = {"recorded": [*map(_in_seconds, recorded)]}
    for event in summary.events:
        # A flip is a moment: its end is the time until which the new value stayed.
        end = event.start if event.end is None or event.kind == "flip" else event.end
        rows.setdefault(event.kind, []).append(_in_seconds((event.start, end)))
    return {**rows}


def topic_rows(shown: PlotWindow) -> Rows:
    """Returns when each topic was recorded, by name: of the topics with the most messages."""
    timeline = shown.view.timeline
    messages = {
        topic: sum(totals.messages for totals in timeline.totals(topic).values())
        for topic in timeline.topics()
    }
    most_first = sorted(messages, key=lambda topic: -messages[topic])
    # A topic that lacks one split is not shown as interrupted.
    joined = ns_from_unix(2 * shown.view.limits.split_duration_s)
    rows: dict[str, Sequence[Seconds]] = {}
    for topic in sorted(most_first[:_MOST_TOPICS]):
        extents = ((first, last) for _, first, last in timeline.extents(topic, shown.window))
        rows[topic] = [*map(_in_seconds, united(extents, joined))]
    return rows


def _in_seconds(span: Span) -> Seconds:
    return unix_from_ns(span[0]), unix_from_ns(span[1])
