"""What became of the goals of actions in a window, from the statuses that action servers publish.

A status message lists every goal that its server still knows, also those that ended some minutes
before. So a goal begins where a message lists it that the one before does not, and ends where its
status becomes succeeded, canceled or aborted (action_msgs/msg/GoalStatus).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.analysis.state_changes import GOAL, GOALS
from ros2_memory.analysis.topic_events import TopicEventsBuilder
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MIN_NS
from ros2_memory.insights.topic_events import add_events

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from ros2_memory.analysis.topic_events import TopicEvents
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.view import View

STATUS_TOPIC: Final = "/_action/status"
GOAL_WORDS: Final = {3: "canceling", 4: "succeeded", 5: "canceled", 6: "aborted"}
FAILURES: Final = frozenset({"canceled", "aborted"})
_ENDED: Final = frozenset({4, 5, 6})


class GoalRun(NamedTuple):
    """A goal: when it was accepted and when it ended, as log times, and how.

    `accepted` is None for a goal that was active before the window, `ended` and `outcome` for one
    that is active at its end.
    """

    action: str
    accepted: Ns | None
    ended: Ns | None
    outcome: str | None


def action_of(topic: str) -> str:
    """Returns the name of an action by the topic of its statuses."""
    return topic.removesuffix(STATUS_TOPIC)


def goals_in(
    view: View, window: TimeWindow, found_of: Mapping[str, TopicEvents | None]
) -> Iterator[GoalRun]:
    """Yields the goals that a message of a window lists and that were active in it.

    `found_of` has what the messages of each topic report in the window.
    """
    for topic, found in found_of.items():
        if found is None or GOALS not in view.snapshot.timeline.types_of(topic):
            continue
        # Which goals it listed before: what a window's first message lists need not be new.
        before = view.stream.newest(topic, TimeWindow(MIN_NS, window.start))
        listed = TopicEventsBuilder()
        if before is not None:
            add_events(view, listed, [before])
        earlier = listed.events()
        old = {} if earlier is None else {each.name: each.last for each in earlier.changes.known}
        yield from _goals(action_of(topic), found, old)


def _goals(action: str, found: TopicEvents, old: Mapping[str, int]) -> Iterator[GoalRun]:
    """Yields the goals of an action, given those that were listed before with their statuses."""
    ends: dict[str, tuple[Ns, int]] = {}
    for change in found.changes.changes:
        if change.name.startswith(GOAL) and change.value in _ENDED:
            ends.setdefault(change.name, (change.time, change.value))
    for known in found.changes.known:
        is_listed_first = known.at == found.first
        if not known.name.startswith(GOAL) or old.get(known.name) in _ENDED:
            continue
        if known.first in _ENDED:
            if known.name not in old and is_listed_first:
                continue  # it may have ended long before
            ends[known.name] = (known.at, known.first)
        ended, status = ends.get(known.name, (None, 0))
        accepted = None if known.name in old else known.at
        yield GoalRun(action, accepted, ended, GOAL_WORDS.get(status))
