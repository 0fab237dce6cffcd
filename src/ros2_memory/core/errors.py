"""The exceptions of this program.

    EpisodicError                 base; `code` is what reaches a client
    |-- ConfigError               invalid_config     the program does not start (exit code 2)
    |-- InvalidArgumentsError     invalid_arguments  a question that cannot be asked
    |-- NoDataError               no_data            an answer: there is no data, and why
    |-- QueryTimeoutError         timeout            the question needs more than call_timeout_s
    |-- BusyError                 busy               not begun: other calls were first
    |-- BagError                  bag_unreadable     a file that cannot be read at all
    |   |-- BagVanishedError      bag_unreadable     it is gone (retention, unmount)
    |   |-- BagContradictionError bag_unreadable     its indexes are wrong; read without them
    |   `-- BagUnreachableError   bag_unreadable     the disk or the machine fails, not the file
    |-- UndecodableError          undecodable        a message that cannot be decoded
    |-- RefusedError              refused            a request that is refused, and why
    |   `-- NotInLakeError        not_in_lake        messages that a lake does not hold
    |-- LakeError                 lake               a lake cannot be opened or written
    `-- RecorderError             recorder           recording cannot start or go on

Adapters translate every foreign exception into this tree; only `tools.replies` turns it into JSON.
"""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, ClassVar, Self

if TYPE_CHECKING:
    from collections.abc import Iterable


class EpisodicError(Exception):
    """Base of the tree. `str(error)` is a full sentence for the person or planner who asked."""

    code: ClassVar[str] = "internal"

    def detached(self) -> Self:
        """Returns the error itself, without what its traceback and causes refer to.

        One that a function catches and keeps refers to its frame, and the frame to the error: what
        the call read would stay in memory until the garbage collector finds the circle.
        """
        self.__context__ = self.__cause__ = None
        return self.with_traceback(None)


class ConfigError(EpisodicError):
    """The configuration is refused; the sentence names the key and what is allowed."""

    code = "invalid_config"


class InvalidArgumentsError(EpisodicError):
    """A call with invalid arguments; the sentence names the argument."""

    code = "invalid_arguments"


class NoDataReason(StrEnum):
    """Why there is no data."""

    TOPIC_NOT_RECORDED = "topic_not_recorded"
    OUTSIDE_RANGE = "outside_range"
    GAP = "gap"
    DELETED = "deleted"
    BETWEEN_MESSAGES = "between_messages"
    NOT_CLOSED_YET = "not_closed_yet"
    UNDECODABLE = "undecodable"
    FRAME_UNKNOWN = "frame_unknown"
    FRAMES_NOT_CONNECTED = "frames_not_connected"
    MIXED = "mixed"
    EMPTY_MEMORY = "empty_memory"


class NoDataError(EpisodicError):
    """There is no data; `detail` says what exists instead and what to ask.

    `notes` are sentences on data that could not be read, and may be what was asked for.
    """

    code = "no_data"

    def __init__(self, reason: NoDataReason, detail: str, notes: tuple[str, ...] = ()) -> None:
        super().__init__(detail)
        self.reason = reason
        self.detail = detail
        self.notes = notes


class QueryTimeoutError(EpisodicError):
    """The query passed its deadline.

    `searched_back_to` is the log time (ns) down to which a search found no match; None if the
    search cannot be continued.
    """

    code = "timeout"

    def __init__(self, sentence: str, searched_back_to: int | None = None) -> None:
        super().__init__(sentence)
        self.searched_back_to = searched_back_to


class BusyError(EpisodicError):
    """The call was not begun, because others were first; the sentence advises what to do."""

    code = "busy"


class BagError(EpisodicError):
    """A bag file that cannot be read: its `path`, and the `reason`.

    `lost` are the first and last log time (inclusive) of the messages that cannot be read, if other
    messages of the file can be read.
    """

    code = "bag_unreadable"

    def __init__(self, path: str, reason: str, lost: tuple[int, int] | None = None) -> None:
        super().__init__(f"{path}: {reason}")
        self.path = path
        self.reason = reason
        self.lost = lost


class BagVanishedError(BagError):
    """The bag file does not exist any more."""


class BagContradictionError(BagError):
    """A bag file whose indexes contradict its messages, which are read without the indexes.

    `lost` is the window of the query: reading goes on after it, and none of its messages is lost.
    """


class BagUnreachableError(BagError):
    """The disk failed, or a resource was exhausted: the file may be intact, and readable later."""


class UndecodableError(EpisodicError):
    """A message that cannot be decoded: its `topic` and `type_name`, and the `reason`."""

    code = "undecodable"

    def __init__(self, topic: str, type_name: str, reason: str) -> None:
        super().__init__(f"{topic} ({type_name}): {reason}")
        self.topic = topic
        self.type_name = type_name
        self.reason = reason


def to_report(failures: Iterable[UndecodableError]) -> UndecodableError:
    """Returns the error that a reply reports of several: the same in whatever order files are read.

    There is at least one.
    """
    return min(failures, key=str)


class RefusedError(EpisodicError):
    """A request is refused; the sentence gives the reason, and what to do instead."""

    code = "refused"


class NotInLakeError(RefusedError):
    """The answer needs messages that the lake does not hold; the robot's own memory may."""

    code = "not_in_lake"


class LakeError(EpisodicError):
    """A lake cannot be opened or written; nothing is lost, and what was left out is tried again."""

    code = "lake"


class RecorderError(EpisodicError):
    """Recording cannot start or continue; the sentence advises what to do."""

    code = "recorder"


def sqlite_code(error: Exception) -> int:
    """Returns the primary result code of SQLite; 0 for an error that is not SQLite's."""
    code: object = getattr(error, "sqlite_errorcode", 0)
    return code & 0xFF if isinstance(code, int) else 0
