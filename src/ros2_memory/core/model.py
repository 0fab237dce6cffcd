"""The domain model: windows, bags, samples, poses and transforms.

Immutable. Times are `Ns` of `log_time`; lengths are metres, angles radians; vectors are
(x, y, z) and quaternions (x, y, z, w), in the frames of REP-103 and REP-105.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.timebase import (
    AT_OR_BEFORE_SLACK_NS,
    MAX_NS,
    MIN_NS,
    NS_PER_US,
    START_SLACK_NS,
    Ns,
    Span,
    ns_from_unix,
)

if TYPE_CHECKING:
    from ros2_memory.core.arrays import Flags, Ints
    from ros2_memory.core.bag_summary import BagSummary

MCAP: Final = ".mcap"
SQLITE: Final = ".db3"
PLAIN_KINDS: Final = (MCAP, SQLITE)
UNMARKED_KINDS: Final = frozenset({SQLITE})
"""Kinds whose files do not show whether their writer has finished."""
COMPRESSED: Final = ".zstd"
BAG_KINDS: Final = (*PLAIN_KINDS, *(f"{kind}{COMPRESSED}" for kind in PLAIN_KINDS))
"""Suffixes of bag files, whichever adapter reads them."""

JsonValue: TypeAlias = "bool | int | float | str | list[JsonValue] | dict[str, JsonValue] | None"
"""The values of a reply; NaN and infinities are not JSON and become null before they are sent."""

_CACHED_PATHS: Final = 2048
"""Files and folders that a query may read; a `Path` is as large as the rest of a `BagFile`."""

Vector3: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]


def _whole_us(time: Ns) -> Ns:
    """Rounds a time to whole microseconds, half a microsecond up."""
    return (time + NS_PER_US // 2) // NS_PER_US * NS_PER_US


@dataclass(frozen=True, slots=True)
class TimeWindow:
    """A half-open span of log time, `[start, stop)`."""

    start: Ns
    stop: Ns

    @classmethod
    def from_unix(cls, start_s: float | None, end_s: float | None) -> TimeWindow:
        """Returns the window of an inclusive query `[start_s, end_s]` in Unix seconds.

        Bounds are granted the tolerance of a float of seconds (see `timebase`). None leaves an end
        open: it is `MIN_NS` or `MAX_NS`.

        Raises:
            InvalidArgumentsError: a bound is not finite, or the start is after the end.
        """
        try:
            start = MIN_NS if start_s is None else ns_from_unix(start_s)
            end = MAX_NS if end_s is None else ns_from_unix(end_s)
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
        """Returns the window of all times."""
        return cls(MIN_NS, MAX_NS)

    @classmethod
    def until(cls, end: Ns) -> TimeWindow:
        """Returns the window of all times up to and including `end`."""
        return cls(MIN_NS, min(end + 1, MAX_NS))

    @classmethod
    def before(cls, moment: Ns, reach: Ns) -> TimeWindow:
        """Returns the window from `reach` before a moment up to and including it."""
        return cls(max(moment - reach, MIN_NS), moment + 1)

    @classmethod
    def around(cls, moment: Ns, reach: Ns) -> TimeWindow:
        """Returns the window from `reach` before a moment up to and including `reach` after it."""
        return cls(max(moment - reach, MIN_NS), min(moment + reach + 1, MAX_NS))

    def asked(self) -> Span:
        """Returns the inclusive bounds that were asked for, without the tolerance of floats.

        They are rounded to microseconds, which a float of seconds resolves. A window that was
        clamped to less than the tolerance gives its start twice.
        """
        start = _whole_us(self.start + START_SLACK_NS)
        return start, max(start, _whole_us(self.stop - 1 - AT_OR_BEFORE_SLACK_NS))

    def contains(self, at: Ns) -> bool:
        """Returns whether a time lies inside."""
        return self.start <= at < self.stop

    def overlaps(self, first: Ns, last: Ns) -> bool:
        """Returns whether any time of the inclusive span `[first, last]` lies inside."""
        return first < self.stop and last >= self.start

    def holding(self, times: Ints) -> Flags:
        """Returns which times lie inside."""
        return (times >= self.start) & (times < self.stop)

    def overlapping(self, firsts: Ints, lasts: Ints) -> Flags:
        """Returns which inclusive spans overlap the window, as `overlaps`."""
        return (firsts < self.stop) & (lasts >= self.start)

    def covers(self, first: Ns, last: Ns) -> bool:
        """Returns whether all of the inclusive span `[first, last]` lies inside."""
        return self.start <= first and last < self.stop

    def intersect(self, other: TimeWindow) -> TimeWindow:
        """Returns the part that both share; empty (`start == stop`) if there is none."""
        start = max(self.start, other.start)
        return TimeWindow(start, max(start, min(self.stop, other.stop)))

    def aligned(self, length: Ns) -> TimeWindow:
        """Returns the window widened to multiples of a length at both ends."""
        start, stop = self.start // length * length, -(-self.stop // length) * length
        return TimeWindow(max(start, MIN_NS), min(stop, MAX_NS))

    def widened(self, by: Ns) -> TimeWindow:
        """Returns the window widened by a duration at both ends."""
        return TimeWindow(max(self.start - by, MIN_NS), min(self.stop + by, MAX_NS))

    @property
    def empty(self) -> bool:
        """Whether no time lies inside."""
        return self.stop <= self.start


class BagState(StrEnum):
    """The state of a bag file."""

    CLOSED = "closed"
    ACTIVE = "active"  # still being written: excluded unless reader.include_active
    INCOMPLETE = "incomplete"  # left open by a crash: its readable messages are served
    DAMAGED = "damaged"  # cannot be read at all: set aside with the reason


class BagFile(NamedTuple):
    """One bag file that answers queries (of any state but damaged, and not empty).

    Attributes:
        file: the path, as a string to save memory: the index keeps 60,000.
        start: the log time of the first message.
        end: the log time of the last message (inclusive).
        sidecar_ns: the mtime of `handover.json` beside the file, which decides which of its
            messages count; 0 without one.
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
    def identity(self) -> tuple[str, int, Ns, Ns, Ns, Ns]:
        """Equal only while the same messages of the file count."""
        return self.file, self.size, self.mtime_ns, self.sidecar_ns, self.start, self.end

    @property
    def path(self) -> Path:
        """The path; mostly the same object each time."""
        return _path(self.file)

    @property
    def recording(self) -> Path:
        """The directory of the rosbag2 recording that this file is a split of."""
        folder, slash, _ = self.file.rpartition("/")
        return folder_path(folder or slash)

    @property
    def window(self) -> TimeWindow:
        """The log times of its messages."""
        return TimeWindow(self.start, self.end + 1)

    def reaches_into(self, window: TimeWindow) -> bool:
        """Returns whether the bag's span overlaps a window."""
        return window.overlaps(self.start, self.end)


# Two caches, since a pass over all files would evict the folders.
_path = lru_cache(maxsize=_CACHED_PATHS)(Path)
folder_path = lru_cache(maxsize=_CACHED_PATHS)(Path)


@dataclass(frozen=True, slots=True)
class SetAside:
    """A file that does not answer: active, damaged, or of a kind that the adapter does not read.

    Attributes:
        written: when the file was last written to; None if that is unknown, or goes on.
        answers: whether the file is active, and its complete chunks answer all the same.
        until: the log time of the last message that answers (inclusive); None without one.
        growing: whether two scans saw the file grow, or a live recorder names it; another active
            file may as well have been left open by a crash.
    """

    path: Path
    reason: str
    written: Ns | None = None
    answers: bool = False
    until: Ns | None = None
    growing: bool = False


@dataclass(frozen=True, slots=True)
class Sample:
    """One message in the result of a query: its log time and its extracted value."""

    time: Ns
    value: JsonValue


@dataclass(frozen=True, slots=True)
class Pose:
    """Position (m) and orientation in `frame_id`; a zero or NaN quaternion is no orientation.

    `frame_id` is empty if the message names no frame. `places` are the named places around the
    position, the smallest first, if they were asked for.
    """

    position: Vector3
    orientation: Quaternion | None
    frame_id: str = ""
    places: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Geodetic:
    """A position on Earth (WGS 84): degrees north and east, metres above the ellipsoid or NaN.

    `has_fix` is False if the receiver reports `NavSatStatus.STATUS_NO_FIX`. `orientation` is from
    east, north and up; None if none is beside the position.
    """

    latitude: float
    longitude: float
    altitude: float
    frame_id: str = ""
    has_fix: bool = True
    orientation: Quaternion | None = None


@dataclass(frozen=True, slots=True)
class Twist:
    """Linear (m/s) and angular (rad/s) velocity expressed in `frame_id` (empty: unknown)."""

    linear: Vector3
    angular: Vector3
    frame_id: str


@dataclass(frozen=True, slots=True)
class Transform:
    """The pose of a child frame in its parent: a point p of the child lies at R p + t there."""

    translation: Vector3
    rotation: Quaternion


@dataclass(frozen=True, slots=True)
class FrameEdge:
    """A parent and a child frame; `static` unless a message of /tf names the pair."""

    parent: str
    child: str
    static: bool


@dataclass(frozen=True, slots=True)
class StampedTransform:
    """One edge of the frame graph as published, with its header stamp and its log time."""

    parent: str
    child: str
    stamp: Ns
    log_time: Ns
    transform: Transform
    static: bool
