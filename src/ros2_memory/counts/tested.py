"""Which messages of a window meet a condition: read once, and kept for when it is asked again.

A search that digests cannot answer looks at thousands of messages, and only the last of each
sighting is in its reply. So times and truths stay in memory, and no message.
"""

from __future__ import annotations

from array import array
from collections import OrderedDict
from threading import Lock
from typing import TYPE_CHECKING, Final, NamedTuple
from weakref import WeakKeyDictionary

from ros2_memory.core.model import BagState

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.core.model import TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.history.reverse_search import ReverseSearch
    from ros2_memory.history.view import View
    from ros2_memory.index.timeline import Timeline

_MOST_QUESTIONS: Final = 4
_MOST_MESSAGES: Final = 262_144
"""Of one question: 9 bytes each."""
_PART: Final = 64
"""A part of a search without messages takes about as much as so many of them."""


class Tested(NamedTuple):
    """A message of a search.

    Attributes:
        time: log time.
        topic: its topic.
        met: whether it meets the condition; None where it cannot be decoded.
        message: itself; None where it was tested for a question before.
    """

    time: Ns
    topic: str
    met: bool | None
    message: StoredMessage | None = None


class _Part(NamedTuple):
    """The log times of all messages of one topic in a window, newest first, and which met."""

    times: array[int]
    met: bytearray


class _Question:
    """What is known of one question."""

    def __init__(self) -> None:
        self.parts: dict[tuple[str, TimeWindow], _Part] = {}
        self.size = 0

    def keep(self, topic: str, window: TimeWindow, part: _Part) -> None:
        size = len(part.times) + _PART
        if self.size + size <= _MOST_MESSAGES:
            self.size += size
            self.parts[topic, window] = part


class _Known:
    """The questions that were asked last about each timeline. Thread-safe."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._questions: WeakKeyDictionary[Timeline, OrderedDict[tuple[object, ...], _Question]] = (
            WeakKeyDictionary()
        )

    def of(self, view: View, search: ReverseSearch) -> _Question:
        memory = view.memory
        # With a catalogue and without are two questions: one must not hide what the other reads.
        key = (repr(search.condition), id(memory.reader), id(memory.extractor), id(memory.recall))
        with self._lock:
            known = self._questions.setdefault(view.snapshot.timeline, OrderedDict())
            question = known.setdefault(key, _Question())
            known.move_to_end(key)
            if len(known) > _MOST_QUESTIONS:
                known.popitem(last=False)
            return question


_KNOWN: Final = _Known()


def tested(
    view: View, search: ReverseSearch, topics: Sequence[str], window: TimeWindow
) -> Iterator[Tested]:
    """Yields the messages of topics in a window, newest first, and whether they meet a condition.

    What was read to its end of closed bags, and could all be decoded, is not read again.

    Raises:
        QueryTimeoutError: while it is iterated, when the deadline has passed.
    """
    question = _KNOWN.of(view, search)
    [topic] = topics if len(topics) == 1 else [""]
    known = question.parts.get((topic, window))
    if known is not None:
        view.bags.check_deadline()
        for time, truth in zip(known.times, known.met, strict=True):
            yield Tested(time, topic, bool(truth))
        return
    part = _Part(array("q"), bytearray())
    before = view.notes.added
    is_kept = len(topics) == 1
    for each in view.stream.messages(topics, window, newest_first=True):
        met = search.matches(each)
        yield Tested(each.time, each.record.channel.topic, met, each)
        # Of two messages at one time it would not be known which one it was.
        is_same = bool(part.times) and part.times[-1] == each.time
        if met is None or is_same or each.bag.state is not BagState.CLOSED:
            is_kept = False
        elif is_kept:
            part.times.append(each.time)
            part.met.append(met)
    if is_kept and view.notes.added == before:
        question.keep(topic, window, part)
