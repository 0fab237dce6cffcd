"""What changed in the seconds before a moment: what came before it, not what caused it.

Changes are log entries of WARN and above, levels of diagnostics, goals of actions, booleans, a
battery that fell below a fraction, and a commanded velocity that became zero while a goal was
active. Where such topics are recorded, it is an answer that nothing changed.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from operator import itemgetter
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.facts import (
    BATTERY,
    CHARGE,
    COMMAND,
    FLAG,
    FULL_CHARGE,
    GOAL,
    GOALS,
    LOG,
    LOW_CHARGES,
    STATUS,
    VELOCITIES,
    battery_of,
    charge_of,
    has_changes,
    has_events,
)
from ros2_memory.analysis.goals import GOAL_WORDS
from ros2_memory.analysis.topic_events import NO_EVENTS, Change, TopicEvents, joined_events
from ros2_memory.core.errors import InvalidArgumentsError, NoDataError, QueryTimeoutError
from ros2_memory.core.model import Pose, TimeWindow
from ros2_memory.core.text import Quoted, repeating, shortened
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S, Ns, unix_from_ns
from ros2_memory.history.conditions import newest_above
from ros2_memory.history.coverage import note_edges, note_unread
from ros2_memory.history.driven_path import resolve_path_topic
from ros2_memory.history.lasting import held_at, is_latched
from ros2_memory.history.robots import note_times_twice
from ros2_memory.history.view import View, ns_argument, open_view
from ros2_memory.insights.topic_events import (
    action_of,
    events_in,
    events_of_messages,
    flag_name,
    last_listings,
    note_left_out,
    toggle_sentence,
    toggled_together,
)
from ros2_memory.places.pose_frames import newest_pose, pose_if_placed, with_place
from ros2_memory.results import Before, PastChange

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from ros2_memory.history.context import Call, Memory

LENGTH_NS: Final = 10 * NS_PER_S
"""How long before an event a change counts."""
_LEAD_NS: Final = 30 * NS_PER_S
"""How long before a window messages are read: a change shows by the message before it."""
_OLDEST_STATE_NS: Final = 3600 * NS_PER_S
"""How old a state may be that no later message repeats. The state of a latched topic never ages."""
_RECEIVED_NS: Final = 3 * NS_PER_S
"""How long after a run of the recorder began it may receive latched messages of before."""
_AROUND_NS: Final = 600 * NS_PER_S
"""A topic with messages so near is recorded, even if it has nothing to report."""
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


class _DatedChange(NamedTuple):
    """A change on a topic. `last` is after `first` for a log entry that is repeated."""

    first: Ns
    last: Ns
    text: str
    topic: str = ""


class ChangesBefore:
    """What changed in a window and shortly before it, on all topics.

    Attributes:
        looked_at: the topics on which a change would show.
        state: booleans, statuses that are not ok, and the goal of each action, at the end.
        events: what the messages of each topic report in the window and before it.
    """

    def __init__(
        self,
        changes: Iterable[_DatedChange],
        looked_at: tuple[str, ...],
        state: tuple[tuple[str, bool | str], ...],
        events: Mapping[str, TopicEvents],
    ) -> None:
        self._changes = sorted(changes)
        self._longest = max((change.last - change.first for change in self._changes), default=0)
        self.looked_at = looked_at
        self.state = state
        self.events = events

    def after(self, at: Ns, length: Ns, *, slack: Ns = 0) -> tuple[PastChange, ...]:
        """Returns the changes in the time (ns) after a moment, nearest first; `before` is negative.

        A change up to `slack` after the moment is left out: it counts as before.
        """
        begin = bisect_left(self._changes, (at + slack + 1,))
        end = bisect_left(self._changes, (at + length + 1,))
        changes = self._changes[begin:end]
        return tuple(PastChange(change.text, at - change.first) for change in changes)

    def before(
        self,
        at: Ns,
        length: Ns = LENGTH_NS,
        *,
        without: str = "",
        beside: str = "",
        slack: Ns = 0,
    ) -> tuple[PastChange, ...]:
        """Returns the changes in the time (ns) before a moment, nearest first.

        A change up to `slack` after the moment counts as at the moment. Sentences that begin with
        `without` are left out, and changes of the topic `beside` at the moment itself: what else
        its message says came with the event, not before it.
        """
        changes = {}
        begin = bisect_left(self._changes, (at - length - self._longest,))
        end = bisect_left(self._changes, (at + slack + 1,))
        for first, last, text, topic in self._changes[begin:end]:
            # A report that goes on is repeated within seconds, if not at the moment itself.
            since = max(0, at - last)
            is_own = bool(without) and text.startswith(without)
            is_beside = bool(beside) and topic == beside and first == at
            if since <= length and not is_own and not is_beside:
                changes[first, text] = PastChange(text, since)
        return tuple(sorted(changes.values(), key=lambda change: change.before))


def topics_with_changes(view: View) -> list[str]:
    """Returns the topics on which changes may show: topics with events, and the commands."""
    timeline, command = view.timeline, _command_topic(view)
    return [
        topic
        for topic in timeline.topics()
        if any(map(has_events, timeline.types_of(topic))) or topic == command
    ]


def changes_in(view: View, window: TimeWindow, earlier: Mapping[str, TopicEvents]) -> ChangesBefore:
    """Returns what changed in a window, and in the seconds before it.

    Args:
        view: of the call.
        window: of the changes.
        earlier: the events in the window, of the topics for which they are known already.
    """
    timeline = view.timeline
    events_of_topics: dict[str, TopicEvents] = {}
    looked_at: list[str] = []
    command = _command_topic(view)
    for topic in topics_with_changes(view):
        types = timeline.types_of(topic)
        inside = earlier[topic] if topic in earlier else events_in(view, topic, window)
        events = _with_state_before(view, topic, window, inside)
        if not events.is_empty:
            events_of_topics[topic] = events
        can_show_changes = any(map(has_changes, types)) or events.known
        if can_show_changes and any(timeline.extents(topic, window.widened(_AROUND_NS))):
            looked_at.append(topic)
    changes: list[_DatedChange] = []
    for topic, events in events_of_topics.items():
        if topic == command:
            of_topic = _commanded_stops(view, command, events_of_topics)
        else:
            of_topic = _changes_of_topic(topic, events)
        firsts = firsts_of_runs(view, topic, window)
        changes += (change for change in of_topic if change.first not in firsts)
    return ChangesBefore(
        changes,
        tuple(looked_at),
        tuple(_state_at_end(view, window, events_of_topics)),
        events_of_topics,
    )


def _commanded_stops(
    view: View, command: str, events_of_topics: Mapping[str, TopicEvents]
) -> Iterator[_DatedChange]:
    """Yields when the commanded velocity became zero while a goal was active."""
    activities = {topic: [*_goal_activity(events)] for topic, events in events_of_topics.items()}
    _, commands = events_of_topics[command].of_kind(COMMAND)
    for at in (change.time for change in commands if not change.value):
        is_active = any(
            _is_active(activity, at) and _has_message_of_run(view, topic, at)
            for topic, activity in activities.items()
        )
        if is_active:
            yield _DatedChange(at, at, f"{command} went to zero while a goal was active")


def firsts_of_runs(view: View, topic: str, window: TimeWindow) -> frozenset[Ns]:
    """Returns the log times of a topic's first messages in runs of the recorder.

    What such a message states may be so for long. None of a log. Of a latched topic those alone
    that the recorder received as it began: they were published before.
    """
    if view.timeline.is_log(topic):
        return frozenset()
    begun = np.array([stop for _, stop in view.snapshot.breaks], np.int64)
    firsts = np.sort(view.bounds(topic, window.widened(_OLDEST_STATE_NS))[0])
    nth = np.searchsorted(firsts, begun)
    begun, firsts = begun[nth < firsts.size], firsts[nth[nth < firsts.size]]
    if _holds_over_runs(view, topic):
        firsts = firsts[firsts - begun <= _RECEIVED_NS]
    return frozenset(firsts.tolist())


def _holds_over_runs(view: View, topic: str) -> bool:
    """Returns whether what a topic said holds in the next run of the recorder: no goals do."""
    return is_latched(view, topic) and GOALS not in view.timeline.types_of(topic)


def _has_message_of_run(view: View, topic: str, at: Ns) -> bool:
    """Returns whether a topic has a message of the recorder's run at a moment, up to then."""
    return any(view.timeline.extents(topic, TimeWindow(_begin_of_run(view, at), at + 1)))


def is_first_of_run(view: View, topic: str, at: Ns) -> bool:
    """Returns whether a topic had no message in the recorder's run before a message at a moment.

    And whether that is no message of those that the recorder receives as it begins.
    """
    begun, earliest = _begin_of_run(view, at), view.snapshot.earliest
    if earliest is None or at - max(begun, earliest) <= _RECEIVED_NS:
        return False
    return not any(view.timeline.extents(topic, TimeWindow(begun, at)))


def _begin_of_run(view: View, at: Ns) -> Ns:
    """Returns when the recorder's run at a moment began (ns); `MIN_NS` of the first one."""
    breaks = view.snapshot.breaks
    nth = bisect_right(breaks, at, key=itemgetter(1)) - 1
    return breaks[nth][1] if nth >= 0 else MIN_NS


def _command_topic(view: View) -> str:
    """Returns the topic of velocities that command the robot's base; empty if there is none.

    Navigation chains such topics, from `/cmd_vel_nav` over `/cmd_vel_smoothed` to `/cmd_vel`: the
    shortest name is the last one.
    """
    timeline = view.timeline
    topics = [
        topic
        for topic in timeline.topics()
        if topic.rsplit("/", 1)[-1].startswith("cmd_vel")
        and not VELOCITIES.isdisjoint(timeline.types_of(topic))
    ]
    return min(topics, key=lambda topic: (len(topic), topic), default="")


def _with_state_before(
    view: View, topic: str, window: TimeWindow, events: TopicEvents
) -> TopicEvents:
    """Returns the events in a window, joined with the state before it.

    No events, if the topic cannot have changes, as a detector's: then nothing before is read.
    """
    is_log = LOG in view.timeline.types_of(topic)
    if not (is_log or events.is_empty or events.known):
        return NO_EVENTS
    start = max(window.start - _LEAD_NS, MIN_NS)
    if _holds_over_runs(view, topic):
        newest = held_at(view, topic, start)
    else:
        newest = view.stream.newest(topic, TimeWindow(max(start - _OLDEST_STATE_NS, MIN_NS), start))
    before = events_of_messages(view, [] if newest is None else [newest])
    parts = (before, events_in(view, topic, TimeWindow(start, window.start)), events)
    return joined_events([part.without_sights() for part in parts])


def _changes_of_topic(topic: str, events: TopicEvents) -> Iterator[_DatedChange]:
    """Yields the reports of a topic, the changes of its states, and states that are new."""
    for report in events.reports:
        span_s, often = unix_from_ns(report.last - report.first), report.reports
        again = f" ({often} times in {span_s:.0f} s)" if often > 1 else ""
        yield _DatedChange(report.first, report.last, Quoted(report.text + again))
    for together in toggled_together(change for change in events.changes if change.kind == FLAG):
        at = together[0].time
        yield _DatedChange(at, at, toggle_sentence(topic, *together), topic)
    levels = {state.name: state.first for state in events.known if state.kind == CHARGE}
    for change in events.changes:
        is_accepted_before = change.kind == GOAL and change.value not in GOAL_WORDS
        level = levels.get(change.name, 0)
        text = "" if is_accepted_before else _change_sentence(topic, change, level)
        if change.kind == CHARGE:
            levels[change.name] = change.value
        if text:
            yield _DatedChange(change.time, change.time, text)
    for kind, name, at, first, _, said in events.known:
        # Earlier messages did not have this goal, this status that is not ok, or this low charge.
        if at != events.first and (kind == GOAL or first):
            text = _change_sentence(topic, Change(kind, name, at, first, said), 0)
            if text:
                yield _DatedChange(at, at, text)


def _change_sentence(topic: str, change: Change, level_before: int) -> str:
    """Returns a sentence on a status, a goal or a lower charge; empty for any other change."""
    if change.kind == STATUS:
        more = f": {change.text}" if change.text else ""
        sentence = f"status of {change.name} became {_level(change.value)}{more}"
        return shortened(Quoted(sentence), _MAX_LOG_CHARS)
    if change.kind == GOAL:
        return f"{action_of(topic)} goal {GOAL_WORDS.get(change.value, 'accepted')}"
    if change.kind == CHARGE and change.value > level_before:
        who, low = battery_of(topic, change.name), LOW_CHARGES[change.value - 1]
        return repeating(f"{who} fell below {low:.0%}", [change.name])
    return ""


def _level(number: int) -> str:
    """Returns a level of diagnostics in words."""
    return _LEVELS[number] if 0 <= number < len(_LEVELS) else f"level {number}"


def _goal_activity(events: TopicEvents) -> Iterator[tuple[Ns, bool]]:
    """Yields whether an action's newest goal is active, from each change of a goal's status on.

    Older goals do not count: their ends may not be recorded.
    """
    goals, changes = events.of_kind(GOAL)
    begun = {goal.name: goal.at for goal in goals}
    states = [(goal.at, goal.name, goal.first) for goal in goals]
    states += [(change.time, change.name, change.value) for change in changes]
    newest, active_goals = MIN_NS, set[str]()
    for time, name, value in sorted(states):
        if begun[name] > newest:
            newest = begun[name]
            active_goals.clear()
        if begun[name] == newest:
            active_goals.discard(name)
            if value in _ACTIVE_GOAL:
                active_goals.add(name)
        yield time, bool(active_goals)


def _is_active(activity: Sequence[tuple[Ns, bool]], time: Ns) -> bool:
    """Returns whether an action's newest goal was active at a time; see `_goal_activity`."""
    nth = bisect_right(activity, (time, True)) - 1
    return nth >= 0 and activity[nth][1]


def _state_at_end(
    view: View, window: TimeWindow, events_of_topics: Mapping[str, TopicEvents]
) -> Iterator[tuple[str, bool | str]]:
    """Yields booleans, statuses that are not ok, and the newest goal of each action, at the end.

    From before the recorder's current run only the values of latched topics hold, and no goals.
    """
    for topic, events in events_of_topics.items():
        is_of_run = _has_message_of_run(view, topic, window.stop - 1)
        if not (is_of_run or _holds_over_runs(view, topic)):
            continue
        is_battery = any(state.kind == CHARGE for state in events.known)
        flags, _ = events.of_kind(FLAG)
        for flag in () if is_battery else flags:
            yield flag_name(topic, flag), bool(flag.last)
        goals, _ = events.of_kind(GOAL)
        if goals:
            # Servers list the newest goal last.
            newest = max(goals[::-1], key=lambda state: (state.at, state.last in _ACTIVE_GOAL))
            word = GOAL_WORDS.get(newest.last, "active")
            is_active = newest.last in _ACTIVE_GOAL
            if is_active and last_listings(view, topic, window, {newest.name}):
                word = "listed no more"  # its server has restarted
            yield f"{action_of(topic)} goal", word
        statuses, _ = events.of_kind(STATUS)
        for status in statuses:
            if status.last:
                yield Quoted(f"status of {status.name}"), _level(status.last)


def recap_before(
    memory: Memory, call: Call, at_s: float, length_s: float, frame_id: str | None = None
) -> Before:
    """Returns what changed in the seconds before a moment, and the state of the robot then.

    And the first changes after it: a robot may report a cause only seconds later.

    Raises:
        InvalidArgumentsError: the moment is not finite, or no transform leads to `frame_id`.
        NoDataError: nothing is recorded.
        QueryTimeoutError: the call's time is over.
    """
    at, length = ns_argument("around", at_s), ns_argument("seconds_before", length_s)
    view = open_view(memory, call, max(at, min(at + _AFTER_NS, memory.clock.now())))
    window = TimeWindow(max(at - length, MIN_NS), min(at + SLACK_NS + 1, MAX_NS))
    changes = changes_in(view, window, {})
    past = changes.before(at, length, slack=SLACK_NS)
    until = min(at + _AFTER_NS + 1, MAX_NS)
    later = changes_in(view, TimeWindow(window.stop, until), {})
    robot, speed_mps = _pose_and_speed(view, at, frame_id)
    if not view.timeline.overlapping(window):
        view.notes.add(f"nothing was recorded in the {length_s:g} s before")
    elif not changes.looked_at:
        view.notes.add("no topic that would show a change is recorded at this time")
    for topic, events in changes.events.items():
        note_left_out(view, topic, events)
    what = "the pose, the state and the changes may be from before that or from after it"
    note_times_twice(view, TimeWindow(window.start, until), what)
    note_unread(view, window)
    note_edges(view, window)
    return Before(
        at,
        length,
        past[:_MOST_CHANGES],
        len(past[_MOST_CHANGES:]),
        changes.looked_at,
        robot,
        speed_mps,
        (*changes.state, *_charges(view, at)),
        later.after(at, _AFTER_NS, slack=SLACK_NS)[:_MOST_AFTER],
        notes=view.notes.sentences(),
    )


def _pose_and_speed(view: View, at: Ns, frame_id: str | None) -> tuple[Pose | None, float | None]:
    """Returns the robot's newest pose, in the map if transforms lead there, and its speed (m/s).

    Raises:
        InvalidArgumentsError: no transform leads to `frame_id` at any time.
    """
    try:
        newest = newest_pose(view, resolve_path_topic(view), TimeWindow.before(at, _POSE_NS))
    except (InvalidArgumentsError, NoDataError):
        return None, None
    if newest is None:
        return None, None
    message, pose = newest
    twist = view.extractor.twist(view.bags.decode(message), message.type)
    speed_mps = None if twist is None else math.hypot(*twist.linear)
    if pose is None:
        return None, speed_mps
    recording = message.recording
    placed_pose = pose_if_placed(view, pose, message.time, recording, frame_id)
    if placed_pose is None:
        return None, speed_mps
    return with_place(view, placed_pose, message.time, recording), speed_mps


def _charges(view: View, at: Ns) -> Iterator[tuple[str, str]]:
    """Yields how full each battery was at a moment, by its topic."""
    timeline = view.timeline
    for topic in timeline.topics():
        if BATTERY not in timeline.types_of(topic):
            continue
        message = view.stream.newest(topic, TimeWindow.before(at, _LEAD_NS))
        fraction = None if message is None else charge_of(view.value(message))
        if message is not None and fraction is not None:
            is_of_percent = _is_nearly_empty(view, topic, message.time)
            yield topic, f"{fraction / 100 if is_of_percent else fraction:.0%}"


def _is_nearly_empty(view: View, topic: str, at: Ns) -> bool:
    """Returns whether the charge of a message is of the last percents of a battery.

    0.9 % looks like a fraction, but percents that can be no fraction led to it in the hour before.
    """
    brief = view.brief()
    recent = TimeWindow.before(at, _OLDEST_STATE_NS)
    try:
        percent = newest_above(brief, topic, "percentage", FULL_CHARGE, recent)
    except QueryTimeoutError:
        return False
    if percent is None or percent.time == at:
        return False
    charge = charge_of(brief.value(percent))
    return charge is not None and charge < min(LOW_CHARGES)
