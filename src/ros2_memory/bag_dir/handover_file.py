"""`handover.json` in a recording's directory: which of its messages count.

While one recording takes over from another, both run for some seconds and record the same messages.
The recorder writes down a cut in publish time: a message published before the cut counts in the old
recording, any other in the new one. The publish time of a message is the same in both, to the
nanosecond; its log time is not. Clocks step, so a cut applies only in the files that were open, to
messages with a log time in the overlap. Elsewhere every message counts.

    rec_A: {"format": 1, "state": "counts", "clock": "publish", "next": "rec_B",
            "counts_until_ns": 1795150000500000000,
            "end": {"log_from_ns": ..., "log_until_ns": ..., "files": ["rec_A_59.mcap"]}, ...}
    rec_B: {"format": 1, "state": "counts", "clock": "publish", "previous": "rec_A",
            "counts_from_ns": 1795150000500000000,
            "begin": {"log_from_ns": ..., "log_until_ns": ..., "files": ["rec_B_0.mcap"]}, ...}

If one recorder stalled, the cut would hide messages that only the other one has. So once the files
on both sides are closed, the recorder compares them (`recorder.handover`), and lists the messages
that the cut gets wrong, by file and topic: `also_counts` here, or `counts_elsewhere`. A message is
the same in both recordings by topic, publish time and payload.

Every recording receives latched messages again, long after they were published, so no cut applies
to a latched channel. Queries recognise them by topic, publish time and payload.
"""

from __future__ import annotations

import errno
import json
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple, TypeAlias
from zlib import crc32

from pydantic import AfterValidator, ConfigDict, StringConstraints, TypeAdapter

from ros2_memory.bag_dir.durable_write import read_small_file, write_all_durably
from ros2_memory.bag_dir.json_files import Int64, parsed
from ros2_memory.bag_dir.layout import HANDOVER_FILE
from ros2_memory.core.errors import RecorderError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping
    from pathlib import Path

    from ros2_memory.storage.base import Record

FORMAT: Final = 1
LOG_CLOCK_NOTE: Final = (
    "publish times equal log times in this recording, so the cut is by log time: "
    "a message received within a millisecond of it may count twice or not at all"
)


class Counting(StrEnum):
    """Whether a recording counts."""

    COUNTS = "counts"
    PENDING = "pending"  # it is taking over: the previous recording still has all messages
    VOID = "void"  # it did not take over: the previous recording went on, and has all messages


class CutClock(StrEnum):
    """The clock of the cut: LOG if publish times equal log times."""

    PUBLISH = "publish"
    LOG = "log"


def _checked_name(value: str) -> str:
    if "/" in value or value in {"", ".", ".."}:
        raise ValueError("it must be the name of a recording")
    return value


_Name: TypeAlias = Annotated[str, AfterValidator(_checked_name)]
_MessageId: TypeAlias = Annotated[str, StringConstraints(pattern=r"^-?\d{1,19} [0-9a-f]{8}$")]
MessageList: TypeAlias = "dict[str, dict[str, tuple[_MessageId, ...]]]"
"""Messages by file and topic, as `message_id` returns them."""
_Time: TypeAlias = Int64 | None
# In the file, keys of times end in `_ns`.
_KEYS: Final = ConfigDict(
    alias_generator=lambda name: f"{name}_ns" if name.endswith(("_from", "_until")) else name,
    defer_build=True,
)


@dataclass(frozen=True, slots=True)
class Overlap:
    """Where a cut applies: in these files, to log times in the half-open `[log_from, log_until)`.

    None leaves a side open: the log times of a simulated clock are unknown in advance.
    """

    __pydantic_config__ = _KEYS

    log_from: _Time
    log_until: _Time
    files: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Handover:
    """The content of `handover.json`; by default every message counts.

    A `next` without `counts_until` is a handover that was begun and not finished.

    Attributes:
        previous: the name of the recording that this one took over from.
        counts_from: in `begin`, messages published earlier count in the previous recording.
        next: the name of the recording that took over from this one.
        counts_until: in `end`, messages published then or later count in the next recording.
        compared: False until the recording was compared with the previous one; None in files of
            versions that did not compare.
        also_counts: messages that count here, against the cut.
        counts_elsewhere: messages that do not count here, against the cut.
    """

    __pydantic_config__ = _KEYS

    state: Counting = Counting.COUNTS
    clock: CutClock = CutClock.PUBLISH
    previous: _Name | None = None
    counts_from: _Time = None
    begin: Overlap | None = None
    next: _Name | None = None
    counts_until: _Time = None
    end: Overlap | None = None
    notes: tuple[str, ...] = ()
    compared: bool | None = None
    also_counts: MessageList = field(default_factory=dict)
    counts_elsewhere: MessageList = field(default_factory=dict)

    @property
    def hides_all(self) -> bool:
        """Whether no message of the recording counts except those in `also_counts`."""
        return self.state is not Counting.COUNTS

    def rule(self, file_name: str) -> FileRule | None:
        """Returns which messages of one bag file count; None if all do, as in most files."""
        sides = (
            (self.begin, MIN_NS, self.counts_from),
            (self.end, self.counts_until, MAX_NS),
        )
        exclusions = [_EVERYTHING] if self.hides_all else []
        for overlap, start, stop in sides:
            if overlap and start is not None and stop is not None and file_name in overlap.files:
                logged = TimeWindow(
                    MIN_NS if overlap.log_from is None else overlap.log_from,
                    MAX_NS if overlap.log_until is None else overlap.log_until,
                )
                exclusions.append(Exclusion(TimeWindow(start, stop), logged))
        elsewhere = _listed_in(self.counts_elsewhere, file_name)
        if not (exclusions or elsewhere):
            return None
        also = _listed_in(self.also_counts, file_name)
        return FileRule(tuple(exclusions), also, elsewhere, hides_latched=self.hides_all)


def _listed_in(messages: MessageList, file_name: str) -> dict[str, frozenset[str]]:
    """Returns the listed messages of one bag file by topic."""
    return {topic: frozenset(ids) for topic, ids in messages.get(file_name, {}).items()}


_HANDOVER: Final = TypeAdapter(Handover)


class Exclusion(NamedTuple):
    """Publish and log times of messages in one file that count in another recording."""

    published: TimeWindow
    logged: TimeWindow

    def excludes(self, publish_time: Ns, log_time: Ns) -> bool:
        """Whether a message with these times counts in another recording.

        A publish time of 0 means that there is none: then the log time decides.
        """
        is_published = self.published.contains(publish_time or log_time)
        return is_published and self.logged.contains(log_time)


_EVERYTHING: Final = Exclusion(TimeWindow.everything(), TimeWindow.everything())


def message_id(publish_time: Ns, payload: bytes) -> str:
    """Returns the identity of a topic's message: its publish time (ns) and its payload's CRC-32."""
    return f"{publish_time} {crc32(payload):08x}"


class FileRule(NamedTuple):
    """Which messages of one bag file count.

    Attributes:
        exclusions: messages that do not count unless `also` lists them.
        also: listed messages that count, by topic.
        elsewhere: listed messages that do not count, by topic.
        hides_latched: whether exclusions apply to latched messages as well.
    """

    exclusions: tuple[Exclusion, ...]
    also: Mapping[str, frozenset[str]]
    elsewhere: Mapping[str, frozenset[str]]
    hides_latched: bool

    @property
    def hides_all(self) -> bool:
        """Whether no message of the file counts."""
        return self.hides_latched and not self.also

    def counts(self, record: Record) -> bool:
        """Whether a message of the file counts."""
        channel = record.channel
        is_excluded = (self.hides_latched or not channel.latched) and any(
            exclusion.excludes(record.publish_time, record.log_time)
            for exclusion in self.exclusions
        )
        listed = (self.also if is_excluded else self.elsewhere).get(channel.topic)
        if not listed:
            return not is_excluded
        is_listed = message_id(record.publish_time, record.payload) in listed
        return is_listed == is_excluded

    def touches(self, window: TimeWindow, topics: Collection[str]) -> bool:
        """Whether some message of the topics, with a log time in a window, may not count."""
        return any(topic in self.elsewhere for topic in topics) or any(
            not window.intersect(exclusion.logged).empty for exclusion in self.exclusions
        )


_PERMANENT: Final = frozenset({errno.EACCES, errno.EPERM, errno.ELOOP, errno.ENAMETOOLONG})
"""Errors that do not go away by themselves."""


class HandoverReading(NamedTuple):
    """The content of a sidecar, or the reason why it is not valid: then every message counts."""

    handover: Handover
    problem: str | None


def read_handover(recording: Path) -> HandoverReading:
    """Returns the sidecar of a recording. Raises nothing: without one every message counts."""
    try:
        return sure_handover(recording)
    except OSError as error:
        return HandoverReading(Handover(), _unreadable(error))


def sure_handover(recording: Path) -> HandoverReading:
    """Returns the sidecar of a recording, as `read_handover` does, unless the disk fails.

    Raises:
        OSError: the disk fails, or a resource is exhausted, so there may be a sidecar.
    """
    try:
        text = read_small_file(recording / HANDOVER_FILE)
        return HandoverReading(parsed(_HANDOVER, text, FORMAT), None)
    except (FileNotFoundError, NotADirectoryError):
        return HandoverReading(Handover(), None)
    except OSError as error:
        if error.errno not in _PERMANENT:
            raise
        reason = _unreadable(error)
    except ValueError as error:
        reason = f"{HANDOVER_FILE} is not a valid sidecar: {error}"
    return HandoverReading(Handover(), reason)


def handover_to_change(recording: Path) -> Handover:
    """Returns the sidecar of a recording, to be changed and written again.

    Raises:
        RecorderError: the disk fails, so that writing might lose the present content.
    """
    try:
        return sure_handover(recording).handover
    except OSError as error:
        raise RecorderError(f"{recording}: {_unreadable(error)}") from error


def _unreadable(error: OSError) -> str:
    return f"{HANDOVER_FILE} cannot be read: {error.strerror or error}"


def write_handover(recording: Path, handover: Handover) -> None:
    """Replaces the sidecar atomically and flushes it.

    Raises:
        RecorderError: the sidecar cannot be written; the old one remains.
    """
    write_handovers({recording: handover})


def write_handovers(handovers: Mapping[Path, Handover]) -> None:
    """Replaces the sidecars of recordings, in this order; a full disk leaves all as they are.

    Raises:
        RecorderError: a sidecar cannot be written.
    """
    texts: dict[Path, str] = {}
    for recording, handover in handovers.items():
        content = {"format": FORMAT, **_HANDOVER.dump_python(handover, by_alias=True)}
        texts[recording / HANDOVER_FILE] = json.dumps(content, indent=1) + "\n"
    try:
        write_all_durably(texts)
    except OSError as error:
        targets = ", ".join(str(target) for target in texts)
        raise RecorderError(f"{targets} cannot be written: {error.strerror or error}") from error
