"""What changed on a topic: things came and went, booleans flipped, errors were reported.

Message by message or a whole bag at once; where a history is cut into bags changes nothing, as
long as nothing is left out for being too much.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple, TypeVar

from ros2_memory.things import things_of
from ros2_memory.timebase import NS_PER_S, Ns

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from ros2_memory.model import JsonValue

T = TypeVar("T")

SILENCE_NS: Final[Ns] = 10 * NS_PER_S
"""After so long without a message a thing counts as gone: many detectors speak only of what is."""

MOST_TOLD: Final = 64
"""Presences, flips and faults of one topic in one bag that are kept, each; the rest is counted."""
MOST_HELD: Final = 20_000
"""The same of a topic in all bags together: what a question about a week may hold in memory."""
MOST_FLAGS: Final = 16

_ERROR: Final = 2
_STALE: Final = 3
_ERROR_LEVELS: Final = {
    "rcl_interfaces/msg/Log": 40,
    "diagnostic_msgs/msg/DiagnosticArray": _ERROR,
}
_LONGEST_TEXT: Final = 160
_TOLD_OF: Final = frozenset({"sensor_msgs/msg/BatteryState"})
_MEASURING: Final = ("geometry_msgs/", "nav_msgs/", "sensor_msgs/", "tf2_msgs/")
"""Packages whose messages are measurements: nothing in them comes, goes or flips."""


class State(NamedTuple):
    """What one message says: names of things, booleans by dot-path, errors as sentences."""

    labels: tuple[str, ...] = ()
    flags: tuple[tuple[str, bool], ...] = ()
    faults: tuple[str, ...] = ()

    @property
    def says_nothing(self) -> bool:
        """Whether there is nothing in it."""
        return not (self.labels or self.flags or self.faults)


NOTHING: Final = State()


class Presence(NamedTuple):
    """A thing in message after message: log times of the first and last (inclusive)."""

    label: str
    first: Ns
    last: Ns
    messages: int


class Flip(NamedTuple):
    """A boolean that is `value` from `time` on, and was the other before."""

    path: str
    time: Ns
    value: bool


class Fault(NamedTuple):
    """An error, and the log times of its first and last report (inclusive)."""

    text: str
    first: Ns
    last: Ns
    reports: int


class Known(NamedTuple):
    """A boolean as it stood at the first message of a bag that has it, and at the last."""

    path: str
    at: Ns
    first: bool
    last: bool


@dataclass(frozen=True, slots=True)
class Story:
    """What one bag holds of one topic, to be joined with what is before and after.

    Attributes:
        first: log time of its first message.
        last: of its last.
        seen: the presences, by the time of their first message.
        from_start: the things that are in the first message.
        to_end: those in the last.
        known: each boolean's value at either end.
        flips: in order.
        faults: by the time of their first report.
        left_out: presences, flips and faults beyond what is kept; the earliest ones are.
        undecodable: messages that cannot be decoded, of which nothing is told; where there are no
            others, `first` lies after `last`.
    """

    first: Ns
    last: Ns
    seen: tuple[Presence, ...] = ()
    from_start: tuple[str, ...] = ()
    to_end: tuple[str, ...] = ()
    known: tuple[Known, ...] = ()
    flips: tuple[Flip, ...] = ()
    faults: tuple[Fault, ...] = ()
    left_out: int = 0
    undecodable: int = 0

    @property
    def says_nothing(self) -> bool:
        """Whether it is only that there were messages."""
        return not (self.seen or self.known or self.faults or self.undecodable)


QUIET: Final = Story(0, 0)
"""Stands for the story of messages that say nothing, whenever they were."""


def tells(type_name: str) -> bool:
    """Whether messages of a type can say anything."""
    return type_name in _TOLD_OF or not type_name.startswith(_MEASURING)


def state_of(value: JsonValue, type_name: str) -> State:
    """What an extracted message of a type says."""
    if not tells(type_name):
        return NOTHING
    faults = tuple(_faults(value, _ERROR_LEVELS.get(type_name)))
    if type_name in _ERROR_LEVELS:
        return State(faults=faults) if faults else NOTHING
    labels = tuple(dict.fromkeys(thing.label for thing in things_of(value)))
    flags = tuple(_flags(value, ""))[:MOST_FLAGS]
    return State(labels, flags, faults) if labels or flags else NOTHING


class StoryBuilder:
    """Takes the messages of one topic, or whole bags of them, in log-time order."""

    def __init__(self) -> None:
        self._first: Ns | None = None
        self._last: Ns = 0
        self._from_start: tuple[str, ...] = ()
        self._open: dict[str, Presence] = {}
        self._over: list[Presence] = []
        self._known: dict[str, Known] = {}
        self._flips: list[Flip] = []
        self._faults: dict[str, Fault] = {}
        self._left_out = 0
        self._undecodable = 0

    def miss(self) -> None:
        """Takes the next message, which cannot be decoded."""
        self._undecodable += 1

    def add(self, time: Ns, state: State) -> None:
        """Takes the next message."""
        if self._first is None:
            self._first, self._from_start = time, state.labels
        if state is not NOTHING or self._open:
            self._carry(time, [Presence(label, time, time, 1) for label in state.labels])
            for path, value in state.flags:
                self._flag(Known(path, time, value, value))
            for text in state.faults:
                self._fault(Fault(text, time, time, 1))
        self._last = time

    def join(self, story: Story) -> None:
        """Takes all messages of a bag that come next, as if they were added one by one."""
        self._undecodable += story.undecodable
        if story.first > story.last:
            return
        if self._first is None:
            self._first, self._from_start = story.first, story.from_start
        spans: dict[str, list[Presence]] = {}
        for each in story.seen:
            spans.setdefault(each.label, []).append(each)
        begun = [spans[label].pop(0) for label in story.from_start if label in spans]
        self._carry(story.first, begun)
        for label, later in spans.items():
            for each in later:
                self._end(label)
                self._open[label] = each
        for label in self._open.keys() - set(story.to_end):
            self._end(label)
        flips = [
            Flip(known.path, known.at, known.first) for known in story.known if self._turns(known)
        ]
        for flip in sorted([*flips, *story.flips], key=lambda flip: flip.time):
            self._add(self._flips, flip)
        for known in story.known:
            self._learn(known)
        for fault in story.faults:
            self._fault(fault)
        self._left_out += story.left_out
        self._last = story.last

    def story(self, at_most: int | None = None) -> Story | None:
        """What was told so far, `at_most` of each kind; None without a message."""
        if self._first is None:
            return Story(1, 0, undecodable=self._undecodable) if self._undecodable else None
        seen = sorted(
            (*self._over, *self._open.values()), key=lambda each: (each.first, each.label)
        )
        faults = sorted(self._faults.values(), key=lambda each: (each.first, each.text))
        told = (len(seen), len(self._flips), len(faults))
        left_out = 0 if at_most is None else sum(max(0, many - at_most) for many in told)
        return Story(
            self._first,
            self._last,
            tuple(seen[:at_most]),
            self._from_start,
            tuple(sorted(self._open)),
            tuple(self._known.values()),
            tuple(self._flips[:at_most]),
            tuple(faults[:at_most]),
            self._left_out + left_out,
            self._undecodable,
        )

    def _carry(self, time: Ns, present: Iterable[Presence]) -> None:
        """Goes on with what is present in the next message; what is not is over."""
        silent = self._first is not None and time - self._last > SILENCE_NS
        goes_on: dict[str, Presence] = {}
        for each in present:
            before = None if silent else self._open.pop(each.label, None)
            goes_on[each.label] = (
                each
                if before is None
                else before._replace(last=each.last, messages=before.messages + each.messages)
            )
        for each in self._open.values():
            self._add(self._over, each)
        self._open = goes_on

    def _turns(self, known: Known) -> bool:
        before = self._known.get(known.path)
        return before is not None and before.last != known.first

    def _flag(self, known: Known) -> None:
        if self._turns(known):
            self._add(self._flips, Flip(known.path, known.at, known.first))
        self._learn(known)

    def _learn(self, known: Known) -> None:
        before = self._known.get(known.path)
        if before is None and len(self._known) >= MOST_HELD:
            self._left_out += 1
            return
        self._known[known.path] = known if before is None else before._replace(last=known.last)

    def _end(self, label: str) -> None:
        """A thing is gone, if it was there."""
        if label in self._open:
            self._add(self._over, self._open.pop(label))

    def _add(self, to: list[T], each: T) -> None:
        """Adds one to what is over, or counts it where that is too much."""
        if len(to) < MOST_HELD:
            to.append(each)
        else:
            self._left_out += 1

    def _fault(self, fault: Fault) -> None:
        before = self._faults.get(fault.text)
        if before is None and len(self._faults) >= MOST_HELD:
            self._left_out += 1
            return
        self._faults[fault.text] = (
            fault
            if before is None
            else before._replace(last=fault.last, reports=before.reports + fault.reports)
        )


def _flags(value: JsonValue, path: str, depth: int = 3) -> Iterator[tuple[str, bool]]:
    """The booleans of an object and of the objects in it, by dot-path; none of lists."""
    if isinstance(value, bool):
        yield path, value
    elif isinstance(value, dict) and depth:
        for name, inner in value.items():
            yield from _flags(inner, f"{path}.{name}" if path else name, depth - 1)


def _faults(value: JsonValue, least: int | None) -> Iterator[str]:
    """The errors in a log entry, or in a list of diagnostics: who says it, and what."""
    if least is None:
        return
    status = value.get("status") if isinstance(value, dict) else None
    for each in status if isinstance(status, list) else [value]:
        if not isinstance(each, dict):
            continue
        level, name = each.get("level"), each.get("name")
        said = each.get("msg", each.get("message"))
        if isinstance(level, int) and level >= least and not (level == _STALE and least == _ERROR):
            text = ": ".join(part for part in (name, said) if isinstance(part, str) and part)
            yield text[:_LONGEST_TEXT]
