"""A home's first days, and what follows them for a year, as the recorder's housekeeping leaves it.

What follows is another life in the same flat: the robot begins it a minute after its first days.
"""

import shutil
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.recorder.days import MemoryDays, MemoryLimits
from ros2_memory.recorder.housekeeping import Housekeeping
from ros2_memory.retention.collect import GarbageCollector
from ros2_memory.retention.policy import RetentionLimits
from ros2_memory.retention.saved_moments import MomentKeeper
from ros2_memory.storage.mcap.writer import McapWriter
from ros2_memory.storage.mcap_reader import McapReader
from tests.home import world
from tests.home.asking import Question
from tests.home.days import Scale
from tests.home.recording import write
from tests.support.clocks import SettableClock
from tests.support.housekeepers import HOUR, PLENTY, Direct, own_all
from tests.support.memories import shipped_extractor

DAY_S = 86_400
_LATER_S = 60
"""A robot's clock is set by some seconds in its first days."""
_BOUNDED = frozenset({"data_time_range", "find_things", "find_matches", "visits"})


def write_later_days(first: Scale, begin: int, days: int, folder: Path) -> None:
    """Writes the bags of so many days from a day on; the world's first days come before it."""
    later = replace(first, seed=first.seed + 1, days=days)
    with patch.object(world, "START_S", world.START_S + begin * DAY_S + _LATER_S):
        write(later, folder)


class Year:
    """A bag directory with `memory.keep` in which bags stay for an hour, on its robot's clock."""

    def __init__(self, bag_dir: Path, split_s: float) -> None:
        self._bag_dir = bag_dir
        self._clock = SettableClock(0)
        reader, writer, own = BagDirReader(McapReader()), McapWriter(), own_all(bag_dir)
        collector = GarbageCollector(
            bag_dir,
            reader,
            writer,
            RetentionLimits(PLENTY, HOUR, keeps_foreign=True),
            own,
            is_synchronised=lambda: True,
            static_topics=("/tf_static",),
            memory=MemoryDays(
                bag_dir,
                reader,
                writer,
                own,
                shipped_extractor(),
                limits=MemoryLimits(texts=("*",), labels=("person",)),
                static_topics=("/tf_static",),
            ),
        )
        self._house = Housekeeping(
            bag_dir,
            reader,
            writer,
            self._clock,
            collector,
            MomentKeeper(bag_dir, 0, self._clock, own, {}),
            own=own,
            split_duration_s=split_s,
            background=Direct(),
        )

    def add(self, later: Path, day: int) -> None:
        """Has the robot record the bags of a later day (0 is the world's first)."""
        until = (world.START_S + (day + 1) * DAY_S + _LATER_S) * NS_PER_S
        for recording in sorted(later.iterdir()):
            bags = sorted(recording.glob("*.mcap"), key=lambda bag: bag.stat().st_mtime_ns)
            if bags[0].stat().st_mtime_ns >= until:
                break
            shutil.move(recording, self._bag_dir / f"later_{recording.name}")
        own_all(self._bag_dir)

    def age(self, day: int) -> None:
        """Deletes, an hour after a day, what is older than an hour."""
        self._clock.at = (world.START_S + (day + 1) * DAY_S + 3600) * NS_PER_S
        left: list[tuple[Path, int]] = []
        while left != (left := self._bags()):
            self._house.apply()

    def _bags(self) -> list[tuple[Path, int]]:
        return [(path, path.stat().st_size) for path in sorted(self._bag_dir.rglob("*.mcap"))]


def about(question: Question, first: Scale) -> Question:
    """Returns a question about a world's days, also when it is asked much later."""
    window = {"start": world.START_S, "end": world.START_S + first.days * DAY_S + _LATER_S}
    if question.tool not in _BOUNDED:
        return question
    return replace(question, arguments={**window, **question.arguments})
