"""What was forgotten: never again is it in the lake, whatever copies of bags come later.

Tombstones lie in the lake's state directory and are kept for ever. Each is written durably before
anything is deleted, and again as done when all of it is gone.
"""

from __future__ import annotations

import json
from dataclasses import asdict, astuple, dataclass
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.durable_write import append_durably
from ros2_memory.bag_dir.json_files import is_integer
from ros2_memory.core.errors import LakeError
from ros2_memory.core.model import TimeWindow
from ros2_memory.lake.rows import id_of_file

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.bag_dir.state_files import Forgetting
    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Ns
    from ros2_memory.storage.base import BagReader

TOMBSTONES_FILE: Final = "tombstones.jsonl"


@dataclass(frozen=True, slots=True)
class Tombstone:
    """Messages of a robot that were forgotten: those of a window (log times, half-open).

    Where there are `topics`, only theirs; where there are `bags`, all of these alone, by their ids.
    """

    robot: str
    start: Ns
    stop: Ns
    topics: tuple[str, ...] = ()
    bags: tuple[str, ...] = ()

    @property
    def window(self) -> TimeWindow:
        """The window."""
        return TimeWindow(self.start, self.stop)

    @classmethod
    def of(cls, robot: str, forgetting: Forgetting) -> Tombstone:
        """Returns what a robot's bag directory asks for."""
        ids = [id_of_file(robot, *astuple(each)) for each in forgetting.bags]
        return cls(robot, forgetting.start, forgetting.stop, forgetting.topics, tuple(ids))

    def forbids(self, reader: BagReader, robot: str, bag: BagFile, bag_id: str) -> bool:
        """Returns whether a bag has a message that was forgotten.

        Raises:
            BagError: it cannot be read.
        """
        if self.bags:
            return robot == self.robot and bag_id in self.bags
        if robot != self.robot or not self.window.overlaps(bag.start, bag.end):
            return False
        topics = tuple(
            each.topic
            for each in bag.summary.topics
            if not self.topics or each.topic in self.topics
        )
        return (
            bool(topics)
            and next(iter(reader.records(bag.path, topics, self.window)), None) is not None
        )


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
            line that a crash cut short is skipped.
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
            value: object = json.loads(line)
        except ValueError:
            value = None
        match value:
            case {
                "robot": str(robot),
                "start": start,
                "stop": stop,
                "done": bool(done),
                **more,
            } if is_integer(start) and is_integer(stop):
                names = [_names(more.get(key, []), path, number) for key in ("topics", "bags")]
                tombstone = Tombstone(robot, start, stop, *names)
                found[tombstone] = done or found.get(tombstone, False)
            case _ if number == len(lines) - 1 or _was_cut(line):
                continue
            case _:
                raise LakeError(
                    f"{path}, line {number}: not a tombstone; nothing is shipped until it is "
                    "repaired, since what was forgotten could come back"
                )
    return found


def _names(value: object, path: Path, line: int) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(each, str) for each in value):
        raise LakeError(f"{path}, line {line}: topics and bags must be lists of names")
    return tuple(value)


def _was_cut(line: str) -> bool:
    """Returns whether a crash cut a line short: nothing was deleted for it yet."""
    return line.startswith("{") and not line.endswith("}")
