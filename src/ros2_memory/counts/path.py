"""How far the robot drove in each bin of a window.

The metres between two log times are those of the drawn path, whose corners have times and the
metres driven up to them: the metres of all bins add up to those of the window.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ros2_memory.counts.bins import BinnedWindow
from ros2_memory.history.driven_path import resolve_path_topic, way_in
from ros2_memory.history.no_data import no_data_between
from ros2_memory.history.robots import require_one_robot
from ros2_memory.history.view import open_span

if TYPE_CHECKING:
    from ros2_memory.counts.bins import By
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.history.view import TimeRange
    from ros2_memory.results import Bins


def count_path(
    memory: Memory, call: Call, span: TimeRange, by: By, *, topic: str | None = None
) -> Bins:
    """Returns how many metres were driven in each bin of a window.

    Raises:
        InvalidArgumentsError: a message of the topic carries no position, or there are too many
            bins.
        NoDataError: there are no poses in the window.
        QueryTimeoutError: the call's time runs out before any result.
    """
    view, asked = open_span(memory, call, span)
    name = resolve_path_topic(view, topic)
    binned = BinnedWindow(view, asked, by, (name,))
    way, since = way_in(view, name, binned.counted)
    if way is None:
        raise no_data_between(view, (name,), asked)
    binned.count_since(since)
    total = way.totals.distance_m
    edges = binned.bins.edges[1:-1]
    inner = way.line.metres_at(edges) if len(way.line) else np.zeros(len(edges))
    metres = np.diff([0.0, *inner.tolist(), total])
    binned.add("metres", "metres", (metres @ binned.bins.member).tolist(), total)
    require_one_robot(view, name, asked)
    return binned.answer()
