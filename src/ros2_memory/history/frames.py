"""The transforms of a history as arrays, and the frames of a window of time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ros2_memory.analysis.frames import (
    TF_CACHE_NS,
    Frames,
    edges_of,
    joined_edges,
    static_in,
)
from ros2_memory.columns.transforms import edges_in
from ros2_memory.core.arrays import rows_of
from ros2_memory.history.scan import messages_of, of_columns, scan
from ros2_memory.history.transforms import decoded_transforms, sessions_of, static_transforms

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ros2_memory.analysis.frames import Edges
    from ros2_memory.columns.units import Rows
    from ros2_memory.core.model import TimeWindow
    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.history.sessions import Session
    from ros2_memory.history.view import View


def edges_of_rows(view: View, rows: Rows, among: Session) -> Edges:
    """Returns the transforms of a session in some rows, by their columns, else by their messages.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
    sessions = sessions_of(view)
    if sessions.holds_carried(rows.recording):
        found = (each for each in messages_of(view, rows) if sessions.has(among, each))
        return _by_message(view, found)
    if sessions.folder(rows.recording) not in among:
        return {}
    known = of_columns(view, rows, lambda each: edges_in(each.table, each.times, each.index))
    if known is not None and len(known) == 1:
        return known[0]
    if known is not None:
        # As those of bags come in the order of their log times.
        return {
            pair: rows_of(edge, np.argsort(edge.log_times, kind="stable"))
            for pair, edge in joined_edges(known).items()
        }
    return _by_message(view, messages_of(view, rows))


def frames_over(view: View, among: Session, window: TimeWindow, target: str) -> Frames:
    """Returns the frames of a session in a window, looked up in a target frame.

    They are the same however the history is cut: moving transforms are read from so far around the
    window that others change nothing in it, and static ones hold from when they were received.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
    limits = view.limits
    around = window.widened(TF_CACHE_NS)
    moving = [
        edges_of_rows(view, rows, among)
        for topic in limits.tf_topics
        for rows in scan(view, topic, around, copies=True)
    ]
    static = static_in(static_transforms(view, among), window)
    return Frames(static, joined_edges(moving), target, limits.tf_clock)


def _by_message(view: View, messages: Iterable[StoredMessage]) -> Edges:
    return edges_of(one for each in messages for one in decoded_transforms(view, each))
