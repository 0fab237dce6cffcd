"""The events of one topic in a window, from what its messages state; and the goals of actions.

A status message of an action lists every goal that its server still knows, also those that ended
some minutes before. So a goal begins where a message lists it that the one before does not, and
ends where its status becomes succeeded, canceled or aborted (action_msgs/msg/GoalStatus).

`goals_asked` is for searches: a condition on the status of such a topic is met by goals, not by
messages, since what a server lists says nothing of when it happened.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from heapq import merge
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.facts import FLAG, GOAL, GOALS, Stated, joined_stated, state_of, stated_by
from ros2_memory.analysis.topic_events import (
    Change,
    KnownState,
    TopicEvents,
    events_of,
    joined_events,
)
from ros2_memory.columns.fragments import FragmentKey
from ros2_memory.columns.kinds import EVENTS
from ros2_memory.columns.scan import STRETCH_NS
from ros2_memory.columns.stated import StatedColumns
from ros2_memory.columns.writing import PART_NS
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.text import Reason, counted
from ros2_memory.history.context import Note
from ros2_memory.history.held_values import breaks_of, held_at, is_latched
from ros2_memory.history.scan import (
    blocks,
    joined_back,
    messages_of,
    of_columns,
    open_scan,
    remembered,
)
from ros2_memory.insights.silences import unrecorded_times

if TYPE_CHECKING:
    from collections.abc import Container, Iterable, Iterator, Mapping, Sequence

    from ros2_memory.analysis.conditions import Condition
    from ros2_memory.columns.scan import Stretch
    from ros2_memory.columns.units import Rows
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.stored_message import StoredMessage
    from ros2_memory.history.view import View
    from ros2_memory.places.where import Scope

_UNDECODED: Final = Reason("could not be decoded, so their content is missing", "topic")


def flag_name(topic: str, flag: KnownState | Change) -> str:
    """Returns how a boolean of a topic is called."""
    return topic if flag.name == "value" else f"{topic} {flag.name}"


def toggle_sentence(topic: str, toggle: Change) -> str:
    """Returns a sentence for a boolean of a topic that toggle_sentence."""
    return f"{flag_name(topic, toggle)} became {'true' if toggle.value else 'false'}"


def flags_before(view: View, topic: str, first: Ns) -> dict[str, bool]:
    """Returns the booleans of the message before one at a log time (ns), by their names.

    Without those that may have toggle_sentence in between, since a message there may be missing.
    """
    holds_on = is_latched(view, topic)
    message = held_at(view, topic, first) if holds_on else view.stream.last(topic, first)
    if message is None or not (holds_on or _lacks_none(view, topic, message.time, first)):
        return {}
    flags, _ = (events_of_messages(view, [message]) or TopicEvents(1, 0)).of_kind(FLAG)
    return {flag.name: bool(flag.last) for flag in flags}


def _lacks_none(view: View, topic: str, before: Ns, first: Ns) -> bool:
    """Returns whether no message of a topic may be missing between two, by their log times (ns)."""
    between = TimeWindow(before, first)
    is_broken = any(between.contains(at) for at in breaks_of(view, topic))
    return not is_broken and not unrecorded_times(view, topic, between)


def events_in(view: View, topic: str, window: TimeWindow) -> TopicEvents | None:
    """Returns what the messages of a topic report in a window; None where there is no message.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
    return joined_events([events for _, events in events_back(view, topic, window)][::-1])


def events_back(view: View, topic: str, window: TimeWindow) -> Iterator[tuple[Ns, TopicEvents]]:
    """Yields the events in times that do not overlap, the newest first.

    Each with a log time (ns) before which none of its events is.

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
                # Those before it in the stretch are wanted next.
                before = min(first - stretch.window.start, STRETCH_NS)
                yield first, _events_of_tables(view, columns, overlapping, before)

    return joined_back(view, opened, EVENTS, make, lambda stretch: stretch.key(topic))


def make_events(view: View, window: TimeWindow, topics: Iterable[str]) -> Iterator[Ns]:
    """Makes the events of the parts of some topics in a window, the newest first.

    Yields a log time (ns) of each.

    Raises:
        QueryTimeoutError: while it is iterated, when the deadline has passed.
    """
    # The parts that lie across a bound of the window are made, too.
    of_topics = [events_back(view, topic, window.widened(PART_NS)) for topic in topics]
    yield from merge(*((at for at, _ in timed) for timed in of_topics), reverse=True)


def events_of_messages(view: View, messages: Iterable[StoredMessage]) -> TopicEvents | None:
    """Returns what messages of one topic report; None without any."""
    return events_of(_stated_in_messages(view, messages))


def events_by_bag(
    view: View, tables: Iterable[Rows], files: Container[str]
) -> dict[str, TopicEvents]:
    """Returns the events that a topic has in each of some bags alone, by their files.

    Args:
        view: of the call.
        tables: all rows of the topic, of these bags and of others.
        files: of the bags.
    """
    columns = StatedColumns(view.extractor)
    stated_of_bags: dict[str, list[Stated]] = defaultdict(list)
    for rows in tables:
        stated = _stated_in_rows(view, columns, rows)
        for bag, positions in rows.bag_rows(files):
            is_whole = len(stated.times) == len(rows)  # else some are undecodable
            some = rows.some(positions)
            of_bag = stated.at(positions) if is_whole else _stated_in_rows(view, columns, some)
            stated_of_bags[bag.file].append(of_bag)
    return {
        file: events
        for file, parts in stated_of_bags.items()
        if (events := events_of(joined_stated(parts))) is not None
    }


def _events_of_tables(
    view: View, columns: StatedColumns, together: list[Rows], also_before: Ns
) -> TopicEvents:
    """Returns the events of tables that overlap in time; those of whole parts are remembered."""

    def make() -> TopicEvents:
        stated = joined_stated([_stated_in_rows(view, columns, rows) for rows in together])
        return events_of(stated) or TopicEvents(1, 0)

    parts = tuple(rows.part for rows in together if rows.part is not None)
    topic = together[0].table.channel.topic
    key = FragmentKey(together[0].first, topic, parts) if len(parts) == len(together) else None
    return remembered(view, EVENTS, key, make, also_before=also_before)


def _stated_in_rows(view: View, columns: StatedColumns, rows: Rows) -> Stated:
    """Returns what the messages of some rows state: by their columns, else by reading them."""
    states = of_columns(view, rows, lambda counting: _stated_by_columns(view, columns, counting))
    if states is None:
        return _stated_in_messages(view, messages_of(view, rows))
    return joined_stated(states)


def _stated_by_columns(view: View, columns: StatedColumns, rows: Rows) -> Stated | None:
    """Returns what the messages of some rows state; None where all of them have to be read."""
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
    """Returns what messages state, in order of log time; nothing of one that is undecodable."""
    states = []
    for message in messages:
        value = view.value(message)
        states.append((message.time, None if value is None else state_of(value, message.type)))
    # Those of a part come bag after bag, in the order in which bags were stored.
    states.sort(key=lambda timed_state: timed_state[0])
    return stated_by([time for time, _ in states], [state for _, state in states])


def note_limits(view: View, topic: str, events: TopicEvents) -> None:
    """Adds notes on events of a topic that are left out: too many, or undecodable."""
    if events.undecodable:
        messages = counted(events.undecodable, "message")
        view.notes.add(Note(_UNDECODED, f"{messages} of {topic}"))
    note_left_out(view, topic, events)


def note_left_out(view: View, topic: str, events: TopicEvents) -> None:
    """Adds notes on events of a topic that are too many."""
    if events.left_out:
        view.notes.add(f"{topic} changes too often to list each change: {events.left_out} more")
    if events.beyond:
        view.notes.add(
            f"{topic} has too many booleans or things in one message: {events.beyond} more are "
            "not followed"
        )


STATUS_TOPIC: Final = "/_action/status"
GOAL_WORDS: Final = {3: "canceling", 4: "succeeded", 5: "canceled", 6: "aborted"}
FAILURES: Final = frozenset({"canceled", "aborted"})
_ENDED: Final = frozenset({4, 5, 6})
_STATUS: Final = "status"
_STATUS_WORDS: Final = {0: "unknown", 1: "accepted", 2: "executing", **GOAL_WORDS}
_FAILED: Final = "failed"


class GoalRun(NamedTuple):
    """A goal: when it was accepted and when it ended, as log times, and its last status.

    `accepted` is None for a goal that was active before the window, `ended` for one that no message
    says to have ended. `first` and `last` are the log times between which it is known (inclusive);
    `goal` is its id in hexadecimal digits. `is_lost`: its server went on without it, as after a
    restart, and listed it at `last` for the last time.
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
        """The name of its action."""
        return action_of(self.topic)

    @property
    def outcome(self) -> str | None:
        """How it ended; None for one that has not."""
        return None if self.ended is None else GOAL_WORDS[self.status]

    @property
    def status_word(self) -> str:
        """Its last status in a word."""
        return _STATUS_WORDS.get(self.status, str(self.status))


def action_of(topic: str) -> str:
    """Returns the name of an action by the topic of its statuses."""
    return topic.removesuffix(STATUS_TOPIC)


def goals_in(
    view: View, window: TimeWindow, events_of_topics: Mapping[str, TopicEvents | None]
) -> Iterator[GoalRun]:
    """Yields the goals that a message of a window lists and that were active in it.

    `events_of_topics` has what the messages of each topic report in the window.
    """
    for topic, events in events_of_topics.items():
        if events is None or GOALS not in view.timeline.types_of(topic):
            continue
        # Which goals it listed before: what a window's first message lists need not be new.
        message_before = view.stream.last(topic, window.start)
        earlier = None if message_before is None else events_of_messages(view, [message_before])
        statuses_before, knows_all = dict[str, int](), False
        if message_before is not None and earlier is not None:
            statuses_before = {goal.name: goal.last for goal in earlier.of_kind(GOAL)[0]}
            is_whole = not (earlier.beyond or earlier.undecodable)
            knows_all = is_whole and _lacks_none(view, topic, message_before.time, events.first)
        goals = [*_goal_runs(topic, events, statuses_before, knows_all=knows_all)]
        lost = last_listings(
            view, topic, window, {goal.goal for goal in goals if goal.ended is None}
        )
        for goal in goals:
            last = lost.get(goal.goal)
            yield goal if last is None else goal._replace(last=last, is_lost=True)


def last_listings(view: View, topic: str, window: TimeWindow, active: set[str]) -> dict[str, Ns]:
    """Returns those of some active goals that a window's newest message does not list.

    Each with the log time of the last message that lists it: a server lists what has not ended for
    as long as it runs.
    """
    listings: dict[str, Ns] = {}
    unlisted = set(active)
    newest = view.stream.messages([topic], window, newest_first=True) if unlisted else iter(())
    for nth, message in enumerate(newest):
        events = events_of_messages(view, [message])
        if events is None or events.beyond or events.undecodable:
            break  # what it lists is not known
        listed = {goal.name for goal in events.of_kind(GOAL)[0]} & unlisted
        unlisted -= listed
        listings |= dict.fromkeys(listed if nth else (), message.time)
        if not unlisted:
            break
    return listings


def goals_asked(
    view: View, topics: Sequence[str], condition: Condition, scope: Scope
) -> list[GoalRun] | None:
    """Returns the goals whose last status meets a condition, the one that is known last first.

    A status is its number and its word; canceled and aborted are failed as well. With a bounded
    scope a goal counts by where that held when it ended. None where the condition is not on the
    status of goals alone.

    Raises:
        InvalidArgumentsError: no status meets the condition.
        QueryTimeoutError: the call's time is over.
    """
    types = {name for topic in topics for name in view.timeline.types_of(topic)}
    field = None if condition.field is None else condition.field.rsplit(".", 1)[-1]
    if types != {GOALS} or field not in {None, _STATUS}:
        return None
    on_status = replace(condition, field=_STATUS)
    wanted = {
        number
        for number, word in _STATUS_WORDS.items()
        if on_status.matches({_STATUS: [number, word, *([_FAILED] if word in FAILURES else [])]})
    }
    if not wanted:
        raise InvalidArgumentsError(
            f"{topics[0]}: the status of a goal is {', '.join(_STATUS_WORDS.values())} "
            f"(0 to {max(_STATUS_WORDS)}), or {_FAILED}, which is canceled or aborted"
        )
    events_of_topics = {topic: events_in(view, topic, scope.window) for topic in topics}
    for topic, events in events_of_topics.items():
        if events is not None:
            note_limits(view, topic, events)
    start, _ = scope.window.asked()
    active = {topic: _active_at(view, topic, start) for topic in topics}
    known = [
        goal._replace(first=start)
        if goal.accepted is None and goal.goal in active[goal.topic]
        else goal
        for goal in goals_in(view, scope.window, events_of_topics)
    ]
    known += [
        GoalRun(topic, goal, None, None, status, start, start)
        for topic, events in events_of_topics.items()
        if events is None
        for goal, status in active[topic].items()
    ]
    goals = [goal for goal in known if goal.status in wanted]
    goals.sort(key=lambda goal: (goal.last, goal.first, goal.goal), reverse=True)
    goals = [goal for goal in goals if scope.holds_at(goal.last)]
    if lost := sum(goal.is_lost for goal in goals):
        view.notes.add(
            f"{counted(lost, 'goal')} whose end was not published, and which the action server "
            "listed no more: last is when it did"
        )
    return goals


def _active_at(view: View, topic: str, moment: Ns) -> dict[str, int]:
    """Returns the goals that a latched topic listed last before a moment as active, by statuses.

    Empty where another run of the recorder has begun since.
    """
    held = held_at(view, topic, moment)
    if held is None or any(held.time <= start < moment for start, _ in view.snapshot.breaks):
        return {}
    events = events_of_messages(view, [held])
    listed = [] if events is None else events.of_kind(GOAL)[0]
    return {goal.name: goal.last for goal in listed if goal.last not in _ENDED}


def _goal_runs(
    topic: str, events: TopicEvents, statuses_before: Mapping[str, int], *, knows_all: bool
) -> Iterator[GoalRun]:
    """Yields the goals of an action, given those that were listed before with their statuses.

    `knows_all`: these are all until the first message, so what else it lists as ended just did.
    """
    ends: dict[str, tuple[Ns, int]] = {}
    goals, changes = events.of_kind(GOAL)
    for change in changes:
        if change.value in _ENDED:
            ends.setdefault(change.name, (change.time, change.value))
    for goal in goals:
        is_listed_first = goal.at == events.first
        if statuses_before.get(goal.name) in _ENDED:
            continue
        if goal.first in _ENDED:
            if goal.name not in statuses_before and is_listed_first and not knows_all:
                continue  # it may have ended long before
            ends[goal.name] = (goal.at, goal.first)
        ended, status = ends.get(goal.name, (None, goal.last))
        accepted = None if goal.name in statuses_before else goal.at
        last = events.last if ended is None else ended
        yield GoalRun(topic, goal.name, accepted, ended, status, goal.at, last)
