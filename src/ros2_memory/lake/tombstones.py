"""What was forgotten: never again is it in the lake, whatever copies of bags come later.

Tombstones lie in the lake's state directory and are kept for ever. Each is written durably before
anything is deleted, and again as done when all of it is gone.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, field, replace
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.json_files import Int64, JsonLog
from ros2_memory.core.errors import LakeError
from ros2_memory.core.model import TimeWindow
from ros2_memory.lake.rows import id_of_file

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.bag_dir.state_files import Forgetting
    from ros2_memory.core.model import BagFile
    from ros2_memory.storage.base import BagReader

TOMBSTONES_FILE: Final = "tombstones.jsonl"


@dataclass(frozen=True, slots=True)
class Tombstone:
    """Messages of a robot that were forgotten: those of a window (log times, half-open).

    Where there are `topics`, only theirs; where there are `bags`, all of these alone, by their ids.
    `done`: all of it is gone; two that differ in that alone are equal.
    """

    robot: str
    start: Int64
    stop: Int64
    topics: tuple[str, ...] = ()
    bags: tuple[str, ...] = ()
    done: bool = field(default=False, compare=False)

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


TOMBSTONES: Final = JsonLog(TOMBSTONES_FILE, Tombstone)


def append_tombstone(state_dir: Path, tombstone: Tombstone, *, done: bool) -> None:
    """Appends a tombstone durably, or that it is done.

    Raises:
        LakeError: it cannot be written.
    """
    try:
        TOMBSTONES.append(state_dir, [replace(tombstone, done=done)])
    except OSError as error:
        path = state_dir / TOMBSTONES_FILE
        raise LakeError(f"{path} cannot be written: {error.strerror}") from error


def read_tombstones(state_dir: Path) -> dict[Tombstone, bool]:
    """Returns the tombstones, and whether each is done.

    Raises:
        LakeError: they cannot be read, or a line is damaged: nothing may be shipped then.
    """
    found: dict[Tombstone, bool] = {}
    try:
        for _, each in TOMBSTONES.all_rows(state_dir):
            found[each] = each.done or found.get(each, False)
    except (OSError, ValueError) as error:
        raise LakeError(
            f"{state_dir / TOMBSTONES_FILE}: {error}; nothing is shipped until it is repaired, "
            "since what was forgotten could come back"
        ) from error
    return found
