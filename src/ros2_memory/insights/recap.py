"""What happened in a window, from the data alone: a few sentences, each with its time.

The robot stood, things came into view and left it, booleans flipped, errors were reported, and
nothing was recorded. Where that is more than a planner wants to read, what matters least is left
out, and counted.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.intervals import united
from ros2_memory.analysis.odometry import is_place
from ros2_memory.analysis.sights import MotionDecoder
from ros2_memory.analysis.standstills import (
    CONTEXT_NS,
    CREEP_MPS,
    SHORTEST_NS,
    StandstillBuilder,
    StandstillCollector,
    StandstillDigest,
)
from ros2_memory.analysis.topic_events import (
    MOST_TOLD,
    NO_EVENTS,
    TopicEvents,
    TopicEventsBuilder,
    has_events,
    state_of,
)
from ros2_memory.catalogue.codec import (
    decode_topic_events,
    encode_topic_events,
    packed_standstills,
    unpacked_standstills,
)
from ros2_memory.core.errors import InvalidArgumentsError, NoDataError, UndecodableError
from ros2_memory.core.text import Reason, counted
from ros2_memory.core.timebase import (
    AT_OR_BEFORE_SLACK_NS,
    START_SLACK_NS,
    ns_from_unix,
    unix_from_ns,
)
from ros2_memory.history.bag_groups import DigestKind, StoredPart, is_whole
from ros2_memory.history.coverage import note_edges, note_unread
from ros2_memory.history.driven_path import add_poses, driven_path, length_notes
from ros2_memory.history.no_data import resolve_pose_topic
from ros2_memory.history.robots import note_robots
from ros2_memory.history.time_arguments import open_span
from ros2_memory.results import Event, Recap

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from ros2_memory.analysis.intervals import IntervalTable, VisibleInterval
    from ros2_memory.analysis.standstills import Standstill
    from ros2_memory.analysis.topic_events import ReportedError
    from ros2_memory.core.model import Pose, TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.history.driven_path import DrivenPath
    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.history.time_arguments import TimeRange
    from ros2_memory.history.view import View

MOST_EVENTS: Final = 25

_UNDECODED: Final = Reason("could not be decoded: what they say is not told", "topic")
_UNTOLD: Final = (
    "the positions are too noisy, or too few, to tell when the robot stood: stood_s is null"
)
_KINDS: Final = ("gap", "error", "stop", "flip", "thing")
"""Kinds of events, the one that matters most first."""
_PLURALS: Final = {
    "gap": "gaps",
    "error": "errors",
    "stop": "stops",
    "flip": "flips",
    "thing": "sights of things",
}


@dataclass(frozen=True, slots=True)
class _Drive:
    """How the robot moved: its way, where there are poses, and its stops, and which go on."""

    way: DrivenPath | None
    stops: tuple[tuple[Standstill, bool], ...]

    def stood(self, length: Ns) -> Ns | None:
        """How long the robot stood in all, in a window of a length; None where nothing tells.

        So it is where no pose is a place, and where the robot neither moved nor stood for most of
        the time: noise hides where it stood.
        """
        stood = sum(stop.end - stop.start for stop, _ in self.stops)
        way = None if self.way is None else self.way.trajectory
        if way is None or not way.is_known:
            return stood or None
        if not stood:
            is_hidden = length >= SHORTEST_NS and way.distance_m <= CREEP_MPS * way.duration_s
            return None if is_hidden else 0
        else_s = way.duration_s - unix_from_ns(stood)
        is_hidden = else_s > way.duration_s / 2 and way.distance_m < CREEP_MPS * else_s
        return None if is_hidden and not way.gaps and ns_from_unix(else_s) > SHORTEST_NS else stood


def recap(memory: Memory, call: Call, span: TimeRange) -> Recap:
    """What happened in a window.

    Raises:
        InvalidArgumentsError: the bounds are missing, reversed, not finite or of no length.
        NoDataError: the memory holds nothing.
        QueryTimeoutError: the call's time is over.
    """
    view, window = open_span(memory, call, span)
    start, end = window.asked()
    drive = _drive(view, window)
    events = [] if drive is None else [*_stops(drive)]
    seen: list[IntervalTable] = []
    throughout: set[str] = set()
    there_still: dict[str, Ns] = {}
    newest = view.snapshot.latest
    known_to = window.stop if newest is None else min(window.stop, newest)
    for topic, story in _stories(view, window):
        events += [*_flips(topic, story), *map(_error, story.faults)]
        seen.append(story.seen)
        throughout.update(story.seen.throughout(start, end))
        there_still |= dict.fromkeys(story.seen.at_end(story.last, known_to), story.last)
        if story.undecodable:
            messages = counted(story.undecodable, "message")
            view.note_thing(_UNDECODED, f"{messages} of {topic}")
        if story.left_out:
            view.note(f"{topic} changes too often to tell each: {story.left_out} more")
        if story.beyond:
            view.note(
                f"{topic} has too many booleans or things in one message: {story.beyond} more are "
                "not followed"
            )
    things = united(seen).without(throughout)
    events += [
        _thing(each, goes_on=each.last == there_still.get(each.label))
        for each in things.longest(MOST_EVENTS)
    ]
    events += _gaps(view, window)
    note_unread(view, window)
    note_edges(view, window)
    counts = Counter(each.kind for each in events)
    if things.size:
        counts["thing"] = things.size
    told = _most_important(view, events, counts)
    latest = view.snapshot.latest
    way = None if drive is None else drive.way
    trajectory = None if way is None else way.trajectory
    for note in () if trajectory is None else length_notes(trajectory):
        view.note(note)
    stood = None if drive is None else drive.stood(end - start)
    if stood is None and trajectory is not None and trajectory.is_known:
        view.note(_UNTOLD)
    known = trajectory if trajectory is not None and trajectory.is_known else None
    return Recap(
        start=start,
        end=end,
        now=memory.clock.now() if memory.limits.now == "wall" or latest is None else latest,
        distance_m=None if known is None else known.distance_m,
        max_speed=None if known is None else known.max_speed,
        stood=stood,
        shortest_stop=SHORTEST_NS,
        frame_id=None if way is None else way.frames[0],
        events=tuple(told),
        throughout=tuple(sorted(throughout)),
        counts=tuple((_PLURALS[kind], counts[kind]) for kind in _KINDS if counts[kind]),
        notes=view.notes,
        path_sum_m=trajectory.path_sum_m
        if trajectory is not None and trajectory.is_noisy
        else None,
        gap_m=trajectory.gap_m if trajectory is not None and trajectory.gaps else None,
    )


def _drive(view: View, window: TimeWindow) -> _Drive | None:
    """How the robot moved; None, with a note, where that is not known."""
    try:
        topic = resolve_pose_topic(view)
        way = driven_path(view, topic, window)
        note_robots(view, topic, window)
        stops = standstills_in(view, topic, window)
        if way is None:
            view.note(f"{topic} has no poses in this time: nothing is known of the way")
    except (InvalidArgumentsError, NoDataError) as error:
        view.note(f"nothing is known of the way: {error}")
        return None
    return None if way is None and not stops else _Drive(way, stops)


def _stories(view: View, window: TimeWindow) -> Iterator[tuple[str, TopicEvents]]:
    for topic in view.snapshot.topics():
        if any(map(has_events, view.snapshot.types_of(topic))):
            story = events_in(view, topic, window)
            if story is not None and not story.says_nothing:
                yield topic, story


def _stops(drive: _Drive) -> Iterator[Event]:
    for (start, end, box), goes_on in drive.stops:
        x, y, _ = box.centre
        yield Event("stop", start, end, f"stood at x {x:z.2f}, y {y:z.2f}", goes_on)


def _flips(topic: str, story: TopicEvents) -> Iterator[Event]:
    """Each flip, and how long it held; up to the end where it still did."""
    until: dict[str, Ns] = {}
    for flip in reversed(story.flips):
        name = topic if flip.path == "value" else f"{topic} {flip.path}"
        text = f"{name} became {'true' if flip.value else 'false'}"
        held = until.get(flip.path)
        yield Event("flip", flip.time, held, text, goes_on=held is None)
        until[flip.path] = flip.time


def _error(fault: ReportedError) -> Event:
    again = f" ({fault.reports} times)" if fault.reports > 1 else ""
    end = fault.last if fault.reports > 1 else None
    return Event("error", fault.first, end, f"error: {fault.text}{again}")


def _thing(presence: VisibleInterval, *, goes_on: bool) -> Event:
    text = f"{presence.label} in view"
    return Event("thing", presence.first, presence.last, text, goes_on)


def _gaps(view: View, window: TimeWindow) -> Iterator[Event]:
    """Where nothing was recorded for more than two splits, inside what the memory spans."""
    longest = 2 * ns_from_unix(view.memory.limits.split_duration_s)
    earliest, latest = view.snapshot.earliest, view.snapshot.latest
    if earliest is None or latest is None:
        return
    reach = max(window.start, earliest)
    misdated = view.snapshot.dating.misdated
    for bag in view.snapshot.overlapping(window):
        if bag.file in misdated:
            continue
        if bag.start - reach > longest:
            yield Event("gap", reach, bag.start, "nothing was recorded")
        reach = max(reach, bag.end)
    end = min(window.stop, latest)
    if end - reach > longest:
        yield Event("gap", reach, end, "nothing was recorded")


def _most_important(view: View, events: Sequence[Event], counts: Counter[str]) -> list[Event]:
    """At most `MOST_EVENTS`, in order of time: of a kind those that lasted longest.

    `counts` is how many there are of each kind; all of those that may be told are among `events`.
    """
    ranked = sorted(
        events,
        key=lambda each: (
            _KINDS.index(each.kind),
            0 if each.end is None else each.start - each.end,
        ),
    )
    told = ranked[:MOST_EVENTS]
    left_out = counts - Counter(each.kind for each in told)
    if left_out:
        named = ", ".join(
            counted(left_out[kind], kind if kind != "thing" else "sight of a thing", _PLURALS[kind])
            for kind in _KINDS
            if left_out[kind]
        )
        view.note(f"left out, since they are too many: {named}; ask for a shorter time")
    return sorted(told, key=lambda each: (each.start, _KINDS.index(each.kind)))


_STANDSTILLS: Final = DigestKind(
    "standstills",
    ask=lambda notes, topic, among: notes.standstills(topic, among),
    packed=lambda digest: packed_standstills(digest).hex(),
    unpacked=lambda text: unpacked_standstills(bytes.fromhex(text)),
)
_STORIES: Final = DigestKind(
    "story",
    ask=lambda notes, topic, among: notes.stories(topic, among),
    packed=lambda story: "" if story is None else encode_topic_events(story).hex(),
    unpacked=lambda text: decode_topic_events(bytes.fromhex(text)) if text else None,
)


class _Standing:
    """Takes poses for what only asks where they are."""

    def __init__(self, to: StandstillBuilder | StandstillCollector) -> None:
        self._to = to

    def add(self, time: Ns, pose: Pose, _speed_mps: float | None = None) -> None:
        """Takes the next pose, if it is one."""
        if is_place(pose.position):
            self._to.add(time, pose.position)


def standstills_in(
    view: View, topic: str, window: TimeWindow
) -> tuple[tuple[Standstill, bool], ...]:
    """Return where the poses of a topic stand still, in order, as far as it is in a window.

    With each comes whether it goes on after the window, or up to the last pose that is known.

    Poses outside of the window count too: a standstill that goes on beyond an end of the window
    ends there, however little of it is inside. So those of windows that follow each other add up.

    Raises:
        InvalidArgumentsError: a message of the topic carries no position.
    """
    start, end = window.start + START_SLACK_NS, window.stop - 1 - AT_OR_BEFORE_SLACK_NS
    window = window.widened(CONTEXT_NS)
    builder = StandstillBuilder()
    kept: StoredPart[StandstillDigest] = StoredPart(view, topic, _STANDSTILLS, window)
    sights = MotionDecoder(view.memory.reader, view.memory.extractor)
    for group in view.groups(topic, window):
        failures: list[UndecodableError] = []
        if not is_whole(group, window):
            add_poses(view, _Standing(builder), sights, group.once(), failures)
        elif (known := kept.of(group)) is not None:
            builder.join(known[0])
        else:
            collector = StandstillCollector()
            span = add_poses(view, _Standing(collector), sights, group.once(), failures)
            digest = collector.digest()
            if digest is not None:
                builder.join(digest)
                if span is not None and not failures:
                    kept.keep(group, digest, span)
    found = builder.standstills()
    return tuple(
        (
            each._replace(start=max(each.start, start), end=min(each.end, end)),
            each.end > end or each.end == builder.last,
        )
        for each in found
        if each.start < end and each.end > start
    )


def events_in(view: View, topic: str, window: TimeWindow) -> TopicEvents | None:
    """What the messages of a topic say in a window; None where there is no message."""
    builder = TopicEventsBuilder()
    kept: StoredPart[TopicEvents | None] = StoredPart(view, topic, _STORIES, window)
    for group in view.groups(topic, window):
        if not is_whole(group, window):
            _hear(view, builder, group.once())
            continue
        known = kept.of(group)
        if known is None:
            collector = TopicEventsBuilder()
            _hear(view, collector, group.once())
            story = collector.story(MOST_TOLD)
            if story is not None:
                kept.keep(group, story, (story.first, story.last))
        else:
            story, span = known
            story = TopicEvents(*span) if story is NO_EVENTS else story
        if story is not None:
            builder.join(story)
    return builder.story()


def _hear(view: View, builder: TopicEventsBuilder, messages: Iterable[StoredMessage]) -> None:
    """Adds what messages say."""
    for found in messages:
        channel = found.record.channel
        try:
            message = view.memory.reader.decode(found.record)
        except UndecodableError:
            builder.miss()
            continue
        value = view.memory.extractor.exact(message, channel.type)
        builder.add(found.time, state_of(value, channel.type))
