"""When the robot was near a place: arrival, departure, closest approach, newest first.

A visit is pose after pose within the radius. It is over when the robot is farther away for some
seconds, and where for longer no pose tells where it is. Odometry that
begins anew gives places another meaning: visits of before are marked.
"""

from __future__ import annotations

import math
from contextlib import suppress
from itertools import islice
from typing import TYPE_CHECKING, Final

from ros2_memory.absence import moment, require_bags, resolve_topic
from ros2_memory.accounts import Visit, Visits
from ros2_memory.candidates import Candidates
from ros2_memory.conditions import Condition, NearPosition
from ros2_memory.copies import COPY_HORIZON_NS
from ros2_memory.errors import InvalidArgumentsError, QueryTimeoutError, UndecodableError
from ros2_memory.groups import groups_of
from ros2_memory.history import View
from ros2_memory.model import TimeWindow
from ros2_memory.places import placing
from ros2_memory.portions import Kept, is_whole
from ros2_memory.restarts import restarts
from ros2_memory.stays import Stays
from ros2_memory.timebase import MAX_NS, MIN_NS, Ns
from ros2_memory.trajectory import PoseCollector
from ros2_memory.unseen import note_unseen
from ros2_memory.ways import POSES, carries_no, leave_out, stops

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ros2_memory.copies import Found
    from ros2_memory.memory import Call, Memory
    from ros2_memory.motion import PoseDigest, Stop
    from ros2_memory.places import Placing
    from ros2_memory.stays import Stay

_MOST_TRIED: Final = 1000
"""The newest poses, of which one must be readable."""


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
    """When the robot was within a radius (m) of a place of the plane, the newest visits first.

    The place is meant in `frame_id`: the map, as where none is given, or the frame of the poses.

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
    view = View(memory, call, wall)
    require_bags(view)
    topic = resolve_topic(view, memory.limits.pose_topic)
    place = placing(view, _pose_frame(view, topic), frame_id)
    looking = _Looking(view, topic, place, (x, y, radius))
    found, more = looking.newest(limit)
    latest, newest = view.snapshot.latest, looking.newest_time
    epochs = [] if place.is_map or not found else restarts(view, topic, found[-1].arrived)
    note_unseen(view, TimeWindow.everything(), nothing=not found)
    told = tuple(
        Visit(
            arrived=stay.arrived if stay.begun else None,
            departed=None if stay.departed == newest else stay.departed,
            duration=stay.departed - stay.arrived,
            closest_m=stay.closest_m,
            closest_at=stay.closest_at,
            restarts=sum(epoch > stay.departed for epoch in epochs),
        )
        for stay in found
    )
    if any(visit.restarts for visit in told):
        view.note(
            "visits with restarts_since are of before odometry began anew: "
            "the same coordinates may have been another place"
        )
    return Visits(
        frame_id=place.frame_id,
        x=x,
        y=y,
        radius_m=radius,
        visits=told,
        more=more,
        total=None if more else len(told),
        now=wall if memory.limits.now == "wall" or latest is None else latest,
        notes=view.notes,
    )


def _pose_frame(view: View, topic: str) -> str:
    """The frame of the newest pose that can be decoded.

    Raises:
        InvalidArgumentsError: the topic's messages carry no position.
        UndecodableError: none of the newest ones can be decoded.
    """
    found = view.newest(topic, TimeWindow.everything())
    if found is None:
        return ""
    try:
        return _frame_of(view, found)
    except UndecodableError as error:
        leave_out(view, error)
        older = view.stream([topic], TimeWindow.until(found.time), newest_first=True)
        for each in islice(older, _MOST_TRIED):
            with suppress(UndecodableError):
                return _frame_of(view, each)
        raise


def _frame_of(view: View, found: Found) -> str:
    message = view.memory.reader.decode(found.record)
    pose = view.memory.extractor.pose(message, found.record.channel.type)
    if pose is None:
        raise InvalidArgumentsError(carries_no("position", found))
    return pose.frame_id


class _Looking:
    """Goes through the poses of a topic from the newest on, but for bags that are ruled out."""

    def __init__(
        self, view: View, topic: str, place: Placing, wanted: tuple[float, float, float]
    ) -> None:
        self._view = view
        self._topic = topic
        self._place = place
        self._x, self._y, self._radius = wanted
        self._here = place.in_poses(self._x, self._y)
        self._kept: Kept[PoseDigest] = Kept(view, topic, POSES, TimeWindow.everything())

    @property
    def newest_time(self) -> Ns | None:
        """When the newest pose was recorded."""
        return next((stop.time for stop in self._positions(TimeWindow.everything())), None)

    def newest(self, limit: int) -> tuple[list[Stay], bool]:
        """The newest visits, and whether there are more."""
        stays = Stays(limit)
        before = MAX_NS
        try:
            for part in self._parts():
                self._pass_over(stays, TimeWindow(part.stop, max(before, part.stop)))
                self._look(stays, part)
                before = part.start
                if stays.enough:
                    return stays.all[:limit], True
        except QueryTimeoutError:
            if not stays.all:
                raise
            self._view.complete = False
            self._view.note(f"the search ran out of time at {moment(before)}")
            return stays.all[:limit], True
        stays.end()
        return stays.all[:limit], len(stays.all) > limit

    def _parts(self) -> Iterator[TimeWindow]:
        """The times in which the robot may have been near, newest first."""
        if self._view.received_twice([self._topic]):
            # What ends a visit may be a copy of a pose in a bag that is ruled out.
            yield TimeWindow.everything()
            return
        if self._here is None:  # the place is another one in every bag: none is ruled out
            near = Condition(NearPosition(0.0, 0.0, None, math.inf))
        else:
            near = Condition(NearPosition(*self._here, None, self._radius))
        for stretch in Candidates(self._view, (self._topic,), near, MAX_NS).stretches():
            yield stretch.window

    def _pass_over(self, stays: Stays, gap: TimeWindow) -> None:
        """Takes the time between two parts: any pose in it is elsewhere."""
        if gap.empty or not stays.under_way:
            return
        for stop in self._positions(gap):
            if not stays.away(stop.time):
                return

    def _look(self, stays: Stays, part: TimeWindow) -> None:
        groups = groups_of(self._view, self._topic, part)
        alone = len(groups) == 1 and is_whole(groups[0], part) and not self._contested(part)
        if alone and self._here is not None:
            known = self._kept.of(groups[0])
            digest, span = known if known is not None else self._made(part)
            if span is not None and self._all_near(digest):
                stays.near(*span, self._closest(digest))
                return
        self._place.look_at(part)
        for time, position in self._positions(part):
            off = self._off(time, position)
            if off is not None and off <= self._radius:
                stays.near(time, time, (off, time))
            else:
                stays.away(time)

    def _contested(self, part: TimeWindow) -> bool:
        """Whether another recording may hold the original of a pose in a part."""
        wider = TimeWindow(max(part.start - COPY_HORIZON_NS, MIN_NS), part.stop)
        return len({each.bag.recording for each in self._view.holdings([self._topic], wider)}) > 1

    def _made(self, part: TimeWindow) -> tuple[PoseDigest, tuple[Ns, Ns] | None]:
        """The digest of the poses of a part, as the catalogue would have it."""
        collector = PoseCollector(self._view.memory.limits.max_plausible_speed_mps)
        times: list[Ns] = []
        for found in self._view.stream([self._topic], part):
            times.append(found.time)
            try:
                message = self._view.memory.reader.decode(found.record)
            except UndecodableError:
                return collector.digest(), None
            pose = self._view.memory.extractor.pose(message, found.record.channel.type)
            if pose is None:
                return collector.digest(), None
            collector.add(found.time, pose)
        return collector.digest(), (times[0], times[-1]) if times else None

    def _all_near(self, digest: PoseDigest) -> bool:
        """Whether every pose of a digest is within the radius, as its drawn path tells."""
        if digest.invalid or not digest.poses or digest.jumps:
            return False
        return all(
            self._away(position) + digest.error_m <= self._radius
            for _, position, _ in digest.vertices
        )

    def _closest(self, digest: PoseDigest) -> tuple[float, Ns]:
        return min((self._away(position), time) for time, position, _ in digest.vertices)

    def _away(self, position: tuple[float, float, float]) -> float:
        """How far (m, in the plane) a position of the poses' frame is from the place."""
        here = self._here or (math.nan, math.nan)
        return math.dist(position[:2], here)

    def _off(self, time: Ns, position: tuple[float, float, float]) -> float | None:
        if self._here is not None:
            return self._away(position)
        there = self._place.of(time, position)
        return None if there is None else math.dist(there[:2], (self._x, self._y))

    def _positions(self, part: TimeWindow) -> Iterator[Stop]:
        """The positions of a part that are places, newest first."""
        return stops(self._view, self._view.stream([self._topic], part, newest_first=True))
