"""The way driven in a window: whole bags by the digests of their poses, the others pose by pose.

A digest is the same whether it comes from the catalogue or is made here from the bag, so an answer
does not depend on what the catalogue knows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

from ros2_memory.analysis.odometry import TimedPosition, is_place
from ros2_memory.analysis.sights import MotionDecoder
from ros2_memory.analysis.trajectory import PoseCollector, TrajectoryBuilder
from ros2_memory.catalogue.codec import decode_poses, encode_poses
from ros2_memory.core.errors import InvalidArgumentsError, UndecodableError
from ros2_memory.core.text import counted, listed
from ros2_memory.history.bag_groups import DigestKind, StoredPart, is_whole
from ros2_memory.history.no_data import topics_with, undecodable, undecodable_in

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from ros2_memory.analysis.trajectory import Trajectory
    from ros2_memory.core.model import Pose, TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.history.view import View

_MOST_AT_ONCE: Final = 1024
"""Messages that are looked at together."""
_MOST_BYTES_AT_ONCE: Final = 1 << 20


class TakesPoses(Protocol):
    """Something to which poses are given in order."""

    def add(self, time: Ns, pose: Pose, speed_mps: float | None = None, /) -> None:
        """Takes the next pose, and the speed that its message states, if it states one."""


@dataclass(frozen=True, slots=True)
class DrivenPath:
    """The way, its frames in order of appearance, and the times of its first and last message."""

    trajectory: Trajectory
    frames: tuple[str, ...]
    first: Ns
    last: Ns


POSES: Final = DigestKind(
    "poses",
    ask=lambda notes, topic, among: notes.poses(topic, among),
    packed=lambda digest: encode_poses(digest).hex(),
    unpacked=lambda text: decode_poses(bytes.fromhex(text)),
)


def driven_path(view: View, topic: str, window: TimeWindow) -> DrivenPath | None:
    """The way in a window by the poses of one topic; None where there is no message.

    Messages that cannot be decoded are left out, with a note.

    Raises:
        InvalidArgumentsError: a message of the topic carries no position.
        NoDataError: no message can be decoded.
    """
    failures: list[UndecodableError] = []
    builder = TrajectoryBuilder(max_plausible_speed_mps=view.memory.limits.max_plausible_speed_mps)
    digests = StoredPart(view, topic, POSES, window)
    sights = MotionDecoder(view.memory.reader, view.memory.extractor)
    first: Ns | None = None
    last: Ns | None = None
    for group in view.groups(topic, window):
        span: tuple[Ns, Ns] | None
        if not is_whole(group, window):
            span = add_poses(view, builder, sights, group.once(), failures)
        elif (known := digests.of(group)) is not None:
            digest, span = known
            builder.join(digest)
        else:
            collector = PoseCollector(view.memory.limits.max_plausible_speed_mps)
            failed = len(failures)
            span = add_poses(view, collector, sights, group.once(), failures)
            digest = collector.digest()
            builder.join(digest)
            if span is not None and failed == len(failures):
                digests.keep(group, digest, span)
        if span is not None:
            first, last = (span[0] if first is None else first), span[1]
    if failures:
        error = failures[0]
        if first is None:
            raise undecodable_in(view, window, error.topic, error.type_name, error) from error
        view.complete = False
        view.note(f"poses left out, since they cannot be decoded: {len(failures)} ({error.reason})")
    if first is None or last is None:
        return None
    return DrivenPath(builder.result(), builder.frames, first, last)


def length_notes(way: Trajectory) -> Iterator[str]:
    """What is not in the length of a way, and why it is not the sum of all steps."""
    if way.invalid:
        poses = counted(way.invalid, "pose")
        yield f"{poses} left out: the coordinates are no place (NaN or beyond)"
    if way.is_noisy:
        yield (
            f"the positions are noisy: step by step they sum up to {way.path_sum_m:.2f} m; "
            "distance_m is without what the noise adds"
        )
    if way.in_doubt:
        yield (
            "the positions come more than 0.25 s apart, and noise or sharp turns are much of the "
            "steps between them: distance_m may be too long, since noise cannot be taken off"
        )
    if way.gaps:
        without = "without a valid pose" if way.invalid else "in which nothing was recorded"
        yield (
            f"{counted(way.gaps, 'gap')} {without}, {way.gap_m:.2f} m across in straight lines "
            "(gap_m): left out of distance_m"
        )
    if way.jumps:
        yield (
            f"{counted(way.jumps, 'jump')} of {way.jumped_m:.2f} m in all, faster than is "
            "plausible, left out of distance and speed"
        )
    if way.resets:
        yield (
            f"odometry began anew {counted(len(way.resets), 'time')}: "
            "what led back to its origin is left out of distance and speed"
        )


def add_poses(
    view: View,
    to: TakesPoses,
    sights: MotionDecoder,
    messages: Iterable[StoredMessage],
    failures: list[UndecodableError],
) -> tuple[Ns, Ns] | None:
    """Adds the poses of messages, and gives the times of the first and last; None without any.

    Those that cannot be decoded are added to `failures`.

    Raises:
        InvalidArgumentsError: a message carries no position.
    """
    first: Ns | None = None
    last: Ns | None = None
    for some in _batches(messages):
        for found, sight in zip(some, sights.of([each.record for each in some]), strict=True):
            if isinstance(sight, UndecodableError):
                failures.append(sight)
                continue
            if sight.pose is None:
                raise InvalidArgumentsError(carries_no(view, "position", found))
            to.add(found.time, sight.pose, sight.speed_mps)
            first = found.time if first is None else first
            last = found.time
        view.check_deadline()
    return None if first is None or last is None else (first, last)


def _batches(messages: Iterable[StoredMessage]) -> Iterator[list[StoredMessage]]:
    """The messages, as many at a time as may be held."""
    some: list[StoredMessage] = []
    size = 0
    for found in messages:
        some.append(found)
        size += len(found.record.payload)
        if len(some) == _MOST_AT_ONCE or size > _MOST_BYTES_AT_ONCE:
            yield some
            some, size = [], 0
    if some:
        yield some


def stops(view: View, messages: Iterable[StoredMessage]) -> Iterator[TimedPosition]:
    """Where the poses of messages are; what is no place is left out.

    So is, with a note, what cannot be decoded.
    """
    for found in messages:
        try:
            message = view.memory.reader.decode(found.record)
        except UndecodableError as error:
            leave_out(view, error)
            continue
        pose = view.memory.extractor.pose(message, found.record.channel.type)
        if pose is not None and is_place(pose.position):
            yield TimedPosition(found.time, pose.position)


def leave_out(view: View, error: UndecodableError) -> None:
    """Says that there are poses which cannot be decoded, and why."""
    view.complete = False
    view.note(f"poses of {error.topic} left out, since they cannot be decoded: {error.reason}")


def decoded(view: View, found: StoredMessage) -> object:
    """The message that was found.

    Raises:
        NoDataError: it cannot be decoded.
    """
    try:
        return view.memory.reader.decode(found.record)
    except UndecodableError as error:
        raise undecodable(error.topic, error.type_name, error) from error


def carries_no(view: View, what: str, found: StoredMessage) -> str:
    """The sentence for a topic that is asked for what its type does not have."""
    channel = found.record.channel
    has = f"carries no {what}"
    if "geodetic" in view.memory.extractor.kinds_of(channel.type):
        has = f"carries latitude and longitude in degrees, and no {what} in metres"
    those = topics_with(view, what)
    hint = f"such as {listed(those)}" if those else "such as one of type nav_msgs/msg/Odometry"
    return (
        f"topic: {channel.topic} is a {channel.type}, which {has}; give a topic that does, {hint}"
    )
