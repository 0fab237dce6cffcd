"""What the robot drove while it was inside of a region: metres, speed and the drawn way.

When it was inside follows from its track in the region's frame, and how far it drove from the
digests of its poses: the length of each bag is shared out along its drawn path, whose corners have
times. So corrections of the map add no metres, and a week of visits costs no reading.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.bulk_decode import motion_decoder
from ros2_memory.analysis.motion.odometry import Motion, MotionTotals, TimedPosition
from ros2_memory.analysis.motion.polyline import DrawnPath
from ros2_memory.analysis.motion.trajectory import (
    MAX_WAYPOINTS,
    TOLERANCE_M,
    PoseCollector,
    Waypoint,
)
from ros2_memory.core.geometry import distance
from ros2_memory.core.timebase import NS_PER_S, Ns, unix_from_ns
from ros2_memory.counts.segment_fold import SegmentFold
from ros2_memory.history.coverage import note_edges, note_unread, note_unrecorded, unix_text
from ros2_memory.history.driven_path import POSES, add_poses
from ros2_memory.history.no_data import (
    no_data_between,
    resolve_pose_topic,
    undecodable,
    with_notes,
)
from ros2_memory.history.robots import require_one_robot
from ros2_memory.history.view import open_span
from ros2_memory.insights.clock_steps import elapsed_in
from ros2_memory.places.pose_frames import placed_waypoints
from ros2_memory.places.scope import times_in_region
from ros2_memory.places.where import parse_where
from ros2_memory.results import DrivenInside

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from ros2_memory.analysis.frames import Floats, Mask, Times
    from ros2_memory.analysis.motion.odometry import PoseDigest, Vertex
    from ros2_memory.core.errors import UndecodableError
    from ros2_memory.core.model import JsonValue, TimeWindow
    from ros2_memory.counts.segment_fold import Digested
    from ros2_memory.history.bag_groups import Span
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.history.view import TimeRange, View
    from ros2_memory.places.robot_tracks import Inside

_SPEED_NS: Final[Ns] = NS_PER_S
"""Over so long a speed is measured: what is shorter is noise."""
_FEWEST_WAYPOINTS: Final = 2


def driven_inside(
    memory: Memory,
    call: Call,
    span: TimeRange,
    *,
    where: JsonValue,
    topic: str | None = None,
    frame_id: str | None = None,
    max_waypoints: int = MAX_WAYPOINTS,
) -> DrivenInside:
    """Returns what was driven inside of a region in a window, by one pose topic.

    Its waypoints are in the poses' own frame or in `frame_id`; 0 asks for none, 1 for the last.

    Raises:
        InvalidArgumentsError: the topic carries no position, or `where` is no region of a frame
            that its poses can be placed in.
        NoDataError: there are no poses in the window.
        QueryTimeoutError: the call's time runs out before any result.
    """
    region = parse_where(memory.limits, where)
    view, window = open_span(memory, call, span)
    name = resolve_pose_topic(view, topic)
    way = driven_way(view, name, window)
    if way is None:
        raise no_data_between(view, (name,), window)
    note_unrecorded(view, window)
    inside = times_in_region(view, region, window)
    totals, waypoints = way.totals(inside), way.waypoints(inside, max_waypoints)
    elapsed = elapsed_in(view, window)
    duration = sum(elapsed.between(each.start, each.stop) for each in inside)
    average = totals.distance_m / unix_from_ns(duration) if duration else 0.0
    if frame_id is not None:
        waypoints = placed_waypoints(view, name, waypoints, way.frames[0], frame_id)
    require_one_robot(view, name, window)
    note_unread(view, window)
    note_edges(view, window)
    return DrivenInside(
        name,
        frame_id or way.frames[0],
        region.shown,
        len(inside),
        duration,
        inside[0].start if inside else None,
        inside[-1].stop if inside else None,
        totals.distance_m,
        # Measured over a second, it is below the mean of a visit that hardly lasts as long.
        max(totals.max_speed, average),
        waypoints,
        notes=view.notes.sentences(),
    )


class InsideTotals(NamedTuple):
    """What was driven inside: metres, and the highest speed (m/s) over a second."""

    distance_m: float
    max_speed: float


@dataclass(frozen=True, slots=True)
class DrivenWay:
    """The drawn path of a window, with the metres driven up to each of its vertices.

    Attributes:
        times: log times, ascending.
        metres: since the first vertex; without gaps, jumps and what noise adds.
        places: x, y and z (m) as columns, in the frame of the poses.
        heading: about z (rad); NaN where it is not known.
        parts: whether the robot jumped to the vertex.
        frames: of the poses, in order of appearance.
    """

    times: Times
    metres: Floats
    places: Floats
    heading: Floats
    parts: Mask
    frames: tuple[str, ...]

    def totals(self, spans: Sequence[Inside]) -> InsideTotals:
        """Returns what was driven in some times."""
        metres = fastest = 0.0
        for span in spans:
            start, stop = self._metres_at([span.start, span.stop])
            driven = max(float(stop - start), 0.0)
            metres += driven
            fastest = max(fastest, self._fastest(span, driven))
        return InsideTotals(metres, fastest)

    def _fastest(self, span: Inside, driven_m: float) -> float:
        lasted = span.stop - span.start
        if lasted <= _SPEED_NS:
            return driven_m / unix_from_ns(lasted) if 2 * lasted >= _SPEED_NS else 0.0
        end = span.stop - _SPEED_NS
        inner = self.times[np.searchsorted(self.times, span.start) :]
        inner = inner[: np.searchsorted(inner, end)]
        # The speed over a second changes its slope only where it begins or ends at a vertex.
        ends = self.times[np.searchsorted(self.times, span.start + _SPEED_NS) :]
        ends = ends[: np.searchsorted(ends, span.stop)] - _SPEED_NS
        begin = np.concatenate(([span.start, end], inner, ends))
        driven = self._metres_at(begin + _SPEED_NS) - self._metres_at(begin)
        # Metres are without jumps, but noise may shift some of them along the way.
        moved = self._places_at(begin + _SPEED_NS) - self._places_at(begin)
        return float(np.minimum(driven, np.sqrt((moved * moved).sum(axis=1))).max())

    def waypoints(self, spans: Sequence[Inside], at_most: int) -> tuple[Waypoint, ...]:
        """Returns the drawn way in some times; `jump` marks where another time begins.

        `at_most` 0 asks for none, 1 for the last.
        """
        path = DrawnPath(TOLERANCE_M)
        for span in spans:
            path.part()
            path.extend(self._vertices(span), 0.0)
        drawn = path.drawn(max(at_most, _FEWEST_WAYPOINTS))
        found = tuple(
            Waypoint(time, position, turn if isinstance(turn, float) else None, jump=not place)
            for piece in drawn.pieces
            for place, (time, position, turn) in enumerate(piece)
        )
        return found if at_most >= _FEWEST_WAYPOINTS else found[len(found) - at_most :]

    def _vertices(self, span: Inside) -> Iterator[Vertex]:
        inner = np.flatnonzero((self.times > span.start) & (self.times < span.stop))
        yield self._vertex_at(span.start)
        for index in inner.tolist():
            yield self._vertex(int(self.times[index]), self.places[index], self.heading[index])
        if span.stop > span.start:
            yield self._vertex_at(span.stop)

    def _vertex_at(self, time: Ns) -> Vertex:
        """Returns where the robot was between two vertices; at the nearer one across a jump."""
        last = len(self.times) - 1
        after = min(int(np.searchsorted(self.times, time, side="right")), last)
        before = max(after - 1, 0)
        lasted = int(self.times[after] - self.times[before])
        share = (time - int(self.times[before])) / lasted if lasted else 0.0
        share = min(max(share, 0.0), 1.0)
        if self.parts[after]:
            share = float(round(share))
        turn = math.remainder(self.heading[after] - self.heading[before], math.tau)
        place = self.places[before] + (self.places[after] - self.places[before]) * share
        return self._vertex(time, place, self.heading[before] + turn * share)

    def _vertex(self, time: Ns, place: Floats, heading: float) -> Vertex:
        x, y, z = place.tolist()
        return time, (x, y, z), None if math.isnan(heading) else float(heading)

    def _places_at(self, times: Times) -> Floats:
        since = int(self.times[0])
        columns = [
            np.interp(times - since, self.times - since, self.places[:, axis]) for axis in range(3)
        ]
        return np.stack(columns, axis=1)

    def _metres_at(self, times: Sequence[Ns] | Times) -> Floats:
        since = int(self.times[0])
        found: Floats = np.interp(
            np.asarray(times, np.int64) - since, self.times - since, self.metres
        )
        return found


@dataclass(frozen=True, slots=True)
class _Part:
    """The path of some bags, and what joins it with those before and after."""

    way: DrivenWay
    totals: MotionTotals


def driven_way(view: View, topic: str, window: TimeWindow) -> DrivenWay | None:
    """Returns the path by the poses of a topic in a window; None if there is no valid pose.

    A note says how far back it is known where the time was over before all was read.

    Raises:
        InvalidArgumentsError: a message of the topic carries no position.
        NoDataError: no message can be decoded.
        QueryTimeoutError: the call's time runs out before any result.
    """
    fastest = view.memory.limits.max_plausible_speed_mps
    failures: list[UndecodableError] = []
    decoder = motion_decoder(view.memory.reader, view.memory.extractor)

    def collect(messages: Iterable[StoredMessage]) -> tuple[PoseDigest, Span | None]:
        collector = PoseCollector(fastest)
        found = add_poses(view, collector.add, decoder, messages, failures)
        return collector.digest(), found

    fold = SegmentFold(
        POSES, collect, lambda found: _part(found, fastest), name="way", failures=failures
    )
    folded = fold.over(view, topic, window)
    if failures:
        if not folded.parts:
            raise with_notes(view, window, undecodable(failures[0]))
        view.notes.complete = False
        view.notes.add(
            f"poses left out, since they cannot be decoded: {len(failures)} ({failures[0].reason})"
        )
    if folded.since is not None:
        view.notes.complete = False
        view.notes.add(
            f"the path is known back to {unix_text(folded.since)}: out of time before older "
            "bags without a digest were read"
        )
    parts = [each for each in folded.parts if len(each.way.times)]
    return _joined(parts, fastest) if parts else None


def _part(found: Sequence[Digested[PoseDigest]], fastest_mps: float) -> _Part:
    """Joins the digests of poses, and shares out along each what it adds to the length."""
    motion = Motion(fastest_mps)
    frames: dict[str, None] = {}
    vertices: list[Vertex] = []
    metres: list[float] = []
    parts: list[bool] = []
    before = 0.0
    for digest, _, _ in found:
        frames.update(dict.fromkeys(digest.frames))
        if not digest.vertices:
            continue
        own, jumps = _without_parts(digest.vertices)
        if digest.totals.head is not None:
            jumps[0] |= motion.join(digest.totals)
        else:  # these few are all its poses, and nothing has parted them yet
            poses = [TimedPosition(time, position) for time, position, _ in digest.vertices]
            for nth in motion.add(poses):
                jumps[nth] = True
        after = motion.totals.distance_m
        steps = [
            0.0 if jump else distance(here[1], there[1])
            for (here, there), jump in zip(pairwise(own), jumps[1:], strict=True)
        ]
        along = np.concatenate(([0.0], np.cumsum(steps)))
        whole = float(along[-1])
        shares = along / whole if whole > 0 else np.ones(len(along))
        metres += (before + (after - before) * shares).tolist()
        vertices += own
        parts += jumps
        before = after
    way = DrivenWay(
        np.array([time for time, _, _ in vertices], np.int64),
        np.array(metres, np.float64),
        np.array([position for _, position, _ in vertices], np.float64).reshape(-1, 3),
        np.array([math.nan if turn is None else turn for *_, turn in vertices], np.float64),
        np.array(parts, np.bool_),
        tuple(frames),
    )
    return _Part(way, motion.totals)


def _without_parts(row: Sequence[Vertex]) -> tuple[list[Vertex], list[bool]]:
    """Returns the vertices of a row, and whether the robot jumped to each."""
    vertices: list[Vertex] = []
    jumps: list[bool] = []
    jumped = False
    for vertex in row:
        if math.isnan(vertex[1][0]):
            jumped = True
            continue
        vertices.append(vertex)
        jumps.append(jumped)
        jumped = False
    return vertices, jumps


def _joined(parts: Sequence[_Part], fastest_mps: float) -> DrivenWay:
    """Returns the paths of parts in order as one."""
    motion = Motion(fastest_mps)
    metres: list[Floats] = []
    frames: dict[str, None] = {}
    for part in parts:
        motion.join(part.totals)
        # What joining adds to a part's own length is driven up to its first vertex.
        metres.append(part.way.metres + (motion.totals.distance_m - part.totals.distance_m))
        frames.update(dict.fromkeys(part.way.frames))
    return DrivenWay(
        np.concatenate([each.way.times for each in parts]),
        np.concatenate(metres),
        np.concatenate([each.way.places for each in parts]),
        np.concatenate([each.way.heading for each in parts]),
        np.concatenate([each.way.parts for each in parts]),
        tuple(frames),
    )
