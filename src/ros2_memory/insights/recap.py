"""A recap of a window, from the data alone: a few sentences, each with its time.

The robot stood, things came into view and left it, booleans toggled, errors were reported, and
nothing was recorded. Where there are more events than a planner wants to read, the least important
are left out, and counted.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.bulk_decode import motion_decoder
from ros2_memory.analysis.intervals import united
from ros2_memory.analysis.motion.odometry import is_place
from ros2_memory.analysis.motion.standstills import (
    CONTEXT_NS,
    CREEP_MPS,
    SHORTEST_NS,
    StandstillBuilder,
    StandstillCollector,
    StandstillDigest,
)
from ros2_memory.analysis.topic_events import has_events
from ros2_memory.catalogue.codec import decode_standstills, encode_standstills
from ros2_memory.core.errors import InvalidArgumentsError, NoDataError, UndecodableError
from ros2_memory.core.text import Reason, counted, listed
from ros2_memory.core.timebase import (
    AT_OR_BEFORE_SLACK_NS,
    START_SLACK_NS,
    ns_from_unix,
    unix_from_ns,
)
from ros2_memory.history.bag_groups import DigestKind, Fold
from ros2_memory.history.context import Note
from ros2_memory.history.coverage import note_edges, note_unread, recording_gaps
from ros2_memory.history.driven_path import add_poses, driven_path, length_notes
from ros2_memory.history.no_data import resolve_pose_topic, seconds
from ros2_memory.history.robots import note_robots
from ros2_memory.history.view import open_span
from ros2_memory.insights.changes_before import (
    SLACK_NS,
    ChangesBefore,
    before,
    changes_in,
    is_routine,
)
from ros2_memory.insights.clock_steps import clock_steps
from ros2_memory.insights.silences import grouped, silences_in
from ros2_memory.insights.topic_events import events_in, toggled
from ros2_memory.results import Before, Event, Recap

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from ros2_memory.analysis.intervals import IntervalTable
    from ros2_memory.analysis.motion.standstills import Standstill
    from ros2_memory.analysis.motion.trajectory import Trajectory
    from ros2_memory.analysis.topic_events import ReportedError, TopicEvents
    from ros2_memory.core.model import Pose, TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.bag_groups import Span
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.history.driven_path import DrivenPath
    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.history.view import TimeRange, View
    from ros2_memory.results import PastChange

MOST_EVENTS: Final = 25

_MOST_CHANGES: Final = 3
"""Changes that are listed before an event, the nearest."""
_MOST_CHARS: Final = 1_200
"""Characters of changes before all events of a recap: a recap with `around` has them all."""
_CHANGE_CHARS: Final = 30
"""What the reply adds to a change's text."""

_UNDECODED: Final = Reason("could not be decoded: what they say is not told", "topic")
_STANDSTILLS_UNKNOWN: Final = (
    "the positions are too noisy, or too few, to tell when the robot stood: stood_s is null"
)
_PLURALS: Final = {
    "gap": "gaps",
    "clock step": "clock steps",
    "silence": "silences",
    "error": "errors",
    "stop": "stops",
    "flip": "flips",
    "thing": "sights of things",
}
"""The kinds of events, the most important first, and the words for several of each."""
_KINDS: Final = tuple(_PLURALS)


@dataclass(frozen=True, slots=True)
class Drive:
    """How the robot moved: its path, and its standstills with whether each goes on afterwards."""

    path: DrivenPath | None = None
    standstills: tuple[tuple[Standstill, bool], ...] = ()

    @property
    def trajectory(self) -> Trajectory | None:
        """The path's trajectory, if there are poses; `is_known` says whether any was valid."""
        return None if self.path is None else self.path.trajectory

    def stood(self, length: Ns) -> Ns | None:
        """Returns how long the robot stood in all, in a window of a length; None if not known.

        It is not known where no pose has a valid position, nor where the robot neither moved nor
        stood for most of the time: noise hides where it stood.
        """
        stood = sum(each.end - each.start for each, _ in self.standstills)
        known = self.trajectory
        if known is None or not known.is_known:
            return stood or None
        if not stood:
            is_hidden = (
                length >= SHORTEST_NS
                and known.totals.distance_m <= CREEP_MPS * known.totals.duration_s
            )
            return None if is_hidden else 0
        else_s = known.totals.duration_s - unix_from_ns(stood)
        is_hidden = (
            else_s > known.totals.duration_s / 2 and known.totals.distance_m < CREEP_MPS * else_s
        )
        if is_hidden and not known.totals.gaps and ns_from_unix(else_s) > SHORTEST_NS:
            return None
        return stood


def recap_or_before(memory: Memory, call: Call, span: TimeRange) -> Recap | Before:
    """Returns what happened in a window, or what changed before a moment; see both.

    Raises:
        InvalidArgumentsError: the window and the moment are given in more than one form.
    """
    is_bounded = span.start_s is not None or span.end_s is not None
    if is_bounded + (span.last_s is not None) + (span.around_s is not None) > 1:
        raise InvalidArgumentsError("last_s, around, or start and end: give one of the three")
    if span.around_s is None:
        return recap(memory, call, span)
    return before(memory, call, span.around_s, span.before_s)


def recap(memory: Memory, call: Call, span: TimeRange) -> Recap:
    """Returns what happened in a window.

    Raises:
        InvalidArgumentsError: the bounds are missing, reversed, not finite or of no length.
        NoDataError: the memory holds nothing.
        QueryTimeoutError: the call's time is over.
    """
    view, window = open_span(memory, call, span)
    start, end = window.asked()
    drive = drive_in(view, window)
    found = found_events(view, window)
    reported, things, throughout = _topic_events(view, window, found)
    events = [*_stops(drive), *reported]
    events += [
        Event("gap", begin, until, "nothing was recorded")
        for begin, until in recording_gaps(view, window)
    ]
    events += [*_clock_steps(view, window), *_silences(view, window)]
    note_unread(view, window)
    note_edges(view, window)
    counts = Counter(each.kind for each in events)
    if things:
        counts["thing"] = things
    shown = _most_important(view, events, counts)
    shown = _with_changes(changes_in(view, window, found), shown)
    trajectory = drive.trajectory
    for note in () if trajectory is None else length_notes(trajectory):
        view.notes.add(note)
    stood = drive.stood(end - start)
    known = trajectory if trajectory is not None and trajectory.is_known else None
    if stood is None and known is not None:
        view.notes.add(_STANDSTILLS_UNKNOWN)
    return Recap(
        start=start,
        end=end,
        now=memory.now(memory.clock.now(), view.snapshot.latest),
        distance_m=None if known is None else known.totals.distance_m,
        max_speed=None if known is None else known.max_speed,
        stood=stood,
        shortest_stop=SHORTEST_NS,
        frame_id=None if drive.path is None else drive.path.frames[0],
        events=tuple(shown),
        throughout=tuple(sorted(throughout)),
        counts=tuple((_PLURALS[kind], counts[kind]) for kind in _KINDS if counts[kind]),
        notes=view.notes.sentences(),
        path_sum_m=None
        if trajectory is None or not trajectory.is_noisy
        else trajectory.totals.path_sum_m,
        gap_m=None if trajectory is None or not trajectory.totals.gaps else trajectory.totals.gap_m,
    )


def drive_in(view: View, window: TimeWindow) -> Drive:
    """Returns how the robot moved; nothing, with a note, where that is not known."""
    try:
        topic = resolve_pose_topic(view)
        path = driven_path(view, topic, window)
        note_robots(view, topic, window)
        standstills = _standstills_in(view, topic, window)
    except (InvalidArgumentsError, NoDataError) as error:
        view.notes.add(f"nothing is known of the way: {error}")
        return Drive()
    if path is None:
        view.notes.add(f"{topic} has no poses in this time: nothing is known of the way")
    return Drive(path, standstills)


def found_events(view: View, window: TimeWindow) -> dict[str, TopicEvents | None]:
    """Returns the events of each topic that can have some; None where it has no message."""
    timeline = view.snapshot.timeline
    return {
        topic: events_in(view, topic, window)
        for topic in timeline.topics()
        if any(map(has_events, timeline.types_of(topic)))
    }


def _topic_events(
    view: View, window: TimeWindow, found_of: Mapping[str, TopicEvents | None]
) -> tuple[list[Event], int, set[str]]:
    """Returns events that messages report, the number of things seen, and those seen throughout.

    Of things that came or went, only the `MOST_EVENTS` that were seen longest are among the events.
    """
    start, end = window.asked()
    newest = view.snapshot.latest
    known_to = window.stop if newest is None else min(window.stop, newest)
    events: list[Event] = []
    visible: list[IntervalTable] = []
    throughout: set[str] = set()
    last_seen: dict[str, Ns] = {}
    for topic, found in found_of.items():
        if found is None or found.is_empty:
            continue
        events += [*_flips(topic, found), *map(_error, found.errors)]
        visible.append(found.visible)
        throughout.update(found.visible.throughout(start, end))
        last_seen |= dict.fromkeys(found.visible.at_end(found.last, known_to), found.last)
        _note_limits(view, topic, found)
    things = united(visible).without(throughout)
    events += [
        Event(
            "thing",
            each.first,
            each.last,
            f"{each.label} in view",
            goes_on=each.last == last_seen.get(each.label),
        )
        for each in things.longest(MOST_EVENTS)
    ]
    return events, things.size, throughout


def _note_limits(view: View, topic: str, events: TopicEvents) -> None:
    if events.undecodable:
        messages = counted(events.undecodable, "message")
        view.notes.add(Note(_UNDECODED, f"{messages} of {topic}"))
    if events.left_out:
        view.notes.add(f"{topic} changes too often to tell each: {events.left_out} more")
    if events.beyond:
        view.notes.add(
            f"{topic} has too many booleans or things in one message: {events.beyond} more are "
            "not followed"
        )


def _stops(drive: Drive) -> Iterator[Event]:
    for (start, end, box), goes_on in drive.standstills:
        x, y, _ = box.centre
        # z: a rounded -0.00 reads as 0.00.
        yield Event("stop", start, end, f"stood at x {x:z.2f}, y {y:z.2f}", goes_on)


def _flips(topic: str, events: TopicEvents) -> Iterator[Event]:
    """Yields each toggle with how long its value held: until the next, or beyond the window."""
    until: dict[str, Ns] = {}
    for toggle in reversed(events.toggles):
        text = toggled(topic, toggle)
        end = until.get(toggle.path)
        yield Event("flip", toggle.time, end, text, goes_on=end is None)
        until[toggle.path] = toggle.time


def _clock_steps(view: View, window: TimeWindow) -> Iterator[Event]:
    """Yields when the clock was set."""
    for at, by in clock_steps(view, window):
        how = f"forward by {seconds(by)}" if by > 0 else f"back by {seconds(-by)} or more"
        yield Event("clock step", at, None, f"the clock was set {how}")


def _silences(view: View, window: TimeWindow) -> Iterator[Event]:
    """Yields when topics with a usual rate were silent; several at the same time are one event."""
    for group in grouped(silences_in(view, window)):
        topics = listed([each.topic for each in group])
        were = "was" if len(group) == 1 else "were"
        first = group[0]
        yield Event(
            "silence", first.start, first.end, f"{topics} {were} silent", goes_on=first.goes_on
        )


def _error(error: ReportedError) -> Event:
    again = f" ({error.reports} times)" if error.reports > 1 else ""
    end = error.last if error.reports > 1 else None
    return Event("error", error.first, end, f"error: {error.text}{again}")


def _with_changes(changes: ChangesBefore, events: Sequence[Event]) -> list[Event]:
    """Returns the events, and with each stop and toggle what changed before."""
    found: dict[Event, tuple[PastChange, ...]] = {}
    for each in events:
        if each.kind == "stop":
            found[each] = changes.before(each.start, slack=SLACK_NS)
        elif each.kind == "flip":
            found[each] = changes.before(each.start, without=each.text.rpartition(" ")[0])
    shown = dict.fromkeys(found, 0)
    left = _MOST_CHARS
    # What a goal that was meant begins or ends with matters least.
    routine = {each: all(map(is_routine, found[each])) for each in found}
    ranks = [(is_last, nth) for is_last in (False, True) for nth in range(_MOST_CHANGES)]
    for is_last, nth in ranks:
        for each, past in found.items():
            if routine[each] is is_last and len(past) > nth == shown[each]:
                size = len(past[nth].text) + _CHANGE_CHARS
                if size <= left:
                    left -= size
                    shown[each] += 1
    return [
        replace(each, before=found[each][: shown[each]]) if each in found else each
        for each in events
    ]


def _most_important(view: View, events: Sequence[Event], counts: Counter[str]) -> list[Event]:
    """Returns at most `MOST_EVENTS`, in order of time: of a kind those that lasted longest.

    `counts` has how many there are of each kind, also of those that are not among `events`.
    """
    ranked = sorted(
        events,
        key=lambda each: (
            _KINDS.index(each.kind),
            0 if each.end is None else each.start - each.end,
        ),
    )
    shown = ranked[:MOST_EVENTS]
    left_out = counts - Counter(each.kind for each in shown)
    if left_out:
        named = ", ".join(
            counted(left_out[kind], kind if kind != "thing" else "sight of a thing", _PLURALS[kind])
            for kind in _KINDS
            if left_out[kind]
        )
        view.notes.add(f"left out, since they are too many: {named}; ask for a shorter time")
    return sorted(shown, key=lambda each: (each.start, _KINDS.index(each.kind)))


_STANDSTILLS: Final = DigestKind(
    "standstills",
    look_up=lambda digests, topic, among: digests.catalogue.standstills(topic, among),
    encode=encode_standstills,
    decode=decode_standstills,
)


def _standstills_in(
    view: View, topic: str, window: TimeWindow
) -> tuple[tuple[Standstill, bool], ...]:
    """Returns where the poses of a topic stand still, in order, as far as it is in a window.

    With each comes whether it goes on after the window, or up to the last pose that is known.

    Poses outside of the window count too: a standstill that goes on beyond an end of the window
    ends there, however little of it is inside. So those of windows that follow each other add up.

    Raises:
        InvalidArgumentsError: a message of the topic carries no position.
    """
    start, end = window.start + START_SLACK_NS, window.stop - 1 - AT_OR_BEFORE_SLACK_NS
    builder = StandstillBuilder()
    decoder = motion_decoder(view.memory.reader, view.memory.extractor)
    failures: list[UndecodableError] = []

    def add(
        to: StandstillBuilder | StandstillCollector, messages: Iterable[StoredMessage]
    ) -> Span | None:
        def add_place(time: Ns, pose: Pose, _speed_mps: float | None) -> None:
            if is_place(pose.position):
                to.add(time, pose.position)

        return add_poses(view, add_place, decoder, messages, failures)

    def collect(
        messages: Iterable[StoredMessage],
    ) -> tuple[StandstillDigest | None, Span | None]:
        collector = StandstillCollector()
        span = add(collector, messages)
        return collector.digest(), span

    Fold(
        _STANDSTILLS,
        add=lambda messages: add(builder, messages),
        collect=collect,
        join=lambda digest, _span: builder.join(digest),
        failures=failures,
    ).over(view, topic, window.widened(CONTEXT_NS))
    return tuple(
        (
            each._replace(start=max(each.start, start), end=min(each.end, end)),
            each.end > end or each.end == builder.last,
        )
        for each in builder.standstills()
        if each.start < end and each.end > start
    )
