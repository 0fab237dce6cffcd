"""`.episodic/screened.json`: what `recording.exclude_when` holds back, and what it has excluded.

The recorder lists a recording here before anything of it exists. From then on none of its files is
served, neither by the query server nor to anything that the recorder does with closed bags, until
it is listed as released: by then what is to be excluded has been cut out of it. A recording of
which nothing is left to be released is done, and as free as one that is not listed.

What the rules know is written before a file is cut: what the cut takes cannot be read again.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from functools import lru_cache
from typing import TYPE_CHECKING, Final, NamedTuple

from pydantic import StrictBool, TypeAdapter

from ros2_memory.bag_dir.durable_write import read_small_file, write_durably
from ros2_memory.bag_dir.json_fields import Int64, json_object, validated
from ros2_memory.bag_dir.layout import OWN_FOLDER, SCREENED_FILE, has_own_name

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.core.timebase import Ns

FORMAT: Final = 1
_READABLE: Final = 0o644  # the two programs may run as different users


@dataclass(slots=True)
class ConditionInterval:
    """An interval in which a topic's condition kept its value, in one recording.

    Attributes:
        first: log time of the first message of it.
        last: log time of the last message of it.
        holds: whether the condition held; None: a message could not be read.
        lasts: the topic is latched: it says nothing while nothing changes.
    """

    first: Int64
    last: Int64
    holds: StrictBool | None
    lasts: StrictBool = False


class FileStep(StrEnum):
    """How far a closed file has come."""

    READ = "read"  # by the rules, and not served yet
    RELEASED = "released"
    UNREADABLE = "unreadable"  # it stays as it is, and is not served


@dataclass(slots=True)
class RecordingScreen:
    """The state of one recording.

    Attributes:
        done: nothing of it is held back any more.
        start: log time of its first message; None before one was read.
        end: log time of its last message that was read; None likewise.
        files: its closed files, by name.
        heard: for each rule the values of its topic, in the order in which they were written.
        unclear: spans of log time in which the clock was set back, so that no order is known.
    """

    done: StrictBool = False
    start: Int64 | None = None
    end: Int64 | None = None
    files: dict[str, FileStep] = field(default_factory=dict)
    heard: dict[str, list[ConditionInterval]] = field(default_factory=dict)
    unclear: list[tuple[Int64, Int64]] = field(default_factory=list)


@dataclass(slots=True)
class Excluded:
    """A stretch of log time (half-open) of which nothing stays.

    `held`: the condition held; else it was not known.
    """

    start: Int64
    stop: Int64
    held: StrictBool = True


@dataclass(slots=True)
class ScreenState:
    """All that is known: recordings in the order in which they began, and what was excluded."""

    recordings: dict[str, RecordingScreen] = field(default_factory=dict)
    excluded: list[Excluded] = field(default_factory=list)


class Gate(NamedTuple):
    """Which files are not served yet.

    `state` is None where the file cannot be read: then no file of a recording is.
    """

    state: ScreenState | None

    def holds(self, recording: str, file: str) -> bool:
        """Returns whether a file of a recording is held back; both by their names."""
        if self.state is None:
            return has_own_name(recording)
        screen = self.state.recordings.get(recording)
        if screen is None or screen.done:
            return False
        return screen.files.get(file) is not FileStep.RELEASED

    def holds_some(self, recording: str) -> bool:
        """Returns whether files of a recording are held back, or may come to be."""
        if self.state is None:
            return has_own_name(recording)
        screen = self.state.recordings.get(recording)
        return screen is not None and not screen.done


OPEN_GATE: Final = Gate(ScreenState())
"""Holds nothing back."""

_STATE: Final = TypeAdapter(ScreenState)


def read_screen_state(bag_dir: Path) -> ScreenState | None:
    """Returns the state, to be changed; None if there is none.

    Raises:
        OSError: it cannot be read.
        ValueError: it is damaged, or of another format.
    """
    try:
        return _parse(read_small_file(bag_dir / SCREENED_FILE))
    except (FileNotFoundError, NotADirectoryError):
        return None


def read_gate(bag_dir: Path) -> Gate:
    """Returns what is held back at this moment. Raises nothing."""
    path = bag_dir / SCREENED_FILE
    try:
        status = path.stat()
        return Gate(_known(path, status.st_mtime_ns, status.st_size, status.st_ino))
    except (FileNotFoundError, NotADirectoryError):
        return OPEN_GATE
    except (OSError, ValueError):
        return Gate(None)


def excluded_between(bag_dir: Path, start: Ns, stop: Ns) -> list[Excluded]:
    """Returns the stretches that were excluded between two log times."""
    state = read_gate(bag_dir).state
    known = () if state is None else state.excluded
    return [each for each in known if each.start < stop and start < each.stop]


def write_screen_state(bag_dir: Path, state: ScreenState) -> None:
    """Replaces the state atomically and flushes it.

    Raises:
        OSError: it cannot be written; the old one remains.
    """
    (bag_dir / OWN_FOLDER).mkdir(parents=True, exist_ok=True)
    text = json.dumps({"format": FORMAT, **asdict(state)}, separators=(",", ":"))
    write_durably(bag_dir / SCREENED_FILE, text, mode=_READABLE)


def _parse(text: str) -> ScreenState:
    try:
        return validated(_STATE, json_object(text, FORMAT))
    except RecursionError as error:
        raise ValueError("it is nothing but brackets") from error


# Asked for by every scan and by many answers; the key says when the file has changed.
@lru_cache(2)
def _known(path: Path, _mtime_ns: int, _size: int, _inode: int) -> ScreenState:
    return _parse(read_small_file(path))
