"""What changed in the seconds before a moment: before it, never because of what.

Log entries of WARN and above, levels of diagnostics, goals of actions, booleans, a battery that
fell below a fraction, and a commanded velocity that became zero while a goal was active. That
nothing changed is an answer where such topics are recorded.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.analysis.facts import (
    BATTERY,
    CHARGE,
    COMMAND,
    FLAG,
    GOAL,
    LOG,
    LOW_CHARGES,
    STATUS,
    VELOCITIES,
    charge_of,
    has_changes,
    has_events,
)
from ros2_memory.analysis.topic_events import Change, Report, TopicEvents, joined_events
from ros2_memory.core.errors import InvalidArgumentsError, NoDataError
from ros2_memory.core.model import Pose, TimeWindow
from ros2_memory.core.text import Quoted
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S, Ns, unix_from_ns
from ros2_memory.history.coverage import note_edges, note_unread
from ros2_memory.history.driven_path import resolve_path_topic
from ros2_memory.history.view import View, ns_argument, open_view
from ros2_memory.insights.goals import GOAL_WORDS, action_of, last_listed
from ros2_memory.insights.topic_events import (
    events_in,
    events_of_messages,
    flag_name,
    note_left_out,
    toggled,
)
from ros2_memory.places.pose_frames import newest_pose, placed, with_place
from ros2_memory.results import Before, PastChange

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from ros2_memory.history.context import Call, Memory

LENGTH_NS: Final = 10 * NS_PER_S
"""How long before an event a change counts."""
_LEAD_NS: Final = 30 * NS_PER_S
"""How long before a window messages are read: a change shows by the message before it."""
_KNOWN_NS: Final = 3600 * NS_PER_S
"""How old a state may be that no later message repeats: of a goal, or of a latched boolean."""
_AROUND_NS: Final = 600 * NS_PER_S
"""A topic with a bag so near is recorded, though it may have nothing to report."""
_POSE_NS: Final = 2 * NS_PER_S
"""The robot may have moved since an older pose."""
SLACK_NS: Final = NS_PER_S // 2
"""When a standstill began is known to half a second: what changed by then counts as before."""
_MOST_CHANGES: Final = 20
_AFTER_NS: Final = 5 * NS_PER_S
"""How long after a time changes are listed: causes are often reported late."""
_MOST_AFTER: Final = 3
_MAX_LOG_CHARS: Final = 100

_LEVELS: Final = ("ok", "warning", "error", "stale")
_ACTIVE_GOAL: Final = frozenset({1, 2, 3})
"""Accepted, executing, canceling (action_msgs/msg/GoalStatus)."""
_ROUTINE: Final = ("goal accepted", "goal succeeded")


class _Change(NamedTuple):
    """Something that changed on a topic; a log entry that is repeated goes on until `last`."""

    first: Ns
    last: Ns
    text: str


class ChangesBefore:
    """What changed in a window and shortly before it, on all topics.

    Attributes:
        looked_at: the topics on which a change would show.
        state: booleans, statuses that are not ok, and the goal of each action, at the end.
        events: by topic, what its messages report in the window and before it.
    """

    def __init__(
        self,
        changes: Iterable[_Change],
        looked_at: tuple[str, ...],
        state: tuple[tuple[str, bool | str], ...],
        events: Mapping[str, TopicEvents],
    ) -> None:
        self._changes = sorted(changes)
        self._longest = max((each.last - each.first for each in self._changes), default=0)
        self.looked_at = looked_at
        self.state = state
        self.events = events

    def after(self, at: Ns, length: Ns, *, slack: Ns = 0) -> tuple[PastChange, ...]:
        """Returns what changed in the time after a moment, nearest first: `before` is negative.

        What changed up to `slack` after it is left out: it counts as before.
        """
        begin = bisect_left(self._changes, (at + slack + 1,))
        end = bisect_left(self._changes, (at + length + 1,))
        return tuple(PastChange(text, at - first) for first, _, text in self._changes[begin:end])

    def before(
        self, at: Ns, length: Ns = LENGTH_NS, *, without: str = "", slack: Ns = 0
    ) -> tuple[PastChange, ...]:
        """Returns what changed in the time before a moment, nearest first.

        What changed up to `slack` after it counts as at the moment. `without` is how sentences
        begin that are left out: those of the boolean that toggled.
        """
        found = {}
        begin = bisect_left(self._changes, (at - length - self._longest,))
        end = bisect_left(self._changes, (at + slack + 1,))
        for first, last, text in self._changes[begin:end]:
            # A report that goes on is repeated within seconds, if not at the moment itself.
            since = max(0, at - last)
            if since <= length and not (without and text.startswith(without)):
                found[first, text] = PastChange(text, since)
        return tuple(sorted(found.values(), key=lambda each: each.before))


def is_routine(change: PastChange) -> bool:
    """Returns whether a change is the begin of a goal, or its end as it was meant."""
    return change.text.endswith(_ROUTINE)


def topics_with_changes(view: View) -> list[str]:
    """Returns the topics whose events show changes: those with events, and the commands."""
    timeline, command = view.timeline, _command(view)
    return [
        topic
        for topic in timeline.topics()
        if any(map(has_events, timeline.types_of(topic))) or topic == command
    ]


def changes_in(
    view: View, window: TimeWindow, known: Mapping[str, TopicEvents | None]
) -> ChangesBefore:
    """Returns what changed in a window, and in the seconds before it.

    Args:
        view: of the call.
        window: of the changes.
        known: the events in the window of topics that were asked before.
    """
    timeline = view.timeline
    joined: dict[str, TopicEvents] = {}
    looked_at: list[str] = []
    command = _command(view)
    for topic in topics_with_changes(view):
        types = timeline.types_of(topic)
        found = known[topic] if topic in known else events_in(view, topic, window)
        events = _with_lead(view, topic, window, found, types)
        if events is not None:
            joined[topic] = events
        if any(map(has_changes, types)) or (events is not None and events.known):
            looked_at += [topic] if _is_recorded(view, topic, window) else []
    changes: list[_Change] = []
    for topic, events in joined.items():
        if topic != command:
            changes += _changes(topic, events)
    if command in joined:
        actions = [[*_activity(events)] for events in joined.values()]
        changes += [
            _Change(stop.time, stop.time, f"{command} went to zero while a goal was active")
            for stop in joined[command].of_kind(COMMAND)[1]
            if not stop.value and any(_is_active(action, stop.time) for action in actions)
        ]
    return ChangesBefore(
        changes,
        tuple(looked_at),
        tuple(_state(view, window, joined)),
        joined,
    )


def _is_recorded(view: View, topic: str, window: TimeWindow) -> bool:
    """Returns whether a topic was recorded around a window."""
    return any(view.timeline.extents(topic, window.widened(_AROUND_NS)))


def _command(view: View) -> str:
    """Returns the topic of velocities that command the robot's base; empty if there is none.

    Of `/cmd_vel_nav`, `/cmd_vel_smoothed` and `/cmd_vel`, which follow each other, the last.
    """
    timeline = view.timeline
    found = [
        topic
        for topic in timeline.topics()
        if topic.rsplit("/", 1)[-1].startswith("cmd_vel")
        and not VELOCITIES.isdisjoint(timeline.types_of(topic))
    ]
    return min(found, key=lambda topic: (len(topic), topic), default="")


def _with_lead(
    view: View,
    topic: str,
    window: TimeWindow,
    found: TopicEvents | None,
    types: Sequence[str],
) -> TopicEvents | None:
    """Returns the events in a window, joined with the state before it.

    None where neither can have a change: a detector's topic is not read for it.
    """
    if not (LOG in types or found is None or found.known):
        return None
    start = max(window.start - _LEAD_NS, MIN_NS)
    newest = view.stream.newest(topic, TimeWindow(max(start - _KNOWN_NS, MIN_NS), start))
    before = None if newest is None else events_of_messages(view, [newest])
    parts = (before, events_in(view, topic, TimeWindow(start, window.start)), found)
    return joined_events([part.without_sights() for part in parts if part is not None])


def _changes(topic: str, events: TopicEvents) -> Iterator[_Change]:
    for report in events.reports:
        yield _Change(report.first, report.last, _reported(report))
    charge = next((each.first for each in events.known if each.kind == CHARGE), 0)
    for change in events.changes:
        text = _changed(topic, change, charge)
        if change.kind == CHARGE:
            charge = change.value
        if text:
            yield _Change(change.time, change.time, text)
    for known in events.known:
        # Where earlier messages are without it, a goal is new, and a status that is not ok; and a
        # charge had been just above a limit.
        if known.at == events.first:
            continue
        if known.kind == GOAL:
            word = GOAL_WORDS.get(known.first, "accepted")
            yield _Change(known.at, known.at, f"{action_of(topic)} goal {word}")
        elif known.kind == STATUS and known.first:
            yield _Change(known.at, known.at, _status(known.name, known.first, known.text))
        elif known.kind == CHARGE and known.first:
            yield _Change(known.at, known.at, _fell(topic, known.first))


def _changed(topic: str, change: Change, charge: int) -> str:
    """Returns a sentence for a change; empty for one that is not reported."""
    if change.kind == FLAG:
        return toggled(topic, change)
    if change.kind == STATUS:
        return _status(change.name, change.value, change.text)
    if change.kind == GOAL and change.value in GOAL_WORDS:
        return f"{action_of(topic)} goal {GOAL_WORDS[change.value]}"
    if change.kind == CHARGE and change.value > charge:
        return _fell(topic, change.value)
    return ""


def _fell(topic: str, level: int) -> str:
    return f"{topic} fell below {LOW_CHARGES[level - 1]:.0%}"


def _status(name: str, level: int, text: str) -> str:
    word = _LEVELS[level] if 0 <= level < len(_LEVELS) else f"level {level}"
    more = f": {text}" if text else ""
    return Quoted(f"status of {name} became {word}{more}"[:_MAX_LOG_CHARS])


def _reported(report: Report) -> str:
    if report.reports == 1:
        return Quoted(report.text)
    span = unix_from_ns(report.last - report.first)
    return Quoted(f"{report.text} ({report.reports} times in {span:.0f} s)")


def _activity(events: TopicEvents) -> Iterator[tuple[Ns, bool]]:
    """Yields, whenever the status of a goal changes, whether the newest one is active from then on.

    An older goal does not count: that it ended may not be recorded.
    """
    goals, changes = events.of_kind(GOAL)
    begun = {goal.name: goal.at for goal in goals}
    states = [(goal.at, goal.name, goal.first) for goal in goals]
    states += [(change.time, change.name, change.value) for change in changes]
    newest, active = MIN_NS, set[str]()
    for time, name, value in sorted(states):
        if begun[name] > newest:
            newest = begun[name]
            active.clear()
        if begun[name] == newest:
            (active.add if value in _ACTIVE_GOAL else active.discard)(name)
        yield time, bool(active)


def _is_active(action: Sequence[tuple[Ns, bool]], time: Ns) -> bool:
    """Returns whether the newest goal of an action was active at a time; see `_activity`."""
    nth = bisect_right(action, (time, True)) - 1
    return nth >= 0 and action[nth][1]


def _state(
    view: View, window: TimeWindow, joined: Mapping[str, TopicEvents]
) -> Iterator[tuple[str, bool | str]]:
    """Yields booleans, statuses that are not ok, and the newest goal of each action, at the end."""
    for topic, events in joined.items():
        is_battery = any(each.kind == CHARGE for each in events.known)
        for flag in () if is_battery else events.of_kind(FLAG)[0]:
            yield flag_name(topic, flag), bool(flag.last)
        goals, _ = events.of_kind(GOAL)
        if goals:
            newest = max(goals, key=lambda each: each.at)
            word = GOAL_WORDS.get(newest.last, "active")
            if newest.last in _ACTIVE_GOAL and last_listed(view, topic, window, {newest.name}):
                word = "listed no more"  # its server has restarted
            yield f"{action_of(topic)} goal", word
        for status in events.of_kind(STATUS)[0]:
            if status.last:
                word = _LEVELS[status.last] if 0 < status.last < len(_LEVELS) else str(status.last)
                yield Quoted(f"status of {status.name}"), word


def before(
    memory: Memory, call: Call, at_s: float, length_s: float, frame_id: str | None = None
) -> Before:
    """Returns what changed in the seconds before a moment, and the state of the robot then.

    And the first changes after it: a robot may report what was the cause only seconds later.

    Raises:
        InvalidArgumentsError: the moment is not finite, or no transform leads to `frame_id`.
        NoDataError: nothing is recorded.
        QueryTimeoutError: the call's time is over.
    """
    at, length = ns_argument("around", at_s), ns_argument("seconds_before", length_s)
    view = open_view(memory, call, max(at, min(at + _AFTER_NS, memory.clock.now())))
    window = TimeWindow(max(at - length, MIN_NS), min(at + SLACK_NS + 1, MAX_NS))
    changes = changes_in(view, window, {})
    found = changes.before(at, length, slack=SLACK_NS)
    later = changes_in(view, TimeWindow(window.stop, min(at + _AFTER_NS + 1, MAX_NS)), {})
    robot, speed_mps = _robot(view, at, frame_id)
    if not view.timeline.overlapping(window):
        view.notes.add(f"nothing was recorded in the {length_s:g} s before")
    elif not changes.looked_at:
        view.notes.add("no topic that would show a change is recorded at this time")
    elif not found:
        view.notes.add(f"nothing changed on the topics looked at in the {length_s:g} s before")
    for topic, events in changes.events.items():
        note_left_out(view, topic, events)
    note_unread(view, window)
    note_edges(view, window)
    return Before(
        at,
        length,
        found[:_MOST_CHANGES],
        len(found[_MOST_CHANGES:]),
        changes.looked_at,
        sum(_is_recorded(view, each, window) for each in view.timeline.topics()),
        robot,
        speed_mps,
        (*changes.state, *_charges(view, at)),
        later.after(at, _AFTER_NS, slack=SLACK_NS)[:_MOST_AFTER],
        notes=view.notes.sentences(),
    )


def _robot(view: View, at: Ns, frame_id: str | None) -> tuple[Pose | None, float | None]:
    """Returns the robot's newest pose, in the map where that is known, and its speed.

    Raises:
        InvalidArgumentsError: no transform leads to `frame_id`, which was asked for.
    """
    window = TimeWindow(max(at - _POSE_NS, MIN_NS), at + 1)
    try:
        found, pose = newest_pose(view, resolve_path_topic(view), window) or (None, None)
    except (InvalidArgumentsError, NoDataError):
        return None, None
    if found is None:
        return None, None
    twist = view.extractor.twist(view.bags.decode(found), found.type)
    speed_mps = None if twist is None else math.hypot(*twist.linear)
    if pose is None:
        return None, speed_mps
    recording = found.bag.recording
    there = placed(view, pose, found.time, recording, frame_id)
    return with_place(view, there, found.time, recording), speed_mps


def _charges(view: View, at: Ns) -> Iterator[tuple[str, str]]:
    """Yields how full each battery was at a time."""
    timeline = view.timeline
    for topic in timeline.topics():
        if BATTERY not in timeline.types_of(topic):
            continue
        found = view.stream.newest(topic, TimeWindow(max(at - _LEAD_NS, MIN_NS), at + 1))
        part = None if found is None else charge_of(view.value(found))
        if part is not None:
            yield topic, f"{part:.0%}"
