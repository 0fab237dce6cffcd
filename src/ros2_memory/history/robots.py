"""Recordings of several robots that are answered together, as one history.

Recordings that hold a topic at the same time are of one robot where a handover joins them, or where
most messages of one are in the other too. At other times they are of several where a frame has one
parent here and another one there.
"""

from __future__ import annotations

from collections import defaultdict
from itertools import chain, combinations, islice, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.layout import MEMORY_FOLDER, has_own_name, is_kept_apart
from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.core.bag_summary import OUT_OF_ORDER_NS
from ros2_memory.core.errors import NoDataError, NoDataReason, NotInLakeError, QueryTimeoutError
from ros2_memory.core.memo import Key
from ros2_memory.core.model import BagFile, BagState, TimeWindow
from ros2_memory.core.spans import COPY_HORIZON_NS, Spans, united
from ros2_memory.core.text import counted, listed
from ros2_memory.core.timebase import NS_PER_S, Ns, iso_local
from ros2_memory.history.coverage import unix_text
from ros2_memory.history.view import View
from ros2_memory.index.clock_faults import FaultyClock
from ros2_memory.index.recordings import (
    Overlapping,
    overlapping_recordings,
    recordings_of,
)
from ros2_memory.index.segment import TopicExtent
from ros2_memory.index.split_order import split_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from ros2_memory.history.context import Call, Memory
    from ros2_memory.history.stored_message import StoredMessage

_NEAR_NS: Final = 10 * NS_PER_S
"""How far around one message others count as recorded at the same time."""
_SLOW_NS: Final = 600 * NS_PER_S
"""As far where recordings overlap at that time: some topics have a message in minutes."""
_TRIED: Final = 7
"""How many messages are looked for in the other recording: a subscriber may miss some."""
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
_MADE: Final[Key[frozenset[Path]]] = Key()
"""Of a call: the recordings that this bag directory's recorder made, one after the other."""
_PARENTS: Final[Key[dict[str, Mapping[str, str]]]] = Key()
"""Of a memory: the parent of each static frame of a recording that is closed."""
SET_BACK: Final = "the clock was set back between recordings"
"""The begin of a sentence on recordings that one recorder made, and that overlap in time."""
ADVICE: Final = "; data.recording selects one recording"
"""The end of a sentence on robots that are mixed."""
_RECENT_NS: Final = 60 * NS_PER_S
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
        first, other = self.recordings
        return Overlapping(Path(first), Path(other), 0, 0).names

    def __str__(self) -> str:
        """Returns a sentence, without a full stop."""
        first, other = self.names
        return (
            f"the frame {self.frame} is in {self.parents[0]} in the recording {first}, and in "
            f"{self.parents[1]} in {other}, as of two robots"
        )


def mixed_recordings(memory: Memory, call: Call) -> tuple[Mixed, ...]:
    """Returns the recordings that overlap in time, with a topic on which they differ.

    Overlaps are known from the index; those that a clock made, which was set back while one of the
    recordings ran, show no second robot. A few messages are read once of each of the first pairs.
    """
    view = View(memory, call)  # notes on what is read here are of no answer
    mixed: list[Mixed] = []
    pairs = overlapping_recordings(view.snapshot, memory.index.joined_with)
    bags, steps = recordings_of(view.snapshot) if pairs else {}, _steps_back(view)
    for pair in pairs:
        by_clock = pair.end - pair.start <= max(steps[pair.first], steps[pair.second])
        is_compared = not by_clock and len(mixed) < _MAX_PAIRS
        try:
            mixed.append(Mixed(pair, _differing_topic(view, pair, bags) if is_compared else None))
        except QueryTimeoutError:
            break
    return tuple(mixed)


def are_of_one_recorder(memory: Memory, pair: Overlapping) -> bool:
    """Whether this bag directory's recorder made both, one after the other by its list.

    Then they overlap in time since the clock was set back.
    """
    return _made_in(memory.index.bag_dir).issuperset((pair.first, pair.second))


def _made_in(bag_dir: Path) -> frozenset[Path]:
    """Returns the recordings that a bag directory's recorder made; none if that is not known."""
    try:
        return frozenset(bag_dir / name for name in OwnRecordings(bag_dir).in_order())
    except OSError:
        return frozenset()


def contradicting_frames(memory: Memory, call: Call) -> tuple[Contradiction, ...]:
    """Returns frames that have one parent in one recording and another in another one.

    By static transforms. Of this program's own recordings in one folder the newest is compared
    alone: they are of one robot.
    """
    view = View(memory, call)
    parents_by_path = memory.memo.of(_PARENTS, dict)
    trees: dict[str, Mapping[str, str]] = {}
    for path, bags in _recordings_to_compare(view):
        try:
            parents = parents_by_path.get(path) or _static_parents(view, bags)
        except QueryTimeoutError:
            break
        if not any(bag.state is BagState.ACTIVE for bag in bags):
            parents_by_path[path] = parents
        trees[path] = parents
    contradictions: dict[str, Contradiction] = {}
    for (first_path, parents), (other, others) in combinations(trees.items(), 2):
        for frame in sorted(parents.keys() & others.keys()):
            if parents[frame] != others[frame]:
                both = (parents[frame], others[frame])
                contradictions.setdefault(frame, Contradiction((first_path, other), frame, both))
    return tuple(contradictions.values())


def describe_mixed(memory: Memory, call: Call) -> tuple[str, ...]:
    """Returns sentences where robots, or times, are plainly mixed; a minute old at most.

    With a week of bags a new check takes 0.1 s, and the page asks every few seconds.
    """
    now, described = memory.clock.now(), memory.memo.of(_DESCRIBED, list)
    for described_at, sentences in described:
        if abs(now - described_at) <= _RECENT_NS:
            return sentences
    sentences = tuple(_mixed_sentences(memory, call))
    described[:] = [(now, sentences)]
    return sentences


def _mixed_sentences(memory: Memory, call: Call) -> Iterator[str]:
    mixed = [both for both in mixed_recordings(memory, call) if both.topic is not None]
    for is_one, what, but in (
        (False, "robots are mixed", "answers treat them as one robot"),
        (True, SET_BACK, "one recorder made them, one after the other"),
    ):
        overlapping = [both for both in mixed if are_of_one_recorder(memory, both.pair) is is_one]
        if not overlapping:
            continue
        names = sorted({name for recordings in overlapping for name in recordings.pair.names})
        first = overlapping[0]
        yield (
            f"{what}: {listed(names)} overlap in time (from {iso_local(first.pair.start)}), each "
            f"with different messages on {first.topic}, but {but}{ADVICE}"
        )
    contradictions = contradicting_frames(memory, call)
    if contradictions:
        more = len(contradictions) - 1
        yield f"robots are mixed: {contradictions[0]}{f' (and {more} more)' if more else ''}"


def _differing_topic(
    view: View, pair: Overlapping, recordings: Mapping[str, Sequence[BagFile]]
) -> str | None:
    both = TimeWindow(pair.start, pair.end + 1)
    bags = [
        [bag for bag in recordings.get(str(path), ()) if bag.reaches_into(both)]
        for path in (pair.first, pair.second)
    ]
    shared = set.intersection(*map(_topics_of, bags)) - view.timeline.transient_local
    of_robot = [topic for topic in (view.pose_topic, *view.limits.tf_topics) if topic in shared]
    for topic in islice([*of_robot, *sorted(shared.difference(of_robot))], _MAX_COMPARED):
        if _bags_differ(view, topic, [_bag_spans(some, topic) for some in bags], both):
            return topic
    return None


def _topics_of(bags: Sequence[BagFile]) -> set[str]:
    return {topic for bag in bags for topic in bag.summary.schema.positions}


def _bag_spans(bags: Sequence[BagFile], topic: str) -> list[TopicExtent]:
    holding = (bag for bag in bags if topic in bag.summary.schema.positions)
    return [TopicExtent(bag, *bag.summary.span_of((topic,))) for bag in holding]


def _recordings_to_compare(view: View) -> list[tuple[str, Sequence[BagFile]]]:
    """Returns the newest recordings with static transforms, of this program's one in a folder."""
    topics = view.limits.tf_static_topics
    root = f"{view.bag_dir}/"
    bags_of: dict[str, Sequence[BagFile]] = {}
    newest: dict[str, str] = {}
    holding = recordings_of(view.snapshot, lambda schema: any(map(schema.positions.get, topics)))
    for path, bags in holding.items():
        folder, _, name = path.rpartition("/")
        if not is_kept_apart(path.removeprefix(root)):
            bags_of[path] = bags
            maker = folder if has_own_name(name) else path
            if maker not in newest or bags_of[newest[maker]][0].start < bags[0].start:
                newest[maker] = path
    ordered = sorted(newest.values(), key=lambda path: bags_of[path][0].start)
    return [(path, bags_of[path]) for path in ordered[-_MAX_TREES:]] if len(ordered) > 1 else []


def _static_parents(view: View, bags: Sequence[BagFile]) -> dict[str, str]:
    """Returns the parent of each static frame of a recording, as it was stated last."""
    parents: dict[str, str] = {}
    window = TimeWindow.everything()
    for topic in view.limits.tf_static_topics:
        spans = _bag_spans(bags, topic)
        merged = view.stream.merged(spans, [topic], window) if spans else ()
        for stored in islice(merged, _MAX_STATIC):
            message = view.bags.decode(stored)
            if message is not None:
                edges = view.extractor.transforms(message, stored.time, static=True)
                parents.update({edge.child: edge.parent for edge in edges})
    return parents


class ParallelRecordings(NamedTuple):
    """Two recordings with messages of their own on a topic at the same time.

    Or one, with itself, in which the clock was set back.

    Attributes:
        first: the one that holds the topic first.
        other: the other one.
        span: when both hold the topic.
        by_clock: whether that is as where a clock was set back between two recordings: it is the
            end of the first and the begin of the other, and less than half of each; or no longer
            than the clock was set back while one of them ran; or one recorder made both.
    """

    first: Path
    other: Path
    span: TimeWindow
    by_clock: bool
    bags: frozenset[str] = frozenset()
    """Of the other one, the files of which messages are beside those of the first; none: all."""

    @property
    def is_twice(self) -> bool:
        """Whether it is one recording, which has a time twice."""
        return self.first == self.other

    def described(self, topic: str) -> str:
        """Returns what a clock made, as a sentence without a full stop."""
        span = f"from {unix_text(self.span.start)} to {unix_text(self.span.stop - 1)}"
        if self.is_twice:
            return (
                f"{self.first.name} has the time {span} twice, as the clock was set back meanwhile"
            )
        return (
            f"{self.first.name} and {self.other.name} have different messages on {topic} {span}, "
            "as after a clock was set back, or from two robots"
        )


def require_one_robot(view: View, topic: str, window: TimeWindow) -> None:
    """Checks that a path by this topic is that of one robot: else it jumps between several.

    A note says where recordings overlap as after a clock was set back, and of which the path is
    there.

    Raises:
        NoDataError: recordings hold messages of their own on the topic at the same time.
    """
    beside = parallel_or_twice(view, topic, window)
    # Transforms are of all recordings at once, so a path by them is not that of one there.
    by_transforms = topic in view.limits.tf_topics
    names = _recording_names([pair for pair in beside if by_transforms or not pair.by_clock])
    if names:
        raise NoDataError(
            NoDataReason.MIXED,
            f"{counted(len(names), 'recording has', 'recordings have')} different messages on "
            f"{topic} at the same time, as from several robots: {listed(names)}; one path over "
            "them would be wrong: ask about a time with one of them, or set data.recording to one",
        )
    for pair in beside:
        before = "files from before" if pair.is_twice else pair.first.name
        view.notes.add(f"{pair.described(topic)}: the path there is that of {before}")


def note_robots(view: View, topic: str, window: TimeWindow) -> Spans:
    """Notes the recordings that hold messages of their own on a topic at the same time.

    And the times that one holds twice. Returns these times, without those that two recordings share
    by a clock which was set back.
    """
    beside = parallel_or_twice(view, topic, window)
    names = _recording_names([pair for pair in beside if not pair.by_clock])
    if names:
        view.notes.add(
            f"{len(names)} recordings have different messages on {topic} at the same time, as "
            f"from several robots, and the answer does not separate them: {listed(names)}"
        )
    for pair in beside:
        if pair.by_clock:
            view.notes.add(f"{pair.described(topic)}: the answer does not separate the two")
    spans = [pair.span for pair in beside if pair.is_twice or not pair.by_clock]
    return united((span.start, span.stop) for span in spans)


def _recording_names(beside: Sequence[ParallelRecordings]) -> list[str]:
    return sorted({path.name for pair in beside for path in (pair.first, pair.other)})


def parallel_or_twice(view: View, topic: str, window: TimeWindow) -> list[ParallelRecordings]:
    """Returns all that would make a path by a topic go to and fro between two times of a robot.

    Recordings beside each other not of latched topics, which each recording receives again, nor
    where that is not known.
    """
    holding = view.timeline.recordings(topic)
    is_latched = topic in view.timeline.transient_local
    beside = [] if is_latched else _recordings_beside(view, topic, window) or []
    twice = (pair for pair in _times_recorded_twice(view, window) if pair.first in holding)
    return [*beside, *twice]


def recordings_apart(
    view: View, topics: Sequence[str], window: TimeWindow
) -> frozenset[Path] | None:
    """Returns the recordings that are beside another one on some topics, latched ones too.

    None where that is not known.
    """
    apart: set[Path] = set()
    for topic in topics:
        pairs = _recordings_beside(view, topic, window)
        if pairs is None:
            return None
        apart.update(path for pair in pairs for path in (pair.first, pair.other))
    return frozenset(apart)


def _recordings_beside(
    view: View, topic: str, window: TimeWindow
) -> list[ParallelRecordings] | None:
    """Returns the recordings that hold messages of their own on a topic at the same time.

    None where the time for the answer is over before it is known, or a lake does not hold the
    messages.
    """
    differing: list[ParallelRecordings] = []
    apart: set[Path] = set()
    noted_before = view.notes.keys()
    try:
        for beside in _overlapping_pairs(view, topic, window):
            pair = beside.first, beside.other
            # Of several robots in a folder there may be thousands of pairs.
            is_known = not beside.by_clock and apart.issuperset(pair)
            if not is_known and _differ(view, topic, pair, beside.span.intersect(window)):
                differing.append(beside)
                apart.update(() if beside.by_clock else pair)
    except (QueryTimeoutError, NotInLakeError):
        return None
    finally:
        # The answer itself needed nothing of what was read here.
        view.notes.retract_outside(keep=noted_before)
    return differing


def note_robots_on(view: View, topics: Sequence[str], window: TimeWindow) -> Spans:
    """Notes, for the first topics, the recordings that hold messages of their own at one time.

    Returns these times; see `note_robots`.
    """
    spans_by_topic = [note_robots(view, topic, window) for topic in topics[:_MAX_TOPICS]]
    return united(chain.from_iterable(spans_by_topic))


def note_robots_near(view: View, stored: StoredMessage) -> None:
    """Notes recordings with messages of their own around the time of a message; see `note_robots`.

    Or that one has this time twice.
    """
    topic, at = stored.topic, stored.time
    pairs = _overlapping_pairs(view, topic, TimeWindow.around(at, _NEAR_NS))
    if any(chain(pairs, _times_recorded_twice(view, TimeWindow(at, at + 1)))):
        note_robots(view, topic, TimeWindow.around(at, _SLOW_NS))


def _overlapping_pairs(view: View, topic: str, window: TimeWindow) -> Iterator[ParallelRecordings]:
    """Yields pairs of recordings that hold a topic at the same time in a window."""
    open_spans: list[tuple[Ns, Ns, Path]] = []
    steps = _steps_back(view)
    recordings = dict(view.timeline.recordings(topic))
    # A thinned day lies around what moments and rules have of it.
    recordings.pop(view.bag_dir / MEMORY_FOLDER, None)
    spans = [(*span, path) for path, span in recordings.items() if window.overlaps(*span)]
    for first, last, path in sorted(spans):
        open_spans = [(since, until, other) for since, until, other in open_spans if until >= first]
        for since, until, other in open_spans:
            span = TimeWindow(first, min(last, until) + 1)
            # One that a wrong clock dated spans years, mostly without a bag.
            near = view.timeline.segments_in(span.widened(COPY_HORIZON_NS))
            is_there = until <= last or any(
                str(other) in some.bags.folders and other in some.recordings(topic) for some in near
            )
            if is_there and window.overlaps(span.start, span.stop - 1):
                shortest = min(last - first, until - since)
                is_edge = since < first and until < last and 2 * (until - first) < shortest
                is_step = span.stop - 1 - span.start <= max(steps[path], steps[other])
                own = view.memo.of(_MADE, lambda: _made_in(view.bag_dir))
                by_clock = is_edge or is_step or own.issuperset((other, path))
                yield ParallelRecordings(other, path, span, by_clock)
        open_spans.append((first, last, path))


def _times_recorded_twice(view: View, window: TimeWindow) -> Iterator[ParallelRecordings]:
    """Yields recordings in which the clock was set back, with the bags from after that.

    Of a bag in which that happened it is not known which messages are from before, and when that
    was to the period of its fastest topic.
    """
    for fault in view.snapshot.dating.faults:
        if fault.kind is not FaultyClock.SET_BACK:
            continue
        twice = TimeWindow(fault.at, fault.at + fault.by + 1)
        if fault.before is None:
            twice = twice.widened(OUT_OF_ORDER_NS)
        series, number = split_of(fault.bag.file) or (None, 0)
        begins = [twice.start if fault.before is None else twice.stop]
        bags = {fault.bag.file}
        for bag in view.timeline.overlapping(twice):
            bag_series, bag_number = split_of(bag.file) or ("", 0)
            if bag_series == series and bag_number < number:
                begins.append(bag.start)
            elif bag_series == series:
                bags.add(bag.file)
        span = TimeWindow(max(min(begins), twice.start), twice.stop)
        if span.start < span.stop and window.overlaps(span.start, span.stop - 1):
            recording = fault.bag.recording
            yield ParallelRecordings(
                recording, recording, span, by_clock=True, bags=frozenset(bags)
            )


def _steps_back(view: View) -> Mapping[Path, Ns]:
    """Returns how far the clock was set back at most while a recording ran; 0 for others."""
    steps: dict[Path, Ns] = defaultdict(int)
    for fault in view.snapshot.dating.faults:
        if fault.kind is FaultyClock.SET_BACK:
            steps[fault.bag.recording] = max(fault.by, steps[fault.bag.recording])
    return steps


def _differ(view: View, topic: str, pair: tuple[Path, Path], both: TimeWindow) -> bool:
    """Whether two recordings hold messages in a window, and each lacks most of the other's."""
    differing, key = view.timeline.memo.of(_DIFFERING, dict), (topic, pair, both)
    if key in differing:
        return differing[key]
    if view.sessions.are_joined(*pair):
        return False
    noted = view.notes.added
    near = view.stream.overlapping_bags([topic], both.widened(COPY_HORIZON_NS))
    bags = [[span for span in near if span.bag.recording == path] for path in pair]
    differ = all(bags) and _bags_differ(view, topic, bags, both)
    if view.notes.added == noted:  # else something could not be read, and may be next time
        differing[key] = differ
    return differ


def _bags_differ(
    view: View,
    topic: str,
    bags: Sequence[Sequence[TopicExtent]],
    both: TimeWindow,
) -> bool:
    """Whether two lists of bags hold messages in a window, and each lacks most of the other's.

    Two runs of a simulation share some, as those of a robot that has not moved yet.
    """
    return all(_lacks_most(view, topic, pair, both) for pair in (bags, bags[::-1]))


def _lacks_most(
    view: View,
    topic: str,
    bags: Sequence[Sequence[TopicExtent]],
    both: TimeWindow,
) -> bool:
    """Whether the second lacks most of some messages that the first has all over a window."""
    first, other = bags
    length = both.stop - both.start
    edges = [both.start + length * nth // _TRIED for nth in range(_TRIED + 1)]
    tried, lacking = 0, 0
    for start, stop in pairwise(edges):
        stored = next(_merged_messages(view, topic, first, TimeWindow(start, stop)), None)
        if stored is not None:
            near = TimeWindow.around(stored.time, COPY_HORIZON_NS)
            copies = _merged_messages(view, topic, other, near)
            tried += 1
            lacking += all(copy.identity != stored.identity for copy in copies)
        if 2 * lacking > _TRIED:
            return True  # whatever the others are
    return 2 * lacking > tried


def _merged_messages(
    view: View, topic: str, bags: Sequence[TopicExtent], window: TimeWindow
) -> Iterator[StoredMessage]:
    inside = [span for span in bags if window.overlaps(span.first, span.last)]
    return view.stream.merged(inside, [topic], window)
