"""`ros2-memory plot`: pictures of what is recorded, by the same queries as the tools.

Times are Unix seconds. No window is opened, and nothing is written but the picture and what
matplotlib keeps in its own folders, its list of fonts.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
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
from ros2_memory.cli.options import AsJson, Bags, Times, as_command
from ros2_memory.cli.output import atomic_file, print_json, print_line, print_notes, spinner
from ros2_memory.core.arrays import Ints
from ros2_memory.core.errors import InvalidArgumentsError, NoDataError, NoDataReason
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.spans import united, without
from ros2_memory.core.text import listed
from ros2_memory.core.timebase import NS_PER_S, Ns, Span, ns_from_unix, unix_from_ns
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.coverage import note_unread, recording_gaps, shown_window
from ros2_memory.history.no_data import resolve_topic
from ros2_memory.history.robots import note_times_twice
from ros2_memory.history.scan import pick
from ros2_memory.history.view import TimeRange, View, open_view
from ros2_memory.insights.recap import recap
from ros2_memory.results import Recap
from ros2_memory.serving.page.drawn_path import Box, Line, line_in_box

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


FORMATS: Final = (".svg", ".png")
_EVERYWHERE: Final = Box(-math.inf, -math.inf, math.inf, math.inf, 0.001)
"""The path is drawn to the millimetre."""
_SHORTEST_S: Final = 0.001
"""A recap needs some length."""
_MOST_SAMPLES: Final = 20_000
"""Messages of a signal that are drawn, evenly spaced: some for each column of a wide picture."""
_MOST_FIELDS: Final = 20
"""Fields of one picture: 300 rows take minutes to lay out."""
MOST_TOPICS: Final = 200
"""Rows of topics in one picture: one of 2,500 is 88,000 pixels high, which few programs show."""
_PERIODS: Final = 5
"""A step of a signal that is longer than so many usual ones, and than a second, is a gap."""
_STYLE: Final = {
    "axes.grid": True,
    "font.size": 9,
    "text.parse_math": False,  # or a dollar sign in a name would begin a formula
}
_DAY_S: Final = 86_400

Seconds: TypeAlias = tuple[float, float]
Floats: TypeAlias = NDArray[np.float64]
Signal: TypeAlias = tuple[Floats, Floats]
"""Times (Unix s) and values; a value is NaN where the message has none, and in gaps."""
Rows: TypeAlias = Mapping[str, Sequence[Seconds]]
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
        """The first and the last time that were asked for (Unix s, inclusive)."""
        return _in_seconds(self.window.asked())

    def recap(self) -> Recap:
        """Returns the recap of the window."""
        start_s, end_s = self.span
        asked = TimeRange(start_s, max(end_s, start_s + _SHORTEST_S))
        return recap(self.view.memory, Call(), asked, each_sight=True)


@dataclass(frozen=True, kw_only=True)
class Picture(Bags, Times):
    """The options of a picture."""

    out: Annotated[
        Path, "--out", "-o", "FILE", "Write the picture here: .svg or .png; overwrites the file."
    ]
    as_json: AsJson = False

    def open_window(self, times: Times | None = None) -> PlotWindow:
        """Opens the memory at the window of the options, or at another one.

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
        return recorded_part(memory, (times or self).window(memory))

    @contextmanager
    def figure(
        self, title: str, shown: PlotWindow, notes: Sequence[str], height: float = 6.0
    ) -> Iterator["Figure"]:
        """Yields a figure to draw on; afterwards writes the file, and prints its name and notes.

        `height` is in inches.

        Raises:
            OSError: the file cannot be written.
        """
        from matplotlib import rc_context  # noqa: PLC0415 - an extra that few install
        from matplotlib.figure import Figure  # noqa: PLC0415

        start, end = (datetime.fromtimestamp(at).astimezone() for at in shown.span)
        with rc_context(_STYLE), atomic_file(self.out) as temporary:
            figure = Figure(figsize=(9.0, height), layout="constrained")
            figure.suptitle(f"{title}, {start:%Y-%m-%d %H:%M:%S} - {end:%Y-%m-%d %H:%M:%S %Z}")
            yield figure
            figure.savefig(temporary, format=self.out.suffix[1:].lower(), dpi=130)
        if self.as_json:
            print_json({"path": str(self.out), "notes": [*notes]})
        else:
            print_line(str(self.out))
            print_notes(notes)


@plot.command("path", epilog=epilog("plot"))
@as_command("plot path")
def plot_path(*, picture: Picture) -> None:
    """Draw the driven path in 2D, with named places.

    Another topic of poses is chosen by data.pose_topic=TOPIC, a frame by data.map_frame=FRAME.
    """
    shown = picture.open_window()
    with spinner("looking for the path"):
        frame, line = _path_in(shown)
        note_unread(shown.view, shown.window)
        note_times_twice(shown.view, shown.window)
    with picture.figure("Path", shown, [*shown.view.notes.sentences()]) as figure:
        _draw_path(figure.add_subplot(), shown, frame, line)


@plot.command("signal", epilog=epilog("plot"))
@as_command("plot signal")
def plot_signal(
    topic: Annotated[
        str, typer.Argument(metavar="TOPIC", help="The name of the topic, such as /battery.")
    ],
    *,
    field: Annotated[list[str], "PATH", "A numeric field, such as position.x; repeatable."],
    picture: Picture,
) -> None:
    """Draw numeric fields of a topic over time, one row for each field."""
    if len(field) > _MOST_FIELDS:
        raise InvalidArgumentsError(f"{len(field)} fields; at most {_MOST_FIELDS} are drawn")
    shown = picture.open_window()
    name = resolve_topic(shown.view, topic)
    with spinner(f"reading {name}"):
        signals, notes = read_signals(shown, name, field)
    with picture.figure(name, shown, notes, 1.2 + 1.9 * len(signals)) as figure:
        rows = figure.subplots(len(signals), 1, sharex=True, squeeze=False)[:, 0]
        for axes, (field_name, (times_s, values)) in zip(rows, signals.items(), strict=True):
            # With marks, or a value between two gaps would not be seen.
            axes.plot(times_s / _DAY_S, values, linewidth=1, marker=".", markersize=2)
            axes.set_title(field_name)
        _show_times(rows[-1], shown.span)


@plot.command("timeline", epilog=epilog("plot"))
@as_command("plot timeline")
def plot_timeline(*, picture: Picture) -> None:
    """Draw what was recorded when: gaps, silences and events, and one row for each topic."""
    shown = picture.open_window()
    with spinner("looking what was recorded when"):
        summary, topics = shown.recap(), topic_rows(shown)
        rows = {**event_rows(shown, summary), **dict([*topics.items()][:MOST_TOPICS])}
    notes = [*summary.notes]
    if len(topics) > MOST_TOPICS:
        notes.append(f"{MOST_TOPICS} of {len(topics)} topics are drawn, the first by name")
    with picture.figure("Recorded", shown, notes, 1.3 + 0.27 * len(rows)) as figure:
        _draw_rows(figure.add_subplot(), rows, shown.span)


@plot.command("recap", epilog=epilog("plot"))
@as_command("plot recap")
def plot_recap(*, picture: Picture) -> None:
    """Draw a day in one picture: where the robot drove, what happened, what was recorded.

    Without a time it is today; --start yesterday --end yesterday is the day before.
    """
    has_times = any((picture.start, picture.end, picture.last))
    shown = picture.open_window(None if has_times else Times(start="today", end="today"))
    with spinner("recalling the day"):
        summary = shown.recap()
        rows = event_rows(shown, summary)
    height = 0.35 + 0.3 * len(rows)
    with picture.figure("Recap", shown, summary.notes, 6.0 + height) as figure:
        plane, timeline = figure.subplots(2, 1, height_ratios=[6.0, height])
        plane.set_axis_off()
        with suppress(InvalidArgumentsError, NoDataError):  # a day without a path is drawn, too
            _draw_path(plane, shown, *_path_in(shown))
            plane.set_axis_on()
        _draw_rows(timeline, rows, shown.span)


def recorded_part(memory: Memory, window: TimeWindow) -> PlotWindow:
    """Returns the part of a window that the memory can show.

    Raises:
        NoDataError: nothing is recorded, or nothing in that window.
    """
    view = open_view(memory, Call(), window.stop)
    part = shown_window(view.snapshot, window)
    if part.empty:
        raise NoDataError(NoDataReason.OUTSIDE_RANGE, "nothing was recorded in this time")
    return PlotWindow(view, part)


def _path_in(shown: PlotWindow) -> tuple[str, Line]:
    """Returns the frame of the robot's path, and the path, which has at least one point.

    Raises:
        NoDataError: nothing places the robot in this time.
    """
    path, line, _ = line_in_box(shown.view.memory, Call(), shown.window, _EVERYWHERE)
    if not len(line.times):
        raise NoDataError(NoDataReason.OUTSIDE_RANGE, "the robot has no place in this time")
    return path.frame, line


def _draw_path(axes: "Axes", shown: PlotWindow, frame: str, line: Line) -> None:
    """Draws a path, with the named places of its frame."""
    for place in shown.view.limits.places:
        if place.frame_id == frame:
            left, right, low, high = place.region.bounds
            axes.annotate(place.name, ((left + right) / 2, (low + high) / 2), ha="center")
    breaks = np.flatnonzero(line.begins)
    x, y = (np.insert(values, breaks, math.nan) for values in (line.x, line.y))
    # With marks, or a point between two breaks would not be seen.
    axes.plot(x, y, linewidth=1.5, marker=".", markersize=2)
    axes.scatter(line.x[0], line.y[0], s=60, marker="o", color="C2", zorder=3, label="start")
    axes.scatter(line.x[-1], line.y[-1], s=60, marker="s", color="C3", zorder=3, label="end")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(f"x (m, {frame})")
    axes.set_ylabel("y (m)")
    axes.legend()


def _draw_rows(axes: "Axes", rows: Rows, span: Seconds) -> None:
    """Draws the rows of a timeline, the first one on top."""
    for row, stretches in enumerate(rows.values()):
        bars = [(first / _DAY_S, (last - first) / _DAY_S) for first, last in stretches]
        # The edge shows a moment, which is no time long.
        axes.broken_barh(bars, (row - 0.34, 0.68), color=f"C{row}", linewidth=1)
    axes.set_yticks(range(len(rows)), [*rows])
    axes.invert_yaxis()
    _show_times(axes, span)


def _show_times(axes: "Axes", span: Seconds) -> None:
    """Limits an axis of days since 1970 to a span, and labels it with local times."""
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter  # noqa: PLC0415 - as above

    start, end = span
    # One offset from UTC for the whole axis: the one in its middle.
    zone = datetime.fromtimestamp((start + end) / 2).astimezone().tzinfo
    locator = AutoDateLocator(tz=zone)
    axes.xaxis.set_major_locator(locator)
    axes.xaxis.set_major_formatter(ConciseDateFormatter(locator, tz=zone))
    axes.set_xlim(start / _DAY_S, max(end, start + _SHORTEST_S) / _DAY_S)


def read_signals(
    shown: PlotWindow, topic: str, fields: Sequence[str]
) -> tuple[dict[str, Signal], list[str]]:
    """Reads numeric fields of a topic.

    Returns the signals by dot-path, and notes.

    Raises:
        InvalidArgumentsError: the messages have no such field, or it holds no number.
    """
    total, picked = pick(shown.view, topic, shown.window, _MOST_SAMPLES)
    times: list[Ns] = []
    rows: list[list[float]] = []
    for time, value in extract_values(shown.view, picked, fields, exact=True):
        cells = value if isinstance(value, dict) else {}
        times.append(time)
        rows.append([_number(cells.get(field)) for field in fields])
    notes = [*shown.view.notes.sentences()]
    if total > _MOST_SAMPLES:
        notes.append(f"{len(rows)} of {total} messages are drawn, evenly spaced")
    columns = np.array(rows, np.float64).reshape(-1, len(fields)).T
    signals = dict(zip(fields, columns, strict=True))
    without_number = [field for field, values in signals.items() if np.isnan(values).all()]
    if without_number:
        raise InvalidArgumentsError(f"{listed(without_number)} holds no number in this time")
    at = np.array(times)
    return {field: _broken_at_gaps(at, values) for field, values in signals.items()}, notes


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
    return rows


def topic_rows(shown: PlotWindow) -> Rows:
    """Returns when each topic was recorded, by name."""
    timeline = shown.view.timeline
    # A topic that lacks one split is not shown as interrupted.
    joined = ns_from_unix(2 * shown.view.limits.split_duration_s)
    rows: dict[str, Sequence[Seconds]] = {}
    for topic in sorted(timeline.topics()):
        extents = ((first, last) for _, first, last in timeline.extents(topic, shown.window))
        rows[topic] = [*map(_in_seconds, united(extents, joined))]
    return rows


def _in_seconds(span: Span) -> Seconds:
    return unix_from_ns(span[0]), unix_from_ns(span[1])
