"""What changed on a topic: things came and went, booleans flipped, errors were reported.

Message by message or a whole bag at once; where a history is cut into bags changes nothing, as
long as nothing is left out for being too much.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.analysis.intervals import IntervalBuilder, IntervalTable, Part, joined
from ros2_memory.messages.detections import detections_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ros2_memory.core.model import JsonValue
    from ros2_memory.core.timebase import Ns

MAX_PER_BAG: Final = 64
"""Presences, flips and faults of one topic in one bag that are kept, each; the rest is counted."""
MOST_HELD: Final = 20_000
"""Flips and faults of a topic in all bags together: what a question about a week may hold."""
MOST_SEEN: Final = 100_000
"""Presences likewise; they are held as numbers."""
MOST_FLAGS: Final = 512
"""Booleans of one message that are followed; the rest is counted."""
MOST_LABELS: Final = 256
"""Names of things in one message, likewise."""

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
    """What one message says: names of things, booleans by dot-path, errors as sentences.

    `beyond` is how many names and booleans it has besides.
    """

    labels: tuple[str, ...] = ()
    flags: tuple[tuple[str, bool], ...] = ()
    faults: tuple[str, ...] = ()
    beyond: int = 0

    @property
    def says_nothing(self) -> bool:
        """Whether there is nothing in it."""
        return not (self.labels or self.flags or self.faults)


NOTHING: Final = State()
NOBODY: Final = IntervalTable()


class Toggle(NamedTuple):
    """A boolean that is `value` from `time` on, and was the other before."""

    path: str
    time: Ns
    value: bool


class ReportedError(NamedTuple):
    """An error, and the log times of its first and last report (inclusive)."""

    text: str
    first: Ns
    last: Ns
    reports: int


class KnownFlag(NamedTuple):
    """A boolean as it stood at the first message of a bag that has it, and at the last."""

    path: str
    at: Ns
    first: bool
    last: bool


@dataclass(frozen=True, slots=True)
class TopicEvents:
    """What one bag holds of one topic, to be joined with what is before and after.

    Attributes:
        first: log time of its first message.
        last: of its last.
        seen: the presences.
        known: each boolean's value at either end.
        flips: in order.
        faults: by the time of their first report.
        left_out: presences, flips and faults beyond what is kept: of presences those that lasted
            longest are, of the others the earliest.
        undecodable: messages that cannot be decoded, of which nothing is told; where there are no
            others, `first` lies after `last`.
        beyond: names of things and booleans of one message that are not followed, at most.
    """

    first: Ns
    last: Ns
    seen: IntervalTable = NOBODY
    known: tuple[KnownFlag, ...] = ()
    flips: tuple[Toggle, ...] = ()
    faults: tuple[ReportedError, ...] = ()
    left_out: int = 0
    undecodable: int = 0
    beyond: int = 0

    @property
    def says_nothing(self) -> bool:
        """Whether it is only that there were messages."""
        return not (self.seen.rows or self.known or self.faults or self.undecodable)


NO_EVENTS: Final = TopicEvents(0, 0)
"""Stands for the story of messages that say nothing, whenever they were."""


def has_events(type_name: str) -> bool:
    """Whether messages of a type can say anything."""
    return type_name in _TOLD_OF or not type_name.startswith(_MEASURING)


def state_of(value: JsonValue, type_name: str) -> State:
    """What an extracted message of a type says."""
    if not has_events(type_name):
        return NOTHING
    faults = tuple(_faults(value, _ERROR_LEVELS.get(type_name)))
    if type_name in _ERROR_LEVELS:
        return State(faults=faults) if faults else NOTHING
    labels = tuple(dict.fromkeys(thing.label for thing in detections_of(value)))
    flags = tuple(_flags(value, ""))
    if not (labels or flags):
        return NOTHING
    beyond = len(labels[MOST_LABELS:]) + len(flags[MOST_FLAGS:])
    return State(labels[:MOST_LABELS], flags[:MOST_FLAGS], faults, beyond)


class TopicEventsBuilder:
    """Takes the messages of one topic, or whole bags of them, in log-time order."""

    def __init__(self) -> None:
        self._parts: list[Part] = []
        self._rows = 0
        self._watcher: IntervalBuilder | None = None
        self._known: dict[str, KnownFlag] = {}
        self._flips: list[Toggle] = []
        self._faults: dict[str, ReportedError] = {}
        self._left_out = 0
        self._undecodable = 0
        self._beyond = 0

    def add_undecodable(self) -> None:
        """Takes the next message, which cannot be decoded."""
        self._undecodable += 1

    def add(self, time: Ns, state: State) -> None:
        """Takes the next message."""
        if self._watcher is None:
            self._watcher = IntervalBuilder(MOST_SEEN)
        self._watcher.add(time, state.labels)
        self._beyond = max(self._beyond, state.beyond)
        for path, value in state.flags:
            self._flag(KnownFlag(path, time, value, value))
        for text in state.faults:
            self._fault(ReportedError(text, time, time, 1))

    def join(self, story: TopicEvents) -> None:
        """Takes all messages of a bag that come next, as if they were added one by one."""
        self._undecodable += story.undecodable
        if story.first > story.last:
            return
        self._settle()
        self._take(Part(story.first, story.last, story.seen))
        if story.known:
            flips = [
                Toggle(known.path, known.at, known.first)
                for known in story.known
                if self._turns(known)
            ]
            for flip in sorted([*flips, *story.flips], key=lambda flip: flip.time):
                self._turn(flip)
            for known in story.known:
                self._learn(known)
        for fault in story.faults:
            self._fault(fault)
        self._left_out += story.left_out
        self._beyond = max(self._beyond, story.beyond)

    def events(self, at_most: int | None = None) -> TopicEvents | None:
        """What was told so far, `at_most` of each kind; None without a message."""
        self._settle()
        if not self._parts:
            return TopicEvents(1, 0, undecodable=self._undecodable) if self._undecodable else None
        first, last, seen = self._one_part()
        faults = sorted(self._faults.values(), key=lambda each: (each.first, each.text))
        told = (seen.size, len(self._flips), len(faults))
        left_out = 0 if at_most is None else sum(max(0, many - at_most) for many in told)
        return TopicEvents(
            first,
            last,
            seen if at_most is None else seen.most_lasting(at_most),
            tuple(self._known.values()),
            tuple(self._flips[:at_most]),
            tuple(faults[:at_most]),
            self._left_out + left_out,
            self._undecodable,
            self._beyond,
        )

    def _settle(self) -> None:
        """Takes what was added message by message."""
        part = None if self._watcher is None else self._watcher.part()
        if self._watcher is not None and part is not None:
            self._left_out += self._watcher.left_out
            self._watcher = None
            self._take(part)

    def _take(self, part: Part) -> None:
        self._parts.append(part)
        self._rows += part.seen.size
        if self._rows > 2 * MOST_SEEN:
            self._one_part()

    def _one_part(self) -> Part:
        """All parts as one, and no more presences than may be held."""
        part = self._parts[0] if len(self._parts) == 1 else joined(self._parts)
        seen = part.seen.most_lasting(MOST_SEEN)
        self._left_out += part.seen.size - seen.size
        self._parts, self._rows = [part._replace(seen=seen)], seen.size
        return self._parts[0]

    def _turns(self, known: KnownFlag) -> bool:
        before = self._known.get(known.path)
        return before is not None and before.last != known.first

    def _flag(self, known: KnownFlag) -> None:
        if self._turns(known):
            self._turn(Toggle(known.path, known.at, known.first))
        self._learn(known)

    def _learn(self, known: KnownFlag) -> None:
        before = self._known.get(known.path)
        if before is None and len(self._known) >= MOST_HELD:
            self._left_out += 1
            return
        self._known[known.path] = known if before is None else before._replace(last=known.last)

    def _turn(self, flip: Toggle) -> None:
        """Adds a flip, or counts it where there are too many."""
        if len(self._flips) < MOST_HELD:
            self._flips.append(flip)
        else:
            self._left_out += 1

    def _fault(self, fault: ReportedError) -> None:
        before = self._faults.get(fault.text)
        if before is None and len(self._faults) >= MOST_HELD:
            self._left_out += 1
            return
        self._faults[fault.text] = (
            fault
            if before is None
            else before._replace(last=fault.last, reports=before.reports + fault.reports)
        )


def _flags(value: JsonValue, path: str) -> Iterator[tuple[str, bool]]:
    """The booleans of an object and of the objects in it, by dot-path; none of lists."""
    if isinstance(value, bool):
        yield path, value
    elif isinstance(value, dict):
        for name, inner in value.items():
            yield from _flags(inner, f"{path}.{name}" if path else name)


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
            yield text if len(text) <= _LONGEST_TEXT else text[: _LONGEST_TEXT - 1] + "…"
