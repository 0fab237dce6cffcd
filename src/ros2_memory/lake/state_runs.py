"""What each message of a topic states, packed: booleans, levels, errors, and labels in view.

The digest of a bag has the events in it as a whole. Where a time cuts the bag, what counts is what
each message in that time states. Most state the same as the one before, so messages in a row are a
run: its state, its first and last time, and how many there are. What is counted message by message
(errors and log entries) is no run, and has each message's own time.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Final, NamedTuple, TypedDict

from ros2_memory.analysis.state_changes import StateLevel
from ros2_memory.analysis.topic_events import EMPTY_STATE, State, TopicEvents

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ros2_memory.core.timebase import Ns

    StateLists = tuple[
        list[str],
        list[tuple[str, bool]],
        list[str],
        int,
        list[tuple[str, int, str]],
        list[str],
        list[float | None],
    ]
    """A `State` as JSON has it."""

KIND: Final = "states"
"""Of digests in a lake."""
EMPTY_KIND: Final = "empty"
"""Likewise: where a detector had nothing to report."""
_UNDECODABLE: Final = -1
_MOST_CHARS: Final = 1 << 20
"""Of all that a topic states in a bag: a hostile one states something else with each message."""


class _Packed(TypedDict):
    states: list[StateLists]
    runs: list[tuple[int, Ns, Ns, int]]


class StateRun(NamedTuple):
    """Messages in a row that state the same; `state` is None for those that were undecodable."""

    state: State | None
    first: Ns
    last: Ns
    messages: int


class EmptyRun(NamedTuple):
    """Messages in a row without a detection; `nth` is the number of the first in its bag."""

    nth: int
    first: Ns
    last: Ns
    messages: int


class EmptyRuns:
    """Takes the messages of one detector in a bag that have no detection, in log-time order."""

    def __init__(self) -> None:
        self._runs: list[EmptyRun] = []

    def add(self, nth: int, time: Ns) -> None:
        """Takes the next of them, the `nth` message of the topic."""
        before = self._runs[-1] if self._runs else None
        if before is not None and before.nth + before.messages == nth:
            self._runs[-1] = before._replace(last=time, messages=before.messages + 1)
        else:
            self._runs.append(EmptyRun(nth, time, time, 1))

    def packed(self) -> bytes:
        """Returns them as bytes; times are since the end of the run before."""
        found: list[tuple[int, Ns, Ns, int]] = []
        end = 0
        for nth, first, last, messages in self._runs:
            found.append((nth, first - end, last - first, messages))
            end = last
        return json.dumps(found, separators=(",", ":")).encode()


def unpacked_empty(packed: bytes) -> Iterator[EmptyRun]:
    """Yields the runs without a detection that were packed, in order."""
    found: list[tuple[int, Ns, Ns, int]] = json.loads(packed)
    end = 0
    for nth, since, length, messages in found:
        first = end + since
        end = first + length
        yield EmptyRun(nth, first, end, messages)


def is_stated(events: TopicEvents | None) -> bool:
    """Returns whether messages of a bag state more than what is in view, by their digest."""
    return events is None or bool(
        events.known or events.errors or events.undecodable or not events.changes.is_empty
    )


class StateRuns:
    """Takes what the messages of one topic of a bag state, in log-time order.

    Where that is too much nothing is kept.
    """

    def __init__(self) -> None:
        self._states: dict[State | None, int] = {None: _UNDECODABLE}
        self._runs: list[list[int]] = []
        self._chars = 0

    def add(self, time: Ns, state: State | None) -> None:
        """Takes the next message; None for one that is undecodable."""
        if self._chars > _MOST_CHARS:
            return
        if state not in self._states:
            self._chars += len(json.dumps(state))
        nth = self._states.setdefault(state, len(self._states) - 1)
        is_counted = state is not None and bool(state.errors or state.reports)
        if self._runs and self._runs[-1][0] == nth and not is_counted:
            self._runs[-1][2:] = [time, self._runs[-1][3] + 1]
        else:
            self._runs.append([nth, time, time, 1])

    def packed(self) -> bytes | None:
        """Returns them as bytes, None where they are too many; times are since the run before."""
        if self._chars > _MOST_CHARS:
            return None
        runs: list[list[int]] = []
        before = 0
        for nth, first, last, count in self._runs:
            runs.append([nth, first - before, last - first, count])
            before = last
        states = [each for each in self._states if each is not None]
        return json.dumps({"states": states, "runs": runs}, separators=(",", ":")).encode()


def unpacked(packed: bytes) -> Iterator[StateRun]:
    """Yields the runs that were packed, in order."""
    found: _Packed = json.loads(packed)
    states = [*map(state_of_lists, found["states"])]
    before = 0
    for nth, since, length, count in found["runs"]:
        first = before + since
        before = first + length
        yield StateRun(None if nth == _UNDECODABLE else states[nth], first, before, count)


def state_of_lists(lists: StateLists) -> State:
    """Returns the state that JSON has as lists."""
    labels, flags, errors, beyond, levels, reports, scores = lists
    state = State(
        tuple(labels),
        tuple((path, flag) for path, flag in flags),
        tuple(errors),
        beyond,
        tuple(StateLevel(name, value, text) for name, value, text in levels),
        tuple(reports),
        tuple(scores),
    )
    return EMPTY_STATE if state.is_empty else state
