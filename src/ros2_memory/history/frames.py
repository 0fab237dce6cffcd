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
from ros2_memory.history.scan import decoded_rows, messages_of, scan
from ros2_memory.history.transforms import decoded_transforms, sessions_of, static_transforms

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from ros2_memory.analysis.frames import Edges
    from ros2_memory.columns.units import Rows
    from ros2_memory.core.model import TimeWindow
    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.history.sessions import Session
    from ros2_memory.history.view import View


def transform_rows(
    view: View, topic: str, window: TimeWindow, among: Session
) -> Iterator[tuple[Rows, Edges]]:
    """Yields the transforms that a session received on a topic in a window, table by table.

    In the order of the first log time of each table. A message that was received by several of its
    recordings counts in each: a lookup takes no notice.

    Raises:
        QueryTimeoutError: while it is iterated, when the deadline has passed.
    """
    sessions = sessions_of(view)
    for rows in scan(view, topic, window, copies=True):
        if sessions.holds_carried(rows.recording) or sessions.folder(rows.recording) in among:
            yield rows, edges_of_rows(view, rows, among)


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
    edges = edges_in(rows.table, rows.times, rows.index)
    if edges is not None:
        return edges
    decoded = [edges_in(some.table, some.times, some.index) for some in decoded_rows(view, rows)]
    known = [edges for edges in decoded if edges is not None]
    if decoded and len(known) == len(decoded):
        # As those of bags come in the order of their log times.
        return {
            pair: edge.rows(np.argsort(edge.log_times, kind="stable"))
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
    limits = view.memory.limits
    around = window.widened(TF_CACHE_NS)
    moving = [
        edges
        for topic in limits.tf_topics
        for _, edges in transform_rows(view, topic, around, among)
    ]
    static = static_in(static_transforms(view, among), window)
    return Frames(static, joined_edges(moving), target, limits.tf_clock)


def _by_message(view: View, messages: Iterable[StoredMessage]) -> Edges:
    return edges_of(one for each in messages for one in decoded_transforms(view, each))
