"""What was forgotten: never again is it in the lake, whatever copies of bags come later.

Tombstones lie in the lake's state directory and are kept for ever. Each is written durably before
anything is deleted, and again as done when all of it is gone.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.durable_write import append_durably
from ros2_memory.bag_dir.json_fields import is_integer
from ros2_memory.core.errors import LakeError
from ros2_memory.core.model import TimeWindow

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Ns
    from ros2_memory.storage.base import BagReader

TOMBSTONES_FILE: Final = "tombstones.jsonl"


@dataclass(frozen=True, slots=True)
class Tombstone:
    """Messages of a robot that were forgotten: those of a window (log times, half-open)."""

    robot: str
    start: Ns
    stop: Ns

    @property
    def window(self) -> TimeWindow:
        """The window."""
        return TimeWindow(self.start, self.stop)

    def forbids(self, reader: BagReader, robot: str, bag: BagFile) -> bool:
        """Returns whether a bag has a message that was forgotten.

        Raises:
            BagError: it cannot be read.
        """
        if robot != self.robot or not self.window.overlaps(bag.start, bag.end):
            return False
        topics = tuple(each.topic for each in bag.summary.topics)
        return next(iter(reader.records(bag.path, topics, self.window)), None) is not None


def append_tombstone(state_dir: Path, tombstone: Tombstone, *, done: bool) -> None:
    """Appends a tombstone durably, or that it is done.

    Raises:
        LakeError: it cannot be written.
    """
    path = state_dir / TOMBSTONES_FILE
    try:
        append_durably(path, json.dumps({**asdict(tombstone), "done": done}) + "\n")
    except OSError as error:
        raise LakeError(f"{path} cannot be written: {error.strerror}") from error


def read_tombstones(state_dir: Path) -> dict[Tombstone, bool]:
    """Returns the tombstones, and whether each is done.

    Raises:
        LakeError: they cannot be read, or a line is damaged: nothing may be shipped then. A last
            line that a crash cut short is none.
    """
    path = state_dir / TOMBSTONES_FILE
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise LakeError(f"{path} cannot be read: {error}") from error
    found: dict[Tombstone, bool] = {}
    lines = text.split("\n")
    for number, line in enumerate(lines[:-1], 1):
        if not line:
            continue
        try:
            fields: object = json.loads(line)
        except ValueError:
            fields = None
        match fields:
            case {"robot": str(robot), "start": start, "stop": stop, "done": bool(done)} if (
                is_integer(start) and is_integer(stop)
            ):
                tombstone = Tombstone(robot, start, stop)
                found[tombstone] = done or found.get(tombstone, False)
            case _ if number == len(lines) - 1 or _was_cut(line):
                continue
            case _:
                raise LakeError(
                    f"{path}, line {number}: not a tombstone; nothing is shipped until it is "
                    "repaired, since what was forgotten could come back"
                )
    return found


def _was_cut(line: str) -> bool:
    """Returns whether a crash cut a line short: nothing was deleted for it yet."""
    return line.startswith("{") and not line.endswith("}")
