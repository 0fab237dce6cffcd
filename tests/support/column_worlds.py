"""Memories with a store of columns, and what they scan beside what plain reading finds."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.bag_dir.layout import OWN_FOLDER
from ros2_memory.columns.fill import Batch, Filling, StoreLimits
from ros2_memory.columns.scanner import Scanner
from ros2_memory.columns.store import FILE, ColumnStore
from ros2_memory.columns.stored import StoredTable
from ros2_memory.columns.table import Table
from ros2_memory.columns.writing import Level
from ros2_memory.core.errors import UndecodableError
from ros2_memory.core.model import BagFile, TimeWindow
from ros2_memory.core.timebase import Clock
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.scan import scan
from ros2_memory.history.view import View
from ros2_memory.serving.backfill import make_fragments
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
from tests.support.leaves import Comparison
from tests.support.memories import memory_of

EVERYTHING = TimeWindow.everything()


def store_file(bag_dir: Path) -> Path:
    return bag_dir / OWN_FOLDER / FILE


@dataclass(frozen=True)
class World:
    """A bag directory, a memory of it with a store, and what fills that."""

    bag_dir: Path
    memory: Memory
    filling: Filling

    @classmethod
    def of(
        cls,
        bag_dir: Path,
        *,
        limits: StoreLimits | None = None,
        files: Sequence[Path] | None = None,
        clock: Clock | None = None,
    ) -> "World":
        reader = BagDirReader(Rosbag2Reader(), bag_dir)
        memory = memory_of(bag_dir, clock=clock, reader=reader)
        store = ColumnStore([store_file(bag_dir)] if files is None else files, reader.definition)
        memory = replace(memory, scanner=Scanner(store, bag_dir))
        assert memory.scanner is not None
        filling = Filling(memory.scanner, reader, bag_dir, memory.clock, limits or StoreLimits())
        return cls(bag_dir, memory, filling)

    @property
    def store(self) -> ColumnStore:
        return self.filling.store

    def fill(self) -> int:
        """Stores all that waits; returns how many bags were stored."""
        done = 0
        while True:
            timeline = self.memory.index.snapshot().timeline
            batches = self.filling.batches(timeline)
            stored = sum(self.filling.fill(batch, timeline) for batch in batches)
            make_fragments(self.memory, self.filling.whole_since())
            self.filling.thin()
            self.filling.trim()
            if not stored:
                return done
            done += stored

    def fill_alone(self, bags: Iterable[BagFile] | None = None) -> int:
        """Stores bags, all that wait, each in parts of its own; returns how many."""
        timeline = self.memory.index.snapshot().timeline
        some = self.filling.waiting(timeline) if bags is None else bags
        return sum(self.filling.fill(Batch([bag], Level.BAG), timeline) for bag in some)

    def prune(self) -> None:
        self.filling.prune(self.memory.index.snapshot().timeline)

    def stored(self) -> set[str]:
        """The paths of the bags that are stored as they are now."""
        coverage = self.filling._scanner.coverage(self.memory.index.snapshot().timeline)
        assert coverage is not None
        missing = {bag.file for bag in coverage.missing}
        bags = self.memory.index.snapshot().timeline.bags
        return {str(bag.path.relative_to(self.bag_dir)) for bag in bags if bag.file not in missing}

    def unstored(self) -> "World":
        """The same world without a store: everything is read from bags."""
        columns = Scanner(None, self.bag_dir)
        return replace(self, memory=replace(self.memory, scanner=columns))

    def topics(self) -> list[str]:
        timeline = self.memory.index.snapshot().timeline
        return sorted({topic.topic for bag in timeline.bags for topic in bag.summary.topics})


def times(world: World, topic: str) -> list[int]:
    """The log times of what a scan yields, sorted."""
    view = View(world.memory, Call())
    return sorted(time for rows in scan(view, topic, EVERYTHING) for time in rows.times.tolist())


def check_rows(
    world: World, topic: str, window: TimeWindow = EVERYTHING, *, newest_first: bool = False
) -> int:
    """Compares what a scan yields with the messages of the same window; returns how many.

    Times and types must be the same, and each column that of the decoded message, within the error
    that the table states.
    """
    view = View(world.memory, Call())
    found: dict[tuple[int, str], list[tuple[Table, int]]] = defaultdict(list)
    for rows in scan(view, topic, window, newest_first=newest_first):
        index = np.arange(len(rows)) if rows.index is None else rows.index
        assert len(rows) == rows.times.size == index.size > 0
        for time, row in zip(rows.times.tolist(), index.tolist(), strict=True):
            found[time, rows.table.channel.type].append((rows.table, row))
    expected: dict[tuple[int, str], list[object]] = defaultdict(list)
    plain = View(world.memory, Call())
    for message in plain.stream.messages([topic], window):
        try:
            decoded: object = world.memory.reader.decode(message.record)
        except UndecodableError:
            decoded = None
        expected[message.record.log_time, message.record.channel.type].append(decoded)
    alone: dict[int, tuple[Table, list[int], list[object]]] = {}
    for key in sorted(found.keys() | expected.keys()):
        rows_then, messages = found[key], expected[key]
        if len(rows_then) != 1 or len(messages) != 1 or messages[0] is None:
            _check_one_time(f"{topic} at {key}", rows_then, messages)
            continue
        [(table, row)] = rows_then
        if "" not in table.left_out:
            _, indices, of_table = alone.setdefault(id(table), (table, [], []))
            indices.append(row)
            of_table.append(messages[0])
    for table, indices, of_table in alone.values():
        comparison = Comparison(_error_of(table))
        comparison.table(table.rows(np.array(indices)), of_table)
        assert comparison.wrong == [], f"{topic}: {comparison.wrong[:3]}"
    return sum(map(len, found.values()))


def _error_of(table: Table) -> Callable[[str], float]:
    return table.error if isinstance(table, StoredTable) else lambda _: 0.0


def _check_one_time(where: str, rows: list[tuple[Table, int]], messages: list[object]) -> None:
    """Compares the rows of one log time and type, of which each has one message."""
    left = [message for message in messages if message is not None]
    for table, row in rows:
        if "" in table.left_out:  # no definition, or not CDR
            messages = messages[1:]
            left = left[1:]
            continue
        wrong: list[str] = []
        for nth, message in enumerate(left):
            comparison = Comparison(_error_of(table))
            comparison.table(table.rows(np.array([row])), [message])
            if not comparison.wrong:
                del left[nth]
                break
            wrong += comparison.wrong
        else:
            raise AssertionError(f"{where}: no message is like row {row}: {wrong}")
    assert left == [], f"{where}: {len(left)} messages have no row"


def check_all(world: World) -> int:
    """As `check_rows`, of every topic."""
    return sum(check_rows(world, topic, EVERYTHING) for topic in world.topics())
