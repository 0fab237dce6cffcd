"""The nouns that every room speaks: windows, bags, topics, samples, poses.

Frozen and slotted. Times are `Ns` of `log_time`; lengths are metres, angles radians; vectors are
(x, y, z) and quaternions (x, y, z, w), in the frames of REP-103 and REP-105.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from pathlib import Path
from typing import Final, NamedTuple, TypeAlias

from ros2_memory.core.bag_summary import BagSummary, TopicSummary
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.timebase import (
    AT_OR_BEFORE_SLACK_NS,
    MAX_NS,
    MIN_NS,
    START_SLACK_NS,
    Ns,
    ns_from_unix,
)

__all__ = [
    "BagFile",
    "BagState",
    "BagSummary",
    "JsonValue",
    "Pose",
    "Quaternion",
    "Sample",
    "SetAside",
    "StampedTransform",
    "TimeWindow",
    "TopicSummary",
    "Transform",
    "Twist",
    "Vector3",
]

JsonValue: TypeAlias = "bool | int | float | str | list[JsonValue] | dict[str, JsonValue] | None"
"""What a reply is made of; NaN and infinities are not JSON and become null before they leave."""

_PATHS_AT_HAND: Final = 2048
"""As many files and folders as a question may be about; a `Path` is as large as all the rest."""

Vector3: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class TimeWindow:
    """A half-open span of log time, `[start, stop)`."""

    start: Ns
    stop: Ns

    @classmethod
    def from_unix(cls, start_s: float, end_s: float) -> TimeWindow:
        """The window of an inclusive question `[start_s, end_s]` in Unix seconds.

        Both bounds are granted the slack of a float of seconds (see `timebase`).

        Raises:
            InvalidArgumentsError: a bound is not finite, or the start is after the end.
        """
        try:
            start, end = ns_from_unix(start_s), ns_from_unix(end_s)
        except ValueError as error:
            raise InvalidArgumentsError(
                f"the window's bounds must be Unix seconds: {error}"
            ) from error
        if start > end:
            raise InvalidArgumentsError(
                f"start ({start_s}) is after end ({end_s}); give the earlier time first"
            )
        return cls(
            max(start - START_SLACK_NS, MIN_NS), min(end + AT_OR_BEFORE_SLACK_NS + 1, MAX_NS)
        )

    @classmethod
    def everything(cls) -> TimeWindow:
        """All of time."""
        return cls(MIN_NS, MAX_NS)

    @classmethod
    def until(cls, end: Ns) -> TimeWindow:
        """All of time up to and including `end`."""
        return cls(MIN_NS, min(end + 1, MAX_NS))

    @classmethod
    def around(cls, moment: Ns, reach: Ns) -> TimeWindow:
        """Returns the window from `reach` before a moment up to and including `reach` after it."""
        return cls(max(moment - reach, MIN_NS), min(moment + reach + 1, MAX_NS))

    def asked(self) -> tuple[Ns, Ns]:
        """The inclusive bounds that were asked for, without the slack of floats of seconds.

        Of a window that was clamped to less than the slack, its first moment twice.
        """
        start = self.start + START_SLACK_NS
        return start, max(start, self.stop - 1 - AT_OR_BEFORE_SLACK_NS)

    def contains(self, moment: Ns) -> bool:
        """Whether the moment lies inside."""
        return self.start <= moment < self.stop

    def overlaps(self, first: Ns, last: Ns) -> bool:
        """Whether any moment of the inclusive span `[first, last]` lies inside."""
        return first < self.stop and last >= self.start

    def covers(self, first: Ns, last: Ns) -> bool:
        """Whether all of the inclusive span `[first, last]` lies inside."""
        return self.start <= first and last < self.stop

    def intersect(self, other: TimeWindow) -> TimeWindow:
        """The part that both share; empty (`start == stop`) where there is none."""
        start = max(self.start, other.start)
        return TimeWindow(start, max(start, min(self.stop, other.stop)))

    def widened(self, by: Ns) -> TimeWindow:
        """So much more on both sides."""
        return TimeWindow(max(self.start - by, MIN_NS), min(self.stop + by, MAX_NS))

    @property
    def empty(self) -> bool:
        """Whether no moment lies inside."""
        return self.stop <= self.start


class BagState(StrEnum):
    """How a bag file stands."""

    CLOSED = "closed"
    ACTIVE = "active"  # still being written: marked, and excluded unless reader.include_active
    INCOMPLETE = "incomplete"  # left open by a crash: its readable messages are served
    DAMAGED = "damaged"  # cannot be read at all: set aside with its reason


class BagFile(NamedTuple):
    """One bag file that answers questions (of any state but damaged, and not empty).

    `file` is its path as a text: of 60,000 files the index keeps no more. `start` and `end` are
    the log times of its first and last message, both inclusive. `sidecar_ns` is the mtime of the
    file beside it that says which of its messages count, or 0.
    """

    file: str
    size: int
    mtime_ns: Ns
    state: BagState
    summary: BagSummary
    start: Ns
    end: Ns
    sidecar_ns: Ns = 0

    @property
    def path(self) -> Path:
        """Where it lies; mostly the same object each time."""
        return _path(self.file)

    @property
    def recording(self) -> Path:
        """The rosbag2 recording that this file is a split of: its directory."""
        folder, slash, _ = self.file.rpartition("/")
        return _folder(folder or slash)


# Apart, since a pass over all files would drive out the folders.
@lru_cache(maxsize=_PATHS_AT_HAND)
def _path(text: str) -> Path:
    return Path(text)


@lru_cache(maxsize=_PATHS_AT_HAND)
def _folder(text: str) -> Path:
    return Path(text)


@dataclass(frozen=True, slots=True)
class SetAside:
    """A file that does not answer: active, damaged, or of a kind that the reader does not read.

    `written` is when it was last written to; None where that is not known, or goes on. `answers`:
    it is active, and what of it is whole answers all the same, up to `until` (the log time of its
    last message, inclusive; None where nothing of it is on disk yet).
    """

    path: Path
    reason: str
    written: Ns | None = None
    answers: bool = False
    until: Ns | None = None


@dataclass(frozen=True, slots=True)
class Sample:
    """One message as it leaves a query: its log time and its extracted value."""

    time: Ns
    value: JsonValue


@dataclass(frozen=True, slots=True)
class Pose:
    """Position (m) and orientation in `frame_id`; a zero or NaN quaternion is no orientation.

    `frame_id` is empty where the message names none.
    """

    position: Vector3
    orientation: Quaternion | None
    frame_id: str = ""


@dataclass(frozen=True, slots=True)
class Geodetic:
    """A place on the Earth (WGS 84): degrees north and east, metres above the ellipsoid or NaN."""

    latitude: float
    longitude: float
    altitude: float
    frame_id: str = ""


@dataclass(frozen=True, slots=True)
class Twist:
    """Linear (m/s) and angular (rad/s) velocity expressed in `frame_id` (empty: not said)."""

    linear: Vector3
    angular: Vector3
    frame_id: str = ""


@dataclass(frozen=True, slots=True)
class Transform:
    """The pose of a child frame in its parent: a point p of the child lies at R p + t there."""

    translation: Vector3
    rotation: Quaternion


@dataclass(frozen=True, slots=True)
class StampedTransform:
    """One edge of the frame graph as published: header stamp and log time both kept."""

    parent: str
    child: str
    stamp: Ns
    log_time: Ns
    transform: Transform
    static: bool
