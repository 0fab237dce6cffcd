"""What became of the goals of actions in a window, from the statuses that action servers publish.

A status message lists every goal that its server still knows, also those that ended some minutes
before. So a goal begins where a message lists it that the one before does not, and ends where its
status becomes succeeded, canceled or aborted (action_msgs/msg/GoalStatus).

`goals_asked` is for searches: a condition on the status of such a topic is met by goals, not by
messages, since what a server lists says nothing of when it happened.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.analysis.facts import GOAL, GOALS
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.text import counted
from ros2_memory.core.timebase import MIN_NS, Ns
from ros2_memory.insights.topic_events import events_in, events_of_messages, note_limits

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from ros2_memory.analysis.conditions import Condition
    from ros2_memory.analysis.topic_events import TopicEvents
    from ros2_memory.history.view import View
    from ros2_memory.places.where import Scope

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
        message_before = view.stream.newest(topic, TimeWindow(MIN_NS, window.start))
        earlier = None if message_before is None else events_of_messages(view, [message_before])
        listed = [] if earlier is None else earlier.of_kind(GOAL)[0]
        statuses_before = {goal.name: goal.last for goal in listed}
        goals = [*_goal_runs(topic, events, statuses_before)]
        lost = last_listed(view, topic, window, {goal.goal for goal in goals if goal.ended is None})
        for goal in goals:
            last = lost.get(goal.goal)
            yield goal if last is None else goal._replace(last=last, is_lost=True)


def last_listed(view: View, topic: str, window: TimeWindow, active: set[str]) -> dict[str, Ns]:
    """Returns those of some active goals that a window's newest message does not list.

    Each with the log time of the last message that lists it: a server lists what has not ended for
    as long as it runs.
    """
    last_listings: dict[str, Ns] = {}
    unlisted = set(active)
    newest = view.stream.messages([topic], window, newest_first=True) if unlisted else iter(())
    for nth, message in enumerate(newest):
        events = events_of_messages(view, [message])
        if events is None or events.beyond or events.undecodable:
            break  # what it lists is not known
        listed = {goal.name for goal in events.of_kind(GOAL)[0]} & unlisted
        unlisted -= listed
        last_listings |= dict.fromkeys(listed if nth else (), message.time)
        if not unlisted:
            break
    return last_listings


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
    goals = [
        goal for goal in goals_in(view, scope.window, events_of_topics) if goal.status in wanted
    ]
    goals.sort(key=lambda goal: (goal.last, goal.first, goal.goal), reverse=True)
    goals = [goal for goal in goals if scope.holds_at(goal.last)]
    if lost := sum(goal.is_lost for goal in goals):
        view.notes.add(
            f"{counted(lost, 'goal')} whose end was not published, and which the action server "
            "listed no more: last is when it did"
        )
    return goals


def _goal_runs(
    topic: str, events: TopicEvents, statuses_before: Mapping[str, int]
) -> Iterator[GoalRun]:
    """Yields the goals of an action, given those that were listed before with their statuses."""
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
            if goal.name not in statuses_before and is_listed_first:
                continue  # it may have ended long before
            ends[goal.name] = (goal.at, goal.first)
        ended, status = ends.get(goal.name, (None, goal.last))
        accepted = None if goal.name in statuses_before else goal.at
        last = events.last if ended is None else ended
        yield GoalRun(topic, goal.name, accepted, ended, status, goal.at, last)
