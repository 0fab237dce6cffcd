"""Recordings of several robots that are answered together, as one history.

Recordings that hold a topic at the same time are of one robot if a handover joins them, or if most
messages of one are in the other too. Recordings of different times are of several robots if a frame
has different parents in them.
"""

from __future__ import annotations

from collections import defaultdict
from contextlib import suppress
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
from ros2_memory.core.text import listed
from ros2_memory.core.timebase import MIN_NS, NS_PER_MS, NS_PER_S, Ns, Span, iso_local, unix_from_ns
from ros2_memory.history.coverage import unix_text
from ros2_memory.history.merged_stream import copies_in
from ros2_memory.history.view import View
from ros2_memory.index.clock_faults import FaultyClock
from ros2_memory.index.recordings import loose_bags_beside_others, recordings_of
from ros2_memory.index.segment import TopicExtent, wider
from ros2_memory.index.split_order import split_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from ros2_memory.history.bag_access import StoredMessage
    from ros2_memory.history.context import Call, Memory

_NEAR_NS: Final = 10 * NS_PER_S
"""Recordings are of the time of a message if they are this near."""
_SLOW_NS: Final = 600 * NS_PER_S
"""Recordings are compared this far around what is asked about: some topics have a message only in
minutes, and in a few seconds each recorder may lose what the other one receives."""
_TRIED: Final = 7
"""So many messages are looked for in the other recording: a subscriber may miss some."""
_FEWEST_SHIFTED: Final = 2
"""So many different messages show that two clocks differ: two robots, too, say one alike."""
_JITTER_NS: Final = 200 * NS_PER_MS
"""Two recorders of one clock receive a message at times that differ by less than this."""
_DRIFT: Final = 10_000
"""Two clocks drift apart by less than one in so many: of crystals, 100 parts per million."""
_MAX_PAIRS: Final = 20
"""At most so many pairs of recordings are compared for the whole memory."""
_MAX_TOPICS: Final = 3
"""At most so many topics of a question are compared."""
_MAX_COMPARED: Final = 8
"""At most so many topics are compared for the whole memory: robots may share some (`/clock`)."""
_MAX_TREES: Final = 32
"""The static transforms of so many recordings are compared, the newest."""
_MAX_STATIC: Final = 50
"""At most so many messages of static transforms are read of a recording."""
MOST_REMEMBERED: Final = 1_000
"""So many comparisons of two recordings are remembered: each window of a question is one."""
_DIFFERING: Final[Key[dict[tuple[str, tuple[Path, Path], TimeWindow], bool]]] = Key()
"""Of a timeline: by topic, pair and window, whether the recordings hold different messages."""
_SHIFTS: Final[Key[dict[tuple[str, tuple[Path, Path], TimeWindow], Ns | None]]] = Key()
"""Of a timeline: by topic, pair and window, how far apart the recordings hold the same messages."""


_TREES: Final[Key[dict[tuple[str, int], Mapping[str, str]]]] = Key()
"""Of a memory: the parent of each static frame, by a closed recording and a hash of its files."""
_LONG_NS: Final = 30 * NS_PER_S
"""A shorter overlap at the ends of two recordings is named in the answers that it touches alone."""
ADVICE: Final = "; data.recording selects one recording"
"""Ends a sentence on mixed robots."""
_RECENT_NS: Final = 60 * NS_PER_S
_DESCRIBED: Final[Key[list[tuple[Ns, tuple[str, ...]]]]] = Key()
"""Of a memory: when `describe_mixed` last checked, and its sentences."""


def _own_recordings(bag_dir: Path) -> frozenset[Path]:
    """Returns the recordings that the recorder of a bag directory made; none if unknown."""
    try:
        return frozenset(bag_dir / name for name in OwnRecordings(bag_dir).in_order())
    except OSError:
        return frozenset()


def describe_mixed(memory: Memory, call: Call) -> tuple[str, ...]:
    """Returns sentences on robots, or times, that are mixed; at most a minute old.

    A check takes 0.1 s with a week of bags, and the page asks every few seconds.
    """
    now, described = memory.clock.now(), memory.memo.of(_DESCRIBED, list)
    for described_at, sentences in described:
        if abs(now - described_at) <= _RECENT_NS:
            return sentences
    sentences = tuple(_mixed_sentences(View(memory, call)))  # its notes belong to no answer
    described[:] = [(now, sentences)]
    return sentences


def _mixed_sentences(view: View) -> Iterator[str]:
    yield from _overlap_sentences(view)
    contradictions = [*_contradicting_frames(view)]
    if contradictions:
        more = len(contradictions) - 1
        yield f"robots are mixed: {contradictions[0]}{f' (and {more} more)' if more else ''}"


def _overlap_sentences(view: View) -> Iterator[str]:
    """Yields a sentence on recordings with different messages at the same time, if there are any.

    It is about the first topic on which several robots show, or else about a long overlap that a
    clock explains. The robot's own topics come first, of which only some pairs are compared.
    """
    by_clock: list[str] = []
    for topic in islice(_shared_topics(view), _MAX_COMPARED):
        parallel = _parallel_recordings(view, topic, TimeWindow.everything(), _MAX_PAIRS) or []
        robots = [pair for pair in parallel if not pair.by_clock]
        if robots:
            yield (
                f"robots are mixed: {listed(_recording_names(view, robots))} overlap in time (from "
                f"{iso_local(robots[0].span.start)}), each with different messages on {topic}, but "
                f"answers treat them as one robot{ADVICE}"
            )
            return
        long_ones = (pair for pair in parallel if pair.span.stop - pair.span.start > _LONG_NS)
        by_clock += (pair.describe_by_clock(topic) for pair in long_ones)
    if by_clock:
        yield f"recordings overlap in time: {by_clock[0]}"


def _shared_topics(view: View) -> Iterator[str]:
    """Yields the topics that several recordings hold, those of the robot's poses first."""
    recorded = view.timeline.topics()
    of_robot = [view.pose_topic, *view.limits.tf_topics]
    for topic in dict.fromkeys([*of_robot, *sorted(recorded)]):
        is_latched = topic in view.timeline.transient_local
        if topic in recorded and not is_latched and len(_recordings_with(view, topic)) > 1:
            yield topic


def _contradicting_frames(view: View) -> Iterator[str]:
    """Yields a sentence on each static frame that has different parents in two recordings."""
    contradicting: set[str] = set()
    for (first, parents), (other, others) in combinations(_static_trees(view).items(), 2):
        for frame in sorted(parents.keys() & others.keys() - contradicting):
            if parents[frame] != others[frame]:
                contradicting.add(frame)
                yield (
                    f"the frame {frame} is in {parents[frame]} in the recording "
                    f"{_name(view, first)}, and in {others[frame]} in {_name(view, other)}, as of "
                    "two robots"
                )


def _static_trees(view: View) -> dict[str, Mapping[str, str]]:
    """Returns the parents of static frames by recording, without those that time is too short for.

    Those of closed bags are remembered until a bag of theirs comes or goes.
    """
    remembered = view.memory.memo.of(_TREES, dict)
    known = dict(remembered)
    remembered.clear()
    trees: dict[str, Mapping[str, str]] = {}
    for path, bags in _recordings_to_compare(view):
        key = path, hash(tuple(bag.identity for bag in bags))
        try:
            trees[path] = known[key] if key in known else _static_parents(view, bags)
        except QueryTimeoutError:
            continue
        if not any(bag.state is BagState.ACTIVE for bag in bags):
            remembered[key] = trees[path]
    return trees


def _recordings_to_compare(view: View) -> list[tuple[str, Sequence[BagFile]]]:
    """Returns the newest recordings with static transforms, with their bags; none if it is one.

    The recordings that this program made in one folder are of one robot: only the newest of them
    counts.
    """
    topics = view.limits.tf_static_topics
    root = f"{view.bag_dir}/"
    newest: dict[str, tuple[str, Sequence[BagFile]]] = {}
    holding = recordings_of(view.snapshot, lambda schema: any(map(schema.positions.get, topics)))
    in_order = sorted(holding.items(), key=lambda recording: recording[1][0].start)
    for path, bags in in_order:
        folder, _, name = path.rpartition("/")
        if not is_kept_apart(path.removeprefix(root)):
            maker = folder if has_own_name(name) else path
            newest.pop(maker, None)
            newest[maker] = path, bags
    return [*newest.values()][-_MAX_TREES:] if len(newest) > 1 else []


def _static_parents(view: View, bags: Sequence[BagFile]) -> dict[str, str]:
    """Returns the last parent of each static frame of a recording."""
    parents: dict[str, str] = {}
    window = TimeWindow.everything()
    for topic in view.limits.tf_static_topics:
        holding = (bag for bag in bags if topic in bag.summary.schema.positions)
        spans = [TopicExtent(bag, *bag.summary.span_of((topic,))) for bag in holding]
        merged = view.stream.merged(spans, [topic], window) if spans else ()
        for stored, message in view.bags.decoded(islice(merged, _MAX_STATIC)):
            edges = view.extractor.transforms(message, stored.time, static=True)
            parents.update({edge.child: edge.parent for edge in edges})
    return parents


class ParallelRecordings(NamedTuple):
    """Two recordings with different messages on a topic at the same time.

    Or one recording in which the clock was set back, twice.

    Attributes:
        first: the recording that holds the topic first.
        other: the other one.
        span: when both hold the topic.
        by_clock: whether a wrong clock explains it: the span is the end of the first and the begin
            of the other, and less than half of each; or one of them has a wrong date; or one
            recorder made both, one after the other; or `shift` is known.
        bags: the files of the other recording that overlap the first; empty for all in its folder.
        shift: how much later (ns) the other one has the same messages; None if it has others.
    """

    first: Path
    other: Path
    span: TimeWindow
    by_clock: bool
    bags: frozenset[str] = frozenset()
    shift: Ns | None = None

    @property
    def is_twice(self) -> bool:
        """Whether it is one recording that has a time twice."""
        return self.first == self.other

    def describe_by_clock(self, topic: str) -> str:
        """Returns a sentence, without a full stop, on a pair that a clock explains.

        Pairs of the same two recorders have the same one: there may be hundreds.
        """
        if self.shift is not None:
            apart_s = unix_from_ns(abs(self.shift))
            return (
                f"two recorders have the same messages of {topic} {apart_s:.1f} s apart, as their "
                "clocks differ"
            )
        span = f"from {unix_text(self.span.start)} to {unix_text(self.span.stop - 1)}"
        if self.is_twice:
            return (
                f"{self.first.name} has the time {span} twice, as the clock was set back meanwhile"
            )
        return (
            f"{self.first.name} and {self.other.name} differ on {topic} {span}, as after a clock "
            "was set back, or of two robots"
        )


def require_one_robot(view: View, topic: str, window: TimeWindow) -> None:
    """Checks that a path by this topic is of one robot: else it would jump between several.

    If a clock explains an overlap, a note says which recording the path follows there.

    Raises:
        NoDataError: recordings hold different messages on the topic at the same time.
    """
    parallel = parallel_or_twice(view, topic, window)
    # A path by transforms uses all recordings at once: it cannot follow one of them.
    by_transforms = topic in view.limits.tf_topics
    names = _recording_names(
        view, [pair for pair in parallel if by_transforms or not pair.by_clock]
    )
    if names:
        raise NoDataError(
            NoDataReason.MIXED,
            f"recordings differ on {topic} at the same time, as of several robots: "
            f"{listed(names)}; ask about a time with one of them, or set data.recording to one",
        )
    for pair in parallel:
        named = pair.first.name if pair.shift is None else "the first"
        before = "files from before" if pair.is_twice else named
        view.notes.add(f"{pair.describe_by_clock(topic)}: the path there is that of {before}")


def note_robots(view: View, topic: str, window: TimeWindow, *, places: bool = False) -> Spans:
    """Notes recordings with different messages on a topic at the same time, and times held twice.

    With `places` the answer says what was where, which is not known in a time held twice. Returns
    these times, without the overlaps of two recordings that a clock explains.
    """
    parallel = parallel_or_twice(view, topic, window)
    names = _recording_names(view, [pair for pair in parallel if not pair.by_clock])
    if names:
        view.notes.add(
            f"recordings differ on {topic} at the same time, as of several robots, and are mixed "
            f"here: {listed(names)}"
        )
    for pair in parallel:
        if pair.by_clock:
            is_left_out = places and pair.is_twice
            what = "what was where then is not known" if is_left_out else "the two are mixed here"
            view.notes.add(f"{pair.describe_by_clock(topic)}: {what}")
    spans = [pair.span for pair in parallel if pair.is_twice or not pair.by_clock]
    return united((span.start, span.stop) for span in spans)


def _recording_names(view: View, pairs: Sequence[ParallelRecordings]) -> list[str]:
    paths = {path for pair in pairs for path in (pair.first, pair.other)}
    return sorted(_name(view, str(path)) for path in paths)


def _name(view: View, path: str) -> str:
    """Returns the name of a recording: its path in the bag directory."""
    root = f"{view.bag_dir}/"
    return path.removeprefix(root) if path.startswith(root) else Path(path).name


def parallel_or_twice(view: View, topic: str, window: TimeWindow) -> list[ParallelRecordings]:
    """Returns what would make a path by a topic jump to and fro.

    That is recordings with different messages at the same time, and recordings that have a time
    twice. Recordings are not compared on latched topics, which each recording receives again.
    """
    parallel: list[ParallelRecordings] = []
    if topic not in view.timeline.transient_local:
        parallel += _parallel_recordings(view, topic, window) or ()
    holding = view.timeline.recordings(topic)
    parallel += (pair for pair in times_recorded_twice(view, window) if pair.first in holding)
    return parallel


def recordings_apart(
    view: View, topics: Sequence[str], window: TimeWindow
) -> frozenset[Path] | None:
    """Returns the recordings that differ from a parallel one on some topics, latched ones too.

    Not those that have its messages by another clock. None if unknown; see `_parallel_recordings`.
    """
    apart: set[Path] = set()
    for topic in topics:
        pairs = _parallel_recordings(view, topic, window)
        if pairs is None:
            return None
        apart.update(
            path for pair in pairs if pair.shift is None for path in (pair.first, pair.other)
        )
    return frozenset(apart)


def _parallel_recordings(
    view: View, topic: str, window: TimeWindow, most_pairs: int | None = None
) -> list[ParallelRecordings] | None:
    """Returns the recordings with different messages on a topic at the same time.

    Of many pairs the first `most_pairs` are compared. None, with a note, if the call's time is over
    before it is known; None, too, if a lake does not hold the messages.
    """
    differing: list[ParallelRecordings] = []
    apart: set[Path] = set()
    # The answer itself does not need what is read here.
    try:
        with view.notes.apart(), suppress(NotInLakeError):
            for parallel in islice(_overlapping_pairs(view, topic, window), most_pairs):
                pair = parallel.first, parallel.other
                # Several robots in one folder have thousands of pairs: once is enough for each.
                is_known = not parallel.by_clock and apart.issuperset(pair)
                both = parallel.span.intersect(window.widened(_SLOW_NS))
                if not is_known and _differ(view, topic, pair, both):
                    shift = _shift_of_clock(view, topic, pair, parallel.span)
                    by_clock = parallel.by_clock or shift is not None
                    differing.append(parallel._replace(by_clock=by_clock, shift=shift))
                    apart.update(() if by_clock else pair)
            return differing
    except QueryTimeoutError:
        view.notes.add(
            f"out of time before it was known whether recordings differ on {topic} at the same "
            "time, as of several robots"
        )
    return None


def note_times_twice(
    view: View, window: TimeWindow, what: str = "both are here, mixed in the order of time"
) -> None:
    """Notes which recordings have a time of a window twice, and `what` the answer has of both."""
    for pair in times_recorded_twice(view, window):
        view.notes.add(f"{pair.describe_by_clock('')}: {what}")


def note_robots_on(
    view: View, topics: Sequence[str], window: TimeWindow, *, places: bool = False
) -> Spans:
    """Does `note_robots` for the first few topics; returns the times of all."""
    spans_by_topic = [
        note_robots(view, topic, window, places=places) for topic in topics[:_MAX_TOPICS]
    ]
    return united(chain.from_iterable(spans_by_topic))


def note_robots_near(view: View, stored: StoredMessage) -> None:
    """Does `note_robots` around a message, if recordings overlap there."""
    topic, at = stored.topic, stored.time
    pairs = _overlapping_pairs(view, topic, TimeWindow.around(at, _NEAR_NS))
    if any(chain(pairs, times_recorded_twice(view, TimeWindow(at, at + 1)))):
        note_robots(view, topic, TimeWindow.around(at, _NEAR_NS))


class _TopicSpan(NamedTuple):
    """A recording, and the first and last log time of a topic in it."""

    first: Ns
    last: Ns
    path: Path


def _overlapping_pairs(view: View, topic: str, window: TimeWindow) -> Iterator[ParallelRecordings]:
    """Yields pairs of recordings that hold a topic at the same time, and that no handover joins."""
    recordings = _recordings_with(view, topic)
    # A thinned day contains the bags of moments and rules of that day.
    recordings.pop(view.bag_dir / MEMORY_FOLDER, None)
    spans = [_TopicSpan(*span, path) for path, span in recordings.items() if window.overlaps(*span)]
    if len(spans) < 2:
        return
    loose = loose_bags_beside_others(view.snapshot)
    loose_files: dict[str, list[str]] = defaultdict(list)
    for file, recording in loose.items():
        loose_files[recording].append(file)
    own = _own_recordings(view.bag_dir)
    earliest, latest = view.snapshot.earliest or 0, view.snapshot.latest or 0
    is_dated = window.overlaps(earliest, latest)
    misdated = _misdated(view, loose)
    if is_dated:  # of a bag that reaches from 1970 to today, what is from today
        spans = [
            each._replace(first=max(each.first, misdated.get(each.path, MIN_NS))) for each in spans
        ]
    going_on: list[_TopicSpan] = []
    for later in sorted(spans):
        going_on = [earlier for earlier in going_on if earlier.last >= later.first]
        for earlier in going_on:
            span = TimeWindow(later.first, min(later.last, earlier.last) + 1)
            is_there = earlier.last <= later.last or _has_bags_near(view, topic, earlier.path, span)
            is_asked = is_there and window.overlaps(span.start, span.stop - 1)
            # Boots in 1970 overlap: that bags are dated by a wrong clock says enough of them.
            is_asked &= not is_dated or span.overlaps(earliest, latest)
            pair = earlier.path, later.path
            if is_asked and not view.sessions.are_joined(*pair):
                is_wrong = own.issuperset(pair) or not misdated.keys().isdisjoint(pair)
                by_clock = is_wrong or _is_short_edge(earlier, later)
                bags = frozenset(loose_files.get(str(later.path), ()))
                yield ParallelRecordings(*pair, span, by_clock, bags)
        going_on.append(later)


def _misdated(view: View, loose: Mapping[str, str]) -> dict[Path, Ns]:
    """Returns the recordings that a wrong clock dated, and from when on their dates are right."""
    misdated: dict[Path, Ns] = {}
    for fault in view.snapshot.dating.faults:
        path = _recording_of(fault.bag, loose)
        since = fault.span[1] + fault.by if fault.kind is FaultyClock.SET_AHEAD else MIN_NS
        misdated[path] = max(misdated.get(path, MIN_NS), since)
    return misdated


def _recordings_with(view: View, topic: str) -> dict[Path, Span]:
    """Returns the recordings that hold a topic, with its first and last log time in each."""
    loose = loose_bags_beside_others(view.snapshot)
    if not loose:
        return dict(view.timeline.recordings(topic))
    recordings: dict[Path, Span] = {}
    for bag, first, last in view.timeline.extents(topic, TimeWindow.everything()):
        path = _recording_of(bag, loose)
        recordings[path] = wider(recordings.get(path), (first, last))
    return recordings


def _recording_of(bag: BagFile, loose: Mapping[str, str]) -> Path:
    """Returns the recording of a bag: its folder, unless `loose` has another by its path."""
    return Path(loose[bag.file]) if bag.file in loose else bag.recording


def _has_bags_near(view: View, topic: str, recording: Path, span: TimeWindow) -> bool:
    """Whether a recording holds a topic near a span: a misdated one spans years without a bag."""
    segments = view.timeline.segments_in(span.widened(COPY_HORIZON_NS))
    folders = recording, recording.parent  # a loose recording is in its parent's bags
    return any(not segment.recordings(topic).keys().isdisjoint(folders) for segment in segments)


def _is_short_edge(earlier: _TopicSpan, later: _TopicSpan) -> bool:
    """Whether two recordings overlap at their ends only, by less than half of each."""
    shortest = min(later.last - later.first, earlier.last - earlier.first)
    is_edge = earlier.first < later.first and earlier.last < later.last
    return is_edge and 2 * (earlier.last - later.first) < shortest


def times_recorded_twice(
    view: View, window: TimeWindow, *, within_bags: bool = True
) -> Iterator[ParallelRecordings]:
    """Yields the recordings in which the clock was set back, with the bags after that.

    Within a bag the moment is known only to the period of its fastest topic, and which messages are
    from before it is not known.
    """
    for fault in view.snapshot.dating.faults:
        if fault.kind is not FaultyClock.SET_BACK or not (within_bags or fault.before):
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


def _differ(view: View, topic: str, pair: tuple[Path, Path], both: TimeWindow) -> bool:
    """Whether two recordings each lack most messages of the other's in a window."""
    remembered, key = view.timeline.memo.of(_DIFFERING, dict), (topic, pair, both)
    known = remembered.get(key)
    if known is not None:
        return known
    first, other = _extents_of(view, topic, pair, both.widened(COPY_HORIZON_NS))
    with view.bags.watched() as reading:
        # Most, not all: two runs of a simulation share some, while the robot has not moved yet.
        differ = bool(first and other) and all(
            _lacks_most(view, topic, here, there, both)
            for here, there in ((first, other), (other, first))
        )
        if topic != view.pose_topic and _recordings_with(view, view.pose_topic).keys() >= {*pair}:
            # By its payload alone a boolean may be any robot's: poses show whose it is.
            streams = (view.stream.merged(extents, [topic], both) for extents in (first, other))
            if any(stored.is_undated for stream in streams for stored in islice(stream, 1)):
                differ = _differ(view, view.pose_topic, pair, both)
    if reading.is_final:
        if len(remembered) >= MOST_REMEMBERED:
            remembered.clear()
        remembered[key] = differ
    return differ


def _extents_of(
    view: View, topic: str, pair: tuple[Path, Path], window: TimeWindow
) -> Iterator[list[TopicExtent]]:
    """Yields for each of two recordings where it has a topic in a window."""
    near = view.stream.overlapping_bags([topic], window)
    loose = loose_bags_beside_others(view.snapshot)
    for path in pair:
        yield [extent for extent in near if _recording_of(extent.bag, loose) == path]


def _shift_of_clock(view: View, topic: str, pair: tuple[Path, Path], span: TimeWindow) -> Ns | None:
    """Returns how much later (ns) the second of two recordings has the messages of the first.

    None if it has other messages. A sample decides, of poses if both have them, else of the topic:
    more than half of it is in the other recording, each message once, and all equally late.
    """
    if _recordings_with(view, view.pose_topic).keys() >= {*pair}:
        topic = view.pose_topic
    remembered, key = view.timeline.memo.of(_SHIFTS, dict), (topic, pair, span)
    if key in remembered:
        return remembered[key]
    around = span.widened(_NEAR_NS)
    first, other = _extents_of(view, topic, pair, around)
    payloads, shifts = set[int](), list[Ns]()
    with view.bags.watched() as reading:
        sample = [*_sampled(view, topic, first, around)]
        for stored in sample:
            payload = stored.identity[1]
            near = view.stream.merged(other, [topic], TimeWindow.around(stored.time, _NEAR_NS))
            equal = [each.time - stored.time for each in near if each.identity[1] == payload]
            if len(equal) == 1:
                payloads.add(payload)
                shifts += equal
    are_enough = len(payloads) >= _FEWEST_SHIFTED and 2 * len(shifts) > len(sample)
    most = _JITTER_NS + (span.stop - span.start) // _DRIFT
    is_alike = are_enough and max(shifts) - min(shifts) <= most
    shift = sorted(shifts)[len(shifts) // 2] if is_alike else None
    if reading.is_final and len(remembered) < MOST_REMEMBERED:
        remembered[key] = shift
    return shift


def _sampled(
    view: View, topic: str, extents: Sequence[TopicExtent], window: TimeWindow
) -> Iterator[StoredMessage]:
    """Yields some messages from all over a window."""
    length = window.stop - window.start
    edges = [window.start + length * nth // _TRIED for nth in range(_TRIED + 1)]
    for start, stop in pairwise(edges):
        yield from islice(view.stream.merged(extents, [topic], TimeWindow(start, stop)), 1)


def _lacks_most(
    view: View,
    topic: str,
    first: Sequence[TopicExtent],
    other: Sequence[TopicExtent],
    both: TimeWindow,
) -> bool:
    """Whether `other` lacks most messages of `first`, by a sample from all over a window."""
    tried, lacking = 0, 0
    for stored in _sampled(view, topic, first, both):
        tried += 1
        near = TimeWindow.around(stored.time, COPY_HORIZON_NS)
        others = ((1, message) for message in view.stream.merged(other, [topic], near))
        lacking += not copies_in(chain([(0, stored)], others)).any()
        if 2 * lacking > _TRIED:
            return True  # the rest of the sample cannot change that
    return 2 * lacking > tried
