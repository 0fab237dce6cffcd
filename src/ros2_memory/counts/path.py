"""How far the robot drove in each bin of a window, everywhere or in a place.

The metres between two log times are those of the drawn path, whose corners have times and the
metres driven up to them: the metres of all bins add up to those of the window.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ros2_memory.counts.bins import BinnedWindow, By
from ros2_memory.history.driven_path import resolve_path_topic, way_in
from ros2_memory.history.no_data import no_data_between
from ros2_memory.history.robots import require_one_robot
from ros2_memory.history.view import TimeRange, open_span
from ros2_memory.places.driven_inside import totals_inside
from ros2_memory.places.robot_tracks import Inside, robot_inside
from ros2_memory.places.where import joined_in_region, parse_where

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from ros2_memory.analysis.motion.trajectory import Line
    from ros2_memory.core.arrays import Ints
    from ros2_memory.core.model import JsonValue
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.results import Bins


def count_path(
    memory: Memory,
    call: Call,
    span: TimeRange,
    by: By,
    *,
    topic: str | None = None,
    where: JsonValue = None,
) -> Bins:
    """Returns how many metres were driven in each bin of a window; with `where` in that place.

    `by` place, the places of `where` have the rows, and what was driven elsewhere counts there.

    Raises:
        InvalidArgumentsError: a message of the topic carries no position, there are too many
            bins, or `where` is no region.
        NoDataError: there are no poses in the window.
        QueryTimeoutError: the call's time runs out before any result.
    """
    region = None if where is None else parse_where(memory.limits, where)
    view, asked = open_span(memory, call, span)
    name = resolve_path_topic(view, topic)
    binned = BinnedWindow(view, asked, by, (name,), region)
    way, since = way_in(view, name, binned.counted)
    if way is None:
        raise no_data_between(view, (name,), asked)
    binned.count_since(since)
    total = way.totals.distance_m
    edges = binned.bins.edges[1:-1]
    if region is not None and by != "place":
        track = joined_in_region(view, region, binned.counted).track
        inside = robot_inside(track, region.region, binned.counted)
        total, inner = totals_inside(way.line, inside).distance_m, _upto(way.line, inside, edges)
    else:
        inner = way.line.metres_at(edges) if len(way.line) else np.zeros(len(edges))
    # Sums of floats differ by less than a micrometre where nothing was driven.
    metres = np.diff([0.0, *inner.tolist(), total]).round(6)
    binned.add("metres", "metres", (metres @ binned.bins.member).tolist(), total)
    require_one_robot(view, name, asked)
    return binned.answer()


def _upto(line: Line, inside: Sequence[Inside], edges: Ints) -> NDArray[np.float64]:
    """Returns how many metres were driven in some times before each edge."""
    metres = np.zeros(len(edges))
    for one in inside:
        ends = np.append(edges.clip(one.start, one.stop), one.start)
        driven = line.metres_at(ends)
        metres += driven[:-1] - driven[-1]
    return metres
