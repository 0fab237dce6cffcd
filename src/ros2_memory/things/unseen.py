"""What a list of things leaves out, in sentences: silent detectors, and detections without a thing.

A detection is without a thing if there are too few, if its score is too low, or without a place.
"""

from __future__ import annotations

import difflib
import math
import re
from collections import defaultdict
from contextlib import suppress
from dataclasses import replace
from itertools import chain, combinations, product
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.conditions import Contains, Equals
from ros2_memory.analysis.facts import GOALS
from ros2_memory.analysis.refusals import fields_of_constant, lack_in_json, lack_of_element
from ros2_memory.analysis.sights import MAX_LABELS, MAX_SPOTS, SLICE_NS, Spot, Unplaced
from ros2_memory.core.arrays import Columns, Flags, Ints, distinct_rows, numbered, rows_by
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
from ros2_memory.core.timebase import MIN_NS, Ns
from ros2_memory.history.condition_hints import constants_named, position_frames, schemas_of
from ros2_memory.history.context import Note
from ros2_memory.history.coverage import unix_text
from ros2_memory.history.detections import LONGEST_LATENCY_NS, stamp_of
from ros2_memory.history.lasting import is_text
from ros2_memory.history.no_data import matching_topics
from ros2_memory.history.reverse_search import ReverseSearch
from ros2_memory.history.scan import scan
from ros2_memory.insights.silences import describe_silences
from ros2_memory.places.pose_frames import axes_of, map_to_choose, unknown_path
from ros2_memory.things.labels import last_word, plain, singular
from ros2_memory.things.places import MAX_PLACES
from ros2_memory.things.seen import topics_with_detections

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

    from ros2_memory.analysis.conditions import Condition
    from ros2_memory.history.bag_access import StoredMessage
    from ros2_memory.history.conditions import Sought
    from ros2_memory.history.view import View
    from ros2_memory.things.instances import Instance, Move, Mover, PlacedStay
    from ros2_memory.things.known import KnownThings

_MOST_NAMED: Final = 5
_SCATTERS: Final = 3.0
"""Things of one label that are no farther apart than so many times their scatter may be one."""
_SAME_PLACE_M: Final = 0.2
_FEWEST_SHIFTED: Final = 3
_SAME_WAY_MM: Final = 120.0
"""Two things that a map shifted went ways that differ by less, the noise of where they are seen."""
_MANY_MESSAGES: Final = 10
"""What is seen in one of so many messages may be mistaken."""
_MOST_TYPES: Final = 3
"""The constants of this many types are looked up: each reads the channels of a file."""
_ARTICLE: Final = re.compile(r"^(?:an?|the) ")
_UNDECODED: Final = Reason(
    "could not be decoded, so their detections are unknown", "topic", of="messages of "
)


_OF_MARKERS: Final = (
    "; a detector of markers may send their places as transforms: list_frames, get_transform_at"
)


class ThingsQuestion(NamedTuple):
    """A question about things, and what it found.

    Attributes:
        labels: the labels by key; empty for all things.
        found: the keys of the things that were found.
        vague: the labels of found things that were last seen while localisation was poor.
        is_bounded: whether the window was asked for; `has_region` whether a region was.
        min_score: how a sentence names the least score, and the setting it is from.
        undecoded: topics with messages that cannot be decoded; see `note_undecoded`.
    """

    labels: Mapping[str, str]
    found: Collection[str]
    vague: Collection[str]
    window: TimeWindow
    is_bounded: bool
    has_region: bool
    min_score: str
    undecoded: Collection[str]

    @property
    def bounds(self) -> str:
        """The window and the region that were asked for, as the end of a sentence."""
        names = []
        if self.is_bounded:
            names.append("window")
        if self.has_region:
            names.append("region")
        return f" in this {' and '.join(names)}" if names else ""


class _LabelDetections(NamedTuple):
    """What was detected of a label in a window.

    Attributes:
        name: the name to show.
        spots: rows of `Spot`; `counts` has how many detections of each count.
        is_carried: which spots are of carried things.
        lost: the detections without a place, as rows of `Unplaced`.
    """

    name: str
    spots: Ints
    counts: Ints
    is_carried: Flags
    lost: Ints

    @property
    def counted(self) -> int:
        """How many detections count."""
        return int(self.counts.sum())

    @property
    def carried(self) -> int:
        """How often it was detected while the robot carried it."""
        return int(self.spots[self.is_carried, Spot.N].sum())

    @property
    def low(self) -> int:
        """How many detections have too low a score."""
        return int(self.spots[~self.is_carried, Spot.N].sum()) - self.counted

    @property
    def unplaced(self) -> int:
        """How many detections have no place."""
        return int(self.lost[:, Unplaced.N].sum())

    @property
    def total(self) -> int:
        """How often it was detected."""
        return int(self.spots[:, Spot.N].sum()) + self.unplaced

    @property
    def is_held(self) -> bool:
        """Whether the robot carried it, and no detection since then counts."""
        last = self.spots[:, Spot.LAST]
        counting = last[self.counts > 0].max(initial=MIN_NS)
        return bool(last[self.is_carried].max(initial=MIN_NS) > counting)


def note_undecoded(view: View, window: TimeWindow) -> frozenset[str]:
    """Notes the topics whose messages may be detections and cannot be decoded, and returns them.

    The first and the newest message of each topic in the window are tried. Broken messages between
    them are not noticed.
    """
    failures: list[UndecodableError] = []
    for topic in topics_with_detections(view.timeline):
        with suppress(NotInLakeError):
            for stored in _messages_to_try(view, topic, window):
                view.bags.decode(stored, failures)
    reasons = {failure.topic: failure.reason for failure in failures}
    for topic, reason in reasons.items():
        view.notes.add_lack(Note(_UNDECODED, topic, reason))
    return frozenset(reasons)


def _messages_to_try(view: View, topic: str, window: TimeWindow) -> Iterator[StoredMessage]:
    """Yields the newest and the first message of a topic, unless columns show that they decode.

    Decoding compiles the type, which takes long.
    """
    newest = view.stream.newest(topic, window)
    first = None if newest is None else view.stream.first([topic], window)
    for stored in filter(None, (newest, first)):
        at = TimeWindow(stored.time, stored.time + 1)
        rows_then = [*scan(view, topic, at, copies=True)]
        if not rows_then or any("" in rows.table.left_out for rows in rows_then):
            yield stored


def describe_hung(view: View, window: TimeWindow) -> Iterator[str]:
    """Yields a sentence for each detector that repeats one message at the end of a window."""
    for topic in topics_with_detections(view.timeline):
        with suppress(NotInLakeError):
            # A plain text has no stamp.
            since = None if is_text(view, topic) else _hung_since(view, topic, window)
            if since is not None:
                yield (
                    f"{topic} repeats its message of {unix_text(since)} again and again: its "
                    "detector seems to hang, and what it saw since then is not known"
                )


def blind_notes(known: KnownThings, windows: Collection[TimeWindow]) -> Iterator[str]:
    """Yields a sentence for each detector that was blind in some windows."""
    spans: dict[str, list[str]] = {}
    for blind in known.by_all.estimate.blind:
        if any(window.overlaps(blind.first, blind.last) for window in windows):
            span = f"from {unix_text(blind.first)} to {unix_text(blind.last)}"
            spans.setdefault(blind.topic, []).append(span)
    for topic, of_topic in spans.items():
        yield (
            f"{topic} was blind {listed(of_topic)}, as in the dark: what was there then is not "
            "known"
        )


def _hung_since(view: View, topic: str, window: TimeWindow) -> Ns | None:
    """Returns the stamp (ns) of an old message that the newest messages of a window repeat.

    None if the newest message differs from the one before, has no stamp, or is so young that its
    image may have been looked at until then.
    """
    newest = view.stream.newest(topic, window)
    stamp = stamp_of(view.bags.decode(newest))
    if newest is None or stamp is None or newest.time - stamp <= LONGEST_LATENCY_NS:
        return None
    before = view.stream.newest(topic, TimeWindow(window.start, newest.time))
    repeats = before is not None and before.record.payload == newest.record.payload
    return stamp if repeats else None


def notes_on_never(
    view: View,
    sought: Sought,
    condition: Condition,
    window: TimeWindow,
    *,
    is_bounded: bool = False,
) -> tuple[str, ...]:
    """Returns the notes on a search that found nothing in a window: what may have been meant.

    `is_bounded`: the search did not count the matches at some times of the window.
    """
    meant = () if is_bounded else _found_otherwise_spelt(view, sought.topic, condition, window)
    topics = matching_topics(view, sought.topic)
    heights = position_frames(view, topics) if condition.field == "position.z" else ()
    frames = {frame for _, of_topic in heights for frame in of_topic}
    return (
        *_score_limit(condition, sought.min_score),
        *_named_numbers(view, topics, condition),
        *_lacks_in_newest(view, topics, condition),
        *(note for frame in sorted(frames) for note in axes_of(frame)),
        *meant,
    )


def _score_limit(condition: Condition, min_score: float | None) -> tuple[str, ...]:
    """Returns a note for "never" if the least score was not asked for, or is above 1."""
    if not condition.min_score or (min_score is not None and min_score <= 1):
        return ()
    unless = "and most scores are from 0 to 1" if min_score else "unless min_score is given"
    return (f"detections with a score below {condition.min_score:g} do not count here, {unless}",)


def _lacks_in_newest(view: View, topics: Sequence[str], condition: Condition) -> Iterator[str]:
    """Yields a note for "never" on each topic whose newest message lacks the field, if JSON may."""
    for topic in topics[:_MOST_TYPES] if condition.field else ():
        stored = view.stream.last(topic)
        if stored is not None:
            field = condition.of_type(stored.type, view.extractor).field or ""
            value = view.example(stored)
            lack = lack_of_element(field, value) or lack_in_json(field, value)
            if lack is not None:
                yield f"{topic}: {lack}"


def _named_numbers(view: View, topics: Sequence[str], condition: Condition) -> tuple[str, ...]:
    """Returns a note for "never" if constants of the topics' types have the word of the condition.

    Then a number stands for the word.
    """
    word = condition.test.folded
    if condition.field or not word:
        return ()
    # The statuses of goals are searched by their words.
    types = sorted({*chain.from_iterable(map(view.timeline.types_of, topics))} - {GOALS})
    named = {
        constant: type_name
        for type_name in types[:_MOST_TYPES]
        for schema in schemas_of(view, type_name)
        for constant in constants_named(schema, "", word)
    }
    if not named:
        return ()
    of_types = listed([f"{constant} ({type_name})" for constant, type_name in named.items()])
    fields = listed([*dict.fromkeys(_fields_of_constants(view, topics, [*named]))])
    such = f", such as {fields}" if fields else ""
    return (f"{abbreviate(word)} names {of_types}: ask equals on the field of that number{such}",)


def _fields_of_constants(
    view: View, topics: Sequence[str], constants: Sequence[str]
) -> Iterator[str]:
    """Yields the fields of the topics' newest messages whose names begin those of constants."""
    for topic in topics[:_MOST_TYPES]:
        stored = None
        with suppress(QueryTimeoutError):
            stored = view.stream.last(topic)
        if stored is None:
            continue
        value = view.example(stored)
        for constant in constants:
            yield from fields_of_constant(constant.partition(" ")[0], value)


def _found_otherwise_spelt(
    view: View, topic: str, condition: Condition, window: TimeWindow
) -> tuple[str, ...]:
    """Returns the note on a text that was not found, if another spelling of it was.

    A search takes a text as it stands, while `find_things` takes a label in any of these forms.
    """
    test = condition.test
    if not isinstance(test, Contains | Equals) or test.folded is None:
        return ()
    brief = view.brief()
    for word in _other_spellings(test.folded):
        other = replace(test, needle=word) if isinstance(test, Contains) else Equals(word)
        with suppress(QueryTimeoutError, InvalidArgumentsError):  # no level is named so
            search = ReverseSearch(brief, topic, replace(condition, test=other))
            stored = search.newest(window.stop, window.start)
            if stored is not None:
                said = f"{abbreviate(test.folded)} was not found, but {abbreviate(word)} was"
                return (f"{said}, last at {unix_text(stored.time)}",)
    return ()


def _other_spellings(text: str) -> list[str]:
    """Returns a text without its article, then in the singular, with each spacing of labels."""
    bare = _ARTICLE.sub("", plain(text))
    words = [word.replace(" ", spacing) for spacing in " _-" for word in (bare, singular(bare))]
    return [word for word in dict.fromkeys(words) if word != text]


def notes_on(view: View, known: KnownThings, question: ThingsQuestion) -> Iterator[str]:
    """Yields what the things that a question found do not say."""
    if not question.found:
        yield from _silence_notes(view, known, question)
    if len(known.frames) > 2:  # the first is the map's
        yield (
            "without a map, a thing may be listed once for each run of odometry, in coordinates of "
            f"that run{map_to_choose(view, known.frames[-1])}"
        )
    if not known.estimate.topics and known.since is None and not question.undecoded:
        yield (
            f"no things are known: no message has an object with {' or '.join(LABELS)}; "
            "find_matches searches text"
        )
    yield from crowded_notes(known)
    yield from blind_notes(known, (question.window,))
    yield from vague_notes(known, (question.window,), question.labels, question.vague)
    if not question.labels:
        yield from unplaced_notes(known, (question.window,))
        yield from _low_score_notes(known, question)
    yield from _notes_on_labels(known, question)
    if _rows_during(question.window, known.estimate.unplaced, Unplaced.FIRST, Unplaced.LAST).size:
        notes = [*unknown_path(view)]
        if not (notes or view.moving_topics):
            topics = listed(view.limits.tf_topics) or "data.tf_topics"
            notes = [f"what is detected is placed by transforms, of which {topics} has none here"]
        yield from notes


def _low_score_notes(known: KnownThings, question: ThingsQuestion) -> Iterator[str]:
    """Yields which labels were only detected with too low a score, of all that were not found."""
    others = sorted(known.estimate.names.keys() - question.found)
    detections = _detections_of(known, others, question.window).values()
    named = [
        f"{label.name} ({counted(label.low, 'time')})"
        for label in detections
        if label.low and not label.counted
    ]
    if named:
        yield repeating(
            f"detected only below {question.min_score}: {listed(named, at_most=_MOST_NAMED)}",
            [label.name for label in detections],
        )


def vague_notes(
    known: KnownThings,
    windows: Collection[TimeWindow],
    keys: Collection[str] = (),
    vague: Collection[str] = (),
) -> Iterator[str]:
    """Yields which labels were last detected while localisation was poor.

    They are the labels in `vague`, and those with one of the keys, or any, whose newest spot in a
    window is poor.
    """
    estimate, spots = known.estimate, known.estimate.spots
    labels = {*vague}
    for window in windows if estimate.poor.any() else ():
        during = estimate.seen_in(np.arange(len(spots)), window)
        codes, number = np.unique(spots[during, Spot.LABEL], return_inverse=True)
        for label, rows in zip(codes.tolist(), rows_by(number, len(codes)), strict=True):
            key = known.labels.key(estimate.labels[label])
            if (not keys or key in keys) and estimate.is_vague(during[rows]):
                labels.add(estimate.names[key])
    if labels:
        yield repeating(
            "localisation was poor when these were detected last, which moves nothing, so that "
            f"they may be elsewhere: {listed(sorted(labels), at_most=_MOST_NAMED)}",
            labels,
        )


def lone_notes(known: KnownThings, movers: Iterable[tuple[Mover, Ints]]) -> Iterator[str]:
    """Yields which movers were last seen by a detection alone, and when before that.

    A thing that stays needs several detections; a mover may be anywhere, so that one counts.

    Args:
        known: the things.
        movers: each with the rows of its spots in a window.
    """
    estimate = known.estimate
    for mover, rows in movers:
        lasts = estimate.spots[rows, Spot.LAST]
        messages = estimate.alone_among(int(rows[lasts.argmax()]), mover)
        if messages >= _MANY_MESSAGES:
            name = estimate.names[mover.key]
            before = np.sort(lasts)[-2:-1].tolist()
            earlier = f"; before that at {unix_text(*before)}" if before else ""
            yield repeating(
                f"{name} was last seen in 1 of {messages} messages, which may be a false "
                f"detection: find_matches has its score{earlier}",
                [name],
            )


def crowded_notes(known: KnownThings) -> Iterator[str]:
    """Yields the labels of which things are left out, since there are too many."""
    crowded = sorted(known.estimate.crowded)
    if crowded:
        yield repeating(
            f"of more than {MAX_PLACES} places of one label, the others are left out: "
            f"{listed(crowded, at_most=_MOST_NAMED)}",
            crowded,
        )


def scatter_notes(stays: Iterable[tuple[Instance, PlacedStay]]) -> Iterator[str]:
    """Yields for a label whether two of its things are so near that noise may have parted them.

    Each thing comes with its stay. Those of different runs of odometry cannot be compared.
    """
    alike: dict[tuple[str, int, str], list[PlacedStay]] = defaultdict(list)
    for thing, stay in stays:
        alike[thing.label, thing.epoch, thing.id].append(stay)
    nearest: dict[str, tuple[float, float]] = {}
    for (label, *_), stays_of_label in alike.items():
        for one, other in combinations(stays_of_label, 2):
            away_m = math.dist(one.at, other.at)
            spread_m = max(one.dev_mm, other.dev_mm) / 1000
            if away_m <= _SCATTERS * spread_m:
                nearest[label] = min((away_m, spread_m), nearest.get(label, (math.inf, 0.0)))
    for label, (away_m, spread_m) in nearest.items():
        yield repeating(
            f"{label}: two of these are only {away_m:.2f} m apart, where detections of it scatter "
            f"by {spread_m:.2f} m: they may be one thing",
            [label],
        )


def look_alike_notes(known: KnownThings, moves: Iterable[Move]) -> Iterator[str]:
    """Yields the labels of moves that may be of other things, and of how many."""
    most: dict[str, int] = {}
    for move, others in known.estimate.look_alikes(moves):
        if others:
            most[move.thing.label] = max(others, most.get(move.thing.label, 0))
    if most:
        labels = [f"{label} (or {others} more)" for label, others in sorted(most.items())]
        yield repeating(
            "which one of a label moved is a guess, since others of it came or went meanwhile: "
            f"{listed(labels, at_most=_MOST_NAMED)}",
            most,
        )


def shift_notes(moves: Sequence[Move], unchanged: int) -> Iterator[str]:
    """Yields how many things went the same way while few stayed: the map may have shifted there."""
    ways = np.array(
        [(move.after.x - move.before.x, move.after.y - move.before.y) for move in moves]
    )
    if len(ways) < _FEWEST_SHIFTED:
        return
    middle = np.median(ways, axis=0)
    alike = np.count_nonzero(np.hypot(*(ways - middle).T) <= _SAME_WAY_MM)
    if alike >= _FEWEST_SHIFTED and alike > (len(ways) + unchanged) / 2:
        x, y = (middle / 1000).tolist()
        yield (
            f"{alike} of the {len(ways)} things in moved went the same way, x {x:+.2f} m and "
            f"y {y:+.2f} m: the map may have shifted, and not they"
        )


def renamed_notes(known: KnownThings, things: Iterable[Instance]) -> Iterator[str]:
    """Yields of things that are not seen any more what of their kind is seen at their place since.

    A detector with other words calls the same thing otherwise: a "coffee mug" is no "mug" to it.
    """
    missed = [thing for thing in things if thing.missed_by is not None]
    kinds = {last_word(thing.key) for thing in missed}
    of_kinds = [other for other in known.estimate.instances if last_word(other.key) in kinds]
    for thing, other in product(missed, of_kinds):
        gone, came = thing.stays[-1], other.stays[0]
        if (
            other.key != thing.key
            and (last_word(other.key), other.epoch) == (last_word(thing.key), thing.epoch)
            and came.first > gone.last
            and math.dist(came.at, gone.at) <= _SAME_PLACE_M
            and not known.labels.are_apart(thing.key, other.key)
        ):
            yield repeating(
                f"{other.label} is seen where {thing.label} was, since {unix_text(came.first)}: "
                "it may be the same thing by another word",
                [thing.label, other.label],
            )


def unplaced_notes(known: KnownThings, windows: Collection[TimeWindow]) -> Iterator[str]:
    """Yields which labels were detected without a place since they were last seen at one.

    And which labels had too many detections at once to tell all of them apart.
    """
    yield from _too_many_labels_note(known)
    for window in windows:
        labels = _detections_of(known, sorted(known.estimate.names), window).values()
        unplaced, crowded = [], []
        for label in labels:
            if label.spots[:, Spot.TOGETHER].max(initial=0) > MAX_SPOTS:
                crowded.append(label.name)
            last = int(label.lost[:, Unplaced.LAST].max(initial=MIN_NS))
            if last > label.spots[:, Spot.LAST].max(initial=MIN_NS) + SLICE_NS:
                first = int(label.lost[:, Unplaced.FIRST].min())
                when = f"from {unix_text(first)} to {unix_text(last)}"
                unplaced.append(f"{label.name} ({counted(label.unplaced, 'time')}, {when})")
        if crowded:
            yield repeating(
                f"of more than {MAX_SPOTS} at once, the others are left out: "
                f"{listed(crowded, at_most=_MOST_NAMED)}",
                crowded,
            )
        if unplaced:
            is_marker = any(label.name.isdecimal() for label in labels if label.unplaced)
            yield repeating(
                f"detected, but could not be placed: {listed(unplaced, at_most=_MOST_NAMED)}"
                f"{_OF_MARKERS if is_marker else ''}",
                [label.name for label in labels],
            )


def _too_many_labels_note(known: KnownThings) -> list[str]:
    """Returns the note on labels that are left out, if a topic has too many in some slice."""
    estimate = known.estimate
    if len(estimate.labels) <= MAX_LABELS:
        return []
    # The first columns of both tables are slice, topic and label.
    tables = (estimate.spots, estimate.unplaced)
    columns = [np.concatenate([table[:, name] for table in tables]) for name in range(3)]
    labels, _ = distinct_rows(columns)
    _, slice_of = distinct_rows([*labels[:, :2].T])
    if np.bincount(slice_of).max() <= MAX_LABELS:
        return []
    return [f"of more than {MAX_LABELS} labels in 10 s, the others are left out"]


def _silence_notes(view: View, known: KnownThings, question: ThingsQuestion) -> Iterator[str]:
    """Yields that detectors published nothing in a window: no thing may be known for that."""
    window, looks = question.window, known.estimate.looks
    topics = [topic for topic in known.estimate.topics if topic not in question.undecoded]
    # Each new message of a detector is a look.
    is_empty = not ((looks.first < window.stop) & (looks.last >= window.start)).any()
    is_blind = any(True for _ in blind_notes(known, (window,)))
    if topics and is_empty and not is_blind and known.reaches_back(window):
        yield (
            f"{listed(topics)} published nothing new in this window: whether things were there "
            "is not known"
        )
    yield from describe_silences(view, known.estimate.topics, window)


def _rows_during(window: TimeWindow, table: Columns, first: int, last: int) -> Ints:
    """Returns the rows of a table that reach into a window, by the numbers of two columns."""
    return np.flatnonzero((table[:, first] < window.stop) & (table[:, last] >= window.start))


def _detections_of(
    known: KnownThings, keys: Collection[str], window: TimeWindow
) -> dict[str, _LabelDetections]:
    """Returns how often labels were detected in a window, by their keys.

    All spots are looked through once, so ask about all labels together.
    """
    if not keys:
        return {}
    estimate = known.estimate
    during = _rows_during(window, estimate.spots, Spot.FIRST, Spot.LAST)
    lost_then = _rows_during(window, estimate.unplaced, Unplaced.FIRST, Unplaced.LAST)
    unplaced = estimate.unplaced[lost_then]
    names, key_of_label = numbered(map(known.labels.key, estimate.labels))
    placed_of = rows_by(key_of_label[estimate.spots[during, Spot.LABEL]], len(names))
    lost_of = rows_by(key_of_label[unplaced[:, Unplaced.LABEL]], len(names))
    number_of = {key: number for number, key in enumerate(names)}
    detections: dict[str, _LabelDetections] = {}
    for key in keys:
        rows = during[placed_of[number_of[key]]]
        detections[key] = _LabelDetections(
            estimate.names[key],
            estimate.spots[rows],
            estimate.counts[rows],
            estimate.carried[rows],
            unplaced[lost_of[number_of[key]]],
        )
    return detections


def _notes_on_labels(known: KnownThings, question: ThingsQuestion) -> Iterator[str]:
    """Yields notes on each label that was asked for."""
    window, labels = question.window, question.labels
    reported = [key for key in labels if key in known.estimate.names]
    too_many = _too_many_labels_note(known) if len(reported) < len(labels) else []
    in_window = _detections_of(known, reported, window)
    absent = [key for key in reported if not in_window[key].total]
    in_all = _detections_of(
        known, absent if known.reaches_back(window) else (), TimeWindow.everything()
    )
    for key, label in labels.items():
        about = f"{abbreviate(label)}: " if len(labels) > 1 else ""
        if key in in_window:
            notes = _detection_notes(known, question, key, in_window[key], in_all.get(key))
        elif key in question.found:  # an id
            continue
        else:
            notes = iter(too_many) if too_many else _similar_labels(known, key, label)
        for note in notes:
            yield still_quoted(about + note, note)


def _detection_notes(
    known: KnownThings,
    question: ThingsQuestion,
    key: str,
    in_window: _LabelDetections,
    in_all: _LabelDetections | None,
) -> Iterator[str]:
    """Yields notes on the detections of a label; `in_all` if the window has none of it."""
    unplaced = in_window.unplaced
    if unplaced:
        lost = counted(unplaced, "detection")
        hint = _OF_MARKERS if in_window.name.isdecimal() else ""
        are = "is" if unplaced == 1 else "are"
        yield f"{lost} of it could not be placed, and {are} left out{hint}"
    if in_window.is_held:
        times = counted(in_window.carried, "time")
        last = int(in_window.spots[in_window.is_carried, Spot.LAST].max())
        yield (
            f"it was seen {times}, last at {unix_text(last)}, to go along with the robot, as what "
            "it carries: that is no place of it"
        )
    if key in question.found:
        return
    if in_window.low:
        times = counted(in_window.low, "time")
        yield f"it was detected {times} below {question.min_score}, which does not count"
    if in_window.counted:
        times = counted(in_window.counted, "time")
        yield (
            f"it was detected {times} in this time, but does not count "
            f"as a thing{question.bounds}: find_matches lists single detections"
        )
    if in_all is not None:
        times = counted(in_all.total, "time")
        when = known.reach or " in all"
        yield f"it was detected {times}{when}, and not once in this window"


def _similar_labels(known: KnownThings, key: str, label: str) -> Iterator[str]:
    """Yields that no detector reported a label, and the labels that are like it, or all labels."""
    names = sorted({*known.estimate.names.values()})
    if not names:
        return
    similar = [name for name in names if key in name or name in key]
    similar += difflib.get_close_matches(key, names, 3)
    shown = [*dict.fromkeys(similar)] or names
    meant = f"did you mean {similar[0]}?" if similar else "find_matches searches identifiers, too"
    yield repeating(
        f"no detector reported the label {abbreviate(label)}{known.reach}; "
        f"there are: {listed(shown)}; {meant}",
        shown,
    )
