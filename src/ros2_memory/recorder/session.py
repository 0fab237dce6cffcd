"""One recording while its `ros2 bag record` runs: the child process, its output and its files.

Only the end of a bag file shows whether it is closed: distributions number splits differently, and
a new file appears some milliseconds before the old one is closed.
"""

from __future__ import annotations

import os
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.layout import bag_kind
from ros2_memory.core.errors import BagError
from ros2_memory.core.timebase import MAX_NS, Ns
from ros2_memory.recorder.process.command import MESSAGES_LOST
from ros2_memory.recorder.process.output import Line, LineKind, parse_line
from ros2_memory.storage.base import BagReader, Closing

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence
    from pathlib import Path

    from ros2_memory.recorder.policies import ClockReading
    from ros2_memory.recorder.process.child import Child

MAX_DISTINCT: Final = 200
"""How many warnings that differ in more than their numbers are reported for one recording."""
EMPTY_GRACE_S: Final = 5.0
"""A file that is still 0 bytes so long after a newer one appeared was lost to a full disk."""
_LAST_LINES: Final = 6


class SplitChanges(NamedTuple):
    """What changed since the last observation.

    `closed` names splits in the order in which they were recorded, and `empty` all those that are
    empty though a newer one was seen. `gone`: the directory existed and does not any more. `faults`
    are sentences about what could not be read.
    """

    closed: tuple[str, ...] = ()
    empty: tuple[str, ...] = ()
    gone: bool = False
    faults: tuple[str, ...] = ()


@dataclass(slots=True)
class _Split:
    first_seen_s: float
    size: int = 0
    closed: bool = False
    start: Ns = MAX_NS


@dataclass(slots=True)
class Splits:
    """The splits of one recording, as of the last observation.

    Attributes:
        received: the topics of which a closed split has a message.
        messages: how many messages all closed splits have.
    """

    directory: Path
    reader: BagReader
    exists: bool = False
    received: set[str] = field(default_factory=set)
    messages: int = 0
    _files: dict[str, _Split] = field(default_factory=dict)

    def observe(self, now_s: float) -> SplitChanges:
        """Reads the directory again. Raises nothing."""
        try:
            sizes = self._sizes()
        except (FileNotFoundError, NotADirectoryError):
            existed, self.exists = self.exists, False
            return SplitChanges(gone=existed)
        except OSError as error:
            return SplitChanges(faults=(f"{self.directory}: {error.strerror or error}",))
        self.exists = True
        for name, size in sizes.items():
            split = self._files.setdefault(name, _Split(now_s))
            split.size = max(split.size, size)
        faults: list[str] = []
        closed = [name for name in sizes if self._note_closed(name, faults)]
        closed.sort(key=lambda name: (self._files[name].start, name))
        newest_s = max((split.first_seen_s for split in self._files.values()), default=now_s)
        overdue = now_s - newest_s >= EMPTY_GRACE_S
        empty = tuple(
            name
            for name, size in sizes.items()
            if overdue and not size and newest_s > self._files[name].first_seen_s
        )
        return SplitChanges(tuple(closed), empty, faults=tuple(faults))

    @property
    def bytes_written(self) -> int:
        """The size of all splits in bytes, deleted ones included; it never shrinks."""
        return sum(split.size for split in self._files.values())

    @property
    def closed_names(self) -> frozenset[str]:
        """The splits that were closed at the last observation."""
        return frozenset(name for name, split in self._files.items() if split.closed)

    @property
    def seen(self) -> Collection[str]:
        """The names of all splits that were ever observed."""
        return self._files.keys()

    def names(self) -> frozenset[str]:
        """Returns the names of all splits, seen before or present now."""
        with suppress(OSError):
            return frozenset(self._files) | frozenset(self._sizes())
        return frozenset(self._files)

    def _sizes(self) -> dict[str, int]:
        sizes: dict[str, int] = {}
        with os.scandir(self.directory) as entries:
            for entry in entries:
                if bag_kind(entry.name) and entry.is_file(follow_symlinks=False):
                    sizes[entry.name] = entry.stat(follow_symlinks=False).st_size
        return sizes

    def _note_closed(self, name: str, faults: list[str]) -> bool:
        """Takes what a split has that was closed since the last observation; returns if it was."""
        split = self._files[name]
        if split.closed or split.size == 0:
            return False
        path = self.directory / name
        try:
            if self.reader.closing(path) is not Closing.CLOSED:
                return False
            split.closed = True
            summary = self.reader.summarize(path)
        except BagError as error:
            if split.closed:
                faults.append(str(error))
            return split.closed
        except OSError as error:
            faults.append(f"{path}: {error.strerror or error}")
            return split.closed
        if not summary.empty:
            split.start = summary.start
        self.received.update(topic.topic for topic in summary.topics)
        self.messages += summary.count
        return True


class SessionState(Enum):
    """How far a session has come."""

    STARTING = auto()
    RECORDING = auto()
    ENDING = auto()
    ENDED = auto()


class RecordingSession:
    """One recording: its name, its child process and its splits.

    Attributes:
        is_listed: whether it is in the list of the recorder's own recordings, as a directory.
        has_recorded: whether its child ever reported that it records.
        subscribed: the topics that its child reported as subscribed, which does not mean that it
            receives any of them.
        of_unknown_type: the topics that its child reported as of an unknown type: one of each type.
    """

    def __init__(self, name: str, child: Child, splits: Splits, began: ClockReading) -> None:
        self.name = name
        self.child = child
        self.splits = splits
        self.began = began
        self.state = SessionState.STARTING
        self.is_listed = False
        self.has_recorded = False
        self.grew_at = began.wall
        self.subscribed: set[str] = set()
        self.of_unknown_type: set[str] = set()
        self._reported: set[tuple[str | None, str]] = set()
        self._last_lines: deque[str] = deque(maxlen=_LAST_LINES)

    @property
    def is_recording(self) -> bool:
        """Whether its child records, and has not been asked to end."""
        return self.state is SessionState.RECORDING

    @property
    def last_output(self) -> str:
        """The last warnings and errors of the child, at most 600 characters.

        Not its INFO lines, nor what it said of a single topic, which is no reason to end.
        """
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
            if line.text and line.topic is None and "[INFO]" not in raw:
                self._last_lines.append(line.text)
            if line.kind is LineKind.READY:
                if not self.has_recorded:
                    lines.append(line)
                self._note_recording()
            elif line.kind is LineKind.SUBSCRIBED and line.topic is not None:
                # A child that subscribes records, in whatever words it reports its beginning.
                self._note_recording()
                # Its own topic says nothing of whether it hears the robot.
                if line.topic != MESSAGES_LOST:
                    self.subscribed.add(line.topic)
                    lines.append(line)
            elif line.kind is not LineKind.OTHER and self._is_new(line):
                if line.kind is LineKind.UNKNOWN_TYPE and line.topic is not None:
                    self.of_unknown_type.add(line.topic)
                lines.append(line)
        return lines

    def silent_topics(self) -> frozenset[str]:
        """Returns topics subscribed to that no closed split contains; none before the first."""
        if not self.splits.closed_names:
            return frozenset()
        return frozenset(self.subscribed - self.splits.received)

    def _note_recording(self) -> None:
        self.has_recorded = True
        if self.state is SessionState.STARTING:
            self.state = SessionState.RECORDING

    def _is_new(self, line: Line) -> bool:
        without_numbers = "".join(char for char in line.text if not char.isdigit())
        key = (line.topic, without_numbers)
        if key in self._reported or len(self._reported) >= MAX_DISTINCT:
            return False
        self._reported.add(key)
        return True
