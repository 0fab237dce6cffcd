"""The path of the robot in one frame with few vertices, each with its time.

Between two vertices the robot is taken to move evenly; no pose is farther than `TOLERANCE_M` from
where that has it *at its time*. So a track answers where the robot was, and when it entered a
region, which a path that is drawn in space alone does not. Vertices are poses.

Which poses are vertices is decided in each *slice* of the clock by itself, so it does not depend
on how a history was cut: the first and the last pose of a slice are vertices, and what lies
farthest from the line between two of them is another. Poses of a table whose first or last slice
other tables may share are all kept there until the tables are joined.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.core.arrays import run_starts
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S, Ns

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from ros2_memory.analysis.frames import Floats, Mask, Times
    from ros2_memory.core.model import TimeWindow

TOLERANCE_M: Final = 0.05
TOLERANCE_RAD: Final = 0.15
TRACK_SLICE_NS: Final = 10 * NS_PER_S
_SLOT_NS: Final = NS_PER_S // 5
"""Of the poses in a slot of the clock the first and the last count: nothing bends a way between."""

_JUMP_NS: Final = 2 * NS_PER_S
"""A step that is faster, and not longer than this, is a jump."""
_MAX_M: Final = 1e8
"""Poses beyond are no place; northings of UTM are up to 1e7."""
_PER_M: Final = 10_000
"""Vertices are rounded to 0.1 mm, as the store has poses."""
_WEIGHT: Final = TOLERANCE_M / TOLERANCE_RAD
"""Metres that count as much as a radian."""
_TURN: Final = 1 << 22
"""Headings are counted in such parts of a turn, so that many turns add up exactly."""


@dataclass(frozen=True, slots=True)
class RobotTrack:
    """Vertices ascending in time.

    Attributes:
        times: log times.
        x: metres.
        y: metres.
        heading: about Z (rad), continuous from vertex to vertex; NaN where it is not known.
        begins: whether a piece begins at the vertex: the robot was not seen between it and the one
            before for longer than `SILENCE_NS`.
        fastest_mps: the highest plausible speed; what is faster is a jump.
    """

    times: Times
    x: Floats
    y: Floats
    heading: Floats
    begins: Mask
    fastest_mps: float = math.inf

    @property
    def ends(self) -> Mask:
        """Whether a piece ends at the vertex."""
        return _is_last(self.begins)

    @property
    def pieces(self) -> tuple[Times, Times]:
        """The first and the last time of each piece (ns, inclusive)."""
        return self.times[self.begins], self.times[self.ends]

    def at(self, times: Times) -> tuple[Floats, Floats, Floats]:
        """Returns x, y (m) and heading (rad) at some times; there must be a vertex."""
        # From the first vertex, so that numbers are small enough for a double to be exact.
        since = self.times[0]
        columns = (self.x, self.y, self.heading)
        x, y, heading = (np.interp(times - since, self.times - since, axis) for axis in columns)
        return x, y, heading


class PartialTrack(NamedTuple):
    """The track by some poses, in order of time, before it is joined with those before and after.

    Attributes:
        times: log times.
        x: metres.
        y: metres.
        turns: headings in whole parts of a turn, continuous from one to the next.
        known: whether the heading is known.
        settled: whether no other pose can be in the slice of this one.
        left_out: poses that could not be placed.
        recording: the folder of the recording that they are of.
    """

    times: Times
    x: Floats
    y: Floats
    turns: Times
    known: Mask
    settled: Mask
    left_out: int
    recording: str = ""

    @property
    def memory_bytes(self) -> int:
        """About how much memory it takes."""
        return 300 + 34 * len(self.times)

    @property
    def columns(self) -> tuple[Times, Floats, Floats, Times, Mask, Mask]:
        """The arrays of its vertices."""
        return self[:6]

    def some(self, index: NDArray[np.intp]) -> PartialTrack:
        """Returns some vertices of it, in the order given."""
        columns = (column[index] for column in self.columns)
        return PartialTrack._make((*columns, self.left_out, self.recording))


def settled_tracks(parts: Sequence[PartialTrack]) -> list[PartialTrack]:
    """Returns one track for each recording that parts are of, which no other part overlaps.

    Only in the first and in the last slice of all there may be other poses.
    """
    by_recording: dict[str, list[PartialTrack]] = defaultdict(list)
    for part in parts:
        by_recording[part.recording].append(part)
    recordings = [*by_recording.values()]
    whole, numbers = joined_tracks(recordings, keeps_ends=True)
    bounds = np.searchsorted(numbers, np.arange(len(recordings) + 1)).tolist()
    return [
        whole.some(np.arange(*span))._replace(
            left_out=sum(part.left_out for part in own), recording=own[0].recording
        )
        for own, span in zip(recordings, pairwise(bounds), strict=True)
    ]


def empty_track() -> RobotTrack:
    """Returns a track without a vertex."""
    return track_by(*joined_tracks([]))


def thinned(times: Times, recordings: Times | int = 0) -> NDArray[np.intp]:
    """Returns which of some poses count: the first and last of each slot.

    Of several of one time the first. They are in order of time, or of recordings and then of time.
    """
    numbers = np.broadcast_to(recordings, times.shape)
    first = np.flatnonzero(_is_new(times, numbers))
    is_new = _is_new(times[first] // _SLOT_NS, numbers[first])
    return first[is_new | _is_last(is_new)]


def _is_new(*columns: Times) -> Mask:
    """Returns which rows differ from the row before; the first one does."""
    differ = np.ones(len(columns[0]), np.bool_)
    differ[1:] = np.logical_or.reduce([np.diff(column) != 0 for column in columns])
    return differ


def _is_last(is_first: Mask) -> Mask:
    """Returns which rows are the last of a group."""
    return np.append(is_first[1:], [True])[: len(is_first)]


def partial_track(
    times: Times, x: Floats, y: Floats, heading: Floats, left_out: int = 0
) -> PartialTrack:
    """Returns the track by poses in log-time order; those that are no place are left out."""
    fine = np.flatnonzero((np.abs(x) < _MAX_M) & (np.abs(y) < _MAX_M))  # false for NaN
    fine = fine[thinned(times[fine])]
    times, heading = times[fine], heading[fine]
    x, y = (np.rint(column[fine] * _PER_M) / _PER_M for column in (x, y))
    known = np.isfinite(heading)
    turns = np.rint(np.where(known, heading, 0.0) / math.tau * _TURN).astype(np.int64)
    slices = times // TRACK_SLICE_NS
    settled = (slices > slices[:1].sum()) & (slices < slices[-1:].sum())
    turns = _continuous(turns, np.zeros(len(times), np.bool_))
    part = PartialTrack(times, x, y, turns, known, settled, left_out)
    return part.some(_vertices(part, ~settled, np.zeros(len(times), np.int64)))


def track_of(times: Times, x: Floats, y: Floats, heading: Floats) -> RobotTrack:
    """Returns the track of poses in log-time order; those that are no place are left out."""
    return track_by(*joined_tracks([[partial_track(times, x, y, heading)]]))


def track_by(whole: PartialTrack, recordings: Times, fastest_mps: float = math.inf) -> RobotTrack:
    """Returns the track by the vertices of recordings; of two of one time the first counts.

    `recordings`: the number of the recording of each vertex.
    """
    _, order = np.unique(whole.times, return_index=True)
    whole, recordings = whole.some(order), recordings[order]
    turns = _continuous(whole.turns, ~_is_new(recordings))
    heading = np.where(whole.known, turns * (math.tau / _TURN), np.nan)
    begins = np.append([True], np.diff(whole.times) > SILENCE_NS)[: len(whole.times)]
    return RobotTrack(whole.times, whole.x, whole.y, heading, begins, fastest_mps)


def joined_tracks(
    recordings: Sequence[Sequence[PartialTrack]], *, keeps_ends: bool = False
) -> tuple[PartialTrack, Times]:
    """Returns the tracks by the poses of all tables of recordings, one track after the other.

    With the number of the recording of each vertex. All at once: a week has thousands of them. If
    it `keeps_ends`, the first and the last slice of all are not settled.
    """
    parts_in_order = [part for parts in recordings for part in parts]
    if not parts_in_order:
        times, none = np.zeros(0, np.int64), np.zeros(0)
        return partial_track(times, none, none, none), times
    sizes = [sum(len(part.times) for part in parts) for parts in recordings]
    columns = map(np.concatenate, zip(*(part.columns for part in parts_in_order), strict=True))
    whole = PartialTrack._make((*columns, 0, ""))
    numbers = np.repeat(np.arange(len(recordings)), sizes)
    order = np.lexsort((whole.times, numbers))
    order = order[thinned(whole.times[order], numbers[order])]
    whole, numbers = whole.some(order), numbers[order]
    are_known = whole.settled & ~_is_new(numbers)
    are_known[1:] &= whole.settled[:-1]
    whole = whole._replace(turns=_continuous(whole.turns, are_known))
    keeps = whole.settled
    if keeps_ends:
        slices = whole.times // TRACK_SLICE_NS
        settled = (slices > slices.min(initial=MAX_NS)) & (slices < slices.max(initial=MIN_NS))
        keeps, whole = keeps | ~settled, whole._replace(settled=settled)
    vertices = _vertices(whole, keeps, numbers)
    return whole.some(vertices), numbers[vertices]


def _continuous(turns: Times, are_known: Mask) -> Times:
    """Returns headings without jumps by whole turns; the steps that are known have none."""
    steps = np.diff(turns, prepend=turns[:1])
    short = (steps + _TURN // 2) % _TURN - _TURN // 2
    first = (turns[:1].sum() + _TURN // 2) % _TURN - _TURN // 2
    whole: Times = first + np.cumsum(np.where(are_known, steps, short))
    return whole


def _vertices(part: PartialTrack, keeps: Mask, recordings: Times) -> NDArray[np.intp]:
    """Returns which poses are vertices: those to keep, and what their slices need besides."""
    times = part.times
    is_first = _is_new(times // TRACK_SLICE_NS, recordings)
    kept = keeps | is_first | _is_last(is_first)
    turned = part.turns * (math.tau / _TURN * _WEIGHT)
    waiting = np.flatnonzero(~kept)
    while waiting.size:
        vertices = np.flatnonzero(kept)
        after = np.searchsorted(vertices, waiting)
        start, end = vertices[after - 1], vertices[after]
        share = (times[waiting] - times[start]) / np.maximum(times[end] - times[start], 1)
        off = np.zeros(waiting.size)
        for column in (part.x, part.y):
            away = column[waiting] - column[start] - (column[end] - column[start]) * share
            off += away * away
        away = turned[waiting] - turned[start] - (turned[end] - turned[start]) * share
        off = np.maximum(off, away * away)
        first = run_starts(after)
        worst = np.maximum.reduceat(off, first)
        worst_here = np.repeat(worst, np.diff(first, append=waiting.size))
        is_bent = worst_here > TOLERANCE_M * TOLERANCE_M
        splits = np.flatnonzero(is_bent & (off == worst_here))
        splits = splits[run_starts(after[splits])]
        kept[waiting[splits]] = True
        is_bent[splits] = False
        waiting = waiting[is_bent]
    return np.flatnonzero(kept)


def jumps(track: RobotTrack) -> Mask:
    """Returns after which vertices the robot jumped to the next one: nobody drives as fast."""
    lasted = np.diff(track.times)
    far = np.hypot(np.diff(track.x), np.diff(track.y)) * 1e9 > track.fastest_mps * lasted
    jumped = far & (lasted > 0) & (lasted <= _JUMP_NS) & ~track.begins[1:]
    return np.append(jumped, [False])[: len(track.times)]


def place_at(track: RobotTrack, time: Ns, silence: Ns = MAX_NS) -> tuple[float, float] | None:
    """Returns where the robot was (m); None before the track.

    Behind the end of a piece it is still there, for `silence` and until the next one begins.
    """
    after = int(np.searchsorted(track.times, time, side="right"))
    if not after:
        return None
    before = after - 1
    since = time - int(track.times[before])
    if after == len(track.times) or track.begins[after]:
        return (float(track.x[before]), float(track.y[before])) if since <= silence else None
    share = since / int(track.times[after] - track.times[before])
    x = track.x[before] + (track.x[after] - track.x[before]) * share
    y = track.y[before] + (track.y[after] - track.y[before]) * share
    return float(x), float(y)


def cut(track: RobotTrack, window: TimeWindow) -> RobotTrack:
    """Returns a track in a window: where it goes on beyond an end, with a point at that end.

    Such a first point does not begin a piece.
    """
    times = track.times
    first, last = np.searchsorted(times, (window.start, window.stop)).tolist()
    at, begins = times[first:last], track.begins[first:last]
    if 0 < first < len(times) and not track.begins[first] and window.start < times[first]:
        at, begins = np.append(window.start, at), np.append(False, begins)
    if 0 < last < len(times) and not track.begins[last] and at[-1:].tolist() != [window.stop - 1]:
        at, begins = np.append(at, window.stop - 1), np.append(begins, False)
    places = track.at(at) if at.size else (track.x[:0], track.y[:0], track.heading[:0])
    return RobotTrack(at, *places, begins, track.fastest_mps)
