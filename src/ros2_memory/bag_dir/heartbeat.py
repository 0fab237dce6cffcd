"""`recorder.json` in the bag directory: what the recorder says of itself every few seconds.

The recorder writes it, the query server reads it. A reader must expect anything: another version's
file, half a file, a file of the operator's. So reading never fails; it says why there is nothing.
A recorder names a recording here before it creates its first file: with a live heartbeat, an open
file of a recording that is not named counts as left behind by a crash.
"""

from __future__ import annotations

import errno
import json
import os
from dataclasses import asdict, dataclass
from enum import StrEnum
from functools import lru_cache
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.durable_write import read_small_file, write_durably
from ros2_memory.core.errors import RecorderError
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S, Ns, ns_from_unix

if TYPE_CHECKING:
    from pathlib import Path

HEARTBEAT_FILE: Final = "recorder.json"
MAX_INTERVAL_S: Final = 3600.0
"""A heartbeat that claims to come more rarely is not believed: it would count as live for days."""

_NO_ROOM: Final = frozenset({errno.ENOSPC, errno.EDQUOT})
_BLOCK: Final = 512  # that is what `st_blocks` counts, whatever the file system
_PATIENCE_INTERVALS: Final = 3
_PATIENCE_AT_LEAST_NS: Final[Ns] = 15 * NS_PER_S


class RecorderState(StrEnum):
    """What the recorder is doing."""

    STARTING = "starting"
    RECORDING = "recording"
    PAUSED = "paused"  # alive, and not recording on purpose: the disk is nearly full, or gone
    STOPPING = "stopping"
    STOPPED = "stopped"


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """One heartbeat.

    `updated` and `since` (the start of this state) are wall clock time; it comes every
    `interval_s` seconds. `recordings` are the recordings being written, as directories relative to
    the bag directory with forward slashes; at a rotation there are two. `subscribed` are the
    topics subscribed to, `silent` those among them that have brought no message; `bytes_written`
    counts all recordings since the recorder started, `restarts` how often it had to start
    `ros2 bag record` anew. `missing` are the topics that are to be recorded, by name, and that no
    publisher has offered since then. `age_held` says which bags stay although they are too old by
    their dates, since the clock is not known to be right; None where there are none.
    """

    pid: int
    updated: Ns
    state: RecorderState
    recordings: tuple[str, ...]
    since: Ns
    bytes_written: int
    subscribed: tuple[str, ...]
    silent: tuple[str, ...]
    last_error: str | None
    interval_s: float
    restarts: int = 0
    missing: tuple[str, ...] = ()
    age_held: str | None = None

    def is_live(self, now: Ns) -> bool:
        """Whether the recorder that wrote this is likely to be there still.

        That is, it was updated within three intervals (at least 15 s) of `now`, on either side: a
        heartbeat from the future comes from before the clock was set back.
        """
        patience = max(ns_from_unix(_PATIENCE_INTERVALS * self.interval_s), _PATIENCE_AT_LEAST_NS)
        return abs(now - self.updated) <= patience


class HeartbeatReading(NamedTuple):
    """The heartbeat, or the reason why there is none."""

    heartbeat: Heartbeat | None
    reason: str | None


def read_heartbeat(bag_dir: Path) -> HeartbeatReading:
    """What the recorder last wrote into `recorder.json`, live or not. Raises nothing."""
    try:
        text = read_small_file(f"{bag_dir}/{HEARTBEAT_FILE}")
        return HeartbeatReading(_parsed(text), None)
    except FileNotFoundError:
        return HeartbeatReading(None, f"there is no {HEARTBEAT_FILE}: no recorder has written here")
    except OSError as error:
        return HeartbeatReading(None, f"{HEARTBEAT_FILE} cannot be read: {error.strerror or error}")
    # json raises RecursionError for a file of nothing but brackets.
    except (ValueError, TypeError, RecursionError) as error:
        return HeartbeatReading(None, f"{HEARTBEAT_FILE} is no heartbeat: {error}")


def write_heartbeat(bag_dir: Path, heartbeat: Heartbeat) -> None:
    """Replaces `recorder.json` at once: a reader sees the old one or this one, never a part.

    On a full disk it is overwritten where it lies, which needs no room: whoever reads it at that
    very moment may find no heartbeat, and finds this one when it looks again.

    Raises:
        RecorderError: the disk is full, whether it could be overwritten or not; or it cannot be
            written, and the old one stands.
    """
    target = bag_dir / HEARTBEAT_FILE
    text = json.dumps(asdict(heartbeat), allow_nan=False, separators=(",", ":"))
    try:
        write_durably(target, text)
    except OSError as error:
        if error.errno in _NO_ROOM:
            _overwritten(target, text.encode())
        raise RecorderError(
            f"{target} cannot be written: {error.strerror or error}; "
            "free disk space or correct the permissions of the bag directory"
        ) from error


def _overwritten(target: Path, data: bytes) -> bool:
    """Whether the file could take the text without a further block of the disk."""
    try:
        descriptor = os.open(target, os.O_WRONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:
        return False
    try:
        status = os.fstat(descriptor)
        if len(data) > status.st_blocks * _BLOCK:
            return False
        # Blanks behind it, in the same write, cover what was there before.
        return os.pwrite(descriptor, data.ljust(status.st_size), 0) >= len(data)
    except OSError:
        return False
    finally:
        os.close(descriptor)


# Read for every question about now, and written every few seconds.
@lru_cache(4)
def _parsed(text: str) -> Heartbeat:
    """The heartbeat in the text; a ValueError or TypeError names the key that is wrong."""
    value: object = json.loads(text)
    if not isinstance(value, dict):
        raise TypeError("it is not a JSON object")
    fields: dict[object, object] = value
    return Heartbeat(
        pid=_int(fields, "pid", least=1),
        updated=_int(fields, "updated"),
        state=_state(fields),
        recordings=_strings(fields, "recordings"),
        since=_int(fields, "since"),
        bytes_written=_int(fields, "bytes_written", least=0),
        subscribed=_strings(fields, "subscribed"),
        silent=_strings(fields, "silent"),
        last_error=_text_or_null(fields, "last_error"),
        interval_s=_interval(fields),
        # Those of an older recorder do not have them.
        restarts=_int(fields, "restarts", least=0) if "restarts" in fields else 0,
        missing=_strings(fields, "missing") if "missing" in fields else (),
        age_held=_text_or_null(fields, "age_held") if "age_held" in fields else None,
    )


def _get(fields: dict[object, object], key: str) -> object:
    if key not in fields:
        raise ValueError(f"it has no {key}")
    return fields[key]


def _int(fields: dict[object, object], key: str, *, least: int = MIN_NS) -> int:
    value = _get(fields, key)
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= MAX_NS:
        raise ValueError(f"{key} must be an integer from {least} to {MAX_NS}")
    return value


def _strings(fields: dict[object, object], key: str) -> tuple[str, ...]:
    value = _get(fields, key)
    if not isinstance(value, list) or not all(isinstance(each, str) for each in value):
        raise ValueError(f"{key} must be a list of strings")
    return tuple(value)


def _text_or_null(fields: dict[object, object], key: str) -> str | None:
    value = _get(fields, key)
    if value is not None and not isinstance(value, str):
        raise ValueError(f"{key} must be a string or null")
    return value


def _state(fields: dict[object, object]) -> RecorderState:
    value = _get(fields, "state")
    if value not in list(RecorderState):
        raise ValueError(f"state must be one of {', '.join(RecorderState)}")
    return RecorderState(str(value))


def _interval(fields: dict[object, object]) -> float:
    value = _get(fields, "interval_s")
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError("interval_s must be a number of seconds")
    if not 0 < value <= MAX_INTERVAL_S:
        raise ValueError(f"interval_s must be above 0 and at most {MAX_INTERVAL_S:g} s")
    return float(value)
