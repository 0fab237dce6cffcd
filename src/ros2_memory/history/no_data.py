"""Errors of questions that have no answer: why there is none, and what to ask instead."""

from __future__ import annotations

import math
import re
from contextlib import suppress
from itertools import chain
from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.silences import LONGEST_OFF_NS
from ros2_memory.bag_dir.layout import is_derived, is_thinned
from ros2_memory.bag_dir.state_files import excluded_between, read_losses
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
from ros2_memory.history.context import short_name
from ros2_memory.history.coverage import (
    being_written,
    gap_around,
    note_unread,
    note_unrecorded,
    seconds,
    unix_text,
    was_removed,
    why_nothing,
)
from ros2_memory.index.file_state import HELD_BACK
from ros2_memory.index.recordings import is_named_after_folder

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ros2_memory.history.stored_message import StoredMessage
    from ros2_memory.history.view import View
    from ros2_memory.index.snapshot import Snapshot

GIVE_TOPIC: Final = "give topic where the tool takes it"
_DEFAULT_POSES: Final = "/odom"
"""`data.pose_topic` where nobody chose another."""
_OF_OTHERS: Final = re.compile(r"(?i)goal|target|click|initial_?pose|waypoint|plan|marker")
"""Names of topics whose poses are not those of the robot."""
MOST_TRIED: Final = 20
"""Topics of unknown content that are looked into for poses."""
_NEAR_NS: Final = 60 * NS_PER_S
"""An older message may stand in for a missing one; farther back it says nothing about the time."""
_CLOCKS_DIFFER_NS: Final = 60 * NS_PER_S
"""A time that is later than now by no more may be now by the clock of who asks."""
ON_DISK_S: Final = 3
"""A message that the recorder received longer ago is on disk, as small as its chunks are."""


def resolve_topic(view: View, name: str) -> str:
    """Returns the recorded topic of a name; a missing or extra leading slash is accepted.

    Raises:
        NoDataError: `topic_not_recorded` with the nearest names, or `empty_memory`.
    """
    topics = view.timeline.topics()
    for candidate in (name, f"/{name}", name.removeprefix("/")):
        if candidate in topics:
            return candidate
    raise not_recorded(view, name)


def only_pose_topic(view: View, what: str = "position", *, degrees: bool = False) -> str | None:
    """Returns the only topic with the robot's poses where `data.pose_topic` is not recorded.

    With `degrees` that of the only satellite receiver, if there is none with poses. None where
    there is more than one, or somebody chose `data.pose_topic`; goals and clicked points do not
    count.
    """
    configured = view.limits.pose_topic
    if configured != _DEFAULT_POSES or configured in view.timeline.topics():
        return None
    topics = topics_of_robot(view, what)
    if not topics and degrees:
        topics = topics_of_robot(view, "geodetic")
    return topics[0] if len(topics) == 1 else None


def topics_of_robot(view: View, what: str) -> list[str]:
    """Returns the names of `topics_with`, without goals and points that somebody clicked."""
    names = dict.fromkeys(named.partition(" ")[0] for named in topics_with(view, what))
    return [topic for topic in names if not _OF_OTHERS.search(topic)]


def has_poses(view: View) -> bool:
    """Whether a topic has the robot's poses; `View.has_poses` remembers it."""
    extractor = view.extractor
    # Asked first, and cheap: of other topics it takes longer to know.
    for type_name in view.timeline.types_of(view.limits.pose_topic):
        if not extractor.is_mapped(type_name) or "position" in extractor.kinds_of(type_name):
            return True
    return bool(topics_of_robot(view, "position") or topics_that_show(view))


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
        name: the topic that was asked for; None for `data.pose_topic`, or with a note for the only
            other one that there is.
        what: "position" or "velocity".
        degrees: whether the latitude and longitude of a satellite receiver answer too.

    Raises:
        NoDataError: as for `resolve_topic`; where the configured topic is not recorded the sentence
            names those that carry poses, or else what the bags have in their place.
    """
    if name is not None:
        return resolve_topic(view, name)
    configured = view.limits.pose_topic
    only = only_pose_topic(view, what, degrees=degrees)
    if only is not None:
        view.notes.add(
            f"by {only}, the only topic for it: data.pose_topic is {configured}, which these bags "
            "do not have"
        )
        return only
    try:
        return resolve_topic(view, configured)
    except NoDataError as error:
        where = _where_it_is(view, what, degrees=degrees)
        if error.reason is not NoDataReason.TOPIC_NOT_RECORDED or where is None:
            raise
        detail = f"data.pose_topic is {configured}, which these bags do not have{where}"
        raise NoDataError(error.reason, detail, error.notes) from error


def _where_it_is(view: View, what: str, *, degrees: bool) -> str | None:
    """Returns where positions or velocities are in bags without `data.pose_topic`, and the setting.

    Else what the bags have in their place; None where they have nothing like it.
    """
    those = {"position": "poses", "velocity": "velocities"}[what]
    topics = topics_with(view, what)
    if not topics and what == "position":
        topics = topics_that_show(view)
    if topics:
        which = topics[0].partition(" ")[0] if len(topics) == 1 else "to one of them"
        return (
            f"; {those} are on {listed(topics)}: set data.pose_topic"
            f"{'=' if len(topics) == 1 else ' '}{which}, or {GIVE_TOPIC}"
        )
    if what == "position" and (
        fixes := topics_with(view, "geodetic") or topics_that_show(view, "geodetic")
    ):
        advice = "give topic" if degrees else "get_position_at answers them by topic"
        return (
            ", nor another with poses in metres; latitude and longitude are on "
            f"{listed(fixes)}: {advice}"
        )
    if what == "velocity" and (posed := topics_with(view, "position") or topics_that_show(view)):
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


def topics_that_show(view: View, what: str = "position") -> list[str]:
    """Returns topics of types outside the schema map whose newest message has a pose.

    Or latitude and longitude, if `what` is "geodetic". Each with its type behind it, of at most
    `MOST_TRIED` topics: for an error alone.
    """
    extractor, timeline = view.extractor, view.timeline
    unmapped = [
        topic
        for topic in timeline.topics()
        if not any(extractor.is_mapped(type_name) for type_name in timeline.types_of(topic))
    ]
    shown = []
    for topic in unmapped[:MOST_TRIED]:
        # What a lake does not hold, as images, shows nothing.
        with suppress(NoDataError, NotInLakeError):
            newest = view.stream.first((topic,), TimeWindow.everything(), newest_first=True)
            if newest is None:
                continue
            message, type_name = decode(view, newest), newest.type
            if what == "geodetic":
                is_shown = extractor.geodetic(message, type_name) is not None
            else:
                pose = extractor.pose(message, type_name)
                is_shown = pose is not None and pose.orientation is not None
            if is_shown:
                shown.append(f"{topic} ({newest.type})")
    return shown


def topics_with(view: View, what: str) -> list[str]:
    """Returns the recorded topics of types that carry `position`, `velocity` or `geodetic`.

    Each with its type behind it. What types that are not in the schema map carry is not known.
    """
    kinds_of, types = view.extractor.kinds_of, view.timeline.types
    all_types = set(chain(*types.values()))
    carriers = {type_name for type_name in all_types if what in kinds_of(type_name)}
    return [
        f"{topic} ({type_name})"
        for topic, names in types.items()
        for type_name in names
        if type_name in carriers
    ]


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
    """Returns the sentence on a bag directory in which no bag answers."""
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
        NoDataError: `empty_memory`, or `not_closed_yet` where splits are there that do not answer.
    """
    snapshot = view.snapshot
    if snapshot.bags:
        return
    if snapshot.active:
        lack, after_s = nothing_here(snapshot), view.limits.closed_after_s
        if _active_answers(view):
            lack, after_s = "nothing of the first split is on disk yet", ON_DISK_S
        raise NoDataError(NoDataReason.NOT_CLOSED_YET, f"{lack}; ask again in {after_s:g} s")
    why = [snapshot.problem or "the bag directory contains no bag with messages"]
    if snapshot.damaged:
        why.append(f"{counted(len(snapshot.damaged), 'damaged file')} set aside")
    if snapshot.unread:
        why.append(f"{counted(len(snapshot.unread), 'file')} of a kind that is not read here")
    raise NoDataError(
        NoDataReason.EMPTY_MEMORY, f"{'; '.join(why)}; data_time_range lists the files"
    )


def not_recorded(view: View, name: str) -> NoDataError:
    """Returns the error for a topic of which no closed bag holds a message.

    Raises:
        NoDataError: nothing is recorded at all.
    """
    require_bags(view)
    snapshot, names = view.snapshot, {name, f"/{name}"}
    reason = NoDataReason.TOPIC_NOT_RECORDED
    if not names.isdisjoint(_cut_topics(view, TimeWindow.everything())):
        reason, detail = NoDataReason.DELETED, f"every message of {name} was deleted"
    elif not names.isdisjoint(snapshot.silent_topics):
        detail = f"{name} is declared in the bags, but no message of it was recorded"
    else:
        detail = f"no topic {name} is recorded"
    topics, stem = snapshot.timeline.topics(), name.rstrip("/").rpartition("/")[2].strip("*")
    near = similar(name, topics, 5) or similar(stem, topics, 5)
    hint = f"similar: {', '.join(near)}" if near else "list_recorded_topics lists all"
    error = NoDataError(reason, f"{detail}; {hint}")
    return with_notes(view, TimeWindow.everything(), error)


def no_data_at(
    view: View,
    topics: tuple[str, ...],
    at: Ns,
    tolerance: Ns | None,
    around: Ns | None = None,
    *,
    deleted: bool = False,
) -> NoDataError:
    """Returns the error for no message of these topics at a moment or within a tolerance before.

    With `around`, neither so long after it. `deleted`: one may have been deleted. The sentence
    names the nearest older and newer message with their distances, and what to do.
    """
    older, newer, elsewhere, is_between = _nearest(
        view, topics, TimeWindow(at, at + 1), (at, at + 1)
    )
    when = "at or before" if tolerance is None else f"within {seconds(tolerance)} before"
    if around is not None:
        when = f"within {seconds(around)} of"
    before = tolerance if around is None else around
    start = MIN_NS if before is None else max(at - before, MIN_NS)
    window = TimeWindow(start, min(at + (around or 0) + 1, MAX_NS))
    reason, why = between(view, window) if is_between else beyond(view, at), list[str]()
    if older and newer and around is None and reason is NoDataReason.GAP:
        reason, why = _within_recording(view, older, newer)
    excluded = excluded_between(view.bag_dir, at, at + 1)
    if (
        deleted
        or excluded
        or _cut_topics(view, window).issuperset(topics)
        or _is_thinned(view, TimeWindow(at, at + 1))
    ):
        reason = NoDataReason.DELETED
    detail = [
        f"no message of {' or '.join(topics)} {when} {unix_text(at)}",
        *elsewhere,
        *_distances(at, older, newer, tolerance),
        *why,
        *_advice(view, reason, at),
    ]
    is_near = older and tolerance is not None and at - older.time <= max(_NEAR_NS, 2 * tolerance)
    if older and is_near and not _to_come(view, at):
        enough = math.ceil(unix_from_ns(at - older.time) * 1000) / 1000
        detail.append(f"to accept the older one, ask with tolerance_s of at least {enough:.3f}")
    return with_notes(view, window, NoDataError(reason, "; ".join(detail)))


def _distances(
    at: Ns, older: StoredMessage | None, newer: StoredMessage | None, tolerance: Ns | None
) -> Iterator[str]:
    """Yields how far the nearest messages are from a moment."""
    if older:
        ago = seconds(at - older.time)
        if tolerance is not None and ago == seconds(tolerance):
            # Rounded it would read as near enough.
            ago = f"{unix_from_ns(at - older.time):.6f} s"
        yield f"the nearest older one is {ago} before it, at {unix_text(older.time)}"
    if newer:
        later = seconds(newer.time - at)
        yield f"the nearest newer one is {later} after it, at {unix_text(newer.time)}"


def _cut_topics(view: View, window: TimeWindow) -> set[str]:
    """Returns the topics of which messages of a window were cut out of bags.

    By `retention.topics`, or by request.
    """
    losses = read_losses(view.bag_dir, window.start, window.stop)
    return {loss.topic for loss in losses if loss.by in {"expired", "forgotten"}}


def _is_thinned(view: View, window: TimeWindow) -> bool:
    """Whether of some time of a window only some messages stayed, and something was recorded."""
    times = view.snapshot.timeline.thinned_times
    return overlaps_any(times, window.start, window.stop - 1) and not view.gaps(window)


def _within_recording(
    view: View, older: StoredMessage, newer: StoredMessage
) -> tuple[NoDataReason, list[str]]:
    """Returns why there is no message between two that follow each other, and a sentence on it."""
    if is_thinned(older.bag.file) and not view.gaps(TimeWindow(older.time + 1, newer.time)):
        why = "of that time only some messages stayed: retention deleted the others"
        return NoDataReason.DELETED, [why]
    pace = view.timeline.pace(older.topic, older.bag.recording).topic
    period = (pace.last - pace.first) // max(pace.messages - 1, 1)
    if newer.time - older.time <= 2 * period:
        pace_text = f"the topic has a message every {seconds(period)}"
        return NoDataReason.BETWEEN_MESSAGES, [pace_text]
    return NoDataReason.GAP, []


def no_data_between(view: View, topics: tuple[str, ...], window: TimeWindow) -> NoDataError:
    """Returns the error for no message of these topics in a window."""
    older, newer, elsewhere, is_between = _nearest(
        view, topics, window, (window.start - 1, window.stop)
    )
    start, end = window.asked()
    names = " or ".join(topics)
    detail = [f"no message of {names} between {unix_text(start)} and {unix_text(end)}", *elsewhere]
    if older:
        detail.append(f"the last one before is at {unix_text(older.time)}")
    if newer:
        detail.append(f"the first one after is at {unix_text(newer.time)}")
    newest = min(end, max(start, view.memory.clock.now()))
    reason = between(view, window) if is_between else beyond(view, newest)
    if _cut_topics(view, window).issuperset(topics) or _is_thinned(view, window):
        reason = NoDataReason.DELETED
    detail += _advice(view, reason, start)
    return with_notes(view, window, NoDataError(reason, "; ".join(detail)))


def require_recorded(view: View, asked: TimeWindow) -> None:
    """Checks that some of a window was recorded: else "never" and "none" would be false.

    An end that is open is `MIN_NS` or `MAX_NS`. Where the start is not, a note says how much of the
    window was not recorded.

    Raises:
        NoDataError: nothing of it was.
    """
    lies_in = gap_around(view, asked)
    if lies_in is None:
        if asked.start > MIN_NS:
            note_unrecorded(view, asked)
        return
    start, end = asked.asked()
    first, last = lies_in
    if asked.start <= MIN_NS:
        when = f"up to {unix_text(end)}"
    elif asked.stop >= MAX_NS:
        when = f"after {unix_text(start)}"
    else:
        when = f"between {unix_text(start)} and {unix_text(end)}"
    detail = [why_nothing(when, deleted=was_removed(view, asked))]
    if first is not None and last is not None:
        detail.append(f"there is a gap from {unix_text(first)} to {unix_text(last)}")
        reason = between(view, asked)
    else:
        reason = beyond(view, start)
    detail += _advice(view, reason, start)
    raise with_notes(view, asked, NoDataError(reason, "; ".join(detail)))


def with_notes(view: View, window: TimeWindow, error: NoDataError) -> NoDataError:
    """Returns the error with all notes, also on what of a window without an answer was not read."""
    note_unread(view, window, nothing=True)
    return NoDataError(error.reason, error.detail, view.notes.sentences())


def _nearest(
    view: View, topics: tuple[str, ...], window: TimeWindow, ends: tuple[Ns, Ns]
) -> tuple[StoredMessage | None, StoredMessage | None, list[str], bool]:
    """Returns the last message up to one of the ends (log time), and the first from the other on.

    Where the recordings of the window have none of the topics, without messages of another time
    altogether, as of another robot's bag, and with a sentence on it. At last whether there are
    messages on both sides, of whatever time.
    """
    until, since = ends
    nearest = (
        view.stream.first(topics, TimeWindow.until(until), newest_first=True),
        view.stream.first(topics, TimeWindow(since, MAX_NS)),
    )
    elsewhere = _only_elsewhere(view, topics, window)
    older, newer = (
        stored
        if not elsewhere or (stored is not None and abs(stored.time - at) <= LONGEST_OFF_NS)
        else None
        for stored, at in zip(nearest, (window.start, window.stop), strict=True)
    )
    return older, newer, elsewhere, all(nearest)


def _only_elsewhere(view: View, topics: tuple[str, ...], window: TimeWindow) -> list[str]:
    """Returns a sentence where the recordings of a window have none of these topics at all.

    It names topics there that carry what these do (poses, velocities). In a folder with the bags of
    several robots, the nearest message of a topic may be another robot's.
    """
    if _cut_topics(view, window).issuperset(topics):
        return []
    timeline, whole = view.timeline, view.snapshot.metadata_folders
    names: dict[str, None] = {}
    held: set[str] = set()
    for bag in timeline.overlapping(window):
        if is_derived(bag.file):
            continue
        held.update(bag.summary.schema.positions)
        if is_named_after_folder(bag.file) or str(bag.recording) in whole:
            if any(bag.recording in timeline.recordings(topic) for topic in topics):
                return []
            names[bag.recording.name] = None
        else:
            names[short_name(bag.path)] = None
    if not names or not held.isdisjoint(topics):
        return []
    alike = _alike(view, topics, held)
    verb = "has" if len(names) == 1 else "have"
    recordings = counted(len(names), "recording").removeprefix("1 ")
    sentence = f"the {recordings} of that time, {listed(sorted(names))}, {verb} no such topic"
    return [sentence + (f"; similar there: {listed(alike)}; give topic" if alike else "")]


def _alike(view: View, topics: tuple[str, ...], held: set[str]) -> list[str]:
    """Returns which of the `held` topics carry all that some topics do, or else some of it."""

    def carried(*topics: str) -> set[str]:
        types = chain.from_iterable(map(view.timeline.types_of, topics))
        return set(chain.from_iterable(map(view.extractor.kinds_of, types)))

    wanted = carried(*topics)
    similar = [topic for topic in sorted(held) if carried(topic) & wanted]
    return [topic for topic in similar if carried(topic) >= wanted] or similar


def between(view: View, window: TimeWindow) -> NoDataReason:
    """Returns why a window with messages on both sides has none.

    While one recording takes over from another, the older one may not be on disk as far as the
    newer one begins: what lies between is no gap.
    """
    if being_written(view.snapshot, window):
        return NoDataReason.NOT_CLOSED_YET
    return NoDataReason.DELETED if was_removed(view, window) else NoDataReason.GAP


def beyond(view: View, at: Ns) -> NoDataReason:
    """Returns why a moment with no message on one of its sides has no answer."""
    latest = view.snapshot.latest
    if latest is not None and at > latest and view.snapshot.active and not _to_come(view, at):
        return NoDataReason.NOT_CLOSED_YET
    return NoDataReason.OUTSIDE_RANGE


def _to_come(view: View, at: Ns) -> list[str]:
    """Returns a sentence for a moment that is later than now by more than two clocks differ."""
    now = view.memory.clock.now()
    if at <= now + _CLOCKS_DIFFER_NS:
        return []
    return [f"the time asked is {seconds(at - now)} in the future: it is {unix_text(now)} now"]


def undecodable(error: UndecodableError) -> NoDataError:
    """Returns the error for messages that are there, and that cannot be decoded."""
    return NoDataError(
        NoDataReason.UNDECODABLE,
        f"messages of {error.topic} ({error.type_name}) are recorded but cannot be decoded: "
        f"{error.reason}",
    )


def decode(view: View, stored: StoredMessage) -> object:
    """Returns the decoded message.

    Raises:
        NoDataError: it cannot be decoded.
    """
    try:
        return view.memory.reader.decode(stored.record)
    except UndecodableError as error:
        raise undecodable(error) from error


def describe_lack(view: View, what: str, stored: StoredMessage) -> str:
    """Returns the sentence on a topic whose type does not carry the `what` that was asked for."""
    has = f"carries no {what}"
    if view.extractor.geodetic(view.bags.decode(stored), stored.type) is not None:
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
    """Whether files that are being written answer, as far as they are on disk."""
    return all(aside.answers for aside in view.snapshot.active)


def _advice(view: View, reason: NoDataReason, at: Ns) -> Iterator[str]:
    """Yields what may help who asked about a moment and later."""
    earliest, latest = view.snapshot.earliest, view.snapshot.latest
    if earliest is not None and latest is not None:
        yield f"the memory covers {unix_text(earliest)} to {unix_text(latest)}"
    if reason is NoDataReason.NOT_CLOSED_YET and _active_answers(view):
        yield f"ask about an earlier moment, or again in {ON_DISK_S} s"
    elif reason is NoDataReason.NOT_CLOSED_YET:
        yield (
            "the split being written is not read until it closes: ask about an earlier moment, "
            f"or again in {view.limits.closed_after_s:g} s"
        )
    yield from _to_come(view, at)
