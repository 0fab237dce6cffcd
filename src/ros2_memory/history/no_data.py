"""Errors of questions that have no answer: why there is none, and what to ask instead."""

from __future__ import annotations

import math
import re
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.layout import is_thinned
from ros2_memory.bag_dir.state_files import excluded_between
from ros2_memory.core.errors import NoDataError, NoDataReason, NotInLakeError, UndecodableError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import overlaps_any
from ros2_memory.core.text import counted, listed, match_topics, similar
from ros2_memory.core.timebase import (
    MAX_NS,
    MIN_NS,
    NS_PER_S,
    Ns,
    unix_from_ns,
)
from ros2_memory.history.coverage import (
    being_written,
    cut_spans,
    gap_around,
    note_unread,
    note_unrecorded,
    seconds,
    unix_text,
    was_removed,
    why_nothing,
)
from ros2_memory.history.lasting import held_at, is_text, still_holds
from ros2_memory.index.file_state import HELD_BACK

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from ros2_memory.history.bag_access import StoredMessage
    from ros2_memory.history.context import Memory
    from ros2_memory.history.view import View
    from ros2_memory.index.snapshot import Snapshot

GIVE_TOPIC: Final = "give topic where the tool takes it"
_DEFAULT_POSES: Final = "/odom"
"""The default of `data.pose_topic`."""
_OF_FLEET: Final = " (for a fleet: fleet.pose_topics)"
_ODOMETRY: Final = (_DEFAULT_POSES, "/odometry/filtered", "/odometry/local")
"""The ends of names of odometry, also of the package robot_localization."""
_OF_OTHERS: Final = re.compile(r"(?i)goal|target|click|initial_?pose|waypoint|plan|marker")
"""Matches names of topics whose poses are not the robot's."""
_MOST_TRIED: Final = 20
"""At most this many topics of unmapped types are looked into for poses."""
_BEST_POSES: Final = {
    "position": " (best to odometry that no localisation corrects)",
    "velocity": "",
}
"""Corrections move a robot that stands, and are not distinguished from a path."""
_NEAR_NS: Final = 60 * NS_PER_S
"""A message that is older by no more may stand in for a missing one."""
_CLOCKS_DIFFER_NS: Final = 60 * NS_PER_S
"""A time that is later than now by no more may be now by the clock of the client."""
_ON_DISK_S: Final = 3
"""A received message is on disk after this time: the recorder's chunks are small."""


def resolve_topic(view: View, name: str) -> str:
    """Returns the recorded topic with a name, with or without its leading slash.

    Raises:
        NoDataError: `topic_not_recorded` with the nearest names, or `empty_memory`.
    """
    topics = view.timeline.topics()
    for candidate in (name, f"/{name}", name.removeprefix("/")):
        if candidate in topics:
            return candidate
    raise not_recorded(view, name)


def only_pose_topic(view: View, what: str = "position", *, degrees: bool = False) -> str | None:
    """Returns the only topic with the robot's poses, if `data.pose_topic` is not recorded.

    Of several topics it is the only odometry in a namespace, if the others are of the same robot.
    With `degrees`, the only topic of a satellite receiver if no topic has poses. None if there is
    more than one topic, or if somebody set `data.pose_topic`.
    """
    configured = view.limits.pose_topic
    if configured != _DEFAULT_POSES or configured in view.timeline.topics():
        return None
    topics = topics_of_robot(view, what)
    if not topics and degrees:
        topics = topics_of_robot(view, "geodetic")
    if len(topics) > 1:
        topics = _odometry_of_one_robot(topics)
    return topics[0] if len(topics) == 1 else None


def _odometry_of_one_robot(topics: Sequence[str]) -> list[str]:
    """Returns the odometry if all topics are in its namespace, or in none."""
    named = {topic: end for topic in topics for end in _ODOMETRY if topic.endswith(end)}
    spaces = tuple(topic.removesuffix(end) + "/" for topic, end in named.items())
    are_of_one = all(topic.startswith(spaces) or topic.rfind("/") <= 0 for topic in topics)
    return [*named] if are_of_one else []


def topics_of_robot(view: View, what: str) -> list[str]:
    """Returns the topics that carry `what` of the robot, without goals and clicked points.

    `what` is as in `topics_with`.
    """
    return [
        topic
        for topic in _types_with(view, what)
        if topic.endswith(_DEFAULT_POSES) or not _OF_OTHERS.search(topic)
    ]


def resolve_pose_topic(
    view: View,
    name: str | None = None,
    what: str = "position",
    *,
    degrees: bool = False,
) -> str:
    """Returns the recorded topic for a question about the robot's motion.

    Args:
        view: what is recorded.
        name: the topic that was asked for; None for `data.pose_topic`, or, with a note, for
            `only_pose_topic`.
        what: "position" or "velocity".
        degrees: whether the latitude and longitude of a satellite receiver answer too.

    Raises:
        NoDataError: as for `resolve_topic`. If the configured topic is not recorded, the sentence
            names topics with poses, or what the bags have instead.
    """
    if name is not None:
        return resolve_topic(view, name)
    configured = view.limits.pose_topic
    only = only_pose_topic(view, what, degrees=degrees)
    if only is not None:
        thing = "odometry" if len(topics_of_robot(view, what)) > 1 else "topic for it"
        view.notes.add(
            f"by {only}, the only {thing}: data.pose_topic is {configured}, which these "
            "bags do not have"
        )
        return only
    try:
        return resolve_topic(view, configured)
    except NoDataError as error:
        alternative = _describe_alternative(view, what, degrees=degrees)
        if error.reason is not NoDataReason.TOPIC_NOT_RECORDED or alternative is None:
            raise
        detail = f"data.pose_topic is {configured}, which these bags do not have{alternative}"
        raise NoDataError(error.reason, detail, error.notes) from error


def _describe_alternative(view: View, what: str, *, degrees: bool) -> str | None:
    """Returns a clause on other topics with positions or velocities, or on the nearest substitute.

    None if there is no substitute either.
    """
    those = {"position": "poses", "velocity": "velocities"}[what]
    topics = topics_with(view, what)
    if not topics and what == "position":
        topics = unmapped_topics_with(view)
    if topics:
        name, _, _ = topics[0].partition(" ")
        value = f"={name}" if len(topics) == 1 else f"{_OF_FLEET} to one of them{_BEST_POSES[what]}"
        if what == "position" and len(topics) > 1 and view.moving_topics:
            value += f", or to {view.moving_topics[0]} to place the robot by transforms"
        return f"; {those} are on {listed(topics)}: set data.pose_topic{value}, or {GIVE_TOPIC}"
    if what == "position" and (
        fixes := topics_with(view, "geodetic") or unmapped_topics_with(view, "geodetic")
    ):
        advice = "give topic" if degrees else "get_position_at answers them by topic"
        return (
            ", nor another with poses in metres; latitude and longitude are on "
            f"{listed(fixes)}: {advice}"
        )
    if what == "velocity" and (
        posed := topics_with(view, "position") or unmapped_topics_with(view)
    ):
        return (
            f", nor another with velocities; poses are on {listed(posed)}: trajectory_summary "
            "returns speeds from them, by topic"
        )
    if moving := view.moving_topics:
        return (
            f", nor another with {those}; transforms are on {listed(moving)}: get_position_at "
            "and trajectory_summary answer by them, get_transform_at returns the pose of one frame "
            "in another, and list_frames lists the frames"
        )
    if what == "velocity" and topics_with(view, "geodetic"):
        return ", nor another with velocities"
    return None


def describe_earlier_poses(view: View, topic: str, before: Ns) -> str:
    """Returns a clause on what has poses until a moment before the first message of `topic`."""
    until = TimeWindow(MIN_NS, before)

    def is_heard(name: str) -> bool:
        return any(view.timeline.extents(name, until))

    topics = [*topics_of_robot(view, "position"), *view.moving_topics]
    earlier = [*filter(is_heard, topics)]
    if is_heard(topic) or not earlier:
        return ""
    return f"; before its first message poses are on {listed(earlier)}: {GIVE_TOPIC}"


def unmapped_topics_with(view: View, what: str = "position") -> list[str]:
    """Returns topics of types outside the schema map whose newest message has a pose.

    Or, if `what` is "geodetic", latitude and longitude. Each is followed by its type. At most
    `_MOST_TRIED` topics are read.
    """
    extractor, timeline = view.extractor, view.timeline
    unmapped = [
        topic
        for topic in timeline.topics()
        if not any(extractor.is_mapped(type_name) for type_name in timeline.types_of(topic))
    ]
    topics = []
    for topic in unmapped[:_MOST_TRIED]:
        # A message cannot be decoded, or a lake does not hold it, as an image.
        with suppress(NoDataError, NotInLakeError):
            newest = view.stream.last(topic)
            if newest is None:
                continue
            message, type_name = require_decoded(view, newest), newest.type
            if what == "geodetic":
                has_it = extractor.geodetic(message, type_name) is not None
            else:
                pose = extractor.pose(message, type_name)
                has_it = pose is not None and pose.orientation is not None
            if has_it:
                topics.append(f"{topic} ({type_name})")
    return topics


def topics_with(view: View, what: str) -> list[str]:
    """Returns the recorded topics that carry `position`, `velocity` or `geodetic`.

    Each is followed by its type. Types outside the schema map are not looked into.
    """
    return [
        f"{topic} ({type_name})"
        for topic, type_names in _types_with(view, what).items()
        for type_name in type_names
    ]


def _types_with(view: View, what: str) -> dict[str, list[str]]:
    """Returns by topic its types that carry `what`."""
    carried: dict[str, list[str]] = {}
    for topic, names in view.timeline.types.items():
        for name in names:
            if what in view.extractor.kinds_of(name):
                carried.setdefault(topic, []).append(name)
    return carried


def matching_topics(view: View, pattern: str) -> tuple[str, ...]:
    """Returns the recorded topics that match a name or glob (`/vision/*/scene_objects`).

    Raises:
        NoDataError: none does.
    """
    if not any(mark in pattern for mark in "*?["):
        return (resolve_topic(view, pattern),)
    matched = tuple(match_topics(view.timeline.topics(), pattern))
    if not matched:
        raise not_recorded(view, pattern)
    return matched


def nothing_here(snapshot: Snapshot) -> str:
    """Returns the sentence on a bag directory without a bag that answers."""
    held_splits = [split for split in snapshot.active if split.reason == HELD_BACK]
    if held_splits:
        splits = counted(len(held_splits), "split")
        return f"no bag is served yet: recording.exclude_when has still to be applied to {splits}"
    if snapshot.active:
        return "there is no closed bag yet: the first one is still being written"
    if snapshot.empty:
        bags = counted(len(snapshot.empty), "bag holds", "bags hold")
        return f"no message is recorded here: {bags} none"
    if snapshot.damaged or snapshot.unread:
        return "no bag here can be read"
    return "no bag is here: nothing is recorded yet, or it is recorded elsewhere"


def require_bags(view: View) -> None:
    """Checks that the memory holds something.

    Raises:
        NoDataError: `empty_memory`, or `not_closed_yet` if there are only splits being written.
    """
    snapshot = view.snapshot
    if snapshot.bags:
        return
    if snapshot.active:
        is_read = _active_answers(view)
        lack = "nothing of the first split is on disk yet" if is_read else nothing_here(snapshot)
        raise NoDataError(NoDataReason.NOT_CLOSED_YET, f"{lack}; ask again {_when_read(view)}")
    why = [snapshot.problem or "the bag directory contains no bag with messages"]
    if snapshot.damaged:
        why.append(f"{counted(len(snapshot.damaged), 'damaged file')} set aside")
    if snapshot.unread:
        why.append(f"{counted(len(snapshot.unread), 'file')} of a kind that is not read here")
    raise NoDataError(
        NoDataReason.EMPTY_MEMORY, f"{'; '.join(why)}; data_time_range lists the files"
    )


def not_recorded(view: View, name: str) -> NoDataError:
    """Returns the error for a topic without a message in any bag.

    Raises:
        NoDataError: nothing is recorded at all.
    """
    require_bags(view)
    snapshot, names, everything = view.snapshot, {name, f"/{name}"}, TimeWindow.everything()
    reason = NoDataReason.TOPIC_NOT_RECORDED
    if any(cut_spans(view.bag_dir, topic, everything) for topic in names):
        reason, detail = NoDataReason.DELETED, f"every message of {name} was deleted"
    elif not names.isdisjoint(snapshot.silent_topics):
        detail = f"{name} is declared in the bags, but no message of it was recorded"
    else:
        detail = f"no topic {name} is recorded"
    topics, stem = snapshot.timeline.topics(), name.rstrip("/").rpartition("/")[2].strip("*")
    near = similar(name, topics, 5) or similar(stem, topics, 5)
    hint = f"similar: {', '.join(near)}" if near else "list_recorded_topics lists all"
    error = NoDataError(reason, f"{detail}; {hint}")
    return with_notes(view, everything, error)


def no_data_at(
    view: View,
    topics: tuple[str, ...],
    at: Ns,
    tolerance: Ns | None,
    around: Ns | None = None,
    *,
    deleted: bool = False,
) -> NoDataError:
    """Returns the error for no message of these topics near a moment.

    The sentence names the nearest messages, and what to do.

    Args:
        view: of the call.
        topics: of which there is no message.
        at: the moment.
        tolerance: how far before it a message would have counted (ns); None for any time before.
        around: how far before and after it a message would have counted; instead of `tolerance`.
        deleted: whether a message that would have counted may have been deleted.
    """
    this_moment = TimeWindow(at, at + 1)
    older, newer = _nearest(view, topics, at, at + 1)
    if around is not None:
        when, start, stop = f"within {seconds(around)} of", at - around, at + around + 1
    elif tolerance is not None:
        when, start, stop = f"within {seconds(tolerance)} before", at - tolerance, at + 1
    else:
        when, start, stop = "at or before", MIN_NS, at + 1
    window = TimeWindow(max(start, MIN_NS), min(stop, MAX_NS))
    why: list[str] = []
    if older is None or newer is None:
        reason = reason_beyond(view, at)
    else:
        reason = reason_between(view, window)
        is_in_gap = bool(view.gaps(this_moment, around=True))
        if not is_in_gap and view.gaps(this_moment, around=True, steps=True):
            why = ["the clock skipped this time, as it was set ahead"]
        elif around is None and reason is NoDataReason.GAP and not is_in_gap:
            reason, why = _reason_within_recording(view, older, newer)
    if (
        deleted
        or excluded_between(view.bag_dir, at, at + 1)
        or _are_cut(view, topics, window)
        or _is_thinned(view, this_moment)
    ):
        reason = NoDataReason.DELETED
    detail = [
        f"no message of {' or '.join(topics)} {when} {unix_text(at)}",
        *_distances(at, older, newer, tolerance),
        *why,
        *_advice(view, reason, at, topics),
    ]
    is_near = older and tolerance is not None and at - older.time <= max(_NEAR_NS, 2 * tolerance)
    holds_on = older and tolerance is not None and _may_hold_on(view, older, at)
    if older and (is_near or holds_on) and not _describe_future(view, at):
        detail.append(accepting(older, at))
    return with_notes(view, window, NoDataError(reason, "; ".join(detail)))


def accepting(older: StoredMessage, at: Ns) -> str:
    """Returns how to ask so that a message before a moment answers."""
    enough = math.ceil(unix_from_ns(at - older.time) * 1000) / 1000
    return f"to accept the older one, ask with tolerance_s of at least {enough:.3f}"


def _may_hold_on(view: View, older: StoredMessage, at: Ns) -> bool:
    """Returns whether a message is a text that may hold until a later moment.

    Such a topic says what a robot does when that changes.
    """
    return is_text(view, older.topic) and held_at(view, older.topic, at, states=True) is not None


def _distances(
    at: Ns, older: StoredMessage | None, newer: StoredMessage | None, tolerance: Ns | None
) -> Iterator[str]:
    """Yields how far the nearest messages are from a moment."""
    if older:
        ago = seconds(at - older.time)
        if tolerance is not None and ago == seconds(tolerance):
            # Rounded, it would read as if it were near enough.
            ago = f"{unix_from_ns(at - older.time):.6f} s"
        yield f"the nearest older one is {ago} before it, at {unix_text(older.time)}"
    if newer:
        later = seconds(newer.time - at)
        yield f"the nearest newer one is {later} after it, at {unix_text(newer.time)}"


def _are_cut(view: View, topics: Iterable[str], window: TimeWindow) -> bool:
    """Whether messages of all topics were cut out of a window, by request or retention."""
    return all(cut_spans(view.bag_dir, topic, window) for topic in topics)


def _is_thinned(view: View, window: TimeWindow) -> bool:
    """Whether a window lies partly in a thinned day, and not in a gap."""
    times = view.snapshot.timeline.thinned_times
    return overlaps_any(times, window.start, window.stop - 1) and not view.gaps(window)


def _reason_within_recording(
    view: View, older: StoredMessage, newer: StoredMessage
) -> tuple[NoDataReason, list[str]]:
    """Returns why there is no message between two consecutive ones, and sentences on that."""
    if is_thinned(older.bag.file) and not view.gaps(TimeWindow(older.time + 1, newer.time)):
        why = "of that time only some messages stayed: retention deleted the others"
        return NoDataReason.DELETED, [why]
    pace = view.timeline.pace(older.topic, older.recording).topic
    period = (pace.last - pace.first) // max(pace.messages - 1, 1)
    if newer.time - older.time <= 2 * period:
        pace_text = f"the topic has a message every {seconds(period)}"
        return NoDataReason.BETWEEN_MESSAGES, [pace_text]
    return NoDataReason.GAP, []


def no_data_between(view: View, topics: tuple[str, ...], window: TimeWindow) -> NoDataError:
    """Returns the error for no message of these topics in a window."""
    older, newer = _nearest(view, topics, window.start - 1, window.stop)
    start, end = window.asked()
    detail = [
        f"no message of {' or '.join(topics)} between {unix_text(start)} and {unix_text(end)}"
    ]
    if older:
        holds = ", and holds: ask about a moment" if still_holds(view, older, start) else ""
        detail.append(f"the last one before is at {unix_text(older.time)}{holds}")
    if newer:
        detail.append(f"the first one after is at {unix_text(newer.time)}")
    if older and newer:
        reason = reason_between(view, window)
    else:
        reason = reason_beyond(view, min(end, max(start, view.memory.clock.now())))
    if _are_cut(view, topics, window) or _is_thinned(view, window):
        reason = NoDataReason.DELETED
    detail += _advice(view, reason, start, topics)
    return with_notes(view, window, NoDataError(reason, "; ".join(detail)))


def no_value_between(view: View, topic: str, field: str | None, window: TimeWindow) -> NoDataError:
    """Returns the error for a window in which a topic, or a field of it, had no value."""
    newest = view.stream.newest(topic, window)
    if newest is None:
        return no_data_between(view, (topic,), window)
    try:
        require_decoded(view, newest)
    except NoDataError as error:
        return with_notes(view, window, error)
    start, end = map(unix_text, window.asked())
    detail = f"no message of {topic} between {start} and {end} has {field or 'a value'}"
    return with_notes(view, window, NoDataError(NoDataReason.GAP, detail))


def require_recorded(view: View, asked: TimeWindow) -> None:
    """Checks that some of a window was recorded: else "never" and "none" would be false.

    An open end of the window is `MIN_NS` or `MAX_NS`. Unless its start is open, a note says how
    much of it was recorded.

    Raises:
        NoDataError: nothing was recorded in it.
    """
    gap = gap_around(view, asked)
    if gap is None:
        if asked.start > MIN_NS:
            note_unrecorded(view, asked)
        return
    start, end = asked.asked()
    first, last = gap
    if asked.start <= MIN_NS:
        when = f"up to {unix_text(end)}"
    elif asked.stop >= MAX_NS:
        when = f"after {unix_text(start)}"
    else:
        when = f"between {unix_text(start)} and {unix_text(end)}"
    detail = [why_nothing(when, deleted=was_removed(view, asked))]
    if first is not None and last is not None:
        detail.append(f"there is a gap from {unix_text(first)} to {unix_text(last)}")
        reason = reason_between(view, asked)
    else:
        reason = reason_beyond(view, start)
    detail += _advice(view, reason, start)
    raise with_notes(view, asked, NoDataError(reason, "; ".join(detail)))


def require_fields(view: View, topic: str, fields: Sequence[str], until: Ns) -> None:
    """Checks that the newest message of a topic before a log time has the fields.

    Raises:
        InvalidArgumentsError: the message lacks a field.
    """
    newest = view.stream.last(topic, until) if fields else None
    message = view.bags.decode(newest)
    if newest is not None and message is not None:
        view.extractor.shown(message, newest.type, fields)


def with_notes(view: View, window: TimeWindow, error: NoDataError) -> NoDataError:
    """Returns the error with all notes, also on unread data, and a step of the clock."""
    if any(at <= window.start and window.stop <= end for at, end in view.skipped_in(window)):
        view.elapsed_in(window)
    note_unread(view, window, nothing=True)
    return NoDataError(error.reason, error.detail, view.notes.sentences())


def _nearest(
    view: View, topics: tuple[str, ...], until: Ns, since: Ns
) -> tuple[StoredMessage | None, StoredMessage | None]:
    """Returns the last message up to a log time, and the first from another one on."""
    older = view.stream.first(topics, TimeWindow.until(until), newest_first=True)
    return older, view.stream.first(topics, TimeWindow(since, MAX_NS))


def reason_between(view: View, window: TimeWindow) -> NoDataReason:
    """Returns why a window with messages on both sides has none.

    It is no gap while one recording takes over from another: the older one may not be on disk up to
    where the newer one begins.
    """
    if being_written(view.snapshot, window):
        return NoDataReason.NOT_CLOSED_YET
    return NoDataReason.DELETED if was_removed(view, window) else NoDataReason.GAP


def reason_beyond(view: View, at: Ns) -> NoDataReason:
    """Returns why a moment without a message before it, or after it, has no answer."""
    latest = view.snapshot.latest
    is_recent = latest is not None and at > latest and not _describe_future(view, at)
    if is_recent and view.snapshot.active:
        return NoDataReason.NOT_CLOSED_YET
    return NoDataReason.OUTSIDE_RANGE


def _describe_future(view: View, at: Ns) -> list[str]:
    """Returns a sentence if a moment is later than now by more than clocks may differ."""
    now = view.memory.clock.now()
    if at <= now + _CLOCKS_DIFFER_NS:
        return []
    return [f"the time asked is {seconds(at - now)} in the future: it is {unix_text(now)} now"]


def undecodable(error: UndecodableError) -> NoDataError:
    """Returns the error for recorded messages that cannot be decoded."""
    return NoDataError(
        NoDataReason.UNDECODABLE,
        f"messages of {error.topic} ({error.type_name}) are recorded but cannot be decoded: "
        f"{error.reason}",
    )


def require_decoded(view: View, stored: StoredMessage) -> object:
    """Returns the decoded message.

    Raises:
        NoDataError: it cannot be decoded.
    """
    try:
        return view.memory.reader.decode(stored.record)
    except UndecodableError as error:
        raise undecodable(error) from error


def describe_lack(view: View, what: str, stored: StoredMessage) -> str:
    """Returns the sentence on a topic whose type does not carry `what`, with topics that do."""
    has, message = f"carries no {what}", view.bags.decode(stored)
    if hasattr(message, what):
        has += f" of a known kind (get_topic_in_range shows its field {what})"
    if view.extractor.geodetic(message, stored.type) is not None:
        has = f"carries latitude and longitude in degrees, and no {what} in metres"
    topics = topics_with(view, what)
    hint = f"such as {listed(topics)}" if topics else "such as one of type nav_msgs/msg/Odometry"
    if not topics and what == "velocity" and "position" in view.extractor.kinds_of(stored.type):
        return (
            f"topic: {stored.topic} is a {stored.type}, which {has}, and no topic recorded does; "
            "trajectory_summary returns speeds from its poses"
        )
    return f"topic: {stored.topic} is a {stored.type}, which {has}; give a topic that does, {hint}"


def _active_answers(view: View) -> bool:
    """Whether the complete chunks of files that are being written answer."""
    return all(aside.answers for aside in view.snapshot.active)


def _when_read(view: View) -> str:
    """Returns when what is being written answers, to end a sentence."""
    if _active_answers(view):
        return f"in {_ON_DISK_S} s"
    heartbeat = view.memory.heartbeat()
    if heartbeat is None and view.limits.kept is None:
        return "when its program has closed it (reader.include_active=true reads MCAP before that)"
    return f"in {view.limits.closed_after_s:g} s"


def are_unlisted(memory: Memory, topics: Sequence[str]) -> bool:
    """Returns whether a recorder runs whose list has none of the topics, or excludes these."""
    heartbeat = memory.heartbeat()
    if heartbeat is None or not heartbeat.is_live(memory.clock.now()):
        return False
    taken, excluded = set[str](), set[str]()
    for line in heartbeat.listed:
        excludes, name = line.startswith("not "), line.removeprefix("not ")
        (excluded if excludes else taken).update(match_topics(topics, name))
    return bool(heartbeat.listed) and taken <= excluded


def _advice(view: View, reason: NoDataReason, at: Ns, topics: Sequence[str] = ()) -> Iterator[str]:
    """Yields sentences on what to ask instead of a moment: of topics, or of all."""
    earliest, latest = view.snapshot.earliest, view.snapshot.latest
    if earliest is not None and latest is not None:
        yield f"the memory covers {unix_text(earliest)} to {unix_text(latest)}"
    if reason is NoDataReason.NOT_CLOSED_YET and topics and are_unlisted(view.memory, topics):
        yield (
            f"the recorder no longer records {listed(topics)} (recording.topics_file): ask about "
            "an earlier moment"
        )
    elif reason is NoDataReason.NOT_CLOSED_YET:
        if not _active_answers(view):
            yield "the split being written is not read until it closes"
        yield f"ask about an earlier moment, or again {_when_read(view)}"
    yield from _describe_future(view, at)
