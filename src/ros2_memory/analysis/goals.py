"""Goals of actions: the words for their statuses (action_msgs/msg/GoalStatus).

A message lists every goal that the action server still knows. An active goal is listed for as long
as it runs; one that ended for minutes more. So a message says which goals are active, and nothing
of when another one ended.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.conditions import Equals
from ros2_memory.core.errors import InvalidArgumentsError

if TYPE_CHECKING:
    from ros2_memory.analysis.conditions import Condition
    from ros2_memory.core.model import JsonValue

GOAL_WORDS: Final = {3: "canceling", 4: "succeeded", 5: "canceled", 6: "aborted"}
FAILURES: Final = frozenset({"canceled", "aborted"})
ENDED: Final = frozenset({4, 5, 6})
STATUS: Final = "status"
STATUS_WORDS: Final = {0: "unknown", 1: "accepted", 2: "executing", **GOAL_WORDS}
_FAILED: Final = "failed"


def statuses_matching(topic: str, condition: Condition) -> set[int]:
    """Returns the statuses whose number or word meets a condition, at least one.

    Canceled and aborted are also called failed. `topic` is for the error.

    Raises:
        InvalidArgumentsError: none does.
    """
    on_status = replace(condition, field=STATUS)
    matching = set()
    for number, word in STATUS_WORDS.items():
        names: list[JsonValue] = [number, word]
        if word in FAILURES:
            names.append(_FAILED)
        if on_status.matches({STATUS: names}):
            matching.add(number)
    if not matching:
        raise InvalidArgumentsError(
            f"{topic}: the status of a goal is {', '.join(STATUS_WORDS.values())} "
            f"(0 to {max(STATUS_WORDS)}), or {_FAILED}, which is canceled or aborted"
        )
    return matching


def while_active(topic: str, condition: Condition) -> Condition:
    """Returns a condition on the word of a status as one on the messages that list goals.

    A condition on a number stays as it is.

    Raises:
        InvalidArgumentsError: the word is no status, or none of a goal that is active.
    """
    if condition.field or condition.test.folded is None:
        return condition
    statuses = statuses_matching(topic, condition)
    if len(statuses) > 1 or statuses & ENDED:
        raise InvalidArgumentsError(
            f"{topic}: while a goal was accepted, executing or canceling can be asked; a goal that "
            "ended stays listed for minutes: find_matches says when each one ended"
        )
    return replace(condition, field=f"status_list.{STATUS}", test=Equals(statuses.pop()))
