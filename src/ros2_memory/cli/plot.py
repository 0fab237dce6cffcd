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
from ros2_memory.cli.cat import extracted
from ros2_memory.cli.options import AsJson, Bags, Times, as_command, newest_day
from ros2_memory.cli.output import (
    leaves,
    made_whole,
    print_json,
    print_line,
    print_notes,
    spinner,
)
from ros2_memory.core.arrays import Ints
from ros2_memory.core.errors import InvalidArgumentsError, NoDataError, NoDataReason
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.spans import united, without
from ros2_memory.core.text import counted, listed, shortened
from ros2_memory.core.timebase import NS_PER_S, Span, ns_from_unix, unix_from_ns
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
"""A signal has a gap, and its line is broken, after so many of its usual periods, and a second."""
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
"""Of the width of a timeline: what is shorter is drawn as long."""
_LONGEST_NAME: Final = 34

Seconds: TypeAlias = tuple[float, float]
Floats: TypeAlias = NDArray[np.float64]
Rows: TypeAlias = dict[str, Sequence[Seconds]]
"""The rows of a timeline by name: stretches, of which equal ones are a moment."""

plot = typer.Typer(
    help="Draw the driven path, a signal, what was recorded when, or a day.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


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
        """The bounds of the window, for people."""
        start, end = (datetime.fromtimestamp(at).astimezone() for at in self.span)
        return f"{start:%Y-%m-%d %H:%M:%S} - {end:%Y-%m-%d %H:%M:%S %Z}"

    def recap(self) -> Recap:
        """Returns what happened."""
        return recap(self.view.memory, Call(), TimeRange.over(self.window))

    def path(self) -> tuple[str, Line]:
        """Returns the frame of the robot's path, and the path; not one that has no point.

        Raises:
            NoDataError: there is none in this time.
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

    def asked(self, *, day: bool = False) -> Asked:
        """Returns what is asked for; without times all, or the newest `day`.

        Raises:
            ConfigError: the optional dependency is missing.
            InvalidArgumentsError: the file's name has a suffix of no picture.
            NoDataError: nothing was recorded in that time.
        """
        require_extra("plot", "plot", "matplotlib")
        if self.out.suffix.lower() not in FORMATS:
            raise InvalidArgumentsError(
                f"--out {self.out} is not a picture: its name must end in {', '.join(FORMATS)}"
            )
        memory = self.memory()
        is_day = day and (self.start, self.end, self.last) == (None, None, None)
        return asked_in(memory, newest_day(memory) if is_day else self.window(memory))

    @contextmanager
    def drawn(self, title: str, size: Seconds, notes: Sequence[str]) -> Iterator["Figure"]:
        """Yields a figure, writes what the block has drawn, and prints the file and the notes.

        `size` is its width and height in inches.

        Raises:
            OSError: it cannot be written.
        """
        # It warns of fonts, of its own limits, and where it finds no place for its list of fonts.
        logging.getLogger("matplotlib").setLevel(logging.ERROR)
        from matplotlib import rc_context  # noqa: PLC0415 - an extra that few install
        from matplotlib.figure import Figure  # noqa: PLC0415

        kind = self.out.suffix[1:].lower()
        with rc_context(_STYLE), warnings.catch_warnings(), made_whole(self.out) as temporary:
            warnings.simplefilter("ignore")  # on letters that no font here has
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
    asked = picture.asked()
    with spinner("looking for the path"):
        frame, line = asked.path()
        happened = asked.recap()
    with picture.drawn(f"Path, {asked.title}", (8.5, 7.0), happened.notes) as figure:
        _draw_path(figure.add_subplot(), asked, frame, line, happened)


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
    asked = picture.asked()
    name = resolve_topic(asked.view, topic)
    with spinner(f"reading {name}"):
        signals, notes = signals_of(asked, name, field or ())
    size = (10.0, 1.2 + 1.9 * len(signals))
    with picture.drawn(f"{name}, {asked.title}", size, notes) as figure:
        rows = figure.subplots(len(signals), 1, sharex=True, squeeze=False)[:, 0]
        for axes, (field_name, (at, values)) in zip(rows, signals.items(), strict=True):
            axes.plot(at / _DAY_S, values, linewidth=1.1, marker="." if len(at) < 60 else "")
            axes.set_title(field_name)
        _label_times(rows[-1].xaxis, *asked.span)


@plot.command("timeline", epilog=epilog("plot"))
@as_command("plot timeline")
def plot_timeline(*, picture: Picture) -> None:
    """Draw what was recorded when: gaps, silences and events, and one row for each topic."""
    asked = picture.asked()
    with spinner("looking what was recorded when"):
        happened = asked.recap()
        rows = event_rows(asked, happened) | topic_rows(asked)
    notes = [*happened.notes]
    if (left_out := len(asked.view.timeline.topics()) - _MOST_TOPICS) > 0:
        notes.append(f"{counted(left_out, 'topic')} with the fewest messages left out")
    with picture.drawn(f"Recorded, {asked.title}", (11.0, 1.3 + 0.27 * len(rows)), notes) as figure:
        _draw_rows(figure.add_subplot(), rows, asked.span)


@plot.command("recap", epilog=epilog("plot"))
@as_command("plot recap")
def plot_recap(*, picture: Picture) -> None:
    """Draw a day in one picture: where the robot drove, what happened, what was recorded.

    Without a time it is the newest day; --start yesterday --end yesterday is the one before today.
    """
    asked = picture.asked(day=True)
    with spinner("recalling the day"):
        happened = asked.recap()
        rows = event_rows(asked, happened)
    height = 0.35 + 0.3 * len(rows)
    with picture.drawn(f"Recap, {asked.title}", (9.0, 6.0 + height), happened.notes) as figure:
        plane, timeline = figure.subplots(2, 1, height_ratios=[6.0, height])
        plane.set_axis_off()
        with suppress(InvalidArgumentsError, NoDataError):  # the page says why there is none
            _draw_path(plane, asked, *asked.path(), happened)
            plane.set_axis_on()
        _draw_rows(timeline, rows, asked.span)


def _draw_path(axes: "Axes", asked: Asked, frame: str, line: Line, happened: Recap) -> None:
    """Draws a path, coloured by time, with named places and standstills of the same frame."""
    from matplotlib.collections import LineCollection  # noqa: PLC0415 - as above

    for place in asked.view.limits.places:
        if place.frame_id == frame:
            left, right, low, high = place.region.bounds
            middle = (left + right) / 2, (low + high) / 2
            axes.annotate(place.name, middle, ha="center", color="#6b7280", fontsize=8)
    points, times = np.column_stack([line.x, line.y]), line.times / NS_PER_S
    pieces, are_lines = np.stack([points[:-1], points[1:]], axis=1), ~line.begins[1:]
    days = times[:-1][are_lines] / _DAY_S
    lines = LineCollection([*pieces[are_lines]], array=days, cmap="viridis", linewidths=2.0)
    axes.add_collection(lines)
    axes.scatter(*points[0], s=60, marker="o", color="#16a34a", zorder=3, label="start")
    axes.scatter(*points[-1], s=60, marker="s", color="#dc2626", zorder=3, label="end")
    stops = [event.point for event in happened.events if event.kind == "stop" and event.point]
    if stops and happened.frame_id == frame:
        axes.scatter(*np.array(stops).T, s=60, color="#f59e0b", alpha=0.55, label="stood")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(f"x (m, {frame})")
    axes.set_ylabel("y (m)")
    axes.legend(loc="best", fontsize=8)
    if times[-1] > times[0] and axes.figure is not None:
        bar = axes.figure.colorbar(lines, ax=axes, shrink=0.8, pad=0.02, label="time of day")
        _label_times(bar.ax.yaxis, times[0], times[-1])


def _draw_rows(axes: "Axes", rows: Rows, span: Seconds) -> None:
    """Draws the rows of a timeline, the first one on top."""
    start, end = span
    least = max((end - start) * _LEAST_SHARE, 1e-6)
    for at, stretches in enumerate(rows.values()):
        bars = [(first / _DAY_S, max(last - first, least) / _DAY_S) for first, last in stretches]
        axes.broken_barh(bars, (at - 0.34, 0.68), facecolors=f"C{at}", linewidth=0)
    axes.set_yticks(range(len(rows)), [shortened(name, _LONGEST_NAME) for name in rows])
    axes.invert_yaxis()
    axes.set_xlim(start / _DAY_S, (end + least) / _DAY_S)
    _label_times(axes.xaxis, start, end + least)


def _label_times(axis: "Axis", start: float, end: float) -> None:
    """Labels an axis of time in this machine's zone, as it is in the middle."""
    from matplotlib.dates import AutoDateLocator, DateFormatter  # noqa: PLC0415 - as above

    zone = datetime.fromtimestamp((start + end) / 2).astimezone().tzinfo
    axis.set_major_locator(AutoDateLocator(tz=zone, maxticks=8))
    form = "%H:%M:%S" if end - start < _DAY_S else "%d %b %H:%M"
    axis.set_major_formatter(DateFormatter(form, tz=zone))


def asked_in(memory: Memory, window: TimeWindow) -> Asked:
    """Returns what is asked for, as far as the memory spans it.

    Raises:
        NoDataError: nothing is recorded, or nothing of that time.
    """
    view = open_view(memory, Call(), window.stop)
    recorded = TimeWindow(view.snapshot.earliest or 0, (view.snapshot.latest or 0) + 1)
    within = window.intersect(recorded)
    if within.empty:
        raise NoDataError(NoDataReason.OUTSIDE_RANGE, "nothing was recorded in this time")
    return Asked(view, within)


def signals_of(
    asked: Asked, topic: str, fields: Sequence[str]
) -> tuple[dict[str, tuple[Floats, Floats]], list[str]]:
    """Returns times and values of numeric fields, and notes; a value is NaN where there is none.

    Raises:
        InvalidArgumentsError: there is no such field, or it has no number in this time.
    """
    view = asked.view
    total, picked = pick(view, topic, asked.window, _MOST_SAMPLES)
    rows = [
        (time, dict(leaves(value))) for time, value in extracted(view, picked, fields, exact=True)
    ]
    notes = [*view.notes.sentences()]
    if total > len(rows):
        notes.append(f"{len(rows)} of {total} messages are drawn, evenly spaced")
    names = fields or [*dict.fromkeys(name for _, row in rows for name in row)]
    columns = {name: np.array([_number(row.get(name)) for _, row in rows]) for name in names}
    numeric = [name for name, values in columns.items() if not np.isnan(values).all()]
    if not numeric or (fields and numeric != [*fields]):
        raise InvalidArgumentsError(f"{listed([*fields]) or topic} holds no number in this time")
    if not fields:
        varying = [name for name in numeric if np.nanmin(columns[name]) < np.nanmax(columns[name])]
        numeric = (varying or numeric)[:_MOST_SIGNALS]
        if left_out := varying[_MOST_SIGNALS:]:
            notes.append(f"not drawn: {listed(left_out)}; name them with --field")
    times = np.array([time for time, _ in rows])
    return {name: _with_breaks(times, columns[name]) for name in numeric}, notes


def _number(value: JsonValue) -> float:
    """Returns a number, or NaN where it is none."""
    return float(value) if isinstance(value, bool | int | float) else math.nan


def _with_breaks(times: Ints, values: Floats) -> tuple[Floats, Floats]:
    """Returns points in seconds, and NaN where there was none for much longer than usual."""
    steps = np.diff(times)
    usual = np.sort(steps)[len(steps) // 2] if len(steps) else 0
    broken = np.flatnonzero(steps > max(_PERIODS * usual, NS_PER_S)) + 1
    shown = np.insert(times, broken, times[broken - 1] + 1) / NS_PER_S
    return shown, np.insert(values, broken, math.nan)


def event_rows(asked: Asked, happened: Recap) -> Rows:
    """Returns a row of what was recorded, and one for each kind of event that occurs."""
    span = asked.window.start, asked.window.stop - 1
    recorded = without([span], [*recording_gaps(asked.view, asked.window)])
    rows: dict[str, list[Seconds]] = {"recorded": [*map(_unix, recorded)]}
    for event in happened.events:
        # What a flip led to is not a part of it.
        end = event.start if event.end is None or event.kind == "flip" else event.end
        rows.setdefault(event.kind, []).append(_unix((event.start, end)))
    return {**rows}


def topic_rows(asked: Asked) -> Rows:
    """Returns when each topic was recorded, of the topics with the most messages, by name."""
    timeline = asked.view.timeline
    messages = {
        topic: sum(totals.messages for totals in timeline.totals(topic).values())
        for topic in timeline.topics()
    }
    joined = ns_from_unix(2 * asked.view.limits.split_duration_s)
    rows: dict[str, Sequence[Seconds]] = {}
    for topic in sorted(sorted(messages, key=lambda topic: -messages[topic])[:_MOST_TOPICS]):
        extents = ((first, last) for _, first, last in timeline.extents(topic, asked.window))
        rows[topic] = [*map(_unix, united(extents, joined))]
    return rows


def _unix(span: Span) -> Seconds:
    return unix_from_ns(span[0]), unix_from_ns(span[1])
