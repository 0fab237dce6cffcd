"""The events of one topic in a window, from what its messages state; and the goals of actions.

A status message of an action lists every goal that its server still knows, also goals that ended
some minutes before. So a goal begins with the first message that lists it, unless it may have been
listed before. It ends when its status becomes succeeded, canceled or aborted
(action_msgs/msg/GoalStatus).

A search for a status finds goals, not messages (`goals_matching`): a message that lists a goal says
nothing of when the goal got that status.
"""

from __future__ import annotations

from collections import defaultdict
from heapq import merge
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.facts import FLAG, GOAL, GOALS, Stated, joined_stated, state_of, stated_by
from ros2_memory.analysis.goals import ENDED, GOAL_WORDS, STATUS, STATUS_WORDS, statuses_matching
from ros2_memory.analysis.intervals import IntervalTable
from ros2_memory.analysis.topic_events import (
    Change,
    KnownState,
    Report,
    TopicEvents,
    events_of,
    joined_events,
)
from ros2_memory.columns.fragments import FragmentKey, FragmentKind
from ros2_memory.columns.scan import STRETCH_NS
from ros2_memory.columns.stated import StatedColumns
from ros2_memory.columns.writing import PART_NS
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.text import Reason, counted, listed
from ros2_memory.history.context import Note
from ros2_memory.history.lasting import breaks_of, held_at, is_latched
from ros2_memory.history.scan import (
    blocks,
    joined_back,
    messages_of,
    of_columns,
    open_scan,
    remembered,
)
from ros2_memory.insights.silences import unrecorded_times
from ros2_memory.messages.levels import FOXGLOVE_LOGS

if TYPE_CHECKING:
    from collections.abc import Container, Iterable, Iterator, Mapping, Sequence

    from ros2_memory.analysis.conditions import Condition
    from ros2_memory.columns.scan import Stretch
    from ros2_memory.columns.units import Rows
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.bag_access import StoredMessage
    from ros2_memory.history.view import View
    from ros2_memory.places.where import Scope


def _joined_events(parts: Sequence[TopicEvents]) -> Sequence[TopicEvents]:
    whole = joined_events(parts)
    return [] if whole.is_empty else [whole]


EVENTS: Final = FragmentKind(
    "events", (TopicEvents, IntervalTable, KnownState, Change, Report), _joined_events
)
"""What came into view, changed or failed on a topic in a part."""
_MOST_NAMED: Final = 5
"""So many booleans that toggled in one message are named."""
_UNDECODED: Final = Reason("could not be decoded, so their content is missing", "topic")


def flag_name(topic: str, flag: KnownState | Change) -> str:
    """Returns the name of a boolean of a topic, for sentences."""
    return topic if flag.name == "value" else f"{topic} {flag.name}"


def toggle_sentence(topic: str, *toggles: Change) -> str:
    """Returns "... became true" for booleans of a message that toggled to the same value."""
    named = flag_name(topic, toggles[0])
    if len(toggles) > 1:
        named = f"{topic} {listed([toggle.name for toggle in toggles], at_most=_MOST_NAMED)}"
    return f"{named} became {'true' if toggles[0].value else 'false'}"


def toggled_together(toggles: Iterable[Change]) -> list[list[Change]]:
    """Returns toggles in groups: those of one message to the same value, in their order."""
    groups: defaultdict[tuple[Ns, bool], list[Change]] = defaultdict(list)
    for toggle in toggles:
        groups[toggle.time, bool(toggle.value)].append(toggle)
    return [*groups.values()]


def message_before(view: View, topic: str, first: Ns) -> StoredMessage | None:
    """Returns the message before a log time (ns); None if one may be missing in between."""
    if is_latched(view, topic):
        return held_at(view, topic, first)
    message = view.stream.last(topic, first)
    is_last = message is not None and _is_unbroken(view, topic, message.time, first)
    return message if is_last else None


def flags_before(view: View, topic: str, first: Ns) -> dict[str, bool]:
    """Returns the booleans in the message before a log time (ns), by their names.

    Empty if a message may be missing in between: the booleans may have toggled there.
    """
    message = message_before(view, topic, first)
    flags, _ = events_of_messages(view, [] if message is None else [message]).of_kind(FLAG)
    return {flag.name: bool(flag.last) for flag in flags}


def _is_unbroken(view: View, topic: str, before: Ns, first: Ns) -> bool:
    """Returns whether no message of a topic can be missing between two log times (ns)."""
    between = TimeWindow(before, first)
    is_broken = any(between.contains(at) for at in breaks_of(view, topic))
    return not is_broken and not unrecorded_times(view, topic, between)


def events_in(view: View, topic: str, window: TimeWindow) -> TopicEvents:
    """Returns what the messages of a topic report in a window.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
    return joined_events([events for _, events in events_back(view, topic, window)][::-1])


def events_back(view: View, topic: str, window: TimeWindow) -> Iterator[tuple[Ns, TopicEvents]]:
    """Yields the events in consecutive times, the newest first, with the start of the time (ns).

    Raises:
        QueryTimeoutError: while it is iterated, when the deadline has passed.
    """
    columns = StatedColumns(view.extractor)
    opened = open_scan(view, topic, window, stored=view.call.stored)

    def make(stretch: Stretch) -> Iterator[tuple[Ns, TopicEvents]]:
        rows = opened.rows(newest_first=True, among=stretch.window)
        for overlapping in blocks(rows, newest_first=True):
            first = max(min(rows.first for rows in overlapping), window.start)
            is_whole = all(rows.part is not None for rows in overlapping)
            is_wanted = is_whole or stretch.parts is not None or not view.call.stored
            if stretch.window.contains(first) and is_wanted:
                # The older parts of the stretch are asked for next.
                before = min(first - stretch.window.start, STRETCH_NS)
                yield first, _events_of_rows(view, columns, overlapping, before)

    return joined_back(view, opened, EVENTS, make, lambda stretch: stretch.key(topic))


def make_events(view: View, window: TimeWindow, topics: Iterable[str]) -> Iterator[Ns]:
    """Makes and stores the events of parts in a window, the newest first.

    Yields the log time (ns) of each part.

    Raises:
        QueryTimeoutError: while it is iterated, when the deadline has passed.
    """
    # Widened, so that parts across a bound of the window are made, too.
    of_topics = [events_back(view, topic, window.widened(PART_NS)) for topic in topics]
    yield from merge(*((at for at, _ in timed) for timed in of_topics), reverse=True)


def events_of_messages(view: View, messages: Iterable[StoredMessage]) -> TopicEvents:
    """Returns what messages of one topic report."""
    return events_of(_stated_in_messages(view, messages))


def events_by_bag(
    view: View, tables: Iterable[Rows], files: Container[str]
) -> dict[str, TopicEvents]:
    """Returns the events that a topic has in each bag alone, by the bag's file.

    Args:
        view: of the call.
        tables: all rows of the topic, in these bags and in others.
        files: of the bags.
    """
    columns = StatedColumns(view.extractor)
    stated_of_bags: dict[str, list[Stated]] = defaultdict(list)
    for rows in tables:
        stated = _stated_in_rows(view, columns, rows)
        is_whole = len(stated.times) == len(rows)  # else some messages are undecodable
        for bag, positions in rows.bag_rows(files):
            if is_whole:
                stated_of_bags[bag.file].append(stated.at(positions))
            else:
                of_bag = _stated_in_rows(view, columns, rows.some(positions))
                stated_of_bags[bag.file].append(of_bag)
    return {file: events_of(joined_stated(parts)) for file, parts in stated_of_bags.items()}


def _events_of_rows(
    view: View, columns: StatedColumns, overlapping: list[Rows], also_before: Ns
) -> TopicEvents:
    """Returns the events of rows that overlap in time; of whole parts from the store."""

    def make() -> TopicEvents:
        stated = joined_stated([_stated_in_rows(view, columns, rows) for rows in overlapping])
        return events_of(stated)

    parts = tuple(rows.part for rows in overlapping if rows.part is not None)
    key = None
    if len(parts) == len(overlapping):
        key = FragmentKey(overlapping[0].first, overlapping[0].table.channel.topic, parts)
    return remembered(view, EVENTS, key, make, also_before=also_before)


def _stated_in_rows(view: View, columns: StatedColumns, rows: Rows) -> Stated:
    """Returns what the messages of rows state: by columns where possible, else by the messages."""
    states = of_columns(view, rows, lambda counting: _stated_by_columns(view, columns, counting))
    if states is None:
        return _stated_in_messages(view, messages_of(view, rows))
    return joined_stated(states)


def _stated_by_columns(view: View, columns: StatedColumns, rows: Rows) -> Stated | None:
    """Returns what the messages of rows state; None if all of them must be read."""
    of_table = columns.of(rows.table)
    if of_table is None:
        return None
    counting = of_table.stated if rows.index is None else of_table.stated.at(rows.index)
    stated = counting._replace(times=rows.times)
    to_read = of_table.to_read(rows.index)
    if not to_read.size:
        return stated
    others = np.setdiff1d(np.arange(len(rows)), to_read)
    read = _stated_in_messages(view, messages_of(view, rows.some(to_read)))
    return joined_stated([stated.at(others), read])


def _stated_in_messages(view: View, messages: Iterable[StoredMessage]) -> Stated:
    """Returns what messages state, in order of log time; undecodable messages state nothing."""
    states = []
    for message in messages:
        value = view.value(message)
        states.append((message.time, None if value is None else state_of(value, message.type)))
    # The messages of a part come bag after bag.
    states.sort(key=lambda timed_state: timed_state[0])
    return stated_by([time for time, _ in states], [state for _, state in states])


def note_limits(view: View, topic: str, events: TopicEvents) -> None:
    """Notes the messages of a topic that cannot be decoded, and the events that are too many."""
    if events.undecodable:
        messages = counted(events.undecodable, "message")
        view.notes.add(Note(_UNDECODED, f"{messages} of {topic}"))
    note_left_out(view, topic, events)


def note_left_out(view: View, topic: str, events: TopicEvents) -> None:
    """Notes the events of a topic that are too many."""
    if events.left_out:
        view.notes.add(f"{topic} changes too often to list each change: {events.left_out} more")
    if events.beyond:
        view.notes.add(
            f"{topic} has too many booleans or things in one message: {events.beyond} more are "
            "not followed"
        )


def note_foxglove_logs(view: View, window: TimeWindow) -> None:
    """Notes the logs of Foxglove's type: their errors are no events, those of ROS logs are."""
    timeline = view.timeline
    for topic in timeline.topics():
        types = timeline.types_of(topic)
        if FOXGLOVE_LOGS.isdisjoint(types):
            continue
        foxglove_types = FOXGLOVE_LOGS & {
            part.type
            for extent in timeline.extents(topic, window)
            for part in extent.bag.summary.of(topic)
        }
        if foxglove_types:
            # Where the topic has two types, its levels have no names; no log of ROS has a 4.
            search = '"above", field "level", value "WARN"'
            if len(types) > 1:
                search = '"equals", field "level", value 4'
            type_name = min(foxglove_types)
            view.notes.add(
                f"errors in {topic} are not among the events, since it is of {type_name}: "
                f"find_matches with condition_type {search} lists them"
            )


STATUS_TOPIC: Final = "/_action/status"


class GoalRun(NamedTuple):
    """A goal in a window. Times are log times (ns).

    Attributes:
        goal: its id in hexadecimal digits.
        accepted: None if it was active before the window.
        ended: None if no message says that it ended.
        status: its last status (action_msgs/msg/GoalStatus).
        first, last: the times between which it is known (inclusive).
        is_lost: its server went on without it, as after a restart. It was last listed at `last`.
    """

    topic: str
    goal: str
    accepted: Ns | None
    ended: Ns | None
    status: int
    first: Ns
    last: Ns
    is_lost: bool = False

    @property
    def action(self) -> str:
        """The name of the action."""
        return action_of(self.topic)

    @property
    def outcome(self) -> str | None:
        """How the goal ended; None if it did not."""
        return None if self.ended is None else GOAL_WORDS[self.status]

    @property
    def status_word(self) -> str:
        """The last status in a word."""
        return STATUS_WORDS.get(self.status, str(self.status))


def action_of(topic: str) -> str:
    """Returns the name of an action by its topic of statuses."""
    return topic.removesuffix(STATUS_TOPIC)


def goals_in(
    view: View, window: TimeWindow, events_of_topics: Mapping[str, TopicEvents]
) -> Iterator[GoalRun]:
    """Yields the goals that were active in a window, and that a message in it lists.

    `events_of_topics` has what the messages of each topic report in the window.
    """
    for topic, events in events_of_topics.items():
        if not events.known or GOALS not in view.timeline.types_of(topic):
            continue
        goals = [*_goal_runs(topic, events, *_listed_before(view, topic, window, events))]
        active = {goal.goal for goal in goals if goal.ended is None}
        listings = last_listings(view, topic, window, active)
        for goal in goals:
            last = listings.get(goal.goal)
            yield goal if last is None else goal._replace(last=last, is_lost=True)


def _listed_before(
    view: View, topic: str, window: TimeWindow, events: TopicEvents
) -> tuple[dict[str, int], bool]:
    """Returns the goals in the last message before a window, with their statuses.

    And whether they are all the goals until the first message of the window.
    """
    message = view.stream.last(topic, window.start)
    if message is None:
        return {}, False
    earlier = events_of_messages(view, [message])
    goals, _ = earlier.of_kind(GOAL)
    is_whole = not (earlier.beyond or earlier.undecodable)
    is_all = is_whole and _is_unbroken(view, topic, message.time, events.first)
    return {goal.name: goal.last for goal in goals}, is_all


def last_listings(view: View, topic: str, window: TimeWindow, active: set[str]) -> dict[str, Ns]:
    """Returns the active goals that a window's newest message lacks, each with its last listing.

    That is the log time (ns) of the last message that lists the goal. A server lists an active goal
    for as long as it runs, so it has been restarted since.
    """
    listings: dict[str, Ns] = {}
    missing = set(active)
    if not missing:
        return listings
    messages = view.stream.messages([topic], window, newest_first=True)
    for nth, message in enumerate(messages):
        events = events_of_messages(view, [message])
        if events.beyond or events.undecodable:
            break  # the message may list goals that are not known
        goals, _ = events.of_kind(GOAL)
        listed = missing.intersection(goal.name for goal in goals)
        missing -= listed
        if nth > 0:
            listings |= dict.fromkeys(listed, message.time)
        if not missing:
            break
    return listings


def goals_matching(
    view: View, topics: Sequence[str], condition: Condition, scope: Scope
) -> list[GoalRun] | None:
    """Returns the goals whose last status meets a condition, the last one first.

    With a bounded scope a goal counts by where the scope held when the goal ended. Returns None if
    the topics do not all list goals, or if the condition is on another field than the status.

    Raises:
        InvalidArgumentsError: no status meets the condition.
        QueryTimeoutError: the call's time is over.
    """
    types = {name for topic in topics for name in view.timeline.types_of(topic)}
    field = None if condition.field is None else condition.field.rsplit(".", 1)[-1]
    if types != {GOALS} or field not in {None, STATUS}:
        return None
    wanted = statuses_matching(topics[0], condition)
    goals = [goal for goal in _known_goals(view, topics, scope.window) if goal.status in wanted]
    goals.sort(key=lambda goal: (goal.last, goal.first, goal.goal), reverse=True)
    goals = [goal for goal in goals if scope.holds_at(goal.last)]
    lost = [goal for goal in goals if goal.is_lost]
    if lost:
        view.notes.add(
            f"{counted(len(lost), 'goal')} whose end was not published, and which the action "
            "server listed no more: last is when it did"
        )
    return goals


def _known_goals(view: View, topics: Sequence[str], window: TimeWindow) -> Iterator[GoalRun]:
    """Yields the goals that were active in a window, even if no message in it lists them."""
    events_of_topics = {topic: events_in(view, topic, window) for topic in topics}
    for topic, events in events_of_topics.items():
        note_limits(view, topic, events)
    start, _ = window.asked()
    active_at_start = {topic: _active_at(view, topic, start) for topic in topics}
    for goal in goals_in(view, window, events_of_topics):
        was_active = goal.accepted is None and goal.goal in active_at_start[goal.topic]
        yield goal._replace(first=start) if was_active else goal
    for topic, events in events_of_topics.items():
        if events.is_empty:
            for name, status in active_at_start[topic].items():
                yield GoalRun(topic, name, None, None, status, start, start)


def _active_at(view: View, topic: str, moment: Ns) -> dict[str, int]:
    """Returns the active goals in a latched topic's last message before a moment, with statuses.

    Empty if another run of the recorder has begun since.
    """
    held = held_at(view, topic, moment)
    if held is None or any(held.time <= start < moment for start, _ in view.snapshot.breaks):
        return {}
    listed, _ = events_of_messages(view, [held]).of_kind(GOAL)
    return {goal.name: goal.last for goal in listed if goal.last not in ENDED}


def _goal_runs(
    topic: str, events: TopicEvents, statuses_before: Mapping[str, int], knows_all: bool
) -> Iterator[GoalRun]:
    """Yields the goals that an action's messages list, unless they ended before.

    `statuses_before` has the goals that were listed before. `knows_all`: there were no others, so a
    goal that is new in the first message has just begun, even if it is listed as ended.
    """
    ends: dict[str, tuple[Ns, int]] = {}
    goals, changes = events.of_kind(GOAL)
    for change in changes:
        if change.value in ENDED:
            ends.setdefault(change.name, (change.time, change.value))
    for goal in goals:
        is_listed_first = goal.at == events.first
        if statuses_before.get(goal.name) in ENDED:
            continue
        if goal.first in ENDED:
            if goal.name not in statuses_before and is_listed_first and not knows_all:
                continue  # it may have ended long before
            ends[goal.name] = (goal.at, goal.first)
        ended, status = ends.get(goal.name, (None, goal.last))
        accepted = None if goal.name in statuses_before else goal.at
        last = events.last if ended is None else ended
        yield GoalRun(topic, goal.name, accepted, ended, status, goal.at, last)
