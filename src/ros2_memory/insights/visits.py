"""When the robot was near a place: arrival, departure, closest approach, newest first.

A visit is pose after pose within the radius. It is over when the robot is farther away for some
seconds, and where for longer no pose tells where it is. Odometry that
begins anew gives places another meaning: visits of before are marked.
"""

from __future__ import annotations

import math
from contextlib import suppress
from itertools import chain, islice, pairwise
from operator import attrgetter
from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.bulk_decode import MotionDecoder
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
    leave_out,
    stops,
)
from ros2_memory.history.duplicates import COPY_HORIZON_NS
from ros2_memory.history.no_data import describe_lack, require_bags, resolve_pose_topic
from ros2_memory.history.reverse_search import CandidateBags
from ros2_memory.history.view import View
from ros2_memory.insights.map_placement import map_placement
from ros2_memory.results import Visit, Visits

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from ros2_memory.analysis.dwell import Dwell
    from ros2_memory.analysis.odometry import PoseDigest, TimedPosition
    from ros2_memory.core.model import Pose, Vector3
    from ros2_memory.history.bag_groups import Group
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.history.duplicates import BagSpan, StoredMessage
    from ros2_memory.insights.map_placement import MapPlacement

_COUNTING_S: Final = 5.0
"""For so long visits are counted that are not shown."""
_ROUNDING_M: Final = 1e-6
"""What may be lost of a distance between doubles."""
_SPLITS: Final = 3
"""A pose so many splits old is the newest of a robot that goes on: a split answers when closed."""
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
    topic = resolve_pose_topic(view)
    place = map_placement(view, _pose_frame(view, topic), topic, frame_id)
    looking = _Looking(view, topic, place, (x, y, radius))
    latest, newest = view.snapshot.latest, looking.newest_time
    now = memory.now(wall, latest)
    stale = _SPLITS * ns_from_unix(memory.limits.split_duration_s)
    known = newest is not None and newest >= now - stale
    found, total = looking.newest(limit)
    epochs = () if place.is_map or not found else _restarts(view, topic, found[-1][0].arrived)
    note_unread(view, TimeWindow.everything(), nothing=not found)
    told = tuple(
        Visit(
            arrived=stay.arrived if stay.begun else None,
            departed=None if known and stay.departed == newest else stay.departed,
            duration=stay.departed - stay.arrived,
            closest_m=closest.distance_m,
            closest_at=closest.time,
            restarts=sum(epoch > stay.departed for epoch in epochs),
        )
        for stay, closest in found
    )
    if newest is not None and any(visit.departed == newest for visit in told):
        view.notes.add(
            f"the newest pose, of {unix_text(newest)}, is too old to know whether the robot is "
            "there now: departed is that pose"
        )
    if any(visit.restarts for visit in told):
        view.notes.add(
            "visits with restarts_since are of before odometry began anew: "
            "the same coordinates may have been another place"
        )
    return Visits(
        frame_id=place.frame_id,
        x=x,
        y=y,
        radius_m=radius,
        visits=told,
        more=total > len(told),
        total=total,
        now=now,
        notes=view.notes.sentences(),
    )


def _restarts(view: View, topic: str, since: Ns) -> tuple[Ns, ...]:
    """When odometry began anew after a moment; not known where the time is over before."""
    try:
        return odometry_resets(view, topic, since)
    except QueryTimeoutError:
        view.notes.complete = False
        view.notes.add("the time was over before it was known whether odometry began anew since")
        return ()


def _pose_frame(view: View, topic: str) -> str:
    """The frame of the newest pose that can be decoded.

    Raises:
        InvalidArgumentsError: the topic's messages carry no position.
        UndecodableError: none of the newest ones can be decoded.
    """
    found = view.stream.newest(topic, TimeWindow.everything())
    if found is None:
        return ""
    try:
        return _frame_of(view, found)
    except UndecodableError as error:
        leave_out(view, error)
        older = view.stream.messages([topic], TimeWindow.until(found.time), newest_first=True)
        for each in islice(older, _MOST_TRIED):
            with suppress(UndecodableError):
                return _frame_of(view, each)
        raise


def _frame_of(view: View, found: StoredMessage) -> str:
    message = view.memory.reader.decode(found.record)
    pose = view.memory.extractor.pose(message, found.record.channel.type)
    if pose is None:
        raise InvalidArgumentsError(describe_lack(view, "position", found))
    return pose.frame_id


class _Looking:
    """Goes through the poses of a topic from the newest on, but for bags that are ruled out."""

    def __init__(
        self, view: View, topic: str, place: MapPlacement, wanted: tuple[float, float, float]
    ) -> None:
        self._view = view
        self._topic = topic
        self._place = place
        self._x, self._y, self._radius = wanted
        self._one = place.is_one(topic)
        self._digests = StoredDigests(view, topic, POSES, TimeWindow.everything())
        self._decoder = MotionDecoder(view.memory.reader, view.memory.extractor)
        self._counting: Deadline | None = None

    @property
    def newest_time(self) -> Ns | None:
        """When the newest pose was recorded."""
        return next((stop.time for stop in self._positions(TimeWindow.everything())), None)

    def newest(self, limit: int) -> tuple[list[tuple[Dwell, Approach]], int]:
        """The newest visits, each with its closest approach, and how many there are in all.

        Where the time is over before all is gone through, there are as many as were found.
        """
        stays = DwellBuilder(limit)
        before = MAX_NS
        try:
            for part in self._parts():
                self._pass_over(stays, TimeWindow(part.stop, max(before, part.stop)))
                self._look(stays, part)
                before = part.start
                if stays.enough and self._counting is None:
                    self._counting = Deadline.after(_COUNTING_S)
                self._check_counting()
            stays.end()
        except QueryTimeoutError:
            if not stays.all:
                raise
            self._view.notes.complete = False
            if self._counting is None:
                self._view.notes.add(f"the search ran out of time at {unix_text(before)}")
            self._view.notes.add(
                f"total counts the visits back to {unix_text(before)}: there may be more"
            )
        return [(stay, self._closest(stay)) for stay in stays.all[:limit]], len(stays.all)

    def _check_counting(self) -> None:
        """Gives up when the time for counting visits that are not shown is over.

        Raises:
            QueryTimeoutError: it is.
        """
        if self._counting is not None and self._counting.expired():
            raise QueryTimeoutError("counting takes too long")

    def _closest(self, stay: Dwell) -> Approach:
        """The closest of all poses of a visit, the earliest of equals.

        Whole bags within the radius are read only where one of their poses may be closer.
        """
        closest = stay.closest
        for bound, window, here in sorted(stay.unread, key=attrgetter("bound")):
            if closest is not None and closest <= bound:
                break
            approaches = [] if closest is None else [closest]
            try:
                self._add_approaches(approaches, window, here)
            except QueryTimeoutError:
                self._view.notes.complete = False
                self._view.notes.add(
                    f"closest_m of the visit until {unix_text(stay.departed)} is not the least: "
                    "the time was over before all of its poses were read"
                )
                return min(approaches, default=bound)
            closest = min(approaches, default=None)
        # Where the bags of the visit are gone meanwhile, what is known of them serves.
        return closest or min(each.bound for each in stay.unread)

    def _add_approaches(
        self, approaches: list[Approach], window: TimeWindow, here: tuple[float, float]
    ) -> None:
        def add(time: Ns, pose: Pose, _speed_mps: float | None) -> None:
            if is_place(pose.position):
                approaches.append(Approach(_away(pose.position, here), time))

        messages = self._view.stream.messages([self._topic], window)
        add_poses(self._view, add, self._decoder, messages, [])

    def _parts(self) -> Iterator[TimeWindow]:
        """The times in which the robot may have been near, newest first."""
        if self._view.stream.may_be_relatched([self._topic]):
            # What ends a visit may be a copy of a pose in a bag that is ruled out.
            yield TimeWindow.everything()
            return
        holdings = self._view.stream.overlapping_bags([self._topic], TimeWindow.everything())
        here = self._here_in(holdings[0]) if self._one and holdings else None
        if here is None:  # the place is another one in some bags: none is ruled out
            near = Condition(NearPosition(0.0, 0.0, None, math.inf))
        else:
            near = Condition(NearPosition(*here, None, self._radius))
        for stretch in CandidateBags(self._view, (self._topic,), near, MAX_NS).windows():
            yield stretch.window

    def _pass_over(self, stays: DwellBuilder, gap: TimeWindow) -> None:
        """Takes the time between two parts: any pose in it is elsewhere."""
        if gap.empty or not stays.under_way:
            return
        for stop in self._positions(gap):
            if not stays.away(stop.time):
                return

    def _look(self, stays: DwellBuilder, part: TimeWindow) -> None:
        groups = groups_of(self._view.stream, self._topic, part)
        alone = len(groups) == 1 and groups[0].is_whole and not self._contested(part)
        here = self._here_in(groups[0].bags[0]) if alone else None
        if here is not None:
            known = self._digests.of(groups[0])
            if known is not None and self._sum_up(stays, groups[0], *known, here):
                return
        self._place.look_at(part)
        for recording, time, position in self._positions_in(part):
            self._check_counting()
            off = self._off(recording, time, position)
            if off is not None and off <= self._radius:
                stays.near(Approach(off, time))
            else:
                stays.away(time)

    def _sum_up(
        self,
        stays: DwellBuilder,
        group: Group,
        digest: PoseDigest,
        span: tuple[Ns, Ns],
        here: tuple[float, float],
    ) -> bool:
        """Takes a whole group by the digest of its poses, where that is enough to know."""
        if digest.invalid or digest.first is None or digest.last is None:
            return False
        path = [vertex[1] for vertex in digest.vertices]
        error_m = digest.error_m + _ROUNDING_M
        bound_m = _off_path(path, here) - error_m
        if bound_m > self._radius:
            stays.away(digest.first.time)
            return True
        near = all(_away(position, here) + error_m <= self._radius for position in path)
        if not near or not self._unbroken(group, digest, span):
            return False
        if digest.error_m == 0 and len({*path}) == 1:
            # It stood, and all poses are one.
            stays.near(Approach(_away(path[0], here), digest.first.time), digest.last.time)
            return True
        bound = Approach(max(bound_m, 0.0), span[0])
        stays.near_throughout(*span, Unread(bound, TimeWindow(span[0], span[1] + 1), here))
        return True

    def _unbroken(self, group: Group, digest: PoseDigest, span: tuple[Ns, Ns]) -> bool:
        """Whether no two poses of a group that follow each other are so far apart as to part it."""
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

    def _contested(self, part: TimeWindow) -> bool:
        """Whether another recording may hold the original of a pose in a part."""
        wider = TimeWindow(max(part.start - COPY_HORIZON_NS, MIN_NS), part.stop)
        return (
            len(
                {
                    each.bag.recording
                    for each in self._view.stream.overlapping_bags([self._topic], wider)
                }
            )
            > 1
        )

    def _here_in(self, held: BagSpan) -> tuple[float, float] | None:
        """Where the place is in the poses' frame of a bag; None where that is not one place."""
        return self._place.in_poses(held.bag.recording, held.first, self._x, self._y)

    def _off(self, recording: Path, time: Ns, position: Vector3) -> float | None:
        here = self._place.in_poses(recording, time, self._x, self._y)
        if here is not None:
            return _away(position, here)
        there = self._place.of(recording, time, position)
        return None if there is None else _away(there, (self._x, self._y))

    def _positions_in(self, part: TimeWindow) -> Iterator[tuple[Path, Ns, Vector3]]:
        """As `_positions`, each with its recording."""
        messages = self._view.stream.messages([self._topic], part, newest_first=True)
        at: list[Path] = []

        def noted() -> Iterator[StoredMessage]:
            for found in messages:
                at[:] = [found.bag.recording]
                yield found

        for stop in stops(self._view, noted()):
            yield at[0], *stop

    def _positions(self, part: TimeWindow) -> Iterator[TimedPosition]:
        """The positions of a part that are places, newest first."""
        return stops(self._view, self._view.stream.messages([self._topic], part, newest_first=True))


def _away(position: Vector3, here: tuple[float, float]) -> float:
    """How far (m, in the plane) a position is from a place of the same frame."""
    return math.dist(position[:2], here)


def _off_path(path: Sequence[Vector3], here: tuple[float, float]) -> float:
    """How far (m, in the plane) a place is from a drawn path of the same frame."""
    # Each vertex by itself too: what is parted may be a single one.
    pairs = chain(zip(path, path, strict=True), pairwise(path))
    gaps = [off_segment(here, before[:2], after[:2]) for before, after in pairs]
    return min(gap for gap in gaps if not math.isnan(gap))


def odometry_resets(view: View, topic: str, since: Ns) -> tuple[Ns, ...]:
    """The times of the first poses of odometry that began anew after a moment, in order."""
    # Poses that cannot be read, or are none, do not say where odometry is.
    with suppress(InvalidArgumentsError, NoDataError):
        way = driven_path(view, topic, TimeWindow(since, MAX_NS))
        if way is not None:
            return way.trajectory.resets
    return ()
