"""How the robot moved in a window: its path, and where it stood still."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.bulk_decode import motion_decoder
from ros2_memory.analysis.clock_steps import Elapsed
from ros2_memory.analysis.motion.odometry import is_place
from ros2_memory.analysis.motion.speed_drops import SLOT_NS
from ros2_memory.analysis.motion.standstills import (
    CONTEXT_NS,
    CREEP_MPS,
    SHORTEST_NS,
    StandstillBuilder,
    StandstillCollector,
    StandstillDigest,
    StandstillRun,
)
from ros2_memory.catalogue.codec import (
    decode_standstill_run,
    decode_standstills,
    encode_standstill_run,
    encode_standstills,
)
from ros2_memory.core.errors import InvalidArgumentsError, NoDataError, UndecodableError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import (
    AT_OR_BEFORE_SLACK_NS,
    NS_PER_S,
    START_SLACK_NS,
    ns_from_unix,
    unix_from_ns,
)
from ros2_memory.history.bag_fold import Fold
from ros2_memory.history.bag_groups import DigestKind, store_shared
from ros2_memory.history.driven_path import (
    add_poses,
    driven_path,
    poses_of_body,
    resolve_path_topic,
)
from ros2_memory.history.robots import require_one_robot
from ros2_memory.insights.clock_steps import across_steps, elapsed_in
from ros2_memory.insights.silences import unrecorded_length

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ros2_memory.analysis.bulk_decode import MotionDecoder
    from ros2_memory.analysis.motion.speed_drops import SpeedDrop
    from ros2_memory.analysis.motion.standstills import Standstill
    from ros2_memory.analysis.motion.trajectory import Trajectory
    from ros2_memory.core.model import Pose
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.bag_groups import Span
    from ros2_memory.history.driven_path import DrivenPath
    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.history.view import View


_NO_WAYPOINTS: Final = 2
"""The fewest that a path is drawn with: drawing takes long, and these are not shown."""
_BRAKING_NS: Final[Ns] = 4 * NS_PER_S
"""A standstill that begins so soon after a loss of speed is what that led to."""


@dataclass(frozen=True, slots=True)
class Drive:
    """How the robot moved: its path, and its standstills with whether each goes on afterwards.

    `drops` are sudden losses of speed that no standstill follows. `elapsed` is how much time passed
    between moments of the window, `unrecorded` for how much of it no poses were recorded.
    """

    path: DrivenPath | None = None
    standstills: tuple[tuple[Standstill, bool], ...] = ()
    drops: tuple[SpeedDrop, ...] = ()
    elapsed: Elapsed = field(default_factory=Elapsed)
    unrecorded: Ns = 0

    @property
    def known(self) -> Trajectory | None:
        """The path's trajectory, if it has a valid pose."""
        known = None if self.path is None else self.path.trajectory
        return known if known is not None and known.is_known else None

    def stood(self, length: Ns) -> Ns | None:
        """Returns how long the robot stood in all, in a window of a length; None if not known.

        It is not known where no pose has a valid position, nor where the robot neither moved nor
        stood for most of the time: noise hides where it stood.
        """
        stood = sum(self.elapsed.between(each.start, each.end) for each, _ in self.standstills)
        known = self.known
        if known is None:
            return stood or None
        recorded_s = known.totals.duration_s - unix_from_ns(self.unrecorded)
        if not stood:
            is_hidden = length >= SHORTEST_NS and known.totals.distance_m <= CREEP_MPS * recorded_s
            return None if is_hidden else 0
        else_s = recorded_s - unix_from_ns(stood)
        is_hidden = else_s > recorded_s / 2 and known.totals.distance_m < CREEP_MPS * else_s
        if is_hidden and not known.totals.gaps and ns_from_unix(else_s) > SHORTEST_NS:
            return None
        return stood


def drive_in(view: View, window: TimeWindow) -> Drive:
    """Returns how the robot moved; nothing, with a note, if that is unknown."""
    elapsed = elapsed_in(view, window)
    try:
        topic = resolve_path_topic(view)
        require_one_robot(view, topic, window)
        path = driven_path(view, topic, window, _NO_WAYPOINTS)
        standstills, drops = _standstills_in(view, topic, window)
    except (InvalidArgumentsError, NoDataError) as error:
        view.notes.add(f"the path is unknown: {error}")
        return Drive(elapsed=elapsed)
    if path is None:
        view.notes.add(f"{topic} has no poses in this time: the path is unknown")
    else:
        path = replace(path, trajectory=across_steps(path, elapsed))
    unrecorded = 0 if path is None else unrecorded_length(view, topic, path, elapsed)
    return Drive(path, standstills, drops, elapsed, unrecorded)


_STANDSTILLS: Final = DigestKind(
    "standstills",
    look_up=lambda digests, topic, among: digests.catalogue.standstills(topic, among),
    encode=encode_standstills,
    decode=decode_standstills,
)


def store_shared_standstills(view: View, topic: str, window: TimeWindow) -> int:
    """Stores the standstills of recordings that touch each other; returns of how many groups.

    Raises:
        InvalidArgumentsError: a message of the topic carries no position.
    """
    decoder = motion_decoder(view.memory.reader, view.memory.extractor)

    def collect(
        messages: Iterable[StoredMessage],
    ) -> tuple[StandstillDigest | None, Span | None]:
        failures: list[UndecodableError] = []
        collector = StandstillCollector()
        span = _add_places(view, collector, decoder, messages, failures)
        return (None if failures else collector.digest()), span

    return store_shared(view, topic, _STANDSTILLS, collect, window)


def _add_places(
    view: View,
    to: StandstillBuilder | StandstillCollector,
    decoder: MotionDecoder,
    messages: Iterable[StoredMessage],
    failures: list[UndecodableError],
) -> Span | None:
    def add_place(time: Ns, pose: Pose, _speed_mps: float | None) -> None:
        if is_place(pose.position):
            to.add(time, pose.position, pose.orientation)

    return add_poses(view, add_place, decoder, messages, failures)


def _in_one(
    found: Sequence[tuple[StandstillDigest, Span]],
) -> Sequence[tuple[StandstillRun, Span]]:
    run = StandstillRun.of([digest for digest, _ in found])
    return [(run, (found[0][1][0], found[-1][1][1]))]


def _encoded(joined: StandstillDigest | StandstillRun) -> bytes:
    if isinstance(joined, StandstillDigest):
        joined = StandstillRun((joined,))
    return encode_standstill_run(joined)


def _whole_bags(view: View, topic: str, window: TimeWindow) -> TimeWindow:
    """Returns a window, or where positions inside of bags are thinned, that of all its bags.

    They have digests of every position.
    """
    extents = [] if view.memory.stated is None else [*view.snapshot.timeline.extents(topic, window)]
    if not extents:
        return window
    first, last = min(each.first for each in extents), max(each.last for each in extents)
    return TimeWindow(min(first, window.start), max(last + 1, window.stop))


def _standstills_in(
    view: View, topic: str, window: TimeWindow
) -> tuple[tuple[tuple[Standstill, bool], ...], tuple[SpeedDrop, ...]]:
    """Returns where the robot of a pose topic stood still, in order, as far as it is in a window.

    And where they lose speed suddenly without standing still next.

    With each comes whether it goes on after the window, or up to the last pose that is known.

    Poses outside of the window count too: a standstill that goes on beyond an end of the window
    ends there, however little of it is inside. So those of windows that follow each other add up.

    Raises:
        InvalidArgumentsError: a message of the topic carries no position.
    """
    start, end = window.start + START_SLACK_NS, window.stop - 1 - AT_OR_BEFORE_SLACK_NS
    builder = StandstillBuilder()
    decoder = motion_decoder(view.memory.reader, view.memory.extractor)
    failures: list[UndecodableError] = []

    def collect(
        messages: Iterable[StoredMessage],
    ) -> tuple[StandstillDigest | None, Span | None]:
        collector = StandstillCollector()
        span = _add_places(view, collector, decoder, messages, failures)
        return collector.digest(), span

    fold = Fold(
        _STANDSTILLS,
        add=lambda messages: _add_places(view, builder, decoder, messages, failures),
        collect=collect,
        join=lambda digest, _span: builder.join(digest),
        reduce=_in_one,
        encode=_encoded,
        decode=decode_standstill_run,
        failures=failures,
    )
    if topic in view.memory.limits.tf_topics:
        for time, pose in poses_of_body(view, window.widened(CONTEXT_NS)):
            builder.add(time, pose.position, pose.orientation)
    else:
        fold.over(view, topic, _whole_bags(view, topic, window.widened(CONTEXT_NS)))
    found = builder.standstills()
    begins = [each.start for each in found]
    standstills = tuple(
        (
            each._replace(start=max(each.start, start), end=min(each.end, end)),
            each.end > end or each.end == builder.last,
        )
        for each in found
        if each.start < end and each.end > start
    )
    drops = tuple(
        each
        for each in builder.drops
        if start <= each.time <= end
        and bisect_left(begins, each.time - SLOT_NS) == bisect_left(begins, each.time + _BRAKING_NS)
    )
    return standstills, drops
