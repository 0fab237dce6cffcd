"""What the recorder reports: log events, and the last of them that was a fault."""

from __future__ import annotations

from typing import TYPE_CHECKING

import structlog

from ros2_memory.recorder.process.output import Said

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ros2_memory.recorder.process.output import Line

_log: structlog.typing.FilteringBoundLogger = structlog.get_logger(__name__)

_INFORM = {Said.READY: "recording", Said.SUBSCRIBED: "subscribed", Said.STOPPED: "recorder_stopped"}
_ADVICE = {
    Said.QOS_REFUSED: "messages of this publisher are not recorded: its QoS does not fit",
    Said.UNKNOWN_TYPE: (
        "the topic is not recorded: name the workspace that defines its type in "
        "recorder.setup_files"
    ),
    Said.SEVERAL_TYPES: "the topic is not recorded: publishers disagree on its type",
    Said.MESSAGES_LOST: "messages were lost: the disk is too slow for what is recorded",
}


class EventLog:
    """Log events of the recorder; `last_error` is the sentence of the newest fault."""

    def __init__(self) -> None:
        self.last_error: str | None = None
        self._standing: set[tuple[str, str]] = set()

    def note(self, event: str, **values: object) -> None:
        """Something that is as it should be."""
        _log.info(event, **values)

    def warn(self, event: str, sentence: str, **values: object) -> None:
        """A fault that recording goes on with."""
        self.last_error = sentence
        _log.warning(event, reason=sentence, **values)

    def fail(self, event: str, sentence: str, **values: object) -> None:
        """A fault that keeps something from being recorded."""
        self.last_error = sentence
        _log.error(event, reason=sentence, **values)

    def fail_once(self, event: str, about: str, sentence: str, **values: object) -> None:
        """As `fail`, and silent while the fault stands for what it is about (see `over`)."""
        if (event, about) not in self._standing:
            self._standing.add((event, about))
            self.fail(event, sentence, **values)

    def over(self, event: str, about: str) -> None:
        """The fault does not stand any more: it is told when it comes again."""
        self._standing.discard((event, about))

    def tell(self, recording: str, lines: Iterable[Line]) -> None:
        """What the recorder of a recording said."""
        for line in lines:
            if line.said in _INFORM:
                about_topic = {} if line.topic is None else {"topic": line.topic}
                self.note(_INFORM[line.said], recording=recording, **about_topic)
            elif line.said in _ADVICE:
                about = f"{line.topic}: " if line.topic else ""
                sentence = f"{about}{_ADVICE[line.said]} ({line.text})"
                self.warn(line.said.value, sentence, recording=recording)
            elif line.said in {Said.ERROR, Said.FOLDER_EXISTS}:
                self.fail("recorder_error", line.text, recording=recording)
            else:
                self.warn("recorder_warning", line.text, recording=recording)
