"""Recordings of several robots that are answered together, as one history.

Recordings that hold a topic at the same time are of one robot where a handover joins them, or where
messages of one are in the other too. At other times they are of several where a frame has one
parent here and another one there.
"""

from __future__ import annotations

from collections import defaultdict
from itertools import chain, combinations, islice
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.layout import MEMORY_FOLDER, has_own_name, is_kept_apart
from ros2_memory.core.errors import NoDataError, NoDataReason, NotInLakeError, QueryTimeoutError
from ros2_memory.core.memo import Key
from ros2_memory.core.model import BagFile, BagState, TimeWindow
from ros2_memory.core.spans import COPY_HORIZON_NS, Spans, united
from ros2_memory.core.text import listed
from ros2_memory.core.timebase import NS_PER_S, Ns, iso_local
from ros2_memory.history.coverage import unix_text
from ros2_memory.history.duplicates import BagSpan, StoredMessage, copy_key
from ros2_memory.history.merged_stream import bag_span_of
from ros2_memory.history.transforms import sessions_of
from ros2_memory.history.view import View
from ros2_memory.index.clock_faults import FaultyClock
from ros2_memory.index.recordings import (
    Overlapping,
    overlapping_recordings,
    recordings_of,
)
from ros2_memory.index.split_order import split_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from ros2_memory.history.context import Call, Memory

_NEAR_NS: Final[Ns] = 10 * NS_PER_S
"""How far around one message others count as recorded at the same time."""
_SLOW_NS: Final[Ns] = 600 * NS_PER_S
"""As far where recordings overlap at that time: some topics have a message in minutes."""
_TRIED: Final = 3
"""How many messages are looked for in the other recording: a subscriber may miss one."""
_MAX_PAIRS: Final = 20
"""Pairs of recordings of which messages are compared."""
_MAX_TOPICS: Final = 3
"""Topics of a question that are compared."""
_MAX_COMPARED: Final = 8
"""Topics of a pair that are compared; robots may share some (`/clock`, a map)."""
_MAX_TREES: Final = 32
"""Recordings of which static transforms are compared, the newest."""
_MAX_STATIC: Final = 50
"""Messages of static transforms that are read of one recording."""
_DIFFERING: Final[Key[dict[tuple[str, tuple[Path, Path], TimeWindow], bool]]] = Key()
"""Of a timeline: whether two recordings hold messages of their own on a topic, in a window."""
_PARENTS: Final[Key[dict[str, Mapping[str, str]]]] = Key()
"""Of a memory: the parent of each static frame of a recording that is closed."""
ADVICE: Final = "; data.recording selects one recording"
"""The end of a sentence on robots that are mixed."""
_RECENT_NS: Final[Ns] = 60 * NS_PER_S
_DESCRIBED: Final[Key[list[tuple[Ns, tuple[str, ...]]]]] = Key()
"""Of a memory: when it was last looked whether robots are mixed, and what was found."""


class Mixed(NamedTuple):
    """Two recordings that overlap in time, and a topic on which each has messages of its own.

    `topic` is None where they share none, or the messages of those that they share.
    """

    pair: Overlapping
    topic: str | None


class Contradiction(NamedTuple):
    """Two recordings (paths) in which a frame has different parents."""

    recordings: tuple[str, str]
    frame: str
    parents: tuple[str, str]

    @property
    def names(self) -> tuple[str, str]:
        """The names of the two recordings."""
        one, other = self.recordings
        return Overlapping(Path(one), Path(other), 0, 0).names

    def __str__(self) -> str:
        """Returns a sentence, without a full stop."""
        one, other = self.names
        return (
            f"the frame {self.frame} is in {self.parents[0]} in the recording {one}, and in "
            f"{self.parents[1]} in {other}, as of two robots"
        )


def mixed_recordings(memory: Memory, call: Call) -> tuple[Mixed, ...]:
    """Returns the recordings that overlap in time, with a topic on which they differ.

    Overlaps are known from the index; those that a clock made, which was set back while one of the
    recordings ran, show no second robot. A few messages are read once of each of the first pairs.
    """
    view = View(memory, call)  # notes on what is read here are of no answer
    found: list[Mixed] = []
    pairs = overlapping_recordings(view.snapshot, memory.index.joined_with)
    bags, steps = recordings_of(view.snapshot) if pairs else {}, _steps_back(view)
    for pair in pairs:
        by_clock = pair.end - pair.start <= max(steps[pair.first], steps[pair.second])
        is_compared = not by_clock and len(found) < _MAX_PAIRS
        try:
            found.append(Mixed(pair, _differing_topic(view, pair, bags) if is_compared else None))
        except QueryTimeoutError:
            break
    return tuple(found)


def contradicting_frames(memory: Memory, call: Call) -> tuple[Contradiction, ...]:
    """Returns frames that have one parent in one recording and another in another one.

    By static transforms. Of this program's own recordings in one folder the newest is compared
    alone: they are of one robot.
    """
    view = View(memory, call)
    known = memory.memo.of(_PARENTS, dict)
    trees: dict[str, Mapping[str, str]] = {}
    for path, bags in _of_different_makers(view):
        try:
            parents = known[path] if path in known else _static_parents(view, bags)
        except QueryTimeoutError:
            break
        if not any(bag.state is BagState.ACTIVE for bag in bags):
            known[path] = parents
        trees[path] = parents
    found: dict[str, Contradiction] = {}
    for (one, parents), (other, others) in combinations(trees.items(), 2):
        for frame in sorted(parents.keys() & others.keys()):
            if parents[frame] != others[frame]:
                both = (parents[frame], others[frame])
                found.setdefault(frame, Contradiction((one, other), frame, both))
    return tuple(found.values())


def describe_mixed(memory: Memory, call: Call) -> tuple[str, ...]:
    """Returns sentences where robots are plainly mixed into one history, a minute old at most.

    With a week of bags a new check takes 0.1 s, and the page asks every few seconds.
    """
    now, known = memory.clock.now(), memory.memo.of(_DESCRIBED, list)
    if not known or abs(now - known[0][0]) > _RECENT_NS:
        known[:] = [(now, tuple(_described(memory, call)))]
    return known[0][1]


def _described(memory: Memory, call: Call) -> Iterator[str]:
    mixed = [each for each in mixed_recordings(memory, call) if each.topic is not None]
    if mixed:
        names = sorted({name for each in mixed for name in each.pair.names})
        first = mixed[0]
        yield (
            f"robots are mixed: {listed(names)} overlap in time (from "
            f"{iso_local(first.pair.start)}), each with different messages on {first.topic}, but "
            f"answers treat them as one robot{ADVICE}"
        )
    contradictions = contradicting_frames(memory, call)
    if contradictions:
        more = len(contradictions) - 1
        yield f"robots are mixed: {contradictions[0]}{f' (and {more} more)' if more else ''}"


def _differing_topic(
    view: View, pair: Overlapping, recordings: Mapping[str, Sequence[BagFile]]
) -> str | None:
    both = TimeWindow(pair.start, pair.end + 1)
    one, other = (
        [bag for bag in recordings.get(str(path), ()) if both.overlaps(bag.start, bag.end)]
        for path in (pair.first, pair.second)
    )
    shared = _topics_of(one) & _topics_of(other) - view.timeline.transient_local
    limits = view.limits
    first = [each for each in (view.pose_topic, *limits.tf_topics) if each in shared]
    for topic in islice([*first, *sorted(shared.difference(first))], _MAX_COMPARED):
        if _differ_in(view, topic, (_spans(one, topic), _spans(other, topic)), both):
            return topic
    return None


def _topics_of(bags: Sequence[BagFile]) -> set[str]:
    return {topic for bag in bags for topic in bag.summary.schema.positions}


def _spans(bags: Sequence[BagFile], topic: str) -> list[BagSpan]:
    return [bag_span_of(bag, (topic,)) for bag in bags if topic in bag.summary.schema.positions]


def _of_different_makers(view: View) -> list[tuple[str, Sequence[BagFile]]]:
    """Returns the newest recordings with static transforms, of this program's one in a folder."""
    topics = view.limits.tf_static_topics
    root = f"{view.bag_dir}/"
    newest: dict[str, tuple[str, Sequence[BagFile]]] = {}
    for path, bags in recordings_of(view.snapshot).items():
        folder, _, name = path.rpartition("/")
        holding = [bag for bag in bags if any(map(bag.summary.schema.positions.get, topics))]
        if holding and not is_kept_apart(path.removeprefix(root)):
            key = folder if has_own_name(name) else path
            before = newest.get(key)
            if before is None or before[1][0].start < holding[0].start:
                newest[key] = (path, holding)
    ordered = sorted(newest.values(), key=lambda each: each[1][0].start)
    return ordered[-_MAX_TREES:] if len(ordered) > 1 else []


def _static_parents(view: View, bags: Sequence[BagFile]) -> dict[str, str]:
    """Returns the parent of each static frame of a recording, as it was stated last."""
    parents: dict[str, str] = {}
    window = TimeWindow.everything()
    for topic in view.limits.tf_static_topics:
        spans = _spans(bags, topic)
        merged = view.stream.merged(spans, [topic], window, newest_first=False) if spans else ()
        for each in islice(merged, _MAX_STATIC):
            message = view.bags.decode(each)
            if message is not None:
                edges = view.extractor.transforms(message, each.time, static=True)
                parents.update({edge.child: edge.parent for edge in edges})
    return parents


class Beside(NamedTuple):
    """Two recordings with messages of their own on a topic at the same time.

    Or one, with itself, in which the clock was set back.

    Attributes:
        first: the one that holds the topic first.
        other: the other one.
        span: when both hold the topic.
        by_clock: whether that is as where a clock was set back between two recordings: it is the
            end of the first and the begin of the other, and less than half of each; or no longer
            than the clock was set back while one of them ran.
    """

    first: Path
    other: Path
    span: TimeWindow
    by_clock: bool
    bags: frozenset[str] = frozenset()
    """Of the other one, the files of which messages are beside those of the first; none: all."""


def require_one_robot(view: View, topic: str, window: TimeWindow) -> None:
    """Checks that a path by this topic is that of one robot: else it jumps between several.

    A note says where recordings overlap as after a clock was set back, and of which the path is
    there.

    Raises:
        NoDataError: recordings hold messages of their own on the topic at the same time.
    """
    found = recordings_beside(view, topic, window)
    names = _names([each for each in found if not each.by_clock])
    # Transforms are of all recordings at once, so a path by them is not that of one there.
    if topic in view.limits.tf_topics:
        names = _names(found)
    if names:
        raise NoDataError(
            NoDataReason.MIXED,
            f"{len(names)} recordings have different messages on {topic} at the same time, as "
            f"from several robots: {listed(names)}; one path over them would be wrong: ask about "
            "a time with one of them, or set data.recording to one",
        )
    for each in [*found, *_beside_themselves(view, window)]:
        name, start, stop = (
            each.first.name,
            unix_text(each.span.start),
            unix_text(each.span.stop - 1),
        )
        view.notes.add(
            f"{name} has the time from {start} to {stop} twice, as the clock was set back "
            "meanwhile: the path there is that from before"
            if each.first == each.other
            else f"{name} and {each.other.name} have different messages on {topic} from {start} to "
            f"{stop}, as after a clock was set back, or from two robots: the path there is that of "
            f"{name}"
        )


def note_robots(view: View, topic: str, window: TimeWindow) -> Spans:
    """Notes the recordings that hold messages of their own on a topic at the same time.

    Returns these times, without those that a clock made which was set back.
    """
    found = recordings_beside(view, topic, window)
    names = _names(found)
    if names:
        view.notes.add(
            f"{len(names)} recordings have different messages on {topic} at the same time, as "
            f"from several robots, and the answer does not separate them: {listed(names)}"
        )
    return united((each.span.start, each.span.stop) for each in found if not each.by_clock)


def _names(found: Sequence[Beside]) -> list[str]:
    return sorted({path.name for each in found for path in (each.first, each.other)})


def beside_path(view: View, topic: str, window: TimeWindow) -> list[Beside]:
    """Returns all that would make a path by a topic go to and fro between two times of a robot."""
    return [*recordings_beside(view, topic, window), *_beside_themselves(view, window)]


def recordings_beside(view: View, topic: str, window: TimeWindow) -> list[Beside]:
    """Returns the recordings that hold messages of their own on a topic at the same time.

    None for latched topics, which each recording receives again, or where the time for the answer
    is over before it is known, or a lake does not hold the messages.
    """
    if topic in view.timeline.transient_local:
        return []
    try:
        return _recordings_beside(view, topic, window)
    except (QueryTimeoutError, NotInLakeError):
        return []


def recordings_apart(
    view: View, topics: Sequence[str], window: TimeWindow
) -> frozenset[Path] | None:
    """Returns the recordings that are beside another one on some topics, latched ones too.

    None where that is not known.
    """
    try:
        pairs = [*chain(*(_recordings_beside(view, topic, window) for topic in topics))]
    except (QueryTimeoutError, NotInLakeError):
        return None
    return frozenset(path for pair in pairs for path in (pair.first, pair.other))


def _recordings_beside(view: View, topic: str, window: TimeWindow) -> list[Beside]:
    found: list[Beside] = []
    apart: set[Path] = set()
    noted_before = view.notes.keys()
    try:
        for each in _overlapping_pairs(view, topic, window):
            pair = each.first, each.other
            # Of several robots in a folder there may be thousands of pairs.
            is_known = not each.by_clock and apart.issuperset(pair)
            if not is_known and _differ(view, topic, pair, each.span.intersect(window)):
                found.append(each)
                apart.update(() if each.by_clock else pair)
    finally:
        # The answer itself needed nothing of what was read here.
        view.notes.retract_outside(keep=noted_before)
    return found


def note_robots_on(view: View, topics: Sequence[str], window: TimeWindow) -> Spans:
    """Does as `note_robots` for the first few of some topics."""
    every = [note_robots(view, topic, window) for topic in topics[:_MAX_TOPICS]]
    return united(chain.from_iterable(every))


def note_robots_near(view: View, found: StoredMessage) -> None:
    """Does as `note_robots`, around the time of a message; a single recording is of one robot."""
    topic = found.topic
    if len(view.timeline.recordings(topic)) > 1:
        near = TimeWindow.around(found.time, _NEAR_NS)
        if any(_overlapping_pairs(view, topic, near)):
            note_robots(view, topic, TimeWindow.around(found.time, _SLOW_NS))


def _overlapping_pairs(view: View, topic: str, window: TimeWindow) -> Iterator[Beside]:
    """Yields pairs of recordings that hold a topic at the same time in a window."""
    open_spans: list[tuple[Ns, Ns, Path]] = []
    steps = _steps_back(view)
    recordings = dict(view.timeline.recordings(topic))
    # A thinned day lies around what moments and rules have of it.
    recordings.pop(view.bag_dir / MEMORY_FOLDER, None)
    spans = [(*span, path) for path, span in recordings.items()]
    for first, last, path in sorted(each for each in spans if window.overlaps(each[0], each[1])):
        open_spans = [each for each in open_spans if each[1] >= first]
        for since, until, other in open_spans:
            span = TimeWindow(first, min(last, until) + 1)
            if window.overlaps(span.start, span.stop - 1):
                shortest = min(last - first, until - since)
                is_edge = since < first and until < last and 2 * (until - first) < shortest
                is_step = span.stop - 1 - span.start <= max(steps[path], steps[other])
                yield Beside(other, path, span, is_edge or is_step)
        open_spans.append((first, last, path))


def _beside_themselves(view: View, window: TimeWindow) -> Iterator[Beside]:
    """Yields recordings in which the clock was set back, with the bags from after that."""
    for fault in view.snapshot.dating.faults:
        after = split_of(fault.bag.file)
        if fault.kind is not FaultyClock.SET_BACK or fault.before is None or after is None:
            continue
        series, number = after
        twice = TimeWindow(fault.bag.start, fault.before.end + 1)
        splits = [(split_of(bag.file), bag) for bag in view.timeline.overlapping(twice)]
        own = [(split[1], bag) for split, bag in splits if split is not None and split[0] == series]
        begin = min((bag.start for nth, bag in own if nth < number), default=twice.stop)
        span = TimeWindow(min(max(begin, twice.start), twice.stop), twice.stop)
        bags = frozenset(bag.file for nth, bag in own if nth >= number)
        if span.start < span.stop and window.overlaps(span.start, span.stop - 1) and bags:
            recording = fault.bag.recording
            yield Beside(recording, recording, span, by_clock=True, bags=bags)


def _steps_back(view: View) -> Mapping[Path, Ns]:
    """Returns how far the clock was set back at most while a recording ran; 0 for others."""
    steps: dict[Path, Ns] = defaultdict(int)
    for fault in view.snapshot.dating.faults:
        if fault.kind is FaultyClock.SET_BACK:
            steps[fault.bag.recording] = max(fault.by, steps[fault.bag.recording])
    return steps


def _differ(view: View, topic: str, pair: tuple[Path, Path], both: TimeWindow) -> bool:
    """Whether two recordings hold messages in a window, and the other none of the one's."""
    known, key = view.timeline.memo.of(_DIFFERING, dict), (topic, pair, both)
    if key in known:
        return known[key]
    if sessions_of(view).are_joined(*pair) or not all(_has_bags(view, path, both) for path in pair):
        return False
    wide, noted = both.widened(COPY_HORIZON_NS), view.notes.added
    bags = view.stream.overlapping_bags([topic], wide)
    one, other = ([each for each in bags if each.bag.recording == path] for path in pair)
    differ = _differ_in(view, topic, (one, other), both)
    if view.notes.added == noted:  # else something could not be read, and may be next time
        known[key] = differ
    return differ


def _has_bags(view: View, recording: Path, window: TimeWindow) -> bool:
    """Whether a recording may have bags in a window: one that a wrong clock dated spans years."""
    folder = str(recording)
    segments = view.timeline.segments_in(window)
    spans = (segment.folder_spans[folder] for segment in segments if folder in segment.folders)
    return any(window.overlaps(*span) for span in spans)


def _differ_in(
    view: View, topic: str, bags: tuple[Sequence[BagSpan], Sequence[BagSpan]], both: TimeWindow
) -> bool:
    """Does as `_differ`, for the bags of each."""
    one, other = bags
    if next(_messages(view, topic, other, both), None) is None:
        return False
    some = list(islice(_messages(view, topic, one, both), _TRIED))
    for found in some:
        near = TimeWindow.around(found.time, COPY_HORIZON_NS)
        key = copy_key(found.record)
        if any(copy_key(each.record) == key for each in _messages(view, topic, other, near)):
            return False
    return bool(some)


def _messages(
    view: View, topic: str, bags: Sequence[BagSpan], window: TimeWindow
) -> Iterator[StoredMessage]:
    inside = [each for each in bags if window.overlaps(each.first, each.last)]
    return view.stream.merged(inside, [topic], window, newest_first=False)
