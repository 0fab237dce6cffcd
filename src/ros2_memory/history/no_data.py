"""Why there is nothing to answer with, and what to ask instead."""

from __future__ import annotations

import math
from difflib import get_close_matches
from typing import TYPE_CHECKING, Final

from ros2_memory.core.errors import NoDataError, NoDataReason, UndecodableError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.text import counted, listed, match_topics
from ros2_memory.core.timebase import (
    MAX_NS,
    MIN_NS,
    Ns,
    unix_from_ns,
    unix_rounded_up,
)
from ros2_memory.history.coverage import may_be_written, note_unread

if TYPE_CHECKING:
    from ros2_memory.history.view import View


ON_DISK_S: Final = 3
"""A message that the recorder received longer ago is on disk, as small as its chunks are."""


def seconds(duration: Ns) -> str:
    """A duration for a sentence: to three digits, and never less exact than to the second."""
    length = unix_from_ns(duration)
    return f"{length:.0f} s" if length >= 100 else f"{length:.3g} s"


def moment(at: Ns) -> str:
    """A moment for a sentence: the Unix seconds that find it again."""
    return f"{unix_rounded_up(at):.6f}"


def resolve_topic(view: View, name: str) -> str:
    """The recorded topic that a question means; a missing or extra leading slash is forgiven.

    Raises:
        NoDataError: `topic_not_recorded` with the nearest names, or `empty_memory`.
    """
    topics = view.snapshot.topics()
    for candidate in (name, f"/{name}", name.removeprefix("/")):
        if candidate in topics:
            return candidate
    raise not_recorded(view, name)


def resolve_pose_topic(
    view: View, name: str | None = None, what: str = "position", *, degrees: bool = False
) -> str:
    """The recorded topic that a question about the robot's motion means.

    Args:
        view: what is recorded.
        name: the topic that was asked for; None for `data.pose_topic`.
        what: "position" or "velocity".
        degrees: whether the latitude and longitude of a satellite receiver answer too.

    Raises:
        NoDataError: as `resolve_topic`; where the configured topic is not recorded the sentence
            names those that carry poses.
    """
    if name is not None:
        return resolve_topic(view, name)
    configured = view.memory.limits.pose_topic
    try:
        return resolve_topic(view, configured)
    except NoDataError as error:
        if error.reason is not NoDataReason.TOPIC_NOT_RECORDED:
            raise
        those = topics_with(view, what)
        if not those and what == "position" and (fixes := topics_with(view, "geodetic")):
            told = (
                f"no topic {configured} is recorded, which data.pose_topic names, nor another with "
                f"poses in metres; latitude and longitude are on {listed(fixes)}"
            )
            advice = "give topic" if degrees else "get_position_at answers them by topic"
            raise NoDataError(error.reason, f"{told}: {advice}", error.notes) from error
        if not those:
            raise
        what = {"position": "poses", "velocity": "velocities"}[what]
        which = those[0].partition(" ")[0] if len(those) == 1 else "to one of them"
        told = (
            f"no topic {configured} is recorded, which data.pose_topic names; {what} are on "
            f"{listed(those)}: set data.pose_topic{'=' if len(those) == 1 else ' '}{which}, "
            "or give topic where the tool takes it"
        )
        raise NoDataError(error.reason, told, error.notes) from error


def topics_with(view: View, what: str) -> list[str]:
    """The recorded topics of types that carry a `position`, `velocity` or `geodetic` place.

    Each with its type behind it. What types that are not in the schema map carry is not known.
    """
    kinds_of = view.memory.extractor.kinds_of
    return [
        f"{topic} ({type_name})"
        for topic in view.snapshot.topics()
        for type_name in sorted(view.snapshot.types_of(topic))
        if what in kinds_of(type_name)
    ]


def matching_topics(view: View, pattern: str) -> tuple[str, ...]:
    """The recorded topics that a name or glob (`/vision/*/scene_objects`) means.

    Raises:
        NoDataError: none does.
    """
    if not any(mark in pattern for mark in "*?["):
        return (resolve_topic(view, pattern),)
    matched = tuple(match_topics(view.snapshot.topics(), pattern))
    if not matched:
        raise not_recorded(view, pattern)
    return matched


def require_bags(view: View) -> None:
    """Refuses a question to a memory that holds nothing.

    Raises:
        NoDataError: `empty_memory`, or `not_closed_yet` where the first split is being written.
    """
    snapshot = view.snapshot
    if snapshot.bags:
        return
    if snapshot.active:
        raise NoDataError(
            NoDataReason.NOT_CLOSED_YET,
            f"nothing of the first split is on disk yet; ask again in {ON_DISK_S} s"
            if _answering(view)
            else "the first split is still being written; ask again when it closes, in "
            f"{view.memory.limits.split_duration_s:g} s or less",
        )
    why = [snapshot.problem or "no bag with messages lies in the bag directory"]
    if snapshot.damaged:
        why.append(f"{counted(len(snapshot.damaged), 'damaged file')} set aside")
    if snapshot.unread:
        why.append(f"{counted(len(snapshot.unread), 'file')} of a kind that is not read here")
    raise NoDataError(
        NoDataReason.EMPTY_MEMORY, f"{'; '.join(why)}; data_time_range lists the files"
    )


def not_recorded(view: View, name: str) -> NoDataError:
    """No message of such a topic lies in any closed bag."""
    require_bags(view)
    snapshot = view.snapshot
    if name in snapshot.silent_topics or f"/{name}" in snapshot.silent_topics:
        told = f"{name} is declared in the bags, but not one message of it was recorded"
    else:
        told = f"no topic {name} is recorded"
    close = get_close_matches(name, snapshot.topics(), n=5, cutoff=0.6)
    if not close:
        stem = name.rstrip("/").rpartition("/")[2].strip("*")
        close = [topic for topic in snapshot.topics() if stem and stem in topic][:5]
    hint = f"similar: {', '.join(close)}" if close else "list_recorded_topics names all"
    note_unread(view, TimeWindow.everything(), nothing=True)
    return NoDataError(NoDataReason.TOPIC_NOT_RECORDED, f"{told}; {hint}", view.notes.sentences())


def no_data_at(
    view: View,
    topics: tuple[str, ...],
    at: Ns,
    tolerance: Ns | None,
    around: Ns | None = None,
) -> NoDataError:
    """No message of these topics at or shortly before a moment; with `around`, nor shortly after.

    The sentence names the nearest older and newer message with their distances, and what to do.
    """
    older = view.stream.first(topics, TimeWindow.until(at), newest_first=True)
    newer = view.stream.first(topics, TimeWindow(at + 1, MAX_NS))
    names = " or ".join(topics)
    when = "at or before" if tolerance is None else f"within {seconds(tolerance)} before"
    if around is not None:
        when = f"within {seconds(around)} of"
    told = [f"no message of {names} {when} {moment(at)}"]
    if older:
        told.append(
            f"the nearest older one is {seconds(at - older.time)} before it, at "
            f"{moment(older.time)}"
        )
    if newer:
        told.append(
            f"the nearest newer one is {seconds(newer.time - at)} after it, at {moment(newer.time)}"
        )
    before = tolerance if around is None else around
    start = TimeWindow.everything().start if before is None else max(at - before, MIN_NS)
    window = TimeWindow(start, min(at + (around or 0) + 1, MAX_NS))
    reason = between(view, window) if older and newer else beyond(view, at)
    acceptable = older.time if older and tolerance is not None else None
    told.append(_advice(view, reason, at, acceptable))
    note_unread(view, window, nothing=True)
    return NoDataError(reason, "; ".join(told), view.notes.sentences())


def no_data_between(view: View, topics: tuple[str, ...], window: TimeWindow) -> NoDataError:
    """No message of these topics in a window."""
    older = view.stream.first(topics, TimeWindow.until(window.start - 1), newest_first=True)
    newer = view.stream.first(topics, TimeWindow(window.stop, MAX_NS))
    names = " or ".join(topics)
    start, end = window.asked()
    told = [f"no message of {names} between {moment(start)} and {moment(end)}"]
    if older:
        told.append(f"the last one before is at {moment(older.time)}")
    if newer:
        told.append(f"the first one after is at {moment(newer.time)}")
    reason = between(view, window) if older and newer else beyond(view, end)
    told.append(_advice(view, reason, window.start, None))
    note_unread(view, window, nothing=True)
    return NoDataError(reason, "; ".join(told), view.notes.sentences())


def between(view: View, window: TimeWindow) -> NoDataReason:
    """Why a window with something on either of its sides has no answer.

    While one recording takes over from another, the older one may not be on disk as far as the
    newer one begins: what lies between is no gap.
    """
    written = may_be_written(view.snapshot, window)
    return NoDataReason.NOT_CLOSED_YET if written else NoDataReason.GAP


def beyond(view: View, at: Ns) -> NoDataReason:
    """Why a moment with nothing on one of its sides has no answer."""
    latest = view.snapshot.latest
    if latest is not None and at > latest and view.snapshot.active:
        return NoDataReason.NOT_CLOSED_YET
    return NoDataReason.OUTSIDE_RANGE


def undecodable(topic: str, type_name: str, error: UndecodableError) -> NoDataError:
    """Messages are there, but mean nothing to us."""
    return NoDataError(
        NoDataReason.UNDECODABLE,
        f"messages of {topic} ({type_name}) are recorded but cannot be decoded: {error.reason}",
    )


def undecodable_in(
    view: View, window: TimeWindow, topic: str, type_name: str, error: UndecodableError
) -> NoDataError:
    """As `undecodable`, of all that a window holds, with the notes on what else was not read."""
    note_unread(view, window, nothing=True)
    told = undecodable(topic, type_name, error)
    return NoDataError(told.reason, told.detail, view.notes.sentences())


def _answering(view: View) -> bool:
    """Whether what is being written answers, as far as it is on disk."""
    return all(aside.answers for aside in view.snapshot.active)


def _advice(view: View, reason: NoDataReason, at: Ns, older: Ns | None) -> str:
    snapshot = view.snapshot
    earliest, latest = snapshot.earliest, snapshot.latest
    advice = []
    if earliest is not None and latest is not None:
        advice.append(f"the memory reaches from {moment(earliest)} to {moment(latest)}")
    if reason is NoDataReason.NOT_CLOSED_YET:
        advice.append(
            f"ask about an earlier moment, or again in {ON_DISK_S} s"
            if _answering(view)
            else "the split being written does not answer until it closes: ask about an earlier "
            f"moment, or again in {view.memory.limits.split_duration_s:g} s"
        )
    if older is not None:
        enough = math.ceil(unix_from_ns(at - older) * 1000) / 1000
        advice.append(f"to accept the older one, ask with tolerance_s of at least {enough:.3f}")
    return "; ".join(advice)
