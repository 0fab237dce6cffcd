"""What a list of things leaves out, in sentences: silent detectors, and detections without a thing.

Those are too few, score too low, or could not be placed.
"""

from __future__ import annotations

import difflib
import re
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.conditions import Contains, Equals
from ros2_memory.analysis.sights import MAX_LABELS, MAX_SPOTS, SLICE_NS, Spot, Unplaced
from ros2_memory.core.arrays import Columns, Ints, distinct_rows, numbered, rows_by
from ros2_memory.core.errors import (
    InvalidArgumentsError,
    NotInLakeError,
    QueryTimeoutError,
    UndecodableError,
)
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.text import (
    LABELS,
    Reason,
    abbreviate,
    counted,
    listed,
    repeating,
    still_quoted,
)
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns
from ros2_memory.history.context import Note
from ros2_memory.history.coverage import unix_text
from ros2_memory.history.detections import hung_since
from ros2_memory.history.no_data import matching_topics
from ros2_memory.history.reverse_search import (
    ReverseSearch,
    named_numbers,
    position_frames,
    score_limit,
)
from ros2_memory.history.scan import scan
from ros2_memory.insights.silences import describe_silences
from ros2_memory.places.pose_frames import axes_of
from ros2_memory.things.labels import plain, singular
from ros2_memory.things.seen import topics_with_detections

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping

    from ros2_memory.analysis.conditions import Condition
    from ros2_memory.history.view import View
    from ros2_memory.things.known import KnownThings

_MOST_NAMED: Final = 5
_ARTICLE: Final = re.compile(r"^(?:an?|the) ")
_UNDECODED: Final = Reason(
    "could not be decoded, so detections in them are not known", "topic", of="messages of "
)


class Asked(NamedTuple):
    """A question about things.

    Attributes:
        labels: those that were asked for, by key; all where there are none.
        found: the keys of things that were found; `vague` the labels of those that were seen last
            while localisation was poor.
        inside: says how things were asked for.
        min_score: names the limit of scores, and where it is from.
        undecoded: topics with messages that cannot be decoded, as of `note_undecoded`.
    """

    labels: Mapping[str, str]
    found: Collection[str]
    vague: Collection[str]
    window: TimeWindow
    inside: str
    min_score: str
    undecoded: Collection[str]


class _Detected(NamedTuple):
    """How often a label was detected: as counts, with too low scores, and without a place.

    `first` and `last` are of those without a place, `placed` is when it was last seen at one;
    `together` how many were seen at once.
    """

    name: str
    counted: int
    low: int
    unplaced: int
    first: Ns
    last: Ns
    placed: Ns
    together: int

    @property
    def total(self) -> int:
        """How often it was detected in all."""
        return self.counted + self.low + self.unplaced


def note_undecoded(view: View, window: TimeWindow) -> frozenset[str]:
    """Notes topics that may have detections, and of which messages in a window cannot be decoded.

    Returns these topics. Of each topic the first and the newest message are tried: where only some
    between them are broken, there is no note.
    """
    failures: list[UndecodableError] = []
    for topic in topics_with_detections(view.timeline):
        with suppress(NotInLakeError):
            newest = view.stream.newest(topic, window)
            first = None if newest is None else view.stream.first([topic], window)
            for stored in filter(None, (newest, first)):
                at = TimeWindow(stored.time, stored.time + 1)
                rows_then = [*scan(view, topic, at, copies=True)]
                # What was decoded need not be compiled again.
                if not rows_then or any("" in rows.table.left_out for rows in rows_then):
                    view.bags.decode(stored, failures)
    reasons = {failure.topic: failure.reason for failure in failures}
    for topic, reason in reasons.items():
        view.notes.add_lack(Note(_UNDECODED, topic, reason))
    return frozenset(reasons)


def describe_hung(view: View, window: TimeWindow) -> Iterator[str]:
    """Yields a sentence for each detector that hangs at the end of a window."""
    for topic in topics_with_detections(view.timeline):
        with suppress(NotInLakeError):
            since = hung_since(view, topic, window)
            if since is not None:
                yield (
                    f"{topic} repeats its message of {unix_text(since)} again and again: its "
                    "detector seems to hang, and what it saw since then is not known"
                )


def notes_on_never(
    view: View,
    topic: str,
    condition: Condition,
    window: TimeWindow,
    min_score: float | None,
    *,
    is_bounded: bool = False,
) -> tuple[str, ...]:
    """Returns the notes on what a search that found nothing in a window may have been meant for.

    `is_bounded`: whether matches of some times in the window did not count.
    """
    meant = () if is_bounded else _found_in_singular(view, topic, condition, window)
    topics = matching_topics(view, topic)
    heights = position_frames(view, topics) if condition.field == "position.z" else ()
    frames = {frame for _, of_topic in heights for frame in of_topic}
    return (
        *score_limit(condition, min_score),
        *named_numbers(view, topics, condition),
        *(note for frame in sorted(frames) for note in axes_of(frame)),
        *meant,
    )


def _found_in_singular(
    view: View, topic: str, condition: Condition, window: TimeWindow
) -> tuple[str, ...]:
    """Returns the note on a text that no message has, but its singular without an article.

    A search takes a text as it stands, and `find_things` a label in either form.
    """
    test = condition.test
    if not isinstance(test, Contains | Equals) or test.folded is None:
        return ()
    bare = _ARTICLE.sub("", plain(test.folded))
    for word in dict.fromkeys((bare, singular(bare))):
        if word == plain(test.folded):
            continue
        other = replace(test, needle=word) if isinstance(test, Contains) else Equals(word)
        with suppress(QueryTimeoutError, InvalidArgumentsError):  # no level is named so
            search = ReverseSearch(view, topic, replace(condition, test=other))
            stored = search.newest(window.stop, window.start)
            if stored is not None:
                said = f"{abbreviate(test.folded)} was not found, but {abbreviate(word)} was"
                return (f"{said}, last at {unix_text(stored.time)}",)
    return ()


def notes_on(view: View, known: KnownThings, asked: Asked) -> Iterator[str]:
    """Yields what the things that were found do not say."""
    if not asked.found:
        yield from _silences(view, known, asked)
    if len(known.frames) > 2:  # the first is the map's
        yield (
            "without a map, each run of odometry has its own coordinates: a thing may be listed "
            "once for each run"
        )
    if not known.estimate.topics and known.since is None and not asked.undecoded:
        yield (
            "no things are known: no message has a detection, which is an object with one of the "
            f"fields {', '.join(LABELS)}, as in vision_msgs/msg/Detection3DArray; find_matches "
            "searches text"
        )
    yield from vague_notes(known, (asked.window,), asked.labels, asked.vague)
    if not asked.labels:
        yield from unplaced_notes(known, (asked.window,))
        others = sorted(known.estimate.names.keys() - asked.found)
        detected = [*_detected(known, others, asked.window)]
        low = [label for label in detected if label.low and not label.counted]
        if low:
            named = [f"{label.name} ({counted(label.low, 'time')})" for label in low]
            yield repeating(
                f"detected only below {asked.min_score}: {listed(named, at_most=_MOST_NAMED)}",
                [label.name for label in detected],
            )
    for key, label in asked.labels.items():
        about = f"{abbreviate(label)}: " if len(asked.labels) > 1 else ""
        for note in _of_label(known, key, asked):
            yield still_quoted(about + note, note)


def vague_notes(
    known: KnownThings,
    windows: Collection[TimeWindow],
    keys: Collection[str] = (),
    also: Collection[str] = (),
) -> Iterator[str]:
    """Yields which labels were detected last while localisation was poor, of some keys or all."""
    estimate, spots = known.estimate, known.estimate.spots
    labels = {*also}
    for window in windows if estimate.poor.any() else ():
        during = estimate.seen_in(np.arange(len(spots)), window)
        found, number = np.unique(spots[during, Spot.LABEL], return_inverse=True)
        for label, rows in zip(found.tolist(), rows_by(number, len(found)), strict=True):
            key = known.labels.key(estimate.labels[label])
            if (not keys or key in keys) and estimate.is_vague(during[rows]):
                labels.add(estimate.names[key])
    if labels:
        yield repeating(
            "localisation was poor when these were detected last, which moves nothing, so that "
            f"they may be elsewhere: {listed(sorted(labels), at_most=_MOST_NAMED)}",
            labels,
        )


def unplaced_notes(known: KnownThings, windows: Collection[TimeWindow]) -> Iterator[str]:
    """Yields which labels were detected without a place since they were last seen at one.

    And those of which there were too many at once to tell them apart.
    """
    yield from _labels_left_out(known)
    for window in windows:
        labels = [*_detected(known, sorted(known.estimate.names), window)]
        unplaced = [
            f"{label.name} ({counted(label.unplaced, 'time')}, "
            f"from {unix_text(label.first)} to {unix_text(label.last)})"
            for label in labels
            if label.last > label.placed + SLICE_NS
        ]
        crowded = [label.name for label in labels if label.together > MAX_SPOTS]
        if crowded:
            yield repeating(
                f"of more than {MAX_SPOTS} at once, the others are left out: "
                f"{listed(crowded, at_most=_MOST_NAMED)}",
                crowded,
            )
        if unplaced:
            yield repeating(
                f"detected, but could not be placed: {listed(unplaced, at_most=_MOST_NAMED)}",
                [label.name for label in labels],
            )


def _labels_left_out(known: KnownThings) -> list[str]:
    """Returns a note where some slice has more labels than are looked at; none where none has."""
    estimate = known.estimate
    if len(estimate.labels) <= MAX_LABELS:
        return []
    # A slice, a topic and a label are the first columns of both.
    tables = (estimate.spots, estimate.unplaced)
    columns = [np.concatenate([table[:, name] for table in tables]) for name in range(3)]
    labels, _ = distinct_rows(columns)
    _, slice_of = distinct_rows([*labels[:, :2].T])
    if np.bincount(slice_of).max() <= MAX_LABELS:
        return []
    return [f"of more than {MAX_LABELS} labels in 10 s, the others are left out"]


def _silences(view: View, known: KnownThings, asked: Asked) -> Iterator[str]:
    """Yields why no thing may be known of a window: its detectors published nothing in it."""
    window, looks = asked.window, known.estimate.looks
    topics = [topic for topic in known.estimate.topics if topic not in asked.undecoded]
    # Each new message of a detector is a look.
    is_empty = not ((looks.first < window.stop) & (looks.last >= window.start)).any()
    if topics and is_empty and known.reaches_back(window):
        yield (
            f"{listed(topics)} published nothing new in this window: whether things were there "
            "is not known"
        )
    yield from describe_silences(view, known.estimate.topics, window)


def _during(window: TimeWindow, table: Ints | Columns, first: int, last: int) -> Ints:
    """Returns the rows of a table that reach into a window, by their `first` and `last` column."""
    return np.flatnonzero((table[:, first] < window.stop) & (table[:, last] >= window.start))


def _detected(known: KnownThings, keys: Iterable[str], window: TimeWindow) -> Iterator[_Detected]:
    """Yields how often each of some labels was detected in a window."""
    estimate, unplaced = known.estimate, known.estimate.unplaced
    during = _during(window, estimate.spots, Spot.FIRST, Spot.LAST)
    all_lost = unplaced[_during(window, unplaced, Unplaced.FIRST, Unplaced.LAST)]
    names, key_of_label = numbered(map(known.labels.key, estimate.labels))
    number_of = {key: number for number, key in enumerate(names)}
    rows_of = rows_by(key_of_label[estimate.spots[during, Spot.LABEL]], len(names))
    lost_of = rows_by(key_of_label[all_lost[:, Unplaced.LABEL]], len(names))
    for key in keys:
        number = number_of[key]
        rows, lost = during[rows_of[number]], all_lost[lost_of[number]]
        spots, count = estimate.spots[rows], int(estimate.counts[rows].sum())
        yield _Detected(
            name=estimate.names[key],
            counted=count,
            low=int(spots[:, Spot.N].sum()) - count,
            unplaced=int(lost[:, Unplaced.N].sum()),
            first=int(lost[:, Unplaced.FIRST].min(initial=MAX_NS)),
            last=int(lost[:, Unplaced.LAST].max(initial=MIN_NS)),
            placed=int(spots[:, Spot.LAST].max(initial=MIN_NS)),
            together=int(spots[:, Spot.TOGETHER].max(initial=0)),
        )


def _of_label(known: KnownThings, key: str, asked: Asked) -> Iterator[str]:
    """Yields notes on a label that was asked for."""
    if key not in known.estimate.names:
        yield from _labels_left_out(known) or _never_reported(known, key, asked.labels[key])
        return
    [detected] = _detected(known, [key], asked.window)
    if unplaced := detected.unplaced:
        lost = counted(unplaced, "detection")
        yield f"{lost} of it could not be placed, and {'is' if unplaced == 1 else 'are'} left out"
    if key in asked.found:
        return
    if detected.low:
        times = counted(detected.low, "time")
        yield f"it was detected {times} below {asked.min_score}, which does not count"
    if detected.counted:
        yield (
            f"it was detected {counted(detected.counted, 'time')} in this time, but does not count "
            f"as a thing{asked.inside}: find_matches lists single detections"
        )
    if not detected.total and known.reaches_back(asked.window):
        [in_all] = _detected(known, [key], TimeWindow.everything())
        when = known.reach or " in all"
        yield f"it was detected {counted(in_all.total, 'time')}{when}, and not once in this window"


def _never_reported(known: KnownThings, key: str, label: str) -> Iterator[str]:
    """Yields which labels there are, those like it first, where there are any."""
    names = sorted({*known.estimate.names.values()})
    close = [name for name in names if key in name or name in key]
    close += difflib.get_close_matches(key, names, 3)
    shown = [*dict.fromkeys(close)] or names
    meant = f"; did you mean {close[0]}?" if close else ""
    if names:
        yield repeating(
            f"no detector reported {abbreviate(label)}{known.reach}; "
            f"there are: {listed(shown)}{meant}",
            shown,
        )
