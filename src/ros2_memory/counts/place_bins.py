"""Bins of where the robot was: places, elsewhere, and where that is not known.

The places are the named ones, or those of a question.

A place that lies in another one counts to both, so the bins may add up to more than the window.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.spans import united
from ros2_memory.core.timebase import NS_PER_S, Ns
from ros2_memory.counts.time_bins import TimeBins
from ros2_memory.history.driven_path import resolve_path_topic
from ros2_memory.places.pose_frames import joined_in, map_placement, placed_times, places_in
from ros2_memory.places.where import Where, places_setting

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.core.arrays import Flags, Ints
    from ros2_memory.core.model import TimeWindow
    from ros2_memory.history.view import View

ELSEWHERE: Final = "(elsewhere)"
UNKNOWN: Final = "(unknown)"


def place_bins(view: View, window: TimeWindow, where: Where | None = None) -> TimeBins:
    """Returns places as bins: when the robot was in each; notes list unknown times.

    Raises:
        InvalidArgumentsError: no place is named in the frame of places, or those of the question
            are in a frame that no transforms lead to.
        NoDataError: there are no poses.
        QueryTimeoutError: the call's time runs out before any result.
    """
    topic = resolve_path_topic(view)
    asked_frame = None if where is None else where.frame_id
    placement = map_placement(view, topic, asked_frame)
    named = view.limits.places if where is None else where.places(placement.frame_id)
    places = places_in(view, named, placement, window)
    if not places:
        frames = " or ".join(placement.frames)
        raise InvalidArgumentsError(
            f"by place needs named places in {frames}, and there is none in "
            f"{places_setting(view.limits)}"
        )
    inside = [
        united((each.start, each.stop + 1) for each in joined.inside(place.region, window))
        for place, joined in places
    ]
    known = placed_times(joined_in(view, placement.frame_id, window).track, [])
    cuts = {at for spans in (*inside, known) for span in spans for at in span}
    within = sorted(at for at in cuts if window.start < at < window.stop)
    edges = np.array([window.start, *within, window.stop], np.int64)
    in_places = np.array([_covered(edges, spans) for spans in inside]).T
    if (np.diff(edges)[in_places.sum(axis=1) > 1] > NS_PER_S).any():
        view.notes.add("places overlap: what is in two of them counts to both")
    in_none = ~in_places.any(axis=1)
    placed = _covered(edges, known)
    member = np.column_stack((in_places, in_none & placed, in_none & ~placed))
    names = (*(each.name for each, _ in places), ELSEWHERE, UNKNOWN)
    return TimeBins(names, edges, member, None)


def _covered(edges: Ints, spans: Sequence[tuple[Ns, Ns]]) -> Flags:
    """Returns for each piece between two edges whether it lies in one of some half-open spans."""
    starts, stops = np.array(spans, np.int64).reshape(-1, 2).T
    begun = np.searchsorted(starts, edges[:-1], side="right")
    ended = np.searchsorted(stops, edges[:-1], side="right")
    return begun > ended
