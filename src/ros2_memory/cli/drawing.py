"""Draws with matplotlib: a path, rows of a timeline, signals. Times are Unix seconds.

Nothing here knows bags or a memory. No window is opened, and nothing is written but the picture and
matplotlib's list of fonts (see `cache_folder`).
"""

from __future__ import annotations

import logging
import os
import textwrap
import warnings
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from tempfile import mkdtemp
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory import PACKAGE


def cache_folder() -> str:
    """Returns where matplotlib keeps its list of fonts: the cache folder, or a temporary one."""
    given = os.environ.get("XDG_CACHE_HOME")
    with suppress(OSError, RuntimeError):
        folder = Path(given) if given else Path.home() / ".cache"
        folder = folder / PACKAGE / "matplotlib"
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return str(folder)
    return mkdtemp(prefix="ros2-memory-")


os.environ.setdefault("MPLCONFIGDIR", cache_folder())
logging.getLogger("matplotlib").setLevel(logging.ERROR)  # it warns of fonts, and of its own limits

from matplotlib import rc_context  # noqa: E402 - it makes its folder when it is imported
from matplotlib.collections import LineCollection  # noqa: E402
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, DateFormatter  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402
from matplotlib.patches import Circle as RoundPatch  # noqa: E402
from matplotlib.patches import Polygon as PolygonPatch  # noqa: E402

from ros2_memory.core.regions import Circle, Place, Polygon  # noqa: E402
from ros2_memory.core.text import shortened  # noqa: E402

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from ros2_memory.cli.plot import DrawnPath, Signal, TimelineRow

_STYLE: Final = {
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 11,
    "axes.titlelocation": "left",
    "figure.facecolor": "white",
    "font.size": 9,
    "svg.hashsalt": "ros2-memory",
    "text.parse_math": False,  # or a dollar sign in a name would begin a formula
}
_GRID: Final = {"color": "#e5e7eb", "linewidth": 0.8}
_PALETTE: Final = ("#2563eb", "#d97706", "#059669", "#7c3aed", "#db2777", "#0891b2")
_DAY_S: Final = 86_400
_LEAST_SHARE: Final = 0.002
"""Of the width of a timeline: what is shorter is drawn as long."""
_LONGEST_NAME: Final = 34
_LEAST_SIDE: Final = 0.4
"""Of the longer side of a plane: the shorter one is no less."""
_DPI: Final = 130
_SECONDS_BELOW_S: Final = 600
"""Beside the colours of a shorter path seconds alone would not be read as such."""


@contextmanager
def picture(path: Path, title: str, subtitle: str, size: tuple[float, float]) -> Iterator[Figure]:
    """Yields a figure, and writes what the block has drawn in the format that the suffix names.

    `subtitle` has the details of the whole, and `size` is its width and height in inches.

    Raises:
        OSError: it cannot be written.
    """
    with rc_context(_STYLE), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # on letters that no font here has
        figure = Figure(figsize=size, layout="constrained")
        shown = f"{title}\n{subtitle}" if subtitle else title
        figure.suptitle(shown, x=0.01, ha="left", fontsize=11)
        yield figure
        metadata = {"Date": None} if path.suffix.lower() == ".svg" else None
        figure.savefig(path, dpi=_DPI, metadata=metadata)


def draw_path(
    axes: Axes,
    path: DrawnPath,
    places: Sequence[Place],
    stops: Sequence[tuple[float, float, float]],
) -> None:
    """Draws a path, coloured by time, with named places and standstills of the same frame."""
    for place in places:
        _draw_place(axes, place)
    points = np.column_stack([path.xs, path.ys])
    pieces = np.stack([points[:-1], points[1:]], axis=1)
    driven = ~path.jumps[1:]
    days = path.times[:-1] / _DAY_S
    lines = LineCollection([*pieces[driven]], array=days[driven], cmap="viridis", linewidths=2.0)
    axes.add_collection(lines)
    axes.add_collection(LineCollection([*pieces[~driven]], colors="#9ca3af", linestyles="dotted"))
    axes.scatter(*points[0], s=60, marker="o", color="#16a34a", zorder=3, label="start")
    axes.scatter(*points[-1], s=60, marker="s", color="#dc2626", zorder=3, label="end")
    if stops:
        xs, ys, lengths = zip(*stops, strict=True)
        sizes = 30 + np.minimum(lengths, 3600) / 12
        look = {"color": "#f59e0b", "alpha": 0.55, "linewidths": 0}
        axes.scatter(xs, ys, s=sizes, zorder=2, label="stood", **look)
    _fit(axes, points)
    axes.grid(visible=True, **_GRID)
    axes.set_axisbelow(True)
    axes.set_xlabel(f"x (m, {path.frame})")
    axes.set_ylabel("y (m)")
    axes.legend(loc="best", framealpha=0.85, fontsize=8)
    if path.times[-1] > path.times[0] and axes.figure is not None:
        is_wide = np.ptp(axes.get_xlim()) > 1.4 * np.ptp(axes.get_ylim())
        side = "bottom" if is_wide else "right"
        bar = axes.figure.colorbar(lines, ax=axes, location=side, shrink=0.8, pad=0.02)
        bar.set_label("time of day")
        _format_times(bar.ax, path.times[0], path.times[-1], of_colors=side)


def _fit(axes: Axes, points: NDArray[np.float64]) -> None:
    """Shows all points at one scale, with some room, and neither side much shorter."""
    low, high = points.min(axis=0), points.max(axis=0)
    least = max(*(high - low), 0.5) * _LEAST_SIDE
    half = np.maximum(high - low, least) * 0.58
    (left, bottom), (right, top) = (low + high) / 2 - half, (low + high) / 2 + half
    axes.set(xlim=(left, right), ylim=(bottom, top))
    axes.set_aspect("equal", adjustable="box")


def _draw_place(axes: Axes, place: Place) -> None:
    region, shade = place.region, {"facecolor": "#f3f4f6", "edgecolor": "#9ca3af"}
    left, right, low, high = region.bounds
    if isinstance(region, Circle):
        axes.add_patch(RoundPatch((region.x, region.y), region.radius_m, **shade))
    else:
        corners = [(left, low), (right, low), (right, high), (left, high)]
        given = region.corners if isinstance(region, Polygon) else corners
        axes.add_patch(PolygonPatch([*given], **shade))
    middle = ((left + right) / 2, (low + high) / 2)
    axes.annotate(place.name, middle, ha="center", va="center", color="#6b7280", fontsize=8)


def draw_rows(axes: Axes, rows: Sequence[TimelineRow], span: tuple[float, float]) -> None:
    """Draws rows, the first one on top."""
    start, end = span
    least = max((end - start) * _LEAST_SHARE, 1e-6)
    for at, row in enumerate(reversed(rows)):
        bars = [
            (first / _DAY_S, max(last - first, least) / _DAY_S) for first, last in row.stretches
        ]
        axes.broken_barh(bars, (at - 0.34, 0.68), facecolors=row.color, linewidth=0)
    names = [shortened(row.name, _LONGEST_NAME) for row in rows]
    axes.set_yticks(range(len(rows)), [*reversed(names)])
    axes.set_ylim(-0.6, len(rows) - 0.4)
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=True, axis="x", **_GRID)
    axes.set_axisbelow(True)
    _format_times(axes, start, end + least)


def draw_signals(figure: Figure, signals: Sequence[Signal], span: tuple[float, float]) -> None:
    """Draws each signal in a row of its own, over one axis of time."""
    rows = figure.subplots(len(signals), 1, sharex=True, squeeze=False)[:, 0]
    for number, (axes, signal) in enumerate(zip(rows, signals, strict=True)):
        times = signal.times / _DAY_S
        marker = "." if len(times) < 60 else ""
        color = _PALETTE[number % len(_PALETTE)]
        axes.plot(times, signal.values, color=color, linewidth=1.1, marker=marker)
        axes.set_title(signal.name)
        axes.grid(visible=True, **_GRID)
        axes.ticklabel_format(axis="y", useOffset=False)
    _format_times(rows[-1], *span)


def draw_recap(
    figure: Figure, rows: Sequence[TimelineRow], span: tuple[float, float], lines: Iterable[str]
) -> Axes:
    """Draws lines of text, and a timeline below; returns the free part beside, for the path."""
    height = 0.35 + 0.3 * len(rows)
    grid = figure.add_gridspec(
        2, 2, height_ratios=[max(7.0 - height, 3.0), height], width_ratios=[1.25, 1.0]
    )
    plane, beside = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[0, 1])
    beside.set_axis_off()
    wrapped = "\n".join(textwrap.fill(each, 62, subsequent_indent="            ") for each in lines)
    beside.text(0, 1, wrapped, ha="left", va="top", fontsize=8.5, linespacing=1.5)
    draw_rows(figure.add_subplot(grid[1, :]), rows, span)
    return plane


def write_instead(axes: Axes, reason: str) -> None:
    """Writes why a part of a picture has nothing to show."""
    axes.set_axis_off()
    axes.text(0.5, 0.5, textwrap.fill(reason, 50), ha="center", va="center", color="#6b7280")


def _format_times(axes: Axes, start: float, end: float, *, of_colors: str = "") -> None:
    """Labels an axis of time in this machine's zone, as it is in the middle.

    `of_colors` is the side on which a bar of colours is.
    """
    zone = datetime.fromtimestamp((start + end) / 2, tz=UTC).astimezone().tzinfo
    axis = axes.yaxis if of_colors == "right" else axes.xaxis
    locator = AutoDateLocator(tz=zone, maxticks=8)
    axis.set_major_locator(locator)
    if of_colors and end - start < _SECONDS_BELOW_S:
        axis.set_major_formatter(DateFormatter("%H:%M:%S", tz=zone))
    else:
        # The title has the date; beside the colours there is no room for it.
        axis.set_major_formatter(ConciseDateFormatter(locator, tz=zone, show_offset=not of_colors))
    if not of_colors and end > start:
        axes.set_xlim(start / _DAY_S, end / _DAY_S)
