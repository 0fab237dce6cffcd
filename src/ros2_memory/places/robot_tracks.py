"""Where the robot was in one frame over many bags, and when it was inside of a region.

Joined from the map digests of bags, which have it in the map and in the poses' own frame, so that
a week costs milliseconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ros2_memory.analysis.intervals import FLICKER_NS, SILENCE_NS
from ros2_memory.analysis.motion.robot_track import RobotTrack, empty_track, track_of
from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.core.geometry import yaw
from ros2_memory.core.regions import Steps, parts_inside
from ros2_memory.history.context import READING_S
from ros2_memory.history.driven_path import body_by_transforms, poses_of_body
from ros2_memory.places.map_digests import MapDigests

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from ros2_memory.catalogue.lookup import SegmentDigests
    from ros2_memory.catalogue.map_digest import MapDigest
    from ros2_memory.core.model import BagFile, TimeWindow
    from ros2_memory.core.regions import Region
    from ros2_memory.core.timebase import Deadline, Ns
    from ros2_memory.history.view import View
    from ros2_memory.index.segment import Segment


class Inside(NamedTuple):
    """A time in which the robot was inside of a region; both ends are inclusive.

    `entered` and `left`: whether it was seen outside just before, and just after.
    """

    start: Ns
    stop: Ns
    entered: bool
    left: bool


@dataclass(frozen=True, slots=True)
class JoinedTrack:
    """The track of the robot in a window.

    Attributes:
        track: of all bags; `error_m` is the largest of them.
        since: how far back it reaches, where not all bags could be read in time; else None.
        left_out: how many poses could not be placed.
    """

    track: RobotTrack
    since: Ns | None = None
    left_out: int = 0


class RobotTracks:
    """Joins the map digests of a view in one frame."""

    def __init__(self, view: View, frame_id: str) -> None:
        self._view = view
        self._frame_id = frame_id
        self._maps = MapDigests(view)
        self._topic = view.pose_topic
        self._reading: Deadline | None = None
        self._is_map = frame_id == view.memory.limits.map_frame

    def over(self, window: TimeWindow) -> JoinedTrack:
        """Returns the track in a window, and a little beyond.

        Raises:
            QueryTimeoutError: the call's time runs out before any result.
        """
        if body_by_transforms(self._view) is not None:
            return JoinedTrack(_track_of_body(self._view, self._frame_id, window))
        parts: list[RobotTrack] = []
        since: Ns | None = None
        left_out = 0
        try:
            for segment in self._segments(window):
                track, missed = self._of_segment(segment, window)
                parts.append(track)
                left_out += missed
        except _PartlyReadError as error:
            parts.append(error.track)
            since = error.since
            if not any(len(each.times) for each in parts):
                raise QueryTimeoutError(
                    f"the question needs more time; {self._view.bags.backfill_progress()}"
                    "ask about a shorter window"
                ) from error
        return JoinedTrack(_joined(parts[::-1]), since, left_out)

    def _segments(self, window: TimeWindow) -> Iterator[Segment]:
        """Yields the segments with poses in a window, newest first."""
        for segment in reversed(self._view.snapshot.timeline.segments):
            span = segment.spans.get(self._topic)
            if span is not None and window.overlaps(*span):
                self._view.bags.check_deadline()
                yield segment

    def _of_segment(self, segment: Segment, window: TimeWindow) -> tuple[RobotTrack, int]:
        """Returns the track of the bags of a segment that reach into a window."""
        digests = self._view.bags.digests_of(segment)
        valid = {} if digests is None else self._maps.valid_in(digests, segment)
        if digests is not None and len(valid) == len(segment.bags):
            return self._stored(digests, segment, valid)
        bags = [each.bag for each in segment.extents(self._topic, window)]
        known = {} if digests is None else self._known(digests, valid)
        found: list[MapDigest] = []
        for bag in reversed([*dict.fromkeys(bags)]):
            stored = known.get(valid.get(bag.file, -1))
            try:
                found.append(self._made(bag) if stored is None else stored)
            except QueryTimeoutError as error:
                raise _PartlyReadError(self._columns(found[::-1])[0], bag.end) from error
        return self._columns(found[::-1])

    def _stored(
        self, digests: SegmentDigests, segment: Segment, valid: Mapping[str, int]
    ) -> tuple[RobotTrack, int]:
        """Returns the track of a whole segment, joined once for as long as it is in use."""

        def joined() -> tuple[RobotTrack, int]:
            stored = self._known(digests, valid)
            bags = segment.bags_with(self._topic)
            # An entry that was deleted meanwhile is of a bag that is gone.
            known = [stored.get(valid[bag.file]) for bag in bags]
            return self._columns([each for each in known if each is not None])

        # The numbers of entries do not change in a whole segment, the frame may be another.
        return digests.derived(f"track in {self._frame_id}", joined)

    def _known(self, digests: SegmentDigests, valid: Mapping[str, int]) -> Mapping[int, MapDigest]:
        """Returns what is stored of bags, in the poses' own frame unless the map is asked for."""
        return digests.catalogue.maps([*valid.values()], own=not self._is_map)

    def _made(self, bag: BagFile) -> MapDigest:
        """Returns the digest of a bag that has none, unless reading has taken too long."""
        if self._reading is None:
            self._reading = self._view.call.partial_after(READING_S)
        if self._reading.expired():
            raise QueryTimeoutError("reading bags without a digest takes too long")
        made = self._maps.made(bag)
        return made if self._is_map or made.own is None else made.own

    def _columns(self, found: Sequence[MapDigest]) -> tuple[RobotTrack, int]:
        """Returns the joined track of digests in order of time, and how many poses it lacks."""
        here = [each for each in found if each.frame_id == self._frame_id]
        elsewhere = sum(len(each.track.times) for each in found if each.frame_id != self._frame_id)
        track = _joined([each.track for each in here])
        return track, sum(each.left_out for each in here) + elsewhere


def _track_of_body(view: View, frame_id: str, window: TimeWindow) -> RobotTrack:
    """Returns the track by transforms, where no topic has the robot's poses."""
    poses = poses_of_body(view, window.widened(SILENCE_NS), frame_id)
    turns = [None if each.orientation is None else yaw(each.orientation) for _, each in poses]
    return track_of(
        np.array([time for time, _ in poses], np.int64),
        np.array([each.position[0] for _, each in poses], np.float64),
        np.array([each.position[1] for _, each in poses], np.float64),
        np.array([math.nan if each is None else each for each in turns], np.float64),
    )


class _PartlyReadError(Exception):
    """The time was over before all bags of a segment were read; `since` is as far as it got."""

    def __init__(self, track: RobotTrack, since: Ns) -> None:
        super().__init__()
        self.track, self.since = track, since


def _joined(tracks: Sequence[RobotTrack]) -> RobotTrack:
    """Returns tracks in order of time as one; of two of one time the earlier one counts."""
    some = [each for each in tracks if len(each.times)]
    if len(some) < 2:
        return some[0] if some else empty_track()
    times = np.concatenate([each.times for each in some])
    reach = np.maximum.accumulate(np.concatenate((times[:1] - 1, times[:-1])))
    fresh = times > reach
    number = np.repeat(np.arange(len(some)), [len(each.times) for each in some])[fresh]
    times = times[fresh]
    begins = np.concatenate([each.begins for each in some])[fresh]
    # Where a track ends and the next one begins, the time between the two decides.
    seams = np.append([True], number[1:] != number[:-1])
    silent = np.append([True], np.diff(times) > SILENCE_NS)
    return RobotTrack(
        times,
        np.concatenate([each.x for each in some])[fresh],
        np.concatenate([each.y for each in some])[fresh],
        np.concatenate([each.heading for each in some])[fresh],
        np.where(seams, silent, begins),
        max(each.error_m for each in some),
    )


def robot_inside(track: RobotTrack, region: Region, window: TimeWindow) -> list[Inside]:
    """Returns when the robot was inside of a region, in order, by its track.

    A robot that was outside for less than `FLICKER_NS` did not leave. What it did in a silence
    longer than `SILENCE_NS` is not known: it ends the time, and begins another.
    """
    count = len(track.times)
    if not count:
        return []
    # A piece of a single vertex is a step of no length.
    ends = np.append(track.begins[1:], [True])
    after = np.where(ends, np.arange(count), np.arange(count) + 1)
    steps = Steps(track.x, track.y, track.x[after], track.y[after])
    parts = parts_inside(region, steps)
    if not len(parts.step):
        return []
    lasted = (track.times[after] - track.times)[parts.step]
    begin = track.times[parts.step]
    starts = begin + np.rint(lasted * parts.start).astype(np.int64)
    stops = begin + np.rint(lasted * parts.stop).astype(np.int64)
    piece = np.cumsum(track.begins)[parts.step]
    apart = (starts[1:] - stops[:-1] >= FLICKER_NS) | (piece[1:] != piece[:-1])
    first = np.append([True], apart)
    last = np.append(apart, [True])
    # Whether the piece began, or ended, inside.
    opens = np.flatnonzero(track.begins)
    closes = np.append(opens[1:], [count]) - 1
    piece_starts, piece_stops = track.times[opens], track.times[closes]
    rows = zip(
        starts[first].tolist(),
        stops[last].tolist(),
        piece_starts[piece[first] - 1].tolist(),
        piece_stops[piece[last] - 1].tolist(),
        strict=True,
    )
    inside = [
        Inside(start, stop, entered=start > opened, left=stop < closed)
        for start, stop, opened, closed in rows
    ]
    return [
        each._replace(
            start=max(each.start, window.start),
            stop=min(each.stop, window.stop - 1),
            entered=each.entered and each.start >= window.start,
            left=each.left and each.stop < window.stop,
        )
        for each in inside
        if each.start < window.stop and each.stop >= window.start
    ]
