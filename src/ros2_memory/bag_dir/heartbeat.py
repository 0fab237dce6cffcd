"""`recorder.json` in the bag directory: the recorder's state, written every few seconds.

The recorder writes it, the query server reads it. The file may be of another version, cut short, or
the operator's own, so reading never fails: it returns the reason why there is no heartbeat. The
recorder lists a recording here before it makes the first file. While the heartbeat is live, an open
file of a recording that is not listed was left behind by a crash.
"""

from __future__ import annotations

import errno
import json
import os
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from functools import cache, lru_cache
from pathlib import Path
from typing import Annotated, Final, NamedTuple, TypeAlias

from pydantic import AfterValidator, ConfigDict, Field, TypeAdapter

from ros2_memory.bag_dir.durable_write import read_small_file, write_durably
from ros2_memory.bag_dir.json_files import Count, Int64, parsed
from ros2_memory.core.errors import RecorderError
from ros2_memory.core.text import encodable
from ros2_memory.core.timebase import MAX_NS, NS_PER_S, Ns, ns_from_unix

HEARTBEAT_FILE: Final = "recorder.json"
MAX_INTERVAL_S: Final = 3600.0
"""A heartbeat with a longer interval is refused: it would count as live for days."""

_DISK_FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT})
_BLOCK_BYTES: Final = 512  # the unit of `st_blocks` on every file system
_LIVE_INTERVALS: Final = 3
_ENDED: Final = frozenset("ZX")
"""States of processes in /proc that have ended: zombie, dead."""
_MIN_LIVE_NS: Final[Ns] = 15 * NS_PER_S

_Text: TypeAlias = Annotated[str, AfterValidator(encodable)]
_Texts: TypeAlias = tuple[_Text, ...]
_Pid: TypeAlias = Annotated[int, Field(strict=True, ge=1, le=MAX_NS)]
_Interval: TypeAlias = Annotated[float, Field(strict=True, gt=0, le=MAX_INTERVAL_S)]


class RecorderState(StrEnum):
    """What the recorder is doing."""

    STARTING = "starting"
    RECORDING = "recording"
    WAITING = "waiting"  # it would record, but nothing has come since it began
    PAUSED = "paused"  # running, but not recording: the disk is nearly full, or missing
    STOPPING = "stopping"
    STOPPED = "stopped"


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """One heartbeat of the recorder; `docs/reference/files.md` says what its fields mean.

    Attributes:
        recordings: the directories that are being written, relative to the bag directory with
            forward slashes; two during a rotation.
        unknown_types: topics that are offered and not recorded, since `ros2 bag record` does not
            know their type, or knows several; one topic of each type that it does not know.
        lost: the number of messages of each topic that are known to be missing in the last hour;
            topics need a counter or a regular header stamp for it.
    """

    __pydantic_config__ = ConfigDict(defer_build=True)

    pid: _Pid
    updated: Int64
    state: RecorderState
    recordings: _Texts
    since: Int64
    bytes_written: Count
    subscribed: _Texts
    silent: _Texts
    last_error: _Text | None
    interval_s: _Interval
    # Older recorders did not write these.
    restarts: Count = 0
    missing: _Texts = ()
    age_held: _Text | None = None
    lost: dict[_Text, Count] = field(default_factory=dict)
    cut_short: _Texts = ()
    waiting_for: _Text | None = None
    held_back: _Text | None = None
    failing_rules: _Texts = ()
    unshipped: _Text | None = None
    listed: _Texts = ()
    process: _Text | None = None
    counted_bytes: Count | None = None
    state_bytes: Count = 0
    last_error_at: Int64 | None = None
    recovered: bool = False
    unknown_types: _Texts = ()
    unheard: _Texts = ()
    fell_silent: _Texts = ()
    required_missing: _Texts = ()
    advice: _Text | None = None
    list_refused: _Text | None = None

    def is_live(self, now: Ns) -> bool:
        """Whether the recorder that wrote this probably still runs.

        `now` must be within three intervals (at least 15 s) of `updated`, on either side: a
        heartbeat from the future was written before the clock was set back. And its process must
        not have ended, if it can be looked up, as on the robot itself.
        """
        limit = max(ns_from_unix(_LIVE_INTERVALS * self.interval_s), _MIN_LIVE_NS)
        return abs(now - self.updated) <= limit and not self._has_ended()

    def _has_ended(self) -> bool:
        system, _, began = (self.process or "").rpartition("/")
        if not system or system != _system():
            return False
        state, since = _state_of(self.pid)
        if state:
            return state in _ENDED or since != began
        return not runs(self.pid)  # processes of others may be hidden in /proc


def runs(pid: int) -> bool:
    """Whether a process with this id exists, or may exist."""
    try:
        with suppress(PermissionError, OverflowError):
            os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def process_of(pid: int) -> str | None:
    """Returns an identity that no other process has; None without such a process, or without /proc.

    It consists of the boot, the namespace of process ids, and the start of the process.
    """
    system, (state, began) = _system(), _state_of(pid)
    return f"{system}/{began}" if system and state else None


@cache
def _system() -> str:
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{boot}/{Path('/proc/self/ns/pid').readlink()}"
    except OSError:
        return ""


def _state_of(pid: int) -> tuple[str, str]:
    """Returns the state and the start (ticks since boot) of a process; empty if none is found."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
        return fields[0], fields[19]
    except (OSError, IndexError):
        return "", ""


class HeartbeatReading(NamedTuple):
    """The heartbeat, or the reason why there is none."""

    heartbeat: Heartbeat | None
    reason: str | None

    @property
    def recordings(self) -> tuple[str, ...]:
        """The recordings that the heartbeat names, live or not."""
        return () if self.heartbeat is None else self.heartbeat.recordings


def read_heartbeat(bag_dir: Path) -> HeartbeatReading:
    """Returns the heartbeat in `recorder.json`, live or not. Raises nothing."""
    try:
        text = read_small_file(f"{bag_dir}/{HEARTBEAT_FILE}")
        return HeartbeatReading(_parse(text), None)
    except FileNotFoundError:
        return HeartbeatReading(None, f"there is no {HEARTBEAT_FILE}: no recorder has written here")
    except OSError as error:
        return HeartbeatReading(None, f"{HEARTBEAT_FILE} cannot be read: {error.strerror or error}")
    except ValueError as error:
        return HeartbeatReading(None, f"{HEARTBEAT_FILE} is not a valid heartbeat: {error}")


def write_heartbeat(bag_dir: Path, heartbeat: Heartbeat) -> None:
    """Replaces `recorder.json` atomically: a reader sees the old heartbeat or this one.

    On a full disk the file is overwritten in place, which needs no free block. A reader at that
    moment may find no heartbeat, and finds this one at its next look.

    Raises:
        RecorderError: the disk is full, even if the file was overwritten; or the file cannot be
            written, and the old one remains.
    """
    target = bag_dir / HEARTBEAT_FILE
    text = json.dumps(asdict(heartbeat), allow_nan=False, separators=(",", ":"))
    try:
        write_durably(target, text)
    except OSError as error:
        if error.errno in _DISK_FULL:
            _overwrite_in_place(target, text.encode())
        raise RecorderError(
            f"{target} cannot be written: {error.strerror or error}; "
            "free disk space or correct the permissions of the bag directory"
        ) from error


def _overwrite_in_place(target: Path, data: bytes) -> None:
    """Overwrites a file if its blocks have room for the data."""
    with suppress(OSError):
        descriptor = os.open(target, os.O_WRONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
        try:
            status = os.fstat(descriptor)
            if len(data) <= status.st_blocks * _BLOCK_BYTES:
                # Padded with blanks, so that one write covers the old content.
                os.pwrite(descriptor, data.ljust(status.st_size), 0)
        finally:
            os.close(descriptor)


_HEARTBEAT: Final = TypeAdapter(Heartbeat)


# Every question about the present reads the file, which changes every few seconds.
@lru_cache(4)
def _parse(text: str) -> Heartbeat:
    return parsed(_HEARTBEAT, text, has_paths=False)
