"""The recorder's log events, and its newest fault."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

from ros2_memory.core.errors import EpisodicError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.recorder.process.output import Line, LineKind

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from ros2_memory.core.timebase import Clock, Ns

_log = get_logger(__name__)

_INFORM = frozenset({LineKind.READY, LineKind.SUBSCRIBED, LineKind.STOPPED})
_ADVICE = {
    LineKind.QOS_REFUSED: "messages of this publisher are not recorded: its QoS does not fit",
    LineKind.UNKNOWN_TYPE: (
        "the topic is not recorded, nor are others of its type, which ros2 bag record does not "
        "name: name the workspace that defines the type in recorder.setup_files"
    ),
    LineKind.SEVERAL_TYPES: "publishers disagree on its type: at most one type is recorded",
    LineKind.TOPIC_LOST: "messages were lost: the disk is too slow for what is recorded",
    LineKind.MESSAGES_LOST: "messages were lost: the disk is too slow for what is recorded",
}

_LASTING = frozenset({LineKind.UNKNOWN_TYPE, LineKind.SEVERAL_TYPES, LineKind.QOS_REFUSED})
"""Faults of a topic that stays unrecorded until somebody mends its publishers."""
_MOST_TOPICS = 1000


class EventLog:
    """Logs events of the recorder, and remembers the newest fault.

    Attributes:
        last_error: the newest fault, as a sentence; while others last, the newest of these.
        last_error_at: when it was logged (wall time).
        recovered: whether recording has gone on since then, and no fault lasts.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self.last_error: str | None = None
        self.last_error_at: Ns | None = None
        self.recovered = False
        self._unresolved: dict[tuple[str, str], tuple[str, Ns]] = {}
        """The faults that last, by event and subject: the sentence, and when it was logged."""
        self._said: set[tuple[str, str]] = set()

    def info(self, event: str, **values: object) -> None:
        """Logs an event of normal operation."""
        _log.info(event, **values)

    def warn(self, event: str, sentence: str, **values: object) -> None:
        """Logs a fault that does not stop recording."""
        self._note_error(sentence)
        _log.warning(event, reason=sentence, **values)

    def remark(self, event: str, sentence: str, **values: object) -> None:
        """Logs a warning about the robot. It is no fault of the recorder."""
        _log.warning(event, reason=sentence, **values)

    def fail(self, event: str, sentence: str, **values: object) -> None:
        """Logs a fault that keeps something from being recorded."""
        self._note_error(sentence)
        _log.error(event, reason=sentence, **values)

    def lasting(self, event: str, subject: str, fault: str | None, **values: object) -> None:
        """Logs a fault of a subject as `fail` does, once until the fault is None."""
        if fault is None:
            self._unresolved.pop((event, subject), None)
        elif (event, subject) not in self._unresolved:
            self._unresolved[event, subject] = fault, self._clock.now()
            self.fail(event, fault, **values)

    @contextmanager
    def lasting_if_refused(self, event: str, subject: str, **values: object) -> Iterator[None]:
        """Logs an error of the block with `lasting`. Without one the fault is over."""
        try:
            yield
        except (EpisodicError, OSError) as error:
            self.lasting(event, subject, str(error), **values)
        else:
            self.lasting(event, subject, None)

    def note_recording(self) -> None:
        """Notes that recording goes on: the faults that do not last are over."""
        if self._unresolved:
            self.last_error, self.last_error_at = [*self._unresolved.values()][-1]
        self.recovered = self.last_error is not None and not self._unresolved

    def note_end(self, recording: str) -> None:
        """Notes that a recording has ended: its lasting faults are over."""
        self._unresolved = {
            (event, subject): fault
            for (event, subject), fault in self._unresolved.items()
            if subject.partition("/")[0] != recording
        }

    def _note_error(self, sentence: str) -> None:
        self.last_error, self.last_error_at = sentence, self._clock.now()
        self.recovered = False

    def report_faults(self, faults: Mapping[str, str]) -> None:
        """Logs each failing task of the housekeeper, once until it succeeds."""
        for task in (*self._lasting_of("housekeeping_failed"), *faults):
            self.lasting("housekeeping_failed", task, faults.get(task), task=task)

    def lasting_faults(self, event: str, recording: str, faults: Mapping[str, str]) -> None:
        """Logs the fault of each file of a recording, once until the file has none."""
        found = {f"{recording}/{file}": fault for file, fault in faults.items()}
        for subject in (*self._lasting_of(event, f"{recording}/"), *found):
            self.lasting(event, subject, found.get(subject), recording=recording)

    def _lasting_of(self, event: str, prefix: str = "") -> list[str]:
        """Returns the subjects that begin with a prefix and have this fault."""
        return [
            subject
            for each, subject in self._unresolved
            if each == event and subject.startswith(prefix)
        ]

    def report_output(self, recording: str, lines: Iterable[Line]) -> None:
        """Logs the lines that the `ros2 bag record` of a recording printed."""
        for line in lines:
            if line.kind in _INFORM:
                topic = {} if line.topic is None else {"topic": line.topic}
                self.info(line.kind.value, recording=recording, **topic)
            elif line.kind in _ADVICE:
                about = f"{line.topic}: " if line.topic else ""
                sentence = f"{about}{_ADVICE[line.kind]} ({line.text})"
                # Each new recorder repeats this: it must not replace the fault that led to it.
                report = self.remark if self._is_repeated(line) else self.warn
                report(line.kind.value, sentence, recording=recording)
            elif line.kind is LineKind.ERROR:
                self.fail("recorder_error", line.text, recording=recording)
            else:
                self.warn("recorder_warning", line.text, recording=recording)

    def _is_repeated(self, line: Line) -> bool:
        """Returns whether an earlier line said this of its topic; remembers the line."""
        if line.topic is None or line.kind not in _LASTING:
            return False
        said = line.kind, line.topic
        is_repeated = said in self._said
        if len(self._said) < _MOST_TOPICS:
            self._said.add(said)
        return is_repeated
