"""Visits to a place: arrival, departure and closest approach, newest first.

A visit is pose after pose within the radius. It is over when the robot is farther away for some
seconds, and where for longer there is no pose to know it by. When odometry is reset, the same
coordinates are another place: visits from before that are marked.
"""

from __future__ import annotations

import math
from itertools import chain, islice, pairwise
from operator import attrgetter
from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.bulk_decode import motion_decoder
from ros2_memory.analysis.conditions import Condition, NearPosition
from ros2_memory.analysis.dwell import Approach, DwellBuilder, Unread
from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.analysis.odometry import is_place
from ros2_memory.core.errors import (
    InvalidArgumentsError,
    NoDataError,
    QueryTimeoutError,
    UndecodableError,
)
from ros2_memory.core.geometry import off_segment
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Deadline, Ns, ns_from_unix
from ros2_memory.history.bag_groups import StoredDigests, groups_of
from ros2_memory.history.coverage import note_unread, unix_text
from ros2_memory.history.driven_path import (
    POSES,
    add_poses,
    driven_path,
    note_left_out,
    positions_of,
)
from ros2_memory.history.duplicates import COPY_HORIZON_NS
from ros2_memory.history.no_data import describe_lack, resolve_pose_topic
from ros2_memory.history.reverse_search import CandidateBags
from ros2_memory.history.view import open_view
from ros2_memory.insights.map_placement import map_placement
from ros2_memory.results import Visit, Visits

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.analysis.dwell import Dwell
    from ros2_memory.analysis.odometry import PoseDigest
    from ros2_memory.core.model import Pose, Vector3
    from ros2_memory.history.bag_groups import Group
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.history.duplicates import BagSpan, StoredMessage
    from ros2_memory.history.view import View
    from ros2_memory.insights.map_placement import MapPlacement

_COUNTING_S: Final = 5.0
"""How long visits are counted that are not shown."""
_ROUNDING_M: Final = 1e-6
"""What rounding of doubles may take off a distance."""
_SPLITS: Final = 3
"""A pose no older than so many splits is current: a split answers only when it is closed."""
_MOST_TRIED: Final = 1000
"""How many of the newest poses are tried until one can be decoded."""


def visits(
    memory: Memory,
    call: Call,
    x: float,
    y: float,
    *,
    frame_id: str | None = None,
    radius_m: float | None = None,
    limit: int = 10,
) -> Visits:
    """Returns when the robot was within a radius (m) of a place in the plane, newest visits first.

    `x` and `y` (m) are in `frame_id`: the map, which is the default, or the frame of the poses.

    Raises:
        InvalidArgumentsError: the pose topic carries no position, the radius is not positive, or
            the frame is another one.
        NoDataError: the memory holds nothing, or no poses.
        QueryTimeoutError: the call's time is over before anything is known.
    """
    radius = memory.limits.position_tolerance_m if radius_m is None else radius_m
    if not (radius > 0 and math.isfinite(radius)):
        raise InvalidArgumentsError(f"radius_m must be more than 0, and was {radius_m}")
    wall = memory.clock.now()
    view = open_view(memory, call, wall)
    topic = resolve_pose_topic(view)
    placement = map_placement(view, _pose_frame(view, topic), topic, frame_id)
    search = _VisitSearch(view, topic, placement, (x, y, radius))
    latest, newest = view.snapshot.latest, search.newest_time
    now = memory.now(wall, latest)
    stale = _SPLITS * ns_from_unix(memory.limits.split_duration_s)
    known = newest is not None and newest >= now - stale
    found, total = search.newest(limit)
    resets = () if placement.is_map or not found else _resets(view, topic, found[-1][0].arrived)
    note_unread(view, TimeWindow.everything(), nothing=not found)
    shown = tuple(
        Visit(
            arrived=dwell.arrived if dwell.begun else None,
            departed=None if known and dwell.departed == newest else dwell.departed,
            duration=dwell.departed - dwell.arrived,
            closest_m=closest.distance_m,
            closest_at=closest.time,
            restarts=sum(reset > dwell.departed for reset in resets),
        )
        for dwell, closest in found
    )
    if newest is not None and any(visit.departed == newest for visit in shown):
        view.notes.add(
            f"the newest pose, of {unix_text(newest)}, is too old to know whether the robot is "
            "there now: departed is that pose"
        )
    if any(visit.restarts for visit in shown):
        view.notes.add(
            "visits with restarts_since are of before odometry began anew: "
            "the same coordinates may have been another place"
        )
    return Visits(
        frame_id=placement.frame_id,
        x=x,
        y=y,
        radius_m=radius,
        visits=shown,
        more=total > len(shown),
        total=total,
        now=now,
        notes=view.notes.sentences(),
    )


def _resets(view: View, topic: str, since: Ns) -> tuple[Ns, ...]:
    """Returns the times of the first poses after each reset of odometry since a moment.

    None, with a note, where the time for the answer is over before they are known.
    """
    try:
        path = driven_path(view, topic, TimeWindow(since, MAX_NS))
    except (InvalidArgumentsError, NoDataError):
        return ()  # poses that cannot be read say nothing about resets
    except QueryTimeoutError:
        view.notes.complete = False
        view.notes.add("the time was over before it was known whether odometry began anew since")
        return ()
    return () if path is None else path.trajectory.totals.resets


def _pose_frame(view: View, topic: str) -> str:
    """Returns the frame of the newest pose that can be decoded; empty without a pose.

    Raises:
        InvalidArgumentsError: the topic's messages carry no position.
        UndecodableError: none of the newest ones can be decoded.
    """
    failure: UndecodableError | None = None
    newest = view.stream.messages([topic], TimeWindow.everything(), newest_first=True)
    for found in islice(newest, _MOST_TRIED):
        try:
            message = view.memory.reader.decode(found.record)
        except UndecodableError as error:
            failure = failure or error
            continue
        pose = view.memory.extractor.pose(message, found.record.channel.type)
        if pose is None:
            raise InvalidArgumentsError(describe_lack(view, "position", found))
        if failure is not None:
            note_left_out(view, failure)
        return pose.frame_id
    if failure is not None:
        raise failure
    return ""


class _VisitSearch:
    """Goes through the poses of a topic from the newest on, without bags that are ruled out."""

    def __init__(
        self, view: View, topic: str, placement: MapPlacement, target: tuple[float, float, float]
    ) -> None:
        self._view = view
        self._topic = topic
        self._placement = placement
        self._x, self._y, self._radius = target
        self._is_fixed = placement.is_fixed(topic)
        self._digests = StoredDigests(view, topic, POSES, TimeWindow.everything())
        self._decoder = motion_decoder(view.memory.reader, view.memory.extractor)
        self._counting: Deadline | None = None

    @property
    def newest_time(self) -> Ns | None:
        """The log time of the newest pose; None without one."""
        return next((found.time for found, _ in self._positions(TimeWindow.everything())), None)

    def newest(self, limit: int) -> tuple[list[tuple[Dwell, Approach]], int]:
        """Returns the newest visits, each with its closest approach, and how many there are.

        Where the time is over before the end, a note says how far back they were counted.
        """
        visits = DwellBuilder(limit)
        before = MAX_NS
        try:
            for part in self._parts():
                self._pass_over(visits, TimeWindow(part.stop, max(before, part.stop)))
                self._add_part(visits, part)
                before = part.start
                if visits.enough and self._counting is None:
                    self._counting = Deadline.after(_COUNTING_S)
                self._check_counting()
            visits.end()
        except QueryTimeoutError:
            if not visits.all:
                raise
            self._view.notes.complete = False
            if self._counting is None:
                self._view.notes.add(f"the search ran out of time at {unix_text(before)}")
            self._view.notes.add(
                f"total counts the visits back to {unix_text(before)}: there may be more"
            )
        return [(visit, self._closest(visit)) for visit in visits.all[:limit]], len(visits.all)

    def _check_counting(self) -> None:
        """Checks that there is time left to count visits that are not shown.

        Raises:
            QueryTimeoutError: there is none.
        """
        if self._counting is not None and self._counting.expired():
            raise QueryTimeoutError("counting takes too long")

    def _closest(self, visit: Dwell) -> Approach:
        """Returns the closest pose of a visit, the earliest of equals.

        Whole bags within the radius are read only where one of their poses may be closer.
        """
        closest = visit.closest
        for bound, window, target in sorted(visit.unread, key=attrgetter("bound")):
            if closest is not None and closest <= bound:
                break
            approaches = [] if closest is None else [closest]
            try:
                self._add_approaches(approaches, window, target)
            except QueryTimeoutError:
                self._view.notes.complete = False
                self._view.notes.add(
                    f"closest_m of the visit until {unix_text(visit.departed)} is not the least: "
                    "the time was over before all of its poses were read"
                )
                return min(approaches, default=bound)
            closest = min(approaches, default=None)
        # Bags that were deleted meanwhile leave their bounds.
        return closest or min(each.bound for each in visit.unread)

    def _add_approaches(
        self, approaches: list[Approach], window: TimeWindow, target: tuple[float, float]
    ) -> None:
        def add(time: Ns, pose: Pose, _speed_mps: float | None) -> None:
            if is_place(pose.position):
                approaches.append(Approach(_away(pose.position, target), time))

        messages = self._view.stream.messages([self._topic], window)
        add_poses(self._view, add, self._decoder, messages, [])

    def _parts(self) -> Iterator[TimeWindow]:
        """Yields the times in which the robot may have been near, newest first."""
        if self._view.stream.may_be_relatched([self._topic]):
            # A visit may be ended by the duplicate of a pose in a bag that is ruled out.
            yield TimeWindow.everything()
            return
        bags = self._view.stream.overlapping_bags([self._topic], TimeWindow.everything())
        target = self._target_in(bags[0]) if self._is_fixed and bags else None
        if target is None:  # its coordinates are not the same in all bags, so none is ruled out
            near = Condition(NearPosition(0.0, 0.0, None, math.inf))
        else:
            near = Condition(NearPosition(*target, None, self._radius))
        for part in CandidateBags(self._view, (self._topic,), near, MAX_NS).windows():
            yield part.window

    def _pass_over(self, visits: DwellBuilder, gap: TimeWindow) -> None:
        """Adds the poses between two parts, which are all elsewhere, until the visit is over."""
        if gap.empty or not visits.under_way:
            return
        for found, _ in self._positions(gap):
            if not visits.away(found.time):
                return

    def _add_part(self, visits: DwellBuilder, part: TimeWindow) -> None:
        """Adds the poses of a part: by their digest where that is enough, else one by one."""
        groups = groups_of(self._view.stream, self._topic, part)
        alone = len(groups) == 1 and groups[0].is_whole and not self._may_have_duplicates(part)
        target = self._target_in(groups[0].bags[0]) if alone else None
        if target is not None:
            known = self._digests.of(groups[0])
            if known is not None and self._add_digest(visits, groups[0], *known, target):
                return
        self._placement.use_window(part)
        for found, position in self._positions(part):
            self._check_counting()
            distance = self._distance(found, position)
            if distance is not None and distance <= self._radius:
                visits.near(Approach(distance, found.time))
            else:
                visits.away(found.time)

    def _add_digest(
        self,
        visits: DwellBuilder,
        group: Group,
        digest: PoseDigest,
        span: tuple[Ns, Ns],
        target: tuple[float, float],
    ) -> bool:
        """Adds a whole group by the digest of its poses; False where that is not enough to know."""
        if digest.invalid or not digest.vertices:
            return False
        path = [vertex[1] for vertex in digest.vertices]
        first, last = digest.vertices[0][0], digest.vertices[-1][0]
        error_m = digest.error_m + _ROUNDING_M
        bound_m = _off_path(path, target) - error_m
        if bound_m > self._radius:
            visits.away(first)
            return True
        near = all(_away(position, target) + error_m <= self._radius for position in path)
        if not near or not self._unbroken(group, digest, span):
            return False
        if digest.error_m == 0 and len({*path}) == 1:
            # The robot stood still: the digest has the exact position of all poses.
            visits.near(Approach(_away(path[0], target), first), last)
            return True
        bound = Approach(max(bound_m, 0.0), span[0])
        visits.near_throughout(*span, Unread(bound, TimeWindow(span[0], span[1] + 1), target))
        return True

    def _unbroken(self, group: Group, digest: PoseDigest, span: tuple[Ns, Ns]) -> bool:
        """Whether no silence between two poses of a group is long enough to end a visit."""
        first, last = span
        if last - first <= SILENCE_NS:
            return True
        if len(group.bags) > 1:
            return False
        bag, window = group.bags[0].bag, TimeWindow(first, last + 1)
        times = self._view.bags.log_times(bag, self._topic, window)
        return len(times) == digest.poses and all(
            after - before <= SILENCE_NS for before, after in pairwise(times)
        )

    def _may_have_duplicates(self, part: TimeWindow) -> bool:
        """Whether another recording may hold the original of a pose in a part."""
        wider = TimeWindow(max(part.start - COPY_HORIZON_NS, MIN_NS), part.stop)
        bags = self._view.stream.overlapping_bags([self._topic], wider)
        return len({each.bag.recording for each in bags}) > 1

    def _target_in(self, held: BagSpan) -> tuple[float, float] | None:
        """Returns the target in the frame of a bag's poses; None where that frame moves."""
        return self._placement.in_poses(held.bag.recording, held.first, self._x, self._y)

    def _distance(self, found: StoredMessage, position: Vector3) -> float | None:
        """Returns how far (m) a pose is from the target; None where no transform tells."""
        recording = found.bag.recording
        target = self._placement.in_poses(recording, found.time, self._x, self._y)
        if target is not None:
            return _away(position, target)
        placed = self._placement.of(recording, found.time, position)
        return None if placed is None else _away(placed, (self._x, self._y))

    def _positions(self, part: TimeWindow) -> Iterator[tuple[StoredMessage, Vector3]]:
        """Returns the positions of a part, newest first."""
        messages = self._view.stream.messages([self._topic], part, newest_first=True)
        return positions_of(self._view, messages)


def _away(position: Vector3, target: tuple[float, float]) -> float:
    """Returns how far (m, in the plane) a position is from a place of the same frame."""
    return math.dist(position[:2], target)


def _off_path(path: Sequence[Vector3], target: tuple[float, float]) -> float:
    """Returns how far (m, in the plane) a place is from a path of the same frame."""
    # Each vertex by itself too: a part of the path may be a single vertex.
    pairs = chain(zip(path, path, strict=True), pairwise(path))
    gaps = [off_segment(target, before[:2], after[:2]) for before, after in pairs]
    return min(gap for gap in gaps if not math.isnan(gap))
