"""The path of the robot in one frame with few vertices, each with its time.

Vertices are poses. Between two vertices the robot is taken to move evenly. Every pose is within
`TOLERANCE_M` of where the track has the robot *at its time*, and within `TOLERANCE_OF_HEIGHT_M` of
its height: more tells storeys apart, and fewer vertices do. So a track says where the robot was,
and when it entered a region, which a path that is drawn in space alone does not.

In each *slice* of the clock the first and the last pose are vertices, and so is the pose farthest
from the line between two vertices, until none is too far. Slices do not depend on how a history
is cut. Other tables may share the first and the last slice of a table, so all its poses stay there
until the tables are joined.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.core.arrays import Flags, Ints, range_numbers, run_starts
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S, Ns

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from ros2_memory.analysis.frames import Floats
    from ros2_memory.core.model import TimeWindow, Vector3

TOLERANCE_M: Final = 0.05
TOLERANCE_OF_HEIGHT_M: Final = 0.2
TOLERANCE_RAD: Final = 0.15
TRACK_SLICE_NS: Final = 10 * NS_PER_S
_SLOT_NS: Final = NS_PER_S // 5
"""In each slot of the clock only the first and the last pose count: a robot hardly bends between.
"""

_JUMP_NS: Final = 2 * NS_PER_S
"""A step that is faster than plausible, and takes at most this time, is a jump."""
_MAX_M: Final = 1e8
"""A coordinate beyond this is no place; northings of UTM are up to 1e7."""
_PER_M: Final = 10_000
"""Vertices are rounded to 0.1 mm, as the store has poses."""
_WEIGHT: Final = TOLERANCE_M / TOLERANCE_RAD
"""How many metres count as much as a radian."""
_WEIGHT_OF_HEIGHT: Final = TOLERANCE_M / TOLERANCE_OF_HEIGHT_M
_TURN: Final = 1 << 22
"""Headings are whole numbers of such parts of a turn, so that many turns add up exactly."""


@dataclass(frozen=True, slots=True)
class RobotTrack:
    """The path of the robot, by vertices that ascend in time.

    Attributes:
        times: log times (ns).
        x: metres.
        y: metres.
        z: metres; NaN if it is not known.
        heading: yaw (rad), continuous from vertex to vertex; NaN if it is not known.
        begins: whether a piece begins at the vertex. Between pieces there is no pose for more than
            `SILENCE_NS`.
        fastest_mps: the highest plausible speed; a faster step is a jump.
    """

    times: Ints
    x: Floats
    y: Floats
    z: Floats
    heading: Floats
    begins: Flags
    fastest_mps: float = math.inf

    @property
    def ends(self) -> Flags:
        """Whether a piece ends at the vertex."""
        return _is_last(self.begins)

    @property
    def pieces(self) -> tuple[Ints, Ints]:
        """The first and the last time of each piece (ns, inclusive)."""
        return self.times[self.begins], self.times[self.ends]

    def at(self, times: Ints) -> tuple[Floats, Floats, Floats, Floats]:
        """Returns x, y, z (m) and heading (rad) at log times; the track has a vertex or more."""
        # Relative to the first vertex, a time is small enough to be exact as a float.
        since = self.times[0]
        columns = (self.x, self.y, self.z, self.heading)
        x, y, z, heading = (np.interp(times - since, self.times - since, axis) for axis in columns)
        return x, y, z, heading


class PartialTrack(NamedTuple):
    """The track of one table of poses, to be joined with those of other tables.

    Attributes:
        times: log times (ns), ascending.
        x: metres.
        y: metres.
        z: metres; NaN if it is not known.
        turns: headings in parts of a turn (`_TURN`), continuous from vertex to vertex.
        known: whether the heading is known.
        settled: whether no other table can have a pose in the slice of the vertex.
        left_out: how many poses could not be placed.
        recording: the folder of the recording.
    """

    times: Ints
    x: Floats
    y: Floats
    z: Floats
    turns: Ints
    known: Flags
    settled: Flags
    left_out: int
    recording: str = ""

    @property
    def memory_bytes(self) -> int:
        """About how much memory it takes."""
        return 300 + 42 * len(self.times)

    @property
    def columns(self) -> tuple[Ints, Floats, Floats, Floats, Ints, Flags, Flags]:
        """The arrays of its vertices."""
        return self[:7]

    def vertices(self, index: NDArray[np.intp]) -> PartialTrack:
        """Returns the vertices at an index array, in the order given."""
        columns = (column[index] for column in self.columns)
        return PartialTrack._make((*columns, self.left_out, self.recording))


def settled_tracks(parts: Sequence[PartialTrack]) -> list[PartialTrack]:
    """Returns one track for each recording of some parts, if these are all of a stretch of time.

    Only the first and the last slice of the stretch stay unsettled.
    """
    by_recording: dict[str, list[PartialTrack]] = defaultdict(list)
    for part in parts:
        by_recording[part.recording].append(part)
    recordings = [*by_recording.values()]
    whole, numbers = joined_tracks(recordings, keeps_ends=True)
    bounds = np.searchsorted(numbers, np.arange(len(recordings) + 1)).tolist()
    tracks = []
    for own_parts, (begin, end) in zip(recordings, pairwise(bounds), strict=True):
        left_out = sum(part.left_out for part in own_parts)
        track = whole.vertices(np.arange(begin, end))
        tracks.append(track._replace(left_out=left_out, recording=own_parts[0].recording))
    return tracks


def empty_track() -> RobotTrack:
    """Returns a track without a vertex."""
    return track_by(*joined_tracks([]))


def slot_ends(times: Ints, recordings: Ints | int = 0) -> NDArray[np.intp]:
    """Returns the indices of the first and the last pose in each slot; of equal times the first.

    Poses are in order of time or, with the numbers of their recordings, of recordings and then of
    time.
    """
    numbers = np.broadcast_to(recordings, times.shape)
    first = run_starts(times, numbers)
    is_new = _is_new(times[first] // _SLOT_NS, numbers[first])
    return first[is_new | _is_last(is_new)]


def _is_new(*columns: Ints) -> Flags:
    """Returns which rows differ from the row before; the first row does."""
    differ = np.ones(len(columns[0]), np.bool_)
    differ[1:] = np.logical_or.reduce([np.diff(column) != 0 for column in columns])
    return differ


def _is_last(is_first: Flags) -> Flags:
    """Returns which rows are the last of a group, by which are the first."""
    return np.append(is_first[1:], [True])[: len(is_first)]


def partial_track(times: Ints, x: Floats, y: Floats, z: Floats, heading: Floats) -> PartialTrack:
    """Returns the track of a table of poses in log-time order.

    Poses with x or y NaN or beyond `_MAX_M` are no place, and dropped; such a z is not known.
    """
    rows = np.flatnonzero((np.abs(x) < _MAX_M) & (np.abs(y) < _MAX_M))
    rows = rows[slot_ends(times[rows])]
    times, heading = times[rows], heading[rows]
    x, y, z = (np.rint(column[rows] * _PER_M) / _PER_M for column in (x, y, z))
    z = np.where(np.abs(z) < _MAX_M, z, np.nan)
    known = np.isfinite(heading)
    turns = np.rint(np.where(known, heading, 0.0) / math.tau * _TURN).astype(np.int64)
    settled = _in_inner_slice(times)
    turns = _continuous(turns, np.zeros(len(times), np.bool_))
    part = PartialTrack(times, x, y, z, turns, known, settled, 0)
    return part.vertices(_vertices(part, ~settled, np.zeros(len(times), np.int64)))


def _in_inner_slice(times: Ints) -> Flags:
    """Returns which times are neither in the first nor in the last slice of all."""
    slices = times // TRACK_SLICE_NS
    first, last = slices.min(initial=MAX_NS), slices.max(initial=MIN_NS)
    is_inner: Flags = (slices > first) & (slices < last)
    return is_inner


def track_of(times: Ints, x: Floats, y: Floats, z: Floats, heading: Floats) -> RobotTrack:
    """Returns the track of all poses (m, rad), which are in log-time order."""
    return track_by(*joined_tracks([[partial_track(times, x, y, z, heading)]]))


def track_by(whole: PartialTrack, recordings: Ints, fastest_mps: float = math.inf) -> RobotTrack:
    """Returns the track of all vertices in order of time; of equal times the first one counts.

    `recordings` has the number of the recording of each vertex.
    """
    _, order = np.unique(whole.times, return_index=True)
    whole, recordings = whole.vertices(order), recordings[order]
    turns = _continuous(whole.turns, ~_is_new(recordings))
    heading = np.where(whole.known, turns * (math.tau / _TURN), np.nan)
    begins = np.append([True], np.diff(whole.times) > SILENCE_NS)[: len(whole.times)]
    return RobotTrack(whole.times, whole.x, whole.y, whole.z, heading, begins, fastest_mps)


def joined_tracks(
    recordings: Sequence[Sequence[PartialTrack]], *, keeps_ends: bool = False
) -> tuple[PartialTrack, Ints]:
    """Joins the tables of each recording, and returns all vertices, recording by recording.

    Returns also the number of the recording of each vertex. Recordings are joined at once, since a
    week may have thousands. With `keeps_ends` the first and the last slice of all stay unsettled.
    """
    parts_in_order = [part for parts in recordings for part in parts]
    if not parts_in_order:
        times, empty = np.zeros(0, np.int64), np.zeros(0)
        return partial_track(times, empty, empty, empty, empty), times
    sizes = [sum(len(part.times) for part in parts) for parts in recordings]
    columns = map(np.concatenate, zip(*(part.columns for part in parts_in_order), strict=True))
    whole = PartialTrack._make((*columns, 0, ""))
    numbers = range_numbers(sizes)
    order = np.lexsort((whole.times, numbers))
    order = order[slot_ends(whole.times[order], numbers[order])]
    whole, numbers = whole.vertices(order), numbers[order]
    # In the middle of a table, headings are continuous already.
    is_continuous = whole.settled & ~_is_new(numbers)
    is_continuous[1:] &= whole.settled[:-1]
    whole = whole._replace(turns=_continuous(whole.turns, is_continuous))
    keeps = whole.settled
    if keeps_ends:
        settled = _in_inner_slice(whole.times)
        keeps, whole = keeps | ~settled, whole._replace(settled=settled)
    vertices = _vertices(whole, keeps, numbers)
    return whole.vertices(vertices), numbers[vertices]


def _continuous(turns: Ints, is_continuous: Flags) -> Ints:
    """Returns headings that change by less than half a turn from each to the next.

    Steps that are continuous already stay as they are.
    """
    steps = np.diff(turns, prepend=0)
    short = (steps + _TURN // 2) % _TURN - _TURN // 2
    is_step_kept = is_continuous & (np.arange(len(turns)) > 0)
    whole: Ints = np.cumsum(np.where(is_step_kept, steps, short))
    return whole


def _vertices(part: PartialTrack, keeps: Flags, recordings: Ints) -> NDArray[np.intp]:
    """Returns the indices of poses that are vertices.

    They are the poses to keep, the first and the last of each slice and, again and again, the pose
    farthest from the line between two vertices, if it is beyond the tolerance.
    """
    times = part.times
    is_first = _is_new(times // TRACK_SLICE_NS, recordings)
    is_vertex = keeps | is_first | _is_last(is_first)
    turned = part.turns * (math.tau / _TURN * _WEIGHT)
    raised = part.z * _WEIGHT_OF_HEIGHT
    waiting = np.flatnonzero(~is_vertex)
    while waiting.size:
        vertices = np.flatnonzero(is_vertex)
        after = np.searchsorted(vertices, waiting)
        start, end = vertices[after - 1], vertices[after]
        share = (times[waiting] - times[start]) / np.maximum(times[end] - times[start], 1)
        x, y, turn, rise = (
            (column[waiting] - column[start] - (column[end] - column[start]) * share) ** 2
            for column in (part.x, part.y, turned, raised)
        )
        # A height that is not known is near any other.
        squared = np.fmax(np.maximum(x + y, turn), rise)
        first = run_starts(after)
        worst = np.maximum.reduceat(squared, first)
        worst_here = np.repeat(worst, np.diff(first, append=waiting.size))
        is_bent = worst_here > TOLERANCE_M * TOLERANCE_M
        splits = np.flatnonzero(is_bent & (squared == worst_here))
        splits = splits[run_starts(after[splits])]
        is_vertex[waiting[splits]] = True
        is_bent[splits] = False
        waiting = waiting[is_bent]
    return np.flatnonzero(is_vertex)


def jumps(track: RobotTrack) -> Flags:
    """Returns after which vertices the robot jumped to the next one, faster than plausible."""
    lasted, x, y, z = map(np.diff, (track.times, track.x, track.y, track.z))
    far = np.fmax(np.hypot(x, y), np.abs(z)) * 1e9 > track.fastest_mps * lasted
    jumped = far & (lasted > 0) & (lasted <= _JUMP_NS) & ~track.begins[1:]
    return np.append(jumped, [False])[: len(track.times)]


def place_at(track: RobotTrack, time: Ns, silence: Ns = MAX_NS) -> Vector3 | None:
    """Returns where the robot was (m) at a log time; None before the track.

    After the end of a piece it stays there for `silence` (ns), or until the next one begins; None
    after that.
    """
    after = int(np.searchsorted(track.times, time, side="right"))
    if not after:
        return None
    before = after - 1
    since = time - int(track.times[before])
    share = 0.0
    if after == len(track.times) or track.begins[after]:
        if since > silence:
            return None
        after = before
    else:
        share = since / int(track.times[after] - track.times[before])
    x, y, z = (
        float(axis[before] + (axis[after] - axis[before]) * share)
        for axis in (track.x, track.y, track.z)
    )
    return x, y, z


def cut_track(track: RobotTrack, window: TimeWindow) -> RobotTrack:
    """Returns a whole track in a window, with a vertex at each end of the window that it crosses.

    A vertex that is added at the start of the window does not begin a piece.
    """
    times = track.times
    first, last = np.searchsorted(times, (window.start, window.stop)).tolist()
    at, begins = times[first:last], track.begins[first:last]
    if first < len(times) and not track.begins[first] and window.start < times[first]:
        at, begins = np.append(window.start, at), np.append(False, begins)
    if last < len(times) and not track.begins[last] and at[-1:].tolist() != [window.stop - 1]:
        at, begins = np.append(at, window.stop - 1), np.append(begins, False)
    places = track.at(at) if at.size else (track.x[:0],) * 4
    return RobotTrack(at, *places, begins, track.fastest_mps)
