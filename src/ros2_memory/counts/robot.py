"""How far the robot drove, and how often and how long it was in places, in each bin of a window.

Metres come from the drawn path: each of its vertices has a log time and the metres driven so far.
So the metres of all bins add up to the metres of the window.
"""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING

import numpy as np

from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.spans import united, without
from ros2_memory.counts.bins import MOST_CELLS, BinnedWindow, By
from ros2_memory.history.coverage import unknown_times
from ros2_memory.history.driven_path import (
    follow,
    no_path,
    path_by_poses,
    resolve_path_topic,
)
from ros2_memory.history.robots import note_robots, require_one_robot
from ros2_memory.history.view import (
    ANY_TIME,
    TimeRange,
    View,
    clamped,
    open_span,
    open_view,
    search_window,
)
from ros2_memory.places.driven_inside import totals_inside
from ros2_memory.places.pose_frames import (
    WHEREABOUTS,
    known_track,
    map_placement,
    placed_times,
    places_in,
)
from ros2_memory.places.visits import ConfirmedStays, TrackedStay, asked_place
from ros2_memory.places.where import Scope, counted_stays, note_other_frame, parse_where

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from ros2_memory.analysis.motion.trajectory import Line
    from ros2_memory.core.arrays import Ints
    from ros2_memory.core.model import JsonValue, TimeWindow
    from ros2_memory.core.regions import Region
    from ros2_memory.core.timebase import Span
    from ros2_memory.history.conditions import Sought
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
    during: Sequence[Sought] = (),
) -> Bins:
    """Returns how many metres the robot drove in each bin of a window, or only inside of `where`.

    With `by` "place" the places of `where` are the bins instead, and what was driven elsewhere is
    counted, too. With `during` only what was driven while other topics met conditions counts.

    Raises:
        InvalidArgumentsError: a message of the topic carries no position, there are too many
            bins, or `where` is no region.
        NoDataError: there are no poses in the window.
        QueryTimeoutError: the call's time runs out before any result.
    """
    place_asked = None if where is None else parse_where(memory.limits, where)
    view, asked = open_span(memory, call, span)
    name = follow(view, topic)
    binned = BinnedWindow(view, asked, by, (name,), place_asked)
    path, since = path_by_poses(view, name, binned.counted)
    if path is None or not path.poses:
        raise no_path(view, name, asked)
    binned.count_since(since)
    total_m = path.totals.distance_m
    edges = binned.bins.edges[1:-1]
    region = None if by == "place" else place_asked
    if region is not None or during:
        scope = Scope(view, binned.counted, during=during)
        stays = counted_stays(view, region, scope, (path.first, path.last))
        inside = [*chain.from_iterable(stays)]
        total_m = totals_inside(path.line, inside).distance_m
        metres_before = _metres_before(path.line, inside, edges)
        binned.add_unknown(scope.unknown)
    else:
        metres_before = path.line.metres_at(edges) if len(path.line) else np.zeros(len(edges))
    # Rounded to a micrometre: differences of sums may be off from 0 by less.
    metres = np.diff([0.0, *metres_before.tolist(), total_m]).round(6)
    of_bins: list[float | None] = (metres @ binned.bins.member).tolist()
    if by != "place":
        # The path has a vertex in each of its slices, and so in each bin with a pose.
        vertices = np.bincount(binned.bins.pieces(path.line.times), minlength=len(metres))
        are_known = vertices @ binned.bins.member > 0
        of_bins = [
            one if is_known else None for one, is_known in zip(of_bins, are_known, strict=True)
        ]
    binned.add("metres", "metres", of_bins, total_m)
    require_one_robot(view, name, asked)
    return binned.answer()


def _metres_before(line: Line, inside: Sequence[Span], edges: Ints) -> NDArray[np.float64]:
    """Returns how many metres were driven in the spans before each edge (ns)."""
    metres = np.zeros(len(edges))
    for start, stop in inside:
        bounds = np.append(edges.clip(start, stop), start)
        driven = line.metres_at(bounds)
        metres += driven[:-1] - driven[-1]
    return metres


def count_visits(
    memory: Memory,
    call: Call,
    x: float | None = None,
    y: float | None = None,
    *,
    by: By,
    where: JsonValue = None,
    frame_id: str | None = None,
    radius_m: float | None = None,
    span: TimeRange = ANY_TIME,
    during: Sequence[Sought] = (),
) -> Bins:
    """Returns entries, exits and minutes in a place for each bin; without a place, in all named.

    The place is a circle around `x` and `y` (m), or `where`; being in any of several places counts.
    With `by` "place" each of them is a bin. With `during` only what was while other topics met
    conditions counts, as in `ConfirmedStays`. Column `placed_s` is how long it was known where the
    robot was, `unknown_s` how long it was not.

    Raises:
        InvalidArgumentsError: the place is invalid, the frame is another one, there are too many
            bins, or x and y are given besides `by` place.
        NoDataError: nothing is recorded in the window, or no poses.
        QueryTimeoutError: the call's time runs out before any result.
    """
    place = asked_place(memory.limits, (x, y), radius_m, where, frame_id)
    if by == "place" and x is not None:
        raise InvalidArgumentsError(
            "by place counts the places of where, or all named ones: give where in place of x and y"
        )
    wall = memory.clock.now()
    window = search_window(span, wall)
    view = open_view(memory, call, min(window.stop, wall))
    asked = clamped(view, window)
    topic = resolve_path_topic(view)
    mixed_spans = note_robots(view, topic, asked, places=True)
    placement = map_placement(view, topic, frame_id if place is None else place.frame_id)
    binned = BinnedWindow(view, asked, by, (topic,), place)
    # `count_since` narrows what is counted. The call remembers the track of this wider window.
    window = binned.counted
    known = known_track(view, placement.frame_id, window)
    binned.count_since(known.since)
    placed_spans = placed_times(known.track, mixed_spans)
    # A short gap ends no visit, but then nothing is recorded.
    binned.add_lengths("placed_s", "duration", without(placed_spans, united(binned.gaps)))
    unknown = unknown_times(view, binned.counted, placed_spans, WHEREABOUTS, mixed=mixed_spans)
    scope = Scope(view, binned.counted, during=during)
    binned.add_unknown(united([*unknown, *scope.unknown]))
    if place is not None and by != "place":
        stays = _stays(view, placement.frame_id, place.region, window, scope)
        if not stays and not during:
            advice = f'ask with frame_id "{placement.pose_frame}"'
            note_other_frame(view, place, placement, binned.window, advice)
        _add_visits(binned, stays)
        return binned.answer()
    named = memory.limits.places if place is None else place.places(placement.frame_id)
    scope = scope.settled()
    # Two places may have one name.
    named_stays = [
        (place.name, _stays(view, place.frame_id, place.region, window, scope))
        for place, _ in places_in(view, named, placement, window)
    ]
    if by == "place":
        _add_visits_by_place(binned, [stays for _, stays in named_stays])
    else:
        _add_visits_of_each(binned, by, named_stays)
    return binned.answer()


def _stays(
    view: View, frame_id: str, region: Region, window: TimeWindow, scope: Scope
) -> list[TrackedStay]:
    """Returns when robots were in a region, in order, as the tool `visits` counts them."""
    return ConfirmedStays(view, frame_id, region, window, scope).visits[::-1]


def _add_visits(binned: BinnedWindow, stays: Sequence[TrackedStay]) -> None:
    """Adds the columns of visits to one place."""
    entries = _entry_times(stays)
    exits = np.array([stay.inside.stop for stay in stays if stay.inside.left], np.int64)
    binned.add_counts("entries", entries)
    binned.add_counts("exits", exits)
    binned.add_lengths("minutes", "minutes", _spans(stays))
    binned.add_first("first_entry", entries)
    binned.add_first("first_exit", exits)
    binned.usual = binned.usual_of(entries)


def _add_visits_by_place(
    binned: BinnedWindow, stays_of_places: Sequence[Sequence[TrackedStay]]
) -> None:
    """Adds the columns of visits for bins of places; there are no visits to "(elsewhere)"."""
    entries = [len(_entry_times(stays)) for stays in stays_of_places]
    exits = [len([stay for stay in stays if stay.inside.left]) for stays in stays_of_places]
    lengths = [binned.elapsed.among(_spans(stays)) for stays in stays_of_places]
    no_visits: list[None] = [None] * (len(binned.bins.names) - len(stays_of_places))
    binned.add("entries", "count", [*entries, *no_visits], sum(entries))
    binned.add("exits", "count", [*exits, *no_visits], sum(exits))
    binned.add("minutes", "minutes", [*lengths, *no_visits], sum(lengths))


def _add_visits_of_each(
    binned: BinnedWindow, by: By, named_stays: Sequence[tuple[str, Sequence[TrackedStay]]]
) -> None:
    """Adds entries and minutes of each named place.

    Raises:
        InvalidArgumentsError: these are too many columns.
    """
    bins = len(binned.bins.names)
    if len(named_stays) * bins > MOST_CELLS:
        raise InvalidArgumentsError(
            f"{len(named_stays)} places by {by} in {bins} bins are too many for one reply: name "
            "one in where, or ask about a shorter window"
        )
    for name, stays in named_stays:
        binned.add_counts(f"{name}.entries", _entry_times(stays))
        binned.add_lengths(f"{name}.minutes", "minutes", _spans(stays))


def _entry_times(stays: Sequence[TrackedStay]) -> Ints:
    return np.array([stay.inside.start for stay in stays if stay.inside.entered], np.int64)


def _spans(stays: Sequence[TrackedStay]) -> list[Span]:
    return [part for stay in stays for part in stay.parts]
