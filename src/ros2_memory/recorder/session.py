"""One recording while its recorder runs: the child process, what it says, and what it writes."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final

from ros2_memory.recorder.process.output import Said, parse_line

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.recorder.handover.plan import ClockReading
    from ros2_memory.recorder.ports import RecorderProcess
    from ros2_memory.recorder.process.output import Line
    from ros2_memory.recorder.split_watcher import Splits

MAX_DISTINCT: Final = 200
"""Warnings that differ in more than their numbers and are told for one recording; no more."""
_LAST_WORDS: Final = 6
_TOLD: Final = frozenset(Said) - {Said.REMARK, Said.FLUSHING}


class RecordingSession:
    """One recording: its name, its child and its splits.

    `subscribed` are the topics that its recorder says it has subscribed to, which does not mean
    that it receives any of them.
    """

    def __init__(
        self, name: str, child: RecorderProcess, splits: Splits, began: ClockReading
    ) -> None:
        self.name = name
        self.child = child
        self.splits = splits
        self.began = began
        self.ready = False
        self.subscribed: set[str] = set()
        self._told: set[tuple[str | None, str]] = set()
        self._last_words: deque[str] = deque(maxlen=_LAST_WORDS)

    def hear(self) -> Sequence[Line]:
        """What the recorder said since the last call and is worth telling; each warning once.

        Some recorders repeat a warning ten times a second for as long as its cause lasts.
        """
        told: list[Line] = []
        for raw in self.child.take_lines():
            line = parse_line(raw)
            if line.text:
                self._last_words.append(line.text)
            if line.said is Said.READY:
                if not self.ready:
                    told.append(line)
                self.ready = True
            elif line.said is Said.SUBSCRIBED and line.topic is not None:
                # One that subscribes records, in whatever words it says that it began.
                self.ready = True
                self.subscribed.add(line.topic)
                told.append(line)
            elif line.said in _TOLD and self._is_new(line):
                told.append(line)
        return told

    @property
    def last_words(self) -> str:
        """The end of what the recorder said, for a report on its death."""
        return " | ".join(self._last_words)[-600:]

    def silent(self) -> frozenset[str]:
        """Topics subscribed to of which no closed split holds a message; none before the first."""
        if not self.splits.closed_names:
            return frozenset()
        return frozenset(self.subscribed - self.splits.heard)

    def _is_new(self, line: Line) -> bool:
        without_numbers = "".join(each for each in line.text if not each.isdigit())
        key = (line.topic, without_numbers)
        if key in self._told or len(self._told) >= MAX_DISTINCT:
            return False
        self._told.add(key)
        return True
