"""One recording while its `ros2 bag record` runs: the child process, its output and its files."""

from __future__ import annotations

from collections import deque
from enum import Enum, auto
from typing import TYPE_CHECKING, Final

from ros2_memory.recorder.process.output import LineKind, parse_line

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.recorder.handover.plan import ClockReading
    from ros2_memory.recorder.process.child import Child
    from ros2_memory.recorder.process.output import Line
    from ros2_memory.recorder.split_watcher import Splits

MAX_DISTINCT: Final = 200
"""How many warnings that differ in more than their numbers are reported for one recording."""
_LAST_LINES: Final = 6
_REPORTED: Final = frozenset(LineKind) - {LineKind.OTHER, LineKind.FLUSHING}


class SessionState(Enum):
    """How far a session has come."""

    STARTING = auto()
    RECORDING = auto()
    ENDING = auto()
    ENDED = auto()


class RecordingSession:
    """One recording: its name, its child process and its splits.

    Attributes:
        state: how far it has come.
        has_recorded: whether its child ever reported that it records.
        subscribed: the topics that its child reported as subscribed, which does not mean that it
            receives any of them.
    """

    def __init__(self, name: str, child: Child, splits: Splits, began: ClockReading) -> None:
        self.name = name
        self.child = child
        self.splits = splits
        self.began = began
        self.state = SessionState.STARTING
        self.has_recorded = False
        self.subscribed: set[str] = set()
        self._reported: set[tuple[str | None, str]] = set()
        self._last_lines: deque[str] = deque(maxlen=_LAST_LINES)

    @property
    def is_recording(self) -> bool:
        """Whether its child records, and has not been asked to end."""
        return self.state is SessionState.RECORDING

    @property
    def last_output(self) -> str:
        """The end of what the child printed, for a report on its death."""
        return " | ".join(self._last_lines)[-600:]

    def age_s(self, now: ClockReading) -> float:
        """Returns for how long it has lived, in seconds."""
        return now.monotonic_s - self.began.monotonic_s

    def end(self) -> None:
        """Asks its child to end. Does nothing the second time."""
        if self.state in {SessionState.STARTING, SessionState.RECORDING}:
            self.state = SessionState.ENDING
            self.child.end()

    def new_lines(self) -> Sequence[Line]:
        """Returns what the child printed since the last call and is worth reporting.

        Each warning comes once: some recorders repeat one ten times a second for as long as its
        cause lasts.
        """
        lines: list[Line] = []
        for raw in self.child.take_lines():
            line = parse_line(raw)
            if line.text:
                self._last_lines.append(line.text)
            if line.kind is LineKind.READY:
                if not self.has_recorded:
                    lines.append(line)
                self._records()
            elif line.kind is LineKind.SUBSCRIBED and line.topic is not None:
                # A child that subscribes records, in whatever words it reports its beginning.
                self._records()
                self.subscribed.add(line.topic)
                lines.append(line)
            elif line.kind in _REPORTED and self._is_new(line):
                lines.append(line)
        return lines

    def silent_topics(self) -> frozenset[str]:
        """Returns topics subscribed to that no closed split contains; none before the first."""
        if not self.splits.closed_names:
            return frozenset()
        return frozenset(self.subscribed - self.splits.received)

    def _records(self) -> None:
        self.has_recorded = True
        if self.state is SessionState.STARTING:
            self.state = SessionState.RECORDING

    def _is_new(self, line: Line) -> bool:
        without_numbers = "".join(each for each in line.text if not each.isdigit())
        key = (line.topic, without_numbers)
        if key in self._reported or len(self._reported) >= MAX_DISTINCT:
            return False
        self._reported.add(key)
        return True
