"""The driven path in a window: whole bags by digests of their poses, the others pose by pose."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, Final, TypeAlias

from ros2_memory.analysis.bulk_decode import motion_decoder
from ros2_memory.analysis.motion.odometry import is_place
from ros2_memory.analysis.motion.trajectory import (
    MAX_WAYPOINTS,
    PoseCollector,
    TrajectoryBuilder,
    joined_poses,
)
from ros2_memory.catalogue.codec import decode_poses, encode_poses
from ros2_memory.core.errors import InvalidArgumentsError, UndecodableError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.text import counted
from ros2_memory.history.bag_fold import Fold
from ros2_memory.history.bag_groups import DigestKind, store_shared
from ros2_memory.history.no_data import describe_lack, undecodable, with_notes

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from ros2_memory.analysis.bulk_decode import MotionDecoder
    from ros2_memory.analysis.motion.odometry import PoseDigest
    from ros2_memory.analysis.motion.trajectory import Trajectory
    from ros2_memory.core.model import Pose, Vector3
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.bag_groups import Span
    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.history.view import View

_MOST_AT_ONCE: Final = 1024
"""Messages that are decoded together: 0.74 in place of 7.6 µs for the position of each."""
_MOST_TRIED: Final = 1000
"""How many of the newest poses are tried until one can be decoded."""
_MOST_BYTES_AT_ONCE: Final = 1 << 20


AddPose: TypeAlias = "Callable[[Ns, Pose, float | None], None]"
"""Takes the next pose (log time, pose), and the speed (m/s) that its message states, if any."""


@dataclass(frozen=True, slots=True)
class DrivenPath:
    """A path, its frames in order of appearance, and the times of its first and last message."""

    trajectory: Trajectory
    frames: tuple[str, ...]
    first: Ns
    last: Ns


POSES: Final = DigestKind(
    "poses",
    look_up=lambda digests, topic, among: digests.catalogue.poses(topic, among),
    encode=encode_poses,
    decode=decode_poses,
)


def driven_path(
    view: View, topic: str, window: TimeWindow, max_waypoints: int = MAX_WAYPOINTS
) -> DrivenPath | None:
    """Returns the path in a window by the poses of one topic; None where there is no message.

    It is drawn with `max_waypoints` (2 or more) at most. Messages that cannot be decoded are left
    out, with a note.

    Raises:
        InvalidArgumentsError: a message of the topic carries no position.
        NoDataError: no message can be decoded.
    """
    fastest = view.memory.limits.max_plausible_speed_mps
    failures: list[UndecodableError] = []
    builder = TrajectoryBuilder(fastest, max_waypoints)
    decoder = motion_decoder(view.memory.reader, view.memory.extractor)

    def collect(messages: Iterable[StoredMessage]) -> tuple[PoseDigest, Span | None]:
        collector = PoseCollector(fastest)
        span = add_poses(view, collector.add, decoder, messages, failures)
        return collector.digest(), span

    span = Fold(
        POSES,
        add=lambda messages: add_poses(view, builder.add, decoder, messages, failures),
        collect=collect,
        join=lambda digest, _span: builder.join(digest),
        reduce=lambda found: joined_poses(found, fastest),
        encode=encode_poses,
        decode=decode_poses,
        failures=failures,
        name=f"{fastest:g}",
    ).over(view, topic, window)
    if failures:
        error = failures[0]
        if span is None:
            raise with_notes(view, window, undecodable(error)) from error
        view.notes.complete = False
        count = len(failures)
        view.notes.add(f"poses left out, since they cannot be decoded: {count} ({error.reason})")
    return None if span is None else DrivenPath(builder.result(), builder.frames, *span)


def store_shared_paths(view: View, topic: str, window: TimeWindow) -> int:
    """Stores the poses of recordings that touch each other; returns of how many groups of bags.

    Raises:
        InvalidArgumentsError: a message of the topic carries no position.
    """
    fastest = view.memory.limits.max_plausible_speed_mps
    decoder = motion_decoder(view.memory.reader, view.memory.extractor)

    def collect(messages: Iterable[StoredMessage]) -> tuple[PoseDigest | None, Span | None]:
        failures: list[UndecodableError] = []
        collector = PoseCollector(fastest)
        span = add_poses(view, collector.add, decoder, messages, failures)
        return (None if failures else collector.digest()), span

    return store_shared(view, topic, POSES, collect, window)


def length_notes(path: Trajectory) -> Iterator[str]:
    """Yields what is left out of the length of a path, and why it is not the sum of all steps."""
    totals = path.totals
    if path.invalid:
        poses = counted(path.invalid, "pose")
        yield f"{poses} left out: their coordinates are not valid (NaN or out of range)"
    if path.is_noisy:
        yield (
            f"the positions are noisy: all steps add up to {totals.path_sum_m:.2f} m; "
            "distance_m leaves out what noise adds"
        )
    if totals.is_uncertain:
        yield (
            "the positions are more than 0.25 s apart, and noise or sharp turns are a large part "
            "of the steps: distance_m may be too long, because noise cannot be removed"
        )
    if totals.gaps:
        without = "without a valid pose" if path.invalid else "without a pose"
        yield (
            f"{counted(totals.gaps, 'gap')} {without}, {totals.gap_m:.2f} m across in straight "
            "lines (gap_m): left out of distance_m"
        )
    if totals.jumps:
        yield (
            f"{counted(totals.jumps, 'jump')} of {totals.jumped_m:.2f} m in all, faster than is "
            "plausible, left out of distance and speed"
        )
    if totals.resets:
        yield (
            f"odometry restarted {counted(len(totals.resets), 'time')}: "
            "the jumps back to its origin are left out of distance and speed"
        )


def add_poses(
    view: View,
    add: AddPose,
    decoder: MotionDecoder,
    messages: Iterable[StoredMessage],
    failures: list[UndecodableError],
) -> tuple[Ns, Ns] | None:
    """Adds the poses of messages, and returns the times of the first and last; None without any.

    Those that cannot be decoded are added to `failures`.

    Raises:
        InvalidArgumentsError: a message carries no position.
    """
    first: Ns | None = None
    last: Ns | None = None
    for some in _batches(messages):
        for found, sample in zip(some, decoder.decode([each.record for each in some]), strict=True):
            if isinstance(sample, UndecodableError):
                failures.append(sample)
                continue
            if sample.pose is None:
                raise InvalidArgumentsError(describe_lack(view, "position", found))
            add(found.time, sample.pose, sample.speed_mps)
            first = found.time if first is None else first
            last = found.time
        view.bags.check_deadline()
    return None if first is None or last is None else (first, last)


def _batches(messages: Iterable[StoredMessage]) -> Iterator[list[StoredMessage]]:
    """Yields the messages in lists, bounded in number and in bytes."""
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


def positions_of(
    view: View, decoder: MotionDecoder, messages: Iterable[StoredMessage]
) -> Iterator[tuple[StoredMessage, Vector3]]:
    """Yields messages with the positions (m) of their poses; without those that are NaN or beyond.

    A note reports which messages cannot be decoded. More and more messages are read ahead.
    """
    rest, ahead = iter(messages), 1
    while some := [*islice(rest, ahead)]:
        ahead = min(2 * ahead, _MOST_AT_ONCE)
        for found, sample in zip(some, decoder.decode([each.record for each in some]), strict=True):
            if isinstance(sample, UndecodableError):
                note_left_out(view, sample)
            elif sample.pose is not None and is_place(sample.pose.position):
                yield found, sample.pose.position


def note_left_out(view: View, error: UndecodableError) -> None:
    """Notes that there are poses which cannot be decoded, and why."""
    view.notes.complete = False
    view.notes.add(f"poses of {error.topic} left out, since they cannot be decoded: {error.reason}")


def pose_frame(view: View, topic: str) -> str:
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
